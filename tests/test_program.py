"""The program as a whole: how it starts and ends, and what it repairs."""

import subprocess
import sys

import tiny
from program import command

from mgs.cli.app import _hint
from mgs.run.folder import read_checkpoint
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
