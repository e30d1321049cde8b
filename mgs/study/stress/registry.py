"""All experiments by name, and a run of them: cells, verdicts, pictures, one CSV."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from mgs.files import atomic_path, write_csv, write_json
from mgs.provenance import versions
from mgs.runtime import processor
from mgs.study.stress.alarms import ALARMS, DATA_FAULTS, PRIOR_EXPERIMENT
from mgs.study.stress.convergence import CONVERGENCE
from mgs.study.stress.endurance import ENDURANCE
from mgs.study.stress.experiment import Experiment
from mgs.study.stress.lab import Preset, scene_cell
from mgs.study.stress.numbers import NUMBERS
from mgs.study.stress.numerics import NUMERICS
from mgs.study.stress.picture import draw_experiment
from mgs.study.stress.scales import SCALES
from mgs.study.stress.scenes import SCENES
from mgs.study.stress.specular import SPECULAR
from mgs.study.stress.spread import SPREAD
from mgs.study.stress.sun import SUN
from mgs.study.stress.survey import SURVEY
from mgs.study.stress.verdict import Row, effect, judged
from mgs.study.stress.views import FREE_MEANS, SEEDS
from mgs.study.sweep import Cell, found, run_cells

EXPERIMENTS: dict[str, Experiment] = {
    "free-means": FREE_MEANS,
    "convergence": CONVERGENCE,
    "scales": SCALES,
    "numerics": NUMERICS,
    "seeds": SEEDS,
    "spread": SPREAD,
    "numbers": NUMBERS,
    "endurance": ENDURANCE,
    "data-faults": DATA_FAULTS,
    "prior-faults": PRIOR_EXPERIMENT,
    "detectors": ALARMS,
    "scenes": SCENES,
    "sun": SUN,
    "specular": SPECULAR,
    "survey": SURVEY,
}


def run_stress(
    out: Path,
    preset: Preset,
    names: Sequence[str],
    command: str,
    report: Callable[[str, int, int], None],
    workers: int = 1,
) -> dict[str, Any]:
    """Do the experiments of these names in the folder `out`, and write stability.csv,
    verdicts.json, NAME.png and stability.md.

    command: the line that makes it again, for verdicts.json. report(cell, done, total) is told
    before each cell that is not
    done yet. workers: processes that do cells side by side. Returns what verdicts.json holds: also
    of the experiments that were done in this folder before. Called again, it does what is left.
    Raises InputError if `out` holds results of another preset or version.
    """
    cells = {cell.name: cell for name in names for cell in EXPERIMENTS[name].cells(preset)}
    data = {cell.name: cell for cell in datasets(preset)}
    needed = {need: data[need] for cell in cells.values() for need in cell.needs}
    run_cells(out, [*needed.values(), *cells.values()], report, workers=workers)
    return write_results(out, rows_done(out, preset), command)


def datasets(preset: Preset) -> list[Cell]:
    """The cells of all datasets that experiments may need."""
    usual = [scene_cell(preset, *rock) for rock in (*preset.rocks, *preset.others)]
    return usual + [cell for experiment in EXPERIMENTS.values() for cell in experiment.data(preset)]


def rows_done(out: Path, preset: Preset) -> dict[str, list[Row]]:
    """Rows of every experiment all of whose cells are done in the folder `out`, now or before."""
    done = {}
    for name, experiment in EXPERIMENTS.items():
        results = [found(out, cell) for cell in experiment.cells(preset)]
        if all(result is not None for result in results):
            done[name] = [row for result in results for row in (result or {})["rows"]]
    return done


def write_results(out: Path, rows: dict[str, list[Row]], command: str) -> dict[str, Any]:
    """Verdicts, pictures and tables of what was measured, rows by experiment; returns what
    verdicts.json holds."""
    experiments = []
    for name, of_one in rows.items():
        experiment = EXPERIMENTS[name]
        claims = [judged(claim, of_one) for claim in experiment.claims]
        experiments.append({"name": name, "question": experiment.question, "claims": claims})
        draw_experiment(out / f"{name}.png", experiment, of_one)
    verdicts = {
        "experiments": experiments,
        "command": command,
        "machine": processor(),
        "versions": versions(),
    }
    flat = [{"experiment": name} | row for name, of_one in rows.items() for row in of_one]
    write_csv(out / "stability.csv", flat)
    with atomic_path(out / "stability.md") as temporary:
        temporary.write_text(table(verdicts), encoding="utf-8")
    write_json(out / "verdicts.json", verdicts)
    return verdicts


def table(verdicts: dict[str, Any]) -> str:
    """The verdicts as a Markdown table."""
    lines = [
        "| experiment | hypothesis | verdict | mean effect (95 % interval) | runs |",
        "| --- | --- | --- | ---: | ---: |",
    ]
    for experiment in verdicts["experiments"]:
        for claim in experiment["claims"]:
            cells = [
                experiment["name"],
                claim["hypothesis"],
                f"**{claim['verdict']}**",
                effect(claim),
                str(claim["runs"]),
            ]
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"
