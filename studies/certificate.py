"""Plans against upper bounds of all sets of views, and the criterion against PSNR.

After the seeds, plans of several sizes and other sets are compared with the bound of
`mgs.policy.certificate`. Then fits to sets show what a share of the criterion is worth in dB.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import spearmanr

from mgs.learning import fit_views, learn
from mgs.policy import certificate, poses
from mgs.policy.relaxation import Relaxation
from mgs.run.directional import DIRECTIONAL_D, Directional
from mgs.scene import Scene, State
from studies.case import Rock
from studies.output import Content, Panel, draw_panels, table
from studies.setups import SETUPS, Found, SetupSize, before_any_fit, case_of, shared_scene
from studies.statistics import interval
from studies.sweep import Cell
from studies.verdict import Row

SETUP = SETUPS["hemisphere"]

POLICIES = {policy.name: policy for policy in (Directional(), DIRECTIONAL_D)}

TRAINING = tuple(Rock(scene) for scene in ("boulder", "contact-binary", "low-sun", "pebbles"))
"""Rocks that chose the default of `enough`."""

COUNTS = (4, 8)
"""Sizes of plans."""

SHARES = (0.8, 0.85, 0.9, 0.95, 0.98)
"""Shares of the gain of all candidates at which greedy sets end."""

NODES, DRAWS, SIZE = 40, 20, 8
"""Nodes of branch and bound; random sets by the criterion; views of a random set that is fitted."""

BATCHES, BATCH, GAUSSIANS = 4, 50, 6000
"""Cells of random sets that are fitted, sets in each, and Gaussians of the priors of fits."""

KINDS = ("bound", "plan", "even", "random")
"""Keys of `mgs.policy.certificate.curve`."""


def cells_of(size: SetupSize, rocks: Iterable[Rock]) -> list[Cell]:
    """Cells of each rock: its dataset, prior, plans and fits. "part" of the last: plans, training,
    growing or random."""
    cells, rocks = [], list(rocks)
    parts: list[tuple[str, str, dict[str, Any], Sequence[Rock]]]
    parts = [("training", "growing", {}, TRAINING), ("growing", "growing", {}, rocks)]
    parts.append(("plans", "planned", {}, rocks))
    parts += [("random", "randomised", {"batch": k}, rocks) for k in range(BATCHES)]
    for part, task, arguments, some in parts:
        for rock in some:
            name = "/".join(["certificate", rock.name, part, *map(str, arguments.values())])
            one = size if part == "plans" else replace(size, gaussians=GAUSSIANS // size.fewer)
            case = case_of(rock, SETUP, one)
            *data, last = case.with_task(name, f"{__name__}:{task}", seed=rock.index, **arguments)
            about = {"rock": rock.name, "scene": rock.scene, "part": part}
            cells += [*data, replace(last, about=about)]
    return cells


def _of_rock(
    root: Path, dataset: str, prior: str, start: Callable[[Scene], State]
) -> tuple[Scene, State, list[int], dict[str, Relaxation], Any]:
    """Scene, state after the seeds, candidates, relaxations by policy, and PSNR of a model."""
    scene, tests, _, _ = shared_scene(root / dataset, root / prior, root / dataset, None)
    state = start(scene)
    free = [i for i in range(len(scene.frames)) if i not in state.taken]
    made = {name: policy.relaxation(scene, state, free) for name, policy in POLICIES.items()}
    return scene, state, free, made, tests


def planned(root: Path, out: Path, dataset: str, prior: str, seed: int) -> dict[str, Any]:
    """Task: "plans", a row for each policy and size; "curve", that of the first policy."""
    rng = np.random.default_rng(seed)

    def start(scene: Scene) -> State:
        return before_any_fit(scene, SETUP.seeds)

    scene, state, free, made, _ = _of_rock(root, dataset, prior, start)

    def plan(name: str, k: int) -> list[int]:
        return [free.index(i) for i in POLICIES[name].plan(scene, state, free, k, None)]

    positions, seeds = scene.positions(state.frames), list(state.taken)
    even = poses.spread(positions[free], positions[seeds], scene.centre)
    plans = []
    for name, one in made.items():
        for k in COUNTS:
            others = even[:k], draws(rng, len(free), k, DRAWS)
            plans.append({"policy": name} | compared(one, plan(name, k), *others))
    name, one = next(iter(made.items()))
    curve = certificate.curve(one, plan(name, max(COUNTS)), even)
    return {"gaussians": len(scene.prior.points), "plans": plans, "curve": curve}


def _psnr_of(
    root: Path, dataset: str, prior: str, sets_of: Callable[..., list[dict[str, Any]]]
) -> dict[str, Any]:
    """PSNR on test views of fits to sets, which start at the model of the seeds as in a run; and
    the sets' gains by policy."""

    def start(scene: Scene) -> State:
        return learn(scene, scene.seeds(SETUP.seeds))

    scene, state, free, made, tests = _of_rock(root, dataset, prior, start)
    rows = []
    for row in sets_of(made, len(free)):
        views = row.pop("set")
        frames = [*state.taken, *(free[v] for v in views)]
        psnr = tests(fit_views(scene, scene.frames, frames, state)[0].gaussians)["psnr"]
        gains = {name: one.gain(views) for name, one in made.items()}
        rows.append(row | {"views": len(views), "psnr": float(psnr.mean())} | gains)
    return {"sets": rows}


def growing(root: Path, out: Path, dataset: str, prior: str, seed: int) -> dict[str, Any]:
    """Task: "sets", the greedy sets of each policy that end at SHARES, and all candidates."""

    def sets_of(made: dict[str, Relaxation], count: int) -> list[dict[str, Any]]:
        rows: list[dict[str, Any]] = [
            {"policy": name, "share": share, "set": certificate.greedy(one, share)}
            for name, one in made.items()
            for share in SHARES
        ]
        return [*rows, {"policy": "", "share": 1.0, "set": list(range(count))}]

    return _psnr_of(root, dataset, prior, sets_of)


def randomised(
    root: Path, out: Path, dataset: str, prior: str, seed: int, batch: int
) -> dict[str, Any]:
    """Task: "sets", BATCH random sets of SIZE."""
    rng = np.random.default_rng([seed, batch])

    def sets_of(_: dict[str, Relaxation], count: int) -> list[dict[str, Any]]:
        return [{"set": some} for some in draws(rng, count, SIZE, BATCH)]

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


def rows_of(results: Found, cells: Sequence[Cell]) -> list[Row]:
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


def losses_of(results: Found, cells: Sequence[Cell]) -> list[Row]:
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


def _mean(rows: Sequence[Row], key: str, form: str) -> str:
    """Mean over scenes with its 95 % interval."""
    scenes: dict[str, list[float]] = {}
    for row in rows:
        scenes.setdefault(row["scene"], []).append(row[key])
    values = [float(np.mean(of)) for of in scenes.values()]
    ends, middle = interval(values), format(float(np.mean(values)), form)
    return middle if ends is None else f"{middle} [{ends[0]:{form}}, {ends[1]:{form}}]"


def text_of(rows: Sequence[Row], losses: Sequence[Row]) -> str:
    """Tables of plans, bounds, correlation and losses: means over scenes, 95 % intervals."""
    lines: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        lines.setdefault((row["policy"], row["views"]), []).append(row)
    shares: dict[tuple[Any, ...], list[Row]] = {}
    for row in losses:
        shares.setdefault((row["policy"], row["share"]), []).append(row)

    def of(key: str, form: str, part: str = "") -> Callable[[Row], str]:
        return lambda line: _mean(
            [row for row in line["of"] if not part or row["part"] == part], key, form
        )

    names = ("plan", "greedy", "farthest", "random, mean", f"random, best of {DRAWS}")
    keys = ("plan", "greedy", "farthest", "random", "random_best")
    of_sets: dict[str, Content] = {"policy": "policy", "views": "views:d"}
    of_sets |= {name: of(key, ".3f") for name, key in zip(names, keys, strict=True)}
    of_plans: dict[str, Content] = {
        "policy": "policy",
        "views": "views:d",
        "plan / relaxation": of("relaxed", ".3f"),
        "one view less / plan": of("fewer", ".3f"),
    }
    of_ranks: dict[str, Content] = {
        "policy": "policy",
        f"rank correlation, {BATCHES * BATCH} sets of {SIZE}": of("correlation", ".2f"),
    }
    of_losses: dict[str, Content] = {
        "policy": "policy",
        "share of all": "share:.2f",
        "views": of("views", ".1f", "growing"),
        "dB lost, training rocks": of("loss", ".2f", "training"),
        "dB lost, others": of("loss", ".2f", "growing"),
    }
    every = [{"policy": name, "views": k, "of": some} for (name, k), some in lines.items()]
    last = [line for line in every if line["views"] == max(COUNTS)]
    ends = [{"policy": name, "share": k, "of": some} for (name, k), some in shares.items()]
    made = ((of_sets, every), (of_plans, every), (of_ranks, last), (of_losses, ends))
    return "\n".join(table(*one) for one in made)


def curve_of(results: Found, cells: Sequence[Cell]) -> list[Row]:
    """Rows of the curve: rock, scene, views, kind (of KINDS), percent of the gain of all."""
    return [
        dict(cell.about) | {"views": row["views"], "kind": kind, "percent": 100 * row[kind]}
        for cell in _of_part("plans", cells)
        for row in results[cell.name]["curve"]
        for kind in KINDS
    ]


def draw(path: Path, curve: Sequence[Row]) -> None:
    """Draw gains against the number of views: bound, plan, farthest poses, random."""
    by_scene: dict[tuple[Any, ...], list[float]] = {}
    for row in curve:
        by_scene.setdefault((row["scene"], row["views"], row["kind"]), []).append(row["percent"])
    rows = [
        {"scene": scene, "views": views, "kind": kind, "percent": float(np.mean(of))}
        for (scene, views, kind), of in by_scene.items()
    ]
    label = "gain of all candidates (%)"
    title = "directional-i, after four seeds"
    draw_panels(path, [Panel("views", "percent", "views chosen", label, "kind", title=title)], rows)


if __name__ == "__main__":
    from studies.commands import start

    start("certificate")
