"""Render Gaussians: one differentiable call, with block lists cached per camera."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mgs import runtime
from mgs.camera import Camera
from mgs.errors import InputError
from mgs.gaussians import SH_MAX, Gaussians
from mgs.memory import padded
from mgs.splat import blocks, kernels
from mgs.splat.blocks import BLOCK_X, BLOCK_Y, BlockLists
from mgs.splat.projection import Splats, camera_array, project
from mgs.splat.recording import one_at_a_time
from mgs.splat.walking import PIXELS, pack, sums_by_splat

CACHE_BYTES = 1 << 30
"""Default memory budget of a `ListCache`, bytes: enough for 100 cameras of 100,000 Gaussians at
640x480."""


@dataclass
class Image:
    """A rendered view, Dr.Jit TensorXf: rgb [H,W,3] linear over the background, alpha [H,W], depth
    [H,W].

    depth: expected z-depth in metres, sum w z / sum w; 0 where alpha is 0.
    """

    rgb: Any
    alpha: Any
    depth: Any


REMEMBERED = 1 << 10
"""For how many cameras a `ListCache` remembers when they were used last, at a few hundred bytes
each: a run that sees new cameras at every step soon grows no more."""


class ListCache:
    """Block lists per camera, kept between calls of `render` and `fisher` within a budget in bytes.

    The lists of one camera are kept even where they alone exceed the budget.

    Lists that no longer fit the Gaussians are found out and rebuilt at every use (see
    `mgs.splat.blocks.changes`), so keeping them never changes an image.

    What is kept: cameras are mostly gone through again and again, in one order (to score views) or
    in a new order each time (to fit). The camera used longest ago is then often the one needed
    next, and a cache that always drops that one (LRU) may never find what it is asked for. Here a
    new camera takes its place only if it was itself used less than half as long ago. Otherwise the
    new lists are used once and dropped. So as many cameras stay as there is room for, and where the
    caller turns to other cameras, these take over within three rounds.
    """

    def __init__(self, budget: int = CACHE_BYTES) -> None:
        self.budget = budget
        self.builds = 0
        self._lists: OrderedDict[bytes, BlockLists] = (
            OrderedDict()
        )  # the one used longest ago first
        self._used: dict[
            bytes, int
        ] = {}  # value of _clock at each camera's last use, its lists held or not
        self._clock = 0  # counts the uses of all cameras

    @property
    def nbytes(self) -> int:
        """Memory held, bytes."""
        return sum(lists.nbytes for lists in self._lists.values())

    def get(self, camera: Camera, splats: Splats) -> tuple[BlockLists, Any]:
        """Lists for detached splats seen by the camera, from the cache or new, and the splats
        packed for them (`walking.pack`).

        Raises InputError where a parameter is not finite, a colour beyond SH_MAX, or the view has
        too many pairs.
        """
        key = camera.key
        lists = self._lists.get(key)
        dr.eval(splats)
        if lists is not None and len(lists.place) != len(splats.mean_x):
            lists = None
        if lists is None:
            _raise_unless_finite(dr.all(splats.finite))
            lists = self._build(key, splats, camera)
            packed = pack(splats, lists.place)
        else:
            not_finite = blocks.REORDERED + 1
            change = dr.select(splats.finite, blocks.changes(lists.footprints, splats), not_finite)
            dr.schedule(change)
            packed = pack(splats, lists.place)
            worst = int(dr.max(change)[0])
            _raise_unless_finite(worst < not_finite)
            if worst == blocks.RESHAPED:  # the places stay, and what is packed
                lists = self._build(key, splats, camera, lists)
            elif worst == blocks.REORDERED:
                lists = self._build(key, splats, camera)
                packed = pack(splats, lists.place)
        self._clock += 1
        self._used[key] = self._clock
        if key in self._lists:
            self._lists.move_to_end(key)
        return lists, packed

    def _build(
        self, key: bytes, splats: Splats, camera: Camera, older: BlockLists | None = None
    ) -> BlockLists:
        """New lists, kept if there is room for them."""
        lists = blocks.build(splats, camera.width, camera.height, older)
        self.builds += 1
        self._keep(key, lists)
        return lists

    def _keep(self, key: bytes, lists: BlockLists) -> None:
        """Hold new lists; then keep the budget, by dropping those used longest ago or the new ones
        (see the class)."""
        self._lists[key] = lists
        while len(self._lists) > 1 and self.nbytes > self.budget:
            oldest = next(other for other in self._lists if other != key)
            if (
                key in self._used
                and 2 * (self._clock - self._used[key]) < self._clock - self._used[oldest]
            ):
                del self._lists[oldest]
            else:
                del self._lists[key]
                break
        if len(self._used) > REMEMBERED:
            self._used = {other: self._used[other] for other in self._lists if other in self._used}


def as_colour(background: Any) -> Any:
    """A background as Color3f, linear RGB: from one number, from three, or from a Dr.Jit colour,
    which keeps its gradient.

    Numbers go to Dr.Jit through `dr.opaque`; otherwise they would be compiled into the kernel, one
    kernel for each colour. Raises InputError for anything else, and for numbers that are not finite
    or beyond SH_MAX.
    """
    if dr.is_jit_v(background):
        return mi.Color3f(background)
    try:
        values = np.broadcast_to(np.asarray(background, np.float64), 3)
    except (TypeError, ValueError):
        values = np.full(3, np.nan)
    if not (np.abs(values) <= SH_MAX).all():
        raise InputError(
            f"background {background}: must be one or three numbers, linear RGB, up to {SH_MAX:,.0f}"
        )
    return mi.Color3f(*(dr.opaque(mi.Float, float(value)) for value in values))


def _raise_unless_finite(finite: Any) -> None:
    if not finite:
        raise InputError(
            f"gaussians: a parameter is NaN or infinite, or a colour beyond {SH_MAX:,.0f}"
        )


def as_drjit(gaussians: Gaussians) -> Gaussians:
    """The same Gaussians with TensorXf fields. Fields that are Dr.Jit arrays already are kept, with
    their gradients.

    Raises InputError where the shapes of the fields do not fit each other, with which a kernel
    would read beyond the end of an array; and where no variant can be started
    (`mgs.runtime.start`).
    """
    runtime.start()
    gaussians.check_shapes()
    values = {f.name: getattr(gaussians, f.name) for f in fields(gaussians)}
    return Gaussians(
        **{k: v if dr.is_array_v(v) else mi.TensorXf(padded(v)) for k, v in values.items()}
    )


class _Rasterise(dr.CustomOp):
    """Compositing as an operation of Dr.Jit's AD: splats -> red, green, blue, alpha, depth times
    alpha, Float [H*W] each.

    Its derivative is written by hand: Dr.Jit's own would have to store the state of every pixel
    before every splat.
    packed, lists: of these splats; places: from `_block_major`; means: whether mean_x and mean_y
    have gradients; channels: how many of the outputs are wanted, from red on, at least 3. The
    others are left out.
    """

    def eval(
        self,
        splats: Splats,
        packed: Any,
        lists: BlockLists,
        places: Any,
        means: bool,
        channels: int,
    ) -> Any:
        self.splats, self.packed, self.lists, self.places = splats, packed, lists, places
        self.means, self.channels = means, channels
        self.out = kernels.forward(lists, packed, channels == 5)
        return self._in_order(self.out)

    def _in_order(self, out: tuple[Any, ...]) -> Any:
        """The output of a kernel, block by block, as arrays of pixels row by row."""
        pixel = dr.gather(mi.Vector4f, out[0], self.places, mode=dr.ReduceMode.NoConflicts)
        if self.channels < 5:
            return tuple(pixel)[: self.channels]
        return *pixel, dr.gather(mi.Float, out[1], self.places, mode=dr.ReduceMode.NoConflicts)

    def forward(self) -> None:
        tangents = kernels.pack_tangents(self.grad_in("splats"), self.splats, self.lists.place)
        self.set_grad_out(self._in_order(kernels.jvp(self.lists, self.packed, tangents)))

    def backward(self) -> None:
        r, g, b, *others = self.grad_out()
        dr.eval(
            r, g, b, others
        )  # Dr.Jit 1.5 ends the process where a scatter's value awaits a scatter itself
        alpha, *depth = others or [mi.Float(0)]
        d_out = tuple(dr.zeros(mi.Float, len(out)) for out in self.out)
        for array, value in zip(d_out, (mi.Vector4f(r, g, b, alpha), *depth), strict=True):
            dr.scatter(array, value, self.places, mode=dr.ReduceMode.NoConflicts)
        placed = kernels.adjoint(
            self.lists, self.packed, self.out, d_out, self.means, self.channels
        )
        sums = sums_by_splat(self.lists, placed, kernels.ADJOINT_SUMS[self.means])
        self.set_grad_in("splats", kernels.splat_gradient(sums, self.splats))


def _block_major(width: int, height: int) -> Any:
    """UInt32 [H*W]: index of each pixel, taken row by row, in the output of the kernels, which is
    block by block."""
    index = dr.arange(mi.UInt32, width * height)
    x, y = index % width, index // width
    block = (y // BLOCK_Y) * (-(-width // BLOCK_X)) + x // BLOCK_X
    return block * PIXELS + (y % BLOCK_Y) * BLOCK_X + x % BLOCK_X


def splats_and_lists(
    gaussians: Gaussians, camera: Camera, cache: ListCache | None
) -> tuple[Splats, BlockLists, Any]:
    """Project Gaussians with Dr.Jit fields. Returns the splats, with gradients, their block lists,
    and the splats packed.

    Raises InputError where a parameter is not finite or a colour beyond SH_MAX, naming the
    parameter and the Gaussian; and where the view has too many pairs.
    """
    splats = project(gaussians, camera_array(camera))
    try:
        return splats, *(cache or ListCache()).get(camera, dr.detach(splats))
    except InputError:
        Gaussians(
            *(np.asarray(dr.detach(getattr(gaussians, f.name))) for f in fields(gaussians))
        ).check()
        raise


@one_at_a_time
def render(
    gaussians: Gaussians,
    camera: Camera,
    background: Any = (0.0, 0.0, 0.0),
    cache: ListCache | None = None,
) -> Image:
    """Render Gaussians by EWA splatting (Kerbl et al. 2023, with the constants of
    `mgs.splat.constants`).

    gaussians: NumPy fields, or Dr.Jit TensorXf fields, any of which may have gradients enabled.
    Derivatives by them are those of Dr.Jit, in reverse mode (`dr.backward`) and in forward mode
    (`dr.forward`; `jvp` is a short way to it). Not
    differentiated: the camera, the thresholds (alpha < 1/255, transmittance, ALPHA_MAX) and the
    depth order.
    background: linear RGB, one number or three, or a Dr.Jit colour, which may have gradients
    enabled. cache: keep one between calls so that a camera seen again reuses its block lists.
    `render` records its own kernels, so it cannot be called inside another `dr.freeze`.
    Raises InputError where a parameter is NaN or infinite or a colour beyond SH_MAX, naming the
    parameter and the first Gaussian; where a number of the background is (a Dr.Jit colour is not
    looked at); and for a view of too many pairs (`mgs.splat.blocks.MAX_PAIRS`).
    """
    runtime.start()
    colour = as_colour(background)
    if len(gaussians) == 0:
        gaussians.check_shapes()
        return _empty(camera, colour)
    splats, lists, packed = splats_and_lists(as_drjit(gaussians), camera, cache)
    return composite(splats, packed, lists, camera.width, camera.height, colour)


@one_at_a_time
def jvp(
    gaussians: Gaussians,
    tangents: Mapping[str, Any],
    camera: Camera,
    background: Any = (0.0, 0.0, 0.0),
    cache: ListCache | None = None,
) -> Image:
    """How the image changes as the Gaussians change along `tangents`: the product J v, in one pass
    (forward-mode derivative).

    J is the Jacobian of `render`, with what it does not differentiate; v are the tangents.
    gaussians, camera, background,
    cache: as in `render`; gradients that are enabled on them play no part.
    tangents: by name of a parameter ("means", "log_scales", "quats", "logit_opacities", "sh") an
    array of the parameter's shape, NumPy or Dr.Jit, in its unit per unit of some t. Parameters that
    are not named do not change. Returns the derivatives by t of rgb [H,W,3], alpha [H,W] and depth
    [H,W], TensorXf. Raises InputError where `render` does, and for a tangent of an unknown name, of
    a wrong shape or that is not finite.
    """
    model = as_drjit(gaussians)
    given = {name: _checked_tangent(model, name, tangent) for name, tangent in tangents.items()}
    with dr.resume_grad():
        watched = Gaussians(
            **{f.name: dr.copy(dr.detach(getattr(model, f.name))) for f in fields(model)}
        )
        for name, tangent in given.items():
            dr.enable_grad(getattr(watched, name))
            dr.set_grad(getattr(watched, name), tangent)
        image = render(watched, camera, dr.detach(as_colour(background)), cache)
        dr.forward_to(
            image, flags=dr.ADFlag.Default | dr.ADFlag.AllowNoGrad
        )  # none where nothing is given to change
        return dr.grad(image)


def _checked_tangent(gaussians: Gaussians, name: str, tangent: Any) -> Any:
    """The tangent of a parameter as a detached TensorXf. Raises InputError, see `jvp`."""
    names = [f.name for f in fields(gaussians)]
    if name not in names:
        raise InputError(f"tangents: {name!r} is no parameter; choose from {', '.join(names)}")
    shape = tuple(getattr(gaussians, name).shape)
    try:
        with np.errstate(over="ignore"):
            values = np.asarray(dr.detach(tangent), np.float32)
    except (TypeError, ValueError):
        raise InputError(
            f"tangents: {name} must be numbers of the parameter's shape, {shape}"
        ) from None
    if values.shape != shape:
        raise InputError(
            f"tangents: {name} has shape {values.shape}, expected {shape}, that of the parameter"
        )
    if not np.isfinite(values).all():
        first = np.argwhere(~np.isfinite(values))[0][0]
        raise InputError(
            f"tangents: {name} is NaN or infinite, first at Gaussian {first}; remove or repair it"
        )
    return mi.TensorXf(padded(values))


def _empty(camera: Camera, background: Any) -> Image:
    """The image of a model without Gaussians: the background. (Dr.Jit has no operations on arrays
    of length 0.)"""
    shape = (camera.height, camera.width)
    rgb = background + dr.zeros(mi.Color3f, camera.height * camera.width)
    return Image(
        mi.TensorXf(dr.ravel(rgb), (*shape, 3)),
        dr.zeros(mi.TensorXf, shape),
        dr.zeros(mi.TensorXf, shape),
    )


def composite(
    splats: Splats, packed: Any, lists: BlockLists, width: int, height: int, background: Any = 0.0
) -> Image:
    """The image of projected splats over a background (Color3f), differentiable in the splats'
    fields and the background.

    packed: the splats' numbers from `walking.pack`; lists: their block lists; width, height:
    pixels.
    """
    r, g, b, alpha, weighted = _rasterised(splats, packed, lists, width, height, 5)
    rgb = mi.Color3f(r, g, b) + (1 - alpha) * background
    expected = dr.select(alpha > 0, weighted / dr.select(alpha > 0, alpha, 1), 0)
    alpha = (
        alpha + 0
    )  # a variable that nothing else depends on: forward-mode AD clears the others when it is done
    shape = (height, width)
    return Image(
        mi.TensorXf(dr.ravel(rgb), (*shape, 3)),
        mi.TensorXf(alpha, shape),
        mi.TensorXf(expected, shape),
    )


def composite_channels(
    splats: Splats, packed: Any, lists: BlockLists, width: int, height: int, channels: int
) -> Any:
    """The colours of `composite` over black and, with four channels instead of three, alpha:
    TensorXf [H,W,channels], differentiable in the splats' fields.

    It is what a fit needs, and takes less time: depth is neither summed nor differentiated, alpha
    only where it is wanted.
    """
    pixels = _rasterised(splats, packed, lists, width, height, channels)
    vectors = mi.Color3f(*pixels) if channels == 3 else mi.Vector4f(*pixels)
    return mi.TensorXf(dr.ravel(vectors), (height, width, channels))


def _rasterised(
    splats: Splats, packed: Any, lists: BlockLists, width: int, height: int, channels: int
) -> Any:
    """The outputs of `_Rasterise` for an image of this size, with gradients of the means where
    these are enabled."""
    return dr.custom(
        _Rasterise,
        splats,
        packed,
        lists,
        _block_major(width, height),
        dr.grad_enabled(splats.mean_x),
        channels,
    )
