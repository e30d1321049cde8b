"""Optimisers of the fit, each a row of a table: how one parameter moves, given its gradient."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

ADAM_BETAS = (0.9, 0.999)
"""Decay of Adam's averages of the gradient and of its square (Kingma and Ba 2015)."""

ADAM_EPSILON = 1e-3
"""Adam's epsilon, (pixel value)^2 per unit of the parameter: a gradient of the summed squared error below it is noise, and a
parameter that no image sees stays where the prior put it instead of walking full steps."""


@dataclass(frozen=True)
class Optimiser:
    """How one array of parameters is moved.

    buffers: how many arrays of the parameter's shape the optimiser keeps between steps; they start at zero.
    step(value, gradient, buffers, rate, t) -> (new value, new buffers), all Dr.Jit TensorXf of one shape but rate, a Float, and
    t, a Float that counts steps from 1. It is recorded once and replayed, so it must be made of Dr.Jit operations alone.
    """

    buffers: int
    step: Callable[[Any, Any, list[Any], Any, Any], tuple[Any, list[Any]]]


def adam(value: Any, gradient: Any, buffers: list[Any], rate: Any, t: Any) -> tuple[Any, list[Any]]:
    """Adam (Kingma and Ba 2015) with ADAM_BETAS and ADAM_EPSILON."""
    m, v = buffers
    beta1, beta2 = ADAM_BETAS
    unbias1, unbias2 = 1 - dr.power(mi.Float(beta1), t), 1 - dr.power(mi.Float(beta2), t)
    m, v = dr.lerp(gradient, m, beta1), dr.lerp(dr.square(gradient), v, beta2)
    update = (m.array / unbias1) / (dr.sqrt(v.array / unbias2) + ADAM_EPSILON) * rate
    return mi.TensorXf(value.array - update, value.shape), [m, v]


OPTIMISERS: dict[str, Optimiser] = {"adam": Optimiser(2, adam)}
"""Optimisers of the fit, by name (`mgs nbv --optimiser`). A program may add its own."""
