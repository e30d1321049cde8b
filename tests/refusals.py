"""Checks of every refusal, and places that a command must keep out of."""

from collections.abc import Callable
from pathlib import Path

import pytest

from mgs import InputError
from mgs.cli.app import main
from studies.frame.program import study_of


def listing(root: Path) -> dict[str, bytes | None]:
    """Every file below a folder with its content, every folder with None."""
    paths = (root, *root.rglob("*")) if root.exists() else ()
    read = {path: path.read_bytes() if path.is_file() else None for path in paths}
    return {str(path.relative_to(root)): content for path, content in read.items()}


def refused(capsys, arguments: list, out: Path | None = None, study: str = "") -> str:
    """Run `mgs ARGUMENTS`, or a study of this name; check that one line is printed, the exit code
    is 2, and `out` is unchanged; return the line."""
    capsys.readouterr()
    before, words = listing(out) if out else None, [str(argument) for argument in arguments]
    with pytest.raises(SystemExit) as stop:
        study_of(study)(words) if study else main(words)
    error = capsys.readouterr().err
    assert stop.value.code == 2, error
    lines = error.splitlines()
    assert len(lines) == 1, error
    assert lines[0].startswith(f"{study or 'mgs'}: ")
    if out:
        assert listing(out) == before, "something was left behind"
    return lines[0]


def fails(words: str, call: Callable[..., object], *arguments, **options) -> str:
    """Check that a call raises an InputError of one line with this pattern; return the line."""
    with pytest.raises(InputError, match=words or None) as error:
        call(*arguments, **options)
    assert "\n" not in str(error.value)
    return str(error.value)


def occupied(path: Path) -> Path:
    path.mkdir()
    (path / "precious.txt").write_text("keep me")
    return path


def a_file(path: Path) -> Path:
    path.write_text("keep me")
    return path
