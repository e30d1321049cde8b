"""Interactive plots of the report page, as Plotly takes them: dictionaries of plain data.

Every plot has `title`, `alt` (for readers who do not see it), `data` (traces), `layout` and
`numbers` (its table). The page's script adds colours of light and dark, and the size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mgs.camera import Camera
from mgs.colour import srgb_from_linear
from mgs.data.up import PLUS_Z, Up, upright
from mgs.gaussians import Gaussians
from mgs.report.figures import Curves, axis_names, line_styles

SYMBOLS: dict[str | tuple[int, int, int], str] = {
    "o": "circle", "s": "square", "^": "triangle-up", "D": "diamond", "v": "triangle-down",
    "P": "cross", "X": "x", "p": "pentagon", "*": "star", "<": "triangle-left",
    ">": "triangle-right", "h": "hexagon", "d": "diamond-tall", (4, 1, 0): "star-diamond",
    (6, 1, 0): "hexagram", "8": "octagon", "H": "hexagon2",
}  # fmt: skip
"""Matplotlib's markers in `mgs.report.figures.POLICY_STYLE` -> Plotly's."""

POINTS = 4000
"""Most Gaussians in the plot of the orbit: every n-th of the model."""

FRUSTUM = 0.12
"""Length of a drawn camera, as a share of the mean distance of the cameras from the model."""

GREY = "#7a7a7a"

METRIC_NAMES = {
    "psnr": "PSNR (dB)",
    "ssim": "SSIM",
    "psnr_mask": "PSNR, rock only (dB)",
    "ssim_mask": "SSIM, rock only",
    "psnr_inside": "PSNR, without the outline (dB)",
    "psnr_corrected": "PSNR, exposure fitted to each view (dB)",
    "psnr_mask_corrected": "PSNR, rock only, exposure fitted to each view (dB)",
    "held_out_psnr": "PSNR, held out (dB)",
    "held_out_psnr_mask": "PSNR, held out, rock only (dB)",
    "test_psnr": "PSNR, test views (dB)",
    "test_psnr_mask": "PSNR, test views, rock only (dB)",
    "depth_error": "depth error ({unit})",
}
"""Headings of metrics whose key says too little; any other metric is called by its key."""


def metric_name(key: str, unit: str = "m") -> str:
    """Heading of a metric, by its key in metrics.json or steps.jsonl. unit: name of a length of
    1."""
    return METRIC_NAMES.get(key, key.replace("_", " ")).replace("{unit}", unit)


def _plot(
    title: str,
    alt: str,
    data: list[dict[str, Any]],
    layout: dict[str, Any],
    heading: Sequence[str],
    rows: list[list[str]],
) -> dict[str, Any]:
    numbers = {"heading": list(heading), "rows": rows}
    return {"title": title, "alt": alt, "data": data, "layout": layout, "numbers": numbers}


def _axis(title: str, **settings: Any) -> dict[str, Any]:
    return {"title": {"text": title}, **settings}


def line_plot(
    title: str, curves: Curves, x: str, y: str, from_zero: bool = False
) -> dict[str, Any]:
    """A plot with one line for each run, in the styles of the PNG figures. x, y: axis titles."""
    traces = []
    for (label, (xs, ys)), style in zip(curves.items(), line_styles(curves), strict=True):
        colour = style["color"]
        dash = "dash" if style["linestyle"] == "--" else "solid"
        trace: dict[str, Any] = {"name": label, "x": list(xs), "y": list(ys)}
        trace["mode"] = "lines+markers"
        trace["marker"] = {"symbol": SYMBOLS[style["marker"]], "color": colour, "size": 7}
        trace["line"] = {"color": colour, "dash": dash, "width": 2}
        traces.append(trace)
    layout = {"xaxis": _axis(x), "yaxis": _axis(y)}
    if from_zero:
        layout["yaxis"]["rangemode"] = "tozero"
    ends = [
        f"{label}: {ys[0]:.4g} at {xs[0]:g}, {ys[-1]:.4g} at {xs[-1]:g}"
        for label, (xs, ys) in curves.items()
        if len(ys) > 0
    ]
    columns = [dict(zip(*curve, strict=True)) for curve in curves.values()]
    rows = [
        [f"{value:g}", *(f"{c[value]:.6g}" if value in c else "–" for c in columns)]
        for value in sorted({value for xs, _ in curves.values() for value in xs})
    ]
    return _plot(
        title, f"{title}, against {x}. {'; '.join(ends)}.", traces, layout, [x, *curves], rows
    )


def timing_plot(label: str, steps: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Seconds of each stage of each step of a run, stacked. steps: lines of steps.jsonl."""
    seconds = [step.get("seconds", {}) for step in steps]
    numbers = [step["step"] for step in steps]
    stages = {
        stage: [of_step.get(stage, 0.0) for of_step in seconds]
        for stage in dict.fromkeys(stage for of_step in seconds for stage in of_step)
    }
    traces = [
        {"type": "bar", "name": stage, "x": numbers, "y": values}
        for stage, values in stages.items()
    ]
    axes = {"xaxis": _axis("step (0: the seeds)"), "yaxis": _axis("seconds")}
    total = {stage: sum(values) for stage, values in stages.items()}
    in_all = ", ".join(f"{stage} {value:.1f} s" for stage, value in total.items())
    rows = [
        [str(number), *(f"{values[i]:.2f}" for values in stages.values())]
        for i, number in enumerate(numbers)
    ]
    rows.append(["all", *(f"{value:.2f}" for value in total.values())])
    alt = f"Seconds of each stage, step by step, of {label}. In all: {in_all}."
    layout = {"barmode": "stack", **axes}
    return _plot(f"Time, {label}", alt, traces, layout, ["step", *stages], rows)


def views_plot(metric: str, runs: Mapping[str, Sequence[Mapping[str, Any]]]) -> dict[str, Any]:
    """A metric of every view, for each run: filled markers for views trained on, open ones for
    others.

    runs: label -> views of metrics.json; views without this metric are left out.
    """
    traces, rows = [], []
    for (label, views), style in zip(runs.items(), line_styles(runs), strict=True):
        measured = [view for view in views if view.get(metric) is not None]
        for trained, which in ((True, "trained on"), (False, "held out")):
            shown = [view for view in measured if view["trained"] == trained]
            symbol = SYMBOLS[style["marker"]] + ("" if trained else "-open")
            marker = {"symbol": symbol, "color": style["color"], "size": 8}
            xs, ys = [view["name"] for view in shown], [view[metric] for view in shown]
            trace = {"name": f"{label}, {which}", "x": xs, "y": ys}
            traces.append(trace | {"mode": "markers", "marker": marker})
            rows += [[label, view["name"], which, f"{view[metric]:.4f}"] for view in shown]
    name = metric_name(metric)
    names = sorted({view["name"] for views in runs.values() for view in views})
    axis = _axis("view", categoryorder="array", categoryarray=names, type="category")
    title = f"{name} of each view"
    alt, layout = (
        f"{title}; the numbers are in the table below.",
        {"xaxis": axis, "yaxis": _axis(name)},
    )
    return _plot(title, alt, traces, layout, ["run", "view", "", name], rows)


def orbit_plot(
    label: str,
    cameras: Sequence[Camera],
    names: Sequence[str],
    seeds: list[int],
    chosen: list[int],
    model: Gaussians | None,
    up: Up = PLUS_Z,
    unit: str = "m",
) -> dict[str, Any]:
    """The orbit in 3D: the model as points, all poses, seeds, and the chosen views, numbered and
    joined in their order.

    names: of the frames; seeds, chosen: their indices. up, unit: of the world; it is drawn turned
    so that +Z is up. The last trace, "shown above", marks the view of the page's slider; the page
    moves it.
    """
    turn, order, taken = upright(up), list(range(1, len(chosen) + 1)), seeds + chosen
    eyes = np.array([camera.position for camera in cameras])
    middle = np.mean(eyes if model is None else model.means, axis=0)
    length = FRUSTUM * float(np.linalg.norm(eyes - middle, axis=1).mean())
    eyes = eyes @ turn.T

    def markers(name: str, which: list[int], texts: list[str], **marker: Any) -> dict[str, Any]:
        trace = _points(name, eyes[which], marker)
        return trace | {"hovertext": texts, "hoverinfo": "text+x+y+z"}

    traces = [] if model is None else [_model_points(model, turn)]
    left = [i for i in range(len(eyes)) if i not in taken]
    open_circle = {"size": 3, "color": "#9a9a9a", "symbol": "circle-open"}
    diamond = {"size": 6, "color": "#D55E00", "symbol": "diamond"}
    bar = {"title": {"text": "step"}, "thickness": 12, "len": 0.6}
    scale = {"colorscale": "Viridis", "showscale": bool(chosen), "colorbar": bar}
    steps = [f"{names[i]}, step {k}" for k, i in zip(order, chosen, strict=True)]
    path = markers("chosen, in their order", chosen, steps, size=6, color=order, **scale)
    path |= {"mode": "lines+markers+text", "text": [str(k) for k in order]}
    path |= {"line": {"color": GREY, "width": 2}, "textfont": {"size": 11}}
    here = {"size": 12, "color": "#dd1111", "symbol": "circle-open"}
    traces += [
        markers("candidates", left, [names[i] for i in left], **open_circle),
        _frusta([cameras[i] for i in taken], length, turn),
        markers("seeds", seeds, [names[i] for i in seeds], **diamond),
        path,
        _points("shown above", eyes[taken[:1]], here) | {"hoverinfo": "skip"},
    ]
    titles = axis_names(up, unit)
    axes = {f"{a}axis": _axis(title) for a, title in zip("xyz", titles, strict=True)}
    view = {"eye": {"x": 0.9, "y": 0.9, "z": 0.7}}
    alt = (
        f"Camera positions of {label} in 3D around the model. "
        f"Seeds: {', '.join(names[i] for i in seeds)}. "
        f"Chosen, in this order: {', '.join(names[i] for i in chosen) or 'none yet'}."
    )
    roles = ["seed"] * len(seeds) + [f"step {k}" for k in order]
    rows = [
        [role, names[i], *(f"{value:.3f}" for value in eyes[i])]
        for role, i in zip(roles, taken, strict=True)
    ]
    layout = {"scene": {"aspectmode": "data", "camera": view, **axes}}
    return _plot(f"Orbit, {label}", alt, traces, layout, ["taken as", "view", *titles], rows)


def _model_points(model: Gaussians, turn: np.ndarray) -> dict[str, Any]:
    """Trace of up to POINTS Gaussians of a model in their colours. turn: [3,3]."""
    some = model[:: max(1, -(-len(model) // POINTS))]
    colours = np.round(srgb_from_linear(some.rgb) * 255).astype(int).tolist()
    marker = {"size": 2, "color": [f"#{r:02x}{g:02x}{b:02x}" for r, g, b in colours]}
    trace = _points("model", np.round(some.means.astype(float) @ turn.T, 4), marker)
    return trace | {"hoverinfo": "skip"}


def _points(name: str, points: np.ndarray, marker: dict[str, Any]) -> dict[str, Any]:
    """Trace of points [M,3] in 3D."""
    x, y, z = np.reshape(points, (-1, 3)).T.tolist()
    trace = {"type": "scatter3d", "name": name, "x": x, "y": y, "z": z}
    return trace | {"mode": "markers", "marker": marker}


def corners_at(camera: Camera, depth: float) -> np.ndarray:
    """Corners of a camera's image at a z-depth, [4,3] world, in order around the image."""
    width, height = camera.width, camera.height
    pixels = np.array([[0, 0, 1], [width, 0, 1], [width, height, 1], [0, height, 1]], float)
    pose = camera.camera_to_world
    return depth * pixels @ np.linalg.inv(camera.K).T @ pose[:3, :3].T + pose[:3, 3]


def _frusta(cameras: Sequence[Camera], length: float, turn: np.ndarray) -> dict[str, Any]:
    """Trace of cameras as wire pyramids of this length. turn: [3,3], rotation of the world."""
    lines: list[list[float | None]] = [[], [], []]
    for camera in cameras:
        corners, eye = corners_at(camera, length) @ turn.T, turn @ camera.position
        edges = [(eye, corner) for corner in corners]
        edges += zip(corners, np.roll(corners, -1, axis=0), strict=True)
        for a, b in edges:
            for axis, values in enumerate(lines):
                values += [round(float(a[axis]), 4), round(float(b[axis]), 4), None]
    x, y, z = lines
    trace = {"type": "scatter3d", "name": "cameras", "mode": "lines", "x": x, "y": y, "z": z}
    return trace | {"line": {"color": GREY, "width": 1.5}, "hoverinfo": "skip"}
