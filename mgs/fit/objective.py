"""Objective of a fit (docs/fit.md, One objective), its gradient, and the diagonal of its curvature
J^T J + lam, with the Jacobian J of all images; the two are of squared differences under any loss.

    Phi = 1/2 sum over images, pixels and channels of (rendered - target)^2
        + 1/2 sum over parameters of lam (theta - start)^2,   lam = (sigma / tau)^2

Alpha may be a fourth channel, whose squared differences count (sigma / sigma_alpha)^2 times.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mgs import runtime
from mgs.camera import Camera
from mgs.colour import linear_from_pixels, srgb_from_linear
from mgs.errors import InputError
from mgs.fit.losses import Size, loss_named
from mgs.gaussians import Gaussians, learned
from mgs.memory import IMAGE_BYTES, Deferred, adopted, kept_within, padded
from mgs.splat import ListCache, as_drjit, fisher, groups
from mgs.splat.blocks import BlockLists
from mgs.splat.projection import camera_array, project, projected
from mgs.splat.recording import frozen, one_at_a_time
from mgs.splat.rendering import composite_channels, splats_and_lists

LEVELS = 256  # values of a pixel of 8 bits
Vector = list[Any]  # of each array of `mgs.gaussians.learned`, a TensorXf of its shape


@dataclass
class Target:
    """Target of a fit as the kernels take it."""

    values: Any  # mi.Float [H*W*S], channels as in `mgs.fit.fitting.fit_gaussians`; of 8 bits UInt8
    alpha_factor: Any  # of the differences in alpha, mi.Float [1]; None: not compared
    stored: int  # S, 3 to 5
    levels: Any = None  # what 8 bits stand for, mi.Float (`_levels`)

    @property
    def channels(self) -> int:
        """Number C of channels that are compared: three colours, and alpha."""
        return 3 if self.alpha_factor is None else 4

    @property
    def recorded(self) -> tuple[int, ...]:
        """Number of channels, and whether they are floats: constants of a recording."""
        return self.stored, self.levels is None

    def __len__(self) -> int:
        """H*W*C, the number of values that are compared."""
        return len(self.values) // self.stored * self.channels

    @property
    def nbytes(self) -> int:
        """Memory held, bytes."""
        return len(self.values) * (4 if self.levels is None else 1)

    @property
    def pixels(self) -> Any:
        """Values that are compared, mi.Float [H*W*C]."""
        pixel, channel = self._places()
        return self._at(pixel, dr.select(channel == 3, 4, channel))

    @property
    def weights(self) -> Any:
        """Factors of the differences to `pixels`, mi.Float [H*W*C]."""
        if self.stored == 3:
            return dr.full(mi.Float, 1, len(self))
        pixel, channel = self._places()
        weight = self._at(pixel, mi.UInt32(3))
        if self.alpha_factor is None:
            return weight
        return weight * dr.select(channel == 3, self.alpha_factor, 1)

    def _places(self) -> tuple[Any, Any]:
        """Pixel and channel of each value that is compared, mi.UInt32 [H*W*C]."""
        index = dr.arange(mi.UInt32, len(self))
        return index // self.channels, index % self.channels

    def _at(self, pixel: Any, channel: Any) -> Any:
        """Values of channels of pixels, mi.Float."""
        value = dr.gather(type(self.values), self.values, pixel * self.stored + channel)
        if self.levels is None:
            return value
        row = mi.UInt32(LEVELS - 1)
        if self.stored == 5:
            row = mi.UInt32(dr.gather(mi.UInt8, self.values, pixel * 5 + 4))
        row = dr.select(channel < 3, row, LEVELS)
        return dr.gather(mi.Float, self.levels, mi.UInt32(value) + row * LEVELS)


@dataclass(frozen=True)
class Photo:
    """An image to fit to: its camera, as an object and for the kernels (`array`), and target."""

    camera: Camera
    array: Any
    target: Target

    @property
    def size(self) -> Size:
        """Width, height and number of channels."""
        return self.camera.width, self.camera.height, self.target.channels


@dataclass
class View:
    """A `Photo` as recorded functions take it, with the block lists and packed splats of a
    model."""

    camera: Any
    target: Target
    size: Size
    lists: BlockLists
    packed: Any

    @property
    def recorded_sizes(self) -> tuple[int, ...]:
        """Sizes that a recording holds as constants (`mgs.splat.recording.frozen`)."""
        return len(self.lists.splat), len(self.lists.block), *self.size, *self.target.recorded

    def rendered(self, model: Gaussians, shift: Sequence[Any] = ()) -> Any:
        """Pixels of a model, TensorXf [H,W,C], differentiable. shift: x and y [N] of zeros, px, to
        differentiate by the splats' centres."""
        splats = project(model, self.camera)
        if shift:
            x, y = splats.mean_x + shift[0], splats.mean_y + shift[1]
            splats = replace(splats, mean_x=x, mean_y=y)
        return composite_channels(splats, self.packed, self.lists, *self.size)

    def slopes(self, shift: Sequence[Any]) -> list[Any]:
        """For each Gaussian, the norm of the derivative of the image's mean loss by its centre, in
        units of half the width and height, and 1 if it is drawn, else 0; Float [N] each. shift: as
        in `rendered`, with the gradient of half the summed loss."""
        width, height, _ = self.size
        along_x, along_y = (
            dr.grad(s) * (size / len(self.target))
            for s, size in zip(shift, (width, height), strict=True)
        )
        pairs = dr.gather(mi.UInt32, self.lists.slot_end - self.lists.slot_start, self.lists.place)
        norm = dr.sqrt(dr.square(along_x) + dr.square(along_y))
        return [norm, dr.select(pairs > 0, mi.Float(1), 0)]


@dataclass
class ParameterPrior:
    """Normal distribution of the learned parameters around their start."""

    start: Gaussians
    lam: dict[str, Any]  # of each learned array, a Float of one number or one per parameter
    share: Any  # 1 / number of images, Float: the part that belongs to one image

    @property
    def means(self) -> str:
        """A name in `mgs.splat.MEANS`."""
        return "free" if "means" in self.lam else "frozen"


@dataclass(frozen=True)
class Objective:
    """Phi for some images (see the module). Models are Gaussians with TensorXf fields."""

    photos: Sequence[Photo]  # beyond IMAGE_BYTES, made from their targets at every use
    prior: ParameterPrior
    cache: ListCache
    alpha_weight: float = 0.0
    error: str = "squared"  # as of `loss_named`

    def loss(self, model: Gaussians) -> float:
        """Mean over the images of their mean loss plus the prior's part; 2 Phi over the number of
        pixel values where all are of one size."""
        return float(np.mean([loss for loss, _ in self._losses(model)]))

    def phi(self, model: Gaussians) -> float:
        """Phi, squared pixel values."""
        return 0.5 * sum(loss * size for loss, size in self._losses(model))

    def _losses(self, model: Gaussians) -> list[tuple[float, int]]:
        """Mean loss of each image plus the prior's part, and its number of values."""
        penalty = sum(
            weighted_squares(lam * self.prior.share, d.array) for d, lam in self.offsets(model)
        )
        errors = []
        for photo in self.photos:
            image, target = _rendered(model, photo, self.cache), photo.target
            values = _errors(self.error, image, target, photo.size, model.linear)
            errors.append((dr.mean(values) + penalty / len(target), len(target)))
            dr.eval(errors[-1])  # frees the rendered image
        return [(float(error[0]), size) for error, size in errors]

    def gradient(self, model: Gaussians) -> Vector:
        """Derivative of Phi by the learned parameters."""
        prior_part = [mi.TensorXf(lam * d.array, d.shape) for d, lam in self.offsets(model)]
        return self._summed(
            prior_part, lambda photo: _image_gradient(model, self.prior, self.view(model, photo))
        )

    def diagonal(self, model: Gaussians) -> Vector:
        """Diagonal of J^T J + lam, with pixel weights of 1."""
        return self._summed(
            [
                mi.TensorXf(lam + dr.zeros(mi.Float, d.array.shape[0]), d.shape)
                for d, lam in self.offsets(model)
            ],
            lambda photo: self._information(model, photo),
        )

    def _summed(self, total: Vector, of_photo: Callable[[Photo], Vector]) -> Vector:
        for photo in self.photos:
            total = [a + b for a, b in zip(total, of_photo(photo), strict=True)]
            dr.eval(total)
        return total

    def largest_diagonal(self, model: Gaussians) -> Vector:
        """Largest diagonal of J^T J of any one image, per parameter, plus that image's share of
        lam. It bounds a step on one image."""
        offsets = self.offsets(model)
        largest = [dr.zeros(mi.TensorXf, d.shape) for d, _ in offsets]
        for photo in self.photos:
            diagonal = self._information(model, photo)
            largest = [
                mi.TensorXf(dr.maximum(a.array, b.array), a.shape)
                for a, b in zip(largest, diagonal, strict=True)
            ]
            dr.eval(largest)
        return [
            mi.TensorXf(a.array + lam * self.prior.share, a.shape)
            for a, (_, lam) in zip(largest, offsets, strict=True)
        ]

    def _information(self, model: Gaussians, photo: Photo) -> Vector:
        means, weight = self.prior.means, self.alpha_weight
        F = fisher(model, photo.camera, cache=self.cache, means=means, alpha_weight=weight)
        columns = zip(self.offsets(model), groups(model.sh_degree, means).values(), strict=True)
        return [mi.TensorXf(padded(F[:, c]).reshape(d.shape)) for (d, _), c in columns]

    def view(self, model: Gaussians, photo: Photo) -> View:
        """A photo with the block lists of a model. Raises InputError as `ListCache.get`."""
        lists, packed = self.cache.get(photo.camera, projected(model, photo.array))
        return View(photo.array, photo.target, photo.size, lists, packed)

    def offsets(self, model: Gaussians) -> list[tuple[Any, Any]]:
        """(offset from the start, lam) of each learned array."""
        prior = self.prior
        return [
            (getattr(model, name) - getattr(prior.start, name), lam)
            for name, lam in prior.lam.items()
        ]


def objective(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    targets: Sequence[np.ndarray | Target],
    start: Gaussians | None = None,
    lam: Mapping[str, float | np.ndarray] | None = None,
    cache: ListCache | None = None,
    means: str = "frozen",
    alpha_weight: float = 0.0,
    error: str = "squared",
) -> Objective:
    """The objective of `mgs.fit.fitting.fit_gaussians`, from the same arguments and settings.
    error: as of `loss_named`. Raises InputError if it is unknown, there is no camera, the start
    does not fit the Gaussians, or `means` is not a name in `mgs.splat.MEANS`. A target without
    alpha, where alpha has a weight, raises it when it is read."""
    groups(gaussians.sh_degree, means)  # raises if the name is unknown
    loss_named(error)
    if len(cameras) != len(targets) or not cameras:
        what = f"there are {len(cameras)} cameras and {len(targets)} targets"
        raise InputError(f"fit: {what}; give one target for each camera, and at least one")

    def photo(i: int) -> Photo:
        return _photo(gaussians, cameras[i], targets[i], alpha_weight)

    kept = kept_within(IMAGE_BYTES, photo, lambda p: p.target.nbytes)
    photos = Deferred(range(len(cameras)), kept)
    start = gaussians if start is None else start
    if start.sh.shape != gaussians.sh.shape:
        raise InputError(
            f"start: has colours of shape {start.sh.shape}, the Gaussians {gaussians.sh.shape}"
        )
    # A copy, because Dr.Jit uses NumPy's memory in place. If parameters and start shared memory
    # when a step is recorded, its replays would take them for the same array (Dr.Jit 1.5).
    start = as_drjit(start.map(lambda array: np.array(array, np.float32)))
    values = {
        name: filled((lam or {}).get(kind, 0.0), getattr(start, name).shape)
        for name, kind in learned(means).items()
    }
    share = dr.opaque(mi.Float, 1 / max(len(photos), 1))
    prior = ParameterPrior(start, values, share)
    return Objective(photos, prior, cache or ListCache(), alpha_weight, error)


def weighted_squares(lam: Any, offsets: Any) -> Any:
    """Sum of lam times squared offsets, Float [1]. lam: one number, or one per offset."""
    return lam * dr.sum(dr.square(offsets)) if len(lam) == 1 else dr.sum(lam * dr.square(offsets))


def filled(values: float | np.ndarray, shape: tuple[int, ...]) -> Any:
    """A number as Float [1], or an array broadcast to `shape` as a flat Float."""
    if np.ndim(values) == 0:
        return dr.opaque(mi.Float, float(values))
    return mi.Float(padded(np.broadcast_to(values, shape).astype(np.float32)).ravel())


def _photo(
    gaussians: Gaussians, camera: Camera, target: np.ndarray | Target, alpha_weight: float
) -> Photo:
    if not isinstance(target, Target):
        target = np.asarray(target)
        if target.ndim != 3 or target.shape[:2] != (camera.height, camera.width):
            size = f"[{camera.height},{camera.width},3 to 5], that of its camera"
            raise InputError(f"target: has shape {list(target.shape)}, expected {size}")
        if target.dtype.kind != "f" or not np.isfinite(target).all():
            cure = "give finite floats, linear RGB from 0 to 1"
            raise InputError(f"target: is {target.dtype}, or has NaN or infinite values; {cure}")
        target = as_target(target, gaussians.linear, alpha_weight)
    return Photo(camera, camera_array(camera), target)


def as_target(target: np.ndarray, linear: bool, alpha_weight: float) -> Target:
    """A target of a fit [H,W,3 to 5] for Gaussians that are blended as linear RGB, or as sRGB. An
    image of 8 bits, with alpha or without, is kept as that, with the same values in a quarter of
    the memory. Raises InputError if alpha has a weight and is missing."""
    runtime.start()
    factor, channels = None, target.shape[-1]
    if alpha_weight:
        if channels < 5:
            raise InputError(
                f"target: has {channels} channels, and with a weight for alpha it needs 5, "
                "alpha as the last"
            )
        factor = dr.opaque(mi.Float, float(np.sqrt(alpha_weight)))
    colour, others = target[..., :3], target[..., 3:]
    values = target if linear else padded(np.dstack([srgb_from_linear(colour), others]))
    alpha = others[..., 1:] if channels == 5 else np.ones_like(target[..., :1])
    straight = np.divide(colour, alpha, out=np.zeros_like(colour), where=alpha > 0)
    bits = _bits(np.dstack([srgb_from_linear(straight), others]))
    levels, rows = _levels(linear), [_bits(alpha)[..., 0]] * 3 + [LEVELS] * 2
    if all(
        np.array_equal(levels[row, bits[..., k]], values[..., k])
        for k, row in enumerate(rows[:channels])
    ):
        of_bits = mi.UInt8(padded(bits, np.uint8).ravel())
        return Target(of_bits, factor, channels, mi.Float(padded(levels).ravel()))
    return Target(mi.Float(adopted(values).ravel()), factor, channels)


def _bits(values: np.ndarray) -> np.ndarray:
    return np.rint(np.clip(values, 0, 1) * (LEVELS - 1)).astype(np.uint8)


@lru_cache(2)
def _levels(linear: bool) -> np.ndarray:
    """Values of the 256 levels of a colour, linear RGB or sRGB, in front of black at each of 256
    alphas, then of a weight or alpha [257,256]."""
    weights = np.arange(LEVELS, dtype=np.float32) / (LEVELS - 1)
    colours = linear_from_pixels(np.arange(LEVELS, dtype=np.uint8)) * weights[:, None]
    return np.vstack([colours if linear else srgb_from_linear(colours), weights])


@one_at_a_time
def _rendered(model: Gaussians, photo: Photo, cache: ListCache) -> Any:
    """Pixels of a model for a photo, Float [H*W*C]. Raises InputError as `mgs.splat.render`."""
    splats, lists, packed = splats_and_lists(model, photo.camera, cache)
    return composite_channels(splats, packed, lists, *photo.size).array


@frozen(lambda error, image, target, size, linear: (error, *size, *target.recorded, linear))
def _errors(error: str, image: Any, target: Target, size: Size, linear: bool) -> Any:
    """Loss `error` of each pixel value of a render, Float [H*W*C]."""
    return loss_named(error)(image, target.pixels, target.weights, size, linear)


def with_gradients(model: Gaussians, prior: ParameterPrior) -> Gaussians:
    """A copy of a model whose learned parameters have gradients enabled. For use in recorded
    functions."""
    values = {name: dr.copy(dr.detach(getattr(model, name))) for name in prior.lam}
    dr.enable_grad(list(values.values()))
    return replace(model, **values)


@frozen(lambda model, prior, view: (prior.means, *model.recorded, *view.recorded_sizes))
def _image_gradient(model: Gaussians, prior: ParameterPrior, view: View) -> Vector:
    """Derivative of half the summed squared error of one image."""
    copy = with_gradients(model, prior)
    error = (view.rendered(copy).array - view.target.pixels) * view.target.weights
    dr.backward(0.5 * dr.sum(dr.square(error)))
    return [dr.grad(getattr(copy, name)) for name in prior.lam]
