"""The paper's loop: seeds -> fit -> information of the training set -> choose a pose -> capture ->
fit -> ... to its end.

The candidates' images are never read: only the cameras of frames not taken yet are touched before a
choice.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mgs.camera import Camera
from mgs.data.dataset import Dataset, Frame, target_of
from mgs.data.up import PLUS_Z, Up, upright
from mgs.errors import InputError
from mgs.files import locked
from mgs.fit.settings import TrainSettings
from mgs.fit.stopping import StopReason
from mgs.gaussians import Gaussians
from mgs.memory import IMAGE_BYTES, Deferred, kept_within
from mgs.metrics import masked_squares
from mgs.policy import criteria
from mgs.policy import from_file as policy_file
from mgs.policy import poses as pose_policies
from mgs.policy import registry as policies
from mgs.policy.context import PolicyContext
from mgs.policy.visibility import Visibility
from mgs.prior.exposure import without_gain
from mgs.prior.initial import warm_start
from mgs.run import detectors, inputs
from mgs.run.ending import diverged, run_end
from mgs.run.folder import (
    DATASET,
    State,
    check_settings,
    read_checkpoint,
    write_checkpoint,
    write_steps,
)
from mgs.run.settings import NbvSettings
from mgs.seeds import generator
from mgs.splat_ply import write_ply

if TYPE_CHECKING:
    from mgs.fit.fitting import Fit

Progress = Callable[[str, int, int], None]
"""Called as progress(stage, done, total)."""


@dataclass(frozen=True)
class Stations:
    """What the loop calls; NumPy in and out, deterministic. `mgs.run.stations` has the real ones,
    tests have stand-ins.

    centre: [3] the rock, metres.
    groups: columns of the Fisher information by kind of parameter (`mgs.splat.groups`).
    initial(frames) -> Gaussians before any training, in the colours of these frames.
    exposure(frames) -> gains [V,3] by which the colours of frames are divided; None: they are taken
    as they are. fit(gaussians, start, cameras, targets, train, on_pass) -> Fit; start: the
    Gaussians before any training; targets and train (the settings) as in `mgs.fit.fitting.fit`.
    fisher(gaussians, camera) -> information of one view [N,P], by the estimator of the run.
    estimate(gaussians, camera, estimator) -> information of one view by a row of
    `mgs.splat.ESTIMATORS`. measure(gaussians, taken frame indices) -> entries for steps.jsonl.
    exact(gaussians, camera) -> exact information of one view [N,P], for what the views see of the
    surface, with or without columns of means; None: as `fisher`.
    look(gaussians, camera) -> linear RGB [H,W,3] and alpha [H,W] of a render, for the signs of
    `mgs.run.detectors`; None: the steps have none.
    on_surface: how many of the Gaussians, the first, lie on the surface, so are what coverage is a
    share of; None: all.
    up: unit vector that points upwards in the world: azimuths are angles about it.
    prior: hash of what `initial` starts from (`mgs.run.inputs.prior_digest`).
    capture(frame): have its images made where they do not exist yet; called before they are read.
    """

    centre: np.ndarray
    groups: dict[str, slice]
    initial: Callable[[list[Frame]], Gaussians]
    fit: Callable[
        [
            Gaussians,
            Gaussians,
            list[Camera],
            Sequence[np.ndarray],
            TrainSettings,
            Callable[[int, int], None],
        ],
        Fit,
    ]
    fisher: Callable[[Gaussians, Camera], np.ndarray]
    estimate: Callable[[Gaussians, Camera, str], np.ndarray]
    measure: Callable[[Gaussians, list[int]], dict[str, float]]
    exposure: Callable[[Sequence[Frame]], np.ndarray] | None = None
    exact: Callable[[Gaussians, Camera], np.ndarray] | None = None
    look: Callable[[Gaussians, Camera], tuple[np.ndarray, np.ndarray]] | None = None
    on_surface: int | None = None
    up: Up = PLUS_Z
    prior: str = ""
    capture: Callable[[Frame], None] = lambda frame: None


@dataclass
class _Stopwatch:
    """Seconds per stage, added up where a stage is met again."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[stage] = round(self.seconds.get(stage, 0.0) + time.perf_counter() - start, 4)


def run(
    out: Path,
    settings: NbvSettings,
    dataset: Dataset,
    stations: Stations,
    progress: Progress,
    on_step: Callable[[State], None] = lambda state: None,
    say: Callable[[str], None] = lambda text: None,
) -> State:
    """Run or resume the loop in `out` (which has its config.json) until the run ends; returns the
    last state.

    progress is told of the work inside a step, on_step of every state that is committed, say of
    what a user should know.

    Killed at any moment and called again, it takes the same views as a run that was never
    interrupted. Raises InputError as `check_settings`; where another process works on the folder;
    where the prior, a pose or a file of a frame taken has changed since the steps that are there;
    before the fit, where a frame it takes cannot be read or has an empty mask; and
    where the fit diverged: the steps before are kept.
    """
    check_settings(settings, len(dataset))
    with locked(out):
        for leftover in [
            *out.glob(".*.part*"),
            *(out / DATASET).rglob(".*.part*"),
        ]:  # of a killed write
            leftover.unlink()
        known = read_checkpoint(out)
        if known is not None:
            inputs.check(out, known, settings, dataset, stations.prior, say)
        loop = Loop(out, settings, dataset, stations, progress)
        if known is not None:
            loop.check(known)
        state = loop.first() if known is None else loop.marked(known)
        if known is None or known.steps != state.steps:
            write_checkpoint(out, state)
        on_step(state)
        while "ended" not in state.steps[-1]:
            finished, state = len(state.steps), loop.next(state)
            write_checkpoint(out, state)
            if len(state.steps) > finished:
                on_step(state)
        write_steps(out, state)
        write_ply(out / "gaussians.ply", state.gaussians)
        return state


class Loop:
    """What stays the same from step to step; each method is a function of the state."""

    def __init__(
        self,
        out: Path,
        settings: NbvSettings,
        dataset: Dataset,
        stations: Stations,
        progress: Progress,
    ) -> None:
        self.out, self.settings, self.frames, self.stations, self.progress = (
            out,
            settings,
            dataset.frames,
            stations,
            progress,
        )
        self.cameras = [frame.camera for frame in dataset.frames]
        self.turn = upright(stations.up)  # policies are told of a world in which +Z points upwards
        self.positions = np.array([camera.position for camera in self.cameras]) @ self.turn.T
        self.centre = self.turn @ stations.centre
        appearance = {kind: columns for kind, columns in stations.groups.items() if kind != "mean"}
        self.prior_lam = criteria.regularisation(
            appearance, settings.pixel_noise, settings.prior_std
        )
        self.lam = settings.regularisation(stations.groups)
        with_alpha = settings.train.alpha_weight > 0
        self.image = kept_within(
            IMAGE_BYTES, lambda i: target_of(self.frames[i], with_alpha), lambda image: image.nbytes
        )
        cameras = {frame.name: inputs.camera_digest(frame.camera) for frame in self.frames}
        self.made_from = {
            "prior": stations.prior,
            "cameras": cameras,
            **inputs.policy_record(settings.policy),
        }
        self.seeds = pose_policies.seed_views(self.positions, self.centre, settings.seeds)
        self.capture(self.seeds)
        self.start = stations.initial([self.frames[i] for i in self.seeds])
        self.points = self.start.means[: self.stations.on_surface] @ self.turn.T
        self.policy = policies.policy_named(settings.policy)
        self.look_anew()
        # The model that was asked about last, and what gives the information of a frame's view
        # about it (`information`).
        self.informed: tuple[Gaussians | None, Callable[[int], np.ndarray]] = (
            None,
            lambda frame: np.empty(0),
        )
        self.before_fit, self.coloured = (
            cache(self._before_fit),
            lru_cache(maxsize=2)(self._coloured),
        )  # on images, too

    def look_anew(self) -> None:
        """Forget what poses see of the surface, so that it is measured again."""
        told = partial(self.progress, "scoring candidates")
        lam = float(self.prior_lam[0])
        self.sight = Visibility(
            self.cameras, self.surface_information, self.points, self.centre, lam, self.turn, told
        )

    def capture(self, views: Sequence[int]) -> None:
        """Have the images of these frames made where they do not exist yet."""
        for done, i in enumerate(views):
            self.progress("capturing", done, len(views))
            self.stations.capture(self.frames[i])

    def check(self, state: State) -> None:
        """Raises InputError where a state is not of this run: where its means, which a fit leaves
        alone, are not the prior's; or, since learned means tell nothing, where it has other
        parameters than this run learns."""
        if state.H.shape[1] != len(self.lam):
            where = f"{self.out / 'config.json'}: settings.train.means"
            raise InputError(
                f"{where} has changed since {self.out} was started; restore it, or start a new run"
            )
        if self.settings.train.means == "frozen" and not np.array_equal(
            state.gaussians.means, self.start.means
        ):
            raise InputError(inputs.moved_start(self.out, self.settings.prior))

    def first(self) -> State:
        """Step 0: the seeds."""
        names = [self.frames[i].name for i in self.seeds]
        choice = {"frame": None, "name": None, "seeds": self.seeds, "seed_names": names}
        choice |= {"score": None, "information_gain": None}
        nothing = np.zeros((len(self.start), len(self.lam)))
        on_surface = nothing[: self.stations.on_surface, : len(self.prior_lam)]
        start = State(self.start, nothing, on_surface, [], [])
        return self.learn(start, self.planned(start, self.seeds, choice, _Stopwatch()))

    def marked(self, state: State, refused: dict[str, Any] | None = None) -> State:
        """The state with `ended` in the last of its steps where the run ends there
        (`mgs.run.ending.run_end`), otherwise
        without it, by the settings as they are now. refused: the choice that comes next, if it is
        known; otherwise it is what a run that ended recorded of it."""
        last = {key: value for key, value in state.steps[-1].items() if key != "ended"}
        uncertainty = float(criteria.uncertainty(state.H, self.lam).mean())
        views = len(state.taken) - self.settings.seeds
        ended = run_end(self.settings, views, uncertainty, refused or state.steps[-1].get("ended"))
        return replace(state, steps=[*state.steps[:-1], last | ({"ended": ended} if ended else {})])

    def next(self, state: State) -> State:
        """One batch of views, a step each: choose their poses, capture their images, learn. A batch
        is closed before a view that would end the run; where that is its first, the state comes
        back as it is, its last step marked."""
        planned = state
        for _ in range(
            min(
                self.settings.batch, self.settings.budget - (len(state.taken) - self.settings.seeds)
            )
        ):
            further = self.plan(planned)
            refused = self.marked(state, further.steps[-1])
            if "ended" in refused.steps[-1]:
                return refused if planned is state else self.learn(state, planned)
            planned = further
        return self.learn(state, planned)

    def plan(self, state: State) -> State:
        """The state with one more view, of which only the pose is known. What the view says about
        the model as it is now is added to H, so the next view of a batch is chosen as if this one
        were taken."""
        watch = _Stopwatch()
        with watch("score"):
            frame, score = self.choose(state)
            F = self.information(state.gaussians)(frame)
            information_gain = criteria.d_optimal(F, state.H, self.lam)
        choice = {
            "frame": frame,
            "name": self.frames[frame].name,
            "score": score,
            "information_gain": information_gain,
        }
        return replace(self.planned(state, [frame], choice, watch), H=state.H + F)

    def planned(
        self, state: State, new: list[int], choice: dict[str, Any], watch: _Stopwatch
    ) -> State:
        """The state with a step for these new views: what is known of it before their images are
        read."""
        with watch("information"):
            surface = state.surface + sum(self.surface_information(self.cameras[i]) for i in new)
        taken = [*state.taken, *new]
        known = {
            "images": len(taken),
            "coverage": criteria.coverage(surface, self.prior_lam),
            "seconds": watch.seconds,
        }
        line = {"step": len(state.steps), **choice, **known}
        return replace(state, surface=surface, taken=taken, steps=[*state.steps, line])

    def choose(self, state: State) -> tuple[int, float]:
        """Frame of the largest score over its cost among those in reach, and that score. Looks at
        poses, never at candidates' images."""
        context = self.context(state, self.reachable(state))
        scores = np.asarray(self.policy(context), np.float64)
        farthest = pose_policies.farthest_pose(
            context.candidates, context.taken, context.centre, context.rng
        )
        where = f"policy {self.settings.policy}: gave"
        if scores.shape != (len(context.candidate_frames),):
            raise InputError(
                f"{where} scores of shape {scores.shape} to {len(context.candidate_frames)} candidates; give each one number"
            )
        weighed = scores / self.cost(context)
        best = max(range(len(context.candidate_frames)), key=lambda k: (weighed[k], farthest[k]))
        if np.isnan(scores).any() or np.isinf(scores[best]):
            raise InputError(
                f"{where} a score that is NaN or infinite; correct it (docs/howto/policy.md)"
            )
        if self.settings.travel is not None and scores[best] < 0:
            raise InputError(
                f"{where} negative scores, which --travel cannot divide by a cost; leave it out, or correct them"
            )
        return context.candidate_frames[best], float(scores[best])

    def cost(self, context: PolicyContext) -> np.ndarray:
        """By what the scores of the candidates are divided, [C]; with the setting `travel` it grows
        with the way to them."""
        if self.settings.travel is None:
            return np.ones(len(context.candidate_frames))
        return pose_policies.travel_cost(
            context.candidates, context.taken[-1], self.settings.travel
        )

    def reachable(self, state: State) -> list[int]:
        """Frames not taken; with the setting `nearest`, so many of them that are nearest to the
        view taken last."""
        left = [i for i in range(len(self.frames)) if i not in state.taken]
        if self.settings.nearest is None:
            return left
        near = pose_policies.nearest_poses(
            self.positions[left], self.positions[state.taken[-1]], self.settings.nearest
        )
        return [left[k] for k in near]

    def context(self, state: State, left: list[int]) -> PolicyContext:
        """What the policy sees when it chooses among the frames in `left`."""

        def told(view: int) -> int:
            self.progress("scoring candidates", left.index(view) if view in left else 0, len(left))
            return view

        return PolicyContext(
            positions=self.positions,
            candidate_frames=left,
            taken_frames=state.taken,
            centre=self.centre,
            rng=generator(
                self.settings.seed, f"{policy_file.label(self.settings.policy)}/{len(state.steps)}"
            ),
            H=state.H,
            lam=self.lam,
            points=self.points,
            surface_H=state.surface,
            prior_lam=self.prior_lam,
            information=lambda view: self.information(state.gaussians)(told(view)),
            surface_information=lambda view: self.sight.information(told(view)),
            estimate=lambda view, estimator: self.stations.estimate(
                state.gaussians, self.cameras[told(view)], estimator
            ),
            seen=lambda view: self.sight.seen(told(view)),
            dome=self.sight.dome,
            gains=self.sight.gains,
        )

    def information(self, model: Gaussians) -> Callable[[int], np.ndarray]:
        """The information [N,P] of each frame's view about a model. Where views are chosen in
        batches it is kept, because all choices of a batch are about the same model."""
        if self.informed[0] is not model:
            room = IMAGE_BYTES if self.settings.batch > 1 else 0
            self.informed = (
                model,
                kept_within(
                    room, lambda i: self.stations.fisher(model, self.cameras[i]), lambda F: F.nbytes
                ),
            )
        return self.informed[1]

    def surface_information(self, camera: Camera) -> np.ndarray:
        """What a pose sees of the surface: exact information about how the Gaussians on it look
        before any training."""
        fisher = self.stations.exact or self.stations.fisher
        return fisher(self.start, camera)[: self.stations.on_surface, : len(self.prior_lam)]

    def learn(self, state: State, planned: State) -> State:
        """Read the images of the views that are planned beyond a state, fit to all so far, sum
        their information at the new model. What the fit says goes into the last of the planned
        steps."""
        *steps, known = planned.steps
        step, taken, new = known["step"], planned.taken, planned.taken[len(state.taken) :]
        watch = _Stopwatch(known["seconds"])
        with watch("capture"):
            self.capture(new)
            for i in new:
                self.image(i)
            gains = (
                self.stations.exposure([self.frames[i] for i in taken])
                if self.stations.exposure
                else None
            )
            targets = self.targets(taken, gains)
        with watch("fit"):
            fit = self.fit(state, taken, targets, step, partial(self.progress, "fitting"))
        if fit.stop_reason == StopReason.DIVERGED:
            raise InputError(diverged(self.out, step, len(state.steps), fit.losses))
        with watch("information"):
            H = np.zeros((len(fit.gaussians), len(self.lam)))
            for done, i in enumerate(taken):
                self.progress("information of the training set", done, len(taken))
                H += self.stations.fisher(fit.gaussians, self.cameras[i])
        kinds = [
            "image",
            "mask",
            "rock",
            "depth",
        ]  # depth tells which part of the surface a colour belongs to
        files = {self.frames[i].name: inputs.frame_digests(self.frames[i], kinds) for i in new}
        made_from = {**self.made_from, "files": state.inputs.get("files", {}) | files}
        line = known | {
            "uncertainty": float(criteria.uncertainty(H, self.lam).mean()),
            "iterations": int(fit.iterations),
            "loss": float(fit.loss),
            "stop_reason": str(fit.stop_reason),
            "seconds": watch.seconds,
        }
        if gains is not None:
            line["exposure"] = {
                self.frames[i].name: gain for i, gain in zip(taken, gains.tolist(), strict=True)
            }
        if self.stations.look:
            with watch("check"):
                if state.taken:
                    line |= self.residual(state.gaussians, new, targets[-len(new) :])
                line |= self.signs(planned, fit, gains)
        every, first = self.settings.evaluate_every, len(state.steps)
        if every and any(k % every == 0 for k in range(first, step + 1)):
            with watch("evaluate"):
                line |= self.stations.measure(fit.gaussians, taken)
        return self.marked(
            State(fit.gaussians, H, planned.surface, taken, [*steps, line], made_from)
        )

    def fit(
        self,
        state: State,
        taken: list[int],
        targets: Sequence[np.ndarray],
        step: int,
        on_pass: Callable[[int, int], None],
    ) -> Fit:
        """A fit to frames taken, of which those of a state are the first, from the model of that
        state."""
        start = self.coloured(tuple(taken))
        model = (
            warm_start(state.gaussians, self.coloured(tuple(state.taken)), start)
            if state.taken
            else start
        )
        cameras = [self.cameras[i] for i in taken]
        return self.stations.fit(
            model, start, cameras, targets, self.settings.train_at(step), on_pass
        )

    def _coloured(self, taken: tuple[int, ...]) -> Gaussians:
        """The Gaussians before any training, in the colours of all frames taken."""
        return replace(self.start, sh=self.stations.initial([self.frames[i] for i in taken]).sh)

    def targets(self, taken: list[int], gains: np.ndarray | None = None) -> Sequence[np.ndarray]:
        """What the model is fitted to in these frames, each as `target_of` has it; colours divided
        by `gains` [V,3]."""
        if gains is None:
            return Deferred(taken, self.image)
        return Deferred(range(len(taken)), lambda k: without_gain(self.image(taken[k]), gains[k]))

    def residual(
        self, model: Gaussians, new: list[int], targets: Sequence[np.ndarray]
    ) -> dict[str, float]:
        """The entry `residual` of a step: the root mean square difference, linear RGB, inside the
        mask, of new images to a model that was not fitted to them. What the noise that the criteria
        assume (the setting `pixel_noise`) can be held against. No entry where the colour of no
        pixel is known for certain."""
        assert self.stations.look
        pairs = zip(new, targets, strict=True)
        squares = [
            masked_squares(self.stations.look(model, self.cameras[i])[0], t, self.frames[i].mask())
            for i, t in pairs
        ]
        together = np.concatenate(squares)
        return {"residual": float(np.sqrt(together.mean()))} if len(together) else {}

    def signs(self, state: State, fit: Fit, gains: np.ndarray | None) -> dict[str, Any]:
        """The entries `signs` of the last step of a state and, where one has just gone beyond its
        limit, `warnings` (`mgs.run.detectors`). fit, gains: those of this step."""
        assert self.stations.look
        views, taken = [], state.taken
        for k, (i, target) in enumerate(zip(taken, self.targets(taken, gains), strict=True)):
            packed, before = self.before_fit(i)
            mask = (
                np.unpackbits(packed, count=target[..., 0].size)
                .astype(bool)
                .reshape(target.shape[:2])
            )
            if gains is not None:  # what was explained by the gain is no sign
                before = replace(before, exposure=before.exposure - float(np.log(gains[k].mean())))
            views.append(
                detectors.view_signs(
                    target, mask, self.stations.look(fit.gaussians, self.cameras[i])[0], before
                )
            )
        scores = [
            step["information_gain"]
            for step in state.steps
            if step.get("information_gain") is not None
        ]
        drift = detectors.means_drift(fit.gaussians.means, self.start.means, self.start.log_scales)
        signs = detectors.step_signs(views, fit.losses, state.steps[-1]["coverage"], scores, drift)
        before_this = next(
            (step["signs"] for step in reversed(state.steps[:-1]) if "signs" in step), None
        )
        said = detectors.alarms(signs, before_this)
        return {"signs": signs, "warnings": said} if said else {"signs": signs}

    def _before_fit(self, frame: int) -> tuple[np.ndarray, detectors.Before]:
        """The mask of a frame that was taken, one bit a pixel, and its signs of the Gaussians
        before any training. Those that no seed saw, which are grey, have the frame's own colours:
        grey would be taken for a change of the exposure."""
        assert self.stations.look
        mask, camera = self.frames[frame].mask(), self.cameras[frame]
        margin = detectors.outline_margin(self.start, camera)
        grey = ~self.start.sh.any(axis=(1, 2), keepdims=True)
        start = replace(self.start, sh=np.where(grey, self._coloured((frame,)).sh, self.start.sh))
        signs = detectors.before_fit(
            self.image(frame), mask, *self.stations.look(start, camera), margin
        )
        return np.packbits(mask), signs
