"""Every kind of bad input, through the real command line: one line that says what is wrong, exit
code 2, nothing left over."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import synthetic
import tiny
from refusals import occupied, refused

from mgs.images import write_exr, write_png
from mgs.splat_ply import write_ply

Change = Callable[[Path], object]


def edit_transforms(change: Callable[[dict], object]) -> Change:
    """A change of transforms.json."""

    def apply(root: Path) -> None:
        path = root / "transforms.json"
        data = json.loads(path.read_text())
        change(data)
        path.write_text(json.dumps(data))

    return apply


def truncate(name: str) -> Change:
    """Cut a file in half, as a full disk does."""

    def apply(root: Path) -> None:
        data = (root / name).read_bytes()
        (root / name).write_bytes(data[: len(data) // 2])

    return apply


def no_intrinsics(data: dict) -> None:
    for key in ("fl_x", "fl_y", "cx", "cy"):
        data.pop(key)


def set_header(**values) -> Change:
    return edit_transforms(lambda data: data.update(values))


def set_frame(**values) -> Change:
    return edit_transforms(lambda data: data["frames"][2].update(values))


def set_pose(matrix: list) -> Change:
    return set_frame(transform_matrix=matrix)


def every_depth(value: Callable[[Path], np.ndarray]) -> Change:
    def apply(root: Path) -> None:
        for path in sorted((root / "depth").glob("*.exr")):
            write_exr(path, {"Z": value(path)})

    return apply


def wrong_size(root: Path) -> None:
    write_png(root / "images/kf_0000.png", np.zeros((5, 7, 3), np.float32))


def small_mask(root: Path) -> None:
    write_png(root / "masks/kf_0000.png", np.ones((5, 7), bool))


def same_name(root: Path) -> None:
    (root / "images/left").mkdir()
    shutil.copy(root / "images/kf_0000.png", root / "images/left/kf_0000.png")
    set_frame(file_path="images/left/kf_0000.png")(root)


NAN_POSE = [[1, 0, 0, float("nan")], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
ZERO_POSE = [[0] * 4] * 3 + [[0, 0, 0, 1]]
FLAT_POSE = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1]]

DATASETS: dict[str, tuple[Change, str]] = {
    "no transforms.json": (lambda root: (root / "transforms.json").unlink(), "transforms.json"),
    "folder in place of transforms.json": (
        lambda root: ((root / "transforms.json").unlink(), (root / "transforms.json").mkdir()),
        "transforms.json",
    ),
    "truncated transforms.json": (truncate("transforms.json"), "transforms.json"),
    "transforms.json of another shape": (
        lambda root: (root / "transforms.json").write_text("[1, 2]"),
        "no frames",
    ),
    "no frames": (edit_transforms(lambda data: data.update(frames=[])), "no frames"),
    "no intrinsics": (edit_transforms(no_intrinsics), "intrinsics"),
    "focal length 0": (edit_transforms(lambda data: data.update(fl_x=0)), "focal"),
    "NaN pose": (set_pose(NAN_POSE), "frame 2"),
    "singular pose": (set_pose(ZERO_POSE), "frame 2"),
    "pose that flattens": (set_pose(FLAT_POSE), "frame 2"),
    "pose that is no matrix": (set_pose([1, 2, 3]), "frame 2"),
    "pose of words": (set_pose([["a"] * 4] * 4), "frame 2"),
    "width of a slip": (set_header(w=10**9), "1000000000x"),
    "width without end": (set_header(w=float("inf")), "frame 0"),
    "focal length without end": (set_header(fl_x=float("inf")), "frame 0"),
    "distortion": (set_header(k1=0.1), "mgs import"),
    "distortion of one frame": (set_frame(p2=-1e-3), "mgs import"),
    "distortion that is no number": (set_header(k4="a"), "mgs import"),
    "fisheye": (set_header(camera_model="OPENCV_FISHEYE"), "mgs import"),
    "fisheye in one frame": (set_frame(camera_model="OPENCV_FISHEYE"), "mgs import"),
    "camera model that is no text": (set_header(camera_model=[1]), "mgs import"),
    "frame twice": (
        edit_transforms(lambda data: data["frames"].append(data["frames"][0])),
        "kf_0000",
    ),
    "name twice": (same_name, "kf_0000"),
    "file_path that is a number": (set_frame(file_path=5), "frame 2"),
    "file_path null": (set_frame(file_path=None), "frame 2"),
    "file_path empty": (set_frame(file_path=""), "frame 2"),
    "file_path with a null character": (set_frame(file_path="a\0b"), "frame 2"),
    "mask_path that is a list": (set_frame(mask_path=["a"]), "mask_path"),
    "timestamp NaN": (set_frame(timestamp=float("nan")), "timestamp"),
    "timestamp of words": (set_frame(timestamp="noon"), "timestamp"),
    "missing image": (lambda root: (root / "images/kf_0003.png").unlink(), "kf_0003.png"),
    "missing depth": (lambda root: (root / "depth/kf_0003.exr").unlink(), "kf_0003.exr"),
    "missing mask": (lambda root: (root / "masks/kf_0003.png").unlink(), "kf_0003.png"),
}
"""Datasets that no command accepts: (what to break, what the line must name)."""

PIXELS: dict[str, tuple[Change, str]] = {
    "truncated image": (truncate("images/kf_0000.png"), "kf_0000.png"),
    "image that is text": (
        lambda root: (root / "images/kf_0000.png").write_text("no pixels"),
        "kf_0000.png",
    ),
    "image of the wrong size": (wrong_size, "7x5"),
    "mask of the wrong size": (small_mask, "7x5"),
    "truncated depth": (truncate("depth/kf_0000.exr"), "kf_0000.exr"),
}
"""Broken pixels, found when a frame is used: `mgs nbv` uses frame 0 as a seed, `mgs prior` every
depth."""

SURVEYS: dict[str, tuple[Change, str]] = {
    "truncated depth": (truncate("depth/kf_0005.exr"), "kf_0005.exr"),
    "neither depth nor masks in transforms.json": (
        edit_transforms(
            lambda data: [
                frame.pop(key)
                for frame in data["frames"]
                for key in ("depth_file_path", "mask_path")
            ]
        ),
        "has no depth images and no points (sparse.ply) and no masks",
    ),
    "no return in any pixel": (
        every_depth(lambda path: np.zeros((tiny.HEIGHT, tiny.WIDTH))),
        "return",
    ),
    "NaN in every pixel": (
        every_depth(lambda path: np.full((tiny.HEIGHT, tiny.WIDTH), np.nan)),
        "return",
    ),
}
"""Depths from which no prior can be built."""


@pytest.mark.parametrize("command", ["nbv", "prior"])
@pytest.mark.parametrize("case", DATASETS)
def test_broken_dataset(capsys, dataset, tmp_path, command, case):
    change, named = DATASETS[case]
    change(dataset)
    assert named in refused(capsys, [command, dataset, "--out", tmp_path / "out"], tmp_path / "out")


@pytest.mark.parametrize("case", PIXELS)
def test_broken_pixels(capsys, dataset, prior, tmp_path, case):
    change, named = PIXELS[case]
    change(dataset)
    line = refused(
        capsys, ["nbv", dataset, "--out", tmp_path / "out", "--prior", prior, "--budget", 1]
    )
    assert named in line
    assert not (tmp_path / "out/steps.jsonl").exists()


@pytest.mark.parametrize("command", ["nbv", "prior"])
@pytest.mark.parametrize("case", SURVEYS)
def test_survey_without_a_rock(capsys, dataset, tmp_path, command, case):
    change, named = SURVEYS[case]
    change(dataset)
    arguments = [
        command,
        dataset,
        "--out",
        tmp_path / "out",
        *(["--budget", 1] if command == "nbv" else []),
    ]
    assert named in refused(capsys, arguments, tmp_path / "out")


@pytest.mark.parametrize("command", ["nbv", "prior"])
def test_ground_without_a_rock(capsys, tmp_path, command):
    synthetic.write_dataset(tmp_path / "plain", rocks=[])
    arguments = [
        command,
        tmp_path / "plain",
        "--out",
        tmp_path / "out",
        *(["--budget", 1] if command == "nbv" else []),
    ]
    assert "no rock" in refused(capsys, arguments, tmp_path / "out")


NBV: dict[str, tuple[list, str]] = {
    "unknown policy": (["--policy", "best"], "best"),
    "more seeds than frames": (["--seeds", 13], "13 seeds"),
    "no seeds": (["--seeds", 0], "--seeds"),
    "budget larger than the candidates": (["--budget", 9], "8 candidates"),
    "negative budget": (["--budget", -1], "--budget"),
    "negative seed": (["--seed", -1], "--seed"),
    "no pixel noise": (["--pixel-noise", 0], "--pixel-noise"),
    "NaN pixel noise": (["--pixel-noise", "nan"], "--pixel-noise"),
    "no passes": (["--passes", 0], "--passes"),
    "negative evaluation interval": (["--evaluate-every", -2], "--evaluate-every"),
}


@pytest.mark.parametrize("case", NBV)
def test_nbv_settings(capsys, dataset, prior, tmp_path, case):
    options, named = NBV[case]
    budget = [] if "--budget" in options else ["--budget", 1]
    arguments = ["nbv", dataset, "--out", tmp_path / "out", "--prior", prior, *budget, *options]
    assert named in refused(capsys, arguments, tmp_path / "out")


@pytest.mark.parametrize("command", ["nbv", "prior"])
@pytest.mark.parametrize("count", [0, 1, -5])
def test_too_few_gaussians(capsys, dataset, tmp_path, command, count):
    arguments = [command, dataset, "--out", tmp_path / "out", "--gaussians", count]
    assert "Gaussians" in refused(
        capsys, arguments + (["--budget", 1] if command == "nbv" else []), tmp_path / "out"
    )


MESHES: dict[str, tuple[str, str]] = {
    "no faces": ("v 0 0 0\nv 1 0 0\nv 0 1 0\n", "faces"),
    "NaN vertices": (
        "v nan 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 2 3 4\nf 1 3 4\n",
        "NaN",
    ),
    "not a mesh": ("this is no mesh", "mesh.obj"),
}


@pytest.mark.parametrize("case", MESHES)
def test_broken_mesh(capsys, tmp_path, case):
    text, named = MESHES[case]
    (tmp_path / "mesh.obj").write_text(text)
    arguments = ["synth-orbit", tmp_path / "out", "--mesh", tmp_path / "mesh.obj"]
    line = refused(capsys, arguments, tmp_path / "out")
    assert named in line
    assert "mesh.obj" in line


SYNTH: dict[str, tuple[list, str]] = {
    "missing mesh": (["--mesh", "nowhere.glb"], "nowhere.glb"),
    "up axis of no mesh": (["--mesh-up", "y"], "--mesh-up"),
    "unknown up axis": (["--mesh-up", "x"], "--mesh-up"),
    "unknown scene": (["--scene", "moonbase"], "moonbase"),
    "missing scene file": (["--scene", "nowhere/x.toml"], "x.toml"),
    "unknown preset": (["--preset", "huge"], "huge"),
    "size of words": (["--size", "big"], "--size"),
    "size 0": (["--size", "0x12"], "--size"),
    "size of a slip": (["--size", "99999999x99999999"], "--size"),
    "size in other digits": (["--size", "3²x24"], "--size"),
}


@pytest.mark.parametrize("case", SYNTH)
def test_synth_orbit_options(capsys, tmp_path, case):
    options, named = SYNTH[case]
    assert named in refused(capsys, ["synth-orbit", tmp_path / "out", *options], tmp_path / "out")


SCENES: dict[str, tuple[str, str]] = {
    "unknown section": ("[rok]", "description, rock, arena"),
    "unknown key": ("[orbit]\nradiu = 4", "kind, radius, altitude"),
    "unknown key of a lobe": ("[[rock.lobes]]\nradius = 1", "centre, radii"),
    "no lobes": ("[rock]\nlobes = []", "rock.lobes"),
    "rock wholly buried": ("[rock]\nburied = 1", "rock.buried"),
    "detail coarser than the rock": ("[rock]\ndetail = 2", "rock.detail"),
    "detail of a slip": ("[rock]\ndetail = 1e-9", "rock.detail"),
    "cameras under the ground": (
        "[orbit]\nkind = 'rings'\nelevations = [-60, -20]",
        "orbit.elevations",
    ),
    "rock behind its dust": (
        "[rock]\ndetail = 0.1\nburied = 0.999\n[orbit]\naltitude = 0\n[arena]\nstones = 0",
        "altitude",
    ),
}


@pytest.mark.parametrize("case", SCENES)
def test_scene_files(capsys, tmp_path, case):
    text, named = SCENES[case]
    (tmp_path / "mine.toml").write_text(text)
    arguments = [
        "synth-orbit",
        tmp_path / "out",
        "--scene",
        tmp_path / "mine.toml",
        "--frames",
        1,
        "--size",
        "16x12",
    ]
    assert named in refused(capsys, arguments, tmp_path / "out")


def edit_numbers(**values) -> Change:
    def apply(root: Path) -> None:
        path = root / "prior.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | values))

    return apply


PRIORS: dict[str, tuple[Change, str]] = {
    "missing": (shutil.rmtree, "mgs prior"),
    "without points": (lambda root: (root / "points.ply").unlink(), "points.ply"),
    "truncated points": (truncate("points.ply"), "prior"),
    "truncated numbers": (truncate("prior.json"), "prior.json"),
    "negative spacing": (edit_numbers(spacing=-1), "prior.json"),
    "NaN tolerance": (edit_numbers(depth_tolerance=float("nan")), "prior.json"),
}


@pytest.mark.parametrize("case", PRIORS)
def test_broken_prior(capsys, dataset, prior, tmp_path, case):
    change, named = PRIORS[case]
    change(prior)
    arguments = ["nbv", dataset, "--out", tmp_path / "out", "--prior", prior, "--budget", 1]
    assert named in refused(capsys, arguments, tmp_path / "out")


def test_nbv_needs_to_know_what_to_do(capsys, dataset, tmp_path):
    assert "--resume" in refused(capsys, ["nbv"])
    assert "--resume" in refused(capsys, ["nbv", dataset])
    assert "--resume" in refused(capsys, ["nbv", dataset, "--resume", tmp_path])


RUNS: dict[str, tuple[Change, str]] = {
    "missing": (shutil.rmtree, "holds no run"),
    "without config": (lambda root: (root / "config.json").unlink(), "holds no run"),
    "truncated config": (truncate("config.json"), "config.json"),
    "truncated checkpoint": (truncate("checkpoint.npz"), "checkpoint.npz"),
}


@pytest.mark.parametrize("command", [["nbv", "--resume"], ["eval"], ["diagnose"]])
@pytest.mark.parametrize("case", RUNS)
def test_broken_run(capsys, dataset, prior, tmp_path, command, case):
    change, named = RUNS[case]
    run = tiny.write_run(tmp_path / "run", dataset, prior)
    change(run)
    assert named in refused(capsys, [*command, run], run)


@pytest.mark.parametrize("command", [["nbv", "--resume"], ["eval"], ["diagnose"]])
def test_run_whose_dataset_is_gone(capsys, dataset, prior, tmp_path, command):
    run = tiny.write_run(tmp_path / "run", dataset, prior)
    shutil.rmtree(dataset)
    assert "correct `dataset`" in refused(capsys, [*command, run], run)


@pytest.mark.parametrize(
    ("views", "named"),
    [("kf_9999", "kf_9999"), ("kf_0000,nothing", "nothing"), (",", "--views"), ("", "--views")],
)
def test_diagnose_of_views_that_are_not_there(capsys, dataset, prior, tmp_path, views, named):
    run = tiny.write_run(tmp_path / "run", dataset, prior)
    assert named in refused(capsys, ["diagnose", run, "--views", views], run)


def test_demo_keeps_out_of_a_folder_of_something_else(capsys, tmp_path):
    assert "not empty" in refused(capsys, ["demo", occupied(tmp_path / "out")], tmp_path / "out")


SPLATS: dict[str, tuple[Change, str]] = {
    "missing": (lambda path: path.unlink(), "no such file"),
    "truncated": (lambda path: path.write_bytes(path.read_bytes()[:-100]), "not a readable"),
    "not a PLY": (lambda path: path.write_text("no splats"), "not a readable"),
    "no opacity": (
        lambda path: path.write_bytes(path.read_bytes().replace(b"opacity", b"opaaaaa")),
        "opacity",
    ),
    "NaN": (
        lambda path: path.write_bytes(path.read_bytes()[:-4] + np.float32(np.nan).tobytes()),
        "quats",
    ),
}


@pytest.mark.parametrize("case", SPLATS)
def test_broken_splats(capsys, dataset, tmp_path, case):
    change, named = SPLATS[case]
    path = tmp_path / "splats.ply"
    write_ply(path, tiny.initial([]))
    change(path)
    arguments = ["render", path, "--cameras", dataset, "--out", tmp_path / "out"]
    assert named in refused(capsys, arguments, tmp_path / "out")
