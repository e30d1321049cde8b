"""The figure of a prior: cloud, ground plane, rock cluster, mesh and samples from one side.
"Picture coordinates" are right, up, and towards the viewer, in metres."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from mgs.data.meshes import Mesh, face_crosses
from mgs.plotting import NO_GRID, drawing, painted
from mgs.prior.build import Prior
from mgs.prior.segmentation import SegmentedCloud

UP = np.array([0.0, 0.0, 1.0])
BLUE, TAN = [0.15, 0.35, 0.75], [0.85, 0.76, 0.6]
FRAMED = NO_GRID | {"axes.spines.top": True, "axes.spines.right": True}
ONE_SIDED = 0.4  # least level mean normal of a surface with a front; half a ball: 0.5
MAX_DOTS = 300_000  # most points drawn in a panel; with more, it looks the same
PIXELS = 440  # width and height of the image of a panel of dots, about those of the panel
LIGHT = np.array([-0.5, 0.4, 0.77])  # direction to the light in picture coordinates, about unit


@dataclass(frozen=True)
class _View:
    """A view for panels. axes: [3,3], rows are the axes of picture coordinates; centre: [3] world,
    in the middle of a panel; reach: half the width of a panel, metres."""

    axes: np.ndarray
    centre: np.ndarray
    reach: float

    def picture(self, points: np.ndarray) -> np.ndarray:
        """Points [N,3] in picture coordinates."""
        return (points - self.centre) @ self.axes.T

    def frame(self, axis, zoom: float = 1) -> None:
        """Set the limits of a panel, `zoom` times as wide as usual."""
        limits = (-zoom * self.reach, zoom * self.reach)
        axis.set(xlim=limits, ylim=limits, aspect="equal", xticks=[], yticks=[])

    def dots(self, axis, points: np.ndarray, colour: np.ndarray, zoom: float, size: int) -> None:
        """Draw world points [N,3], nearest last, as squares of `size` of the PIXELS. colour: RGB
        [N,3], or values [N] for a colour map."""
        if colour.ndim == 1:
            colour = painted(colour, "viridis", colour.min(), colour.max()) / 255
        if len(points) > MAX_DOTS:
            subset = np.random.default_rng(0).choice(len(points), MAX_DOTS, replace=False)
            points, colour = points[subset], colour[subset]
        places, across = self.picture(points), np.arange(size) - size / 2
        order = np.argsort(places[:, 2])
        x, y = PIXELS / 2 * (1 + places[order, :2] / (zoom * self.reach)).T[..., None, None]
        row, column = np.broadcast_arrays(y + across[:, None], x + across)
        inside = (np.minimum(row, column) >= 0) & (np.maximum(row, column) < PIXELS)
        colours = np.broadcast_to(colour[order, None, None], (*row.shape, 3))
        image = np.ones((PIXELS, PIXELS, 3))
        image[row[inside].astype(int), column[inside].astype(int)] = colours[inside]
        limits = (-zoom * self.reach, zoom * self.reach)
        axis.imshow(image, extent=limits * 2, origin="lower", interpolation="nearest")
        self.frame(axis, zoom)


def draw_prior(path: str | Path, prior: Prior, segmented: SegmentedCloud | None) -> None:
    """Write the figure of a prior as a PNG, atomically. segmented: the cloud of the mesh; None if
    the mesh was given, without panels of the cloud. Raises InputError if it cannot be written."""
    plane = None if segmented is None else segmented.plane
    body = prior.mesh.vertices
    reach = 0.5 * float(np.linalg.norm(np.ptp(body, axis=0)))
    up = UP if plane is None else plane.normal
    axes_of_view = _oblique(up, prior.normals.mean(0))
    view = _View(axes_of_view, (body.min(0) + body.max(0)) / 2, reach)
    truth = prior.numbers.get("truth")
    error = f", accuracy {1e3 * truth['accuracy']:.2f} mm" if truth else ""
    unseen = "" if prior.mesh.seen.all() else "\nblue: seen by no frame, not sampled"
    normals = prior.normals @ view.axes.T
    towards = normals[:, 2] > 0
    shade = _lambert(normals[towards]) * [0.95, 0.85, 0.7]
    dot = round(np.sqrt(np.clip(4e5 / max(len(shade), 1), 9, 100)))
    metres = prior.numbers.get("unit", "m") == "m"
    spacing = f"{1e3 * prior.spacing:.2f} mm" if metres else f"{prior.spacing:.3g} units"
    area = f"{prior.mesh.areas.sum():.2f} {'m' if metres else 'unit'}²"
    lines, columns = (1, 2) if segmented is None else (2, 3)
    with drawing(path, 3 * columns, 3.6 * lines, FRAMED, dpi=150) as figure:
        axes = list(figure.subplots(lines, columns).ravel())
        if segmented is not None:
            axes.pop().remove()
            _cloud_panels(axes[:3], view, segmented)
        _shaded_mesh(axes[-2], view, prior.mesh)
        axes[-2].set_title(f"mesh, {area}{error}{unseen}")
        view.dots(axes[-1], prior.points[towards], shade, 1, dot)
        samples = f"samples: N = {len(prior.points):,} = area / spacing²"
        axes[-1].set_title(f"{samples}\nspacing {spacing}")


def draw_refused(path: str | Path, points: np.ndarray, rock: np.ndarray) -> None:
    """Write the figure of a cloud [P,3] without surface, from the side and from above, as a PNG.
    rock: [P] bool, taken for the object, blue. Raises InputError if it cannot be written."""
    object_points = points[rock] if rock.sum() > 1 else points
    middle = np.median(object_points, axis=0)
    reach = 1.5 * float(np.quantile(np.linalg.norm(object_points - middle, axis=1), 0.95))
    tint = np.where(rock[:, None], BLUE, TAN)
    oblique = _oblique(UP)
    above = np.stack([oblique[0], np.cross(UP, oblique[0]), UP])
    with drawing(path, 7, 4.2, FRAMED, dpi=100) as figure:
        views = {"from the side": oblique, "from above": above}
        taken = f"{int(rock.sum()):,} taken for the object (blue)"
        for axis, (name, axes) in zip(figure.subplots(1, 2), views.items(), strict=True):
            _View(axes, middle, reach).dots(axis, points, tint, 2, 3)
            axis.set_title(f"{name}: {len(points):,} points,\n{taken}")


def _cloud_panels(axes, view: _View, segmented: SegmentedCloud) -> None:
    """Draw three panels: the cloud, its points on the ground plane (or, without one, not the
    rock's), and the rock's."""
    cloud, rock, ground = segmented.cloud.points, segmented.rock_points, segmented.ground
    if segmented.plane is None:
        height = cloud[:, 2] - np.min(rock[:, 2])
        other, label = cKDTree(rock).query(cloud)[0] > 0, "not the object's"
    else:
        height = segmented.plane.height(cloud)
        other, label = ground, f"ground plane: {int(ground.sum()):,} inliers"
    near = np.linalg.norm(cloud - view.centre, axis=1) < 4 * view.reach
    tint = np.where(other[near][:, None], TAN, BLUE)
    panels = [
        (f"cloud: {len(cloud):,} points\ncoloured by height", cloud[near], height[near], 2.2),
        (f"{label} (tan)\nthe rest in blue", cloud[near], tint, 2.2),
        (f"the object: {len(rock):,} points", rock, rock[:, 2], 1.0),
    ]
    for axis, (title, points, colour, zoom) in zip(axes, panels, strict=True):
        view.dots(axis, points, colour, zoom, 2)
        axis.set_title(title)


def _oblique(up: np.ndarray, facing: np.ndarray = np.zeros(3)) -> np.ndarray:
    """Axes of picture coordinates, rows [3,3], of a viewer 30 degrees above the ground, and before
    the front of a surface that is ONE_SIDED. facing: its mean normal."""
    side = np.cross(up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.9 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    ahead = np.cross(side, up)
    level = np.cos(0.8) * side + np.sin(0.8) * ahead
    across = facing - (facing @ up) * up
    if (length := float(np.linalg.norm(across))) > ONE_SIDED:
        level = across / length
    towards = np.cos(np.pi / 6) * level + np.sin(np.pi / 6) * up
    right = np.cross(up, towards)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(towards, right), towards])


def _shaded_mesh(axis, view: _View, mesh: Mesh) -> None:
    """Draw the front faces of a mesh, Lambert shaded, nearest last; unseen ones in blue."""
    from matplotlib.collections import PolyCollection

    vertices = view.picture(mesh.vertices)
    corners, normal = vertices[mesh.faces], face_crosses(vertices, mesh.faces)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    front = np.flatnonzero(normal[:, 2] > 0)
    front = front[np.argsort(corners[front].mean(1)[:, 2])]
    colour = np.where(mesh.seen[front][:, None], [0.82, 0.8, 0.78], [0.25, 0.4, 0.8])
    shade = _lambert(normal[front]) * colour
    faces = PolyCollection(
        corners[front, :, :2], facecolors=shade, edgecolors=shade, linewidths=0.2, rasterized=True
    )
    axis.add_collection(faces)
    view.frame(axis)


def _lambert(normals: np.ndarray) -> np.ndarray:
    """Brightness [N,1] of normals [N,3] in picture coordinates."""
    return np.clip(0.25 + 0.75 * normals @ LIGHT, 0.05, 1)[:, None]
