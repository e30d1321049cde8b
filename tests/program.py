"""Run commands of the program and studies in this process, and read the steps of a run."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mgs.cli.app import main
from mgs.reports.tables import compare_runs, comparison_rows
from studies.frame.program import study_of


def exit_code(*arguments) -> int:
    """Run `mgs ARGUMENTS` and return its exit code."""
    with pytest.raises(SystemExit) as stop:
        main([str(argument) for argument in arguments])
    return int(stop.value.code or 0)


def command(*arguments) -> None:
    """Run `mgs ARGUMENTS`; fails unless it exits with 0."""
    assert exit_code(*arguments) == 0


def output(capsys, *arguments) -> str:
    """What `mgs ARGUMENTS` alone prints, in one line; fails unless it exits with 0."""
    capsys.readouterr()
    command(*arguments)
    return said(capsys)[0]


def study(name, *arguments, exit_code=0, **changes) -> None:
    """Run a study; fails unless it exits with this code. changes: of the fields of the `Study`."""
    with pytest.raises(SystemExit) as stop:
        replace(study_of(name), **changes)([str(argument) for argument in arguments])
    assert stop.value.code == exit_code


def python(program: str, *arguments, env=(), **options) -> subprocess.CompletedProcess:
    """Run the text of a program in a new process, and capture what it prints."""
    command = [sys.executable, "-c", program, *map(str, arguments)]
    options = {"capture_output": True, "text": True, "timeout": 300} | options
    return subprocess.run(command, env=os.environ | dict(env), **options)


def stop_at(count: int = 1) -> Callable[..., None]:
    """A callback that interrupts at its count-th call, as Ctrl-C does."""
    calls = []

    def called(*_, **__):
        calls.append(1)
        if len(calls) == count:
            signal.raise_signal(signal.SIGINT)

    return called


def said(capsys) -> tuple[str, str]:
    """Output and errors since the last call, in one line each: rich breaks long ones."""
    captured = capsys.readouterr()
    return " ".join(captured.out.split()), " ".join(captured.err.split())


def table_numbers(runs: list[Path]) -> list[dict]:
    """Rows of the table of these runs."""
    return comparison_rows(compare_runs(runs))


def steps(run: Path) -> list[dict]:
    """Lines of steps.jsonl."""
    return [json.loads(line) for line in (run / "steps.jsonl").read_text().splitlines()]


def timeless(lines: list[dict]) -> list[dict]:
    """Lines of steps.jsonl without their seconds."""
    return [{key: value for key, value in line.items() if key != "seconds"} for line in lines]


def change_settings(run: Path, **values) -> None:
    """Change settings in the config.json of a run."""
    config = json.loads((run / "config.json").read_text())
    config["settings"] |= values
    (run / "config.json").write_text(json.dumps(config))


def change_checkpoint(path: Path, record: Callable[[dict], object] = dict, **arrays) -> None:
    """Change a checkpoint.npz: its text by a function, and arrays; those that are None go."""
    with np.load(path) as data:
        known = json.loads(str(data["json"]))
        record(known)
        arrays = dict(data) | {"json": np.array(json.dumps(known))} | arrays
    np.savez(path, **{name: values for name, values in arrays.items() if values is not None})


def change_steps(run: Path, change: Callable[[list[dict]], list[dict]], **record) -> None:
    """Change the steps of a run, in its checkpoint and in steps.jsonl. record: other values of the
    checkpoint's text."""
    made = change(steps(run))
    values = {"steps": made, **record}
    change_checkpoint(run / "checkpoint.npz", lambda known: known.update(values))
    (run / "steps.jsonl").write_text("".join(json.dumps(line) + "\n" for line in made))
