"""What a fit lowers: the negative logarithm of the posterior of the Gaussians' parameters, its
gradient and its curvature.

A pixel is the rendered value plus noise of standard deviation sigma, and each parameter lies around
its start with a standard deviation tau. The negative logarithm of the posterior is then, up to a
constant and times sigma^2, the objective

    Phi = 1/2 sum over images, pixels and channels of (rendered - target)^2  +  1/2 sum over
    parameters of lam (theta - start)^2

with lam = (sigma / tau)^2 (`mgs.policy.criteria.regularisation`). Its curvature, J^T J + lam with
the Jacobian J of all images,
is the matrix whose diagonal the criteria use: the model that is fitted and the one whose
information is measured are the same. With lam = 0 it is maximum likelihood, the paper's Eq. 2 up to
a constant.

Alpha may be a fourth channel, with noise of its own, sigma_alpha: its squared differences then
count alpha_weight = (sigma / sigma_alpha)^2 times. What a camera sees of alpha is the outline of
the rock. The criteria leave it out.

The means are frozen by default, as in the paper. Where they are "free", all three coordinates are
parameters like the others. Where they move along the "normal", the parameter is one offset per
Gaussian, metres: how far its mean lies from its start, along a given normal.

The curvature is never stored (10,000 Gaussians have 110,000 parameters): its product with a vector
takes one derivative in forward mode and one in reverse mode for each image.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mgs.camera import Camera
from mgs.errors import InputError
from mgs.gaussians import Gaussians, learned
from mgs.memory import IMAGE_BYTES, Deferred, kept_within, padded
from mgs.splat import ListCache, as_drjit, fisher, groups
from mgs.splat.blocks import BlockLists
from mgs.splat.information import unit_normals
from mgs.splat.projection import camera_array, project, rows_as_vectors
from mgs.splat.recording import frozen, one_at_a_time
from mgs.splat.rendering import composite_channels, splats_and_lists

Vector = list[Any]
"""A number for every learned parameter: a TensorXf for each array of `mgs.gaussians.learned`, of
its shape; for means that move along their normals the shape is [N]."""


@dataclass(frozen=True)
class Photo:
    """An image to fit to: its camera, the same for the kernels, its pixels, mi.Float [H*W*C] of C =
    3 channels, or 4 with alpha, and by what differences to them are multiplied, mi.Float
    [H*W*C]."""

    camera: Camera
    array: Any
    pixels: Any
    weights: Any

    @property
    def size(self) -> tuple[int, int, int]:
        """Width and height, pixels, and the number of channels: 3, or with alpha 4."""
        return (
            self.camera.width,
            self.camera.height,
            len(self.pixels) // (self.camera.width * self.camera.height),
        )

    @property
    def nbytes(self) -> int:
        """Memory of pixels and weights."""
        return 4 * (len(self.pixels) + len(self.weights))


@dataclass
class Prior:
    """What holds the parameters near their start: for each of the learned arrays its lam, Float, of
    one number or of one for
    each parameter. share: 1 / number of images, Float, the part of the prior that goes with one
    image. normals: where means move along them, TensorXf [N,3].
    """

    start: Gaussians
    lam: dict[str, Any]
    share: Any
    normals: Any = None

    @property
    def means(self) -> str:
        """A name in `mgs.splat.MEANS`."""
        if "means" not in self.lam:
            return "frozen"
        return "free" if self.normals is None else "normal"

    def along(self, name: str, vectors: Any) -> Any:
        """Changes of a parameter, or derivatives by it, as those of what is learned of it: for
        means that move along their normals the part along these, [N,3] -> [N]; for everything else
        the same again."""
        if name != "means" or self.normals is None:
            return vectors
        product = dr.dot(
            rows_as_vectors(vectors, mi.Vector3f), rows_as_vectors(self.normals, mi.Vector3f)
        )
        return mi.TensorXf(product, vectors.shape[:1])

    def across(self, name: str, changes: Any) -> Any:
        """The way back: changes of what is learned as changes of the parameter itself, for offsets
        [N] -> [N,3]."""
        if name != "means" or self.normals is None:
            return changes
        return mi.TensorXf(
            dr.ravel(rows_as_vectors(self.normals, mi.Vector3f) * changes.array), self.normals.shape
        )


@dataclass(frozen=True)
class Objective:
    """Phi of this module's docstring, for some images. Models are Gaussians with TensorXf fields.

    photos: those beyond IMAGE_BYTES are made anew from their target at every use. alpha_weight: as
    in the module's docstring; 0 where alpha is no channel."""

    photos: Sequence[Photo]
    prior: Prior
    cache: ListCache
    alpha_weight: float = 0.0

    def loss(self, model: Gaussians) -> float:
        """2 Phi over the number of pixel values: the mean squared error of the images plus the
        prior's part."""
        penalty = sum(
            weighted_squares(lam * self.prior.share, d.array) for d, lam in self.pulls(model)
        )
        errors = []
        for photo in self.photos:
            drawn = _drawn(model, photo, self.cache)
            errors.append(
                dr.mean(dr.square((drawn - photo.pixels) * photo.weights))
                + penalty / len(photo.pixels)
            )
            dr.eval(errors[-1])  # or it would hold the image until the last one is done
        return float(np.mean([float(error[0]) for error in errors]))

    def phi(self, model: Gaussians) -> float:
        """Phi itself, (pixel value)^2."""
        return 0.5 * sum(len(photo.pixels) for photo in self.photos) * self.loss(model)

    def gradient(self, model: Gaussians) -> Vector:
        """The derivative of Phi by the parameters."""
        total = [mi.TensorXf(lam * d.array, d.shape) for d, lam in self.pulls(model)]
        for photo in self.photos:
            lists, packed = self.lists(model, photo)
            parts = _image_gradient(
                model,
                self.prior,
                photo.array,
                packed,
                lists,
                photo.pixels,
                photo.weights,
                photo.size,
            )
            total = [a + b for a, b in zip(total, parts, strict=True)]
            dr.eval(total)
        return total

    def curvature_times(self, model: Gaussians, vector: Vector) -> Vector:
        """(J^T J + lam) times a vector."""
        total = [
            mi.TensorXf(lam * v.array, v.shape)
            for v, lam in zip(vector, self.prior.lam.values(), strict=True)
        ]
        for photo in self.photos:
            lists, packed = self.lists(model, photo)
            parts = _image_curvature(
                model, self.prior, vector, photo.array, packed, lists, photo.weights, photo.size
            )
            total = [a + b for a, b in zip(total, parts, strict=True)]
            dr.eval(total)
        return total

    def diagonal(self, model: Gaussians) -> Vector:
        """The diagonal of J^T J + lam, by exact Fisher information; weights of pixels are taken as
        1."""
        total = [
            mi.TensorXf(lam + dr.zeros(mi.Float, d.array.shape[0]), d.shape)
            for d, lam in self.pulls(model)
        ]
        for photo in self.photos:
            total = [
                t + part for t, part in zip(total, self._information(model, photo), strict=True)
            ]
            dr.eval(total)
        return total

    def largest_diagonal(self, model: Gaussians) -> Vector:
        """The largest entry of any one image's diagonal, with that image's share of lam: what
        bounds a step on one image."""
        least = [(d, lam * self.prior.share) for d, lam in self.pulls(model)]
        largest = [dr.zeros(mi.TensorXf, d.shape) for d, _ in least]
        for photo in self.photos:
            parts = self._information(model, photo)
            largest = [
                mi.TensorXf(dr.maximum(a.array, b.array), a.shape)
                for a, b in zip(largest, parts, strict=True)
            ]
            dr.eval(largest)
        return [
            mi.TensorXf(a.array + lam, a.shape) for a, (_, lam) in zip(largest, least, strict=True)
        ]

    def _information(self, model: Gaussians, photo: Photo) -> Vector:
        """The exact Fisher information of one image."""
        means = self.prior.means
        normals = np.asarray(self.prior.normals) if means == "normal" else None
        found = fisher(
            model,
            photo.camera,
            cache=self.cache,
            means=means,
            normals=normals,
            alpha_weight=self.alpha_weight,
        )
        columns = zip(self.pulls(model), groups(model.sh_degree, means).values(), strict=True)
        return [mi.TensorXf(padded(found[:, c]).reshape(d.shape)) for (d, _), c in columns]

    def lists(self, model: Gaussians, photo: Photo) -> tuple[BlockLists, Any]:
        """Block lists of one image and the splats packed for them. Raises InputError as
        `ListCache.get`."""
        return self.cache.get(photo.camera, _project(model, photo.array))

    def pulls(self, model: Gaussians) -> list[tuple[Any, Any]]:
        """For each of the learned arrays how far it is from its start, and its lam."""
        prior = self.prior
        return [
            (prior.along(n, getattr(model, n) - getattr(prior.start, n)), lam)
            for n, lam in prior.lam.items()
        ]


def objective(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    targets: Sequence[np.ndarray],
    start: Gaussians | None = None,
    lam: Mapping[str, float | np.ndarray] | None = None,
    cache: ListCache | None = None,
    means: str = "frozen",
    normals: np.ndarray | None = None,
    alpha_weight: float = 0.0,
) -> Objective:
    """The objective of `mgs.fit.fitting.fit`, from the same arguments; means, alpha_weight: the
    settings of these names.

    Raises InputError where the start or the normals do not fit the Gaussians, or `means` is not a
    name in `mgs.splat.MEANS`. Where alpha has a weight and a target has no alpha, it is raised by
    whatever reads that target first.
    """
    groups(gaussians.sh_degree, means)  # raises where the name is unknown
    unit = unit_normals(len(gaussians), normals) if means == "normal" else None
    if len(cameras) != len(targets):
        raise ValueError(f"there are {len(cameras)} cameras, but {len(targets)} targets")

    def photo(i: int) -> Photo:
        return _photo(cameras[i], np.asarray(targets[i], np.float32), alpha_weight)

    photos = Deferred(range(len(cameras)), kept_within(IMAGE_BYTES, photo, lambda p: p.nbytes))
    start = gaussians if start is None else start
    if start.sh.shape != gaussians.sh.shape:
        raise InputError(
            f"start: has colours of shape {start.sh.shape}, expected {gaussians.sh.shape}, that of the Gaussians"
        )
    # A copy: Dr.Jit uses NumPy's memory in place, and a recorded step takes parameters and start
    # for the same array for ever if they were in the same memory when it was recorded (Dr.Jit 1.5).
    start = as_drjit(
        Gaussians(*(np.array(getattr(start, f.name), np.float32) for f in fields(start)))
    )
    values = {
        name: filled((lam or {}).get(kind, 0.0), getattr(start, name).shape)
        for name, kind in learned(means).items()
    }
    directions = None if unit is None else mi.TensorXf(padded(unit))
    prior = Prior(start, values, dr.opaque(mi.Float, 1 / max(len(photos), 1)), directions)
    return Objective(photos, prior, cache or ListCache(), alpha_weight)


def weighted_squares(lam: Any, away: Any) -> Any:
    """Sum of lam times the square of distances, Float [1]; lam: of one number, or of one for each
    distance."""
    return lam * dr.sum(dr.square(away)) if len(lam) == 1 else dr.sum(lam * dr.square(away))


def filled(values: float | np.ndarray, shape: tuple[int, ...]) -> Any:
    """A number as Float, or an array that broadcasts to a shape as Float of as many numbers as the
    shape has."""
    if np.ndim(values) == 0:
        return dr.opaque(mi.Float, float(values))
    return mi.Float(padded(np.broadcast_to(values, shape).astype(np.float32)).ravel())


def _photo(camera: Camera, target: np.ndarray, alpha_weight: float) -> Photo:
    """target: as `fit` takes it. Raises InputError where alpha has a weight and the target has
    none."""
    pixels, channels = target[..., :3], target.shape[-1]
    weights = np.broadcast_to(
        target[..., 3:4] if channels > 3 else np.ones((), np.float32), pixels.shape
    )
    if alpha_weight:
        if channels < 5:
            raise InputError(
                f"target: has {channels} channels, and with a weight for alpha it needs 5, alpha as the last"
            )
        pixels = np.dstack([pixels, target[..., 4]])
        weights = np.dstack([weights, np.float32(np.sqrt(alpha_weight)) * weights[..., 0]])
    return Photo(
        camera, camera_array(camera), *(mi.Float(padded(a).ravel()) for a in (pixels, weights))
    )


@one_at_a_time
def _drawn(model: Gaussians, photo: Photo, cache: ListCache) -> Any:
    """The pixels of an image as the model has them, Float [H*W*C]. Raises InputError as
    `mgs.splat.render`."""
    splats, lists, packed = splats_and_lists(model, photo.camera, cache)
    return composite_channels(splats, packed, lists, *photo.size).array


def newton_decrease(
    found: Objective,
    model: Gaussians,
    iterations: int,
    progress: Callable[[int, int], None] = lambda done, most: None,
) -> list[float]:
    """By how much Phi would fall at most if the images were linear in the parameters: 1/2 g^T (J^T
    J + lam)^-1 g, after each iteration of conjugate gradients with the diagonal of the matrix as
    preconditioner.

    The numbers grow from iteration to iteration, towards the limit. The full J^T J is needed: its
    diagonal ignores that neighbouring splats can do each other's work, and so takes them for better
    determined than they are. lam must not be 0.
    """
    gradient = found.gradient(model)
    inverse = [dr.rcp(d.array) for d in found.diagonal(model)]
    x = [dr.zeros(mi.TensorXf, g.shape) for g in gradient]
    residual = [-g for g in gradient]
    z = [mi.TensorXf(i * r.array, r.shape) for i, r in zip(inverse, residual, strict=True)]
    direction, rz, decreases = z, dot(residual, z), []
    if rz == 0:  # at a minimum; so is a model that no camera sees
        return [0.0]
    for done in range(iterations):
        progress(done, iterations)
        product = found.curvature_times(model, direction)
        step = rz / dot(direction, product)
        x, residual = plus(x, step, direction), plus(residual, -step, product)
        z = [mi.TensorXf(i * r.array, r.shape) for i, r in zip(inverse, residual, strict=True)]
        before, rz = rz, dot(residual, z)
        direction = plus(z, rz / before, direction)
        dr.eval(x, residual, direction)
        decreases.append(-0.5 * dot(gradient, x))
    return decreases


def dot(a: Vector, b: Vector) -> float:
    """Sum of products, in double precision."""
    sums = [dr.sum(mi.Float64(x.array) * mi.Float64(y.array)) for x, y in zip(a, b, strict=True)]
    return sum(float(s[0]) for s in sums)


def plus(a: Vector, factor: float, b: Vector) -> Vector:
    """a + factor b."""
    scale = dr.opaque(mi.Float, factor)
    return [
        mi.TensorXf(dr.fma(scale, y.array, x.array), x.shape) for x, y in zip(a, b, strict=True)
    ]


def watched(model: Gaussians, prior: Prior) -> Gaussians:
    """A copy of the model whose learned parameters have gradients enabled, for use inside a
    recorded function."""
    values = {name: dr.copy(dr.detach(getattr(model, name))) for name in prior.lam}
    dr.enable_grad(list(values.values()))
    return replace(model, **values)


def _sizes(model: Gaussians, prior: Prior, lists: BlockLists, size: Any) -> tuple[Any, ...]:
    return prior.means, len(lists.splat), len(lists.block), *model.sh.shape, *size


@frozen(lambda model, camera: model.sh.shape)
def _project(model: Gaussians, camera: Any) -> Any:
    return project(model, camera)


@frozen(
    lambda model, prior, camera, packed, lists, target, weight, size: _sizes(
        model, prior, lists, size
    )
)
def _image_gradient(
    model: Gaussians,
    prior: Prior,
    camera: Any,
    packed: Any,
    lists: BlockLists,
    target: Any,
    weight: Any,
    size: Any,
) -> Vector:
    """The derivative of half the summed squared error of one image."""
    copy = watched(model, prior)
    drawn = composite_channels(project(copy, camera), packed, lists, *size)
    dr.backward(0.5 * dr.sum(dr.square((drawn.array - target) * weight)))
    return _gradients(copy, prior)


@frozen(
    lambda model, prior, vector, camera, packed, lists, weight, size: _sizes(
        model, prior, lists, size
    )
)
def _image_curvature(
    model: Gaussians,
    prior: Prior,
    vector: Vector,
    camera: Any,
    packed: Any,
    lists: BlockLists,
    weight: Any,
    size: Any,
) -> Vector:
    """J^T J times a vector, for one image: forward mode gives J v, reverse mode J^T of that."""
    copy = watched(model, prior)
    for name, tangent in zip(prior.lam, vector, strict=True):
        dr.set_grad(getattr(copy, name), prior.across(name, tangent))
    drawn = composite_channels(project(copy, camera), packed, lists, *size)
    dr.forward_to(drawn)
    along = dr.detach(dr.grad(drawn).array) * dr.square(weight)
    copy = watched(model, prior)
    drawn = composite_channels(project(copy, camera), packed, lists, *size)
    dr.backward(dr.sum(drawn.array * along))
    return _gradients(copy, prior)


def _gradients(copy: Gaussians, prior: Prior) -> Vector:
    """The gradients that were found for a `watched` copy, by what is learned."""
    return [prior.along(name, dr.grad(getattr(copy, name))) for name in prior.lam]
