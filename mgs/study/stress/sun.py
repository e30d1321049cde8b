"""A sun that stands elsewhere in the second half of the flight: what it costs, what notices it, and
whether gains help."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mgs.data.dataset import load_dataset
from mgs.files import read_json
from mgs.metrics import agreement
from mgs.prior.exposure import exposure_of
from mgs.run.detectors import DETECTORS
from mgs.run.operations import psnr_measure
from mgs.splat import ListCache
from mgs.study.material import test_views_of
from mgs.study.stress.experiment import Experiment, Panel, turns
from mgs.study.stress.faults import Captured, captured, signs_of
from mgs.study.stress.lab import CACHE, Lab, Preset, open_lab, scene_cell, variant_cell
from mgs.study.stress.verdict import Claim, Row, paired, single
from mgs.study.sweep import Cell, cell_folder
from mgs.synth.scene_file import load_scene_file

TURN = 60.0
"""Degrees by which the second sun's azimuth differs from the first one's."""

VIEWS, SEEDS = 8, 4

ONE, TWO, HALF = "one sun", "two suns", "first half only"


def scaled(frame: Captured, factor: np.ndarray) -> Captured:
    """The frame with its colours, linear RGB, times a factor for each channel, [3]."""
    rgba = frame.rgba * np.append(factor, 1).astype(np.float32)
    return replace(frame, pixels=frame.pixels * factor.astype(np.float32), rgba=rgba)


def two_suns(lab: Lab, root: Path, scene: str, other: str) -> Lab:
    """The lab with the second half of its flight under the sun of another dataset, whose cameras
    are the same.

    scene, other: cells of datasets. The photographs are brought to one exposure: each dataset was
    metered by itself."""
    folders = [cell_folder(root, f"dataset/{name}") / "dataset" for name in (scene, other)]
    first, second = (float(read_json(folder / "config.json")["exposure"]) for folder in folders)
    half, others = len(lab.frames) // 2, load_dataset(folders[1]).frames
    later = [scaled(captured(frame), np.full(3, first / second)) for frame in others[half:]]
    return lab.changed(frames=(*lab.frames[:half], *later))


def with_gains(lab: Lab, taken: Sequence[int]) -> Lab:
    """The lab whose photographs taken are divided by the gains that `mgs nbv --exposure` estimates
    of them."""
    gains = dict(zip(taken, exposure_of(lab.prior)([lab.frames[i] for i in taken]), strict=True))
    frames = [
        scaled(captured(f), 1 / gains[i]) if i in gains else f for i, f in enumerate(lab.frames)
    ]
    return lab.changed(frames=tuple(frames))


def first_half(count: int, views: int, turn: float) -> list[int]:
    """So many frames spread over the first half of `count`; turn: by which share of their spacing
    they are moved on."""
    return [int((k + turn) * (count // 2) / views) for k in range(views)]


def sun(root: Path, out: Path, scene: str, other: str, turns_: int) -> dict[str, Any]:
    """Fits to evenly spread views under one sun and under two, and the ranking of candidates.
    other: the second sun's cell."""
    lab, rows = open_lab(root, scene), list[Row]()
    labs = {ONE: lab, TWO: two_suns(lab, root, scene, other)}
    tests = test_views_of(load_dataset(cell_folder(root, f"dataset/{scene}") / "dataset"))
    corrected = psnr_measure(tests, ListCache(CACHE), exposure=True)
    for suffix, turn in turns(turns_):
        run, even = {"run": f"{scene}, {suffix}"}, lab.even(VIEWS, turn)
        fits = [(light, gains, even) for light in labs for gains in (False, True)]
        for light, gains, taken in [*fits, (HALF, False, first_half(len(lab.frames), VIEWS, turn))]:
            photographs = labs.get(light, lab)
            model, signs = signs_of(with_gains(photographs, taken) if gains else photographs, taken)
            quality, said = corrected(model, []), loud(signs)
            row: Row = {
                "light": light,
                "gains": gains,
                "label": light + (", --exposure" if gains else ""),
            }
            row |= {key: quality[key] for key in ("psnr", "psnr_mask", "psnr_corrected")}
            rows.append(
                run | row | {"alarm": float(bool(said)), "alarms": " ".join(said)} | named(signs)
            )
        seeds = lab.even(SEEDS, turn)
        reference = _ranking(lab, seeds)
        rows += [
            run | {"ranking": light, **agreement(_ranking(of, seeds), reference)}
            for light, of in labs.items()
        ]
    return {"rows": rows}


def named(signs: dict[str, float]) -> Row:
    """Signs as entries of a row."""
    return {f"sign {name}": value for name, value in signs.items()}


def loud(signs: dict[str, float]) -> list[str]:
    """The signs that are beyond their limits."""
    return [name for name, value in signs.items() if value > DETECTORS[name].limit]


def _ranking(lab: Lab, seeds: list[int]) -> np.ndarray:
    """The D-optimal score of each candidate after a fit to the seeds."""
    return lab.scores(lab.fit(seeds).gaussians, seeds, lab.left(seeds))


def _cells(preset: Preset) -> list[Cell]:
    cells = []
    for (scene, seed), variant in zip(preset.rocks, _data(preset), strict=True):
        name, needs = f"{scene}-{seed}", (scene_cell(preset, scene, seed).name, variant.name)
        arguments = {"scene": name, "other": Path(variant.name).name, "turns_": preset.turns}
        cells.append(Cell(f"sun/{name}", f"{__name__}:sun", arguments, needs))
    return cells


def _data(preset: Preset) -> list[Cell]:
    """The same orbits under the second sun, without test views and priors."""
    changes = {
        scene: {"sky": {"sun_azimuth": load_scene_file(scene).sky.sun_azimuth + TURN}}
        for scene, _ in preset.rocks
    }
    return [
        variant_cell(preset, scene, seed, "later", changes[scene], tests=0, gaussians=0)
        for scene, seed in preset.rocks
    ]


def of_limits(rows: Sequence[Row]) -> list[Row]:
    """Signs of the fits without gains over their limits, for the picture; without those that are of
    no use here: `means`, which are frozen, and `worse`, which is of fits that start from a fitted
    model."""
    return [
        {"run": row["run"], "sign": name, "of limit": row[f"sign {name}"] / detector.limit, "under": row["light"]}
        for row in rows
        if row.get("gains") is False and row["light"] != HALF
        for name, detector in DETECTORS.items()
        if f"sign {name}" in row and name not in ("means", "worse")
    ]  # fmt: skip


def _under(light: str, gains: bool = False) -> Row:
    return {"light": light, "gains": gains}


SUN = Experiment(
    "What does a sun cost that moves in mid-flight?",
    _cells,
    (
        Claim("A sun that moves by 60 degrees in mid-flight costs 1 dB or more on the test views (8 even views).",
              paired("psnr", _under(TWO), _under(ONE)), "dB", "below", -1.0, "rock and set of views"),
        Claim("Gains (`--exposure`) win back at most 0.5 dB of that: where shadows move, no gain explains it.",
              paired("psnr", _under(TWO, True), _under(TWO)), "dB", "below", 0.5, "rock and set of views"),
        Claim("As many views from the first half alone are worse than views from all sides under two suns.",
              paired("psnr", _under(HALF), _under(TWO)), "dB", "below", 0.0, "rock and set of views"),
        Claim("The second sun hardly changes the D-optimal ranking after four seeds: Kendall's tau is at least 0.9.",
              single("tau", {"ranking": TWO}), "tau", "above", 0.9, "rock and set of seeds"),
        Claim("At least nine of ten fits under two suns raise an alarm.",
              single("alarm", _under(TWO)), "share", "above", 0.9, "rock and set of views"),
        Claim("No fit under one sun raises an alarm.",
              single("alarm", _under(ONE)), "share", "below", 0.0, "rock and set of views"),
    ),
    (
        Panel("label", "psnr", "light", "PSNR on test views (dB)"),
        Panel("sign", "of limit", "sign", "sign over its limit", "under"),
    ),
    of_limits,
    _data,
)  # fmt: skip
