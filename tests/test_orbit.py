"""Orbits: where the cameras are, and what they look at."""

import numpy as np
import pytest

from mgs.synth.orbit import orbit_cameras, orbit_positions, perturb
from mgs.synth.scene_file import Orbit

TARGET = np.array([0.3, -0.2, 0.6])
KINDS = ["circle", "rings", "spiral", "hemisphere"]


@pytest.mark.parametrize("kind", KINDS)
def test_every_camera_has_the_target_in_the_middle(kind):
    for camera in orbit_cameras(Orbit(kind=kind), 24, TARGET, 44, 96, 72):
        pixel, z = camera.project(TARGET[None])
        np.testing.assert_allclose(pixel[0], [48, 36], atol=1e-9)
        assert z[0] > 0
        assert camera.world_to_camera[1, 2] < 0  # no camera is upside down


def test_circle_is_the_papers_orbit():
    p = orbit_positions(Orbit(radius=3, altitude=2), 8, TARGET)
    np.testing.assert_allclose(np.linalg.norm(p[:, :2] - TARGET[:2], axis=1), 3)
    np.testing.assert_allclose(p[:, 2], 2)
    azimuth = np.unwrap(np.arctan2(*(p - TARGET).T[1::-1]))
    np.testing.assert_allclose(np.diff(azimuth), np.pi / 4)


@pytest.mark.parametrize("kind", KINDS[1:])
def test_domes_keep_distance_and_elevation(kind):
    p = orbit_positions(Orbit(kind=kind, radius=3, elevations=(10, 60)), 40, TARGET) - TARGET
    np.testing.assert_allclose(np.linalg.norm(p, axis=1), 3)
    elevation = np.degrees(np.arcsin(p[:, 2] / 3))
    assert elevation.min() >= 10 - 1e-9
    assert elevation.max() <= 60 + 1e-9
    assert np.ptp(elevation) > 40
    assert len(np.unique(p.round(6), axis=0)) == 40


@pytest.mark.parametrize("kind", KINDS)
def test_distances_are_taken_in_turn(kind):
    near = orbit_positions(Orbit(kind=kind), 7, TARGET)
    far = orbit_positions(Orbit(kind=kind, distances=(1, 2, 3)), 7, TARGET)
    factors = np.array([1, 2, 3, 1, 2, 3, 1])
    np.testing.assert_allclose(far - TARGET, factors[:, None] * (near - TARGET))
    assert np.array_equal(far[factors == 1], near[factors == 1]), "not a bit of these changes"


def test_hemisphere_is_even():
    p = orbit_positions(Orbit(kind="hemisphere", radius=1, elevations=(0, 90)), 100, np.zeros(3))
    distance = np.linalg.norm(p[:, None] - p[None], axis=-1) + 9 * np.eye(100)
    nearest = distance.min(1)
    assert nearest.max() < 2.5 * nearest.min()


def test_pose_noise_has_the_stated_size():
    cameras = orbit_cameras(Orbit(), 400, TARGET, 44, 96, 72)
    noisy = perturb(cameras, 0.02, 0.5, np.random.default_rng(0))
    moved = np.array([b.position - a.position for a, b in zip(cameras, noisy, strict=True)])
    assert moved.std(0) == pytest.approx([0.02] * 3, rel=0.15)
    poses = [[c.world_to_camera[:3, :3] for c in each] for each in (cameras, noisy)]
    turns = np.array(poses[1]) @ np.array(poses[0]).swapaxes(1, 2)
    angles = np.degrees(np.arccos(np.clip((np.trace(turns, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    assert np.sqrt((angles**2).mean() / 3) == pytest.approx(0.5, rel=0.1)
