"""Try to make the methods fail: experiments test hypotheses, and a fixed statistical rule judges
each. A run has failed if its PSNR on the test views, which no fault touches, is more than FAILURE
below that of the clean run on the same rock and views.
"""

import functools
from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

import mgs
from mgs.data.dataset import target_of
from mgs.files import write_json, write_text
from mgs.fit.fitting import Fit, fit_gaussians
from mgs.fit.settings import MEAN_RATE, PASSES, RATES
from mgs.policy import criteria
from mgs.policy.poses import seed_views
from mgs.prior.initial import pixel_on
from mgs.provenance import versions
from mgs.run import detectors
from mgs.runtime import processor
from mgs.seeds import generator
from mgs.splat import groups
from studies.faults import IMAGE_FAULTS, PRIOR_FAULTS, captured, pose_noise
from studies.frame.case import Case, Rock, Size, judge
from studies.frame.claim import Claim, Effects, Row, judged, paired, single, verdict_table
from studies.frame.output import Panel, draw_panels, write_csv
from studies.frame.program import WORKERS, Study, Work, names_of, study_of
from studies.frame.sweep import Cell, result_of

CACHE = 1 << 28
"""Budget of the block lists of one lab, bytes."""

FAILURE = 1.0
"""Loss of PSNR, dB, above which a run has failed."""

VIEWS = 6
"""Views of the fits that faults spoil."""

FREE_PASSES = 40
"""Passes of fits with free means: four times the default, since a collapse takes time."""


@dataclass(frozen=True)
class Experiment:
    """A question about where the method fails.

    cells(size): the work; results may have "rows", records with the `run` they belong to.
    """

    question: str
    cells: "Callable[[StressSize], list[Cell]]"
    claims: Sequence[Claim]
    panels: Sequence[Panel]


@dataclass(frozen=True)
class StressSize:
    """Size of all experiments.

    images: of every dataset. gaussians: of each prior. rocks: (scene, seed) of all experiments.
    others: more of them, for some experiments. turns: sets of views of a rock, turned against one
    another. repeats: draws of each random fault. few_views: numbers of views with free means.
    only: names of the experiments to be done.
    """

    images: Size
    gaussians: int
    rocks: tuple[tuple[str, int], ...]
    others: tuple[tuple[str, int], ...]
    turns: int
    repeats: int
    few_views: tuple[int, ...]
    experiments: Mapping[str, Experiment] = field(default_factory=lambda: EXPERIMENTS)
    only: tuple[str, ...] = ()

    def case(self, scene: str, seed: int) -> Case:
        """Case of a rock."""
        return Case(Rock(scene, seed), self.images, {"gaussians": self.gaussians, "seed": seed})


def rock_cell(
    name: str, task: str, size: StressSize, rock: tuple[str, int], **more: Any
) -> list[Cell]:
    """Cells of a task on one rock: those of its case, and NAME/SCENE-SEED. The task is called with
    scene="SCENE-SEED", dataset and prior."""
    label = f"{rock[0]}-{rock[1]}"
    task = f"{__name__}:{task}"
    return size.case(*rock).with_task(f"{name}/{label}", task, scene=label, **more)


def turns(count: int) -> list[tuple[str, float]]:
    """Names of sets of views, and the share of their spacing by which each is turned."""
    return [(f"turn {k}", k / count) for k in range(count)]


@dataclass(frozen=True)
class Lab:
    """A rock to experiment on: frames, a prior, and a dataset whose test views judge models."""

    frames: tuple[mgs.Frame, ...]
    prior: mgs.Prior
    dataset: mgs.Dataset
    cache: mgs.ListCache = field(default_factory=lambda: mgs.ListCache(CACHE))

    @property
    def cameras(self) -> list[mgs.Camera]:
        """Cameras of all frames."""
        return [frame.camera for frame in self.frames]

    def changed(self, **fields: Any) -> "Lab":
        """Copy with other frames or another prior, and a cache of its own."""
        return replace(self, cache=mgs.ListCache(CACHE), **fields)

    def even(self, count: int, turn: float = 0.0) -> list[int]:
        """Views at evenly spaced azimuths. turn: share of the spacing by which they are turned."""
        angle = -2 * np.pi * turn / count
        c, s = np.cos(angle), np.sin(angle)
        about_z = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        positions = np.array([camera.position for camera in self.cameras])
        return seed_views((positions - self.prior.points.mean(0)) @ about_z.T, np.zeros(3), count)

    def start(self, taken: Sequence[int]) -> mgs.Gaussians:
        """Gaussians before training, in the colours of the views taken."""
        frames, pixel = [self.frames[i] for i in taken], pixel_on(self.prior, self.cameras)
        return mgs.initial_gaussians(self.prior, frames, pixel, linear=False)[0]

    def lam(self, means: str = "frozen") -> np.ndarray:
        """Lambda of each column of the information [P], with the default settings of `mgs nbv`."""
        stds = criteria.PRIOR_STD | {"mean": criteria.MEAN_STD * self.prior.spacing}
        return criteria.regularisation(groups(0, means), prior_std=stds)

    def fit(
        self,
        taken: Sequence[int],
        passes: int = PASSES,
        means: str = "frozen",
        with_prior: bool = True,
        start: mgs.Gaussians | None = None,
    ) -> Fit:
        """Fit of exactly so many passes, otherwise with the default settings of `mgs nbv`.

        with_prior: lambda holds the parameters near `start`, by default the Gaussians before
        training.
        """
        start = self.start(taken) if start is None else start
        rates = RATES | {"mean": MEAN_RATE * self.prior.spacing}
        how = {"passes": passes, "tolerance": 0.0, "means": means, "rates": rates}
        train = mgs.TrainSettings.model_validate(how)
        lam = criteria.lam_by_kind(self.lam(means), groups(0, means)) if with_prior else None
        cameras = [self.cameras[i] for i in taken]
        targets = [target_of(self.frames[i]) for i in taken]
        return fit_gaussians(start, cameras, targets, train, None, self.cache, start, lam)

    def information(
        self, model: mgs.Gaussians, views: Sequence[int], means: str = "frozen"
    ) -> list[np.ndarray]:
        """Exact Fisher information [N,P] of each of some views."""
        every = (mgs.fisher(model, self.cameras[i], cache=self.cache, means=means) for i in views)
        return [F.astype(np.float64) for F in every]

    def scores(
        self, model: mgs.Gaussians, taken: Sequence[int], means: str = "frozen"
    ) -> np.ndarray:
        """D-optimality of each view that is not taken."""
        H, lam = np.sum(self.information(model, taken, means), axis=0), self.lam(means)
        others = [i for i in range(len(self.frames)) if i not in taken]
        each = self.information(model, others, means)
        return np.array([criteria.d_optimal(F, H, lam) for F in each])

    def quality(self, model: mgs.Gaussians) -> dict[str, float]:
        """PSNR on the test views, dB: of whole images (psnr), and inside the rock (psnr_mask)."""
        metrics = judge(model, self.dataset)
        return {key: metrics[key] for key in ("psnr", "psnr_mask")}


@functools.lru_cache(maxsize=2)
def open_lab(dataset: Path, prior: Path) -> Lab:
    """Lab of a dataset and a prior."""
    data = mgs.load_dataset(dataset)
    return Lab(data.frames, mgs.load_prior(prior), data)


KINDS = {
    "frozen": ("frozen", True),
    "free": ("free", True),
    "frozen, no prior": ("frozen", False),
    "free, no prior": ("free", False),
}
"""Setting of the means, and whether a prior holds all parameters; the paper has none. Free means
are compared with frozen ones of the same prior, since a fit without one loses quality anyway."""


def free_means(
    root: Path, out: Path, scene: str, dataset: str, prior: str, turns_: int, counts: list[int]
) -> dict[str, Any]:
    """Fits with frozen and with free means on few views: quality, drift of the means in spacings,
    and the ranking of the other views."""
    lab, rows = open_lab(root / dataset, root / prior), []
    for suffix, turn in turns(turns_):
        for count in counts:
            taken, references = lab.even(count, turn), dict[bool, np.ndarray]()
            start = lab.start(taken)
            for kind, (means, with_prior) in KINDS.items():
                model = lab.fit(taken, FREE_PASSES, means, with_prior, start).gaussians
                scores = lab.scores(model, taken, means)
                reference = references.setdefault(with_prior, scores)
                drift = np.linalg.norm(model.means - start.means, axis=1) / lab.prior.spacing
                row = {"run": f"{scene}, {suffix}", "views": count, "means": kind}
                row |= lab.quality(model) | {"drift": float(np.sqrt(np.mean(drift**2)))}
                rows.append(row | {"tau": tau(scores, reference)})
    return {"rows": rows}


def tau(mine: np.ndarray, reference: np.ndarray) -> float:
    """Kendall's tau of scores of candidates [C] with reference scores; 0 if either is constant."""
    from scipy.stats import kendalltau  # takes half a second

    constant = np.ptp(mine) == 0 or np.ptp(reference) == 0
    return 0.0 if constant else float(kendalltau(mine, reference).statistic)


def _means(views: int, kind: str, other: str) -> Effects:
    return paired("psnr", {"views": views, "means": kind}, {"views": views, "means": other})


FREE_MEANS = Experiment(
    "Do free means collapse on few views?",
    lambda size: [
        cell
        for rock in size.rocks
        for cell in rock_cell(
            "free-means",
            "free_means",
            size,
            rock,
            turns_=size.turns,
            counts=list(size.few_views),
        )
    ],
    (
        Claim(
            "On 4 views, free means lose 1 dB or more against frozen ones, both without a prior "
            "(paper, section III).",
            _means(4, "free, no prior", "frozen, no prior"), "dB", "below", -1.0,
        ),
        Claim(
            "On 2 views, free means lose 1 dB or more against frozen ones, both without a prior.",
            _means(2, "free, no prior", "frozen, no prior"), "dB", "below", -1.0,
        ),
        Claim(
            "On 4 views, frozen means lose 0.5 dB or more where no prior holds the other "
            "parameters.",
            _means(4, "frozen, no prior", "frozen"), "dB", "below", -0.5,
        ),
        Claim(
            "With the prior on their place, free means lose no more than 0.5 dB on 4 views.",
            _means(4, "free", "frozen"), "dB", "above", -0.5,
        ),
        Claim(
            "On 4 views, freeing the means (no prior) changes the D-optimal ranking: Kendall's tau "
            "is at most 0.8.",
            single("tau", {"views": 4, "means": "free, no prior"}), "tau", "below", 0.8,
        ),
    ),
    (
        Panel("views", "psnr", "views", "PSNR on test views (dB)", "means"),
        Panel("views", "drift", "views", "drift of the means, rms (spacings)", "means"),
        Panel("views", "tau", "views", "Kendall's tau with frozen means, same prior", "means"),
    ),
)  # fmt: skip

ANOTHER = "another rock's prior"

SHORT_FITS = (1, 2, 5)
"""Passes of fits that are stopped too early, as a fault."""

FREE_VIEWS = (2, 4)
"""Views of fits whose means are free and held by no prior, as a fault."""

ONE_POSE = (1.0, 4.0)
"""Sizes of `pose_noise` in a single view."""


def indicators_of(
    lab: Lab, taken: Sequence[int], passes: int = PASSES, means: str = "frozen"
) -> tuple[mgs.Gaussians, dict[str, float]]:
    """A fit, and the indicators that the loop would compute after its first step."""
    start = lab.start(taken)
    fit = lab.fit(taken, passes, means, means == "frozen", start)
    surface = np.sum(lab.information(start, taken), axis=0)[: len(lab.prior.points)]
    views = []
    for frame in (lab.frames[i] for i in taken):
        models = (start, fit.gaussians)
        old, new = (mgs.render(model, frame.camera, cache=lab.cache) for model in models)
        target, mask = target_of(frame), frame.mask()
        margin = detectors.outline_margin(start, frame.camera)
        before = detectors.before_fit(mask, np.asarray(old.alpha), margin)
        views.append(detectors.view_indicators(target, mask, np.asarray(new.rgb), before))
    std = criteria.MEAN_STD * lab.prior.spacing
    drift = detectors.means_drift(fit.gaussians.means, start.means, std)
    seen = criteria.coverage(surface, lab.lam())
    positions = np.array([lab.frames[i].camera.position for i in taken])
    return fit.gaussians, detectors.step_indicators(views, positions, fit.losses, seen, [], drift)


SIZES_IN_WORDS = {
    ANOTHER: "draw {:g}",
    **{name: fault.words for name, fault in (IMAGE_FAULTS | PRIOR_FAULTS).items()},
}
"""Formats of sizes with their units; of others, a plain number."""


def label_of(fault: str, size: float) -> str:
    """Name of a fault and its size, with the unit."""
    if fault == "none":
        return "no fault"
    return f"{fault}, {SIZES_IN_WORDS.get(fault, '{:g}').format(size)}"


def _row(lab: Lab, run: str, fault: str, size: float, clean: Row | None, *how: Any) -> Row:
    """Row of one fit. clean: that of the clean run; how: arguments of `indicators_of`."""
    model, indicators = indicators_of(lab, *how)
    row: Row = {"run": run, "scene": run.split(",")[0], "fault": fault, "size": size}
    row |= {"label": label_of(fault, size), **lab.quality(model)}
    lost = (row if clean is None else clean)["psnr"] - row["psnr"]
    row |= {"lost": lost, "failed": bool(lost > FAILURE)}
    return row | {f"sign {name}": value for name, value in indicators.items()}


def faults(
    root: Path,
    out: Path,
    scene: str,
    dataset: str,
    prior: str,
    kinds: str,
    others: list[dict[str, str]],
    repeats: int,
) -> dict[str, Any]:
    """Clean fits to evenly spread views, and fits with every fault of a kind at every size.

    kinds: "images" or "prior". others: datasets and priors of other rocks, whose priors are tried
    in place of the right one. repeats: draws of faults, each with views of its own.
    """
    opened, rows = open_lab(root / dataset, root / prior), []
    lab = opened.changed(frames=tuple(captured(frame) for frame in opened.frames))
    table = IMAGE_FAULTS if kinds == "images" else PRIOR_FAULTS
    for name, turn in turns(repeats):
        run, taken = f"{scene}, {name}", lab.even(VIEWS, turn)
        clean = _row(lab, run, "none", VIEWS, None, taken)
        rows.append(clean)
        for fault, (change, sizes, _) in table.items():
            for size in sizes:
                rng = generator(0, f"stress/{run}/{fault}/{size}")
                spoiled = _spoiled(lab, taken, kinds, change, size, rng)
                rows.append(_row(spoiled, run, fault, size, clean, taken))
        if kinds == "images":
            rows += _fit_faults(lab, run, taken, turn, clean)
            continue
        for k, other in enumerate(others):
            wrong = open_lab(root / other["dataset"], root / other["prior"]).prior
            rows.append(_row(lab.changed(prior=wrong), run, ANOTHER, k, clean, taken))
    return {"rows": rows}


def _spoiled(
    lab: Lab, taken: Sequence[int], kinds: str, change: Any, size: float, rng: np.random.Generator
) -> Lab:
    """The lab with the fault in the frames that are fitted, or in the prior."""
    if kinds == "prior":
        return lab.changed(prior=change(lab.prior, size, rng))
    frames = (change(f, size, rng) if i in taken else f for i, f in enumerate(lab.frames))
    return lab.changed(frames=tuple(frames))


def _fit_faults(lab: Lab, run: str, taken: Sequence[int], turn: float, clean: Row) -> list[Row]:
    """Fits of too few passes, with free means on few views, and with one wrong pose."""
    rows = [_row(lab, run, "few passes", passes, clean, taken, passes) for passes in SHORT_FITS]
    for count in FREE_VIEWS:
        few = lab.even(count, turn)
        frozen = _row(lab, run, "none", count, None, few)
        rows += [frozen, _row(lab, run, "free means", count, frozen, few, FREE_PASSES, "free")]
    for size in ONE_POSE:
        rng = generator(0, f"stress/{run}/one bad pose/{size}")
        spoiled = _spoiled(lab, taken[:1], "images", pose_noise, size, rng)
        rows.append(_row(spoiled, run, "one bad pose", size, clean, taken))
    return rows


def fault_cells(size: StressSize, kinds: str) -> list[Cell]:
    """Cells of a kind of faults on all rocks of a size."""
    rocks, cells = (*size.rocks, *size.others), []
    for k, rock in enumerate(rocks):
        others = [size.case(*rocks[(k + step) % len(rocks)]) for step in (1, 2)]
        more = {"kinds": kinds, "others": [c.folders for c in others], "repeats": size.repeats}
        *made, cell = rock_cell(f"faults-{kinds}", "faults", size, rock, **more)
        made += [one for case in others for one in case.cells()]
        cells += [*made, replace(cell, needs=tuple(dict.fromkeys(one.name for one in made)))]
    return cells


def _harm(fault: str, size: float, words: str, bound: float = 1.0, harmless: bool = False) -> Claim:
    """Claim that a fault of this size costs the bound or more; harmless: at most the bound."""
    amount = f"at most {bound:g} dB" if harmless else f"{bound:g} dB or more"
    lost = single("lost", {"fault": fault, "size": size})
    hypothesis = f"{words} costs {amount} on the test views."
    return Claim(hypothesis, lost, "dB", "below" if harmless else "above", bound, "rock and draw")


LOST = Panel(
    "label", "lost", "fault and its size", "PSNR lost on test views (dB)",
    title="PSNR that each fault costs",
)  # fmt: skip

DATA_FAULTS = Experiment(
    "Which faults of the images spoil a model?",
    lambda size: fault_cells(size, "images"),
    (
        _harm("pose noise", 1.0, "Pose noise of 1 degree and 1 cm"),
        _harm("image noise", 0.1, "Image noise of a tenth of the range", harmless=True),
        _harm("exposure", 0.3, "Exposure that varies by 0.3 stops"),
        _harm("motion blur", 5.0, "Motion blur of 5 pixels"),
        _harm("defocus", 1.5, "Defocus of 1.5 pixels"),
        _harm("missing depth", 0.6, "Depth missing in 60 % of the pixels (the prior as it was)",
              0.5, harmless=True),
        _harm("shifted mask", 4.0, "A mask that is off by 4 pixels"),
        _harm("wrong mask", 3.0, "A mask that is 3 pixels too large or too small"),
    ),
    (LOST,),
)  # fmt: skip

PRIOR_EXPERIMENT = Experiment(
    "Which faults of the prior spoil a model?",
    lambda size: fault_cells(size, "prior"),
    (
        _harm("noisy prior", 2.0, "Noise of 2 spacings on the prior's points"),
        _harm("smoothed prior", 10.0, "Over-smoothing the prior (10 rounds)", harmless=True),
        _harm("holes", 0.2, "A hole of a fifth of the surface"),
        _harm("shifted prior", 0.1, "A prior that is shifted by 10 cm"),
        _harm("scaled prior", 1.1, "A prior that is 10 % too large"),
        _harm("turned prior", 15.0, "A prior that is turned by 15 degrees"),
        _harm(ANOTHER, 0, "The prior of another rock"),
    ),
    (LOST,),
)


def _alarm(row: Row) -> float:
    """1 where any sign is beyond its limit in `mgs.run.detectors`, else 0."""
    found = (
        (row.get(f"sign {sign}"), detector.limit) for sign, detector in detectors.DETECTORS.items()
    )
    return float(any(value is not None and value > limit for value, limit in found))


def false_alarms(rows: Sequence[Row]) -> list[float]:
    """Alarms of clean runs, 1 or 0; those of both kinds of faults count once."""
    clean = {(row["run"], row["size"]): row for row in rows if row["fault"] == "none"}
    return [_alarm(row) for row in clean.values()]


def caught(rows: Sequence[Row]) -> list[float]:
    """Alarms of failed runs, 1 or 0."""
    return [_alarm(row) for row in rows if row["failed"]]


ALARMS = Experiment(
    "Do the detectors tell failed runs from good ones?",
    lambda size: [*fault_cells(size, "images"), *fault_cells(size, "prior")],
    (
        Claim(
            "At most one in thirty clean runs raises an alarm.",
            false_alarms, "share", "below", 1 / 30, "clean run",
        ),
        Claim(
            "At least nine of ten failed runs raise an alarm.",
            caught, "share", "above", 0.9, "failed run",
        ),
    ),
    (
        Panel("fault", "failed", "fault, at all its sizes", "runs that failed (share)"),
    ),
)  # fmt: skip

EXPERIMENTS: dict[str, Experiment] = {
    "free-means": FREE_MEANS,
    "data-faults": DATA_FAULTS,
    "prior-faults": PRIOR_EXPERIMENT,
    "detectors": ALARMS,
}


SIZES = {
    "quick": StressSize(
        images=Size(160, 120, 24, 8),
        gaussians=3000,
        rocks=(("boulder", 0), ("boulder", 1)),
        others=(("contact-binary", 0), ("low-sun", 0)),
        turns=2,
        repeats=1,
        few_views=(2, 4, 8),
    ),
    "full": StressSize(
        images=Size(320, 240, 32, 12),
        gaussians=10_000,
        rocks=(*(("boulder", seed) for seed in range(5)), ("strata", 0), ("strata", 1)),
        others=tuple(
            (s, seed) for s in ("contact-binary", "low-sun", "pebbles") for seed in range(3)
        ),
        turns=3,
        repeats=3,
        few_views=(2, 3, 4, 6, 8),
    ),
}


def shown(size: StressSize) -> list[Cell]:
    """Cells of the experiments to be done."""
    return [cell for name in size.only for cell in size.experiments[name].cells(size)]


def sized(size: StressSize, options: Namespace) -> StressSize:
    """Size with the option --only."""
    return replace(size, only=tuple(names_of(options.only, list(size.experiments))))


def write(work: Work) -> list[Path]:
    """Write stability.csv (all numbers), verdicts.json, stability.md (the verdicts as tables) and
    NAME.png of every experiment that is done in this folder."""
    out, records, rows, sections = work.out, [], list[Row](), []
    paths = [out / name for name in ("verdicts.json", "stability.csv", "stability.md")]
    for name, experiment in work.size.experiments.items():
        results = [result_of(out, cell) for cell in experiment.cells(work.size)]
        if None in results:
            continue
        own = [row for result in results if result for row in result.get("rows", ())]
        claims = [judged(claim, own) for claim in experiment.claims]
        title = "" if experiment.panels[0].title else experiment.question
        paths.append(out / f"{name}.png")
        draw_panels(paths[-1], experiment.panels, own, title)
        records.append({"name": name, "question": experiment.question, "claims": claims})
        rows += [{"experiment": name} | row for row in own]
        sections.append(f"**{name}**: {experiment.question}\n\n{verdict_table(claims)}")
    record = {"experiments": records, "command": work.command}
    write_json(paths[0], record | {"machine": processor(), "versions": versions()})
    write_csv(paths[1], rows)
    write_text(paths[2], "\n".join(sections))
    return paths


STUDY = Study(
    "stress",
    __doc__,
    write,
    SIZES,
    lambda work: shown(work.size),
    WORKERS | {"--only": {"help": "Names of experiments, separated by commas. Default: all."}},
    sized,
)

if __name__ == "__main__":
    study_of("stress")()
