"""The program `mgs`: its commands, and how they end.

The files beside this one have the commands. A command imports what is slow to import when it is
called, so that `mgs --help` does not wait for Mitsuba.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
import shlex
import sys
import warnings
from collections.abc import Callable, Sequence
from inspect import cleandoc
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import typer

from mgs import __version__
from mgs.cli.bench import bench
from mgs.cli.dataset import dataset
from mgs.cli.demo import demo
from mgs.cli.doctor import doctor
from mgs.cli.import_data import import_data
from mgs.cli.models import diagnose, evaluate, prune, refit
from mgs.cli.nbv import nbv
from mgs.cli.pictures import render, view
from mgs.cli.prior import prior
from mgs.cli.report import report
from mgs.cli.share import export
from mgs.cli.studies import chart, parsimony, reproduce, stress
from mgs.cli.survey import survey
from mgs.cli.synth_orbit import synth_orbit
from mgs.errors import InputError, Notice

INTERRUPTED = 130
"""Exit code after Ctrl-C: by convention 128 plus the number of the signal, SIGINT."""

LONGEST_NAME = 200
"""Characters of a file name that an error message shows."""

CURES = {
    errno.ENAMETOOLONG: "give a shorter name",
    errno.ELOOP: "remove the symbolic links that lead to each other",
    errno.EACCES: "choose a place that you may read and write",
    errno.ENOSPC: "make room",
    errno.EDQUOT: "make room",
}
"""Errors of the system that the user can correct, and how. All others are errors of the program."""

COMMANDS: dict[str, Callable[..., None]] = {
    "doctor": doctor,
    "synth-orbit": synth_orbit,
    "dataset": dataset,
    "import": import_data,
    "survey": survey,
    "prior": prior,
    "nbv": nbv,
    "eval": evaluate,
    "diagnose": diagnose,
    "report": report,
    "view": view,
    "render": render,
    "export": export,
    "prune": prune,
    "refit": refit,
    "demo": demo,
    "bench": bench,
    "reproduce": reproduce,
    "chart": chart,
    "stress": stress,
    "parsimony": parsimony,
}
"""All commands, in about the order in which they are used."""

RESUMABLE = ("synth-orbit", "import", "demo", "reproduce", "chart", "stress", "parsimony")
"""Commands that continue where they stopped when they are given again."""

app = typer.Typer(name="mgs", add_completion=False, pretty_exceptions_enable=False)


def _help(docstring: str | None) -> str:
    """Join the lines of each paragraph, so that the help breaks lines only at the terminal's
    width."""
    paragraphs = cleandoc(docstring or "").split("\n\n")
    return "\n\n".join(" ".join(paragraph.split()) for paragraph in paragraphs)


for name, command in COMMANDS.items():
    app.command(name, help=_help(command.__doc__))(command)


def _print_version(wanted: bool) -> None:
    """Callback of --version."""
    if wanted:
        typer.echo(f"mgs {__version__}")
        raise typer.Exit


VersionOption = typer.Option(
    "--version", callback=_print_version, is_eager=True, help="Print the version and stop."
)


@app.callback()
def _program(version: Annotated[bool, VersionOption] = False) -> None:
    """Active Gaussian splatting: exact Fisher information and next-best-view selection."""


def main(arguments: list[str] | None = None) -> None:
    """Run a command and end the process. arguments: of the command line; default: the process's.

    Bad input and wrong options print one line and end with exit code 2, an interruption with 130.
    Always raises SystemExit, except that errors of the program itself pass through.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    if isinstance(sys.stdout, io.TextIOWrapper):  # a terminal may lack characters of the tables
        sys.stdout.reconfigure(errors="replace")
    warnings.simplefilter("always", Notice)
    warnings.showwarning = _print_warning  # type: ignore[assignment]
    try:
        code = app(arguments or ["--help"], prog_name="mgs", standalone_mode=False)
        sys.stdout.flush()
    except OSError as error:
        if error.errno not in CURES:
            raise
        raise _stop(_system_error(error), 2) from None
    except InputError as error:
        raise _stop(str(error), 2) from None
    except typer.TyperException as error:
        message = error.format_message().replace("Value error, ", "")
        raise _stop(" ".join(message.split()), 2) from None
    except typer.Abort:
        raise _stop("stopped", 1) from None
    except Exception as error:
        if not _from_interrupt(error):
            raise
        code = INTERRUPTED
    if code == INTERRUPTED:  # typer turns Ctrl-C into this exit code and prints nothing
        raise _stop(f"interrupted{_hint(arguments)}", INTERRUPTED)
    raise SystemExit(code or 0)


def _print_warning(message: Any, category: type, filename: str, line: int, *_: Any) -> None:
    """Print a Notice as one line of ours, other warnings as Python does."""
    text = f"mgs: {message}\n" if category is Notice else None
    sys.stderr.write(text or warnings.formatwarning(message, category, filename, line))


def _hint(arguments: Sequence[str]) -> str:
    """End of the line of an interrupted command: the way to continue, if there is one."""
    command, *options = arguments or [""]
    if command in RESUMABLE:
        return "; run the same command again to continue"
    runs = [after for option, after in pairwise(options) if option in ("--out", "--resume")]
    if command != "nbv" or not runs or not (Path(runs[-1]) / "config.json").is_file():
        return ""
    return f"; continue with: mgs nbv --resume {shlex.quote(runs[-1])}"


def _from_interrupt(error: BaseException | None) -> bool:
    """Whether Ctrl-C caused an exception: during a call, Dr.Jit raises one of its own."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _system_error(error: OSError) -> str:
    """Line for an error of the system. If the standard output failed, what it still buffers is
    dropped, so that Python does not fail again at its end."""
    name = str(error.filename or "standard output")
    if error.filename is None:
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    shown = name if len(name) <= LONGEST_NAME else f"{name[:LONGEST_NAME]}..."
    return f"{shown}: {error.strerror}; {CURES[error.errno or 0]}"


def _stop(message: str, code: int) -> SystemExit:
    """Print one line to standard error; return the exception that ends the process."""
    print(f"mgs: {message}", file=sys.stderr)
    return SystemExit(code)
