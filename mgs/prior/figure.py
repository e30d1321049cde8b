"""One picture of the prior: cloud, ground plane, rock cluster, mesh, samples, all seen from the same side."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mgs.data.meshes import Mesh
from mgs.plotting import STYLE, new_figure, save_figure
from mgs.prior.build import Prior
from mgs.prior.segmentation import Rock

MAX_DOTS = 60_000
"""Points drawn per panel; more do not show."""

LIGHT = np.array([-0.5, 0.4, 0.77])
"""Direction to the light in the picture's frame (right, up, towards the viewer)."""


def draw_prior(path: str | Path, prior: Prior, rock: Rock | None) -> None:
    """Write the figure as a PNG, atomically; rock: what the mesh was built from, None where it was given."""
    import matplotlib

    up = np.array([0.0, 0.0, 1.0]) if rock is None else rock.plane.normal
    frame = _oblique(up)
    body = prior.mesh.vertices
    centre = (body.min(0) + body.max(0)) / 2
    reach = 0.5 * float(np.linalg.norm(np.ptp(body, axis=0)))
    truth = prior.numbers.get("truth")
    error = f", accuracy {1e3 * truth['accuracy']:.2f} mm" if truth else ""
    unseen = "" if prior.mesh.seen.all() else "\nblue: seen by no frame, not sampled"
    shade = np.clip(0.25 + 0.75 * (prior.normals @ frame.T) @ LIGHT, 0.05, 1)[:, None] * [0.95, 0.85, 0.7]
    towards = (prior.normals @ frame.T)[:, 2] > 0
    samples = f"samples: N = {len(prior.points):,} = area / spacing²\nspacing {1e3 * prior.spacing:.2f} mm"
    with matplotlib.rc_context(STYLE | {"axes.spines.top": True, "axes.spines.right": True}):
        figure = new_figure(17 if rock is not None else 7, 4.2, dpi=100)
        axes = figure.subplots(1, 5 if rock is not None else 2)
        if rock is not None:
            _cloud_panels(axes[:3], rock, frame, centre, reach)
        _shaded_mesh(axes[-2], prior.mesh, frame, centre, reach)
        axes[-2].set_title(f"mesh, {prior.numbers['mesh_area']:.2f} m²{error}{unseen}")
        _dots(axes[-1], ((prior.points - centre) @ frame.T)[towards], shade[towards], None, reach, None)
        axes[-1].set_title(samples)
        save_figure(figure, path)


def _cloud_panels(axes, rock: Rock, frame: np.ndarray, centre: np.ndarray, reach: float) -> None:
    """The cloud, its plane inliers and the rock's points."""
    cloud, height, ground = rock.cloud.points, rock.plane.height(rock.cloud.points), rock.ground
    near = np.linalg.norm(cloud - centre, axis=1) < 4 * reach
    panels = [
        (f"cloud: {len(cloud):,} points\ncoloured by height", cloud[near], height[near], "viridis", 2.2),
        (f"ground plane: {int(ground.sum()):,} inliers (tan)\nthe rest in blue", cloud[near], (~ground[near]) * 1.0, None, 2.2),
        (f"rock cluster: {len(rock.points):,} points", rock.points, rock.plane.height(rock.points), "viridis", 1.0),
    ]
    for axis, (title, points, value, colours, zoom) in zip(axes, panels, strict=True):
        tint = np.where(value[:, None] > 0.5, [0.15, 0.35, 0.75], [0.85, 0.76, 0.6]) if colours is None else value
        _dots(axis, (points - centre) @ frame.T, tint, colours, zoom * reach, 0.8)
        axis.set_title(title)


def _oblique(up: np.ndarray) -> np.ndarray:
    """[3,3] rows right, up, towards the viewer: from 30 degrees above the ground, at an arbitrary fixed azimuth."""
    side = np.cross(up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.9 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    ahead = np.cross(side, up)
    level = np.cos(0.8) * side + np.sin(0.8) * ahead
    towards = np.cos(np.pi / 6) * level + np.sin(np.pi / 6) * up
    right = np.cross(up, towards)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(towards, right), towards])


def _dots(axis, points: np.ndarray, colour: np.ndarray, colours: str | None, reach: float, size: float | None) -> None:
    """Scatter points [N,3] (picture frame), nearest drawn last; size in points^2, by default from their number."""
    if len(points) > MAX_DOTS:
        chosen = np.random.default_rng(0).choice(len(points), MAX_DOTS, replace=False)
        points, colour = points[chosen], colour[chosen]
    order = np.argsort(points[:, 2])
    size = float(np.clip(60_000 / max(len(points), 1), 0.3, 12)) if size is None else size
    axis.scatter(*points[order, :2].T, c=colour[order], cmap=colours, s=size, linewidths=0, rasterized=True)
    axis.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal", xticks=[], yticks=[])


def _shaded_mesh(axis, mesh: Mesh, frame: np.ndarray, centre: np.ndarray, reach: float) -> None:
    """Faces towards the viewer, painted far to near with Lambert shading."""
    from matplotlib.collections import PolyCollection

    corners = ((mesh.vertices - centre) @ frame.T)[mesh.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    colour = np.where(mesh.seen[:, None], [0.82, 0.8, 0.78], [0.25, 0.4, 0.8])
    front = np.flatnonzero(normal[:, 2] > 0)
    front = front[np.argsort(corners[front].mean(1)[:, 2])]
    shade = np.clip(0.25 + 0.75 * normal[front] @ LIGHT, 0.05, 1)[:, None] * colour[front]
    axis.add_collection(
        PolyCollection(corners[front, :, :2], facecolors=shade, edgecolors=shade, linewidths=0.2, rasterized=True)
    )
    axis.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal", xticks=[], yticks=[])
