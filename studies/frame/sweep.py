"""Resumable sweeps: cells of work, each done once.

A cell is a function and its JSON arguments. Its result is kept in OUT/cells/NAME/result.json,
beside the files it writes, and is reused as long as function and arguments stay the same. Cells run
one after another in this process, or several at a time in Dask workers; the results are the same.
"""

import gc
import logging
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from graphlib import TopologicalSorter
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mgs import InputError
from mgs.files import read_json, write_json

if TYPE_CHECKING:
    from distributed import Client

CELLS = "cells"
CONNECT_SECONDS = 10
"""Longest wait for a scheduler to answer, and for its first worker."""

PRELOAD = "pymeshlab"
"""Module that workers import in their main thread. A process in which another thread imports it and
makes a Poisson surface aborts when it ends."""

Report = Callable[[str, int, int], None]
"""Called as report(name, done, total) for each cell that is not done yet."""

Results = dict[str, dict[str, Any]]
"""Results of cells by their names."""


@dataclass(frozen=True)
class Cell:
    """One piece of work of a study.

    name: folder below CELLS; may contain slashes. task: "MODULE:FUNCTION", called as
    function(root, out, **arguments) with the study's folder and the cell's own folder, which may
    hold files of an interrupted call; returns JSON data. needs: names of cells that must be done
    before. alone: the result contains seconds, so the cell runs in this process while all workers
    are idle; no other cell needs it. about: first columns of its rows in tables.
    """

    name: str
    task: str
    arguments: dict[str, Any] = field(default_factory=dict)
    needs: tuple[str, ...] = ()
    alone: bool = False
    about: dict[str, Any] = field(default_factory=dict)


def cell_folder(root: Path, name: str) -> Path:
    return root / CELLS / name


def result_of(root: Path, cell: Cell) -> dict[str, Any] | None:
    """Result of a cell; None if it is not done. Raises InputError if its folder holds the result of
    another task or of other arguments."""
    path = cell_folder(root, cell.name) / "result.json"
    if not path.is_file():
        return None
    record = read_json(path)
    result = record.get("found") if isinstance(record, dict) else None
    asked = {"task": cell.task, "arguments": cell.arguments}
    if not isinstance(result, dict) or record != asked | {"found": result}:
        raise InputError(
            f"{path}: was made with other settings or by another version; "
            "delete that folder, or give a new one"
        )
    return result


def results_so_far(root: Path, cells: Iterable[Cell]) -> Results:
    """Results of the cells that are done."""
    results = {cell.name: result_of(root, cell) for cell in cells}
    return {name: result for name, result in results.items() if result is not None}


def do(root: Path, cell: Cell) -> dict[str, Any]:
    """Do a cell, unless it is done; returns its result."""
    before = result_of(root, cell)
    if before is not None:
        return before
    module, _, name = cell.task.partition(":")
    out = cell_folder(root, cell.name)
    out.mkdir(parents=True, exist_ok=True)
    result: dict[str, Any] = getattr(import_module(module), name)(root, out, **cell.arguments)
    record = {"task": cell.task, "arguments": cell.arguments, "found": result}
    write_json(out / "result.json", record)
    return result


def run_cells(
    root: Path,
    cells: Iterable[Cell],
    report: Report,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
) -> Results:
    """Do all cells in the order of their needs, and return their results.

    workers: number of processes, which share the cores; one: this process. scheduler: address of a
    Dask scheduler whose workers are used instead; they must see `root` under the same path and have
    one thread each. A cell is reported before it begins, and in a worker once it is done.

    Raises what a cell raises; InputError if the scheduler does not answer or is lost, its workers
    do not fit, or a cell's worker is killed repeatedly. Finished cells are kept.
    """
    root = root.resolve()  # workers may have another current folder
    by_name = {cell.name: cell for cell in cells}
    order = TopologicalSorter({name: cell.needs for name, cell in by_name.items()}).static_order()
    ordered = [by_name[name] for name in order]
    results = results_so_far(root, ordered)

    def tell(cell: Cell) -> None:
        report(cell.name, len(results), len(ordered))

    side_by_side = [cell for cell in ordered if cell.name not in results and not cell.alone]
    if side_by_side and (scheduler or (workers or 1) > 1):
        threads = None if scheduler else max(1, len(os.sched_getaffinity(0)) // (workers or 1))
        with _client(workers or 1, scheduler) as client:
            for cell, result in _done_in_workers(root, side_by_side, client, threads):
                tell(cell)
                results[cell.name] = result
    for cell in ordered:
        if cell.name not in results:
            tell(cell)
            results[cell.name] = do(root, cell)
    return {cell.name: results[cell.name] for cell in ordered}


@contextmanager
def _client(workers: int, scheduler: str | None) -> "Iterator[Client]":
    """Connection to a scheduler: the one at the address, or a cluster of this machine that ends
    with the block."""
    import dask
    from distributed import Client, LocalCluster

    settings = {
        "distributed.worker.profile.enabled": False,
        "distributed.comm.timeouts.connect": CONNECT_SECONDS,
        # Poisson surfaces start a thread for each core, which would keep all workers waiting.
        "distributed.nanny.pre-spawn-environ.OMP_WAIT_POLICY": "passive",
    }
    silent = logging.CRITICAL + 1  # killed workers are retried, and errors of cells are raised
    names = ("distributed", "distributed.client", "tornado.application")
    loggers = [logging.getLogger(name) for name in names]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(silent)
    options: dict[str, Any] = {
        "host": "127.0.0.1",
        "dashboard_address": "127.0.0.1:0",
        "preload": PRELOAD,
    }
    options |= {"threads_per_worker": 1, "memory_limit": 0, "silence_logs": silent}
    try:
        with dask.config.set(settings):
            if scheduler is not None:
                with _connected(scheduler) as client:
                    yield client
                return
            with LocalCluster(n_workers=workers, **options) as cluster, Client(cluster) as client:
                yield client
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def _connected(scheduler: str) -> "Client":
    from distributed import Client

    client = None
    with suppress(OSError, ValueError, TimeoutError):
        client = Client(scheduler, timeout=CONNECT_SECONDS)
    if client is None:
        gc.collect()  # the client that failed: collected while another starts, it blocks for ever
        raise InputError(
            f"--scheduler {scheduler}: no Dask scheduler answers; "
            "give its address, as tcp://HOST:8786"
        )
    with suppress(TimeoutError):
        client.wait_for_workers(1, timeout=CONNECT_SECONDS)
    threads = client.nthreads().values()
    if not threads or max(threads) > 1:
        client.close()
        fault = "has a worker with several threads" if threads else "has no worker"
        raise InputError(
            f"--scheduler {scheduler}: {fault}; "
            f"start workers with `dask worker {scheduler} --nthreads 1`"
        )
    return client


def _done_in_workers(
    root: Path, cells: list[Cell], client: "Client", threads: int | None
) -> Iterator[tuple[Cell, dict[str, Any]]]:
    """Do cells in workers, one at a time in each; yield them with their results as they end."""
    from distributed import Future, KilledWorker, as_completed

    futures: dict[str, Future] = {}
    for cell in cells:
        needs = [futures[name] for name in cell.needs if name in futures]
        futures[cell.name] = client.submit(_do_in_worker, root, cell, threads, needs, pure=False)
    by_future = {futures[cell.name]: cell for cell in cells}
    for future in as_completed(by_future):
        try:
            yield by_future[future], future.result()
        except CancelledError:
            raise InputError(
                "the connection to the Dask scheduler is lost; finished cells are kept: run the "
                "same command again when the scheduler is there"
            ) from None
        except KilledWorker:
            raise InputError(
                f"{by_future[future].name}: its worker was killed again and again (is there too "
                "little memory?); run the same command again with fewer workers"
            ) from None


def _do_in_worker(root: Path, cell: Cell, threads: int | None, needs: list[Any]) -> dict[str, Any]:
    """`do` in a worker process with this many threads of Dr.Jit, None: its default; after the cells
    whose results are `needs`."""
    if threads is not None:
        import drjit as dr

        from mgs import runtime

        runtime.start()
        dr.set_thread_count(threads)
    return do(root, cell)
