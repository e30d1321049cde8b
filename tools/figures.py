"""Draw the figures of docs/results again from the rows beside them.

python tools/figures.py [NAME ...]     # names of FIGURES; default: all
"""

import sys
from collections.abc import Callable, Mapping
from pathlib import Path

from studies import chart, parsimony, photographs, setups, stress
from studies.frame.output import read_rows
from studies.frame.statistics import Row

RESULTS = Path(__file__).parent.parent / "docs/results"


def draw_chart(path: Path, rows: list[Row]) -> None:
    chart.draw(path, chart.points_over_rocks(rows))


FIGURES: Mapping[str, tuple[str, Callable[[Path, list[Row]], None]]] = {
    "chart": ("chart/chart", draw_chart),
    "parsimony": ("parsimony/parsimony", parsimony.draw),
    "photographs": ("photographs/photographs", photographs.draw),
    "setups": ("setups/setups", setups.draw),
    "stress": ("stress/stress", stress.draw),
}
"""Figures by name: file below RESULTS without its ending, and the function that draws its rows."""


if __name__ == "__main__":
    for name in sys.argv[1:] or FIGURES:
        where, draw = FIGURES[name]
        rows = read_rows(RESULTS / f"{where}.csv")
        shown = [{key: value for key, value in row.items() if value is not None} for row in rows]
        draw(RESULTS / f"{where}.png", shown)
        print(f"wrote docs/results/{where}.png")
