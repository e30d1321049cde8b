"""Viewers of others draw what is exported as mgs draws it, and the PSNR of the run's own table.

NODE_MODULES: folder of the packages three, @sparkjsdev/spark and playcanvas; by default the one of
`npm root -g`.
"""

import base64
import io
import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from browser import opened
from PIL import Image
from program import command

from mgs import open_run, psnr
from mgs.camera import opengl_from_opencv
from mgs.colour import srgb_from_linear
from mgs.evaluation import render_view
from mgs.reports.exporting import to_y_up
from mgs.splat_files import FORMATS, load_gaussians

pytestmark = pytest.mark.slow

# PlayCanvas takes what a compressed PLY lacks below degree 3 as -0.016.
PADDED = "padded.compressed.ply"
HOST, NEAR, FAR = "http://localhost/", 0.01, 100.0

PAGE = """<script type="importmap">{"imports": {
    "three": "/three/build/three.module.js",
    "three/addons/": "/three/examples/jsm/",
    "@sparkjsdev/spark": "/@sparkjsdev/spark/dist/spark.module.js",
    "playcanvas": "/playcanvas/build/playcanvas.mjs"
}}</script><body></body>"""

READ = [("spark", kind) for kind in ("ply", "compressed-ply", "spz")]
READ += [("playcanvas", kind) for kind in ("ply", "compressed-ply", "glb")]
"""Formats that each viewer reads."""


@pytest.fixture(scope="module")
def packages():
    folder = os.environ.get("NODE_MODULES")
    if folder is None:
        npm = shutil.which("npm") or pytest.skip("npm is not installed")
        folder = subprocess.check_output([npm, "root", "-g"], text=True).strip()
    for name in ("three", "@sparkjsdev/spark", "playcanvas"):
        if not (Path(folder) / name).is_dir():
            pytest.skip(f"{folder}: has no {name} (npm install {name})")
    return Path(folder)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A small run of a rock whose colours have SH degree 1, with its exports."""
    root = tmp_path_factory.mktemp("viewers")
    orbit = ["--size", "160x120", "--orbit", "hemisphere", "--frames", "8", "--test-views", "1"]
    command("synth-orbit", root / "data", *orbit)
    command("fit", root / "data", "--out", root / "run", "--gaussians", 5000, "--sh", 1)
    command("eval", root / "run")
    for kind in FORMATS:
        command("export", root / "run", "--to", kind)
    command("export", root / "run", "--to", "compressed-ply", "--sh", 3, "--out", root / PADDED)
    return open_run(root / "run")


def projection(camera) -> np.ndarray:
    """OpenGL's projection [4,4] of a camera."""
    K, w, h = camera.K, camera.width, camera.height
    across = [2 * K[0, 0] / w, 0, 1 - 2 * K[0, 2] / w, 0]
    down = [0, 2 * K[1, 1] / h, 2 * K[1, 2] / h - 1, 0]
    depth = [0, 0, (NEAR + FAR) / (NEAR - FAR), 2 * NEAR * FAR / (NEAR - FAR)]
    return np.array([across, down, depth, [0, 0, -1, 0]])


@pytest.mark.parametrize(("viewer", "kind"), READ)
def test_a_viewer_shows_what_was_measured(browser, packages, run, viewer, kind):
    (frame,) = run.dataset.test_views().frames
    camera, file = frame.camera, run.folder / f"export{FORMATS[kind]}"
    if (viewer, kind) == ("playcanvas", "compressed-ply"):
        file = run.folder.parent / PADDED
    turn = np.eye(4)  # from the run's world to that of the file
    if kind == "glb":
        turn[:3, :3] = to_y_up(run.dataset.world.up)
    elif kind == "spz":
        turn = np.diag([1.0, -1, -1, 1])

    def serve(route):
        path = route.request.url.removeprefix(HOST)
        if not path:
            return route.fulfill(body=PAGE, content_type="text/html")
        local = {"viewers.mjs": Path(__file__).parent / path, file.name: file}
        kind = "text/javascript" if path.endswith("js") else "application/octet-stream"
        body = local.get(path, packages / path).read_bytes()
        return route.fulfill(body=body, content_type=kind)

    matrices = projection(camera), turn @ opengl_from_opencv(camera.world_to_camera)
    asked = [f"/{file.name}", camera.width, camera.height]
    asked += [matrix.T.ravel().tolist() for matrix in matrices]
    call = f"async (asked) => (await import('/viewers.mjs')).{viewer}(...asked)"
    with opened(browser, HOST, camera.width, camera.height, serve=serve) as (tab, wrong):
        picture = tab.evaluate(call, asked)
    assert wrong == []
    shown = Image.open(io.BytesIO(base64.b64decode(picture.split(",")[1]))).convert("RGB")
    shown = np.asarray(shown) / 255
    drawn = srgb_from_linear(render_view(load_gaussians(file), camera)[0])
    truth = srgb_from_linear(frame.target()[0][..., :3])
    measured = json.loads((run.folder / "metrics.json").read_text())["test_views"][0]["psnr"]
    print(viewer, kind, psnr(shown, drawn), psnr(shown, truth) - measured)
    assert psnr(shown, drawn) >= 45
    assert abs(psnr(shown, truth) - measured) <= 0.1
