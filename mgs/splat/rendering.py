"""Render Gaussians in one differentiable call, with block lists cached per camera."""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mgs import runtime
from mgs.camera import Camera
from mgs.errors import InputError
from mgs.gaussians import SH_MAX, Gaussians
from mgs.memory import padded
from mgs.notebook import html, picture
from mgs.splat import blocks, kernels
from mgs.splat.blocks import BLOCK_X, BLOCK_Y, BlockLists
from mgs.splat.projection import Splats, camera_array, project, projected
from mgs.splat.recording import one_at_a_time
from mgs.splat.walking import PIXELS, pack, sums_by_splat

CACHE_BYTES = 1 << 28  # budget of a `ListCache`: 33 cameras of 100,000 Gaussians at 640x480


@dataclass
class Image:
    """A rendered view, Dr.Jit TensorXf.

    rgb: linear, over the background [H,W,3]. alpha: [H,W]. depth: expected z-depth sum w z / sum w,
    metres, 0 where alpha is 0 [H,W]."""

    rgb: Any
    alpha: Any
    depth: Any

    def __repr__(self) -> str:
        *views, height, width = self.alpha.shape
        return f"Image({''.join(f'{count} of ' for count in views)}{width}x{height})"

    def _repr_html_(self) -> str:
        rgb = np.asarray(self.rgb)
        return html(repr(self), [picture(one) for one in (rgb if rgb.ndim == 4 else [rgb])])


REMEMBERED = 1 << 10  # cameras whose last use a `ListCache` remembers, a few hundred bytes each


class ListCache:
    """Block lists per camera, kept between calls of `render` and `fisher` within a budget in bytes.
    The lists of one camera are kept even if they exceed it.

    Every use checks that the lists still fit the Gaussians (`mgs.splat.blocks.changes`) and
    rebuilds them if not, so caching never changes an image.

    Replacement: callers mostly go through their cameras again and again, in one order or a new one
    each time. The camera used longest ago is then often needed next, so least-recently-used
    replacement may never find anything. Here a new camera replaces the one used longest ago only if
    it was itself used less than half as long ago. Otherwise its lists are used once and dropped. If
    the caller turns to other cameras, these take over within three rounds."""

    def __init__(self, budget: int = CACHE_BYTES) -> None:
        self.budget = budget
        self.builds = 0
        self._lists: OrderedDict[bytes, BlockLists] = OrderedDict()  # used longest ago first
        self._used: dict[bytes, int] = {}  # _clock at the last use of each camera, held or not
        self._clock = 0  # counts the uses of all cameras

    @property
    def nbytes(self) -> int:
        """Memory held, bytes."""
        return sum(lists.nbytes for lists in self._lists.values())

    def clear(self) -> None:
        """Drop all lists."""
        self._lists.clear()

    def get(self, camera: Camera, splats: Splats) -> tuple[BlockLists, Any]:
        """Lists for detached splats seen by the camera, cached or new, and the packed splats
        (`walking.pack`). Raises InputError if a parameter is not finite, a colour beyond SH_MAX, or
        the view has too many pairs."""
        # Old lists may fit no longer: footprints or depth order may have changed.
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
            if worst == blocks.RESHAPED:  # places and packed splats stay valid
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
        """New lists, kept; over budget those used longest ago go, or these (see the class)."""
        lists = self._lists[key] = blocks.build(splats, camera, older)
        self.builds += 1
        clock, uses = self._clock, self._used
        while len(self._lists) > 1 and self.nbytes > self.budget:
            # The oldest leaves if the new one was used less than half as long ago.
            oldest = next(other for other in self._lists if other != key)
            if key in uses and 2 * (clock - uses[key]) < clock - uses[oldest]:
                del self._lists[oldest]
            else:
                del self._lists[key]
                break
        if len(uses) > REMEMBERED:
            self._used = {other: uses[other] for other in self._lists if other in uses}
        return lists


def as_colour(background: Any) -> Any:
    """A background as Color3f, linear RGB: one number, three, or a Dr.Jit colour, which keeps its
    gradient. Numbers pass through `dr.opaque`, so they are not compiled into kernels. Raises
    InputError for anything else, and for numbers that are not finite or beyond SH_MAX."""
    if dr.is_jit_v(background):
        return mi.Color3f(background)
    try:
        values = np.broadcast_to(np.asarray(background, np.float64), 3)
    except (TypeError, ValueError):
        values = np.full(3, np.nan)
    if not (np.abs(values) <= SH_MAX).all():
        why = f"must be one or three numbers, linear RGB, up to {SH_MAX:,.0f}"
        raise InputError(f"background {background}: {why}")
    return mi.Color3f(*(dr.opaque(mi.Float, float(value)) for value in values))


def _raise_unless_finite(finite: Any) -> None:
    if not finite:
        why = f"a parameter is NaN or infinite, or a colour beyond {SH_MAX:,.0f}"
        raise InputError(f"gaussians: {why}")


def as_drjit(gaussians: Gaussians) -> Gaussians:
    """The same Gaussians with TensorXf fields. Dr.Jit fields stay as they are, with their
    gradients. Raises InputError if the shapes of the fields do not fit each other, or no variant
    can be started (`mgs.runtime.start`)."""
    runtime.start()
    gaussians.check_shapes()
    return gaussians.map(lambda v: v if dr.is_array_v(v) else mi.TensorXf(padded(v)))


class _Rasterise(dr.CustomOp):
    """Compositing as a Dr.Jit AD operation: splats -> red, green, blue, alpha, depth times alpha,
    Float [H*W] each.

    The derivative is written by hand. Dr.Jit's own would store the state of every pixel before
    every splat.

    packed, lists: of these splats. places: from `_block_major`. means: whether mean_x and mean_y
    have gradients. channels: number of outputs, from red on, at least 3."""

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
        """Output of a kernel, block by block, as arrays of pixels row by row."""
        pixel = dr.gather(mi.Vector4f, out[0], self.places, mode=dr.ReduceMode.NoConflicts)
        if self.channels < 5:
            return tuple(pixel)[: self.channels]
        return *pixel, dr.gather(mi.Float, out[1], self.places, mode=dr.ReduceMode.NoConflicts)

    def forward(self) -> None:
        tangents = kernels.pack_tangents(self.grad_in("splats"), self.splats, self.lists.place)
        self.set_grad_out(self._in_order(kernels.jvp(self.lists, self.packed, tangents)))

    def backward(self) -> None:
        r, g, b, *others = self.grad_out()
        # Dr.Jit 1.5 ends the process if a scatter's value depends on an unevaluated scatter.
        dr.eval(r, g, b, others)
        alpha, *depth = others or [mi.Float(0)]
        d_out = tuple(dr.zeros(mi.Float, len(out)) for out in self.out)
        for array, value in zip(d_out, (mi.Vector4f(r, g, b, alpha), *depth), strict=True):
            dr.scatter(array, value, self.places, mode=dr.ReduceMode.NoConflicts)
        how = self.means, self.channels
        totals = kernels.adjoint(self.lists, self.packed, self.out, d_out, *how)
        sums = sums_by_splat(self.lists, totals, kernels.ADJOINT_SUMS[self.means])
        self.set_grad_in("splats", kernels.splat_gradient(sums, self.splats))


def _block_major(lists: BlockLists, width: int, height: int) -> Any:
    """Index of each pixel (row by row) in the output of the kernels (block by block), UInt32
    [H*W]."""
    index = dr.arange(mi.UInt32, width * height)
    # Column and row of the pixel, counted from the first block of the film that it touches.
    x, y = lists.left % BLOCK_X + index % width, lists.top % BLOCK_Y + index // width
    block = (y // BLOCK_Y) * lists.blocks_x + x // BLOCK_X
    return block * PIXELS + (y % BLOCK_Y) * BLOCK_X + x % BLOCK_X


def by_block(lists: BlockLists, camera: Camera, values: np.ndarray) -> Any:
    """Four numbers per pixel [H,W,4] in the order of the kernels, Float [L*32*4]; 0 outside."""
    out = dr.zeros(mi.Float, 4 * PIXELS * len(lists.block))
    places = _block_major(lists, camera.width, camera.height)
    vectors = dr.unravel(mi.Vector4f, mi.Float(padded(values).ravel()))
    dr.scatter(out, vectors, places, mode=dr.ReduceMode.NoConflicts)
    dr.eval(out)
    return out


def splats_and_lists(
    gaussians: Gaussians, camera: Camera, cache: ListCache | None
) -> tuple[Splats, BlockLists, Any]:
    """Project Gaussians with Dr.Jit fields. Returns the splats, with gradients, their block lists,
    and the packed splats. Raises InputError if a parameter is not finite or a colour beyond SH_MAX,
    naming parameter and Gaussian; and if the view has too many pairs."""
    device = camera_array(camera.seen_from(gaussians.origin))
    splats = (project if dr.grad_enabled(gaussians, device) else projected)(gaussians, device)
    try:
        return splats, *(cache or ListCache()).get(camera, dr.detach(splats))
    except InputError:
        gaussians.map(lambda v: np.asarray(dr.detach(v))).check()
        raise


@one_at_a_time
def render(
    gaussians: Gaussians,
    camera: Camera | Sequence[Camera],
    background: Any = (0.0, 0.0, 0.0),
    cache: ListCache | None = None,
) -> Image:
    """Render Gaussians by EWA splatting (Kerbl et al. 2023, with `mgs.splat.constants`).

    - gaussians: NumPy fields, or TensorXf fields, any of which may have gradients enabled.
    - background: linear RGB, one number or three, or a Dr.Jit colour, with or without gradient.
    - cache: pass the same one to all calls, to reuse the block lists of cameras.

    Returns rgb [H,W,3] (linear; sRGB if `gaussians.linear` is false), alpha [H,W] and depth [H,W]
    (expected z-depth, metres), TensorXf; of V cameras of one size [V,H,W,3] and [V,H,W].

    Differentiable by Dr.Jit in reverse mode (`dr.backward`) and forward mode (`dr.forward`, `jvp`),
    also by a camera that has Dr.Jit values (`Camera`, `moved`). Not differentiated: the thresholds
    (ALPHA_MIN, ALPHA_MAX, TRANSMITTANCE_MIN) and the depth order.

    Raises InputError inside another `dr.freeze`, since it records kernels of its own; if a
    parameter is not finite or a colour beyond SH_MAX, naming parameter and first Gaussian; if a
    number of the background is (a Dr.Jit colour is not checked); for a view with too many pairs
    (`mgs.splat.blocks.MAX_PAIRS`); and for no cameras, or cameras of different sizes."""
    runtime.start()
    if not isinstance(camera, Camera):
        model, cache = as_drjit(gaussians), cache or ListCache()
        return _stacked([render(model, one, background, cache) for one in camera])
    if dr.flag(dr.JitFlag.FreezingScope):
        raise InputError("render: records kernels of its own; call it outside of `dr.freeze`")
    colour = as_colour(background)
    if len(gaussians) == 0:
        gaussians.check_shapes()
        return _empty(camera, colour)
    splats, lists, packed = splats_and_lists(as_drjit(gaussians), camera, cache)
    return composite(splats, packed, lists, camera.width, camera.height, colour)


def _stacked(images: Sequence[Image]) -> Image:
    """One image of several of one size, which come first in its shapes."""
    if len({tuple(image.alpha.shape) for image in images}) != 1:
        raise InputError("render: takes one or more cameras of one image size; draw others apart")

    def stacked(name: str) -> Any:
        parts = [getattr(image, name) for image in images]
        return mi.TensorXf(dr.concat([p.array for p in parts]), (len(parts), *parts[0].shape))

    return Image(stacked("rgb"), stacked("alpha"), stacked("depth"))


def _empty(camera: Camera, background: Any) -> Image:
    """Image of a model without Gaussians. (Dr.Jit has no operations on arrays of length 0.)"""
    shape = (camera.height, camera.width)
    rgb = background + dr.zeros(mi.Color3f, camera.height * camera.width)
    alpha, depth = dr.zeros(mi.TensorXf, shape), dr.zeros(mi.TensorXf, shape)
    return Image(mi.TensorXf(dr.ravel(rgb), (*shape, 3)), alpha, depth)


def composite(
    splats: Splats, packed: Any, lists: BlockLists, width: int, height: int, background: Any = 0.0
) -> Image:
    """Image of projected splats over a background (Color3f), differentiable in the splats and the
    background. packed: from `walking.pack`. lists: block lists. width, height: pixels."""
    r, g, b, alpha, weighted = _rasterised(splats, packed, lists, width, height, 5)
    # C = sum w c + T_end background, with T_end = 1 - alpha.
    rgb = mi.Color3f(r, g, b) + (1 - alpha) * background
    # Expected depth: sum w z / sum w.
    expected = dr.select(alpha > 0, weighted / dr.select(alpha > 0, alpha, 1), 0)
    alpha = alpha + 0  # a leaf: forward-mode AD clears the gradients of inner variables
    shape = (height, width)
    return Image(
        mi.TensorXf(dr.ravel(rgb), (*shape, 3)),
        mi.TensorXf(alpha, shape),
        mi.TensorXf(expected, shape),
    )


def composite_channels(
    splats: Splats, packed: Any, lists: BlockLists, width: int, height: int, channels: int
) -> Any:
    """Colours of `composite` over black and, with four channels, alpha: TensorXf [H,W,channels],
    differentiable in the splats. Faster than `composite`: depth is left out, and alpha unless
    wanted."""
    pixels = _rasterised(splats, packed, lists, width, height, channels)
    vectors = mi.Color3f(*pixels) if channels == 3 else mi.Vector4f(*pixels)
    return mi.TensorXf(dr.ravel(vectors), (height, width, channels))


def _rasterised(
    splats: Splats, packed: Any, lists: BlockLists, width: int, height: int, channels: int
) -> Any:
    """Outputs of `_Rasterise`, with gradients of the means if enabled."""
    places, means = _block_major(lists, width, height), dr.grad_enabled(splats.mean_x)
    return dr.custom(_Rasterise, splats, packed, lists, places, means, channels)
