"""The program as a whole: how it starts and ends, and what it repairs."""

import subprocess
import sys
import warnings

import pytest
import tiny
import typer
from program import command
from refusals import refused

import mgs
from mgs.cli.app import COMMANDS, _hint, app
from mgs.cli.options import keys_of, parse_settings
from mgs.cli.renamed import OPTIONS, renewed
from mgs.run.folder import read_checkpoint
from mgs.run.settings import NbvSettings
from mgs.splat_ply import read_ply

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
        code = [sys.executable, "-c", INTERRUPTED.format(module=module), *arguments]
        ended = subprocess.run(code, capture_output=True, text=True)
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


def test_the_hint_knows_options_with_an_equals_sign(tmp_path):
    (tmp_path / "config.json").touch()
    given = ["nbv", "data", f"--out={tmp_path}", "--capture-command=fly {pose}", "--seed", "3"]
    again = f"; continue with: mgs nbv --resume {tmp_path} --capture-command 'fly {{pose}}'"
    assert _hint(given) == again
    assert _hint(["fit", "data", "--out", str(tmp_path)]) == again.partition(" --capture")[0]


@pytest.mark.parametrize("name", OPTIONS)
def test_old_options_become_options_and_settings_that_the_command_has(name):
    command = typer.main.get_command(app).commands[name]
    options = {flag for parameter in command.params for flag in parameter.opts}
    for old, new in OPTIONS[name].items():
        assert old not in options
        if new.startswith("--"):
            assert new in options
        else:
            key, _, value = new.removesuffix(".").partition("=")
            pair = f"{key}.colour=1" if new.endswith(".") else f"{key}={value or 1}"
            assert parse_settings([pair], command)


def test_old_words_print_the_new_ones():
    with warnings.catch_warnings(record=True) as notices:
        warnings.simplefilter("always")
        words = renewed(["nbv", "d", "--seed-views=3", "--rate", "colour=1", "--no-antialiased"])
        assert renewed(["refit", "RUN"]) == ["simplify", "--method", "refit", "RUN"]
    sets = ["--set", "train.rates.colour=1", "--set", "train.antialiased=false"]
    assert words == ["nbv", "d", "--seeds=3", *sets]
    new = ["--seeds=3", " ".join(sets[:2]), " ".join(sets[2:]), "mgs simplify --method refit"]
    shown = [str(notice.message) for notice in notices]
    assert all(f" is now {words};" in line for words, line in zip(new, shown, strict=True)), shown


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
    with pytest.raises(mgs.InputError, match=wrong):
        mgs.run_nbv(data, tmp_path / "run", prior=prior, train={"alpha_weight": -1})
    words = ["nbv", data, "--prior", prior, "--out", tmp_path / "run"]
    assert wrong in refused(capsys, [*words, "--set", "train.alpha_weight=-1"], tmp_path)
    with pytest.raises(mgs.InputError, match=r"runs/--no-such-run/data"):
        mgs.load_dataset("runs/--no-such-run/data")


def test_no_command_has_many_options_and_each_has_its_help():
    commands = typer.main.get_command(app).commands
    for name in COMMANDS:
        options = [p for p in commands[name].params if p.param_type_name == "option"]
        assert len(options) <= 15, name
        assert all(parameter.help for parameter in commands[name].params), name
