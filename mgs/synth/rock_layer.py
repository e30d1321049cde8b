"""The picture of the rock alone, from the same rendering as the whole image. The variant must be
set before this module is imported: an integrator is a class of the variant."""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import gaussian_filter, uniform_filter

SHARE_MIN = 1e-6  # least divisor in place of a share of samples, which is a multiple of 1/spp or 0
# Of 1, 2 and 4, 4 gives the denoised outline nearest to a rendering with many samples.
CONTINUATION = 4.0  # standard deviation that continues the rock beyond its outline, pixels
WEIGHT_MIN = 1e-4  # least divisor in place of a sum of Gaussian weights
GUIDES = 6  # channels of albedo and normal
RAYS = 2**22  # camera rays traced at once: bounds the memory of their channels to some 200 MB


class RockLayer(mi.SamplingIntegrator):
    """Integrator that repeats another one's channels for the rock alone.

    Channels: those of the inner integrator (RGB, then its AOVs); the same again, where samples
    whose camera ray meets something else first count as 0; and the share of the samples that count.
    The inner integrator sees the whole scene and the same random numbers as without this class, so
    its channels are the same bit for bit."""

    def __init__(self, inner: Any, rock: Any) -> None:
        super().__init__(mi.Properties())
        self.inner, self.rock = inner, mi.ShapePtr(rock)

    def aov_names(self) -> list[str]:
        """Names of the channels after the first RGB."""
        names = self.inner.aov_names()
        return [*names, *(f"rock.{name}" for name in ("R", "G", "B", *names)), "rock.share"]

    def sample(
        self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True
    ) -> tuple[Any, Any, list[Any]]:
        """RGB along a camera ray, whether it meets anything, and the other channels."""
        hit = scene.ray_intersect_preliminary(ray, coherent=True, active=active)
        rgb, valid, aovs = self.inner.sample(scene, sampler, ray, medium, active)
        return rgb, valid, [*aovs, *_layer(hit.shape == self.rock, rgb, aovs)]


class Guides(mi.SamplingIntegrator):
    """Integrator of the denoiser's guides: channels of a `RockLayer` whose inner integrator gives
    black, albedo and shading normal.

    The same numbers, to rounding, as with Mitsuba's `aov` integrator inside, with half the rays."""

    def __init__(self, rock: Any) -> None:
        super().__init__(mi.Properties())
        self.rock = mi.ShapePtr(rock)

    def aov_names(self) -> list[str]:
        """Names of the channels after the first RGB."""
        return [f"guide.{k}" for k in range(GUIDES)] + [f"rock.{k}" for k in range(GUIDES + 4)]

    def sample(
        self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True
    ) -> tuple[Any, Any, list[Any]]:
        """Black, whether a camera ray meets anything, and the other channels."""
        hit = scene.ray_intersect(ray, mi.RayFlags.All, coherent=True, active=active)
        valid, black = hit.is_valid(), mi.Color3f(0)
        albedo = dr.select(valid, hit.bsdf(ray).eval_diffuse_reflectance(hit, valid), 0)
        aovs = [*albedo, *dr.select(valid, hit.sh_frame.n, 0)]
        return black, valid, [*aovs, *_layer(valid & (hit.shape == self.rock), black, aovs)]


def _layer(on_rock: Any, rgb: Any, aovs: list[Any]) -> list[Any]:
    """Channels of a sample that count for the rock alone, and their share."""
    return [dr.select(on_rock, value, 0) for value in (*rgb, *aovs, mi.Float(1))]


def render_layers(
    scene: Any, integrator: RockLayer | Guides, spp: int, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Render once: channels of the inner integrator [H,W,C], the same for the rock alone, and the
    share of samples [H,W]."""
    sensor = scene.sensors()[0]
    sampler, (width, height) = sensor.sampler().clone(), sensor.film().size()
    sampler.set_sample_count(spp)
    spp = sampler.sample_count()  # rounded up, where the sampler has a grid
    most = max(RAYS // (width * height), 1)
    each = next(n for n in range(min(spp, most), 0, -1) if spp % n == 0)
    sampler.set_samples_per_wavefront(each)
    sampler.seed(seed, width * height * each)
    image = np.zeros((height, width, 1), np.float32)
    for _ in range(spp // each):
        image = image + _sums(scene, sensor, sampler, integrator, spp, each)
        sampler.advance()
        sampler.schedule_state()
    image /= np.float32(spp)
    channels = image.shape[-1] // 2
    return image[..., :channels], image[..., channels:-1], image[..., -1]


def _sums(
    scene: Any, sensor: Any, sampler: Any, integrator: Any, spp: int, each: int
) -> np.ndarray:
    """Sums of `each` of `spp` samples per pixel, float32 [H,W,C], with `mi.render`'s samples.
    Unlike its film, whose threads add to a pixel in any order, the sums do not depend on
    threads."""
    width, height = sensor.film().size()
    pixel = dr.arange(mi.UInt32, width * height * each) // each
    row = pixel // width
    place = mi.Point2f(pixel - row * width, row) + sampler.next_2d()
    ray, _ = sensor.sample_ray_differential(0, 0, place / mi.Vector2f(width, height), 0.5)
    ray.scale_differential(mi.Float(spp**-0.5))
    rgb, _, aovs = integrator.sample(scene, sampler, ray)
    channels = [*rgb, *aovs]
    dr.eval(channels)  # otherwise each sum below would trace the rays again
    sums = np.broadcast_arrays(*(dr.block_sum(channel, each).numpy() for channel in channels))
    return np.stack(sums, -1).reshape(height, width, -1)


def with_coverage(values: np.ndarray, share: np.ndarray, coverage: np.ndarray) -> np.ndarray:
    """Channels of the rock alone, float32 [H,W,C], as if exactly the share `coverage` of the
    samples had met the rock.

    values [H,W,C], share [H,W]: from `render_layers`; coverage [H,W]: share of the pixel that the
    rock covers. At the outline, few random samples give a noisy share. The result is the mean over
    the samples that met the rock, or over the 3x3 pixels around if none did, times the coverage."""
    own = values / np.maximum(share, SHARE_MIN)[..., None]
    shares = np.maximum(uniform_filter(share, 3), SHARE_MIN)
    around = uniform_filter(values, (3, 3, 1)) / shares[..., None]
    return np.where((share > 0)[..., None], own, around) * coverage[..., None]


def continued(values: np.ndarray, coverage: np.ndarray) -> np.ndarray:
    """The rock's channels in front of a backdrop that continues them beyond its outline, [H,W,C].
    values [H,W,C]: channels of the rock alone; coverage [H,W]. The backdrop is the mean of the rock
    nearby (CONTINUATION). In front of black there would be an edge, at which a denoiser makes
    mistakes."""
    mean = gaussian_filter(values, (CONTINUATION, CONTINUATION, 0))
    weight = gaussian_filter(coverage, CONTINUATION)[..., None]
    return values + (1 - coverage[..., None]) * mean / np.maximum(weight, WEIGHT_MIN)


def lattice(n: int) -> np.ndarray:
    """n points [n,2], n odd, spread over the unit square, one in its centre (Fibonacci)."""
    step = np.arange(n) - n // 2
    return (np.stack([step / n, step * (5**0.5 - 1) / 2], 1) + 0.5) % 1
