"""When to stop: images and metres that rules save against the PSNR that they lose.

`python benchmarks/stopping.py OUT` runs `directional-d` from 4 to 30 images on hemispheres of 36
views around eight rocks of eight scenes, and applies every rule to these runs. Losses and savings
are against the 30 images; metres are the way through the views in the order taken.
"""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from mgs import runtime

runtime.start()

from mgs.data.dataset import load_dataset  # noqa: E402
from mgs.prior.build import load_prior  # noqa: E402
from mgs.run.loop import select_views, uncertainty  # noqa: E402
from mgs.run.operations import operations_of, psnr_over  # noqa: E402
from mgs.run.planning import rated  # noqa: E402
from mgs.run.prediction import predicted_psnr  # noqa: E402
from mgs.run.problem import Problem  # noqa: E402
from mgs.run.settings import NbvSettings, with_defaults  # noqa: E402
from mgs.run.state import Learned  # noqa: E402
from mgs.splat import ListCache  # noqa: E402
from mgs.study.case import test_views_of  # noqa: E402
from mgs.study.reproduce import SIZES  # noqa: E402
from mgs.study.rocks import FRESH, Rock  # noqa: E402
from mgs.study.setups import SETUPS, case_of  # noqa: E402
from mgs.study.sweep import run_cells  # noqa: E402

Steps = list[dict[str, Any]]

SETTINGS = {"policy": "directional-d", "seeds": 4, "budget": 26}


def run(out: Path, rock: Rock) -> Steps:
    """Steps of a run: images, metres, PSNR and masked PSNR of test views, uncertainty, the
    prediction; gain and score of the last view."""
    case = case_of(rock, SETUPS["hemisphere"], SIZES["quick"].setups)
    run_cells(out, case.cells(), lambda cell, done, total: print(cell, flush=True))
    data, prior = load_dataset(out / case.dataset), load_prior(out / case.prior)
    given = {"dataset": out / case.dataset, "prior": out / case.prior, **SETTINGS}
    settings, cache = NbvSettings(**with_defaults(given)), ListCache()
    problem = Problem(data, settings, operations_of(data, prior, settings))
    tests = test_views_of(data).frames
    on_tests, on_views = psnr_over(tests, cache), psnr_over(data.frames, cache)
    steps: Steps = []
    entries: list[dict[str, float]] = []
    last: Learned | None = None
    for state in select_views(problem):
        assert isinstance(state, Learned)
        way = problem.positions[state.taken]
        step: dict[str, Any] = {"images": len(state.taken)}
        step["metres"] = float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum())
        step["uncertainty"] = uncertainty(problem, state)
        fitted = on_views(state.gaussians, state.taken)["psnr_mask"]
        entry = {"fitted": float(np.mean(10 ** (-fitted / 10)))}
        if last is not None:
            choice = state.choices[0]
            step |= {"gain": choice.information_gain, "score": choice.score}
            new = on_views(last.gaussians, state.taken[-1:])["psnr_mask"]
            entry |= {"new": float(10 ** (-new[0] / 10)), "gain": choice.score}
        left = [i for i in range(len(problem.frames)) if i not in state.taken]
        scores = rated(problem, problem.context(state, left))
        entry["left"] = float(np.mean([score for _, score in scores]))
        entries.append(entry)
        step["predicted"] = predicted_psnr(entries) or 0.0
        on = on_tests(state.gaussians, range(len(tests)))
        step |= {"psnr": float(on["psnr"].mean()), "mask": float(on["psnr_mask"].mean())}
        steps.append(step)
        last = state
    return steps


def before(holds: Callable[[Steps, int], bool]) -> Callable[[Steps], int]:
    """Stop before the first view of which this holds, since it is known before its image."""
    return lambda s: next((k - 1 for k in range(1, len(s)) if holds(s, k)), len(s) - 1)


def after(holds: Callable[[Steps, int], bool]) -> Callable[[Steps], int]:
    """Stop after the first view of which this holds."""
    return lambda s: next((k for k in range(1, len(s)) if holds(s, k)), len(s) - 1)


def rules() -> dict[str, Callable[[Steps], int]]:
    """Rules by name."""
    found: dict[str, Callable[[Steps], int]] = {}
    for n in range(8, 30):
        found[f"{n} images"] = lambda s, n=n: n - 4
    for g in (0.03, 0.025, 0.02, 0.015):
        found[f"--stop-gain {g}"] = before(lambda s, k, g=g: s[k]["gain"] < g)
    for f in (0.4, 0.3, 0.2):
        name = f"score below {f:.0%} of the first"
        found[name] = before(lambda s, k, f=f: s[k]["score"] < f * s[1]["score"])
    for u in (0.7, 0.69, 0.68):
        found[f"--stop-uncertainty {u}"] = after(lambda s, k, u=u: s[k]["uncertainty"] <= u)
    for d in (24, 25, 26, 27, 28, 29):
        found[f"--stop-psnr {d}"] = after(lambda s, k, d=d: s[k]["predicted"] >= d)
    return found


def main(out: Path) -> None:
    """Run all rocks that are not done, and print a table."""
    runs = []
    for rock in FRESH[:8]:
        path = out / f"stopping-{rock.name}.json"
        if not path.is_file():
            path.write_text(json.dumps(run(out, rock)))
        runs.append(json.loads(path.read_text()))
        wrong = np.array([s["predicted"] - s["mask"] for s in runs[-1]][6:])
        print(f"{rock.name}: predicted less true, {wrong.mean():.2f} sd {wrong.std():.2f} dB")
    for name, rule in rules().items():
        ends = [(steps, steps[rule(steps)]) for steps in runs]
        images = np.array([end["images"] for _, end in ends])
        saved = np.mean([1 - end["metres"] / steps[-1]["metres"] for steps, end in ends])
        mask = np.array([end["mask"] for _, end in ends])
        lost = np.array([steps[-1]["psnr"] - end["psnr"] for steps, end in ends])
        print(
            f"| {name} | {images.mean():.1f} ({images.min()} to {images.max()}) | {saved:.0%} | "
            f"{lost.mean():.2f} ({lost.std(ddof=1):.2f}; {lost.max():.2f}) | "
            f"{mask.mean():.2f} ({mask.std(ddof=1):.2f}; {mask.min():.2f}) |"
        )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
