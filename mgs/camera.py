"""Pinhole cameras and the frames they are given in.

World: metres, +Z up. Camera: OpenCV (x right, y down, z forward), pixel centres at +0.5. Depth: z-depth in metres, 0 = no
return.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mgs.errors import InputError

MAX_PIXELS = 2**27
"""Largest image of a camera: what is larger is a slip of the keyboard, and would end in a lack of memory."""

MAX_SIDE = 2**20
"""Largest width and height of an image, pixels: beyond it float32 cannot tell neighbouring pixel centres well, and a strip a
pixel wide, drawn in whole blocks, has far more than MAX_PIXELS."""

_OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera. Two are equal where all their numbers are.

    K: [3,3] float64, pixels: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]. width, height: pixels.
    world_to_camera: [4,4] float64, rigid, OpenCV axes, metres.
    Raises InputError where K or the pose is not finite, K has skew or a non-positive focal length, the image has no pixel,
    parts of pixels, more than MAX_PIXELS or a side beyond MAX_SIDE, or the pose is not rigid.
    """

    K: NDArray[np.float64]
    width: int
    height: int
    world_to_camera: NDArray[np.float64]

    def __post_init__(self) -> None:
        K = np.asarray(self.K, np.float64)
        pose = np.asarray(self.world_to_camera, np.float64)
        if int(self.width) != self.width or int(self.height) != self.height:
            raise InputError(f"camera: image size {self.width}x{self.height} must be whole pixels")
        object.__setattr__(self, "width", int(self.width))  # NumPy's integers are no sizes to Dr.Jit
        object.__setattr__(self, "height", int(self.height))
        object.__setattr__(self, "K", K)
        object.__setattr__(self, "world_to_camera", pose)
        if K.shape != (3, 3) or not np.isfinite(K).all():
            raise InputError("camera: K must be a finite 3x3 matrix; correct the intrinsics")
        if K[0, 0] <= 0 or K[1, 1] <= 0:
            raise InputError("camera: focal lengths must be positive; correct fl_x and fl_y")
        if K[0, 1] != 0 or K[1, 0] != 0 or not np.array_equal(K[2], [0, 0, 1]):
            raise InputError("camera: K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], without skew; resample the images")
        if self.width < 1 or self.height < 1 or self.width * self.height > MAX_PIXELS:
            size = f"{self.width}x{self.height}"
            raise InputError(f"camera: image size {size} must be at least 1x1, and at most {MAX_PIXELS:,} pixels in all")
        if max(self.width, self.height) > MAX_SIDE:
            raise InputError(f"camera: image size {self.width}x{self.height} must be at most {MAX_SIDE:,} pixels either way")
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            raise InputError("camera: the pose has NaN or infinite entries; correct its transform matrix")
        rotation = pose[:3, :3]
        rigid = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4) and np.linalg.det(rotation) > 0
        if not rigid or not np.allclose(pose[3], [0, 0, 0, 1], atol=1e-9):
            raise InputError("camera: the pose is singular or not rigid; its rotation must be orthonormal")

    def _key(self) -> tuple[object, ...]:
        return self.K.tobytes(), self.width, self.height, self.world_to_camera.tobytes()

    def __eq__(self, other: object) -> bool:
        return self._key() == other._key() if isinstance(other, Camera) else NotImplemented

    def __hash__(self) -> int:
        return hash(self._key())

    @property
    def camera_to_world(self) -> NDArray[np.float64]:
        """[4,4] OpenCV camera-to-world."""
        R, t = self.world_to_camera[:3, :3], self.world_to_camera[:3, 3]
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = R.T, -R.T @ t
        return pose

    @property
    def position(self) -> NDArray[np.float64]:
        """[3] camera centre in the world, metres."""
        return self.camera_to_world[:3, 3]

    @property
    def key(self) -> bytes:
        """K, pose and image size as bytes: equal where all of these are, so it names the view in caches and seeds."""
        return self.K.tobytes() + self.world_to_camera.tobytes() + f"{self.width}x{self.height}".encode()

    def project(self, points: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """World points [N,3] -> (pixels [N,2], z-depth [N]); pixels are meaningless where z <= 0."""
        p = np.asarray(points, np.float64) @ self.world_to_camera[:3, :3].T + self.world_to_camera[:3, 3]
        z = p[:, 2]
        safe = np.where(z > 0, z, 1.0)
        u = self.K[0, 0] * p[:, 0] / safe + self.K[0, 2]
        v = self.K[1, 1] * p[:, 1] / safe + self.K[1, 2]
        return np.stack([u, v], 1), z

    def unproject(self, depth: ArrayLike) -> NDArray[np.float64]:
        """z-depth image [H,W], metres -> world points [H,W,3]; meaningless where depth is 0."""
        depth = np.asarray(depth, np.float64)
        v, u = np.mgrid[: self.height, : self.width] + 0.5
        x = (u - self.K[0, 2]) / self.K[0, 0] * depth
        y = (v - self.K[1, 2]) / self.K[1, 1] * depth
        pose = self.camera_to_world
        return np.stack([x, y, depth], -1) @ pose[:3, :3].T + pose[:3, 3]


def look_at(eye: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> NDArray[np.float64]:
    """OpenCV world_to_camera [4,4] of a camera at `eye` that looks at `target` with world `up` (metres)."""
    eye = np.asarray(eye, np.float64)
    forward: NDArray[np.float64] = np.asarray(target, np.float64) - eye
    norm = np.linalg.norm(forward)
    if norm == 0:
        raise InputError("look_at: eye and target are the same point")
    forward = forward / norm
    right: NDArray[np.float64] = np.cross(forward, np.asarray(up, np.float64))
    if np.linalg.norm(right) < 1e-9:
        right = np.cross(forward, [0.0, 1.0, 0.0])
    right = right / np.linalg.norm(right)
    pose = np.eye(4, dtype=np.float64)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ eye
    return pose


def opencv_from_opengl(camera_to_world: ArrayLike) -> NDArray[np.float64]:
    """nerfstudio's OpenGL camera-to-world [4,4] -> our OpenCV world_to_camera [4,4]."""
    return np.asarray(np.linalg.inv(np.asarray(camera_to_world, np.float64) @ _OPENGL_FROM_OPENCV), np.float64)


def opengl_from_opencv(world_to_camera: ArrayLike) -> NDArray[np.float64]:
    """Our OpenCV world_to_camera [4,4] -> nerfstudio's OpenGL camera-to-world [4,4]."""
    return np.asarray(np.linalg.inv(np.asarray(world_to_camera, np.float64)) @ _OPENGL_FROM_OPENCV, np.float64)
