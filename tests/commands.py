"""Run `mgs` in this process."""

from __future__ import annotations

from pathlib import Path

import pytest

from mgs.cli.app import main


def run(*arguments: object) -> int:
    """Run `mgs ARGUMENTS` and return its exit code."""
    with pytest.raises(SystemExit) as stop:
        main([str(argument) for argument in arguments])
    return int(stop.value.code or 0)


def said(capsys) -> tuple[str, str]:
    """Output and errors since the last call, in one line each: rich breaks long ones."""
    captured = capsys.readouterr()
    return " ".join(captured.out.split()), " ".join(captured.err.split())


def one_line(error: str, message: str, out: Path) -> None:
    """Check that an error is one line with this message, and that `out` was not made."""
    assert message in error
    assert "\n" not in error.strip()
    assert not out.exists()
