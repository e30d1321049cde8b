"""The interactive plots of the report page, as Plotly takes them: dictionaries of traces and axes,
made of plain data.

The page's script adds what depends on the reader: colours of light and dark, and the size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mgs.camera import Camera
from mgs.colour import srgb_from_linear
from mgs.data.up import PLUS_Z, Up, upright
from mgs.gaussians import Gaussians
from mgs.report.figures import axis_names, line_styles

SYMBOLS: dict[str | tuple[int, int, int], str] = {
    "o": "circle", "s": "square", "^": "triangle-up", "D": "diamond", "v": "triangle-down", "P": "cross", "X": "x",
    "p": "pentagon", "*": "star", "<": "triangle-left", ">": "triangle-right", "h": "hexagon", "d": "diamond-tall",
    (4, 1, 0): "star-diamond", (6, 1, 0): "hexagram", "8": "octagon", "H": "hexagon2",
}  # fmt: skip
"""Matplotlib's markers, as `mgs.report.figures.POLICY_STYLE` has them -> Plotly's."""

POINTS = 4000
"""Most Gaussians that the plot of the orbit shows: every so-manieth of the model."""

FRUSTUM = 0.12
"""Length of a drawn camera, as a share of the mean distance of the cameras from the model."""

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
"""Headings of metrics whose key says too little. Any other number is called by its key."""


def metric_name(key: str, unit: str = "m") -> str:
    """The heading of a metric, by its key in metrics.json or steps.jsonl. unit: what a length of 1
    is called."""
    return METRIC_NAMES.get(key, key.replace("_", " ")).replace("{unit}", unit)


Curves = Mapping[str, tuple[Sequence[float], Sequence[float]]]
"""Label of a run -> x and y of its line."""


def line_plot(
    title: str, curves: Curves, x: str, y: str, from_zero: bool = False
) -> dict[str, Any]:
    """A plot with one line for each run, in the styles of the PNG figures. x, y: what the axes are
    called."""
    traces = []
    for (label, (xs, ys)), style in zip(curves.items(), line_styles(curves), strict=True):
        dash = "dash" if style["linestyle"] == "--" else "solid"
        marker = {"symbol": SYMBOLS[style["marker"]], "color": style["color"], "size": 7}
        line = {"color": style["color"], "dash": dash, "width": 2}
        traces.append(
            {
                "name": label,
                "x": list(xs),
                "y": list(ys),
                "mode": "lines+markers",
                "marker": marker,
                "line": line,
            }
        )
    layout: dict[str, Any] = {"xaxis": {"title": {"text": x}}, "yaxis": {"title": {"text": y}}}
    if from_zero:
        layout["yaxis"]["rangemode"] = "tozero"
    return {
        "title": title,
        "alt": _in_words(title, curves, x),
        "data": traces,
        "layout": layout,
        "numbers": _numbers(x, curves),
    }


def _in_words(title: str, curves: Curves, x: str) -> str:
    """What a line plot shows, for those who do not see it: where each line starts and ends."""
    ends = [
        f"{label}: {ys[0]:.4g} at {xs[0]:g}, {ys[-1]:.4g} at {xs[-1]:g}"
        for label, (xs, ys) in curves.items()
        if len(ys) > 0
    ]
    return f"{title}, against {x}. {'; '.join(ends)}."


def _numbers(x: str, curves: Curves) -> dict[str, Any]:
    """The numbers of a line plot as a table: heading and rows of text."""
    xs = sorted({value for values, _ in curves.values() for value in values})
    columns = [dict(zip(*curve, strict=True)) for curve in curves.values()]
    rows = [
        [f"{value:g}", *(f"{c[value]:.6g}" if value in c else "–" for c in columns)] for value in xs
    ]
    return {"heading": [x, *curves], "rows": rows}


def timing_plot(label: str, steps: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Seconds of each stage of each step of a run, stacked. steps: the lines of steps.jsonl."""
    stages = list(dict.fromkeys(stage for step in steps for stage in step.get("seconds", {})))
    numbers = [step["step"] for step in steps]
    seconds = {
        stage: [step.get("seconds", {}).get(stage, 0.0) for step in steps] for stage in stages
    }
    traces = [
        {"type": "bar", "name": stage, "x": numbers, "y": values}
        for stage, values in seconds.items()
    ]
    layout = {
        "barmode": "stack",
        "xaxis": {"title": {"text": "step (0: the seeds)"}},
        "yaxis": {"title": {"text": "seconds"}},
    }
    total = {stage: sum(values) for stage, values in seconds.items()}
    alt = f"Seconds of each stage, step by step, of {label}. In all: " + ", ".join(
        f"{s} {v:.1f} s" for s, v in total.items()
    )
    rows = [[str(n), *(f"{seconds[s][i]:.2f}" for s in stages)] for i, n in enumerate(numbers)]
    rows.append(["all", *(f"{value:.2f}" for value in total.values())])
    numbers_table = {"heading": ["step", *stages], "rows": rows}
    return {
        "title": f"Time, {label}",
        "alt": alt + ".",
        "data": traces,
        "layout": layout,
        "numbers": numbers_table,
    }


def views_plot(metric: str, runs: Mapping[str, Sequence[Mapping[str, Any]]]) -> dict[str, Any]:
    """A metric of every view, for each run: filled markers for views trained on, open ones for the
    others.

    runs: label -> views of metrics.json; views without this metric are left out.
    """
    traces, rows = [], []
    for (label, views), style in zip(runs.items(), line_styles(runs), strict=True):
        symbol = SYMBOLS[style["marker"]]
        for trained in (True, False):
            shown = [
                view
                for view in views
                if view["trained"] == trained and view.get(metric) is not None
            ]
            marker = {
                "symbol": symbol if trained else f"{symbol}-open",
                "color": style["color"],
                "size": 8,
            }
            name = f"{label}, {'trained on' if trained else 'held out'}"
            xs, ys = [view["name"] for view in shown], [view[metric] for view in shown]
            traces.append({"name": name, "x": xs, "y": ys, "mode": "markers", "marker": marker})
            rows += [
                [label, v["name"], "trained on" if trained else "held out", f"{v[metric]:.4f}"]
                for v in shown
            ]
    names = sorted({view["name"] for views in runs.values() for view in views})
    axis = {
        "title": {"text": "view"},
        "categoryorder": "array",
        "categoryarray": names,
        "type": "category",
    }
    layout = {"xaxis": axis, "yaxis": {"title": {"text": metric_name(metric)}}}
    title = f"{metric_name(metric)} of each view"
    numbers = {"heading": ["run", "view", "", metric_name(metric)], "rows": rows}
    return {
        "title": title,
        "alt": f"{title}; the numbers are in the table below.",
        "data": traces,
        "layout": layout,
    } | {"numbers": numbers}


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
    """The orbit in 3D: the model as points, all poses, seeds, and the chosen views with their
    numbers, joined in their order.

    names: of the frames; seeds, chosen: their indices. up, unit: of the world, which is turned by
    `mgs.data.up.upright` before it is drawn. The last trace, "shown above", is the view that the
    page's slider is at; the page moves it.
    """
    turn, traces = upright(up), []
    eyes = np.array([camera.position for camera in cameras]) @ turn.T
    if model is not None:
        some = model[:: max(1, -(-len(model) // POINTS))]
        colours = np.round(srgb_from_linear(some.rgb) * 255).astype(int).tolist()
        marker = {"size": 2, "color": [f"#{r:02x}{g:02x}{b:02x}" for r, g, b in colours]}
        traces.append(
            _points(
                "model", np.round(some.means.astype(float) @ turn.T, 4), marker, hoverinfo="skip"
            )
        )
    left = [i for i in range(len(eyes)) if i not in seeds + chosen]
    traces += [
        _points(
            "candidates",
            eyes[left],
            {"size": 3, "color": "#9a9a9a", "symbol": "circle-open"},
            names=[names[i] for i in left],
        ),
        _frusta([cameras[i] for i in seeds + chosen], FRUSTUM * _distance(cameras, model), turn),
        _points(
            "seeds",
            eyes[seeds],
            {"size": 6, "color": "#D55E00", "symbol": "diamond"},
            names=[names[i] for i in seeds],
        ),
    ]
    order = list(range(1, len(chosen) + 1))
    marker = {"size": 6, "color": order, "colorscale": "Viridis", "showscale": bool(chosen)}
    marker["colorbar"] = {"title": {"text": "step"}, "thickness": 12, "len": 0.6}
    labelled = [f"{names[i]}, step {k}" for k, i in zip(order, chosen, strict=True)]
    path = _points(
        "chosen, in their order", eyes[chosen], marker, names=labelled, mode="lines+markers+text"
    )
    traces.append(
        path
        | {
            "text": [str(k) for k in order],
            "line": {"color": "#7a7a7a", "width": 2},
            "textfont": {"size": 11},
        }
    )
    first = (seeds + chosen)[:1]
    here = {"size": 12, "color": "#dd1111", "symbol": "circle-open"}
    traces.append(_points("shown above", eyes[first], here, hoverinfo="skip"))
    titles = axis_names(up, unit)
    axes = {f"{a}axis": {"title": {"text": title}} for a, title in zip("xyz", titles, strict=True)}
    view = {"eye": {"x": 0.9, "y": 0.9, "z": 0.7}}
    layout = {"scene": {"aspectmode": "data", "camera": view, **axes}}
    alt = (
        f"Camera positions of {label} in 3D around the model. Seeds: {', '.join(names[i] for i in seeds)}. "
        f"Chosen, in this order: {', '.join(names[i] for i in chosen) or 'none yet'}."
    )
    rows = [
        [what, names[i], *(f"{value:.3f}" for value in eyes[i])]
        for what, i in [
            *(("seed", i) for i in seeds),
            *((f"step {k}", i) for k, i in zip(order, chosen, strict=True)),
        ]
    ]
    numbers = {"heading": ["taken as", "view", *titles], "rows": rows}
    return {
        "title": f"Orbit, {label}",
        "alt": alt,
        "data": traces,
        "layout": layout,
        "numbers": numbers,
    }


def _distance(cameras: Sequence[Camera], model: Gaussians | None) -> float:
    """Mean distance of the cameras from the middle of the model, or of the cameras."""
    eyes = np.array([camera.position for camera in cameras])
    middle = np.mean(eyes if model is None else model.means, axis=0)
    return float(np.linalg.norm(eyes - middle, axis=1).mean())


def _points(
    name: str,
    points: np.ndarray,
    marker: dict[str, Any],
    names: list[str] | None = None,
    mode: str = "markers",
    hoverinfo: str | None = None,
) -> dict[str, Any]:
    """A trace of points [M,3] in 3D. names: of each, shown when the pointer is on it."""
    x, y, z = np.reshape(points, (-1, 3)).T.tolist()
    trace = {
        "type": "scatter3d",
        "name": name,
        "x": x,
        "y": y,
        "z": z,
        "mode": mode,
        "marker": marker,
    }
    if names is not None:
        trace |= {"hovertext": names, "hoverinfo": "text+x+y+z"}
    return trace | ({"hoverinfo": hoverinfo} if hoverinfo else {})


def corners_at(camera: Camera, depth: float) -> np.ndarray:
    """The corners of a camera's image at this z-depth, as points of the world [4,3], in order
    around the image."""
    width, height = camera.width, camera.height
    pixels = np.array([[0, 0, 1], [width, 0, 1], [width, height, 1], [0, height, 1]], float)
    pose = camera.camera_to_world
    return depth * pixels @ np.linalg.inv(camera.K).T @ pose[:3, :3].T + pose[:3, 3]


def _frusta(cameras: Sequence[Camera], length: float, turn: np.ndarray) -> dict[str, Any]:
    """Cameras as wire pyramids of this length in one trace of lines. turn: [3,3], the rotation of
    the world."""
    lines: list[list[float | None]] = [[], [], []]
    for camera in cameras:
        corners, eye = corners_at(camera, length) @ turn.T, turn @ camera.position
        for a, b in [
            *((eye, corner) for corner in corners),
            *zip(corners, np.roll(corners, -1, axis=0), strict=True),
        ]:
            for axis, values in enumerate(lines):
                values += [round(float(a[axis]), 4), round(float(b[axis]), 4), None]
    x, y, z = lines
    line = {"color": "#7a7a7a", "width": 1.5}
    return {
        "type": "scatter3d",
        "name": "cameras",
        "mode": "lines",
        "x": x,
        "y": y,
        "z": z,
        "line": line,
        "hoverinfo": "skip",
    }
