"""Why a run ends, what a resumed run needs, and flights with a limit: tours, poses not allowed."""

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import synthetic
import tiny
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from program import change_settings, command, said, steps, stop_at
from refusals import fails
from test_directional import squares
from tiny import resume, run

from mgs import learn, load_dataset
from mgs.errors import Notice
from mgs.files import read_json, write_json
from mgs.policy import criteria, tour
from mgs.policy.directional import Views, precision
from mgs.policy.pool_gains import PoolGains
from mgs.run import folder as run_folder
from mgs.run.choosing import planned_flight
from mgs.run.ending import run_end
from mgs.run.flight import Flight
from mgs.run.policies import Directional
from mgs.run.settings import FlightLimits, NbvSettings


@pytest.fixture(scope="module")
def spent(whole):
    """The last state of a run that spent its budget of 5 views."""
    return run_folder.open_run(whole).state


def never(*arguments):
    raise AssertionError("a run that has ended computes nothing")


NUMBERS = st.floats(1e-3, 1 - 1e-3)


@given(
    views=st.integers(0, 5),
    uncertainty=NUMBERS,
    gain=NUMBERS,
    limits=st.tuples(*[st.none() | NUMBERS] * 3),
    predicted=st.none() | NUMBERS,
)
def test_the_first_rule_that_holds_is_the_reason(views, uncertainty, gain, limits, predicted):
    stop_uncertainty, stop_gain, stop_psnr = limits
    limit = {"stop_uncertainty": stop_uncertainty, "stop_gain": stop_gain, "stop_psnr": stop_psnr}
    settings = NbvSettings(dataset=".", prior=".", budget=3, **limit)
    refused = {"name": "kf_0001", "information_gain": gain}
    found = run_end(settings, views, uncertainty, refused, None, predicted)
    holds = {
        "budget": views >= 3,
        "uncertainty": stop_uncertainty is not None and uncertainty <= stop_uncertainty,
        "psnr": None not in (stop_psnr, predicted) and predicted >= stop_psnr,
        "gain": stop_gain is not None and gain < stop_gain,
    }
    reason = next((reason for reason, held in holds.items() if held), None)
    assert (found and found["reason"]) == reason
    # What was recorded is enough to find the same again.
    assert run_end(settings, views, uncertainty, found, None, predicted) == found
    unknown = run_end(settings, views, uncertainty, None, None, predicted)
    assert unknown == (None if reason == "gain" else found)


def test_uncertainty_is_the_variance_left_over_that_of_the_prior():
    rng = np.random.default_rng(0)
    H, lam, noise = rng.exponential(size=(5, 11)), rng.exponential(size=11), 0.3
    posterior, prior = noise**2 / (H + lam), noise**2 / lam
    np.testing.assert_allclose(criteria.uncertainty(H, lam), (posterior / prior).mean(axis=1))
    assert (criteria.uncertainty(np.zeros_like(H), lam) == 1).all()
    assert (criteria.uncertainty(H + 1e-6, lam) < criteria.uncertainty(H, lam)).all()


@pytest.mark.parametrize("rule", ["stop_gain", "stop_uncertainty", "budget"])
def test_a_run_that_ended_goes_on_only_when_its_rule_is_changed(loaded, spent, tmp_path, rule):
    two, three = spent.steps[2:4]
    assert two["uncertainty"] > three["uncertainty"]
    limit, left = (two["information_gain"] + three["information_gain"]) / 2, two["uncertainty"]
    next_view = {"name": three["name"], "information_gain": three["information_gain"]}
    value, changed, reason, numbers = {
        "stop_gain": (limit, None, "gain", {**next_view, "limit": limit}),
        "stop_uncertainty": (left, None, "uncertainty", {"uncertainty": left, "limit": left}),
        "budget": (2, 5, "budget", {}),
    }[rule]
    out = tmp_path / "run"
    state = run(out, loaded, **{rule: value})
    assert state.taken == spent.taken[:5]
    assert "ended" not in state.steps[-2]
    assert state.steps[-1]["ended"] == {"reason": reason, "views": 2, **numbers}
    assert three["name"] not in state.inputs["files"], "the image of a view that was refused"
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    again = resume(out, loaded, fit=never, fisher=never)
    assert again.taken == state.taken
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    change_settings(out, **{rule: changed})
    last = resume(out, loaded)
    assert last.taken == spent.taken
    assert ["ended" in line for line in last.steps] == [False] * 5 + [True]
    np.testing.assert_array_equal(last.gaussians.sh, spent.gaussians.sh)


def other_image(root: Path, name: str) -> None:
    """Replace the image of a frame by that of frame 1."""
    shutil.copy(root / "images/kf_0001.png", root / f"images/{name}.png")


def edit(root: Path, name: str, x: float = 0, **values) -> None:
    """Change a frame's entries in transforms.json, and move its camera by x metres."""

    def change(data):
        record = next(record for record in data["frames"] if name in record["file_path"])
        record["transform_matrix"][0][3] += x
        record.update(values)

    synthetic.edit(root, change)


OTHER = "images/kf_0000.png"
CHANGES = {
    r"images/kf_0004\.png has changed since .*run took it": lambda d: other_image(d, "kf_0004"),
    r"depth/kf_0000\.exr has changed": lambda d: (d / "depth/kf_0000.exr").write_bytes(b"other"),
    r"images/kf_0000\.png has changed": lambda d: edit(d, "kf_0004", rock_file_path=OTHER),
    "the mask of frame kf_0000 has changed": lambda d: edit(d, "kf_0000", mask_path=None),
    "the camera of frame kf_0005 has changed": lambda d: edit(d, "kf_0005", x=1e-6),
}
"""Message, and change of the dataset. Of 12 frames on a circle 0, 4 and 8 are the seeds."""


@pytest.fixture
def half_done(dataset, tmp_path):
    """A dataset and a run of three steps of six."""
    loaded, out = load_dataset(dataset), tmp_path / "run"
    settings = tiny.start(out, loaded).model_copy(update={"budget": 2})
    tiny.go(out, settings, loaded)
    return dataset, out


@pytest.mark.parametrize("message", CHANGES)
def test_a_run_does_not_go_on_from_changed_inputs(half_done, message):
    root, out = half_done
    CHANGES[message](root)
    before = (out / "steps.jsonl").read_text()
    fails(message, tiny.resume, out, load_dataset(root))
    assert (out / "steps.jsonl").read_text() == before


def test_a_run_goes_on_where_images_of_candidates_changed(half_done):
    """And where the dataset moved: config.json names its new folder."""
    root, out = half_done
    taken = run_folder.read_checkpoint(out).taken
    for i in set(range(tiny.FRAMES)) - {1, *taken}:
        other_image(root, f"kf_{i:04d}")
    moved = root.rename(root.parent / "elsewhere")
    change_settings(out, dataset=str(moved))
    assert len(tiny.resume(out, load_dataset(moved)).steps) == 6


def test_a_run_that_goes_on_with_another_version_says_so(half_done):
    root, out = half_done
    config = read_json(out / "config.json")
    config["versions"] |= {"mgs": "0.0.9", "commit": "0", "python": "3.0"}
    write_json(out / "config.json", config)
    with pytest.warns(Notice, match=r"was started with mgs 0\.0\.9; the next steps may differ"):
        tiny.resume(out, load_dataset(root))
    tiny.resume(out, load_dataset(root))  # has no step to go, and warnings are errors


def test_a_run_does_not_go_on_from_other_initial_gaussians(half_done):
    root, out = half_done

    def initial(frames):
        g = tiny.initial(frames)
        return replace(g, means=g.means + np.float32(0.01))

    fails("is not the prior that .*run", tiny.resume, out, load_dataset(root), initial=initial)


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
    A = base + squares(points, pool.of(views), 1).sum(0)
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
    held = SimpleNamespace(of_poses=lambda poses: worth[list(poses)], take=lambda views: None)
    held.without = lambda view: held
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


def test_a_tour_is_of_its_policy_and_of_the_views_it_may_have(loaded):
    """Runs that differ in the policy share a scene, and so may missions of one's own."""
    limits = {"seeds": 3, "flight": {"length": 30.0}}
    missions = [NbvSettings(dataset=".", prior=".", budget=n, **limits) for n in (9, 9, 1)]
    shared = tiny.scene(loaded, missions[0])
    plans = []
    ours, other = Directional(), Directional(tour=(0, 1.0, False))
    for mission, policy in zip(missions, (ours, other, ours), strict=True):
        scenes = shared, tiny.scene(loaded, mission)
        states = [learn(scene, scene.seeds(3)) for scene in scenes]
        pairs = zip(scenes, states, strict=True)
        plan, alone = (planned_flight(*pair, policy, mission) for pair in pairs)
        assert plan == alone
        plans.append(plan)
    assert plans[0] != plans[1]
    assert len(plans[2]) == 1


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


def test_a_view_in_reach_is_one_that_a_plan_can_take():
    """Around a cylinder a way with a stop can be shorter: its corners lie nearer to the arc."""
    angles = np.radians([0, 14.9, 7.45])
    legs = tour.legs(np.column_stack([np.cos(angles), np.sin(angles), [0, 0, 0]]), np.zeros(2), 1.0)
    assert legs[1, 2] + legs[2, 0] < legs[1, 0] - 1e-3
    for time in (9.522, 9.5225, 9.524):
        flight = Flight(FlightLimits(time=time, speed=1.0, no_fly=1.0), legs, home=0)
        share = flight.share_from([0, 1], 9)
        way, _ = tour.grown(legs, [1, 0], [2], lambda stops, cost: (2, 1.0), share, 1.0)
        assert flight.in_reach([0, 1], [2]) == way[1:-1]


@pytest.mark.parametrize(("name", "value"), [("seeds", 2), ("sh", 1)])
def test_a_run_does_not_go_on_with_other_seeds_or_colours(half_done, name, value):
    """Its next steps would have other numbers than its views, so it could not be read again."""
    root, out = half_done
    change_settings(out, **{name: value})
    before = (out / "checkpoint.npz").read_bytes()
    fails(rf"settings\.{name} has changed since", tiny.resume, out, load_dataset(root))
    assert (out / "checkpoint.npz").read_bytes() == before
