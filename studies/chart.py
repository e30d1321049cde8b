"""Speed against accuracy of fits and of whole runs.

A point is one `mgs nbv`: its time, and its quality on the test views. A *fit* takes all its images
at once, evenly spaced in azimuth; a *run* starts from the seeds and chooses the other images one by
one. Factors are varied one at a time around the default; those that matter most are crossed.

Points are timed one by one: let nothing else run meanwhile.
"""

import shlex
import shutil
from argparse import Namespace
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import mgs
from mgs.fit.settings import PASSES, WARM_PASSES
from mgs.plotting import drawing
from studies.frame.case import Case, Rock, Size, judge, test_views_of
from studies.frame.output import Content, group_styles, grouped, logarithmic, table, write_table
from studies.frame.program import Study, Work, at_least, names_of, study_of
from studies.frame.statistics import Row, pareto_front
from studies.frame.sweep import Cell, Results
from studies.frame.timing import REFERENCE, span, timed, with_seconds

if TYPE_CHECKING:
    from matplotlib.axes import Axes

KINDS = ("fit", "run")

SCENE = "boulder"
"""Scene of the charts."""

BASE = "d-optimal"
"""Policy of runs in which other settings vary."""

DENSITY = 1 / 8
"""Density of the base: a tenth of the automatic one, for short times."""

QUALITIES = ("psnr", "ssim", "psnr_mask", "ssim_mask")
"""Metrics of the test views in rows."""

LATER_PASSES = {2: 2, 5: 3, 10: 5, 20: 10, 40: 20}
"""Passes of later fits of a run, by passes of the first."""

PRESETS: dict[str, dict[str, Any]] = {
    "fast": {"passes": 5, "warm_passes": 3, "density": 1 / 4},
    "balanced": {"passes": PASSES, "warm_passes": WARM_PASSES, "density": 1 / 2},
    "accurate": {"passes": PASSES, "warm_passes": WARM_PASSES, "density": 5 / 4},
}
"""Fields of a `Point` by name: settings that docs/speed-accuracy.md recommends."""


@dataclass(frozen=True)
class ChartSize:
    """Size of the charts.

    images: of the dataset. count: images fitted, of which `seeds` are evenly spaced. repeats:
    timings of each point. run_passes: of the first fit of runs. reference: of `timed`. kinds: of
    KINDS. given: a dataset in place of the rendered one. The other fields are values of factors.
    """

    images: Size
    count: int
    repeats: int
    densities: tuple[float, ...]
    passes: tuple[int, ...]
    run_passes: tuple[int, ...]
    image_counts: tuple[int, ...]
    policies: tuple[str, ...]
    estimators: tuple[str, ...] = ("loss-gradient",)
    presets: Mapping[str, Mapping[str, Any]] = field(default_factory=lambda: PRESETS)
    seeds: int = 4
    reference: tuple[int, int, int] = REFERENCE
    kinds: tuple[str, ...] = KINDS
    given: Path | None = None

    def case(self, density: float) -> Case:
        """Case with a prior of this density."""
        label = self.given.name if self.given else ""
        return Case(Rock(SCENE), self.images, {"density": density}, self.given, label=label)


SIZES = {
    "quick": ChartSize(
        images=Size(192, 144, 24, 8),
        count=8,
        repeats=2,
        densities=(1 / 8, 1 / 4, 1 / 2, 3 / 4),
        passes=(5, 10, 20),
        run_passes=(5, 10),
        image_counts=(4, 12),
        policies=("directional-i", "random"),
    ),
    "full": ChartSize(
        images=Size(320, 240, 32, 12),
        count=12,
        repeats=3,
        densities=(1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 3 / 4),
        passes=(2, 5, 10, 20, 40),
        run_passes=(5, 10, 20),
        image_counts=(4, 6, 8, 16, 24),
        policies=(
            "directional-i", "directional-d", "fisherrf", "uniform", "farthest", "random", "paper"
        ),
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Point:
    """Settings of one `mgs nbv`. policy: empty for a fit of all images at once."""

    images: int
    density: float = DENSITY
    passes: int = PASSES
    warm_passes: int = WARM_PASSES
    policy: str = ""
    estimator: str = "exact"

    @property
    def kind(self) -> str:
        """One of KINDS."""
        return "run" if self.policy else "fit"

    @property
    def name(self) -> str:
        """Name of its cell."""
        parts = [f"d{1 / self.density:g}", f"i{self.images}", f"p{self.passes}"]
        parts += [str(self.warm_passes), self.policy, self.estimator] if self.policy else []
        return f"{self.kind}/{'-'.join(parts)}"

    def settings(self, seeds: int) -> dict[str, Any]:
        """Settings of `mgs nbv`."""
        seeds = seeds if self.policy else self.images
        return {
            "policy": self.policy or "uniform",
            "estimator": self.estimator,
            "warm_passes": self.warm_passes,
            "seeds": seeds,
            "budget": self.images - seeds,
            "train": {"passes": self.passes},
        }

    def command(self, dataset: Path, prior: Path, seeds: int) -> str:
        """Command line that makes this model."""
        given = self.settings(seeds)
        passes = given.pop("train")["passes"]
        given |= {"train.passes": passes}
        words = ["mgs", "nbv", str(dataset), "--prior", str(prior), "--out", "RUN"]
        for key, value in given.items():
            words += ["--set", f"{key}={value}"]
        return shlex.join(words)


def factors(size: ChartSize) -> dict[str, list[Point]]:
    """Points by factor; a point may be in several."""
    fit, run = Point(size.count), Point(size.count, policy=BASE)
    return {
        "number of Gaussians": [replace(fit, density=d) for d in size.densities],
        "passes": [replace(fit, passes=p) for p in size.passes],
        "images": [replace(fit, images=n) for n in size.image_counts],
        "number and passes of a fit": [
            replace(fit, density=d, passes=p) for d in size.densities for p in size.passes
        ],
        "policy": [replace(run, policy=name) for name in (BASE, *size.policies)],
        "estimator": [replace(run, estimator=name) for name in size.estimators],
        "number and passes": [
            replace(run, density=d, passes=p, warm_passes=LATER_PASSES[p])
            for d in size.densities[-3:]
            for p in size.run_passes
        ],
        "preset": list(preset_points(size).values()),
    }


def preset_points(size: ChartSize) -> dict[str, Point]:
    """Runs with PRESETS."""
    run = Point(size.count, policy=BASE)
    return {name: replace(run, **row) for name, row in size.presets.items()}


def points_of(size: ChartSize, kind: str) -> list[Point]:
    """Points of a kind, each once."""
    points = (point for some in factors(size).values() for point in some if point.kind == kind)
    return list(dict.fromkeys(points))


def cells_of(size: ChartSize) -> list[Cell]:
    """Cells of all points, and those they need."""
    cells: list[Cell] = []
    for point in (point for kind in size.kinds for point in points_of(size, kind)):
        how = {"repeats": size.repeats, "settings": point.settings(size.seeds)}
        how["reference"] = list(size.reference)
        task = f"{__name__}:measure"
        cells += size.case(point.density).with_task(point.name, task, alone=True, **how)
    return cells


def rows_of(size: ChartSize, kind: str, results: Results, unit: float) -> list[Row]:
    """A row for each point of a kind: factors, settings, results, command, and whether it is on the
    front of seconds against PSNR and SSIM among points of as many images. unit: seconds of the
    reference."""
    by_factor, rows = factors(size), list[Row]()
    presets = {point: name for name, point in preset_points(size).items()}
    for point in points_of(size, kind):
        case = size.case(point.density)
        names = [name for name in by_factor if point in by_factor[name]]
        row: Row = {"factors": "; ".join(names), "preset": presets.get(point, "")}
        row |= asdict(point) | results[point.name]
        row |= {"gaussians": results[case.prior_name]["gaussians"]}
        where = Path(case.dataset), Path(case.prior)  # below the study's folder
        rows.append(row | {"command": point.command(*where, size.seeds)})
    rows = with_seconds(rows, unit)
    for count in {row["images"] for row in rows}:
        alike = [row for row in rows if row["images"] == count]
        seconds = [row["seconds"] for row in alike]
        for column, metric in (("front", "psnr"), ("front_ssim", "ssim")):
            front = pareto_front(seconds, [row[metric] for row in alike])
            for row, on in zip(alike, front, strict=True):
                row[column] = bool(on)
    return rows


def measure(
    root: Path,
    out: Path,
    dataset: str,
    prior: str,
    settings: dict[str, Any],
    repeats: int,
    reference: Sequence[int] = REFERENCE,
) -> dict[str, Any]:
    """Task: time a run, files included, and judge its model. Returns times (`timed`), qualities and
    passes of all fits together."""

    def run() -> mgs.Checkpoint:
        shutil.rmtree(out / "run", ignore_errors=True)
        return mgs.run_nbv(root / dataset, out / "run", prior=root / prior, **settings).state

    state, times = timed(run, repeats, tuple(reference))
    shutil.rmtree(out / "run")
    metrics = judge(state.gaussians, mgs.load_dataset(root / dataset))
    return {
        **times,
        **{name: metrics[name] for name in QUALITIES},
        "total_passes": sum(step["iterations"] // step["images"] for step in state.steps),
    }


def _settings_text(row: Row) -> str:
    passes = f"{row['passes']} passes" + (f", then {row['warm_passes']}" if row["policy"] else "")
    name = f"**{row['preset']}**: " if row["preset"] else ""
    estimator = "" if row["estimator"] == "exact" else row["estimator"]
    parts = [f"{row['gaussians']:,} Gaussians", passes, row["policy"], estimator]
    return name + ", ".join(part for part in parts if part)


WORDS = {
    "gaussians": "{:,} Gaussians",
    "passes": "{} passes",
    "images": "{} images",
    "policy": "policy {}",
    "estimator": "estimator {}",
}
"""Settings of a point, in words."""


def changes(rows: Sequence[Row]) -> list[Row]:
    """Rows that differ from the base of their kind in one of WORDS, with the change in words, the
    times over that of the base, and the differences of PSNR, dB."""
    changed = []
    for one in grouped(rows, "kind"):
        about = {"density": DENSITY, "passes": PASSES, "estimator": "exact"}
        about |= {"policy": BASE if one["kind"] == "run" else None}
        about |= {"images": Counter(row["images"] for row in one["of"]).most_common(1)[0][0]}
        alike = [{**row, "policy": row["policy"] or None} for row in one["of"]]
        base = next(row for row in alike if about.items() <= row.items())
        for row in alike:
            keys = [key for key in WORDS if row[key] != base[key]]
            if len(keys) == 1:
                words = f"{one['kind']}: {WORDS[keys[0]].format(row[keys[0]])}"
                row |= {"change": words, "times": row["seconds"] / base["seconds"]}
                row |= {f"{key}_more": row[key] - base[key] for key in ("psnr", "psnr_mask")}
                changed.append(row)
    return changed


def tables(rows: Sequence[Row]) -> str:
    """Table of single changes; of fits, then of runs, on the fronts or with a preset."""
    columns: dict[str, Content] = {"change": "change", "times the seconds": "times:.2f"}
    columns |= {"PSNR (dB)": "psnr_more:+.2f", "rock (dB)": "psnr_mask_more:+.2f"}
    text = table(columns, changes(rows))
    return f"{text}\n{fronts(rows)}"


def fronts(rows: Sequence[Row]) -> str:
    """Tables of the points on the fronts or with a preset, of each kind."""
    columns: dict[str, Content] = {"on the front, or a preset": _settings_text, "images": "images"}
    columns |= {"seconds": span, "PSNR (dB)": "psnr:.2f", "SSIM": "ssim:.4f"}
    columns |= {"PSNR, rock (dB)": "psnr_mask:.2f"}
    texts = []
    for one in grouped(rows, "kind"):
        shown = [row for row in one["of"] if row["front"] or row["preset"]]
        texts.append(table(columns, sorted(shown, key=lambda r: (r["images"], r["seconds"]))))
    return "\n".join(texts)


def check_dataset(dataset: Path) -> None:
    """Raises InputError for a dataset that cannot be read or has no test views."""
    test_views_of(mgs.load_dataset(dataset))


def sized(size: ChartSize, options: Namespace) -> ChartSize:
    """Size with the options."""
    given: Path | None = options.dataset and options.dataset.resolve()
    if given:
        check_dataset(given)
    kinds = tuple(names_of(options.only, KINDS))
    return replace(size, given=given, kinds=kinds, repeats=options.repeats or size.repeats)


def write(work: Work) -> list[Path]:
    """Write chart.csv, .json, .md and .png."""
    size, results = work.size, work.results
    unit = float(np.median([one["reference"] for one in results.values() if "reference" in one]))
    rows = [
        {"kind": kind} | row for kind in size.kinds for row in rows_of(size, kind, results, unit)
    ]
    draw(work.out / "chart.png", rows)
    more = {"repeats": size.repeats, "reference_seconds": unit}
    return [*write_table(work, "chart", rows, tables(rows), **more), work.out / "chart.png"]


TITLES = {"fit": "What a second buys: single fits", "run": "What a second buys: whole runs"}
"""Titles of the figures of the kinds."""


def draw(path: Path, rows: Sequence[Row]) -> None:
    """Draw seconds against PSNR, a panel for each kind of KINDS, for points of the usual number of
    images: by the last of their factors, with the best of each time and the names of presets.

    Raises InputError if the file cannot be written.
    """
    names = list(dict.fromkeys(map(_factor, rows)))
    looks = dict(zip(names, group_styles(names), strict=True))
    kinds = {one["kind"]: one["of"] for one in grouped(rows, "kind")}
    with drawing(path, 0.6 + 4.2 * len(kinds), 4.6) as figure:
        panels = figure.subplots(1, len(kinds), squeeze=False)[0]
        for axes, (kind, rows) in zip(panels, kinds.items(), strict=True):
            _draw_kind(axes, rows, looks)
            axes.set_title(TITLES[kind])


def _factor(row: Row) -> str:
    return str(row["factors"].split("; ")[-1])


def _draw_kind(axes: "Axes", rows: Sequence[Row], looks: Mapping[str, dict[str, Any]]) -> None:
    """Draw one panel. looks: keywords for matplotlib by factor."""
    most = Counter(row["images"] for row in rows).most_common(1)[0][0]
    rows = [row for row in rows if row["images"] == most]
    front = sorted((row["seconds"], row["psnr"]) for row in rows if row["front"])
    ahead = {"color": "black", "linewidth": 1, "zorder": 1, "label": "best of its time"}
    axes.step(*zip(*front, strict=True), where="post", **ahead)
    for name in dict.fromkeys(map(_factor, rows)):
        of = [row for row in rows if _factor(row) == name]
        low, x, high = (
            np.array([row[f"seconds{end}"] for row in of]) for end in ("_low", "", "_high")
        )
        look = looks[name] | {"linestyle": "none", "elinewidth": 0.8, "markersize": 6}
        axes.errorbar(x, [row["psnr"] for row in of], xerr=[x - low, high - x], **look)
    for row in rows:
        at = row["seconds"], row["psnr"]
        axes.annotate(row["preset"] or "", at, (6, -12), textcoords="offset points")
    logarithmic(axes)
    axes.margins(0.08)
    axes.set(xlabel=f"seconds, {most} images", ylabel="PSNR on the test views (dB)")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=2, fontsize=9)


STUDY = Study(
    "chart",
    __doc__,
    write,
    SIZES,
    lambda work: cells_of(work.size),
    {
        "--dataset": {
            "type": Path,
            "help": "A dataset with test views, in place of the rendered one.",
        },
        "--only": {"help": "fit or run. Default: both."},
        "--repeats": {
            "type": at_least(1),
            "help": "Timings of each point; the median counts. Default: quick 2, full 3.",
        },
    },
    sized,
)

if __name__ == "__main__":
    study_of("chart")()
