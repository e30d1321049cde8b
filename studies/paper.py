"""The paper to the letter, and what each difference of mgs from it is worth.

The paper's set-up, smaller: a ring of 48 views, four even seeds, eight choices by its Eq. 7. To the
letter: Gaussians lie on the mesh, in one layer, in the colours of the seeds; fits are Adam on the
images alone, without a prior, alpha or antialiasing; H sums the squared gradients of the training
loss. Where the paper says nothing (loss, rates, passes, scales) it is as in mgs.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

import mgs
from mgs.gaussians import LEARNED
from mgs.run.policies import Policy
from studies.frame.case import ROCKS
from studies.frame.output import Panel, draw_panels, grouped, scene_mean, table, write_table
from studies.frame.program import WORKERS, Study, Work, study_of
from studies.frame.statistics import Row
from studies.frame.sweep import Cell
from studies.setups import SETUPS, SIZES, SetupSize, case_of, shared_scene, sized

SEEDS, CHOICES = 4, 8

LETTER, OURS, DEFAULT = "to the letter", "`paper` of mgs", "default of mgs"
OF_MGS = OURS, DEFAULT

FREE = 1e3
"""Factor on the standard deviations of the prior, with which it has no effect on a fit."""

SETTINGS: dict[str, Mapping[str, Any]] = {
    "natural gradient, in place of Adam": {"optimiser": "natural"},
    "Gaussians below a pixel fainter": {"antialiased": True},
    "alpha fitted": {"alpha_weight": 0.1},
    "blended as light, in place of sRGB": {"space": "linear"},
    "squares, in place of L1 and D-SSIM": {"loss": "squared"},
}
"""Differences of fits, as settings of `train`."""

PRIOR, COLOURS, INSET, BACKING, DUMMY = (
    "a prior in the fit, and the natural gradient", "colours of all views taken",
    "Gaussians below the surface", "a second layer", "H from the dummy loss",
)  # fmt: skip

VARIANTS = (LETTER, COLOURS, INSET, BACKING, *SETTINGS, PRIOR, DUMMY, OURS, DEFAULT)
"""Rows: the paper, the paper with one difference each, and mgs."""


@dataclass(frozen=True)
class Letter:
    """The paper's Eq. 7; H from the training loss of the views taken, which the paper implies."""

    name = "letter"
    needs_fit = True

    def __call__(self, scene: mgs.Scene, state: mgs.State, views: list[int]) -> np.ndarray:
        """Score views [C]; lambda is that of `mgs.Paper`, with the dummy loss."""
        H = sum(self.squares(scene, state, i) for i in state.taken)
        dummy = [scene.information(state, i, "loss-gradient") for i in state.taken]
        lam = np.mean(dummy, dtype=np.float64)
        gains = [scene.information(state, i, "loss-gradient") / (H + lam) for i in views]
        return np.array([np.log1p(gain).mean() for gain in gains])

    @staticmethod
    def squares(scene: mgs.Scene, state: mgs.State, view: int) -> np.ndarray:
        """Squared gradient of the mean squared error of a view taken [N,P], in the space in which
        the model is blended."""
        frame = state.frames[view]
        image = state.gaussians.blended(scene.image(frame)[..., :3]).astype(np.float32)
        shown = np.asarray(mgs.render(state.gaussians, frame.camera).rgb)
        slope = (shown - image) * (2 / image.size)
        gradient = mgs.vjp(state.gaussians, slope, frame.camera, by=LEARNED)
        return np.concatenate([part.reshape(len(part), -1) for part in gradient.values()], 1) ** 2


class SeedColours(mgs.Scene):
    """Scene whose Gaussians start in the colours of the seeds."""

    def initial(self, frames: Sequence[mgs.Frame]) -> mgs.Gaussians:
        """As `mgs.Scene.initial`, of the first SEEDS frames."""
        return super().initial(frames[:SEEDS])


def scene_of(whole: mgs.Scene, variant: str) -> mgs.Scene:
    """The scene of a variant. whole: with the prior of the variant and settings of mgs."""
    if variant in OF_MGS:
        return whole
    ours, model = whole.settings, {}
    train: dict[str, Any] = {"optimiser": "adam", "antialiased": False, "alpha_weight": 0.0}
    train |= SETTINGS.get(variant, {})
    if variant == PRIOR:
        train["optimiser"] = "natural"
    else:
        model = {"prior_std": {kind: FREE * std for kind, std in ours.prior_std.items()}}
    settings = ours.model_copy(update={**model, "train": ours.train.model_copy(update=dict(train))})
    kind = mgs.Scene if variant == COLOURS else SeedColours
    scene = kind(whole.dataset, whole.prior, settings)
    if variant != INSET:
        scene.__dict__["pixel"] = 0.0  # the unit of the depth below the surface
    scene.__dict__["surface_lam"] = (
        whole.surface_lam
    )  # without a prior all that is seen is observed
    return scene


def cells_of(size: SetupSize) -> list[Cell]:
    """Cells of every variant on every rock, with datasets and priors."""
    cells: list[Cell] = []
    for rock in size.rocks:
        plain = case_of(rock, SETUPS["ring"], size)
        for k, variant in enumerate(VARIANTS):
            backed = variant in (BACKING, *OF_MGS)
            settings = plain.settings if backed else {**plain.settings, "backing": 0.0}
            case = replace(plain, settings=settings)
            label = f"paper/{rock.name}/{k}"
            about = {"variant": variant}
            cells += case.with_task(label, f"{__name__}:run", about=about, variant=variant)
    return cells


def run(root: Path, out: Path, dataset: str, prior: str, variant: str) -> dict[str, float | None]:
    """Task: choose CHOICES views after SEEDS; PSNR of the last model, dB, and the gains."""
    whole, tests, pool = shared_scene(root / dataset, root / prior, None)
    scene = scene_of(whole, variant)
    policy: Policy = mgs.Paper() if variant in (OURS, DUMMY) else Letter()
    if variant == DEFAULT:
        policy = mgs.Directional()
    steps = list(follow(scene, policy, CHOICES))
    state, gains = steps[-1][0], [gain for _, gain in steps[1:]]
    comparable = variant != DEFAULT  # its scores are no gain by Eq. 7
    rises = sum(b > a for a, b in pairwise(gains))
    on_tests, on_pool = tests(state.gaussians), pool(state.gaussians)
    return {
        "test": float(on_tests["psnr"].mean()),
        "test_mask": float(on_tests["psnr_mask"].mean()),
        "pool": float(on_pool["psnr"].mean()),
        "first_gain": gains[0] if comparable else None,
        "last_gain": gains[-1] if comparable else None,
        "rises": rises if comparable else None,
    }


def follow(
    scene: mgs.Scene, policy: Policy, count: int, seeds: int = SEEDS
) -> Iterator[tuple[mgs.State, float]]:
    """Yield the state after the seeds, with the score 0, and after each choice with its own."""
    state = mgs.learn(scene, scene.seeds(seeds))
    yield state, 0.0
    for _ in range(count):
        view, score = mgs.choose(scene, state, policy)
        state = mgs.learn(scene, [*state.taken, view], state)
        yield state, score


def rows_of(work: Work) -> list[Row]:
    """A row for each rock and variant, and KEY_change from the paper's."""
    rows = work.rows()
    usual = {row["rock"]: row for row in rows if row["variant"] == LETTER}
    for row in rows:
        row |= {
            f"{key}_change": row[key] - usual[row["rock"]][key]
            for key in ("test", "test_mask", "pool")
        }
    return rows


def tables(rows: Sequence[Row]) -> str:
    """Table of the variants, means over scenes; changes from the first row with 95 % intervals."""
    columns: dict[str, Any] = {"Eq. 7 on a ring, 4 + 8 views": "variant"}
    columns |= {"test views (dB)": scene_mean("test", ".2f", ends=False)}
    columns |= {"change": scene_mean("test_change", "+.2f")}
    columns |= {"on the rock": scene_mean("test_mask_change", "+.2f")}
    columns |= {"all views (dB)": scene_mean("pool", ".2f", ends=False)}
    columns |= {"first gain": scene_mean("first_gain", ".3f", ends=False)}
    columns |= {"last": scene_mean("last_gain", ".3f", ends=False)}
    columns |= {"rises of 7": scene_mean("rises", ".1f", ends=False)}
    return table(columns, grouped(rows, "variant"))


def write(work: Work) -> list[Path]:
    """Write paper.csv, paper.json, paper.md and paper.png."""
    rows = rows_of(work)
    changed = [row for row in rows if row["variant"] != LETTER]
    path, label = work.out / "paper.png", "PSNR on test views over the paper's letter (dB)"
    draw_panels(path, [Panel("variant", "test_change", "", label)], changed)
    return [*write_table(work, "paper", rows, tables(rows)), path]


STUDY = Study("paper", __doc__, write, SIZES, cells_of, ROCKS | WORKERS, sized)

if __name__ == "__main__":
    study_of("paper")()
