"""Directional optimality (docs/nbv.md): what views see, and sums over them. Gains are computed by
`mgs.policy.relaxation.directional`, and by its fast twin, `mgs.policy.pool_gains`.

The prior's Gaussian j has the colour sum_k c_k y_k(d) along d, with K = (L + 1)^2 spherical
harmonics y. W_vj: its squared blending weights in view v, y_vj: y of the direction from v to j.

    S_j = (Lambda + sum over the views taken of W_vj y_vj y_vj^T)^-1
    D:  3/2 sum_j log(1 + W_cj y_cj^T S_j y_cj)  nats, three channels being equal
    I:  sum_j W_cj (S_j y_cj)^T M_j (S_j y_cj) / (1 + W_cj y_cj^T S_j y_cj)  in sigma_e^2

with M_j = sum over the dome of W_vj y_vj y_vj^T, by the Sherman-Morrison formula."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from mgs.camera import Camera, look_at
from mgs.colour import SH_C0, sh_basis
from mgs.policy.criteria import Array
from mgs.synth.orbit import orbit_positions
from mgs.synth.scene_file import Orbit

Result = TypeVar("Result")

DOME = 48  # number of poses of the dome for I-optimality; chosen
DOME_ELEVATIONS = (0.0, 85.0)  # lowest and highest elevation of the dome, degrees
CHUNK = 1024  # Gaussians per task of a thread, which bounds the memory


class Views(NamedTuple):
    """Poses, and what they see of the surface.

    positions: camera centres [V,3], metres.
    seen: squared blending weights of each Gaussian in each view [V,N] (`squared_weights`)."""

    positions: Array
    seen: Array

    def of(self, views: Sequence[int]) -> "Views":
        return Views(self.positions[list(views)], self.seen[list(views)])


def squared_weights(F: Array) -> NDArray[np.float32]:
    """Squared blending weights of each Gaussian, summed over the pixels of a view [N].

    F: exact Fisher information of the view [N,P], for colours of SH degree 0. Its entry for a
    colour coefficient is this sum times SH_C0^2, or 0 for a channel that is clamped at 0, so the
    largest of the three channels is used."""
    return np.asarray(F[:, :3].max(axis=1) / SH_C0**2, np.float32)


def dome_cameras(like: Camera, positions: Array, centre: Array) -> list[Camera]:
    """DOME cameras spread evenly over a dome, looking at `centre` [3]. They have the intrinsics of
    `like` and the median distance of `positions` [V,3] from the centre, metres."""
    radius = float(np.median(np.linalg.norm(np.asarray(positions) - centre, axis=1)))
    settings = Orbit(kind="hemisphere", radius=radius, elevations=DOME_ELEVATIONS)
    poses = [look_at(eye, centre) for eye in orbit_positions(settings, DOME, centre)]
    return [Camera(like.K, like.width, like.height, pose) for pose in poses]


def vectors(points: Array, views: Views, degree: int) -> NDArray[np.float64]:
    """sqrt(W) y of each view and point [N,V,K]. points: [N,3], metres.

    Only pairs that see each other are computed: most do not."""
    point, view = np.nonzero(views.seen.T)
    offset = np.asarray(points, np.float64)[point] - np.asarray(views.positions, np.float64)[view]
    z = np.zeros((len(points), len(views.positions), (degree + 1) ** 2))
    z[point, view] = sh_basis(offset / np.linalg.norm(offset, axis=1, keepdims=True), degree)
    return z * np.sqrt(views.seen.T.astype(np.float64))[..., None]


def precision(degree: int, tau: float, lam: float) -> NDArray[np.float64]:
    """Diagonal of Lambda [K]: lam for degree 0, lam / tau^2 for higher degrees."""
    orders = [2 * order + 1 for order in range(degree + 1)]
    return np.repeat([lam, *[lam / tau**2] * degree], orders)


def information(points: Array, views: Views, degree: int) -> NDArray[np.float64]:
    """Sum over the views of W y y^T [N,K,K]. points: [N,3], metres."""

    def part(some: slice) -> NDArray[np.float64]:
        z = vectors(points[some], of_points(views, some), degree)
        return np.asarray(z.transpose(0, 2, 1) @ z)

    return np.concatenate(in_parts(len(points), part))


def of_points(views: Views, some: slice) -> Views:
    return Views(views.positions, views.seen[:, some])


def in_parts(count: int, part: Callable[[slice], Result]) -> list[Result]:
    """Results of `part` for slices of CHUNK out of `count`, in order, from threads.

    `part` must not call this function: it would wait for its own thread."""
    chunks = [slice(first, first + CHUNK) for first in range(0, count, CHUNK)]
    if len(chunks) < 2:
        return [part(some) for some in chunks]
    return list(_threads(os.getpid()).map(part, chunks))


@lru_cache(maxsize=1)
def _threads(process: int) -> ThreadPoolExecutor:
    """Threads of a process, which a fork of it does not have."""
    return ThreadPoolExecutor(len(os.sched_getaffinity(0)))
