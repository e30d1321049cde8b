"""Policies on a NeRF-synthetic scene of a few pixels, from its split to the tables."""

import json
from dataclasses import replace

import numpy as np
import pytest
import tiny
from program import study
from refusals import fails
from synthetic import sphere

import mgs
from mgs.camera import opengl_from_opencv
from mgs.data.clouds import SparseCloud, write_cloud
from mgs.data.dataset import write_transforms
from mgs.data.importers import import_source
from mgs.data.sources import read_source
from mgs.images import write_png
from mgs.policy.poses import nearest_poses
from studies import blender
from studies.frame.output import read_rows

FEW = replace(blender.SIZES["quick"], downscale=1, gaussians=60, views=((2, 4),), passes=1, draws=1)
pytestmark = pytest.mark.usefixtures("short_fits")


@pytest.fixture
def scenes(tmp_path):
    """A folder with the scene `ball`: 12 training and 3 test views of a sphere, with alpha."""
    data = mgs.load_dataset(tiny.write_dataset(tmp_path / "data"))
    root = tmp_path / "scenes/ball"
    for split, frames in (("train", data.frames), ("test", data.frames[1::4])):
        records = []
        for i, frame in enumerate(frames):
            alpha = np.where(frame.mask(), 255, 0)
            colour = np.full((*alpha.shape, 3), 40 + 10 * i)
            write_png(root / f"{split}/r_{i}.png", np.dstack([colour, alpha]).astype(np.uint8))
            pose = opengl_from_opencv(frame.camera.world_to_camera).tolist()
            records.append({"file_path": f"./{split}/r_{i}", "transform_matrix": pose})
        angle = 2 * np.arctan(tiny.WIDTH / 2 / frame.camera.K[0, 0])
        text = json.dumps({"camera_angle_x": float(angle), "frames": records})
        (root / f"transforms_{split}.json").write_text(text)
    return root.parent


def test_every_policy_runs_and_no_candidate_is_read(scenes, tmp_path, monkeypatch):
    read = []
    monkeypatch.setattr(mgs.Frame, "target", _noted(mgs.Frame.target, read))
    monkeypatch.setattr(mgs.Frame, "mask", _noted(mgs.Frame.mask, read))
    out = tmp_path / "out"
    study("blender", out, "--dir", scenes, sizes={"quick": FEW})
    rows = read_rows(out / "blender.csv")
    assert {row["policy"] for row in rows} == {*blender.OURS, *blender.COMPARED}
    taken = [json.loads(row["taken"]) for row in rows]
    assert all(len(set(views)) == 4 and views[0] == 0 for views in taken)
    assert len({views[1] for views in taken}) == 1, "all policies have the same seeds"
    training = {name for name in read if name.startswith("train")}
    names = [f"train_r_{i}" for i in range(12)]
    assert training == {names[i] for views in taken for i in views}
    far, other = (next(row for row in rows if row["policy"] == p) for p in ("farthest", "uniform"))
    assert (far["lead"], other["lead"]) == (0, other["psnr"] - far["psnr"])
    text = (out / "blender.md").read_text()
    assert "POp-GS D" in text
    assert f"| {other['psnr']:.2f}, {other['lead']:+.2f} |" in text
    assert (out / "blender.png").is_file()


def test_photographs_are_chosen_among_the_nearest_and_judged_by_those_held_out(
    tmp_path, monkeypatch
):
    root = tiny.write_dataset(tmp_path / "scenes/ball")
    frames = mgs.load_dataset(root).frames
    write_transforms(root, [replace(one, depth_path=None, mask_path=None) for one in frames])
    write_cloud(root / "sparse.ply", SparseCloud(sphere(30)))
    read, out = [], tmp_path / "out"
    monkeypatch.setattr(mgs.Frame, "target", _noted(mgs.Frame.target, read))
    monkeypatch.setattr(mgs.Frame, "rgb", _noted(mgs.Frame.rgb, read))
    size = replace(FEW, views=((2, 0.5),), nearest=(None, 2), draws=2, policies=("random", "cover"))
    study("blender", out, "--dir", root.parent, sizes={"quick": size})
    rows = read_rows(out / "blender.csv")
    data = mgs.load_dataset(next(out.glob("cells/dataset/*/dataset")))
    names = [frame.name for frame in data.frames]
    assert {one.name for one in frames} - set(names) == {"kf_0002", "kf_0007"}
    assert (data.root / "sparse.ply").is_file(), "models start at the points"
    taken = [json.loads(row["taken"]) for row in rows]
    assert all(len(set(views)) == 5 for views in taken)
    assert set(read) == {names[i] for views in taken for i in views} | {"kf_0002", "kf_0007"}
    assert len({tuple(views[:2]) for views in taken}) == 2, "each draw has its seeds"
    positions = np.array([camera.position for camera in data.cameras])
    for row, views in zip(rows, taken, strict=True):
        if row["views"] == "50%, 2 nearest":
            for k in range(2, 5):
                rest = [i for i in range(len(names)) if i not in views[:k]]
                near = nearest_poses(positions[rest], positions[views[k - 1]], 2)
                assert views[k] in [rest[i] for i in near]
    text = (out / "blender.md").read_text()
    assert all(views in text for views in ("| 50% ", "| 50%, 2 nearest "))


def test_a_run_from_random_points_reads_no_candidate(scenes, tmp_path, monkeypatch):
    shots, tests = read_source(scenes / "ball", test_split="test").set_apart(None)
    data = import_source(shots, tmp_path / "ball", tests=tests)
    read = []
    for name in ("target", "mask"):
        monkeypatch.setattr(mgs.Frame, name, _noted(getattr(mgs.Frame, name), read))
    how = {"source": "random", "gaussians": 60, "seeds": 2, "budget": 2, "train": {"passes": 1}}
    run = mgs.run_nbv(data.root, tmp_path / "run", **how)
    assert run.settings.policy == "farthest", "the default where there is no surface"
    assert run.settings.train.means == "free"
    assert set(read) == {data.frames[i].name for i in run.state.taken}
    fails("need a surface", mgs.run_nbv, data.root, tmp_path / "other", flight={"length": 9}, **how)
    given = {"prior": run.settings.prior, "source": "random"}
    fails("leave out `prior`", mgs.run_nbv, data.root, tmp_path / "other", **given)


def _noted(method, names):
    def call(frame):
        names.append(frame.name)
        return method(frame)

    return call


def test_a_split_becomes_test_views(scenes):
    source = read_source(scenes / "ball", test_split="test")
    assert "--test-split test" in read_source(scenes / "ball").notes[-1]
    train, tests = source.set_apart(None)
    assert (len(train.shots), len(tests.shots)) == (12, 3)
    assert {shot.name for shot in tests.shots} == {f"test_r_{i}" for i in range(3)}
    for split, fault in (("train", "training split"), ("val", "transforms_val.json")):
        fails(fault, read_source, scenes / "ball", test_split=split)
