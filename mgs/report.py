"""Figures and tables of runs, from files only: nothing is computed anew.

One function a figure; each takes plain data and writes one PNG. `read_run` gathers that data from a run folder.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mgs.conventions import srgb_from_linear
from mgs.errors import InputError
from mgs.files import atomic_path, read_json

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from rich.console import Console

STYLE = {
    "font.family": "serif",
    "font.serif": ["STIXGeneral", "DejaVu Serif"],
    "mathtext.fontset": "stix",
    "font.size": 10,
    "axes.titlesize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "lines.linewidth": 1.5,
    "lines.markersize": 4,
}
DPI = 200
POLICY_STYLE = {
    "d-optimal": ("#0072B2", "o"),
    "coverage": ("#D55E00", "s"),
    "random": ("#009E73", "^"),
    "uniform": ("#CC79A7", "D"),
    "farthest": ("#E69F00", "v"),
    "t-optimal": ("#56B4E9", "P"),
    "a-optimal": ("#000000", "X"),
}
"""Colour (Okabe and Ito's colour-blind-safe set) and marker of a policy, the same in every figure."""


@dataclass(frozen=True)
class Run:
    """What a run folder says: policy, lines of steps.jsonl, metrics.json where the run was evaluated, settings."""

    folder: Path
    policy: str
    steps: list[dict[str, Any]]
    metrics: dict[str, Any] | None
    settings: dict[str, Any]

    @property
    def seeds(self) -> list[int]:
        """Frame indices of the seeds."""
        return list(self.steps[0]["seeds"])

    @property
    def chosen(self) -> list[int]:
        """Frame indices in the order of their choice, without the seeds."""
        return [int(step["frame"]) for step in self.steps[1:]]


def read_run(folder: str | Path) -> Run:
    """Read config.json, steps.jsonl and, where it is there, metrics.json.

    Raises InputError where the folder holds no run, or a file is damaged or empty.
    """
    folder = Path(folder)
    config = read_json(folder / "config.json")
    path = folder / "steps.jsonl"
    if not path.is_file():
        raise InputError(f"{path}: no such file; the run has no finished step, continue it with `mgs nbv --resume {folder}`")
    try:
        steps = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        policy = config["settings"]["policy"]
        steps[0]["seeds"]
    except (ValueError, KeyError, TypeError, IndexError):
        raise InputError(f"{folder}: config.json or steps.jsonl is damaged; resume the run to write them anew") from None
    metrics = folder / "metrics.json"
    return Run(folder, policy, steps, read_json(metrics) if metrics.is_file() else None, config["settings"])


def new_figure(width: float, height: float, dpi: int = DPI) -> Figure:
    """An empty figure, width and height in inches."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), dpi=dpi, layout="constrained")


def save_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure as PNG, atomically."""
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png")


def _style(policy: str) -> dict[str, Any]:
    colour, marker = POLICY_STYLE.get(policy, ("#7f7f7f", "."))
    return {"color": colour, "marker": marker, "label": policy}


def orbit_figure(
    path: str | Path,
    positions: np.ndarray,
    surface: np.ndarray | None,
    choices: Mapping[str, tuple[Sequence[int], Sequence[int]]],
) -> None:
    """The orbit from above: every pose, the seeds, the chosen views coloured and numbered in their order; a panel a policy.

    positions: [C,3] camera centres, metres. surface: [N,3] points of the rock or None. choices: policy -> (seeds, chosen), as
    indices into positions.
    """
    import matplotlib
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    with matplotlib.rc_context(STYLE):
        figure = new_figure(3.1 * len(choices) + 0.8, 3.9)
        axes = figure.subplots(1, len(choices), sharex=True, sharey=True, squeeze=False)[0]
        last = max((len(chosen) for _, chosen in choices.values()), default=1)
        norm = Normalize(1, max(last, 2))
        for axis, (policy, (seeds, chosen)) in zip(axes, choices.items(), strict=True):
            _orbit_panel(axis, positions, surface, list(seeds), list(chosen), norm)
            axis.set(title=f"{policy}: {len(seeds)} seeds, {len(chosen)} chosen", xlabel="$x$ (m)")
        axes[0].set_ylabel("$y$ (m)")
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
        bar = figure.colorbar(ScalarMappable(norm, "viridis"), ax=list(axes), shrink=0.8, pad=0.01)
        bar.set_label("step at which the view was chosen")
        save_figure(figure, path)


def _orbit_panel(
    axis: Axes, positions: np.ndarray, surface: np.ndarray | None, seeds: list[int], chosen: list[int], norm: Any
) -> None:
    """One policy from above."""
    xy = np.asarray(positions)[:, :2]
    centre = xy.mean(axis=0) if surface is None else np.asarray(surface)[:, :2].mean(axis=0)
    if surface is not None:
        rock = np.asarray(surface)[:: max(1, len(surface) // 6000)]
        axis.scatter(rock[:, 0], rock[:, 1], s=0.6, color="#b9b4ab", linewidths=0, zorder=1)
    axis.scatter(
        xy[:, 0], xy[:, 1], s=12, facecolors="white", edgecolors="#9a9a9a", linewidths=0.6, label="candidate", zorder=2
    )
    axis.scatter(xy[seeds, 0], xy[seeds, 1], s=46, marker="*", color="#D55E00", linewidths=0, label="seed", zorder=4)
    order = np.arange(1, len(chosen) + 1)
    axis.scatter(xy[chosen, 0], xy[chosen, 1], s=26, c=order, cmap="viridis", norm=norm, linewidths=0, label="chosen", zorder=3)
    for number, index in zip(order, chosen, strict=True):
        outward = xy[index] - centre
        outward = outward / max(float(np.linalg.norm(outward)), 1e-9)
        axis.annotate(
            str(number), xy[index], xytext=tuple(outward * 9), textcoords="offset points", fontsize=6, ha="center", va="center"
        )
    span = np.abs(xy - centre).max() * 1.2
    axis.set(xlim=(centre[0] - span, centre[0] + span), ylim=(centre[1] - span, centre[1] + span), aspect="equal")


def gain_figure(path: str | Path, gains: Mapping[str, Sequence[float]]) -> None:
    """Information gain (Eq. 7) of the selected view at each active step, a line a policy (the paper's Fig. 2)."""
    import matplotlib

    with matplotlib.rc_context(STYLE):
        figure = new_figure(4.8, 3.1)
        axis = figure.subplots()
        for policy, values in gains.items():
            axis.plot(np.arange(1, len(values) + 1), values, **_style(policy))
        axis.set(xlabel="active step", ylabel=r"$\mathrm{IG}_D$ of the selected view")
        axis.set_ylim(bottom=0)
        _whole_steps(axis)
        axis.legend()
        save_figure(figure, path)


def coverage_figure(path: str | Path, coverage: Mapping[str, tuple[Sequence[int], Sequence[float]]]) -> None:
    """Surface coverage after each image, and what each image added (the paper's Fig. 3).

    coverage: policy -> (images in the training set, share of Gaussians observed in [0,1]); the first entry is the seeds.
    """
    import matplotlib

    with matplotlib.rc_context(STYLE):
        figure = new_figure(7.2, 3.1)
        left, right = figure.subplots(1, 2)
        for policy, (images, shares) in coverage.items():
            percent = 100 * np.asarray(shares, float)
            left.plot(images, percent, **_style(policy))
            right.plot(list(images)[1:], np.diff(percent), **_style(policy))
        left.set(xlabel="images", ylabel=r"surface coverage $C$ (%)")
        right.set(xlabel="images", ylabel="coverage gained (percentage points)")
        right.axhline(0, color="#9a9a9a", linewidth=0.8, zorder=0)
        for axis in (left, right):
            _whole_steps(axis)
        left.legend()
        save_figure(figure, path)


def psnr_figure(path: str | Path, panels: Mapping[str, Mapping[str, tuple[Sequence[int], Sequence[float]]]]) -> None:
    """PSNR against the number of images, a line a policy. panels: what is measured -> policy -> (images, dB)."""
    import matplotlib

    with matplotlib.rc_context(STYLE):
        figure = new_figure(3.6 * len(panels), 3.1)
        axes = figure.subplots(1, len(panels), squeeze=False)[0]
        for axis, (what, curves) in zip(axes, panels.items(), strict=True):
            for policy, (images, decibels) in curves.items():
                axis.plot(images, decibels, **_style(policy))
            axis.set(xlabel="images in the training set", ylabel=f"PSNR, {what} (dB)")
            _whole_steps(axis)
        axes[0].legend()
        save_figure(figure, path)


def _whole_steps(axis: Axes) -> None:
    from matplotlib.ticker import MaxNLocator

    axis.xaxis.set_major_locator(MaxNLocator(integer=True))


def comparison_figure(
    path: str | Path,
    truth: np.ndarray,
    renders: Mapping[str, np.ndarray],
    *,
    title: str = "",
    captions: Mapping[str, str] | None = None,
) -> None:
    """Truth and renders of one view, each with its absolute difference below (the paper's Fig. 4), cropped to the rock.

    truth, renders: linear RGB [H,W,3]; captions: policy -> text under its name (PSNR, SSIM).
    """
    import matplotlib

    window = crop(truth.max(axis=2) > 0)
    shown = srgb_from_linear(truth)[window]
    images = {policy: srgb_from_linear(image)[window] for policy, image in renders.items()}
    differences = {policy: np.abs(image - shown).mean(axis=2) for policy, image in images.items()}
    limit = max(float(np.quantile(d, 0.995)) for d in differences.values()) or 1.0
    columns, aspect = 1 + len(images), shown.shape[0] / shown.shape[1]
    with matplotlib.rc_context(STYLE | {"axes.grid": False}):
        figure = new_figure(2.7 * columns, 2.7 * aspect * 2 + 0.9)
        axes = figure.subplots(2, columns)
        axes[0, 0].imshow(shown, interpolation="nearest")
        axes[0, 0].set_title(f"truth\n{title}")
        for column, (policy, image) in enumerate(images.items(), 1):
            axes[0, column].imshow(image, interpolation="nearest")
            axes[0, column].set_title(policy + (f"\n{captions[policy]}" if captions and policy in captions else ""))
            map_ = axes[1, column].imshow(differences[policy], cmap="magma", vmin=0, vmax=limit, interpolation="nearest")
        for axis in axes.flat:
            axis.set_axis_off()
        axes[1, 0].text(0.97, 0.5, "|render $-$ truth|", ha="right", va="center", transform=axes[1, 0].transAxes)
        bar = figure.colorbar(map_, ax=list(axes[1, 1:]), orientation="horizontal", shrink=0.6, pad=0.02, aspect=40)
        bar.set_label("mean absolute difference of the sRGB channels, in [0, 1]")
        save_figure(figure, path)


def crop(mask: np.ndarray, margin: float = 0.06) -> tuple[slice, slice]:
    """Rows and columns around a mask [H,W], with a margin as a share of the image; the whole image where the mask is empty."""
    rows, columns = np.nonzero(mask)
    if len(rows) == 0:
        return slice(None), slice(None)
    h, w = mask.shape
    dy, dx = round(margin * h), round(margin * w)
    return (
        slice(max(0, int(rows.min()) - dy), min(h, int(rows.max()) + dy + 1)),
        slice(max(0, int(columns.min()) - dx), min(w, int(columns.max()) + dx + 1)),
    )


COLUMNS = {
    "policy": "policy",
    "images": "images",
    "all.psnr": "PSNR, all (dB)",
    "all.ssim": "SSIM, all",
    "held_out.psnr": "PSNR, held out (dB)",
    "held_out.ssim": "SSIM, held out",
    "held_out.psnr_mask": "PSNR, held out, rock only (dB)",
    "held_out.ssim_mask": "SSIM, held out, rock only",
    "coverage": "coverage (%)",
}
"""Columns of the table: where the number lies in metrics.json, and its heading."""


def table_rows(folders: Sequence[str | Path]) -> list[list[str]]:
    """A row of text a run, in the order of COLUMNS. Raises InputError where a run was not evaluated."""
    rows = []
    for folder in folders:
        run = read_run(folder)
        if run.metrics is None:
            raise InputError(f"{folder}: has no metrics.json; measure it with `mgs eval {folder}`")
        values = {"policy": run.policy, "coverage": 100 * run.steps[-1]["coverage"], "images": run.metrics["images"]}
        values |= {f"{views}.{name}": run.metrics[views][name] for views in ("all", "held_out") for name in run.metrics[views]}
        rows.append([_cell(column, values.get(column)) for column in COLUMNS])
    return rows


def _cell(column: str, value: Any) -> str:
    if value is None:
        return "–"
    return f"{value:.4f}" if "ssim" in column else f"{value:.2f}" if isinstance(value, float) else str(value)


def markdown_table(rows: Sequence[Sequence[str]]) -> str:
    """The table as Markdown, numbers right-aligned."""
    heading = "| " + " | ".join(COLUMNS.values()) + " |\n|" + " --- |" + " ---: |" * (len(COLUMNS) - 1) + "\n"
    return heading + "".join("| " + " | ".join(row) + " |\n" for row in rows)


def print_table(console: Console, rows: Sequence[Sequence[str]]) -> None:
    """Print the table to a terminal of 80 columns."""
    from rich import box
    from rich.table import Table

    short = [
        "policy",
        "images",
        *(f"{name}\n{views}" for views in ("all", "new", "rock") for name in ("PSNR", "SSIM")),
        "cover",
    ]
    table = Table(
        box=box.SIMPLE_HEAD,
        pad_edge=False,
        caption="dB and %; new: views never trained on; rock: those, inside its mask",
    )
    for i, heading in enumerate(short):
        table.add_column(heading, justify="right" if i else "left", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    console.print(table)


def write_report(out: str | Path, folders: Sequence[str | Path]) -> list[Path]:
    """Every figure and the table of runs on one dataset, into the folder `out`; returns the files written.

    orbit.png, gain.png, coverage.png, comparison.png (a view that the fewest runs were trained on), psnr.png (where runs were
    evaluated on the way), table.md. Raises InputError where a run was not evaluated with pictures.
    """
    from mgs.dataset import load_dataset
    from mgs.evaluate import read_comparison
    from mgs.gaussians import read_ply

    out, runs = Path(out), {run.policy: run for run in map(read_run, folders)}
    first = next(iter(runs.values()))
    frames = load_dataset(first.settings["dataset"]).frames
    rows = table_rows(folders)

    positions = np.array([frame.camera.position for frame in frames])
    choices = {policy: (run.seeds, run.chosen) for policy, run in runs.items()}
    orbit_figure(out / "orbit.png", positions, read_ply(first.folder / "gaussians.ply").means, choices)
    gain_figure(out / "gain.png", {policy: [s["information_gain"] for s in run.steps[1:]] for policy, run in runs.items()})
    curves = {policy: ([s["images"] for s in run.steps], [s["coverage"] for s in run.steps]) for policy, run in runs.items()}
    coverage_figure(out / "coverage.png", curves)

    frame = frames[unseen_view(list(runs.values()), len(frames))]
    pairs = {
        policy: read_comparison(run.folder / "renders" / f"{frame.name}.png", frame.camera) for policy, run in runs.items()
    }
    truth = next(iter(pairs.values()))[0]
    captions = {policy: _caption(run, frame.name) for policy, run in runs.items()}
    renders = {policy: rendered for policy, (_, rendered) in pairs.items()}
    comparison_figure(out / "comparison.png", truth, renders, title=frame.name, captions=captions)
    written = [out / f"{name}.png" for name in ("orbit", "gain", "coverage", "comparison")]

    measured = {policy: [s for s in run.steps if "psnr" in s] for policy, run in runs.items()}
    if all(measured.values()):
        panels = {
            what: {policy: ([s["images"] for s in steps], [s[key] for s in steps]) for policy, steps in measured.items()}
            for what, key in (("all views", "psnr"), ("all views, rock only", "psnr_mask"))
        }
        psnr_figure(out / "psnr.png", panels)
        written.append(out / "psnr.png")
    with atomic_path(out / "table.md") as temporary:
        temporary.write_text(markdown_table(rows), encoding="utf-8")
    return [*written, out / "table.md"]


def unseen_view(runs: Sequence[Run], frames: int) -> int:
    """A frame that the fewest runs were trained on; of those, the one in the middle."""
    counts = [sum(index in run.seeds + run.chosen for run in runs) for index in range(frames)]
    fewest = [index for index in range(frames) if counts[index] == min(counts)]
    return fewest[len(fewest) // 2]


def _caption(run: Run, name: str) -> str:
    """PSNR and SSIM of one view, and how many images the model had."""
    view = next(view for view in (run.metrics or {})["views"] if view["name"] == name)
    seen = ", trained on" if view["trained"] else ""
    return f"{len(run.seeds) + len(run.chosen)} images{seen}; {view['psnr']:.2f} dB, SSIM {view['ssim']:.4f}"
