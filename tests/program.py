"""Run commands of the program in this process, and read the steps of a run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from mgs.cli.app import main


def command(*arguments) -> None:
    """Run `mgs ARGUMENTS`; fails unless it exits with 0."""
    with pytest.raises(SystemExit) as stop:
        main([str(argument) for argument in arguments])
    assert stop.value.code == 0


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
