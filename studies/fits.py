"""What each setting of a fit is worth, and what wrong poses cost: one setting changed at a time.

Fits to even views of rocks that chose nothing, judged on the test views and on a spiral at other
distances. The last rows have poses with noise, as given and refined (`mgs fit --refine-poses`).
"""

from argparse import Namespace
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

import mgs
from mgs.fit.poses import displaced
from mgs.fit.settings import MEAN_RATE, PoseNoise
from mgs.learning import refine_poses
from mgs.policy.criteria import PRIOR_STD
from mgs.policy.poses import medoids
from mgs.seeds import generator
from studies import setups
from studies.frame.case import ROCKS
from studies.frame.output import Panel, draw_panels, grouped, scene_mean, table, write_table
from studies.frame.program import WORKERS, Options, Study, Work, study_of
from studies.frame.statistics import Row
from studies.frame.sweep import Cell
from studies.setups import SETUPS, SetupSize, case_of, shared_scene, spiral_of, views_of

DEFAULT = "default"

POOLS = {"hemisphere": (12, 4), "mixed distances": (12,)}
"""Set-ups, and how many even views are fitted."""

DEGREES, METRES = 0.25, 0.0025
"""Noise of a pose: of the turn about each axis of the camera, and of the position along it."""


@dataclass(frozen=True)
class Variant:
    """Changed settings: of the model (`ModelSettings`), of its fit, of the prior; and the poses."""

    train: Mapping[str, Any] = field(default_factory=dict)
    model: Mapping[str, Any] = field(default_factory=dict)
    prior: Mapping[str, Any] = field(default_factory=dict)
    poses: Literal["exact", "noisy"] = "exact"
    refined: bool = False


def wider(factor: float) -> dict[str, float]:
    """Standard deviations of the prior, but for colours and opacities."""
    return {kind: PRIOR_STD[kind] * factor for kind in ("scale", "rotation")}


VARIANTS = {
    DEFAULT: Variant(),
    "3DGS's Gaussians below a pixel: antialiased=false": Variant({"antialiased": False}),
    "blended as light: space=linear": Variant({"space": "linear"}),
    "colours alone: alpha_weight=0": Variant({"alpha_weight": 0.0}),
    "no second layer: prior --backing 0": Variant(prior={"backing": 0.0}),
    "optimiser=adam": Variant({"optimiser": "adam"}),
    "passes=5": Variant({"passes": 5}),
    "passes=20": Variant({"passes": 20}),
    "passes=40, tolerance=0": Variant({"passes": 40, "tolerance": 0.0}),
    "loss=squared": Variant({"loss": "squared"}),
    "scale and rotation four times as free": Variant(model={"prior_std": wider(4)}),
    "pixel_noise=0.04": Variant(model={"pixel_noise": 0.04}),
    "--sh 1": Variant(model={"sh": 1}),
    "means=free": Variant({"means": "free"}),
    "poses refined": Variant(refined=True),
    "poses wrong": Variant(poses="noisy"),
    "poses wrong, refined": Variant(poses="noisy", refined=True),
}
"""Variants by their names in the table."""


VARIANT: Options = {
    "--variant": {
        "action": "append",
        "choices": list(VARIANTS),
        "metavar": "NAME",
        "help": "Only this variant beside the default; repeatable.",
    }
}


@dataclass(frozen=True)
class FitsSize(SetupSize):
    """Size of the study. variants: beside the default; without any, all."""

    variants: tuple[str, ...] = ()


SIZES = {name: FitsSize(**vars(size)) for name, size in setups.SIZES.items()}


def cells_of(size: FitsSize) -> list[Cell]:
    """Cells of the variants on every rock, with datasets and priors."""
    variants = {n: v for n, v in VARIANTS.items() if n in (DEFAULT, *(size.variants or VARIANTS))}
    cells: list[Cell] = []
    for rock in size.rocks:
        spiral = spiral_of(rock, size)
        for pool, counts in POOLS.items():
            for name, variant in variants.items():
                plain = case_of(rock, SETUPS[pool], size)
                case = replace(plain, settings={**plain.settings, **variant.prior})
                for count in counts:
                    label = name.replace(" ", "-").replace("=", "-").replace(":", "")
                    cells += case.with_task(
                        f"fit/{rock.name}/{pool.replace(' ', '-')}-{count}/{label}",
                        f"{__name__}:fit_and_judge",
                        about={"pool": f"{pool}, {count}", "variant": name},
                        made=[*case.cells(), *spiral.cells()[:1]],
                        spiral=spiral.dataset,
                        variant=name,
                        views=count,
                    )
    return cells


def fit_and_judge(
    root: Path, out: Path, dataset: str, prior: str, spiral: str, variant: str, views: int
) -> dict[str, float]:
    """Task: fit to even views with a variant of VARIANTS; PSNR of the model, dB."""
    whole, tests, _ = shared_scene(root / dataset, root / prior, None)
    change, settings = VARIANTS[variant], whole.settings
    train = dict(change.train)
    model = dict(change.model)
    if train.get("means") == "free":
        spacing = whole.prior.spacing
        train["rates"] = settings.train.rates | {"mean": MEAN_RATE * spacing}
        model["prior_std"] = settings.prior_std | {"mean": spacing / 2}
    elif "prior_std" in model:
        model["prior_std"] = settings.prior_std | model["prior_std"]
    settings = settings.model_copy(
        update={**model, "train": settings.train.model_copy(update=train)}
    )
    positions = whole.positions(whole.frames)
    frames = tuple(whole.frames[i] for i in medoids(positions, whole.centre, views))
    if change.poses == "noisy":
        rng, std = generator(0, f"poses/{dataset}"), [np.radians(DEGREES)] * 3 + [METRES] * 3
        frames = tuple(replace(f, camera=displaced(f.camera, rng.normal(0, std))) for f in frames)
    scene = mgs.Scene(replace(whole.dataset, frames=frames), whole.prior, settings)
    if change.refined:
        frames = refine_poses(scene, PoseNoise())
    fitted = scene.fitted(scene.start(frames), frames).gaussians
    on_tests, on_spiral = tests(fitted), views_of(root / spiral)(fitted)
    return {
        "test": float(on_tests["psnr"].mean()),
        "test_mask": float(on_tests["psnr_mask"].mean()),
        "spiral": float(on_spiral["psnr"].mean()),
    }


def rows_of(work: Work) -> list[Row]:
    """A row for each rock, pool and variant: PSNR, and KEY_change from the default's."""
    rows = work.rows()
    usual = {(row["rock"], row["pool"]): row for row in rows if row["variant"] == DEFAULT}
    for row in rows:
        before = usual[row["rock"], row["pool"]]
        row |= {f"{key}_change": row[key] - before[key] for key in ("test", "test_mask", "spiral")}
    return rows


def tables(rows: Sequence[Row]) -> str:
    """Table of the changes, means over scenes with 95 % intervals; of the default its PSNR."""
    pools = list(dict.fromkeys(row["pool"] for row in rows))
    columns: dict[str, Any] = {"changed": "variant"}
    columns |= {pool: scene_mean("test_change", "+.2f", pool=pool) for pool in pools}
    inside = scene_mean("test_mask_change", "+.2f", pool=pools[0])
    columns |= {f"{pools[0]}, in the mask": inside}
    usual, *changed = grouped(rows, "variant")
    first = {"default (dB)": "variant"} | {
        pool: scene_mean("test", ".2f", ends=False, pool=pool) for pool in pools
    }
    return "\n".join([table(first, [usual]), table(columns, changed)])


def write(work: Work) -> list[Path]:
    """Write fits.csv, fits.json, fits.md and fits.png."""
    rows = rows_of(work)
    y_label = "change of PSNR on test views (dB)"
    changed = [row for row in rows if row["variant"] != DEFAULT]
    path = work.out / "fits.png"
    draw_panels(path, [Panel("variant", "test_change", "", y_label, "pool")], changed)
    return [*write_table(work, "fits", rows, tables(rows)), path]


def sized(size: FitsSize, options: Namespace) -> Any:
    changed: Any = setups.sized(size, options)
    return replace(changed, variants=tuple(options.variant or ()))


STUDY = Study("fits", __doc__, write, SIZES, cells_of, ROCKS | VARIANT | WORKERS, sized)

if __name__ == "__main__":
    study_of("fits")()
