"""Directional optimality: what a view says about how the surface looks from every direction. Pure
NumPy, float64.

The fit gives each Gaussian one colour. Real colours depend on the direction: relief smaller than a
Gaussian shades and hides parts of it, and a view from 30 degrees says little about the look from
90. So these criteria give each Gaussian j of the prior's surface a colour that is richer than the
fit's, and ask how well the views determine it: the colour seen along the direction d is sum_k c_k
y_k(d), with real spherical harmonics y of degree L, so K = (L + 1)^2 coefficients for each channel.
Before any image the coefficients are independent, with standard deviation tau_0 for degree 0 and
tau tau_0 for the others.

A view v in which j has the squared blending weights W_vj, summed over its pixels, adds W_vj y y^T
to the information, y being y(d_vj), so that the posterior covariance of one channel's coefficients
is sigma_e^2 S_j with

    S_j = (Lambda + sum over the views taken of W_vj y_vj y_vj^T)^-1,   Lambda = diag(sigma_e^2 /
    tau_l^2).

A candidate c changes S_j by a matrix of rank one, which gives its gains in closed form (matrix
determinant lemma and Sherman-Morrison formula):

- D: what it says about the coefficients, 3/2 sum_j log(1 + W_cj y_cj^T S_j y_cj) nats, three
channels being equal;
- I: by how much the variance of the colours falls that are predicted for a dome of poses around the
object. With
  M_j = sum over the dome of W_vj y_vj y_vj^T that is sum_j W_cj (S_j y_cj)^T M_j (S_j y_cj) / (1 +
  W_cj y_cj^T S_j y_cj), for one channel and in units of sigma_e^2.

Poses and the prior's surface are all that is needed: no images and no fit. Everything here is
computed anew at every call. Runs use `mgs.policy.pool_gains`, which is tested against it and much
faster.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from mgs.camera import Camera, look_at
from mgs.colour import SH_C0
from mgs.policy.criteria import Array
from mgs.synth.orbit import orbit_positions
from mgs.synth.scene_file import Orbit

Result = TypeVar("Result")

DOME = 48
"""Number of poses of the dome, over which I-optimality averages. A chosen constant."""

DOME_ELEVATIONS = (0.0, 85.0)
"""Lowest and highest elevation of the dome, degrees: all of the sky, so no knowledge of where a
model will be judged from."""

CHUNK = 1024
"""How many Gaussians a thread works on at once, which bounds the memory: with 100 candidates and
degree 3, an array of all their coefficients takes 13 MB."""


class Views(NamedTuple):
    """Poses, and what they see of the surface.

    positions: [V,3] camera centres, metres. seen: [V,N], for each view and Gaussian the squared
    blending weights, summed over the view's pixels (`squared_weights`).
    """

    positions: Array
    seen: Array


def squared_weights(F: Array) -> NDArray[np.float32]:
    """[N] sum over the pixels of a view of each Gaussian's squared blending weights.

    F: [N,P] exact Fisher information of the view about Gaussians whose colours do not depend on the
    direction. Its entry for a colour coefficient of degree 0 is this sum times SH_C0^2, or 0 for a
    channel that is clamped at 0; so the largest of the three channels is taken.
    """
    return np.asarray(F[:, :3].max(axis=1) / SH_C0**2, np.float32)


def dome_cameras(like: Camera, positions: Array, centre: Array) -> list[Camera]:
    """Cameras spread evenly over a dome around the object, which look at it.

    Their intrinsics are those of `like`, their distance from `centre` [3] is the median one of
    `positions` [V,3]; metres.
    """
    radius = float(np.median(np.linalg.norm(np.asarray(positions) - centre, axis=1)))
    settings = Orbit(kind="hemisphere", radius=radius, elevations=DOME_ELEVATIONS)
    return [
        Camera(like.K, like.width, like.height, look_at(eye, centre))
        for eye in orbit_positions(settings, DOME, centre)
    ]


def basis(points: Array, views: Views, degree: int) -> NDArray[np.float64]:
    """[N,V,K] spherical harmonics of the directions from the cameras to points [N,3], metres; 0
    where the view does not see the point, which is most of them and would cost most of the time."""
    from mgs.splat.reference import sh_basis  # imported here because mgs.splat loads Dr.Jit

    point, view = np.nonzero(views.seen.T)
    offset = np.asarray(points, np.float64)[point] - np.asarray(views.positions, np.float64)[view]
    y = np.zeros((len(points), len(views.positions), (degree + 1) ** 2))
    y[point, view] = sh_basis(offset / np.linalg.norm(offset, axis=1, keepdims=True), degree)
    return y


def precision(degree: int, tau: float, lam: float) -> NDArray[np.float64]:
    """[K] Lambda, the prior's information about each coefficient: lam = (sigma_e / tau_0)^2 for
    degree 0, lam / tau^2 above."""
    return np.repeat(
        [lam, *[lam / tau**2] * degree], [2 * order + 1 for order in range(degree + 1)]
    )


def information(points: Array, views: Views, degree: int) -> NDArray[np.float64]:
    """[N,K,K] sum over the views of W y y^T. points: [N,3] metres."""
    y = basis(points, views, degree) * np.sqrt(views.seen.T.astype(np.float64))[..., None]
    return np.asarray(y.transpose(0, 2, 1) @ y)


def gains(
    points: Array,
    lam: float,
    degree: int,
    tau: float,
    taken: Views,
    candidates: Views,
    dome: Views | None = None,
) -> NDArray[np.float64]:
    """[C] what each candidate adds to the views taken: the D gain, or with a dome the I gain (see
    the module).

    points: [N,3] means of the Gaussians on the surface, metres. lam, degree, tau: the prior
    (`precision`).
    """
    prior = np.diag(precision(degree, tau, lam))

    def part(some: slice) -> NDArray[np.float64]:
        views = [
            None if views is None else Views(views.positions, views.seen[:, some])
            for views in (taken, candidates, dome)
        ]
        return _gains(points[some], prior, degree, *views)  # type: ignore[arg-type]

    return np.asarray(sum(in_parts(len(points), part), np.zeros(len(candidates.positions))))


def in_parts(count: int, part: Callable[[slice], Result]) -> list[Result]:
    """Results for CHUNK of so many Gaussians at a time, in their order. NumPy lets other threads
    run while it computes."""
    chunks = [slice(first, first + CHUNK) for first in range(0, count, CHUNK)]
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        return list(pool.map(part, chunks))


def _gains(
    points: Array, prior: Array, degree: int, taken: Views, candidates: Views, dome: Views | None
) -> NDArray[np.float64]:
    """`gains` of some of the Gaussians. prior: [K,K]."""
    S = np.linalg.inv(prior + information(points, taken, degree))
    y, W = basis(points, candidates, degree), candidates.seen.T.astype(np.float64)
    moved = y @ S
    explained = W * (moved * y).sum(2)
    if dome is None:
        return np.asarray(1.5 * np.log1p(explained).sum(0))
    M = information(points, dome, degree)
    return np.asarray((W * ((moved @ M) * moved).sum(2) / (1 + explained)).sum(0))
