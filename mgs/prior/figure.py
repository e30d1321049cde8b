"""The picture of a prior, prior.png: cloud, ground plane, rock cluster, mesh and samples, all seen
from the same side.

"Picture coordinates" are right, up, and towards the viewer, in metres.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from mgs.data.meshes import Mesh
from mgs.plotting import STYLE, new_figure, save_figure
from mgs.prior.build import Prior
from mgs.prior.segmentation import SegmentedCloud

MAX_DOTS = 60_000
"""Most points that are drawn in a panel; with more, the picture looks the same."""

LIGHT = np.array([-0.5, 0.4, 0.77])
"""Direction to the light in picture coordinates, about a unit vector."""


def draw_prior(path: str | Path, prior: Prior, segmented: SegmentedCloud | None) -> None:
    """Write the picture of a prior as a PNG; the file appears complete.

    segmented: the cloud that the mesh was built from, None if the mesh was given: then the panels
    of the cloud are left out. Raises InputError if it cannot be written.
    """
    import matplotlib

    plane = None if segmented is None else segmented.plane
    frame = _oblique(np.array(prior.up) if plane is None else plane.normal)
    body = prior.mesh.vertices
    centre = (body.min(0) + body.max(0)) / 2
    reach = 0.5 * float(np.linalg.norm(np.ptp(body, axis=0)))
    truth = prior.numbers.get("truth")
    error = f", accuracy {1e3 * truth['accuracy']:.2f} mm" if truth else ""
    unseen = "" if prior.mesh.seen.all() else "\nblue: seen by no frame, not sampled"
    shade = np.clip(0.25 + 0.75 * (prior.normals @ frame.T) @ LIGHT, 0.05, 1)[:, None] * [
        0.95,
        0.85,
        0.7,
    ]
    towards = (prior.normals @ frame.T)[:, 2] > 0
    metres = prior.numbers.get("unit", "m") == "m"
    spacing = f"{1e3 * prior.spacing:.2f} mm" if metres else f"{prior.spacing:.3g} units"
    samples = f"samples: N = {len(prior.points):,} = area / spacing²\nspacing {spacing}"
    with matplotlib.rc_context(STYLE | {"axes.spines.top": True, "axes.spines.right": True}):
        figure = new_figure(17 if segmented is not None else 7, 4.2, dpi=100)
        axes = figure.subplots(1, 5 if segmented is not None else 2)
        if segmented is not None:
            _cloud_panels(axes[:3], segmented, np.array(prior.up), frame, centre, reach)
        _shaded_mesh(axes[-2], prior.mesh, frame, centre, reach)
        axes[-2].set_title(
            f"mesh, {prior.numbers['mesh_area']:.2f} {'m' if metres else 'unit'}²{error}{unseen}"
        )
        _dots(
            axes[-1],
            ((prior.points - centre) @ frame.T)[towards],
            shade[towards],
            None,
            reach,
            None,
        )
        axes[-1].set_title(samples)
        save_figure(figure, path)


def draw_refused(path: str | Path, points: np.ndarray, kept: np.ndarray, up: np.ndarray) -> None:
    """Write the picture of a cloud [P,3] that gives no surface, from the side and from above, as a
    PNG; blue: the points `kept` [P] that were taken for the object. up: [3] unit. Raises InputError
    if it cannot be written."""
    import matplotlib

    middle = np.median(points[kept] if kept.any() else points, axis=0)
    reach = 1.5 * float(
        np.quantile(np.linalg.norm((points[kept] if kept.any() else points) - middle, axis=1), 0.95)
    )
    tint = np.where(kept[:, None], [0.15, 0.35, 0.75], [0.85, 0.76, 0.6])
    side = _oblique(up)[0]
    above = np.stack([side, np.cross(up, side), up])
    with matplotlib.rc_context(STYLE | {"axes.spines.top": True, "axes.spines.right": True}):
        figure = new_figure(7, 4.2, dpi=100)
        for axis, frame, name in zip(
            figure.subplots(1, 2),
            (_oblique(up), above),
            ("from the side", "from above"),
            strict=True,
        ):
            _dots(axis, (points - middle) @ frame.T, tint, None, 2 * reach, 1.5)
            axis.set_title(
                f"{name}: {len(points):,} points,\n{int(kept.sum()):,} taken for the object (blue)"
            )
        save_figure(figure, path)


def _cloud_panels(
    axes,
    segmented: SegmentedCloud,
    up: np.ndarray,
    frame: np.ndarray,
    centre: np.ndarray,
    reach: float,
) -> None:
    """Three panels: the cloud, its points on the ground plane (or, without one, all that are not
    the rock's), and the rock's.

    up: [3] unit, for the heights where there is no plane. frame: as `_oblique`; centre: [3] of the
    picture in the world; reach: half the width of the rock in the picture; metres.
    """
    cloud, rock, ground = segmented.cloud.points, segmented.rock_points, segmented.ground
    height = (
        cloud @ up - np.min(rock @ up) if segmented.plane is None else segmented.plane.height(cloud)
    )
    other = ground if segmented.plane is not None else cKDTree(rock).query(cloud)[0] > 0
    named = (
        f"ground plane: {int(ground.sum()):,} inliers"
        if segmented.plane is not None
        else "not the object's"
    )
    near = np.linalg.norm(cloud - centre, axis=1) < 4 * reach
    panels = [
        (
            f"cloud: {len(cloud):,} points\ncoloured by height",
            cloud[near],
            height[near],
            "viridis",
            2.2,
        ),
        (f"{named} (tan)\nthe rest in blue", cloud[near], (~other[near]) * 1.0, None, 2.2),
        (f"rock cluster: {len(rock):,} points", rock, rock @ up, "viridis", 1.0),
    ]
    for axis, (title, points, value, colours, zoom) in zip(axes, panels, strict=True):
        tint = (
            np.where(value[:, None] > 0.5, [0.15, 0.35, 0.75], [0.85, 0.76, 0.6])
            if colours is None
            else value
        )
        _dots(axis, (points - centre) @ frame.T, tint, colours, zoom * reach, 0.8)
        axis.set_title(title)


def _oblique(up: np.ndarray) -> np.ndarray:
    """The axes of picture coordinates in the world, rows [3,3], of a viewer 30 degrees above a
    ground whose normal is `up` [3].

    The azimuth of the viewer is arbitrary, but always the same.
    """
    side = np.cross(up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.9 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    ahead = np.cross(side, up)
    level = np.cos(0.8) * side + np.sin(0.8) * ahead
    towards = np.cos(np.pi / 6) * level + np.sin(np.pi / 6) * up
    right = np.cross(up, towards)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(towards, right), towards])


def _dots(
    axis,
    points: np.ndarray,
    colour: np.ndarray,
    colours: str | None,
    reach: float,
    size: float | None,
) -> None:
    """Draw points [N,3], in picture coordinates, those nearest to the viewer last.

    colour: values [N] for the colour map `colours`, or RGB [N,3]; reach: half the width of the
    panel, metres; size: of a dot, in square typographic points, None to choose it by the number of
    points.
    """
    if len(points) > MAX_DOTS:
        chosen = np.random.default_rng(0).choice(len(points), MAX_DOTS, replace=False)
        points, colour = points[chosen], colour[chosen]
    order = np.argsort(points[:, 2])
    size = float(np.clip(60_000 / max(len(points), 1), 0.3, 12)) if size is None else size
    axis.scatter(
        *points[order, :2].T, c=colour[order], cmap=colours, s=size, linewidths=0, rasterized=True
    )
    axis.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal", xticks=[], yticks=[])


def _shaded_mesh(axis, mesh: Mesh, frame: np.ndarray, centre: np.ndarray, reach: float) -> None:
    """Draw the faces of a mesh that face the viewer, with Lambert shading, from the farthest to the
    nearest.

    frame, centre, reach: as in `_cloud_panels`. Faces that do not count as seen are blue.
    """
    from matplotlib.collections import PolyCollection

    corners = ((mesh.vertices - centre) @ frame.T)[mesh.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    colour = np.where(mesh.seen[:, None], [0.82, 0.8, 0.78], [0.25, 0.4, 0.8])
    front = np.flatnonzero(normal[:, 2] > 0)
    front = front[np.argsort(corners[front].mean(1)[:, 2])]
    shade = np.clip(0.25 + 0.75 * normal[front] @ LIGHT, 0.05, 1)[:, None] * colour[front]
    axis.add_collection(
        PolyCollection(
            corners[front, :, :2],
            facecolors=shade,
            edgecolors=shade,
            linewidths=0.2,
            rasterized=True,
        )
    )
    axis.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal", xticks=[], yticks=[])
