"""Pinhole cameras with OpenCV axes (x right, y down, z forward) in a world in metres, +Z up. Pixels
(u, v) count from the image's corner: the first centre is (0.5, 0.5). Depth is z-depth along the
camera's z axis, metres; 0 is "no return"."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mgs.errors import InputError

MAX_PIXELS = 2**27  # of an image: more are probably a typing error and would not fit into memory
MAX_SIDE = 2**20  # width and height of an image, pixels: float32 resolves no more pixel centres
FURTHEST = 1e8  # largest coordinate of a camera, and entry of K; float32 ends there
_OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL: x right, y up, z backward


@dataclass(frozen=True, eq=False)
class Camera:
    """Pinhole camera. Two cameras are equal if all their numbers are equal.

    - K: [3,3] float64, intrinsics in pixels: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]].
    - width, height: of the image, pixels.
    - world_to_camera: [4,4] float64, rigid transform in metres, to OpenCV axes (x right, y down,
      z forward).
    - film, corner: of a crop window, the camera of the whole film, and the window's left and top on
      it, pixels (`cropped`). Splats are projected as for the whole film, so that tiles fit together
      bit for bit.

    K and world_to_camera may be Dr.Jit tensors. `mgs.render` then differentiates the image by them;
    `traced` holds both, and the fields their values.

    Raises InputError if K or the pose is not finite, K has skew or a focal length that is not
    positive, an entry exceeds FURTHEST, the width or height is not a whole number of at least 1,
    the image exceeds MAX_PIXELS or MAX_SIDE, or the pose is not rigid."""

    K: NDArray[np.float64]
    width: int
    height: int
    world_to_camera: NDArray[np.float64]
    film: Camera | None = None
    corner: tuple[int, int] = (0, 0)
    traced: tuple[Any, Any] | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        arrays = self.K, self.world_to_camera
        if any(type(array).__module__.startswith("drjit") for array in arrays):
            object.__setattr__(self, "traced", arrays)
        K = np.asarray(self.K, np.float64) + 0.0  # makes 0.0 of -0.0: `key` compares bytes
        pose = np.asarray(self.world_to_camera, np.float64) + 0.0
        try:
            whole = int(self.width) == self.width and int(self.height) == self.height
        except (ValueError, OverflowError):  # of NaN and of infinity
            whole = False
        if not whole:
            raise InputError(f"camera: image size {self.width}x{self.height} must be whole pixels")
        # Dr.Jit does not accept NumPy's integers as sizes.
        size = {"width": int(self.width), "height": int(self.height)}
        for name, value in (size | {"K": K, "world_to_camera": pose}).items():
            object.__setattr__(self, name, value)
        if problem := self._problem():
            raise InputError(f"camera: {problem}")

    def _problem(self) -> str:
        """Reason for which no camera can have these numbers, and its cure; empty if one can."""
        K, pose, size = self.K, self.world_to_camera, f"image size {self.width}x{self.height}"
        if K.shape != (3, 3) or not np.isfinite(K).all():
            return "K must be a finite 3x3 matrix; correct the intrinsics"
        if K[0, 0] <= 0 or K[1, 1] <= 0:
            return "focal lengths must be positive; correct fl_x and fl_y"
        if K[0, 1] != 0 or K[1, 0] != 0 or not np.array_equal(K[2], [0, 0, 1]):
            return (
                "K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], without skew; resample the images"
            )
        if self.width < 1 or self.height < 1 or self.width * self.height > MAX_PIXELS:
            return f"{size} must be at least 1x1, and at most {MAX_PIXELS:,} pixels in all"
        if max(self.width, self.height) > MAX_SIDE:
            return f"{size} must be at most {MAX_SIDE:,} pixels either way"
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            return "the pose has NaN or infinite entries; correct its transform matrix"
        if max(np.abs(K).max(), np.abs(pose).max()) > FURTHEST:
            far = f"K or the pose has entries beyond {FURTHEST:g}"
            return f"{far}; correct the focal length or the position"
        R, last = pose[:3, :3], pose[3]
        rigid = np.allclose(R @ R.T, np.eye(3), atol=1e-4) and np.linalg.det(R) > 0
        if not rigid or not np.allclose(last, [0, 0, 0, 1], atol=1e-9):
            return "the pose is singular or not rigid; its rotation must be orthonormal"
        return ""

    def __eq__(self, other: object) -> bool:
        return self.key == other.key if isinstance(other, Camera) else NotImplemented

    def __hash__(self) -> int:
        return hash(self.key)

    @property
    def camera_to_world(self) -> NDArray[np.float64]:
        """Inverse of world_to_camera [4,4]: rigid transform in metres, from OpenCV axes."""
        R, t = self.world_to_camera[:3, :3], self.world_to_camera[:3, 3]
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = R.T, -R.T @ t
        return pose

    @property
    def position(self) -> NDArray[np.float64]:
        """Centre of the camera in the world [3], metres."""
        return self.camera_to_world[:3, 3]

    @property
    def focal(self) -> float:
        """Geometric mean of both focal lengths, pixels: the area of a pixel at z-depth z is
        (z / focal)^2. A NumPy float64, so that float32 depths over it are float64."""
        return np.float64(np.sqrt(self.K[0, 0] * self.K[1, 1]))

    @property
    def key(self) -> bytes:
        """K, pose and image size as bytes: the key of a view in caches and seeds."""
        size = f"{self.width}x{self.height}".encode()
        numbers = self.K.tobytes() + self.world_to_camera.tobytes() + size
        return numbers + (repr(self.corner).encode() + self.film.key if self.film else b"")

    def project(self, points: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Project world points [N,3], metres, to pixels [N,2] and z-depths [N], metres. Pixels are
        meaningless where the z-depth is not positive."""
        R, t = self.world_to_camera[:3, :3], self.world_to_camera[:3, 3]
        p = np.asarray(points, np.float64) @ R.T + t
        z = p[:, 2]
        safe = np.where(z > 0, z, 1.0)
        u = self.K[0, 0] * p[:, 0] / safe + self.K[0, 2]
        v = self.K[1, 1] * p[:, 1] / safe + self.K[1, 2]
        return np.stack([u, v], 1), z

    def unproject(self, depth: ArrayLike) -> NDArray[np.float64]:
        """World points [H,W,3] at the pixel centres of a depth image [H,W], both in metres. Points
        are meaningless where the depth is 0."""
        depth = np.asarray(depth, np.float64)
        v, u = np.mgrid[: self.height, : self.width] + 0.5
        x = (u - self.K[0, 2]) / self.K[0, 0] * depth
        y = (v - self.K[1, 2]) / self.K[1, 1] * depth
        pose = self.camera_to_world
        return np.stack([x, y, depth], -1) @ pose[:3, :3].T + pose[:3, 3]

    def resized(self, width: int) -> Camera:
        """Same view in an image of this width, pixels. The height follows, rounded, at least 1.
        Raises InputError if the image becomes too large, or is a crop window."""
        if self.film is not None:
            raise InputError("camera: a crop window keeps its scale; resize the film, then crop it")
        height = max(1, round(self.height * width / self.width))
        scale = np.diag([width / self.width, height / self.height, 1.0])
        return Camera(scale @ self.K, width, height, self.world_to_camera)

    def seen_from(self, origin: ArrayLike) -> Camera:
        """Same camera in a world whose coordinates count from `origin` [3], metres."""
        origin = np.asarray(origin, np.float64)
        if not origin.any():
            return self
        if self.traced:
            raise InputError("camera: Dr.Jit values need Gaussians of origin 0; move the means")
        R, t = self.world_to_camera[:3, :3], self.world_to_camera[:3, 3]
        return self._posed(R, t + R @ origin, self.film and self.film.seen_from(origin))

    def scaled(self, factor: float) -> Camera:
        """Same camera in a world whose lengths are multiplied by a factor."""
        R, t = self.world_to_camera[:3, :3], self.world_to_camera[:3, 3]
        return self._posed(R, factor * t, self.film and self.film.scaled(factor))

    def turned(self, turn: ArrayLike) -> Camera:
        """Same camera in a world that is turned by a rotation [3,3]."""
        R, t = self.world_to_camera[:3, :3], self.world_to_camera[:3, 3]
        return self._posed(R @ np.transpose(turn), t, self.film and self.film.turned(turn))

    def _posed(self, R: ArrayLike, t: ArrayLike, film: Camera | None) -> Camera:
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = R, t
        return Camera(self.K, self.width, self.height, pose, film, self.corner)

    def cropped(self, left: int, top: int, width: int, height: int) -> Camera:
        """Camera of a window of the image, all four in pixels. Raises InputError if the window is
        empty or leaves the image."""
        right, bottom = left + width, top + height
        if not (0 <= left < right <= self.width and 0 <= top < bottom <= self.height):
            place = f"the window of {width}x{height} pixels at ({left}, {top})"
            image = f"the image, {self.width}x{self.height}"
            raise InputError(f"camera: {place} is empty or leaves {image}")
        K = self.K - [[0, 0, left], [0, 0, top], [0, 0, 0]]
        corner = self.corner[0] + left, self.corner[1] + top
        return Camera(K, width, height, self.world_to_camera, self.film or self, corner)


def look_at(
    eye: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)
) -> NDArray[np.float64]:
    """Return world_to_camera [4,4] of a camera at `eye` [3], metres, that looks at `target` [3].

    up: direction [3] that points upwards in the image. If the camera looks along it, +Y replaces
    it, or +Z where the camera looks along +Y. Raises InputError if eye and target are the same
    point."""
    eye = np.asarray(eye, np.float64)
    forward: NDArray[np.float64] = np.asarray(target, np.float64) - eye
    norm = np.linalg.norm(forward)
    if norm == 0:
        raise InputError("look_at: eye and target are the same point")
    forward = forward / norm
    right: NDArray[np.float64] = np.cross(forward, np.asarray(up, np.float64))
    for other in ([0.0, 1.0, 0.0], [0.0, 0.0, 1.0]):
        if np.linalg.norm(right) < 1e-9:
            right = np.cross(forward, other)
    right = right / np.linalg.norm(right)
    pose = np.eye(4, dtype=np.float64)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ eye
    return pose


def heading_and_pitch(camera: Camera) -> tuple[float, float]:
    """Direction of view, degrees: heading clockwise from +Y (0 to 360), pitch above the horizon.
    Where the camera looks straight down, the heading is that of the image's top; straight up, that
    of its bottom."""
    _, (down_x, down_y, _), (x, y, z) = camera.world_to_camera[:3, :3]
    if np.hypot(x, y) < 1e-6:
        x, y = np.sign(z) * down_x, np.sign(z) * down_y
    heading, pitch = np.degrees(np.arctan2(x, y)), np.degrees(np.arcsin(np.clip(z, -1, 1)))
    return float(heading % 360), float(pitch)


def opencv_from_opengl(camera_to_world: ArrayLike) -> NDArray[np.float64]:
    """Invert nerfstudio's camera-to-world [4,4] (OpenGL axes) to world_to_camera [4,4] (OpenCV).
    Raises numpy.linalg.LinAlgError if the matrix is singular."""
    pose: NDArray[np.float64] = np.asarray(camera_to_world, np.float64) @ _OPENGL_FROM_OPENCV
    return np.asarray(np.linalg.inv(pose), np.float64)


def opengl_from_opencv(world_to_camera: ArrayLike) -> NDArray[np.float64]:
    """Invert world_to_camera [4,4] (OpenCV) to nerfstudio's camera-to-world [4,4] (OpenGL)."""
    pose = np.linalg.inv(np.asarray(world_to_camera, np.float64))
    return np.asarray(pose @ _OPENGL_FROM_OPENCV, np.float64)


def extent_of(cameras: Sequence[Camera]) -> float:
    """Size of a scene, metres: 1.1 times the radius of the camera positions about their mean."""
    positions = np.array([camera.position for camera in cameras])
    return 1.1 * float(np.linalg.norm(positions - positions.mean(0), axis=1).max())
