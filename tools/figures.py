"""Draw the figures of docs/results again from the rows beside them.

python tools/figures.py [NAME ...]     # chart, parsimony, setups, stress; default: all
"""

import csv
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from studies import chart, parsimony, setups, stress

RESULTS = Path(__file__).parent.parent / "docs/results"

Rows = list[dict[str, Any]]


def read_rows(path: Path) -> Rows:
    """Rows of a CSV file; numbers, true and false are converted, empty cells left out."""
    with path.open(newline="", encoding="utf-8") as file:
        rows = csv.DictReader(file)
        return [{key: _value(text) for key, text in row.items() if text} for row in rows]


def _value(text: str) -> Any:
    if text in ("True", "False"):
        return text == "True"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def _chart(path: Path, rows: Rows) -> None:
    runs = read_rows(path.with_name("run.csv"))
    kinds = {"fit": rows, "run": runs}
    chart.draw(path, {k: [{"preset": ""} | row for row in rows] for k, rows in kinds.items()})


FIGURES: Mapping[str, tuple[str, Callable[[Path, Rows], None]]] = {
    "chart": ("chart/fit", _chart),
    "parsimony": ("parsimony/parsimony", parsimony.draw),
    "setups": ("setups/setups", setups.draw),
    "stress": ("stress/stress", stress.draw),
}
"""Figures by name: file below RESULTS without its ending, and the function that draws its rows."""


if __name__ == "__main__":
    for name in sys.argv[1:] or FIGURES:
        where, draw = FIGURES[name]
        draw(RESULTS / f"{where}.png", read_rows(RESULTS / f"{where}.csv"))
        print(f"wrote docs/results/{where}.png")
