"""Datasets on disk: round trips, checks of their consistency; cameras and Gaussians as values."""

import copy
import json
import re
from dataclasses import replace

import numpy as np
import pytest
import synthetic
import tiny
from PIL import Image
from refusals import fails
from scipy.ndimage import gaussian_filter

from mgs import as_drjit
from mgs.camera import Camera, look_at, opencv_from_opengl
from mgs.colour import linear_from_srgb
from mgs.data.check import check_dataset
from mgs.data.dataset import load_dataset, target_of, write_transforms
from mgs.data.frames import boundary, write_rock_image
from mgs.gaussians import ARRAYS
from mgs.images import write_exr, write_png
from mgs.prior.exposure import without_gain

W, H = 64, 48
K = synthetic.orbit_cameras(1, W, H)[0].K


@pytest.fixture
def folder(tmp_path):
    return synthetic.orbit(tmp_path / "data", 6, W, H).root


def test_round_trip_keeps_cameras_and_pixels(folder):
    first = load_dataset(folder)
    write_transforms(folder, first.frames)
    again = load_dataset(folder)
    for a, b in zip(first.frames, again.frames, strict=True):
        assert (a.name, a.timestamp) == (b.name, b.timestamp)
        np.testing.assert_allclose(a.camera.world_to_camera, b.camera.world_to_camera, atol=1e-12)
        np.testing.assert_array_equal(a.camera.K, b.camera.K)
        np.testing.assert_array_equal(a.rgb(), b.rgb())
        depth, mask, _ = synthetic.cast(a.camera, [(synthetic.CENTRE, synthetic.AXES)])
        np.testing.assert_array_equal(a.depth(), depth.astype(np.float32))
        np.testing.assert_array_equal(a.mask(), mask)
        np.testing.assert_array_equal(a.masked_rgb()[~a.mask()], 0)


def test_transforms_are_nerfstudios(folder):
    """OpenGL camera-to-world: the camera looks along -z of the matrix, at the rock."""
    data = json.loads((folder / "transforms.json").read_text())
    assert {"fl_x", "fl_y", "cx", "cy", "w", "h"} <= set(data)
    pose = np.array(data["frames"][1]["transform_matrix"])
    ahead = synthetic.CENTRE - pose[:3, 3]
    np.testing.assert_allclose(-pose[:3, 2], ahead / np.linalg.norm(ahead), atol=1e-9)
    assert pose[2, 1] > 0  # its y is up
    camera = load_dataset(folder).frames[1].camera
    np.testing.assert_allclose(camera.world_to_camera, opencv_from_opengl(pose))


def test_frames_come_in_order_of_time_and_may_have_their_own_intrinsics(folder):
    def change(data):
        data["frames"].reverse()
        data["frames"][0]["fl_x"] = 99.0

    synthetic.edit(folder, change)
    frames = load_dataset(folder).frames
    assert [frame.timestamp for frame in frames] == sorted(frame.timestamp for frame in frames)
    assert frames[-1].camera.K[0, 0] == 99.0
    assert frames[0].camera.K[0, 0] == K[0, 0]


def _with_rock_images(folder):
    """The dataset with rock images, of alphas in steps of 1/255 that agree with the masks."""
    frames = []
    for i, frame in enumerate(load_dataset(folder).frames):
        rng, mask = np.random.default_rng(i), frame.mask()
        alpha = np.where(mask, 1.0, 0.0)
        rim = boundary(mask)
        alpha[rim] = rng.integers(1, 255, rim.sum()) / 255
        rgb = linear_from_srgb(rng.integers(0, 256, (H, W, 3)) / 255) * alpha[..., None]
        frame = replace(frame, rock_path=folder / f"rock/{frame.name}.png")
        write_rock_image(frame.rock_path, np.dstack([rgb, alpha]))
        frames.append((frame, np.dstack([rgb, alpha])))
    write_transforms(folder, [frame for frame, _ in frames])
    return frames


def test_the_target_is_the_rock_premultiplied(folder):
    """Alpha comes back exactly, colour to the step of 8 bits, from sRGB with straight alpha."""
    written = _with_rock_images(folder)
    for frame, (_, expected) in zip(load_dataset(folder).frames, written, strict=True):
        rgba, weight = frame.target()
        np.testing.assert_allclose(rgba, expected, atol=1e-6)
        assert rgba.dtype == weight.dtype == np.float32
        np.testing.assert_array_equal(weight, 1)
        np.testing.assert_array_equal(frame.masked_rgb(), rgba[..., :3])
        with Image.open(frame.rock_path) as image:
            assert image.mode == "RGBA"
            straight = np.asarray(image) / 255
        covered = straight[..., 3] > 0
        colour = rgba[covered, :3] / rgba[covered, 3:]
        np.testing.assert_allclose(linear_from_srgb(straight[covered, :3]), colour, rtol=1e-5)
        without_mask = replace(frame, mask_path=None)
        np.testing.assert_array_equal(without_mask.mask(), rgba[..., 3] >= 0.5)


def test_the_target_of_a_mask_has_no_weight_along_its_outline(folder):
    frame = load_dataset(folder).frames[0]
    mask, (rgba, weight) = frame.mask(), frame.target()
    np.testing.assert_array_equal(rgba, np.dstack([frame.rgb() * mask[..., None], mask]))
    padded = np.pad(mask, 1, mode="edge")
    neighbours = [padded[1:-1, :-2], padded[1:-1, 2:], padded[:-2, 1:-1], padded[2:, 1:-1]]
    differs = np.any([neighbour != mask for neighbour in neighbours], axis=0)
    assert 40 < differs.sum() < 300
    np.testing.assert_array_equal(weight, np.where(differs, 0, 1))
    np.testing.assert_array_equal(frame.masked_rgb(), rgba[..., :3])
    np.testing.assert_array_equal(target_of(frame), np.dstack([rgba[..., :3], weight]))
    with_alpha = np.dstack([rgba[..., :3], weight, rgba[..., 3]])
    np.testing.assert_array_equal(target_of(frame, True), with_alpha)
    halved = without_gain(target_of(frame, True), np.array([2.0, 2.0, 2.0]))
    np.testing.assert_array_equal(halved, np.dstack([rgba[..., :3] / 2, weight, rgba[..., 3]]))
    rgba, weight = replace(frame, mask_path=None).target()
    np.testing.assert_array_equal(rgba, np.dstack([frame.rgb(), np.ones((H, W))]))
    np.testing.assert_array_equal(weight, 1)
    # The edge of the image is no outline.
    mask = np.zeros((5, 6), bool)
    mask[:, 3:] = True
    np.testing.assert_array_equal(boundary(mask), [[False, False, True, True, False, False]] * 5)


def test_a_camera_has_no_skew_and_whole_pixels():
    for entry in ((0, 1), (1, 0), (2, 0), (2, 1), (2, 2)):  # nothing else reads these entries
        skewed = K.copy()
        skewed[entry] += 0.5
        fails(r"K must be \[\[fx, 0, cx\].* without skew", Camera, skewed, W, H, np.eye(4))
    for side in (float("nan"), float("inf"), np.float32("nan"), 12.5):
        for size in ((side, H), (W, side)):
            fails("must be whole pixels", Camera, K, *size, np.eye(4))


def test_a_focal_length_keeps_the_precision_of_what_it_divides():
    """Sizes of pixels were float32 once, so every prior from depth was another."""
    K = np.array([[3.1, 0, 2], [0, 3.1, 1], [0, 0, 1]])
    camera = Camera(K, 4, 2, np.eye(4))
    assert camera.focal == K[0, 0]
    assert (np.ones(2, np.float32) / camera.focal).dtype == np.float64
    assert (np.float32(1) / camera.focal).dtype == np.float64


def test_cameras_that_differ_in_the_sign_of_zero_are_equal():
    signed_K, signed_pose = (np.where(matrix == 0, -0.0, matrix) for matrix in (K, np.eye(4)))
    plain, signed = Camera(K, W, H, np.eye(4)), Camera(signed_K, W, H, signed_pose)
    assert plain == signed
    assert hash(plain) == hash(signed)


def test_check_passes_a_sound_dataset(tmp_path):
    check = check_dataset(synthetic.orbit(tmp_path, 12, W, H))
    assert check.problems == []
    assert check.seen_through < 0.05
    assert 2 < check.depth_range[0] < check.depth_range[1] < 3.5


def test_check_finds_wrong_depth_units_and_wrong_axes(tmp_path):
    dataset = synthetic.orbit(tmp_path / "far", 12, W, H)
    for frame in dataset.frames:
        write_exr(frame.depth_path, {"Z": 1.3 * frame.depth()})
    assert any("see through" in problem for problem in check_dataset(dataset).problems)
    folder = synthetic.orbit(tmp_path / "axes", 12, W, H).root
    flip = np.diag([1.0, -1.0, -1.0, 1.0])

    def change(data):
        for frame in data["frames"]:
            frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ flip).tolist()

    synthetic.edit(folder, change)
    problems = check_dataset(load_dataset(folder)).problems
    assert any("share no point" in problem for problem in problems)


def test_check_lists_every_problem(folder):
    frames = load_dataset(folder).frames
    frames[0].image_path.write_bytes(b"")
    write_png(frames[1].mask_path, np.zeros((H, W), bool))
    write_exr(frames[2].depth_path, {"Z": np.zeros((H, W), np.float32)})
    pose = json.loads((folder / "transforms.json").read_text())["frames"][3]["transform_matrix"]
    synthetic.edit(folder, lambda d: d["frames"][4].update(transform_matrix=pose))
    problems = "\n".join(check_dataset(load_dataset(folder)).problems)
    for expected in ("not a readable image", "mask is empty", "same pose as kf_0003"):
        assert expected in problems
    assert "most of the mask has no depth" in problems


def test_check_names_blurred_frames_or_says_that_all_are(folder):
    frames = load_dataset(folder).frames

    def soften(frame):
        write_png(frame.image_path, gaussian_filter(frame.rgb(), (1.5, 1.5, 0)))

    soften(frames[2])
    (problem,) = check_dataset(load_dataset(folder)).problems
    assert re.match(r"frame kf_0002: is blurred, by 1\.\d pixels \(median 0\.\d\)", problem)
    for frame in (*frames[:2], *frames[3:]):
        soften(frame)
    (problem,) = check_dataset(load_dataset(folder)).problems
    assert re.match(r"the images are blurred, by 1\.\d pixels in the median", problem)


def test_check_compares_rock_images_with_masks(folder):
    frames = [frame for frame, _ in _with_rock_images(folder)]
    assert check_dataset(load_dataset(folder)).problems == []
    for frame, change in ((frames[1], -1), (frames[2], 1)):
        rgba, _ = frame.target()
        row, column = np.argwhere(rgba[..., 3] == (change < 0))[7]
        rgba[row, column] += change
        write_rock_image(frame.rock_path, rgba)
    write_rock_image(frames[3].rock_path, np.ones((H, W + 1, 4)))
    frames[4].rock_path.write_bytes(b"")
    problems = check_dataset(load_dataset(folder)).problems
    assert [problem.split("/")[-1] for problem in problems] == [
        "kf_0001.png: contradicts the mask in 1 pixels; make both from the same source",
        "kf_0002.png: contradicts the mask in 1 pixels; make both from the same source",
        f"kf_0003.png: is {W + 1}x{H}, but transforms.json says {W}x{H}; correct either",
        "kf_0004.png: not a readable image; give a PNG or JPEG, or write it again if it is damaged",
    ]
    for frame, problem in zip(frames[1:5], problems, strict=True):
        assert str(frame.rock_path) in problem


WHOLE = tiny.initial([])
VIEW = Camera(np.diag([20.0, 20.0, 1.0]), 16, 12, look_at([3, 0, 1], [0, 0, 0]))


def test_slices_masks_and_indices_give_gaussians():
    chosen = np.array([5, 2, 9])
    mask = np.zeros(len(WHOLE), bool)
    mask[chosen] = True
    assert len(WHOLE[3:7]) == 4
    np.testing.assert_array_equal(WHOLE[chosen].means, WHOLE.means[chosen])
    assert WHOLE[mask] == WHOLE[np.sort(chosen)]
    assert WHOLE[4] == WHOLE[4:5]
    assert WHOLE[-1].check() == WHOLE[len(WHOLE) - 1 :]
    assert as_drjit(WHOLE)[3:7] == WHOLE[3:7]


@pytest.mark.parametrize("axis", np.eye(3))
def test_a_camera_that_looks_along_up_has_a_pose(axis):
    turn = look_at([0, 0, 0], axis, up=axis)[:3, :3]
    assert np.allclose(turn @ turn.T, np.eye(3))
    assert np.allclose(turn[2], axis)


@pytest.mark.parametrize("name", ARRAYS)
def test_gaussians_are_equal_if_all_numbers_are(name):
    other = copy.deepcopy(WHOLE)
    assert WHOLE == other == as_drjit(WHOLE)
    values = getattr(other, name)
    values.flat[-1] = np.nextafter(values.flat[-1], np.float32(9))
    assert other != WHOLE
    assert replace(WHOLE, **{name: getattr(WHOLE, name)[:-1]}) != WHOLE
    assert replace(WHOLE, antialiased=not WHOLE.antialiased) != WHOLE
    assert WHOLE != "gaussians"
    with pytest.raises(TypeError):
        hash(WHOLE)


def test_cameras_are_equal_if_all_numbers_are():
    others = {"width": 17, "height": 13, "world_to_camera": np.eye(4)}
    others["K"] = np.diag([20.0, 21.0, 1.0])
    for change in ({}, *({name: value} for name, value in others.items())):
        other = Camera(**{**vars(VIEW), **change})
        assert (other == VIEW) == (not change)
        assert len({VIEW, other}) == (2 if change else 1)
    assert VIEW != "camera"
