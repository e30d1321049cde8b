"""Bytes against quality: the format mgs beside SPZ, compressed PLY, SOG, and the pictures as JPEG.

Each rock is fitted with several numbers of Gaussians. Every coder writes each model: whole, pruned
as by `mgs simplify`, and with 1/2 to 1/16 of its Gaussians, fitted once more as by `mgs export
--bytes`. What the best files of the format mgs give is fitted and written again, as there. A coder
is judged by the best of its files at each size. What files do not say, as the space of colours, is
added when they are read back, so only the coding differs.
"""

import io
import shutil
import subprocess
import warnings
from argparse import Namespace
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import mgs
from mgs.colour import srgb_from_linear
from mgs.compact.encode import Compact
from mgs.errors import Notice
from mgs.evaluation import render_view
from mgs.plotting import NO_GRID, crop, drawing
from mgs.reports.compacting import ROUNDS, compact_run, encoding, refitting, settled, thinned
from mgs.run.folder import Run
from mgs.run.nbv import start_fit
from mgs.splat_files import FORMATS, load_gaussians, write_gaussians
from studies.frame.case import FRESH, ROCKS, Case, Rock, Size, judge, rocks_of, test_views_of
from studies.frame.output import Panel, draw_panels, table, write_table
from studies.frame.program import Study, Work, study_of
from studies.frame.statistics import Row, interval, pareto_front
from studies.frame.sweep import Cell

WITH, ALONE, JPEG, SOG = "mgs, mesh at the receiver", "mgs", "JPEG, fitted at home", "SOG"
OTHERS = {"SPZ": "spz", "compressed PLY": "compressed-ply"}

SCALES = (0.02, 0.05, 0.12, 0.3)
"""Scales of the steps (`mgs.compact.encode.Encoder.file`)."""

QUALITIES = (50,)
"""JPEG qualities, 0 to 100."""

AUTO = "auto"
"""Automatic number of Gaussians."""

SENT = (10_000, 30_000, 100_000)
"""Bytes after which the picture shows the model."""

LINK = 4000
"""Bits per second."""

COMMON = 24
"""Values of PSNR at which two coders are compared, evenly over what both reach."""


@dataclass(frozen=True)
class RateSize:
    """Rocks, images, and numbers of Gaussians. tool: command of splat-transform, or empty."""

    images: Size
    counts: tuple[int | str, ...]
    rocks: tuple[Rock, ...] = FRESH[:6]
    tool: str = ""

    def case(self, rock: Rock) -> Case:
        """Views of a rock from a hemisphere, with a prior of the automatic number of Gaussians."""
        case = Case(rock, self.images, {"seed": 0})
        return case.on_orbit({"kind": "hemisphere", "distances": [1]})

    def cells(self) -> list[Cell]:
        """Cells of all rocks: files of each number of Gaussians, of JPEG, and of the picture."""
        cells: list[Cell] = []
        for rock in self.rocks:
            whole = self.case(rock)
            for count in self.counts:
                case = whole
                if count != AUTO:
                    case = replace(whole, settings={"gaussians": count, "seed": 0})
                task, name = f"{__name__}:code", f"files/{rock.name}/{count}"
                cells += case.with_task(name, task, tool=self.tool)
            for quality in QUALITIES:
                name = f"jpeg/{rock.name}/{quality}"
                cells += whole.with_task(name, f"{__name__}:by_jpeg", quality=quality)
            if rock == self.rocks[0]:
                cells += whole.with_task("picture", f"{__name__}:picture")
        return cells


def fitted(root: Path, out: Path, dataset: str, prior: str) -> Run:
    """Fit of all images of a dataset, in OUT/run."""
    run = start_fit(root / dataset, out / "run", prior=root / prior, force=True)
    return mgs.resume_nbv(run)


def code(root: Path, out: Path, dataset: str, prior: str, tool: str) -> dict[str, Any]:
    """Task: fit a model; write it by every coder. Returns the rows of its files."""
    run, data = fitted(root, out, dataset, prior), mgs.load_dataset(root / dataset)
    g, rows = run.gaussians, [_row("whole model", 0, run.gaussians, data)]
    models, fit = [(g, np.arange(len(g))), *thinned(run, whole=False)], refitting(run)
    for name, shared in ((WITH, True), (ALONE, False)):
        encoder = encoding(run, shared)
        encoders = [(encoder(*model), model[1]) for model in models]
        coded = [(one.file(scale), kept) for one, kept in encoders for scale in SCALES]
        mine = [_row_of(name, file, data) for file, _ in coded]
        best = pareto_front([row["kB"] for row in mine], [row["psnr"] for row in mine])
        for (file, kept), chosen in zip(coded, best, strict=True):
            for _ in range(ROUNDS if chosen else 0):
                again = encoder(fit(file.model), kept, file.header)
                file = settled(again.plan(file.header.scale), fit)
                mine.append(_row_of(name, file, data))
        rows += mine
    # Not every format says in which space colours are blended, or that splats are antialiased.
    marks = partial(replace, linear=g.linear, antialiased=g.antialiased)
    for model, _ in models:
        paths = {coder: out / f"model{FORMATS[kind]}" for coder, kind in OTHERS.items()}
        for coder, path in paths.items():
            write_gaussians(path, model, OTHERS[coder], np.eye(3))
        files = {coder: (path, path) for coder, path in paths.items()}
        if tool:
            mgs.write_ply(out / "model.ply", model)
            for pair in (("model.ply", "model.sog"), ("model.sog", "back.ply")):
                words = [*tool.split(), "-w", *pair]
                subprocess.run(words, cwd=out, check=True, capture_output=True)
            files[SOG] = out / "model.sog", out / "back.ply"
        for coder, (path, back) in files.items():
            read = marks(load_gaussians(back))
            rows.append(_row(coder, path.stat().st_size, read, data))
    return {"rows": rows}


def _row(coder: str, size: int, model: mgs.Gaussians, dataset: mgs.Dataset) -> Row:
    """Row of a file, by the model read from it."""
    found = judge(model, dataset)
    row = {"coder": coder, "gaussians": len(model), "kB": size / 1e3}
    return row | {key: found[key] for key in ("psnr", "psnr_mask", "psnr_inside")}


def _row_of(coder: str, file: Compact, dataset: mgs.Dataset) -> Row:
    """Row of a file of the format mgs."""
    return _row(coder, len(file), file.model, dataset) | {"scale": file.header.scale}


def by_jpeg(root: Path, out: Path, dataset: str, prior: str, quality: int) -> dict[str, Any]:
    """Task: fit the images as they come out of JPEG. The receiver has poses, masks and prior."""
    sent, size = out / "dataset", 0
    shutil.rmtree(sent, ignore_errors=True)
    shutil.copytree(root / dataset, sent)
    for frame in mgs.load_dataset(sent).frames:
        with Image.open(frame.image_path) as image, io.BytesIO() as file:
            image.convert("RGB").save(file, "JPEG", quality=quality, optimize=True)
            size += file.tell()
            with Image.open(file) as read:
                read.save(frame.image_path)
    run = fitted(root, out, str(sent.resolve()), prior)
    return {"rows": [_row(JPEG, size, run.gaussians, mgs.load_dataset(root / dataset))]}


def picture(root: Path, out: Path, dataset: str, prior: str) -> dict[str, Any]:
    """Task: draw a test view after SENT bytes of one file each, with and without positions, beside
    the truth."""
    return draw_sent(fitted(root, out, dataset, prior), out)


def draw_sent(run: Run, out: Path) -> dict[str, Any]:
    """Draw OUT/sent.png of a run, as `picture`."""
    frame = test_views_of(run.dataset).frames[0]
    truth, part = frame.target()[0][..., :3], crop(frame.mask())
    files = {name: compact_run(run, SENT[-1], shared=name == WITH).data for name in (WITH, ALONE)}
    shown = list[tuple[str, str, np.ndarray]]()
    for name, file in files.items():
        path = out / f"{len(shown)}.mgs"
        for sent in SENT:
            path.write_bytes(file[:sent])
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", Notice)
                model = load_gaussians(path, run.settings.prior if name == WITH else None)
            rgb = render_view(model, frame.camera)[0]
            error = np.mean((srgb_from_linear(rgb) - srgb_from_linear(truth)) ** 2)
            title = f"{sent // 1000} kB, {8 * sent / LINK:.0f} s: {-10 * np.log10(error):.1f} dB"
            shown.append((name, title, rgb))
    with drawing(out / "sent.png", 9.6, 4.6, NO_GRID) as figure:
        axes = figure.subplots(2, 4)
        for k, line in enumerate(axes):
            images = [*shown[3 * k : 3 * k + 3], ("", "truth", truth)]
            for axis, (_, title, rgb) in zip(line, images, strict=True):
                axis.imshow(srgb_from_linear(rgb)[part], interpolation="lanczos")
                axis.set_title(title)
                axis.set(xticks=[], yticks=[])
            line[0].set_ylabel(images[0][0])
    return {"bytes": {name: len(file) for name, file in files.items()}}


def rows_of(work: Work) -> Iterator[Row]:
    """Rows of all files; `front`: no file of its coder is smaller and better."""
    for rock in work.size.rocks:
        of = [f"files/{rock.name}/{count}" for count in work.size.counts]
        of += [f"jpeg/{rock.name}/{quality}" for quality in QUALITIES]
        rows = [row for name in of for row in work.results[name]["rows"]]
        for coder in dict.fromkeys(row["coder"] for row in rows):
            mine = sorted((r for r in rows if r["coder"] == coder), key=lambda row: row["kB"])
            front = pareto_front([r["kB"] for r in mine], [r["psnr"] for r in mine])
            for row, best in zip(mine, front, strict=True):
                yield {"run": rock.name, **row, "front": bool(best)}


def share(rows: Sequence[Row], run: str, one: str, other: str, below: float | None = None) -> float:
    """Bytes of a coder over those of another at equal PSNR: geometric mean over the values that
    both reach, or at this many dB below the best of them; NaN if there is none."""
    fronts = [
        [r for r in rows if r["run"] == run and r["coder"] == coder and r["front"]]
        for coder in (one, other)
    ]
    if not all(fronts):
        return float("nan")
    ends = [(front[0]["psnr"], front[-1]["psnr"]) for front in fronts]
    low, high = max(a for a, _ in ends), min(b for _, b in ends)
    if low > high:
        return float("nan")
    at = np.linspace(low, high, COMMON) if below is None else np.array([high - below])
    if at[0] < low:
        return float("nan")
    logs = [np.interp(at, [r["psnr"] for r in f], np.log([r["kB"] for r in f])) for f in fronts]
    return float(np.exp(np.mean(logs[0] - logs[1])))


PAIRS = {
    "mgs / SPZ": (ALONE, "SPZ"),
    "mgs with mesh / SPZ": (WITH, "SPZ"),
    "compressed PLY / SPZ": ("compressed PLY", "SPZ"),
    "SOG / SPZ": (SOG, "SPZ"),
    "mgs with mesh / JPEG": (WITH, JPEG),
}
"""Coders compared, by the heading of their column."""


LEVELS = {None: "mean", 0: "at the best PSNR", 2: "2 dB below it"}


def tables(rows: Sequence[Row]) -> str:
    """Table of `share` of PAIRS on each rock, and of the means of LEVELS with 95 % intervals."""
    runs = list(dict.fromkeys(row["run"] for row in rows))
    values = {name: [share(rows, run, *pair) for run in runs] for name, pair in PAIRS.items()}
    lines: list[Row] = []
    for k, run in enumerate(runs):
        found = {name: of[k] for name, of in values.items()}
        lines.append({"rock": run} | {n: f"{v:.3f}" for n, v in found.items() if not np.isnan(v)})
    for below, label in LEVELS.items():
        mean: Row = {"rock": label}
        for name, pair in PAIRS.items():
            of = [share(rows, run, *pair, below) for run in runs]
            if (ends := interval(of)) and not np.isnan(of).any():
                mean[name] = f"{np.mean(of):.3f} [{ends[0]:.3f}, {ends[1]:.3f}]"
        lines.append(mean)
    return table({name: name for name in ("rock", *PAIRS)}, lines)


def write(work: Work) -> list[Path]:
    """Write rate.csv, .json, .md and .png, and sent.png."""
    rows = list(rows_of(work))
    labels = "kB", "psnr", "kB", "PSNR, test views (dB)", "coder", True
    panels = [
        Panel(*labels, only=(("run", rock.name), ("front", True)), title=rock.name)
        for rock in work.size.rocks
    ]
    drawn = [row for row in rows if row["kB"]]
    draw_panels(work.out / "rate.png", panels, drawn, "Best files of each coder")
    shutil.copyfile(work.out / "cells/picture/sent.png", work.out / "sent.png")
    paths = write_table(work, "rate", rows, tables(rows))
    return [*paths, work.out / "rate.png", work.out / "sent.png"]


def sized(size: RateSize, options: Namespace) -> RateSize:
    """Size with the rocks and the tool of the options."""
    return replace(size, rocks=rocks_of(options, 6), tool=options.splat_transform)


STUDY = Study(
    "rate",
    __doc__,
    write,
    {
        "quick": RateSize(Size(128, 96, 36, 16), (AUTO, 5000)),
        "full": RateSize(Size(320, 240, 36, 16), (AUTO, 30_000, 10_000, 3000)),
    },
    RateSize.cells,
    ROCKS
    | {
        "--splat-transform": {
            "default": "",
            "metavar": "COMMAND",
            "help": "Command of splat-transform, to write SOG.",
        }
    },
    sized,
)

if __name__ == "__main__":
    study_of("rate")()
