"""Numbers of the pages: the rows of docs/results, their tables, and two of them made anew."""

from dataclasses import replace
from pathlib import Path

import pytest

from studies import all as every
from studies import fits
from studies.frame.case import FRESH
from studies.frame.output import read_rows, tables_of, write_csv
from studies.frame.sweep import run_cells

RESULTS = Path(__file__).parent.parent / "docs/results"


def test_tables_of_pages_are_of_their_rows():
    shown = tables_of(RESULTS / "fits/fits.csv")[1].splitlines()
    assert shown[0].startswith("| changed | hemisphere, 12 |")
    gains = [row["test_change"] for row in read_rows(RESULTS / "fits/fits.csv")
             if row["variant"] == "--sh 1" and row["pool"] == "hemisphere, 4"]  # fmt: skip
    (line,) = (line for line in shown if line.startswith("| --sh 1 |"))
    assert f"| {sum(gains) / len(gains):+.2f} [" in line
    assert "| near angle |" in tables_of(RESULTS / "setups/setups.csv")[1]


def test_rows_made_anew_are_compared_with_those_of_their_rock(tmp_path):
    usual = RESULTS / "fits/fits.csv"
    rows = [row for row in read_rows(usual) if row["rock"] == "boulder-11"]
    one, other = every.compared(write_csv(tmp_path / "fits.csv", rows), usual)
    assert len(one) == 51
    assert [every.difference(*pair) for pair in zip(one, other, strict=True)] == [(0, "")] * 51
    changed = one[0] | {"test": one[0]["test"] + 0.25, "commit": "another"}
    apart, where = every.difference(changed, one[0])
    assert apart == pytest.approx(0.25)
    assert where == "in test of boulder-11 boulder hemisphere, 12 default"
    assert every.difference(one[0], one[1])[0] == float("inf")
    assert every.difference({"views": 3}, {"views": 4})[0] == 1
    for wrong in (None, float("nan")):
        assert every.difference({"gain": wrong}, {"gain": 1.0})[0] == float("inf")


@pytest.mark.slow
def test_two_rows_of_the_pages_are_those_of_this_commit(tmp_path):
    """Fits to 12 and to 4 even views of a fresh rock, from its rendering on. A change that moves
    them moves the pages: `make results`."""
    size = replace(fits.SIZES["quick"], rocks=FRESH[:1])
    cells = {cell.name: cell for cell in fits.cells_of(size)}
    chosen = [
        cell
        for cell in cells.values()
        if cell.about.get("variant") == fits.DEFAULT and "hemisphere" in cell.about["pool"]
    ]
    for cell in chosen:
        chosen += [cells[name] for name in cell.needs if cells[name] not in chosen]
    results = run_cells(tmp_path, chosen, lambda *what: None)
    rows = {
        (row["rock"], row["pool"]): row
        for row in read_rows(RESULTS / "fits/fits.csv")
        if row["variant"] == fits.DEFAULT
    }
    for cell in (cell for cell in chosen if cell.about):
        row = rows[cell.about["rock"], cell.about["pool"]]
        assert results[cell.name]["test"] == pytest.approx(row["test"], abs=every.ENOUGH)
