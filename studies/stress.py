"""Make the methods fail: what faults of images, prior and fit cost, and which warnings they raise.

Each fault has three sizes. A run is a fit to VIEWS even views of a hemisphere, with the default
settings of `mgs nbv` but for the fault. It has failed if its PSNR on the test views, which no fault
touches, is more than FAILURE below that of the same rock without the fault. Its choice is judged,
too: the gain that the best view under the fault has without it, over the largest gain. The second
part frees the means on few views, with and without a prior on the parameters.
"""

import gc
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import mgs
from mgs.policy import criteria
from mgs.run.checks import Checks
from mgs.run.detectors import DETECTORS
from mgs.run.policies import Policy
from mgs.run.settings import NbvSettings
from mgs.seeds import generator
from studies.faults import IMAGE_FAULTS, PRIOR_FAULTS, captured, pose_noise
from studies.frame.case import FRESH, ROCKS, Case, judge
from studies.frame.output import Panel, draw_panels, grouped, scene_mean, table, write_table
from studies.frame.program import WORKERS, Study, Work, study_of
from studies.frame.statistics import Row
from studies.frame.sweep import Cell
from studies.paper import FREE
from studies.setups import SETUPS, SIZES, SetupSize, case_of, sized

FAILURE = 1.0
"""Loss of PSNR, dB, above which a run has failed."""

VIEWS = 8
"""Views of the fits that faults spoil."""

FREE_PASSES = 40
"""Passes of fits with free means: four times the default, since a collapse takes time."""

FEW = [2, 4, 8]
"""Numbers of views with free means."""

KINDS = {
    "frozen": ("frozen", 1.0),
    "free": ("free", 1.0),
    "frozen, no prior": ("frozen", FREE),
    "free, no prior": ("free", FREE),
}
"""Setting of the means, and factor on the standard deviations of the prior; the paper has no prior.
Free means are compared with frozen ones of the same prior, since a fit without one loses anyway."""

POLICIES: dict[str, Policy] = {"d-optimal": mgs.DOptimal(), "directional-i": mgs.Directional()}
"""Policies whose choice is judged."""

NONE, ANOTHER, SHORT, ONE_POSE = "none", "another rock's prior", "few passes", "one bad pose"
SUN, SUN_MOVES = "moving sun", (5, 15, 45)
"""Degrees of azimuth by which the sun moves before the later half of the views is taken."""

FIT_FAULTS = {SHORT: ((5, 2, 1), "{:g}"), ONE_POSE: ((0.25, 1.0, 4.0), "{:g}° and cm")}
"""Sizes of faults of the fit and of a single view, and their words."""

WORDS = {name: fault.words for name, fault in (IMAGE_FAULTS | PRIOR_FAULTS).items()}
WORDS |= {name: words for name, (_, words) in FIT_FAULTS.items()}
WORDS |= {ANOTHER: "{:g}", SUN: "{:g}°"}
"""Formats of sizes with their units."""


def cells_of(size: SetupSize) -> list[Cell]:
    """Cells of both parts on every rock, with datasets and priors."""
    cells: list[Cell] = []
    rocks = dict.fromkeys((*size.rocks, *FRESH))  # a prior of another rock, also for one rock
    cases = [case_of(rock, SETUPS["hemisphere"], size) for rock in rocks]
    for k, case in enumerate(cases[: len(size.rocks)]):
        others = [cases[(k + step) % len(cases)] for step in (1, 2, 3)]
        moved = [under_sun(case, degrees) for degrees in SUN_MOVES]
        made = [one for each in (case, *others) for one in each.cells()]
        made += [one.cells()[0] for one in moved]
        wrong: dict[str, Any] = {"others": [other.prior for other in others]}
        wrong["moved"] = [one.dataset for one in moved]
        for part, more in (("faults", wrong), ("few_views", {"counts": FEW})):
            name, task = f"{part}/{case.rock.name}", f"{__name__}:{part}"
            *own, last = case.with_task(name, task, made=made, **more)
            about = {"part": part, "rock": case.rock.name, "scene": case.rock.scene}
            cells += [*own, replace(last, about=about)]
    return cells


def under_sun(case: Case, degrees: float) -> Case:
    """Case of the same views, with the sun turned by so many degrees of azimuth."""
    from mgs.synth.scene_file import load_scene_file

    sky = load_scene_file(case.rock.scene_file).sky
    changes = {**case.changes, "sky": {"sun_azimuth": sky.sun_azimuth + degrees}}
    label, size = f"{case.label}/sun-{degrees:g}", replace(case.size, tests=0)
    return replace(case, changes=changes, label=label, size=size)


def scene_of(data: mgs.Dataset, prior: mgs.Prior, loose: float = 1.0, **train: Any) -> mgs.Scene:
    """Scene with the settings of a run that has all its views. train: settings of fits.

    loose: factor on the standard deviations of the prior.
    """
    usual = mgs.Scene(data, prior).settings
    stds = {kind: loose * std for kind, std in usual.prior_std.items()}
    settings = NbvSettings(
        dataset=data.root,
        prior=data.root,
        budget=0,
        prior_std=stds,
        train=usual.train.model_copy(update=train),
    )
    return mgs.Scene(data, prior, settings.with_spacing(prior.spacing, loose))


def indicators(scene: mgs.Scene, state: mgs.State) -> dict[str, float]:
    """The indicators that `mgs nbv` writes for the state."""
    assert isinstance(scene.settings, NbvSettings)
    checks = Checks(scene, scene.settings, POLICIES["d-optimal"])
    coverage = criteria.coverage(state.surface, scene.surface_lam)
    views = checks.views(state.gaussians, state, state.taken)
    step = {"coverage": coverage, "information_gain": None}
    return dict(checks.indicators(state, views, [step])["indicators"])


def gains(scene: mgs.Scene, state: mgs.State) -> dict[str, np.ndarray]:
    """Score of each view that is not taken, by each policy."""
    others = [i for i in range(len(state.frames)) if i not in state.taken]
    return {name: policy(scene, state, others) for name, policy in POLICIES.items()}


class Lab:
    """A rock whose fits are compared with that of the same views without a fault."""

    def __init__(self, root: Path, dataset: str, prior: str) -> None:
        data = mgs.load_dataset(root / dataset)
        frames = tuple(captured(frame) for frame in data.frames)
        self.name, self.prior = dataset, mgs.load_prior(root / prior)
        self.data = replace(data, frames=frames)
        self.taken = scene_of(self.data, self.prior).seeds(VIEWS)
        self.rows: list[Row] = []
        self.clean: Row = {}
        self.best: dict[str, np.ndarray] = {}
        self.add(NONE, 0)

    def add(
        self, fault: str, size: float, prior: mgs.Prior | None = None, frames: Any = (), **how: Any
    ) -> None:
        """Fit with a fault, and add its row. prior, frames: in place of the right ones; how: of
        `scene_of`."""
        data = replace(self.data, frames=tuple(frames)) if frames else self.data
        scene = scene_of(data, prior or self.prior, **how)
        state = mgs.learn(scene, self.taken)
        row: Row = {"fault": fault, "size": size, **quality(state.gaussians, self.data)}
        signs, scores = indicators(scene, state), gains(scene, state)
        if fault == NONE:
            self.clean, self.best = row, scores
        for name, usual in self.best.items():
            row[f"choice {name}"] = float(usual[np.argmax(scores[name])] / usual.max())
        row |= {"lost": self.clean["psnr"] - row["psnr"]}
        self.rows.append(row | {f"sign {name}": value for name, value in signs.items()})
        gc.collect()  # a scene and its caches refer to each other

    def rng(self, fault: str, size: float) -> np.random.Generator:
        return generator(0, f"stress/{self.name}/{fault}/{size}")

    def with_fault(self, change: Any, size: float, views: Sequence[int], fault: str) -> list[Any]:
        """All frames, those of some views changed."""
        rng, frames = self.rng(fault, size), enumerate(self.data.frames)
        return [change(f, size, rng) if i in views else f for i, f in frames]

    def with_later(self, frames: Sequence[mgs.Frame]) -> list[mgs.Frame]:
        """Frames of the rock, with the later half of the views taken replaced. frames: of the same
        poses."""
        later = sorted(self.taken)[len(self.taken) // 2 :]
        pairs = enumerate(zip(self.data.frames, frames, strict=True))
        return [other if i in later else own for i, (own, other) in pairs]


def quality(model: mgs.Gaussians, data: mgs.Dataset) -> dict[str, float]:
    """PSNR on the test views, dB: of whole images (psnr), and inside the rock (psnr_mask)."""
    metrics = judge(model, data)
    return {key: metrics[key] for key in ("psnr", "psnr_mask")}


def faults(
    root: Path, out: Path, dataset: str, prior: str, others: Sequence[str], moved: Sequence[str]
) -> dict[str, list[Row]]:
    """Task: rows of every fault at every size. others: priors of other rocks. moved: datasets of
    this one under SUN_MOVES."""
    lab = Lab(root, dataset, prior)
    for fault, (change, sizes, _) in IMAGE_FAULTS.items():
        for size in sizes:
            lab.add(fault, size, frames=lab.with_fault(change, size, lab.taken, fault))
    for fault, (change, sizes, _) in PRIOR_FAULTS.items():
        for size in sizes:
            lab.add(fault, size, change(lab.prior, size, lab.rng(fault, size)))
    for k, other in enumerate(others):
        lab.add(ANOTHER, k, mgs.load_prior(root / other))
    for degrees, folder in zip(SUN_MOVES, moved, strict=True):
        later = map(captured, mgs.load_dataset(root / folder).frames)
        lab.add(SUN, degrees, frames=lab.with_later([*later]))
    for passes in FIT_FAULTS[SHORT][0]:
        lab.add(SHORT, passes, passes=passes)
    for size in FIT_FAULTS[ONE_POSE][0]:
        lab.add(ONE_POSE, size, frames=lab.with_fault(pose_noise, size, lab.taken[:1], ONE_POSE))
    return {"rows": lab.rows}


def few_views(
    root: Path, out: Path, dataset: str, prior: str, counts: Sequence[int]
) -> dict[str, list[Row]]:
    """Task: rows of fits with frozen and free means on few views. moved: distance of the means
    from the surface, rms, spacings. tau: Kendall's, of the D-optimal ranking with that of frozen
    means of the same prior."""
    from scipy.stats import kendalltau  # takes half a second

    data, surface = mgs.load_dataset(root / dataset), mgs.load_prior(root / prior)
    usual, rows = scene_of(data, surface), list[Row]()
    for count in counts:
        frozen = dict[float, np.ndarray]()
        for kind, (means, loose) in KINDS.items():
            how = {"means": means, "passes": FREE_PASSES, "tolerance": 0.0}
            scene = scene_of(data, surface, loose, **how)
            state = mgs.learn(scene, usual.seeds(count))
            away = state.gaussians.means - scene.untrained(state).means
            moved = float(np.sqrt(np.mean((away**2).sum(axis=1))) / surface.spacing)
            scores = gains(scene, state)["d-optimal"]
            tau = float(kendalltau(frozen.setdefault(loose, scores), scores).statistic)
            row = {"views": count, "means": kind, "moved": moved, "tau": tau}
            rows.append(row | quality(state.gaussians, data))
    return {"rows": rows}


def rows_of(work: Work) -> list[Row]:
    """Rows of both parts; of faults with the names of the warnings, of few views with the PSNR
    `over` that of frozen means with a prior."""
    rows = work.rows()
    for row in rows:
        signs = {name: row.get(f"sign {name}") for name in DETECTORS}
        above = [n for n, v in signs.items() if v is not None and v > DETECTORS[n].limit]
        row["warnings"] = " ".join(above)
    usual = {(r["rock"], r["views"]): r["psnr"] for r in rows if r.get("means") == "frozen"}
    for row in rows:
        if row["part"] == "few_views":
            row["over"] = row["psnr"] - usual[row["rock"], row["views"]]
    return rows


def label_of(row: Row) -> str:
    """Name of a fault and its size, with the unit."""
    return f"{row['fault']}, {WORDS[row['fault']].format(row['size'])}"


def by_size(cell: Any) -> Any:
    """Content of a column for a row of one fault: the content of each size."""
    return lambda group: " / ".join(cell(one) for one in grouped(group["of"], "size"))


def sizes(group: Row) -> str:
    """The sizes of a fault, with the unit once; of other rocks' priors, how many."""
    before, _, after = WORDS[group["fault"]].partition("{")
    unit = after[after.index("}") + 1 :]
    each = [WORDS[group["fault"]].format(one["size"]) for one in grouped(group["of"], "size")]
    if group["fault"] == ANOTHER:
        return f"{len(each)} rocks"
    short = [text.removeprefix(before).removesuffix(unit) for text in each]
    return f"{before}{' / '.join(short)}{unit}"


def count_of_warnings(group: Row) -> str:
    return str(sum(bool(row["warnings"]) for row in group["of"]))


def commonest_warnings(group: Row) -> str:
    """Warnings that at least half of the runs of the two larger sizes raise, or of all rocks."""
    last = grouped(group["of"], "size")[group["fault"] != ANOTHER :]
    runs = [row for one in last for row in one["of"]]
    count = Counter(name for row in runs for name in (row["warnings"] or "").split())
    return ", ".join(name for name, many in count.most_common() if 2 * many >= len(runs)) or "–"


def share_of_gain(policy: str) -> Any:
    """Content: mean share of the gain that the choice keeps at each size, per cent."""
    share = by_size(scene_mean(f"choice {policy}", ".0%", ends=False))
    return lambda group: share(group).replace("%", "")


def tables(rows: Sequence[Row]) -> str:
    """Tables of faults, warnings and few views; means over scenes, for few views with 95 %
    intervals."""
    both = grouped([row for row in rows if row["part"] == "faults"], "fault")
    clean, spoiled = both[0]["of"], [row for group in both[1:] for row in group["of"]]
    columns: dict[str, Any] = {"fault": "fault", "sizes": sizes}
    columns |= {"cost (dB)": by_size(scene_mean("lost", ".1f", ends=False))}
    columns |= {"runs warned of": by_size(count_of_warnings), "by": commonest_warnings}
    columns |= {"`d-optimal` keeps (%)": share_of_gain("d-optimal")}
    columns |= {"`directional-i` keeps (%)": share_of_gain("directional-i")}
    text = table(columns, both[1:])

    groups = {
        "no fault": clean,
        "a fault that costs at most 1 dB": [row for row in spoiled if row["lost"] <= FAILURE],
        "a fault that costs more": [row for row in spoiled if row["lost"] > FAILURE],
    }
    several = [{"with": name, "of": of, "runs": len(of)} for name, of in groups.items()]
    text += (
        f"\n{table({'runs with': 'with', 'runs': 'runs', 'warned of': count_of_warnings}, several)}"
    )

    few = grouped([row for row in rows if row["part"] == "few_views"], "views", "means")
    columns = {"views": "views", "means": "means", "PSNR (dB)": scene_mean("psnr", ".2f", False)}
    columns |= {"over frozen means with a prior": scene_mean("over", "+.2f")}
    columns |= {"moved (spacings)": scene_mean("moved", ".2f", ends=False)}
    columns |= {"tau of the ranking": scene_mean("tau", ".2f")}
    return f"{text}\n{table(columns, few)}"


def write(work: Work) -> list[Path]:
    """Write stress.csv, .json and .md, and a picture of the faults."""
    rows = rows_of(work)
    path = work.out / "stress.png"
    draw(path, rows)
    return [*write_table(work, "stress", rows, tables(rows)), path]


def draw(path: Path, rows: Sequence[Row]) -> None:
    """Draw what faults of the images and of the prior cost."""
    shown = [
        row | {"label": label_of(row), "of": PRIOR if row["fault"] in PRIOR_FAULTS else IMAGES}
        for row in rows
        if row["part"] == "faults" and row["fault"] in (*IMAGE_FAULTS, SUN, *PRIOR_FAULTS)
    ]
    label = "PSNR lost on test views (dB)"
    panels = [
        Panel("label", "lost", "", label, only=(("of", of),), title=of) for of in (IMAGES, PRIOR)
    ]
    draw_panels(path, panels, shown)


IMAGES, PRIOR = "Faults of images", "Faults of the prior"

STUDY = Study("stress", __doc__, write, SIZES, cells_of, ROCKS | WORKERS, sized)

if __name__ == "__main__":
    study_of("stress")()
