"""Tables that commands print."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich import box
from rich.table import Table

from mgs.cli.terminal import Terminal

if TYPE_CHECKING:
    from mgs.run.folder import Checkpoint

GROUPS = {"test": "test", "all": "all", "held_out": "held out"}  # in headings of `print_quality`

SHOWN = {
    True: ("test.psnr", "test.ssim", "test.psnr_mask", "held_out.psnr", "held_out.psnr_mask"),
    False: (
        *("all.psnr", "all.ssim", "held_out.psnr", "held_out.ssim"),
        *("held_out.psnr_mask", "held_out.ssim_mask"),
    ),
}
"""Columns of `print_quality` with and without test views: as many as fit into 80 characters."""

MOST_NAMES = 8  # most seed views that are named in a line, not counted

MEASURED = {
    f"{prefix}{key}": f"{name} of {views} views"
    for prefix, views in (("test_", "test"), ("held_out_", "held-out"), ("", "all"))
    for key, name in (("psnr", "PSNR"), ("psnr_mask", "masked PSNR"))
}
"""Metrics of steps.jsonl -> words; a line shows the first two that there are."""


def settings_table(keys: Sequence[tuple[str, str, str]]) -> Table:
    table = Table("--set KEY=VALUE", "", box=box.SIMPLE_HEAD, pad_edge=False)
    for key, default, text in keys:
        shown = f" Default: {default}." if default and "Default" not in text else ""
        table.add_row(key, text + shown)
    return table


def print_quality(console: Terminal, rows: Sequence[Mapping[str, Any]]) -> None:
    """Print the rows of `mgs.reports.tables.comparison_rows` as a table, for 80 columns."""
    from mgs.reports.tables import has_held_out, is_masked, table_cell

    tested, new = any("test.psnr" in row for row in rows), has_held_out(rows)
    metrics = [key for key in SHOWN[tested] if new or not key.startswith("held_out.")]
    metrics = [key for key in metrics if is_masked(rows) or "mask" not in key]
    keys = ["images", *metrics, "coverage"]
    caption = "n: images; PSNR in dB, coverage in %"
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, caption=caption)
    table.add_column("policy", overflow="fold")
    for key in keys:
        table.add_column(_heading(key, new), justify="right", no_wrap=True)
    for row in rows:
        table.add_row(row["policy"], *(table_cell(key, row.get(key)) for key in keys))
    console.print(table)


def _heading(key: str, new: bool) -> str:
    views, _, metric = key.partition(".")
    if not metric:
        return {"coverage": "cover", "images": "n"}[key]
    name, _, mask = metric.partition("_")
    group = GROUPS[views] if new or views != "all" else "training"
    return ("masked\n" if mask else "") + f"{name.upper()}\n{group}"


def print_run(out: Path, state: "Checkpoint", metrics: dict[str, Any], console: Terminal) -> None:
    from mgs.reports.tables import metrics_row
    from mgs.run.ending import RunEnd, why_ended

    last = state.steps[-1]
    row = metrics_row(metrics["policy"], metrics) | {"coverage": 100 * last["coverage"]}
    print_quality(console, [row])
    if "ended" in last and (last["ended"]["views"] or last["ended"]["reason"] != RunEnd.BUDGET):
        console.print(f"the run has ended: {why_ended(last['ended'])}", soft_wrap=True)
    console.print(f"wrote {out}", soft_wrap=True)


def step_lines(step: Mapping[str, Any]) -> Iterator[str]:
    """A line of steps.jsonl in words: a line for the step, its certificate and its warnings."""
    from mgs.policy.certificate import Certificate

    names = [step["name"]] if step["name"] else step.get("seed_names", [])
    views = ", ".join(names) if len(names) <= MOST_NAMES else f"{len(names)} views"
    parts = [f"step {step['step']}: {views}"]
    if step["score"] is not None:
        parts.append(f"score {step['score']:.4g}")
    parts.append(f"coverage {100 * step['coverage']:.2f} %")
    if "loss" in step:
        passes = step["iterations"] // step["images"]
        parts.append(f"{passes} passes to a loss of {step['loss']:.3g} ({step['stop_reason']})")
    measured = [key for key in MEASURED if step.get(key) is not None][:2]
    if not measured and (psnr := step.get("prediction", {}).get("psnr")):
        parts.append(f"masked PSNR of views not taken about {psnr:.1f} dB")
    parts += [f"{MEASURED[key]} {step[key]:.2f} dB" for key in measured]
    yield ", ".join([*parts, f"{sum(step['seconds'].values()):.1f} s"])
    if "certificate" in step:
        yield Certificate(**step["certificate"]).sentence()
    yield from (f"step {step['step']}: {warning}" for warning in step.get("warnings", []))
