"""The picture of the rock alone, from the same rendering as the whole image.

The variant must be set before this module is imported (`mgs.runtime.start`): an integrator is a
class of the variant.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import gaussian_filter, uniform_filter

SHARE_MIN = 1e-6
"""Divisor in place of a smaller share of samples, which can only be 0: a pixel has far fewer than a
million samples."""

CONTINUATION = 4.0
"""Standard deviation, pixels, of the Gaussian weights with which the rock's values are averaged to
continue them beyond its
outline. Measured with 1, 2 and 4: with 4, the denoised outline is nearest to a rendering with many
samples."""

WEIGHT_MIN = 1e-4
"""Divisor in place of a smaller sum of Gaussian weights: far from the rock the continuation fades
to black."""


class RockLayer(mi.SamplingIntegrator):
    """Runs another integrator, and repeats its channels for the rock alone.

    The channels of an image are those of the inner integrator (RGB, then its AOVs); then the same
    again, in which samples whose camera ray meets something else before the rock count as 0; and
    last the share of the samples that count. The inner integrator sees the whole scene, so the rock
    is lit and shaded by all that surrounds it. It gets the same random numbers as without this
    class, so its channels are the same, bit for bit.
    """

    def __init__(self, inner: Any, rock: Any) -> None:
        super().__init__(mi.Properties())
        self.inner, self.rock = inner, mi.ShapePtr(rock)

    def aov_names(self) -> list[str]:
        """Names of the channels that follow the first RGB."""
        names = self.inner.aov_names()
        return [*names, *(f"rock.{name}" for name in ("R", "G", "B", *names)), "rock.share"]

    def sample(
        self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True
    ) -> tuple[Any, Any, list[Any]]:
        """What Mitsuba asks of an integrator: RGB along a camera ray, whether it meets anything,
        and the other channels."""
        on_rock = (
            scene.ray_intersect_preliminary(ray, coherent=True, active=active).shape == self.rock
        )
        rgb, valid, aovs = self.inner.sample(scene, sampler, ray, medium, active)
        return (
            rgb,
            valid,
            [*aovs, *(dr.select(on_rock, value, 0) for value in (*rgb, *aovs, mi.Float(1)))],
        )


def render_layers(
    scene: Any, integrator: RockLayer, spp: int, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Render once: the inner integrator's channels [H,W,C], the same for the rock alone, and the
    share of samples [H,W]."""
    image = np.array(mi.render(scene, integrator=integrator, spp=spp, seed=seed))
    channels = image.shape[-1] // 2
    return image[..., :channels], image[..., channels:-1], image[..., -1]


def with_coverage(values: np.ndarray, share: np.ndarray, coverage: np.ndarray) -> np.ndarray:
    """Channels of the rock alone as if exactly the share `coverage` of the samples had met the
    rock, float32 [H,W,C].

    values [H,W,C] and share [H,W]: as `render_layers` gives them; coverage [H,W]: the share of the
    pixel that the rock covers. Of a few random samples in a pixel at the rock's outline, more or
    fewer may meet the rock than the coverage says. The result
    is without this noise: it is the mean over the samples that did meet the rock, times the
    coverage. Where none of a pixel's samples did, the mean is that of the 3x3 pixels around it.
    """
    own = values / np.maximum(share, SHARE_MIN)[..., None]
    around = (
        uniform_filter(values, (3, 3, 1))
        / np.maximum(uniform_filter(share, 3), SHARE_MIN)[..., None]
    )
    return np.where((share > 0)[..., None], own, around) * coverage[..., None]


def continued(values: np.ndarray, coverage: np.ndarray) -> np.ndarray:
    """The rock's channels in front of a backdrop that continues them beyond its outline, [H,W,C].

    values [H,W,C]: channels of the rock alone; coverage [H,W]. The backdrop is the mean of the
    rock's pixels nearby (see CONTINUATION), so this picture is smooth across the outline. The rock
    in front of black has an edge there, at which a denoiser makes mistakes.
    """
    mean = gaussian_filter(values, (CONTINUATION, CONTINUATION, 0))
    weight = gaussian_filter(coverage, CONTINUATION)[..., None]
    return values + (1 - coverage[..., None]) * mean / np.maximum(weight, WEIGHT_MIN)


def lattice(n: int) -> np.ndarray:
    """n points [n,2], n odd, spread evenly over the unit square (Fibonacci lattice); the middle
    point is in its centre."""
    step = np.arange(n) - n // 2
    return (np.stack([step / n, step * (5**0.5 - 1) / 2], 1) + 0.5) % 1
