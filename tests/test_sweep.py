"""A sweep of cells: each is done once, in the order of needs, and what was interrupted goes on."""

import json
import os
import sys
import time
from importlib import import_module
from pathlib import Path

import pytest
from program import python
from refusals import fails

from studies.frame import program
from studies.frame.program import names_of
from studies.frame.sweep import Cell, cell_folder, result_of, run_cells

CALLS = []


def add(root, out, x, to=None, seconds=0):
    """A task: x plus what another cell found."""
    CALLS.append(out.name)
    time.sleep(seconds)
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


def describe(root, out):
    """A task that finds its process, and whether another cell has begun and not ended."""
    import drjit as dr

    others = [folder for folder in out.parent.iterdir() if folder != out]
    beside = [folder.name for folder in others if not (folder / "result.json").exists()]
    process = {"pid": os.getpid(), "threads": dr.thread_count()}
    return process | {"beside": beside, "waits": os.environ.get("OMP_WAIT_POLICY")}


def test_workers_find_silently_what_a_serial_run_finds(tmp_path, capfd):
    slow, told = cell("slow", x=1, seconds=0.5), []
    cells = [cell("last", ("slow",), x=2, to="slow"), slow, cell("other", x=3)]
    report = lambda name, *_: told.append(name)  # noqa: E731
    found = run_cells(tmp_path / "a", cells, report, workers=2)
    assert capfd.readouterr() == ("", "")
    assert sorted(told) == ["last", "other", "slow"]
    assert found == run_cells(tmp_path / "b", cells, silent)


def test_a_cell_that_must_be_alone_runs_here_and_others_share_the_cores(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(6))
    task, slow = "test_sweep:describe", cell("slow", x=1, seconds=0.5)
    cells = [Cell("alone", task, alone=True), Cell("other", task), slow]
    results = run_cells(tmp_path, cells, silent, workers=2)
    assert (results["alone"]["pid"], results["alone"]["beside"]) == (os.getpid(), [])
    assert results["other"]["pid"] != os.getpid()
    assert (results["other"]["threads"], results["other"]["waits"]) == (3, "passive")


def test_what_a_cell_raises_ends_all_workers_and_what_is_done_is_kept(tmp_path):
    cells = [cell("a", x=1), cell("b", ("a",), x=-1), cell("long", x=1, seconds=60)]
    began = time.monotonic()
    with pytest.raises(ValueError, match="-1"):
        run_cells(tmp_path, cells, silent, workers=2)
    assert time.monotonic() - began < 40
    assert [result_of(tmp_path, one) for one in cells] == [{"sum": 1}, None, None]


def strike(root, out, who, end):
    """A task that sends a signal to its study, its worker, or all processes, as Ctrl-C does. Then
    another worker is there and idle, because cell c is done."""
    while not (cell_folder(root, "c") / "result.json").exists():
        time.sleep(0.05)
    os.kill({"all": 0, "study": os.getppid(), "worker": os.getpid()}[who], end)
    time.sleep(60)
    return {}


STRUCK = """
import sys
from test_sweep import Cell, cell, program
out, who, end = sys.argv[1:]
struck = Cell("b", "test_sweep:strike", {"who": who, "end": int(end)}, ("a",))
cells = lambda work: [cell("a", x=1), struck, cell("c", ("a",), x=1)]
program.Study("made", "", None, {"quick": 0}, cells, program.WORKERS)([out, "--workers", "2"])
"""


@pytest.mark.parametrize(
    ("who", "end", "code", "line"),
    [
        ("all", 2, 130, "made: interrupted; run the same command again to continue\n"),
        ("study", 9, -9, ""),
        ("worker", 9, 2, "made: a worker was killed (is there too little memory?); "
                         "run the same command again with fewer workers\n"),
    ],
)  # fmt: skip
def test_a_signal_ends_all_processes_and_what_is_done_is_kept(tmp_path, who, end, code, line):
    # Python tells of a killed process what is no fault of ours, that its semaphores are left.
    env = {"PYTHONPATH": os.pathsep.join(sys.path), "PYTHONWARNINGS": "ignore:resource_tracker"}
    options = {"env": env, "start_new_session": True, "timeout": 50}
    ended = python(STRUCK, tmp_path / "out", who, end, **options)  # until no worker can print
    assert (ended.returncode, ended.stderr) == (code, line)
    assert result_of(tmp_path / "out", cell("a", x=1)) == {"sum": 1}
