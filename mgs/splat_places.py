"""Gaussians under a change of coordinates: axes that point elsewhere, and affine transforms."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from mgs.colour import even_directions, sh_basis
from mgs.data.world import PLUS_Z, World
from mgs.errors import InputError
from mgs.gaussians import Gaussians
from mgs.rotation import rotmat_from_quat

# Coordinates in which each colour coefficient's basis function is odd.
PARITY = (*("", "y", "z", "x", "xy", "yz", "", "xz"), *("", "y", "xyz", "y", "z", "x", "z", "x"))
UNEVEN = 1e-4  # relative difference of lengths, and cosine between axes: an error of rounding
FAR = 1e4  # coordinate beyond which float32 is coarser than 1 mm: it goes to `Gaussians.origin`


def mirrored(g: Gaussians, signs: tuple[int, int, int]) -> Gaussians:
    """Gaussians in axes that point along `signs` times the old ones, exactly. A second call
    returns the first ones."""
    x, y, z = signs
    sign, (ox, oy, oz) = {"x": x, "y": y, "z": z}, g.origin
    odd = [np.prod([sign[name] for name in names]) for names in PARITY[: g.sh.shape[1]]]
    return replace(
        g,
        means=g.means * np.array(signs, np.float32),
        quats=g.quats * np.array([1, y * z, x * z, x * y], np.float32),
        sh=g.sh * np.array(odd, np.float32)[:, None],
        origin=(x * ox, y * oy, z * oz),
    )


def moved(g: Gaussians, matrix: np.ndarray, where: object) -> Gaussians:
    """Gaussians under an affine map [4,4]: means, covariances, and the directions of colours.
    Uneven scales stretch the covariances, while colours only turn. Raises InputError, which begins
    with `where`, for shear and for singular maps."""
    A, origin = matrix[:3, :3], matrix[:3, :3] @ g.origin + matrix[:3, 3]
    if np.allclose(A, np.eye(3), rtol=0, atol=1e-9):
        return settled(g, g.means.astype(np.float64), origin)
    lengths = np.linalg.norm(A, axis=0)
    if not np.isfinite(matrix).all() or lengths.min() <= 1e-9 * lengths.max():
        raise InputError(f"{where}: the transform of a node is singular; apply it and export again")
    Q = A / lengths
    if np.abs(Q.T @ Q - np.eye(3)).max() > UNEVEN:
        cure = "apply it in the program that made the file and export again"
        raise InputError(f"{where}: the transform of a node has shear; {cure}")
    turn = Q * np.sign(np.linalg.det(Q))  # a covariance is the same under -A
    if np.ptp(lengths) <= UNEVEN * lengths.max():
        w, x, y, z = np.roll(Rotation.from_matrix(turn).as_quat(), 1)
        product = [[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]
        quats, log_scales = g.quats @ np.transpose(product), g.log_scales + np.log(lengths.mean())
    else:
        axes = A @ rotmat_from_quat(g.quats) * np.exp(g.log_scales.astype(np.float64))[:, None]
        U, S, _ = np.linalg.svd(axes)
        U[:, :, 2] *= np.linalg.det(U)[:, None]
        quats = np.roll(Rotation.from_matrix(U).as_quat(), 1, axis=1)
        with np.errstate(divide="ignore"):
            log_scales = np.log(S)
    d = even_directions()
    sh_turn = np.linalg.pinv(sh_basis(d, g.sh_degree)) @ sh_basis(d @ Q, g.sh_degree)
    sh = np.einsum("kl,nlc->nkc", sh_turn, g.sh)
    quats, log_scales, sh = (np.asarray(array, np.float32) for array in (quats, log_scales, sh))
    rotated = replace(g, quats=quats, log_scales=log_scales, sh=sh)
    return settled(rotated, g.means.astype(np.float64) @ A.T, origin)


def to_source(g: Gaussians, world: World) -> Gaussians:
    """Gaussians of an upright world in that of the files it was read from, except for its origin:
    the only way out for models."""
    return _turned(g, world, world.turn.T)


def from_source(g: Gaussians, world: World) -> Gaussians:
    """Gaussians in the world of a dataset's files as that dataset's upright world has them. Those
    without an origin of their own count from that of the dataset already."""
    return _turned(g.counted_from(world.origin), world, world.turn)


def _turned(g: Gaussians, world: World, turn: np.ndarray) -> Gaussians:
    matrix = np.eye(4)
    matrix[:3, :3] = turn
    return g if world.up == PLUS_Z else moved(g, matrix, "model")


def settled(g: Gaussians, means: np.ndarray, origin: np.ndarray) -> Gaussians:
    """Gaussians at means + origin (float64). Whole metres of far coordinates become `g.origin`."""
    finite = means[np.isfinite(means).all(axis=1)]
    middle = origin + (np.median(finite, axis=0) if len(finite) else 0)
    x, y, z = np.round(middle).tolist() if np.abs(middle).max() > FAR else (0.0, 0.0, 0.0)
    with np.errstate(over="ignore"):
        near = (means + (origin - (x, y, z))).astype(np.float32)
    return replace(g, means=near, origin=(x, y, z))
