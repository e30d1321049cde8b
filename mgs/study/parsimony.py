"""How much model does a scene need? Quality and cost against the number of Gaussians, the kinds of
parameter that are learned, and the degree of the colours' spherical harmonics; and whether a rule
that sees no test view would have chosen well.

A fit sees views one after the other, spread evenly around the rock, as `mgs nbv` does: so each
view, before it is fitted, is a
free test. The rules:

- resolution: N of `mgs prior --gaussians auto`, from the mesh and the cameras alone;
- next error: the squared error of the next view inside the rock's mask, under the model of the
views before it: its likelihood
  with any fixed noise;
- predictive: the mean log-likelihood of a pixel value of the same, with the noise of a pixel from
the residual of the views
  that were fitted: a model that fitted them too closely expects less error than it makes;
- evidence: Laplace's approximation of the logarithm of the marginal likelihood of the images, up to
a constant that is the same
  for all: -Phi / sigma² - 1/2 sum log((H + lambda) / lambda), with Phi of `mgs.fit.objective` and
  the exact diagonal H.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mgs.files import read_json
from mgs.policy.criteria import DIRECTIONAL_STD
from mgs.study.sweep import Cell, cell_folder, run_cells

AUTO = "auto"
"""The number of Gaussians of `mgs prior`; of what is learned, and of the SH degree, what `mgs
refit` chooses."""

LEARNED = {
    "colour": ("colour",),
    "+ opacity": ("colour", "opacity"),
    "+ scale": ("colour", "opacity", "scale"),
    "+ rotation": ("colour", "opacity", "scale", "rotation"),
}
"""Sets of kinds of parameters that are learned, by what each adds to the one before."""
ALL = "+ rotation"

DEGREES = (0, 1, 2)

PRUNE_NOISE = (0.1, 0.2, 0.5)
"""Allowed change by pruning, over sigma_e, the noise of a pixel."""

RULES = {"psnr_inside": 1, "next_error": -1, "predictive": 1, "evidence": 1}
"""Columns of a row by which a model may be chosen, the first with the test views in view; 1: more
is better, -1: less."""

GREY = (0.2, 0.2, 0.2)
VARIANTS: dict[str, dict[str, Any]] = {
    "shining boulder": {"specular": 0.5, "roughness": 0.3},
    "plain boulder": {"colours": (GREY, GREY), "dust": GREY},
}
"""Boulders of which some keys of [rock] in the scene file are others."""

SCENES = ("boulder", "strata", "pebbles", "contact-binary", *VARIANTS)
"""On the first two the constants of the rule for N were chosen, on the others it is tested."""

CLOSE = 0.1
"""dB: models whose quality differs by less count as equally good."""


@dataclass(frozen=True)
class Preset:
    """Size of the study. counts: fixed numbers of Gaussians; views: images that are fitted, the
    first `seeds` at once."""

    scenes: tuple[str, ...]
    counts: tuple[int, ...]
    width: int
    height: int
    frames: int
    tests: int
    views: int
    seeds: int = 4
    spp: int = 8
    seed: int = 0


PRESETS = {
    "quick": Preset(SCENES, (2500, 5000, 10_000, 20_000, 40_000), 160, 120, 16, 6, 8),
    "full": Preset(SCENES, (10_000, 20_000, 40_000, 80_000, 160_000), 320, 240, 32, 12, 12),
}


def _cell(name: str, task: str, needs: Sequence[str], **arguments: Any) -> Cell:
    """A cell of a task of this module. Fits are done alone, as their seconds are reported."""
    return Cell(
        name, f"mgs.study.parsimony:{task}", arguments, tuple(needs), alone=task.startswith("fit")
    )


def fit_name(scene: str, gaussians: int | str, learned: str, degree: int) -> str:
    """The name of a fit's cell."""
    return f"fit/{scene}/{gaussians}-{'-'.join(LEARNED[learned])}-degree-{degree}"


def cells_of(size: Preset) -> list[Cell]:
    """All cells: of each scene a data set, its priors, the fits, and the pruning of the automatic
    one."""
    cells: list[Cell] = []
    numbers: tuple[int | str, ...] = (*size.counts, AUTO)
    for scene in size.scenes:
        data = f"dataset/{scene}"
        made = {
            key: getattr(size, key) for key in ("width", "height", "frames", "tests", "spp", "seed")
        }
        cells.append(_cell(data, "make_dataset", (), scene=scene, **made))
        for n in numbers:
            cells.append(
                _cell(
                    f"prior/{scene}/{n}",
                    "make_prior",
                    [data],
                    scene=scene,
                    gaussians=n,
                    seed=size.seed,
                )
            )
        fits = [(n, ALL, 0) for n in numbers]
        fits += [(AUTO, learned, 0) for learned in LEARNED if learned != ALL]
        fits += [(AUTO, ALL, degree) for degree in DEGREES if degree]
        for n, learned, degree in fits:
            arguments: dict[str, Any] = {
                "scene": scene,
                "gaussians": n,
                "learned": learned,
                "degree": degree,
            }
            arguments |= {"views": size.views, "seeds": size.seeds}
            arguments |= {"directional_std": DIRECTIONAL_STD} if degree else {}
            cells.append(
                _cell(
                    fit_name(scene, n, learned, degree),
                    "fit_and_judge",
                    [f"prior/{scene}/{n}"],
                    **arguments,
                )
            )
        best = fit_name(scene, AUTO, ALL, 0)
        cells.append(_cell(f"prune/{scene}", "prune_and_judge", [best], scene=scene, fit=best))
        needs, arguments = (
            [f"prior/{scene}/{AUTO}"],
            {"scene": scene, "views": size.views, "seeds": size.seeds},
        )
        cells.append(_cell(f"lean/{scene}", "fit_lean_and_judge", needs, **arguments))
    return cells


def make_dataset(
    root: Path,
    out: Path,
    scene: str,
    width: int,
    height: int,
    frames: int,
    tests: int,
    spp: int,
    seed: int,
) -> Any:
    """A task: the data set of a scene, in the cell's folder "data"."""
    from mgs.study.material import made_dataset
    from mgs.synth import rendering
    from mgs.synth.scene_file import load_scene_file

    loaded = load_scene_file("boulder" if scene in VARIANTS else scene)
    loaded = loaded.model_copy(
        update={"rock": loaded.rock.model_copy(update=VARIANTS.get(scene, {}))}
    )
    made_dataset(
        out / "data", loaded, rendering.RenderPreset(width, height, frames, spp), seed, tests
    )
    return {}


def make_prior(root: Path, out: Path, scene: str, gaussians: int | str, seed: int) -> Any:
    """A task: a prior of so many Gaussians, or "auto", in the cell's folder "prior"."""
    from mgs.study.material import made_prior

    prior = made_prior(
        out / "prior",
        cell_folder(root, f"dataset/{scene}") / "data",
        gaussians=gaussians,
        seed=seed,
    )
    return {"gaussians": len(prior.points) + prior.backed, "spacing": prior.spacing} | {
        key: prior.numbers[key] for key in ("sampled_area", "resolution") if key in prior.numbers
    }


def views_in_order(positions: np.ndarray, centre: np.ndarray, views: int, seeds: int) -> list[int]:
    """Indices of views spread evenly in azimuth, in an order in which the first `seeds` are spread
    evenly too.

    positions: [C,3] of the cameras, +Z up; centre: [3]."""
    from mgs.policy.poses import seed_views

    spread = list(seed_views(positions, centre, views))
    step = max(views // seeds, 1)
    return [view for first in range(step) for view in spread[first::step]]


def fit_and_judge(
    root: Path,
    out: Path,
    scene: str,
    gaussians: int | str,
    learned: str,
    degree: int,
    views: int,
    seeds: int,
    directional_std: float = DIRECTIONAL_STD,
) -> Any:
    """A task: fit views one after the other; what the test views, the next views and the evidence
    say of the model.
    directional_std: tau of colours of degrees above 0, which is a constant; named so that a result
    of another is not taken."""
    from mgs.data.dataset import load_dataset, target_of
    from mgs.fit.fitting import fit
    from mgs.fit.objective import objective
    from mgs.fit.settings import RATES, TrainSettings
    from mgs.gaussians import Gaussians
    from mgs.policy.criteria import PIXEL_NOISE
    from mgs.prior.build import load_prior
    from mgs.prior.initial import initial_gaussians, warm_start
    from mgs.report.evidence import fit_lam, regularisation
    from mgs.run.settings import NbvSettings
    from mgs.splat import ListCache, as_drjit, fisher, groups
    from mgs.splat_ply import write_ply

    folder = cell_folder(root, f"dataset/{scene}") / "data"
    dataset, kept = load_dataset(folder), cell_folder(root, f"prior/{scene}/{gaussians}") / "prior"
    prior, cache, columns = load_prior(kept), ListCache(), groups(degree)
    train = TrainSettings(
        rates={kind: rate if kind in LEARNED[learned] else 0.0 for kind, rate in RATES.items()}
    )
    settings = NbvSettings(dataset=folder, prior=kept, train=train)
    lam = regularisation(settings, degree)
    by_kind = fit_lam(lam, degree)
    positions = np.array([frame.camera.position for frame in dataset.frames])
    frames = [
        dataset.frames[i] for i in views_in_order(positions, prior.points.mean(0), views, seeds)
    ]
    cameras, targets = [frame.camera for frame in frames], [target_of(frame) for frame in frames]

    def start_of(count: int) -> Gaussians:
        """The Gaussians before training, in the colours of the first `count` frames, as the loop of
        `mgs nbv` has them."""
        of_seeds, coloured = (initial_gaussians(prior, frames[:k])[0] for k in (seeds, count))
        return replace(of_seeds, sh=coloured.sh).with_degree(degree)

    start = model = start_of(seeds)
    fitted, following, seconds, passes = list[float](), list[float](), 0.0, 0
    for step, count in enumerate(range(seeds, views + 1)):
        before, start = start, start_of(count)
        model = warm_start(model, before, start)
        began = time.perf_counter()
        found = fit(
            model,
            cameras[:count],
            targets[:count],
            settings.train_at(step),
            None,
            cache,
            start,
            by_kind,
        )
        seconds, passes, model = (
            seconds + time.perf_counter() - began,
            passes + found.passes,
            found.gaussians,
        )
        if count < views:
            fitted.append(
                float(np.mean([_squared_error(model, frame) for frame in frames[:count]]))
            )
            following.append(_squared_error(model, frames[count]))
    learned_columns = np.concatenate(
        [np.arange(columns[kind].start, columns[kind].stop) for kind in LEARNED[learned]]
    )
    H = sum(fisher(model, camera, cache=cache).astype(np.float64) for camera in cameras)[
        :, learned_columns
    ]  # type: ignore
    phi = objective(model, cameras, targets, start, by_kind, cache).phi(as_drjit(model))
    write_ply(out / "gaussians.ply", model)
    return _quality(model, dataset) | {
        "views": [frame.name for frame in frames],
        "gaussians": len(model),
        "parameters": int(H.size),
        "informed": float((lam[learned_columns] < H).mean()),
        "seconds": seconds,
        "passes": passes,
        "next_error": float(np.mean(following)),
        "predictive": float(
            np.mean([log_likelihood(*pair) for pair in zip(following, fitted, strict=True)])
        ),
        "evidence": float(-phi / PIXEL_NOISE**2 - 0.5 * np.log1p(H / lam[learned_columns]).sum()),
    }


def fit_lean_and_judge(root: Path, out: Path, scene: str, views: int, seeds: int) -> Any:
    """A task: `mgs.report.evidence.lean_fit` to as many views, with the automatic number of
    Gaussians."""
    from mgs.data.dataset import load_dataset
    from mgs.fit.settings import TrainSettings
    from mgs.prior.build import load_prior
    from mgs.report.evidence import last_images, lean_fit
    from mgs.run.settings import NbvSettings
    from mgs.splat import ListCache

    folder, kept = (
        cell_folder(root, f"dataset/{scene}") / "data",
        cell_folder(root, f"prior/{scene}/{AUTO}") / "prior",
    )
    dataset, prior = load_dataset(folder), load_prior(kept)
    settings = NbvSettings(dataset=folder, prior=kept, seeds=seeds, train=TrainSettings())
    positions = np.array([frame.camera.position for frame in dataset.frames])
    frames = [
        dataset.frames[i] for i in views_in_order(positions, prior.points.mean(0), views, seeds)
    ]
    images, began = last_images(settings, prior, frames), time.perf_counter()
    found = lean_fit(images, settings, cache=ListCache())
    assert found.left_out is not None
    whole = _quality(found.whole, dataset)
    return _quality(found.gaussians, dataset) | {
        "whole": whole,
        "gaussians": len(found.gaussians),
        "parameters": found.parameters,
        "seconds": time.perf_counter() - began,
        "degree": found.gaussians.sh_degree,
        "directional_gain": found.left_out.gain,
        "directional_error": found.left_out.error,
        "shares": {kind: float(mask.mean()) for kind, mask in found.learned.items()},
    }


def log_likelihood(error: float, variance: float) -> float:
    """The mean logarithm of the likelihood of pixel values, in nats, from their mean squared error,
    if each is the rendered one plus Gaussian noise of this variance; both (linear RGB)²."""
    return -0.5 * float(np.log(2 * np.pi * variance)) - error / (2 * variance)


def _squared_error(model: Any, frame: Any) -> float:
    """Mean squared error of a frame's pixel values inside the rock's mask, linear RGB."""
    from mgs.data.dataset import target_of
    from mgs.metrics import masked_squares
    from mgs.splat import render

    rgb = np.asarray(render(model, frame.camera).rgb, np.float64)
    return float(masked_squares(rgb, target_of(frame), frame.mask()).mean())


def _quality(model: Any, dataset: Any) -> dict[str, float]:
    """PSNR on the test views, dB: of the whole frame, and of the pixels that the rock covers
    wholly."""
    from mgs.report.evaluation import evaluate

    found = evaluate(model, (), (), test_frames=dataset.test_views().frames)["test"]
    return {"psnr": found["psnr"], "psnr_inside": found["psnr_inside"]}


def prune_and_judge(root: Path, out: Path, scene: str, fit: str) -> Any:
    """A task: prune the model of a fit at several noises, and judge what is left."""
    from mgs.data.dataset import load_dataset
    from mgs.policy.criteria import PIXEL_NOISE
    from mgs.splat.pruning import prune
    from mgs.splat_ply import read_ply

    dataset = load_dataset(cell_folder(root, f"dataset/{scene}") / "data")
    model = read_ply(cell_folder(root, fit) / "gaussians.ply")
    views = read_json(cell_folder(root, fit) / "result.json")["found"]["views"]
    cameras, rows = [frame.camera for frame in dataset.frames if frame.name in views], []
    for share in PRUNE_NOISE:
        found = prune(model, cameras, share * PIXEL_NOISE)
        numbers = {
            "noise": share,
            "gaussians": len(found.kept),
            "predicted": found.predicted,
            "actual": found.actual,
        }
        rows.append(numbers | _quality(model[found.kept], dataset))
    return {"rows": rows}


def run_study(root: Path, size: Preset, report: Callable[[str, int, int], None]) -> dict[str, Any]:
    """Do all cells that are not done, and return what they say: "rows", one for each fit, and
    "scenes", `verdict` of each."""
    found = run_cells(root, cells_of(size), report)
    rows: list[dict[str, Any]] = []
    for scene in size.scenes:
        for cell in cells_of(size):
            if cell.name.startswith(f"fit/{scene}/"):
                asked = {key: cell.arguments[key] for key in ("scene", "learned", "degree")}
                numbers = {key: value for key, value in found[cell.name].items() if key != "views"}
                rows.append(asked | {"asked": str(cell.arguments["gaussians"])} | numbers)
        numbers = {
            key: value
            for key, value in found[f"lean/{scene}"].items()
            if not isinstance(value, dict)
        }
        rows.append({"scene": scene, "learned": AUTO, "asked": AUTO, **numbers})
    scenes = {
        scene: verdict([row for row in rows if row["scene"] == scene]) for scene in size.scenes
    }
    for scene in size.scenes:
        scenes[scene] |= {
            "prior": found[f"prior/{scene}/{AUTO}"],
            "pruned": found[f"prune/{scene}"]["rows"],
        }
        scenes[scene] |= {"lean": found[f"lean/{scene}"]}
    return {"rows": rows, "scenes": scenes}


def axes_of(rows: Sequence[dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """The rows of one scene that differ in one thing alone: fixed "gaussians", "learned", "degree",
    in order."""
    plain = [row for row in rows if row["learned"] != AUTO and row["degree"] == 0]
    return {
        "gaussians": [row for row in plain if row["asked"] != AUTO],
        "learned": sorted((row for row in plain if row["asked"] == AUTO), key=_kinds),
        "degree": sorted(
            (row for row in rows if row["asked"] == AUTO and row["learned"] == ALL),
            key=lambda r: r["degree"],
        ),
    }


def _kinds(row: dict[str, Any]) -> int:
    return list(LEARNED).index(row["learned"])


def verdict(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """What the rows of one scene say of the automatic choice, of N, of what is learned, and of the
    SH degree.

    best: the largest PSNR inside the rock of a fixed choice, dB: of N, all being learned, or of
    kinds or a degree, with the
    automatic N. number: that of the automatic N, all being learned. auto, loss: that of the
    automatic choice of everything, and
    how far it is below the best. parameters: of the automatic choice; smallest: the fewest of a
    fixed choice within CLOSE of
    the best. close, small: whether the loss is at most CLOSE, and the parameters at most the
    smallest. chosen: for each axis and each rule the value that the rule would choose, and its loss
    against the best of the axis, dB.
    """
    auto = next(row for row in rows if row["learned"] == AUTO)
    number = next(
        row for row in rows if row["asked"] == AUTO and row["learned"] == ALL and row["degree"] == 0
    )
    fixed = [row for row in rows if row not in (auto, number)]
    best = max(row["psnr_inside"] for row in fixed)
    smallest = min(row["parameters"] for row in fixed if row["psnr_inside"] >= best - CLOSE)
    chosen = {}
    for axis, of in axes_of(rows).items():
        top = max(row["psnr_inside"] for row in of)
        for rule, sign in RULES.items():
            row = max(of, key=lambda row: sign * row[rule])
            chosen[f"{axis} by {rule}"] = {"value": row[axis], "loss": top - row["psnr_inside"]}
    loss = best - auto["psnr_inside"]
    return {
        "best": best,
        "number": number["psnr_inside"],
        "auto": auto["psnr_inside"],
        "loss": loss,
        "parameters": auto["parameters"],
        "smallest": smallest,
        "close": loss <= CLOSE,
        "small": auto["parameters"] <= smallest,
        "chosen": chosen,
    }
