"""Statistics of studies, against known answers and brute force; tables and plots."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from studies.frame.output import grouped, scene_mean, table, with_interval
from studies.frame.statistics import MOST_ROCKS, holm, interval, pareto_front, permutation_p

numbers = st.floats(-10, 10, allow_nan=False).map(lambda x: round(x, 3))


def test_the_interval_is_that_of_students_t():
    low, high = interval([1.0, 2.0, 3.0, 4.0, 5.0])
    half = 2.7764451 * np.sqrt(2.5 / 5)  # t of 4 degrees of freedom at 97.5 %
    assert (low, high) == pytest.approx((3 - half, 3 + half))
    assert interval([1.0]) is None


@given(st.lists(numbers, min_size=2, max_size=7))
def test_permutation_p_is_the_share_of_sign_flips(differences):
    observed = abs(sum(differences))
    signs = np.array(list(product((1, -1), repeat=len(differences))))
    expected = np.mean(np.abs(signs @ differences) >= observed - 1e-9)
    assert permutation_p(differences) == pytest.approx(expected)


def test_without_replication_there_is_no_claim_and_too_many_rocks_are_refused():
    assert permutation_p([3.0]) is None
    assert permutation_p([0.1] * 12) == pytest.approx(2 / 4096)
    with pytest.raises(ValueError, match="at most"):
        permutation_p([1.0] * (MOST_ROCKS + 1))


@given(st.lists(st.floats(0, 1), min_size=1, max_size=8), st.floats(0.001, 0.5))
def test_holm_rejects_as_the_step_down_procedure_does(p_values, alpha):
    rejected, order = set(), sorted(range(len(p_values)), key=lambda k: p_values[k])
    for rank, k in enumerate(order):
        if min(1.0, (len(p_values) - rank) * p_values[k]) > alpha:
            break
        rejected.add(k)
    adjusted = holm(p_values)
    assert {k for k, p in enumerate(adjusted) if p <= alpha} == rejected
    assert all(a >= p for a, p in zip(adjusted, p_values, strict=True))


@given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), min_size=1, max_size=12))
def test_a_point_is_on_the_front_unless_another_beats_it(points):
    costs, gains = zip(*points, strict=True)
    on = pareto_front(costs, gains)
    for i, (cost, gain) in enumerate(points):
        beaten = any(c <= cost and g >= gain and (c, g) != (cost, gain) for c, g in points)
        assert on[i] != beaten
    assert pareto_front([1, np.nan, 2], [1, 5, 2]).tolist() == [True, False, True]


def test_columns_are_formats_or_functions_and_missing_values_are_dashes():
    columns = {"name": "name", "dB": "psnr:.2f", "twice": lambda row: str(2 * row["n"])}
    text = table(columns, [{"name": "a", "psnr": 1.239, "n": 2}, {"name": "b", "n": 1}])
    assert text.splitlines()[2:] == ["| a | 1.24 | 4 |", "| b | – | 2 |"]
    assert with_interval({"d": 1.0, "d_low": 0.5, "d_high": 1.5}, "d") == "+1.00 [+0.50, +1.50]"
    assert with_interval({"d": 1.0, "d_low": None}, "d") == "+1.00"
    assert with_interval({}, "d") == "–"


def test_means_are_over_scenes():
    rows = [{"scene": s, "k": k, "x": x} for s, k, x in (("a", 1, 2), ("a", 1, 4), ("b", 1, 5))]
    (group,) = grouped(rows, "k")
    assert scene_mean("x", ".1f", ends=False)(group) == "4.0"  # 3 and 5
    assert scene_mean("x", ".1f")(group).startswith("4.0 [-8.7, 16.7")
    assert scene_mean("x", ".1f")({"of": [*rows, {"scene": "c", "x": None}]}) == "–"
