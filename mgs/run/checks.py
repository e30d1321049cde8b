"""Entries of steps.jsonl that compare renders with images: residual, indicators, warnings, and the
prediction for the views not taken."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np

from mgs.camera import Camera
from mgs.gaussians import Gaussians
from mgs.policy.poses import POSE_POLICIES
from mgs.policy.registry import PLANNED
from mgs.run import detectors
from mgs.run.problem import Problem
from mgs.run.state import Learned

GEOMETRIC = (*POSE_POLICIES, "cover")
"""Policies that ignore how much a view tells, so one of small gain does not mean that all are."""

WINDOW = 3
"""Number of last fits whose new views give the mean excess of `predicted_psnr`. Chosen among 2 to 8
on two rocks that judge nothing."""

LEAST_ERROR = 1e-8
"""Least mean squared error that is predicted, 80 dB."""


class Checks:
    """Compares renders with the images taken. render(gaussians, camera) -> RGB, alpha."""

    def __init__(
        self,
        problem: Problem,
        render: Callable[[Gaussians, Camera], tuple[np.ndarray, np.ndarray]],
    ) -> None:
        self.problem, self.render = problem, render
        self.before_fit = cache(self._before_fit)

    def entries(
        self, learned: Learned, new: list[int], known: Sequence[dict[str, Any]]
    ) -> dict[str, Any]:
        """Entries of the last line in `known`, the lines of all steps: `residual`, `indicators`,
        `warnings` and `prediction`. new: views that the model before was not fitted to."""
        new_views: list[detectors.ViewIndicators] = []
        entries: dict[str, Any] = {}
        if learned.before is not None:
            new_views = self.views(learned.before, learned, new)
            entries["residual"] = float(np.sqrt(np.mean([view.error**2 for view in new_views])))
        views = self.views(learned.fit.gaussians, learned, learned.taken)
        entries |= self.indicators(learned, views, known)
        settings = self.problem.settings
        if settings.stop_psnr is not None or settings.policy in PLANNED:
            past = [step["prediction"] for step in known if "prediction" in step]
            entry = self.prediction(learned.taken, new, views, new_views)
            if (psnr := predicted_psnr([*past, entry])) is not None:
                entry["psnr"] = psnr
            entries["prediction"] = entry
        return entries

    def views(
        self, model: Gaussians, learned: Learned, some: list[int]
    ) -> list[detectors.ViewIndicators]:
        """Compare the images of the last views taken, `some`, with a model."""
        problem, views = self.problem, []
        shown = problem.targets(learned.taken, learned.gains)[-len(some) :]
        for i, target in zip(some, shown, strict=True):
            packed, before = self.before_fit(i)
            size = target.shape[0] * target.shape[1]
            mask = np.unpackbits(packed, count=size).astype(bool).reshape(target.shape[:2])
            rendered = self.render(model, problem.cameras[i])[0]
            views.append(detectors.view_indicators(target, mask, rendered, before))
        return views

    def prediction(
        self,
        taken: list[int],
        new: list[int],
        views: list[detectors.ViewIndicators],
        new_views: list[detectors.ViewIndicators],
    ) -> dict[str, float]:
        """Entry of the last fit for `predicted_psnr`.

        views: all views taken, under the model. new_views: the new ones, under the model before.
        """

        def mean_gain(before: list[int], poses: list[int]) -> float:
            gains = self.problem.visibility.gains(before, poses, *PLANNED["directional-d"])
            return float(gains.mean())

        entry = {"fitted": float(np.mean([view.srgb_error for view in views]))}
        if new_views:
            entry["new"] = float(np.mean([view.srgb_error for view in new_views]))
            entry["gain"] = mean_gain(taken[: -len(new)], new)
        if left := [i for i in range(len(self.problem.frames)) if i not in taken]:
            entry["left"] = mean_gain(taken, left)
        return entry

    def indicators(
        self,
        learned: Learned,
        views: list[detectors.ViewIndicators],
        steps: Sequence[dict[str, Any]],
    ) -> dict[str, Any]:
        """`indicators` of the last step, and `warnings` where one now exceeds its limit."""
        problem, fit = self.problem, learned.fit
        known = [] if problem.settings.policy in GEOMETRIC else steps
        scores = [s["information_gain"] for s in known if s["information_gain"] is not None]
        start, coverage = problem.start, steps[-1]["coverage"]
        drift = 0.0  # changed Gaussians are not those of the start
        std = problem.settings.prior_std.get("mean")
        if std and problem.settings.train.density == "fixed":
            drift = detectors.means_drift(fit.gaussians.means, start.means, std)
        positions = problem.positions[learned.taken]
        last = problem.views_left(learned.taken) <= 0
        indicators = detectors.step_indicators(
            views, positions, fit.losses, coverage, scores, drift, last
        )
        if start.opacities.max() < 0.5:  # random points: no surface to compare with
            for name in ("prior", "pose", "coverage"):
                indicators.pop(name, None)
        before_this = next(
            (step["indicators"] for step in reversed(steps[:-1]) if "indicators" in step), None
        )
        said = detectors.alarms(indicators, before_this)
        return {"indicators": indicators, "warnings": said} if said else {"indicators": indicators}

    def _before_fit(self, frame: int) -> tuple[np.ndarray, detectors.Before]:
        """Mask of a frame taken, one bit a pixel, and its indicators before any training."""
        problem = self.problem
        mask, camera = problem.frames[frame].mask(), problem.cameras[frame]
        margin = detectors.outline_margin(problem.start, camera)
        alpha = self.render(problem.start, camera)[1]
        return np.packbits(mask), detectors.before_fit(mask, alpha, margin)


def predicted_psnr(entries: Sequence[Mapping[str, float]]) -> float | None:
    """Mean PSNR of the views not taken, dB; None without a new view, or if all are taken.

    The image of a new view is a test of the model before it. Its error is above the mean error of
    the images which that model was fitted to. This excess is about proportional to the view's
    directional gain (D of `mgs.policy.directional`), so the last views give the factor for the
    views not taken.

    entries: of every fit so far. "fitted": mean squared error of the views fitted to; "left": mean
    gain of the views not taken; after the first fit also "new", the error of the new view under the
    model before, and "gain", its gain at that time.
    """
    steps = list(pairwise(entries))[-WINDOW:]
    if not steps or "left" not in entries[-1]:
        return None
    excess = np.mean([after["new"] - before["fitted"] for before, after in steps])
    gain = np.mean([after["gain"] for _, after in steps])
    factor = max(float(excess), 0.0) / max(float(gain), 1e-30)
    error = entries[-1]["fitted"] + factor * entries[-1]["left"]
    return -10 * math.log10(max(error, LEAST_ERROR))
