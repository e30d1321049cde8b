"""Scenes that are harder than a boulder in the afternoon: a rock that hides parts of itself, long
shadows, small stones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mgs.study.stress.experiment import Experiment, Panel, rock_cell, turns
from mgs.study.stress.lab import Preset, by_policy, open_lab
from mgs.study.stress.verdict import Claim, Effects, paired
from mgs.study.sweep import Cell

POLICIES = ("d-optimal", "uniform", "random")
VIEWS = 8


def scenes(root: Path, out: Path, scene: str, kind: str, turns_: int) -> dict[str, Any]:
    """Models of eight images, four of them seeds, chosen by each policy. kind: "usual" or "hard",
    for the claims."""
    lab, rows = open_lab(root, scene), []
    for suffix, turn in turns(turns_):
        known = {"run": f"{scene}, {suffix}", "scene": scene.rpartition("-")[0], "kind": kind}
        rows += [known | row for row in by_policy(lab, lab.even(4, turn), VIEWS, POLICIES)]
    return {"rows": rows}


def _cells(preset: Preset) -> list[Cell]:
    kinds = [(rock, "usual") for rock in preset.rocks] + [(rock, "hard") for rock in preset.others]
    return [
        rock_cell("scenes", f"{__name__}:scenes", preset, *rock, kind=kind, turns_=preset.turns)
        for rock, kind in kinds
    ]


def _difference(kind: str, other: str) -> Effects:
    return paired("psnr", {"kind": kind, "policy": "d-optimal"}, {"kind": kind, "policy": other})


SCENES = Experiment(
    "Do rocks that hide parts of themselves, or long shadows, change which policy is better?",
    _cells,
    (
        Claim("On the usual rocks, D-optimal is not behind random views at 8 images.", _difference("usual", "random"), "dB",
              "above", 0.0, "rock and set of seeds"),
        Claim("On the usual rocks, D-optimal is not behind views spread evenly in azimuth.", _difference("usual", "uniform"),
              "dB", "above", 0.0, "rock and set of seeds"),
        Claim("On non-convex rocks and under a low sun, D-optimal is not behind random views.", _difference("hard", "random"),
              "dB", "above", 0.0, "rock and set of seeds"),
        Claim("On these, D-optimal is not behind views spread evenly in azimuth.", _difference("hard", "uniform"), "dB",
              "above", 0.0, "rock and set of seeds"),
    ),
    (Panel("scene", "psnr", "scene", "PSNR on test views (dB)", "policy"),),
)  # fmt: skip
