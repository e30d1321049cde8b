"""The three kernels: forward, adjoint, Fisher. One SIMD lane owns one block of pixels and walks its list front to back.

All loops here run at trace time over the BLOCK_X x BLOCK_Y pixels of a lane; nothing runs over Gaussians or pixels in Python.
One gather of a splat serves all the lane's pixels, and one store per (splat, block) pair carries their sum: gathers and
stores, not arithmetic, are what splatting on a CPU spends its time on. Sums go to the pair's own slot and a second kernel adds
each splat's contiguous slots, so there are no atomics and every rerun is bitwise equal, whatever the number of threads.

Notation as in 3DGS: w = alpha T, C = sum w c; S is the colour behind a splat, and D = dC/d(alpha) = c T - S / (1 - alpha).
The adjoint and Fisher walk front to back again with S = C - (colour so far): decisions (thresholds, stop) are recomputed by
the same instructions, so they are the same, and no per-pixel index has to be kept.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mgs.splat.blocks import BLOCK_X, BLOCK_Y, BlockLists
from mgs.splat.constants import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from mgs.splat.projection import Splats
from mgs.splat.recording import frozen

PIXELS = BLOCK_X * BLOCK_Y

LN2 = 0.6931471805599453

DENORMAL = 1e-24
"""Sums smaller than this become 0: threads differ in how they flush denormals, and nothing else would differ between reruns.
So far above the smallest float (1e-38), no product of a sum that is kept, and no error of one that is, can be denormal."""


def _baked(lists: BlockLists, *others: Any) -> tuple[int, ...]:
    """What a recording of a kernel bakes in: the lengths of its buffers, and its flag."""
    return len(lists.splat), len(lists.slot_start), len(lists.block), *(x for x in others if isinstance(x, bool))


def pack(s: Splats, place: Any) -> Any:
    """Detached splats at the places of their block lists. Of `project`: Float [16 N], one cache line each, (u, v, k, p),
    (e, log2_opacity, z, u_rest), (r, g, b, v_rest), (k_rest, three unused). Of `project64`: Float64 [12 N], (u, v, k, p),
    (e, log2_opacity, z, unused), (r, g, b, unused)."""
    shape, colour = [s.u, s.v, s.k, s.p], s.colour
    if s.u_rest is None:
        real, vector, parts = mi.Float64, mi.Vector4d, [shape, [s.e, s.log2_opacity, s.z, 0], [*colour, 0]]
    else:
        real, vector = mi.Float, mi.Vector4f
        parts = [shape, [s.e, s.log2_opacity, s.z, s.u_rest], [*colour, s.v_rest], [s.k_rest, 0, 0, 0]]
    packed = dr.empty(real, 4 * len(parts) * len(s.u))
    for i, part in enumerate(parts):
        dr.scatter(packed, vector(*part), place * len(parts) + i, mode=dr.ReduceMode.NoConflicts)
    dr.eval(packed)
    return packed


def _unpack(packed: Any, place: Any) -> Splats:
    """The splats at the given places: u, v, k Float64, the other numbers as exact as they were packed."""
    if type(packed) is mi.Float64:
        (u, v, k, p), (e, log2_opacity, z, _), (r, g, b, _) = (dr.gather(mi.Vector4d, packed, place * 3 + i) for i in range(3))
        return Splats(u, v, k, p, e, log2_opacity, z, r, g, b)
    (u, v, k, p), (e, log2_opacity, z, u_rest), (r, g, b, v_rest), (k_rest, *_) = (
        dr.gather(mi.Vector4f, packed, place * 4 + i) for i in range(4)
    )
    double = mi.Float64
    u, v, k = double(u) + double(u_rest), double(v) + double(v_rest), double(k) + double(k_rest)
    return Splats(u, v, k, p, e, log2_opacity, z, r, g, b)


@dataclass
class Lane:
    """Where a lane is: pixel of its first corner (Float), its range of pairs (UInt32)."""

    x: Any
    y: Any
    start: Any
    end: Any


def _lane(lists: BlockLists) -> tuple[Lane, list[Any]]:
    """The lanes and, per pixel, transmittance 1 inside the image and 0 (finished) outside."""
    x, y = (lists.block % lists.blocks_x) * BLOCK_X, (lists.block // lists.blocks_x) * BLOCK_Y
    T = [
        dr.select((x + i < lists.width) & (y + j < lists.height), mi.Float(1), mi.Float(0))
        for j in range(BLOCK_Y)
        for i in range(BLOCK_X)
    ]
    return Lane(mi.Float(x) + 0.5, mi.Float(y) + 0.5, lists.start, lists.end), T


@dataclass
class Row:
    """One row of a lane's pixels under one splat: eta and, per pixel, xi and the unclamped alpha."""

    eta: Any
    xi: list[Any]
    raw: list[Any]


EXP2 = (1.0, 0.69314720574, 0.24022646891, 0.05550328776, 0.00961848896, 0.00133999314, 0.00015345812)
"""Polynomial of 2^x on [-1/2, 1/2] of small relative error, 3e-9, and none at 0 (Remez exchange)."""


def exp2(x: Any) -> Any:
    """2^x, relative error 3e-9 (of a Float: 8e-8), for x up to 120, and 2^-120 for x below -120. Half the instructions of
    dr.exp2, which also knows infinity and zero: an alpha of 2^-120 is not drawn, whatever it is."""
    integer, bits = (mi.Int64, 52) if type(x) is mi.Float64 else (mi.Int32, 23)
    x = dr.select(x > -120, x, -120)
    whole = dr.round(x)
    part = x - whole
    value = type(x)(EXP2[-1])
    for coefficient in EXP2[-2::-1]:
        value = dr.fma(value, part, coefficient)
    return dr.reinterpret_array(type(x), dr.reinterpret_array(integer, value) + (integer(whole) << bits))


CENTRE = BLOCK_X // 2
"""Column from which a row's alphas are stepped outwards."""


def _rows(lane: Lane, s: Splats) -> list[Row]:
    """alpha = 2^(log2_opacity - xi^2 - eta^2) on the lane's pixels.

    The lane's corner is placed in double: far along a slanted needle, xi is a small difference of large numbers. alpha is
    stepped along a row by multiplication, as the exponent is quadratic there: three exp2 a row, not eight, for rounding errors
    four times as large. Starting from the middle, nothing underflows: EPS2D keeps p below 1.6, so alpha there is at least
    2^-100 wherever the row has a pixel drawn. Where it is less (a splat that shrank since its lists were built may be far
    away), steps only make it smaller, since `exp2` returns too much below 2^-120.
    """
    real = type(s.p)
    dx, dy = mi.Float64(lane.x) - s.u, mi.Float64(lane.y) - s.v
    corner, down = real(mi.Float64(s.p) * (dx - s.k * dy)), real(dy)
    pk, bend = s.p * real(s.k), exp2(-2 * s.p * s.p)
    rows = []
    for j in range(BLOCK_Y):
        eta = s.e * (down + j)
        first = dr.fma(-pk, real(j), corner)
        xi = [dr.fma(s.p, real(i), first) for i in range(BLOCK_X)]
        row = dr.fma(-eta, eta, s.log2_opacity)
        middle = xi[CENTRE]
        power = dr.fma(-middle, middle, row)
        raw = [exp2(power)] * BLOCK_X
        for columns, sign in ((range(CENTRE + 1, BLOCK_X), -1), (range(CENTRE - 1, -1, -1), 1)):
            step = s.p * dr.fma(real(2 * sign), middle, -s.p)
            ratio = exp2(dr.select(power > -120, step, -120))
            for i in columns:
                raw[i] = raw[i + sign] * ratio
                ratio = ratio * bend
        rows.append(Row(eta, xi, raw))
    return rows


def _blend(raw: Any, T: Any) -> tuple[Any, Any, Any, Any]:
    """One splat at one pixel: alpha (0 where it is not drawn), w = alpha T, transmittance after it, and whether any is left.

    A finished pixel carries its transmittance negated, so it draws nothing more and its alpha is still known. Comparisons and
    selects, not dr.minimum: that must propagate NaN, which costs five instructions.
    """
    alpha = dr.select(raw >= ALPHA_MIN, dr.select(raw <= ALPHA_MAX, raw, ALPHA_MAX), 0)
    after = dr.fma(-alpha, T, T)
    room = after > TRANSMITTANCE_MIN
    alpha = dr.select(room, alpha, 0)
    return alpha, alpha * T, dr.select(room, after, -dr.abs(T)), room


def _walk(lists: BlockLists, packed: Any, lane: Lane, pixels: list[list[Any]], visit: Callable[..., Any]) -> list[list[Any]]:
    """Walk the lists front to back until they end or no pixel has transmittance left; returns the last state of the pixels.

    visit(i, splat, rows, pixels) -> (pixels, alive) draws the splat of pair i on the lane's pixels. Their states stay
    together, pixel by pixel, since the compiler keeps that order: each is then finished before the next needs registers.
    """

    def body(i: Any, pixels: Any, alive: Any) -> Any:
        splat = _unpack(packed, dr.gather(mi.UInt32, lists.splat, i))
        pixels, alive = visit(i, splat, _rows(lane, splat), pixels)
        return i + 1, pixels, (i + 1 < lane.end) & alive

    start = mi.UInt32(lane.start)
    _, pixels, _ = dr.while_loop((start, pixels, start < lane.end), lambda i, pixels, alive: alive, body)
    return pixels


def _composite(lists: BlockLists, packed: Any, lane: Lane, T: list[Any], numbers: Callable[[Splats], list[Any]]) -> Any:
    """For each of a lane's pixels, [transmittance, sum w n for each of the numbers n of a splat]."""
    count = len(numbers(_unpack(packed, mi.UInt32(0))))
    pixels = [[t, *(dr.zeros(type(packed), len(lists.block)) for _ in range(count))] for t in T]

    def visit(i: Any, splat: Splats, rows: list[Row], pixels: Any) -> Any:
        new, alive = [], mi.Bool(False)
        for pixel, (T, *sums) in enumerate(pixels):
            _, w, after, room = _blend(rows[pixel // BLOCK_X].raw[pixel % BLOCK_X], T)
            new.append([after, *(dr.fma(n, w, s) for n, s in zip(numbers(splat), sums, strict=True))])
            alive |= room
        return new, alive

    return _walk(lists, packed, lane, pixels, visit)


@frozen(_baked)
def forward(lists: BlockLists, packed: Any) -> tuple[Any, Any]:
    """Composite. Returns block-major pixels: rgba Float [L*32*4] (premultiplied, no background), weighted depth [L*32].

    alpha is summed, not 1 - T: expected depth is a quotient by alpha in faint pixels, where the other has kept its last bits.
    """
    pixels = _composite(lists, packed, *_lane(lists), lambda splat: [*splat.colour, mi.Float(1), splat.z])
    rgba, depth = (dr.empty(mi.Float, len(lists.block) * PIXELS * size) for size in (4, 1))
    for pixel, (_, *colour, z) in enumerate(pixels):
        place = lists.block * PIXELS + pixel
        dr.scatter(rgba, mi.Vector4f(*colour), place, mode=dr.ReduceMode.NoConflicts)
        dr.scatter(depth, z, place, mode=dr.ReduceMode.NoConflicts)
    return rgba, depth


def _slopes(colours: list[Any], behind: list[Any], alpha: Any, w: Any, after: Any, free: Any) -> list[Any]:
    """The derivatives D alpha of a pixel's channels by ln alpha, as Float; 0 where alpha is clamped or the pixel finished.

    In double as alpha / (1 - alpha) (c T (1 - alpha) - S), where nothing but the difference cancels and the rest may be single.
    In single precision 1 - alpha would lose digits in opaque pixels, so there as c w - S alpha / (1 - alpha).
    """
    if type(alpha) is mi.Float64:
        odds = dr.select(free, mi.Float(w) / mi.Float(after), 0)
        return [odds * mi.Float(dr.fma(c, after, -s)) for c, s in zip(colours, behind, strict=True)]
    held, lost = dr.select(free, w, 0), dr.select(free, alpha / (1 - alpha), 0)
    return [dr.fma(c, held, -s * lost) for c, s in zip(colours, behind, strict=True)]


def _slots(lists: BlockLists, count: int) -> Any:
    """Room for `count` sums per pair, side by side, in whole packets of four."""
    return dr.zeros(mi.Float, len(lists.splat) * 4 * _packets(count))


def _packets(count: int) -> int:
    return -(-count // 4)


def _store(slots: Any, sums: list[Any], slot: Any) -> None:
    padded, packets = sums + [mi.Float(0)] * (-len(sums) % 4), _packets(len(sums))
    for i in range(packets):
        dr.scatter(slots, mi.Vector4f(*padded[4 * i : 4 * i + 4]), slot * packets + i, mode=dr.ReduceMode.NoConflicts)


def _per_splat(lists: BlockLists, slots: Any, count: int, real: Any) -> Any:
    """Add each splat's contiguous slots, in order and in double: [N * packets * 4] of the given type, where splats lie."""
    dr.eval(slots)
    packets = _packets(count)
    lane = dr.arange(mi.UInt32, len(lists.place) * packets)
    place, packet = lane // packets, lane % packets
    start, end = (dr.gather(mi.UInt32, a, place) for a in (lists.slot_start, lists.slot_end))

    def body(i: Any, total: Any) -> Any:
        return i + 1, total + mi.Vector4d(dr.gather(mi.Vector4f, slots, i * packets + packet))

    _, total = dr.while_loop((start, mi.Vector4d(0)), lambda i, total: i < end, body)
    total = [dr.select(dr.abs(x) > DENORMAL, x, 0) for x in total]
    return dr.ravel((mi.Vector4f if real is mi.Float else mi.Vector4d)(*total))


def by_splat(lists: BlockLists, placed: Any, count: int) -> list[Any]:
    """The sums of `_per_splat` as `count` arrays [N], in the Gaussians' order. Evaluated, since arithmetic would wait for these
    random reads: in a kernel of its own it is faster."""
    packets, vector = _packets(count), mi.Vector4f if type(placed) is mi.Float else mi.Vector4d
    sums = [x for i in range(packets) for x in dr.gather(vector, placed, lists.place * packets + i)][:count]
    dr.eval(sums)
    return sums


ADJOINT_SUMS = {False: 8, True: 10}
"""Sums per splat of `adjoint`: means frozen, means free."""


@frozen(_baked)
def adjoint(lists: BlockLists, packed: Any, out: tuple[Any, Any], d_out: tuple[Any, Any], means: bool) -> Any:
    """Sums over pixels, from which `splat_gradient` makes the gradient with respect to each splat's numbers, given `forward`'s
    output (rgba, depth) and the gradient of it; to be read through `by_splat`.

    sum w dL (4: r, g, b, z) and, with s = d alpha of the loss, sum s (1, xi^2, xi eta, eta^2), and with means=True (frozen
    means need two sums less) sum s (xi, eta).
    """
    lane, T = _lane(lists)
    dL, pixels = [], []
    for pixel in range(PIXELS):
        place = lists.block * PIXELS + pixel
        rgba, d_rgba = (dr.gather(mi.Vector4f, a[0], place) for a in (out, d_out))
        z, dz = (dr.gather(mi.Float, a[1], place) for a in (out, d_out))
        dL.append((*d_rgba, dz))
        pixels.append([T[pixel], dr.dot(rgba, d_rgba) + z * dz])
    count = ADJOINT_SUMS[means]
    slots = _slots(lists, count)

    def visit(i: Any, splat: Splats, rows: list[Row], pixels: Any) -> Any:
        new, alive = [], mi.Bool(False)
        sums, (r, g, b) = [mi.Float(0)] * 10, splat.colour
        for j, row in enumerate(rows):
            m0, m1, m2 = mi.Float(0), mi.Float(0), mi.Float(0)
            for x, (raw, xi) in enumerate(zip(row.raw, row.xi, strict=True)):
                transmittance, behind = pixels[j * BLOCK_X + x]
                dr_, dg, db, da, dz = dL[j * BLOCK_X + x]
                alpha, w, after, room = _blend(raw, transmittance)
                c = dr.fma(r, dr_, dr.fma(g, dg, dr.fma(b, db, dr.fma(splat.z, dz, da))))
                behind = dr.fma(-c, w, behind)
                new.append([after, behind])
                alive |= room
                (slope,) = _slopes([c], [behind], alpha, w, after, room & (raw <= ALPHA_MAX))
                sums[:4] = [dr.fma(w, d, s) for d, s in zip((dr_, dg, db, dz), sums[:4], strict=True)]
                first = slope * xi
                m0, m1, m2 = m0 + slope, m1 + first, dr.fma(first, xi, m2)
            eta_m0 = row.eta * m0
            moments = (m0, m2, m1 * row.eta, eta_m0 * row.eta, m1, eta_m0)
            sums[4:] = [a + b for a, b in zip(sums[4:], moments, strict=True)]
        _store(slots, sums[:count], dr.gather(mi.UInt32, lists.slot, i))
        return new, alive

    _walk(lists, packed, lane, pixels, visit)
    return _per_splat(lists, slots, count, mi.Float)


def splat_gradient(sums: list[Any], splats: Splats) -> Splats:
    """The gradient from the sums of `adjoint`; that of u and v is None where means are frozen."""
    r, g, b, z, d, xx, xy, yy, *first = sums
    k, p, e = splats.k, splats.p, splats.e
    du = dv = None
    if first:
        fx, fy = first
        du, dv = 2 * LN2 * p * fx, 2 * LN2 * (e * fy - p * k * fx)
    return Splats(du, dv, 2 * LN2 * p / e * xy, -2 * LN2 / p * xx, -2 * LN2 / e * yy, LN2 * d, z, r, g, b)


FISHER_SUMS = {False: 7, True: 22}
"""Sums per splat of `fisher`: exact diagonal, exact blocks."""


@frozen(_baked)
def fisher(lists: BlockLists, packed: Any, background: Any, block: bool) -> Any:
    """Sums over pixels and channels, from which O(N) work makes the Fisher information; to be read through `by_splat`.

    With f = (xi^2, xi eta, eta^2), s_c = D_c alpha and |s|^2 summed over channels:
    sum w^2, sum |s|^2, the five moments sum |s|^2 (xi^4, xi^3 eta, xi^2 eta^2, xi eta^3, eta^4): seven, the exact diagonal.
    block=True appends sum |s|^2 f (3) and, for c = r, g, b, sum w s_c (1) and sum w s_c f (3): 22, the exact blocks. Those
    cancel, so give it splats packed in double: then pixels are too, and only sums over a lane's pixels are single.
    background: Color3f.
    """
    real = type(packed)
    lane, T = _lane(lists)
    T = [real(t) for t in T]
    pixels = _composite(lists, packed, lane, T, lambda splat: splat.colour)
    behind = [[dr.fma(dr.abs(t), real(b), c) for c, b in zip(rgb, background, strict=True)] for t, *rgb in pixels]
    dr.eval(behind)
    count = FISHER_SUMS[block]
    slots = _slots(lists, count)

    def visit(i: Any, splat: Splats, rows: list[Row], pixels: Any) -> Any:
        new, alive = [], mi.Bool(False)
        sums = [mi.Float(0)] * 22
        for j, row in enumerate(rows):
            m = [mi.Float(0)] * 5
            cross = [[mi.Float(0)] * 3 for _ in range(3)]
            for x, (raw, xi) in enumerate(zip(row.raw, row.xi, strict=True)):
                transmittance, *behind = pixels[j * BLOCK_X + x]
                alpha, w, after, room = _blend(raw, transmittance)
                behind = [dr.fma(-c, w, s) for c, s in zip(splat.colour, behind, strict=True)]
                new.append([after, *behind])
                alive |= room
                slopes = _slopes(splat.colour, behind, alpha, w, after, room & (raw <= ALPHA_MAX))
                w, xi = mi.Float(w), mi.Float(xi)
                sums[0] = dr.fma(w, w, sums[0])
                square = sum(s * s for s in slopes)
                xi2 = xi * xi
                m[0], m[1], m[2] = m[0] + square, dr.fma(square, xi, m[1]), dr.fma(square, xi2, m[2])
                power = square * xi2
                m[3], m[4] = dr.fma(power, xi, m[3]), dr.fma(power, xi2, m[4])
                if block:
                    for c, s in enumerate(slopes):
                        ws = w * s
                        a = cross[c]
                        cross[c] = [a[0] + ws, dr.fma(ws, xi, a[1]), dr.fma(ws, xi2, a[2])]
            eta = mi.Float(row.eta)
            eta2 = eta * eta
            moments = [m[0], m[4], m[3] * eta, m[2] * eta2, m[1] * eta2 * eta, m[0] * eta2 * eta2]
            if block:
                moments += [m[2], m[1] * eta, m[0] * eta2]
                for a in cross:
                    moments += [a[0], a[2], a[1] * eta, a[0] * eta2]
            sums[1 : 1 + len(moments)] = [a + b for a, b in zip(sums[1:], moments, strict=False)]
        _store(slots, sums[:count], dr.gather(mi.UInt32, lists.slot, i))
        return new, alive

    _walk(lists, packed, lane, [[t, *c] for t, c in zip(T, behind, strict=True)], visit)
    return _per_splat(lists, slots, count, mi.Float64)
