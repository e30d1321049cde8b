"""How much model a scene needs.

Charts quality and cost against the number of Gaussians, the kinds of parameters that are learned,
and the SH degree, and compares the automatic choice: N of `mgs prior --gaussians auto`, kinds and
degree of `mgs refit`. A fit sees views one after the other, spread evenly around the rock, as in
`mgs nbv`.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import mgs
from mgs.fit.evidence import lean_fit
from mgs.fit.pruning import prune
from mgs.fit.settings import RATES
from mgs.learning import fit_views, images_of
from mgs.policy.criteria import PIXEL_NOISE
from mgs.policy.poses import seed_views
from mgs.splat import groups
from studies.frame.case import Case, Rock, Size, judge
from studies.frame.claim import Claim, Row, judged, single, verdict_table
from studies.frame.output import Content, Panel, draw_panels, table, write_table
from studies.frame.program import Study, Work, study_of
from studies.frame.sweep import Cell

AUTO = "auto"
"""Automatic number of Gaussians."""

LEARNED = {
    "colour": ("colour",),
    "+ opacity": ("colour", "opacity"),
    "+ scale": ("colour", "opacity", "scale"),
    "+ rotation": ("colour", "opacity", "scale", "rotation"),
}
"""Kinds of parameters that are learned, by what each set adds to the one before."""

ALL = "+ rotation"

NUMBER, KINDS, DEGREE = "number of Gaussians", "kinds learned", "SH degree"
AUTOMATIC, PRUNED = "automatic", "pruned"
"""Values of the column `choice`: what differs among fixed choices; number, kinds and degree chosen
automatically; and the fit with the automatic number, pruned."""

PRUNE_NOISE = (0.1, 0.2, 0.5)
"""Allowed change by pruning, over the noise of a pixel."""

GREY = [0.2, 0.2, 0.2]
VARIANTS: dict[str, dict[str, Any]] = {
    "shining boulder": {"specular": 0.5, "roughness": 0.3},
    "plain boulder": {"colours": [GREY, GREY], "dust": GREY},
}
"""Boulders with other values of keys of [rock] in the scene file."""

SCENES = ("boulder", "strata", "pebbles", "contact-binary", *VARIANTS)
"""The first two were used to choose the constants of the rule for N; the others test it."""

CLOSE = 0.1
"""Difference of quality, dB, up to which models count as equally good."""


@dataclass(frozen=True)
class ParsimonySize:
    """Size of the study. counts: fixed numbers of Gaussians. views: images that are fitted, the
    first `seeds` at once. degrees: of the SH."""

    scenes: tuple[str, ...]
    counts: tuple[int, ...]
    images: Size
    views: int
    seeds: int = 4
    degrees: tuple[int, ...] = (0, 1, 2)

    def case(self, scene: str, gaussians: int | str) -> Case:
        """Case of a scene with a prior of so many Gaussians."""
        changes = {"rock": VARIANTS[scene]} if scene in VARIANTS else {}
        rock, settings = Rock("boulder" if changes else scene), {"gaussians": gaussians, "seed": 0}
        return Case(rock, self.images, settings, changes=changes, label=scene)


SIZES = {
    "quick": ParsimonySize(SCENES, (2500, 5000, 10_000, 20_000, 40_000), Size(160, 120, 16, 6), 8),
    "full": ParsimonySize(
        SCENES, (10_000, 20_000, 40_000, 80_000, 160_000), Size(320, 240, 32, 12), 12
    ),
}

Fixed = tuple[str, int | str, str, int]
"""Factor that varies, number of Gaussians, kinds learned, and SH degree of a fit."""


def fixed_choices(size: ParsimonySize) -> list[Fixed]:
    """Fixed choices of number, kinds and degree, one factor at a time."""
    choices: list[Fixed] = [(NUMBER, n, ALL, 0) for n in size.counts]
    choices += [(KINDS, AUTO, learned, 0) for learned in LEARNED]
    return choices + [(DEGREE, AUTO, ALL, degree) for degree in size.degrees]


def _fit_name(scene: str, gaussians: int | str, learned: str, degree: int) -> str:
    return f"fit/{scene}/{gaussians}-{'-'.join(LEARNED[learned])}-degree-{degree}"


def cells_of(size: ParsimonySize) -> list[Cell]:
    """Cells of each scene: dataset, priors, fits, and the fit of `mgs refit`."""
    cells: list[Cell] = []
    shared: dict[str, Any] = {"alone": True, "views": size.views, "seeds": size.seeds}
    for scene in size.scenes:
        for _, n, learned, degree in fixed_choices(size):
            arguments: dict[str, Any] = shared | {"learned": learned, "degree": degree}
            if (n, learned, degree) == (AUTO, ALL, 0):
                arguments["noises"] = list(PRUNE_NOISE)
            name, task = _fit_name(scene, n, learned, degree), f"{__name__}:fit_and_judge"
            cells += size.case(scene, n).with_task(name, task, **arguments)
        task = f"{__name__}:fit_lean_and_judge"
        cells += size.case(scene, AUTO).with_task(f"lean/{scene}", task, **shared)
    return cells


def views_in_order(positions: np.ndarray, centre: np.ndarray, views: int, seeds: int) -> list[int]:
    """Indices of views evenly spaced in azimuth, ordered so that the first `seeds` are evenly
    spaced too. positions: [C,3] of the cameras, +Z up; centre: [3]."""
    spread = list(seed_views(positions, centre, views))
    step = max(views // seeds, 1)
    return [view for first in range(step) for view in spread[first::step]]


def fit_and_judge(
    root: Path,
    out: Path,
    dataset: str,
    prior: str,
    views: int,
    seeds: int,
    learned: str,
    degree: int,
    noises: Sequence[float] = (),
) -> dict[str, Any]:
    """Task: fit views one after the other; returns quality and cost, and the same of the model
    pruned at each of `noises`."""
    rates = {kind: rate if kind in LEARNED[learned] else 0.0 for kind, rate in RATES.items()}
    train = mgs.TrainSettings(rates=rates)
    settings = mgs.ModelSettings(sh=degree, train=train)
    scene = mgs.Scene(mgs.load_dataset(root / dataset), mgs.load_prior(root / prior), settings)
    spent = list[float]()
    order = views_in_order(scene.positions(scene.frames), scene.centre, views, seeds)
    for i in order:
        scene.image(scene.frames[i])  # reads it, which is not timed
    before, passes = None, 0
    for count in range(seeds, views + 1):
        began = time.perf_counter()
        fit, _ = fit_views(scene, scene.frames, order[:count], before)
        spent.append(time.perf_counter() - began)
        passes, model = passes + fit.passes, fit.gaussians
        nothing = np.zeros((0, 0))  # no view is chosen by information
        before = mgs.State(scene.frames, tuple(order[:count]), seeds, model, nothing, nothing)
    cameras = [scene.frames[i].camera for i in order]
    kinds = groups(degree)
    each = sum(kinds[kind].stop - kinds[kind].start for kind in LEARNED[learned])
    pruned = []
    for noise in noises:
        left = prune(model, cameras, noise * PIXEL_NOISE)
        row = {"noise": noise, "gaussians": len(left.kept), "actual": left.actual}
        row |= {"predicted": left.predicted, "parameters": len(left.kept) * each}
        pruned.append(row | _quality(model[left.kept], root / dataset))
    return _quality(model, root / dataset) | {
        "gaussians": len(model),
        "parameters": len(model) * each,
        "seconds": sum(spent),
        "passes": passes,
        "pruned": pruned,
    }


def fit_lean_and_judge(
    root: Path, out: Path, dataset: str, prior: str, views: int, seeds: int
) -> dict[str, Any]:
    """Task: `mgs.fit.evidence.lean_fit` to as many views."""
    settings = mgs.ModelSettings(train=mgs.TrainSettings())
    scene = mgs.Scene(mgs.load_dataset(root / dataset), mgs.load_prior(root / prior), settings)
    order = views_in_order(scene.positions(scene.frames), scene.centre, views, seeds)
    frames = [scene.frames[i] for i in order]
    images, began = images_of(scene, frames), time.perf_counter()
    found = lean_fit(images, settings)
    seconds = time.perf_counter() - began
    return _quality(found.gaussians, root / dataset) | {
        "gaussians": len(found.gaussians),
        "parameters": found.parameters,
        "seconds": seconds,
        "degree": found.gaussians.sh_degree,
        "shares": {kind: float(mask.mean()) for kind, mask in found.learned.items()},
    }


def _quality(model: mgs.Gaussians, dataset: Path) -> dict[str, float]:
    """PSNR on the test views, dB: of the whole frame, and of pixels that the rock covers wholly."""
    found = judge(model, mgs.load_dataset(dataset))
    return {"psnr": found["psnr"], "psnr_inside": found["psnr_inside"]}


def rows_of(size: ParsimonySize, found: Mapping[str, Any], scene: str) -> list[Row]:
    """A row for each fixed choice on a scene, for each pruned model, and for the automatic choice
    with its comparison (`compared`)."""
    rows: list[Row] = []
    for choice, n, learned, degree in fixed_choices(size):
        numbers = dict(found[_fit_name(scene, n, learned, degree)])
        pruned = numbers.pop("pruned")
        about = {"run": scene, "choice": choice, "asked": str(n)}
        rows.append(about | {"learned": learned, "degree": degree} | numbers)
        if choice == KINDS:
            rows += [about | {"choice": PRUNED} | row for row in pruned]
    auto = {"run": scene, "choice": AUTOMATIC, "asked": AUTO, **found[f"lean/{scene}"]}
    return [*rows, auto | compared(rows, auto)]


def compared(rows: Sequence[Row], auto: Row) -> Row:
    """Comparison of the automatic choice with the fixed ones of a scene.

    number: PSNR with the automatic N, all kinds learned, dB. best: largest PSNR of another fixed
    choice. loss: how far the automatic choice is below it. smallest: fewest parameters of a fixed
    choice within CLOSE of the best. over_smallest: parameters over these.
    """

    def is_number(row: Row) -> bool:
        return (row["asked"], row["learned"], row["degree"]) == (AUTO, ALL, 0)

    fixed = [row for row in rows if row["choice"] != PRUNED]
    number = next(row for row in fixed if is_number(row))
    others = [row for row in fixed if not is_number(row)]
    best = max(row["psnr_inside"] for row in others)
    smallest = min(row["parameters"] for row in others if row["psnr_inside"] >= best - CLOSE)
    return {
        "number": number["psnr_inside"],
        "best": best,
        "loss": best - auto["psnr_inside"],
        "smallest": smallest,
        "over_smallest": auto["parameters"] / smallest,
    }


CLAIMS = (
    Claim(
        "The automatic choice is at most 0.1 dB below the best fixed choice.",
        single("loss", {"choice": AUTOMATIC}), "dB", "below", CLOSE, "scene",
    ),
    Claim(
        "It has no more parameters than the smallest fixed choice within 0.1 dB of the best.",
        single("over_smallest", {"choice": AUTOMATIC}), "times", "below", 1.0, "scene",
    ),
)  # fmt: skip

COLUMNS: dict[str, Content] = {
    "scene": "run",
    "best fixed (dB)": "best:.2f",
    "automatic (dB)": "psnr_inside:.2f",
    "parameters": "parameters:,",
    "smallest fixed within 0.1 dB": "smallest:,",
    "holds": lambda row: _holds(row),
}


def _holds(row: Row) -> str:
    if row["loss"] > CLOSE:
        return "no: worse"
    return "yes" if row["over_smallest"] <= 1 else "no: too many parameters"


def write(work: Work) -> list[Path]:
    """Write parsimony.csv, .json, .md and .png."""
    size, results = work.size, work.results
    rows = [row for scene in size.scenes for row in rows_of(size, results, scene)]
    priors = {scene: results[size.case(scene, AUTO).prior_name] for scene in size.scenes}
    claims = [judged(claim, rows) for claim in CLAIMS]
    choices = [row for row in rows if row["choice"] == AUTOMATIC]
    text = f"{table(COLUMNS, choices)}\n{verdict_table(claims)}"
    draw(work.out / "parsimony.png", rows)
    paths = write_table(work, "parsimony", rows, text, priors=priors, claims=claims)
    return [*paths, work.out / "parsimony.png"]


def draw(path: Path, rows: Sequence[Row]) -> None:
    """Draw PSNR against the number of parameters, a panel for each scene."""
    label, axes = "PSNR inside the rock (dB)", ("parameters", "psnr_inside")
    panels = [
        Panel(*axes, "learned parameters", label, "choice", True, (("run", scene),), scene)
        for scene in dict.fromkeys(row["run"] for row in rows)
    ]
    title = "The automatic choice of parameters (star) beside fixed ones"
    draw_panels(path, panels, rows, title)


STUDY = Study(
    "parsimony",
    __doc__,
    write,
    SIZES,
    lambda work: cells_of(work.size),
)

if __name__ == "__main__":
    study_of("parsimony")()
