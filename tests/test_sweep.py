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
import numpy as np
import pytest
from distributed import LocalCluster
from refusals import fails

from mgs.errors import InputError
from studies.frame import program, sweep
from studies.frame.program import names_of
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
    from studies.frame.program import Work

    for path in Path(program.__file__).parent.parent.glob("[!_]*.py"):
        if "STUDY = " not in path.read_text():
            continue
        study = program.study_of(path.stem)
        for scale, size in study.sizes.items():
            if study.name in ("photographs", "blender"):
                continue  # their cells are of datasets that are given
            options = study.parser().parse_args(["OUT", "--scale", scale])
            work = Work(options, "", study.sized(size, options))
            yield study.name, study.cells(work)


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


def test_names_come_in_the_order_of_those_known():
    assert names_of(None, [*"abc"]) == ["a", "b", "c"]
    assert names_of("c, a,c", [*"abc"]) == ["a", "c"]
    for only in ("", "a,", "d"):
        fails(r"^--only", names_of, only, [*"abc"])


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


def real_run(root, out, data, killed=False):
    """A task: `mgs nbv`; if asked for, its first attempt is killed after its first choice."""
    from mgs.gaussians import ARRAYS
    from mgs.run.inputs import array_digest
    from mgs.run.nbv import resume_nbv, run_nbv

    first, run = not (out / "run").exists(), out / "run"

    def on_step(state):
        if killed and first and len(state.steps) == 2:
            os.kill(os.getpid(), signal.SIGKILL)

    given = {"gaussians": 150, "seeds": 2, "budget": 2}
    done = run_nbv(data, run, on_step=on_step, **given) if first else resume_nbv(run)
    state = done.state
    arrays = [*(getattr(state.gaussians, name) for name in ARRAYS), state.H, state.surface]
    losses = [step["loss"] for step in state.steps]
    return {"taken": state.taken, "arrays": array_digest(arrays), "losses": losses}


def surface(root, out):
    """A task: a Poisson surface of a sphere's points."""
    import pymeshlab

    points = np.random.default_rng(0).normal(size=(500, 3))
    points /= np.linalg.norm(points, axis=1)[:, None]
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(points, v_normals_matrix=points))
    meshes.generate_surface_reconstruction_screened_poisson(depth=5)
    return {}


def mixed(data, killed):
    """Cells of several kinds; where asked for, one of them kills its process once."""
    cells = [Cell(str(x), "test_sweep:add_slowly", {"x": x}) for x in range(4)]
    cells.append(cell("last", ("0", "3"), x=1))
    cells += [Cell(f"surface/{k}", "test_sweep:surface") for k in range(2)]
    more = {"killed": True} if killed else {}
    return [*cells, Cell("run", "test_sweep:real_run", {"data": str(data)} | more)]


PROGRAM = """
import sys
from pathlib import Path
from test_sweep import mixed, run_cells

if __name__ == "__main__":
    with open(sys.argv[2], "w") as told:
        cells = mixed(sys.argv[3], True)
        run_cells(Path(sys.argv[1]), cells, lambda name, *_: print(name, file=told), workers=2)
"""


@pytest.mark.slow
def test_two_workers_of_which_one_is_killed_find_silently_what_a_serial_run_finds(tmp_path):
    import synthetic

    data = synthetic.write_dataset(tmp_path / "data", synthetic.orbit_cameras(8, 48, 36)).root
    program, told = tmp_path / "program.py", tmp_path / "told.txt"
    program.write_text(PROGRAM)
    paths = os.pathsep.join([os.path.dirname(__file__), os.getcwd()])
    command = [sys.executable, program, tmp_path / "parallel", told, data]
    options = {"env": os.environ | {"PYTHONPATH": paths}, "capture_output": True, "text": True}
    done = subprocess.run(command, timeout=240, **options)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    names = told.read_text().split()
    assert len(names) == len(set(names)) == 8
    assert names.index("last") > max(names.index("0"), names.index("3"))
    serial = run_cells(tmp_path / "serial", mixed(data, False), silent)
    assert len(serial["run"]["taken"]) == 4
    for cell in mixed(data, True):
        assert result_of(tmp_path / "parallel", cell) == serial[cell.name]


@pytest.fixture(scope="module")
def scheduler():
    """Address of a Dask scheduler with two worker processes."""
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 0}),
        LocalCluster(
            n_workers=2, threads_per_worker=1, host="127.0.0.1", memory_limit=0,
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


SLEEP = Cell("sleep", "test_sweep:sleep")


def sleep(root, out):
    """A task that outlives its scheduler."""
    time.sleep(3)
    return {}


def test_a_lost_scheduler_is_one_line(tmp_path, caplog):
    place = tmp_path / "scheduler.json"
    file, here = ["--scheduler-file", place], {"PYTHONPATH": os.pathsep.join(sys.path)}
    of_scheduler = ["scheduler", *file, "--host", "127.0.0.1", "--port", "0", "--no-dashboard"]
    of_worker = ["worker", *file, "--nthreads", "1", "--no-nanny", "--no-dashboard"]
    options = {"env": os.environ | here, "stderr": subprocess.DEVNULL}
    begun = [sys.executable, "-m"]
    scheduler, worker = (
        subprocess.Popen([*begun, f"distributed.cli.dask_{name}", *rest], **options)
        for name, *rest in (of_scheduler, of_worker)
    )

    def lose():
        while not (tmp_path / "cells/sleep").exists():
            time.sleep(0.05)
        scheduler.kill()

    thread = threading.Thread(target=lose, daemon=True)
    try:
        while not place.is_file():
            time.sleep(0.05)
        thread.start()
        address = json.loads(place.read_text())["address"]
        with pytest.raises(InputError, match="the connection to the Dask scheduler is lost"):
            run_cells(tmp_path, [SLEEP], silent, scheduler=address)
    finally:
        for process in (scheduler, worker):
            process.kill()
            process.wait()
    assert [one.name for one in caplog.records if one.name == "distributed.client"] == []
