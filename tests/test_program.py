"""The program as a whole: how it starts and ends, what it repairs; settings of `mgs nbv`."""

import fcntl
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny
import typer
from program import change_settings, command, python
from refusals import fails, refused

import mgs
from mgs import InputError, ListCache, fisher, load_dataset, load_prior, read_ply, save_prior
from mgs.cli import nbv as nbv_command
from mgs.cli.app import COMMANDS, _hint, app
from mgs.cli.options import keys_of
from mgs.evaluation import psnr_measure
from mgs.files import write_json
from mgs.fit.settings import ALPHA_WEIGHT
from mgs.images import write_png
from mgs.policy import criteria
from mgs.run import folder as run_folder
from mgs.run.folder import read_checkpoint
from mgs.run.inputs import prior_digest
from mgs.run.settings import NbvSettings

INTERRUPTED = """
import builtins
from mgs.__main__ import main
real = builtins.__import__

def interrupted(name, *rest):
    if name == {module!r}:
        raise KeyboardInterrupt
    return real(name, *rest)

builtins.__import__ = interrupted
main()
"""


def test_ctrl_c_while_modules_are_imported_is_one_line():
    for module, arguments in {"typer": [], "mgs.cli.app": [], "mgs.resources": ["doctor"]}.items():
        ended = python(INTERRUPTED.format(module=module), *arguments)
        assert (ended.returncode, ended.stderr) == (130, "mgs: interrupted\n")


def test_a_damaged_model_is_restored_from_the_checkpoint(dataset, prior, tmp_path, capsys):
    run = tiny.write_run(tmp_path / "run", dataset, prior)
    model, intact = run / "gaussians.ply", (run / "gaussians.ply").read_bytes()
    flipped = bytearray(intact)
    flipped[-40] ^= 0xFF
    for damaged in (bytes(flipped), intact[:-100], b""):
        model.write_bytes(damaged)
        command("eval", run, "--no-pictures")
        said = f"mgs: {model}: was damaged; restored from checkpoint.npz"
        assert said in capsys.readouterr().err.splitlines()
        assert model.read_bytes() == intact
    assert read_ply(model) == read_checkpoint(run).gaussians
    command("eval", run, "--no-pictures")
    assert "restored" not in capsys.readouterr().err


def test_the_model_of_a_run_at_work_is_left_to_it(dataset, prior, tmp_path, capsys):
    """Between its last checkpoint and the model that it writes next."""
    run = tiny.write_run(tmp_path / "run", dataset, prior)
    (run / "gaussians.ply").unlink()
    with open(run / ".lock", "w") as lock:
        print("mgs 1", file=lock, flush=True)
        fcntl.flock(lock, fcntl.LOCK_EX)
        command("report", run, "--html", tmp_path / "page.html")
        assert "restored" not in capsys.readouterr().err
        assert not (run / "gaussians.ply").exists()


def test_the_hint_knows_options_with_an_equals_sign(tmp_path):
    (tmp_path / "config.json").touch()
    given = ["nbv", "data", f"--out={tmp_path}", "--capture-command=fly {pose}", "--seed", "3"]
    again = f"; continue with: mgs nbv --resume {tmp_path}"
    assert _hint(given) == f"{again} --capture-command 'fly {{pose}}'"
    assert _hint([*given[:3], "--policy=mine.py:best"]) == f"{again} --policy mine.py:best"
    assert _hint([*given[:3], "--policy", "random"]) == again
    assert _hint(["fit", "data", "--out", str(tmp_path)]) == again


def test_help_ends_with_the_settings_that_have_no_option(capsys):
    command("nbv", "--help")
    shown = capsys.readouterr().out
    table = shown[shown.index("KEY=VALUE", shown.rindex("--help")) :]
    rows = {line.split()[0] for line in table.splitlines() if line[:2].strip()}
    options = {"dataset", "prior", "policy", "budget", "seeds", "seed", "train.seed", "batch"}
    assert {key for key, *_ in keys_of(NbvSettings)} - options <= rows
    assert not options & rows


def test_a_setting_has_the_same_name_in_python_and_on_the_command_line(tmp_path, capsys):
    data, prior = tiny.write_dataset(tmp_path / "data"), tiny.write_prior(tmp_path / "prior")
    wrong = "train.alpha_weight = -1: must be at least 0"
    fails(wrong, mgs.run_nbv, data, tmp_path / "run", prior=prior, train={"alpha_weight": -1})
    words = ["nbv", data, "--prior", prior, "--out", tmp_path / "run"]
    assert wrong in refused(capsys, [*words, "--set", "train.alpha_weight=-1"], tmp_path)
    fails(r"runs/--no-such-run/data", mgs.load_dataset, "runs/--no-such-run/data")


def test_no_command_has_many_options_and_each_has_its_help():
    commands = typer.main.get_command(app).commands
    for name in COMMANDS:
        options = [p for p in commands[name].params if p.param_type_name == "option"]
        assert len(options) <= 15, name
        assert all(parameter.help for parameter in commands[name].params), name


KINDS = "must be a number for each of colour, scale, rotation, opacity"


def started(dataset: Path, out: Path, prior: Path | None = None, **values) -> NbvSettings:
    """Start a run; the settings in its config.json."""
    mgs.start_run(dataset, out, prior=prior, **values)
    return run_folder.open_run(out).settings


def blacken(dataset: Path, *frames: int) -> None:
    """Empty the masks of these frames."""
    for i in frames:
        write_png(dataset / f"masks/kf_{i:04d}.png", np.zeros((tiny.HEIGHT, tiny.WIDTH), bool))


def test_the_datasets_own_prior_is_the_default(dataset, tmp_path):
    own, other = tiny.write_prior(dataset / "prior"), tiny.write_prior(tmp_path / "other")
    assert started(dataset, tmp_path / "run", budget=2).prior == own.resolve()
    assert not (tmp_path / "run/prior").exists()
    settings = started(dataset, tmp_path / "given", other, budget=2, train={"seed": 7})
    assert settings.prior == other.resolve()
    assert (settings.seed, settings.train.seed) == (0, 7)


@pytest.mark.parametrize(("frames", "budget"), [(12, 8), (60, 50)])
def test_the_default_budget_is_50_or_all_candidates(prior, tmp_path, frames, budget):
    dataset = tiny.write_dataset(tmp_path / "orbit", frames=frames)
    assert started(dataset, tmp_path / "run", prior).budget == budget
    fails(f"{frames - 4} candidates", started, dataset, tmp_path / "more", prior, budget=frames - 3)


@pytest.mark.parametrize(("frame", "images"), [(4, 0), (6, 4)])
def test_a_frame_without_rock_is_refused_before_it_is_fitted_to(dataset, tmp_path, frame, images):
    """Frames 0, 4 and 8 of 12 on a circle are seeds; `farthest` takes 2 first, then 6."""
    blacken(dataset, frame)
    fits = []

    def fit(gaussians, start, cameras, *rest):
        fits.append(len(cameras))
        return tiny.fit(gaussians, start, cameras, *rest)

    parts = {"fit": fit}
    with pytest.raises(InputError, match=f"kf_000{frame}.*is empty"):
        tiny.run(tmp_path / "run", load_dataset(dataset), parts=parts, policy="farthest")
    assert max(fits, default=0) == images


def test_a_mean_over_no_view_is_left_out(dataset):
    loaded, model, seeds = load_dataset(dataset), tiny.initial([]), [0, 4, 8]
    blacken(dataset, *(set(range(12)) - set(seeds)))
    measure = psnr_measure(loaded, ListCache())
    found = measure(model, seeds)
    assert list(found) == ["psnr", "psnr_mask", "held_out_psnr"]
    assert np.isfinite(list(found.values())).all()
    assert list(measure(model, list(range(12)))) == ["psnr", "psnr_mask"]
    tiny.write_dataset(dataset / "test", frames=3)
    tested = psnr_measure(loaded, ListCache())(model, seeds)
    assert list(tested) == ["test_psnr", "test_psnr_mask"]
    alone = psnr_measure(load_dataset(dataset / "test"), ListCache())(model, [])
    assert tested["test_psnr"] == alone["psnr"]


@pytest.mark.parametrize("made", ["dataset", "random"])
def test_demo_refuses_results_of_another_seed(tmp_path, capsys, made):
    root = tiny.write_dataset(tmp_path / "demo/dataset")
    if made == "dataset":
        write_json(root / "config.json", {"seed": 3})
    else:
        tiny.start(tmp_path / "demo/random", load_dataset(root), seed=3)
    said = refused(capsys, ["demo", tmp_path / "demo", "--seed", "1"])
    assert f"demo/{made}: was made with `seed` 3, not 1" in said
    assert not (tmp_path / "demo/prior").exists()


def test_a_replaced_prior_is_one_line_on_resume(dataset, prior, tmp_path, capsys):
    run, known = tiny.write_run(tmp_path / "run", dataset, prior), load_prior(prior)
    change_settings(run, budget=1)
    prior.rename(tmp_path / "kept")
    said = refused(capsys, ["nbv", "--resume", run], run)
    where = f"run/config.json: prior {prior} is not there; if it was moved, correct `prior`"
    assert where in said
    save_prior(prior, replace(known, normals=known.normals[::-1]))
    said = refused(capsys, ["nbv", "--resume", run], run)
    assert f"{prior}: is not the prior that {run} was started on" in said
    shutil.rmtree(prior)
    (tmp_path / "kept").rename(prior)
    command("nbv", "--resume", run)
    others = {"points": known.points[::-1]}, {"spacing": 0.4}, {"depth_tolerance": 0.3}
    assert len({prior_digest(replace(known, **other)) for other in ({}, *others)}) == 4


DAMAGED = [
    ({"budget": -1}, "budget = -1: must be at least 0"),
    ({"haste": 1}, "haste: unknown setting"),
    ({"prior_std": {"color": 1.0}}, f"prior_std = {{'color': 1.0}}: {KINDS}"),
    ({"train": {"decay": float("nan")}}, "train.decay"),
]


@pytest.mark.parametrize(("values", "named"), DAMAGED)
def test_a_damaged_setting_is_named_with_its_file(seeded, tmp_path, capsys, values, named):
    run = Path(shutil.copytree(seeded, tmp_path / "run"))
    change_settings(run, **values)
    assert f"{run}/config.json: {named}" in refused(capsys, ["nbv", "--resume", run], run)


def test_options_win_over_a_file_of_settings(dataset, prior, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(nbv_command, "resume_and_print", lambda *given, **more: None)
    file, first, second = (tmp_path / name for name in ("mine.toml", "first", "second"))
    text = f'dataset = "{dataset.name}"\nprior = "{prior}"\nseeds = 3\nbudget = 2\n'
    file.write_text(text + "[train]\npasses = 2\n")
    command("nbv", "--config", file, "--budget", 1, "--out", first)
    made = run_folder.open_run(first).settings
    assert (made.seeds, made.budget, made.train.passes, made.prior) == (3, 1, 2, prior.resolve())
    command("nbv", "--config", first / "config.json", "--policy", "random", "--out", second)
    assert run_folder.open_run(second).settings == made.model_copy(update={"policy": "random"})
    for wrong, said in {
        "budgett = 1": "mine.toml: budgett: unknown",
        "budget = -1": "mine.toml: budget = -1: must be at least 0",
        "budget = ": "mine.toml: not valid TOML",
    }.items():
        file.write_text(wrong)
        assert said in refused(capsys, ["nbv", dataset, "--config", file, "--out", tmp_path / "x"])


def test_options_reach_the_run(dataset, prior, tmp_path):
    """Here the paper's Eq. 7: squared gradients of one scalar loss per image, one lambda."""
    keys = "estimator=loss-gradient lam=1e-6 train.passes=2 train.rates.colour=0.1 "
    keys += "train.rates.opacity=0 prior_std.scale=2 train.alpha_weight=0.3 nearest=5 travel=2.5 "
    keys += "stop_gain=1e-9 stop_uncertainty=1e-9 train.antialiased=false"
    options = "--budget 1 --seeds 3 --batch 3 --seed 7 --set " + keys.replace(" ", " --set ")
    run = tmp_path / "run"
    command("nbv", dataset, "--prior", prior, "--out", run, *options.split())
    state, settings = run_folder.read_checkpoint(run), run_folder.open_run(run).settings
    assert settings.train.rates == {"colour": 0.1, "scale": 0.04, "rotation": 0.02, "opacity": 0}
    assert settings.train.alpha_weight == 0.3
    assert settings.seed == settings.train.seed == 7
    assert settings.prior_std == criteria.PRIOR_STD | {"scale": 2.0}
    assert (settings.nearest, settings.travel, settings.batch) == (5, 2.5, 3)
    assert settings.stop_gain == settings.stop_uncertainty == 1e-9
    assert read_ply(run / "gaussians.ply").antialiased == state.gaussians.antialiased == False  # noqa: E712
    opacities = state.gaussians.logit_opacities
    np.testing.assert_array_equal(opacities[0], opacities)
    cameras = [load_dataset(dataset).frames[i].camera for i in state.taken]
    each = [
        [fisher(state.gaussians, c, name) for c in cameras] for name in ("loss-gradient", "exact")
    ]
    paper, exact = np.array(each, np.float64).sum(1)
    np.testing.assert_array_equal(state.H, paper)
    assert np.abs(state.H - exact).max() > 0.5 * exact.max()


def test_without_masks_alpha_has_no_weight_by_default(dataset, prior, tmp_path):
    """Alpha of such a frame is 1 everywhere, which no camera measured."""

    def weight(name: str, **values) -> float:
        return started(dataset, tmp_path / name, prior, budget=1, **values).train.alpha_weight

    assert weight("masked") == ALPHA_WEIGHT
    made = json.loads((dataset / "transforms.json").read_text())
    for frame in made["frames"]:
        frame.pop("mask_path", None)
        frame.pop("rock_file_path", None)
    write_json(dataset / "transforms.json", made)
    assert weight("bare") == 0
    assert weight("given", train={"alpha_weight": 0.3}) == 0.3
