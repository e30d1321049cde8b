"""Plans against upper bounds of all sets of views, and the criterion against PSNR.

After the seeds, plans of several sizes and other sets are compared with the bound of
`mgs.policy.certificate`. Then fits to random sets and to sets of growing size show what a share of
the criterion is worth in dB.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import spearmanr

from mgs.learning import fit_views
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

COUNTS = (4, 8)
"""Sizes of plans."""

GROWING = (1, 2, 3, 4, 6, 8, 10, 12, 16, 20, 24)
"""Sizes of the sets of the curve, and of those that are fitted."""

NODES, DRAWS, SETS, SIZE = 40, 20, 40, 8
"""Nodes of branch and bound; random sets by the criterion; random sets that are fitted, and their
size."""

KINDS = ("bound", "plan", "farthest", "random")
"""Keys of the curve."""


def cells_of(size: SetupSize, rocks: Iterable[Rock]) -> list[Cell]:
    """A cell for each rock, with its dataset and prior."""
    cells = []
    for rock in rocks:
        case = case_of(rock, SETUP, size)
        name = f"certificate/{rock.name}/{size.width}x{size.height}"
        *data, last = case.with_task(name, f"{__name__}:certified", seed=rock.index)
        cells += [*data, replace(last, about={"rock": rock.name, "scene": rock.scene})]
    return cells


def certified(root: Path, out: Path, dataset: str, prior: str, seed: int) -> dict[str, Any]:
    """Task: "plans", a row for each policy and size; "curve", a row for each of GROWING, as shares
    of the gain of all candidates; "sets", criterion and PSNR of sets. Gains are those after the
    seeds."""
    scene, tests, _, _ = shared_scene(root / dataset, root / prior, root / dataset, None)
    state, rng = before_any_fit(scene, SETUP.seeds), np.random.default_rng(seed)
    free = [i for i in range(len(scene.frames)) if i not in state.taken]
    made = {name: policy.relaxation(scene, state, free) for name, policy in POLICIES.items()}

    def planned(name: str, k: int) -> list[int]:
        return [free.index(i) for i in POLICIES[name].plan(scene, state, free, k, None)]

    plans, curve = [], []
    for name, one in made.items():
        for k in COUNTS:
            others = spread(scene, state, free, k), draws(rng, len(free), k, DRAWS)
            plans.append({"policy": name} | compared(one, planned(name, k), *others))
    name, one = next(iter(made.items()))
    for k in GROWING:
        gains = {
            "bound": certificate.upper_bound(one, k).value,
            "plan": one.gain(planned(name, k)),
            "farthest": one.gain(spread(scene, state, free, k)),
            "random": float(np.mean([one.gain(some) for some in draws(rng, len(free), k, 5)])),
        }
        every = one.gain(range(len(free)))
        curve.append({"views": k} | {key: gain / every for key, gain in gains.items()})
    sets = [("greedy", certificate.greedy(one, 1.0, most=k)) for k in GROWING]
    sets += [("random", some) for some in draws(rng, len(free), SIZE, SETS)]
    sets.append(("all", list(range(len(free)))))
    rows = []
    for kind, views in sets:
        frames = [*state.taken, *(free[v] for v in views)]
        psnr = tests(fit_views(scene, scene.frames, frames)[0].gaussians)["psnr"]
        gains = {name: one.gain(views) for name, one in made.items()}
        rows.append({"kind": kind, "views": len(views), "psnr": float(psnr.mean())} | gains)
    count = len(scene.prior.points)
    return {"gaussians": count, "plans": plans, "curve": curve, "sets": rows}


def draws(rng: np.random.Generator, count: int, k: int, number: int) -> list[list[int]]:
    """Random sets of k out of `count`."""
    return [rng.choice(count, k, replace=False).tolist() for _ in range(number)]


def spread(scene: Scene, state: State, free: Sequence[int], k: int) -> list[int]:
    """The k candidates that the policy `farthest` takes after the seeds."""
    taken, positions = list(state.taken), scene.positions(state.frames)
    for _ in range(k):
        others = [i for i in free if i not in taken]
        apart = poses.farthest_pose(positions[others], positions[taken], scene.centre)
        taken.append(others[int(apart.argmax())])
    return [free.index(i) for i in taken[len(state.taken) :]]


def compared(
    made: Relaxation, plan: Sequence[int], even: Sequence[int], random: Sequence[Sequence[int]]
) -> Row:
    """Gains of a plan and of other sets of as many views, their bounds, and CPU seconds."""
    k, start = len(plan), time.process_time()
    bound = certificate.upper_bound(made, k)
    seconds = time.process_time() - start
    best = certificate.best_set(made, plan, most=NODES)
    gains = [made.gain(some) for some in random]
    return {
        "views": k,
        "candidates": made.candidates,
        "plan": made.gain(plan),
        "greedy": made.gain(certificate.greedy(made, 1.0, most=k)),
        "farthest": made.gain(even),
        "random": float(np.mean(gains)),
        "random_best": float(np.max(gains)),
        "relaxed": bound.value,
        "gap": bound.gap,
        "bound": best.bound,
        "best": best.gain,
        "nodes": best.nodes,
        "fewer": certificate.upper_bound(made, k - 1).value,
        "all": made.gain(range(made.candidates)),
        "bound_seconds": seconds,
        "seconds": time.process_time() - start,
    }


def rows_of(results: Found, cells: Sequence[Cell]) -> list[Row]:
    """A row for each rock, policy and size of a plan: gains as shares of the bound; "correlation"
    of the criterion and PSNR over random sets; "loss" of PSNR, dB, at the first greedy set with 80,
    90 and 95 % of the gain of all, interpolated."""
    rows: list[Row] = []
    for cell in (cell for cell in cells if cell.about):
        found = results[cell.name]
        for plan in found["plans"]:
            keys = ("plan", "greedy", "farthest", "random", "random_best", "best")
            shares = {key: plan[key] / plan["bound"] for key in keys}
            shares["relaxed"] = plan["plan"] / plan["relaxed"]
            shares["fewer"] = plan["fewer"] / plan["plan"]
            more = {key: plan[key] for key in ("policy", "views", "nodes", "bound_seconds")}
            rows.append(
                dict(cell.about) | more | shares | _in_decibels(found["sets"], plan["policy"])
            )
    return rows


def _in_decibels(sets: Sequence[Row], policy: str) -> Row:
    """Correlation and losses of `rows_of`."""
    random = [one for one in sets if one["kind"] == "random"]
    growing, every = [one for one in sets if one["kind"] == "greedy"], sets[-1]
    share = [one[policy] / every[policy] for one in growing]
    loss = [every["psnr"] - one["psnr"] for one in growing]
    rank = spearmanr([one[policy] for one in random], [one["psnr"] for one in random])
    losses = {f"loss_{p}": float(np.interp(p / 100, share, loss)) for p in (80, 90, 95)}
    return {"correlation": float(rank.statistic)} | losses


def text_of(rows: Sequence[Row]) -> str:
    """A line for each policy and size: means over scenes with 95 % intervals."""
    lines: dict[tuple[str, int], list[Row]] = {}
    for row in rows:
        lines.setdefault((row["policy"], row["views"]), []).append(row)

    def mean(key: str, form: str) -> Callable[[Row], str]:
        def cell(line: Row) -> str:
            scenes: dict[str, list[float]] = {}
            for row in line["of"]:
                scenes.setdefault(row["scene"], []).append(row[key])
            values = [float(np.mean(of)) for of in scenes.values()]
            ends, middle = interval(values), format(float(np.mean(values)), form)
            return middle if ends is None else f"{middle} [{ends[0]:{form}}, {ends[1]:{form}}]"

        return cell

    shares = ("plan", "greedy", "farthest", "random", "random_best")
    names = ("plan", "greedy", "farthest", "random, mean", f"random, best of {DRAWS}")
    of_sets: dict[str, Content] = {"policy": "policy", "views": "views:d"}
    of_sets |= {name: mean(key, ".3f") for name, key in zip(names, shares, strict=True)}
    of_plans: dict[str, Content] = {
        "policy": "policy",
        "views": "views:d",
        "plan / relaxation": mean("relaxed", ".3f"),
        "one view less / plan": mean("fewer", ".3f"),
        "CPU s of the relaxation": mean("bound_seconds", ".2f"),
    }
    of_psnr: dict[str, Content] = {
        "policy": "policy",
        f"rank correlation, {SETS} sets of {SIZE}": mean("correlation", ".2f"),
        "dB lost at 80 %": mean("loss_80", ".2f"),
        "at 90 %": mean("loss_90", ".2f"),
        "at 95 %": mean("loss_95", ".2f"),
    }
    every = [{"policy": name, "views": k, "of": of} for (name, k), of in lines.items()]
    last = [line for line in every if line["views"] == max(COUNTS)]
    return "\n".join([table(of_sets, every), table(of_plans, every), table(of_psnr, last)])


def curve_of(results: Found, cells: Sequence[Cell]) -> list[Row]:
    """Rows of the curve: rock, scene, views, kind (of KINDS), percent of the gain of all."""
    return [
        dict(cell.about) | {"views": row["views"], "kind": kind, "percent": 100 * row[kind]}
        for cell in cells
        if cell.about
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
