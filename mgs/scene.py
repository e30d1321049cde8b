"""`Scene`, which stays fixed in a run, and `State`, which each step makes anew."""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from mgs.camera import Camera
from mgs.data.dataset import Dataset, target_of
from mgs.data.frames import Frame, as_asked, has_masks
from mgs.errors import InputError
from mgs.fit.fitting import Fit, fit_gaussians
from mgs.fit.objective import Target, as_target
from mgs.fit.settings import ALPHA_WEIGHT, ModelSettings, TrainSettings
from mgs.fit.unfinished import Unfinished
from mgs.gaussians import ARRAYS, Gaussians
from mgs.memory import IMAGE_BYTES, KEPT_BYTES, Deferred, kept_within, release
from mgs.policy import poses
from mgs.policy.visibility import Visibility, one_in
from mgs.prior.build import Prior
from mgs.prior.exposure import exposure_of, without_gain
from mgs.prior.initial import colours_of, initial_gaussians, pixel_on
from mgs.progress import Stage, report
from mgs.provenance import source_digest, versions
from mgs.seeds import generator
from mgs.splat import ListCache, fisher, groups, render
from mgs.splat.information import fisher_of_colours
from mgs.survey.fusion import focus

Value = TypeVar("Value")


def _key_of_fit(
    model: Gaussians,
    start: Gaussians,
    frames: Sequence[Frame],
    gains: np.ndarray | None,
    train: TrainSettings,
    lam: Mapping[str, Any],
) -> str:
    """Hash of all that decides a fit, with the content of files and of mgs, and the versions of
    libraries."""
    about = [versions(), source_digest(), train.model_dump(mode="json")]
    settings = json.dumps(about, sort_keys=True)
    digest = hashlib.sha256(settings.encode())
    models = [(name, getattr(one, name)) for name in ARRAYS for one in (model, start)]
    for name, values in (("gains", gains), *models, *sorted(lam.items())):
        array = np.ascontiguousarray(() if values is None else values)
        digest.update(repr((name, array.shape, array.dtype)).encode() + array.tobytes())
    for frame in frames:
        digest.update(frame.camera.key)
        for path in (frame.image_path, frame.mask_path, frame.rock_path):
            digest.update(hashlib.sha256(path.read_bytes()).digest() if path else b"none")
    return digest.hexdigest()


@dataclass(frozen=True)
class Choice:
    """A chosen view.

    view: its index. score: the policy's own number. information_gain: Eq. 7 of this view by the
    scene's estimator, whatever the policy. coverage: Eq. 9 of all views taken with this one, 0 to
    1."""

    view: int
    score: float
    information_gain: float
    coverage: float


@dataclass(frozen=True, eq=False)
class State:
    """The views taken, the model fitted to them, and their Fisher information.

    - frames: all V frames; those taken as they were captured, some as given up.
    - taken: indices of the views taken, in order. The first `seeds` of them began the run.
    - gaussians: the model. H: [N,P] information of the views taken at it, diagonal of J^T J.
    - surface: [S,P] their exact information about the S Gaussians on the prior's surface, as they
      were before training; without columns of means.
    - skipped: number of views taken before the flight began.
    - fit: how the model was found. exposure: [V,3] gains of the views taken, if estimated.
      choices: the views chosen since the fit before."""

    frames: tuple[Frame, ...]
    taken: tuple[int, ...]
    seeds: int
    gaussians: Gaussians
    H: np.ndarray
    surface: np.ndarray
    skipped: int = 0
    fit: Fit | None = None
    exposure: np.ndarray | None = None
    choices: tuple[Choice, ...] = ()

    @property
    def step(self) -> int:
        """Number of views chosen after the seeds."""
        return len(self.taken) - self.seeds

    @property
    def cameras(self) -> list[Camera]:
        """Cameras of all V frames."""
        return [frame.camera for frame in self.frames]

    @property
    def moved(self) -> tuple[tuple[int, Camera], ...]:
        """Views whose picture was taken from another pose than was asked for, with its camera."""
        return tuple((i, f.camera) for i, f in enumerate(self.frames) if f.asked is not None)


@dataclass(frozen=True, eq=False)
class Scene:
    """Frames, a surface, and how a model of them is fitted.

    - dataset: V frames. prior: the surface on which the Gaussians lie.
    - settings: of fits and of information. Default: `ModelSettings`, with alpha matched where all
      frames have a mask or a rock image.
    - capture(frame): returns the frame once its images exist, which it makes where they do not. Its
      camera is that of the picture; it is `given_up` where there is none to be had.
    - on_pass(done, most, model): called after each pass of a fit.
    - keep: most bytes of the information of views about one model that are kept for several
      choices (`mgs.memory.VIEW_BYTES`).
    - unfinished: file from which an interrupted fit continues.

    Values are computed at their first use and kept. Raises InputError as
    `ModelSettings.regularisation`, and where the prior was built with another upward direction."""

    dataset: Dataset
    prior: Prior
    settings: ModelSettings = None  # type: ignore[assignment]
    capture: Callable[[Frame], Frame] = lambda frame: frame
    keep: int = 0
    on_pass: Callable[[int, int, Gaussians], None] = lambda done, most, model: None
    unfinished: Path | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.dataset, Dataset) or not isinstance(self.prior, Prior):
            call = "mgs.Scene(mgs.load_dataset(FOLDER), mgs.load_prior(FOLDER))"
            raise TypeError(f"Scene: needs a dataset and a prior that are loaded: {call}")
        if self.settings is None:
            weight = ALPHA_WEIGHT if has_masks(self.dataset.frames) else 0.0
            settings = ModelSettings(train=TrainSettings(alpha_weight=weight))
            object.__setattr__(self, "settings", settings)
        own, up = self.prior.world.up, self.dataset.world.up
        if not np.allclose(own, up):
            other = f"was built with up {own}, the dataset has {up}"
            raise InputError(f"prior: {other}; load the dataset with `up` of the prior")

    @cached_property
    def frames(self) -> tuple[Frame, ...]:
        """All frames, with the cameras that a live capture asks for."""
        return tuple(as_asked(frame) for frame in self.dataset.frames)

    @cached_property
    def centre(self) -> np.ndarray:
        """Middle of the object [3], metres; with a random start, what the cameras look at."""
        if self.prior.kind == "random":
            return focus(self.frames).point
        return np.asarray(self.prior.points.mean(axis=0))

    @cached_property
    def ground(self) -> float:
        """Height of the object's lowest point, metres."""
        return float(self.prior.mesh.vertices[:, 2].min())

    @cached_property
    def groups(self) -> dict[str, slice]:
        """Columns of the Fisher information by kind of parameter."""
        return groups(self.settings.sh, self.settings.train.means)

    @cached_property
    def lam(self) -> np.ndarray:
        """Lambda of each parameter [P], the prior's information (`criteria.regularisation`)."""
        return self.settings.regularisation(self.groups)

    @cached_property
    def surface_lam(self) -> np.ndarray:
        """Lambda of the surface before training: without means and without the setting `lam`."""
        return self.settings.regularisation(groups(self.settings.sh), surface=True)

    @cached_property
    def cache(self) -> ListCache:
        return ListCache()

    @cached_property
    def memo(self) -> dict[Any, Any]:
        return {}

    def once(self, key: Any, make: Callable[[], Value]) -> Value:
        """Return make(), computed once for each key."""
        if key not in self.memo:
            self.memo[key] = make()
        return self.memo[key]

    def latest(self, name: str, key: Any, make: Callable[[], Value]) -> Value:
        """Return make(), kept until another key of this name is asked for."""
        if name not in self.memo or self.memo[name][0] != key:
            self.memo[name] = key, make()
        return self.memo[name][1]  # type: ignore[no-any-return]

    def with_seed(self, seed: int) -> "Scene":
        """The same scene with another seed of the policies' draws; computed values are kept."""
        other = copy(self)
        object.__setattr__(other, "settings", self.settings.model_copy(update={"seed": seed}))
        return other

    def rng(self, state: State, name: str) -> np.random.Generator:
        """Random generator of a policy, new in each step."""
        return generator(self.settings.seed, f"{name}/{state.step + 1}")

    # --- The model -------------------------------------------------------------------------------

    @cached_property
    def colours(self) -> Callable[[Frame], Any]:
        """colours(frame) -> which samples of the prior a frame sees, and their colours."""
        size = lambda parts: sum(part.nbytes for part in parts)  # noqa: E731
        return kept_within(IMAGE_BYTES, colours_of(self.prior), size)

    @cached_property
    def measured_exposure(self) -> Callable[[Sequence[Frame]], np.ndarray]:
        """measured_exposure(frames) -> gains [V,3]."""
        return exposure_of(self.prior)

    @cached_property
    def pixel(self) -> float:
        """Size of a pixel of the closest cameras on the surface, metres."""
        return pixel_on(self.prior, self.dataset.cameras)

    def initial(self, frames: Sequence[Frame]) -> Gaussians:
        """Gaussians before training, in the colours of these frames."""
        gains = self.measured_exposure(frames) if self.settings.exposure else None
        train = self.settings.train
        how = self.pixel, gains, self.colours, train.antialiased, train.space == "linear"
        return initial_gaussians(self.prior, frames, *how)[0].with_degree(self.settings.sh)

    @cached_property
    def start(self) -> Callable[[tuple[Frame, ...]], Gaussians]:
        """start(frames) -> `initial`; the last results are kept."""
        return lru_cache(3)(self.initial)

    def untrained(self, state: State) -> Gaussians:
        """Gaussians before training, in the colours of the seeds."""
        return self.start(tuple(state.frames[i] for i in state.taken[: state.seeds]))

    @cached_property
    def target(self) -> Callable[[Frame], Target]:
        """target(frame) -> target of the scene's fits for the kernels, without a gain."""
        train = self.settings.train
        how = train.space == "linear", train.alpha_weight
        make = lambda frame: as_target(target_of(frame, how[1] > 0), *how)  # noqa: E731
        return kept_within(IMAGE_BYTES, make, lambda target: target.nbytes)

    @cached_property
    def image(self) -> Callable[[Frame], np.ndarray]:
        """image(frame) -> target of a fit [H,W,4 or 5] (`mgs.data.dataset.target_of`)."""
        alpha = self.settings.train.alpha_weight > 0
        size = lambda image: image.nbytes  # noqa: E731
        return kept_within(IMAGE_BYTES, lambda frame: target_of(frame, alpha), size)

    def targets(self, frames: Sequence[Frame], gains: np.ndarray | None) -> Sequence[np.ndarray]:
        """Targets of a fit to frames; colours are divided by `gains` [V,3], if given."""

        def target(k: int) -> np.ndarray:
            image = self.image(frames[k])
            return image if gains is None else without_gain(image, gains[k])

        return Deferred(range(len(frames)), target)

    def targets_for(
        self,
        model: Gaussians,
        frames: Sequence[Frame],
        gains: np.ndarray | None,
        train: TrainSettings,
    ) -> Sequence[np.ndarray | Target]:
        """`targets` of a fit of a model. Those of `target`, which fits share, where there are no
        gains, and model and settings are blended and weighted as the scene's."""
        own = self.settings.train
        same = model.linear == (own.space == "linear") and train.alpha_weight == own.alpha_weight
        if gains is not None or not same:
            return self.targets(frames, gains)
        return Deferred(range(len(frames)), lambda k: self.target(frames[k]))

    def fitted(
        self,
        model: Gaussians,
        frames: Sequence[Frame],
        gains: np.ndarray | None = None,
        train: TrainSettings | None = None,
    ) -> Fit:
        """Fit a model to frames; the prior's mean is `start` of these frames. train: settings of
        the fit, by default those of the scene."""
        report(Stage.FIT, 0, 1)
        train = train or self.settings.train
        lam = self.settings.lam_by_kind(self.groups)
        cameras = [frame.camera for frame in frames]

        targets = self.targets_for(model, frames, gains, train)
        start = self.start(tuple(frames))
        self.memo.pop("views", None)  # they are about the model before
        release(KEPT_BYTES)  # what scores took, and then what the fit took
        unfinished = None
        if self.unfinished:
            key = _key_of_fit(model, start, frames, gains, train, lam)
            unfinished = Unfinished(self.unfinished, key)
        fit_ = fit_gaussians(
            *(model, cameras, targets, train, self.on_pass, self.cache, start, lam),
            on_image=partial(report, Stage.FIT),
            unfinished=unfinished,
        )
        release(KEPT_BYTES)
        return fit_

    def render(self, model: Gaussians, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Linear RGB [H,W,3] and alpha [H,W] of a model."""
        image = render(model, camera, cache=self.cache)
        return model.linear_rgb(np.asarray(image.rgb)), np.asarray(image.alpha)

    # --- Information -----------------------------------------------------------------------------

    def fisher(self, model: Gaussians, camera: Camera, estimator: str = "exact") -> np.ndarray:
        """Fisher information of a view about a model [N,P]; no image is read."""
        means = self.settings.train.means
        return fisher(model, camera, estimator, cache=self.cache, means=means)

    def fisher_of_colours(self, model: Gaussians, camera: Camera) -> np.ndarray:
        """Columns of colours of the exact `fisher`, in less time."""
        return fisher_of_colours(model, camera, self.cache)

    def information(self, state: State, view: int, estimator: str | None = None) -> np.ndarray:
        """Information of a view about the model of a state [N,P].

        estimator: a name in `mgs.splat.ESTIMATORS`, by default that of the scene."""
        key = state.frames[view].camera, estimator or self.settings.estimator
        if not self.keep:
            return self.fisher(state.gaussians, *key)
        model, cache = self.memo.get("views", (None, None))
        if model is not state.gaussians:
            # Copies: the kernel's array has padded rows, and Dr.Jit keeps its memory.
            make = lambda key: np.array(self.fisher(state.gaussians, *key))  # noqa: E731
            cache = kept_within(self.keep, make, lambda F: F.nbytes)
            self.memo["views"] = state.gaussians, cache
        return cache(key)

    def surface(self, state: State) -> Visibility:
        """Visibility of the prior's surface from each pose; it depends on poses and prior alone."""
        key = state.taken[: state.seeds], state.moved
        return self.latest("surface", key, lambda: self._visibility(state))

    def plan_surface(self, state: State) -> Visibility:
        """The same for directional gains. Where there are many pairs of a pose and a Gaussian, one
        in k Gaussians, of k times the area, in images of 1/k of the pixels."""
        k = one_in(len(self.prior.points), len(state.frames))
        if k == 1 or any(camera.film is not None for camera in state.cameras):
            return self.surface(state)
        key = state.taken[: state.seeds], state.moved
        return self.latest("plan", key, lambda: self._visibility(state, k))

    def _visibility(self, state: State, k: int = 1) -> Visibility:
        start, cameras = self.untrained(state), state.cameras
        count, columns = len(self.prior.points), len(self.surface_lam)
        if k > 1:
            some = np.r_[0:count:k, count : len(start) : k]
            larger = start.log_scales[some] + np.float32(np.log(k) / 2)
            start, count = replace(start[some], log_scales=larger), len(range(0, count, k))
            cameras = [c.resized(max(1, round(c.width / np.sqrt(k)))) for c in cameras]

        def exact(camera: Camera) -> np.ndarray:
            return self.fisher(start, camera, "exact")[:count, :columns]

        def colour(camera: Camera) -> np.ndarray:
            return self.fisher_of_colours(start, camera)[:count]

        points, lam = start.means[:count], float(self.surface_lam[0])
        return Visibility(cameras, exact, colour, points, self.centre, lam, k)

    def positions(self, frames: Sequence[Frame]) -> np.ndarray:
        """Camera centres [V,3], metres."""
        return np.array([frame.camera.position for frame in frames])

    def seeds(self, count: int, among: Sequence[int] | None = None) -> list[int]:
        """Views to begin with, spread over the directions of near poses (`poses.seed_views`).

        among: indices to choose from, by default all. Raises InputError if they are fewer."""
        views = range(len(self.frames)) if among is None else among
        if not 1 <= count <= len(views):
            most = len(views)
            raise InputError(f"scene: {count} seeds of {most} poses; ask for 1 to {most}")
        positions = self.positions([self.frames[i] for i in views])
        return [int(views[k]) for k in poses.seed_views(positions, self.centre, count)]
