"""Faults of images and of priors, what they cost, and whether the detectors of a run report them.

A run has failed if its PSNR on the test views, which no fault touches, is more than FAILURE below
that of the clean run on the same rock and views.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion, gaussian_filter, shift
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mgs.colour import linear_from_srgb, srgb_from_linear
from mgs.data.dataset import target_of
from mgs.data.frames import Frame
from mgs.fit.settings import PASSES
from mgs.gaussians import Gaussians
from mgs.policy.criteria import MEAN_STD, coverage
from mgs.prior.build import Prior
from mgs.run import detectors
from mgs.run.detectors import DETECTORS
from mgs.seeds import generator
from mgs.splat import render
from studies.output import Panel
from studies.stress.fits import FREE_PASSES
from studies.stress.lab import Experiment, Lab, StressSize, open_lab, rock_cell, turns
from studies.sweep import Cell
from studies.verdict import Claim, Row, single

FAILURE = 1.0
"""Loss of PSNR, dB, above which a run has failed."""

VIEWS = 6


@dataclass(frozen=True, kw_only=True)
class Captured(Frame):
    """A frame with its pixels in memory. pixels: linear RGB [H,W,3]; rgba: the rock alone,
    premultiplied [H,W,4]; z: depth [H,W], metres; rock: mask [H,W]."""

    pixels: np.ndarray
    rgba: np.ndarray
    z: np.ndarray
    rock: np.ndarray

    def rgb(self) -> np.ndarray:
        """Linear RGB [H,W,3]."""
        return self.pixels

    def depth(self) -> np.ndarray:
        """Depth [H,W], metres."""
        return self.z

    def mask(self) -> np.ndarray:
        """Mask of the rock [H,W]."""
        return self.rock

    def target(self) -> tuple[np.ndarray, np.ndarray]:
        """Image of the rock alone [H,W,4], and weights of the pixels [H,W]."""
        return self.rgba, np.ones(self.rgba.shape[:2], np.float32)


def captured(frame: Frame) -> Captured:
    """A frame of a dataset with its pixels read."""
    rgba, _ = frame.target()
    return Captured(
        **vars(frame), pixels=frame.rgb(), rgba=rgba, z=frame.depth(), rock=frame.mask()
    )


class Fault(NamedTuple):
    """Fault of images or of priors.

    change: function (frame or prior, size, generator) that returns it spoiled. sizes: from small to
    large. words: format of a size with its unit.
    """

    change: Callable[[Any, float, np.random.Generator], Any]
    sizes: tuple[float, ...]
    words: str


def _colours(frame: Captured, change: Callable[[np.ndarray], np.ndarray]) -> Captured:
    """Change linear colours in the image and in the image of the rock alone."""
    alpha = frame.rgba[..., 3:]
    rock = np.clip(change(frame.rgba[..., :3]), 0, None) * (alpha > 0)
    rgba = np.concatenate([rock, alpha], axis=-1, dtype=np.float32)
    pixels = np.clip(change(frame.pixels), 0, None).astype(np.float32)
    return replace(frame, pixels=pixels, rgba=rgba)


def pose_noise(frame: Captured, size: float, rng: np.random.Generator) -> Captured:
    """Pose error. size: degrees about each axis of the camera, and centimetres."""
    pose = frame.camera.world_to_camera.copy()
    turn = Rotation.from_rotvec(np.deg2rad(size) * rng.normal(size=3)).as_matrix()
    pose[:3] = turn @ pose[:3]
    pose[:3, 3] += 0.01 * size * rng.normal(size=3)
    return replace(frame, camera=replace(frame.camera, world_to_camera=pose))


def image_noise(frame: Captured, size: float, rng: np.random.Generator) -> Captured:
    """Noise of sRGB values. size: standard deviation."""
    noise = rng.normal(0, size, frame.pixels.shape)

    def change(rgb: np.ndarray) -> np.ndarray:
        return linear_from_srgb(np.clip(srgb_from_linear(np.clip(rgb, 0, 1)) + noise, 0, 1))

    return _colours(frame, change)


def exposure(frame: Captured, size: float, rng: np.random.Generator) -> Captured:
    """Varying exposure. size: standard deviation in stops."""
    factor = 2.0 ** rng.normal(0, size)
    return _colours(frame, lambda rgb: np.minimum(rgb * factor, 1))


def motion_blur(frame: Captured, size: float, rng: np.random.Generator) -> Captured:
    """Motion in a random direction. size: length in pixels."""
    angle = rng.uniform(0, 2 * np.pi)
    offsets = np.linspace(-size / 2, size / 2, 2 * int(size) + 1)
    steps = [(t * np.sin(angle), t * np.cos(angle), 0) for t in offsets]
    rgba, pixels = (
        np.mean([shift(one, step, order=1, mode="nearest") for step in steps], axis=0)
        for one in (frame.rgba, frame.pixels)
    )
    return _blurred(frame, pixels, rgba)


def defocus(frame: Captured, size: float, rng: np.random.Generator) -> Captured:
    """Blur. size: standard deviation in pixels."""
    pixels, rgba = (gaussian_filter(one, (size, size, 0)) for one in (frame.pixels, frame.rgba))
    return _blurred(frame, pixels, rgba)


def _blurred(frame: Captured, pixels: np.ndarray, rgba: np.ndarray) -> Captured:
    rock = rgba[..., 3] >= 0.5
    pixels, rgba = pixels.astype(np.float32), rgba.astype(np.float32)
    return replace(frame, pixels=pixels, rgba=rgba, rock=rock)


def missing_depth(frame: Captured, size: float, rng: np.random.Generator) -> Captured:
    """Depth missing in patches; the prior was built before. size: share of the pixels."""
    patches = gaussian_filter(rng.normal(size=frame.z.shape), 4)
    z = np.where(patches < np.quantile(patches, size), 0, frame.z).astype(np.float32)
    return replace(frame, z=z)


def shifted_mask(frame: Captured, size: float, rng: np.random.Generator) -> Captured:
    """Mask moved in a random direction. size: pixels."""
    angle = rng.uniform(0, 2 * np.pi)
    offset = (size * np.sin(angle), size * np.cos(angle))
    return _masked(frame, shift(frame.rgba[..., 3], offset, order=1) >= 0.5)


def wrong_mask(frame: Captured, size: float, rng: np.random.Generator) -> Captured:
    """Mask too large, or, in every second frame, too small. size: pixels."""
    change = binary_dilation if rng.random() < 0.5 else binary_erosion
    return _masked(frame, change(frame.rock, iterations=int(size)))


def _masked(frame: Captured, mask: np.ndarray) -> Captured:
    """The rock cut out of the image by another mask."""
    alpha = mask.astype(np.float32)[..., None]
    rgba = np.concatenate([frame.pixels * alpha, alpha], axis=-1, dtype=np.float32)
    return replace(frame, rock=mask, rgba=rgba)


IMAGE_FAULTS: dict[str, Fault] = {
    "pose noise": Fault(pose_noise, (0.25, 1.0, 4.0), "{:g}° and cm"),
    "image noise": Fault(image_noise, (0.02, 0.1, 0.3), "{:g} of the range"),
    "exposure": Fault(exposure, (0.1, 0.3, 1.0), "{:g} stops"),
    "motion blur": Fault(motion_blur, (2.0, 5.0, 12.0), "{:g} px"),
    "defocus": Fault(defocus, (0.5, 1.5, 4.0), "{:g} px"),
    "missing depth": Fault(missing_depth, (0.2, 0.6, 0.95), "{:.0%}"),
    "shifted mask": Fault(shifted_mask, (1.0, 4.0, 10.0), "{:g} px"),
    "wrong mask": Fault(wrong_mask, (1.0, 3.0, 8.0), "{:g} px"),
}
"""Faults by name."""


def noisy_prior(prior: Prior, size: float, rng: np.random.Generator) -> Prior:
    """Noise along the normals. size: standard deviation in spacings."""
    off = size * prior.spacing * rng.normal(size=(len(prior.points), 1))
    return replace(prior, points=prior.points + off * prior.normals)


def smoothed_prior(prior: Prior, size: float, rng: np.random.Generator) -> Prior:
    """Over-smoothed surface. size: how many times a point moves to the mean of its 32 nearest."""
    points = prior.points
    near = cKDTree(points).query(points, k=min(32, len(points)))[1]
    for _ in range(int(size)):
        points = points[near].mean(axis=1)
    return replace(prior, points=points)


def holes(prior: Prior, size: float, rng: np.random.Generator) -> Prior:
    """Surface missing around a random point. size: share of the surface."""
    n = len(prior.points)
    away = np.linalg.norm(prior.points - prior.points[rng.integers(n)], axis=1)
    kept = away > np.quantile(away, size)
    backed = int(kept[: prior.backed].sum())
    return replace(prior, points=prior.points[kept], normals=prior.normals[kept], backed=backed)


def shifted(prior: Prior, size: float, rng: np.random.Generator) -> Prior:
    """Prior moved in a random horizontal direction. size: metres."""
    angle = rng.uniform(0, 2 * np.pi)
    offset = size * np.array([np.cos(angle), np.sin(angle), 0])
    return replace(prior, points=prior.points + offset)


def scaled(prior: Prior, size: float, rng: np.random.Generator) -> Prior:
    """Prior scaled about its centre. size: factor."""
    centre = prior.points.mean(0)
    return replace(prior, points=centre + size * (prior.points - centre))


def turned(prior: Prior, size: float, rng: np.random.Generator) -> Prior:
    """Prior turned about the vertical through its centre. size: degrees."""
    centre, turn = prior.points.mean(0), Rotation.from_euler("z", size, degrees=True).as_matrix()
    points = centre + (prior.points - centre) @ turn.T
    return replace(prior, points=points, normals=prior.normals @ turn.T)


PRIOR_FAULTS: dict[str, Fault] = {
    "noisy prior": Fault(noisy_prior, (0.5, 2.0, 6.0), "{:g} spacings"),
    "smoothed prior": Fault(smoothed_prior, (2.0, 10.0, 40.0), "{:g} times"),
    "holes": Fault(holes, (0.05, 0.2, 0.5), "{:.0%} of the surface"),
    "shifted prior": Fault(shifted, (0.02, 0.1, 0.4), "{:g} m"),
    "scaled prior": Fault(scaled, (1.02, 1.1, 1.4), "factor {:g}"),
    "turned prior": Fault(turned, (3.0, 15.0, 90.0), "{:g}°"),
}
"""Faults by name."""

ANOTHER = "another rock's prior"

SHORT_FITS = (1, 2, 5)
"""Passes of fits that are stopped too early, as a fault."""

FREE_VIEWS = (2, 4)
"""Views of fits whose means are free and held by no prior, as a fault."""

ONE_POSE = (1.0, 4.0)
"""Sizes of `pose_noise` in a single view."""


def indicators_of(
    lab: Lab, taken: Sequence[int], passes: int = PASSES, means: str = "frozen"
) -> tuple[Gaussians, dict[str, float]]:
    """A fit, and the indicators that the loop would compute after its first step."""
    start = lab.start(taken)
    fit = lab.fit(taken, passes, means, with_prior=means == "frozen", start=start)
    surface = np.sum(lab.information(start, taken), axis=0)[: len(lab.prior.points)]
    views = []
    for frame in (lab.frames[i] for i in taken):
        models = (start, fit.gaussians)
        old, new = (render(model, frame.camera, cache=lab.cache) for model in models)
        target, mask = target_of(frame), frame.mask()
        margin = detectors.outline_margin(start, frame.camera)
        before = detectors.before_fit(mask, np.asarray(old.alpha), margin)
        views.append(detectors.view_indicators(target, mask, np.asarray(new.rgb), before))
    std = MEAN_STD * lab.prior.spacing
    drift = detectors.means_drift(fit.gaussians.means, start.means, std)
    seen = coverage(surface, lab.lam())
    positions = np.array([lab.frames[i].camera.position for i in taken])
    return fit.gaussians, detectors.step_indicators(views, positions, fit.losses, seen, [], drift)


SIZES_IN_WORDS = {
    ANOTHER: "draw {:g}",
    **{name: fault.words for name, fault in (IMAGE_FAULTS | PRIOR_FAULTS).items()},
}
"""Formats of sizes with their units; of others, a plain number."""


def label_of(fault: str, size: float) -> str:
    """Name of a fault and its size, with the unit."""
    if fault == "none":
        return "no fault"
    return f"{fault}, {SIZES_IN_WORDS.get(fault, '{:g}').format(size)}"


def _row(lab: Lab, run: str, fault: str, size: float, clean: Row | None, *how: Any) -> Row:
    """Row of one fit. clean: that of the clean run; how: arguments of `indicators_of`."""
    model, indicators = indicators_of(lab, *how)
    row: Row = {"run": run, "scene": run.split(",")[0], "fault": fault, "size": size}
    row |= {"label": label_of(fault, size), **lab.quality(model)}
    lost = (row if clean is None else clean)["psnr"] - row["psnr"]
    row |= {"lost": lost, "failed": bool(lost > FAILURE)}
    return row | {f"sign {name}": value for name, value in indicators.items()}


def faults(
    root: Path,
    out: Path,
    scene: str,
    dataset: str,
    prior: str,
    kinds: str,
    others: list[dict[str, str]],
    repeats: int,
) -> dict[str, Any]:
    """Clean fits to evenly spread views, and fits with every fault of a kind at every size.

    kinds: "images" or "prior". others: datasets and priors of other rocks, whose priors are tried
    in place of the right one. repeats: draws of faults, each with views of its own.
    """
    opened, rows = open_lab(root / dataset, root / prior), []
    lab = opened.changed(frames=tuple(captured(frame) for frame in opened.frames))
    table = IMAGE_FAULTS if kinds == "images" else PRIOR_FAULTS
    for name, turn in turns(repeats):
        run, taken = f"{scene}, {name}", lab.even(VIEWS, turn)
        clean = _row(lab, run, "none", VIEWS, None, taken)
        rows.append(clean)
        for fault, (change, sizes, _) in table.items():
            for size in sizes:
                rng = generator(0, f"stress/{run}/{fault}/{size}")
                spoiled = _spoiled(lab, taken, kinds, change, size, rng)
                rows.append(_row(spoiled, run, fault, size, clean, taken))
        if kinds == "images":
            rows += _fit_faults(lab, run, taken, turn, clean)
            continue
        for k, other in enumerate(others):
            wrong = open_lab(root / other["dataset"], root / other["prior"]).prior
            rows.append(_row(lab.changed(prior=wrong), run, ANOTHER, k, clean, taken))
    return {"rows": rows}


def _spoiled(
    lab: Lab, taken: Sequence[int], kinds: str, change: Any, size: float, rng: np.random.Generator
) -> Lab:
    """The lab with the fault in the frames that are fitted, or in the prior."""
    if kinds == "prior":
        return lab.changed(prior=change(lab.prior, size, rng))
    frames = (change(f, size, rng) if i in taken else f for i, f in enumerate(lab.frames))
    return lab.changed(frames=tuple(frames))


def _fit_faults(lab: Lab, run: str, taken: Sequence[int], turn: float, clean: Row) -> list[Row]:
    """Fits of too few passes, with free means on few views, and with one wrong pose."""
    rows = [_row(lab, run, "few passes", passes, clean, taken, passes) for passes in SHORT_FITS]
    for count in FREE_VIEWS:
        few = lab.even(count, turn)
        frozen = _row(lab, run, "none", count, None, few)
        rows += [frozen, _row(lab, run, "free means", count, frozen, few, FREE_PASSES, "free")]
    for size in ONE_POSE:
        rng = generator(0, f"stress/{run}/one bad pose/{size}")
        spoiled = _spoiled(lab, taken[:1], "images", pose_noise, size, rng)
        rows.append(_row(spoiled, run, "one bad pose", size, clean, taken))
    return rows


def fault_cells(size: StressSize, kinds: str) -> list[Cell]:
    """Cells of a kind of faults on all rocks of a size."""
    rocks, cells = (*size.rocks, *size.others), []
    for k, rock in enumerate(rocks):
        others = [size.case(*rocks[(k + step) % len(rocks)]) for step in (1, 2)]
        more = {"kinds": kinds, "others": [c.folders for c in others], "repeats": size.repeats}
        task = f"{__name__}:faults"
        *made, cell = rock_cell(f"faults-{kinds}", task, size, rock, **more)
        made += [one for case in others for one in case.cells()]
        cells += [*made, replace(cell, needs=tuple(dict.fromkeys(one.name for one in made)))]
    return cells


def _harm(fault: str, size: float, words: str, bound: float = 1.0, harmless: bool = False) -> Claim:
    """Claim that a fault of this size costs the bound or more; harmless: at most the bound."""
    amount = f"at most {bound:g} dB" if harmless else f"{bound:g} dB or more"
    lost = single("lost", {"fault": fault, "size": size})
    hypothesis = f"{words} costs {amount} on the test views."
    return Claim(hypothesis, lost, "dB", "below" if harmless else "above", bound, "rock and draw")


LOST = Panel(
    "label", "lost", "fault and its size", "PSNR lost on test views (dB)",
    title="PSNR that each fault costs",
)  # fmt: skip

DATA_FAULTS = Experiment(
    "Which faults of the images spoil a model?",
    lambda size: fault_cells(size, "images"),
    (
        _harm("pose noise", 1.0, "Pose noise of 1 degree and 1 cm"),
        _harm("image noise", 0.1, "Image noise of a tenth of the range", harmless=True),
        _harm("exposure", 0.3, "Exposure that varies by 0.3 stops"),
        _harm("motion blur", 5.0, "Motion blur of 5 pixels"),
        _harm("defocus", 1.5, "Defocus of 1.5 pixels"),
        _harm("missing depth", 0.6, "Depth missing in 60 % of the pixels (the prior as it was)",
              0.5, harmless=True),
        _harm("shifted mask", 4.0, "A mask that is off by 4 pixels"),
        _harm("wrong mask", 3.0, "A mask that is 3 pixels too large or too small"),
    ),
    (LOST,),
)  # fmt: skip

PRIOR_EXPERIMENT = Experiment(
    "Which faults of the prior spoil a model?",
    lambda size: fault_cells(size, "prior"),
    (
        _harm("noisy prior", 2.0, "Noise of 2 spacings on the prior's points"),
        _harm("smoothed prior", 10.0, "Over-smoothing the prior (10 rounds)", harmless=True),
        _harm("holes", 0.2, "A hole of a fifth of the surface"),
        _harm("shifted prior", 0.1, "A prior that is shifted by 10 cm"),
        _harm("scaled prior", 1.1, "A prior that is 10 % too large"),
        _harm("turned prior", 15.0, "A prior that is turned by 15 degrees"),
        _harm(ANOTHER, 0, "The prior of another rock"),
    ),
    (LOST,),
)


def _alarm(row: Row) -> float:
    """1 where any sign is beyond its limit in `mgs.run.detectors`, else 0."""
    found = ((row.get(f"sign {sign}"), detector.limit) for sign, detector in DETECTORS.items())
    return float(any(value is not None and value > limit for value, limit in found))


def false_alarms(rows: Sequence[Row]) -> list[float]:
    """Alarms of clean runs, 1 or 0; those of both kinds of faults count once."""
    clean = {(row["run"], row["size"]): row for row in rows if row["fault"] == "none"}
    return [_alarm(row) for row in clean.values()]


def caught(rows: Sequence[Row]) -> list[float]:
    """Alarms of failed runs, 1 or 0."""
    return [_alarm(row) for row in rows if row["failed"]]


ALARMS = Experiment(
    "Do the detectors tell failed runs from good ones?",
    lambda size: [*fault_cells(size, "images"), *fault_cells(size, "prior")],
    (
        Claim(
            "At most one in thirty clean runs raises an alarm.",
            false_alarms, "share", "below", 1 / 30, "clean run",
        ),
        Claim(
            "At least nine of ten failed runs raise an alarm.",
            caught, "share", "above", 0.9, "failed run",
        ),
    ),
    (
        Panel("fault", "failed", "fault, at all its sizes", "runs that failed (share)"),
    ),
)  # fmt: skip
