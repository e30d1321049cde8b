"""Damaged files in every loader: it succeeds or raises an InputError of one line, prints nothing,
and takes little memory and time.

`pytest -m fuzz` makes them at random. FUZZ_SECONDS: CPU time for each loader, by default 20;
FUZZ_SEED: of the random numbers, by default 0. An input that fails is copied to the folder
`corpus`, which the quick suite reads.
"""

import faulthandler
import hashlib
import os
import re
import resource
import shutil
import struct
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from itertools import starmap
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import cv2
import numpy as np
import pytest
import synthetic
import tiny
import trimesh
from PIL import ExifTags, Image
from test_recordings import WRITERS

from mgs import InputError, evaluate_run, images, load_dataset, load_prior, open_run, write_page
from mgs.camera import opengl_from_opencv
from mgs.cli.app import CURES
from mgs.compact import container
from mgs.compact.columns import start_of
from mgs.compact.encode import Encoder
from mgs.data.clouds import SparseCloud, read_cloud, write_cloud
from mgs.data.dataset import load_cameras
from mgs.data.frames import Frame, as_captured
from mgs.data.meshes import load_mesh
from mgs.data.photographs import _usable, sharpest_frames
from mgs.data.shots import Spacing
from mgs.data.sources import read_source
from mgs.data.structure import Matcher
from mgs.data.world import World
from mgs.files import read_json, write_json
from mgs.gaussians import ARRAYS
from mgs.images import (
    exif_exposure,
    image_size,
    read_depth,
    read_mask,
    read_values,
    write_exr,
    write_png,
)
from mgs.reports.tables import compare_runs
from mgs.run.candidates import Site, read_poses, refusals
from mgs.run.live import _flown
from mgs.run.settings import settings_in
from mgs.splat_files import load_gaussians, write_gaussians
from mgs.splat_ply import read_ply, write_compressed_ply, write_ply
from mgs.synth.capture import photographer_of
from mgs.synth.scene_file import load_scene_file, sensor_of
from mgs.view.layers import read_subject
from studies.frame.sweep import Cell, result_of

os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # read once, by the first video

FLOATS = (float("nan"), float("inf"), -1.0, 0.0, 1e-300)
NUMBERS = [struct.pack(form, n) for form in ("<I", ">I", "<Q") for n in (0, 1, 255, 2**32 - 1)]
NUMBERS += [struct.pack(form, n) for form in ("<f", "<d") for n in FLOATS]
WORDS = [b"NaN", b"1e999", b"1e300", b"-7", b"0", b"0.5", b"1" * 30, b"1" * 5000, b"inf", b"null"]
WORDS += [b"", b"[]", b"{}", b"[" * 5000, b"[" * 5000 + b"]" * 5000, b"\0", b"\n", b'"\\ud800"']
WORDS += [b'"../x"', b'"\\u0000"', b"list uchar int", b"vertex", b"face"]
"""What stands in damaged files in the place of numbers and words."""


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Bytes cut off, flipped or repeated, with numbers or words in the place of others."""
    found = bytearray(data)
    for _ in range(rng.integers(1, 5)):
        place = rng.integers(len(found) + 1)
        kind = rng.choice(["cut", "flip", "number", "word", "token", "token", "repeat"])
        if kind == "cut":
            del found[place:]
        elif kind == "flip" and place < len(found):
            found[place] ^= 1 << rng.integers(8)
        elif kind == "number":
            number = NUMBERS[rng.integers(len(NUMBERS))]
            found[place : place + len(number)] = number
        elif kind == "word":
            found[place : place + rng.integers(7)] = WORDS[rng.integers(len(WORDS))]
        elif kind == "token":
            after = re.compile(rb"[^\s,:=\[\]{}]+").search(found, place)
            if after:
                found[after.start() : after.end()] = WORDS[rng.integers(len(WORDS))]
        else:
            found[place:place] = found[place : place + rng.integers(65)]
    return bytes(found)


CORPUS = Path(__file__).parent / "corpus"
SECONDS = float(os.environ.get("FUZZ_SECONDS", "20"))
SEED = int(os.environ.get("FUZZ_SEED", "0"))
LONGEST = 60
"""Seconds after which reading a small file counts as endless, and ends the process."""
MOST_GROWTH = 2 << 30
"""Most growth of the peak memory by a damaged small file, bytes."""


def read_image(path: Path) -> None:
    image_size(path)
    exif_exposure(path)
    images.read_rgba(path)


NOISE = np.random.default_rng(0).integers(0, 65535, (24, 32, 4), np.uint16)


def png(path: Path) -> None:
    Image.fromarray((NOISE >> 8).astype(np.uint8)).save(path)


def exr(path: Path) -> None:
    write_exr(path, dict.fromkeys("RGZ", NOISE[..., 0] / 65535))


def cloud(path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(20, 3))
    write_cloud(path, SparseCloud(points, points, np.ones(20)))


def mesh(path: Path, side: int = 4) -> None:
    """A ball as GLB, with a texture of side x side pixels."""
    ball = trimesh.creation.icosphere(subdivisions=1)
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.new("1", (side, side)))
    ball.visual = trimesh.visual.TextureVisuals(uv=ball.vertices[:, :2], material=material)
    path.write_bytes(ball.export(file_type="glb"))


def scene(path: Path) -> None:
    path.write_text("[rock]\nsize = 2.0\nlobes = [{radii = [1, 2, 1]}]\n[orbit]\nkind = 'rings'\n")


def colmap(kind: str) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        import pycolmap

        lens = {"model": "OPENCV", "params": [30, 30, 16, 12] + [0] * 4, "camera_id": 1}
        camera = pycolmap.Camera(width=32, height=24, **lens)
        model = pycolmap.Reconstruction()
        model.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(name="a.png", camera_id=1, image_id=1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
        getattr(model, f"write_{kind}")(path.parent)
        (path.parent / "images").mkdir(exist_ok=True)
        png(path.parent / "images/a.png")

    return write


def recording(kind: str, file: str) -> Callable[[Path], None]:
    """Writer of a recording of three frames, of which `file` is one."""

    def write(path: Path) -> None:
        root = path.parents[file.count("/")]
        WRITERS[kind](root, synthetic.orbit(root / "data", 3, 16, 12))

    return write


def of_recording(path: Path) -> None:
    """Read the recording of which a file is one, as far as the sizes of its images."""
    deep = path.parent.name in ("rtabmap_calib", "bundle", "cams")
    deep += 2 * (path.parent.name == "cameras")
    root = path if path.suffix in (".bag", ".xml", ".r3d") else path.parents[deep]
    pose = "/slam/pose" if path.suffix == ".mcap" else None
    for shot in read_source(root, unpack=root.parent / "unpacked", pose=pose).shots:
        image_size(shot.image)


def poses(path: Path) -> None:
    path.write_text(
        "name,x,y,z,target_x,target_y,target_z,qw,qx,qy,qz\na,3,0,1,0,0,0,1,0,0,0\n"
        'b,0,3,1,0,0,0.5,.5,.5,-.5,.5\n"c d",2,2,1,0,0,0,1,0,0,0\n'
    )
    tiny.write_prior(path.parent / "prior")


def of_poses(path: Path) -> None:
    """Read candidates, and tell which can be flown."""
    camera = tiny.orbit()[0]
    site = Site(load_prior(path.parent / "prior"), camera)
    refusals(read_poses(path, site), [camera], site)


def run(path: Path) -> None:
    """A finished run of the seeds alone, with its dataset and prior beside it."""
    root = path.parent.parent
    data, prior = tiny.write_dataset(root / "data"), tiny.write_prior(root / "prior")
    tiny.write_run(root / "run", data, prior)
    evaluate_run(root / "run", pictures=False)


def read_all(path: Path) -> None:
    """Everything that commands read of the run around a file."""
    root = path.parent.parent
    found = open_run(root / "run")
    found.metrics, found.steps  # noqa: B018
    compare_runs([root / "run"])
    found.state, found.dataset, found.prior  # noqa: B018
    read_subject(root / "run")


HALF = Spacing.parse("0.5s")


def spz(path: Path) -> None:
    write_gaussians(path, replace(tiny.initial([]), antialiased=True), "spz", np.eye(3))


def video(path: Path) -> None:
    code = {".avi": "MJPG", ".mp4": "mp4v"}[path.suffix]
    film = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*code), 10, (32, 24))
    for k in range(24):
        film.write(np.roll(NOISE[..., :3] >> 8, k, axis=1).astype(np.uint8))
    film.release()


def photograph(path: Path) -> None:
    """A JPEG on its side with exposure, focal length and GPS in its EXIF."""
    image = Image.fromarray((NOISE[..., :3] >> 8).astype(np.uint8))
    exif = image.getexif()
    exif[ExifTags.Base.Orientation] = 6
    tags = ExifTags.Base
    shot = {tags.ExposureTime: 0.01, tags.FNumber: 2.8, tags.FocalLengthIn35mmFilm: 28}
    exif.get_ifd(ExifTags.IFD.Exif).update(shot)
    gps = {1: "N", 2: (48.0, 1.0, 2.0), 3: "E", 4: (11.0, 1.0, 2.0), 5: b"\0", 6: 300.0}
    exif.get_ifd(ExifTags.IFD.GPSInfo).update(gps)
    image.save(path, exif=exif)


def of_photograph(path: Path) -> None:
    """Read a photograph as an import of a folder does, as far as its features."""
    read_image(path)
    usable, _ = _usable(path.parent, [path])
    if usable:
        Matcher(usable, path.parent / "matches")._extract([0])


def asked(path: Path) -> Frame:
    """The frame of which a live capture wrote a file, with its picture."""
    root = path.parent.parent
    frame = Frame("a", tiny.orbit()[0], 0.0, root / "images/a.png", on_demand=True)
    frame.image_path.parent.mkdir(exist_ok=True)
    png(frame.image_path)
    return frame


def captured(path: Path) -> None:
    camera = asked(path).camera
    own = {"K": camera.K.tolist(), "width": 16, "height": 12}
    own |= {"world_to_camera": camera.world_to_camera.tolist()}
    write_json(path, {"camera": own, "depth": True})


def flown(path: Path) -> None:
    pose = opengl_from_opencv(asked(path).camera.world_to_camera)
    write_json(path, {"transform_matrix": pose.tolist(), "w": 16, "h": 12, "k1": 0.1})


def on_demand(path: Path) -> None:
    scene = load_scene_file("boulder").model_dump(mode="json")
    scene["rock"] |= {"detail": 0.1}
    preset = {"width": 16, "height": 12, "frames": 3, "spp": 1}
    about = {"scene": scene, "preset": preset, "seed": 0, "mesh": None, "denoise": False}
    about |= {"pose_noise": None, "on_demand": {"mesh": None}}
    write_json(path, about | {"exposure": 1.0, "samples_per_pixel": 1})


def of_on_demand(path: Path) -> None:
    """Read what a survey and a run read of it."""
    sensor_of(path.parent)
    photographer_of(path.parent)


NO_SUMS = mock.patch.object(container, "zlib", SimpleNamespace(crc32=lambda _: 0))
"""Without checks of sums, so that damage reaches the decoder."""


def without_sums(path: Path) -> None:
    header, packets = container.split((CORPUS / "MGS/one.mgs").read_bytes(), path)
    with NO_SUMS:
        path.write_bytes(container.join(header, starmap(container.packet, packets.items())))


def masked(path: Path) -> None:
    """A file of three quarters of a prior's Gaussians, in the receiver's places."""
    prior = load_prior(tiny.write_prior(path.parent / "prior"))
    model, kept = tiny.initial([]), np.flatnonzero(np.arange(tiny.POINTS) % 4)
    gradients = lambda g: iter([{name: np.ones_like(getattr(g, name)) for name in ARRAYS}])  # noqa: E731
    with NO_SUMS:
        start = start_of(prior, 0.0)
        path.write_bytes(bytes(Encoder(model[kept], gradients, start, kept).file(0.1)))


def of_masked(path: Path) -> None:
    with NO_SUMS:
        load_gaussians(path, path.parent / "prior")


def result(path: Path) -> None:
    result_of(path.parents[2], Cell(path.parent.name, "a:b", {"a": 1}))


ROBOTS = (
    ("ROS bag 1", "one.bag"),
    ("ROS bag 2", "bag/bag.db3"),
    ("ROS bag 2", "bag/metadata.yaml"),
    ("ROS bag MCAP", "bag/bag.mcap"),
    ("TUM RGB-D", "tum/rgb.txt"),
    ("TUM RGB-D", "tum/groundtruth.txt"),
    ("TUM RGB-D", "tum/calibration.txt"),
    ("Open3D", "open3d/trajectory.log"),
    ("Open3D", "open3d/camera_intrinsic.json"),
    ("7-Scenes", "seq-01/frame-000001.pose.txt"),
    ("7-Scenes", "camera-intrinsics.txt"),
    ("3D Scanner App", "scan/frame_00006.json"),
    ("Polycam", "polycam/keyframes/cameras/2350515175632.json"),
    ("Record3D", "record3d/metadata.json"),
    ("Record3D r3d", "scan.r3d"),
    ("RTAB-Map", "rtabmap/rtabmap_camera_poses.txt"),
    ("RTAB-Map", "rtabmap/rtabmap_calib/1.yaml"),
    ("Metashape", "metashape/cameras.xml"),
    ("OpenSfM", "opensfm/opensfm/reconstruction.json"),
    ("Bundler", "bundler/bundle/bundle.out"),
    ("Bundler", "bundler/list.txt"),
    ("LLFF", "llff/poses_bounds.npy"),
    ("MVSNet", "mvsnet/cams/kf_0000_cam.txt"),
    ("openMVG benchmark", "benchmark/gt_dense_cameras/kf_0000.png.camera"),
    ("3D Gaussian Splatting", "splats/cameras.json"),
)
"""Recordings of robots, scanners and other programs, and files of theirs."""

RUN = ("config.json", "steps.jsonl", "metrics.json")
CELL = {"task": "a:b", "arguments": {"a": 1}, "found": {"psnr": 1.5}}
TRANSFORMS = lambda path: tiny.write_dataset(path.parent, 3)  # noqa: E731
SOURCE = lambda path: read_source(path.parent)  # noqa: E731

LOADERS: dict[str, tuple[str, Callable[[Path], None], Callable[[Path], object]]] = {
    "PNG": ("a.png", png, read_image),
    "photograph": ("a.jpg", photograph, of_photograph),
    **{
        kind: (f"a.{kind.lower()}", video, lambda path: sharpest_frames(path, path.parent, HALF))
        for kind in ("AVI", "MP4")
    },
    "JPEG": ("a.jpg", lambda path: Image.effect_noise((32, 24), 50).save(path), read_image),
    "depth": ("d.png", lambda path: Image.new("I;16", (32, 24), 9).save(path), read_values),
    "TIFF": (
        "d.tif",
        lambda path: Image.effect_noise((32, 24), 50).convert("F").save(path),
        read_depth,
    ),
    "WebP": ("a.webp", png, read_image),
    "EXR": ("a.exr", exr, images.read_exr),
    "PLY": ("a.ply", lambda path: write_ply(path, tiny.initial([])), read_ply),
    "compressed PLY": (
        "c.ply",
        lambda path: write_compressed_ply(path, tiny.initial([])),
        read_ply,
    ),
    "MGS": ("a.mgs", lambda path: shutil.copy(CORPUS / "MGS/one.mgs", path), load_gaussians),
    "MGS without sums": ("a.mgs", without_sums, NO_SUMS(load_gaussians)),
    "MGS masked": ("a.mgs", masked, of_masked),
    "SPZ": ("a.spz", spz, load_gaussians),
    "splat GLB": (
        "s.glb",
        lambda path: write_gaussians(path, tiny.initial([]), "glb", np.eye(3)),
        load_gaussians,
    ),
    "cloud": ("cloud.ply", cloud, read_cloud),
    "GLB": ("a.glb", mesh, load_mesh),
    "OBJ": ("a.obj", trimesh.creation.icosphere(subdivisions=0).export, load_mesh),
    "mesh PLY": ("m.ply", trimesh.creation.icosphere(subdivisions=0).export, load_mesh),
    "16 bits": ("a.png", lambda path: cv2.imwrite(str(path), NOISE[..., :3]), read_image),
    "mask": ("a.png", lambda path: write_png(path, np.eye(24, 32, dtype=bool)), read_mask),
    "checkpoint": ("run/checkpoint.npz", run, read_all),
    **{f"run {name}": (f"run/{name}", run, read_all) for name in RUN},
    "page": (
        "run/metrics.json",
        run,
        lambda path: write_page(path.parent.parent / "page.html", [path.parent]),
    ),
    "prior.json": ("prior/prior.json", run, read_all),
    "prior mesh": ("prior/mesh.ply", run, read_all),
    "prior points": ("prior/points.ply", run, read_all),
    "study": ("cells/a/result.json", lambda path: write_json(path, CELL), result),
    "JSON": ("a.json", lambda path: path.write_text('{"a": [1, 2.5, "b"]}'), read_json),
    "transforms.json": ("transforms.json", TRANSFORMS, lambda path: load_dataset(path.parent)),
    "import": ("transforms.json", TRANSFORMS, SOURCE),
    "cameras": ("transforms.json", TRANSFORMS, load_cameras),
    "captured": ("captured/a.json", captured, lambda path: as_captured(asked(path))),
    "flown": (
        "answers/a.flown.json",
        flown,
        lambda path: _flown(path, asked(path), asked(path).image_path, World()),
    ),
    "on demand": ("config.json", on_demand, of_on_demand),
    "settings": (
        "a.toml",
        lambda path: path.write_text("policy = 'paper'\nseeds = 2\n[train]\npasses = 3\n"),
        settings_in,
    ),
    "scene": ("a.toml", scene, load_scene_file),
    **{
        f"COLMAP {name}": (name, colmap(kind), SOURCE)
        for kind, end in (("text", "txt"), ("binary", "bin"))
        for name in (f"{n}.{end}" for n in ("cameras", "images", "points3D", "frames", "rigs"))
    },
    **{
        f"{kind} {Path(file).stem}": (file, recording(kind, file), of_recording)
        for kind, file in ROBOTS
    },
    "poses": ("poses.csv", poses, of_poses),
}
"""Loader -> name of its file, function that writes a sound one, function that reads it."""


def harmless(name: str, path: Path) -> None:
    """Read a file as in the program `mgs`, where warnings of libraries are not printed."""
    faulthandler.dump_traceback_later(LONGEST, exit=True)
    read, lines = LOADERS[name][2], []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            read(path)
        except InputError as error:
            lines = str(error).splitlines()
        except OSError as error:
            if error.errno not in CURES:  # of which the program makes one line
                raise
    assert len(lines) < 2


def peak() -> int:
    """Largest memory of this process since `begin_peak`, bytes."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def begin_peak() -> int:
    """Begin to measure the largest memory, bytes; as it is now."""
    Path("/proc/self/clear_refs").write_text("5")
    return peak()


@pytest.mark.parametrize("name", sorted(folder.name for folder in CORPUS.iterdir()))
def test_inputs_that_once_failed(name, tmp_path, capfd):
    file, write, read = LOADERS[name]
    write(tmp_path / file)
    read(tmp_path / file)
    for path in (CORPUS / name).iterdir():
        (tmp_path / file).write_bytes(path.read_bytes())
        before = begin_peak()
        harmless(name, tmp_path / file)
        assert peak() < before + MOST_GROWTH, path
    assert capfd.readouterr().err == ""


@pytest.mark.fuzz
@pytest.mark.parametrize("name", LOADERS)
def test_damaged_files(name, request, capfd):
    """pytest's cache has the file that was read last, also after the death of the process."""
    file, write, read = LOADERS[name]
    folder = request.config.cache.mkdir("fuzz") / name
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    write(folder / file)
    read(folder / file)
    sound, before = (folder / file).read_bytes(), begin_peak()
    rng, end = np.random.default_rng(SEED), time.process_time() + SECONDS
    while time.process_time() < end:
        data = damaged(sound, rng)
        (folder / file).write_bytes(data)
        try:
            harmless(name, folder / file)
            assert peak() < before + MOST_GROWTH
            assert capfd.readouterr().err == ""
        except BaseException:
            (CORPUS / name).mkdir(exist_ok=True)
            (CORPUS / name / hashlib.sha256(data).hexdigest()[:12]).write_bytes(data)
            raise
