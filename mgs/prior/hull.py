"""The visual hull by carving (Laurentini 1994): marching cubes where the least distance of a
point's projections inside the masks' outlines, times the size of a pixel there, is 0."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter, label

from mgs.camera import Camera
from mgs.data.frames import Frame, in_image, nearest_point
from mgs.data.lens import shrunk_to
from mgs.data.meshes import Mesh
from mgs.errors import InputError, Notice
from mgs.memory import IMAGE_BYTES
from mgs.prior.surface import Surface
from mgs.progress import report

COARSE, REFINEMENTS = 48, 2  # cells along an edge of the first grid; its refinements by two
NEAR_SURFACE = 3.0  # nodes are evaluated anew if their interpolated value is under this many cells
BLOCK = 32_768  # points that are carved at once
ROW = 4096  # points are passed to OpenCV in rows of this length
# Of a mask to carve with: outlines finer than the grid. More than 268 share IMAGE_BYTES.
MOST_PIXELS = 1_000_000
MARGIN = 1.3  # half edge of the grid over the largest radius of the object that a mask shows
LEAST_VIEWS = 3  # A point in the image of fewer frames is outside
AGREEMENT = 0.8  # least median share of a mask that the hull must fill
FITTING = 0.95  # the same, above which masks and poses fit each other, so that no view errs
LEAST_PIECE = 0.02  # least volume of a piece over that of the largest; smaller ones are specks
ODD = 0.5  # least share of what few frames cut away, for a mask that cuts it away to be left out
FEW = 0.1  # share of the frames that see a point of the object and may carve it by mistake


def visual_hull(frames: Sequence[Frame]) -> Surface:
    """Visual hull of the masks of frames, smoothed by at most half a cell. Its numbers have the
    mean and least share of a mask that it fills.

    Where it fills less than FITTING of the median mask, wrong poses each cut a bit away, or
    smoothing took what is as thin as two cells. Then the hulls without smoothing, and of all but
    FEW of the frames that see a point, are carved too, and the one that fits the masks best is
    taken. A few masks that cut away what no others do are left out, with a warning. Raises
    InputError if all masks are empty or full, if they share no point of space, or if the hull fills
    too little of them, because poses and masks do not fit; the message names frames."""
    others = list(frames)
    while True:
        try:
            return _carved(others)
        except _Contradiction as error:
            if error.share < ODD or len(frames) - len(others) >= FEW * len(frames):
                raise InputError(f"{error}") from None
            name = others.pop(error.place).name
            text = (
                f"the mask of {name} cuts away {error.share:.0%} of what few others cut away; it "
                f"shapes no hull, and `mgs import --exclude {name}` leaves its image out"
            )
            warnings.warn(Notice(text), stacklevel=2)


class _Contradiction(InputError):
    """Masks that do not fit, with the place of the frame that fits least and the share that it
    alone cuts away."""

    def __init__(self, what: str, frames: Sequence[Frame], odd: tuple[int, float, float]) -> None:
        self.place, self.share, usual = odd
        name = frames[self.place].name
        super().__init__(
            f"prior: {what}; frame {name} cuts away {self.share:.0%} of the "
            f"space that few other frames cut away (the median frame {usual:.0%}); "
            f"correct its mask or pose, or leave it out with `mgs import --exclude {name}`"
        )


def _carved(frames: Sequence[Frame]) -> Surface:
    """`visual_hull` of all frames. Raises _Contradiction where their masks do not fit."""
    views, most = list[_View](), min(MOST_PIXELS, IMAGE_BYTES // (4 * len(frames)))
    for frame in frames:
        report("reading masks", len(views), len(frames))
        views.append(_view(frame, most))
    lo, edge = _bounds(frames)
    cell, best = edge / (COARSE * 2**REFINEMENTS), -1.0
    for wrong in (0.0, FEW) if FEW * len(views) >= 1 else (0.0,):
        field = _field(views, lo, edge, wrong)
        if field.max() <= 0:
            what = "the masks share no point in space"
            raise _Contradiction(what, frames, _odd_one(views, _grid(lo, edge)))
        smooth = np.clip(gaussian_filter(field, 1.0), field - cell / 2, field + cell / 2)
        for values in (smooth, field) if smooth.max() > 0 else (field,):
            mesh = _meshed(values, lo, cell)
            filled, overlap = _fit(views, mesh)
            if np.nanmedian(overlap) > best:
                best, hull, fill = float(np.nanmedian(overlap)), mesh, filled
            if np.nanmedian(fill) >= FITTING and not wrong:
                break
        if np.nanmedian(fill) < AGREEMENT:
            share = f"{np.nanmedian(fill):.0%} of the median mask"
            what = f"the masks carve away most of the object (the hull fills {share})"
            raise _Contradiction(what, frames, _odd_one(views, _grid(lo, edge)))
        if np.nanmedian(fill) >= FITTING:
            break
    fills = {"hull_fills_masks": np.nanmean(fill), "hull_fills_least": np.nanmin(fill)}
    return Surface(hull, cell, {"hull_cell": cell} | {key: float(fills[key]) for key in fills})


@dataclass(frozen=True)
class _View:
    """A frame to carve with. distance: [H,W] from the mask's outline, in shorter sides of a pixel,
    positive inside."""

    camera: Camera
    distance: np.ndarray

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Distance of points [N,3] inside the silhouette, world; +inf outside the image."""
        import cv2

        if len(points) == 0:
            return np.zeros(0)
        pixels, z = self.camera.project(points)
        inside = in_image(self.camera, pixels, z)
        padded = np.zeros((-(-len(points) // ROW) * ROW, 2), np.float32)
        padded[: len(points)] = np.where(inside[:, None], pixels - 0.5, 0)
        at = padded.reshape(-1, ROW, 2)  # OpenCV takes images of up to 32,767 rows
        remap: Any = cv2.remap  # its stub takes no None
        parts = [
            remap(self.distance, part, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            for part in np.array_split(at, -(-len(at) // ROW))
        ]
        side = z / max(self.camera.K[0, 0], self.camera.K[1, 1])
        value = np.concatenate(parts).ravel()[: len(points)] * side
        return np.where(inside, value, np.inf)


def _view(frame: Frame, most: int) -> _View:
    """View of a frame, with a mask of at most `most` pixels, since all are kept in memory."""
    camera, smaller = shrunk_to(frame.camera, most)
    mask = smaller(frame.mask().astype(np.uint8) * 255, True) >= 128
    far = np.full(mask.shape, float(max(mask.shape)))
    focal = camera.K[[1, 0], [1, 0]]
    distance = partial(distance_transform_edt, sampling=focal.max() / focal)  # down, across
    inside = far if mask.all() else distance(mask) - 0.5
    outside = distance(~mask) - 0.5 if mask.any() else far
    return _View(camera, np.where(mask, inside, -outside).astype(np.float32))


def _bounds(frames: Sequence[Frame]) -> tuple[np.ndarray, float]:
    """Lowest corner [3] and edge of the cube to carve in, around the point nearest to the rays
    through the masks' centres. Raises InputError if every mask is empty or fills its image."""
    rays, cones = [], []
    for k, frame in enumerate(frames):
        report("outlines of masks", k, len(frames))
        mask = frame.mask()
        if not mask.any() or mask.all():
            continue
        rows, columns = np.nonzero(mask)
        pixels = np.stack([columns, rows], 1) + 0.5
        middle, K = (pixels.min(0) + pixels.max(0)) / 2, frame.camera.K
        ray = frame.camera.world_to_camera[:3, :3].T @ np.linalg.solve(K, [*middle, 1])
        rays.append(ray / np.linalg.norm(ray))
        tangent = np.linalg.norm((pixels - middle) / K[[0, 1], [0, 1]], axis=1).max()
        cones.append((frame.camera.position, tangent))
    if not cones:
        cure = "give masks that are white on the object only"
        raise InputError(f"prior: every mask is empty or full; {cure}")
    centre = nearest_point([position for position, _ in cones], rays)
    half = MARGIN * max(np.linalg.norm(at - centre) * tangent for at, tangent in cones)
    return centre - half, float(2 * half)


def _grid(lo: np.ndarray, edge: float) -> np.ndarray:
    """Nodes [N,3] of the coarse grid, world."""
    side = edge / COARSE * np.arange(COARSE + 1)
    return lo + np.stack(np.meshgrid(side, side, side, indexing="ij"), -1).reshape(-1, 3)


def _field(views: Sequence[_View], lo: np.ndarray, edge: float, wrong: float) -> np.ndarray:
    """`_inside` of the nodes of the finest grid, [N,N,N]; interpolated away from the surface. If
    no node of the coarse grid is inside, that grid."""
    cells = COARSE
    field = _inside(views, _grid(lo, edge), 2 * NEAR_SURFACE * edge / cells, wrong)
    field = field.reshape([COARSE + 1] * 3)
    for _ in range(REFINEMENTS if field.max() > 0 else 0):
        field, cells = _refined(field), 2 * cells
        cell = edge / cells
        near = np.argwhere(np.abs(field) < NEAR_SURFACE * cell)
        field[tuple(near.T)] = _inside(views, lo + cell * near, NEAR_SURFACE * cell, wrong)
    return field


def _inside(views: Sequence[_View], points: np.ndarray, reach: float, wrong: float) -> np.ndarray:
    """Least value of points [N,3] over the views, but for the share `wrong` of those that see them,
    clipped to +-reach, float32 [N]; -reach if fewer than LEAST_VIEWS have the point in their
    image."""
    field = np.full(len(points), -reach, np.float32)
    for first in range(0, len(points), BLOCK):
        report("visual hull", first, len(points))
        part = points[first : first + BLOCK]
        values, active = np.empty((len(views), len(part))), np.arange(len(part))
        deep = np.zeros(len(part), int)
        for row, view in zip(values, views, strict=True):
            row[active] = view(part[active])
            deep[active] += row[active] <= -reach
            active = active[deep[active] <= wrong * len(views)]  # others are far from the surface
        values = np.sort(values[:, active], axis=0)
        count = np.isfinite(values).sum(axis=0)
        value = np.take_along_axis(values, (wrong * count).astype(int)[None], 0)[0]
        value[count < min(LEAST_VIEWS, len(views))] = -reach
        field[first + active] = np.clip(value, -reach, reach)
    return field


def _odd_one(views: Sequence[_View], points: np.ndarray) -> tuple[int, float, float]:
    """Place of the frame that carves most of the points that few others carve (FEW), the share of
    them that it carves, and that of the median frame. points: [N,3], of the coarse grid."""
    values = np.stack([view(points) for view in views])
    carved, count = values <= 0, np.isfinite(values).sum(axis=0)
    above = carved.sum(axis=0) - np.maximum(FEW * count, 1)
    above[count < min(LEAST_VIEWS, len(views))] = len(views)
    share = carved[:, above <= max(above.min(), 0)].mean(axis=1)
    return int(share.argmax()), float(share.max()), float(np.median(share))


def _refined(field: np.ndarray) -> np.ndarray:
    """The field on a grid with twice as many cells, interpolated linearly."""
    fine = field
    for axis in range(3):
        front = np.moveaxis(fine, axis, 0)
        between = np.empty((2 * len(front) - 1, *front.shape[1:]), np.float32)
        between[::2], between[1::2] = front, (front[1:] + front[:-1]) / 2
        fine = np.moveaxis(between, 0, axis)
    return np.ascontiguousarray(fine)


def _without_specks(field: np.ndarray) -> np.ndarray:
    """The field, made negative in connected positive pieces under LEAST_PIECE."""
    pieces, _ = label(field > 0)
    sizes = np.bincount(pieces.ravel())
    sizes[0] = 0
    specks = np.append(True, sizes[1:] < LEAST_PIECE * sizes.max())
    return np.where(specks[pieces], -np.abs(field), field)


def _meshed(field: np.ndarray, lo: np.ndarray, cell: float) -> Mesh:
    """Surface where a field on a grid from lo [3] is 0, without specks."""
    from skimage.measure import marching_cubes

    solid = np.pad(_without_specks(field), 1, constant_values=-cell)
    vertices, faces, _, _ = marching_cubes(solid, 0.0, gradient_direction="ascent")
    vertices = lo + cell * (vertices.astype(np.float64) - 1)
    return Mesh(vertices, faces.astype(np.int64), np.ones(len(faces), bool))


def _fit(views: Sequence[_View], mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Share of the mask of each view that the mesh fills, and intersection over union of the two;
    NaN for an empty mask."""
    from mgs.data.raycast import mesh_depth  # imported here because it loads Mitsuba

    depth, shares = mesh_depth(mesh), list[tuple[float, float]]()
    for view in views:
        report("comparing the hull with masks", len(shares), len(views))
        mask, outline = view.distance > 0, depth(view.camera) > 0
        both = (mask & outline).sum()
        areas = mask.sum(), (mask | outline).sum()
        shares.append((both / areas[0], both / areas[1]) if areas[0] else (np.nan, np.nan))
    filled, overlap = np.array(shares).T
    return filled, overlap
