"""`mgs reproduce`: the paper's results and what it leaves open, each from its own cells of work."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rich.progress import Progress

    from mgs.study.reproduce import Preset


def reproduce(
    out: Annotated[
        Path, typer.Argument(help="Folder for everything; the same command again goes on.")
    ] = Path("reproduced"),
    preset: Annotated[
        str,
        typer.Option(
            help="quick: Table I of 12 of 32 views, 320x240. paper: of 54 of 100 views, 640x480."
        ),
    ] = "quick",
    only: Annotated[
        str | None,
        typer.Option(
            help="Which results, as table1,curves: table1, figures, curves, seeds, pools, oracle. Default: all but oracle."
        ),
    ] = None,
    rocks: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="How many rocks the curves, seeds, pools and the oracle have. Default: the preset's.",
        ),
    ] = None,
    policy: Annotated[
        list[str] | None,
        typer.Option(
            help="One policy more in curves and pools: a name, or FILE.py:FUNCTION. May be given several times."
        ),
    ] = None,
    mesh: Annotated[
        list[Path] | None,
        typer.Option(
            help="A rock of your own for results over many rocks, instead of mgs's. May be given several times."
        ),
    ] = None,
    batch: Annotated[
        int,
        typer.Option(
            min=1,
            help="Of Table I and the figures: views that are chosen before the model is fitted again.",
        ),
    ] = 1,
    workers: Annotated[
        int, typer.Option(min=1, help="Worker processes, which share this machine's cores.")
    ] = 1,
    scheduler: Annotated[
        str | None,
        typer.Option(help="Use the workers of this Dask scheduler instead, as tcp://HOST:8786."),
    ] = None,
) -> None:
    """Make the results of docs/results.md: Table I at equal numbers of images, PSNR against images
    over many rocks with statistics, numbers of seeds, pools of candidates, and an oracle that looks
    at the truth.

    Every dataset, prior and run is a cell, done once and kept in OUT/cells; what they say together
    is written to OUT/results.
    Runs whose seconds are reported run alone: let nothing else run on the machine meanwhile.
    """
    from rich.console import Console
    from rich.progress import MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from mgs import runtime
    from mgs.errors import InputError, row_named
    from mgs.files import check_writable
    from mgs.study import reproduce_asked as asked
    from mgs.study.reproduce import PRESETS

    names = asked.results_of(only)
    size = asked.with_policies(row_named(PRESETS, preset, "--preset"), names, policy or [])
    size = asked.with_meshes(asked.with_batch(size, names, batch), names, mesh or [])
    counts = {name: asked.rocks_of(name, size, rocks) for name in names}
    if scheduler is not None and workers != 1:
        raise InputError(
            "--workers starts workers here, and --scheduler uses those of a scheduler; give one of them"
        )
    check_preset(check_writable(out), preset)
    runtime.start()
    console = Console(highlight=False)
    columns = (TextColumn("{task.description}"), MofNCompleteColumn(), TimeElapsedColumn())
    for name in names:
        with Progress(
            *columns, console=console, transient=True, disable=not console.is_terminal
        ) as bar:
            written = _make(name, out, preset, size, counts[name], bar, workers, scheduler)
        console.print(f"{name}: wrote " + ", ".join(str(path) for path in written), soft_wrap=True)


def _make(
    name: str,
    out: Path,
    preset: str,
    size: Preset,
    count: int,
    bar: Progress,
    workers: int,
    scheduler: str | None,
) -> list[Path]:
    """Do the cells of a result over so many rocks, telling of each that begins, and write it.
    Returns its files."""
    from mgs.study import reproduce as study
    from mgs.study import reproduce_asked as asked
    from mgs.study.reproduce_results import WRITERS, known_runs
    from mgs.study.sweep import run_cells

    result = study.RESULTS[name]
    over_rocks = name in asked.over_rocks()
    many = f" --rocks {count}" if result.rocks(size) > 1 else ""
    own = "".join(
        f" --policy {_from_here(policy)}"
        for policy in size.own_policies
        if name in ("curves", "pools")
    )
    batch = (
        f" --batch {size.table.batch}"
        if size.table.batch > 1 and name in ("table1", "figures")
        else ""
    )
    meshes = "".join(f" --mesh {mesh.file.name}" for mesh in size.meshes if over_rocks)
    command = f"mgs reproduce --preset {preset} --only {name}{many}{own}{meshes}{batch}"
    task = bar.add_task(name, total=None)

    def tell(cell: str, done: int, total: int) -> None:
        if result.grows and (so_far := known_runs(out, result.runs(size, count))):
            WRITERS[name](out, out / "results", so_far, size, count, command)
        bar.console.print(f"{name} {done}/{total} {cell}", style="dim", soft_wrap=True)
        bar.update(task, completed=done, total=total)

    found = run_cells(
        out, study.cells_of(name, size, count), tell, workers=workers, scheduler=scheduler
    )
    return WRITERS[name](out, out / "results", found, size, count, command)


def _from_here(policy: str) -> str:
    """A policy as one would give it here: where its file lies below the current folder, by its path
    from there."""
    here = Path.cwd()
    return (
        str(Path(policy).relative_to(here))
        if Path(policy).is_relative_to(here)
        else Path(policy).name
    )


def check_preset(out: Path, preset: str) -> None:
    """Raises InputError if the folder is of another preset, or holds something else; records the
    preset in OUT/study.json."""
    from mgs.errors import InputError
    from mgs.files import check_new_folder, read_json, write_json

    record = out / "study.json"
    if not record.is_file():
        check_new_folder(out)
        write_json(record, {"preset": preset})
    elif (there := read_json(record)) != {"preset": preset}:
        was = there.get("preset") if isinstance(there, dict) else None
        raise InputError(
            f"{out}: was begun with --preset {was}, not {preset}; give that, or another folder"
        )
