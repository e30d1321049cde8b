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
"""Adam's epsilon, (pixel value)^2 per unit of the parameter: a gradient of the summed squared error
below it is noise, and a parameter that no image sees stays where the prior put it instead of
walking full steps."""


NATURAL_BETA = 0.9
"""Decay of the average of the gradient of `natural`."""

NATURAL_OVERLAP = 4.0
"""By how much the exact diagonal is raised in `natural`. The diagonal says how an image changes
with one parameter alone, while
a pixel is blended from several splats that move at once: steps of the diagonal's own length would
overshoot. A chosen constant."""

LEAST_INFORMATION = 1e-6
"""Least information that `natural` assumes, (pixel value per unit of the parameter)^2: without a
prior, a parameter that no image sees has none, and one that is hardly seen would be moved by
rounding errors."""

INFORMATION_PASSES = 10
"""Passes from one computation of the information that an optimiser uses to the next; each costs
about as much as a pass."""


@dataclass(frozen=True)
class Optimiser:
    """How one array of parameters is moved.

    buffers: how many arrays of the parameter's shape the optimiser keeps between steps; they start
    at zero. step(value, gradient, information, buffers, rate, t) -> (new value, new buffers), all
    Dr.Jit TensorXf of one shape but rate, a Float, and t, a Float that counts steps from 1. It is
    recorded once and replayed, so it must be made of Dr.Jit operations alone.
    uses_information: whether `information` is given, the largest entry of any one image's diagonal
    of J^T J, with that image's share of lam, measured again every INFORMATION_PASSES passes; it is
    None otherwise.
    """

    buffers: int
    step: Callable[[Any, Any, Any, list[Any], Any, Any], tuple[Any, list[Any]]]
    uses_information: bool = False


def adam(
    value: Any, gradient: Any, information: Any, buffers: list[Any], rate: Any, t: Any
) -> tuple[Any, list[Any]]:
    """Adam (Kingma and Ba 2015) with ADAM_BETAS and ADAM_EPSILON: steps of about the rate, whatever
    the gradient."""
    m, v = buffers
    beta1, beta2 = ADAM_BETAS
    unbias1, unbias2 = 1 - dr.power(mi.Float(beta1), t), 1 - dr.power(mi.Float(beta2), t)
    m, v = dr.lerp(gradient, m, beta1), dr.lerp(dr.square(gradient), v, beta2)
    update = (m.array / unbias1) / (dr.sqrt(v.array / unbias2) + ADAM_EPSILON) * rate
    return mi.TensorXf(value.array - update, value.shape), [m, v]


def natural(
    value: Any, gradient: Any, information: Any, buffers: list[Any], rate: Any, t: Any
) -> tuple[Any, list[Any]]:
    """Natural gradient with the exact diagonal of the Fisher information as its metric (Amari
    1998), momentum, and steps of at most the rate, beyond which images are not linear in the
    parameters. Where information is plenty, steps are short of that and shrink as the gradient
    does; where there is none, the prior's lam keeps them finite.

    A step is made for one image, so its metric is the information of the image that says most about
    the parameter. The mean
    over the images would be too little for a parameter that few of them see: its steps would
    overshoot by their number, and longer fits to many images diverge."""
    m = dr.lerp(gradient, buffers[0], NATURAL_BETA)
    curvature = NATURAL_OVERLAP * dr.maximum(information.array, LEAST_INFORMATION)
    update = dr.clip(m.array / curvature, -rate, rate)
    return mi.TensorXf(value.array - update, value.shape), [m]


OPTIMISERS: dict[str, Optimiser] = {
    "natural": Optimiser(1, natural, uses_information=True),
    "adam": Optimiser(2, adam),
}
"""Optimisers of the fit, by name (`mgs nbv --optimiser`). A program may add its own."""
