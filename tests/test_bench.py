"""`mgs bench splat` and `mgs bench scaling`: what is timed, counted, fitted, drawn and written."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import tiny
from PIL import Image

from mgs.bench import core, scaling
from mgs.bench.scaling import OPERATIONS, exponents, fitted, scaling_exponents
from mgs.cli.app import main
from mgs.files import read_json


def points(most: int = 1_000_000) -> list[dict]:
    """Records of a machine on which N brings pairs ~ N^0.5 and time ~ pairs^1.4, pixels pairs ~
    pixels^0.5 and time ~ pairs, both time ~ pairs^0.9."""
    numbers = [n for n in scaling.NUMBERS if n <= most]
    grown = {n: n >= most // 100 for n in numbers}
    rows = [("gaussians", n, 307_200, 2, n**0.5, n**0.7 if grown[n] else 1.0) for n in numbers]
    rows += [("pixels", 100_000, 4**i, 2, 2.0**i, 2.0**i) for i in range(4)]
    rows += [("both", n, 3 * n, 2, float(n), n**0.9 if grown[n] else 1.0) for n in numbers]
    rows += [("threads", 100_000, 307_200, t, 1.0, 1 / t) for t in (1, 2)]
    return [
        dict(zip(("sweep", "n", "pixels", "threads", "pairs"), row[:5], strict=True))
        | dict.fromkeys(OPERATIONS, row[5])
        | {"peak_bytes": 1e3 * row[1], "list_bytes": 1e2 * row[1]}
        for row in rows
    ]


def test_exponents_of_growth():
    records = points()
    assert fitted(records)[0]["n"] == 10_000
    expected = {"N": 0.7, "pixels": 0.5, "threads": -1}
    expected |= {"pairs alone": 0.9, "pairs, N growing": 1.4, "pairs, image growing": 1.0}
    assert scaling_exponents(records)["forward, cold"] == pytest.approx(expected)
    assert scaling_exponents(records)["peak memory"]["N"] == pytest.approx(1.0)
    assert fitted(points(3000))[0]["n"] == 1000
    one_core = [p for p in records if p["sweep"] != "threads" or p["threads"] == 1]
    assert "threads" not in scaling_exponents(one_core)["forward, cold"]


def test_cold_renders_a_new_view_in_each_call(monkeypatch):
    gaussians = tiny.initial([])
    camera, seen, draw = core.surface_camera(gaussians, 32, 24), [], core.render

    def watched(gaussians, camera, cache=None):
        if cache is None:
            seen.append(camera)
        return draw(gaussians, camera, cache=cache)

    monkeypatch.setattr(core, "render", watched)
    core.time_core(gaussians, camera, 3)
    poses = {c.world_to_camera.tobytes() for c in [camera, *seen]}
    assert len(seen) == 3 + core.WARM_UP
    assert len(poses) == len(seen) + 1
    centre = (gaussians.means.min(axis=0) + gaussians.means.max(axis=0)) / 2
    for other in seen:
        assert np.array_equal(other.K, camera.K)
        np.testing.assert_allclose(
            other.world_to_camera @ [*centre, 1], camera.world_to_camera @ [*centre, 1], atol=1e-6
        )
        assert other.position[2] == pytest.approx(camera.position[2])


def test_operations_of_a_known_loop_are_counted():
    """Five chains of an FMA (2) and a division (1); the sum after the loop is not part of it."""
    x, n = dr.arange(mi.Float, 64) + 1, dr.opaque(mi.UInt32, 3)
    dr.eval(x)

    def body(i, values):
        return i + 1, [dr.fma(v, x, 0.5) / v for v in values]

    def call():
        start = dr.zeros(mi.UInt32, 64), [x] * 5
        return sum(dr.while_loop(start, lambda i, _: i < n, body)[1])

    assert core.flops_per_pair(call, 64) == 5 * 3 / core.TOGETHER
    assert core.flops_per_pair(call, 1) == 0


def test_bench_splat_measures_every_target():
    said = []
    found = core.bench_splat(1000, 64, 48, 3, said.append)
    assert len(said) == 4
    assert found["figures"].keys() == core.TARGETS.keys()
    assert all(value > 0 for value in found["figures"].values())
    assert set(found["seconds"]) == {*OPERATIONS, "volprim_forward", "volprim_gradient"}
    assert all(0 < share < 1 for share in found["share_of_peak"].values())
    assert found["peak_gflops_measured"] > 1


def test_peak_memory_is_that_of_the_point_alone():
    dr.eval(dr.arange(mi.Float, 1 << 26))
    assert dr.detail.malloc_watermark(dr.JitBackend.LLVM) >= 1 << 28
    found = scaling.in_new_process(scaling.scaling_point, 1000, 32, 24, 1, 3)
    assert found["peak_bytes"] < 1 << 27


def test_the_json_holds_the_command_as_typed(monkeypatch, capsys, tmp_path):
    result = {"repeats": 5, "points": points()} | exponents(points())
    monkeypatch.setattr(scaling, "bench_scaling", lambda *_: dict(result))
    chart, json = tmp_path / "chart.png", tmp_path / "a b.json"
    arguments = ["bench", "scaling", "--repeats", "5", "--json", str(json), "--chart", str(chart)]
    monkeypatch.setattr("sys.argv", ["/somewhere/bin/mgs", *arguments])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 0
    with Image.open(chart) as picture:
        picture.load()
    written = read_json(json)
    assert written["command"] == f"mgs bench scaling --repeats 5 --json '{json}' --chart {chart}"
    assert written["repeats"] == 5
    assert written["exponents_from_n"] == 10_000
    printed = capsys.readouterr().out
    assert "start at 10,000" in printed
    assert "1.40" in printed
