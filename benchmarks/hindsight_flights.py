"""Shortest flights in hindsight: may any planner need 70 % of the metres of even spacing on a dome?

A flight is improved by annealing: one to three neighbouring stops are dropped, others inserted
until none fits, and the result is kept by the PSNR of its own fit on the test views. So the search
knows the images and the test views, which no planner does.

    python benchmarks/hindsight_flights.py OUT [--fits 500]

Rocks are four that judge nothing. OUT is a study folder; a run continues in it. Prints for each
rock and length the metres over those of even spacing with the same PSNR, of the planned tour and of
the best flight found.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from mgs.policy import tour
from mgs.run.loop import fit_views
from mgs.run.problem import Problem
from mgs.study.flights import EVEN_IMAGES, FLIERS, LENGTHS, OURS, evenly_spaced, short_tour
from mgs.study.rocks import Rock
from mgs.study.setups import SETUPS, SetupSize, case_of, shared_problem
from mgs.study.sweep import run_cells

ROCKS = tuple(Rock(scene, 1) for scene in ("boulder", "pebbles", "strata", "contact-binary"))
DETOUR = 0.05  # a stop's chance to be inserted falls by e for each such share of the limit
HEAT = 0.15  # PSNR that a worse flight may lose at the start, dB
IDLE = 3000  # tries without a new set of stops after which the search ends

Judge = Callable[[Sequence[int]], float]


def judge_of(problem: Problem, tests: Callable, memory: Path) -> Judge:
    """PSNR on the test views of a fit to some views; remembered in a file."""
    known = dict[tuple[int, ...], float]()
    if memory.exists():
        known = {tuple(views): psnr for views, psnr in map(json.loads, memory.open())}

    def judged(views: Sequence[int]) -> float:
        key = tuple(sorted(int(view) for view in views))
        if key not in known:
            found = tests(fit_views(problem, list(key)).gaussians)
            known[key] = float(found["psnr"].mean())
            with memory.open("a") as file:
                file.write(json.dumps([key, known[key]]) + "\n")
        return known[key]

    return judged


def filled(legs: np.ndarray, way: list[int], banned: set[int], limit: float, rng) -> list[int]:
    """A tour with random stops inserted at their cheapest places until none fits."""
    while True:
        free = [i for i in range(len(legs)) if i not in way and i not in banned]
        if not free:
            return way
        added, places = tour.insertions(legs, way, free)
        fits = np.flatnonzero(tour.tour_length(legs, way) + added <= limit)
        if not len(fits):
            return way
        chance = np.exp(-added[fits] / (DETOUR * limit))
        k = rng.choice(fits, p=chance / chance.sum())
        way = tour.two_opt(legs, [*way[: places[k]], free[k], *way[places[k] :]])


def best_in_hindsight(
    problem: Problem, start: Sequence[int], limit: float, judged: Judge, fits: int
) -> list[int]:
    """The best flight found from this one."""
    legs, home, rng = problem.flight.legs, problem.flight.home, np.random.default_rng(0)
    way, reached = [*start, home], judged(start)
    best, most, seen, idle = way, reached, set(), 0
    while len(seen) < fits and idle < IDLE:
        first, width = rng.integers(1, max(2, len(way) - 1)), rng.integers(1, 4)
        dropped = way[first : first + width][: len(way) - 1 - first]
        kept = [stop for stop in way[1:-1] if stop not in dropped]
        banned = {int(rng.choice(dropped))} if dropped else set()
        new = filled(legs, tour.two_opt(legs, [home, *kept, home]), banned, limit, rng)
        key = tuple(sorted(new))
        idle, psnr = (idle + 1 if key in seen else 0), judged(new[:-1])
        seen.add(key)
        heat = max(HEAT * (1 - len(seen) / fits), 1e-3)
        if psnr >= reached or rng.random() < np.exp((psnr - reached) / heat):
            way, reached = new, psnr
        if psnr > most:
            best, most = new, psnr
    return best[:-1]


def ratio(
    way: Sequence[int], problem: Problem, judged: Judge, metres: np.ndarray, psnr: np.ndarray
) -> float:
    """Metres of a flight over those with which even spacing has its PSNR."""
    return problem.flight.metres(way) / float(np.interp(judged(way), psnr, metres))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--fits", type=int, default=500)
    given = parser.parse_args()
    out, size, ratios = given.out.resolve(), SetupSize(gaussians=6000), {}
    cases = {rock: case_of(rock, SETUPS["one seed"], size) for rock in ROCKS}
    run_cells(out, [c for case in cases.values() for c in case.cells()], lambda *at: print(*at))
    for rock, case in cases.items():
        folders = out / case.dataset, out / case.prior, out / case.dataset
        problem, tests, _, _ = shared_problem(*folders, None, 1, SETUPS["one seed"].frames - 1)
        problem = problem.with_settings(policy="directional-d")
        judged = judge_of(problem, tests, out / f"{rock.name}.jsonl")
        everywhere = [*problem.seeds, *problem.reachable(problem.seeds)]
        whole = problem.flight.metres(short_tour(problem, everywhere))
        even = [evenly_spaced(problem, count) for count in EVEN_IMAGES]
        metres, psnr = np.array(sorted((problem.flight.metres(w), judged(w)) for w in even)).T
        known = problem, judged, metres, np.maximum.accumulate(psnr)
        for length in LENGTHS:
            planned = FLIERS[OURS][0](problem.with_settings(flight_length=length * whole))
            limit = length * whole * (1 + tour.ROUNDING)
            best = best_in_hindsight(problem, planned, limit, judged, given.fits)
            ratios[rock.name, length] = ratio(planned, *known), ratio(best, *known)
            print(f"{rock.name} {length:.0%}: {ratios[rock.name, length]}", flush=True)
    for length in LENGTHS:
        mean = np.mean([ratios[rock.name, length] for rock in ROCKS], axis=0)
        print(f"mean {length:.0%}: planned {mean[0]:.3f}, in hindsight {mean[1]:.3f}")


if __name__ == "__main__":
    main()
