"""What changes the choice of a view although the rock stays the same: lambda, prior widths, units,
resolution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mgs.camera import Camera
from mgs.gaussians import Gaussians
from mgs.metrics import agreement
from mgs.policy.criteria import d_optimal
from mgs.splat import fisher, groups
from mgs.study.stress.experiment import Experiment, Panel, cells_per_rock, turns
from mgs.study.stress.lab import Array, open_lab
from mgs.study.stress.verdict import Claim, Row, runs_of, single

EXPONENTS = tuple(range(-10, 3))
"""Of the one lambda for all parameters, powers of ten."""

FACTORS = (1 / 16, 1 / 4, 4.0, 16.0)
"""On the prior standard deviation of the parameters."""

NARROW = (1 / 4, 4.0)
"""Those of FACTORS within which a person may well be wrong about it."""

SIZES = (0.25, 0.5, 2.0)
"""Sides of the image that a candidate is scored at, over those of the dataset."""

ONE_LAMBDA = 1e-6
"""The lambda of POp-GS, where one serves all parameters."""


def resized(camera: Camera, factor: float) -> Camera:
    """The same camera with an image of another size."""
    K = camera.K.copy()
    K[:2] *= factor
    return Camera(
        K,
        max(1, round(camera.width * factor)),
        max(1, round(camera.height * factor)),
        camera.world_to_camera,
    )


def in_millimetres(model: Gaussians, camera: Camera) -> tuple[Gaussians, Camera]:
    """A model and a camera of the same world with lengths in millimetres."""
    pose = camera.world_to_camera.copy()
    pose[:3, 3] *= 1000
    scaled = replace(
        model,
        means=(1000 * model.means).astype(np.float32),
        log_scales=(model.log_scales + np.log(1000)).astype(np.float32),
    )
    return scaled, replace(camera, world_to_camera=pose)


def scales(root: Path, out: Path, scene: str, turns_: int) -> dict[str, Any]:
    """The ranking of candidates from four even views under each change, against that of the default
    settings."""
    lab, rows = open_lab(root, scene), []
    for suffix, turn in turns(turns_):
        taken = lab.even(4, turn)
        left, model = lab.left(taken), lab.fit(taken).gaussians
        H, Fs, lam = (
            np.sum(lab.information(model, taken), axis=0),
            lab.information(model, left),
            lab.lam(),
        )
        base = np.array([d_optimal(F, H, lam) for F in Fs])
        run = f"{scene}, {suffix}"

        def add(
            what: str, setting: float | str, scores: Array, against: Array = base, run: str = run
        ) -> None:
            rows.append(
                {"run": run, "what": what, "setting": setting, **agreement(scores, against)}
            )

        def scored(lam: Array, factor: float = 1.0, H: Array = H, Fs: list[Array] = Fs) -> Array:
            return np.array([d_optimal(factor * F, factor * H, lam) for F in Fs])

        for exponent in EXPONENTS:
            add("one lambda", 10.0**exponent, scored(np.full_like(lam, 10.0**exponent)))
        for factor in FACTORS:
            add("prior std", factor, scored(lam / factor**2))
            for kind, columns in groups(0).items():
                changed = lam.copy()
                changed[columns] /= factor**2
                add(f"prior std of {kind}", factor, scored(changed))
        add("range 0 to 255", "range 0 to 255", scored(lam, 255.0**2))
        for size in SIZES:
            cameras = [resized(camera, size) for camera in lab.cameras]
            add("image size", size, _scored(model, cameras, taken, left, lam))
        cameras = [in_millimetres(model, camera)[1] for camera in lab.cameras]
        scaled = in_millimetres(model, lab.cameras[0])[0]
        add("millimetres", "frozen means", _scored(scaled, cameras, taken, left, lam))
        one = np.full_like(lab.lam("free"), ONE_LAMBDA)
        metres = _scored(model, lab.cameras, taken, left, one, "free")
        add(
            "millimetres",
            "free means, one lambda",
            _scored(scaled, cameras, taken, left, one, "free"),
            metres,
        )
        default = lab.lam("free")
        millimetres = default.copy()
        millimetres[groups(0, "free")["mean"]] /= (
            1000**2
        )  # tau is a share of the spacing, so it is in millimetres too
        metres = _scored(model, lab.cameras, taken, left, default, "free")
        add(
            "millimetres",
            "free means",
            _scored(scaled, cameras, taken, left, millimetres, "free"),
            metres,
        )
    return {"rows": rows}


def _scored(
    model: Gaussians,
    cameras: Sequence[Camera],
    taken: Sequence[int],
    left: Sequence[int],
    lam: Array,
    means: str = "frozen",
) -> Array:
    """Eq. 7 of the views left, from cameras that are not those of the dataset."""
    H = np.sum([fisher(model, cameras[i], means=means).astype(np.float64) for i in taken], axis=0)
    return np.array([d_optimal(fisher(model, cameras[i], means=means), H, lam) for i in left])


def _worst_regret(what: str, settings: Sequence[float]) -> Any:
    def effects(rows: Sequence[Row]) -> list[float]:
        of = [row for row in rows if row["what"] == what and row["setting"] in settings]
        return [
            max(row["regret"] for row in of if row["run"] == run)
            for run in runs_of(of, {"what": what})
        ]

    return effects


SCALES = Experiment(
    "Which scales change the choice of a view?",
    cells_per_rock("scales", f"{__name__}:scales", lambda preset: {"turns_": preset.turns}),
    (
        Claim("With one lambda for all parameters, its value from 1e-10 to 100 does not matter: the worst of the views chosen "
              "costs at most 2 % of the information gain (default lambda).",
              _worst_regret("one lambda", [10.0**e for e in EXPONENTS]), "share", "below", 0.02, "rock and set of views"),
        Claim("Prior standard deviations that are four times too large or too small cost at most 2 % of the information gain.",
              _worst_regret("prior std", NARROW), "share", "below", 0.02, "rock and set of views"),
        Claim("Images of range 0 to 255, with lambda as for range 0 to 1, cost at most 2 % of the information gain.",
              single("regret", {"what": "range 0 to 255"}), "share", "below", 0.02, "rock and set of views"),
        Claim("With frozen means, metres or millimetres give the same ranking: Kendall's tau is at least 0.99.",
              single("tau", {"what": "millimetres", "setting": "frozen means"}), "tau", "above", 0.99,
              "rock and set of views"),
        Claim("With free means and tau as a share of the spacing (default), they give the same ranking too.",
              single("tau", {"what": "millimetres", "setting": "free means"}), "tau", "above", 0.99,
              "rock and set of views"),
        Claim("With free means and one lambda, the unit of length changes the ranking: Kendall's tau is at most 0.9.",
              single("tau", {"what": "millimetres", "setting": "free means, one lambda"}), "tau", "below",
              0.9, "rock and set of views"),
        Claim("Scored at half the image size, the views chosen cost at most 2 % of the information gain.",
              single("regret", {"what": "image size", "setting": 0.5}), "share", "below", 0.02,
              "rock and set of views"),
    ),
    (
        Panel("setting", "tau", "one lambda for all", "Kendall's tau with default", None, True, (("what", "one lambda"),)),
        Panel("setting", "tau", "prior std, times", "Kendall's tau with default", None, True, (("what", "prior std"),)),
        Panel("setting", "tau", "image size, times", "Kendall's tau with full size", None, True, (("what", "image size"),)),
        Panel("setting", "tau", "lengths in millimetres", "Kendall's tau with metres", None, False,
              (("what", "millimetres"),)),
    ),
)  # fmt: skip
