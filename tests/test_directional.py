"""Directional D- and I-optimality against their definitions, and laws of a gain."""

import numpy as np
import pytest
import tiny
from hypothesis import given
from hypothesis import strategies as st

from mgs.colour import SH_C0
from mgs.data.dataset import load_dataset
from mgs.policy import criteria, directional
from mgs.policy.directional import Views, gains
from mgs.run import folder as run_folder
from mgs.run import loop
from mgs.run.problem import Problem
from mgs.splat import reference

N, LAM = 4, (0.02 / 1.0) ** 2


def random_views(rng, count):
    """Poses around the origin, some of which see nothing of some Gaussians."""
    seen = rng.choice([0.0, 1.0], (count, N)) * 10 ** rng.uniform(-4, 2, (count, N))
    return Views(rng.normal(size=(count, 3)) * 3 + [0, 0, 4], seen)


def scene(seed, taken=3, candidates=4, dome=5):
    """Points of a rock, views taken, candidates, a dome."""
    rng = np.random.default_rng(seed)
    points = 0.5 * rng.normal(size=(N, 3))
    return points, *(random_views(rng, count) for count in (taken, candidates, dome))


def together(a, b):
    return Views(np.concatenate([a.positions, b.positions]), np.concatenate([a.seen, b.seen]))


seeds, degrees = st.integers(0, 10_000), st.integers(0, 3)
taus = st.sampled_from([0.03, 0.1, 0.3, 1.0])


def posterior(points, views, degree, tau):
    """[N,K,K] the inverse of Lambda + sum W y y^T, one view and one Gaussian at a time."""
    found = []
    for j, point in enumerate(points):
        total = np.diag(directional.precision(degree, tau, LAM))
        for position, seen in zip(views.positions, views.seen, strict=True):
            direction = (point - position) / np.linalg.norm(point - position)
            y = reference.sh_basis(direction[None], degree)[0]
            total = total + seen[j] * np.outer(y, y)
        found.append(np.linalg.inv(total))
    return np.array(found)


@given(seeds, degrees, taus)
def test_a_rank_one_update_gives_what_full_inverses_give(seed, degree, tau):
    """D: decrease of log det S, times three channels, halved. I: decrease of the variance summed
    over the dome."""
    points, taken, candidates, dome = scene(seed)
    before = posterior(points, taken, degree, tau)
    predicted = directional.information(points, dome, degree)
    d = gains(points, LAM, degree, tau, taken, candidates)
    i = gains(points, LAM, degree, tau, taken, candidates, dome)
    for c in range(len(candidates.positions)):
        one = Views(candidates.positions[[c]], candidates.seen[[c]])
        after = posterior(points, together(taken, one), degree, tau)
        expected = 1.5 * (np.linalg.slogdet(before)[1] - np.linalg.slogdet(after)[1]).sum()
        assert d[c] == pytest.approx(expected, rel=1e-6, abs=1e-8)
        fall, whole = (np.einsum("nkl,nlk->", predicted, S) for S in (before - after, before))
        assert i[c] == pytest.approx(fall, rel=1e-6, abs=1e-9 * whole)


@given(seeds, taus)
def test_degree_zero_is_the_colour_part_of_d_optimality(seed, tau):
    """In nats: half of Eq. 7, summed over the three channels."""
    points, taken, candidates, _ = scene(seed)

    def colour(seen):
        return np.repeat(SH_C0**2 * seen[:, None], 3, axis=1)

    H = colour(taken.seen.sum(0))
    eq7 = [criteria.d_optimal(colour(seen), H, np.full(3, LAM)) for seen in candidates.seen]
    expected = 0.5 * H.size * np.array(eq7)
    assert gains(points, LAM, 0, tau, taken, candidates) == pytest.approx(expected, rel=1e-9)


def test_gaussians_in_parts_add_up(monkeypatch):
    points, taken, candidates, dome = scene(0)
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


@pytest.mark.parametrize("policy", ["directional-d", "directional-i"])
def test_a_flight_is_planned_without_looking_at_any_fit(dataset, tmp_path, policy):
    """A run whose model is black after every fit takes the same views."""

    def forgetful(*arguments):
        fit = tiny.fit(*arguments)
        fit.gaussians.sh[:] = -100
        return fit

    loaded, states = load_dataset(dataset), []
    for name, fit in (("run", tiny.fit), ("forgetful", forgetful)):
        parts = tiny.operations(fit=fit)
        states.append(tiny.run(tmp_path / name, loaded, parts, policy=policy, budget=3))
    scores = [[step["score"] for step in state.steps] for state in states]
    assert (states[0].taken, scores[0]) == (states[1].taken, scores[1])
    start, cameras = tiny.initial([]), tiny.orbit()

    def views(cameras):
        seen = [directional.squared_weights(tiny.fisher(start, camera)) for camera in cameras]
        return Views(np.array([camera.position for camera in cameras]), np.stack(seen))

    seeds, first = states[0].taken[:3], states[0].taken[3]
    left = [i for i in range(tiny.FRAMES) if i not in seeds]
    dome = views(directional.dome_cameras(cameras[0], views(cameras).positions, np.zeros(3)))
    degree, tau, around = {"directional-d": (1, 0.3, None), "directional-i": (2, 0.2, dome)}[policy]
    pools = (views([cameras[i] for i in chosen]) for chosen in (seeds, left))
    lam = criteria.regularisation(tiny.GROUPS)[0]
    expected = gains(start.means, lam, degree, tau, *pools, around)
    assert scores[0][1] == pytest.approx(expected.max())
    assert expected[left.index(first)] == pytest.approx(expected.max())


@pytest.mark.parametrize("policy", ["coverage", "directional-d", "directional-i"])
def test_what_poses_see_is_measured_once_and_again_when_it_is_forgotten(dataset, tmp_path, policy):
    """A choice that is timed must not profit from what the one before it kept (`mgs chart --only
    scoring`)."""
    looked, loaded = [], load_dataset(dataset)

    def exact(gaussians, camera):
        looked.append(camera)
        return tiny.fisher(gaussians, camera)

    settings = tiny.start(tmp_path / "run", loaded, policy=policy)
    problem = Problem(loaded, settings, tiny.operations(exact=exact))
    state, counts = loop.learn(problem, problem.seeds), []
    for forget in (False, False, True, True):
        if forget:
            problem.__dict__.pop("visibility")
        looked.clear()
        loop.choose(problem, state)
        counts.append(len(looked))
    assert counts[1] == 0 < counts[0] == counts[2] == counts[3]


@pytest.mark.parametrize("policy", ["directional-d", "directional-i"])
def test_a_run_takes_the_views_of_its_plan(loaded, tmp_path, policy):
    """Whatever order; after another view a new plan is made, and with a travel cost none."""
    state = tiny.run(tmp_path / "run", loaded, policy=policy, budget=4)
    settings = run_folder.open_run(tmp_path / "run").settings
    problem = Problem(loaded, settings, tiny.operations())
    seeds, chosen = state.taken[:3], state.taken[3:]
    left = problem.reachable(seeds)
    assert sorted(chosen) == problem.planned(seeds, left)
    first = [*seeds, chosen[0]]
    assert problem.planned(first, problem.reachable(first)) == sorted(chosen[1:])
    other = [*seeds, next(i for i in left if i not in chosen)]
    new = problem.planned(other, problem.reachable(other))
    assert len(new) == 3
    for changes in ({"travel": 1.0}, {"policy": "cover"}):
        assert problem.with_settings(**changes).planned(seeds, left) == left


@pytest.mark.parametrize("policy", ["directional-d", "directional-i"])
def test_a_run_with_limited_reach_follows_its_path(loaded, tmp_path, policy):
    """After another view a new path is planned."""
    state = tiny.run(tmp_path / "run", loaded, policy=policy, budget=4, nearest=2)
    settings = run_folder.open_run(tmp_path / "run").settings
    problem = Problem(loaded, settings, tiny.operations())
    seeds, chosen = state.taken[:3], state.taken[3:]
    for step in range(4):
        taken = [*seeds, *chosen[:step]]
        assert chosen[step] in problem.reachable(taken)
        assert problem.planned(taken, problem.reachable(taken)) == [chosen[step]]
    other = [*seeds, next(i for i in problem.reachable(seeds) if i != chosen[0])]
    (new,) = problem.planned(other, problem.reachable(other))
    assert new in problem.reachable(other)
