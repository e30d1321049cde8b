"""The real operations together: dataset, prior, next best views, evaluation, diagnosis, report."""

import json
import re
from pathlib import Path

import pytest
import synthetic
from program import command, exit_code, said, steps, stop_at, timeless

from mgs import ListCache, initial_gaussians, load_dataset, load_prior, read_ply, scene
from mgs.cli import app, demo, terminal
from mgs.cli.app import COMMANDS, main
from mgs.evaluation import psnr_measure
from mgs.fit import unfinished
from mgs.progress import Stage
from mgs.run.policies import POLICIES
from mgs.synth.rendering import write_contact_sheet

pytestmark = pytest.mark.usefixtures("coarse_priors")

VIEWS = ["--seeds", "3", "--budget", "4", "--set", "train.passes=6", "--seed", "1"]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return synthetic.orbit(tmp_path_factory.mktemp("end") / "dataset", 10).root


@pytest.fixture(scope="module")
def run(dataset, coarse_priors):
    out = dataset.parent / "run"
    command("nbv", dataset, "--out", out, "--gaussians", 300, *VIEWS, "--set", "evaluate_every=2")
    return out


def test_the_run_is_whole_and_learns_from_more_images(dataset, run):
    lines, metrics = steps(run), json.loads((run / "metrics.json").read_text())
    assert [line["images"] for line in lines] == [3, 4, 5, 6, 7]
    assert all(min(line["score"], line["information_gain"]) > 0 for line in lines[1:])
    assert ["psnr" in line for line in lines] == [True, False, True, False, True]
    every, held_out = metrics["all"], metrics["held_out"]
    assert (every["count"], held_out["count"]) == (10, 3)
    assert every["psnr"] == pytest.approx(lines[-1]["psnr"], abs=1e-4)
    assert held_out["psnr_mask"] == pytest.approx(lines[-1]["held_out_psnr_mask"], abs=1e-4)
    assert len(read_ply(run / "gaussians.ply")) == 300
    loaded, seeds = load_dataset(dataset), lines[0]["seeds"]
    start, _ = initial_gaussians(load_prior(run / "prior"), [loaded.frames[i] for i in seeds])
    untrained = psnr_measure(loaded, ListCache())(start, seeds)["psnr"]
    first, second, third = (line["psnr"] for line in lines if "psnr" in line)
    assert untrained < first < second < third


def test_a_fit_shows_a_view_before_its_end(dataset, run, tmp_path, capsys, monkeypatch):
    """Without a terminal, lines of progress are on the standard error."""
    for name in ("BETWEEN", "MOST"):
        monkeypatch.setattr(terminal, f"SECONDS_{name}", 0.0)
    out = tmp_path / "fit"
    command("fit", dataset, "--out", out, "--prior", run / "prior", "--passes", 5)
    printed, lines = said(capsys)
    decibels = [float(number) for number in re.findall(r"pass \d of 5: ([\d.]+) dB", printed)]
    assert decibels[0] < decibels[1]
    frames = load_dataset(dataset).frames
    assert (out / f"renders/{frames[len(frames) // 2].name}.png").is_file()
    assert "fitting: 7 of 70" in lines  # uses of an image: within a pass, too
    assert "fitting: 30 of 70" in lines
    command("dataset", "check", dataset)
    assert "reading: 3 of 10" in said(capsys)[1]


def test_an_interrupted_fit_continues_within_its_pass(dataset, run, tmp_path, monkeypatch):
    """From its config.json, too, which has its settings in another order."""
    monkeypatch.setattr(unfinished, "SECONDS", 0.0)
    out, report, used = tmp_path / "fit", scene.report, []

    def interrupted(last):
        def reported(stage, done, total):
            if stage == Stage.FIT and total > 1:
                used.append(done)
            if done == last:
                raise KeyboardInterrupt
            report(stage, done, total)

        return reported

    arguments = ["fit", dataset, "--prior", run / "prior", "--passes", 4, "--means", "free"]
    command(*arguments, "--out", tmp_path / "whole")
    monkeypatch.setattr(scene, "report", interrupted(37))
    assert exit_code(*arguments, "--out", out) == 130
    assert (out / "fit.npz").is_file()
    used.clear()
    monkeypatch.setattr(scene, "report", interrupted(-1))
    command("nbv", "--resume", out)
    assert used == list(range(37, 60))
    assert (out / "gaussians.ply").read_bytes() == (tmp_path / "whole/gaussians.ply").read_bytes()
    assert not (out / "fit.npz").exists()


def test_interrupted_in_the_middle_of_a_step_then_resumed(
    dataset, run, tmp_path, capsys, monkeypatch
):
    """Between two passes of the fit of its third step."""
    out, fit, fits = tmp_path / "run", scene.fit_gaussians, []

    def interrupted(gaussians, cameras, targets, settings, on_pass, *rest, **how):
        fits.append(len(cameras))
        on_pass = stop_at(2) if len(fits) == 3 else on_pass
        return fit(gaussians, cameras, targets, settings, on_pass, *rest, **how)

    with monkeypatch.context() as patched:
        patched.setattr(scene, "fit_gaussians", interrupted)
        arguments = ["nbv", dataset, "--out", out, "--prior", run / "prior", *VIEWS]
        assert exit_code(*arguments, "--set", "evaluate_every=2") == 130
    assert said(capsys)[1].endswith(f"mgs: interrupted; continue with: mgs nbv --resume {out}")
    assert len(steps(out)) == 2
    command("nbv", "--resume", out)
    assert timeless(steps(out)) == timeless(steps(run))
    assert (out / "gaussians.ply").read_bytes() == (run / "gaussians.ply").read_bytes()


def test_ctrl_c_inside_a_call_of_drjit_is_one_line_too(capsys, monkeypatch):
    """Dr.Jit raises an exception of its own with KeyboardInterrupt as its cause."""

    def stopped(*_, **__):
        raise RuntimeError("an exception while processing an argument") from KeyboardInterrupt()

    def broken(*_, **__):
        raise RuntimeError("broken")

    # The other commands write nothing before they are done, or start anew.
    goes_on = ("synth-orbit", "import", "demo")
    monkeypatch.setattr(app, "app", stopped)
    for name in COMMANDS:
        with pytest.raises(SystemExit) as stop:
            main([name])
        assert stop.value.code == 130
        hint = "; run the same command again to continue" if name in goes_on else ""
        assert capsys.readouterr().err == f"mgs: interrupted{hint}\n"
    monkeypatch.setattr(app, "app", broken)
    with pytest.raises(RuntimeError, match="broken"):
        main(["doctor"])


@pytest.mark.usefixtures("short_fits")
def test_demo_shows_the_table_and_the_pictures_and_can_be_repeated(tmp_path, capsys, monkeypatch):
    """All of `mgs demo` but the rendering of its dataset; the second time it changes nothing."""
    out = tmp_path / "demo"
    dataset = synthetic.orbit(out / "dataset", 13, 32, 24)
    write_contact_sheet(out / "dataset/contact_sheet.png", dataset.frames)
    synthetic.orbit(out / "dataset/test", 2, 32, 24)
    assert set(demo.POLICIES) < set(POLICIES)
    policies = ("d-optimal", "random")
    monkeypatch.setattr("mgs.cli.demo.POLICIES", policies)
    monkeypatch.setattr("mgs.cli.demo.GAUSSIANS", "150")
    monkeypatch.setattr("mgs.cli.demo.BUDGET", 1)
    monkeypatch.setattr("mgs.reports.diagnostics.VIEWS", 1)
    command("demo", out)
    shown = capsys.readouterr().out
    lines = shown[shown.index("4/4") :].splitlines()
    assert all(f"wrote {out / policy}\n" in shown for policy in policies)
    table = json.loads((out / "report/table.json").read_text())
    for row in table:
        line = next(line for line in lines if line.split()[:1] == [row["policy"]])
        assert line.split()[2:4] == [f"{row['test.psnr']:.2f}", f"{row['test.ssim']:.4f}"]
        last = steps(out / row["policy"])[-1]
        assert row["test.psnr"] == pytest.approx(last["test_psnr"], abs=1e-4)
    begin = ("wrote ", "  ")
    pictures = [line.split()[-1] for line in lines if line.startswith(begin) and "demo/" in line]
    assert sum(picture.endswith(".png") for picture in pictures) >= 7
    assert all(Path(picture).exists() for picture in pictures if picture.endswith(".png"))
    alone = ("--prior", out / "prior", "--budget", "1", "--set", "evaluate_every=1")
    command("nbv", out / "dataset", *alone, "--policy", "random", "--out", tmp_path / "alone")
    first, shared, own = (
        steps(path) for path in (out / "d-optimal", out / "random", tmp_path / "alone")
    )
    assert timeless(shared) == timeless(own)
    assert ["fit" in run[0]["seconds"] for run in (first, shared, own)] == [True, False, True]
    kept = {path: path.read_bytes() for path in out.glob("*/steps.jsonl")}
    assert len(kept) == len(policies)
    command("demo", out)
    assert {path: path.read_bytes() for path in out.glob("*/steps.jsonl")} == kept
