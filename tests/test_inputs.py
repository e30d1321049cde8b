"""A resumed run needs its prior, all poses and the files of frames taken as they were."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny
from PIL import Image
from program import change_settings

from mgs.data.dataset import load_dataset
from mgs.errors import InputError
from mgs.images import write_exr
from mgs.run import folder as run_folder
from mgs.run import recording


def retouch(path: Path) -> None:
    """Change one pixel of an image."""
    with Image.open(path) as picture:
        pixels = np.array(picture)
    pixels[tiny.HEIGHT // 2, tiny.WIDTH // 2] ^= 1
    Image.fromarray(pixels).save(path)


def empty_depth(path: Path) -> None:
    write_exr(path, {"Z": np.zeros((tiny.HEIGHT, tiny.WIDTH), np.float32)})


def edit(root: Path, name: str, x: float = 0, **values) -> None:
    """Change a frame's entries in transforms.json, and move its camera by x metres."""
    data = json.loads((root / "transforms.json").read_text())
    record = next(record for record in data["frames"] if name in record["file_path"])
    record["transform_matrix"][0][3] += x
    record.update(values)
    (root / "transforms.json").write_text(json.dumps(data))


CHANGES = {
    "image": (
        lambda root: retouch(root / "images/kf_0004.png"),
        r"images/kf_0004\.png has changed since .*run took it",
    ),
    "mask": (lambda root: retouch(root / "masks/kf_0008.png"), r"masks/kf_0008\.png has changed"),
    "rock": (
        lambda root: edit(root, "kf_0004", rock_file_path="images/kf_0000.png"),
        r"images/kf_0000\.png has changed",
    ),
    "depth": (
        lambda root: empty_depth(root / "depth/kf_0000.exr"),
        r"depth/kf_0000\.exr has changed",
    ),
    "no mask": (
        lambda root: edit(root, "kf_0000", mask_path=None),
        r"transforms\.json: the mask of frame kf_0000 has changed",
    ),
    "pose": (
        lambda root: edit(root, "kf_0005", x=1e-6),
        r"transforms\.json: the camera of frame kf_0005 has changed",
    ),
    "intrinsics": (
        lambda root: edit(root, "kf_0005", fl_x=16.1),
        "the camera of frame kf_0005 has changed",
    ),
}
"""Change of the dataset, and message. Of 12 frames on a circle 0, 4 and 8 are the seeds."""


@pytest.fixture
def half_done(tmp_path):
    """A dataset of its own and a run of three steps of six."""
    root, out, parts = tiny.write_dataset(tmp_path / "dataset"), tmp_path / "run", tiny.operations()
    dataset = load_dataset(root)
    settings = tiny.start(out, dataset).model_copy(update={"budget": 2})
    recording.run(out, settings, dataset, parts, tiny.silent)
    return root, out


@pytest.mark.parametrize("what", CHANGES)
def test_a_run_does_not_go_on_from_changed_inputs(half_done, what):
    root, out = half_done
    change, message = CHANGES[what]
    change(root)
    before = (out / "steps.jsonl").read_text()
    with pytest.raises(InputError, match=message):
        tiny.resume(out, load_dataset(root))
    assert (out / "steps.jsonl").read_text() == before


def test_a_run_goes_on_where_images_of_candidates_changed(half_done):
    """And where the dataset moved: config.json names its new folder."""
    root, out = half_done
    taken = run_folder.read_checkpoint(out).taken
    for i in set(range(tiny.FRAMES)) - set(taken):
        retouch(root / f"images/kf_{i:04d}.png")
    moved = root.rename(root.parent / "elsewhere")
    change_settings(out, dataset=str(moved))
    assert len(tiny.resume(out, load_dataset(moved)).steps) == 6


def test_a_run_does_not_go_on_from_other_initial_gaussians(half_done):
    root, out = half_done

    def initial(frames):
        g = tiny.initial(frames)
        return replace(g, means=g.means + np.float32(0.01))

    with pytest.raises(InputError, match=r"is not the prior that .*run was started on"):
        tiny.resume(out, load_dataset(root), tiny.operations(initial=initial))
