"""Policies on NeRF-synthetic scenes by FisherRF's protocol, beside published numbers.

View 0 and those farthest from it are the seeds, the other training views are the candidates, the
200 test views judge, in front of white. Models start at random points in the ball that all cameras
see, inside the masks of the views taken: no picture or mask of a candidate is read. Every policy
chooses one view at a time. A new fit to all views taken is judged.
"""

import time
from argparse import Namespace
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

import mgs
from mgs.colour import srgb_from_linear
from mgs.data.importers import import_source
from mgs.data.sources import read_source
from mgs.fit.settings import TrainSettings
from mgs.learning import fit_views
from mgs.metrics import psnr
from mgs.policy.poses import spread
from mgs.run.nbv import LOOSE
from mgs.run.policy_file import policy_of
from mgs.run.settings import NbvSettings, validated
from mgs.splat import render
from studies import policies as others
from studies.frame.case import test_views_of
from studies.frame.output import (
    Content,
    Panel,
    draw_panels,
    grouped,
    table,
    with_interval,
    write_table,
)
from studies.frame.program import Study, Work, at_least, study_of
from studies.frame.statistics import Row, interval
from studies.frame.sweep import CELLS, Cell
from studies.setups import before_any_fit, choose_views

NAME = "blender"

RANDOM = "random"

ALPHA_WEIGHT = 1.0
"""Weight of alpha in fits. In front of white, an error of alpha counts as much as one of colour."""

ONCE = ("popgs-block",)
"""Policies that are run with the first draw alone, since they take minutes."""

OURS = (RANDOM, "farthest", "directional-i", "directional-d", "cover", "uniform", "d-optimal")
"""Policies of mgs by their names."""

COMPARED: dict[str, Any] = {
    "paper, no means": others.paper_still,
    "fisherrf, code": others.fisherrf_code,
    "fisherrf, paper": others.fisherrf_paper,
    "popgs-t": others.popgs_t,
    "popgs-d": others.popgs_d,
    "popgs-block": others.popgs_block,
    "cover, nbv_gym": others.cover_gym,
    "gavis-like": others.gavis_like,
}
"""Published policies by label."""

PUBLISHED: tuple[Row, ...] = (
    {"policy": "uniform (POp-GS)", "psnr": 23.32},
    {"policy": "FisherRF (POp-GS)", "psnr": 24.59},
    {"policy": "POp-GS T", "psnr": 25.40},
    {"policy": "POp-GS D", "psnr": 25.52},
    {"policy": "FisherRF (AGILE-GS)", "seconds": 28.0},
    {"policy": "COVER (AGILE-GS)", "seconds": 9.33},
    {"policy": "AGILE-GS", "seconds": 0.074},
)
"""Means over the eight scenes at 800x800 with 10 views, fits of 3DGS with 30,000 steps; seconds a
choice on an RTX A2000."""


@dataclass(frozen=True)
class BlenderSize:
    """Sizes of images and models, and numbers of runs.

    downscale: of the 800x800 images. gaussians: of every model. views: numbers of views at the
    start and at the end. passes: of the fit that is judged, twice the default. loss: of all fits.
    draws: seeds of the random start. scenes: folders with transforms_train.json and
    transforms_test.json, set by the options.
    """

    downscale: int = 4
    gaussians: int = 10_000
    views: tuple[tuple[int, int], ...] = ((2, 10),)
    passes: int = 20
    loss: str = TrainSettings().loss
    draws: int = 3
    policies: tuple[str, ...] = (*OURS, *COMPARED)
    scenes: tuple[Path, ...] = ()


SIZES = {
    "quick": BlenderSize(),
    "full": BlenderSize(1, 100_000, ((2, 10), (4, 20)), draws=10),
}


def sized(size: BlenderSize, options: Namespace) -> BlenderSize:
    """Size with the options. Raises InputError where --dir has no scene, or a policy is unknown."""
    root = options.dir.resolve()
    scenes = [path.parent for path in root.glob("*/transforms_train.json")]
    scenes = [path for path in scenes if (path / "transforms_test.json").is_file()]
    if not scenes:
        raise mgs.InputError(
            f"--dir {options.dir}: has no scene, a folder with transforms_train.json and "
            "transforms_test.json; give the folder that holds lego, mic and the others"
        )
    for policy in options.policy or ():
        if policy not in size.policies:
            known = "; ".join(size.policies)
            raise mgs.InputError(f"--policy {policy}: is not compared; choose of {known}")
    changes = {key: getattr(options, key) for key in ("downscale", "gaussians", "draws", "loss")}
    changes |= {"policies": tuple(options.policy or ())}
    given = {key: value for key, value in changes.items() if value}
    return replace(size, scenes=tuple(sorted(scenes)), **given)


def cells_of(size: BlenderSize) -> list[Cell]:
    """Cells that import the scenes, then those of every draw, scene and policy."""
    data = {
        scene: Cell(
            f"dataset/{scene.name}-{size.downscale}",
            f"{__name__}:make_dataset",
            {"source": str(scene), "downscale": size.downscale},
        )
        for scene in size.scenes
    }
    cells = list(data.values())
    for draw in range(size.draws):
        for (first, last), policy, scene in product(size.views, size.policies, size.scenes):
            if draw > 0 and policy in ONCE:
                continue
            how = {"first": first, "last": last, "policy": policy, "seed": draw}
            how |= {key: getattr(size, key) for key in ("gaussians", "passes", "loss")}
            made = data[scene]
            label = policy.replace(", ", "-").replace(" ", "-")
            where = f"{scene.name}-{size.downscale}/{size.gaussians}/{first}-{last}"
            cells.append(
                Cell(
                    f"run/{where}/{label}-{draw}",
                    f"{__name__}:choose_and_judge",
                    {"dataset": f"{CELLS}/{made.name}/dataset"} | how,
                    (made.name,),
                    alone=True,
                    about={"scene": scene.name, "views": last, "policy": policy, "draw": draw},
                )
            )
    return cells


def make_dataset(root: Path, out: Path, source: str, downscale: int) -> dict[str, Any]:
    """Task: import the training views of a scene, and its test split as test views."""
    shots, tests = read_source(Path(source), test_split="test").set_apart(None)
    data = import_source(shots, out / "dataset", tests=tests, downscale=downscale)
    camera = data.frames[0].camera
    return {"frames": len(data), "width": camera.width, "height": camera.height}


def choose_and_judge(
    root: Path,
    out: Path,
    dataset: str,
    first: int,
    last: int,
    policy: str,
    seed: int,
    gaussians: int,
    passes: int,
    loss: str,
) -> dict[str, Any]:
    """Task: choose views until there are `last`, fit all of them from the start, and judge.

    Returns "psnr" (dB, mean over the test views), "taken", and CPU seconds: "choice" (mean of a
    score of all candidates, with what it needs beside the fit), "fits" (between choices, together)
    and "fit" (of the model that is judged).
    """
    data, tests = loaded(root / dataset)

    def start_from(views: Sequence[int]) -> mgs.Scene:
        shown = [data.frames[i] for i in views]
        prior = mgs.build_prior(data, gaussians=gaussians, seed=seed, source="random", shown=shown)
        train = {"means": "free", "alpha_weight": ALPHA_WEIGHT, "loss": loss}
        about = {"dataset": data.root, "prior": data.root, "seed": seed, "train": train}
        settings = validated(NbvSettings, about).with_spacing(prior.spacing, LOOSE["random"])
        return mgs.Scene(data, prior, settings)

    positions = np.array([camera.position for camera in data.cameras])
    seeds = [0, *(1 + k for k in spread(positions[1:], positions[:1], np.zeros(3))[: first - 1])]
    scene, rule = start_from(seeds), policy_of(COMPARED.get(policy, policy))
    mission = mgs.Mission(seeds=first, budget=last - first)
    clock = time.process_time
    start = clock()
    state = mgs.learn(scene, seeds) if rule.needs_fit else before_any_fit(scene, seeds)
    state, choices = choose_views(scene, rule, mission, state)
    fits = clock() - start - sum(choices)
    start, taken = clock(), list(state.taken)
    scene = start_from(taken)
    train = scene.settings.train.model_copy(update={"passes": passes})
    model = fit_views(scene, scene.frames, taken, train=train)[0].gaussians
    seconds = {"choice": float(np.mean(choices)), "fits": fits, "fit": clock() - start}
    errors = []
    for frame, truth in tests:
        drawn = np.asarray(render(model, frame.camera, 1.0, scene.cache).rgb)
        errors.append(psnr(truth / np.float32(255), drawn.clip(0, 1)))
    return {"psnr": float(np.mean(errors)), "taken": taken, **seconds}


@lru_cache(maxsize=2)
def loaded(dataset: Path) -> tuple[mgs.Dataset, list[tuple[mgs.Frame, np.ndarray]]]:
    """Dataset, and its test views with their pictures in front of white, uint8 sRGB [H,W,3]."""
    data = mgs.load_dataset(dataset)
    return data, [(frame, on_white(frame)) for frame in test_views_of(data).frames]


def on_white(frame: mgs.Frame) -> np.ndarray:
    """Picture of a frame in front of white, uint8 sRGB [H,W,3]; sRGB values are mixed by alpha."""
    rgba = frame.target()[0]
    alpha = rgba[..., 3:]
    colour = srgb_from_linear(rgba[..., :3] / np.where(alpha > 0, alpha, 1))
    return np.asarray(np.round(255 * (colour * alpha + 1 - alpha)), np.uint8)


def rows_of(work: Work) -> list[Row]:
    """A row for each run that is done."""
    done = [cell for cell in work.cells if cell.about and cell.name in work.results]
    return [dict(cell.about) | work.results[cell.name] for cell in done]


def means_of(rows: Sequence[Row]) -> list[Row]:
    """A row for each number of views and policy, best first: means over scenes and draws. PSNR and
    lead over `random` have 95 % intervals over the draws of the random start, each a mean over the
    scenes."""
    base = {
        (row["views"], row["scene"], row["draw"]): row["psnr"]
        for row in rows
        if row["policy"] == RANDOM
    }
    means = []
    for group in grouped(rows, "views", "policy"):
        of = group.pop("of")
        for row in of:
            against = base.get((row["views"], row["scene"], row["draw"]))
            row["lead"] = None if against is None else row["psnr"] - against
        for key in ("psnr", "lead") if all(row["lead"] is not None for row in of) else ("psnr",):
            draws = [_mean(draw["of"], key) for draw in grouped(of, "draw")]
            low, high = interval(draws) or (None, None)
            group |= {key: _mean(of, key), f"{key}_low": low, f"{key}_high": high}
        group |= {f"psnr {one['scene']}": _mean(one["of"], "psnr") for one in grouped(of, "scene")}
        group |= {key: _mean(of, key) for key in ("choice", "fits", "fit")}
        means.append(group | {"runs": len(of)})
    return sorted(means, key=lambda row: (row["views"], -row["psnr"]))


def _mean(rows: Sequence[Row], key: str) -> float:
    return float(np.mean([row[key] for row in rows]))


def tables(rows: Sequence[Row]) -> str:
    """Table of policies, and that of PUBLISHED."""
    columns: dict[str, Content] = {"views": "views", "policy": "policy"}
    scenes = dict.fromkeys(row["scene"] for row in rows)
    columns |= {f"{scene} (dB)": f"psnr {scene}:.2f" for scene in scenes}
    columns |= {
        "mean (dB)": "psnr:.2f",
        "over random (dB)": lambda row: with_interval(row, "lead"),
        "CPU s a choice": "choice:.2f",
        "CPU s of fits between": "fits:.0f",
    }
    published: dict[str, Content] = {
        "published": "policy", "mean of 8 scenes (dB)": "psnr:.2f", "GPU s a choice": "seconds:.3g",
    }  # fmt: skip
    return f"{table(columns, means_of(rows))}\n{table(published, PUBLISHED)}"


def write(work: Work) -> list[Path]:
    """Write blender.csv, a row for each run, .json, .md and .png."""
    rows = rows_of(work)
    means = means_of(rows)
    ordered = [row for mean in means for row in rows if row["policy"] == mean["policy"]]
    panels = [
        Panel(
            "policy",
            "psnr",
            "",
            "PSNR on 200 test views (dB)",
            title=f"{scene.name}, {last} views",
            only=(("scene", scene.name), ("views", last)),
        )
        for scene in work.size.scenes
        for _, last in work.size.views
    ]
    draw_panels(work.out / f"{NAME}.png", panels, ordered)
    size = replace(work.size, scenes=())
    paths = write_table(work, NAME, rows, tables(rows), size=asdict(size), means=means)
    return [*paths, work.out / f"{NAME}.png"]


STUDY = Study(
    NAME,
    __doc__,
    write,
    SIZES,
    lambda work: cells_of(work.size),
    {
        "--dir": {
            "type": Path,
            "required": True,
            "help": "Folder with NeRF-synthetic scenes, as lego and mic.",
        },
        "--downscale": {"type": at_least(1), "help": "Divisor of 800x800. Default: 4, or full 1."},
        "--gaussians": {"type": at_least(2), "help": "Default: 10,000, or full 100,000."},
        "--draws": {"type": at_least(1), "help": "Random starts. Default: 3, or full 10."},
        "--loss": {"help": "Loss of all fits. Default: that of mgs nbv."},
        "--policy": {"action": "append", "help": "A policy to run; repeatable. Default: all."},
    },
    sized,
)

if __name__ == "__main__":
    study_of(NAME)()
