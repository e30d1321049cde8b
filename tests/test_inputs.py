"""A resumed run goes on from what it was made from: the prior, the poses and the files of the
frames taken."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import tiny
from PIL import Image

from mgs.data.dataset import load_dataset
from mgs.errors import InputError
from mgs.gaussians import Gaussians
from mgs.images import write_exr
from mgs.run import folder as run_folder
from mgs.run import recording


def retouch(path: Path) -> None:
    """Change an image a little."""
    with Image.open(path) as picture:
        pixels = np.array(picture)
    pixels[tiny.HEIGHT // 2, tiny.WIDTH // 2] ^= 1
    Image.fromarray(pixels).save(path)


def nudge(root: Path, name: str, **values) -> None:
    """Change the record of a frame in transforms.json; x: its position, metres."""
    data = json.loads((root / "transforms.json").read_text())
    record = next(record for record in data["frames"] if name in record["file_path"])
    record["transform_matrix"][0][3] += values.pop("x", 0)
    record.update(values)
    (root / "transforms.json").write_text(json.dumps(data))


SPOILT = {
    "image": (
        lambda root: retouch(root / "images/kf_0004.png"),
        r"images/kf_0004\.png has changed since .*run took it",
    ),
    "mask": (lambda root: retouch(root / "masks/kf_0008.png"), r"masks/kf_0008\.png has changed"),
    "rock": (
        lambda root: nudge(root, "kf_0004", rock_file_path="images/kf_0000.png"),
        r"images/kf_0000\.png has changed",
    ),
    "depth": (
        lambda root: write_exr(
            root / "depth/kf_0000.exr", {"Z": np.zeros((tiny.HEIGHT, tiny.WIDTH), np.float32)}
        ),
        r"depth/kf_0000\.exr has changed",
    ),
    "no mask": (
        lambda root: nudge(root, "kf_0000", mask_path=None),
        r"transforms\.json: the mask of frame kf_0000 has changed",
    ),
    "pose": (
        lambda root: nudge(root, "kf_0005", x=1e-6),
        r"transforms\.json: the camera of frame kf_0005 has changed",
    ),
    "intrinsics": (
        lambda root: nudge(root, "kf_0005", fl_x=16.1),
        "the camera of frame kf_0005 has changed",
    ),
}
"""What may change between a run and its resumption, and how it is named. Of 12 frames on a circle
0, 4 and 8 are the seeds."""


@pytest.fixture
def half_done(tmp_path):
    """A dataset of its own and a run of three steps of six."""
    root = tiny.write_dataset(tmp_path / "dataset")
    settings = tiny.start(tmp_path / "run", load_dataset(root))
    recording.run(
        tmp_path / "run",
        settings.model_copy(update={"budget": 2}),
        load_dataset(root),
        tiny.operations(),
        tiny.silent,
    )
    return root, tmp_path / "run"


def resume(root: Path, out: Path, **parts) -> run_folder.State:
    """The last state of a resumed run."""
    settings, operations = run_folder.read_settings(out), tiny.operations(**parts)
    return recording.run(out, settings, load_dataset(root), operations, tiny.silent)


@pytest.mark.parametrize("what", SPOILT)
def test_a_run_does_not_go_on_from_changed_inputs(half_done, what):
    root, out = half_done
    spoil, named = SPOILT[what]
    spoil(root)
    before = (out / "steps.jsonl").read_text()
    with pytest.raises(InputError, match=named):
        resume(root, out)
    assert (out / "steps.jsonl").read_text() == before


def test_a_run_goes_on_where_what_it_has_not_taken_changed(half_done):
    """Only the pose of a candidate is an input until it is taken: its files may still change."""
    root, out = half_done
    taken = run_folder.read_checkpoint(out).taken
    for i in set(range(tiny.FRAMES)) - set(taken):
        retouch(root / f"images/kf_{i:04d}.png")
    moved = root.rename(root.parent / "elsewhere")
    config = json.loads((out / "config.json").read_text())
    config["settings"]["dataset"] = str(moved)
    (out / "config.json").write_text(json.dumps(config))
    assert len(resume(moved, out).steps) == 6


@pytest.mark.parametrize("count", [tiny.POINTS, tiny.POINTS - 1])
def test_a_run_does_not_go_on_from_another_prior(half_done, count):
    root, out = half_done

    def initial(frames):
        g = tiny.initial(frames)
        fewer = (getattr(g, field.name)[:count] for field in fields(g))
        return replace(Gaussians(*fewer), means=g.means[:count] + np.float32(0.01))

    for parts in ({"initial": initial}, {"prior": "another spacing"}):
        with pytest.raises(InputError, match=r"is not the prior that .*run was started on"):
            resume(root, out, **parts)
