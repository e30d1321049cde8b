"""Damaged files in every loader: it succeeds or raises InputError, within bounded memory.

`pytest -m fuzz` runs it; FUZZ_SECONDS is the time for each loader, by default 20.
"""

from __future__ import annotations

import os
import resource
import struct
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tiny
import trimesh
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from PIL import Image

from mgs.data.clouds import SparseCloud, read_cloud, write_cloud
from mgs.data.dataset import load_dataset
from mgs.data.meshes import load_mesh
from mgs.data.sources import read_source
from mgs.errors import InputError
from mgs.files import read_json
from mgs.images import exif_exposure, image_size, read_exr, read_rgba, read_values, write_exr
from mgs.splat_ply import read_ply, write_ply
from mgs.synth.scene_file import load_scene_file

pytestmark = pytest.mark.fuzz
SECONDS = float(os.environ.get("FUZZ_SECONDS", "20"))
MOST_GROWTH = 2 << 30  # bytes, of peak memory by damaged small files

HUGE = (0, 1, 0x7F, 0xFF, 0x7FFFFFFF, 0xFFFFFFFF, 1 << 30)
WORDS = (
    b"NaN",
    b"1e999",
    b"-1",
    b"1" * 30,
    b"null",
    b"[]",
    b"{}",
    b'"\\ud800"',
    b"",
    b"\0",
    b"inf",
)


def read_image(path: Path) -> None:
    image_size(path)
    exif_exposure(path)
    read_rgba(path)


def png(path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (24, 32, 4), np.uint8)
    Image.fromarray(pixels).save(path)


def exr(path: Path) -> None:
    write_exr(path, {name: np.random.default_rng(0).normal(size=(24, 32)) for name in "RGZ"})


def cloud(path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(20, 3))
    write_cloud(path, SparseCloud(points, points, np.ones(20)))


def compressed(path: Path) -> None:
    chunk = "".join(
        f"property float {end}_{name}\n"
        for name in ("x", "y", "z", "scale_x", "scale_y", "scale_z")
        for end in ("min", "max")
    )
    words = "".join(
        f"property uint packed_{n}\n" for n in ("position", "rotation", "scale", "color")
    )
    head = f"element chunk 1\n{chunk}element vertex 20\n{words}end_header\n"
    body = np.tile([-1, 1], 6).astype("<f4").tobytes() + np.arange(80, dtype="<u4").tobytes()
    path.write_bytes(f"ply\nformat binary_little_endian 1.0\n{head}".encode() + body)


def mesh(path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=1)
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.new("RGB", (4, 4)))
    ball.visual = trimesh.visual.TextureVisuals(uv=ball.vertices[:, :2], material=material)
    path.write_bytes(ball.export(file_type="glb"))


def scene(path: Path) -> None:
    path.write_text("[rock]\nsize = 2.0\nlobes = [{radii = [1, 2, 1]}]\n[orbit]\nkind = 'rings'\n")


def transforms(path: Path) -> None:
    tiny.write_dataset(path.parent, 3)


def colmap(kind: str) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        import pycolmap

        camera = pycolmap.Camera(
            model="OPENCV", width=32, height=24, params=[30, 30, 16, 12] + [0] * 4
        )
        camera.camera_id = 1
        model = pycolmap.Reconstruction()
        model.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(name="a.png", camera_id=1, image_id=1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
        getattr(model, f"write_{kind}")(path.parent)
        (path.parent / "images").mkdir(exist_ok=True)
        png(path.parent / "images/a.png")

    return write


def of_folder(path: Path) -> None:
    read_source(path.parent)


LOADERS: dict[str, tuple[str, Callable[[Path], None], Callable[[Path], object]]] = {
    "PNG": ("a.png", png, read_image),
    "JPEG": ("a.jpg", lambda path: Image.effect_noise((32, 24), 50).save(path), read_image),
    "depth": ("d.png", lambda path: Image.new("I;16", (32, 24), 9).save(path), read_values),
    "EXR": ("a.exr", exr, read_exr),
    "PLY": ("a.ply", lambda path: write_ply(path, tiny.initial([])), read_ply),
    "compressed PLY": ("c.ply", compressed, read_ply),
    "cloud": ("cloud.ply", cloud, read_cloud),
    "GLB": ("a.glb", mesh, load_mesh),
    "OBJ": ("a.obj", trimesh.creation.icosphere(subdivisions=0).export, load_mesh),
    "mesh PLY": ("m.ply", trimesh.creation.icosphere(subdivisions=0).export, load_mesh),
    "JSON": ("a.json", lambda path: path.write_text('{"a": [1, 2.5, "b"]}'), read_json),
    "transforms.json": ("transforms.json", transforms, lambda path: load_dataset(path.parent)),
    "import": ("transforms.json", transforms, of_folder),
    "scene": ("a.toml", scene, load_scene_file),
    **{
        f"COLMAP {name}": (name, colmap(kind), of_folder)
        for kind, end in (("text", "txt"), ("binary", "bin"))
        for name in (f"{n}.{end}" for n in ("cameras", "images", "points3D", "frames", "rigs"))
    },
}
"""Loader -> name of its file, function that writes a sound one, function that reads it."""


@st.composite
def damages(draw: st.DrawFn, data: bytes) -> bytes:
    """Bytes of a file: truncated, with bytes flipped, with 32-bit numbers or words of a grammar in
    the place of others, and with a part repeated."""
    found = bytearray(data)
    for _ in range(draw(st.integers(1, 4))):
        place = draw(st.integers(0, max(len(found) - 1, 0)))
        kind = draw(st.sampled_from(["cut", "flip", "number", "word", "repeat"]))
        if kind == "cut":
            del found[place:]
        elif kind == "flip" and found:
            found[place] ^= 1 << draw(st.integers(0, 7))
        elif kind == "number":
            value = struct.pack(draw(st.sampled_from("<>")) + "I", draw(st.sampled_from(HUGE)))
            found[place : place + 4] = value
        elif kind == "word":
            found[place : place + draw(st.integers(0, 6))] = draw(st.sampled_from(WORDS))
        else:
            found[place:place] = found[place : place + draw(st.integers(0, 64))]
    return bytes(found)


@pytest.mark.parametrize("name", LOADERS)
def test_damaged_files(name, tmp_path):
    file, write, read = LOADERS[name]
    write(tmp_path / file)
    sound, until = (tmp_path / file).read_bytes(), time.monotonic() + SECONDS
    read(tmp_path / file)
    before = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    @settings(
        max_examples=100,
        phases=[Phase.generate, Phase.shrink],
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(damages(sound))
    def damaged(data: bytes) -> None:
        (tmp_path / file).write_bytes(data)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of libraries; the command line prints none
            lines = []
            try:
                read(tmp_path / file)
            except InputError as error:
                lines = str(error).splitlines()
            assert len(lines) < 2

    while time.monotonic() < until:
        damaged()
    assert 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < before + MOST_GROWTH
