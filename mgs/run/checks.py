"""Entries of steps.jsonl that compare renders with images."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import pairwise
from typing import Any

import numpy as np

from mgs.data.frames import Frame, frame_blur
from mgs.gaussians import Gaussians
from mgs.memory import IMAGE_BYTES, kept_within
from mgs.prior.exposure import without_gain
from mgs.progress import Stage, report
from mgs.run import detectors
from mgs.run.flight import views_left
from mgs.run.policies import DIRECTIONAL_D, Policy
from mgs.run.settings import NbvSettings
from mgs.scene import Scene, State

WINDOW = 3  # number of last fits that give the mean excess of `predicted_psnr`. Chosen on two rocks
LEAST_ERROR = 1e-8  # least mean squared error that is predicted, 80 dB


@dataclass(frozen=True)
class Checks:
    """Compares renders with the images taken."""

    scene: Scene
    settings: NbvSettings
    policy: Policy

    def entries(
        self,
        state: State,
        before: Gaussians | None,
        new: Sequence[int],
        steps: Sequence[dict[str, Any]],
    ) -> dict[str, Any]:
        """Entries of the last line in `steps`, the lines of all steps: `residual`, `indicators`,
        `warnings` and `prediction`. new: views that the model `before` was not fitted to."""
        new_views: list[detectors.ViewIndicators] = []
        entries: dict[str, Any] = {}
        if before is not None:
            new_views = self.views(before, state, new)
            entries["residual"] = float(np.sqrt(np.mean([view.error**2 for view in new_views])))
        views = self.views(state.gaussians, state, state.taken)
        entries |= self.indicators(state, views, steps)
        if self.settings.stop_psnr is not None or hasattr(self.policy, "plan"):
            past = [step["prediction"] for step in steps if "prediction" in step]
            entry = self.prediction(state, new, views, new_views)
            if (psnr := predicted_psnr([*past, entry])) is not None:
                entry["psnr"] = psnr
            entries["prediction"] = entry
        return entries

    def views(
        self, model: Gaussians, state: State, some: Sequence[int]
    ) -> list[detectors.ViewIndicators]:
        views = list[detectors.ViewIndicators]()
        for k, view in list(enumerate(state.taken))[-len(some) :]:
            report(Stage.CHECK, len(views), len(some))
            frame = state.frames[view]
            key = "before fit", state.taken[: state.seeds], frame
            before = self.scene.once(key, partial(self._before_fit, state, frame))
            packed, truth, blurred = self.compared(frame)
            rendered = self.scene.render(model, frame.camera)[0]
            bits = np.unpackbits(packed, count=rendered[..., 0].size)
            counted = bits.astype(bool).reshape(rendered.shape[:2])
            if state.exposure is not None:
                truth = without_gain(truth, state.exposure[k])
            seen = detectors.view_indicators(truth, counted, rendered, before)
            views.append(replace(seen, blur=blurred))
        return views

    def prediction(
        self,
        state: State,
        new: Sequence[int],
        views: list[detectors.ViewIndicators],
        new_views: list[detectors.ViewIndicators],
    ) -> dict[str, float]:
        """Entry of the last fit for `predicted_psnr`.

        views: all views taken, under the model. new_views: the new ones, under the model before."""

        def mean_gain(before: Sequence[int], poses: Sequence[int]) -> float:
            gains = self.scene.plan_surface(state).gains(before, poses, DIRECTIONAL_D.model)
            return float(gains.mean())

        entry = {"fitted": float(np.mean([view.srgb_error for view in views]))}
        if new_views:
            entry["new"] = float(np.mean([view.srgb_error for view in new_views]))
            entry["gain"] = mean_gain(state.taken[: -len(new)], new)
        if others := [i for i in range(len(state.frames)) if i not in state.taken]:
            entry["left"] = mean_gain(state.taken, others)
        return entry

    def indicators(
        self, state: State, views: list[detectors.ViewIndicators], steps: Sequence[dict[str, Any]]
    ) -> dict[str, Any]:
        """`indicators` of the last step, and `warnings` where one now exceeds its limit."""
        assert state.fit is not None
        start, coverage = self.scene.untrained(state), steps[-1]["coverage"]
        gains = [gain for step in steps if (gain := step["information_gain"]) is not None]
        automatic = self.settings.enough is not None  # the last views then add little by design
        if automatic or getattr(self.policy, "geometric", False):
            gains = []
        drift = 0.0  # changed Gaussians are not those of the start
        std = self.settings.prior_std.get("mean")
        if std and self.settings.train.density == "fixed":
            drift = detectors.means_drift(state.gaussians.means, start.means, std)
        positions = self.scene.positions([state.frames[i] for i in state.taken])
        last = views_left(state, self.settings) <= 0
        numbers = state.fit.losses, coverage, gains, drift, last
        indicators = detectors.step_indicators(views, positions, *numbers)
        if start.opacities.max() < 0.5:  # random points: no surface to compare with
            for name in ("prior", "pose", "coverage"):
                indicators.pop(name, None)
        if state.choices:  # few passes, whose loss falls with the rates: good runs by up to 25 %
            indicators.pop("unconverged", None)
        before = [step["indicators"] for step in steps[:-1] if "indicators" in step]
        alarms = detectors.alarms(indicators, before[-1] if before else None)
        return {"indicators": indicators} | ({"warnings": alarms} if alarms else {})

    def _before_fit(self, state: State, frame: Frame) -> detectors.Before:
        """Indicators of a frame taken before any training."""
        start = self.scene.untrained(state)
        margin = detectors.outline_margin(start, frame.camera)
        alpha = self.scene.render(start, frame.camera)[1]
        return detectors.before_fit(frame.mask(), alpha, margin)

    @cached_property
    def compared(self) -> Callable[[Frame], tuple[np.ndarray, np.ndarray, float]]:
        """compared(frame) -> `_compared`, kept within IMAGE_BYTES."""
        return kept_within(IMAGE_BYTES, _compared, lambda parts: sum(p.nbytes for p in parts[:2]))


def _compared(frame: Frame) -> tuple[np.ndarray, np.ndarray, float]:
    """Pixels of a frame taken that are compared, one bit each, their colours [M,3], linear RGB, and
    `frame_blur`."""
    (rgba, weight), mask = frame.target(), frame.mask()
    counted = mask & (weight > 0)
    return np.packbits(counted), rgba[..., :3][counted], frame_blur(frame, mask)


def predicted_psnr(entries: Sequence[Mapping[str, float]]) -> float | None:
    """Mean PSNR of the views not taken, dB; None without a new view, or if all are taken.

    The image of a new view tests the model before it. How far its error exceeds that of the images
    fitted to is about proportional to its directional gain, and the last views give the factor.

    entries: of every fit so far. "fitted": mean squared error of the views fitted to; "left": mean
    gain of the views not taken; after the first fit also "new", the error of the new view under the
    model before, and "gain", its gain at that time."""
    steps = list(pairwise(entries))[-WINDOW:]
    if not steps or "left" not in entries[-1]:
        return None
    excess = np.mean([after["new"] - before["fitted"] for before, after in steps])
    gain = np.mean([after["gain"] for _, after in steps])
    factor = max(float(excess), 0.0) / max(float(gain), 1e-30)
    error = entries[-1]["fitted"] + factor * entries[-1]["left"]
    return -10 * math.log10(max(error, LEAST_ERROR))
