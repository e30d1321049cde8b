"""When to stop: images that rules take against the PSNR that they lose, on hemispheres of 36 views.

`python benchmarks/stopping.py OUT` runs `directional-d` from 4 to 30 images on eight rocks of eight
scenes (two CPU minutes each) and applies every rule to these runs. A rule's loss is against the 30
images. `mgs reproduce OUT --only setups` uses the same datasets and priors.
"""

import json
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.stats import spearmanr

from mgs import runtime

runtime.start()

from mgs.data.dataset import load_dataset  # noqa: E402
from mgs.prior.build import load_prior  # noqa: E402
from mgs.run.loop import select_views, uncertainty  # noqa: E402
from mgs.run.operations import operations_of, psnr_over  # noqa: E402
from mgs.run.problem import Problem  # noqa: E402
from mgs.run.settings import NbvSettings, with_defaults  # noqa: E402
from mgs.run.state import Learned  # noqa: E402
from mgs.splat import ListCache  # noqa: E402
from mgs.study.case import test_views_of  # noqa: E402
from mgs.study.reproduce import SIZES  # noqa: E402
from mgs.study.rocks import FRESH, Rock  # noqa: E402
from mgs.study.setups import SETUPS, case_of  # noqa: E402
from mgs.study.sweep import run_cells  # noqa: E402

Steps = list[dict[str, float]]

SETTINGS = {"policy": "directional-d", "seeds": 4, "budget": 26}


def run(out: Path, rock: Rock) -> Steps:
    """Steps of a run: images, test (PSNR, dB), uncertainty; gain and score of the last view, and
    surprise, the PSNR of the images before less that of its image before the fit."""
    case = case_of(rock, SETUPS["hemisphere"], SIZES["quick"].setups)
    run_cells(out, case.cells(), lambda cell, done, total: print(cell, flush=True))
    data, prior = load_dataset(out / case.dataset), load_prior(out / case.prior)
    given = {"dataset": out / case.dataset, "prior": out / case.prior, **SETTINGS}
    settings, cache = NbvSettings(**with_defaults(given)), ListCache()
    problem = Problem(data, settings, operations_of(data, prior, settings))
    tests = test_views_of(data).frames
    on_tests, on_views = psnr_over(tests, cache), psnr_over(data.frames, cache)
    steps: Steps = []
    last: Learned | None = None
    for state in select_views(problem):
        assert isinstance(state, Learned)
        step = {"images": len(state.taken), "uncertainty": uncertainty(problem, state)}
        if last is not None:
            fitted, new = (
                on_views(last.gaussians, v)["psnr"] for v in (last.taken, state.taken[-1:])
            )
            step["surprise"] = float(fitted.mean() - new.mean())
            step |= {"gain": state.choices[0].information_gain, "score": state.choices[0].score}
        step["test"] = float(on_tests(state.gaussians, range(len(tests)))["psnr"].mean())
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
    for n in (12, 14, 16, 18, 20):
        found[f"{n} images"] = lambda s, n=n: n - 4
    for g in (0.025, 0.02, 0.015):
        found[f"--stop-gain {g}"] = before(lambda s, k, g=g: s[k]["gain"] < g)
    for f in (0.4, 0.3, 0.2):
        name = f"score below {f:.0%} of the first"
        found[name] = before(lambda s, k, f=f: s[k]["score"] < f * s[1]["score"])
    for u in (0.7, 0.69, 0.68):
        found[f"--stop-uncertainty {u}"] = after(lambda s, k, u=u: s[k]["uncertainty"] <= u)
    for d in (3, 2.5, 2):
        found[f"surprise below {d} dB"] = after(lambda s, k, d=d: s[k]["surprise"] <= d)
    return found


def main(out: Path) -> None:
    """Run all rocks that are not done, and print a table."""
    runs = []
    for rock in FRESH[:8]:
        path = out / f"stopping-{rock.name}.json"
        if not path.is_file():
            path.write_text(json.dumps(run(out, rock)))
        runs.append(json.loads(path.read_text()))
    for name, rule in rules().items():
        ends = [(steps, rule(steps)) for steps in runs]
        images = np.array([steps[k]["images"] for steps, k in ends])
        lost = np.array([steps[-1]["test"] - steps[k]["test"] for steps, k in ends])
        print(
            f"| {name} | {images.mean():.1f} | {images.min():.0f} to {images.max():.0f} | "
            f"{lost.mean():.2f} | {lost.std(ddof=1):.2f} | {lost.max():.2f} |"
        )
    won = [b["test"] - a["test"] for steps in runs for a, b in pairwise(steps)]
    for key in ("gain", "score", "surprise"):
        told = [s[key] / steps[1][key] for steps in runs for s in steps[1:]]
        print(f"{key}: Spearman with the gain of PSNR {spearmanr(told, won).statistic:.2f}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
