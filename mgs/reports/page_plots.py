"""Plots of the report page as Plotly takes them: `title`, `alt`, `data`, `layout`, and as a table
`numbers`. The script of the page adds the size and the colours of light and dark. Also its words
and numbers, read from the files of runs: notes, tables, links."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from mgs.camera import Camera
from mgs.colour import srgb_from_linear
from mgs.gaussians import Gaussians
from mgs.policy.certificate import Certificate
from mgs.policy.criteria import GAIN_UNIT
from mgs.reports.figures import Curves, line_styles
from mgs.reports.tables import table_cell, table_columns, table_heading, table_row
from mgs.run.ending import RunEnd, why_ended
from mgs.run.folder import Run

SYMBOLS: dict[str | tuple[int, int, int], str] = {
    "o": "circle", "s": "square", "^": "triangle-up", "D": "diamond", "v": "triangle-down",
    "P": "cross", "X": "x", "p": "pentagon", "*": "star", "<": "triangle-left",
    ">": "triangle-right", "h": "hexagon", "d": "diamond-tall", (4, 1, 0): "star-diamond",
    (6, 1, 0): "hexagram", "8": "octagon", "H": "hexagon2",
}  # fmt: skip
"""Matplotlib's markers in `mgs.reports.figures.POLICY_STYLE` -> Plotly's."""

POINTS = 4000  # most Gaussians in the plot of the orbit: every n-th of the model
FRUSTUM = 0.12  # length of a drawn camera over the mean distance of cameras from the model

GREY = "#7a7a7a"

METRIC_NAMES = {
    "psnr": "PSNR (dB)",
    "psnr_mask": "masked PSNR (dB)",
    "psnr_corrected": "PSNR, exposure fitted (dB)",
    "psnr_mask_corrected": "masked PSNR, exposure fitted (dB)",
}
METRIC_NAMES |= {
    f"{key}_{metric}": name.replace("PSNR", f"PSNR, {views}")
    for key, views in (("held_out", "held-out views"), ("test", "test views"))
    for metric, name in METRIC_NAMES.items()
}
"""Metrics of steps.jsonl -> headings."""


def _plot(
    title: str, alt: str, data: list[dict[str, Any]], layout: dict[str, Any]
) -> dict[str, Any]:
    """A plot with axes x and y. Its table has a row for each x, and a column for each trace."""
    columns = [dict(zip(trace["x"], trace["y"], strict=True)) for trace in data]
    xs = sorted(set().union(*columns))
    rows = [[_number(x), *(_number(column.get(x, "–")) for column in columns)] for x in xs]
    heading = [layout["xaxis"]["title"]["text"], *(trace["name"] for trace in data)]
    numbers = {"heading": heading, "rows": rows}
    return {"title": title, "alt": alt, "data": data, "layout": layout, "numbers": numbers}


def _number(value: Any) -> str:
    return value if isinstance(value, str) else f"{value:.6g}"


def _axis(title: str, **settings: Any) -> dict[str, Any]:
    return {"title": {"text": title}, **settings}


def line_plot(title: str, curves: Curves, y: str, from_zero: bool = False) -> dict[str, Any]:
    """A plot over the number of images, a line for each run, in the styles of the PNG figures. y:
    title of the axis."""
    traces = []
    for (label, (xs, ys)), style in zip(curves.items(), line_styles(curves), strict=True):
        colour = style["color"]
        dash = {"-": "solid", "--": "dash", ":": "dot"}[style["linestyle"]]
        trace: dict[str, Any] = {"name": label, "x": list(xs), "y": list(ys)}
        trace["mode"] = "lines+markers"
        trace["marker"] = {"symbol": SYMBOLS[style["marker"]], "color": colour, "size": 7}
        trace["line"] = {"color": colour, "dash": dash, "width": 2}
        traces.append(trace)
    layout = {"xaxis": _axis("images"), "yaxis": _axis(y)}
    if from_zero:
        layout["yaxis"]["rangemode"] = "tozero"
    ends = [
        f"{label}: {ys[0]:.4g} at {xs[0]:g}, {ys[-1]:.4g} at {xs[-1]:g}"
        for label, (xs, ys) in curves.items()
        if len(ys) > 0
    ]
    return _plot(title, f"{title}, against images. {'; '.join(ends)}.", traces, layout)


def timing_plot(label: str, steps: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Seconds of each stage of each step of a run, stacked. steps: lines of steps.jsonl."""
    seconds = [step.get("seconds", {}) for step in steps]
    numbers = [step["step"] for step in steps]
    stages = {
        stage: [of_step.get(stage, 0.0) for of_step in seconds]
        for stage in dict.fromkeys(stage for of_step in seconds for stage in of_step)
    }
    bar = {"type": "bar", "x": numbers}
    traces = [bar | {"name": stage, "y": values} for stage, values in stages.items()]
    in_all = ", ".join(f"{stage} {sum(values):.1f} s" for stage, values in stages.items())
    alt = f"Seconds of each stage, step by step, of {label}. In all: {in_all}."
    axes = {"xaxis": _axis("step (0: the seeds)"), "yaxis": _axis("seconds")}
    return _plot(f"Time, {label}", alt, traces, {"barmode": "stack", **axes})


def views_plot(metric: str, runs: Mapping[str, Sequence[Mapping[str, Any]]]) -> dict[str, Any]:
    """A metric of every view, for each run: filled markers for views trained on, open ones for
    others.

    runs: label -> views of metrics.json; views without this metric are left out."""
    traces = []
    for (label, views), style in zip(runs.items(), line_styles(runs), strict=True):
        numbers = [view for view in views if view.get(metric) is not None]
        for trained, which in ((True, "training view"), (False, "held-out view")):
            part = [view for view in numbers if view["trained"] == trained]
            symbol = SYMBOLS[style["marker"]] + ("" if trained else "-open")
            marker = {"symbol": symbol, "color": style["color"], "size": 8}
            xs, ys = [view["name"] for view in part], [view[metric] for view in part]
            trace = {"name": f"{label}, {which}", "x": xs, "y": ys}
            traces.append(trace | {"mode": "markers", "marker": marker})
    name = METRIC_NAMES[metric]
    names = sorted({view["name"] for views in runs.values() for view in views})
    axis = _axis("view", categoryorder="array", categoryarray=names, type="category")
    title = f"{name} of each view"
    alt = f"{title}; the numbers are in the table below."
    return _plot(title, alt, traces, {"xaxis": axis, "yaxis": _axis(name)})


CURVES = {
    "bound": ("bound: no set has more", "#888888"),
    "plan": ("planned views", "#d1495b"),
    "even": ("evenly spaced", "#0072B2"),
    "random": ("random", "#E69F00"),
}
"""Keys of `mgs.policy.certificate.curve` -> names and colours."""


def curve_plot(label: str, certificate: Mapping[str, Any]) -> dict[str, Any]:
    """Share of the gain of all candidates against the number of views, after the seeds. The
    marker of the number that is planned is large."""
    numbers = [row["views"] for row in certificate["curve"]]
    sizes = [13 if k == certificate["views"] else 6 for k in numbers]
    traces = [
        {
            "name": name,
            "x": numbers,
            "y": [100 * row[key] for row in certificate["curve"]],
            "mode": "lines+markers",
            "line": {"color": colour, "dash": "dash" if key == "bound" else "solid"},
            "marker": {"color": colour, "size": sizes if key == "plan" else 6},
        }
        for key, (name, colour) in CURVES.items()
    ]
    title = f"Gain that a number of views can have, {label}"
    alt = f"{title}: the upper bound of all sets, the plan, evenly spaced and random views."
    axes = {"xaxis": _axis("views after the seeds"), "yaxis": _axis("gain of all candidates (%)")}
    return _plot(title, alt, traces, axes)


def orbit_plot(label: str, run: Run) -> dict[str, Any]:
    """The cameras in 3D: the model as points, all poses, seeds, and the chosen views, numbered and
    joined in their order. Other candidates have the colours of their prices, if the run has them.
    The last trace, "shown above", marks the view of the page's slider; the page moves it."""
    taken, frames = run.indices, run.dataset.frames
    seeds, views = taken[: run.settings.seeds], taken[run.settings.seeds :]
    order = list(range(1, len(views) + 1))
    names, cameras = zip(*((frame.name, frame.camera) for frame in frames), strict=True)
    eyes = np.array([camera.position for camera in cameras])
    middle = np.mean(run.gaussians.means, axis=0)
    length = FRUSTUM * float(np.linalg.norm(eyes - middle, axis=1).mean())

    def markers(name: str, which: list[int], texts: list[str], **marker: Any) -> dict[str, Any]:
        trace = _points(name, eyes[which], marker)
        return trace | {"hovertext": texts, "hoverinfo": "text+x+y+z"}

    candidates = [i for i in range(len(eyes)) if i not in taken]
    prices = run.steps[0].get("certificate", {}).get("prices", {})
    circle: dict[str, Any] = {"size": 3, "color": "#9a9a9a", "symbol": "circle-open"}
    others, start = ("candidates", "seeds") if run.settings.budget else ("not fitted", "images")
    bar: dict[str, Any] = {"thickness": 12, "len": 0.6}
    if candidates and all(names[i] in prices for i in candidates):
        price = {"title": {"text": "price of a picture"}, **bar, "x": -0.1}
        colours = {"color": [prices[names[i]] for i in candidates], "colorscale": "Cividis"}
        circle = {"size": 5, **colours, "showscale": True, "colorbar": price}
        others = "candidates, by price"
    diamond = {"size": 6, "color": "#D55E00", "symbol": "diamond"}
    step = {"title": {"text": "step"}, **bar}
    scale = {"colorscale": "Viridis", "showscale": bool(views), "colorbar": step}
    steps = [f"{names[i]}, step {k}" for k, i in zip(order, views, strict=True)]
    path = markers("chosen, in their order", views, steps, size=6, color=order, **scale)
    path |= {"mode": "lines+markers+text", "text": [str(k) for k in order]}
    path |= {"line": {"color": GREY, "width": 2}, "textfont": {"size": 11}}
    here = {"size": 12, "color": "#dd1111", "symbol": "circle-open"}
    traces = [
        _model_points(run.gaussians),
        markers(others, candidates, [names[i] for i in candidates], **circle),
        _frusta([cameras[i] for i in taken], length),
        markers(start, seeds, [names[i] for i in seeds], **diamond),
        path,
        _points("shown above", eyes[taken[:1]], here) | {"hoverinfo": "skip"},
    ]
    unit = "" if run.dataset.unit == "unit" else f" ({run.dataset.unit})"
    axes = {f"{a}axis": _axis(a + unit) for a in "xyz"}
    view = {"eye": {"x": 0.9, "y": 0.9, "z": 0.7}}
    first, later = (", ".join(names[i] for i in some) for some in (seeds, views))
    alt = f"Camera positions of {label} in 3D around the model. {start.capitalize()}: {first}."
    if run.settings.budget:
        alt += f" Chosen, in this order: {later or 'none yet'}."
    layout = {"scene": {"aspectmode": "data", "camera": view, **axes}}
    return {"title": f"Cameras, {label}", "alt": alt, "data": traces, "layout": layout}


def _model_points(model: Gaussians) -> dict[str, Any]:
    some = model[:: max(1, -(-len(model) // POINTS))]
    colours = np.round(srgb_from_linear(some.linear_rgb(some.rgb)) * 255).astype(int).tolist()
    marker = {"size": 2, "color": [f"#{r:02x}{g:02x}{b:02x}" for r, g, b in colours]}
    trace = _points("model", np.round(some.means.astype(float), 4), marker)
    return trace | {"hoverinfo": "skip"}


def _points(name: str, points: np.ndarray, marker: dict[str, Any]) -> dict[str, Any]:
    x, y, z = np.reshape(points, (-1, 3)).T.tolist()
    trace = {"type": "scatter3d", "name": name, "x": x, "y": y, "z": z}
    return trace | {"mode": "markers", "marker": marker}


def corners_at(camera: Camera, depth: float) -> np.ndarray:
    """Corners of a camera's image at a z-depth, [4,3] world, in order around the image."""
    width, height = camera.width, camera.height
    pixels = np.array([[0, 0, 1], [width, 0, 1], [width, height, 1], [0, height, 1]], float)
    pose = camera.camera_to_world
    return depth * pixels @ np.linalg.inv(camera.K).T @ pose[:3, :3].T + pose[:3, 3]


def _frusta(cameras: Sequence[Camera], length: float) -> dict[str, Any]:
    lines: list[list[float | None]] = [[], [], []]
    for camera in cameras:
        corners, eye = corners_at(camera, length), camera.position
        edges = [(eye, corner) for corner in corners]
        edges += zip(corners, np.roll(corners, -1, axis=0), strict=True)
        for a, b in edges:
            for axis, values in enumerate(lines):
                values += [round(float(a[axis]), 4), round(float(b[axis]), 4), None]
    x, y, z = lines
    trace = {"type": "scatter3d", "name": "cameras", "mode": "lines", "x": x, "y": y, "z": z}
    return trace | {"line": {"color": GREY, "width": 1.5}, "hoverinfo": "skip"}


def notes(run: Run) -> list[str]:
    """Sentences about what is unfinished or missing, the end of the run, and its warnings."""
    taken, lines = len(run.indices), []
    if run.ended is None:
        resume = f"`mgs nbv --resume {run.folder}` goes on"
        lines.append(f"Unfinished: {taken} of {run.planned} views are taken; {resume}.")
    elif run.ended["reason"] != RunEnd.BUDGET:  # a spent budget is no news
        lines.append(f"The run has ended: {why_ended(run.ended)}.")
    if run.metrics is None:
        lines.append(f"Not measured: `mgs eval {run.folder}` adds its PSNR and SSIM.")
    elif run.measured is None:
        of = f"metrics.json is of {run.metrics['images']} images, the model of {taken}"
        again = f"`mgs eval {run.folder}` measures again"
        lines.append(f"{of}: its numbers are left out; {again}.")
    if run.settings.estimator != "exact":
        gain = f"Its information gain is by the estimator {run.settings.estimator}"
        lines.append(f"{gain}: compare it with that of the same estimator only.")
    if certificate := run.steps[0].get("certificate"):
        lines.append(Certificate(**certificate).sentence())
    for step in run.steps:
        prefix = f"step {step['step']}: " if run.settings.budget else ""
        lines += [prefix + warning for warning in step.get("warnings", [])]
    return lines


def summary_rows(runs: Mapping[str, Run]) -> list[tuple[str, list[str]]]:
    """Rows of the table of results, (heading, a cell for each run): the report's table, without
    what no run has, then the size of the model and the time."""
    rows = [table_row(label, run) for label, run in runs.items()]
    seconds = [sum(sum(s.get("seconds", {}).values()) for s in run.steps) for run in runs.values()]
    keys = table_columns(rows)[1:]
    table = [
        (table_heading(key, rows), [table_cell(key, row.get(key)) for row in rows]) for key in keys
    ]
    table.append(("Gaussians", [f"{len(run.gaussians):,}" for run in runs.values()]))
    return [*table, ("time (s)", [f"{value:.1f}" for value in seconds])]


def measured(step: Mapping[str, Any]) -> dict[str, float]:
    """Metrics of images in a line of steps.jsonl."""
    return {key: step[key] for key in METRIC_NAMES if step.get(key) is not None}


def step_facts(step: Mapping[str, Any]) -> list[tuple[str, str]]:
    """(name, value) of a line of steps.jsonl: images, information gain, coverage, and metrics."""
    facts = [("images", str(step["images"]))]
    if step.get("information_gain") is not None:
        facts.append(("information gain", f"{step['information_gain']:.4g} {GAIN_UNIT}"))
    facts.append(("Gaussians observed", f"{100 * step['coverage']:.2f} %"))
    return facts + [(METRIC_NAMES[key], table_cell(key, v)) for key, v in measured(step).items()]


def measured_views(run: Run) -> list[dict[str, Any]]:
    """Views in metrics.json: those of the dataset, then its test views, as `test/NAME`."""
    metrics = run.measured or {}
    tests = [view | {"name": f"test/{view['name']}"} for view in metrics.get("test_views", [])]
    return [*metrics.get("views", []), *tests]


def psnr_of(run: Run, view: str) -> str:
    """PSNR of a view as part of a caption; empty if it was not measured."""
    psnr = {one["name"]: one["psnr"] for one in measured_views(run)}.get(view)
    return "" if psnr is None else f", {psnr:.2f} dB"


def setting_rows(runs: Mapping[str, Run]) -> list[tuple[str, list[str], bool]]:
    """Rows of the table of settings and versions: (key, a value for each run, whether they
    differ)."""
    columns = []
    for run in runs.values():
        versions = run.config.get("versions", {}).items()
        numbers = {f"version of {name}": version for name, version in versions}
        columns.append(_texts(run.config["settings"]) | numbers)
    rows = []
    for key in dict.fromkeys(key for column in columns for key in column):
        values = [column.get(key, "–") for column in columns]
        rows.append((key, values, len(set(values)) > 1))
    return rows


def _texts(values: Mapping[str, Any], path: str = "") -> dict[str, str]:
    """Nested settings as text, by their keys joined by dots."""
    texts: dict[str, str] = {}
    for key, value in values.items():
        name = f"{path}{key}"
        texts |= _texts(value, f"{name}.") if isinstance(value, dict) else {name: str(value)}
    return texts


def links(run: Run, page: Path) -> list[tuple[str, str]]:
    """(address relative to the page, name) of the existing files of a run that a reader may
    open."""
    names = ["gaussians.ply", "metrics.json", "steps.jsonl", "config.json"]
    maps = sorted(run.folder.glob("diagnostics/*.exr"))
    names += ["diagnostics/information.ply", *(f"diagnostics/{file.name}" for file in maps)]
    files = [(run.folder / name, name) for name in names]
    prior = run.settings.prior
    files += [(prior / name, f"prior: {name}") for name in ("mesh.ply", "points.ply")]
    start = page.resolve().parent
    there = [(os.path.relpath(f.resolve(), start), name) for f, name in files if f.is_file()]
    return [(quote(Path(path).as_posix()), name) for path, name in there]
