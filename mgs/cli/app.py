"""The program `mgs`: its commands, and how they end.

Beside this file there is one for each command. Commands import what they need when they are called,
so that `mgs --help` does not wait for Mitsuba.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
import sys
from collections.abc import Callable
from inspect import cleandoc
from typing import Annotated

import typer

from mgs import __version__
from mgs.cli.bench import bench
from mgs.cli.dataset import dataset
from mgs.cli.demo import demo
from mgs.cli.diagnose import diagnose
from mgs.cli.doctor import doctor
from mgs.cli.evaluate import evaluate
from mgs.cli.import_data import import_data
from mgs.cli.nbv import nbv
from mgs.cli.prior import prior
from mgs.cli.prune import prune
from mgs.cli.refit import refit
from mgs.cli.render import render
from mgs.cli.report import report
from mgs.cli.studies import chart, parsimony, reproduce, stress
from mgs.cli.survey import survey
from mgs.cli.synth_orbit import synth_orbit
from mgs.cli.view import view
from mgs.errors import InputError

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

_AGAIN = "run the same command again to continue"
GOES_ON = {
    "synth-orbit": _AGAIN,
    "import": _AGAIN,
    "demo": _AGAIN,
    "reproduce": _AGAIN,
    "chart": _AGAIN,
    "stress": _AGAIN,
    "parsimony": _AGAIN,
    "nbv": "`mgs nbv --resume RUN` continues a run whose folder is there",
}
"""What is printed after Ctrl-C, for the commands that can go on where they stopped. The others
start anew."""

app = typer.Typer(name="mgs", add_completion=False, pretty_exceptions_enable=False)


def _help(docstring: str | None) -> str:
    """A docstring with each paragraph in one line, so that the help screen breaks lines at the
    width of the terminal only."""
    return "\n\n".join(
        " ".join(paragraph.split()) for paragraph in cleandoc(docstring or "").split("\n\n")
    )


for name, command in COMMANDS.items():
    app.command(name, help=_help(command.__doc__))(command)


def _print_version(wanted: bool) -> None:
    """What the option --version does."""
    if wanted:
        typer.echo(f"mgs {__version__}")
        raise typer.Exit


@app.callback()
def _program(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version and stop."
        ),
    ] = False,
) -> None:
    """Active Gaussian splatting: exact Fisher information and next-best-view selection."""


def main(arguments: list[str] | None = None) -> None:
    """Run a command and end the process. arguments: those of the command line, by default the
    process's own.

    Bad input and wrong options print one line, with exit code 2; an interruption prints one line,
    with exit code 130. Always raises SystemExit, but for errors of the program itself, which pass
    through.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    if isinstance(sys.stdout, io.TextIOWrapper):  # a terminal may lack characters of the tables
        sys.stdout.reconfigure(errors="replace")
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
        raise _stop(
            " ".join(error.format_message().replace("Value error, ", "").split()), 2
        ) from None
    except typer.Abort:
        raise _stop("stopped", 1) from None
    except Exception as error:
        if not _from_interrupt(error):
            raise
        code = INTERRUPTED
    if code == INTERRUPTED:  # typer turns Ctrl-C into this exit code and prints nothing
        hint = GOES_ON.get(arguments[0]) if arguments else None
        raise _stop(f"interrupted; {hint}" if hint else "interrupted", INTERRUPTED)
    raise SystemExit(code or 0)


def _from_interrupt(error: BaseException | None) -> bool:
    """Whether Ctrl-C is the cause of an exception. If it comes during a call of Dr.Jit, that raises
    an exception of its own."""
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
    """Print one line to the standard error, and return the exception that ends the process with
    this exit code."""
    print(f"mgs: {message}", file=sys.stderr)
    return SystemExit(code)
