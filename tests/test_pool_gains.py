"""Updated gains against the reference, `mgs.policy.directional.gains`."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mgs.policy import pool_gains as module
from mgs.policy.directional import Views, gains
from mgs.policy.pool_gains import PoolGains, planned_path, planned_views, pool_gains

LAM = (0.02 / 1.0) ** 2
POSES = 7


def views_of(rng, count, points):
    """Poses around the origin, some of which see nothing of some points."""
    seen = rng.choice([0.0, 1.0], (count, points)) * 10 ** rng.uniform(-4, 2, (count, points))
    return Views(rng.normal(size=(count, 3)) * 3 + [0, 0, 4], seen.astype(np.float32))


def scene(seed, points=5, poses=POSES, dome=5):
    """Points of a rock, a pool of poses, a dome."""
    rng = np.random.default_rng(seed)
    surface = 0.5 * rng.normal(size=(points, 3))
    return surface, views_of(rng, poses, points), views_of(rng, dome, points)


def function(points, pool, dome):
    return pool_gains(points, LAM, lambda: pool, lambda: dome)


def reference(points, pool, dome, taken, left, degree, tau, over_dome):
    before, after = (Views(pool.positions[some], pool.seen[some]) for some in (taken, left))
    return gains(points, LAM, degree, tau, before, after, dome if over_dome else None)


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
    pool.seen[order[1]] = 0
    found = function(points, pool, dome)
    for count in (2, 3, POSES - 1):
        asked = order[:count], order[count:], degree, tau, over_dome
        expected = reference(points, pool, dome, *asked)
        assert found(*asked) == pytest.approx(expected, rel=1e-6, abs=1e-9 * expected.max())


@pytest.mark.parametrize("over_dome", [False, True])
def test_many_views_leave_no_error_behind(over_dome):
    """A hundred views of the same points, whose variance falls by five orders of magnitude."""
    rock = scene(0, 300, 110, 48)
    asked = list(range(100)), list(range(100, 110)), 3, 0.1, over_dome
    np.testing.assert_allclose(function(*rock)(*asked), reference(*rock, *asked), rtol=1e-6)


def test_a_resumed_run_has_the_same_bits():
    """Views one by one, all at once, or after other views."""
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
    rock = scene(2)
    found = function(*rock)
    for how in [(3, 0.1, True), (2, 0.3, False), (2, 0.3, True), (2, 0.1, True), (3, 0.1, True)]:
        asked = [0], [3, 4], *how
        assert found(*asked) == pytest.approx(reference(*rock, *asked), rel=1e-6)


def test_what_does_not_fit_into_memory_is_computed_from_scratch(monkeypatch):
    rock, asked = scene(3), ([0, 1], [3, 4], 3, 0.1, True)
    monkeypatch.setattr(module, "IMAGE_BYTES", 1000)
    monkeypatch.setattr(module, "PoolGains", None)
    assert np.array_equal(function(*rock)(*asked), reference(*rock, *asked))


@pytest.mark.parametrize("points", [0, 3])
def test_poses_that_see_nothing_gain_nothing(points):
    blind = Views(scene(0)[1].positions, np.zeros((POSES, points), np.float32))
    for over_dome in (False, True):
        found = function(np.zeros((points, 3)), blind, blind)([0], [3, 4], 3, 0.1, over_dome)
        assert np.array_equal(found, [0, 0])


def test_memory_is_what_the_constants_say():
    points, pool, dome = scene(0, 3000, 60, 4)
    held = module.PoolGains(points, pool, LAM, 3, 0.1, dome)
    arrays = [held.S, held.M, held.g, held.q, held.weights, held.of, held.by, held.poses]
    pairs, entries = np.count_nonzero(pool.seen), 16 * 17 // 2
    expected = module.BYTES_OF_ENTRY * 3000 * entries + module.BYTES_OF_PAIR * pairs
    assert sum(np.asarray(a).nbytes for a in arrays) == pytest.approx(expected, rel=0.01)


@settings(max_examples=20)
@given(st.integers(0, 10_000), st.integers(0, 2), st.booleans(), st.permutations(range(POSES)))
def test_gains_after_a_view_is_dropped_are_those_without_it(seed, degree, over_dome, order):
    points, pool, dome = scene(seed)
    around = dome if over_dome else None
    held = PoolGains(points, pool, LAM, degree, 0.3, around)
    held.take(order[:3])
    held.drop(order[1])
    asked = [order[0], order[2]], order[3:], degree, 0.3, over_dome
    expected = reference(points, pool, dome, *asked)
    assert held.of_poses(order[3:]) == pytest.approx(expected, rel=1e-5, abs=1e-7 * expected.max())


def circle(count, radius):
    angles = 2 * np.pi * np.arange(count) / count
    return radius * np.stack([np.cos(angles), np.sin(angles), 0 * angles], 1)


def disc():
    """24 points, 16 poses, and a function taken, views -> gain of these views, one by one."""
    points, positions = circle(24, 1), circle(16, 4)
    towards = positions[:, None] - points
    cosine = (towards * points).sum(2) / np.linalg.norm(towards, axis=2)
    pool = Views(positions, np.maximum(cosine, 0).astype(np.float32) ** 2)

    def gain(taken, views):
        parts = (([*taken, *views[:k]], [view]) for k, view in enumerate(views))
        return sum(reference(points, pool, None, *part, 1, 0.3, False)[0] for part in parts)

    return points, pool, gain


@pytest.mark.parametrize(("taken", "count"), [([0], 2), ([0, 1], 4), ([0, 3, 9], 5)])
def test_no_exchange_betters_a_plan_which_greedy_choice_misses(taken, count):
    """Around a disc, where two views after the first are best at thirds of the circle."""
    points, pool, gain_after = disc()
    free = [view for view in range(16) if view not in taken]

    def gains_of(before, views):
        return reference(points, pool, None, taken + before, views, 1, 0.3, False)

    def gain(views):
        return gain_after(taken, views)

    greedy = []
    for _ in range(count):
        left = [view for view in free if view not in greedy]
        greedy.append(left[int(gains_of(greedy, left).argmax())])
    held = PoolGains(points, pool, LAM, 1, 0.3)
    held.take(taken)
    plan = planned_views(held, free, count)
    assert gain(plan) > 1.0001 * gain(greedy)
    for k in range(count):
        for other in set(free) - set(plan):
            assert gain([*plan[:k], other, *plan[k + 1 :]]) < 1.0001 * gain(plan)
    if taken == [0]:
        assert sorted(plan) == [5, 11]


@pytest.mark.parametrize("taken", [[0, 8], [2, 13, 8]])
def test_a_path_gains_as_much_as_any_within_reach(monkeypatch, taken):
    """Around a disc in steps of at most two poses, where the way that begins best is not."""
    points, pool, gain = disc()
    held = PoolGains(points, pool, LAM, 1, 0.3)
    held.take(taken)

    def reach(views):
        near = [(views[-1] + step) % 16 for step in (-2, -1, 1, 2)]
        return [view for view in near if view not in views]

    paths = [[]]
    for _ in range(4):
        paths = [[*path, view] for path in paths for view in reach([*taken, *path])]
    assert planned_path(held, reach, 4) in paths
    best = max(gain(taken, path) for path in paths)
    for width, least, most in ((1, 0, 0.98), (module.WIDTH, 0.99, 1.0001), (99, 0.9999, 1.0001)):
        monkeypatch.setattr(module, "WIDTH", width)
        assert least < gain(taken, planned_path(held, reach, 4)) / best < most
    assert held.taken == taken


def test_a_path_ends_where_nothing_is_in_reach():
    points, pool, _ = disc()
    held = PoolGains(points, pool, LAM, 1, 0.3)
    held.take([0])
    assert planned_path(held, lambda views: [1, 2][len(views) - 1 : 2], 4) == [1, 2]
    assert planned_path(held, lambda views: [], 4) == []
