"""Files of a suggestion: a figure, numbers, and the poses to fly."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np

from mgs.camera import opengl_from_opencv
from mgs.data.dataset import write_transforms
from mgs.data.frames import Frame
from mgs.data.world import World
from mgs.files import write_json
from mgs.plotting import NO_GRID, crop, drawing, literal
from mgs.policy.criteria import GAIN_UNIT
from mgs.reports.diagnostics import VISIBLE, picture, run_scalars, show_map, view_maps
from mgs.reports.page_plots import CURVES
from mgs.run.folder import Run
from mgs.run.suggest import Suggestion, View, taken_in_order

CONVENTION = (
    "transform_matrix: camera to world, in the dataset's unit, OpenGL axes (x right, y up, z "
    "backwards), as in nerfstudio"
)

CHOSEN = "#d1495b"  # colour of the planned views, and of the image from which the way is told
MOST_PICTURES, PICTURE_WIDTH = 6, 200  # views in the figure, and pixels of the width of a picture


def write_suggestion(out: Path, run: Run, suggestion: Suggestion) -> None:
    """Write suggestions.json, transforms.json and suggestions.png into the folder `out`.

    transforms.json is a dataset of the planned poses in flying order, in the coordinates of the
    data that was imported; their pictures belong in images/. Raises InputError if a file cannot be
    written."""
    write_json(out / "suggestions.json", numbers(run, suggestion))
    world, frames = run.dataset.world, []
    for k, view in enumerate(suggestion.plan):
        image = out / f"images/{view.name}.png"
        frames.append(Frame(view.name, world.whole(view.camera), float(k), image, on_demand=True))
    write_transforms(out, frames, world.home, {"convention": CONVENTION})
    draw_suggestion(out / "suggestions.png", run, suggestion)


def numbers(run: Run, suggestion: Suggestion) -> dict[str, Any]:
    units = {
        "information_gain": f"Eq. 7, {GAIN_UNIT}",
        "unseen": "share of what the picture shows that no image shows",
        "unknown": "mean share of the prior's variance left in what the picture shows",
        "distance": f"from the last image, {run.dataset.unit}",
    }
    world, worth = run.dataset.world, suggestion.certificate
    names = [view.name for view in suggestion.ranking]
    return {
        "policy": suggestion.policy,
        "images": len(run.taken),
        "convention": CONVENTION,
        "units": units,
        "flight": {"metres": suggestion.metres, "seconds": suggestion.seconds},
        "certificate": worth.record(names) if worth else None,
        "dropped": suggestion.dropped,
        "plan": [_record(view, world) for view in suggestion.plan],
        "ranking": [_record(view, world) for view in suggestion.ranking],
    }


def _record(view: View, world: World) -> dict[str, Any]:
    values = {key: value for key, value in asdict(view).items() if key != "camera"}
    pose = opengl_from_opencv(world.leave(world.whole(view.camera)).world_to_camera)
    return values | {"transform_matrix": pose.tolist()}


def draw_suggestion(path: str | Path, run: Run, suggestion: Suggestion) -> None:
    """Draw the site from above, for the first planned views what the model shows from there and how
    uncertain it is, and the curve of the certificate. Raises InputError if the figure cannot be
    written."""
    views = suggestion.plan[:MOST_PICTURES]
    scalars = {"uncertainty": run_scalars(run)["uncertainty"]}
    curve = suggestion.certificate.curve if suggestion.certificate else []
    widths = [3.6, *[1.7] * len(views), *[3.2] * bool(curve)]
    with drawing(path, 0.4 + sum(widths), 4.2, NO_GRID, dpi=120) as figure:
        grid = figure.add_gridspec(2, len(widths), width_ratios=widths)
        if curve:
            _curve(figure.add_subplot(grid[:, -1]), curve, len(suggestion.plan))
        site = figure.add_subplot(grid[:, 0])
        _from_above(site, run, suggestion)
        for k, view in enumerate(views, 1):
            small = view.camera.resized(min(view.camera.width, PICTURE_WIDTH))
            maps = view_maps(run.state.gaussians, small, scalars)
            window = crop(maps["A"] >= VISIBLE)
            top, below = (figure.add_subplot(grid[row, k]) for row in (0, 1))
            top.imshow(picture(maps)[window])
            top.set_title(literal(f"{k}: {view.name}\n{fill(view.way, 28)}"), fontsize=8)
            shown = show_map(below, maps, "uncertainty", window, "cividis", vmin=0, vmax=1)
            gain = f"gain {view.information_gain:.3f}"
            below.set_title(f"unknown {100 * view.unknown:.0f} %, {gain}", fontsize=8)
            top.set_axis_off()
            for axis in (top, below):
                axis.set_anchor("N")
        figure.colorbar(shown, ax=below, shrink=0.8, aspect=16, label="variance left")
        legend = site.get_legend_handles_labels()
        figure.legend(*legend, loc="outside lower left", ncols=3)


def _curve(axis: Any, curve: Sequence[Mapping[str, float]], planned: int) -> None:
    axis.axvline(planned, color="#dddddd", linewidth=5)
    for key, (name, colour) in CURVES.items():
        shares = [100 * row[key] for row in curve]
        style = {"linestyle": "--"} if key == "bound" else {}
        numbers = [row["views"] for row in curve]
        axis.plot(numbers, shares, marker="o", markersize=3, label=name, color=colour, **style)
    title = f"gain of so many views,\n% of that of all candidates (planned: {planned})"
    axis.set(xlabel="views", title=title, ylim=(0, 102))
    axis.legend(fontsize=7, handlelength=1, labelspacing=0.3)


def _from_above(axis: Any, run: Run, suggestion: Suggestion) -> None:
    def level(points: Any) -> np.ndarray:
        return np.atleast_2d(points)[:, :2]

    axis.margins(0.15)  # for names
    frames = taken_in_order(run)
    images = level([frame.camera.position for frame in frames])
    stops = [level(view.camera.position) for view in suggestion.plan]
    ways = [view.way.partition(":")[0] for view in suggestion.plan[:MOST_PICTURES]]
    named = {name for way in ways for name in way.removeprefix("from ").split(" towards ")}
    for frame, place in zip(frames, images, strict=True):
        if frame.name in named:
            x, y = place - min(np.concatenate(stops), key=lambda stop: np.linalg.norm(stop - place))
            side = {"ha": "left" if x > 0 else "right", "va": "bottom" if y > 0 else "top"}
            apart = (7 if x > 0 else -7, 5 if y > 0 else -5)  # from its mark and the nearest stop
            about = {"textcoords": "offset points", "fontsize": 7, "color": CHOSEN, **side}
            axis.annotate(literal(frame.name), place, apart, **about)
            axis.scatter(*place, marker="^", s=26, color=CHOSEN, zorder=3)
    ranked = level([view.camera.position for view in suggestion.ranking])
    gains, label = [view.information_gain for view in suggestion.ranking], f"gain ({GAIN_UNIT})"
    if suggestion.certificate:
        gains = [100 * price for price in suggestion.certificate.prices]
        label = "what a picture there adds (% of the bound)"
    surface = run.prior.points[: run.prior.numbers.get("triangulated") or None]  # no random ones
    axis.scatter(*level(surface[::7]).T, s=0.5, color="#b0a898", rasterized=True)
    axis.scatter(*images.T, marker="^", s=26, color="black", label="images so far")
    dots = axis.scatter(*ranked.T, c=gains, s=18, cmap="viridis", label="candidates")
    way = [images[:1]]
    for corners, stop in zip(suggestion.corners, [*stops, images[:1]], strict=True):
        way += [level(corners)] * (len(corners) > 0) + [stop]
    axis.plot(*np.concatenate(way).T, color=CHOSEN, linewidth=1.2)
    axis.scatter(*np.concatenate(stops).T, s=110, color=CHOSEN, zorder=3, label="to take next")
    for k, stop in enumerate(stops, 1):
        axis.text(*stop[0], str(k), color="white", fontsize=8, ha="center", va="center", zorder=4)
    axis.set(aspect="equal", title="from above")
    if (unit := run.dataset.unit) != "unit":  # else lengths say nothing
        title = f"from above: a flight of {suggestion.metres:.1f} {unit}"
        axis.set(xlabel=f"x ({unit})", ylabel=f"y ({unit})", title=title)
    axis.figure.colorbar(dots, ax=axis, shrink=0.6, aspect=20, label=label)
