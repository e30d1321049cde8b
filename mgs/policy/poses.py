"""Pose policies: scores of candidates from camera positions alone. Pure NumPy."""

import numpy as np
from numpy.typing import NDArray

from mgs.policy.criteria import Array

# Chosen: distance up to which poses are seeds, over that of the nearest (half as many pixels see
# the surface), and the most by which such seeds may spread less evenly than the best of all poses.
NEAR, LESS_EVEN = 2**0.5, 1.5


def azimuths(positions: Array, centre: Array) -> NDArray[np.float64]:
    """Azimuths of camera centres [C,3] about `centre` [3], radians in [0, 2 pi), 0 = +X."""
    offset = np.asarray(positions, np.float64) - centre
    return np.arctan2(offset[:, 1], offset[:, 0]) % (2 * np.pi)


def uniform_azimuth(candidates: Array, taken: Array, centre: Array) -> Array:
    """Azimuth gap to the next view taken on the left times that on the right, square radians.
    Splitting a gap a + b lowers the sum of squared gaps by 2ab, so this is greedy for the most even
    spread."""
    gaps = (azimuths(taken, centre)[None, :] - azimuths(candidates, centre)[:, None]) % (2 * np.pi)
    return _rounded(gaps.min(axis=1) * (2 * np.pi - gaps.max(axis=1)))


def farthest_pose(candidates: Array, taken: Array, centre: Array) -> Array:
    """Distance to the nearest camera already taken, metres (farthest-point sampling)."""
    distance = np.linalg.norm(candidates[:, None, :] - taken[None, :, :], axis=2)
    return _rounded(distance.min(axis=1))


def farthest_order(candidates: Array, taken: Array, centre: Array) -> list[int]:
    """Order in which `farthest_pose` takes all candidates [C,3] after the cameras taken [T,3]."""
    order, rest = list[int](), list(range(len(candidates)))
    while rest:
        so_far = np.concatenate([taken, candidates[order]])
        order.append(rest.pop(int(farthest_pose(candidates[rest], so_far, centre).argmax())))
    return order


def angles(ours: Array, theirs: Array, centre: Array) -> NDArray[np.float64]:
    """Angles [A,B] at `centre` between camera centres [A,3] and [B,3], radians."""
    offsets = ours - centre, theirs - centre
    a, b = (offset / np.linalg.norm(offset, axis=1, keepdims=True) for offset in offsets)
    return np.asarray(np.arccos(np.clip(a @ b.T, -1, 1)))


def _rounded(scores: Array) -> Array:
    """Round, so that distances which differ only by rounding errors are ties."""
    return np.round(scores, 9)


def nearest_poses(positions: Array, here: Array, count: int) -> list[int]:
    """Sorted indices of the `count` positions [C,3] nearest to `here` [3]."""
    distance = _rounded(np.linalg.norm(positions - here, axis=1))
    return sorted(int(k) for k in np.argsort(distance, kind="stable")[:count])


def travel_cost(positions: Array, here: Array, travel: float) -> NDArray[np.float64]:
    """Cost of an image at each position [C,3] for a camera that is at `here` [3], in images. It is
    1 + distance / travel, with the distance along a straight line. travel: metres that cost as much
    as an image."""
    return np.asarray(1 + _rounded(np.linalg.norm(positions - here, axis=1)) / travel)


def path_length(positions: Array) -> float:
    """Length of the polygon through the positions [T,3], metres."""
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())


def seed_views(positions: Array, centre: Array, count: int) -> list[int]:
    """`count` distinct frames to begin with: `medoids` of the near poses, if these are all around.

    Near are poses up to NEAR times as far as the nearest, because far ones say little about small
    Gaussians. Where they are fewer than `count`, or leave directions of the pool out, as close-ups
    of one side do, the medoids of all poses. Arguments as `medoids`."""
    everywhere = medoids(positions, centre, count)
    distance = _rounded(np.linalg.norm(positions - centre, axis=1))
    near = np.flatnonzero(distance <= NEAR * distance.min())
    if len(near) < count:
        return everywhere
    seeds = [int(near[k]) for k in medoids(positions[near], centre, count)]
    apart, least = (
        (angles(positions[some], positions, centre) ** 2).min(axis=0).sum()
        for some in (seeds, everywhere)
    )
    return seeds if apart <= LESS_EVEN * least else everywhere


def medoids(positions: Array, centre: Array, count: int) -> list[int]:
    """`count` distinct frames spread over the directions of a pool, in the order of their azimuths.

    k-medoids: from the frames nearest to even azimuths, one frame at a time is exchanged as long as
    that lowers the sum over the pool of the squared angle to the nearest. positions: camera centres
    [C,3]; centre: the rock [3]; metres. Needs count <= C."""
    azimuth, squared = azimuths(positions, centre), angles(positions, positions, centre) ** 2
    seeds = list[int]()
    for target in 2 * np.pi * np.arange(count) / count:
        distance = _rounded(np.abs((azimuth - target + np.pi) % (2 * np.pi) - np.pi))
        distance[seeds] = np.inf
        seeds.append(int(np.argmin(distance)))
    before = None
    while seeds != before:
        before = list(seeds)
        for k in range(count):
            others = seeds[:k] + seeds[k + 1 :]
            nearest = squared[others].min(axis=0, initial=np.inf)
            cost = _rounded(np.minimum(nearest, squared).sum(axis=1))
            cost[others] = np.inf
            if cost.min() < cost[seeds[k]]:
                seeds[k] = int(np.argmin(cost))
    order = np.round(azimuth, 9) % round(2 * np.pi, 9)  # an azimuth just below 2 pi is 0
    return sorted(seeds, key=lambda i: (order[i], i))
