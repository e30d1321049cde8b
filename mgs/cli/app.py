"""The `mgs` command. One file per command in this room; heavy imports stay inside the commands."""

from __future__ import annotations

import sys
from collections.abc import Callable
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
from mgs.cli.render import render
from mgs.cli.report import report
from mgs.cli.survey import survey
from mgs.cli.synth_orbit import synth_orbit
from mgs.errors import InputError

INTERRUPTED = 130
"""Exit code after Ctrl-C: 128 + SIGINT."""

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
    "render": render,
    "demo": demo,
    "bench": bench,
}

_AGAIN = "run the same command again to continue"
GOES_ON = {
    "synth-orbit": _AGAIN,
    "import": _AGAIN,
    "demo": _AGAIN,
    "nbv": "`mgs nbv --resume RUN` continues a run whose folder is there",
}
"""What a person is told after Ctrl-C, by command. The others start anew: they write at the end, or write the same again."""
"""Every command of the `mgs` program, in the order of the pipeline."""

app = typer.Typer(name="mgs", add_completion=False, pretty_exceptions_enable=False)


for name, command in COMMANDS.items():
    app.command(name)(command)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"mgs {__version__}")
        raise typer.Exit


@app.callback()
def _program(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and stop.")
    ] = False,
) -> None:
    """Active Gaussian splatting: exact Fisher information and next-best-view selection."""


def main(arguments: list[str] | None = None) -> None:
    """Run a command and end the process: bad input and wrong options are one line and exit code 2, an interruption is one
    line and exit code 130. Raises SystemExit, always."""
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        code = app(arguments or ["--help"], prog_name="mgs", standalone_mode=False)
    except InputError as error:
        raise _stop(str(error), 2) from None
    except typer.TyperException as error:
        raise _stop(" ".join(error.format_message().replace("Value error, ", "").split()), 2) from None
    except typer.Abort:
        raise _stop("stopped", 1) from None
    except Exception as error:
        if not _from_interrupt(error):
            raise
        code = INTERRUPTED
    if code == INTERRUPTED:  # typer has turned Ctrl-C into this, without a word
        hint = GOES_ON.get(arguments[0]) if arguments else None
        raise _stop(f"interrupted; {hint}" if hint else "interrupted", INTERRUPTED)
    raise SystemExit(code or 0)


def _from_interrupt(error: BaseException | None) -> bool:
    """Whether Ctrl-C is behind an exception: Dr.Jit raises one of its own where it is hit inside its calls."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _stop(message: str, code: int) -> SystemExit:
    print(f"mgs: {message}", file=sys.stderr)
    return SystemExit(code)
