"""Gaussians and cameras as values: slices, equality."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import tiny

from mgs.camera import Camera, look_at
from mgs.gaussians import ARRAYS
from mgs.splat import as_drjit

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


@pytest.mark.parametrize(
    "change",
    [
        {"width": 17},
        {"height": 13},
        {"K": np.diag([20.0, 21.0, 1.0])},
        {"world_to_camera": np.eye(4)},
        {},
    ],
)
def test_cameras_are_equal_if_all_numbers_are(change):
    other = Camera(**{**vars(VIEW), **change})
    assert (other == VIEW) == (not change)
    assert len({VIEW, other}) == (2 if change else 1)
    assert VIEW != "camera"
