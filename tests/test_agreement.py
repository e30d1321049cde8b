"""Poses that do not fit the pictures are noticed, and the mistake is named."""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
import synthetic

from mgs import Frame
from mgs.data import agreement as poses
from mgs.data.agreement import BODY, FLIP, observed
from mgs.data.structure import Matcher
from mgs.images import write_exr, write_png
from mgs.synth.orbit import perturb

pytestmark = pytest.mark.usefixtures("features_once")


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    """Views of a plane with a texture of noise."""
    root = tmp_path_factory.mktemp("plane")
    noise = np.random.default_rng(0).random((800, 800)).astype(np.float32)
    texture = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2), None, 0, 1, cv2.NORM_MINMAX)
    made = []
    for k in range(5):
        eye, target = [np.cos(0.15 * k), np.sin(0.15 * k), 1.2], [0.2 * (k % 2), 0.1 * (k % 3), 0]
        camera = synthetic.pinhole(260.0, 320, 240, eye, target)
        rays = camera.unproject(np.ones((240, 320))) - camera.position
        at = camera.position - rays * (camera.position[2] / rays[..., 2:])
        u, v = (np.float32(200 * at[..., axis] + 400) for axis in (0, 1))
        grey = cv2.remap(texture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        path = root / f"images/kf_{k}.png"
        write_png(path, np.repeat(grey[..., None], 3, -1), linear=False)
        made.append(Frame(path.stem, camera, float(k), path))
    return made


@pytest.fixture(scope="module")
def matches(tmp_path_factory):
    """A folder that keeps the matches of the pictures, whatever their poses."""
    return tmp_path_factory.mktemp("matches") / "kept"


def agreement(frames, folder):
    return poses.agreement(frames, Matcher.of_frames(frames, folder))


def wrong(frames, change):
    """The frames with another world_to_camera."""
    changed = [replace(f.camera, world_to_camera=change(f.camera.world_to_camera)) for f in frames]
    return [replace(frame, camera=camera) for frame, camera in zip(frames, changed, strict=True)]


def test_right_poses_fit(frames, matches):
    found = agreement(frames, matches)
    assert found.error < 0.3
    assert found.problem == ""
    assert agreement(frames[:1], matches) is None


MISTAKES = {
    "camera axes of OpenCV in place": lambda W: FLIP @ W,
    "are the inverse: world-to-camera": np.linalg.inv,
    "body whose x axis points forward, not": lambda W: FLIP @ np.linalg.inv(BODY) @ W,
    "of a body whose x axis points forward": lambda W: np.linalg.inv(BODY) @ W,
    "of mirrored pictures": None,
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_wrong_convention_is_named(frames, matches, tmp_path, name):
    if change := MISTAKES[name]:
        found = agreement(wrong(frames, change), matches)
    else:
        mirrored = [tmp_path / frame.image_path.name for frame in frames]
        for frame, path in zip(frames, mirrored, strict=True):
            write_png(path, frame.rgb()[:, ::-1])
        pairs = zip(frames, mirrored, strict=True)
        found = agreement([replace(f, image_path=p) for f, p in pairs], tmp_path / "matches")
    assert found.error > 1
    assert name in found.problem


def test_a_wrong_focal_length_is_named(frames, tmp_path):
    K = frames[0].camera.K * [[1.3, 1, 1], [1, 1.3, 1], [1, 1, 1]]
    zoomed = [replace(frame, camera=replace(frame.camera, K=K)) for frame in frames]
    found = agreement(zoomed, tmp_path / "matches")
    assert "fit a focal length 0.7" in found.problem


ARCH = [([-0.4, 0, 0.25], [0.15, 0.2, 0.35]), ([0.5, 0.1, 0.3], [0.2, 0.1, 0.4])]


@pytest.mark.parametrize("evidence", ["depth", "outlines", "directions"])
def test_without_matches_others_tell(tmp_path, evidence):
    """Pictures of little texture, where cameras are far apart."""
    rocks = [(np.array(c), np.array(a)) for c, a in ARCH]
    frames = synthetic.write_dataset(tmp_path, None, rocks, depth=evidence == "depth").frames
    if evidence == "directions":
        frames = [replace(frame, mask_path=None) for frame in frames]
    right = agreement(frames, tmp_path / "matches")
    assert right is None or (right.error < 1 and not right.problem)
    assert (right is None) == (evidence == "directions")
    for name in [*MISTAKES][:3]:
        found = agreement(wrong(frames, MISTAKES[name]), tmp_path / "matches")
        assert evidence in found.evidence
        assert name in found.problem


@pytest.mark.parametrize("rocks", [ARCH, [([0, 0, 0.3], [0.5, 0.4, 0.2])]])
def test_masks_tell_shuffled_pictures(tmp_path, rocks):
    rocks = [(np.array(c), np.array(a)) for c, a in rocks]
    cameras = synthetic.orbit_cameras(9, 96, 72) + synthetic.orbit_cameras(5, 96, 72, 2.0, 2.5)
    frames = synthetic.write_dataset(tmp_path, cameras, rocks, depth=False).frames
    order = np.random.default_rng(7).permutation(len(frames))
    shuffled = [replace(f, camera=frames[k].camera) for f, k in zip(frames, order, strict=True)]
    right, found = (agreement(one, tmp_path / "matches") for one in (frames, shuffled))
    matcher = Matcher.of_frames(frames, tmp_path / "matches")
    assert poses.agreement(frames, matcher, masked=False) is None
    assert right.error < 1
    assert "do not belong to these pictures" in found.problem


def test_depth_in_another_unit_is_named(tmp_path):
    near, far = synthetic.orbit_cameras(8), synthetic.orbit_cameras(8, radius=3.4, altitude=2.4)
    cameras = [(near, far)[k % 2][k] for k in range(8)]  # a plain ring turns into itself
    frames = synthetic.write_dataset(tmp_path, cameras).frames
    for frame in frames:
        write_exr(frame.depth_path, {"Z": 5 * frame.depth()})
    problem = agreement(frames, tmp_path / "matches").problem
    assert re.search("fit lengths (4.9|5).* times as long", problem)


def test_points_that_pictures_show_tell(frames):
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.3, 0.3, (50, 2)), np.zeros(50)])
    seen = [(f.camera, points, f.camera.project(points)[0] + 0.1) for f in frames]
    assert observed(seen).error == pytest.approx(0.1414, abs=1e-3)
    turned = [(wrong(frames, np.linalg.inv)[k].camera, p, x) for k, (_, p, x) in enumerate(seen)]
    assert "are the inverse" in observed(turned).problem


@pytest.mark.parametrize("depth", [True, False])
def test_errors_are_in_pixels_of_either_side(tmp_path, depth):
    cameras, errors = synthetic.orbit_cameras(8, 80, 60), []
    for across in (True, False):
        root, several = tmp_path / f"{across}", synthetic.halved(cameras, across)
        frames = synthetic.write_dataset(root, several, depth=depth).frames
        moved = perturb(several, 0.02, 0.3, np.random.default_rng(0))
        moved = [replace(f, camera=c) for f, c in zip(frames, moved, strict=True)]
        errors.append(agreement(moved, root / "matches").error)
    assert errors[0] == pytest.approx(errors[1], rel=0.2)
