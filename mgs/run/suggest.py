"""`mgs suggest` for programs: rank candidate poses by a run's model, and plan a flight over some.

The model is a coarse one: about COARSE of its Gaussians, larger by the ratio of their spacings, in
smaller images in which they are as large as before."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mgs.camera import Camera
from mgs.colour import SH_C0
from mgs.data.clouds import read_cloud
from mgs.data.frames import Frame
from mgs.data.structure import CLOUD
from mgs.errors import InputError
from mgs.gaussians import Gaussians
from mgs.learning import information, surface_information
from mgs.memory import VIEW_BYTES, kept_within
from mgs.policy import criteria, tour
from mgs.policy.certificate import Certificate
from mgs.policy.directional import squared_weights
from mgs.prior.build import Prior
from mgs.progress import Progress, listening, no_progress, report
from mgs.run.candidates import Named, Site, refusals, way_to
from mgs.run.choosing import plan_flight, rated
from mgs.run.flight import allowed, flight_of, free, reachable
from mgs.run.folder import Run
from mgs.run.loop import appraised, choose_batch
from mgs.run.policies import Policy
from mgs.run.policy_file import in_file, is_function, name_of, policy_of
from mgs.run.refine import refined
from mgs.run.settings import NbvSettings, check_settings, validated
from mgs.run.worth import certificate, enough_views
from mgs.scene import Choice, Scene, State
from mgs.splat import fisher_derivatives

COARSE = 8000  # Gaussians on the surface by which candidates are rated, about; chosen
FINE = 320  # most pixels of an image's width of a model that is not thinned; chosen


@dataclass(frozen=True)
class View:
    """A candidate and what its picture would give.

    score: the policy's. information_gain: Eq. 7 (`mgs.policy.criteria.d_optimal`). unseen, unknown:
    share of what it shows, by squared blending weight, that no image shows, and mean share of the
    prior's variance that is left there. distance: from the last image taken. azimuth, elevation:
    from the middle of the object, degrees; azimuth 0 is +X of the upright world. way: as `way_to`.
    planned: place in the order of choice, from 1; 0 if not planned. moved: distance from the
    candidate, where `refine` moved it."""

    name: str
    camera: Camera
    score: float
    information_gain: float
    unseen: float
    unknown: float
    distance: float
    azimuth: float
    elevation: float
    way: str
    planned: int = 0
    moved: float = 0.0


@dataclass(frozen=True)
class Suggestion:
    """Candidates in the order of their scores, and the planned ones in flying order.

    A planned view's score and gain are those with the views chosen before it. metres: length of the
    flight from the first image taken through the plan and back; seconds: its time. dropped:
    reasons for which candidates cannot be flown, with their numbers. corners: points of the way
    before each planned view and before home, where it leads around the no-fly cylinder.
    policy: its name. certificate: bounds of the plan by its criterion, with prices in the order of
    `ranking`; None where the policy has none, or all candidates are planned. refined: gain of the
    plan by Eq. 7 before and after its poses moved; None without `refine`."""

    ranking: list[View]
    plan: list[View]
    metres: float
    seconds: float
    dropped: dict[str, int]
    corners: list[NDArray[np.float64]]
    policy: str
    certificate: Certificate | None = None
    refined: tuple[float, float] | None = None


def suggest(
    run: Run,
    poses: Sequence[Named],
    views: int | Literal["auto"] = 1,
    *,
    safe_distance: float = 0.0,
    elevations: tuple[float, float] | None = None,
    refine: bool = False,
    progress: Progress | None = None,
    **settings: Any,
) -> Suggestion:
    """Rank poses by what a picture from each would add to the model of a run, and plan `views`.

    views: "auto" for the fewest that have the share `enough` of the gain of all candidates; with a
    limit of the flight the most. The flight starts and ends at the first image taken.
    safe_distance, elevations: as `refusals`. refine: move planned poses by `refined`; scores and
    certificate are those of the candidates. settings: fields of `NbvSettings` in place of the
    run's. Raises InputError if fewer poses can be flown than `views`, a setting is invalid, or the
    policy fails."""
    policy, own = settings.pop("policy", None) or run.policy, run.settings.policy
    if policy is None and (in_file(own) or is_function(own)):
        raise InputError(f"{run.folder}: its policy is a program, {own}; name it with `policy`")
    settings |= {} if policy is None else {"policy": name_of(policy)}
    images, site = taken_in_order(run), site_of(run)
    taken = [frame.camera for frame in images]
    with listening(progress):
        why = refusals(poses, taken, site, safe_distance, elevations)
    flyable = [pose for pose, reason in zip(poses, why, strict=True) if not reason]
    dropped = {reason: why.count(reason) for reason in dict.fromkeys(why) if reason}
    most = len(flyable) if views == "auto" else views
    mission = _settings(run, len(taken), min(most, len(flyable)), settings)
    _check_left(len(poses), len(flyable), dropped, most, mission.flies)
    rule = policy_of(policy or mission.policy)
    with listening(progress):
        scene, state = _coarse_scene(run, images, flyable, mission)
        scene.__dict__["ground"] = site.ground  # the mesh of a whole scene is a ball
        weights = _weights(scene, state, len(taken))
        may = allowed(scene, mission)
        blind = [i for i, seen in weights.items() if not seen.any()]
        ruled_out = [i for i in weights if not may[i] and i not in blind]
        more = {"sees nothing of the object": blind}
        more["ruled out by flight.no_fly or flight.clearance"] = ruled_out
        dropped |= {reason: len(some) for reason, some in more.items() if some}
        frames = [replace(frame, given_up=i in blind) for i, frame in enumerate(state.frames)]
        state = replace(state, frames=tuple(frames))
        stops = free(scene, state, mission)
        _check_left(len(poses), len(stops), dropped, 1 if views == "auto" else most, mission.flies)
        if views == "auto":
            most = enough_views(scene, state, rule, mission)
            mission = mission.model_copy(update={"budget": most, "batch": max(most, 2)})
        in_words = partial(way_to, images=images, site=site, unit=run.dataset.unit)
        describe = _describer(scene, state, flyable, weights, in_words)
        every = rated(scene, state, rule, stops)
        rated_views = [(view, score) for view, score in every if score > -np.inf]
        if excluded := len(every) - len(rated_views):
            dropped["excluded by the policy"] = excluded
        ranking = [describe(appraised(scene, state, view, score)[0]) for view, score in rated_views]
        choices, way = _plan(scene, state, rule, mission)
        order = [view for view, _ in rated_views]
        worth, gains = certificate(scene, state, rule, mission, way[1:-1], order), None
        if refine:
            limits = taken, site, safe_distance, elevations

            def flies(camera: Camera) -> bool:
                with listening(no_progress):  # of the walls, for each pose that is tried
                    return refusals([("", camera)], *limits) == [""]

            report("moving the poses", 0, 1)
            state, gains = refined(scene, state, mission, way, scene.derivatives, flies)
            weights, planned = _weights(scene, state, len(taken)), state
            for k, choice in enumerate(choices):
                choices[k], planned = appraised(scene, planned, choice.view, choice.score)
            describe = _describer(scene, state, flyable, weights, in_words)
        chosen = {choice.view: (choice, k) for k, choice in enumerate(choices, 1)}
        plan = [describe(*chosen[view]) for view in way[1:-1]]
    radius, axis = mission.flight.no_fly or 0.0, scene.centre[:2]
    ends = scene.positions(state.frames)[way]
    corners = [tour.leg_corners(a, b, axis, radius) for a, b in pairwise(ends)]
    metres = tour.tour_length(flight_of(scene, state, mission).legs, way)
    seconds = metres / mission.flight.speed + mission.flight.hover * len(plan)
    return Suggestion(ranking, plan, metres, seconds, dropped, corners, rule.name, worth, gains)


def site_of(run: Run) -> Site:
    """The object of a run, or its whole scene, and the points that its images show."""
    prior, data = run.prior, run.dataset
    shown = prior.points[: prior.numbers.get("triangulated", 0)]
    whole, points = run.of_scene and len(shown) > 0, None
    if whole:
        points = shown
    elif (cloud := data.root / CLOUD).is_file():
        points = read_cloud(cloud).upright(data.world).points
    return Site(prior, run.taken[-1].camera, data.world, points, whole)


def taken_in_order(run: Run) -> list[Frame]:
    """The images of a run in the order in which they were taken; seeds alone by their time."""
    if len(run.taken) > run.settings.seeds:
        return run.taken
    return sorted(run.taken, key=lambda frame: (frame.timestamp, frame.name))


def _settings(run: Run, taken: int, views: int, given: dict[str, Any]) -> NbvSettings:
    fixed = {"seeds": taken, "budget": views, "batch": max(views, 2)}
    free = dict.fromkeys(["travel", "nearest", "stop_gain", "stop_uncertainty", "stop_psnr"])
    own = run.settings.model_dump()
    own["train"]["density"] = "fixed"  # nothing is fitted
    limits = {"flight": own["flight"] | dict(given.get("flight", {}))}
    settings = validated(NbvSettings, own | free | given | limits | fixed)
    check_settings(settings, taken + views)
    return settings


def _check_left(count: int, left: int, dropped: dict[str, int], views: int, flies: bool) -> None:
    reasons = "; ".join(f"{number} {why}" for why, number in dropped.items()) or "none was dropped"
    if not left:
        none = f"none of the {count} candidates can be flown ({reasons})"
        raise InputError(f"suggest: {none}; give others")
    if left < views and not flies:
        raise InputError(f"suggest: views {views} of {left} candidates ({reasons}); lower it")


def _weights(scene: Scene, state: State, taken: int) -> dict[int, NDArray[np.float32]]:
    """Squared blending weights of the surface's Gaussians in each candidate, by its index."""
    weights, count = {}, len(scene.frames)
    for i in range(taken, count):
        report("looking from the candidates", i - taken, count - taken)
        weights[i] = squared_weights(scene.information(state, i))[: len(scene.prior.points)]
    return weights


def _describer(
    scene: Scene,
    state: State,
    poses: Sequence[Named],
    weights: dict[int, Any],
    way: Callable[[Camera], str],
) -> Callable[..., View]:
    """A function (choice, place in the plan or 0) -> `View`."""
    unseen = ~criteria.observed(state.surface, scene.surface_lam)
    uncertain = criteria.uncertainty(state.H, scene.lam)[: len(scene.prior.points)]
    taken, positions = len(state.taken), scene.positions(state.frames)

    def describe(choice: Choice, planned: int = 0) -> View:
        seen, (name, camera) = weights[choice.view], poses[choice.view - taken]
        frame = state.frames[choice.view]
        shift = frame.camera.position - (frame.asked or frame.camera).position
        camera = replace(camera, world_to_camera=frame.camera.world_to_camera)
        x, y, z = offset = positions[choice.view] - scene.centre
        return View(
            name,
            camera,
            score=choice.score,
            information_gain=choice.information_gain,
            unseen=float(seen[unseen].sum() / seen.sum()),
            unknown=float((seen * uncertain).sum() / seen.sum()),
            distance=float(np.linalg.norm(positions[choice.view] - positions[taken - 1])),
            azimuth=float(np.degrees(np.arctan2(y, x)) % 360),
            elevation=float(np.degrees(np.arcsin(z / np.linalg.norm(offset)))),
            way=way(camera),
            planned=planned,
            moved=float(np.linalg.norm(shift)),
        )

    return describe


def _plan(
    scene: Scene, state: State, policy: Policy, mission: NbvSettings
) -> tuple[list[Choice], list[int]]:
    """The views of the plan in order of choice, and the way: indices of its poses in flying order,
    from home to home."""
    flight = flight_of(scene, state, mission)
    if mission.flies:
        if not reachable(scene, state, mission):
            beyond = "no candidate is within the limits of the flight"
            raise InputError(f"suggest: {beyond}; raise `flight.length` or `flight.time`")
        choices, planned = list[Choice](), state
        for view, score in plan_flight(scene, state, policy, mission):
            choice, planned = appraised(scene, planned, view, score)
            choices.append(choice)
        order = [choice.view for choice in choices]
    else:
        _, choices, _ = choose_batch(scene, state, policy, mission)
        order = [choice.view for choice in choices]
        order = tour.flying_order(flight.legs, flight.home, order, flight.home)
    return choices, [flight.home, *order, flight.home]


@dataclass(frozen=True, eq=False)
class _CoarseScene(Scene):
    """A scene whose information is about one model; no image of it is read.

    factor: ratio of the information of an image at its own size to that of a view."""

    model: Gaussians | None = None
    factor: float = 1.0

    def initial(self, frames: Sequence[Frame]) -> Gaussians:
        assert self.model is not None
        return self.model

    def fisher(self, model: Gaussians, camera: Camera, estimator: str = "exact") -> np.ndarray:
        return self._measured((camera, estimator))

    def derivatives(self, camera: Camera) -> np.ndarray:
        """Derivatives of `fisher` by the camera [7,N,Q], without columns of means."""
        return self.factor * fisher_derivatives(self.initial(()), camera, cache=self.cache)

    @cached_property
    def _measured(self) -> Callable[[tuple[Camera, str]], np.ndarray]:
        def measure(key: tuple[Camera, str]) -> np.ndarray:
            F = super(_CoarseScene, self).fisher(self.initial(()), *key)
            return np.asarray(F * np.float32(self.factor))

        return kept_within(VIEW_BYTES, measure, lambda F: F.nbytes)


def _coarse_scene(
    run: Run, images: Sequence[Frame], poses: Sequence[Named], settings: NbvSettings
) -> tuple[_CoarseScene, State]:
    """Scene of the images taken, then the poses, with a coarse model; and its state, whose last
    view is the first image, where the flight starts."""
    whole = run.state.gaussians
    own = run.prior if run.settings.train.density == "fixed" else _on_model(run.prior, whole)
    prior, rows = coarse_prior(own)
    thinning = len(prior.points) / len(own.points)
    model = _coarse(whole, rows, thinning)
    width = max(round(images[0].camera.width * thinning**0.5), 1)

    def small(camera: Camera) -> Camera:
        return camera.resized(max(min(camera.width, width if thinning < 1 else FINE), 16))

    frames = [replace(frame, camera=small(frame.camera)) for frame in images]
    frames += [Frame(f"{name}/candidate", small(camera), 0.0, Path(name)) for name, camera in poses]
    dataset = replace(run.dataset, frames=tuple(frames))
    count, ratio = len(images), images[0].camera.width / frames[0].camera.width
    scene = _CoarseScene(dataset, prior, settings, model=model, factor=ratio**2 * thinning)
    taken = (*range(1, count), 0)
    H = information(scene, model, [frames[i] for i in taken])
    state = State(scene.frames, taken, count, model, H, H, skipped=count)
    return scene, replace(state, surface=surface_information(scene, state, taken))


def _on_model(prior: Prior, model: Gaussians) -> Prior:
    """A prior with a sample at each Gaussian of a model whose Gaussians are no longer its own."""
    near = cKDTree(prior.points).query(model.means)[1]
    return replace(prior, points=model.means, normals=prior.normals[near], backed=0)


def coarse_prior(prior: Prior, most: int = COARSE) -> tuple[Prior, NDArray[np.int64]]:
    """About `most` samples of a prior, one in each cell of a grid, and their indices. A prior with
    at most as many is returned as it is, with all indices."""
    count = len(prior.points)
    if count <= most:
        return prior, np.arange(count)
    low, high = prior.spacing, prior.spacing * count
    rows = np.arange(count)
    while len(rows) > most or high / low > 1.05:
        cell = np.sqrt(low * high)
        cells = np.floor((prior.points - prior.points.min(axis=0)) / cell).astype(np.int64)
        x, y, z = cells.T
        _, y_size, z_size = cells.max(axis=0) + 1
        rows = np.sort(np.unique((x * y_size + y) * z_size + z, return_index=True)[1])
        low, high = (cell, high) if len(rows) > most else (low, cell)
    thinned = replace(
        prior,
        points=prior.points[rows],
        normals=prior.normals[rows],
        spacing=prior.spacing * float(np.sqrt(count / len(rows))),
        backed=0,
    )
    return thinned, rows


def _coarse(model: Gaussians, rows: np.ndarray, thinning: float) -> Gaussians:
    """Gaussians of a model for the samples of a coarse prior. None is black: a colour that is
    clamped at 0 has no information."""
    some = model if thinning == 1 else model[rows]
    grown = some.log_scales - np.float32(0.5 * np.log(thinning))
    return replace(some, log_scales=grown, sh=np.maximum(some.sh, np.float32(-0.49 / SH_C0)))
