"""Viewers of others draw what is exported as mgs draws it, and the PSNR of the run's own table.

NODE_MODULES: folder of the packages three, @sparkjsdev/spark and playcanvas; by default the one of
`npm root -g`. It may have @playcanvas/splat-transform, too. RUN: folder of an evaluated run
(`demo/directional-i`); by default a small fit.
"""

import base64
import io
import json
import os
import shutil
import subprocess
from dataclasses import replace
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
# Least agreement, and most that PSNR is off, dB: on a canvas of 8 bits, rounded at each blend; and
# in half floats. Those of RUN are of the demo (docs/howto/look.md).
LIMITS = OF_PADDED = (45, 0.1), (50, 0.1)
AS_IT_COMES = (45, 0.1), (45, 0.1)
if "RUN" in os.environ:
    LIMITS, OF_PADDED = ((45, 0.2), (55, 0.1)), ((45, 0.25), (55, 0.1))

PAGE = """<script type="importmap">{"imports": {
    "three": "/three/build/three.module.js",
    "three/addons/": "/three/examples/jsm/",
    "@sparkjsdev/spark": "/@sparkjsdev/spark/dist/spark.module.js",
    "playcanvas": "/playcanvas/build/playcanvas.mjs"
}}</script><body></body>"""

READ = [("sparkAsItComes", "ply")]
READ += [("spark", kind) for kind in ("ply", "compressed-ply", "spz")]
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
    """An evaluated run and a folder of its exports; colours of the small fit have SH degree 1."""
    root = tmp_path_factory.mktemp("viewers")
    folder = Path(os.environ.get("RUN", root / "run"))
    if folder == root / "run":
        orbit = ["--size", "160x120", "--orbit", "hemisphere", "--frames", "8", "--test-views", "1"]
        command("synth-orbit", root / "data", *orbit)
        command("fit", root / "data", "--out", folder, "--gaussians", 5000, "--sh", 1)
        command("eval", folder)
    for kind, ending in FORMATS.items():
        command("export", folder, "--to", kind, "--out", root / f"export{ending}")
    command("export", folder, "--to", "compressed-ply", "--sh", 3, "--out", root / PADDED)
    return open_run(folder), root


def projection(camera) -> np.ndarray:
    """OpenGL's projection [4,4] of a camera."""
    K, w, h = camera.K, camera.width, camera.height
    across = [2 * K[0, 0] / w, 0, 1 - 2 * K[0, 2] / w, 0]
    down = [0, 2 * K[1, 1] / h, 2 * K[1, 2] / h - 1, 0]
    depth = [0, 0, (NEAR + FAR) / (NEAR - FAR), 2 * NEAR * FAR / (NEAR - FAR)]
    return np.array([across, down, depth, [0, 0, -1, 0]])


def floats(picture: str, camera) -> np.ndarray:
    """Colours [H,W,3] from 0 to 1 of a data URL or of half floats (tests/viewers.mjs)."""
    if picture.startswith("data:"):
        image = Image.open(io.BytesIO(base64.b64decode(picture.split(",")[1]))).convert("RGB")
        return np.asarray(image) / 255
    rows = np.array(picture.split(","), np.uint16).view(np.float16)
    return rows.reshape(camera.height, camera.width, 4)[::-1, :, :3].astype(float).clip(0, 1)


@pytest.mark.parametrize(("viewer", "kind"), READ)
def test_a_viewer_shows_what_was_measured(browser, packages, run, viewer, kind):
    if viewer == "sparkAsItComes" and "RUN" in os.environ:
        pytest.skip("single views of the demo are off by up to 0.3 dB in Spark as it comes")
    run, root = run
    frames, file = run.dataset.test_views().frames, root / f"export{FORMATS[kind]}"
    camera, limits = frames[0].camera, AS_IT_COMES if viewer == "sparkAsItComes" else LIMITS
    if (viewer, kind) == ("playcanvas", "compressed-ply"):
        file, limits = root / PADDED, OF_PADDED
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

    poses = [turn @ opengl_from_opencv(frame.camera.world_to_camera) for frame in frames]
    asked = [f"/{file.name}", camera.width, camera.height, projection(camera).T.ravel().tolist()]
    asked.append([pose.T.ravel().tolist() for pose in poses])
    call = f"async (asked) => (await import('/viewers.mjs')).{viewer}(...asked)"
    with opened(browser, HOST, camera.width, camera.height, serve=serve) as (tab, wrong):
        pictures = iter(tab.evaluate(call, asked))
    assert wrong == []
    gaussians = load_gaussians(file)
    measured = json.loads((run.folder / "metrics.json").read_text())["test_views"]
    for frame, row in zip(frames, measured, strict=True):
        drawn = srgb_from_linear(render_view(gaussians, frame.camera)[0])
        truth = srgb_from_linear(frame.target()[0][..., :3])
        for least, most in limits:
            shown = floats(next(pictures), frame.camera)
            lost = row["psnr"] - psnr(shown, truth)
            print(viewer, kind, f"{psnr(shown, drawn):.1f} {lost:.3f} of {most}")
            assert psnr(shown, drawn) >= least
            assert abs(lost) <= most


@pytest.mark.parametrize(("kind", "ending"), [("ply", "glb"), ("compressed-ply", "ply")])
def test_splat_transform_writes_what_it_reads(packages, run, kind, ending, tmp_path):
    """Our file, by splat-transform into another format: the same picture."""
    program, node = packages / "@playcanvas/splat-transform/bin/cli.mjs", shutil.which("node")
    if node is None or not program.is_file():
        pytest.skip(f"{packages}: has no @playcanvas/splat-transform")
    given, made = run[1] / f"export{FORMATS[kind]}", tmp_path / f"made.{ending}"
    subprocess.run([node, program, given, made], check=True, capture_output=True)
    camera = run[0].dataset.test_views().frames[0].camera
    models = load_gaussians(given), replace(load_gaussians(made), antialiased=True)
    assert psnr(*(render_view(model, camera)[0] for model in models)) >= 60
