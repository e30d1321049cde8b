"""Entries of steps.jsonl that show whether a run goes wrong: residual, indicators, warnings."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from mgs.camera import Camera
from mgs.gaussians import Gaussians
from mgs.policy.poses import POSE_POLICIES
from mgs.run import detectors
from mgs.run.problem import Problem
from mgs.run.state import Learned

GEOMETRIC = (*POSE_POLICIES, "cover")
"""Policies that ignore how much a view tells, so one of small gain does not mean that all are."""


class Checks:
    """Compares renders with the images taken. render(gaussians, camera) -> RGB, alpha."""

    def __init__(
        self,
        problem: Problem,
        render: Callable[[Gaussians, Camera], tuple[np.ndarray, np.ndarray]],
    ) -> None:
        self.problem, self.render = problem, render
        self.before_fit = cache(self._before_fit)

    def residual(self, learned: Learned, before: Gaussians, new: list[int]) -> dict[str, float]:
        """`residual` of a step: rms difference of new images to the model before, linear RGB.

        Inside the mask; to be compared with the setting `pixel_noise`. Empty where no pixel counts.
        """
        problem = self.problem
        shown = problem.targets(learned.taken, learned.gains)[-len(new) :]
        found = detectors.residual(
            (
                self.render(before, problem.cameras[i])[0],
                target,
                problem.frames[i].mask(),
            )
            for i, target in zip(new, shown, strict=True)
        )
        return {} if found is None else {"residual": found}

    def indicators(self, learned: Learned, steps: list[dict[str, Any]]) -> dict[str, Any]:
        """`indicators` of the last step, and `warnings` where one now exceeds its limit."""
        problem, gains, fit = self.problem, learned.gains, learned.fit
        views = []
        shown = problem.targets(learned.taken, gains)
        for i, target in zip(learned.taken, shown, strict=True):
            packed, before = self.before_fit(i)
            size = target.shape[0] * target.shape[1]
            mask = np.unpackbits(packed, count=size).astype(bool).reshape(target.shape[:2])
            rendered = self.render(fit.gaussians, problem.cameras[i])[0]
            views.append(detectors.view_indicators(target, mask, rendered, before))
        known = [] if problem.settings.policy in GEOMETRIC else steps
        scores = [s["information_gain"] for s in known if s["information_gain"] is not None]
        start, coverage = problem.start, steps[-1]["coverage"]
        drift = 0.0  # changed Gaussians are not those of the start
        std = problem.settings.prior_std.get("mean")
        if std and problem.settings.train.density == "fixed":
            drift = detectors.means_drift(fit.gaussians.means, start.means, std)
        indicators = detectors.step_indicators(views, fit.losses, coverage, scores, drift)
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
