"""A resumed run needs its prior, all poses and the files of frames taken as they were."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny
from program import change_settings

from mgs.data.dataset import load_dataset
from mgs.errors import InputError
from mgs.run import folder as run_folder


def other_image(root: Path, name: str) -> None:
    """Replace the image of a frame by that of frame 1."""
    shutil.copy(root / "images/kf_0001.png", root / f"images/{name}.png")


def edit(root: Path, name: str, x: float = 0, **values) -> None:
    """Change a frame's entries in transforms.json, and move its camera by x metres."""
    data = json.loads((root / "transforms.json").read_text())
    record = next(record for record in data["frames"] if name in record["file_path"])
    record["transform_matrix"][0][3] += x
    record.update(values)
    (root / "transforms.json").write_text(json.dumps(data))


CHANGES = {
    r"images/kf_0004\.png has changed since .*run took it": (
        lambda root: other_image(root, "kf_0004")
    ),
    r"depth/kf_0000\.exr has changed": (
        lambda root: (root / "depth/kf_0000.exr").write_bytes(b"other")
    ),
    r"images/kf_0000\.png has changed": (
        lambda root: edit(root, "kf_0004", rock_file_path="images/kf_0000.png")
    ),
    r"transforms\.json: the mask of frame kf_0000 has changed": (
        lambda root: edit(root, "kf_0000", mask_path=None)
    ),
    r"transforms\.json: the camera of frame kf_0005 has changed": (
        lambda root: edit(root, "kf_0005", x=1e-6)
    ),
}
"""Message, and change of the dataset. Of 12 frames on a circle 0, 4 and 8 are the seeds."""


@pytest.fixture
def half_done(dataset, tmp_path):
    """A dataset and a run of three steps of six."""
    loaded, out = load_dataset(dataset), tmp_path / "run"
    settings = tiny.start(out, loaded).model_copy(update={"budget": 2})
    tiny.go(out, settings, loaded)
    return dataset, out


@pytest.mark.parametrize("message", CHANGES)
def test_a_run_does_not_go_on_from_changed_inputs(half_done, message):
    root, out = half_done
    CHANGES[message](root)
    before = (out / "steps.jsonl").read_text()
    with pytest.raises(InputError, match=message):
        tiny.resume(out, load_dataset(root))
    assert (out / "steps.jsonl").read_text() == before


def test_a_run_goes_on_where_images_of_candidates_changed(half_done):
    """And where the dataset moved: config.json names its new folder."""
    root, out = half_done
    taken = run_folder.read_checkpoint(out).taken
    for i in set(range(tiny.FRAMES)) - {1, *taken}:
        other_image(root, f"kf_{i:04d}")
    moved = root.rename(root.parent / "elsewhere")
    change_settings(out, dataset=str(moved))
    assert len(tiny.resume(out, load_dataset(moved)).steps) == 6


def test_a_run_does_not_go_on_from_other_initial_gaussians(half_done):
    root, out = half_done

    def initial(frames):
        g = tiny.initial(frames)
        return replace(g, means=g.means + np.float32(0.01))

    with pytest.raises(InputError, match=r"is not the prior that .*run was started on"):
        tiny.resume(out, load_dataset(root), initial=initial)
