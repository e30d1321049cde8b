"""Arithmetic that the kernels do themselves."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mgs.splat.walking import exp2


@pytest.mark.parametrize(("real", "bound"), [("Float", 1e-7), ("Float64", 3e-9)])
def test_exp2_is_as_exact_as_it_says(real, bound):
    real = getattr(mi, real)
    x = np.concatenate([np.random.default_rng(0).uniform(-120, 120, 100_000), np.arange(-119.5, 120, 0.5)])
    x = np.asarray(real(x), np.float64)
    error = np.asarray(exp2(real(x)), np.float64) / np.exp2(x) - 1
    assert np.abs(error).max() < bound
    assert np.asarray(exp2(real(0.0)))[0] == 1


@pytest.mark.parametrize("real", ["Float", "Float64"])
def test_exp2_far_below_is_nothing(real):
    """Pixels far from a splat: exponents of any size, down to -inf, give what no threshold of alpha lets through."""
    real = getattr(mi, real)
    values = np.asarray(exp2(real([-120.5, -127, -150, -1100, -1e10, -3e38, -np.inf])))
    assert (values > 0).all()
    assert (values < 1e-35).all()
    assert dr.all(exp2(real(np.nan)) < 1e-35), "NaN draws nothing"
