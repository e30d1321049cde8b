"""Bad input through the real command line: one line that says what is wrong, exit code 2, nothing
left over. Each check is tried by one command."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tiny
from refusals import refused

from mgs.images import write_png

Change = Callable[[Path], object]


def cases(table: dict[str, tuple[Any, str]]) -> Any:
    """Parametrise a test by the rows of a table: name -> (change or input, words of the line)."""
    return pytest.mark.parametrize(("given", "named"), table.values(), ids=table.keys())


def edit(change: Callable[[dict], object], name: str = "transforms.json") -> Change:
    """A change of a JSON file."""

    def apply(root: Path) -> None:
        data = json.loads((root / name).read_text())
        change(data)
        (root / name).write_text(json.dumps(data))

    return apply


def header(**values) -> Change:
    return edit(lambda data: data.update(values))


def frame(**values) -> Change:
    return edit(lambda data: data["frames"][2].update(values))


def truncate(name: str) -> Change:
    """Cut a file in half, as a full disk does."""

    def apply(root: Path) -> None:
        data = (root / name).read_bytes()
        (root / name).write_bytes(data[: len(data) // 2])

    return apply


def remove(name: str) -> Change:
    return lambda root: (root / name).unlink()


FAR = [[1, 0, 0, 1e300], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
DATASETS: dict[str, tuple[Change, str]] = {
    "no transforms.json": (remove("transforms.json"), "transforms.json"),
    "transforms.json of another shape": (
        lambda root: (root / "transforms.json").write_text("[1, 2]"),
        "no frames",
    ),
    "pose of words": (frame(transform_matrix=[["a"] * 4] * 4), "frame 2"),
    "pose of NaN": (frame(transform_matrix=[[float("nan")] * 4] * 4), "not a finite 4x4"),
    "singular pose": (frame(transform_matrix=np.diag([1, 1, 0, 1]).tolist()), "singular"),
    "pose far away": (frame(transform_matrix=FAR), "entries beyond 1e+08"),
    "no pose": (edit(lambda data: data["frames"][2].pop("transform_matrix")), "frame 2 lacks"),
    "no intrinsics": (edit(lambda data: data.pop("fl_x")), "intrinsics"),
    "width 0": (header(w=0), "image size"),
    "negative focal length": (header(fl_x=-1), "focal lengths"),
    "no image file": (frame(file_path="images/none.png"), "does not exist"),
    "width of half a pixel": (header(w=16.5), "must be whole pixels"),
    "width without end": (header(w=float("inf")), "must be whole pixels"),
    "focal length without end": (header(fl_x=float("inf")), "frame 0"),
    "distortion of one frame": (frame(p2=-1e-3), "mgs import"),
    "fisheye": (header(camera_model="OPENCV_FISHEYE"), "mgs import"),
    "name twice": (frame(file_path="images/../images/kf_0000.png"), "kf_0000"),
    "file_path with a null character": (frame(file_path="a\0b"), "frame 2"),
    "mask_path that is a list": (frame(mask_path=["a"]), "mask_path"),
    "timestamp of words": (frame(timestamp="noon"), "timestamp"),
    "missing depth": (remove("depth/kf_0003.exr"), "kf_0003.exr"),
}
"""Datasets that no command accepts."""


@cases(DATASETS)
def test_broken_dataset(capsys, dataset, tmp_path, given, named):
    given(dataset)
    assert named in refused(capsys, ["nbv", dataset, "--out", tmp_path / "out"], tmp_path / "out")


@cases(
    {
        "image that is text": (
            lambda root: (root / "images/kf_0000.png").write_text("no pixels"),
            "kf_0000.png",
        ),
        "image of the wrong size": (
            lambda root: write_png(root / "images/kf_0000.png", np.zeros((5, 7, 3), np.float32)),
            "7x5",
        ),
    }
)
def test_broken_pixels(capsys, dataset, prior, tmp_path, given, named):
    """They are found when a frame is used; frame 0 is a seed."""
    given(dataset)
    arguments = ["nbv", dataset, "--out", tmp_path / "out", "--prior", prior, "--budget", 1]
    assert named in refused(capsys, arguments)
    assert not (tmp_path / "out/steps.jsonl").exists()


DUST = "[rock]\ndetail = 0.1\nburied = 0.999\n[orbit]\naltitude = 0\n[arena]\nstones = 0"


@cases(
    {
        "unknown key of a lobe": ("[[rock.lobes]]\nradius = 1", "centre, radii"),
        "detail coarser than the rock": ("[rock]\ndetail = 2", "rock.detail"),
        "detail of a slip": ("[rock]\ndetail = 1e-9", "rock.detail"),
        "rock behind its dust": (DUST, "altitude"),
        "negative size": ("[rock]\nsize = -1", "rock.size"),
        "no TOML": ("[rock", "not valid TOML"),
        "NaN": ("[sky]\nturbidity = nan", "sky.turbidity"),
    }
)
def test_scene_files(capsys, tmp_path, given, named):
    (tmp_path / "mine.toml").write_text(given)
    arguments = ["synth-orbit", tmp_path / "out", "--scene", tmp_path / "mine.toml"]
    arguments += ["--frames", 1, "--size", "16x12"]
    assert named in refused(capsys, arguments, tmp_path / "out")


@cases(
    {
        "missing": (shutil.rmtree, "mgs prior"),
        "truncated numbers": (truncate("prior.json"), "prior.json"),
        "negative spacing": (
            edit(lambda data: data.update(spacing=-1), "prior.json"),
            "must be positive metres",
        ),
    }
)
def test_broken_prior(capsys, dataset, prior, tmp_path, given, named):
    given(prior)
    arguments = ["nbv", dataset, "--out", tmp_path / "out", "--prior", prior, "--budget", 1]
    assert named in refused(capsys, arguments, tmp_path / "out")


@pytest.mark.parametrize(
    "command", [["nbv", "--resume"], ["eval"], ["diagnose"], ["simplify"], ["view"]]
)
def test_broken_run(capsys, dataset, prior, tmp_path, command):
    run = tiny.write_run(tmp_path / "run", dataset, prior)
    dataset.rename(tmp_path / "elsewhere")
    assert "correct `dataset`" in refused(capsys, [*command, run], run)
    (tmp_path / "elsewhere").rename(dataset)
    truncate("checkpoint.npz")(run)
    assert "checkpoint.npz" in refused(capsys, [*command, run], run)
