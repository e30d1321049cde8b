"""`mgs nbv` around the loop: what a run is started with, what is refused, what is printed."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny
from refusals import refused
from rich.console import Console

from mgs.cli.app import main
from mgs.cli.nbv import print_run, start_and_print
from mgs.data.dataset import load_dataset
from mgs.errors import InputError
from mgs.files import locked, write_json
from mgs.fit.settings import ALPHA_WEIGHT, TrainSettings
from mgs.images import write_png
from mgs.policy import criteria
from mgs.policy import poses as pose_policies
from mgs.prior.build import load_prior, save_prior
from mgs.report.convergence import remaining_decrease
from mgs.run import folder as run_folder
from mgs.run import nbv, recording
from mgs.run.folder import load_run
from mgs.splat import fisher


@pytest.fixture
def dataset(tmp_path):
    return tiny.write_dataset(tmp_path / "dataset")


def started(dataset: Path, out: Path, prior: Path | None = None, **values) -> tuple[dict, str]:
    """Settings in the config.json of a run that `start_and_print` wrote, and what it printed."""
    console = Console(record=True, width=500)
    start_and_print(dataset, out, console, prior=prior, **values)
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
    prior = tiny.write_prior(tmp_path / "prior")
    settings, _ = started(dataset, tmp_path / "run", prior, budget=2, seed=7)
    assert settings["train"] == TrainSettings(seed=7, alpha_weight=ALPHA_WEIGHT).model_dump()
    assert settings["train"]["seed"] == settings["seed"] == 7


@pytest.mark.parametrize(("frames", "budget"), [(12, 8), (4, 0), (60, 50)])
def test_the_default_budget_is_50_or_all_candidates(tmp_path, frames, budget):
    dataset, prior = (
        tiny.write_dataset(tmp_path / "orbit", frames=frames),
        tiny.write_prior(tmp_path / "prior"),
    )
    assert started(dataset, tmp_path / "run", prior)[0]["budget"] == budget
    with pytest.raises(InputError, match=f"exceeds its {frames - 4} candidates"):
        started(dataset, tmp_path / "more", prior, budget=frames - 3)


def blacken(dataset: Path, *frames: int) -> None:
    """Empty the masks of these frames."""
    for i in frames:
        write_png(dataset / f"masks/kf_{i:04d}.png", np.zeros((tiny.HEIGHT, tiny.WIDTH), bool))


@pytest.mark.parametrize(
    ("frames", "images", "named"),
    [(range(12), 0, "kf_0000"), ([4], 0, "kf_0004"), ([6], 4, "kf_0006")],
)
def test_a_frame_without_rock_is_refused_before_it_is_fitted_to(
    dataset, tmp_path, frames, images, named
):
    """Of 12 frames on a circle 0, 4 and 8 are seeds; `farthest` takes 2 first, then 6."""
    blacken(dataset, *frames)
    fits = []

    def fit(gaussians, start, cameras, *rest):
        fits.append(len(cameras))
        return tiny.fit(gaussians, start, cameras, *rest)

    loaded = load_dataset(dataset)
    settings = tiny.start(tmp_path / "run", loaded, policy="farthest")
    with pytest.raises(InputError, match=f"{named}.*is empty"):
        recording.run(tmp_path / "run", settings, loaded, tiny.operations(fit=fit), tiny.silent)
    assert max(fits, default=0) == images


def test_a_mean_over_no_view_is_left_out(dataset, tmp_path):
    """Held-out frames without rock: no line of steps.jsonl holds NaN, which is no JSON."""
    from mgs.run.operations import psnr_measure
    from mgs.splat import ListCache

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
    tiny.write_dataset(dataset / "test", frames=3)
    tested = psnr_measure(loaded, ListCache())(model, [0, 4, 8])
    assert list(tested) == ["psnr", "held_out_psnr", "test_psnr", "test_psnr_mask"]
    assert (
        tested["test_psnr"]
        == psnr_measure(load_dataset(dataset / "test"), ListCache())(model, [])["psnr"]
    )


def test_a_quality_that_could_not_be_measured_is_a_dash(dataset, tmp_path):
    state = run_folder.State(tiny.initial([]), np.zeros(0), np.zeros(0), [0], [])
    views = {"count": 2, "psnr": 30.123, "ssim": 0.95, "psnr_mask": None, "ssim_mask": None}
    console = Console(record=True, width=500)
    print_run(tmp_path, state, {"all": views, "held_out": {"count": 0}}, console)
    text = "(2): PSNR 30.12 dB, SSIM 0.9500; inside the rock mask PSNR – dB, SSIM –"
    assert f"views trained on {text}" in console.export_text(clear=False)
    assert "test views" not in console.export_text()
    print_run(tmp_path, state, {"all": views, "held_out": {"count": 0}, "test": views}, console)
    assert f"test views {text}\nviews trained on {text}" in console.export_text()


@pytest.mark.parametrize(
    "name", ["kf_{}", "DJI_20231105103211_000{}_W_some_flight", "frame {} of the [second] flight"]
)
@pytest.mark.parametrize("width", [80, 200])
def test_names_and_numbers_are_readable_at_80_columns(tmp_path, name, width):
    line = {
        "step": 0, "name": None, "seed_names": [name.format(i) for i in range(4)], "score": None, "coverage": 1.0,
        "iterations": 1120, "loss": 2.34e-4, "stop_reason": "pass-limit", "seconds": {"fit": 123.4},
    }  # fmt: skip
    steps = [line, line | {"step": 1, "name": name.format(5), "score": 1.234e-05}]
    console = Console(record=True, width=width)
    metrics = {"all": {"count": 0}, "held_out": {"count": 0}}
    print_run(
        tmp_path,
        nbv.State(tiny.initial([]), np.zeros(0), np.zeros(0), [0], steps),
        metrics,
        console,
    )
    shown = console.export_text().splitlines()[:-1]
    assert max(len(text) for text in shown) <= width
    for i in (0, 1, 2, 3, 5):
        assert sum(name.format(i) in text for text in shown) == 1
    for number in ("1.234e-05", "100.00 %", "1120", "0.000234", "pass-limit", "123.4"):
        assert any(number in text for text in shown)


@pytest.mark.parametrize("made", ["dataset", "random"])
def test_demo_does_not_show_another_seeds_results(tmp_path, capsys, made):
    root = tiny.write_dataset(tmp_path / "demo/dataset")
    if made == "dataset":
        write_json(root / "config.json", {"seed": 3})
    else:
        tiny.start(tmp_path / "demo/random", load_dataset(root), seed=3)
    with pytest.raises(SystemExit) as stop:
        main(["demo", str(tmp_path / "demo"), "--seed", "1"])
    assert stop.value.code == 2
    assert f"demo/{made}: was made with --seed 3, not 1" in capsys.readouterr().err
    assert not (tmp_path / "demo/prior").exists()


@pytest.mark.parametrize(
    "train", [{"speed": 1}, {"passes": "many"}, {"rates": [0.1, 0.2]}, {"decay": float("nan")}]
)
def test_damaged_settings_of_the_fit_are_one_line_on_resume(dataset, tmp_path, capsys, train):
    prior = tiny.write_prior(tmp_path / "prior")
    tiny.start(tmp_path / "run", load_dataset(dataset), prior=prior)
    config = json.loads((tmp_path / "run/config.json").read_text())
    config["settings"]["train"] = train
    (tmp_path / "run/config.json").write_text(json.dumps(config))
    with pytest.raises(SystemExit) as stop:
        main(["nbv", "--resume", str(tmp_path / "run")])
    assert stop.value.code == 2
    shown = capsys.readouterr().err
    assert f"config.json: settings.train.{next(iter(train))}" in shown
    assert len(shown.splitlines()) == 1


def test_learning_rates_that_are_too_high_are_one_line(dataset, prior, tmp_path, capsys):
    """The loss settles on that of a black image: flat, but above its start."""
    run = tmp_path / "run"
    train = {
        "optimiser": "adam",
        "rates": {"colour": 20, "scale": 20, "rotation": 10, "opacity": 50},
    }
    tiny.start(run, load_dataset(dataset), prior=prior, budget=1, train=train)
    said = refused(capsys, ["nbv", "--resume", run])
    assert "the fit to the seeds diverged: its loss was" in said
    assert "lower the learning rates (`train.rates` in" in said
    config = json.loads((run / "config.json").read_text())
    config["settings"]["train"] = {}
    write_json(run / "config.json", config)
    with pytest.raises(SystemExit) as stop:
        main(["nbv", "--resume", str(run)])
    assert stop.value.code == 0


@pytest.mark.parametrize("change", ["normals", "spacing", "points", "count"])
def test_a_replaced_prior_is_one_line_on_resume(dataset, prior, tmp_path, capsys, change):
    """Whatever changed in it; nothing is lost, and with the old one back the run goes on."""
    run = tmp_path / "run"
    tiny.start(run, load_dataset(dataset), prior=prior, budget=0, train={"passes": 1})
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
    save_prior(prior, other)
    capsys.readouterr()
    assert f"{prior}: is not the prior that {run} was started on" in refused(
        capsys, ["nbv", "--resume", run], run
    )
    prior.rename(tmp_path / "other")
    (tmp_path / "kept").rename(prior)
    with pytest.raises(SystemExit) as stop:
        main(["nbv", "--resume", str(run)])
    assert stop.value.code == 0


@pytest.mark.parametrize("command", [["nbv", "--resume"], ["eval"]])
def test_one_process_at_a_time_works_on_a_run(dataset, prior, tmp_path, capsys, command):
    """A second one would take the other's half-written files for those of a killed process, and
    remove them."""
    run = tiny.write_run(tmp_path / "run", dataset, prior)
    with locked(run):
        (run / ".checkpoint.1.part.npz").write_bytes(b"half")
        assert f"{run}: process {os.getpid()} works on it" in refused(capsys, [*command, run], run)
    with pytest.raises(SystemExit) as stop:
        main([*command, str(run)])
    assert stop.value.code == 0


def test_a_run_appears_whole_or_not_at_all(dataset, tmp_path, monkeypatch):
    """Killed while its prior is built, the same command works again: the folder takes its name when
    all of it is there."""
    there, start = [], run_folder.start

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
    "prior_std": (
        {"color": 1.0},
        "settings.prior_std: must be a number for each of colour, scale, rotation, opacity",
    ),
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


@pytest.mark.parametrize(
    "values", [{"pixel_noise": float("inf")}, {"prior_std": {"colour": float("inf")}}]
)
def test_scales_of_lambda_are_finite(dataset, tmp_path, values):
    with pytest.raises(InputError, match="finite"):
        started(dataset, tmp_path / "run", tiny.write_prior(tmp_path / "prior"), **values)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--estimator", "block"], "--estimator block: unknown; choose one of exact, hutchinson"),
        (["--estimator", "guess"], "--estimator guess: unknown"),
        (["--optimiser", "hope"], "--optimiser 'hope': unknown; choose one of natural, adam"),
        (["--lam", "0"], "--lam 0.0: Input should be greater than or equal to"),
        (["--rate", "colour"], "--rate colour: expected KIND=NUMBER, as in --rate colour=0.01"),
        (["--rate", "colour=-1"], "--rate colour=-1.0: Input should be greater than or equal to 0"),
        (
            ["--rate", "hue=1"],
            "--rate {'hue': 1.0}: must be a number for each of colour, scale, rotation, opacity",
        ),
        (["--prior-std", "scale=inf"], "--prior-std scale=inf: Input should be a finite number"),
        (
            ["--pixel-noise", "1e-200"],
            "--pixel-noise 1e-200: Input should be greater than or equal to 0.000001",
        ),
        (["--passes", "0"], "--passes 0: Input should be greater than or equal to 1"),
    ],
)
def test_bad_options_are_one_line(dataset, prior, tmp_path, capsys, options, message):
    out = tmp_path / "run"
    assert message in refused(
        capsys, ["nbv", dataset, "--prior", prior, "--budget", "1", "--out", out, *options]
    )
    assert not out.exists()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"optimizer": "adam"}, "setting optimizer = 'adam': Extra inputs are not permitted"),
        (
            {"train": {"tolerance": -1}},
            "setting train.tolerance = -1: Input should be greater than or equal to 0",
        ),
    ],
)
def test_settings_without_an_option_are_named_by_their_key(
    dataset, prior, tmp_path, values, message
):
    with pytest.raises(InputError, match=message):
        started(dataset, tmp_path / "run", prior, budget=1, **values)


def test_a_seed_of_the_fit_is_kept(dataset, prior, tmp_path):
    assert (
        started(dataset, tmp_path / "run", prior, budget=1, seed=3, train={"seed": 7})[0]["train"][
            "seed"
        ]
        == 7
    )


def test_options_of_the_criterion_and_the_fit_reach_the_run(dataset, prior, tmp_path):
    """The paper's Eq. 7: squared gradients of one scalar loss per image, one lambda."""
    options = "--estimator loss-gradient --lam 1e-6 --budget 1 --seeds 3 --passes 2"
    options += " --rate colour=0.1 --rate opacity=0 --prior-std scale=2"
    with pytest.raises(SystemExit) as stop:
        main(
            [
                "nbv",
                str(dataset),
                "--prior",
                str(prior),
                "--out",
                str(tmp_path / "run"),
                *options.split(),
            ]
        )
    assert stop.value.code == 0
    state = run_folder.read_checkpoint(tmp_path / "run")
    settings = run_folder.read_settings(tmp_path / "run")
    assert settings.train.rates == {"colour": 0.1, "scale": 0.04, "rotation": 0.02, "opacity": 0}
    assert settings.prior_std == criteria.PRIOR_STD | {"scale": 2.0}
    np.testing.assert_array_equal(
        state.gaussians.logit_opacities[0], state.gaussians.logit_opacities
    )
    cameras = [load_dataset(dataset).frames[i].camera for i in state.taken]
    paper = sum(
        fisher(state.gaussians, camera, "loss-gradient").astype(np.float64) for camera in cameras
    )
    np.testing.assert_array_equal(state.H, paper)
    exact = sum(fisher(state.gaussians, camera).astype(np.float64) for camera in cameras)
    assert np.abs(state.H - exact).max() > 0.5 * exact.max()


def test_options_of_the_choice_and_the_end_reach_the_run(dataset, prior, tmp_path):
    options = "--budget 0 --passes 1 --nearest 5 --travel 2.5 --batch 3 --stop-gain 0.01 --stop-uncertainty 0.2"
    with pytest.raises(SystemExit) as stop:
        main(
            [
                "nbv",
                str(dataset),
                "--prior",
                str(prior),
                "--out",
                str(tmp_path / "run"),
                *options.split(),
            ]
        )
    assert stop.value.code == 0
    found = run_folder.read_settings(tmp_path / "run")
    assert (found.nearest, found.travel, found.batch, found.stop_gain, found.stop_uncertainty) == (
        5,
        2.5,
        3,
        0.01,
        0.2,
    )


def test_without_masks_alpha_has_no_weight_by_default(dataset, prior, tmp_path):
    """A frame with neither mask nor alpha shows nothing but rock: its alpha is 1 everywhere, which
    no camera measured."""
    assert (
        started(dataset, tmp_path / "masked", prior, budget=1)[0]["train"]["alpha_weight"]
        == ALPHA_WEIGHT
    )
    made = json.loads((dataset / "transforms.json").read_text())
    for frame in made["frames"]:
        frame.pop("mask_path", None)
        frame.pop("rock_file_path", None)
    (dataset / "transforms.json").write_text(json.dumps(made))
    assert started(dataset, tmp_path / "bare", prior, budget=1)[0]["train"]["alpha_weight"] == 0
    given = started(dataset, tmp_path / "given", prior, budget=1, train={"alpha_weight": 0.3})
    assert given[0]["train"]["alpha_weight"] == 0.3


def test_alpha_as_a_channel_reaches_every_fit_and_the_resumed_run(dataset, prior, tmp_path):
    def run(name, *options):
        with pytest.raises(SystemExit) as stop:
            main(
                [
                    "nbv",
                    *map(str, options),
                    "--out" if options else "--resume",
                    str(tmp_path / name),
                ]
            )
        assert stop.value.code == 0
        return run_folder.read_settings(tmp_path / name), run_folder.read_checkpoint(
            tmp_path / name
        )

    given = [dataset, "--prior", prior, "--passes", 2, "--policy", "uniform"]
    settings, plain = run("plain", *given, "--budget", 1, "--alpha-weight", 0)
    with_alpha, whole = run("whole", *given, "--budget", 1, "--alpha-weight", 0.5)
    usual, _ = run("usual", *given, "--budget", 0)
    assert [s.train.alpha_weight for s in (settings, with_alpha, usual)] == [0, 0.5, ALPHA_WEIGHT]
    assert (whole.gaussians.logit_opacities != plain.gaussians.logit_opacities).any()
    run("begun", *given, "--budget", 0, "--alpha-weight", 0.5)
    config = tmp_path / "begun/config.json"
    config.write_text(config.read_text().replace('"budget": 0', '"budget": 1'))
    _, begun = run("begun")
    assert begun.taken == whole.taken
    assert (tmp_path / "begun/gaussians.ply").read_bytes() == (
        tmp_path / "whole/gaussians.ply"
    ).read_bytes()
    frames = [load_dataset(dataset).frames[i] for i in whole.taken]
    phi = [
        remaining_decrease(whole.gaussians, s, load_prior(prior), frames)["phi"]
        for s in (settings, with_alpha)
    ]
    assert phi[1] > phi[0] > 0


def test_the_documented_policy_of_ones_own(dataset, tmp_path, monkeypatch):
    """The criterion in docs/howto/policy.md is started, run, and read back where nobody registered
    it."""
    name = "least-known"
    monkeypatch.setitem(criteria.CRITERIA, name, None)  # so that it is gone again at the end
    monkeypatch.setitem(pose_policies.POSE_POLICIES, "highest", None)
    page = (Path(__file__).parent.parent / "docs/howto/policy.md").read_text()
    exec(page.split('```python title="my_mgs.py"\n')[1].split("```")[0], {})
    started(dataset, tmp_path / "run", tiny.write_prior(tmp_path / "prior"), policy=name, budget=1)

    loaded, scores = load_dataset(dataset), []
    own = criteria.CRITERIA[name]
    counted = criteria.Criterion(lambda *given: scores.append(own.score(*given)) or scores[-1])
    monkeypatch.setitem(criteria.CRITERIA, name, counted)
    state = recording.run(
        tmp_path / "run",
        run_folder.read_settings(tmp_path / "run"),
        loaded,
        tiny.operations(),
        tiny.silent,
    )
    assert len(scores) == len(loaded) - 4
    assert state.steps[-1]["score"] == max(scores) > 0

    monkeypatch.undo()
    assert load_run(tmp_path / "run")[3] == name
    with pytest.raises(InputError, match=f"--policy {name}: unknown; choose one of d-optimal"):
        recording.run(
            tmp_path / "run",
            run_folder.read_settings(tmp_path / "run"),
            loaded,
            tiny.operations(),
            tiny.silent,
        )


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


def test_a_run_that_is_there_is_not_begun_again(dataset, prior, tmp_path, capsys):
    run = tiny.write_run(tmp_path / "run", dataset, prior)
    said = refused(capsys, ["nbv", dataset, "--prior", prior, "--out", run], run)
    assert (
        f"{run}: holds a run; `mgs nbv --resume {run}` continues it; for another, choose a new folder"
        in said
    )


@pytest.mark.parametrize(
    "option", ["--budget 9", "--policy random", "--exposure", "--prior-std colour=1"]
)
def test_resume_takes_no_other_setting(dataset, prior, tmp_path, capsys, option):
    run = tiny.write_run(tmp_path / "run", dataset, prior)
    said = refused(capsys, ["nbv", "--resume", run, *option.split()], run)
    assert (
        f"nbv: {option.split()[0]}: --resume takes its settings from {run / 'config.json'}; change it there"
        in said
    )


def test_a_dataset_is_not_taken_for_a_run(dataset, prior, tmp_path, capsys):
    (tmp_path / "other").mkdir()
    (tmp_path / "other/config.json").write_text('{"scene": {}}')
    said = refused(
        capsys, ["nbv", dataset, "--prior", prior, "--out", tmp_path / "other"], tmp_path
    )
    assert "not empty" in said
    assert "--resume" not in said
