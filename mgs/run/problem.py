"""Selection problem: all that stays fixed in a run (frames, surface, settings, policy)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from mgs.camera import Camera
from mgs.data.dataset import Dataset, target_of
from mgs.data.frames import Frame, as_asked, capture_record
from mgs.data.up import PLUS_Z, Up, upright
from mgs.errors import InputError
from mgs.files import remove_file
from mgs.gaussians import Gaussians
from mgs.memory import IMAGE_BYTES, VIEW_BYTES, Deferred, kept_within
from mgs.policy import criteria, poses, tour
from mgs.policy.context import Policy, PolicyContext
from mgs.policy.from_file import label
from mgs.policy.registry import PLANNED, policy_named
from mgs.policy.visibility import Visibility
from mgs.prior.exposure import without_gain
from mgs.run.flight import Flight, allowed_poses
from mgs.run.settings import NbvSettings
from mgs.seeds import generator

if TYPE_CHECKING:
    from mgs.fit.fitting import Fit
    from mgs.fit.settings import TrainSettings
    from mgs.run.state import Fitted

Progress = Callable[[str, int, int], None]
"""Called as progress(stage, done, total)."""


def no_progress(stage: str, done: int, total: int) -> None:
    """Default callback: does nothing."""


@dataclass(frozen=True)
class Operations:
    """Deterministic functions that the loop computes with, NumPy in and out (`operations_of`).

    centre: [3] middle of the rock, metres. groups: columns of the Fisher information by kind of
    parameter (`mgs.splat.groups`). up: unit vector that points upwards in the world. ground: height
    of the object's lowest point, metres.
    on_surface: number of Gaussians on the surface, the first ones; None: all.
    prior: hash of what `initial` starts from (`mgs.run.inputs.prior_digest`).

    initial(frames) -> Gaussians before training, in the colours of these frames.
    exposure(frames) -> gains [V,3] that colours are divided by; None: images are taken as they are.
    fit(gaussians, start, cameras, targets, train, on_pass) -> Fit (`mgs.fit.fitting.fit`).
    fisher(gaussians, camera) -> information of a view [N,P], by the estimator of the run.
    estimate(gaussians, camera, estimator) -> the same by any row of `mgs.splat.ESTIMATORS`.
    exact(gaussians, camera) -> exact information [N,P]; None: as `fisher`.
    render(gaussians, camera) -> linear RGB [H,W,3] and alpha [H,W]; None: no detectors.
    measure(gaussians, taken) -> entries of steps.jsonl (`mgs.evaluation.psnr_measure`).
    capture(frame) -> the frame once its images exist, which this makes where they do not; its
    camera is that of the picture. `given_up` where there is none to be had.
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
    render: Callable[[Gaussians, Camera], tuple[np.ndarray, np.ndarray]] | None = None
    on_surface: int | None = None
    up: Up = PLUS_Z
    ground: float = -np.inf
    prior: str = ""
    capture: Callable[[Frame], Frame] = lambda frame: frame


class Problem:
    """A selection problem: V candidate frames, and how the model is fitted to those taken.

    - positions, centre, points: metres, in coordinates in which +Z is up.
    - lam: [P], lambda of the run. prior_lam: the same for the surface, without columns of means and
      without the setting `lam`.
    - allowed: [V] bool, poses that `no_fly` and `clearance` allow.
    - skipped: number of views taken before the flight.
    - seeds: seed views; by default spread over the directions of the poses allowed.

    Values that depend on images are computed at their first use. Raises InputError if fewer poses
    are allowed than seeds are needed, and as `policy_named` and `NbvSettings.regularisation`.
    """

    def __init__(
        self,
        dataset: Dataset,
        settings: NbvSettings,
        operations: Operations,
        progress: Progress = no_progress,
        policy: Policy | None = None,
        seeds: Sequence[int] | None = None,
    ) -> None:
        self.dataset, self.settings = dataset, settings
        self.operations, self.progress = operations, progress
        self.frames = [as_asked(frame) for frame in dataset.frames]
        self.cameras = [frame.camera for frame in self.frames]
        self.policy = policy or policy_named(settings.policy)
        self.turn = upright(operations.up)
        self.positions = np.array([camera.position for camera in self.cameras]) @ self.turn.T
        self.centre = self.turn @ operations.centre
        kinds = {kind: at for kind, at in operations.groups.items() if kind != "mean"}
        self.prior_lam = criteria.regularisation(kinds, settings.pixel_noise, settings.prior_std)
        self.lam = settings.regularisation(operations.groups)
        self.allowed = allowed_poses(
            self.positions, self.centre, operations.ground, settings.flight
        )
        self.skipped = 0
        self.seeds = self._spread_seeds() if seeds is None else list(seeds)
        with_alpha = settings.train.alpha_weight > 0
        self.image = kept_within(
            IMAGE_BYTES, lambda i: target_of(self.frames[i], with_alpha), lambda image: image.nbytes
        )
        self.start_of = lru_cache(maxsize=3)(self._start_of)

    def with_settings(self, **changes: Any) -> Problem:
        """The same problem with other settings that neither change `lam` nor the seeds, such as
        the policy, `seed` or `train`. What was measured of dataset and prior is kept."""
        other = copy(self)
        other.settings = self.settings.model_copy(update=changes)
        other.policy = policy_named(other.settings.policy)
        other.__dict__.pop("flight", None)
        return other

    def _spread_seeds(self) -> list[int]:
        free, count = np.flatnonzero(self.allowed), self.settings.seeds
        if len(free) < count:
            raise InputError(
                f"{self.dataset.root}: flight.no_fly and flight.clearance allow "
                f"{len(free)} of its {len(self.frames)} poses, fewer than {count} seeds; "
                "lower one of them"
            )
        return [int(free[k]) for k in poses.seed_views(self.positions[free], self.centre, count)]

    def check_seeds(self) -> None:
        """Raises InputError where the flight over the seeds and home exceeds the limits."""
        flight, limits = self.flight, self.settings.flight
        metres = flight.metres(self.seeds)
        if flight.share(metres, len(self.seeds)) > 1:
            seconds = metres / limits.speed + limits.hover * len(self.seeds)
            raise InputError(
                f"nbv: the flight over {len(self.seeds)} seeds and home takes {metres:.1f} m and "
                f"{seconds:.0f} s; raise `flight.length` or `flight.time`, or lower `seeds`"
            )

    @cached_property
    def flight(self) -> Flight:
        """Legs between all poses, and the limits of the flight; its home is the first seed."""
        matrix = tour.legs(self.positions, self.centre[:2], self.settings.flight.no_fly or 0.0)
        return Flight(self.settings.flight, matrix, self.seeds[0], self.skipped)

    @cached_property
    def start(self) -> Gaussians:
        """The Gaussians before training, in the colours of the seeds, whose images this reads."""
        self.make_seeds()
        return self.operations.initial([self.frames[i] for i in self.seeds])

    @cached_property
    def on_surface(self) -> int:
        """Number of Gaussians on the prior's surface: the first ones."""
        count = self.operations.on_surface
        return len(self.start) if count is None else count

    @cached_property
    def points(self) -> np.ndarray:
        """[S,3] means of the Gaussians on the surface before training."""
        return self.start.means[: self.on_surface] @ self.turn.T

    @cached_property
    def visibility(self) -> Visibility:
        """Visibility of the surface from each pose."""

        def progress(done: int, total: int) -> None:
            self.progress("scoring candidates", done, total)

        lam = float(self.prior_lam[0])
        look = self._exact_on_surface
        return Visibility(self.cameras, look, self.points, self.centre, lam, self.turn, progress)

    def _start_of(self, taken: tuple[int, ...]) -> Gaussians:
        """The Gaussians before training, in the colours of all views taken."""
        sh = self.operations.initial([self.frames[i] for i in taken]).sh
        return replace(self.start, sh=sh)

    def targets(
        self, taken: Sequence[int], gains: np.ndarray | None = None
    ) -> Sequence[np.ndarray]:
        """Targets of a fit to frames (`mgs.data.dataset.target_of`); colours over `gains` [V,3]."""
        if gains is None:
            return Deferred(taken, self.image)
        return Deferred(range(len(taken)), lambda k: without_gain(self.image(taken[k]), gains[k]))

    def views_left(self, taken: Sequence[int]) -> int:
        """Number of views that the budget has left."""
        return self.settings.budget - (len(taken) - self.settings.seeds)

    def free(self, taken: Sequence[int]) -> list[int]:
        """Frames that are allowed, and not taken or given up."""
        may = [self.allowed[i] and not frame.given_up for i, frame in enumerate(self.frames)]
        return [i for i in range(len(self.frames)) if may[i] and i not in taken]

    def reachable(self, taken: Sequence[int]) -> list[int]:
        """Frames of `free` within the flight's limits; with the setting `nearest`, that many
        nearest to the last view."""
        left = self.free(taken)
        if self.settings.flies:
            left = self.flight.in_reach(taken, left)
        if self.settings.nearest is None:
            return left
        here = self.positions[taken[-1]]
        near = poses.nearest_poses(self.positions[left], here, self.settings.nearest)
        return [left[k] for k in near]

    def planned(self, taken: Sequence[int], left: list[int]) -> list[int]:
        """Frames in `left` among which a policy of PLANNED chooses: the rest of its plan, or the
        next view of its path where the setting `nearest` limits the reach.

        The plan is made after the seeds. If a view outside it was taken, a new plan is made after
        all views taken. Returns all of `left` for other policies, and where a limit of the flight
        or the travel cost depends on the last view.
        """
        settings = self.settings
        model = PLANNED.get(settings.policy)
        if model is None or settings.travel or settings.flies:
            return left
        for start in (taken[: settings.seeds], taken):
            known = tuple(start), tuple(self.free(start)), self.views_left(start)
            done = list(taken[len(start) :])
            if settings.nearest:
                path = self.visibility.path(*known, settings.nearest, model)
                if path[: len(done)] == done and path[len(done) :]:
                    return [path[len(done)]]
            else:
                plan = self.visibility.planned(*known, model)
                rest = [i for i in left if i in plan]
                if rest and set(done) <= set(plan):
                    return rest
        return left

    def travel_cost(self, context: PolicyContext) -> np.ndarray:
        """Travel cost of each candidate [C]; ones without the setting `travel`."""
        if self.settings.travel is None:
            return np.ones(len(context.candidate_frames))
        return poses.travel_cost(context.candidates, context.taken[-1], self.settings.travel)

    def make_images(self, views: Sequence[int]) -> bool:
        """Make the images of these frames where they do not exist yet; whether all could be made.

        Stops at the first that was given up. Where a picture was taken from another pose, the
        problem has that pose from now on.
        """
        for done, i in enumerate(views):
            self.progress("capturing", done, len(views))
            frame = self.operations.capture(self.frames[i])
            if frame.camera != self.cameras[i]:
                self.cameras[i] = frame.camera
                self.positions[i] = self.turn @ frame.camera.position
                for known in ("visibility", "flight"):
                    self.__dict__.pop(known, None)
            self.frames[i] = frame
            if frame.given_up:
                return False
        return True

    def retry(self) -> None:
        """Make candidates again of the frames that were given up."""
        for i, frame in enumerate(self.frames):
            if frame.given_up:
                remove_file(self.dataset.root, capture_record(frame))
                self.frames[i] = replace(frame, given_up=False)

    def make_seeds(self) -> None:
        """Make the images of the seeds; the nearest other pose replaces one that was given up.

        Raises InputError where no other is left.
        """
        while not self.make_images(self.seeds):
            failed = next(i for i in self.seeds if self.frames[i].given_up)
            others = self.reachable(self.seeds)
            if not others:
                count = sum(frame.given_up for frame in self.frames)
                raise InputError(
                    f"{self.dataset.root}: too few poses are left for the seeds, {count} gave no "
                    "picture; mend the capture and resume the run, or start again with "
                    "fewer `seeds`"
                )
            nearest = poses.nearest_poses(self.positions[others], self.positions[failed], 1)[0]
            self.seeds = [others[nearest] if i == failed else i for i in self.seeds]

    def resume(self, taken: Sequence[int]) -> None:
        """Continue with views that were taken before."""
        self.seeds = list(taken[: self.settings.seeds])
        self.make_images(taken)

    def moved(self, views: Sequence[int]) -> bool:
        """Whether some of these pictures were taken from another pose than was asked for."""
        return any(self.frames[i].asked is not None for i in views)

    def surface_information(self, frame: int) -> np.ndarray:
        """Exact information [S,P] of a view about the surface before training."""
        return self._exact_on_surface(self.cameras[frame])

    def _exact_on_surface(self, camera: Camera) -> np.ndarray:
        fisher = self.operations.exact or self.operations.fisher
        return fisher(self.start, camera)[: self.on_surface, : len(self.prior_lam)]

    def view_information(self, model: Gaussians) -> Callable[[int], np.ndarray]:
        """A function frame -> information [N,P] of its view at a model.

        Where several choices are about one model, in batches and plans of a flight, results are
        kept within VIEW_BYTES.
        """
        fisher, cameras = self.operations.fisher, self.cameras
        if self.settings.batch == 1 and not self.settings.flies:
            return lambda i: fisher(model, cameras[i])
        # Copies: the kernel's array has padded rows, and Dr.Jit keeps its memory when it is freed.
        return kept_within(
            VIEW_BYTES, lambda i: np.array(fisher(model, cameras[i])), lambda F: F.nbytes
        )

    def context(
        self,
        state: Fitted,
        left: list[int],
        fisher: Callable[[int], np.ndarray] | None = None,
    ) -> PolicyContext:
        """Context of the policy's choice among the frames in `left`.

        fisher(frame): information of its view at the model, computed by default.
        """
        fisher = fisher or self.view_information(state.gaussians)
        step = len(state.taken) - self.settings.seeds + 1

        def shown(view: int) -> int:
            done = left.index(view) if view in left else 0
            self.progress("scoring candidates", done, len(left))
            return view

        estimate = self.operations.estimate
        self.progress("scoring candidates", 0, len(left))
        return PolicyContext(
            positions=self.positions,
            candidate_frames=left,
            taken_frames=state.taken,
            centre=self.centre,
            rng=generator(self.settings.seed, f"{label(self.settings.policy)}/{step}"),
            H=state.H,
            lam=self.lam,
            points=self.points,
            surface_H=state.surface,
            prior_lam=self.prior_lam,
            information=lambda view: fisher(shown(view)),
            surface_information=lambda view: self.visibility.information(shown(view)),
            estimate=lambda view, name: estimate(state.gaussians, self.cameras[shown(view)], name),
            seen=lambda view: self.visibility.seen(shown(view)),
            dome=lambda: self.visibility.dome(),
            gains=lambda *given: self.visibility.gains(*given),
        )
