"""Plans against upper bounds of all sets of views, and the criterion against PSNR.

After the seeds, plans of several sizes and other sets are compared with the bound of
`mgs.policy.certificate`. Then fits to sets show what a share of the criterion is worth in dB.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import spearmanr

import mgs
from mgs.learning import fit_views
from mgs.policy import certificate, poses
from mgs.policy.relaxation import Relaxation
from mgs.run.policies import DIRECTIONAL_D, Directional
from studies.frame.case import ROCKS, Rock
from studies.frame.output import (
    Content,
    Panel,
    draw_panels,
    grouped,
    over_scenes,
    scene_mean,
    table,
    write_csv,
    write_table,
)
from studies.frame.program import WORKERS, Study, Work, study_of
from studies.frame.statistics import Row
from studies.frame.sweep import Cell
from studies.setups import SETUPS, Results, SetupSize, before_any_fit, case_of, shared_scene, sized

SETUP = SETUPS["hemisphere"]

POLICIES = {policy.name: policy for policy in (Directional(), DIRECTIONAL_D)}

TRAINING = tuple(Rock(scene) for scene in ("boulder", "contact-binary", "low-sun", "pebbles"))
"""Rocks that chose the default of `enough`."""

NODES = 40
"""Nodes of branch and bound."""


@dataclass(frozen=True)
class CertificateSize(SetupSize):
    """Size of the study.

    counts: views of plans. shares: of the gain of all candidates at which greedy sets end. sets:
    random sets by the criterion. batches, batch: cells of random sets that are fitted, and sets in
    each, of so many `views`. fitted: Gaussians of the priors of fits. training: rocks that chose
    the default of `enough`.
    """

    counts: tuple[int, ...] = (4, 8)
    shares: tuple[float, ...] = (0.8, 0.85, 0.9, 0.95, 0.98)
    sets: int = 20
    batches: int = 4
    batch: int = 50
    views: int = 8
    fitted: int = 6000
    training: tuple[Rock, ...] = TRAINING


SIZES = {"quick": CertificateSize(), "paper": CertificateSize(320, 240, 24, 16)}

KINDS = ("bound", "plan", "even", "random")
"""Keys of `mgs.policy.certificate.curve`."""


def cells_of(size: CertificateSize) -> list[Cell]:
    """Cells of each rock: its dataset, prior, plans and fits. "part" of the last: plans, training,
    growing or random."""
    parts: list[tuple[str, str, dict[str, Any], Sequence[Rock]]]
    shares = {"shares": list(size.shares)}
    parts = [
        ("training", "growing", shares, size.training),
        ("growing", "growing", shares, size.rocks),
    ]
    of_plans = {"counts": list(size.counts), "sets": size.sets}
    parts.append(("plans", "planned", of_plans, size.rocks))
    for k in range(size.batches):
        of_sets = {"batch": [k, size.batch], "views": size.views}
        parts.append((f"random/{k}", "randomised", of_sets, size.rocks))
    cells = []
    for part, task, arguments, rocks in parts:
        one = size if part == "plans" else replace(size, gaussians=size.fitted)
        for rock in rocks:
            name = f"certificate/{rock.name}/{part}"
            how = {"about": {"part": part.partition("/")[0]}, "seed": rock.index, **arguments}
            cells += case_of(rock, SETUP, one).with_task(name, f"{__name__}:{task}", **how)
    return cells


def _of_rock(
    root: Path, dataset: str, prior: str, start: Callable[[mgs.Scene], mgs.State]
) -> tuple[mgs.Scene, mgs.State, list[int], dict[str, Relaxation], Any]:
    """Scene, state after the seeds, candidates, relaxations by policy, and PSNR of a model."""
    scene, tests, _ = shared_scene(root / dataset, root / prior, None)
    state = start(scene)
    free = [i for i in range(len(scene.frames)) if i not in state.taken]
    made = {name: policy.relaxation(scene, state, free) for name, policy in POLICIES.items()}
    return scene, state, free, made, tests


def planned(
    root: Path, out: Path, dataset: str, prior: str, seed: int, counts: Sequence[int], sets: int
) -> dict[str, Any]:
    """Task: "plans", a row for each policy and size; "curve", that of the first policy."""
    rng = np.random.default_rng(seed)

    def start(scene: mgs.Scene) -> mgs.State:
        return before_any_fit(scene, scene.seeds(SETUP.seeds))

    scene, state, free, made, _ = _of_rock(root, dataset, prior, start)

    def plan(name: str, k: int) -> list[int]:
        return [free.index(i) for i in POLICIES[name].plan(scene, state, free, k, None)]

    positions, seeds = scene.positions(state.frames), list(state.taken)
    even = poses.farthest_order(positions[free], positions[seeds], scene.centre)
    plans = []
    for name, one in made.items():
        for k in counts:
            others = even[:k], draws(rng, len(free), k, sets)
            plans.append({"policy": name} | compared(one, plan(name, k), *others))
    name, one = next(iter(made.items()))
    curve = certificate.curve(one, plan(name, max(counts)), even)
    return {"gaussians": len(scene.prior.points), "plans": plans, "curve": curve}


def _psnr_of(
    root: Path, dataset: str, prior: str, sets_of: Callable[..., list[dict[str, Any]]]
) -> dict[str, Any]:
    """PSNR on test views of fits to sets, which start at the model of the seeds as in a run; and
    the sets' gains by policy."""

    def start(scene: mgs.Scene) -> mgs.State:
        return mgs.learn(scene, scene.seeds(SETUP.seeds))

    scene, state, free, made, tests = _of_rock(root, dataset, prior, start)
    rows = []
    for row in sets_of(made, len(free)):
        views = row.pop("set")
        frames = [*state.taken, *(free[v] for v in views)]
        psnr = tests(fit_views(scene, scene.frames, frames, state)[0].gaussians)["psnr"]
        gains = {name: one.gain(views) for name, one in made.items()}
        rows.append(row | {"views": len(views), "psnr": float(psnr.mean())} | gains)
    return {"sets": rows}


def growing(
    root: Path, out: Path, dataset: str, prior: str, seed: int, shares: Sequence[float]
) -> dict[str, Any]:
    """Task: "sets", the greedy sets of each policy that end at these shares, and all candidates."""

    def sets_of(made: dict[str, Relaxation], count: int) -> list[dict[str, Any]]:
        rows: list[dict[str, Any]] = [
            {"policy": name, "share": share, "set": certificate.greedy(one, share)}
            for name, one in made.items()
            for share in shares
        ]
        return [*rows, {"policy": "", "share": 1.0, "set": list(range(count))}]

    return _psnr_of(root, dataset, prior, sets_of)


def randomised(
    root: Path, out: Path, dataset: str, prior: str, seed: int, batch: Sequence[int], views: int
) -> dict[str, Any]:
    """Task: "sets", random sets of so many views. batch: its number, and the number of sets."""
    rng = np.random.default_rng([seed, batch[0]])

    def sets_of(_: dict[str, Relaxation], count: int) -> list[dict[str, Any]]:
        return [{"set": some} for some in draws(rng, count, views, batch[1])]

    return _psnr_of(root, dataset, prior, sets_of)


def draws(rng: np.random.Generator, count: int, k: int, number: int) -> list[list[int]]:
    """Random sets of k out of `count`."""
    return [rng.choice(count, k, replace=False).tolist() for _ in range(number)]


def compared(
    made: Relaxation, plan: Sequence[int], even: Sequence[int], random: Sequence[Sequence[int]]
) -> Row:
    """Gains of a plan and of other sets of as many views, and their bounds."""
    k = len(plan)
    best = certificate.best_set(made, plan, most=NODES)
    gains = [made.gain(some) for some in random]
    return {
        "views": k,
        "plan": made.gain(plan),
        "greedy": made.gain(certificate.greedy(made, 1.0, most=k)),
        "farthest": made.gain(even),
        "random": float(np.mean(gains)),
        "random_best": float(np.max(gains)),
        "relaxed": certificate.upper_bound(made, k).value,
        "bound": best.bound,
        "best": best.gain,
        "nodes": best.nodes,
        "fewer": certificate.upper_bound(made, k - 1).value,
    }


def rows_of(results: Results, cells: Sequence[Cell]) -> list[Row]:
    """A row for each rock, policy and size of a plan: gains as shares of the bound, and
    "correlation" of the criterion and PSNR over the rock's random sets."""
    rows: list[Row] = []
    for cell in _of_part("plans", cells):
        others = [
            one for one in _of_part("random", cells) if one.about["rock"] == cell.about["rock"]
        ]
        sets = [row for one in others for row in results[one.name]["sets"]]
        for plan in results[cell.name]["plans"]:
            keys = ("plan", "greedy", "farthest", "random", "random_best", "best")
            shares = {key: plan[key] / plan["bound"] for key in keys}
            shares["relaxed"] = plan["plan"] / plan["relaxed"]
            shares["fewer"] = plan["fewer"] / plan["plan"]
            rank = spearmanr(
                *zip(*((row[plan["policy"]], row["psnr"]) for row in sets), strict=True)
            )
            more = {key: plan[key] for key in ("policy", "views", "nodes")}
            about = {key: cell.about[key] for key in ("rock", "scene")}
            rows.append(about | more | shares | {"correlation": float(rank.statistic)})
    return rows


def losses_of(results: Results, cells: Sequence[Cell]) -> list[Row]:
    """Rows with "part" (training or growing), rock, scene, policy, share, views, and "loss" against
    all candidates, dB."""
    rows: list[Row] = []
    for cell in [*_of_part("training", cells), *_of_part("growing", cells)]:
        *sets, every = results[cell.name]["sets"]
        for one in sets:
            numbers = {key: one[key] for key in ("policy", "share", "views")}
            rows.append(dict(cell.about) | numbers | {"loss": every["psnr"] - one["psnr"]})
    return rows


def _of_part(part: str, cells: Sequence[Cell]) -> list[Cell]:
    return [cell for cell in cells if cell.about.get("part") == part]


def tables(rows: Sequence[Row], losses: Sequence[Row] = ()) -> str:
    """Tables of plans, bounds, correlation and losses: means over scenes, 95 % intervals."""
    names = ("plan", "greedy", "farthest", "random, mean", "random, best")
    keys = ("plan", "greedy", "farthest", "random", "random_best")
    of_sets: dict[str, Content] = {"policy": "policy", "views": "views:d"}
    of_sets |= {name: scene_mean(key, ".3f") for name, key in zip(names, keys, strict=True)}
    of_plans: dict[str, Content] = {
        "policy": "policy",
        "views": "views:d",
        "plan / relaxation": scene_mean("relaxed", ".3f"),
        "one view less / plan": scene_mean("fewer", ".3f"),
    }
    of_ranks: dict[str, Content] = {
        "policy": "policy",
        "rank correlation with PSNR": scene_mean("correlation", ".2f"),
    }
    of_losses: dict[str, Content] = {
        "policy": "policy",
        "share of all": "share:.2f",
        "views": scene_mean("views", ".1f", part="growing"),
        "dB lost, training rocks": scene_mean("loss", ".2f", part="training"),
        "dB lost, others": scene_mean("loss", ".2f", part="growing"),
    }
    every, ends = grouped(rows, "policy", "views"), grouped(losses, "policy", "share")
    most = max(line["views"] for line in every)
    last = [line for line in every if line["views"] == most]
    made = ((of_sets, every), (of_plans, every), (of_ranks, last), (of_losses, ends))
    return "\n".join(table(*one) for one in made if one[1])


def curve_of(results: Results, cells: Sequence[Cell]) -> list[Row]:
    """Rows of the curve: rock, scene, views, kind (of KINDS), percent of the gain of all."""
    return [
        dict(cell.about) | {"views": row["views"], "kind": kind, "percent": 100 * row[kind]}
        for cell in _of_part("plans", cells)
        for row in results[cell.name]["curve"]
        for kind in KINDS
    ]


def draw(path: Path, curve: Sequence[Row]) -> None:
    """Draw gains against the number of views: bound, plan, farthest poses, random."""
    rows = [
        group | {"percent": percent}
        for group in grouped(curve, "views", "kind")
        for percent in over_scenes(group["of"], "percent").values()
    ]
    label = "gain of all candidates (%)"
    title = "directional-i, after four seeds"
    draw_panels(path, [Panel("views", "percent", "views chosen", label, "kind", title=title)], rows)


def write(work: Work) -> list[Path]:
    """Write certificate.csv, .json, .md and .png, certificate-curve.csv and -losses.csv."""
    rows, losses, curve = (
        make(work.results, work.cells) for make in (rows_of, losses_of, curve_of)
    )
    draw(work.out / "certificate.png", curve)
    text = tables(rows, losses)
    paths = write_table(work, "certificate", rows, text, rocks=len(work.size.rocks))
    for name, of in (("curve", curve), ("losses", losses)):
        paths.append(write_csv(work.out / f"certificate-{name}.csv", of))
    return [*paths, work.out / "certificate.png"]


STUDY = Study("certificate", __doc__, write, SIZES, cells_of, ROCKS | WORKERS, sized)

if __name__ == "__main__":
    study_of("certificate")()
