"""Flights with a limit: PSNR against metres of a policy that plans a tour, and of others.

Every flight starts and ends at the same pose. One fit to its images from the prior is judged on the
test views. Even spacing is flown with many numbers of images. So for the PSNR of another flight
there are the metres with which even spacing has the same.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

import mgs
from mgs.learning import fit_views
from mgs.policy import tour
from mgs.policy.poses import travel_cost
from mgs.run.choosing import planned_flight, rated
from mgs.run.flight import flight_of, reachable
from mgs.run.policies import DIRECTIONAL_D
from mgs.run.settings import FlightLimits
from studies.frame.case import ROCKS
from studies.frame.output import (
    Content,
    Panel,
    draw_panels,
    grouped,
    over_scenes,
    scene_mean,
    table,
    write_table,
)
from studies.frame.program import WORKERS, Study, Work, study_of
from studies.frame.statistics import Row
from studies.frame.sweep import Cell
from studies.policies import angle
from studies.setups import SETUPS, Results, SetupSize, before_any_fit, case_of, shared_scene, sized

SIZES = {
    "quick": SetupSize(gaussians=6000, passes=10),
    "paper": SetupSize(320, 240, 24, 16, passes=10),
}

POOLS = {"dome": SETUPS["one seed"], "mixed distances": SETUPS["mixed distances"]}
"""Candidates; the flight starts with one seed in both."""

LENGTHS = (0.2, 0.35, 0.55)
"""Lengths of a flight over that of a short tour through all candidates."""

EVEN, EVEN_IMAGES = "even spacing", (2, 3, 4, 5, 6, 8, 11, 15, 20, 27, 36)
"""Baseline, and its numbers of images."""

OURS = "planned tour"
Flier = Callable[[mgs.Scene, mgs.State, mgs.Mission], list[int]]
"""(scene, state after the seed, mission with a limit) -> the views of a flight in flying order."""


def one_by_one(scene: mgs.Scene, state: mgs.State, mission: mgs.Mission) -> list[int]:
    """Views of the largest score / travel cost in reach, one after another."""
    while views := reachable(scene, state, mission):
        cost = None
        if mission.travel is not None:
            positions = scene.positions(state.frames)
            cost = travel_cost(positions[views], positions[state.taken[-1]], mission.travel)
        view, _ = rated(scene, state, DIRECTIONAL_D, views, cost)[0]
        state = replace(state, taken=(*state.taken, view))
    return list(state.taken)


def cut(scene: mgs.Scene, state: mgs.State, mission: mgs.Mission) -> list[int]:
    """Views in the order of a choice without a limit, as many as a short tour can take."""
    flight = flight_of(scene, state, mission)
    order = one_by_one(scene, state, mission.model_copy(update={"flight": FlightLimits()}))
    flown = [short_tour(flight.legs, order[:count]) for count in range(1, len(order) + 1)]
    return max((way for way in flown if flight.share(flight.metres(way), len(way)) <= 1), key=len)


def planned(scene: mgs.Scene, state: mgs.State, mission: mgs.Mission) -> list[int]:
    """Views of the tour that the policy plans."""
    return [*state.taken, *planned_flight(scene, state, DIRECTIONAL_D, mission)]


def short_tour(legs: np.ndarray, views: Sequence[int]) -> list[int]:
    """Order the views along a short tour from the first one and back."""
    home, *stops = views
    return [home, *tour.flying_order(legs, home, stops, home)]


def evenly_spaced(scene: mgs.Scene, state: mgs.State, count: int) -> list[int]:
    """`count` views, each the farthest in direction from those before."""
    chosen, positions = list(state.taken), scene.positions(state.frames)
    while len(chosen) < count:
        others = [i for i in range(len(state.frames)) if i not in chosen]
        apart = angle(positions[others], positions[chosen], scene.centre)
        chosen.append(others[int(apart.argmax())])
    return chosen


FLIERS: Mapping[str, tuple[Flier, dict[str, Any]]] = {
    OURS: (planned, {}),
    "score / (1 + metres)": (one_by_one, {"travel": 1.0}),
    "five nearest": (one_by_one, {"nearest": 5}),
    "no limit, cut": (cut, {}),
}
"""Fliers by name, all with `directional-d`, and fields of their `Mission`."""


def cells_of(size: SetupSize) -> list[Cell]:
    """A cell for each rock and pool, with its dataset and prior."""
    cells: list[Cell] = []
    for rock, (name, setup) in product(size.rocks, POOLS.items()):
        count = "" if size.gaussians is None else f"-{size.gaussians}"
        folder = f"{name.replace(' ', '-')}-{size.width}x{size.height}{count}"
        cells += case_of(rock, setup, size).with_task(
            f"flights/{rock.name}/{folder}",
            f"{__name__}:fly_and_judge",
            about={"pool": name},
            frames=setup.frames // size.fewer,
            passes=size.passes,
        )
    return cells


def fly_and_judge(
    root: Path, out: Path, dataset: str, prior: str, frames: int, passes: int
) -> dict[str, Any]:
    """Task: fly every policy with every length, and judge a fit to each flight's images.

    Returns "whole", metres of a short tour through all candidates, and "flights": for each one
    "policy", "length" over `whole` (None for even spacing), "images", "metres", "psnr" and
    "psnr_mask" over the test views, dB, and "taken".
    """
    scene, tests, _ = shared_scene(root / dataset, root / prior, None)
    state, mission = before_any_fit(scene, scene.seeds(1)), mgs.Mission(seeds=1, budget=frames - 1)
    anywhere = flight_of(scene, state, mission)
    everywhere = [*state.taken, *reachable(scene, state, mission)]
    whole = anywhere.metres(short_tour(anywhere.legs, everywhere))
    train = scene.settings.train.model_copy(update={"passes": passes})

    @cache
    def judged(views: tuple[int, ...]) -> dict[str, float]:
        on = tests(fit_views(scene, scene.frames, views, train=train)[0].gaussians)
        return {key: float(on[key].mean()) for key in ("psnr", "psnr_mask")}

    def flight(policy: str, length: float | None, taken: list[int]) -> Row:
        row: Row = {"policy": policy, "length": length, "images": len(taken)}
        row |= {"metres": anywhere.metres(taken), **judged(tuple(sorted(taken)))}
        return row | {"taken": [int(i) for i in taken]}

    even = (evenly_spaced(scene, state, n) for n in EVEN_IMAGES if n <= frames)
    flights = [flight(EVEN, None, short_tour(anywhere.legs, views)) for views in even]
    for policy, (fly, settings) in FLIERS.items():
        for length in LENGTHS:
            limits = {"flight": FlightLimits(length=length * whole), **settings}
            limited = mission.model_copy(update=limits)
            flights.append(flight(policy, length, fly(scene, state, limited)))
    return {"whole": whole, "flights": flights}


def rows_of(results: Results, cells: Sequence[Cell]) -> list[Row]:
    """A row for each flight, with "gain": dB over even spacing with the same metres, and "ratio":
    metres over those with which even spacing has the same PSNR, both interpolated. The ratio is
    None where the PSNR is below that of the shortest flight with even spacing."""
    rows: list[Row] = []
    for cell in (cell for cell in cells if cell.about):
        flights = results[cell.name]["flights"]
        even = sorted((one["metres"], one["psnr"]) for one in flights if one["policy"] == EVEN)
        metres, psnr = np.array(even).T
        psnr = np.maximum.accumulate(psnr)
        for one in flights:
            row = cell.about | {key: value for key, value in one.items() if key != "taken"}
            if one["policy"] != EVEN:
                row["gain"] = one["psnr"] - float(np.interp(one["metres"], metres, psnr))
                same = float(np.interp(one["psnr"], psnr, metres))
                row["ratio"] = one["metres"] / same if one["psnr"] >= psnr[0] else None
            rows.append(row)
    return rows


COLUMNS: dict[str, Content] = {
    "candidates": "pool",
    "length": "length:.0%",
    "policy": "policy",
    "images": scene_mean("images", ".1f", ends=False),
    "PSNR (dB)": scene_mean("psnr", ".2f", ends=False),
    "over even spacing (dB)": scene_mean("gain", "+.2f"),
    "metres / even spacing's": scene_mean("ratio", ".2f"),
}


def tables(rows: Sequence[Row]) -> str:
    """A line for each pool, length and policy: means over scenes with 95 % intervals."""
    limited = [row for row in rows if row["length"] is not None]
    lines = grouped(limited, "pool", "length", "policy")
    return table(COLUMNS, sorted(lines, key=lambda line: (line["pool"], line["length"])))


def draw(path: Path, rows: Sequence[Row]) -> None:
    """Draw the metres over those of even spacing against the length, means over scenes."""
    limited = [row for row in rows if row["length"] is not None]
    shown = [
        group | {"percent": 100 * group["length"], "ratio": ratio}
        for group in grouped(limited, "pool", "policy", "length")
        for ratio in over_scenes(group["of"], "ratio").values()
    ]
    labels = "flight / whole tour (%)", "metres / even spacing's"
    panels = [
        Panel("percent", "ratio", *labels, "policy", only=(("pool", pool),), title=pool)
        for pool in POOLS
    ]
    draw_panels(path, panels, shown, "Metres of a flight over even spacing's with the same PSNR")


def write(work: Work) -> list[Path]:
    """Write flights.csv, .json, .md and .png."""
    rows = rows_of(work.results, work.cells)
    draw(work.out / "flights.png", rows)
    paths = write_table(work, "flights", rows, tables(rows), rocks=len(work.size.rocks))
    return [*paths, work.out / "flights.png"]


STUDY = Study("flights", __doc__, write, SIZES, cells_of, ROCKS | WORKERS, sized)

if __name__ == "__main__":
    study_of("flights")()
