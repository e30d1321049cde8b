"""A rock that shines: its colour depends on the direction it is seen from, which the default model
does not have."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mgs.data.dataset import load_dataset, target_of
from mgs.files import read_json
from mgs.gaussians import Gaussians
from mgs.metrics import masked_squares
from mgs.policy.poses import azimuth_difference, azimuths
from mgs.run.operations import psnr_measure
from mgs.splat import ListCache, render
from mgs.study.stress.experiment import Experiment, Panel, turns
from mgs.study.stress.lab import CACHE, Lab, Preset, by_policy, open_lab, variant_cell
from mgs.study.stress.verdict import Claim, Effects, Row, paired, runs_of
from mgs.study.sweep import Cell, cell_folder

MATERIALS = {
    "diffuse": {"specular": 0.0, "roughness": 0.8},
    "specular": {"specular": 0.5, "roughness": 0.3},
}
"""Keys of [rock] in a scene file: no mirror-like reflection at all, and a strong one."""

SHINY = "specular"

FRAMES, FEW = 32, 12
"""Frames of each dataset, all of which are fitted at last; and how many are fitted before."""

DEGREES = (0, 1, 2, 3)
VIEWS, SEEDS = 8, 4

BIN = 30
"""Degrees: angles are rounded to multiples of it."""


def errors_by_angle(lab: Lab, model: Gaussians, views: Sequence[int], sun: float) -> list[Row]:
    """For each of some views the root of the mean squared error inside the mask, linear RGB, and
    the angle between the azimuths
    of camera and sun, seen from the rock, degrees: 0 where the camera has the sun behind it, 180
    where it looks towards it.

    sun: its azimuth, degrees."""
    positions = np.array([lab.cameras[i].position for i in views])
    angles = np.degrees(
        azimuth_difference(azimuths(positions, lab.prior.points.mean(0)), np.radians(sun))
    )
    rows = []
    for i, angle in zip(views, angles, strict=True):
        frame = lab.frames[i]
        squares = masked_squares(
            np.asarray(render(model, frame.camera, cache=lab.cache).rgb),
            target_of(frame),
            frame.mask(),
        )
        rows.append(
            {
                "angle": float(angle),
                "angle of sun": float(BIN * round(angle / BIN)),
                "rms": float(np.sqrt(np.mean(squares))),
            }
        )
    return rows


def specular(root: Path, out: Path, scene: str, turns_: int) -> dict[str, Any]:
    """Models of the rock in each material, on few views and of views that policies chose; of the
    specular one, of every SH degree, and on all views too."""
    rows = list[Row]()
    for material in MATERIALS:
        lab = open_lab(root, f"{scene}-{material}")
        folder = cell_folder(root, f"dataset/{scene}-{material}") / "dataset"
        sun = float(read_json(folder / "config.json")["scene"]["sky"]["sun_azimuth"])
        orbit = psnr_measure(load_dataset(folder), ListCache(CACHE))
        degrees = DEGREES if material == SHINY else DEGREES[:1]
        for suffix, turn in turns(turns_):
            named, taken = {"run": f"{scene}, {suffix}", "material": material}, lab.even(FEW, turn)
            models = _fits(lab, taken, degrees)
            rows += [named | row for row in _qualities(lab, taken, models)]
            rows += [named | _on_orbit(orbit(model, taken), model) for model in models]
            rows += [named | row for row in errors_by_angle(lab, models[0], lab.left(taken), sun)]
            rows += [named | row for row in by_policy(lab, lab.even(SEEDS, turn), VIEWS)]
        if material == SHINY:
            taken = list(range(len(lab.frames)))
            rows += [
                {"run": scene, "material": material} | row
                for row in _qualities(lab, taken, _fits(lab, taken, degrees))
            ]
    return {"rows": rows}


def _fits(lab: Lab, taken: Sequence[int], degrees: Sequence[int]) -> list[Gaussians]:
    """A model of each SH degree."""
    start = lab.start(taken)
    return [lab.fit(taken, start=start.with_degree(degree)).gaussians for degree in degrees]


def _qualities(lab: Lab, taken: Sequence[int], models: Sequence[Gaussians]) -> list[Row]:
    fitted = {"views": len(taken), "fitted": f"{len(taken)} views"}
    return [fitted | {"degree": model.sh_degree, **lab.quality(model)} for model in models]


def _on_orbit(measured: dict[str, float], model: Gaussians) -> Row:
    """The same, but judged by the frames of the orbit that were not fitted: for the picture, not
    for the claims."""
    return {
        "fitted": f"{FEW} views; on orbit",
        "degree": model.sh_degree,
        "psnr": measured["held_out_psnr"],
    }


def _data(preset: Preset) -> list[Cell]:
    """A dataset of every rock in every material."""
    return [
        variant_cell(preset, scene, seed, name, {"rock": rock}, frames=FRAMES)
        for scene, seed in preset.rocks
        for name, rock in MATERIALS.items()
    ]


def _cells(preset: Preset) -> list[Cell]:
    names = [f"{scene}-{seed}" for scene, seed in preset.rocks]
    needs = [tuple(f"dataset/{name}-{material}" for material in MATERIALS) for name in names]
    arguments = {"turns_": preset.turns}
    return [
        Cell(f"specular/{name}", f"{__name__}:specular", {"scene": name, **arguments}, need)
        for name, need in zip(names, needs, strict=True)
    ]


def best_of_degrees(views: int) -> Effects:
    """Effects: PSNR of the best degree from 1 to 3 on the specular rock, minus that of degree 0,
    run by run."""
    of = [paired("psnr", _fit(views, degree), _fit(views, 0)) for degree in DEGREES[1:]]
    return lambda rows: [
        float(max(gains)) for gains in zip(*(effects(rows) for effects in of), strict=True)
    ]


def _fit(views: int, degree: int, material: str = SHINY) -> Row:
    return {"material": material, "views": views, "degree": degree}


def towards_the_sun(rows: Sequence[Row]) -> list[float]:
    """For each run: by how much the error of the specular rock exceeds that of the diffuse one in
    views towards the sun (from 120 degrees on), minus the same of views that have it behind them
    (up to 60)."""
    views = [row for row in rows if "rms" in row]
    found = []
    for run in runs_of(views, {}):

        def mean(material: str, low: float, high: float, run: str = run) -> float:
            one = [
                r["rms"]
                for r in views
                if r["run"] == run and r["material"] == material and low <= r["angle"] <= high
            ]
            return float(np.mean(one))

        facing, behind = (
            mean("specular", *span) - mean("diffuse", *span) for span in ((120, 180), (0, 60))
        )
        found.append(facing - behind)
    return found


def _ahead(policy: str, other: str) -> Effects:
    return paired(
        "psnr", {"material": SHINY, "policy": policy}, {"material": SHINY, "policy": other}
    )


SPECULAR = Experiment(
    "What does a rock cost that shines, and does a colour that depends on the direction help?",
    _cells,
    (
        Claim("On 12 views, the rock with a specular lobe is 1 dB or more worse on the test views than the same rock without.",
              paired("psnr", _fit(FEW, 0), _fit(FEW, 0, "diffuse")), "dB", "below", -1.0, "rock and set of views"),
        Claim("Its error exceeds that of the diffuse rock by more in views towards the sun than in views away from it.",
              towards_the_sun, "linear RGB", "above", 0.0, "rock and set of views"),
        Claim("On 32 views of the specular rock, the best of the SH degrees 1 to 3 gains 0.3 dB or more.",
              best_of_degrees(FRAMES), "dB", "above", 0.3, "rock"),
        Claim("On 12 views of it, none of them gains anything.",
              best_of_degrees(FEW), "dB", "below", 0.0, "rock and set of views"),
        Claim("On the specular rock, D-optimal is not behind random views at 8 images.",
              _ahead("d-optimal", "random"), "dB", "above", 0.0, "rock and set of seeds"),
        Claim("On the specular rock, directional I-optimality is not behind views spread evenly in azimuth.",
              _ahead("directional-i", "uniform"), "dB", "above", 0.0, "rock and set of seeds"),
    ),
    (
        Panel("degree", "psnr", "SH degree, specular rock", "PSNR of views (dB)", "fitted", only=(("material", SHINY),)),
        Panel("angle of sun", "rms", "from sun to camera (degrees)", "rms error of views not fitted (linear RGB)", "material"),
        Panel("material", "psnr", "rock", "PSNR on test views (dB)", "policy"),
    ),
    data=_data,
)  # fmt: skip
