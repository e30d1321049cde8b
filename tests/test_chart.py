"""Charts: times, commands of rows, presets, a whole chart of a tiny rock; and the benchmark."""

import json
import shlex
import shutil
from pathlib import Path

import pytest
import tiny
import typer
from program import study
from refusals import refused

from mgs.cli.app import app
from mgs.cli.nbv import nbv
from mgs.cli.options import parse_settings
from mgs.files import read_json
from mgs.run.settings import NbvSettings
from studies import bench as core
from studies import chart, photographs
from studies.chart_points import points_over_rocks
from studies.frame import timing
from studies.frame.case import Size
from studies.frame.output import read_rows
from studies.frame.program import study_of


def test_times_are_ratios_to_a_reference_that_is_timed_beside_each_call(monkeypatch):
    slowness = iter([1, 1, 4, 4])
    cost = {"reference": 0.5, "work": 2.0}

    def clock(call):
        name, slow = call(), next(slowness)
        return name, cost[name] * slow, 2 * slow

    monkeypatch.setattr(timing, "_clock", clock)
    result, times = timing.timed(lambda: "work", 2, lambda: "reference")
    assert result == "work"
    assert times["ratio"] == times["ratio_low"] == times["ratio_high"] == 4
    assert (times["wall"], times["reference"]) == (5, 1.25)


def test_what_takes_little_time_is_timed_more_often(monkeypatch):
    seconds = {"reference": 0.1, "short": 0.25, "shorter": 0.01}
    monkeypatch.setattr(timing, "_clock", lambda call: ((name := call()), seconds[name], 0.0))
    for name, often in (("short", 4), ("shorter", timing.MOST_REPEATS)):
        calls = []
        timing.timed(lambda name=name, calls=calls: calls.append(1) or name, 2, lambda: "reference")
        assert len(calls) == 1 + often  # the first is not timed


def test_points_are_compared_with_the_base_of_the_same_rock():
    def row(rock, passes, seconds, psnr):
        about = {"kind": "fit", "images": 8, "density": 0.1, "passes": passes, "base": passes == 10}
        results = {"seconds": seconds, "psnr": psnr, "psnr_mask": psnr}
        return about | results | {"rock": rock}

    rows = [row("a", 10, 2, 20), row("b", 10, 4, 22), row("a", 5, 1, 19), row("b", 5, 1, 24)]
    base, other = points_over_rocks(rows)
    assert [one["times"] for one in base["of"] + other["of"]] == [1, 1, 1 / 2, 1 / 4]
    assert [one["psnr_more"] for one in base["of"] + other["of"]] == [0, 0, -1, 2]
    assert (base["seconds"], base["psnr_more"], base["front"]) == (3, 0, False)
    assert (other["seconds"], other["psnr_more"], other["front"]) == (1, 0.5, True)


COMMANDS = typer.main.get_command(app).commands


def parsed(line):
    """Parameters of a command line of mgs, or of a study."""
    words = shlex.split(line)
    if words[:2] == ["python", "-m"]:
        options = study_of(words[2].removeprefix("studies.")).parser().parse_args(words[3:])
        return vars(options)
    assert words[0] == "mgs"
    return COMMANDS[words[1]].make_context(words[1], words[2:]).params


@pytest.mark.parametrize("size", chart.SIZES.values(), ids=chart.SIZES)
def test_commands_of_points_say_what_was_measured(size):
    points = [point for kind in chart.KINDS for point in chart.points_of(size, kind)]
    assert len({point.name for point in points}) == len(points)
    assert set(chart.preset_points(size)) == set(chart.PRESETS)
    assert set(chart.preset_points(size).values()) <= set(points)
    for point in points:
        words, made = parsed(point.command("DATA", "PRIOR", size.seeds)), point.settings(size.seeds)
        train = made.pop("train")
        said = parse_settings(words["settings"], nbv)
        assert said == made | {"train": train}
        settings = NbvSettings(dataset="DATA", prior="PRIOR", **made, train=train)
        assert settings.train_at(1).passes == min(point.warm_passes, point.passes)


SMALL = chart.ChartSize(
    Size(32, 24, 6, 3), count=4, repeats=1, densities=(1 / 8,), passes=(1,), run_passes=(),
    image_counts=(), policies=(), estimators=(), seeds=3, reference=(100, 32, 24),
    presets={"fast": {"passes": 2, "warm_passes": 1, "density": 1 / 8}},
)  # fmt: skip


@pytest.mark.usefixtures("coarse_priors", "figures")
def test_a_chart_is_measured_once_and_written(dataset, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(timing, "MOST_REPEATS", 1)
    tiny.write_dataset(dataset / "test", frames=3)
    out, times = tmp_path / "chart", []
    for _ in range(2):
        study("chart", out, "--dataset", dataset, "--repeats", 1, sizes={"quick": SMALL})
        told = capsys.readouterr().out
        times.append({p: p.stat().st_mtime_ns for p in out.glob("cells/**/result.json")})
    assert "/prior" not in told  # the second time all was there
    assert times[0] == times[1]
    record, rows = json.loads((out / "chart.json").read_text()), read_rows(out / "chart.csv")
    assert len(rows) == len(record["rows"])
    assert parsed(record["command"])["dataset"] == dataset
    assert all(parsed(row["command"]) for row in rows)
    for row in rows:
        assert row["seconds"] == pytest.approx(row["ratio"] * record["reference_seconds"], rel=1e-3)
    points = points_over_rocks(rows)
    for kind in chart.KINDS:
        assert any(point["front"] for point in points if point["kind"] == kind)
    assert [row["total_passes"] for row in rows if row["kind"] == "fit"][1] == 1
    assert "| **fast**: " in (out / "chart.md").read_text()
    assert (out / "chart.png").stat().st_size > 10_000


@pytest.mark.usefixtures("coarse_priors", "figures")
def test_photographs_are_charted_beside_another_program(dataset, tmp_path, capsys):
    tiny.write_dataset(dataset / "test", frames=3)
    peer, out = tmp_path / "other.csv", tmp_path / "chart"
    charted = [out, "--dataset", dataset, "--gaussians", "60"]
    second = Path(shutil.copytree(dataset, tmp_path / "second"))
    namesake = shutil.copytree(dataset, tmp_path / "other" / "second")
    for text in (
        "psnr\n", "psnr\n1,x\n", "step\n1,5\n", "psnr\n0,9\n", "psnr\n1,inf\n",
        "dataset,psnr\n0.5,third,20\n",
    ):  # fmt: skip
        peer.write_text(f"cpu_seconds,{text}")
        line = refused(capsys, [*charted, "--peer", peer], out, "photographs")
        assert str(peer) in line
    peer.write_text("cpu_seconds,step,psnr,dataset\n0.5,9,20,\n2,50,21.5,second\n")
    several = [out, "--dataset", second, "--dataset", namesake]
    assert "have one name" in refused(capsys, several, out, "photographs")
    no_tests = [out, "--dataset", tiny.write_dataset(tmp_path / "untested")]
    assert "has no test views" in refused(capsys, no_tests, out, "photographs")
    charted += ["--dataset", second]
    study("photographs", *charted, "--peer", peer, sizes={"quick": photographs.Fits((1, 2))})
    record = json.loads((out / "photographs.json").read_text())
    ours, others = record["rows"][:4], record["rows"][4:]
    assert [row["dataset"] for row in ours] == [dataset.name] * 2 + ["second"] * 2
    assert [row["passes"] for row in ours] == [1, 2, 1, 2]
    assert all(row["cpu_seconds"] > 0 and row["psnr"] > 5 for row in ours)
    assert others == [
        {"dataset": dataset.name, "program": "other", "cpu_seconds": 0.5, "psnr": 20},
        {"dataset": "second", "program": "other", "cpu_seconds": 2, "psnr": 21.5},
    ]
    assert parsed(record["command"])["peer"] == [peer]
    assert all(parsed(row["command"])["passes"] == row["passes"] for row in ours)
    assert (out / "photographs.png").stat().st_size > 10_000


def test_cold_keeps_no_lists(monkeypatch):
    gaussians = tiny.initial([])
    camera, cold, draw = core.surface_camera(gaussians, 32, 24), [], core.render

    def watched(gaussians, camera, cache=None):
        if cache is None:
            cold.append(camera)
        return draw(gaussians, camera, cache=cache)

    monkeypatch.setattr(core, "render", watched)
    core.time_core(gaussians, camera, 3)
    assert len(cold) == 3 + core.WARM_UP


@pytest.mark.slow
def test_times_every_operation_and_writes_json(capsys, tmp_path):
    json = tmp_path / "a b.json"
    arguments = ["--gaussians", "1000", "--repeats", "3", "--json", str(json)]
    study("bench", *arguments)
    written = read_json(json)
    line = f"python -m studies.bench --gaussians 1000 --repeats 3 --json '{json}'"
    assert written["command"] == line
    own = {"forward_cold", "forward_warm", "gradient_warm", "fisher_exact", "fisher_block"}
    assert set(written["seconds"]) == own | {"volprim_forward", "volprim_gradient"}
    assert all(value > 0 for value in [*written["seconds"].values(), *written["ratios"].values()])
    assert "forward warm speedup" in capsys.readouterr().out
    assert "is there already" in refused(capsys, ["--json", json], tmp_path, "bench")
