"""Cameras that fly around a rock at the origin and look at one target, its middle."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from mgs.camera import Camera, look_at
from mgs.synth.scene_file import Orbit


def intrinsics(fov: float, width: int, height: int) -> np.ndarray:
    """Pinhole K [3,3], pixels: horizontal field of view in degrees, square pixels, principal point
    in the middle."""
    focal = width / 2 / np.tan(np.radians(fov) / 2)
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])


def orbit_positions(settings: Orbit, frames: int, target: np.ndarray) -> np.ndarray:
    """Camera centres [frames,3], world, metres, in the order of flight: counter-clockwise, from
    azimuth 0, which is +x.

    settings.kind is one of: circle, of fixed radius and altitude, as in the paper; rings, `turns`
    circles at rising elevations; spiral, `turns` turns with rising elevation; hemisphere, positions
    spread evenly between the two elevations (Fibonacci lattice), sorted by azimuth. Frame k is then
    moved away from the target to settings.distances[k % len] times its distance.
    target [3]: the point that all look at, world, metres.
    """
    positions = _at_one_distance(settings, frames, target)
    return positions + (np.resize(settings.distances, frames)[:, None] - 1) * (positions - target)


def _at_one_distance(settings: Orbit, frames: int, target: np.ndarray) -> np.ndarray:
    """Camera centres [frames,3] as of `orbit_positions`, without the factors on their distances."""
    step = np.arange(frames)
    if settings.kind == "circle":
        azimuth = 2 * np.pi * step / frames
        x, y = (
            target[0] + settings.radius * np.cos(azimuth),
            target[1] + settings.radius * np.sin(azimuth),
        )
        return np.stack([x, y, np.full(frames, settings.altitude)], 1)
    low, high = np.radians(settings.elevations)
    along = step / max(frames - 1, 1)
    if settings.kind == "rings":
        rings = max(1, round(settings.turns))
        ring = step * rings // frames
        azimuth = 2 * np.pi * (step * rings / frames - ring)
        elevation = low + (high - low) * ring / max(rings - 1, 1)
    elif settings.kind == "spiral":
        azimuth, elevation = 2 * np.pi * settings.turns * along, low + (high - low) * along
    else:
        elevation = np.arcsin(np.sin(low) + (np.sin(high) - np.sin(low)) * (step + 0.5) / frames)
        azimuth = np.pi * (3 - np.sqrt(5)) * step % (2 * np.pi)
        order = np.argsort(azimuth)
        azimuth, elevation = azimuth[order], elevation[order]
    flat = settings.radius * np.cos(elevation)
    return (
        np.stack(
            [flat * np.cos(azimuth), flat * np.sin(azimuth), settings.radius * np.sin(elevation)], 1
        )
        + target
    )


def orbit_cameras(
    settings: Orbit, frames: int, target: np.ndarray, fov: float, width: int, height: int
) -> list[Camera]:
    """The cameras of an orbit. target [3]: the point that all look at, world, metres; fov:
    horizontal, degrees."""
    K = intrinsics(fov, width, height)
    return [
        Camera(K, width, height, look_at(eye, target))
        for eye in orbit_positions(settings, frames, target)
    ]


def perturb(
    cameras: list[Camera], position: float, rotation: float, rng: np.random.Generator
) -> list[Camera]:
    """The cameras with an independent Gaussian error in each pose.

    position: standard deviation along each axis, metres; rotation: standard deviation about each
    axis, degrees.
    """
    noisy = []
    for camera in cameras:
        pose = camera.camera_to_world
        pose[:3, 3] += rng.normal(0, position, 3)
        pose[:3, :3] = (
            pose[:3, :3] @ Rotation.from_rotvec(rng.normal(0, np.radians(rotation), 3)).as_matrix()
        )
        world_to_camera = np.linalg.inv(pose).astype(np.float64)
        noisy.append(Camera(camera.K, camera.width, camera.height, world_to_camera))
    return noisy
