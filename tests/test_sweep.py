"""A sweep of cells: each is done once, in the order of needs, and what was interrupted goes on."""

import json
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from importlib import import_module
from pathlib import Path

import dask
import pytest
from distributed import LocalCluster
from refusals import fails

from studies.frame import program, sweep
from studies.frame.sweep import Cell, cell_folder, result_of, run_cells

CALLS = []


def add(root, out, x, to=None):
    """A task: x plus what another cell found."""
    CALLS.append(out.name)
    if x < 0:
        raise ValueError(x)
    (out / "file").write_text(str(x))
    before = float((cell_folder(root, to) / "file").read_text()) if to else 0
    return {"sum": x + before}


def cell(name, needs=(), **arguments):
    return Cell(name, "test_sweep:add", arguments, needs)


def silent(name, done, total):
    pass


def test_cells_come_after_those_they_need_and_are_done_once(tmp_path):
    CALLS.clear()
    first = cell("a/1", x=1)
    with pytest.raises(ValueError, match="-1"):
        run_cells(tmp_path, [cell("b", ("a/1",), x=-1), first], silent)
    cells, told = [cell("b", ("a/1",), x=2, to="a/1"), first], []
    assert run_cells(tmp_path, cells, silent) == {"a/1": {"sum": 1}, "b": {"sum": 3}}
    again = run_cells(tmp_path, cells, lambda *what: told.append(what))
    assert again == {"a/1": {"sum": 1}, "b": {"sum": 3}}
    assert told == []
    assert CALLS == ["1", "b", "b"]
    fails("other settings", run_cells, tmp_path, [cell("a/1", x=2)], silent)


def studies():
    """Cells of each study by its name, of every size."""
    for path in Path(program.__file__).parent.parent.glob("[!_]*.py"):
        if "STUDY = " not in path.read_text():
            continue
        study = program.study_of(path.stem)
        for scale, size in study.sizes.items():
            if study.name in ("photographs", "blender"):
                continue  # their cells are of datasets that are given
            options = study.parser().parse_args(["OUT", "--scale", scale])
            yield study.name, study.cells(study.sized(size, options))


def test_cells_of_a_study_have_one_name_each_and_all_they_need():
    seen = set()
    for study, cells in studies():
        seen.add(study)
        by_name = {one.name: one for one in cells}
        for one in cells:
            module, _, function = one.task.partition(":")
            assert callable(getattr(import_module(module), function)), study
            assert by_name[one.name] == one, study
            assert set(one.needs) <= set(by_name), study
            assert not any(by_name[name].alone for name in one.needs), study
            assert json.loads(json.dumps(one.arguments)) == one.arguments, study
            assert one.alone or study != "chart" or "repeats" not in one.arguments
    assert {"setups", "oracle", "survey", "flights", "certificate", "table1", "stress"} < seen


def add_slowly(root, out, x):
    """A task that takes part of a second."""
    time.sleep(0.2)
    return {"square": x * x}


def write_process(root, out, **arguments):
    """A task that finds its process, and whether another cell has begun and not ended."""
    others = [folder for folder in out.parent.iterdir() if folder != out]
    beside = [folder.name for folder in others if not (folder / "result.json").exists()]
    return {"pid": os.getpid(), "beside": beside}


def die(root, out):
    """A task that its process does not survive."""
    os.kill(os.getpid(), signal.SIGKILL)


def die_once(root, out):
    """A task that its process does not survive at first."""
    if not (out / "begun").exists():
        (out / "begun").touch()
        die(root, out)
    return {"preloaded": "pymeshlab" in sys.modules}


def test_two_workers_of_which_one_is_killed_find_silently_what_a_serial_run_finds(tmp_path, capfd):
    cells, told = [Cell(str(x), "test_sweep:add_slowly", {"x": x}) for x in range(3)], []
    killed = [Cell("killed", "test_sweep:die_once"), cell("last", (*"012", "killed"), x=1)]
    report = lambda name, *_: told.append(name)  # noqa: E731
    found = run_cells(tmp_path / "a", cells + killed, report, workers=2)
    assert capfd.readouterr() == ("", "")
    assert sorted(told) == ["0", "1", "2", "killed", "last"]
    assert told[-1] == "last"
    more = {"killed": {"preloaded": True}, "last": {"sum": 1}}
    assert found == run_cells(tmp_path / "b", cells, silent) | more


@pytest.fixture(scope="module")
def scheduler():
    """Address of a Dask scheduler with one worker process, of which each imports for seconds."""
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 0}),
        LocalCluster(
            n_workers=1, threads_per_worker=1, host="127.0.0.1", memory_limit=0,
            dashboard_address="127.0.0.1:0", silence_logs=logging.CRITICAL + 1,
        ) as cluster,
    ):  # fmt: skip
        yield cluster.scheduler_address


def test_a_cell_that_must_be_alone_runs_here_and_beside_nothing(tmp_path, scheduler):
    alone = Cell("alone", "test_sweep:write_process", alone=True)
    cells = [alone, Cell("a", "test_sweep:add_slowly", {"x": 1})]
    cells.append(Cell("b", "test_sweep:write_process"))
    results = run_cells(tmp_path, cells, silent, scheduler=scheduler)
    assert results["alone"] == {"pid": os.getpid(), "beside": []}
    assert results["b"]["pid"] != os.getpid()


def test_what_a_cell_raises_in_a_worker_is_raised_and_what_is_done_is_kept(tmp_path, scheduler):
    cells = [cell("a", x=1), cell("b", ("a",), x=-1)]
    with pytest.raises(ValueError, match="-1"):
        run_cells(tmp_path, cells, silent, scheduler=scheduler)
    assert result_of(tmp_path, cells[0]) == {"sum": 1}
    assert result_of(tmp_path, cells[1]) is None


def test_a_cell_that_kills_its_worker_again_and_again_is_one_clear_line(tmp_path, scheduler):
    cells = [Cell("deadly", "test_sweep:die")]
    fails("deadly: its worker", run_cells, tmp_path, cells, silent, scheduler=scheduler)


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nonsense://x"])
def test_a_scheduler_that_does_not_answer_is_one_clear_line(tmp_path, address, monkeypatch):
    monkeypatch.setattr(sweep, "CONNECT_SECONDS", 0.5)
    cells, named = [cell("a", x=1)], f"^--scheduler {address}: no Dask"
    fails(named, run_cells, tmp_path, cells, silent, scheduler=address)


@pytest.mark.parametrize(("workers", "fault"), [(0, "has no worker"), (1, "several threads")])
def test_a_scheduler_whose_workers_will_not_do_is_one_clear_line(
    tmp_path, workers, fault, monkeypatch
):
    monkeypatch.setattr(sweep, "CONNECT_SECONDS", 1)
    options = {"processes": False, "dashboard_address": "127.0.0.1:0", "threads_per_worker": 2}
    options |= {"host": "127.0.0.1", "protocol": "tcp://"}
    with LocalCluster(n_workers=workers, **options) as cluster:
        place = {"scheduler": cluster.scheduler_address}
        fails(fault, run_cells, tmp_path, [cell("a", x=1)], silent, **place)


def sleep(root, out):
    """A task that outlives its scheduler."""
    time.sleep(3)
    return {}


HOST = """
from distributed import LocalCluster
options = {"processes": False, "host": "127.0.0.1", "protocol": "tcp://"}
with LocalCluster(1, threads_per_worker=1, dashboard_address="127.0.0.1:0", **options) as cluster:
    print(cluster.scheduler_address, flush=True)
    input()
"""


def test_a_lost_scheduler_is_one_line(tmp_path, caplog):
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    env = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.Popen([sys.executable, "-c", HOST], text=True, env=env, **pipes)

    def lose():
        while not (tmp_path / "cells/sleep").exists():
            time.sleep(0.05)
        process.kill()

    threading.Thread(target=lose, daemon=True).start()
    place = {"scheduler": process.stdout.readline().strip()}
    cells = [Cell("sleep", "test_sweep:sleep")]
    try:
        fails("the connection to the Dask .* is lost", run_cells, tmp_path, cells, silent, **place)
    finally:
        process.kill()
        process.communicate()
    assert [one.name for one in caplog.records if one.name == "distributed.client"] == []
