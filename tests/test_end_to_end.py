"""The real stations together on a rock of a few pixels: dataset, prior, next best views,
evaluation, diagnosis, report."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import synthetic

from mgs.cli import app
from mgs.cli.app import COMMANDS, main
from mgs.data.dataset import load_dataset
from mgs.images import read_exr
from mgs.policy import criteria
from mgs.report import predicted_error
from mgs.run import folder as run_folder
from mgs.splat_ply import read_ply

OPTIONS = ["--gaussians", "300", "--seeds", "3", "--budget", "4", "--passes", "6", "--seed", "1"]
STRUCK = """
import os, signal
from mgs.run import operations
from mgs.cli.app import main

fit, fits = operations.fit, []

def struck(gaussians, cameras, targets, settings, on_pass, *rest):
    fits.append(len(cameras))

    def blow(done, most):
        on_pass(done, most)
        if len(fits) == 3:
            os.kill(os.getpid(), {blow})

    return fit(gaussians, cameras, targets, settings, blow, *rest)

operations.fit = struck
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell starts what runs in the background deaf to it
main()
"""
"""The program, which sends itself a signal in the middle of its third step: between two passes of
the fit."""


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    root = tmp_path_factory.mktemp("end") / "dataset"
    synthetic.write_dataset(root, synthetic.orbit_cameras(10, 48, 36))
    return root


@pytest.fixture(scope="module")
def run(dataset):
    out = dataset.parent / "run"
    command("nbv", dataset, "--out", out, *OPTIONS, "--evaluate-every", 2)
    return out


def command(*arguments) -> None:
    """A command of the program, in this process; it must end well."""
    with pytest.raises(SystemExit) as stop:
        main([str(argument) for argument in arguments])
    assert stop.value.code == 0


def steps(out: Path) -> list[dict]:
    return [json.loads(line) for line in (out / "steps.jsonl").read_text().splitlines()]


def test_errors_are_predicted_and_judged(run):
    """The calibration of a real run: on its own views, whose shares inside the intervals are what
    they were fitted to be."""
    command("diagnose", run, "--calibrate")
    found = json.loads((run / "diagnostics/uncertainty.json").read_text())
    assert found["views"] == {"folds": 7, "held out": 3}
    rows = {(row["prediction"], row["views"]): row for row in found["rows"]}
    assert len(rows) == 4 * 2
    for prediction in predicted_error.ROWS:
        assert rows[prediction, "folds"]["held"]["0.9"][0] == pytest.approx(0.9, abs=0.01)
        assert rows[prediction, "held out"]["spearman"] > 0
    maps = read_exr(next((run / "diagnostics").glob("*.errors.exr")))
    assert set(maps) == {f"{what}.{channel}" for what in ("error", "sigma") for channel in "RGB"}
    assert min(maps[f"sigma.{channel}"].min() for channel in "RGB") > 0
    first = (run / "diagnostics/uncertainty.json").read_bytes()
    command("diagnose", run, "--calibrate")
    assert (run / "diagnostics/uncertainty.json").read_bytes() == first


def test_the_run_is_whole(dataset, run):
    lines, metrics = steps(run), json.loads((run / "metrics.json").read_text())
    frames = load_dataset(dataset).frames
    assert [line["images"] for line in lines] == [3, 4, 5, 6, 7]
    assert all(line["score"] == line["information_gain"] > 0 for line in lines[1:])
    assert ["psnr" in line for line in lines] == [True, False, True, False, True]
    assert metrics["all"]["count"] == 10
    assert metrics["held_out"]["count"] == 3
    assert metrics["all"]["psnr"] == pytest.approx(lines[-1]["psnr"], abs=1e-4)
    assert metrics["held_out"]["psnr_mask"] == pytest.approx(
        lines[-1]["held_out_psnr_mask"], abs=1e-4
    )
    assert {line["name"] for line in lines[1:]} < {frame.name for frame in frames}
    assert len(read_ply(run / "gaussians.ply")) == 300
    config = json.loads((run / "config.json").read_text())
    assert config["settings"]["train"]["passes"] == 6
    assert Path(config["settings"]["prior"]) == (run / "prior").resolve()


def test_learning_helps_and_so_do_more_images(dataset, run):
    from mgs.prior.build import load_prior
    from mgs.prior.initial import initial_gaussians
    from mgs.run.operations import psnr_measure
    from mgs.splat import ListCache

    loaded, lines = load_dataset(dataset), steps(run)
    start, _ = initial_gaussians(
        load_prior(run / "prior"), [loaded.frames[i] for i in lines[0]["seeds"]]
    )
    untrained = psnr_measure(loaded, ListCache())(start, lines[0]["seeds"])["psnr"]
    measured = [line["psnr"] for line in lines if "psnr" in line]
    assert untrained < measured[0] < measured[1] < measured[2]


def test_choice_is_the_best_of_the_real_information(dataset, run):
    """Redo the last choice from the checkpoint of a run one view shorter, candidate by
    candidate."""
    from mgs.splat import fisher, groups

    shorter = dataset.parent / "shorter"
    command(
        "nbv",
        dataset,
        "--out",
        shorter,
        "--prior",
        run / "prior",
        *OPTIONS[2:4],
        "--budget",
        3,
        *OPTIONS[6:],
    )
    state, frames = run_folder.read_checkpoint(shorter), load_dataset(dataset).frames
    lam = criteria.regularisation(groups(0))
    H = sum(fisher(state.gaussians, frames[i].camera).astype(np.float64) for i in state.taken)
    left = [i for i in range(10) if i not in state.taken]
    gains = [criteria.d_optimal(fisher(state.gaussians, frames[i].camera), H, lam) for i in left]
    last = steps(run)[-1]
    assert last["frame"] == left[int(np.argmax(gains))]
    assert last["score"] == pytest.approx(max(gains), rel=1e-5)


@pytest.mark.parametrize(
    ("blow", "code"), [(signal.SIGKILL, -signal.SIGKILL), (signal.SIGINT, 130)]
)
def test_interrupted_in_the_middle_of_a_step_then_resumed(dataset, run, tmp_path, blow, code):
    """A real process, a real signal inside the third step; the same views, the same model, bit for
    bit."""
    out = tmp_path / "run"
    program = [sys.executable, "-c", STRUCK.format(blow=int(blow))]
    arguments = ["nbv", str(dataset), "--out", str(out), *OPTIONS, "--evaluate-every", "2"]
    process = subprocess.run([*program, *arguments], capture_output=True, text=True)
    error = process.stderr
    assert process.returncode == code, error
    assert "Traceback" not in error
    assert ("mgs: interrupted" in error) == (blow == signal.SIGINT)
    before = steps(out)
    assert len(before) == 2
    command("nbv", "--resume", out)
    assert timeless(steps(out)) == timeless(steps(run))
    assert (out / "gaussians.ply").read_bytes() == (run / "gaussians.ply").read_bytes()


def test_ctrl_c_inside_a_call_of_drjit_is_one_line_too(capsys, monkeypatch):
    """Dr.Jit turns it into an exception of its own, with Ctrl-C as the cause; an exception without
    it stays what it is."""

    def stopped(*_, **__):
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as interrupt:
            raise RuntimeError(
                "an exception while processing an argument (see above)"
            ) from interrupt

    def broken(*_, **__):
        raise RuntimeError("broken")

    monkeypatch.setattr(app, "app", stopped)
    for name in COMMANDS:
        with pytest.raises(SystemExit) as stop:
            main([name])
        assert stop.value.code == 130
        # Only these go on: the others write nothing before they are done, or start anew.
        goes_on = ("synth-orbit", "import", "demo", "reproduce", "chart", "stress", "parsimony")
        again = "; run the same command again to continue" if name in goes_on else ""
        resume = (
            "; `mgs nbv --resume RUN` continues a run whose folder is there"
            if name == "nbv"
            else ""
        )
        assert capsys.readouterr().err == f"mgs: interrupted{again}{resume}\n"
    monkeypatch.setattr(app, "app", broken)
    with pytest.raises(RuntimeError, match="broken"):
        main(["doctor"])


def timeless(lines: list[dict]) -> list[dict]:
    return [{key: value for key, value in line.items() if key != "seconds"} for line in lines]


def test_resuming_a_finished_run_shows_it_again(run, capsys):
    before = (run / "checkpoint.npz").read_bytes()
    command("nbv", "--resume", run)
    assert (run / "checkpoint.npz").read_bytes() == before
    assert "views never trained on" in capsys.readouterr().out


def test_compare_policies_and_report(dataset, run, tmp_path, capsys):
    from mgs.report.writing import write_report

    other = dataset.parent / "random"
    command(
        "nbv", dataset, "--out", other, "--prior", run / "prior", "--policy", "random", *OPTIONS[2:]
    )
    capsys.readouterr()
    for folder in (run, other):
        command("eval", folder)  # `mgs nbv` has measured the model, and drawn nothing
        assert f"kept {folder}/metrics.json, measured before" in capsys.readouterr().out
    command("diagnose", run, "--views", "kf_0001")
    written = write_report(tmp_path / "report", [run, other])
    assert {"orbit.png", "gain.png", "coverage.png", "comparison.png", "table.md"} <= {
        path.name for path in written
    }
    assert len(list((run / "renders").iterdir())) == 10
    assert (run / "diagnostics/kf_0001.exr").is_file()


def test_demo_shows_the_table_and_the_pictures_and_can_be_given_again(
    tmp_path, capsys, monkeypatch
):
    """`mgs demo` over a dataset that is there already (rendering takes minutes): every later
    station, then nothing to do."""
    from mgs.cli.demo import POLICIES
    from mgs.synth.rendering import write_contact_sheet

    out = tmp_path / "demo"
    dataset = synthetic.write_dataset(out / "dataset", synthetic.orbit_cameras(13, 48, 36))
    write_contact_sheet(out / "dataset/contact_sheet.png", dataset.frames)
    synthetic.write_dataset(out / "dataset/test", synthetic.orbit_cameras(2, 48, 36))
    for name, value in {
        "cli.demo.GAUSSIANS": 200,
        "cli.demo.BUDGET": 2,
        "report.diagnostics.VIEWS": 1,
    }.items():
        monkeypatch.setattr(f"mgs.{name}", value)
    command("demo", out)
    shown = capsys.readouterr().out
    assert all(policy in shown for policy in POLICIES)
    assert shown.count("test views (2): PSNR") == len(POLICIES)
    table = json.loads((out / "report/table.json").read_text())
    for row in table:
        line = next(line for line in shown.splitlines() if line.split()[:1] == [row["policy"]])
        assert line.split()[2:4] == [f"{row['test.psnr']:.2f}", f"{row['test.ssim']:.4f}"]
        assert row["test.psnr"] == pytest.approx(
            steps(out / row["policy"])[-1]["test_psnr"], abs=1e-4
        )
    pictures = [
        Path(line.strip())
        for line in shown.splitlines()
        if line.startswith("  ") and "demo/" in line
    ]
    assert len(pictures) >= 7
    assert all(picture.is_file() for picture in pictures)
    kept = {path: path.read_bytes() for path in out.glob("*/steps.jsonl")}
    assert len(kept) == len(POLICIES)
    command("demo", out)
    assert {path: path.read_bytes() for path in out.glob("*/steps.jsonl")} == kept
