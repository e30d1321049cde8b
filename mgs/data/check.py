"""Checks of a dataset: that every file can be read, and that colour, depth, masks and poses agree
with one another."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mgs.data.dataset import Dataset, Frame
from mgs.errors import InputError

TOLERANCE = 0.02
"""A point of the rock counts as seen through by a frame whose depth in that place is greater than
the point's own by more than this share of it."""

MAX_SEEN_THROUGH = 0.08
"""Largest share of points that may be seen through (median over pairs of neighbouring frames).
Measured on a sphere: 0.01 to
0.03 in sound datasets, because of the pixels at the outline, and 0.1 to 0.2 where all depths are 10
% too large."""


@dataclass(frozen=True)
class Check:
    """What a check found.

    problems: one line each, which names the frame or file and the cure. mask_share: mean share of
    the pixels that are rock.
    depth_range: smallest and largest depth of the rock, metres; zeros without depth. seen_through:
    median of the function `seen_through` over pairs of neighbouring frames; NaN without depth.
    """

    problems: list[str]
    mask_share: float
    depth_range: tuple[float, float]
    seen_through: float


def there(dataset: Dataset) -> list[Frame]:
    """The frames of a dataset, without those on demand that nobody has taken."""
    return [
        frame
        for frame in dataset.frames
        if not frame.on_demand or (frame.mask_path is not None and frame.mask_path.exists())
    ]


def check_dataset(
    dataset: Dataset, progress: Callable[[int, int], None] = lambda done, total: None
) -> Check:
    """Read every pixel of the frames that are `there` in a dataset, and list all that is wrong with
    it.

    progress: called as progress(frames done, all frames).
    """
    problems: list[str] = []
    shares, ranges, shares_through = [], [], []
    poses: dict[bytes, str] = {}
    before: tuple[Frame, np.ndarray, np.ndarray] | None = None
    frames = there(dataset)
    for index, frame in enumerate(frames):
        try:
            if not frame.on_demand or frame.image_path.exists():  # a survey has no images
                frame.rgb()
            mask = frame.mask()
            shares.append(mask.mean())
            if not mask.any():
                problems.append(
                    f"frame {frame.name}: the mask is empty; aim the camera at the rock or remove the frame"
                )
            if frame.rock_path is not None and (
                contrary := _contrary(frame.target()[0][..., 3], mask)
            ):
                problems.append(
                    f"{frame.rock_path}: contradicts the mask in {contrary} pixels; make both from the same source"
                )
            pose = frame.camera.world_to_camera.round(9).tobytes()
            if poses.setdefault(pose, frame.name) != frame.name:
                problems.append(
                    f"frame {frame.name}: has the same pose as {poses[pose]}; remove one of them"
                )
            if frame.depth_path is not None and mask.any():
                depth = frame.depth()
                on_rock = depth[mask]
                if (on_rock < 0).any():
                    problems.append(
                        f"frame {frame.name}: negative depth inside the mask; depth must be metres, 0 = no return"
                    )
                elif (on_rock > 0).mean() < 0.5:
                    problems.append(
                        f"frame {frame.name}: most of the mask has no depth; restore the depth file"
                    )
                else:
                    ranges.append((on_rock[on_rock > 0].min(), on_rock.max()))
                    if before is not None:
                        shares_through.append(seen_through(*before, frame, depth))
                    before = frame, depth, mask
        except InputError as error:
            problems.append(str(error))
        progress(index + 1, len(frames))
    common = [share for share in shares_through if np.isfinite(share)]
    through = float(np.median(common)) if common else float("nan")
    if shares_through and not through <= MAX_SEEN_THROUGH:
        found = (
            f"see through {through:.0%} of each other's rock"
            if common
            else "share no point of the rock"
        )
        problems.append(
            f"neighbouring frames {found}: poses, intrinsics or depth follow another convention; poses must be OpenGL "
            "camera-to-world, depth z-depth in metres"
        )
    low, high = (min(r[0] for r in ranges), max(r[1] for r in ranges)) if ranges else (0.0, 0.0)
    return Check(
        problems, float(np.mean(shares)) if shares else 0.0, (float(low), float(high)), through
    )


def _contrary(alpha: np.ndarray, mask: np.ndarray) -> int:
    """Number of pixels in which a mask [H,W] and an alpha [H,W] contradict each other.

    The mask says whether the rock is seen in the centre of the pixel. So it is contradicted by an
    alpha of 0 where it is true, and by an alpha of 1 where it is false; any alpha between agrees
    with both.
    """
    return int((mask & (alpha == 0) | ~mask & (alpha == 1)).sum())


def seen_through(
    frame: Frame, depth: np.ndarray, mask: np.ndarray, other: Frame, other_depth: np.ndarray
) -> float:
    """The share of the rock's points in `frame` that `other` contradicts, because it sees something
    behind them in their place.

    Something in front of a point may hide it from `other`, but nothing lets it see through the
    point; so this share is near 0 where poses and depths are right, however far apart the two
    frames are. NaN where no point is in view of `other`.
    depth, other_depth: [H,W] z-depth, metres; mask: [H,W] bool, the rock in `frame`.
    """
    points = frame.camera.unproject(depth)[mask & (depth > 0)]
    pixels, z = other.camera.project(points)
    columns, rows = np.floor(pixels).astype(int).T
    inside = (
        (z > 0)
        & (columns >= 0)
        & (columns < other.camera.width)
        & (rows >= 0)
        & (rows < other.camera.height)
    )
    seen = other_depth[rows[inside], columns[inside]]
    through = (seen > z[inside] * (1 + TOLERANCE))[seen > 0]
    return float(through.mean()) if len(through) else float("nan")
