"""The kernels: forward (image), jvp (its tangents), adjoint (gradients), fisher (sums for the
Fisher information), removal (change of the image when a splat is removed). Symbols:
docs/notation.md.

The last three draw the image front to back once more and subtract, S = C - (colour so far), so they
make the same decisions. They store sums for each (splat, block) pair, and a second kernel adds
those of each splat in a fixed order."""

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi

from mgs.splat.blocks import BlockLists
from mgs.splat.constants import ALPHA_MAX
from mgs.splat.projection import Splats
from mgs.splat.recording import frozen
from mgs.splat.walking import (
    PIXELS,
    Lane,
    PixelRow,
    blend,
    computed_after,
    lanes,
    pack_parts,
    recorded_sizes,
    sums_by_place,
    unpack,
    walk,
    walk_and_store,
    without_denormals,
)

LN2 = 0.6931471805599453


def _pixel_sums(
    lists: BlockLists, packed: Any, lane: Lane, T: list[Any], numbers: Callable[[Splats], list[Any]]
) -> Any:
    """[T, sum w n, ...] of each pixel of a lane, with a sum for each of a splat's numbers n. T: as
    in `blend`."""
    # State of a pixel: its transmittance T, then the sums of w n, front to back.
    count = len(numbers(unpack(packed, mi.UInt32(0))))
    pixels = [[t, *(dr.zeros(type(packed), len(lane.first)) for _ in range(count))] for t in T]

    def draw(of_splat: list[Any], raw: Any, _xi: Any, _eta: Any, pixel: list[Any]) -> list[Any]:
        T, *sums = pixel
        # T <- T (1 - alpha) and sum <- sum + w n, with w = alpha T.
        _, w, after, _ = blend(raw, T)
        return [after, *(dr.fma(n, w, s) for n, s in zip(of_splat, sums, strict=True))]

    return walk(lists, packed, lane, pixels, draw, lambda _, splat: numbers(splat))


@frozen(recorded_sizes)
def forward(lists: BlockLists, packed: Any, whole: bool) -> tuple[Any, ...]:
    """Image of packed splats: Float arrays rgba [L*32*4] and, if `whole`, depth [L*32].

    Pixels are stored block by block, in a block row by row. Colour is sum w c, without background;
    alpha is sum w; depth is sum w z, metres, not divided by alpha.

    Without `whole`, alpha is computed as 1 - T, which saves a sum. For the expected depth, a
    quotient by alpha, that difference has too few digits in faint pixels."""
    lane, T = lanes(lists)
    # Depth and alpha as sums of w z and w: a quotient of both keeps its digits.
    if whole:
        numbers = lambda splat: [*splat.colour, mi.Float(1), splat.depth]  # noqa: E731
        pixels = _pixel_sums(lists, packed, lane, T, numbers)
        return _store_pixels(lists, lane, [sums for _, *sums in pixels])
    # T of a finished pixel is negative (`blend`), so alpha = 1 - |T|.
    pixels = _pixel_sums(lists, packed, lane, T, lambda splat: splat.colour)
    return _store_pixels(lists, lane, [[*rgb, 1 - dr.abs(t)] for t, *rgb in pixels])


def _store_pixels(lists: BlockLists, lane: Lane, pixels: list[list[Any]]) -> tuple[Any, ...]:
    """Write red, green, blue, alpha and, if given, depth of each pixel in the layout of
    `forward`."""
    sizes = (4, 1) if len(pixels[0]) == 5 else (4,)
    out = tuple(dr.empty(mi.Float, len(lists.block) * PIXELS * size) for size in sizes)
    for pixel, (r, g, b, a, *depth) in enumerate(pixels):
        for array, value in zip(out, (mi.Vector4f(r, g, b, a), *depth), strict=True):
            dr.scatter(array, value, lane.first + pixel, mode=dr.ReduceMode.NoConflicts)
    return out


# Powers (a, b) of the monomials xi^a eta^b up to second order. The derivative of ln alpha of a
# pixel by any parameter is a polynomial of these.
POWERS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))


def log_alpha_tangent(tangents: Splats, splats: Splats) -> dict[tuple[int, int], Any]:
    """Derivative of ln alpha of a pixel along `tangents` of the splats: coefficients of `POWERS`,
    arrays [N]. By the chain rule through xi and eta. It does not hold where alpha is clamped.
    Letters p, k, e: docs/notation.md."""
    k, p, e = splats.shear, splats.white_x, splats.white_y
    # ln alpha = ln 2 (log2 o - xi^2 - eta^2) with xi = p (dx - k dy), eta = e dy, so its tangent is
    # ln 2 (d log2 o - 2 xi dxi - 2 eta deta). A centre that moves by (u', v') gives dxi = -p (u' -
    # k v'), deta = -e v'; k' gives dxi = -p dy k' = -(p/e) eta k'; p' gives dxi = (p'/p) xi, and e'
    # deta = (e'/e) eta.
    one = LN2 * tangents.log2_opacity
    xi = 2 * LN2 * p * (tangents.mean_x - k * tangents.mean_y)
    eta = 2 * LN2 * e * tangents.mean_y
    xi_xi = -2 * LN2 / p * tangents.white_x
    xi_eta = 2 * LN2 * p / e * tangents.shear
    eta_eta = -2 * LN2 / e * tangents.white_y
    return dict(zip(POWERS, (one, xi, eta, xi_xi, xi_eta, eta_eta), strict=True))


def pack_tangents(tangents: Splats, splats: Splats, place: Any) -> Any:
    """Pack the tangents of each splat at its `place`: Float [12 N], evaluated. tangents:
    derivatives of the splats' fields (`_rest` fields are not read). Packed are the coefficients of
    `log_alpha_tangent` and the tangents of depth and colour."""
    # Six coefficients of the tangent of ln alpha, then those of depth and colour.
    one, xi, eta, xi_xi, xi_eta, eta_eta = log_alpha_tangent(tangents, splats).values()
    return pack_parts(
        [[one, xi, eta, xi_xi], [xi_eta, eta_eta, tangents.depth, 0], [*tangents.colour, 0]], place
    )


def _tangents_at(lists: BlockLists, packed_tangents: Any, pair: Any) -> tuple[Any, Any, Any]:
    """What `pack_tangents` packed for the splat of a pair: coefficients of the tangent of ln alpha,
    tangents of its colour and of its depth."""
    place = dr.gather(mi.UInt32, lists.splat, pair)
    (*first, xi_xi), (xi_eta, eta_eta, d_depth, _), (*d_colour, _) = (
        dr.gather(mi.Vector4f, packed_tangents, place * 3 + part) for part in range(3)
    )
    return [*first, xi_xi, xi_eta, eta_eta], d_colour, d_depth


def _blend_tangent(
    by_log_alpha: list[Any], raw: Any, xi: Any, eta: Any, T: Any, d_alpha_so_far: Any
) -> tuple[Any, ...]:
    """The four results of `blend`, then the tangents of alpha and w."""
    one, by_xi, by_eta, xi_xi, xi_eta, eta_eta = by_log_alpha
    alpha, w, after, room = blend(raw, T)
    # d ln alpha = one + by_eta eta + eta_eta eta^2 + (by_xi + xi_eta eta) xi + xi_xi xi^2.
    constant = dr.fma(dr.fma(eta_eta, eta, by_eta), eta, one)
    linear = dr.fma(xi_eta, eta, by_xi)
    d_log_alpha = dr.fma(dr.fma(xi_xi, xi, linear), xi, constant)
    # d alpha = alpha d ln alpha, 0 where alpha is clamped; then dw = T d alpha + alpha dT.
    drawn = dr.select(room, alpha, 0)
    d_alpha = dr.select(raw <= ALPHA_MAX, drawn * d_log_alpha, 0)
    return alpha, w, after, room, d_alpha, dr.fma(d_alpha, T, -drawn * d_alpha_so_far)


@frozen(recorded_sizes)
def jvp(lists: BlockLists, packed: Any, packed_tangents: Any) -> tuple[Any, ...]:
    """Derivative of the output of `forward` along tangents of the splats (`pack_tangents`), in the
    same layout.

    It is J v for the Jacobian J of `forward` and tangents v, in one pass front to back (forward
    mode). With alpha' the tangent of a splat's alpha, T the transmittance and dT its tangent,
    dw = alpha' T + alpha dT is the tangent of the weight w, the next splat's dT is dT - dw, and the
    colour changes by c dw + w dc. dT = -(sum of dw so far), minus the tangent of the pixel's alpha,
    so it is not stored. Where alpha is clamped at ALPHA_MAX or the splat is not drawn, alpha' is 0.
    """
    lane, T = lanes(lists)
    # State of a pixel: T, the tangent of its alpha so far (-dT), then those of r, g, b and depth.
    pixels = [[t, *(dr.zeros(mi.Float, len(lane.first)) for _ in range(5))] for t in T]

    def start(pair: Any, splat: Splats) -> tuple[list[Any], list[Any], list[Any]]:
        by_log_alpha, d_colour, d_depth = _tangents_at(lists, packed_tangents, pair)
        return by_log_alpha, [*splat.colour, splat.depth], [*d_colour, d_depth]

    def draw(of_splat: Any, raw: Any, xi: Any, eta: Any, pixel: list[Any]) -> list[Any]:
        by_log_alpha, numbers, tangents = of_splat
        T, d_alpha_so_far, *sums = pixel
        _, w, after, _, _, dw = _blend_tangent(by_log_alpha, raw, xi, eta, T, d_alpha_so_far)
        # d(sum of w n) grows by n dw + w dn.
        sums = [
            dr.fma(n, dw, dr.fma(w, dn, s))
            for n, dn, s in zip(numbers, tangents, sums, strict=True)
        ]
        return [after, d_alpha_so_far + dw, *sums]

    pixels = walk(lists, packed, lane, pixels, draw, start)
    ordered = ([*rgb, alpha, z] for _, alpha, *rgb, z in pixels)
    return _store_pixels(
        lists, lane, [[without_denormals(x) for x in values] for values in ordered]
    )


def _finished(pixels: Any, background: Any, real: Any) -> Any:
    """Finished colours of pixels over a background (Color3f), from the [T, r, g, b] of
    `_pixel_sums`."""
    return [
        [dr.fma(dr.abs(t), real(b), c) for c, b in zip(rgb, background, strict=True)]
        for t, *rgb in pixels
    ]


def _slopes(
    colours: list[Any],
    behind: list[Any],
    alpha: Any,
    w: Any,
    after: Any,
    free: Any,
    last: Any = None,
) -> list[Any]:
    """s_c = D_c alpha, the derivative of each channel of a pixel by ln alpha of one splat, Float.

    colours: of the splat, c. behind: the colour S composited behind it.
    w, after: weight and transmittance from `blend`.
    free: mask of pixels where the splat is drawn and alpha is not clamped; elsewhere it is 0.
    last: T_end, the transmittance of the finished pixel, times any factor. If given,
        T_end alpha / (1 - alpha) is appended, the derivative of the pixel's alpha, 1 - T_end.

    In double it is alpha / (1 - alpha) times the difference c T (1 - alpha) - S. Only the
    difference can cancel, so the rest may be single. In single precision 1 - alpha has few digits
    in opaque pixels, so c w - S alpha / (1 - alpha) is used, whose first term does not contain it.
    """
    pairs = zip(colours, behind, strict=True)
    if type(alpha) is mi.Float64:
        # w / after = alpha T / (T (1 - alpha)) = alpha / (1 - alpha).
        odds = dr.select(free, mi.Float(w) / mi.Float(after), 0)
        slopes = [odds * mi.Float(dr.fma(c, after, -s)) for c, s in pairs]
    else:
        odds = alpha / (1 - alpha)
        slopes = [dr.select(free, dr.fma(c, w, -s * odds), 0) for c, s in pairs]
    return slopes if last is None else [*slopes, dr.select(free, odds * last, 0)]


ADJOINT_SUMS = {False: 8, True: 10}  # sums per splat of `adjoint`, without and with means


@frozen(recorded_sizes)
def adjoint(
    lists: BlockLists,
    packed: Any,
    out: tuple[Any, ...],
    d_out: tuple[Any, ...],
    means: bool,
    channels: int,
) -> Any:
    """Sums over pixels for `splat_gradient`, to be read by `sums_by_splat`.

    out, d_out: output of `forward`, and the gradient dL of a loss by it.
    channels: how many of red, green, blue, alpha and depth the loss depends on, at least 3. The
        others are not read; without depth its sum is 0.

    Sums: w dL for red, green, blue and depth (4). With s the derivative of the loss by ln alpha at
    the pixel: s times 1, xi^2, xi eta, eta^2 (4), and, if means have gradients, s times xi, eta
    (2)."""
    # State of a pixel: T, and the loss behind the current splat, <dL, S>: it starts as <dL, C> and
    # falls by <dL, c> w with each splat. One number replaces the colours behind.
    lane, T = lanes(lists)
    dL, pixels = [], []
    for pixel in range(len(T)):
        places = lane.first + pixel
        # <dL, C> of the finished pixel, over all channels that the loss depends on.
        rgba, d_rgba = (list(dr.gather(mi.Vector4f, a[0], places)) for a in (out, d_out))
        values, slopes = rgba[:channels], d_rgba[:channels]
        if channels == 5:
            values = [*rgba, dr.gather(mi.Float, out[1], places)]
            slopes = [*d_rgba, dr.gather(mi.Float, d_out[1], places)]
        dL.append(slopes)
        pixels.append([T[pixel], sum(v * d for v, d in zip(values, slopes, strict=True))])
    count = ADJOINT_SUMS[means]

    def visit(_pair: Any, splat: Splats, rows: list[PixelRow], pixels: Any) -> Any:
        new, alive = [], mi.Bool(False)
        sums, (r, g, b) = [mi.Float(0)] * 10, splat.colour
        for j, row in enumerate(rows):
            m0, m1, m2 = mi.Float(0), mi.Float(0), mi.Float(0)
            for x, (raw, xi) in enumerate(zip(row.raw_alpha, row.xi, strict=True)):
                raw = computed_after(raw, [*sums[:4], m0, m1, m2] if x else sums if j else [])
                transmittance, behind = pixels[j * lane.columns + x]
                dr_, dg, db, *others = dL[j * lane.columns + x]
                # c = <dL, c>: what a unit of this splat's weight adds to the loss.
                alpha, w, after, room = blend(raw, transmittance)
                c = dr.fma(b, db, others[0]) if others else b * db  # others: alpha, depth
                if len(others) == 2:
                    c = dr.fma(splat.depth, others[1], c)
                    sums[3] = dr.fma(w, others[1], sums[3])
                c = dr.fma(r, dr_, dr.fma(g, dg, c))
                behind = dr.fma(-c, w, behind)
                new.append([after, behind])
                alive |= room
                # s = dL / d ln alpha = alpha (<dL, c> T - <dL, S> / (1 - alpha)).
                (slope,) = _slopes([c], [behind], alpha, w, after, room & (raw <= ALPHA_MAX))
                # dL / dc = sum of w dL, by channel.
                sums[:3] = [dr.fma(w, d, s) for d, s in zip((dr_, dg, db), sums[:3], strict=True)]
                # Moments of the row: sums of s, s xi, s xi^2.
                first = slope * xi
                m0, m1, m2 = m0 + slope, m1 + first, dr.fma(first, xi, m2)
            # eta is constant along a row: s xi eta and s eta^2 follow from the row's moments.
            eta_m0 = row.eta * m0
            moments = (m0, m2, m1 * row.eta, eta_m0 * row.eta, m1, eta_m0)
            sums[4:] = [a + b for a, b in zip(sums[4:], moments, strict=True)]
        return new, alive, sums[:count]

    by_pair = walk_and_store(lists, packed, lane, pixels, visit, count)
    return sums_by_place(lists, by_pair, count, mi.Float)


def splat_gradient(sums: list[Any], splats: Splats) -> Splats:
    """Gradient by the splats' fields, from the sums of `adjoint`, by the chain rule through xi and
    eta. mean_x and mean_y are None if their sums are missing. Letters p, k, e: docs/notation.md."""
    # Transpose of `log_alpha_tangent`: each field's gradient is its coefficient there times the
    # sum.
    # dL/dp = sum s d(ln alpha)/dp = -(2 ln 2 / p) sum s xi^2, and so on.
    red, green, blue, depth, one, xi_xi, xi_eta, eta_eta, *first = sums
    k, p, e = splats.shear, splats.white_x, splats.white_y
    mean_x = mean_y = None
    if first:
        xi, eta = first
        mean_x, mean_y = 2 * LN2 * p * xi, 2 * LN2 * (e * eta - p * k * xi)
    return Splats(
        mean_x=mean_x,
        mean_y=mean_y,
        shear=2 * LN2 * p / e * xi_eta,
        white_x=-2 * LN2 / p * xi_xi,
        white_y=-2 * LN2 / e * eta_eta,
        log2_opacity=LN2 * one,
        depth=depth,
        red=red,
        green=green,
        blue=blue,
    )


def fisher_moments(cross: bool, means: bool) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """Powers (a, b) of the monomials xi^a eta^b that `fisher` sums: weighted by |s|^2, and by w s_c
    for each channel c. cross: products with colours are needed. means: derivatives by the means are
    needed, which alone contain xi and eta to the first power."""
    # Without means, d ln alpha has orders 0 and 2, so its squares have 0, 2 and 4; products with a
    # colour have 0 and 2. Means add order 1, and so 1 and 3 to the squares.
    squared, mixed = [0, 4, 2], [0, 2] if cross else []
    if means:
        squared += [1, 3]
        mixed += [1] if cross else []
    return tuple(
        [(order - b, b) for order in orders for b in range(order + 1)]
        for orders in (squared, mixed)
    )  # type: ignore


def fisher_sums(cross: bool, means: bool, weighted: bool = False) -> int:
    """Number of sums per splat of `fisher`: 10 for the exact diagonal, 22 for blocks; with means
    16, and 34 with `cross`. If weighted, w^2 has a sum for each channel: two more."""
    squared, mixed = fisher_moments(cross, means)
    return (3 if weighted else 1) + len(squared) + 3 * len(mixed)


def _monomial(in_xi: list[Any], power: tuple[int, int], eta: Any, eta2: Any) -> Any:
    """The moment xi^a eta^b of one row of pixels, from its moments in xi. eta2 = eta^2."""
    a, b = power
    moment = in_xi[a]
    for factor in [eta2] * (b // 2) + [eta] * (b % 2):
        moment = moment * factor
    return moment


@frozen(recorded_sizes)
def fisher(
    lists: BlockLists,
    packed: Any,
    background: Any,
    cross: bool,
    means: bool = False,
    alpha_weight: Any = None,
    roots: Any = None,
) -> Any:
    """Sums over pixels for `mgs.splat.information`, to be read by `sums_by_splat`.

    With s_c = D_c alpha the derivative of channel c by ln alpha, and |s|^2 the sum of s_c^2, they
    are w^2, then the monomials of `fisher_moments` times |s|^2 and, if `cross`, times w s_r, w s_g
    and w s_b.

    background: Color3f, linear RGB.
    alpha_weight: Float [1], if alpha is a fourth channel, which adds alpha_weight s_alpha^2 to
        |s|^2, with s_alpha = T_end alpha / (1 - alpha).
    roots: square roots of the weights of r, g, b and alpha, Float [L*32*4] in the layout of
        `forward`. Channel c and its s_c are multiplied by them, and w^2 is summed by channel.

    Off-diagonal entries of blocks are sums that cancel, so for blocks give splats packed in double
    (`project64`). Pixels are then computed in double; only sums within a block are single."""
    # First pass: the finished colour C of each pixel, from which the second subtracts.
    real = type(packed)
    lane, T = lanes(lists)
    T = [real(t) for t in T]
    pixels = _pixel_sums(lists, packed, lane, T, lambda splat: splat.colour)
    behind, last = _finished(pixels, background, real), [None] * len(T)
    # T_end sqrt(alpha_weight): the fourth channel, alpha, as a colour that all splats share.
    if alpha_weight is not None:
        last = [mi.Float(dr.abs(t)) * dr.sqrt(alpha_weight) for t, *_ in pixels]
    factors = [
        [] if roots is None else list(dr.gather(mi.Vector4f, roots, lane.first + pixel))
        for pixel in range(len(T))
    ]
    dr.eval(behind, last, factors)
    # Second pass: per pair, the sums over the pixels of its block, row by row.
    squared, mixed = fisher_moments(cross, means)
    count, of_colour = fisher_sums(cross, means, roots is not None), 1 if roots is None else 3

    def visit(_pair: Any, splat: Splats, rows: list[PixelRow], pixels: Any) -> Any:
        new, alive = [], mi.Bool(False)
        sums = [mi.Float(0)] * count
        for j, row in enumerate(rows):
            # m[a] = sum over the row of |s|^2 xi^a, a = 0 to 4; cross_m[c][a] = sum of w s_c xi^a,
            # a = 0 to 2. Powers of eta, constant along the row, are multiplied in at its end.
            m = [mi.Float(0)] * 5
            cross_m = [[mi.Float(0)] * 3 for _ in range(3)]
            for x, (raw, xi) in enumerate(zip(row.raw_alpha, row.xi, strict=True)):
                pixel = j * lane.columns + x
                in_row = [*sums[:of_colour], *m, *(c for a in cross_m for c in a)]
                raw = computed_after(raw, in_row if x else sums if j else [])
                transmittance, *behind = pixels[pixel]
                alpha, w, after, room = blend(raw, transmittance)
                # S <- S - c w: the colour composited behind this splat.
                behind = [dr.fma(-c, w, s) for c, s in zip(splat.colour, behind, strict=True)]
                new.append([after, *behind])
                alive |= room
                free = room & (raw <= ALPHA_MAX)
                # s_c = alpha (c T - S / (1 - alpha)), and s_alpha if alpha is observed.
                slopes = _slopes(splat.colour, behind, alpha, w, after, free, last[pixel])
                w, xi = mi.Float(w), mi.Float(xi)
                # Weighted: channel c of the pixel times the root of its weight.
                weights = [w] * 3
                if factors[pixel]:
                    slopes = [s * root for s, root in zip(slopes, factors[pixel], strict=False)]
                    weights = [w * root for root in factors[pixel][:3]]
                # Colours: sum of w^2.
                for c in range(of_colour):
                    sums[c] = dr.fma(weights[c], weights[c], sums[c])
                # Footprint and opacity: |s|^2 times 1, xi, xi^2, xi^3, xi^4.
                square = sum(s * s for s in slopes)
                xi2 = xi * xi
                m[0], m[1] = m[0] + square, dr.fma(square, xi, m[1])
                m[2] = dr.fma(square, xi2, m[2])
                power = square * xi2
                m[3], m[4] = dr.fma(power, xi, m[3]), dr.fma(power, xi2, m[4])
                # Colour times footprint: w s_c times 1, xi, xi^2.
                for c, s in enumerate(slopes[:3] if cross else []):
                    ws = weights[c] * s
                    a = cross_m[c]
                    cross_m[c] = [a[0] + ws, dr.fma(ws, xi, a[1]), dr.fma(ws, xi2, a[2])]
            # Moments of the pair: += xi^a eta^b of the row, for each power (a, b).
            eta = mi.Float(row.eta)
            eta2 = eta * eta
            moments = [_monomial(m, power, eta, eta2) for power in squared]
            moments += [_monomial(a, power, eta, eta2) for a in cross_m for power in mixed]
            pairs = zip(sums[of_colour:], moments, strict=True)
            sums[of_colour:] = [a + b for a, b in pairs]
        return new, alive, sums

    pixels = [[t, *c] for t, c in zip(T, behind, strict=True)]
    by_pair = walk_and_store(lists, packed, lane, pixels, visit, count)
    return sums_by_place(lists, by_pair, count, mi.Float64)


@frozen(recorded_sizes)
def squared_weights(lists: BlockLists, packed: Any) -> Any:
    """The first sum of `fisher`, w^2, alone: one pass, in which colours are not read."""
    lane, T = lanes(lists)

    def visit(_pair: Any, _splat: Splats, rows: list[PixelRow], pixels: Any) -> Any:
        new, alive, total = [], mi.Bool(False), mi.Float(0)
        for pixel, (transmittance,) in enumerate(pixels):
            raw = rows[pixel // lane.columns].raw_alpha[pixel % lane.columns]
            raw = computed_after(raw, [total] if pixel else [])
            _, w, after, room = blend(raw, transmittance)
            new.append([after])
            alive |= room
            total = dr.fma(w, w, total)
        return new, alive, [total]

    by_pair = walk_and_store(lists, packed, lane, [[t] for t in T], visit, 1)
    return sums_by_place(lists, by_pair, 1, mi.Float64)


@frozen(recorded_sizes)
def fisher_jvp(
    lists: BlockLists, packed: Any, packed_tangents: Any, out: Any, d_out: Any, background: Any
) -> Any:
    """Derivative of the sums of `fisher`, without `cross` and `means`, along tangents of the splats
    (`pack_tangents`) at constant xi and eta.

    They are 2 w dw, then 2 <s, ds> times the monomials, whose change the caller adds. With S the
    colour behind, ds_c = c dw + w dc - dS_c alpha / (1 - alpha) - S_c dalpha / (1 - alpha)^2.
    out, d_out: rgba of `forward` and of `jvp`. background: Color3f, linear RGB."""
    lane, T = lanes(lists)
    # State of a pixel: T, the tangent of its alpha so far, S and dS, at first of the whole pixel.
    pixels: list[list[Any]] = []
    for pixel, t in enumerate(T):
        rgba, d_rgba = (dr.gather(mi.Vector4f, x, lane.first + pixel) for x in (out, d_out))
        behind = [dr.fma(1 - rgba[3], b, rgba[c]) for c, b in enumerate(background)]
        d_behind = [dr.fma(-d_rgba[3], b, d_rgba[c]) for c, b in enumerate(background)]
        pixels.append([t, dr.zeros(mi.Float, len(lane.first)), *behind, *d_behind])
    squared, count = fisher_moments(False, False)[0], fisher_sums(False, False)

    def visit(pair: Any, splat: Splats, rows: list[PixelRow], pixels: Any) -> Any:
        by_log_alpha, d_colour, _ = _tangents_at(lists, packed_tangents, pair)
        new, alive, sums = [], mi.Bool(False), [mi.Float(0)] * count
        for j, row in enumerate(rows):
            m = [mi.Float(0)] * 5  # sums over the row of 2 <s, ds> xi^a
            for x, (raw, xi) in enumerate(zip(row.raw_alpha, row.xi, strict=True)):
                raw = computed_after(raw, [sums[0], *m] if x else sums if j else [])
                T, so_far, *behind = pixels[j * lane.columns + x]
                alpha, w, after, room, d_alpha, dw = _blend_tangent(
                    by_log_alpha, raw, xi, row.eta, T, so_far
                )
                alive |= room
                odds, power = alpha / (1 - alpha), mi.Float(0)
                d_odds = d_alpha / dr.square(1 - alpha)
                for c, (n, dn) in enumerate(zip(splat.colour, d_colour, strict=True)):
                    grown = dr.fma(n, dw, w * dn)  # d(c w)
                    behind[c] = S = dr.fma(-n, w, behind[c])
                    behind[3 + c] = dS = behind[3 + c] - grown
                    power = dr.fma(n * w - S * odds, grown - dS * odds - S * d_odds, power)
                new.append([after, so_far + dw, *behind])
                sums[0] = dr.fma(2 * w, dw, sums[0])
                power = dr.select(room & (raw <= ALPHA_MAX), 2 * power, 0)
                for a in range(5):
                    m[a] = m[a] + power
                    power = power * xi
            eta2 = row.eta * row.eta
            moments = [_monomial(m, power, row.eta, eta2) for power in squared]
            sums[1:] = [a + b for a, b in zip(sums[1:], moments, strict=True)]
        return new, alive, sums

    by_pair = walk_and_store(lists, packed, lane, pixels, visit, count)
    return sums_by_place(lists, by_pair, count, mi.Float64)


@frozen(recorded_sizes)
def removal(lists: BlockLists, packed: Any, background: Any) -> Any:
    """Sum over pixels of alpha^2 |D|^2 of each splat, to be read by `sums_by_splat` (one sum,
    Float64). A pixel is affine in the alpha of each splat, with slope D. So setting alpha to 0
    changes it by exactly -alpha D, also where alpha is clamped. Effects on the thresholds of other
    splats are ignored. background: Color3f, linear RGB."""
    lane, T = lanes(lists)
    pixels = _pixel_sums(lists, packed, lane, T, lambda splat: splat.colour)
    behind = _finished(pixels, background, mi.Float)
    dr.eval(behind)

    def visit(_pair: Any, splat: Splats, rows: list[PixelRow], pixels: Any) -> Any:
        new, alive, total = [], mi.Bool(False), mi.Float(0)
        for pixel, (transmittance, *behind) in enumerate(pixels):
            raw = rows[pixel // lane.columns].raw_alpha[pixel % lane.columns]
            alpha, w, after, room = blend(raw, transmittance)
            behind = [dr.fma(-c, w, s) for c, s in zip(splat.colour, behind, strict=True)]
            new.append([after, *behind])
            alive |= room
            # alpha D_c in each channel, also where alpha is clamped (mask `room` alone).
            total += sum(s * s for s in _slopes(splat.colour, behind, alpha, w, after, room))
        return new, alive, [total]

    pixels = [[t, *c] for t, c in zip(T, behind, strict=True)]
    by_pair = walk_and_store(lists, packed, lane, pixels, visit, 1)
    return sums_by_place(lists, by_pair, 1, mi.Float64)
