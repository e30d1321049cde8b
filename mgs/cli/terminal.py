"""The terminal: text is printed as it is, without markup, and names cannot control it; progress."""

import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich import box
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
)
from rich.table import Table
from rich.text import Text

from mgs.errors import printable_lines
from mgs.progress import listening

if TYPE_CHECKING:
    from mgs.run.folder import Checkpoint


class Terminal(Console):
    """Console that reads no markup in text and cells, and escapes control characters in them."""

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, highlight=False, emoji=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(printable_lines(text), **options)


def echo(text: str) -> None:
    """Print text to the standard output, whatever its width."""
    print(printable_lines(text))


# Least and largest time between two lines of progress without a terminal; a tenth of all time.
SECONDS_BETWEEN, SECONDS_MOST = 10.0, 60.0


class ProgressBar:
    """Lines at the bottom of the terminal: the stage at work, and above it the whole. Without a
    terminal, a line on the standard error from time to time."""

    def __init__(self, bar: Progress, stage: str) -> None:
        self._bar = bar
        self._begun = self._printed = time.monotonic()
        self._whole: TaskID | None = None
        self._name = stage
        self._stage = bar.add_task(stage, total=None)

    def __call__(self, stage: str, done: int = 0, total: int = 0) -> None:
        """Show a stage and how far it is. total: 0 if unknown."""
        if stage != self._name:
            self._bar.remove_task(self._stage)
            self._name, self._stage = stage, self._bar.add_task(stage, total=None)
        self._bar.update(self._stage, completed=done, total=total or None)
        now = time.monotonic()
        pause = max(SECONDS_BETWEEN, min((now - self._begun) / 10, SECONDS_MOST))
        if self._bar.disable and now > self._printed + pause:
            self._printed = now
            of = f": {done} of {total}" if total > 1 else ""
            print(printable_lines(f"{stage}{of}"), file=sys.stderr, flush=True)

    def whole(self, name: str, done: int, total: int) -> None:
        if self._whole is None:
            self._whole = self._bar.add_task(name, total=total)
        self._bar.update(self._whole, completed=done, total=total)

    def print(self, text: str) -> None:
        """Print a line above the bar; it stays when the bar goes."""
        self._bar.console.print(text, soft_wrap=True, markup=False, highlight=False)


@contextmanager
def progress_bar(stage: str = "reading", console: Terminal | None = None) -> Iterator[ProgressBar]:
    """Show progress while the context is open, on a terminal or in a notebook; nothing of it stays.

    It listens to `mgs.progress.report`, and what it yields may be called as progress(stage, done,
    total)."""
    name = TextColumn("{task.description}", markup=False)
    columns = name, BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    console = console or Terminal()
    off = not (console.is_terminal or console.is_jupyter)  # it would leave an empty line
    with Progress(*columns, console=console, transient=True, disable=off) as bar:
        progress = ProgressBar(bar, stage)
        with listening(progress):
            yield progress


GROUPS = {"test": "test", "all": "all", "held_out": "held out"}  # in headings of `print_quality`

SHOWN = {
    "test": ("test.psnr", "test.ssim", "test.psnr_mask", "held_out.psnr", "held_out.psnr_mask"),
    "held_out": ("all.psnr", "all.ssim", "held_out.psnr", "held_out.ssim", "held_out.psnr_mask"),
    "all": ("all.psnr", "all.ssim", "all.psnr_mask", "all.ssim_mask"),
}
"""Columns of `print_quality` with test views, else with held-out views, and with neither: as many
as fit into 80 characters."""

FAR_APART = 6.0  # dB that test views may have less than those fitted without a word; chosen
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
    views = "test" if tested else "held_out" if new else "all"
    metrics = [key for key in SHOWN[views] if new or not key.startswith("held_out.")]
    metrics = [key for key in metrics if is_masked(rows) or "mask" not in key]
    if exposure := any(row.get("exposure") for row in rows):
        metrics = [f"{key}_corrected" if "psnr" in key else key for key in metrics]
    covered = any("coverage" in row for row in rows)
    keys = ["images", *metrics, *(["coverage"] if covered else [])]
    caption = f"n: images; PSNR in dB{' with fitted gains' if exposure else ''}"
    caption += ", coverage in %" if covered else ""
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
    name, group = metric.partition("_")[0], GROUPS[views]
    group = group if new or views != "all" else "training"
    return ("masked\n" if "mask" in metric else "") + f"{name.upper()}\n{group}"


def _apart(row: Mapping[str, Any]) -> float:
    """PSNR of the views fitted less that of test views, dB, of a run that took all images."""
    metric = "psnr_corrected" if row.get("exposure") else "psnr"
    fitted, test = row.get(f"all.{metric}"), row.get(f"test.{metric}")
    return 0.0 if fitted is None or test is None or row.get("held_out.count") else fitted - test


def print_run(out: Path, state: "Checkpoint", metrics: dict[str, Any], console: Terminal) -> None:
    from mgs.reports.tables import metrics_row
    from mgs.run.ending import RunEnd, why_ended

    last = state.steps[-1]
    row = metrics_row(metrics["policy"], metrics) | {"exposure": bool(last.get("exposure"))}
    row |= {"coverage": 100 * last["coverage"]} if len(state.steps) > 1 else {}
    print_quality(console, [row])
    if (apart := _apart(row)) > FAR_APART:
        cure = "too few photographs show what they show; take more between them"
        console.print(
            f"test views have {apart:.1f} dB less than those fitted: {cure}", soft_wrap=True
        )
    if "ended" in last and (last["ended"]["views"] or last["ended"]["reason"] != RunEnd.BUDGET):
        console.print(f"the run has ended: {why_ended(last['ended'])}", soft_wrap=True)
    console.print(f"wrote {out}", soft_wrap=True)


def step_lines(step: Mapping[str, Any], of_fit: bool = False) -> Iterator[str]:
    """A line of steps.jsonl in words: a line for the step, its certificate and its warnings.
    of_fit: whether it is the only one."""
    from mgs.policy.certificate import Certificate

    names = [step["name"]] if step["name"] else step.get("seed_names", [])
    views = ", ".join(names) if len(names) <= MOST_NAMES else f"{len(names)} views"
    prefix = "" if of_fit else f"step {step['step']}: "
    parts = [prefix + views]
    if step["score"] is not None:
        parts.append(f"score {step['score']:.4g}")
    if not of_fit:
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
    yield from (prefix + warning for warning in step.get("warnings", []))
