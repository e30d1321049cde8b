"""The paper's figures 2 and 3: gain and coverage over fifty choices of the 100 views of a ring.

Four even seeds, then one view at a time, by Eq. 7 or by coverage-greedy choice; and one seed, to
test Eq. 13. "To the letter" is as in `studies.paper`, except that a Gaussian is observed (Eq. 9)
with the lambda of mgs.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

import mgs
from mgs.policy.criteria import coverage, d_optimal
from mgs.run.policies import Policy, each
from studies.frame.case import ROCKS
from studies.frame.output import (
    Panel,
    draw_panels,
    grouped,
    scene_mean,
    table,
    text_of,
    write_table,
)
from studies.frame.program import WORKERS, Study, Work, study_of
from studies.frame.statistics import Row
from studies.frame.sweep import Cell
from studies.paper import DEFAULT, LETTER, OF_MGS, OURS, Letter, follow, scene_of
from studies.setups import RING, Setup, SetupSize, case_of, shared_scene, sized

VIEWS, CHOICES = 100, 50

SIZES = {"quick": SetupSize(96, 72), "paper": SetupSize(320, 240, 24, 16)}

GREEDY = "coverage-greedy, to the letter"

EXACT = "exact information, else to the letter"


def exact_letter(scene: mgs.Scene, state: mgs.State, views: list[int]) -> np.ndarray:
    """Eq. 7 by the exact diagonal of J^T J [C]; lambda is its mean for one view taken, as in
    `mgs.Paper`."""
    H = np.stack([scene.information(state, i) for i in state.taken]).sum(axis=0, dtype=np.float64)
    lam = np.full_like(scene.lam, H.mean() / len(state.taken))
    return each(views, lambda i: d_optimal(scene.information(state, i), H, lam))


POLICIES: dict[str, Policy] = {LETTER: Letter(), OURS: mgs.Paper(), GREEDY: mgs.Coverage()}

POLICIES_FROM_ONE: dict[str, Any] = {
    LETTER: Letter(), OURS: mgs.Paper(), EXACT: exact_letter, DEFAULT: mgs.Directional(),
}  # fmt: skip


def cells_of(size: SetupSize) -> list[Cell]:
    """A cell for each rock and policy, with datasets and priors."""
    cells: list[Cell] = []
    for rock in size.rocks:
        case = case_of(rock, Setup(RING, VIEWS), size)
        for seeds, policies in ((4, POLICIES), (1, POLICIES_FROM_ONE)):
            task, end = ("run", "") if seeds == 4 else ("run_from_one", "-one")
            for k, variant in enumerate(policies):
                plain = {} if variant in OF_MGS else {"backing": 0.0}
                one = replace(case, settings={**case.settings, **plain})
                name, about = f"ring/{rock.name}/{k}{end}", {"variant": variant, "seeds": seeds}
                cells += one.with_task(name, f"{__name__}:{task}", about=about, variant=variant)
    return cells


def run(root: Path, out: Path, dataset: str, prior: str, variant: str) -> dict[str, Any]:
    """Task: choose CHOICES views. Returns "test" and "pool", PSNR of the last model on test views
    and over all views, dB; "score" of each choice; and "observed", share of the Gaussians that the
    views taken observe (Eq. 9), after the seeds and after each choice."""
    whole, tests, pool = shared_scene(root / dataset, root / prior, None)
    scene, scores, observed = scene_of(whole, variant), [], []
    for state, score in follow(scene, POLICIES[variant], CHOICES):
        scores.append(score)
        observed.append(coverage(state.surface, scene.surface_lam))
    on_tests, on_pool = tests(state.gaussians), pool(state.gaussians)
    return {
        "test": float(on_tests["psnr"].mean()),
        "pool": float(on_pool["psnr"].mean()),
        "score": scores[1:],
        "observed": observed,
    }


def run_from_one(root: Path, out: Path, dataset: str, prior: str, variant: str) -> dict[str, float]:
    """Task: choose three views after one seed. Returns "opposite", score of the view opposite to
    the seed over the mean of its two neighbours'; "apart", degrees between the seed and the first
    choice; and "seen" as `rows_of`, of these four views."""
    whole = shared_scene(root / dataset, root / prior, None)[0]
    scene, policy = scene_of(whole, variant), POLICIES_FROM_ONE[variant]
    states = [state for state, _ in follow(scene, policy, 3, seeds=1)]
    seed, first = states[-1].taken[:2]
    opposite, *beside = policy(scene, states[0], [(seed + k) % VIEWS for k in (VIEWS // 2, 1, -1)])
    steps = abs(first - seed)
    return {
        "opposite": float(opposite / np.mean(beside)),
        "apart": 360 / VIEWS * min(steps, VIEWS - steps),
        "seen": 100 * coverage(states[-1].surface, scene.surface_lam),
    }


def rows_of(work: Work) -> list[Row]:
    """A row for each rock, policy and number of seeds. From four: "first" and "last" gain, "rises"
    and "largest_rise" between neighbouring choices, all None for coverage-greedy choice; shares
    "seen" after the seeds and "seen_last" at the end, in %; "useful", choices after which more is
    observed; "pool_change", "pool" over that of the letter, dB."""
    rows = work.rows()
    letter = {
        row["rock"]: row["pool"] for row in rows if (row["variant"], row["seeds"]) == (LETTER, 4)
    }
    for row in rows:
        if row["seeds"] == 1:
            continue
        gains, observed = row.pop("score"), row.pop("observed")
        steps = np.diff(gains)
        by_gain = {
            "first": gains[0],
            "last": gains[-1],
            "rises": int((steps > 0).sum()),
            "largest_rise": float(max(steps.max(), 0.0)),
        }
        row |= by_gain if row["variant"] != GREEDY else dict.fromkeys(by_gain)
        row |= {"seen": 100 * observed[0], "seen_last": 100 * observed[-1]}
        row["useful"] = sum(b > a for a, b in pairwise(observed))
        row["pool_change"] = row["pool"] - letter[row["rock"]]
    return rows


def tables(rows: Sequence[Row]) -> str:
    """Tables of the policies from four seeds and from one, means over scenes with intervals."""
    columns: dict[str, Any] = {"4 + 50 of 100 views": "variant"}
    columns |= {"all views (dB)": scene_mean("pool", ".2f")}
    columns |= {"change": scene_mean("pool_change", "+.2f")}
    columns |= {"observed by the seeds (%)": scene_mean("seen", ".1f")}
    columns |= {"choices that observe more": scene_mean("useful", ".1f")}
    first, last = scene_mean("first", ".3f", ends=False), scene_mean("last", ".4f", ends=False)
    columns |= {"first and last gain": lambda row: f"{text_of(first, row)}, {text_of(last, row)}"}
    columns |= {"rises of 49": scene_mean("rises", ".1f")}
    one: dict[str, Any] = {"1 + 3 of 100 views": "variant"}
    one |= {"opposite view's score over a neighbour's": scene_mean("opposite", ".1f")}
    one |= {"first choice, degrees from the seed": scene_mean("apart", ".0f")}
    one |= {"observed by the four (%)": scene_mean("seen", ".1f")}
    parts = [[row for row in rows if row["seeds"] == count] for count in (4, 1)]
    pairs = zip((columns, one), parts, strict=True)
    return "\n".join(table(heads, grouped(part, "variant")) for heads, part in pairs)


def write(work: Work) -> list[Path]:
    """Write ring.csv, ring.json, ring.md and ring.png."""
    rows, steps = rows_of(work), []
    for row in (row for row in work.rows() if row["seeds"] > 1):
        gains = [None, *row["score"]] if row["variant"] != GREEDY else [None] * (CHOICES + 1)
        for k, (gain, seen) in enumerate(zip(gains, row["observed"], strict=True)):
            shown = {"choice": k, "seen": 100 * seen} | ({} if gain is None else {"gain": gain})
            steps.append({"variant": row["variant"].replace("`", "")} | shown)
    panels = [
        Panel("choice", "gain", "choice", "gain of the view taken (Eq. 7)", "variant"),
        Panel("choice", "seen", "choice", "Gaussians observed (%)", "variant"),
    ]
    path = work.out / "ring.png"
    draw_panels(path, panels, steps)
    return [*write_table(work, "ring", rows, tables(rows), rocks=len(work.size.rocks)), path]


STUDY = Study("ring", __doc__, write, SIZES, cells_of, ROCKS | WORKERS, sized)

if __name__ == "__main__":
    study_of("ring")()
