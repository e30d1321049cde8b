"""Extreme numbers: they must not end the program, and what comes out must be finite."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from mgs.camera import Camera
from mgs.errors import InputError
from mgs.fit.fitting import fit
from mgs.fit.settings import TrainSettings
from mgs.gaussians import Gaussians
from mgs.policy.criteria import d_optimal
from mgs.splat import fisher, render
from mgs.study.stress.experiment import Experiment, Panel, rock_cell
from mgs.study.stress.lab import Lab, Preset, open_lab
from mgs.study.stress.scales import resized
from mgs.study.stress.verdict import Claim
from mgs.study.sweep import Cell

Case = Callable[[Gaussians, Camera, int], tuple[Gaussians, Camera, float | None]]
"""(model, camera, largest number of Gaussians) -> model, camera, and a colour that the whole image
has, None: as rendered."""


def _scaled(model: Gaussians, change: tuple[float, float, float]) -> Gaussians:
    return replace(model, log_scales=(model.log_scales + np.log(change)).astype(np.float32))


def _repeated(model: Gaussians, count: int) -> Gaussians:
    """Copies of a model until there are so many Gaussians; each copy a little beside the last."""
    pick = np.arange(count) % len(model)
    aside = 1e-3 * (np.arange(count) // len(model))[:, None]
    taken = Gaussians(*(np.ascontiguousarray(getattr(model, f.name)[pick]) for f in fields(model)))
    return replace(taken, means=(taken.means + aside).astype(np.float32))


def _everywhere(model: Gaussians, logit: float) -> Gaussians:
    return replace(model, logit_opacities=np.full(len(model), logit, np.float32))


CASES: dict[str, Case] = {
    "anisotropy 1:1000": lambda m, c, n: (_scaled(m, (10.0, 1.0, 0.1)), c, None),
    "anisotropy 1:1,000,000": lambda m, c, n: (_scaled(m, (100.0, 1.0, 0.001)), c, None),
    "opacities saturated at 1": lambda m, c, n: (_everywhere(m, 40.0), c, None),
    "opacities saturated at 0": lambda m, c, n: (_everywhere(m, -40.0), c, None),
    "all Gaussians at one place": lambda m, c, n: (
        replace(m, means=np.tile(m.means[:1], (len(m), 1))),
        c,
        None,
    ),
    "image of one colour": lambda m, c, n: (m, c, 0.3),
    "image all black": lambda m, c, n: (m, c, 0.0),
    "image a thousand times too bright": lambda m, c, n: (m, c, 1000.0),
    "1 Gaussian": lambda m, c, n: (m[:1], c, None),
    "many Gaussians": lambda m, c, n: (_repeated(m, n), c, None),
    "image of 1 pixel": lambda m, c, n: (m, resized(c, 1e-6), None),
    "image of 3840x2880": lambda m, c, n: (m, resized(c, 3840 / c.width), None),
    "rock behind the camera": lambda m, c, n: (
        m,
        replace(c, world_to_camera=_turned_round(c.world_to_camera)),
        None,
    ),
}
"""By name. They are fitted for two passes to one image, rendered before and after, and their
information is measured."""


def _turned_round(pose: np.ndarray) -> np.ndarray:
    return np.diag([-1.0, 1.0, -1.0, 1.0]) @ pose


def numbers(root: Path, out: Path, scene: str, most: int) -> dict[str, Any]:
    """Each case, and a view that is offered a second time."""
    lab = open_lab(root, scene)
    taken = lab.even(4)
    model = lab.fit(taken).gaussians
    rows = [
        {"run": name, "what": "case", **_tried(case(model, lab.cameras[0], most))}
        for name, case in CASES.items()
    ]
    return {"rows": rows + [_offered_twice(lab, model, view) for view in lab.left(taken)]}


def _tried(case: tuple[Gaussians, Camera, float | None]) -> dict[str, Any]:
    """Whether all that the program computes of a case is finite, and whether it refused it in one
    clear line."""
    model, camera, colour = case
    try:
        image = render(model, camera)
        rgb = np.asarray(image.rgb)
        target = rgb * 0.5 + 0.1 if colour is None else np.full_like(rgb, colour)
        fitted = fit(model, [camera], [target], TrainSettings(passes=2)).gaussians
        found = [
            rgb,
            np.asarray(image.alpha),
            np.asarray(image.depth),
            np.asarray(render(fitted, camera).rgb),
        ]
        found += [fisher(one, camera) for one in (model, fitted)]
        finite = all(np.isfinite(array).all() for array in found) and bool((found[-1] >= 0).all())
    except InputError as error:
        return {"finite": 0.0, "refused": str(error)}
    return {"finite": float(finite), "refused": ""}


def _offered_twice(lab: Lab, model: Gaussians, view: int) -> dict[str, Any]:
    """What a view gains when it is taken for the second time, over the first; no other view has
    been taken."""
    F, lam = lab.information(model, [view])[0], lab.lam()
    first, second = d_optimal(F, np.zeros_like(F), lam), d_optimal(F, F, lam)
    return {"run": lab.frames[view].name, "what": "twice", "ratio": second / first}


def _cells(preset: Preset) -> list[Cell]:
    most = 100_000 if preset.gaussians < 10_000 else 1_000_000
    return [rock_cell("numbers", f"{__name__}:numbers", preset, *preset.rocks[0], most=most)]


NUMBERS = Experiment(
    "Do extreme numbers end the program, or give numbers that are not finite?",
    _cells,
    (
        Claim("Every extreme case is rendered, fitted and measured, and all that comes out is finite.",
              lambda rows: [row["finite"] for row in rows if row["what"] == "case"], "share", "above", 1.0, "case"),
        Claim("A view that is offered a second time gains at most a fifth of what it gained at first.",
              lambda rows: [row["ratio"] for row in rows if row["what"] == "twice"], "ratio", "below", 0.2, "view"),
    ),
    (
        Panel("run", "finite", "case", "finite (1: yes)", None, False, (("what", "case"),)),
        Panel("run", "ratio", "view", "second gain over first", None, False, (("what", "twice"),)),
    ),
)  # fmt: skip
