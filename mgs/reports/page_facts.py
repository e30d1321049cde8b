"""Words and numbers of the report page, read from the files of runs: notes, tables, links."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

from mgs.policy.certificate import Certificate
from mgs.policy.criteria import GAIN_UNIT
from mgs.reports.page_plots import METRIC_NAMES
from mgs.reports.tables import table_cell, table_columns, table_heading, table_row
from mgs.run.ending import RunEnd, why_ended
from mgs.run.folder import Run


def notes(run: Run) -> list[str]:
    """Sentences about what is unfinished or missing, the end of the run, and its warnings."""
    taken, lines = len(run.indices), []
    if run.ended is None:
        resume = f"`mgs nbv --resume {run.folder}` goes on"
        lines.append(f"Unfinished: {taken} of {run.planned} views are taken; {resume}.")
    elif run.ended["reason"] != RunEnd.BUDGET:  # a spent budget is no news
        lines.append(f"The run has ended: {why_ended(run.ended)}.")
    if run.metrics is None:
        lines.append(f"Not measured: `mgs eval {run.folder}` adds its PSNR and SSIM.")
    elif run.measured is None:
        of = f"metrics.json is of {run.metrics['images']} images, the model of {taken}"
        again = f"`mgs eval {run.folder}` measures again"
        lines.append(f"{of}: its numbers are left out; {again}.")
    if run.settings.estimator != "exact":
        gain = f"Its information gain is by the estimator {run.settings.estimator}"
        lines.append(f"{gain}: compare it with that of the same estimator only.")
    if certificate := run.steps[0].get("certificate"):
        lines.append(Certificate(**certificate).sentence())
    for step in run.steps:
        lines += [f"step {step['step']}: {warning}" for warning in step.get("warnings", [])]
    return lines


def summary_rows(runs: Mapping[str, Run]) -> list[tuple[str, list[str]]]:
    """Rows of the table of results, (heading, a cell for each run): the report's table, without
    what no run has, then the size of the model and the time."""
    rows = [table_row(label, run) for label, run in runs.items()]
    seconds = [sum(sum(s.get("seconds", {}).values()) for s in run.steps) for run in runs.values()]
    keys = table_columns(rows)[1:]
    table = [
        (table_heading(key, rows), [table_cell(key, row.get(key)) for row in rows]) for key in keys
    ]
    table.append(("Gaussians", [f"{len(run.gaussians):,}" for run in runs.values()]))
    return [*table, ("time of all steps (s)", [f"{value:.1f}" for value in seconds])]


def measured(step: Mapping[str, Any]) -> dict[str, float]:
    """Metrics of images in a line of steps.jsonl."""
    return {key: step[key] for key in METRIC_NAMES if step.get(key) is not None}


def step_facts(step: Mapping[str, Any]) -> list[tuple[str, str]]:
    """(name, value) of a line of steps.jsonl: images, information gain, coverage, and metrics."""
    facts = [("images", str(step["images"]))]
    if step.get("information_gain") is not None:
        facts.append(("information gain", f"{step['information_gain']:.4g} {GAIN_UNIT}"))
    facts.append(("Gaussians observed", f"{100 * step['coverage']:.2f} %"))
    return facts + [(METRIC_NAMES[key], table_cell(key, v)) for key, v in measured(step).items()]


def measured_views(run: Run) -> list[dict[str, Any]]:
    """Views in metrics.json: those of the dataset, then its test views, as `test/NAME`."""
    metrics = run.measured or {}
    tests = [view | {"name": f"test/{view['name']}"} for view in metrics.get("test_views", [])]
    return [*metrics.get("views", []), *tests]


def psnr_of(run: Run, view: str) -> str:
    """PSNR of a view as part of a caption; empty if it was not measured."""
    psnr = {one["name"]: one["psnr"] for one in measured_views(run)}.get(view)
    return "" if psnr is None else f", {psnr:.2f} dB"


def setting_rows(runs: Mapping[str, Run]) -> list[tuple[str, list[str], bool]]:
    """Rows of the table of settings and versions: (key, a value for each run, whether they
    differ)."""
    columns = []
    for run in runs.values():
        versions = run.config.get("versions", {}).items()
        numbers = {f"version of {name}": version for name, version in versions}
        columns.append(_texts(run.config["settings"]) | numbers)
    rows = []
    for key in dict.fromkeys(key for column in columns for key in column):
        values = [column.get(key, "–") for column in columns]
        rows.append((key, values, len(set(values)) > 1))
    return rows


def _texts(values: Mapping[str, Any], path: str = "") -> dict[str, str]:
    """Nested settings as text, by their keys joined by dots."""
    texts: dict[str, str] = {}
    for key, value in values.items():
        name = f"{path}{key}"
        texts |= _texts(value, f"{name}.") if isinstance(value, dict) else {name: str(value)}
    return texts


def links(run: Run, page: Path) -> list[tuple[str, str]]:
    """(address relative to the page, name) of the existing files of a run that a reader may
    open."""
    names = ["gaussians.ply", "metrics.json", "steps.jsonl", "config.json"]
    maps = sorted(run.folder.glob("diagnostics/*.exr"))
    names += ["diagnostics/information.ply", *(f"diagnostics/{file.name}" for file in maps)]
    files = [(run.folder / name, name) for name in names]
    prior = run.settings.prior
    files += [(prior / name, f"prior: {name}") for name in ("mesh.ply", "points.ply")]
    start = page.resolve().parent
    there = [(os.path.relpath(f.resolve(), start), name) for f, name in files if f.is_file()]
    return [(quote(Path(path).as_posix()), name) for path, name in there]
