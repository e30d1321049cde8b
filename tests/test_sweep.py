"""A sweep of cells: each is done once, in the order of needs, and what was interrupted goes on."""

import pytest

from mgs.errors import InputError
from mgs.study.sweep import Cell, cell_folder, run_cells

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


@pytest.fixture(autouse=True)
def _fresh():
    CALLS.clear()


def silent(name, done, total):
    pass


def test_cells_come_after_those_they_need_and_are_done_once(tmp_path):
    cells = [cell("b", ("a/1",), x=2, to="a/1"), cell("a/1", x=1)]
    assert run_cells(tmp_path, cells, silent) == {"a/1": {"sum": 1}, "b": {"sum": 3}}
    assert CALLS == ["1", "b"]
    told = []
    assert run_cells(tmp_path, cells, lambda *what: told.append(what)) == {"a/1": {"sum": 1}, "b": {"sum": 3}}
    assert CALLS == ["1", "b"]
    assert told == []


def test_what_failed_is_done_again_and_the_rest_is_kept(tmp_path):
    with pytest.raises(ValueError, match="-1"):
        run_cells(tmp_path, [cell("a", x=1), cell("b", ("a",), x=-1)], silent)
    run_cells(tmp_path, [cell("a", x=1), cell("b", ("a",), x=5)], silent)
    assert CALLS == ["a", "b", "b"]


def test_the_result_of_another_question_is_refused(tmp_path):
    run_cells(tmp_path, [cell("a", x=1)], silent)
    with pytest.raises(InputError, match="other settings"):
        run_cells(tmp_path, [cell("a", x=2)], silent)
