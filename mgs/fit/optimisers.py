"""Optimisers of a fit, by name."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

ADAM_BETAS = (0.9, 0.999)  # decay of Adam's averages of gradient and square (Kingma and Ba 2015)
# Adam's epsilon, (pixel value)^2 per unit of the parameter. Gradients of the summed squared error
# below it are noise, so parameters that no image sees stay where the prior put them.
ADAM_EPSILON = 1e-3
NATURAL_BETA = 0.9  # decay of the gradient's average in `natural`
# Factor on the exact diagonal in `natural`. The diagonal is for one parameter alone, but the
# several splats of a pixel move together: without the factor, steps overshoot. A chosen constant.
NATURAL_OVERLAP = 4.0
# Lower bound of the information in `natural`, (pixel value per unit of the parameter)^2. Without a
# prior, parameters that are hardly seen would otherwise be moved by rounding errors.
LEAST_INFORMATION = 1e-6
INFORMATION_PASSES = 10  # between two computations of an optimiser's information; each costs a pass


@dataclass(frozen=True)
class Optimiser:
    """An update rule for one array of parameters.

    buffers: number of arrays of the parameter's shape kept between steps, zero at first.
    step(value, gradient, information, buffers, rate, t) -> (new value, new buffers). All are Dr.Jit
        TensorXf of one shape, but rate (Float) and t (Float, step number from 1). It is recorded
        once and replayed, so it must consist of Dr.Jit operations.
    uses_information: whether `information` is given: `Objective.largest_diagonal`, measured every
        INFORMATION_PASSES passes. Otherwise it is None.
    """

    buffers: int
    step: Callable[[Any, Any, Any, list[Any], Any, Any], tuple[Any, list[Any]]]
    uses_information: bool = False


def adam(
    value: Any, gradient: Any, information: Any, buffers: list[Any], rate: Any, t: Any
) -> tuple[Any, list[Any]]:
    """Adam (Kingma and Ba 2015) with ADAM_BETAS and ADAM_EPSILON."""
    m, v = buffers
    beta1, beta2 = ADAM_BETAS
    unbias1, unbias2 = 1 - dr.power(mi.Float(beta1), t), 1 - dr.power(mi.Float(beta2), t)
    m, v = dr.lerp(gradient, m, beta1), dr.lerp(dr.square(gradient), v, beta2)
    update = (m.array / unbias1) / (dr.sqrt(v.array / unbias2) + ADAM_EPSILON) * rate
    return mi.TensorXf(value.array - update, value.shape), [m, v]


def natural(
    value: Any, gradient: Any, information: Any, buffers: list[Any], rate: Any, t: Any
) -> tuple[Any, list[Any]]:
    """Natural gradient (Amari 1998) with momentum; its metric is the exact diagonal of the Fisher
    information.

    Steps are at most as long as the rate, beyond which images are not linear in the parameters.

    A step is for one image, so the metric is the information of the image that says most about the
    parameter. With the mean over the images, parameters that few images see would overshoot.
    """
    m = dr.lerp(gradient, buffers[0], NATURAL_BETA)
    curvature = NATURAL_OVERLAP * dr.maximum(information.array, LEAST_INFORMATION)
    update = dr.clip(m.array / curvature, -rate, rate)
    return mi.TensorXf(value.array - update, value.shape), [m]


# By name (setting `train.optimiser`). A program may add its own.
OPTIMISERS: dict[str, Optimiser] = {
    "natural": Optimiser(1, natural, uses_information=True),
    "adam": Optimiser(2, adam),
}
