"""`mgs reproduce`, `stress`, `parsimony` and `chart`: the studies."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from rich.table import Table

from mgs import runtime
from mgs.cli.options import argument, option, parse_gaussians
from mgs.cli.terminal import Terminal
from mgs.errors import InputError, row_named
from mgs.files import check_new_folder, check_writable, folder_locked, read_json, write_json
from mgs.provenance import command_line

if TYPE_CHECKING:
    from mgs.study.sweep import Report

Size = TypeVar("Size")

Out = Annotated[Path, argument("Folder for everything; the same command again continues.")]
Workers = Annotated[int, option("Worker processes, which share the cores.", min=1)]


@contextmanager
def _study(
    out: Path, sizes: Mapping[str, Size], preset: str
) -> Iterator[tuple[Size, Terminal, Report]]:
    """Context of every study: locks its folder and records its scale; gives the size, a console,
    and the callback that prints each cell that begins.

    Raises InputError for an unknown scale, and if the folder is of another scale, holds something
    else, cannot be written or is in use.
    """
    size, console = row_named(sizes, preset, "--scale"), Terminal()
    record = check_writable(out) / "study.json"

    def report(cell: str, done: int, total: int) -> None:
        console.print(f"{done}/{total} {cell}", style="dim", soft_wrap=True)

    with folder_locked(out):
        if not record.is_file():
            check_new_folder(out)
            write_json(record, {"preset": preset})
        elif (there := read_json(record)) != {"preset": preset}:
            was = there.get("preset") if isinstance(there, dict) else None
            raise InputError(
                f"{out}: was begun with --scale {was}, not {preset}; give that, or another folder"
            )
        runtime.start()
        yield size, console, report


def reproduce(
    out: Out = Path("reproduced"),
    preset: Annotated[
        str,
        option(
            "quick: Table I with 12 of 32 views, 320x240. paper: 54 of 100 views, 640x480.",
            "--scale",
        ),
    ] = "quick",
    only: Annotated[
        str | None,
        option(
            "Results to make, separated by commas: table1, figures, setups, flights, survey, "
            "oracle. Default: table1, figures and setups."
        ),
    ] = None,
    rocks: Annotated[
        int | None,
        option(
            "Number of rocks for setups, flights, survey and oracle. Default: as --scale says.",
            min=1,
        ),
    ] = None,
    policy: Annotated[
        list[str] | None,
        option("A further policy for setups: a name or FILE.py:FUNCTION; repeatable."),
    ] = None,
    mesh: Annotated[
        list[Path] | None,
        option("A rock of your own in place of the procedural ones (not Table I); repeatable."),
    ] = None,
    batch: Annotated[
        int, option("For Table I and the figures: views chosen before the next fit.", min=1)
    ] = 1,
    workers: Workers = 1,
    scheduler: Annotated[
        str | None, option("Use the workers of this Dask scheduler instead, as tcp://HOST:8786.")
    ] = None,
) -> None:
    """Make the results of docs/results.md: the paper's Table I, policies in six set-ups over many
    rocks with statistics, and an oracle.

    Table I compares policies at equal numbers of images. The oracle chooses the view that raises
    the PSNR of the test views most: an upper bound for policies, which cannot see test views.
    Every dataset, prior and run is made once and kept in OUT/cells; the results are written to
    OUT/results. Runs whose seconds are reported run one at a time: let nothing else run meanwhile.
    """
    from mgs.study.reproduce import SIZES
    from mgs.study.reproduce_results import make, results_of, rocks_of, with_options

    names = results_of(only)
    size = row_named(SIZES, preset, "--scale")
    size = with_options(size, names, policy or [], mesh or [], batch)
    counts = {name: rocks_of(name, size, rocks) for name in names}
    if scheduler is not None and workers != 1:
        raise InputError(
            "--workers starts workers here, and --scheduler uses those of a scheduler; "
            "give one of them"
        )
    with _study(out, SIZES, preset) as (_, console, report):
        for name, count in counts.items():
            written = make(out, name, preset, size, count, report, workers, scheduler)
            files = ", ".join(str(path) for path in written)
            console.print(f"{name}: wrote {files}", soft_wrap=True)


def stress(
    out: Out = Path("out/stress"),
    preset: Annotated[
        str,
        option(
            "quick: minutes with --workers 2. full: more rocks, larger images; hours.", "--scale"
        ),
    ] = "quick",
    workers: Workers = 1,
    only: Annotated[
        str | None, option("Names of experiments, separated by commas. Default: all.")
    ] = None,
) -> None:
    """Try to make the methods fail: test hypotheses by experiments, and judge each by a fixed
    statistical rule.

    Writes stability.csv (all numbers), verdicts.json, stability.md (the verdicts as tables) and a
    plot of each experiment.
    """
    from mgs.study.stress.lab import SIZES
    from mgs.study.stress.run import EXPERIMENTS, run_stress
    from mgs.study.sweep import names_of

    names = names_of(only, EXPERIMENTS)
    with _study(out, SIZES, preset) as (size, console, report):
        for experiment in run_stress(out, size, names, command_line(), report, workers):
            console.print(f"{experiment['name']}: {experiment['question']}", soft_wrap=True)
            _print_claims(console, experiment["claims"])
    console.print(f"wrote {out}: verdicts.json, stability.csv, stability.md, plots", soft_wrap=True)


def parsimony(
    out: Out = Path("parsimony"),
    preset: Annotated[
        str,
        option(
            "quick: six scenes of small images, ten minutes. full: 320x240, half an hour.",
            "--scale",
        ),
    ] = "quick",
) -> None:
    """Chart quality and cost against the number of Gaussians, the kinds of parameters learned, and
    the SH degree; mark the automatic choice.

    Renders the scenes, fits each model view by view, and measures it on test views that no model
    is fitted to. Writes parsimony.json, parsimony.csv, parsimony.md and parsimony.png.
    """
    from mgs.study import parsimony as study
    from mgs.study.output import text_of

    with _study(out, study.SIZES, preset) as (size, console, report):
        choices, claims = study.run_study(out, size, report, command_line(), preset)
    table = Table(*study.COLUMNS)
    for row in choices:
        table.add_row(*(text_of(content, row) for content in study.COLUMNS.values()))
    console.print(table)
    _print_claims(console, claims)
    console.print(f"wrote {out}: parsimony.json, .csv, .md and .png", soft_wrap=True)


def chart(
    out: Out = Path("chart"),
    dataset: Annotated[
        list[Path] | None,
        option(
            "A dataset with test views, in place of the one that is rendered. Photographs: "
            "repeat for more."
        ),
    ] = None,
    preset: Annotated[
        str, option("quick: about ten minutes on two quiet cores. full: hours.", "--scale")
    ] = "quick",
    only: Annotated[str | None, option("fit, run or photographs. Default: fit,run.")] = None,
    repeats: Annotated[
        int | None,
        option("Timings of each point; the median counts. Default: quick 2, full 3.", min=1),
    ] = None,
    gaussians: Annotated[
        list[str] | None,
        option("Number of Gaussians of photographs; repeat for more.", metavar="N|auto"),
    ] = None,
    peer: Annotated[
        list[Path] | None,
        option(
            "CSV of another program on photographs: `cpu_seconds`, `psnr` and, if not of the first "
            "dataset, `dataset`; repeat for more."
        ),
    ] = None,
) -> None:
    """Chart speed against accuracy of single fits and of whole runs.

    Writes a CSV, JSON, Markdown and PNG file for fits (fit.*) and for runs (run.*); each row names
    the command that makes it again. Points are timed one by one: let nothing else run meanwhile.
    `--only photographs --dataset DATASET` times `mgs fit` with more and more passes.
    """
    from mgs.study.chart import KINDS, SIZES, check_dataset, run_chart
    from mgs.study.photographs import NAME, chart_photographs, read_peer
    from mgs.study.sweep import names_of

    kinds = names_of(only or ",".join(KINDS), (*KINDS, NAME))
    counts = [parse_gaussians(count) or "auto" for count in gaussians or ["auto"]]
    datasets = dataset or []
    for folder in datasets:
        check_dataset(folder)
    if len({folder.absolute().name for folder in datasets}) < len(datasets):
        raise InputError("--dataset: two folders have one name; rename one")
    if NAME not in kinds and (gaussians or peer):
        option_given = "--gaussians" if gaussians else "--peer"
        raise InputError(f"{option_given}: is of photographs alone; give --only {NAME}, too")
    if NAME in kinds and not datasets:
        raise InputError(f"--only {NAME}: needs photographs; give --dataset DATASET")
    if kinds != [NAME] and len(datasets) > 1:
        raise InputError(f"--dataset: only --only {NAME} takes more than one")
    for file in peer or []:
        read_peer(file, [folder.absolute().name for folder in datasets])
    with _study(out, SIZES, preset) as (_, console, report):
        if NAME in kinds:
            kinds.remove(NAME)
            rows = chart_photographs(out, preset, datasets, counts, peer or [], report)
            console.print(f"{NAME}: {len(rows)} rows in {out / f'{NAME}.csv'}", soft_wrap=True)
        given = datasets[0] if datasets else None
        found = run_chart(out, preset, kinds, repeats, given, report) if kinds else {}
    for kind, (rows, claims) in found.items():
        console.print(f"{kind}: {len(rows)} rows in {out / f'{kind}.csv'}", soft_wrap=True)
        _print_claims(console, claims)


def _print_claims(console: Terminal, claims: list[dict[str, Any]]) -> None:
    from mgs.study.verdict import effect

    for one in claims:
        text = f"{one['hypothesis']} {effect(one)}, {one['runs']} runs"
        console.print(f"  {one['verdict']:8} {text}", soft_wrap=True)
