"""Consistency checks of a dataset."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_erosion, minimum_filter

from mgs.data.dataset import Dataset
from mgs.data.frames import Frame, frame_blur, has_masks, in_image
from mgs.errors import InputError
from mgs.metrics import MOST_BLUR
from mgs.progress import report

TOLERANCE = 0.02  # relative excess of depth beyond which a frame sees through a point of the rock
# Measured on rendered rocks: 0 in sound datasets, 0.07 to 0.3 with all depths 10 % too large.
MAX_SEEN_THROUGH = 0.05  # largest share of points seen through, median over neighbouring frames


@dataclass(frozen=True)
class Check:
    """Result of `check_dataset`."""

    problems: list[str]  # one line each, with the frame or file and the cure
    mask_share: float  # mean share of rock pixels
    depth_range: tuple[float, float]  # of the rock, metres; zeros without depth
    seen_through: float  # median of `seen_through` over neighbours; NaN without depth


def taken_frames(dataset: Dataset) -> list[Frame]:
    """Frames whose files should exist: all, except on-demand ones that no run has taken."""
    return [
        frame
        for frame in dataset.frames
        if not frame.on_demand or (frame.mask_path is not None and frame.mask_path.exists())
    ]


def check_dataset(dataset: Dataset) -> Check:
    """Read every pixel of the `taken_frames` and list all problems."""
    problems: list[str] = []
    shares, ranges, through = [], [], []
    poses: dict[bytes, str] = {}
    blurs: dict[str, float] = {}
    before: tuple[Frame, np.ndarray, np.ndarray] | None = None
    frames = taken_frames(dataset)
    for index, frame in enumerate(frames):
        try:
            mask = frame.mask()
            if not frame.on_demand or frame.image_path.exists():  # a survey has no images
                blurs[frame.name] = frame_blur(frame, mask)
            shares.append(mask.mean())
            problems.extend(_mask_problems(frame, mask))
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
                        f"frame {frame.name}: negative depth inside the mask; "
                        "depth must be metres, 0 = no return"
                    )
                elif (on_rock > 0).mean() < 0.5:
                    problems.append(
                        f"frame {frame.name}: most of the mask has no depth; restore the depth file"
                    )
                else:
                    ranges.append((on_rock[on_rock > 0].min(), on_rock.max()))
                    if before is not None:
                        through.append(seen_through(*before, frame, depth))
                    before = frame, depth, mask
        except InputError as error:
            problems.append(str(error))
        report("reading", index + 1, len(frames))
    common = [share for share in through if np.isfinite(share)]
    median = float(np.median(common)) if common else float("nan")
    if through and not median <= MAX_SEEN_THROUGH:
        what = f"see through {median:.0%} of each other's rock"
        problems.append(
            f"neighbouring frames {what if common else 'share no point of the rock'}: "
            "poses, intrinsics or depth follow another convention; "
            "poses must be OpenGL camera-to-world, depth z-depth in metres"
        )
    problems.extend(blur_problems(blurs))
    problems.extend(_test_problems(dataset))
    low, high = (min(r[0] for r in ranges), max(r[1] for r in ranges)) if ranges else (0.0, 0.0)
    share = float(np.mean(shares)) if shares else 0.0
    return Check(problems, share, (float(low), float(high)), median)


def blur_problems(blurs: Mapping[str, float]) -> Iterator[str]:
    """Yield a line for each image that is blurred, or one for all. blurs: `frame_blur` by name."""
    median = float(np.median(list(blurs.values()))) if blurs else 0.0
    if median > MOST_BLUR:
        yield (
            f"the images are blurred, by {median:.1f} pixels in the median; take them again, "
            "sharp, or import them smaller (`--downscale`), by which they lose little"
        )
        return
    for name, value in blurs.items():
        if value > MOST_BLUR:
            yield (
                f"frame {name}: is blurred, by {value:.1f} pixels (median {median:.1f}); take it "
                f"again, or leave it out (`mgs import --exclude {name}`)"
            )


def _test_problems(dataset: Dataset) -> Iterator[str]:
    tests = dataset.test_views()
    if tests is not None and has_masks(dataset.frames) and not has_masks(tests.frames):
        yield (
            f"{tests.root}: the test views have no masks as the frames have, so their background "
            f"would count as the object; make masks with `mgs dataset masks {tests.root} --prior "
            f"{dataset.root / 'prior'}`, or import again with --masks"
        )


def _mask_problems(frame: Frame, mask: np.ndarray) -> Iterator[str]:
    """Problems of a mask [H,W]: empty, or in contradiction to the rock image. The mask is about
    pixel centres. So alpha = 0 contradicts a true pixel and alpha = 1 a false one; any value
    between agrees with both."""
    if not mask.any():
        yield (
            f"frame {frame.name}: the mask is empty; aim the camera at the rock or remove the frame"
        )
    if frame.rock_path is None:
        return
    alpha = frame.target()[0][..., 3]
    count = int((mask & (alpha == 0) | ~mask & (alpha == 1)).sum())
    if count:
        yield (
            f"{frame.rock_path}: contradicts the mask in {count} pixels; "
            "make both from the same source"
        )


def seen_through(
    frame: Frame, depth: np.ndarray, mask: np.ndarray, other: Frame, other_depth: np.ndarray
) -> float:
    """Share of the rock points of `frame` where `other` measures a larger depth; NaN if it has none
    of them in view.

    depth, other_depth: [H,W] z-depth, metres. mask: [H,W] bool, the rock in `frame`. Other things
    can hide a point of the rock, but nothing can be measured behind it. So the share is near 0 for
    right poses and depths. To allow for large pixels, depth is the least of 3x3 pixels, and pixels
    at the outline do not count."""
    inner = binary_erosion(mask, np.ones((3, 3)), border_value=1)  # outlines mix two depths
    points = frame.camera.unproject(depth)[(inner if inner.any() else mask) & (depth > 0)]
    pixels, z = other.camera.project(points)
    inside = in_image(other.camera, pixels, z)
    columns, rows = np.floor(pixels[inside]).astype(int).T
    nearest = minimum_filter(np.where(other_depth > 0, other_depth, np.inf), 3)
    surface = np.where(other_depth > 0, nearest, 0)[rows, columns]
    through = (surface > z[inside] * (1 + TOLERANCE))[surface > 0]
    return float(through.mean()) if len(through) else float("nan")
