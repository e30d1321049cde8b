"""Directional D- and I-optimality against their definitions, their updated gains against gains
computed anew, and plans of views."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import synthetic
import tiny
from hypothesis import given, settings
from hypothesis import strategies as st
from program import steps
from splat import reference

from mgs import Scene, choose, learn, load_prior
from mgs.colour import SH_C0, sh_basis
from mgs.policy import criteria, directional, relaxation, visibility
from mgs.policy.directional import Views
from mgs.policy.pool_gains import PoolGains
from mgs.policy.visibility import Visibility, planned_path, planned_views
from mgs.run import flight
from mgs.run import folder as run_folder
from mgs.run.policies import POLICIES

LAM = (0.02 / 1.0) ** 2


def gains(*given):
    """Gain of each candidate after the views taken [C], from scratch."""
    return relaxation.directional(*given).added(())


POSES = 7


def random_views(rng, count, points):
    """Poses around the origin, some of which see nothing of some points."""
    seen = rng.choice([0.0, 1.0], (count, points)) * 10 ** rng.uniform(-4, 2, (count, points))
    return Views(rng.normal(size=(count, 3)) * 3 + [0, 0, 4], seen.astype(np.float32))


def scene(seed, points=5, poses=POSES, dome=5):
    """Points of a rock, a pool of poses, a dome."""
    rng = np.random.default_rng(seed)
    surface = 0.5 * rng.normal(size=(points, 3))
    return surface, random_views(rng, poses, points), random_views(rng, dome, points)


seeds, degrees = st.integers(0, 10_000), st.integers(0, 3)
taus = st.sampled_from([0.03, 0.1, 0.3, 1.0])


def squares(points, views, degree):
    """[V,N,K,K] W y y^T, one view and one Gaussian at a time."""
    size = (degree + 1) ** 2
    made = np.zeros((*views.seen.shape, size, size))
    for v, j in np.ndindex(views.seen.shape):
        direction = points[j] - views.positions[v]
        y = sh_basis((direction / np.linalg.norm(direction))[None], degree)[0]
        made[v, j] = views.seen[v, j] * np.outer(y, y)
    return made


def posterior(points, views, degree, tau):
    """[N,K,K] the inverse of Lambda + sum W y y^T."""
    prior = np.diag(directional.precision(degree, tau, LAM))
    return np.linalg.inv(prior + squares(points, views, degree).sum(0))


@given(seeds, degrees, taus)
def test_a_rank_one_update_gives_what_full_inverses_give(seed, degree, tau):
    """D: 1.5 times the fall of log det S. I: fall of the variance summed over the dome."""
    points, pool, dome = scene(seed)
    taken, candidates = pool.of([0, 1, 2]), [3, 4, 5, 6]
    before = posterior(points, taken, degree, tau)
    predicted = directional.information(points, dome, degree)
    d = gains(points, LAM, degree, tau, taken, pool.of(candidates))
    i = gains(points, LAM, degree, tau, taken, pool.of(candidates), dome)
    for c, candidate in enumerate(candidates):
        after = posterior(points, pool.of([0, 1, 2, candidate]), degree, tau)
        expected = 1.5 * (np.linalg.slogdet(before)[1] - np.linalg.slogdet(after)[1]).sum()
        assert d[c] == pytest.approx(expected, rel=1e-6, abs=1e-8)
        fall, whole = (np.einsum("nkl,nlk->", predicted, S) for S in (before - after, before))
        assert i[c] == pytest.approx(fall, rel=1e-6, abs=1e-9 * whole)


def test_gaussians_in_parts_add_up(monkeypatch):
    points, pool, dome = scene(0)
    taken, candidates = pool.of([0, 1, 2]), pool.of([3, 4, 5, 6])
    whole = [gains(points, LAM, 2, 0.3, taken, candidates, views) for views in (None, dome)]
    monkeypatch.setattr(directional, "CHUNK", 3)
    parts = [gains(points, LAM, 2, 0.3, taken, candidates, views) for views in (None, dome)]
    np.testing.assert_allclose(parts, whole, rtol=1e-12)


def test_squared_weights_are_those_of_the_renderer():
    """Squared derivatives by a colour coefficient add up to SH_C0^2 sum w^2, unless clamped."""
    model, camera = tiny.initial([]), tiny.orbit(1)[0]
    weights = directional.squared_weights(reference.fisher(model, camera))
    shape = tiny.HEIGHT * tiny.WIDTH, 3, tiny.POINTS, 11
    derivatives = reference.jacobian(model, camera).reshape(shape)[:, 0, :, 0]
    assert weights.max() > 0.1
    np.testing.assert_allclose(weights, ((derivatives / SH_C0) ** 2).sum(0), rtol=1e-5)
    model.sh[:, 0, :2] = -10
    clamped = directional.squared_weights(reference.fisher(model, camera))
    np.testing.assert_allclose(clamped, weights, rtol=1e-5)


def test_the_dome_stands_around_the_rock():
    cameras, centre = tiny.orbit(), np.array([0.5, 0, 0])
    positions = np.array([camera.position for camera in cameras])
    dome = directional.dome_cameras(cameras[0], positions, centre)
    offset = np.array([camera.position for camera in dome]) - centre
    radius = np.linalg.norm(offset, axis=1)
    np.testing.assert_allclose(radius, np.median(np.linalg.norm(positions - centre, axis=1)))
    assert (offset[:, 2] >= 0).all()
    assert np.abs(offset[:, :2].mean(0)).max() < 0.1 * radius[0]
    for camera in dome:
        pixel, _ = camera.project(centre[None])
        np.testing.assert_allclose(pixel[0], [tiny.WIDTH / 2, tiny.HEIGHT / 2], atol=1e-9)


def updated(points, pool, dome):
    surface = Visibility([], None, lambda camera: camera, points, np.zeros(3), LAM)
    surface.pool, surface.dome = pool, dome
    return lambda taken, left, *model: surface.gains(taken, left, model)


def anew(points, pool, dome, taken, left, degree, tau, over_dome):
    around = dome if over_dome else None
    return gains(points, LAM, degree, tau, pool.of(taken), pool.of(left), around)


@settings(max_examples=40)
@given(seeds, degrees, taus, st.booleans(), st.permutations(range(POSES)))
def test_after_every_view_the_gains_are_those_computed_anew(seed, degree, tau, over_dome, order):
    points, pool, dome = scene(seed)
    pool.seen[order[1]] = 0
    found = updated(points, pool, dome)
    for count in (2, 3, POSES - 1):
        asked = order[:count], order[count:], degree, tau, over_dome
        expected = anew(points, pool, dome, *asked)
        assert found(*asked) == pytest.approx(expected, rel=1e-6, abs=1e-9 * expected.max())


@pytest.mark.parametrize("over_dome", [False, True])
def test_many_views_leave_no_error_behind(over_dome):
    """A hundred views of the same points, whose variance falls by five orders of magnitude."""
    rock = scene(0, 300, 110, 48)
    asked = list(range(100)), list(range(100, 110)), 3, 0.1, over_dome
    np.testing.assert_allclose(updated(*rock)(*asked), anew(*rock, *asked), rtol=1e-6)


def test_a_resumed_run_has_the_same_bits():
    points, pool, dome = scene(1, 50)
    one_by_one = updated(points, pool, dome)
    for count in range(1, 5):
        grown = one_by_one(list(range(count)), [5, 6], 3, 0.1, True)
    fresh = updated(points, pool, dome)([0, 1, 2, 3], [5, 6], 3, 0.1, True)
    assert np.array_equal(grown, fresh)
    one_by_one([2, 0], [5, 6], 3, 0.1, True)
    assert np.array_equal(one_by_one([0, 1, 2, 3], [5, 6], 3, 0.1, True), fresh)
    assert not np.array_equal(one_by_one([0, 1, 2, 4], [5, 6], 3, 0.1, True), fresh)


def test_degrees_and_criteria_are_kept_apart():
    rock = scene(2)
    found = updated(*rock)
    for how in [(3, 0.1, True), (2, 0.3, False), (2, 0.3, True), (2, 0.1, True), (3, 0.1, True)]:
        asked = [0], [3, 4], *how
        assert found(*asked) == pytest.approx(anew(*rock, *asked), rel=1e-6)


def test_where_there_are_many_pairs_few_large_gaussians_choose_as_well(tmp_path, monkeypatch):
    cameras = synthetic.orbit_cameras(24, 96, 72)
    data = synthetic.write_rock(tmp_path / "dataset", cameras, 3000)
    rock = Scene(data, load_prior(data.root / "prior"))
    model, views = (2, 0.2, True), list(range(4, 24))
    state = learn(rock, rock.seeds(4))
    fine = rock.plan_surface(state)
    assert fine is rock.surface(state)
    count = len(fine.points)
    monkeypatch.setattr(visibility, "MOST_PAIRS", 42 * count - 1)
    monkeypatch.setattr(visibility, "COARSE_PAIRS", 42 * count // 4)
    coarse = rock.plan_surface(state)
    assert len(coarse.points) == -(-count // 4)
    assert coarse.cameras[0].width == 48
    gains = [surface.gains(state.taken, views, model) for surface in (fine, coarse)]
    assert np.corrcoef(gains)[0, 1] > 0.95
    assert np.sum(gains[1]) == pytest.approx(np.sum(gains[0]), rel=0.3)
    gain_of = fine.relaxation(state.taken, views, model).gain
    best, found = (
        gain_of([views.index(v) for v in of.planned(tuple(state.taken), tuple(views), 6, model)])
        for of in (fine, coarse)
    )
    assert 0.98 * best < found <= best


@pytest.mark.parametrize("points", [0, 3])
def test_poses_that_see_nothing_gain_nothing(points):
    blind = Views(scene(0)[1].positions, np.zeros((POSES, points), np.float32))
    for over_dome in (False, True):
        found = updated(np.zeros((points, 3)), blind, blind)([0], [3, 4], 3, 0.1, over_dome)
        assert np.array_equal(found, [0, 0])


@settings(max_examples=20)
@given(seeds, degrees, st.booleans(), st.permutations(range(POSES)))
def test_gains_without_a_view_are_those_of_the_others(seed, degree, over_dome, order):
    points, pool, dome = scene(seed)
    around = dome if over_dome else None
    held = PoolGains(points, pool, LAM, degree, 0.3, around)
    held.take(order[:3])
    before, left = held.of_poses(order), held.without(order[1])
    for taken in ([order[0], order[2]], [order[0], order[2], order[3]]):
        expected = anew(points, pool, dome, taken, order[4:], degree, 0.3, over_dome)
        close = pytest.approx(expected, rel=1e-5, abs=1e-7 * expected.max())
        assert left.of_poses(order[4:]) == close
        left.take(order[3:4])
    assert np.array_equal(held.of_poses(order), before)
    assert held.taken == order[:3]


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
        return sum(anew(points, pool, None, *part, 1, 0.3, False)[0] for part in parts)

    return points, pool, gain


@pytest.mark.parametrize(("taken", "count"), [([0], 2), ([0, 1], 4), ([0, 3, 9], 5)])
def test_no_exchange_betters_a_plan_which_greedy_choice_misses(taken, count):
    """Around a disc, where two views after the first are best at thirds of the circle."""
    points, pool, gain_after = disc()
    free = [view for view in range(16) if view not in taken]

    def gain(views):
        return gain_after(taken, views)

    greedy = []
    for _ in range(count):
        left = [view for view in free if view not in greedy]
        greedy.append(max(left, key=lambda view: gain([*greedy, view])))
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
    assert 0.99 < gain(taken, planned_path(held, reach, 4)) / best < 1.0001
    assert held.taken == taken
    monkeypatch.setattr(visibility, "WIDTH", 1)
    assert gain(taken, planned_path(held, reach, 4)) / best < 0.98


def test_a_path_ends_where_nothing_is_in_reach():
    points, pool, _ = disc()
    held = PoolGains(points, pool, LAM, 1, 0.3)
    held.take([0])
    assert planned_path(held, lambda views: [1, 2][len(views) - 1 : 2], 4) == [1, 2]
    assert planned_path(held, lambda views: [], 4) == []


@pytest.mark.parametrize("policy", ["coverage", "directional-d", "directional-i"])
def test_views_are_chosen_without_looking_at_any_fit(loaded, tmp_path, policy):

    def black(*arguments):
        fit = tiny.fit(*arguments)
        fit.gaussians.sh[:] = -100
        return fit

    whole = tiny.run(tmp_path / "run", loaded, policy=policy)
    same = tiny.run(tmp_path / "black", loaded, parts={"fit": black}, policy=policy)
    assert same.taken == whole.taken
    for key in ("score", "coverage"):
        assert [step[key] for step in same.steps] == [step[key] for step in whole.steps]


@pytest.mark.parametrize("policy", ["directional-d", "directional-i"])
def test_scores_are_gains_after_the_views_taken(loaded, tmp_path, policy):
    state = tiny.run(tmp_path / "run", loaded, policy=policy, budget=3)
    start, cameras = tiny.initial([]), tiny.orbit()

    def views(cameras):
        seen = [directional.squared_weights(tiny.fisher(start, camera)) for camera in cameras]
        return Views(np.array([camera.position for camera in cameras]), np.stack(seen))

    seeds, first = state.taken[:3], state.taken[3]
    left = [i for i in range(tiny.FRAMES) if i not in seeds]
    dome = views(directional.dome_cameras(cameras[0], views(cameras).positions, np.zeros(3)))
    degree, tau, around = {"directional-d": (1, 0.3, None), "directional-i": (2, 0.2, dome)}[policy]
    pools = (views([cameras[i] for i in chosen]) for chosen in (seeds, left))
    lam = criteria.regularisation(tiny.GROUPS)[0]
    expected = gains(start.means, lam, degree, tau, *pools, around)
    assert state.steps[1]["score"] == pytest.approx(expected.max())
    assert expected[left.index(first)] == pytest.approx(expected.max())


@pytest.mark.parametrize("policy", ["coverage", "directional-d", "directional-i"])
def test_what_poses_see_is_measured_once(loaded, tmp_path, policy):
    looked = []

    def exact(gaussians, camera):
        looked.append(camera)
        return tiny.fisher(gaussians, camera)

    scene = tiny.scene(loaded, tiny.start(tmp_path / "run", loaded), exact=exact)
    state = learn(scene, scene.seeds(3))
    looked.clear()
    first = choose(scene, state, POLICIES[policy])
    assert looked
    looked.clear()
    assert choose(scene, state, POLICIES[policy]) == first
    assert not looked


def test_the_surface_is_measured_once_in_each_view_taken(loaded, tmp_path):
    looked = []

    def exact(gaussians, camera):
        looked.append(camera.key)
        return tiny.fisher(gaussians, camera)

    state = tiny.run(tmp_path / "run", loaded, parts={"exact": exact}, policy="uniform", batch=2)
    assert looked == [loaded.frames[i].camera.key for i in state.taken]


def flown(loaded, out, policy, **limits):
    """A run of four views: its scene, a function views -> state, its mission and chosen views."""
    taken = tiny.run(out, loaded, budget=4, policy=policy, **limits).taken
    settings = run_folder.open_run(out).settings
    scene = tiny.scene(loaded, settings)
    start = learn(scene, taken[:3])
    return scene, lambda views: replace(start, taken=(*taken[:3], *views)), settings, taken[3:]


@pytest.mark.parametrize("policy", ["directional-d", "directional-i"])
def test_a_run_takes_the_views_of_its_plan(loaded, tmp_path, policy):
    scene, after, mission, chosen = flown(loaded, tmp_path / "run", policy)

    def planned(views):
        state = after(views)
        candidates, left = flight.free(scene, state, mission), flight.views_left(state, mission)
        plan = POLICIES[policy].plan(scene, state, candidates, left, None)
        return sorted(i for i in plan if i in candidates)

    assert planned([]) == sorted(chosen)
    assert planned(chosen[:1]) == sorted(chosen[1:])
    other = next(i for i in flight.free(scene, after([]), mission) if i not in chosen)
    assert len(planned([other])) == 3


@pytest.mark.parametrize("policy", ["directional-d", "directional-i", "coverage", "a flight"])
def test_a_run_records_what_its_plan_is_worth(loaded, tmp_path, policy):
    """Scores of the steps add up to the gain of the plan, which has at least the share of the best
    set of as many views that is recorded, whatever the way between them."""
    limits = {"flight": {"length": 30.0}} if policy == "a flight" else {}
    policy = "directional-d" if limits else policy
    scene, after, mission, chosen = flown(loaded, tmp_path / "run", policy, **limits)
    first, *others = steps(tmp_path / "run")
    state, recorded = after([]), first["certificate"]
    views = flight.free(scene, state, mission)
    made = POLICIES[policy].relaxation(scene, state, views)
    gain = made.gain([views.index(i) for i in chosen])
    assert gain == pytest.approx(sum(line["score"] for line in others), rel=1e-5)
    largest = max(made.gain(some) for some in combinations(range(len(views)), len(chosen)))
    assert recorded["share"] <= gain / largest * (1 + 1e-9)
    assert recorded["of_all"] == pytest.approx(gain / made.gain(range(len(views))))
    assert list(recorded["prices"]) == [scene.frames[i].name for i in views]
    assert recorded["views"] == len(chosen) > 0
    assert limits or (len(chosen), recorded["candidates"]) == (4, len(views))


@pytest.mark.parametrize("policy", ["directional-d", "directional-i"])
def test_a_run_with_limited_reach_follows_its_path(loaded, tmp_path, policy):
    scene, after, mission, chosen = flown(loaded, tmp_path / "run", policy, nearest=2)
    for step in range(4):
        state = after(chosen[:step])
        assert chosen[step] in flight.reachable(scene, state, mission)
        assert choose(scene, state, POLICIES[policy], mission)[0] == chosen[step]
    other = next(i for i in flight.reachable(scene, after([]), mission) if i != chosen[0])
    new, _ = choose(scene, after([other]), POLICIES[policy], mission)
    assert new in flight.reachable(scene, after([other]), mission)


def test_a_travel_cost_is_weighed_against_the_gain_of_every_pose(loaded, tmp_path):
    """No plan is made, since the cost depends on the last view."""
    scene, after, mission, _ = flown(loaded, tmp_path / "run", "directional-d")
    state, policy = after([]), POLICIES["directional-d"]
    near = mission.model_copy(update={"travel": 1e-3})
    views = flight.free(scene, state, mission)
    here, positions = scene.positions(state.frames)[state.taken[-1]], scene.positions(state.frames)
    cost = 1 + np.linalg.norm(positions[views] - here, axis=1) / 1e-3
    worth = policy(scene, state, views) / cost
    assert choose(scene, state, policy, near)[0] == views[int(worth.argmax())]


def test_the_precision_of_a_prior_is_that_of_its_degrees():
    assert directional.precision(1, 0.5, 3.0).tolist() == [3, 12, 12, 12]
