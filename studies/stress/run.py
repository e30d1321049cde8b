"""All experiments, and the command that does them: cells, verdicts, plots, one table."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mgs.files import atomic_path, write_csv, write_json
from mgs.provenance import versions
from mgs.runtime import processor
from studies.output import draw_panels
from studies.stress.faults import ALARMS, DATA_FAULTS, PRIOR_EXPERIMENT
from studies.stress.fits import CONVERGENCE, FREE_MEANS
from studies.stress.lab import Experiment, StressSize
from studies.sweep import Report, found, run_cells
from studies.verdict import Row, judged, verdict_table

EXPERIMENTS: dict[str, Experiment] = {
    "free-means": FREE_MEANS,
    "convergence": CONVERGENCE,
    "data-faults": DATA_FAULTS,
    "prior-faults": PRIOR_EXPERIMENT,
    "detectors": ALARMS,
}


def run_stress(
    out: Path,
    size: StressSize,
    names: Sequence[str],
    command: str,
    report: Report,
    workers: int = 1,
) -> list[Row]:
    """Do the experiments of these names in a folder, and write stability.csv, verdicts.json,
    stability.md and NAME.png.

    Returns the experiments of verdicts.json, including those done in this folder before. Raises
    InputError if the folder holds results of another size.
    """
    cells = [cell for name in names for cell in EXPERIMENTS[name].cells(size)]
    run_cells(out, cells, report, workers=workers)
    experiments, rows, sections = [], list[Row](), []
    for name, experiment in EXPERIMENTS.items():
        results = [found(out, cell) for cell in experiment.cells(size)]
        if None in results:
            continue
        own = [row for result in results if result for row in result.get("rows", ())]
        claims = [judged(claim, own) for claim in experiment.claims]
        title = "" if experiment.panels[0].title else experiment.question
        draw_panels(out / f"{name}.png", experiment.panels, own, title)
        experiments.append({"name": name, "question": experiment.question, "claims": claims})
        rows += [{"experiment": name} | row for row in own]
        sections.append(f"**{name}**: {experiment.question}\n\n{verdict_table(claims)}")
    record: dict[str, Any] = {"experiments": experiments, "command": command}
    write_json(out / "verdicts.json", record | {"machine": processor(), "versions": versions()})
    write_csv(out / "stability.csv", rows)
    with atomic_path(out / "stability.md") as temporary:
        temporary.write_text("\n".join(sections), encoding="utf-8")
    return experiments
