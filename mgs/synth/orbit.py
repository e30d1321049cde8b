"""Cameras that fly around a rock at the origin and look at its middle."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from mgs.camera import Camera, look_at
from mgs.errors import InputError
from mgs.synth.scene_file import Orbit, SceneFile

if TYPE_CHECKING:
    import trimesh

EVALUATION_ELEVATIONS = (5.0, 75.0)  # elevations of the test views above the rock's middle, degrees
MOST_NOISE = 1000.0  # largest error of positions, metres: far beyond any orbit


@dataclass(frozen=True)
class PoseNoise:
    """Standard deviations of the pose errors in transforms.json, per axis: metres and degrees.

    Raises InputError if one is negative, NaN or absurdly large."""

    position: float = 0.0
    rotation: float = 0.0

    def __post_init__(self) -> None:
        if not (0 <= self.position <= MOST_NOISE and 0 <= self.rotation <= 180):
            raise InputError(
                f"synth-orbit: pose_noise {self.position:g} must be 0 to {MOST_NOISE:g} metres, "
                f"and rotation_noise {self.rotation:g} 0 to 180 degrees"
            )


def intrinsics(fov: float, width: int, height: int) -> np.ndarray:
    """Pinhole K [3,3], pixels, square and centred; fov: horizontal field of view, degrees."""
    focal = width / 2 / np.tan(np.radians(fov) / 2)
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])


def orbit_positions(settings: Orbit, frames: int, target: np.ndarray) -> np.ndarray:
    """Camera centres [frames,3], world, metres, counter-clockwise from azimuth 0 (+x).

    settings.kind: circle, of fixed radius and altitude (paper); rings, `turns` circles at rising
    elevations; spiral, `turns` turns of rising elevation; hemisphere, spread evenly between the
    elevations (Fibonacci lattice), sorted by azimuth. Frame k is then moved away from the target
    [3] to settings.distances[k % len] times its distance."""
    step = np.arange(frames)
    low, high = np.radians(settings.elevations)
    along = step / max(frames - 1, 1)
    if settings.kind == "circle":
        azimuth, elevation = 2 * np.pi * step / frames, np.zeros(frames)
    elif settings.kind == "rings":
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
    x, y, z = flat * np.cos(azimuth), flat * np.sin(azimuth), settings.radius * np.sin(elevation)
    positions = np.stack([x, y, z], 1) + target
    if settings.kind == "circle":
        positions[:, 2] = settings.altitude
    return positions + (np.resize(settings.distances, frames)[:, None] - 1) * (positions - target)


def orbit_cameras(
    settings: Orbit, frames: int, target: np.ndarray, fov: float, width: int, height: int
) -> list[Camera]:
    """Cameras of an orbit that look at `target` [3], world, metres; fov: horizontal, degrees."""
    K = intrinsics(fov, width, height)
    positions = orbit_positions(settings, frames, target)
    return [Camera(K, width, height, look_at(eye, target)) for eye in positions]


def rock_cameras(
    scene: SceneFile, size: tuple[int, int], frames: int, rock: "trimesh.Trimesh"
) -> list[Camera]:
    """Cameras of the scene's orbit, aimed at the middle of the rock above the ground. size: (width,
    height), pixels. Raises InputError if that part of the rock is not wholly inside a frame."""
    return _aimed(scene, scene.orbit, size, frames, rock, "frame")


def evaluation_cameras(
    scene: SceneFile, size: tuple[int, int], views: int, rock: "trimesh.Trimesh"
) -> list[Camera]:
    """Cameras of test views, spread evenly over a dome of EVALUATION_ELEVATIONS at the radius of
    the scene's orbit. Raises InputError as `rock_cameras`."""
    change = {"kind": "hemisphere", "elevations": EVALUATION_ELEVATIONS, "distances": (1,)}
    dome = scene.orbit.model_copy(update=change)
    return _aimed(scene, dome, size, views, rock, "test view")


def _aimed(
    scene: SceneFile,
    orbit: Orbit,
    size: tuple[int, int],
    frames: int,
    rock: "trimesh.Trimesh",
    what: str,
) -> list[Camera]:
    target = np.array([0, 0, rock.bounds[1, 2] / 2])
    cameras = orbit_cameras(orbit, frames, target, scene.camera.fov, *size)
    visible = np.asarray(rock.vertices[rock.vertices[:, 2] > 0]).T
    width, height = size
    # Rows times (u z, v z, z): z times the distance from each border, a pixel inside; last row z.
    borders = np.array([[1, 0, -1], [-1, 0, width - 1], [0, 1, -1], [0, -1, height - 1], [0, 0, 1]])
    for index, camera in enumerate(cameras):
        planes = borders @ camera.K @ camera.world_to_camera[:3]
        if ((planes[:, :3] @ visible).min(1) + planes[:, 3] < [0, 0, 0, 0, 1e-9]).any():
            cure = "raise orbit.radius or camera.fov"
            raise InputError(f"scene: the rock is not wholly in {what} {index}; {cure}")
    return cameras


def perturb(
    cameras: list[Camera], position: float, rotation: float, rng: np.random.Generator
) -> list[Camera]:
    """Cameras with independent Gaussian pose errors. position, rotation: standard deviations per
    axis, metres and degrees."""
    from scipy.spatial.transform import Rotation  # here, so that `mgs --help` does not load it

    noisy = []
    for camera in cameras:
        pose = camera.camera_to_world
        pose[:3, 3] += rng.normal(0, position, 3)
        turn = Rotation.from_rotvec(rng.normal(0, np.radians(rotation), 3)).as_matrix()
        pose[:3, :3] = pose[:3, :3] @ turn
        world_to_camera = np.linalg.inv(pose).astype(np.float64)
        noisy.append(Camera(camera.K, camera.width, camera.height, world_to_camera))
    return noisy
