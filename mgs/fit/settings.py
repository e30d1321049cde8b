"""Settings of a fit, validated and frozen. Imports neither Mitsuba nor Dr.Jit."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, field_validator

from mgs.policy.criteria import PIXEL_NOISE, PRIOR_STD, lam_by_kind, regularisation

# Learning rates of the optimiser, about the longest step, in the unit of each kind of parameter:
# colour coefficient, log-scale, quaternion, opacity logit. Chosen constants (docs/fit.md).
RATES = {"colour": 0.02, "scale": 0.04, "rotation": 0.02, "opacity": 0.1}
# Learning rate of means as a multiple of the spacing of the prior's samples. Larger steps push more
# Gaussians behind others, where no image sees them. A chosen constant.
MEAN_RATE = 0.02
# Most passes of the first fit of a run, and of the later ones, which start from a model that was
# fitted to all images but the new. More passes overfit. Chosen constants (docs/speed-accuracy.md).
PASSES, WARM_PASSES = 10, 5
WARM_RATE = 0.7  # they start near their end: full rates lead away from it (the same page)
# Default of `TrainSettings.alpha_weight` in a run whose frames all have a mask or alpha. A chosen
# constant (docs/fit.md, An opaque surface).
ALPHA_WEIGHT = 0.1

MOST_OF_FIT, MOST_PASSES = 2**25, 10**6  # Gaussians and passes of a fit

Positive = Annotated[float, Field(gt=0, le=1e9, allow_inf_nan=False)]
# A number that others are divided by, bounded so that the results neither overflow nor vanish.
Scale = Annotated[float, Field(ge=1e-6, le=1e6, allow_inf_nan=False)]


def complete(given: Any, defaults: Mapping[str, float]) -> Any:
    """A number for each kind of parameter: the given one, or the default. "mean" may be given too.
    It has no default, because its unit is the metre and scenes differ in size."""
    if not isinstance(given, Mapping) or not given.keys() <= {*defaults, "mean"}:
        raise ValueError(
            f"must be a number for each of {', '.join(defaults)}; "
            "for mean, too, where means are learned"
        )
    return {**defaults, **given}


class Frozen(BaseModel):
    """Settings whose docstrings are their help."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)


class TrainSettings(Frozen):
    """Settings of `mgs.fit.fitting.fit_gaussians`."""

    means: Literal["frozen", "free"] = "frozen"
    """Whether means are frozen, as in the paper, or free."""
    density: str = "fixed"
    """Density control of free means: fixed, split (divide the Gaussians that images pull at most),
    or adaptive (add and remove as 3DGS)."""
    most_gaussians: Annotated[int, Field(ge=1, le=MOST_OF_FIT)] = 200_000
    """Number of Gaussians beyond which a density control adds none."""
    loss: str = "l1-dssim"
    """Loss: l1-dssim (0.8 L1 + 0.2 D-SSIM of sRGB values, as 3DGS), or squared (difference of the
    values as the model blends them)."""
    optimiser: str = "natural"
    """Optimiser of the fit: natural (gradient divided by Fisher information) or adam."""
    passes: Annotated[int, Field(ge=1, le=MOST_PASSES)] = PASSES
    """Most passes over the images in a fit."""
    tolerance: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.01
    """The fit has settled when two passes in a row lower the loss by less than this share."""
    rates: dict[str, Annotated[float, Field(ge=0, le=1e6)]] = RATES
    """Learning rate by kind of parameter, 0: not learned; `mean`, in metres, only if means move."""
    antialiased: bool = True
    """Make Gaussians that are smaller than a pixel fainter, so that near and far views agree. 3DGS
    and the paper do not."""
    space: Literal["linear", "srgb"] = "srgb"
    """Space in which colours are blended: linear, as light adds; srgb, as in 3DGS and viewers."""
    alpha_weight: Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False)] = 0.0
    """Weight of alpha as a fourth channel in the loss, (sigma_rgb / sigma_alpha)^2; 0: not used.
    Default of a run: 0.1 where all frames have a mask or alpha, else 0."""
    decay: Positive = 0.1
    """Factor by which the rates fall over `passes`."""
    steady_rates: tuple[str, ...] = ()
    """Kinds of parameters whose rates do not fall."""
    sh_steps: Annotated[int, Field(ge=0)] = 0
    """Steps after which colours learn one more SH degree; 0: they learn all from the start."""
    directional_rate: Annotated[float, Field(ge=0, le=1)] = 1.0
    """Rate of colours of SH degree 1 and more, over that of degree 0."""
    seed: Annotated[int, Field(ge=0)] = 0
    """Seed of the order of images in each pass."""

    _every_kind = field_validator("rates", mode="before")(lambda given: complete(given, RATES))


class PoseNoise(Frozen):
    """Standard deviation of the error of poses that are refined."""

    degrees: Positive = 0.25
    """Standard deviation of poses that are refined: of the turn about each axis, degrees."""
    distance: Positive = 0.0025
    """The same of the position along each axis, as a share of the distance to the object."""


class ModelSettings(Frozen):
    """How a model is fitted to the views taken, and how its information is measured."""

    seed: Annotated[int, Field(ge=0)] = 0
    """Seed of all random draws."""
    estimator: str = "exact"
    """Estimator of the Fisher information: exact, or loss-gradient (the paper's)."""
    lam: Annotated[float, Field(ge=1e-30, le=1e30, allow_inf_nan=False)] | None = None
    """One lambda for all parameters, as in the paper. Default: (pixel noise / prior std)^2."""
    pixel_noise: Scale = PIXEL_NOISE
    """Standard deviation of a pixel value's residual; sets lambda, the regularisation."""
    prior_std: dict[str, Scale] = PRIOR_STD
    """Prior standard deviation by kind of parameter; `mean`, in metres, only if means move."""
    warm_passes: Annotated[int, Field(ge=1, le=MOST_PASSES)] = WARM_PASSES
    """Most passes of each fit after the first; never more than `passes`."""
    warm_rate: Positive = WARM_RATE
    """Factor on the learning rates of the fits after the first."""
    exposure: bool = False
    """Estimate a gain per image and channel, for images of unequal exposure or white balance."""
    sh: Annotated[int, Field(ge=0, le=3)] = 0
    """Degree of the spherical harmonics of colour: 0 (the same from all directions) to 3."""
    train: TrainSettings = TrainSettings()
    """Settings of each fit."""

    _every_kind = field_validator("prior_std", mode="before")(
        lambda given: complete(given, PRIOR_STD)
    )

    def train_at(self, step: int) -> TrainSettings:
        """Settings of the fit of a step: `train` for step 0, with the warm values afterwards."""
        if step == 0:
            return self.train
        rates = {kind: self.warm_rate * rate for kind, rate in self.train.rates.items()}
        passes = min(self.warm_passes, self.train.passes)
        return self.train.model_copy(update={"rates": rates, "passes": passes})

    def regularisation(
        self, groups: dict[str, slice], surface: bool = False
    ) -> NDArray[np.float64]:
        """lambda [P] of the columns of the Fisher information; groups: columns by kind. surface: of
        the Gaussians on the surface before training, which the setting `lam` does not concern.
        Raises InputError as `criteria.regularisation`."""
        by_kind = regularisation(groups, self.pixel_noise, self.prior_std)
        return by_kind if surface or self.lam is None else np.full_like(by_kind, self.lam)

    def lam_by_kind(self, groups: dict[str, slice]) -> dict[str, Any]:
        """lambda as `mgs.fit.fitting.fit_gaussians` takes it (`criteria.lam_by_kind`)."""
        return lam_by_kind(self.regularisation(groups), groups)


def as_3dgs(extent: float) -> dict[str, Any]:
    """Values of `TrainSettings` as in Kerbl et al. 2023, for any number of passes. extent: of the
    scene, metres (`mgs.camera.extent_of`)."""
    steady = {"colour": 2.5e-3, "scale": 5e-3, "rotation": 1e-3, "opacity": 5e-2}
    return {
        "means": "free",
        "density": "adaptive",
        "loss": "l1-dssim",
        "optimiser": "adam",
        "rates": steady | {"mean": 1.6e-4 * extent},
        "steady_rates": tuple(steady),
        "decay": 0.01,
        "tolerance": 0.0,
        "sh_steps": 1000,
        "directional_rate": 1 / 20,
        "antialiased": False,
        "alpha_weight": 0.0,
    }
