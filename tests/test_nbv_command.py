"""`mgs nbv` around the loop: what a run is started with, what is refused, what is printed."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, fields, replace
from pathlib import Path

import numpy as np
import pytest
import tiny
from refusals import refused
from rich.console import Console

from mgs import nbv, policies
from mgs.cli import main
from mgs.commands.nbv import print_run, read_train_settings, start_run, train_settings
from mgs.dataset import load_dataset
from mgs.errors import InputError
from mgs.evaluate import load_run
from mgs.files import locked, write_json, write_png
from mgs.prior import load_prior, save_prior
from mgs.surface import Mesh


@pytest.fixture
def dataset(tmp_path):
    return tiny.write_dataset(tmp_path / "dataset")


def started(dataset: Path, out: Path, prior: Path | None = None, **values) -> tuple[dict, str]:
    """Settings in the config.json of a run that `start_run` wrote, and what it printed."""
    console = Console(record=True, width=500)
    start_run(dataset, out, prior, None, values, console)
    return json.loads((out / "config.json").read_text())["settings"], console.export_text()


def test_the_datasets_own_prior_is_the_default(dataset, tmp_path):
    own, other = tiny.write_prior(dataset / "prior"), tiny.write_prior(tmp_path / "other")
    settings, shown = started(dataset, tmp_path / "run", budget=2)
    assert Path(settings["prior"]) == own.resolve()
    assert f"prior: {own}" in shown
    assert not (tmp_path / "run/prior").exists()
    settings, _ = started(dataset, tmp_path / "given", other, budget=2)
    assert Path(settings["prior"]) == other.resolve()


def test_every_setting_of_the_fit_is_written_down_and_the_root_seed_reaches_it(dataset, tmp_path):
    from mgs.train import TrainSettings

    prior = tiny.write_prior(tmp_path / "prior")
    settings, _ = started(dataset, tmp_path / "run", prior, budget=2, seed=7)
    assert set(settings["train"]) == {field.name for field in fields(TrainSettings)}
    assert settings["train"]["seed"] == settings["seed"] == 7


@pytest.mark.parametrize(("frames", "budget"), [(12, 8), (4, 0), (60, 50)])
def test_the_default_budget_is_50_or_all_candidates(tmp_path, frames, budget):
    dataset, prior = tiny.write_dataset(tmp_path / "orbit", frames=frames), tiny.write_prior(tmp_path / "prior")
    assert started(dataset, tmp_path / "run", prior)[0]["budget"] == budget
    with pytest.raises(InputError, match=f"exceeds its {frames - 4} candidates"):
        started(dataset, tmp_path / "more", prior, budget=frames - 3)


def blacken(dataset: Path, *frames: int) -> None:
    """Empty the masks of these frames."""
    for i in frames:
        write_png(dataset / f"masks/kf_{i:04d}.png", np.zeros((tiny.HEIGHT, tiny.WIDTH), bool))


@pytest.mark.parametrize(("frames", "images", "named"), [(range(12), 0, "kf_0000"), ([4], 0, "kf_0004"), ([6], 4, "kf_0006")])
def test_a_frame_without_rock_is_refused_before_it_is_fitted_to(dataset, tmp_path, frames, images, named):
    """Of 12 frames on a circle 0, 4 and 8 are seeds; `farthest` takes 2 first, then 6."""
    blacken(dataset, *frames)
    fits = []

    def fit(gaussians, cameras, *rest):
        fits.append(len(cameras))
        return tiny.fit(gaussians, cameras, *rest)

    loaded = load_dataset(dataset)
    settings = tiny.start(tmp_path / "run", loaded, policy="farthest")
    with pytest.raises(InputError, match=f"{named}.*is empty"):
        nbv.run(tmp_path / "run", settings, loaded, tiny.stations(fit=fit), tiny.silent)
    assert max(fits, default=0) == images


def test_a_mean_over_no_view_is_left_out(dataset, tmp_path):
    """Held-out frames without rock: no line of steps.jsonl holds NaN, which is no JSON."""
    from mgs.splat import ListCache
    from mgs.stations import psnr_measure

    loaded, model = load_dataset(dataset), tiny.initial([])
    whole = psnr_measure(loaded, ListCache())(model, [0, 4, 8])
    assert list(whole) == ["psnr", "psnr_mask", "held_out_psnr", "held_out_psnr_mask"]
    blacken(dataset, *(set(range(12)) - {0, 4, 8}))
    measure = psnr_measure(loaded, ListCache())
    found = measure(model, [0, 4, 8])
    assert list(found) == ["psnr", "psnr_mask", "held_out_psnr"]
    assert np.isfinite(list(found.values())).all()
    assert list(measure(model, list(range(12)))) == ["psnr", "psnr_mask"]
    blacken(dataset, 0, 4, 8)
    assert list(psnr_measure(loaded, ListCache())(model, [0, 4, 8])) == ["psnr", "held_out_psnr"]


def test_a_quality_that_could_not_be_measured_is_a_dash(dataset, tmp_path):
    state = nbv.State(tiny.initial([]), np.zeros(0), np.zeros(0), [0], [])
    views = {"count": 2, "psnr": 30.123, "ssim": 0.95, "psnr_mask": None, "ssim_mask": None}
    console = Console(record=True, width=500)
    print_run(tmp_path, state, {"all": views, "held_out": {"count": 0}}, console)
    assert "all views (2): PSNR 30.12 dB, SSIM 0.9500; inside the rock mask PSNR – dB, SSIM –" in console.export_text()


@pytest.mark.parametrize("name", ["kf_{}", "DJI_20231105103211_000{}_W_some_flight", "frame {} of the [second] flight"])
@pytest.mark.parametrize("width", [80, 200])
def test_names_and_numbers_are_readable_at_80_columns(tmp_path, name, width):
    line = {
        "step": 0, "name": None, "seed_names": [name.format(i) for i in range(4)], "gain": None, "coverage": 1.0,
        "iterations": 1120, "loss": 2.34e-4, "stop_reason": "pass-limit", "seconds": {"fit": 123.4},
    }  # fmt: skip
    steps = [line, line | {"step": 1, "name": name.format(5), "gain": 1.234e-05}]
    console = Console(record=True, width=width)
    metrics = {"all": {"count": 0}, "held_out": {"count": 0}}
    print_run(tmp_path, nbv.State(tiny.initial([]), np.zeros(0), np.zeros(0), [0], steps), metrics, console)
    shown = console.export_text().splitlines()[:-1]
    assert max(len(text) for text in shown) <= width
    for i in (0, 1, 2, 3, 5):
        assert sum(name.format(i) in text for text in shown) == 1
    for number in ("1.234e-05", "100.00 %", "1120", "0.000234", "pass-limit", "123.4"):
        assert any(number in text for text in shown)


@pytest.mark.parametrize("made", ["dataset", "coverage"])
def test_demo_does_not_show_another_seeds_results(tmp_path, capsys, made):
    root = tiny.write_dataset(tmp_path / "demo/dataset")
    if made == "dataset":
        write_json(root / "config.json", {"seed": 3})
    else:
        tiny.start(tmp_path / "demo/coverage", load_dataset(root), seed=3)
    with pytest.raises(SystemExit) as stop:
        main(["demo", str(tmp_path / "demo"), "--seed", "1"])
    assert stop.value.code == 2
    assert f"demo/{made}: was made with --seed 3, not 1" in capsys.readouterr().err
    assert not (tmp_path / "demo/prior").exists()


@pytest.mark.parametrize("train", [{"speed": 1}, {"passes": "many"}, {"rates": [0.1, 0.2]}, {"decay": float("nan")}])
def test_damaged_settings_of_the_fit_are_one_line_on_resume(dataset, tmp_path, capsys, train):
    prior = tiny.write_prior(tmp_path / "prior")
    tiny.start(tmp_path / "run", load_dataset(dataset), prior=prior, train=train)
    with pytest.raises(SystemExit) as stop:
        main(["nbv", "--resume", str(tmp_path / "run")])
    assert stop.value.code == 2
    shown = capsys.readouterr().err
    assert f"config.json: train.{next(iter(train))}" in shown
    assert len(shown.splitlines()) == 1


def test_learning_rates_that_are_too_high_are_one_line(dataset, prior, tmp_path, capsys):
    """The loss settles on that of a black image: flat, but above its start."""
    run = tmp_path / "run"
    train = train_settings(None, 0) | {"rates": [20, 20, 10, 50]}
    tiny.start(run, load_dataset(dataset), prior=prior, budget=1, train=train)
    said = refused(capsys, ["nbv", "--resume", run])
    assert "the fit to the seeds diverged: its loss was" in said
    assert "lower the learning rates (`train.rates` in" in said
    config = json.loads((run / "config.json").read_text())
    config["settings"]["train"] = train_settings(None, 0)
    write_json(run / "config.json", config)
    with pytest.raises(SystemExit) as stop:
        main(["nbv", "--resume", str(run)])
    assert stop.value.code == 0


@pytest.mark.parametrize("change", ["normals", "spacing", "points", "count"])
def test_a_replaced_prior_is_one_line_on_resume(dataset, prior, tmp_path, capsys, change):
    """Whatever changed in it; nothing is lost, and with the old one back the run goes on."""
    run = tmp_path / "run"
    tiny.start(run, load_dataset(dataset), prior=prior, budget=0, train=train_settings(1, 0))
    with pytest.raises(SystemExit):
        main(["nbv", "--resume", str(run)])
    config = json.loads((run / "config.json").read_text())
    config["settings"]["budget"] = 1
    write_json(run / "config.json", config)
    known = load_prior(prior)
    other = {
        "normals": replace(known, normals=known.normals[::-1]),
        "spacing": replace(known, numbers=known.numbers | {"spacing": 0.4}),
        "points": replace(known, points=known.points[::-1]),
        "count": replace(known, points=known.points[1:], normals=known.normals[1:]),
    }[change]
    prior.rename(tmp_path / "kept")
    save_prior(prior, other, Mesh(known.points[:3], np.array([[0, 1, 2]]), np.zeros(1, bool)))
    capsys.readouterr()
    assert f"{prior}: is not the prior that {run} was started on" in refused(capsys, ["nbv", "--resume", run], run)
    prior.rename(tmp_path / "other")
    (tmp_path / "kept").rename(prior)
    with pytest.raises(SystemExit) as stop:
        main(["nbv", "--resume", str(run)])
    assert stop.value.code == 0


@pytest.mark.parametrize("command", [["nbv", "--resume"], ["eval"]])
def test_one_process_at_a_time_works_on_a_run(dataset, prior, tmp_path, capsys, command):
    """A second one would take the other's half-written files for those of a killed process, and remove them."""
    run = tiny.write_run(tmp_path / "run", dataset, prior)
    with locked(run):
        (run / ".checkpoint.1.part.npz").write_bytes(b"half")
        assert f"{run}: process {os.getpid()} works on it" in refused(capsys, [*command, run], run)
    with pytest.raises(SystemExit) as stop:
        main([*command, str(run)])
    assert stop.value.code == 0


def test_a_run_appears_whole_or_not_at_all(dataset, tmp_path, monkeypatch):
    """Killed while its prior is built, the same command works again: the folder takes its name when all of it is there."""
    there, start = [], nbv.start

    def watched(out, *rest):
        there.append((tmp_path / "run").exists())
        start(out, *rest)

    monkeypatch.setattr(nbv, "start", watched)
    own = tiny.write_prior(tmp_path / "prior")
    started(dataset, tmp_path / "run", own, budget=1)
    assert there == [False]
    assert {p.name for p in tmp_path.iterdir()} == {"run", "prior", dataset.name}


SETTINGS = {
    "budget": (-1, "settings.budget: Input should be greater than or equal to 0"),
    "seeds": ("four", "settings.seeds: Input should be a valid integer"),
    "speed": (1, "settings.speed: Extra inputs are not permitted"),
    "prior_std": ({"colour": 1.0}, "settings.prior_std: must have a number for each of colour, scale, rotation, opacity"),
}


@pytest.mark.parametrize("key", SETTINGS)
@pytest.mark.parametrize("command", [["nbv", "--resume"], ["eval"], ["diagnose"]])
def test_a_damaged_setting_is_named_with_its_file(dataset, prior, tmp_path, capsys, key, command):
    """Not by the option of a command that nobody gave."""
    run = tiny.write_run(tmp_path / "run", dataset, prior)
    config = json.loads((run / "config.json").read_text())
    value, named = SETTINGS[key]
    config["settings"][key] = value
    write_json(run / "config.json", config)
    said = refused(capsys, [*command, run], run)
    assert f"{run}/config.json: {named}" in said
    assert "--" not in said


@pytest.mark.parametrize("values", [{"pixel_noise": float("inf")}, {"prior_std": {"colour": float("inf")}}])
def test_scales_of_lambda_are_finite(dataset, tmp_path, values):
    with pytest.raises(InputError, match="finite"):
        started(dataset, tmp_path / "run", tiny.write_prior(tmp_path / "prior"), **values)


def test_settings_of_the_fit_are_read_back_as_they_were(tmp_path):
    from mgs.train import TrainSettings

    assert asdict(read_train_settings(tmp_path, train_settings(6, 2))) == asdict(TrainSettings(passes=6, seed=2))


def test_the_documented_policy_of_ones_own(dataset, tmp_path, monkeypatch):
    """The program in docs/nbv.md, its command caught: the policy is started, run, and read back where nobody registered it."""
    monkeypatch.setattr(policies, "CRITERIA", dict(policies.CRITERIA))
    commands: list[list[str]] = []
    monkeypatch.setattr("mgs.cli.main", commands.append)
    page = (Path(__file__).parent.parent / "docs/nbv.md").read_text()
    exec(page.split("```python\n")[1].split("```")[0], {})
    name = commands[0][commands[0].index("--policy") + 1]
    started(dataset, tmp_path / "run", tiny.write_prior(tmp_path / "prior"), policy=name, budget=1)

    loaded, scores = load_dataset(dataset), []
    own = policies.CRITERIA[name]
    monkeypatch.setitem(policies.CRITERIA, name, lambda *given: scores.append(own(*given)) or scores[-1])
    state = nbv.run(tmp_path / "run", nbv.read_settings(tmp_path / "run"), loaded, tiny.stations(), tiny.silent)
    assert len(scores) == len(loaded) - 4
    assert state.steps[-1]["gain"] == max(scores) > 0

    monkeypatch.undo()
    assert load_run(tmp_path / "run")[3] == name
    with pytest.raises(InputError, match=f"--policy {name}: unknown; choose one of d-optimal"):
        nbv.run(tmp_path / "run", nbv.read_settings(tmp_path / "run"), loaded, tiny.stations(), tiny.silent)


@pytest.mark.parametrize("moved", ["dataset", "prior"])
def test_what_a_run_was_made_from_has_moved(dataset, prior, tmp_path, capsys, moved):
    run = tiny.write_run(tmp_path / "run", dataset, prior)
    (tmp_path / moved).rename(tmp_path / "elsewhere")
    with pytest.raises(SystemExit) as stop:
        main(["nbv", "--resume", str(run)])
    assert stop.value.code == 2
    assert (
        f"run/config.json: {moved} {tmp_path / moved} is not there; if it was moved, correct `{moved}`"
        in capsys.readouterr().err
    )
