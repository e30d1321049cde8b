"""`mgs bench roofline`: counts of work in LLVM IR, limits of the machine, and what is made of
both."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from refusals import refused

from mgs.bench import core, machine, roofline
from mgs.bench.chart import roofline_figure
from mgs.bench.roofline import ROOFS, SUPPLIES, limit_shares, run_kernels, trips, verdict
from mgs.bench.work import Work, count_work
from mgs.cli.app import main
from mgs.errors import InputError
from mgs.files import read_json
from mgs.splat import ListCache, as_drjit, kernels
from mgs.splat.projection import camera_array, project
from mgs.splat.walking import PIXELS, computed_after

KERNEL = """
define void @drjit_1(i64 %start, i64 %end, i32 %thread_id, ptr noalias %params) #0 {
entry:
    %arr_1 = alloca float, i32 16, align 64
    br label %body

body:
    %index = phi i64 [ %index_next, %suffix ], [ %start, %entry ]
    %f1_p = load ptr, ptr %params, align 8, !invariant.load !4
    %f1 = load <8 x float>, ptr %f1_p, align 64, !alias.scope !2
    %f2_1 = insertelement <8 x float> undef, float 0x0, i32 0
    %f2 = shufflevector <8 x float> %f2_1, <8 x float> undef, <8 x i32> zeroinitializer
    br label %l_1_pre

l_1_pre:
    br label %l_1_loop

l_1_loop:
    %f1_cur = phi i64 [ 0, %l_1_pre ], [ %f1_next, %l_1_loop ]
    %f1_ptr = getelementptr inbounds <8 x float>, ptr %arr_1, i64 %f1_cur
    store <8 x float> %f2, ptr %f1_ptr, align 64
    %f1_next = add i64 %f1_cur, 1
    %f1_cont = icmp ult i64 %f1_next, 2
    br i1 %f1_cont, label %l_1_loop, label %l_2_cond

l_2_cond:
    %r3 = phi <8 x i32> [ %r0, %l_1_loop ], [ %r9, %l_2_end ]
    %d4 = phi <8 x double> [ %d0, %l_1_loop ], [ %d8, %l_2_end ]
    %p5 = icmp ult <8 x i32> %r3, %r1
    %p5_red = call i1 @llvm.vector.reduce.or.v8i1(<8 x i1> %p5)
    br i1 %p5_red, label %l_2_body, label %l_2_done

l_2_body:
    %f6_1 = getelementptr inbounds float, ptr %f1_p, <8 x i32> %r3
    %f6 = call <8 x float> @llvm.masked.gather.v8f32(<8 x ptr> %f6_1, i32 4, <8 x i1> %p5, <8 x float> zeroinitializer)
    %f7_5 = call fastcc [4 x <8 x float>] @gather_4xf32(<8 x ptr> %f6_1)
    %f7 = extractvalue [4 x <8 x float>] %f7_5, 0
    %a1 = getelementptr inbounds float, ptr %arr_1, i32 8
    %a1_5 = load <8 x float>, ptr %a1, align 64
    %a2 = call <8 x float> @llvm.fma.v8f32(<8 x float> %a1_5, <8 x float> %f1, <8 x float> %f7)
    %a3 = fdiv <8 x float> %a2, %f1
    %a4 = getelementptr inbounds float, ptr %arr_1, i32 8
    %a4_5 = load <8 x float>, ptr %a4, align 64
    %a4_6 = select <8 x i1> %p5, <8 x float> %a3, <8 x float> %a4_5
    store <8 x float> %a4_6, ptr %a4, align 64
    %d7 = fpext <8 x float> %f6 to <8 x double>
    %d8 = fadd <8 x double> %d4, %d7
    %f9 = fneg <8 x float> %a3
    call fastcc void @scatter_add_4xf32(<8 x ptr> %f6_1, <8 x i1> %p5, [4 x <8 x float>] %f7_5)
    call void @llvm.memcpy.inline.p0.p0.i32(ptr align(64) %arr_1, ptr align(64) %arr_1, i32 64, i1 0)
    %r9 = add <8 x i32> %r3, %r3
    br label %l_2_end

l_2_end:
    br label %l_2_cond

l_2_done:
    call void @llvm.masked.scatter.v8f64(<8 x double> %d4, <8 x ptr> %f6_1, i32 4, <8 x i1> %p5), !alias.scope !2
    call fastcc void @reduce_add_i32_atomic(<8 x ptr> %f6_1, <8 x i32> %r3, i16 %m)
    br label %suffix

suffix:
    %index_next = add i64 %index, 8
    %cond = icmp uge i64 %index_next, %end
    br i1 %cond, label %done, label %body, !llvm.loop !5

done:
    ret void
}

define internal fastcc void @scatter_add_4xf32(<8 x ptr> %p, <8 x i1> %m, [4 x <8 x float>] %v) {
    %x = fadd <8 x float> %v, %v
    ret void
}
"""


def test_the_work_of_a_kernel_is_counted():
    """Straight: f1 is loaded, two numbers of the array filled, d4 stored, a number added to in
    place.

    Loop: a gathered number and a packet of four; four numbers added to; two variables (4 and 8
    bytes) read and written; one number of the array read and written; a copy of its 8 bytes a lane;
    and f1, which was made before, read.
    """
    found = count_work(KERNEL)
    assert (found.width, len(found.loops)) == (8, 1)
    assert found.straight == Work(bytes=4 + 8 + 2 * 4, state_bytes=2 * 4, addresses=2)
    instructions = (
        1 + 1 + 1 + 1 + 2 + 2 + 1
    )  # icmp, fma, fdiv, select, fpext and fadd on doubles, add
    loop = Work(
        3,
        1,
        1,
        0,
        instructions,
        4 + 16 + 2 * 16,
        state_bytes=2 * (4 + 8) + 2 * 4 + 2 * 8 + 4,
        addresses=3,
    )
    assert found.loops[0] == loop
    assert loop * 2 + loop == loop * 3


def test_what_is_no_kernel_is_refused():
    for text in ("", "define void @drjit_1() {\nentry:\n    ret void\n}\n"):
        with pytest.raises(ValueError, match="no kernel"):
            count_work(text)
    inner = "    br label %l_3_cond\n\nl_3_cond:\n    br i1 %p5_red, label %l_3_cond, label %l_2_end\n\nl_2_end:\n"
    with pytest.raises(ValueError, match="loop inside a loop"):
        count_work(KERNEL.replace("    br label %l_2_end\n\nl_2_end:\n", inner))


def compiled(call):
    """The only kernel with lanes that a call starts."""
    (kernel,) = [
        kernel for kernel in run_kernels(call, 1) if kernel.kind == "JIT" and kernel.size > 1
    ]
    return kernel


def test_the_reader_understands_what_drjit_writes_today():
    x, n = dr.arange(mi.Float, 64) + 1, dr.opaque(mi.UInt32, 3)
    dr.eval(x)

    def body(i, values):
        return i + 1, [dr.fma(v, x, 0.5) / v for v in values]

    kernel = compiled(
        lambda: sum(dr.while_loop((dr.zeros(mi.UInt32, 64), [x] * 5), lambda i, _: i < n, body)[1])
    )
    found = count_work(kernel.ir)
    (loop,) = found.loops
    assert kernel.size == 64
    assert (loop.flops, loop.divisions, loop.bytes) == (5 * 3, 5, 0)
    assert loop.state_bytes == 2 * 4 * (5 + 1) + 4  # five numbers, the counter, and x
    assert (found.straight.flops, found.straight.bytes) == (4, 4 + 4)


@pytest.mark.parametrize("real", [mi.Float, mi.Float64])
def test_bits_that_are_always_zero_are_not_counted(real):
    """LLVM leaves them out. Bits that may be set count: x & 1 is an operation, and to add it
    another."""
    x, y = real(dr.arange(mi.Float, 64) + 1), dr.arange(mi.Float, 64) + 2
    dr.eval(x, y)
    integer = mi.UInt32 if real is mi.Float else mi.UInt64

    def straight(change):
        def call():
            before = [y * 2, y * y]
            return change(x, before) + 1, *before

        return count_work(compiled(call).ir).straight

    def with_last_bit(x, before):
        return dr.reinterpret_array(
            real, dr.reinterpret_array(integer, x) | integer(dr.reinterpret_array(mi.UInt32, y) & 1)
        )

    plain, changed = straight(lambda x, before: x), straight(with_last_bit)
    assert straight(computed_after) == plain
    extended = (
        1 + 2 + 2
    )  # in double: x & 1, its extension, and the addition, where 64 bits count twice
    assert changed.instructions == plain.instructions + (2 if real is mi.Float else extended)


def test_work_of_the_kernels_is_what_their_authors_meant():
    """A pair is read as an index and a splat of 64 bytes, without depth 48; the adjoint writes two
    packets of sums. Forward draws two pairs at a time. Of each pixel it carries six numbers,
    without alpha and depth four."""
    gaussians = core.surface_gaussians(500)
    camera = core.surface_camera(gaussians, 184, 92)
    device = as_drjit(gaussians)
    splats = project(device, camera_array(camera))
    lists, packed = ListCache().get(camera, splats)
    (whole,), (forward,) = (
        count_work(compiled(lambda w=w: kernels.forward(lists, packed, w)).ir).loops
        for w in (True, False)
    )
    assert (whole.bytes, forward.bytes) == (2 * (4 + 64), 2 * (4 + 48))
    assert (whole.addresses, forward.addresses) == (2 * (1 + 4), 2 * (1 + 3))
    assert 2 * 6 * 4 * PIXELS <= whole.state_bytes < 2 * 7 * 4 * PIXELS
    assert 2 * 4 * 4 * PIXELS <= forward.state_bytes < 2 * 5 * 4 * PIXELS
    assert whole.divisions == forward.divisions == 0
    out = kernels.forward(lists, packed, False)
    dr.eval(out)
    walk = next(
        k
        for k in run_kernels(lambda: kernels.adjoint(lists, packed, out, out, False, 3), 1)
        if k.ir
    )
    adjoint, zeros = count_work(walk.ir).loops
    assert adjoint.bytes == 4 + 48 + 2 * 16
    assert (zeros.bytes, zeros.flops) == (2 * 16, 0)
    assert adjoint.divisions == PIXELS
    assert adjoint.flops > forward.flops / 2 > 15 * PIXELS
    assert (
        core.flops_per_pair(lambda: kernels.forward(lists, packed, False), len(lists.block))
        == (forward.flops + forward.flops64) / 2
    )
    assert core.flops_per_pair(lambda: kernels.forward(lists, packed, False), 1) == 0


@given(st.lists(st.integers(0, 50), min_size=1, max_size=40), st.sampled_from([4, 8, 16]))
def test_a_register_runs_until_its_last_lane_ends(lengths, width):
    busy, every = trips(np.array(lengths), width)
    registers = [lengths[i : i + width] for i in range(0, len(lengths), width)]
    assert (busy, every) == (sum(lengths), sum(width * max(register) for register in registers))


LIMITS = {
    "flops": 100e9, "flops64": 50e9, "divisions": 4e9, "divisions64": 2e9,
    "bandwidth": {"L1": 200e9, "L2": 100e9, "L3": 40e9, "memory": 10e9}, "addresses": 500e6,
}  # fmt: skip


def test_shares_of_the_limits():
    work = Work(
        flops=10e9,
        flops64=5e9,
        divisions=1e9,
        divisions64=1e9,
        instructions=20e9,
        bytes=8e9,
        state_bytes=12e9,
    )
    work = replace(work, addresses=3e8)
    share = limit_shares({"seconds": 2.0, "executed": vars(work)}, LIMITS)
    expected = {
        "FMA": 0.1,
        "division": 0.375,
        "instructions": 0.2,
        "L1": 0.05,
        "L2": 0.04,
        "L3": 0.1,
        "memory": 0.4,
    }
    expected["addresses"] = 0.3
    assert share == pytest.approx(expected)


@pytest.mark.parametrize(
    ("changed", "own", "said"),
    [
        ({}, 0.0, "none; nearest is division"),
        ({"L3": 0.4}, 0.0, "none; nearest is L3"),
        ({}, 0.6, "Dr.Jit's sorts and prefix sums"),
        ({"addresses": 0.2}, 0.31, "Dr.Jit's sorts and prefix sums, and addresses"),
        ({"addresses": 0.2}, 0.29, "none; nearest is division"),
        ({"addresses": 0.6}, 0.0, "addresses, if they lie in L3"),
        ({"instructions": 0.8, "L3": 0.9}, 0.1, "instructions"),
        ({"L3": 0.6, "memory": 2.4}, 0.0, "L3, if its bytes come from there"),
        ({"memory": 1.6}, 0.0, "memory, if part of its bytes come from there"),
    ],
)
def test_what_bounds_a_kernel(changed, own, said):
    share = dict.fromkeys((*ROOFS, *SUPPLIES), 0.1) | {"division": 0.3} | changed
    assert verdict(share, own) == said


def cache_folder(folder, levels):
    for i, (level, kind, size) in enumerate(levels):
        (folder / f"index{i}").mkdir()
        for name, text in (("level", level), ("type", kind), ("size", size)):
            (folder / f"index{i}/{name}").write_text(f"{text}\n")
    return folder


def test_sizes_of_caches_are_read(tmp_path, monkeypatch):
    levels = [
        ("1", "Data", "48K"),
        ("1", "Instruction", "32K"),
        ("2", "Unified", "2048K"),
        ("3", "Unified", "32768K"),
    ]
    monkeypatch.setattr(machine, "CACHES", cache_folder(tmp_path, levels))
    assert machine.cache_sizes() == {"L1": 48 << 10, "L2": 2 << 20, "L3": 32 << 20}


def test_a_system_that_does_not_tell_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(machine, "CACHES", cache_folder(tmp_path, [("1", "Data", "48K")]))
    with pytest.raises(InputError, match="no sizes of three caches"):
        machine.cache_sizes()
    monkeypatch.setattr(machine, "CACHES", tmp_path / "missing")
    assert "sizes of three caches" in refused(capsys, ["bench", "roofline", "--gaussians", 1000])


def test_rates_are_those_of_the_work_that_the_timed_kernels_do(monkeypatch):
    """With a kernel that takes a second, a rate is the number of operations that are in its
    code."""
    calls = []
    monkeypatch.setattr(machine, "kernel_seconds", lambda call: calls.append(call) or 1.0)
    lanes = 1 << 16
    assert (
        machine.peak_flops()
        == lanes * 64 * (flops := count_work(compiled(calls.pop()).ir).loops[0]).flops
    )
    assert flops.flops == 2 * 8 * 16
    assert (
        machine.peak_flops(mi.Float64)
        == lanes * 64 * count_work(compiled(calls.pop()).ir).loops[0].flops64
    )
    assert (
        machine.division_rate(mi.Float)
        == lanes * 4 * count_work(compiled(calls.pop()).ir).loops[0].divisions
    )
    reads = machine.address_rate(1 << 16)
    assert (
        reads
        == (1 << 18) * count_work(compiled(calls.pop()).ir).straight.addresses
        == 16 * (1 << 18)
    )
    found = machine.local_bandwidth(4096)
    counter = 2 * 4
    assert found == lanes / 16 * 64 * (
        count_work(compiled(calls.pop()).ir).loops[0].state_bytes - counter
    )
    assert found == lanes / 16 * 64 * (4096 // 64) * 8


def test_a_bandwidth_is_bytes_over_seconds(monkeypatch):
    """Each time the clock is read a second has passed. Two arrays of 4 KB are read, one is
    written."""
    monkeypatch.setattr(machine.time, "perf_counter", itertools.count().__next__)
    monkeypatch.setattr(machine, "SECONDS", 1e-4)
    rounds = round(20e9 * 1e-4 / (12 * 1024))
    assert machine.stream_bandwidth(8192) == 12 * 1024 * rounds * dr.thread_count()


def test_limits_are_measured():
    assert machine.kernel_seconds(lambda: dr.arange(mi.Float, 1 << 16) * 2) > 0
    assert machine.local_bandwidth(1024, lanes=256, rounds=4) > 0


@pytest.fixture(scope="module")
def result():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(roofline, "machine_limits", lambda report: LIMITS)
        said = []
        yield roofline.bench_roofline(1000, 80, 60, 3, said.append)
        assert said[:3] == ["forward", "forward: alpha and depth", "jvp"]


def test_every_kernel_has_its_place(result, tmp_path, monkeypatch):
    rows = {row["name"]: row for row in result["kernels"]}
    assert {
        "forward: alpha and depth",
        "lists tested, and packing",
        "pixels row by row",
    } <= rows.keys()
    assert rows["pixels row by row"]["unit"] == "pixel"
    steps = [
        "projection",
        "packing",
        "block lists",
        "sums to gradient",
        "sums to exact Fisher",
        "sums to block Fisher",
    ]
    assert {
        "forward",
        "jvp",
        "adjoint: walk",
        "adjoint: add up",
        "block Fisher: add up",
        *steps,
    } <= rows.keys()
    assert any(name.startswith("exact Fisher: walk") for name in rows)
    for row in rows.values():
        assert row["seconds"] > 0
        assert 0 < row["lanes_active"] <= 1
        assert all(math.isfinite(share) and share >= 0 for share in row["shares"].values())
        assert row["executed"]["bytes"] >= row["useful"]["bytes"] > 0
    walk = rows["forward"]
    executed = walk["executed"]["flops"] + walk["executed"]["flops64"]
    assert walk["gflops"] == pytest.approx(executed / walk["seconds"] / 1e9)
    assert (
        walk["intensity"]
        < walk["array_intensity"]
        == pytest.approx(executed / walk["executed"]["bytes"])
    )
    assert (walk["unit"], rows["projection"]["unit"], rows["adjoint: add up"]["unit"]) == (
        "2 pairs of a block",
        "Gaussian",
        "4 pairs of a splat",
    )
    assert rows["block lists"]["own_seconds"] > 0
    assert (
        rows["sums to block Fisher"]["each"]["flops64"]
        > rows["sums to exact Fisher"]["each"]["flops64"]
    )


def test_the_chart_has_the_kernels_and_the_roofs(result, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr("mgs.bench.chart.save_figure", lambda figure, path: drawn.append(figure))
    roofline_figure(tmp_path / "roof.png", result)
    (axes,) = drawn[0].axes
    named = {
        line.get_label(): line.get_xydata()[0]
        for line in axes.lines
        if not line.get_label().startswith("_")
    }
    expected = {
        row["name"]: (row["intensity"], row["gflops"]) for row in result["kernels"] if row["gflops"]
    }
    assert named.keys() == expected.keys()
    for name, point in expected.items():
        np.testing.assert_allclose(named[name], point)
    texts = [text.get_text() for text in axes.texts]
    assert texts == [
        "L1 200 GB/s",
        "L2 100 GB/s",
        "L3 40 GB/s",
        "memory 10 GB/s",
        "FMA 100 Gflop/s",
        "FMA in double 50 Gflop/s",
    ]


def test_the_command_prints_writes_and_draws(result, tmp_path, monkeypatch, capsys):
    asked = []
    monkeypatch.setattr(
        roofline, "bench_roofline", lambda *arguments: asked.append(arguments[:4]) or result
    )
    json, chart = tmp_path / "roof.json", tmp_path / "roof.png"
    arguments = [
        "bench",
        "roofline",
        "--gaussians",
        "1000",
        "--json",
        str(json),
        "--chart",
        str(chart),
    ]
    monkeypatch.setattr("sys.argv", ["mgs", *arguments])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 0
    assert asked == [(1000, 640, 480, 9)]
    with Image.open(chart) as picture:
        picture.load()
    written = read_json(json)
    assert written["command"].startswith("mgs bench roofline --gaussians 1000")
    assert written["kernels"][0]["name"] == "forward"
    printed = capsys.readouterr().out
    assert "L1 200, L2 100" in printed
    assert "bound by" in printed
