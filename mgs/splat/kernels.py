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
from mgs.splat.frozen import frozen
from mgs.splat.project import Splats

PIXELS = BLOCK_X * BLOCK_Y

LN2 = 0.6931471805599453

DENORMAL = 1e-24
"""Sums smaller than this become 0: threads differ in how they flush denormals, and nothing else would differ between reruns.
So far above the smallest float (1e-38), no product of a sum that is kept, and no error of one that is, can be denormal."""


def _sizes(lists: BlockLists, *_: Any, **__: Any) -> tuple[int, ...]:
    """What a recording of a kernel bakes in: the lengths of its buffers."""
    return len(lists.splat), len(lists.slot_start), len(lists.block)


def pack(s: Splats, place: Any) -> Any:
    """Detached splats as Float [16 N], one cache line each, at the places of their block lists:
    (u, v, k, p), (e, log2_opacity, z, u_rest), (r, g, b, v_rest), (k_rest, three unused)."""
    n = len(s.u)
    packed = dr.empty(mi.Float, 16 * n)
    place = place * 4
    parts = ((s.u, s.v, s.k, s.p), (s.e, s.log2_opacity, s.z, s.u_rest), (s.r, s.g, s.b, s.v_rest), (s.k_rest, 0, 0, 0))
    for i, part in enumerate(parts):
        dr.scatter(packed, mi.Vector4f(*part), place + i, mode=dr.ReduceMode.NoConflicts)
    dr.eval(packed)
    return packed


def _unpack(packed: Any, splat: Any) -> list[Any]:
    """The four Vector4f of the given splats, as `pack` lists them."""
    return [dr.gather(mi.Vector4f, packed, splat * 4 + i) for i in range(4)]


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
    """One row of a lane's pixels under one splat: eta (Float) and, per pixel, xi and the unclamped alpha."""

    eta: Any
    xi: list[Any]
    raw: list[Any]


CENTRE = BLOCK_X // 2
"""Column from which a row's alphas are stepped outwards."""


def _rows(lane: Lane, splat: list[Any], stepped: bool = True) -> list[Row]:
    """alpha = 2^(log2_opacity - xi^2 - eta^2) on the lane's pixels.

    The lane's corner is placed in double: far along a slanted needle, xi is a small difference of large numbers.
    stepped: the exponent is quadratic along a row, so alpha is stepped by multiplication: three exp2 a row, not eight, for
    rounding errors four times as large. Starting from the middle, nothing underflows: EPS2D keeps p below 1.6, so alpha there
    is at least 2^-100 wherever the row has a pixel drawn.
    """
    (u, v, k, p), (e, log2_opacity, _, u_rest), (*_, v_rest), (k_rest, *_) = splat
    double = mi.Float64
    dx, dy = double(lane.x) - double(u) - double(u_rest), double(lane.y) - double(v) - double(v_rest)
    corner, down = mi.Float(double(p) * (dx - (double(k) + double(k_rest)) * dy)), mi.Float(dy)
    pk, bend = p * k, dr.exp2(-2 * p * p)
    rows = []
    for j in range(BLOCK_Y):
        eta = e * (down + j)
        first = dr.fma(-pk, mi.Float(j), corner)
        xi = [dr.fma(p, mi.Float(i), first) for i in range(BLOCK_X)]
        row = dr.fma(-eta, eta, log2_opacity)
        if not stepped:
            rows.append(Row(eta, xi, [dr.exp2(dr.fma(-x, x, row)) for x in xi]))
            continue
        middle = xi[CENTRE]
        raw = [dr.exp2(dr.fma(-middle, middle, row))] * BLOCK_X
        for columns, sign in ((range(CENTRE + 1, BLOCK_X), -1), (range(CENTRE - 1, -1, -1), 1)):
            ratio = dr.exp2(p * dr.fma(mi.Float(2 * sign), middle, -p))
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


def _walk(
    lists: BlockLists, packed: Any, lane: Lane, pixels: list[list[Any]], visit: Callable[..., Any], stepped: bool = True
) -> list[list[Any]]:
    """Walk the lists front to back until they end or no pixel has transmittance left; returns the last state of the pixels.

    visit(i, rows, rest, colour, pixels) -> (pixels, alive) draws the splat of pair i on the lane's pixels. Their states stay
    together, pixel by pixel, since the compiler keeps that order: each is then finished before the next needs registers.
    """

    def body(i: Any, pixels: Any, alive: Any) -> Any:
        splat = _unpack(packed, dr.gather(mi.UInt32, lists.splat, i))
        _, rest, colour, _ = splat
        pixels, alive = visit(i, _rows(lane, splat, stepped), rest, colour, pixels)
        return i + 1, pixels, (i + 1 < lane.end) & alive

    start = mi.UInt32(lane.start)
    _, pixels, _ = dr.while_loop((start, pixels, start < lane.end), lambda i, pixels, alive: alive, body)
    return pixels


@frozen(_sizes)
def forward(lists: BlockLists, packed: Any, stepped: bool = True) -> tuple[Any, Any, Any]:
    """Composite; stepped: see `_rows`. Returns block-major pixels: rgba Float [L*32*4] (premultiplied, no background),
    weighted depth [L*32] and transmittance [L*32].

    alpha is summed, not 1 - T, nor T the rest of alpha: expected depth is a quotient by alpha in faint pixels, and the colour
    behind a splat is a multiple of T in opaque ones, where the other has kept its last bits only.
    """
    lane, T = _lane(lists)
    pixels = [[t, *(dr.zeros(mi.Float, len(lists.block)) for _ in range(5))] for t in T]

    def visit(i: Any, rows: list[Row], rest: Any, colour: Any, pixels: Any) -> Any:
        new, alive = [], mi.Bool(False)
        for pixel, (T, r, g, b, alpha, z) in enumerate(pixels):
            _, w, after, room = _blend(rows[pixel // BLOCK_X].raw[pixel % BLOCK_X], T)
            drawn = [dr.fma(c, w, s) for c, s in zip((colour.x, colour.y, colour.z, rest.z), (r, g, b, z), strict=True)]
            new.append([after, *drawn[:3], alpha + w, drawn[3]])
            alive |= room
        return new, alive

    pixels = _walk(lists, packed, lane, pixels, visit, stepped)
    rgba, depth, through = (dr.empty(mi.Float, len(lists.block) * PIXELS * size) for size in (4, 1, 1))
    for pixel, (transmittance, r, g, b, alpha, z) in enumerate(pixels):
        place = lists.block * PIXELS + pixel
        dr.scatter(rgba, mi.Vector4f(r, g, b, alpha), place, mode=dr.ReduceMode.NoConflicts)
        dr.scatter(depth, z, place, mode=dr.ReduceMode.NoConflicts)
        dr.scatter(through, dr.abs(transmittance), place, mode=dr.ReduceMode.NoConflicts)
    return rgba, depth, through


def _held_and_lost(alpha: Any, w: Any, raw: Any) -> tuple[Any, Any]:
    """(a, b) such that the derivative of a pixel by ln alpha is D alpha = a c - b S; 0 where alpha is clamped."""
    free = raw <= ALPHA_MAX
    return dr.select(free, w, 0), dr.select(free, alpha * dr.rcp(1 - alpha), 0)


def _buffers(lists: BlockLists, count: int) -> list[Any]:
    """Room for `count` sums per pair, four to a buffer."""
    return [dr.zeros(mi.Float, len(lists.splat) * 4) for _ in range(-(-count // 4))]


def _store(buffers: list[Any], sums: list[Any], slot: Any) -> None:
    padded = sums + [mi.Float(0)] * (-len(sums) % 4)
    for n, buffer in enumerate(buffers):
        dr.scatter(buffer, mi.Vector4f(*padded[4 * n : 4 * n + 4]), slot, mode=dr.ReduceMode.NoConflicts)


def _per_splat(lists: BlockLists, buffers: list[Any], count: int) -> list[Any]:
    """Add each splat's contiguous slots, in order and in double: `count` Float64 [N], in the Gaussians' order.

    Slots are added where splats lie, one after the other in memory, and their sums move four at a time.
    """
    dr.eval(buffers)
    total = [mi.Vector4d(0) for _ in buffers]

    def body(i: Any, total: list[Any]) -> Any:
        return i + 1, [t + mi.Vector4d(dr.gather(mi.Vector4f, buffer, i)) for t, buffer in zip(total, buffers, strict=True)]

    _, total = dr.while_loop((mi.UInt32(lists.slot_start), total), lambda i, total: i < lists.slot_end, body)
    n = len(lists.place)
    placed = [dr.empty(mi.Float64, 4 * n) for _ in buffers]
    for sums, buffer in zip(total, placed, strict=True):
        dr.scatter(buffer, sums, dr.arange(mi.UInt32, n), mode=dr.ReduceMode.NoConflicts)
    dr.eval(placed)
    flat = [component for buffer in placed for component in dr.gather(mi.Vector4d, buffer, lists.place)][:count]
    return [dr.select(dr.abs(x) > DENORMAL, x, 0) for x in flat]


@frozen(_sizes)
def adjoint(lists: BlockLists, packed: Any, out: tuple[Any, Any], d_out: tuple[Any, Any], means: bool) -> Splats:
    """Gradient with respect to each splat's numbers, given `forward`'s output (rgba, depth) and the gradient of it.

    With means=False the gradients of u and v are not computed (None): frozen means need two sums less.
    """
    lane, T = _lane(lists)
    dL, pixels = [], []
    for pixel in range(PIXELS):
        place = lists.block * PIXELS + pixel
        rgba, d_rgba = (dr.gather(mi.Vector4f, a[0], place) for a in (out, d_out))
        z, dz = (dr.gather(mi.Float, a[1], place) for a in (out, d_out))
        dL.append((*d_rgba, dz))
        pixels.append([T[pixel], dr.dot(rgba, d_rgba) + z * dz])
    count = 10 if means else 8
    buffers = _buffers(lists, count)

    def visit(i: Any, rows: list[Row], rest: Any, colour: Any, pixels: Any) -> Any:
        new, alive = [], mi.Bool(False)
        sums = [mi.Float(0)] * 10
        for j, row in enumerate(rows):
            m0, m1, m2 = mi.Float(0), mi.Float(0), mi.Float(0)
            for x, (raw, xi) in enumerate(zip(row.raw, row.xi, strict=True)):
                transmittance, behind = pixels[j * BLOCK_X + x]
                dr_, dg, db, da, dz = dL[j * BLOCK_X + x]
                alpha, w, after, room = _blend(raw, transmittance)
                c = dr.fma(colour.x, dr_, dr.fma(colour.y, dg, dr.fma(colour.z, db, dr.fma(rest.z, dz, da))))
                behind = dr.fma(-c, w, behind)
                new.append([after, behind])
                alive |= room
                held, lost = _held_and_lost(alpha, w, raw)
                slope = dr.fma(c, held, -behind * lost)
                sums[:4] = [dr.fma(w, d, s) for d, s in zip((dr_, dg, db, dz), sums[:4], strict=True)]
                first = slope * xi
                m0, m1, m2 = m0 + slope, m1 + first, dr.fma(first, xi, m2)
            eta_m0 = row.eta * m0
            moments = (m0, m2, m1 * row.eta, eta_m0 * row.eta, m1, eta_m0)
            sums[4:] = [a + b for a, b in zip(sums[4:], moments, strict=True)]
        _store(buffers, sums[:count], dr.gather(mi.UInt32, lists.slot, i))
        return new, alive

    _walk(lists, packed, lane, pixels, visit)
    r, g, b, z, d, xx, xy, yy, *first = (mi.Float(x) for x in _per_splat(lists, buffers, count))
    shape, rest, *_ = _unpack(packed, lists.place)
    k, p, e = shape.z, shape.w, rest.x
    du = dv = None
    if means:
        fx, fy = first
        du, dv = 2 * LN2 * p * fx, 2 * LN2 * (e * fy - p * k * fx)
    return Splats(du, dv, 2 * LN2 * p / e * xy, -2 * LN2 / p * xx, -2 * LN2 / e * yy, LN2 * d, z, r, g, b)


@frozen(_sizes)
def fisher(lists: BlockLists, packed: Any, rgba: Any, transmittance: Any, background: Any, block: bool) -> list[Any]:
    """Sums over pixels and channels, Float64 [N] each, from which O(N) work makes the Fisher information.

    With f = (xi^2, xi eta, eta^2), s_c = D_c alpha and |s|^2 summed over channels:
    sum w^2, sum |s|^2, the five moments sum |s|^2 (xi^4, xi^3 eta, xi^2 eta^2, xi eta^3, eta^4): seven, the exact diagonal.
    block=True appends sum |s|^2 f (3) and, for c = r, g, b, sum w s_c (1) and sum w s_c f (3): 22, the exact blocks.
    rgba, transmittance: of `forward`, stepped where block is False: entries off the diagonal cancel, so blocks need alphas as
    exact as can be. background: Color3f.
    """
    lane, T = _lane(lists)
    pixels = []
    for pixel in range(PIXELS):
        out = dr.gather(mi.Vector4f, rgba, lists.block * PIXELS + pixel)
        through = dr.gather(mi.Float, transmittance, lists.block * PIXELS + pixel)
        pixels.append([T[pixel], *(dr.fma(through, b, c) for c, b in zip((out.x, out.y, out.z), background, strict=True))])
    count = 22 if block else 7
    buffers = _buffers(lists, count)

    def visit(i: Any, rows: list[Row], rest: Any, colour: Any, pixels: Any) -> Any:
        new, alive = [], mi.Bool(False)
        sums, rgb = [mi.Float(0)] * 22, (colour.x, colour.y, colour.z)
        for j, row in enumerate(rows):
            m = [mi.Float(0)] * 5
            cross = [[mi.Float(0)] * 3 for _ in range(3)]
            for x, (raw, xi) in enumerate(zip(row.raw, row.xi, strict=True)):
                transmittance, *behind = pixels[j * BLOCK_X + x]
                alpha, w, after, room = _blend(raw, transmittance)
                behind = [dr.fma(-c, w, s) for c, s in zip(rgb, behind, strict=True)]
                new.append([after, *behind])
                alive |= room
                held, lost = _held_and_lost(alpha, w, raw)
                slopes = [dr.fma(c, held, -s * lost) for c, s in zip(rgb, behind, strict=True)]
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
            eta = row.eta
            eta2 = eta * eta
            moments = [m[0], m[4], m[3] * eta, m[2] * eta2, m[1] * eta2 * eta, m[0] * eta2 * eta2]
            if block:
                moments += [m[2], m[1] * eta, m[0] * eta2]
                for a in cross:
                    moments += [a[0], a[2], a[1] * eta, a[0] * eta2]
            sums[1 : 1 + len(moments)] = [a + b for a, b in zip(sums[1:], moments, strict=False)]
        _store(buffers, sums[:count], dr.gather(mi.UInt32, lists.slot, i))
        return new, alive

    _walk(lists, packed, lane, pixels, visit, stepped=not block)
    return _per_splat(lists, buffers, count)
