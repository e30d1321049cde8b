"""The program of a study: `python -m studies.NAME OUT`. Options, the folder, cells, files."""

import shlex
import sys
import warnings
from argparse import ArgumentParser, ArgumentTypeError, Namespace
from collections.abc import Callable, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from mgs import InputError, runtime
from mgs.errors import Notice, from_interrupt, missing, printable_lines, row_named
from mgs.files import check_new_folder, check_writable, folder_locked, read_json, write_json
from studies.frame.statistics import Row

if TYPE_CHECKING:
    from collections.abc import Iterator

    from studies.frame.sweep import Cell, Results

INTERRUPTED = 130
"""Exit code after Ctrl-C."""

Options = dict[str, dict[str, Any]]
"""Options by name, with the arguments of `ArgumentParser.add_argument`."""


def at_least(least: int) -> Callable[[str], int]:
    """Type of an option: a whole number from `least` on."""

    def parse(text: str) -> int:
        if not text.isdecimal() or int(text) < least:
            raise ArgumentTypeError(f"{text!r} is no whole number from {least} on")
        return int(text)

    return parse


SCALE: Options = {
    "--scale": {"default": "quick", "help": "quick: minutes; the other: hours. Default: quick."}
}
WORKERS: Options = {
    "--workers": {
        "type": at_least(1),
        "default": 1,
        "help": "Worker processes, which share the cores.",
    },
    "--scheduler": {
        "metavar": "ADDRESS",
        "help": "Use the workers of this Dask scheduler instead, as tcp://HOST:8786.",
    },
}


@dataclass(frozen=True)
class Work:
    """A study with the options given, which `Study.write` reads.

    size: one of the sizes, after `Study.sized`. results: of the cells that are done.
    """

    options: Namespace
    command: str
    size: Any = None
    cells: "Sequence[Cell]" = ()
    results: "Results" = field(default_factory=dict)

    @property
    def out(self) -> Path:
        """Folder of the study."""
        return Path(self.options.out)

    def rows(self) -> list[Row]:
        """A row for each result of a cell that is about something, or for each of its "rows"."""
        done = [cell for cell in self.cells if cell.about and cell.name in self.results]
        pairs = [(cell.about, self.results[cell.name]) for cell in done]
        return [about | row for about, result in pairs for row in result.get("rows", [result])]


class Parser(ArgumentParser):
    """Parser that raises InputError."""

    def error(self, message: str) -> NoReturn:
        """Raise the message of bad arguments."""
        raise InputError(message)


@dataclass(frozen=True)
class Study:
    """A study.

    - about: text of --help. sizes: by the name of --scale; without any the program has neither OUT
      nor --scale, and no cells. options: further options.
    - sized(size, options): checks the options and changes the size by them.
    - cells(size): what is to be done. write(work): writes the files from `work.results` and returns
      their paths; the Markdown files are printed.
    - growing: the files are also written before each cell, from the cells done alone by then.
    """

    name: str
    about: str
    write: Callable[[Work], list[Path]]
    sizes: Mapping[str, Any] = field(default_factory=dict)
    cells: "Callable[[Any], list[Cell]]" = lambda size: []
    options: Options = field(default_factory=dict)
    sized: Callable[[Any, Namespace], Any] = lambda size, options: size
    growing: bool = False

    def parser(self) -> Parser:
        prog = f"python -m studies.{self.name}"
        parser = Parser(prog, description=self.about, allow_abbrev=False)
        out: Options = {
            "out": {"type": Path, "help": "Folder for everything; run again to continue."}
        }
        for option, how in ((out | SCALE if self.sizes else {}) | self.options).items():
            parser.add_argument(option, **how)
        return parser

    def __call__(self, arguments: Sequence[str] | None = None) -> NoReturn:
        """Run as a program. arguments: by default those of the process.

        Bad input prints one line and ends with exit code 2, an interruption with 130. Always raises
        SystemExit, except that errors of the program itself pass through.
        """
        warnings.simplefilter("always", Notice)
        line, code = "", 2
        try:
            self.run(sys.argv[1:] if arguments is None else arguments)
            code = 0
        except InputError as error:
            line = str(error)
        except ModuleNotFoundError as error:
            line = missing(error.name)
            if not line:
                raise
        except (Exception, KeyboardInterrupt) as error:
            if not from_interrupt(error):
                raise
            line, code = "interrupted; run the same command again to continue", INTERRUPTED
        if line:
            print(f"{self.name}: {line}", file=sys.stderr)
        raise SystemExit(code)

    def run(self, arguments: Sequence[str]) -> None:
        """Do the study. Raises InputError for bad options or a folder that does not fit."""
        options = self.parser().parse_args(arguments)
        work = Work(options, shlex.join(["python", "-m", f"studies.{self.name}", *arguments]))
        if not self.sizes:
            self.tell(self.write(work))
            return
        if getattr(options, "scheduler", None) and options.workers != 1:
            raise InputError("--scheduler: has workers of its own; leave out --workers")
        size = self.sized(row_named(self.sizes, options.scale, "--scale"), options)
        work = replace(work, size=size)
        cells = {cell.name: cell for cell in self.cells(size)}  # of one name: the same
        work = replace(work, cells=list(cells.values()))
        with _begun(work.out, options.scale):
            self.tell(self.write(replace(work, results=self._results(work))))

    def _results(self, work: Work) -> "Results":
        from studies.frame.sweep import results_so_far, run_cells

        timed = [cell for cell in work.cells if cell.alone]

        def report(name: str, done: int, total: int) -> None:
            if self.growing and (results := results_so_far(work.out, timed)):
                self.write(replace(work, results=results))
            print(printable_lines(f"{done}/{total} {name}"), flush=True)

        how = {key: getattr(work.options, key, None) for key in ("workers", "scheduler")}
        return run_cells(work.out, work.cells, report, **how)

    def tell(self, paths: Sequence[Path]) -> None:
        """Print the Markdown files, and the names of all."""
        for path in paths:
            if path.suffix == ".md":
                print(printable_lines(path.read_text(encoding="utf-8")))
        if paths:
            print(printable_lines(f"wrote {', '.join(map(str, paths))}"))


def study_of(name: str) -> Study:
    """The study of the module `studies.NAME`."""
    study = import_module(f"studies.{name}").STUDY
    assert isinstance(study, Study)
    return study


@contextmanager
def _begun(out: Path, scale: str) -> "Iterator[None]":
    """Lock the folder of a study and record its scale.

    Raises InputError if the folder is of another scale, holds something else, cannot be written or
    is in use.
    """
    record = check_writable(out) / "study.json"
    with folder_locked(out):
        if not record.is_file():
            check_new_folder(out)
            write_json(record, {"scale": scale})
        elif (there := read_json(record)) != {"scale": scale}:
            was = there.get("scale") if isinstance(there, dict) else None
            raise InputError(
                f"{out}: was begun with --scale {was}, not {scale}; give that, or another folder"
            )
        runtime.start()
        yield
