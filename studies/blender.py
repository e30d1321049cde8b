"""Policies on scenes of others: NeRF-synthetic by FisherRF's protocol, and photographs.

NeRF-synthetic: view 0 and those farthest from it are the seeds, the other training views are the
candidates, the 200 test views judge, in front of white. Models start at random points in the ball
that all cameras see, inside the masks of the views taken: no picture or mask of a candidate is
read. Photographs without masks: every TEST_EVERY-th is a test view, the seeds are drawn, and models
start at the points that came with the cameras. Every policy chooses one view at a time. A new fit
to all views taken is judged.
"""

import time
from argparse import Namespace
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

import mgs
from mgs.colour import srgb_from_linear
from mgs.data.frames import has_masks
from mgs.data.importers import import_source
from mgs.data.sources import TRAINING, read_source
from mgs.data.structure import CLOUD
from mgs.files import copy_file
from mgs.fit.settings import TrainSettings
from mgs.learning import fit_views
from mgs.metrics import psnr
from mgs.policy.poses import farthest_order
from mgs.run.nbv import FREE_TRAIN, LOOSE
from mgs.run.policy_file import policy_of
from mgs.run.settings import NbvSettings, validated
from mgs.seeds import generator
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

FARTHEST = "farthest"
"""Policy over which others lead: the default from random points."""

TEST_EVERY = 5
"""Photographs for each test view, which is the middle one of so many by name."""

ALPHA_WEIGHT = 1.0
"""Weight of alpha in fits. In front of white, an error of alpha counts as much as one of colour."""

ONCE = ("popgs-block",)
"""Policies that are run with the first draw alone, since they take minutes."""

OURS = ("random", FARTHEST, "directional-i", "directional-d", "cover", "uniform", "d-optimal")
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

    downscale: of the images. gaussians: of every model. views: numbers of views at the start and at
    the end; below 1 a share of the training views. nearest: numbers of candidates, those nearest to
    the last view; None: all. passes: of the fit that is judged, twice the default. loss: of all
    fits. draws: seeds of the random start. scenes: folders that are `scene_in`, set by the options.
    """

    downscale: int = 4
    gaussians: int = 10_000
    views: tuple[tuple[int, float], ...] = ((2, 10),)
    nearest: tuple[int | None, ...] = (None,)
    passes: int = 20
    loss: str = TrainSettings().loss
    draws: int = 3
    policies: tuple[str, ...] = (*OURS, *COMPARED)
    scenes: tuple[Path, ...] = ()


SIZES = {
    "quick": BlenderSize(),
    "full": BlenderSize(1, 100_000, ((2, 10), (4, 20)), draws=10),
    "photographs": BlenderSize(
        downscale=3,
        gaussians=5_000,
        views=((2, 0.5),),
        nearest=(None, 5),
        passes=15,
        draws=5,
        policies=(
            *("random", FARTHEST, "directional-i", "d-optimal", "cover"),
            *("paper, no means", "fisherrf, code"),
        ),
    ),
}


def scene_in(folder: Path) -> bool:
    """Whether a folder is a scene: one of NeRF-synthetic, or a dataset of photographs."""
    split = [(folder / name).is_file() for name in (TRAINING, "transforms_test.json")]
    return all(split) or (folder / "transforms.json").is_file()


def sized(size: BlenderSize, options: Namespace) -> BlenderSize:
    """Size with the options. Raises InputError where --dir has no scene, or a policy is unknown."""
    root = options.dir.resolve()
    scenes = [folder for folder in root.glob("*") if scene_in(folder)]
    if not scenes:
        raise mgs.InputError(
            f"--dir {options.dir}: has no scene, a folder with transforms.json, or with {TRAINING} "
            "and transforms_test.json; give the folder that holds lego, mic and the others"
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
    setups = list(product(size.views, size.nearest))
    for draw in range(size.draws):
        for ((first, last), nearest), policy, scene in product(setups, size.policies, size.scenes):
            if draw > 0 and policy in ONCE:
                continue
            how = {"first": first, "last": last, "policy": policy, "seed": draw}
            how |= {key: getattr(size, key) for key in ("gaussians", "passes", "loss")}
            how |= {"nearest": nearest} if nearest else {}
            made = data[scene]
            label = policy.replace(", ", "-").replace(" ", "-")
            views = views_of(last, nearest)
            where = f"{scene.name}-{size.downscale}/{size.gaussians}/{first}-{views}"
            cells.append(
                Cell(
                    f"run/{where}/{label}-{draw}",
                    f"{__name__}:choose_and_judge",
                    {"dataset": f"{CELLS}/{made.name}/dataset"} | how,
                    (made.name,),
                    alone=True,
                    about={"scene": scene.name, "views": views, "policy": policy, "draw": draw},
                )
            )
    return cells


def views_of(last: float, nearest: int | None) -> int | str:
    """Value of the column of views: their number or share at the end, and the candidates."""
    views = f"{last:.0%}" if last < 1 else int(last)
    return f"{views}, {nearest} nearest" if nearest else views


def make_dataset(root: Path, out: Path, source: str, downscale: int) -> dict[str, Any]:
    """Task: import the training views of a scene, its test views, and its points."""
    folder = Path(source)
    split = (folder / TRAINING).is_file()
    given = read_source(folder, test_split="test" if split else None)
    if not split:
        names = sorted(shot.name for shot in given.shots)
        given = replace(given, tests=frozenset(names[TEST_EVERY // 2 :: TEST_EVERY]))
    shots, tests = given.set_apart(None)
    up, _ = shots.up_or_estimate()
    data = import_source(shots, out / "dataset", tests=tests, downscale=downscale, up=up)
    if (folder / CLOUD).is_file():
        copy_file(folder / CLOUD, data.root / CLOUD)
    camera = data.frames[0].camera
    return {"frames": len(data), "width": camera.width, "height": camera.height}


def choose_and_judge(
    root: Path,
    out: Path,
    dataset: str,
    first: int,
    last: float,
    policy: str,
    seed: int,
    gaussians: int,
    passes: int,
    loss: str,
    nearest: int | None = None,
) -> dict[str, Any]:
    """Task: choose views until there are `last`, fit all of them from the start, and judge.

    Returns "psnr" (dB, mean over the test views), "taken", and CPU seconds: "choice" (mean of a
    score of all candidates, with what it needs beside the fit), "fits" (between choices, together)
    and "fit" (of the model that is judged).
    """
    data, _ = loaded(root / dataset)
    model, masked = (gaussians, seed, loss), has_masks(data.frames)
    count = round(last * len(data)) if last < 1 else int(last)
    if masked:
        positions = np.array([camera.position for camera in data.cameras])
        far = farthest_order(positions[1:], positions[:1], np.zeros(3))
        seeds = [0, *(1 + k for k in far[: first - 1])]
        scene = scene_of(data, seeds, *model)
    else:
        seeds = generator(seed, "start").permutation(len(data))[:first].tolist()
        scene = scene_of(data, range(len(data)), *model)
    rule = policy_of(COMPARED.get(policy, policy))
    mission = mgs.Mission(seeds=first, budget=count - first, nearest=nearest)
    clock = time.process_time
    start = clock()
    state = mgs.learn(scene, seeds) if rule.needs_fit else before_any_fit(scene, seeds)
    state, choices = choose_views(scene, rule, mission, state)
    fits = clock() - start - sum(choices)
    views = state.taken if masked else tuple(sorted(state.taken))
    result, fit = judged(root / dataset, views, *model, passes)
    seconds = {"choice": float(np.mean(choices)), "fits": fits, "fit": fit}
    return {"psnr": result, "taken": list(state.taken), **seconds}


def scene_of(
    data: mgs.Dataset, shown: Sequence[int], gaussians: int, seed: int, loss: str
) -> mgs.Scene:
    """Scene that starts at points of the views shown, in their masks if there are any."""
    frames = [data.frames[i] for i in shown]
    prior = mgs.build_prior(data, gaussians=gaussians, seed=seed, source="random", shown=frames)
    weight = ALPHA_WEIGHT if has_masks(data.frames) else 0.0
    train = {"means": "free", "alpha_weight": weight, "loss": loss}
    about = {"dataset": data.root, "prior": data.root, "seed": seed, "train": train}
    settings = validated(NbvSettings, about).with_spacing(prior.spacing, LOOSE["random"])
    return mgs.Scene(data, prior, settings)


@lru_cache
def judged(
    dataset: Path, taken: tuple[int, ...], gaussians: int, seed: int, loss: str, passes: int
) -> tuple[float, float]:
    """PSNR of a new fit to the views taken, dB, mean over the test views, and its CPU seconds.
    Policies that take the same photographs share it."""
    data, tests = loaded(dataset)
    masked, start = has_masks(data.frames), time.process_time()
    scene = scene_of(data, taken, gaussians, seed, loss)
    how = {} if masked else FREE_TRAIN
    train = scene.settings.train.model_copy(update=how | {"passes": passes})
    model = fit_views(scene, scene.frames, taken, train=train)[0].gaussians
    seconds = time.process_time() - start
    errors = []
    for frame, truth in tests:
        image = render(model, frame.camera, 1.0 if masked else 0.0, scene.cache)
        errors.append(psnr(truth / np.float32(255), np.asarray(image.rgb).clip(0, 1)))
    return float(np.mean(errors)), seconds


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


def means_of(rows: Sequence[Row]) -> list[Row]:
    """A row for each number of views and policy, by lead: means over scenes and draws. "lead" is
    over `FARTHEST` from the same start; where there are only two scenes, also "lead SCENE". PSNR
    and lead have 95 % intervals over the scenes, each a mean over the draws; where there are only
    two, over the draws of the random start."""
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    unit = "scene" if len(scenes) > 2 else "draw"
    start = ("views", "scene", "draw")
    base = {
        tuple(row[key] for key in start): row["psnr"] for row in rows if row["policy"] == FARTHEST
    }
    means = []
    for group in grouped(rows, "views", "policy"):
        of = group.pop("of")
        for row in of:
            against = base.get(tuple(row[key] for key in start))
            row["lead"] = None if against is None else row["psnr"] - against
        group |= _with_bounds(of, "psnr", "psnr", unit) | _with_bounds(of, "lead", "lead", unit)
        for scene in scenes if unit == "draw" else ():
            some = [row for row in of if row["scene"] == scene]
            group |= {f"psnr {scene}": _mean(some, "psnr")} if some else {}
            group |= _with_bounds(some, "lead", f"lead {scene}", unit)
        group |= {key: _mean(of, key) for key in ("choice", "fits", "fit")}
        means.append(group | {"runs": len(of)})
    by = "lead" if all("lead" in row for row in means) else "psnr"
    return sorted(means, key=lambda row: (str(row["views"]), -row[by]))


def _with_bounds(rows: Sequence[Row], key: str, name: str, unit: str) -> Row:
    """Mean of a key of the rows as `name`, and its interval over the values of `unit`; empty where
    a row has none."""
    if not rows or any(row[key] is None for row in rows):
        return {}
    low, high = interval([_mean(one["of"], key) for one in grouped(rows, unit)]) or (None, None)
    return {name: _mean(rows, key), f"{name}_low": low, f"{name}_high": high}


def _mean(rows: Sequence[Row], key: str) -> float:
    return float(np.mean([row[key] for row in rows]))


def _with_lead(row: Row, name: str) -> str:
    """PSNR and lead of a row, of a scene by " SCENE"; – where the policy did not run there."""
    if f"psnr{name}" not in row:
        return "–"
    return f"{row[f'psnr{name}']:.2f}, {with_interval(row, f'lead{name}')}"


def tables(rows: Sequence[Row]) -> str:
    """Table of policies, with columns for each scene if these are two, and that of PUBLISHED."""
    columns: dict[str, Content] = {"views": "views", "policy": "policy"}
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    for name in [*(f" {scene}" for scene in scenes if len(scenes) <= 2), ""]:
        title = f"{name.strip() or 'mean'}: PSNR, over {FARTHEST} (dB)"
        columns[title] = partial(_with_lead, name=name)
    columns |= {"CPU s a choice": "choice:.2f", "CPU s of fits between": "fits:.0f"}
    published: dict[str, Content] = {
        "published": "policy", "mean of 8 scenes (dB)": "psnr:.2f", "GPU s a choice": "seconds:.3g",
    }  # fmt: skip
    return f"{table(columns, means_of(rows))}\n{table(published, PUBLISHED)}"


def write(work: Work) -> list[Path]:
    """Write blender.csv, a row for each run, .json, .md and .png."""
    rows = work.rows()
    means = means_of(rows)
    keys = ("views", "policy")
    ordered = [row for mean in means for row in rows if all(row[k] == mean[k] for k in keys)]
    panels = [
        Panel(
            "policy",
            "psnr",
            "",
            "PSNR on the test views (dB)",
            title=f"{scene.name}, {views} views",
            only=(("scene", scene.name), ("views", views)),
        )
        for scene in work.size.scenes
        for views in dict.fromkeys(row["views"] for row in ordered)
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
    cells_of,
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
