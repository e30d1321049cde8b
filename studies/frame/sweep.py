"""Resumable sweeps: cells of work, each done once.

A cell is a function and its JSON arguments. Its result is kept in OUT/cells/NAME/result.json,
beside the files it writes, and is reused as long as function and arguments stay the same. Cells run
one after another in this process, or several at a time in workers; the results are the same.
"""

import os
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, field
from graphlib import TopologicalSorter
from importlib import import_module
from multiprocessing import active_children, get_context, parent_process
from pathlib import Path
from threading import Thread
from typing import Any

from mgs import InputError, runtime
from mgs.files import read_json, write_json

CELLS = "cells"

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
    """Folder of a cell."""
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


def run_cells(root: Path, cells: Iterable[Cell], report: Report, *, workers: int = 1) -> Results:
    """Do all cells in the order of their needs, and return their results.

    workers: number of processes, which share the cores; one: this process. A cell is reported
    before it begins, and in a worker once it is done.

    Raises what a cell raises; InputError if a worker is killed. Finished cells are kept.
    """
    root = root.resolve()  # tasks run programs in other folders
    by_name = {cell.name: cell for cell in cells}
    order = TopologicalSorter({name: cell.needs for name, cell in by_name.items()}).static_order()
    ordered = [by_name[name] for name in order]
    results = results_so_far(root, ordered)

    def tell(cell: Cell) -> None:
        report(cell.name, len(results), len(ordered))

    side_by_side = [cell for cell in ordered if cell.name not in results and not cell.alone]
    if side_by_side and workers > 1:
        with worker_pool(workers, "a worker") as pool:
            for cell, result in _done_in_workers(root, side_by_side, pool):
                tell(cell)
                results[cell.name] = result
    for cell in ordered:
        if cell.name not in results:
            tell(cell)
            results[cell.name] = do(root, cell)
    return {cell.name: results[cell.name] for cell in ordered}


def _done_in_workers(
    root: Path, cells: list[Cell], pool: ProcessPoolExecutor
) -> Iterator[tuple[Cell, dict[str, Any]]]:
    """Do each cell once its needs are done; yield them with their results as they end."""
    by_name = {cell.name: cell for cell in cells}
    order = TopologicalSorter(
        {cell.name: [name for name in cell.needs if name in by_name] for cell in cells}
    )
    order.prepare()
    running: dict[Future[dict[str, Any]], Cell] = {}
    while order.is_active():
        for name in order.get_ready():
            running[pool.submit(do, root, by_name[name])] = by_name[name]
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            cell = running.pop(future)
            yield cell, future.result()
            order.done(cell.name)


@contextmanager
def worker_pool(workers: int, name: str) -> Iterator[ProcessPoolExecutor]:
    """Pool of worker processes, which share the cores and end with the block.

    Raises InputError if one is killed. name: of a worker, for that message.
    """
    threads = max(1, len(os.sched_getaffinity(0)) // workers)
    with ProcessPoolExecutor(workers, get_context("spawn"), _begin, (threads,)) as pool:
        try:
            yield pool
        except BrokenProcessPool:
            fewer = " with fewer workers" if workers > 1 else ""
            raise InputError(
                f"{name} was killed (is there too little memory?); "
                f"run the same command again{fewer}"
            ) from None
        finally:
            for process in active_children():
                process.terminate()


def _begin(threads: int) -> None:
    """Begin a worker process with this many threads of Dr.Jit. It ends silently at Ctrl-C, and with
    its parent."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    parent = parent_process()
    assert parent

    def end_with_parent() -> None:
        parent.join()
        os._exit(1)

    Thread(target=end_with_parent, daemon=True).start()
    # OpenMP threads of a Poisson surface, one for each core, would keep all workers waiting.
    os.environ["OMP_WAIT_POLICY"] = "passive"
    runtime.start()
    import drjit as dr

    dr.set_thread_count(threads)
