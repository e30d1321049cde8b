"""Flights with a limit: tours, the budget of a run, poses that are not allowed."""

from types import SimpleNamespace

import numpy as np
import pytest
import tiny
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from program import command, said, steps, stop_at
from test_directional import squares
from tiny import run

from mgs.policy import tour
from mgs.policy.directional import Views, precision
from mgs.policy.pool_gains import PoolGains
from mgs.run import folder as run_folder
from mgs.run.settings import FlightLimits

POSITIONS = arrays(np.float64, (9, 3), elements=st.floats(-50, 50, width=32))
RADII = st.sampled_from([0.0, 1.0, 20.0])
AXIS = np.array([1.0, -2.0])


@given(POSITIONS, RADII)
def test_a_leg_is_as_long_as_its_corners_say_and_keeps_out(positions, radius):
    matrix = tour.legs(positions, AXIS, radius)
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-6)
    straight = np.linalg.norm(positions[0] - positions[1])
    corners = tour.leg_corners(positions[0], positions[1], AXIS, radius)
    way = np.array([positions[0], *corners, positions[1]])
    length = np.linalg.norm(np.diff(way, axis=0), axis=1).sum()
    assert matrix[0, 1] == pytest.approx(length, abs=1e-4)
    assert length >= straight - 1e-6
    assert len(corners) == 0 or radius > 0
    out = np.linalg.norm(positions[:2, :2] - AXIS, axis=1)
    if out.min() > radius:
        between = way[:-1, None] + np.linspace(0, 1, 20)[:, None] * np.diff(way, axis=0)[:, None]
        nearest = np.linalg.norm(between[..., :2] - AXIS, axis=2).min()
        assert nearest > radius - 1e-3 * (1 + radius)


@given(POSITIONS, RADII, st.permutations(range(8)))
def test_insertion_and_2_opt_only_shorten(positions, radius, order):
    """Against a stop put at the end of the tour, before home, and the tour as it was."""
    matrix = tour.legs(positions, AXIS, radius)
    added, places = tour.insertions(matrix, order, [8])
    way = [*order[: places[0]], 8, *order[places[0] :]]
    naive = [*order[:-1], 8, order[-1]]
    assert tour.tour_length(matrix, way) <= tour.tour_length(matrix, naive) + 1e-9
    grown = tour.tour_length(matrix, way) - tour.tour_length(matrix, order)
    assert added[0] == pytest.approx(max(grown, 0), abs=1e-9)
    short = tour.two_opt(matrix, way)
    assert (short[0], short[-1], sorted(short)) == (way[0], way[-1], sorted(way))
    assert tour.tour_length(matrix, short) <= tour.tour_length(matrix, way) + 1e-9
    visited = tour.flying_order(matrix, order[0], order[1:-1], order[-1])
    assert sorted(visited) == sorted(order[1:-1])


def total(points, pool, views):
    """Gain of these views by its definition, 1.5 times the growth of log det A."""
    base = np.diag(precision(1, 0.3, 1e-3))
    A = base + squares(points, Views(pool.positions[views], pool.seen[views]), 1).sum(0)
    return 1.5 * (np.linalg.slogdet(A)[1] - np.linalg.slogdet(base)[1]).sum()


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000), st.floats(2, 30), st.integers(1, 8))
def test_a_plan_keeps_its_limit_leaves_no_room_and_betters_the_tour_it_grew_from(seed, limit, most):
    rng = np.random.default_rng(seed)
    positions = rng.normal(size=(9, 3)) * 2 + [0, 0, 4]
    seen = np.where(rng.random((9, 12)) < 0.6, 10 ** rng.uniform(-3, 1, (9, 12)), 0)
    rock = rng.normal(size=(12, 3)) / 2, Views(positions, seen.astype(np.float32))
    legs, held = tour.legs(positions, AXIS), PoolGains(*rock, 1e-3, 1, 0.3)
    held.take([0])
    greedily = held.copy()

    def share(metres, stops):
        return np.where(stops <= most, (metres + stops) / limit, np.inf)

    def pick(stops, cost):
        best = int((greedily.of_poses(stops) / cost).argmax())
        greedily.take([stops[best]])
        return stops[best], 0.0

    given = legs, [0, 1], range(2, 9)
    greedy, _ = tour.grown(*given, pick, share, 1 / most)
    way = tour.planned_tour(*given, held, share, 1 / most)
    assert (way[0], way[-1], len(set(way))) == (0, 1, len(way))
    assert len(way) == 2 or share(tour.tour_length(legs, way), len(way) - 2) <= 1 + tour.ROUNDING
    assert total(*rock, way[:-1]) >= total(*rock, greedy[:-1]) * (1 - 1e-9)
    left = [stop for stop in range(2, 9) if stop not in way]
    added, _ = tour.insertions(legs, way, left)
    assert (share(tour.tour_length(legs, way) + added, len(way) - 1) > 1).all()


def test_a_plan_finds_what_greedy_choice_misses():
    """The view worth most for its way leaves no room for two beyond it, which are worth more."""
    positions = np.array([[0, 0, 0], [1, 0, 0], [-3, 0, 0], [-3, 0.1, 0.0]])

    def share(metres, stops):
        return np.asarray(metres / 6.5)

    worth = np.array([0.0, 1.0, 1.5, 1.5])  # whatever was taken, unlike that of `PoolGains`
    held = SimpleNamespace(of_poses=lambda poses: worth[list(poses)], copy=lambda: held)
    held.take = held.drop = lambda views: None
    legs = tour.legs(positions, AXIS)
    way = tour.planned_tour(legs, [0, 0], [1, 2, 3], held, share, 0.0)
    assert sorted(way) == [0, 0, 2, 3]


def metres(dataset, taken):
    positions = np.array([dataset.frames[i].camera.position for i in [*taken, taken[0]]])
    return np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()


LIMITS = [
    {"flight": {"length": 30.0}, "batch": 2},
    {"flight": {"time": 40.0, "speed": 1.0, "hover": 3.0}},
    {"flight": {"length": 19.0}, "policy": "random"},
]


@pytest.mark.parametrize("limits", LIMITS, ids=str)
def test_a_flight_never_exceeds_its_limits_and_resumes_the_same(loaded, tmp_path, limits):
    given = {"budget": 9, "seeds": 3, **limits}
    state = run(tmp_path / "run", loaded, **given)
    flown, pictures = metres(loaded, state.taken), len(state.taken)
    flight = FlightLimits(**limits["flight"])
    assert flown <= (flight.length or np.inf)
    assert flown / flight.speed + 3 * pictures <= (flight.time or np.inf)
    assert state.steps[-1]["ended"] == {
        "reason": "flight", "views": pictures - 3, "metres": pytest.approx(flown)
    }  # fmt: skip
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "part", loaded, on_step=stop_at(2), **given)
    assert tiny.resume(tmp_path / "part", loaded).taken == state.taken


def test_a_limit_that_binds_nothing_changes_no_view_of_one_step(loaded, tmp_path):
    free = run(tmp_path / "free", loaded, budget=1)
    wide = run(tmp_path / "wide", loaded, budget=1, flight={"length": 1e6})
    assert wide.taken == free.taken


def test_poses_that_are_not_allowed_are_never_taken(dataset, prior, tmp_path, capsys):
    """Twelve poses on a circle of 3 m; the sphere's samples reach from -1 to 1 m."""
    given = ["--seeds", 3, "--budget", 2, "--prior", prior]
    command("nbv", dataset, *given, "--set", "flight.no_fly=2.9", "--out", tmp_path / "run")
    assert "0 of 12 poses are ruled out by flight.no_fly and flight.clearance" in said(capsys)[0]
    assert len(steps(tmp_path / "run")) == 3
    settings = run_folder.open_run(tmp_path / "run").settings
    settings = settings.model_copy(update={"flight": FlightLimits(no_fly=2.0)})
    scene = tiny.scene(run_folder.open_run(tmp_path / "run").dataset, settings)
    positions = scene.positions(scene.frames)
    opposite = tour.legs(positions, scene.centre[:2], settings.flight.no_fly)[0, 6]
    assert 6 < opposite == pytest.approx(2 * np.sqrt(5) + 2 * (np.pi - 2 * np.arccos(2 / 3)), 0.01)
