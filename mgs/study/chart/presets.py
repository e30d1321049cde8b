"""The presets of `mgs nbv` on scenes that the charts did not use: beside the best settings of a
grid that take no more time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mgs.study.chart import fit
from mgs.study.chart.plan import OTHER_SCENES, Plan, synthetic
from mgs.study.chart.timing import with_seconds
from mgs.study.sweep import Cell

EQUAL_TIME = 1.05
"""Settings that take so many times as long still count as of equal time: less than that is not
resolved by the clock."""

LOSS = 0.1
"""By how much a preset may be worse than the best of equal time, dB."""


def cells(plan: Plan, repeats: int) -> list[Cell]:
    """The runs of `mgs.study.chart.fit.crossed_runs`, among which the presets are, on every other
    scene."""
    found = [
        cell
        for scene in OTHER_SCENES
        for cell in fit.cells(plan, synthetic(plan, scene), fit.crossed_runs(plan), repeats)
    ]
    return list({cell.name: cell for cell in found}.values())


def rows(plan: Plan, root: Path, found: dict[str, Any], unit: float) -> list[dict[str, Any]]:
    """A row for each scene and preset: its time and quality, best: the PSNR of the best of equal
    time, loss: how much better
    that is, dB, holds: whether that is at most LOSS, best_*: what that one is. unit: seconds of the
    reference."""
    made = []
    for scene in OTHER_SCENES:
        data = synthetic(plan, scene)
        runs = {p: found[f"fit/{data.label}/{p.name}"] for p in fit.crossed_runs(plan)}
        timed = dict(zip(runs, with_seconds(list(runs.values()), unit), strict=True))
        for name, point in fit.preset_points(plan).items():
            run, prior = timed[point], data.prior(point.density)
            equal = [
                p for p, other in timed.items() if other["seconds"] <= EQUAL_TIME * run["seconds"]
            ]
            winner = max(equal, key=lambda p: timed[p]["psnr"])
            best = timed[winner]["psnr"]
            loss = best - run["psnr"]
            made.append({
                "scene": scene, "preset": name, "gaussians": found[prior.name]["gaussians"], **run, "best": best, "loss": loss,
                "holds": loss <= LOSS, "best_passes": winner.passes, "best_warm_passes": winner.warm_passes,
                "best_gaussians": found[data.prior(winner.density).name]["gaussians"],
                "best_psnr_mask": timed[winner].get("psnr_mask"),
                "command": point.command(str(root / data.folder), str(root / f"cells/{prior.name}/prior"), plan.seeds),
            })  # fmt: skip
    return made
