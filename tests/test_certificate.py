"""Upper bounds and branch and bound against every set of few candidates, SciPy, and definitions."""

import tracemalloc
import weakref
from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest
from refusals import fails
from scipy.optimize import minimize
from test_directional import squares

from mgs.policy import certificate, criteria, relaxation
from mgs.policy.certificate import added_bound, best_set, least_bound, upper_bound
from mgs.policy.directional import Views, precision
from mgs.policy.relaxation import TOLERANCE
from mgs.run import worth
from mgs.run.settings import Mission

LAM, POSES, POINTS = 0.02**2, 9, 40
KINDS = ["d", "i", "eq7"]
EVERY = [*KINDS, "coverage"]


def case(kind, seed=0, order=None):
    """Relaxation of a random pool, and the gain of a set by the definition of its criterion."""
    rng = np.random.default_rng(seed)
    order = np.arange(POSES) if order is None else order
    points = 0.5 * rng.normal(size=(POINTS, 3))
    shape = POSES + 8, POINTS
    seen = rng.choice([0.0, 1.0], shape) * 10 ** rng.uniform(-4, 0, shape)
    every = Views(rng.normal(size=(POSES + 8, 3)) * 3 + [0, 0, 4], seen.astype(np.float32))
    parts = order, slice(POSES, POSES + 2), slice(POSES + 2, None)
    views, taken, dome = (Views(every.positions[some], every.seen[some]) for some in parts)
    if kind in "di":
        model, around = ((1, 0.3), None) if kind == "d" else ((2, 0.2), dome)
        made = relaxation.directional(points, LAM, *model, taken, views, around)
        each, whole = (squares(points, one, model[0]) for one in (views, dome))
        base = np.diag(precision(*model, LAM)) + squares(points, taken, model[0]).sum(0)

        def value(A):
            if kind == "d":
                return 1.5 * np.linalg.slogdet(A)[1].sum()
            return -np.trace(np.linalg.inv(A) @ whole.sum(0), axis1=1, axis2=2).sum()

        return made, lambda some: value(base + each[list(some)].sum(0)) - value(base)
    F = rng.uniform(0, 3, (POSES, POINTS, 4))[order] * (views.seen > 0)[..., None]
    lam = np.full(4, 1.5)
    H = rng.choice([0.0, 1.0, 2.0], (POINTS, 4))
    if kind == "coverage":
        F, H, lam = F[..., :3], H[:, :3], lam[:3]
        made = relaxation.Coverage(F, H, lam)
        return made, lambda some: criteria.coverage_greedy(F[list(some)].sum(0), H, lam)
    made = relaxation.d_optimal(F, H, lam)
    return made, lambda some: criteria.d_optimal(F[list(some)].sum(0), H, lam)


def test_weights_of_many_candidates_are_moved_into_a_box_in_little_memory():
    rng = np.random.default_rng(0)
    x, (lo, hi) = rng.uniform(0, 1, 4000), np.sort(rng.integers(0, 2, (2, 4000)), axis=0)
    tracemalloc.start()
    for k in (lo.sum(), lo.sum() + 20, hi.sum()):
        moved = certificate._moved(x, lo, hi, k)
        assert moved.sum() == pytest.approx(k)
        assert ((lo <= moved) & (moved <= hi)).all()
        shifts = (moved - x)[(lo < moved) & (moved < hi)]
        assert shifts.size == 0 or np.ptp(shifts) < 1e-12
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4e6


@pytest.mark.parametrize("kind", EVERY)
@pytest.mark.parametrize("k", [1, 2, 4, POSES])
def test_every_set_is_below_the_bound_and_branch_and_bound_finds_the_best(kind, k):
    made, gain = case(kind, k)
    every = {some: gain(some) for some in combinations(range(POSES), k)}
    largest = max(every.values())
    bound = upper_bound(made, k)
    assert bound.value >= largest * (1 - 1e-9)
    assert bound.weights.sum() == pytest.approx(k)
    assert bound.gap <= TOLERANCE
    for some in list(every)[:: max(len(every) // 7, 1)]:
        assert made.gain(some) == pytest.approx(every[some], rel=1e-6, abs=1e-9)
    best = best_set(made, min(every, key=lambda some: every[some]), gap=1e-9)
    assert every[tuple(best.views)] == pytest.approx(largest)
    assert best.bound == pytest.approx(largest, rel=1e-6)


def test_many_cuts_close_the_gap_of_coverage():
    assert upper_bound(case("coverage", 10)[0], 2).gap <= TOLERANCE


@pytest.mark.parametrize("kind", KINDS)
def test_the_bound_is_the_optimum_that_scipy_finds(kind):
    made, _ = case(kind)
    how = {"method": "SLSQP", "jac": True, "options": {"ftol": 1e-12, "maxiter": 200}}
    sum_of_3 = {"type": "eq", "fun": lambda x: x.sum() - 3}
    loss, start = lambda x: [-part for part in made.tangent(x)], np.full(POSES, 3 / POSES)
    found = minimize(loss, start, bounds=[(0, 1)] * POSES, constraints=sum_of_3, **how)
    bound = upper_bound(made, 3, tolerance=1e-7)
    assert bound.value == pytest.approx(-found.fun, rel=1e-5)
    assert bound.stopped == "gap"
    assert 0 <= bound.gap <= 1e-7


@pytest.mark.parametrize("kind", KINDS)
def test_gradient_and_curvature_are_those_of_differences(kind):
    made, _ = case(kind, 3)
    x, d = np.linspace(0.1, 0.9, POSES), np.random.default_rng(1).normal(size=POSES)
    ahead, behind = (made.tangent(x + h * d) for h in (1e-4, -1e-4))
    assert made.tangent(x)[1] @ d == pytest.approx((ahead[0] - behind[0]) / 2e-4, rel=1e-5)
    bend, expected = -made.curvature(x) @ d, (ahead[1] - behind[1]) / 2e-4
    assert bend == pytest.approx(expected, rel=1e-4, abs=1e-6 * abs(bend).max())


def test_many_candidates_take_little_memory(monkeypatch):
    """All products of 500 views for 400 Gaussians at once would take 800 MB; and a criterion goes
    with its arrays as soon as nothing names it."""
    F = np.random.default_rng(0).uniform(0, 3, (500, 400, 1))
    made, x = relaxation.d_optimal(F, F[0], np.ones(1)), np.full(500, 0.1)
    tracemalloc.start()
    sums = made.curvature(x)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 60e6
    monkeypatch.setattr(relaxation, "CURVATURE", 500**2 * 400)
    assert made.curvature(x) == pytest.approx(sums, rel=1e-12)
    assert made.coarse.gain([3]) > 0
    gone = weakref.ref(made)
    del made
    assert gone() is None


@pytest.mark.parametrize("k", [1, 3])
@pytest.mark.parametrize("kind", ["d", "eq7"])
def test_gains_after_any_views_bound_every_set_where_the_criterion_is_submodular(kind, k):
    made, gain = case(kind, k)
    largest = max(gain(some) for some in combinations(range(POSES), k))
    for views in ([], [0], [2, 5, 7]):
        assert added_bound(made, views, k) >= largest * (1 - 1e-9)
    holding = max(gain([*some, 0]) for some in combinations(range(1, 5), k))
    assert added_bound(made, [0], k, np.arange(1, 5)) >= holding * (1 - 1e-9)


def test_the_smaller_bound_counts():
    """The best single view has the largest gain, which the relaxation does not reach."""
    for kind in KINDS:
        made, gain = case(kind)
        largest = max(gain([v]) for v in range(POSES))
        assert least_bound(made, 1) == pytest.approx(largest, rel=1e-6)
        assert upper_bound(made, 1).value > 1.01 * largest
        assert least_bound(made, POSES - 1) == upper_bound(made, POSES - 1).value
    assert added_bound(case("i")[0], [], 2) == np.inf


@pytest.mark.parametrize("kind", EVERY)
def test_duplicates_have_equal_prices_and_reruns_equal_bits(kind):
    order = [0, 1, 2, 3, 3, 5, 6, 7, 8]
    bounds = [upper_bound(case(kind, 5, order)[0], 3) for _ in range(2)]
    assert bounds[0].prices[3] == pytest.approx(bounds[0].prices[4], rel=1e-12)
    for one, other in zip(*bounds, strict=True):
        assert np.array_equal(one, other)


def test_a_duplicate_of_a_view_that_observes_what_it_sees_has_no_price_under_coverage():
    F, lam = np.random.default_rng(1).choice([0.0, 2.0], (POSES, POINTS, 3)), np.ones(3)
    F[4] = F[3]
    before, after = (relaxation.Coverage(F, H, lam) for H in (0 * F[3], F[3]))
    assert upper_bound(after, 3).prices[3] == after.added([])[3] == 0
    assert before.added([])[3] > before.added([4])[3] == 0


def test_a_coarse_start_and_few_steps_change_the_gap_and_never_the_truth(monkeypatch):
    made, gain = case("i", 2)
    largest = max(gain(some) for some in combinations(range(POSES), 3))
    monkeypatch.setattr(relaxation, "COARSE", 4)
    coarse, _ = case("i", 2)
    assert len(coarse.coarse.base) < len(coarse.base) / 2
    assert upper_bound(coarse, 3).value == pytest.approx(upper_bound(made, 3).value, rel=2e-3)
    monkeypatch.setattr(relaxation, "STEPS", 1)
    for kept in (made, case("i", 2)[0]):
        assert upper_bound(kept, 3).value >= largest
    assert upper_bound(made, 3, tolerance=0).stopped == "steps"
    assert upper_bound(made, 3, tolerance=0, seconds=0).stopped == "time"
    assert best_set(made, [0, 1, 2], seconds=0).bound >= largest


def test_bad_input_has_one_line():
    made, _ = case("d")
    for k in (0, POSES + 1):
        fails(f"{k} of {POSES}", upper_bound, made, k)
    F = np.ones((3, 2, 1))
    fails("none of the 3", relaxation.d_optimal, 0 * F, F[0], np.ones(1))
    F[1, 0] = np.nan
    fails(r"candidate 1 .*not finite", relaxation.d_optimal, F, F[0], np.ones(1))


@pytest.mark.parametrize("kind", ["d", "i"])
def test_a_certificate_holds_for_every_set(kind):
    made, gain = case(kind, 4)
    plan = certificate.greedy(made, 1.0, most=3)
    held = certificate.certify(made, plan, kind)
    largest, fewer = (max(gain(some) for some in combinations(range(POSES), k)) for k in (3, 2))
    assert gain(plan) >= held.share * largest * (1 - 1e-6)
    assert held.share >= 0.9
    assert fewer <= held.fewer * gain(plan)
    assert held.of_all == pytest.approx(gain(plan) / gain(range(POSES)))


@pytest.mark.parametrize("kind", KINDS)
def test_greedy_takes_as_many_views_as_a_share_of_all_needs(kind):
    made, gain = case(kind, 6)
    views, every = certificate.greedy(made, 0.8), gain(range(POSES))
    assert gain(views) >= 0.8 * every > gain(views[:-1])
    assert len(set(views)) == len(views)
    for k in range(len(views)):
        best = max(gain([*views[:k], v]) for v in range(POSES) if v not in views[:k])
        assert gain(views[: k + 1]) == pytest.approx(best)
    assert sorted(certificate.greedy(made, 1.0)) == list(range(POSES))


def test_a_plan_that_adds_nothing_has_no_certificate():
    """Two views together observe what neither does, of which coverage counts nothing."""
    made = relaxation.Coverage(np.full((4, 6, 3), 0.4), np.zeros((6, 3)), np.ones(3))
    policy = SimpleNamespace(name="coverage", relaxation=lambda *_: made)
    scene, views = SimpleNamespace(cache={}), [0, 1, 2, 3]
    assert made.gain(views) > made.gain([0, 1]) == 0
    assert worth.certificate(scene, None, policy, Mission(), [0, 1], views) is None
