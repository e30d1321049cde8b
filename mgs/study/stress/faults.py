"""Faults of the data and of the prior, one pure function each; what they cost, and which signs tell
of them.

A run counts as failed if its PSNR on the test views, which no fault touches, is more than FAILURE
dB below that of the clean run on the same rock and views.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion, gaussian_filter, shift
from scipy.spatial.transform import Rotation

from mgs.camera import Camera
from mgs.colour import linear_from_srgb, srgb_from_linear
from mgs.data.dataset import Frame, target_of
from mgs.fit.settings import PASSES
from mgs.policy.criteria import coverage
from mgs.prior.build import Prior
from mgs.run import detectors
from mgs.seeds import generator
from mgs.splat import render
from mgs.study.stress.experiment import turns
from mgs.study.stress.lab import Lab, Preset, open_lab
from mgs.study.stress.verdict import Row
from mgs.study.sweep import Cell

FAILURE = 1.0
"""dB."""

VIEWS = 6


@dataclass(frozen=True)
class Captured(Frame):
    """A frame whose pixels are in memory, so that they can be spoiled. pixels: linear RGB [H,W,3];
    rgba: the rock alone, premultiplied [H,W,4]; z: depth [H,W], metres; rock: its mask [H,W]."""

    pixels: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 3)))
    rgba: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 4)))
    z: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    rock: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), bool))

    def rgb(self) -> np.ndarray:
        """As `Frame.rgb`."""
        return self.pixels

    def depth(self) -> np.ndarray:
        """As `Frame.depth`."""
        return self.z

    def mask(self) -> np.ndarray:
        """As `Frame.mask`."""
        return self.rock

    def target(self) -> tuple[np.ndarray, np.ndarray]:
        """As `Frame.target`."""
        return self.rgba, np.ones(self.rgba.shape[:2], np.float32)


def captured(frame: Frame) -> Captured:
    """A frame of a dataset with its pixels read."""
    own = {name: getattr(frame, name) for name in Frame.__dataclass_fields__}
    return Captured(
        **own, pixels=frame.rgb(), rgba=frame.target()[0], z=frame.depth(), rock=frame.mask()
    )


ImageFault = Callable[[Captured, float, np.random.Generator], Captured]
"""(frame, size of the fault, generator) -> the frame, spoiled."""

PriorFault = Callable[[Prior, float, np.random.Generator], Prior]


def _colours(frame: Captured, change: Callable[[np.ndarray], np.ndarray]) -> Captured:
    """The same change of linear colour in the image and in the image of the rock alone."""
    alpha = frame.rgba[..., 3:]
    rock = np.clip(change(frame.rgba[..., :3]), 0, None) * (alpha > 0)
    rgba = np.concatenate([rock, alpha], axis=-1, dtype=np.float32)
    return replace(
        frame, pixels=np.clip(change(frame.pixels), 0, None).astype(np.float32), rgba=rgba
    )


def pose_noise(frame: Captured, size: float, rng: np.random.Generator) -> Captured:
    """size: degrees about each axis of the camera; its position is off by as much as keeps the rock
    in sight, 1 cm a degree."""
    pose = frame.camera.world_to_camera.copy()
    turn = Rotation.from_rotvec(np.deg2rad(size) * rng.normal(size=3)).as_matrix()
    pose[:3] = turn @ pose[:3]
    pose[:3, 3] += 0.01 * size * rng.normal(size=3)
    return replace(
        frame, camera=Camera(frame.camera.K, frame.camera.width, frame.camera.height, pose)
    )


def image_noise(frame: Captured, size: float, rng: np.random.Generator) -> Captured:
    """size: standard deviation of noise on sRGB values."""
    noise = rng.normal(0, size, frame.pixels.shape)
    return _colours(
        frame,
        lambda rgb: linear_from_srgb(np.clip(srgb_from_linear(np.clip(rgb, 0, 1)) + noise, 0, 1)),
    )


def exposure(frame: Captured, size: float, rng: np.random.Generator) -> Captured:
    """size: standard deviation of the exposure in stops."""
    factor = 2.0 ** rng.normal(0, size)
    return _colours(frame, lambda rgb: np.minimum(rgb * factor, 1))


def motion_blur(frame: Captured, size: float, rng: np.random.Generator) -> Captured:
    """size: length of the motion, pixels, in a random direction."""
    angle = rng.uniform(0, 2 * np.pi)
    offsets = np.linspace(-size / 2, size / 2, 2 * int(size) + 1)
    steps = [(t * np.sin(angle), t * np.cos(angle), 0) for t in offsets]
    moved = np.mean([shift(frame.rgba, step, order=1, mode="nearest") for step in steps], axis=0)
    pixels = np.mean([shift(frame.pixels, step, order=1, mode="nearest") for step in steps], axis=0)
    return replace(
        frame,
        pixels=pixels.astype(np.float32),
        rgba=moved.astype(np.float32),
        rock=moved[..., 3] >= 0.5,
    )


def defocus(frame: Captured, size: float, rng: np.random.Generator) -> Captured:
    """size: standard deviation of the blur, pixels."""
    rgba = gaussian_filter(frame.rgba, (size, size, 0)).astype(np.float32)
    return replace(
        frame,
        pixels=gaussian_filter(frame.pixels, (size, size, 0)),
        rgba=rgba,
        rock=rgba[..., 3] >= 0.5,
    )


def missing_depth(frame: Captured, size: float, rng: np.random.Generator) -> Captured:
    """size: share of the pixels without a return, in patches. The prior was built before; depth
    colours the Gaussians."""
    patches = gaussian_filter(rng.normal(size=frame.z.shape), 4)
    return replace(
        frame, z=np.where(patches < np.quantile(patches, size), 0, frame.z).astype(np.float32)
    )


def shifted_mask(frame: Captured, size: float, rng: np.random.Generator) -> Captured:
    """size: pixels by which the mask is off, in a random direction; what it cuts out is taken for
    the rock."""
    angle = rng.uniform(0, 2 * np.pi)
    return _masked(
        frame,
        shift(frame.rgba[..., 3], (size * np.sin(angle), size * np.cos(angle)), order=1) >= 0.5,
    )


def wrong_mask(frame: Captured, size: float, rng: np.random.Generator) -> Captured:
    """size: pixels by which the mask is too large, or, in every second frame, too small."""
    grow, count = rng.random() < 0.5, int(size)
    found = (binary_dilation if grow else binary_erosion)(frame.rock, iterations=count)
    return _masked(frame, found)


def _masked(frame: Captured, mask: np.ndarray) -> Captured:
    """The frame with the rock cut out of its image by another mask."""
    alpha = mask.astype(np.float32)[..., None]
    return replace(
        frame,
        rock=mask,
        rgba=np.concatenate([frame.pixels * alpha, alpha], axis=-1, dtype=np.float32),
    )


IMAGE_FAULTS: dict[str, tuple[ImageFault, tuple[float, ...]]] = {
    "pose noise": (pose_noise, (0.25, 1.0, 4.0)),  # degrees
    "image noise": (image_noise, (0.02, 0.1, 0.3)),  # of sRGB range
    "exposure": (exposure, (0.1, 0.3, 1.0)),  # stops
    "motion blur": (motion_blur, (2.0, 5.0, 12.0)),  # pixels
    "defocus": (defocus, (0.5, 1.5, 4.0)),  # pixels
    "missing depth": (missing_depth, (0.2, 0.6, 0.95)),  # of pixels
    "shifted mask": (shifted_mask, (1.0, 4.0, 10.0)),  # pixels
    "wrong mask": (wrong_mask, (1.0, 3.0, 8.0)),  # pixels
}
"""By name: the fault, and its sizes from small to large."""


def _of_points(prior: Prior, points: np.ndarray, normals: np.ndarray | None = None) -> Prior:
    return replace(prior, points=points, normals=prior.normals if normals is None else normals)


def noisy_prior(prior: Prior, size: float, rng: np.random.Generator) -> Prior:
    """size: standard deviation of noise along the normals, spacings."""
    off = size * prior.spacing * rng.normal(size=(len(prior.points), 1))
    return _of_points(prior, prior.points + off * prior.normals)


def smoothed_prior(prior: Prior, size: float, rng: np.random.Generator) -> Prior:
    """size: how many times each point moves to the mean of its 32 nearest, as an over-smoothed
    Poisson mesh would lie."""
    from scipy.spatial import cKDTree

    points = prior.points
    near = cKDTree(points).query(points, k=min(32, len(points)))[1]
    for _ in range(int(size)):
        points = points[near].mean(axis=1)
    return _of_points(prior, points)


def holes(prior: Prior, size: float, rng: np.random.Generator) -> Prior:
    """size: share of the surface that is missing, around one random point. The Gaussians that are
    left stay as they are."""
    n = len(prior.points)
    away = np.linalg.norm(prior.points - prior.points[rng.integers(n)], axis=1)
    kept = away > np.quantile(away, size)
    backed = int(kept[: prior.backed].sum())
    return replace(prior, points=prior.points[kept], normals=prior.normals[kept], backed=backed)


def shifted(prior: Prior, size: float, rng: np.random.Generator) -> Prior:
    """size: metres, in a random horizontal direction."""
    angle = rng.uniform(0, 2 * np.pi)
    return _of_points(prior, prior.points + size * np.array([np.cos(angle), np.sin(angle), 0]))


def scaled(prior: Prior, size: float, rng: np.random.Generator) -> Prior:
    """size: factor about the centre."""
    centre = prior.points.mean(0)
    return _of_points(prior, centre + size * (prior.points - centre))


def turned(prior: Prior, size: float, rng: np.random.Generator) -> Prior:
    """size: degrees about the vertical through the centre."""
    centre, turn = prior.points.mean(0), Rotation.from_euler("z", size, degrees=True).as_matrix()
    return _of_points(prior, centre + (prior.points - centre) @ turn.T, prior.normals @ turn.T)


PRIOR_FAULTS: dict[str, tuple[PriorFault, tuple[float, ...]]] = {
    "noisy prior": (noisy_prior, (0.5, 2.0, 6.0)),  # spacings
    "smoothed prior": (smoothed_prior, (2.0, 10.0, 40.0)),  # rounds
    "holes": (holes, (0.05, 0.2, 0.5)),  # of the surface
    "shifted prior": (shifted, (0.02, 0.1, 0.4)),  # m
    "scaled prior": (scaled, (1.02, 1.1, 1.4)),  # times
    "turned prior": (turned, (3.0, 15.0, 90.0)),  # degrees
}
"""By name, as IMAGE_FAULTS."""

SHORT_FITS = (1, 2, 5)
"""Passes of fits that are stopped too early, as a fault of their own."""

FREE_VIEWS, FREE_PASSES = (2, 4), 40
"""Views and passes of fits whose means are free and held by no prior, as another."""

ONE_POSE = (1.0, 4.0)
"""Degrees of `pose_noise` in a single view."""


def signs_of(
    lab: Lab, taken: Sequence[int], passes: int = PASSES, means: str = "frozen"
) -> tuple[Any, dict[str, float]]:
    """A fit, and the signs that the loop would have of it after its first step."""
    start = lab.start(taken)
    found = lab.fit(taken, passes, means, with_prior=means == "frozen", start=start)
    lam, views = lab.lam(), []
    surface = np.sum(lab.information(start, taken), axis=0)[: len(lab.prior.points)]
    for frame in (lab.frames[i] for i in taken):
        old, new = (
            render(model, frame.camera, cache=lab.cache) for model in (start, found.gaussians)
        )
        target, mask, margin = (
            target_of(frame),
            frame.mask(),
            detectors.outline_margin(start, frame.camera),
        )
        before = detectors.before_fit(
            target, mask, np.asarray(old.rgb), np.asarray(old.alpha), margin
        )
        views.append(detectors.view_signs(target, mask, np.asarray(new.rgb), before))
    drift = detectors.means_drift(found.gaussians.means, start.means, start.log_scales)
    return found.gaussians, detectors.step_signs(
        views, found.losses, coverage(surface, lam), [], drift
    )


def _row(
    lab: Lab, run: str, fault: str, size: float, clean: Mapping[str, Any] | None, *arguments: Any
) -> Row:
    model, signs = signs_of(lab, *arguments)
    quality = lab.quality(model)
    reference = quality["psnr"] if clean is None else clean["psnr"]
    lost = reference - quality["psnr"]
    named = {
        "run": run,
        "scene": run.split(",")[0],
        "fault": fault,
        "size": size,
        "label": f"{fault} {size:g}",
    }
    return (
        named
        | quality
        | {"lost": lost, "failed": bool(lost > FAILURE)}
        | {f"sign {name}": value for name, value in signs.items()}
    )


def faults(
    root: Path, out: Path, scene: str, kinds: str, others: list[str], repeats: int
) -> dict[str, Any]:
    """Fits to evenly spread views with every fault of a kind ("images" or "prior") at every size,
    beside clean ones.

    others: rocks whose priors are tried in the place of the right one. repeats: draws of faults,
    each with views of its own.
    """
    opened, rows = open_lab(root, scene), []
    lab = opened.changed(frames=tuple(captured(frame) for frame in opened.frames))
    table: Mapping[str, Any] = IMAGE_FAULTS if kinds == "images" else PRIOR_FAULTS
    for run, turn in turns(repeats):
        named, taken = f"{scene}, {run}", lab.even(VIEWS, turn)
        clean = _row(lab, named, "none", VIEWS, None, taken)
        rows.append(clean)
        for fault, (function, sizes) in table.items():
            for size in sizes:
                rng = generator(0, f"stress/{named}/{fault}/{size}")
                rows.append(
                    _row(
                        _spoiled(lab, taken, kinds, function, size, rng),
                        named,
                        fault,
                        size,
                        clean,
                        taken,
                    )
                )
        if kinds == "images":
            rows += _fit_faults(lab, named, taken, turn, clean)
        else:
            wrong = {
                k: lab.changed(prior=open_lab(root, name).prior) for k, name in enumerate(others)
            }
            rows += [_row(wrong[k], named, "another rock's prior", k, clean, taken) for k in wrong]
    return {"rows": rows}


def _spoiled(
    lab: Lab, taken: Sequence[int], kinds: str, function: Any, size: float, rng: np.random.Generator
) -> Lab:
    """The lab with the fault: in the frames that are fitted, or in the prior."""
    if kinds == "prior":
        return lab.changed(prior=function(lab.prior, size, rng))
    return lab.changed(
        frames=tuple(function(f, size, rng) if i in taken else f for i, f in enumerate(lab.frames))
    )


def _fit_faults(lab: Lab, run: str, taken: Sequence[int], turn: float, clean: Row) -> list[Row]:
    """Fits of too few passes, fits with free means on few views, with their own clean runs, and one
    view with a wrong pose."""
    rows = [_row(lab, run, "few passes", passes, clean, taken, passes) for passes in SHORT_FITS]
    for count in FREE_VIEWS:
        few = lab.even(count, turn)
        frozen = _row(lab, run, "none", count, None, few)
        rows += [frozen, _row(lab, run, "free means", count, frozen, few, FREE_PASSES, "free")]
    for size in ONE_POSE:
        rng = generator(0, f"stress/{run}/one bad pose/{size}")
        rows.append(
            _row(
                _spoiled(lab, taken[:1], "images", pose_noise, size, rng),
                run,
                "one bad pose",
                size,
                clean,
                taken,
            )
        )
    return rows


def fault_cells(preset: Preset, kinds: str) -> list[Cell]:
    """A cell for each rock of the preset, the others too."""
    rocks = [f"{scene}-{seed}" for scene, seed in (*preset.rocks, *preset.others)]
    needs = tuple(f"dataset/{rock}" for rock in rocks)
    cells = []
    for k, rock in enumerate(rocks):
        others = [rocks[(k + 1) % len(rocks)], rocks[(k + 2) % len(rocks)]]
        arguments = {"scene": rock, "kinds": kinds, "others": others, "repeats": preset.repeats}
        cells.append(Cell(f"faults-{kinds}/{rock}", f"{__name__}:faults", arguments, needs))
    return cells
