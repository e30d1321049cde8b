"""Policies: laws of an information gain, and each policy against its formula."""

from dataclasses import replace
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from refusals import fails
from splat import reference
from splat.scenes import make_camera, make_gaussians
from synthetic import sphere

import mgs
from mgs.colour import SH_C0, srgb_from_linear
from mgs.policy import criteria
from mgs.policy import poses as pose_policies
from mgs.run.policies import POLICIES
from mgs.splat import groups
from mgs.synth.orbit import orbit_positions
from mgs.synth.scene_file import Orbit
from studies import policies as studied
from studies import ring
from studies.frame.program import Work
from studies.frame.sweep import Cell
from studies.paper import LETTER, Letter

LAM = criteria.regularisation(groups(0))
N = 5
information = arrays(np.float64, (N, 11), elements=st.floats(0, 1e4, allow_subnormal=False))
scales = arrays(np.float64, 11, elements=st.floats(1e-3, 1e3))
AZIMUTHS = np.arange(12) * np.pi / 6
CIRCLE = np.stack([np.cos(AZIMUTHS), np.sin(AZIMUTHS), np.full(12, 0.5)], 1)
CENTRE = np.zeros(3)
SCORES = {
    "d-optimal": criteria.d_optimal,
    "a-optimal": criteria.a_optimal,
    "fisherrf": criteria.fisherrf,
    "coverage": criteria.coverage_greedy,
}
any_criterion = st.sampled_from(sorted(SCORES))


@given(information, information)
def test_d_optimal_is_the_exact_log_determinant_difference(F, H):
    before = np.linalg.slogdet(np.diag((H + LAM).ravel()))[1]
    after = np.linalg.slogdet(np.diag((H + F + LAM).ravel()))[1]
    found = criteria.d_optimal(F, H, LAM) * H.size
    assert found == pytest.approx(after - before, rel=1e-9, abs=1e-9)


@given(information, information, information, any_criterion)
def test_scores_are_never_negative_and_grow_with_what_is_seen(F, more, H, name):
    score = SCORES[name]
    assert score(np.zeros_like(H), H, LAM) == 0 <= score(F, H, LAM)
    assert score(F + more, H, LAM) >= score(F, H, LAM) * (1 - 1e-12)


@given(
    information, information, information, st.sampled_from(["d-optimal", "a-optimal", "fisherrf"])
)
def test_returns_diminish(F, H, seen, name):
    score = SCORES[name]
    assert score(F, H + seen, LAM) <= score(F, H, LAM) * (1 + 1e-12)


@given(information, information, scales, st.sampled_from(["d-optimal", "fisherrf", "coverage"]))
def test_units_do_not_matter_when_lambda_carries_them(F, H, unit, name):
    """theta -> unit * theta divides J by unit. Powers of two are exact in floating point, so the
    threshold of `coverage` cannot flip by rounding."""
    score = SCORES[name]
    square = 4.0 ** np.round(np.log2(unit))
    changed = score(F / square, H / square, LAM / square)
    assert changed == pytest.approx(score(F, H, LAM), rel=1e-9)


def test_regularisation_is_the_priors_information_per_group():
    tau = {"colour": 1, "scale": 2, "rotation": 0.5, "opacity": 10}
    lam = criteria.regularisation(groups(0), pixel_noise=0.1, prior_std=tau)
    assert lam == pytest.approx([0.01] * 3 + [0.0025] * 3 + [0.04] * 4 + [0.0001])
    by_kind = {"colour": 0.01, "scale": 0.0025, "rotation": 0.04, "opacity": 0.0001}
    assert criteria.lam_by_kind(lam, groups(0)) == pytest.approx(by_kind)
    fails("no number for mean", criteria.regularisation, groups(0, "free"), 0.1, tau)


def test_coverage_counts_newly_observed_gaussians():
    H = np.zeros((4, 11))
    H[0, :3] = 1.0
    sees_two = np.zeros((4, 11))
    sees_two[[0, 1, 2], :3] = 1.0
    assert criteria.coverage(H, LAM) == 0.25
    assert criteria.coverage_greedy(sees_two, H, LAM) == 2
    sees_old = np.zeros((4, 11))
    sees_old[0, :3] = 5.0
    assert criteria.coverage_greedy(sees_old, H, LAM) == 0


@given(arrays(np.float64, (2, N, 14, 11), elements=st.floats(-10, 10)))
def test_blocks_are_the_log_determinant_of_the_posterior(jacobians):
    """H_j = J_j^T J_j of a few rows. The diagonal alone overestimates."""
    F, H = (np.einsum("nrk,nrl->nkl", J, J) for J in jacobians)
    expected = np.linalg.slogdet(H + np.diag(LAM))[1].mean() / 11 - np.log(LAM).mean()
    found = studied.block_log_determinant(H, LAM)
    assert found == pytest.approx(expected, rel=1e-6, abs=1e-6)
    assert studied.block_log_determinant(H + F, LAM) >= found - 1e-9
    diagonal = np.einsum("nkk->nk", H)
    assert found <= criteria.d_optimal(diagonal, np.zeros_like(diagonal), LAM) + 1e-9


def test_rounding_below_zero_counts_as_no_information():
    assert studied.block_log_determinant(-np.eye(11)[None], LAM) == 0


def test_angle_spreads_over_a_dome():
    taken = np.array([[2.0, 0, 0]])
    candidates = np.array([[0, 0, 9.0], [-0.5, 0, 0], [4, 0.1, 0], [0, 2, 0]])
    for centre in (CENTRE, np.array([3.0, 4.0, 5.0])):
        found = studied.angle(candidates + centre, taken + centre, centre)
        expected = [np.pi / 2, np.pi, np.arctan(0.1 / 4), np.pi / 2]
        assert found == pytest.approx(expected, abs=1e-6)


def known(H, **surface):
    """A scene and a state after view 0: what policies use of them."""
    surface = SimpleNamespace(**surface)
    scene = SimpleNamespace(lam=LAM, surface_lam=LAM, surface=lambda state: surface)
    return scene, SimpleNamespace(H=H, surface=H, taken=(0,), frames=range(4))


def test_policies_use_their_own_estimator():
    """Both for candidates and views taken."""
    rng, scales = np.random.default_rng(0), {"exact": 1, "loss-gradient": 1e-9}
    models = {name: rng.random((4, N, 11)) * scale for name, scale in scales.items()}
    J = rng.normal(size=(4, N, 14, 11))
    models["block"] = np.einsum("vnrk,vnrl->vnkl", J, J)
    exact, blocks, gradients = (models[name] for name in ("exact", "block", "loss-gradient"))
    scene, state = known(exact[0])
    scene.information = lambda state, view, estimator="exact": models[estimator][view]
    whole = [studied.block_log_determinant(blocks[0] + F, LAM) for F in blocks[1:]]
    d = np.array(whole) - studied.block_log_determinant(blocks[0], LAM)
    assert studied.block_d(scene, state, [1, 2, 3]) == pytest.approx(d)
    lam = np.full(11, gradients[0].mean())  # of the one view taken
    paper = [criteria.d_optimal(F, gradients[0], lam) for F in gradients[1:]]
    assert POLICIES["paper"](scene, state, [1, 2, 3]) == pytest.approx(paper)


def seen_from(eyes, model):
    """Cameras at these places, and a state in which the first has seen the model."""
    cameras = [make_camera((24, 18), 30.0, eye) for eye in eyes]
    frames = tuple(SimpleNamespace(camera=camera) for camera in cameras)
    return cameras, mgs.State(frames, (0,), 1, model, np.zeros((len(model), 11)), np.zeros(0))


def test_full_d_is_the_gain_of_the_whole_matrix(monkeypatch):
    """Against dense float64 Jacobians; by the blocks it is 6 and 8 % larger."""
    monkeypatch.setattr(studied, "PROBES", 8)
    model = make_gaussians(12, 3, log_scales=(-1.5, -0.8))
    cameras, state = seen_from([(2.0, 0.4, 1.1), (1.9, 0.9, 0.8), (-1.9, 0.3, 1.0)], model)
    settings = SimpleNamespace(train=SimpleNamespace(means="frozen"))
    scene = SimpleNamespace(settings=settings, cache=mgs.ListCache(), lam=LAM)
    J = [reference.jacobian(model, camera).reshape(-1, 132) for camera in cameras]
    each = [jacobian.T @ jacobian for jacobian in J]
    prior = np.diag(np.tile(LAM, 12))
    before = np.linalg.slogdet(each[0] + prior)[1]
    gains = [np.linalg.slogdet(each[0] + F + prior)[1] - before for F in each[1:]]
    assert studied.full_d(scene, state, [1, 2]) == pytest.approx(np.array(gains) / 132, rel=0.03)


def test_fisherrf_code_squares_the_gradient_of_each_pixel():
    """Channels are summed first, and activations enter once (its CUDA kernel and PyTorch)."""
    model = make_gaussians(5, 3, colour=0.4)
    cameras, state = seen_from([(2.0, 0.4, 1.1), (0.2, 2.1, 0.8), (-1.9, 0.3, 1.0)], model)
    o = 1 / (1 + np.exp(-model.logit_opacities.astype(np.float64)))

    def F(camera):
        J = reference.jacobian(model, camera, (1.0, 1.0, 1.0), "free")
        squares = (J.sum(1) ** 2).sum(0)
        squares[:, :3] = (J[..., :3] ** 2).sum((0, 1))
        squares[:, 3:6] /= np.exp(model.log_scales)
        squares[:, 6:10] = 0
        squares[:, 10] /= o * (1 - o)
        return squares

    scores = [(F(camera) / (F(cameras[0]) + 1e-6)).sum() for camera in cameras[1:]]
    found = studied.fisherrf_code(SimpleNamespace(cache=None), state, [1, 2])
    assert found == pytest.approx(scores, rel=1e-3)


@pytest.mark.parametrize("linear", [True, False])
def test_the_papers_h_squares_the_gradient_of_the_training_loss(linear):
    """Against central differences of the float64 renderer's mean squared error."""
    model, camera = replace(make_gaussians(6, 3), linear=linear), make_camera()
    image = np.random.default_rng(0).random((camera.height, camera.width, 3)).astype(np.float32)
    scene = SimpleNamespace(image=lambda frame: image)
    target = image if linear else srgb_from_linear(image)
    state = SimpleNamespace(frames=[SimpleNamespace(camera=camera)], gaussians=model)
    found = Letter.squares(scene, state, 0)

    def loss(array, row, column, step):
        values = getattr(model, array).astype(np.float64)
        values.reshape(6, -1)[row, column] += step
        moved = replace(model, **{array: values})
        return np.square(reference.render(moved, camera)["rgb"] - target).mean()

    for column, (array, k) in enumerate((("sh", 0), ("sh", 1), ("sh", 2), ("log_scales", 0))):
        for row in range(6):
            up, down = (loss(array, row, k, step) for step in (1e-4, -1e-4))
            slope = ((up - down) / 2e-4) ** 2
            assert found[row, column] == pytest.approx(slope, rel=2e-3, abs=1e-9)
    assert found.shape == (6, 11)
    assert (found > 1e-8).any()


def test_rows_of_the_ring_count_rises_and_choices_that_observe_more():
    scores, observed = [0.3, 0.1, 0.2, 0.1], [0.5, 0.6, 0.6, 0.6, 0.7]
    about, names = {"rock": "boulder-11", "scene": "boulder", "seeds": 4}, (LETTER, ring.GREEDY)
    cells = [Cell(name, "", about=about | {"variant": name}) for name in names]
    results = {
        name: {"pool": pool, "score": scores, "observed": observed}
        for name, pool in zip(names, (30.0, 30.5), strict=True)
    }
    letter, greedy = ring.rows_of(Work(SimpleNamespace(), "", None, cells, results))
    assert [letter[key] for key in ("first", "last", "rises", "useful")] == [0.3, 0.1, 1, 2]
    assert letter["largest_rise"] == pytest.approx(0.1)
    assert [letter["seen"], letter["seen_last"]] == pytest.approx([50, 70])
    assert greedy["rises"] is None
    assert greedy["useful"] == 2
    assert [letter["pool_change"], greedy["pool_change"]] == [0, 0.5]


def test_exact_information_to_the_letter_is_eq_7():
    """Two Gaussians of one parameter: a view of the unseen one gains more."""
    F = {0: [[1.0], [0.0]], 1: [[1.0], [0.0]], 2: [[0.0], [1.0]]}
    scene = SimpleNamespace(lam=np.ones(1), information=lambda state, i: np.array(F[i]))
    found = ring.exact_letter(scene, SimpleNamespace(taken=(0,)), [1, 2])
    assert found == pytest.approx([np.log(1 + 1 / 1.5) / 2, np.log(1 + 1 / 0.5) / 2])


def test_visibility_baselines_prefer_the_other_side():
    """One Gaussian, seen from +X: a pose beside it is worth less than one beyond it."""
    model = replace(make_gaussians(1, 0), means=np.zeros((1, 3), np.float32))
    model = replace(model, logit_opacities=np.full(1, 3, np.float32))
    _, state = seen_from([(2.0, 0, 0.5), (1.9, 0.3, 0.5), (-2.0, 0, 0.5)], model)
    scene = SimpleNamespace(cache=None, lam=LAM, settings=SimpleNamespace(pixel_noise=0.02))
    scene.information = lambda state, view: np.full((1, 11), 1e3)
    for policy in (studied.cover_gym, studied.gavis_like):
        near, far = policy(scene, state, [1, 2])
        assert far > near


def test_cover_looks_at_what_was_not_observed():
    """The first of two points was observed from +X; the view taken says less about the second than
    the prior does."""
    points = np.array([[0.0, 0, 0], [0, 0, 1e-9]])
    positions = np.array([[4.0, 0, 0], [0, 4, 0], [0, -4, 0], [4, 0, 0]])
    enough = LAM[0] / SH_C0**2
    seen = np.array([[10 * enough, 0.5 * enough], [1, 0], [3, 1], [0, 2]])
    given = {"positions": positions, "points": points, "seen": lambda view: seen[view]}
    scene, state = known(None, **given)
    cover = POLICIES["cover"]
    assert cover(scene, state, [1, 2, 3]) == pytest.approx([0.5, (3 * 0.5 + 1) / 4, 1])
    positions[1] = [4 * np.cos(0.5), 4 * np.sin(0.5), 0]  # nearer to the first view taken
    state.taken = 0, 2
    assert cover(scene, state, [1]) == pytest.approx([(1 - np.cos(0.5)) / 2])
    scene, state = known(None, **given | {"seen": lambda view: np.zeros(2)})
    assert cover(scene, state, [1]) == 0


def test_no_exchange_lowers_what_a_plan_of_cover_leaves_new():
    """Sum COVER's own scores over all poses: the least that an exchange can reach."""
    rng, eyes = np.random.default_rng(1), sphere(12) * 4
    seen = rng.random((12, 30)) * (rng.random((12, 30)) < 0.4)
    scene, state = known(
        np.zeros((30, 11)), positions=eyes, points=rng.random((30, 3)), seen=lambda view: seen[view]
    )
    scene.once = lambda key, make: make()
    state.seeds, state.moved, state.frames = 1, None, range(12)
    views = list(range(1, 12))

    def new(plan):
        after = SimpleNamespace(**vars(state) | {"taken": (0, *plan)})
        return POLICIES["cover"](scene, after, range(12)).sum()

    plan = studied.cover_plan.plan(scene, state, views, 4, None)
    assert len(set(plan)) == 4
    assert new(plan) < new(views[:4])
    for k, view in product(range(4), sorted(set(views) - set(plan))):
        assert new([*plan[:k], view, *plan[k + 1 :]]) >= new(plan) - 1e-6
    assert studied.cover_plan.plan(scene, state, views, 4, nearest=5) == views


def test_uniform_leaves_even_gaps_at_every_count():
    taken = [0, 3, 6, 9]
    for largest in (3, 3, 3, 2, 2, 2, 2, 1):
        left = [i for i in range(12) if i not in taken]
        scores = pose_policies.uniform_azimuth(CIRCLE[left], CIRCLE[taken], CENTRE)
        taken.append(left[int(np.argmax(scores))])
        assert np.diff([*sorted(taken), 12]).max() == largest


def test_farthest_looks_at_height_too():
    poles = np.array([[1.0, 0, 0.5], [0, 0, 9.0], [-1, 0, 0.5]])
    assert np.argmax(pose_policies.farthest_pose(poles, CIRCLE, CENTRE)) == 1


def test_seeds_are_evenly_spaced_wherever_the_orbit_starts():
    rock = np.array([3.0, 4.0, 0.0])
    assert pose_policies.seed_views(CIRCLE, CENTRE, 4) == [0, 3, 6, 9]
    assert pose_policies.seed_views(np.roll(CIRCLE, 5, axis=0) + rock, rock, 4) == [5, 8, 11, 2]
    assert sorted(pose_policies.seed_views(CIRCLE, CENTRE, 12)) == list(range(12))


def test_seeds_are_spread_over_elevations_too():
    """On a dome, no other frame in place of one seed brings the poses nearer to the seeds."""
    dome = orbit_positions(Orbit(kind="hemisphere", radius=4), 30, CENTRE)
    squared = pose_policies.angles(dome, dome, CENTRE) ** 2

    def cost(seeds):
        return squared[seeds].min(axis=0).sum()

    for count in (1, 2, 5, 12):
        seeds = pose_policies.seed_views(dome, CENTRE, count)
        assert len(set(seeds)) == count
        for k in range(count):
            others = [[*seeds[:k], i, *seeds[k + 1 :]] for i in range(30)]
            assert min(map(cost, others)) >= cost(seeds) - 1e-9
    (top,) = pose_policies.seed_views(dome, CENTRE, 1)
    assert dome[top, 2] > np.quantile(dome[:, 2], 0.8), "one seed looks from above"


def test_seeds_are_near_the_rock_and_all_around():
    """Seeds of two shells are those of the inner one alone, but close-ups of one side do not keep
    them from the others."""
    shells = np.concatenate([2 * CIRCLE, CIRCLE])
    assert pose_policies.seed_views(shells, CENTRE, 4) == [12, 15, 18, 21]
    for inner in (1, 4, 6):
        some = pose_policies.seed_views(shells[: 12 + inner], CENTRE, 4)
        assert np.allclose(np.diff(AZIMUTHS[np.array(some) % 12]), np.pi / 2)


def test_azimuth_is_measured_about_the_rock():
    positions = np.array([[2.0, 1.0, 9.0], [1.0, 2.0, -1.0], [0.0, 1.0, 0.0]])
    found = pose_policies.azimuths(positions, np.array([1.0, 1.0, 0.0]))
    assert found == pytest.approx([0, np.pi / 2, np.pi])
