"""Rotations in NumPy: quaternions (w x y z), rotation matrices, glTF's axes."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

QUAT_MIN = 1e-12  # quaternions no larger than this mean the identity

WORLD_FROM_GLTF = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""Rotation [4,4] from the axes of glTF (+Y up) to the world's (+Z up)."""


def rotmat_from_quat(quats: ArrayLike) -> NDArray[np.float64]:
    """Rotation matrices [...,3,3] of quaternions wxyz [...,4] of any norm; identity for zero."""
    q = np.asarray(quats, np.float64)
    valid = np.abs(q).max(-1, keepdims=True) > QUAT_MIN
    norm = np.linalg.norm(q, axis=-1, keepdims=True)
    q = np.where(valid, q / np.where(valid, norm, 1.0), [1.0, 0.0, 0.0, 0.0])
    w, x, y, z = np.moveaxis(q, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def quat_from_normals(normals: ArrayLike) -> NDArray[np.float64]:
    """Unit quaternions wxyz [N,4] of the shortest rotations from +Z to normals [N,3]."""
    n = np.asarray(normals, np.float64)
    n = n / np.linalg.norm(n, axis=1, keepdims=True)
    q = np.stack([1 + n[:, 2], -n[:, 1], n[:, 0], np.zeros(len(n))], 1)
    q[n[:, 2] < -1 + 1e-9] = [0.0, 1.0, 0.0, 0.0]
    return q / np.linalg.norm(q, axis=1, keepdims=True)
