"""Policies as algebra: the properties that make a score an information gain."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mgs.colour import SH_C0
from mgs.policy import criteria
from mgs.policy import poses as pose_policies
from mgs.policy import registry as policies
from mgs.seeds import generator

GROUPS = {
    "colour": slice(0, 3),
    "scale": slice(3, 6),
    "rotation": slice(6, 10),
    "opacity": slice(10, 11),
}
LAM = criteria.regularisation(GROUPS)
N = 5
information = arrays(np.float64, (N, 11), elements=st.floats(0, 1e4, allow_subnormal=False))
scales = arrays(np.float64, 11, elements=st.floats(1e-3, 1e3))
CIRCLE = np.stack(
    [np.cos(np.arange(12) * np.pi / 6), np.sin(np.arange(12) * np.pi / 6), np.full(12, 0.5)], 1
)
CENTRE = np.zeros(3)


@given(information, information)
def test_d_optimal_is_the_exact_log_determinant_difference(F, H):
    before = np.linalg.slogdet(np.diag((H + LAM).ravel()))[1]
    after = np.linalg.slogdet(np.diag((H + F + LAM).ravel()))[1]
    assert criteria.d_optimal(F, H, LAM) * H.size == pytest.approx(
        after - before, rel=1e-9, abs=1e-9
    )


@given(information, information, st.sampled_from(sorted(criteria.CRITERIA)))
def test_no_view_loses_information(F, H, name):
    assert criteria.CRITERIA[name].score(F, H, LAM) >= 0


@given(information, st.sampled_from(sorted(criteria.CRITERIA)))
def test_a_view_that_sees_nothing_gains_nothing(H, name):
    assert criteria.CRITERIA[name].score(np.zeros_like(H), H, LAM) == 0


@given(information, information, information, st.sampled_from(sorted(criteria.CRITERIA)))
def test_seeing_more_is_never_worse(F, more, H, name):
    score = criteria.CRITERIA[name].score
    assert score(F + more, H, LAM) >= score(F, H, LAM) * (1 - 1e-12)


@given(
    information, information, information, st.sampled_from(["d-optimal", "t-optimal", "fisherrf"])
)
def test_returns_diminish(F, H, seen, name):
    """Submodularity: with the model held fixed, a view is worth less once others have been
    taken."""
    score = criteria.CRITERIA[name].score
    assert score(F, H + seen, LAM) <= score(F, H, LAM) * (1 + 1e-12)


@given(information, information, scales, st.sampled_from(["d-optimal", "fisherrf", "coverage"]))
def test_units_do_not_matter_when_lambda_carries_them(F, H, unit, name):
    """theta -> unit * theta divides J by unit; lam = (sigma / tau)^2 follows, so the gain must not
    change."""
    score = criteria.CRITERIA[name].score
    # Powers of two: exact in floating point, so the threshold of `coverage` cannot flip by
    # rounding.
    unit = 2.0 ** np.round(np.log2(unit))
    assert score(F / unit**2, H / unit**2, LAM / unit**2) == pytest.approx(
        score(F, H, LAM), rel=1e-9
    )


@settings(max_examples=30)
@given(arrays(np.float64, (6, N, 11), elements=st.floats(0, 10, allow_subnormal=False)))
def test_greedy_d_optimal_reaches_its_guarantee(views):
    """Monotone and submodular, so greedy is within 1 - 1/e of the best pair (Nemhauser et al.
    1978)."""
    H = np.zeros((N, 11))

    def value(chosen):
        return criteria.d_optimal(views[list(chosen)].sum(0), H, LAM)

    first = max(range(6), key=lambda i: value([i]))
    second = max((i for i in range(6) if i != first), key=lambda i: value([first, i]))
    best = max(value([i, j]) for i in range(6) for j in range(i))
    assert value([first, second]) >= (1 - 1 / np.e) * best - 1e-12


def test_regularisation_is_the_priors_information_per_group():
    lam = criteria.regularisation(
        GROUPS, pixel_noise=0.1, prior_std={"colour": 1, "scale": 2, "rotation": 0.5, "opacity": 10}
    )
    assert lam == pytest.approx([0.01] * 3 + [0.0025] * 3 + [0.04] * 4 + [0.0001])


def test_gain_is_twice_the_mutual_information_of_a_linear_gaussian_model():
    """y = J theta + e with diagonal J^T J: I(theta; y) = 1/2 log det(I + J Sigma J^T / sigma^2)."""
    rng = np.random.default_rng(0)
    j, sigma = rng.normal(size=11), criteria.PIXEL_NOISE
    tau = sigma / np.sqrt(LAM)
    mutual = 0.5 * np.linalg.slogdet(np.eye(11) + np.diag((j * tau / sigma) ** 2))[1]
    assert criteria.d_optimal(j[None] ** 2, np.zeros((1, 11)), LAM) == pytest.approx(
        2 / 11 * mutual
    )


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


def test_t_optimal_is_the_difference_the_paper_writes():
    rng = np.random.default_rng(1)
    F, H = rng.random((N, 11)), rng.random((N, 11))
    assert criteria.t_optimal(F, H, LAM) == pytest.approx(
        (1 / (H + LAM) - 1 / (H + F + LAM)).mean()
    )


@given(information, information, information)
def test_i_optimal_is_the_fall_of_a_predicted_variance(F, H, weight):
    """Never negative; with equal weights the fall of the mean variance; a view is worth less once
    it was taken."""
    found = criteria.i_optimal(F, H, LAM, weight)
    assert found == pytest.approx(
        (weight * (1 / (H + LAM) - 1 / (H + F + LAM))).mean(), rel=1e-6, abs=1e-6
    )
    assert 0 <= criteria.i_optimal(F, H + F, LAM, weight) <= found
    assert criteria.i_optimal(F, H, LAM, np.ones_like(H)) == criteria.t_optimal(F, H, LAM)


@given(information, information)
def test_blocks_without_correlations_are_a_diagonal(F, H):
    F_blocks, H_blocks = (values[:, :, None] * np.eye(11) for values in (F, H))
    gain = criteria.block_log_determinant(
        H_blocks + F_blocks, LAM
    ) - criteria.block_log_determinant(H_blocks, LAM)
    assert gain == pytest.approx(criteria.d_optimal(F, H, LAM), rel=1e-6, abs=1e-9)


@given(arrays(np.float64, (2, N, 14, 11), elements=st.floats(-10, 10)))
def test_blocks_are_the_log_determinant_of_the_posterior(jacobians):
    """H_j = J_j^T J_j of a few rows; the gain is never negative. A diagonal, which knows no
    correlation, says more."""
    F, H = (np.einsum("nrk,nrl->nkl", J, J) for J in jacobians)
    expected = np.linalg.slogdet(H + np.diag(LAM))[1].mean() / 11 - np.log(LAM).mean()
    assert criteria.block_log_determinant(H, LAM) == pytest.approx(expected, rel=1e-6, abs=1e-6)
    assert (
        criteria.block_log_determinant(H + F, LAM) >= criteria.block_log_determinant(H, LAM) - 1e-9
    )
    diagonal = np.einsum("nkk->nk", H)
    assert (
        criteria.block_log_determinant(H, LAM)
        <= criteria.d_optimal(diagonal, np.zeros_like(diagonal), LAM) + 1e-9
    )


def test_rounding_below_zero_counts_as_no_information():
    assert criteria.block_log_determinant(-np.eye(11)[None], LAM) == 0


def test_angle_spreads_over_a_dome():
    """A pole, four on the horizon, one close by at the same angle as another: distance plays no
    part."""
    taken = np.array([[2.0, 0, 0]])
    candidates = np.array([[0, 0, 9.0], [-0.5, 0, 0], [4, 0.1, 0], [0, 2, 0]]) + CENTRE
    found = pose_policies.smallest_angle(candidates, taken, CENTRE, np.random.default_rng(0))
    assert found == pytest.approx([np.pi / 2, np.pi, np.arctan(0.1 / 4), np.pi / 2], abs=1e-6)
    moved = np.array([3.0, 4.0, 5.0])
    again = pose_policies.smallest_angle(
        candidates + moved, taken + moved, CENTRE + moved, np.random.default_rng(0)
    )
    assert again == pytest.approx(found, abs=1e-6)


def outlook_of(models, H, **given):
    """An context on three candidates, 1, 2 and 3, after one view, 0."""
    nothing = np.zeros((0, 11))
    parts = {
        "positions": CIRCLE[:4], "candidate_frames": [1, 2, 3], "taken_frames": [0], "centre": CENTRE, "rng": np.random.default_rng(0),
        "H": H, "lam": LAM, "points": np.zeros((0, 3)), "surface_H": nothing, "prior_lam": LAM,
        "information": lambda view: models["exact"][view], "surface_information": lambda view: nothing,
        "estimate": lambda view, estimator: models[estimator][view], "seen": lambda view: np.zeros(0), "dome": lambda: None,
        "gains": lambda *_: np.zeros(0),
    }  # fmt: skip
    return policies.PolicyContext(**(parts | given))


def test_what_the_outlook_policies_ask_for():
    """Each by its own estimator for the views taken, too; the pool of `i-optimal` is all poses,
    also those out of reach."""
    rng = np.random.default_rng(0)
    models = {
        name: rng.random((4, N, 11)) * scale
        for name, scale in (("exact", 1), ("loss-gradient", 1e-9))
    }
    J = rng.normal(size=(4, N, 14, 11))
    models["block"] = np.einsum("vnrk,vnrl->vnkl", J, J)
    context = outlook_of(models, models["exact"][0])
    H = models["exact"][0]
    expected = [
        criteria.i_optimal(models["exact"][i], H, LAM, models["exact"].mean(0)) for i in (1, 2, 3)
    ]
    assert policies.policy_named("i-optimal")(context) == pytest.approx(expected)
    assert policies.policy_named("i-optimal")(
        outlook_of(models, H, candidate_frames=[2])
    ) == pytest.approx(expected[1:2])
    taken = criteria.block_log_determinant(models["block"][0], LAM)
    expected = [
        criteria.block_log_determinant(models["block"][0] + models["block"][i], LAM) - taken
        for i in (1, 2, 3)
    ]
    assert policies.policy_named("block-d")(context) == pytest.approx(expected)
    gradients, lam = models["loss-gradient"], np.full(11, 1e-6)
    expected = [criteria.d_optimal(gradients[i], gradients[0], lam) for i in (1, 2, 3)]
    assert policies.policy_named("paper")(context) == pytest.approx(expected)


def test_cover_and_completeness_look_at_what_was_not_observed():
    """Two points of a surface, which count by what a candidate sees of them: the first was observed
    from +X, of the second the view knows less than the prior does."""
    points = np.array([[0.0, 0, 0], [0, 0, 1e-9]])
    positions = np.array([[4.0, 0, 0], [0, 4, 0], [0, -4, 0], [4, 0, 0]])
    enough = LAM[0] / SH_C0**2
    seen = np.array([[10 * enough, 0.5 * enough], [1, 0], [3, 1], [0, 2]])
    surface_H = np.outer(seen[0] * SH_C0**2, np.ones(11))
    context = outlook_of(
        {},
        None,
        positions=positions,
        points=points,
        surface_H=surface_H,
        seen=lambda view: seen[view],
    )
    assert policies.policy_named("cover")(context) == pytest.approx([0.5, (3 * 0.5 + 1) / 4, 1])
    assert policies.policy_named("completeness")(context) == pytest.approx([0, 1, 2])
    positions[1] = 4 * np.array(
        [np.cos(0.5), np.sin(0.5), 0]
    )  # nearer to the first view than to the second
    both = outlook_of(
        {},
        None,
        positions=positions,
        points=points,
        taken_frames=[0, 2],
        candidate_frames=[1],
        seen=lambda view: seen[view],
    )
    assert policies.policy_named("cover")(both) == pytest.approx([(1 - np.cos(0.5)) / 2])
    blind = outlook_of(
        {},
        None,
        positions=positions,
        points=points,
        candidate_frames=[1],
        seen=lambda view: np.zeros(2),
    )
    assert policies.policy_named("cover")(blind) == 0


def test_random_differs_between_rounds_and_repeats_between_runs():
    def draws(seed):
        return [
            int(
                np.argmax(
                    pose_policies.random_order(
                        CIRCLE, CIRCLE[:1], CENTRE, generator(seed, f"random/{k}")
                    )
                )
            )
            for k in range(20)
        ]

    assert draws(7) == draws(7)
    assert draws(7) != draws(8)
    assert len(set(draws(7))) > 5


def test_uniform_leaves_even_gaps_at_every_count():
    taken = [0, 3, 6, 9]
    for largest in (3, 3, 3, 2, 2, 2, 2, 1):
        left = [i for i in range(12) if i not in taken]
        scores = pose_policies.uniform_azimuth(
            CIRCLE[left], CIRCLE[taken], CENTRE, np.random.default_rng(0)
        )
        taken.append(left[int(np.argmax(scores))])
        assert np.diff([*sorted(taken), 12]).max() == largest


def test_farthest_looks_at_height_too():
    poles = np.array([[1.0, 0, 0.5], [0, 0, 9.0], [-1, 0, 0.5]])
    assert (
        np.argmax(pose_policies.farthest_pose(poles, CIRCLE, CENTRE, np.random.default_rng(0))) == 1
    )


def test_seeds_are_evenly_spaced_wherever_the_orbit_starts():
    rock = np.array([3.0, 4.0, 0.0])
    assert pose_policies.seed_views(CIRCLE, CENTRE, 4) == [0, 3, 6, 9]
    assert pose_policies.seed_views(np.roll(CIRCLE, 5, axis=0) + rock, rock, 4) == [5, 8, 11, 2]
    assert sorted(pose_policies.seed_views(CIRCLE, CENTRE, 12)) == list(range(12))


def test_azimuth_is_measured_about_the_rock():
    positions = np.array([[2.0, 1.0, 9.0], [1.0, 2.0, -1.0], [0.0, 1.0, 0.0]])
    assert pose_policies.azimuths(positions, np.array([1.0, 1.0, 0.0])) == pytest.approx(
        [0, np.pi / 2, np.pi]
    )


def test_each_kind_of_parameter_has_one_lambda():
    columns = {
        "colour": slice(0, 3),
        "scale": slice(3, 6),
        "rotation": slice(6, 10),
        "opacity": slice(10, 11),
    }
    lam = criteria.regularisation(
        columns, 0.1, {"colour": 1, "scale": 0.5, "rotation": 0.2, "opacity": 2}
    )
    assert criteria.lam_by_kind(lam, columns) == pytest.approx(
        {"colour": 0.01, "scale": 0.04, "rotation": 0.25, "opacity": 0.0025}
    )
