"""Statistics over rocks, against known answers and brute force."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mgs.study.statistics import MOST_ROCKS, area, holm, images_to_reach, interval, permutation_p

numbers = st.floats(-10, 10, allow_nan=False).map(lambda x: round(x, 3))


def test_the_area_is_the_mean_of_a_straight_line_and_weighs_gaps():
    assert area([4, 5, 6], [20, 21, 22]) == pytest.approx(21)
    assert area([4, 12], [10, 30]) == pytest.approx(20)
    assert area([4, 5, 12], [0, 8, 8]) == pytest.approx((4 + 56) / 8)
    assert area([4], [7.5]) == 7.5


def test_the_interval_is_that_of_students_t():
    low, high = interval([1.0, 2.0, 3.0, 4.0, 5.0])
    half = 2.7764451 * np.sqrt(2.5 / 5)  # t of 4 degrees of freedom at 97.5 %
    assert (low, high) == pytest.approx((3 - half, 3 + half))
    assert interval([1.0]) is None


@pytest.mark.parametrize(
    ("differences", "p"),
    [
        ([1.0, 2.0, 3.0], 2 / 8),  # only all as they are, or all flipped, are as far from 0
        ([0.1] * 12, 2 / 4096),
        ([1.0, -1.0], 1.0),
        ([0.0, 0.0, 0.0], 1.0),
        ([3.0, -1.0], 1.0),
        ([-5.0, -4.0, 1.0], 4 / 8),
    ],
)
def test_permutation_p_of_known_cases(differences, p):
    assert permutation_p(differences) == pytest.approx(p)


@given(st.lists(numbers, min_size=2, max_size=7))
def test_permutation_p_is_the_share_of_sign_flips(differences):
    observed = abs(sum(differences))
    flips = [
        abs(sum(s * d for s, d in zip(signs, differences, strict=True)))
        for signs in product((1, -1), repeat=len(differences))
    ]
    expected = np.mean([flip >= observed - 1e-9 for flip in flips])
    assert permutation_p(differences) == pytest.approx(expected)


def test_without_replication_there_is_no_claim_and_too_many_rocks_are_refused():
    assert permutation_p([3.0]) is None
    with pytest.raises(ValueError, match="at most"):
        permutation_p([1.0] * (MOST_ROCKS + 1))


def test_holm_of_a_known_case():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.4, 0.9]) == pytest.approx([0.8, 0.9])
    assert holm([]) == []


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


def test_a_level_is_reached_between_two_points_or_never():
    assert images_to_reach([4, 5, 7], [20, 21, 23], 22) == pytest.approx(6)
    assert images_to_reach([4, 5, 7], [20, 21, 23], 20) == 4
    assert images_to_reach([4, 5, 7], [20, 19, 23], 19.5) == 4
    assert images_to_reach([4, 5, 7], [20, 21, 23], 23.1) is None
