"""Command lines of the studies: `python -m studies.NAME OUT`."""

from __future__ import annotations

import shlex
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from inspect import cleandoc
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer
from rich.table import Table

from mgs import runtime
from mgs.cli.terminal import Terminal
from mgs.errors import InputError, Notice, missing, row_named
from mgs.files import (
    check_new_file,
    check_new_folder,
    check_writable,
    folder_locked,
    read_json,
    write_json,
)

if TYPE_CHECKING:
    from studies.sweep import Report

Size = TypeVar("Size")
CONSOLE = Terminal(soft_wrap=True)
INTERRUPTED = 130

Out = Annotated[Path, typer.Argument(help="Folder for everything; run again to continue.")]
Runs = Annotated[list[Path], typer.Argument(help="Folders that `mgs nbv` wrote.", metavar="RUN...")]
Scale = Annotated[str, typer.Option("--scale", help="quick: minutes. paper: the paper's size.")]
QuickOrFull = Annotated[str, typer.Option("--scale", help="quick: minutes. full: hours.")]
Rocks = Annotated[int | None, typer.Option(help="Number of rocks.", min=1)]
Policies = Annotated[
    list[str] | None,
    typer.Option("--policy", help="A further policy: a name or FILE.py:NAME; repeatable."),
]
Meshes = Annotated[
    list[Path] | None,
    typer.Option("--mesh", help="A rock of your own in place of the procedural ones; repeatable."),
]
Workers = Annotated[int, typer.Option(help="Worker processes, which share the cores.", min=1)]
Scheduler = Annotated[
    str | None,
    typer.Option(help="Use the workers of this Dask scheduler instead, as tcp://HOST:8786."),
]


def program(name: str) -> typer.Typer:
    """Command line of a study."""
    command = globals()[name]
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    paragraphs = cleandoc(command.__doc__).split("\n\n")
    app.command(help="\n\n".join(" ".join(part.split()) for part in paragraphs))(command)
    return app


def start(name: str, arguments: Sequence[str] | None = None) -> None:
    """Run a study as a program. arguments: by default those of the process.

    Bad input prints one line and ends with exit code 2, an interruption with 130. Always raises
    SystemExit, except that errors of the program itself pass through.
    """
    warnings.simplefilter("always", Notice)
    line, code, app = "", 2, program(name)
    try:
        code = app(arguments, prog_name=f"python -m studies.{name}", standalone_mode=False) or 0
    except InputError as error:
        line = str(error)
    except typer.TyperException as error:
        line = " ".join(error.format_message().split())
    except ModuleNotFoundError as error:
        line = missing(error.name)
        if not line:
            raise
    except Exception as error:
        if not isinstance(error.__cause__ or error.__context__, KeyboardInterrupt):
            raise
        code = INTERRUPTED  # Dr.Jit raises an exception of its own during a call
    if code == INTERRUPTED:
        line = "interrupted; run the same command again to continue"
    if line:
        print(f"{name}: {line}", file=sys.stderr)
    raise SystemExit(code)


def command_line(name: str) -> str:
    """Command line of this process."""
    return shlex.join(["python", "-m", f"studies.{name}", *sys.argv[1:]])


@contextmanager
def _study(out: Path, sizes: Mapping[str, Size], scale: str) -> Iterator[tuple[Size, Report]]:
    """Lock the folder of a study and record its scale; yield its size, and the callback that prints
    each cell that begins.

    Raises InputError for an unknown scale, and if the folder is of another scale, holds something
    else, cannot be written or is in use.
    """
    size, record = row_named(sizes, scale, "--scale"), check_writable(out) / "study.json"

    def report(cell: str, done: int, total: int) -> None:
        CONSOLE.print(f"{done}/{total} {cell}", style="dim")

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
        yield size, report


def _result(
    name: str,
    out: Path,
    scale: str,
    rocks: int | None,
    workers: int,
    scheduler: str | None,
    policies: Sequence[str] | None = None,
    meshes: Sequence[Path] | None = None,
    batch: int = 1,
) -> None:
    """Make a result of `studies.results` and print the names of its files."""
    from studies.results import make, rocks_of, with_options
    from studies.table1 import SIZES

    if scheduler is not None and workers != 1:
        raise InputError(
            "--workers starts workers here, and --scheduler uses those of a scheduler; "
            "give one of them"
        )
    size = row_named(SIZES, scale, "--scale")
    size = with_options(size, policies or [], meshes or [], batch)
    count = rocks_of(name, size, rocks)
    with _study(out, SIZES, scale) as (_, report):
        written = make(out, name, scale, size, count, report, workers, scheduler)
        CONSOLE.print(f"wrote {', '.join(str(path) for path in written)}")


def table1(
    out: Out,
    scale: Scale = "quick",
    batch: Annotated[int, typer.Option(help="Views chosen before the next fit.", min=1)] = 1,
) -> None:
    """Make the paper's Table I, and figures of some of its runs.

    Policies are compared at equal numbers of images. quick: 12 of 32 views, 320x240; paper: 54 of
    100 views, 640x480. Runs are timed one by one: let nothing else run meanwhile.
    """
    _result("table1", out, scale, None, 1, None, batch=batch)


def setups(
    out: Out,
    scale: Scale = "quick",
    rocks: Rocks = None,
    policy: Policies = None,
    mesh: Meshes = None,
    workers: Workers = 1,
    scheduler: Scheduler = None,
) -> None:
    """Compare policies in six set-ups over many rocks, with statistics."""
    _result("setups", out, scale, rocks, workers, scheduler, policy, mesh)


def oracle(
    out: Out,
    scale: Scale = "quick",
    rocks: Rocks = None,
    policy: Policies = None,
    mesh: Meshes = None,
    workers: Workers = 1,
    scheduler: Scheduler = None,
) -> None:
    """Compare policies as `setups` does, with an oracle that chooses the view which raises the PSNR
    of the test views most: an upper bound for policies, which cannot see test views."""
    _result("oracle", out, scale, rocks, workers, scheduler, policy, mesh)


def survey(
    out: Out,
    scale: Scale = "quick",
    rocks: Rocks = None,
    policy: Policies = None,
    mesh: Meshes = None,
    workers: Workers = 1,
    scheduler: Scheduler = None,
) -> None:
    """Compare policies as `setups` does, with the poses, depth and prior of `mgs survey`."""
    _result("survey", out, scale, rocks, workers, scheduler, policy, mesh)


def flights(
    out: Out,
    scale: Scale = "quick",
    rocks: Rocks = None,
    mesh: Meshes = None,
    workers: Workers = 1,
    scheduler: Scheduler = None,
) -> None:
    """Compare planned flights of several lengths with evenly spaced poses."""
    _result("flights", out, scale, rocks, workers, scheduler, meshes=mesh)


def certificate(
    out: Out,
    scale: Scale = "quick",
    rocks: Rocks = None,
    mesh: Meshes = None,
    workers: Workers = 1,
    scheduler: Scheduler = None,
) -> None:
    """Compare plans with upper bounds of all sets of views, and the criterion with PSNR."""
    _result("certificate", out, scale, rocks, workers, scheduler, meshes=mesh)


def stress(
    out: Out,
    scale: QuickOrFull = "quick",
    workers: Workers = 1,
    only: Annotated[
        str | None, typer.Option(help="Names of experiments, separated by commas. Default: all.")
    ] = None,
) -> None:
    """Try to make the methods fail: test hypotheses by experiments, and judge each by a fixed
    statistical rule.

    Writes stability.csv (all numbers), verdicts.json, stability.md (the verdicts as tables) and a
    plot of each experiment.
    """
    from studies.stress.lab import SIZES
    from studies.stress.run import EXPERIMENTS, run_stress
    from studies.sweep import names_of

    names = names_of(only, EXPERIMENTS)
    with _study(out, SIZES, scale) as (size, report):
        command = command_line("stress")
        for experiment in run_stress(out, size, names, command, report, workers):
            CONSOLE.print(f"{experiment['name']}: {experiment['question']}")
            _print_claims(experiment["claims"])
    CONSOLE.print(f"wrote {out}: verdicts.json, stability.csv, stability.md, plots")


def parsimony(out: Out, scale: QuickOrFull = "quick") -> None:
    """Chart quality and cost against the number of Gaussians, the kinds of parameters learned, and
    the SH degree; mark the automatic choice.

    Renders the scenes, fits each model view by view, and measures it on test views that no model
    is fitted to. Writes parsimony.json, parsimony.csv, parsimony.md and parsimony.png.
    """
    from studies import parsimony as study
    from studies.output import text_of

    with _study(out, study.SIZES, scale) as (size, report):
        choices, claims = study.run_study(out, size, report, command_line("parsimony"), scale)
    table = Table(*study.COLUMNS)
    for row in choices:
        table.add_row(*(text_of(content, row) for content in study.COLUMNS.values()))
    CONSOLE.print(table)
    _print_claims(claims)
    CONSOLE.print(f"wrote {out}: parsimony.json, .csv, .md and .png")


def chart(
    out: Out,
    dataset: Annotated[
        Path | None, typer.Option(help="A dataset with test views, in place of the rendered one.")
    ] = None,
    scale: QuickOrFull = "quick",
    only: Annotated[str | None, typer.Option(help="fit or run. Default: both.")] = None,
    repeats: Annotated[
        int | None,
        typer.Option(
            help="Timings of each point; the median counts. Default: quick 2, full 3.", min=1
        ),
    ] = None,
) -> None:
    """Chart speed against accuracy of single fits and of whole runs.

    Writes a CSV, JSON, Markdown and PNG file for fits (fit.*) and for runs (run.*); each row names
    the command that makes it again. Points are timed one by one: let nothing else run meanwhile.
    """
    from studies.chart import KINDS, SIZES, check_dataset, run_chart
    from studies.sweep import names_of

    kinds = names_of(only, KINDS)
    if dataset:
        check_dataset(dataset)
    with _study(out, SIZES, scale) as (_, report):
        results = run_chart(out, scale, kinds, repeats, dataset, report)
    for kind, (rows, claims) in results.items():
        CONSOLE.print(f"{kind}: {len(rows)} rows in {out / f'{kind}.csv'}")
        _print_claims(claims)


def photographs(
    out: Out,
    dataset: Annotated[
        list[Path], typer.Option(help="A dataset with test views; repeat for more.")
    ],
    scale: QuickOrFull = "quick",
    gaussians: Annotated[
        list[str] | None,
        typer.Option(help="Number of Gaussians; repeat for more.", metavar="N|auto"),
    ] = None,
    peer: Annotated[
        list[Path] | None,
        typer.Option(
            help="CSV of another program: `cpu_seconds`, `psnr` and, if not of the first dataset, "
            "`dataset`; repeat for more."
        ),
    ] = None,
) -> None:
    """Chart PSNR against CPU seconds of `mgs fit` on photographs, with more and more passes.

    Fits are timed one by one: let nothing else run meanwhile.
    """
    from studies.chart import check_dataset
    from studies.photographs import PASSES, chart_photographs, parse_count, read_peer

    counts = [parse_count(count) for count in gaussians or ["auto"]]
    for folder in dataset:
        check_dataset(folder)
    names = [folder.absolute().name for folder in dataset]
    if len(set(names)) < len(names):
        raise InputError("--dataset: two folders have one name; rename one")
    for file in peer or []:
        read_peer(file, names)
    with _study(out, PASSES, scale) as (_, report):
        rows = chart_photographs(out, scale, dataset, counts, peer or [], report)
    CONSOLE.print(f"{len(rows)} rows in {out / 'photographs.csv'}")


def calibration(runs: Runs) -> None:
    """Predict the errors of unseen views and compare them with the true ones.

    Writes RUN/diagnostics/uncertainty.json and uncertainty.png. The prediction is calibrated by
    leaving each of the run's own views out of a fit once. NAME.errors.exr has the true error and
    the predicted standard deviation of some views.
    """
    from studies.predicted_error import calibrate_run

    runtime.start()
    for run in runs:
        with folder_locked(run / "diagnostics"):
            for path in calibrate_run(run):
                CONSOLE.print(f"wrote {path}")


def bench(
    json: Annotated[Path | None, typer.Option(help="Write all measurements to this file.")] = None,
    gaussians: Annotated[int, typer.Option(help="Number of Gaussians.", min=1000)] = 100_000,
    repeats: Annotated[
        int, typer.Option(help="Calls of each operation; the median counts.", min=3)
    ] = 9,
) -> None:
    """Time rendering, gradients and Fisher information, and Mitsuba's own integrator,
    volprim_rf_basic.

    The timed scene is a rock of surface Gaussians in an image of 640x480 pixels. Let nothing else
    run on the machine meanwhile. The JSON file also holds the command line, the machine and the
    versions.
    """
    from mgs.provenance import versions

    if json is not None:
        check_new_file(json, False)  # before minutes of measuring
    runtime.start()
    from studies.bench import bench_splat

    def report(what: str) -> None:  # no spinner: its thread would be timed too
        CONSOLE.print(f"timing {what}", style="dim")

    result = bench_splat(gaussians, 640, 480, repeats, report)
    seconds = Table("operation", "milliseconds", title=f"{gaussians:,} Gaussians, 640x480")
    for name, value in result["seconds"].items():
        seconds.add_row(name.replace("_", " "), f"{1e3 * value:.1f}")
    ratios = Table("ratio", "measured")
    for name, value in result["ratios"].items():
        ratios.add_row(name.replace("_", " "), f"{value:.3g}")
    CONSOLE.print(seconds, ratios, f"peak memory {result['peak_memory_megabytes']:.0f} MB")
    if json is not None:
        made = {"command": command_line("bench"), "machine": runtime.processor()}
        write_json(json, result | made | {"versions": versions()})
        CONSOLE.print(f"wrote {json}")


def _print_claims(claims: list[dict[str, Any]]) -> None:
    from studies.verdict import effect

    for one in claims:
        text = f"{one['hypothesis']} {effect(one)}, {one['runs']} runs"
        CONSOLE.print(f"  {one['verdict']:8} {text}")
