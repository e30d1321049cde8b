"""Gains that are brought up to date against those computed anew, the float64 reference of
`mgs.policy.directional`."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mgs.policy import pool_gains as module
from mgs.policy.directional import Views, gains
from mgs.policy.pool_gains import pool_gains

LAM = (0.02 / 1.0) ** 2
POSES = 7


def views_of(rng, count, points):
    """Poses around the origin, some of which see nothing of some points."""
    seen = rng.choice([0.0, 1.0], (count, points)) * 10 ** rng.uniform(-4, 2, (count, points))
    return Views(rng.normal(size=(count, 3)) * 3 + [0, 0, 4], seen.astype(np.float32))


def scene(seed, points=5):
    """Points of a rock, a pool of poses, a dome."""
    rng = np.random.default_rng(seed)
    return (
        0.5 * rng.normal(size=(points, 3)),
        views_of(rng, POSES, points),
        views_of(rng, 5, points),
    )


def some(views, which):
    return Views(views.positions[which], views.seen[which])


def function(points, pool, dome):
    return pool_gains(points, LAM, lambda: pool, lambda: dome)


@settings(max_examples=40)
@given(
    st.integers(0, 10_000),
    st.integers(0, 3),
    st.sampled_from([0.03, 0.1, 0.3]),
    st.booleans(),
    st.permutations(range(POSES)),
)
def test_after_every_view_the_gains_are_those_computed_anew(seed, degree, tau, over_dome, order):
    points, pool, dome = scene(seed)
    pool.seen[order[1]] = 0  # a view that teaches nothing
    found = function(points, pool, dome)
    for count in (2, 3, POSES - 1):
        taken, left = order[:count], order[count:]
        expected = gains(
            points,
            LAM,
            degree,
            tau,
            some(pool, taken),
            some(pool, left),
            dome if over_dome else None,
        )
        assert found(taken, left, degree, tau, over_dome) == pytest.approx(
            expected, rel=1e-6, abs=1e-9 * expected.max()
        )


@pytest.mark.parametrize("over_dome", [False, True])
def test_many_views_leave_no_error_behind(over_dome):
    """A hundred views of the same points, whose variance falls by five orders of magnitude."""
    rng = np.random.default_rng(0)
    points, pool, dome = (
        0.5 * rng.normal(size=(300, 3)),
        views_of(rng, 110, 300),
        views_of(rng, 48, 300),
    )
    taken, left = list(range(100)), list(range(100, 110))
    found = function(points, pool, dome)(taken, left, 3, 0.1, over_dome)
    expected = gains(
        points, LAM, 3, 0.1, some(pool, taken), some(pool, left), dome if over_dome else None
    )
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_a_resumed_run_has_the_same_bits():
    """Views one by one or all at once; and a function that was asked about other views in
    between."""
    points, pool, dome = scene(1, 50)
    one_by_one = function(points, pool, dome)
    for count in range(1, 5):
        grown = one_by_one(list(range(count)), [5, 6], 3, 0.1, True)
    fresh = function(points, pool, dome)([0, 1, 2, 3], [5, 6], 3, 0.1, True)
    assert np.array_equal(grown, fresh)
    one_by_one([2, 0], [5, 6], 3, 0.1, True)
    assert np.array_equal(one_by_one([0, 1, 2, 3], [5, 6], 3, 0.1, True), fresh)
    assert not np.array_equal(one_by_one([0, 1, 2, 4], [5, 6], 3, 0.1, True), fresh)


def test_degrees_and_criteria_are_kept_apart():
    points, pool, dome = scene(2)
    found = function(points, pool, dome)
    for degree, tau, over_dome in [
        (3, 0.1, True),
        (2, 0.3, False),
        (2, 0.3, True),
        (2, 0.1, True),
        (3, 0.1, True),
    ]:
        expected = gains(
            points,
            LAM,
            degree,
            tau,
            some(pool, [0]),
            some(pool, [3, 4]),
            dome if over_dome else None,
        )
        assert found([0], [3, 4], degree, tau, over_dome) == pytest.approx(expected, rel=1e-6)


def test_what_does_not_fit_into_memory_is_computed_anew(monkeypatch):
    points, pool, dome = scene(3)
    monkeypatch.setattr(module, "IMAGE_BYTES", 1000)
    monkeypatch.setattr(module, "PoolGains", None)
    expected = gains(points, LAM, 3, 0.1, some(pool, [0, 1]), some(pool, [3, 4]), dome)
    assert np.array_equal(function(points, pool, dome)([0, 1], [3, 4], 3, 0.1, True), expected)


@pytest.mark.parametrize("points", [0, 3])
def test_poses_that_see_nothing_gain_nothing(points):
    blind = Views(scene(0)[1].positions, np.zeros((POSES, points), np.float32))
    for over_dome in (False, True):
        found = function(np.zeros((points, 3)), blind, blind)([0], [3, 4], 3, 0.1, over_dome)
        assert np.array_equal(found, [0, 0])


def test_the_memory_that_is_reckoned_with_is_what_is_held():
    """Bytes of all arrays of a pool, over those that BYTES_OF_ENTRY and BYTES_OF_PAIR say; points
    and poses are few."""
    rng = np.random.default_rng(0)
    points, pool, dome = rng.normal(size=(3000, 3)), views_of(rng, 60, 3000), views_of(rng, 4, 3000)
    held = module.PoolGains(points, pool, LAM, 3, 0.1, dome)
    arrays = [
        np.asarray(held.S),
        np.asarray(held.M),
        np.asarray(held.g),
        np.asarray(held.q),
        np.asarray(held.weights),
    ]
    arrays += [np.asarray(held.of), np.asarray(held.by), held.poses]
    expected = module.BYTES_OF_ENTRY * 3000 * (
        16 * 17 // 2
    ) + module.BYTES_OF_PAIR * np.count_nonzero(pool.seen)
    assert sum(array.nbytes for array in arrays) == pytest.approx(expected, rel=0.01)
