"""A sweep: cells of work, each done once, so that a long study can stop at any moment and go on.

A cell is a function and its arguments. What it finds is kept in CELLS/NAME/result.json below the
study's folder, beside the files that it makes. A cell whose result is there, with the same function
and arguments, is not done again.

Cells are done one after another in this process, or several at a time in worker processes (Dask).
What they find is the same.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from graphlib import TopologicalSorter
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mgs.errors import InputError
from mgs.files import read_json, write_json

if TYPE_CHECKING:
    from distributed import Client

CELLS = "cells"
CONNECT_SECONDS = 10
"""How long to wait for a scheduler to answer, and for it to have a worker."""

PRELOAD = "pymeshlab"
"""A module that workers import before they begin. Where a thread other than the first imports it
and then makes a Poisson surface, the process aborts when it ends."""

Report = Callable[[str, int, int], None]
"""Called as report(name, done, total) before each cell that is not done yet."""


@dataclass(frozen=True)
class Cell:
    """One piece of work of a study."""

    name: str
    """Its folder below CELLS; may have slashes."""
    task: str
    """MODULE:FUNCTION. The function is called as f(root, out, **arguments), root: the folder of the
    study, out: the cell's own folder, which is there and may hold what an interrupted call left. It
    returns what JSON can hold."""
    arguments: dict[str, Any] = field(default_factory=dict)
    """JSON values."""
    needs: tuple[str, ...] = ()
    """Names of the cells that must be done before."""
    alone: bool = False
    """Whether its seconds are reported: it is done in this process, while no worker has anything to
    do."""


def names_of(only: str | None, known: Iterable[str]) -> list[str]:
    """The names that an option --only gives, with commas between, or all where it is None; in the
    order of those known.

    Raises InputError for a name that is not known, and where there is none.
    """
    known = list(known)
    asked = known if only is None else [name.strip() for name in only.split(",")]
    for name in asked:
        if name not in known:
            raise InputError(f"--only {name!r}: unknown; choose some of {','.join(known)}")
    return [name for name in known if name in asked]


def cell_folder(root: Path, name: str) -> Path:
    """The folder of a cell."""
    return root / CELLS / name


def found(root: Path, cell: Cell) -> dict[str, Any] | None:
    """What a cell found; None if it is not done. Raises InputError if the folder holds the result
    of another question."""
    path = cell_folder(root, cell.name) / "result.json"
    if not path.is_file():
        return None
    record = read_json(path)
    if record["task"] != cell.task or record["arguments"] != cell.arguments:
        raise InputError(
            f"{path}: was made with other settings or by another version; delete that folder, or give a new one"
        )
    result: dict[str, Any] = record["found"]
    return result


def do(root: Path, cell: Cell) -> dict[str, Any]:
    """Do a cell, unless it is done, and return what it found."""
    known = found(root, cell)
    if known is not None:
        return known
    module, _, name = cell.task.partition(":")
    out = cell_folder(root, cell.name)
    out.mkdir(parents=True, exist_ok=True)
    result: dict[str, Any] = getattr(import_module(module), name)(root, out, **cell.arguments)
    write_json(
        out / "result.json", {"task": cell.task, "arguments": cell.arguments, "found": result}
    )
    return result


def run_cells(
    root: Path,
    cells: Sequence[Cell],
    report: Report,
    *,
    workers: int = 1,
    scheduler: str | None = None,
) -> dict[str, dict[str, Any]]:
    """Do all cells, those that others need first; returns what each found, by name.

    workers: number of processes. With one the cells are done in this process, one after another;
    with more, cells that do not need one another are done at the same time, and share this
    machine's cores. scheduler: address of a Dask scheduler whose workers are used instead; they
    must see `root` under the same path, and have one thread each (`dask worker --nthreads 1`),
    because a cell is parallel in itself. A cell whose worker is killed is done again. Raises what a
    cell raises, and InputError if the scheduler does not answer, if its workers are none or have
    more threads, or if a cell's worker is killed again and again. What is done by then is kept.
    """
    root = root.resolve()  # workers may have another current folder
    order = list(TopologicalSorter({cell.name: cell.needs for cell in cells}).static_order())
    by_name = {cell.name: cell for cell in cells}
    ordered = [by_name[name] for name in order]
    if scheduler is None and workers == 1:
        return _run_here(root, ordered, report)
    results = {cell.name: result for cell in ordered if (result := found(root, cell)) is not None}
    if len(results) < len(ordered):
        with _client(workers, scheduler) as client:
            threads = None if scheduler else max(1, len(os.sched_getaffinity(0)) // workers)
            _run_there(root, ordered, results, report, client, threads)
    return {name: results[name] for name in order}


def _run_here(root: Path, ordered: Sequence[Cell], report: Report) -> dict[str, dict[str, Any]]:
    """Do the cells one after another in this process."""
    results: dict[str, dict[str, Any]] = {}
    for cell in ordered:
        if found(root, cell) is None:
            report(cell.name, len(results), len(ordered))
        results[cell.name] = do(root, cell)
    return results


@contextmanager
def _client(workers: int, scheduler: str | None) -> Iterator[Client]:
    """Context manager that gives a connection to a scheduler: the one at that address, or one of
    our own with that many worker processes, which end with the block. Raises InputError as
    `run_cells`."""
    import dask
    from distributed import Client, LocalCluster

    quiet = {
        "distributed.worker.profile.enabled": False,
        "distributed.comm.timeouts.connect": CONNECT_SECONDS,
    }
    loggers = [logging.getLogger(name) for name in ("distributed", "tornado.application")]
    levels = [logger.level for logger in loggers]
    for (
        logger
    ) in loggers:  # a worker that is killed is no news here, and what a cell raises is raised
        logger.setLevel(logging.CRITICAL + 1)
    try:
        with dask.config.set(quiet):
            if scheduler is None:
                with (
                    LocalCluster(
                        n_workers=workers, threads_per_worker=1, host="127.0.0.1", memory_limit=0,
                        dashboard_address="127.0.0.1:0", silence_logs=logging.CRITICAL + 1, preload=PRELOAD,
                    ) as cluster,
                    Client(cluster) as client,
                ):  # fmt: skip
                    yield client
            else:
                with _connected(scheduler) as client:
                    yield client
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def _connected(scheduler: str) -> Client:
    """A connection to the scheduler at an address. Raises InputError as `run_cells`."""
    from distributed import Client

    try:
        client = Client(scheduler, timeout=CONNECT_SECONDS)
    except (OSError, ValueError, TimeoutError):
        raise InputError(
            f"--scheduler {scheduler}: no Dask scheduler answers; give its address, as tcp://HOST:8786"
        ) from None
    with suppress(TimeoutError):
        client.wait_for_workers(1, timeout=CONNECT_SECONDS)
    threads = client.nthreads().values()
    if not threads or max(threads) > 1:
        client.close()
        fault = "has a worker with several threads" if threads else "has no worker"
        raise InputError(
            f"--scheduler {scheduler}: {fault}; start workers with `dask worker {scheduler} --nthreads 1`"
        )
    return client


def _run_there(
    root: Path,
    ordered: Sequence[Cell],
    results: dict[str, dict[str, Any]],
    report: Report,
    client: Client,
    threads: int | None,
) -> None:
    """Do the cells that `results` lacks, and put what they find there. At most one is given to each
    worker at a time; those to be done alone wait until nothing else can be done."""
    from distributed import Future, KilledWorker, wait

    names = {cell.name for cell in ordered}
    waiting = [cell for cell in ordered if cell.name not in results]
    running: dict[Future, Cell] = {}
    while waiting or running:
        ready = [
            cell for cell in waiting if all(need in results for need in cell.needs if need in names)
        ]
        free = max(0, max(1, len(client.nthreads())) - len(running))
        for cell in [cell for cell in ready if not cell.alone][:free]:
            report(cell.name, len(results), len(ordered))
            running[client.submit(_do_in_worker, root, cell, threads, pure=False)] = cell
            waiting.remove(cell)
        if not running:
            cell = next(cell for cell in ready if cell.alone)
            report(cell.name, len(results), len(ordered))
            results[cell.name] = do(root, cell)
            waiting.remove(cell)
            continue
        for future in wait(list(running), return_when="FIRST_COMPLETED").done:
            cell = running.pop(future)
            try:
                results[cell.name] = future.result()
            except KilledWorker:
                raise InputError(
                    f"{cell.name}: its worker was killed again and again (is there too little memory?); "
                    "run the same command again with fewer workers"
                ) from None


def _do_in_worker(root: Path, cell: Cell, threads: int | None) -> dict[str, Any]:
    """`do`, in a worker process. threads: of Dr.Jit in this process; None: as many as it takes by
    itself."""
    if threads is not None:
        import drjit as dr

        from mgs import runtime

        runtime.start()
        dr.set_thread_count(threads)
    return do(root, cell)
