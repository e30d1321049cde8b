"""What `mgs bench` records: views never seen before, memory of one point alone, exponents, the
command line."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import tiny
from PIL import Image
from refusals import refused

from mgs.bench import chart, core
from mgs.bench.chart import scaling_figure
from mgs.bench.growth import OPERATIONS, fitted, linear_growth, scaling_exponents
from mgs.cli.app import main
from mgs.files import read_json


def points(most: int = 1_000_000) -> list[dict]:
    """Records of a machine on which N brings pairs ~ N^0.5 and time ~ pairs^1.4, pixels pairs ~
    pixels^0.5 and time ~ pairs, both time ~ pairs^0.9."""
    numbers = [n for n in (1_000, 3_000, 10_000, 30_000, 100_000, 300_000, 1_000_000) if n <= most]
    rows = [
        ("gaussians", n, 307_200, 2, n**0.5, n**0.7 if n >= most // 100 else 1.0) for n in numbers
    ]
    rows += [("pixels", 100_000, 4**i, 2, 2.0**i, 2.0**i) for i in range(4)]
    rows += [("both", n, 3 * n, 2, float(n), n**0.9 if n >= most // 100 else 1.0) for n in numbers]
    rows += [("threads", 100_000, 307_200, t, 1.0, 1 / t) for t in (1, 2)]
    return [
        dict(zip(("sweep", "n", "pixels", "threads", "pairs"), row[:5], strict=True))
        | dict.fromkeys(OPERATIONS, row[5])
        | {"peak_bytes": 1e3 * row[1], "list_bytes": 1e2 * row[1]}
        for row in rows
    ]


def test_growth_with_pairs_is_told_for_either_way_to_get_more():
    records = points()
    assert fitted(records)[0]["n"] == 10_000
    row = scaling_exponents(records)["forward, cold"]
    expected = {
        "N": 0.7,
        "pixels": 0.5,
        "threads": -1,
        "pairs alone": 0.9,
        "pairs, N growing": 1.4,
        "pairs, image growing": 1.0,
    }
    assert row == pytest.approx(expected)
    assert scaling_exponents(records)["peak memory"]["N"] == pytest.approx(1.0)
    assert fitted(points(3000))[0]["n"] == 1000
    one_core = [p for p in records if p["sweep"] != "threads" or p["threads"] == 1]
    assert "threads" not in scaling_exponents(one_core)["forward, cold"]


@pytest.mark.parametrize("threads", [1, 2])
def test_the_chart_shows_the_records(tmp_path, monkeypatch, threads):
    drawn = []
    monkeypatch.setattr(chart, "save_figure", lambda figure, path: drawn.append((figure, path)))
    records = [p for p in points() if p["sweep"] != "threads" or p["threads"] <= threads]
    scaling_figure(tmp_path / "chart.png", records)
    ((figure, path),) = drawn
    assert path == tmp_path / "chart.png"
    forward = [axis.lines[0].get_xydata() for axis in figure.axes[:4]]
    for found, (sweep, key) in zip(
        forward,
        (("gaussians", "n"), ("pixels",) * 2, ("threads",) * 2, ("both", "pairs")),
        strict=True,
    ):
        expected = [(p[key], 1e3 * p["forward_warm"]) for p in records if p["sweep"] == sweep]
        np.testing.assert_allclose(found, expected)
    titles = [axis.get_legend().get_texts()[0].get_text() for axis in figure.axes[:4]]
    assert titles == [
        "forward, warm: 0.70",
        "forward, warm: 0.50",
        "forward, warm: -1.00" if threads > 1 else "forward, warm: ",
        "forward, warm: 0.90, 1.40",
    ]


def test_linear_growth_finds_the_costs_it_is_made_of():
    """And says by how much a time that grows faster is missed."""
    records = points()
    for p in records:
        p.update(dict.fromkeys(OPERATIONS, 2e-3 + 3e-9 * p["pairs"] + 5e-9 * p["n"]))
        p["forward_cold"] = 1e-9 * p["n"] ** 1.5
        p["fisher_exact"] = 1.0 if p["threads"] == 1 else 4e-9 * p["n"]
    found = linear_growth(records)
    assert list(found["forward, warm"].values()) == pytest.approx([2, 3, 5, 0], abs=1e-6)
    assert list(found["exact Fisher"].values()) == pytest.approx([0, 0, 4, 0], abs=1e-6)
    assert found["forward, cold"]["worst deviation"] > 0.3


def test_cold_means_a_view_never_seen_before(monkeypatch):
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


def test_peak_memory_is_that_of_the_point_alone():
    dr.eval(dr.arange(mi.Float, 1 << 26))
    assert dr.detail.malloc_watermark(dr.JitBackend.LLVM) >= 1 << 28
    assert core.in_new_process(core.scaling_point, 1000, 32, 24, 1, 3)["peak_bytes"] < 1 << 27


def test_the_json_holds_the_command_as_typed(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(core, "bench_scaling", lambda *_: points())
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


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (
            ["splat", "--chart", "x.png"],
            "--chart: is for scaling and roofline, not for splat; leave it out",
        ),
        (
            ["fit", "--gaussians", 5000],
            "--gaussians: is for splat and scaling and roofline, not for fit",
        ),
        (["fit", "--repeats", 5], "--repeats: is for"),
        (["roofline", "--dataset", "demo/dataset"], "--dataset: is for fit, not for roofline"),
    ],
)
def test_what_a_benchmark_has_no_use_for_is_refused(capsys, arguments, line):
    assert line in refused(capsys, ["bench", *arguments])


def test_one_n_is_too_few_to_fit(capsys):
    assert "at least 3000" in refused(capsys, ["bench", "scaling", "--gaussians", 2999])
