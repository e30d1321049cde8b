"""The program `mgs`: its commands, and how they end. A command is imported when it is used."""

import contextlib
import errno
import io
import os
import shlex
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from mgs import __version__
from mgs.cli.options import Row, describe
from mgs.errors import InputError, Notice, from_interrupt, missing, printable

INTERRUPTED = 130  # exit code after Ctrl-C: by convention 128 plus the number of the signal, SIGINT
LONGEST_NAME = 200  # characters of a file name that an error message shows

CURES = {
    errno.ENAMETOOLONG: "give a shorter name",
    errno.ELOOP: "remove the symbolic links that lead to each other",
    errno.EACCES: "choose a place that you may read and write",
    errno.ENOSPC: "make room",
    errno.EDQUOT: "make room",
}
"""Errors of the system that the user can correct, and how. All others are errors of the program."""

COMMANDS = {
    "doctor": ("doctor.doctor", "Check this machine and what is installed."),
    "synth-orbit": ("datasets.synth_orbit", "Render a dataset: an orbit around a rock."),
    "dataset": ("datasets.dataset", "Check a dataset, or make its masks."),
    "import": ("import_data.import_data", "Make a dataset of your own images and cameras."),
    "survey": ("datasets.survey", "Simulate a survey flight with a noisy depth camera."),
    "prior": ("prior.prior", "Build the prior: a mesh of the object, and samples of it."),
    "nbv": ("nbv.nbv", "Choose the next best views."),
    "fit": ("nbv.fit", "Fit a model to all images of a dataset."),
    "suggest": ("suggest.suggest", "Rank candidate poses, and plan the next flight."),
    "eval": ("models.evaluate", "Measure PSNR and SSIM of models."),
    "diagnose": ("models.diagnose", "Draw maps of information and uncertainty."),
    "report": ("models.report", "Compare runs by figures and a table, or by one HTML page."),
    "view": ("share.view", "Show a run or a model in the browser."),
    "render": ("share.render", "Draw a model through given cameras."),
    "export": ("share.export", "Write a model for other programs."),
    "video": ("share.video", "Make a video of a run."),
    "simplify": ("models.simplify", "Make the model of a run smaller."),
    "demo": ("demo.demo", "Run all steps on a small rock."),
}
"""Commands in about the order in which they are used: file and function, and a line of help."""

RESUMABLE = ("synth-orbit", "import", "demo")  # commands that continue when they are given again


class _Command(TyperCommand):
    """A command; the help of one with --set ends with a table of the settings."""

    keys: Sequence[Row] = ()

    def format_help(self, ctx: Any, formatter: Any) -> None:
        super().format_help(ctx, formatter)
        if self.keys:
            from mgs.cli.terminal import Terminal, settings_table

            Terminal().print(settings_table(self.keys))


class _Commands(Mapping[str, Any]):
    """All commands by name; a command is imported when it is looked up."""

    def __len__(self) -> int:
        return len(COMMANDS)

    def __iter__(self) -> Iterator[str]:
        return iter(COMMANDS)

    def __getitem__(self, name: str) -> Any:
        file, function = COMMANDS[name][0].split(".")
        code = getattr(import_module(f"mgs.cli.{file}"), function)
        alone = typer.Typer(add_completion=False)
        alone.command(name, cls=_Command)(code)
        command: Any = typer.main.get_command(alone)
        describe(command, code.__doc__, getattr(code, "keys", ()))
        return command


class _Program(TyperGroup):
    """The program, whose own help imports no command."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.commands: Any = _Commands()

    def format_help(self, ctx: Any, formatter: Any) -> None:
        self.commands = {name: TyperCommand(name, help=row[1]) for name, row in COMMANDS.items()}
        super().format_help(ctx, formatter)


app = typer.Typer(name="mgs", cls=_Program, add_completion=False, pretty_exceptions_enable=False)


def _print_version(on: bool) -> None:
    if on:
        from mgs.cli.terminal import echo

        echo(f"mgs {__version__}")
        raise typer.Exit


VersionOption = typer.Option(
    "--version", callback=_print_version, is_eager=True, help="Print the version and stop."
)


@app.callback()
def _program(version: Annotated[bool, VersionOption] = False) -> None:
    """Active Gaussian splatting: choose the next best views by exact Fisher information."""


def main(arguments: list[str] | None = None) -> None:
    """Run a command and end the process. arguments: of the command line; default: the process's.

    Bad input and wrong options print one line and end with exit code 2, an interruption with 130.
    Always raises SystemExit, except that errors of the program itself pass through."""
    arguments = (sys.argv[1:] if arguments is None else arguments) or ["--help"]
    for argument in arguments:
        if any("\udc80" <= character <= "\udcff" for character in argument):
            raise _stop(f"{argument}: is not UTF-8, as libraries need it; rename the file", 2)
    if isinstance(sys.stdout, io.TextIOWrapper):  # a terminal may lack characters of the tables
        sys.stdout.reconfigure(errors="replace")
    warnings.simplefilter("always", Notice)
    warnings.showwarning = _print_warning  # type: ignore[assignment]
    try:
        code = app(arguments, prog_name="mgs", standalone_mode=False)
        if sys.stdout is not None:  # closed by who started the process
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
        lacks = missing(error.name) if isinstance(error, ModuleNotFoundError) else ""
        if lacks:
            raise _stop(lacks, 2) from None
        if not from_interrupt(error):
            raise
        code = INTERRUPTED
    if code == INTERRUPTED:  # typer turns Ctrl-C into this exit code and prints nothing
        raise _stop(f"interrupted{_hint(arguments)}", INTERRUPTED)
    raise SystemExit(code or 0)


def _print_warning(message: Any, category: type, filename: str, line: int, *_: Any) -> None:
    text = f"mgs: {printable(str(message))}\n" if category is Notice else None
    sys.stderr.write(text or warnings.formatwarning(message, category, filename, line))


def _hint(arguments: Sequence[str]) -> str:
    """End of the line of an interrupted command: the way to continue, if there is one."""
    command, *words = arguments or [""]
    options = [part for x in words for part in (x.split("=", 1) if x.startswith("--") else [x])]
    if command in RESUMABLE:
        but = " without --force" if "--force" in options else ""
        return f"; run the same command again{but} to continue"
    runs = [after for option, after in pairwise(options) if option in ("--out", "--resume")]
    if command not in ("nbv", "fit") or not runs or not (Path(runs[-1]) / "config.json").is_file():
        return ""
    again = [
        part  # what a run with live capture or a user's own policy needs again
        for option, value in pairwise(options)
        if option.startswith("--capture-")
        or (option, value[:8]) == ("--set", "capture.")
        or (option == "--policy" and ".py:" in value)
        for part in (option, value)
    ]
    return f"; continue with: mgs nbv {shlex.join(['--resume', runs[-1], *again])}"


def _system_error(error: OSError) -> str:
    """Line for an error of the system. What a failed standard output still buffers is dropped."""
    name = str(error.filename or "standard output")
    if error.filename is None:
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return f"{name[:LONGEST_NAME]}: {error.strerror}; {CURES[error.errno or 0]}"


def _stop(message: str, code: int) -> SystemExit:
    """Print one line to standard error; return the exception that ends the process."""
    print(f"mgs: {printable(message)}", file=sys.stderr)
    return SystemExit(code)
