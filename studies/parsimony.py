"""How much model a scene needs.

Quality against the number of Gaussians, the kinds of parameters that are learned, and the SH
degree, beside the automatic choices: the number of `mgs prior`, kinds and degree of `mgs simplify
--method refit`, and its pruning. A fit sees VIEWS even views of a hemisphere, with the default
settings of `mgs nbv`, and is judged inside the rock.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import mgs
from mgs.fit.evidence import lean_fit
from mgs.fit.pruning import prune
from mgs.learning import images_of
from mgs.policy.criteria import PIXEL_NOISE
from mgs.splat import groups
from studies.frame.case import ROCKS, judge
from studies.frame.output import Panel, draw_panels, grouped, scene_mean, table, write_table
from studies.frame.program import WORKERS, Study, Work, study_of
from studies.frame.statistics import Row
from studies.frame.sweep import Cell
from studies.setups import SETUPS, SIZES, SetupSize, case_of, sized

VIEWS = 8
"""Images that are fitted."""

COUNTS = (2500, 5000, 10_000, 20_000, 40_000)
"""Fixed numbers of Gaussians."""

LEARNED = {
    "colour": ("colour",),
    "+ opacity": ("colour", "opacity"),
    "+ scale": ("colour", "opacity", "scale"),
    "+ rotation": ("colour", "opacity", "scale", "rotation"),
}
"""Kinds of parameters that are learned, by what each set adds to the one before."""

ALL = "+ rotation"

DEGREES = (1, 2)
"""Degrees of the SH beside 0."""

PRUNE_NOISE = (0.1, 0.2, 0.5)
"""Allowed change by pruning, over the noise of a pixel."""

LOSSES = (0.05, 1.0, 2.0)
"""Other values of `mgs simplify --loss`, with colours of degree 0, dB."""

NUMBER, KINDS, DEGREE, LOSS = "number of Gaussians", "kinds learned", "SH degree", "refit's loss"
DEFAULT, REFIT, PRUNED = "default", "refit", "pruned"
"""Values of the column `choice`: what differs from the default, the refitted model, the pruned."""


def cells_of(size: SetupSize) -> list[Cell]:
    """Cells of each rock: dataset, priors, fits, and the refit."""
    cells: list[Cell] = []
    for rock in size.rocks:
        case = case_of(rock, SETUPS["hemisphere"], size)
        choices = [(NUMBER, n, ALL, 0) for n in COUNTS] + [(DEFAULT, None, ALL, 0)]
        choices += [(KINDS, None, learned, 0) for learned in LEARNED if learned != ALL]
        choices += [(DEGREE, None, ALL, degree) for degree in DEGREES]
        for choice, number, learned, degree in choices:
            settings = case.settings if number is None else {"gaussians": number, "seed": 0}
            more: dict[str, Any] = {"learned": list(LEARNED[learned]), "degree": degree}
            more["pruned"] = choice == DEFAULT
            name = f"fit/{rock.name}/{number or 'auto'}-{'-'.join(LEARNED[learned])}-{degree}"
            about = {"choice": choice, "asked": number or 0, "learned": learned, "degree": degree}
            task = f"{__name__}:fit_and_judge"
            cells += replace(case, settings=settings).with_task(name, task, about=about, **more)
        task, about = f"{__name__}:refit_and_judge", {"choice": REFIT}
        cells += case.with_task(f"refit/{rock.name}", task, about=about)
    return cells


def scene_of(root: Path, dataset: str, prior: str) -> mgs.Scene:
    """Scene with the default settings of a run."""
    return mgs.Scene(mgs.load_dataset(root / dataset), mgs.load_prior(root / prior))


def quality(model: mgs.Gaussians, dataset: mgs.Dataset, parameters: int) -> Row:
    """PSNR on the test views, dB (of the whole frame, and of pixels that the rock covers wholly),
    and the size of the model."""
    metrics = judge(model, dataset)
    numbers = {key: metrics[key] for key in ("psnr", "psnr_inside")}
    return {"gaussians": len(model), "parameters": parameters} | numbers


def fit_and_judge(
    root: Path,
    out: Path,
    dataset: str,
    prior: str,
    learned: Sequence[str],
    degree: int,
    pruned: bool,
) -> dict[str, list[Row]]:
    """Task: the row of a fit in which some kinds of parameters are learned. pruned: also of the
    model without the Gaussians that change the images by less than each of PRUNE_NOISE."""
    usual = scene_of(root, dataset, prior)
    train = usual.settings.train
    rates = {kind: rate if kind in learned else 0.0 for kind, rate in train.rates.items()}
    changes = {"sh": degree, "train": train.model_copy(update={"rates": rates})}
    scene = replace(usual, settings=usual.settings.model_copy(update=changes))
    state = mgs.learn(scene, scene.seeds(VIEWS))
    model, kinds = state.gaussians, groups(degree)
    each = sum(kinds[kind].stop - kinds[kind].start for kind in learned)
    rows = [quality(model, scene.dataset, each * len(model))]
    cameras = [state.frames[i].camera for i in state.taken]
    for noise in PRUNE_NOISE if pruned else ():
        left = model[prune(model, cameras, noise * PIXEL_NOISE).kept]
        row = quality(left, scene.dataset, each * len(left))
        rows.append(row | {"choice": PRUNED, "noise": noise, "left": len(left) / len(model)})
    return {"rows": rows}


def refit_and_judge(root: Path, out: Path, dataset: str, prior: str) -> dict[str, list[Row]]:
    """Task: rows of `mgs simplify --method refit` on the same views, by default and with LOSSES."""
    scene = scene_of(root, dataset, prior)
    frames = [scene.frames[i] for i in scene.seeds(VIEWS)]
    images = images_of(scene, frames)
    lean = lean_fit(images, scene.settings)
    row = quality(lean.gaussians, scene.dataset, lean.parameters)
    row |= {"degree": lean.gaussians.sh_degree}
    if lean.left_out:
        row |= {"left_out": lean.left_out.gain, "left_out_error": lean.left_out.error}
    rows = [row]
    for loss in LOSSES:
        other = lean_fit(images, scene.settings, sh="0", loss=loss)
        row = quality(other.gaussians, scene.dataset, other.parameters)
        rows.append(row | {"choice": LOSS, "loss": loss, "degree": 0})
    return {"rows": rows}


def rows_of(work: Work) -> list[Row]:
    """Rows with the PSNR over that of the default, and the share of its parameters."""
    rows = work.rows()
    default = {row["rock"]: row for row in rows if row["choice"] == DEFAULT}
    for row in rows:
        usual = default[row["rock"]]
        row |= {f"{key}_over": row[key] - usual[key] for key in ("psnr", "psnr_inside")}
        row["share"] = row["parameters"] / usual["parameters"]
    return rows


def name_of(row: Row) -> str:
    words: dict[str, str] = {
        NUMBER: f"{row.get('asked') or 0:,} Gaussians",
        KINDS: f"learns {(row.get('learned') or '').replace('+', 'up to')}",
        DEGREE: f"SH degree {row['degree']}",
        PRUNED: f"pruned, {row.get('noise') or 0:g} sigma",
        REFIT: "`refit`",
        LOSS: f"`refit --loss {row.get('loss') or 0:g} --sh 0`",
        DEFAULT: "default",
    }
    return words[row["choice"]]


def tables(rows: Sequence[Row]) -> str:
    """Tables of all choices, means over scenes, and of the automatic number and the refit of each
    rock."""
    columns: dict[str, Any] = {"model": "name"}
    columns |= {"inside the rock (dB)": scene_mean("psnr_inside", ".2f", ends=False)}
    columns |= {"over the default": scene_mean("psnr_inside_over", "+.2f")}
    columns |= {"whole frame": scene_mean("psnr_over", "+.2f")}
    columns |= {"parameters": scene_mean("share", ".0%", ends=False)}
    text = table(columns, grouped([row | {"name": name_of(row)} for row in rows], "name"))

    def of(group: Row, key: str, choice: str, **only: Any) -> Any:
        some = {"choice": choice, **only}
        return next(row[key] for row in group["of"] if some.items() <= row.items())

    columns = {"rock": "scene", "automatic number": lambda g: f"{of(g, 'gaussians', DEFAULT):,}"}
    for n in COUNTS[2:]:
        columns[f"{n:,}"] = lambda g, n=n: f"{of(g, 'psnr_inside_over', NUMBER, asked=n):+.2f}"
    columns |= {"`refit`": lambda g: f"{of(g, 'psnr_inside_over', REFIT):+.2f}"}
    columns |= {"its parameters": lambda g: f"{of(g, 'share', REFIT):.0%}"}
    columns |= {"its SH degree": lambda g: str(of(g, "degree", REFIT))}
    return f"{text}\n{table(columns, grouped(rows, 'scene'))}"


def write(work: Work) -> list[Path]:
    """Write parsimony.csv, .json, .md and .png."""
    rows, path = rows_of(work), work.out / "parsimony.png"
    draw(path, rows)
    return [*write_table(work, "parsimony", rows, tables(rows)), path]


def draw(path: Path, rows: Sequence[Row]) -> None:
    """Draw PSNR against the number of parameters, both over those of the default, means of
    rocks."""
    lines = (NUMBER, KINDS, PRUNED, LOSS)
    shown: list[Row] = []
    for group in grouped([row | {"name": name_of(row)} for row in rows], "name"):
        choice = group["of"][0]["choice"]
        percent = {"percent": 100 * float(np.mean([row["share"] for row in group["of"]]))}
        names = lines if choice == DEFAULT else (choice,) if choice in (*lines, REFIT) else ()
        shown += [row | percent | {"choice": name} for name in names for row in group["of"]]
    labels = "learned parameters (%)", "PSNR inside the rock over the default (dB)"
    panel = Panel("percent", "psnr_inside_over", *labels, "choice", True)
    draw_panels(path, [panel], shown)


STUDY = Study("parsimony", __doc__, write, SIZES, cells_of, ROCKS | WORKERS, sized)

if __name__ == "__main__":
    study_of("parsimony")()
