"""Steps of the loop at the model: capture views, fit to them, and sum their information."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mgs.data.frames import Frame
from mgs.errors import InputError
from mgs.fit.evidence import Images
from mgs.fit.fitting import Fit
from mgs.fit.objective import objective
from mgs.fit.poses import INDEPENDENT, ROUND, ROUNDS, motion_std, pose_steps, tau
from mgs.fit.settings import PoseNoise, TrainSettings
from mgs.fit.stopping import DivergedError, StopReason
from mgs.gaussians import Gaussians
from mgs.policy.poses import azimuths
from mgs.prior.initial import warm_start
from mgs.progress import Stage, report
from mgs.scene import Choice, Scene, State
from mgs.splat import as_drjit


def captured(scene: Scene, frames: tuple[Frame, ...], views: Sequence[int]) -> tuple[Frame, ...]:
    """Capture the images of some views: the frames afterwards, up to the first given up."""
    result = list(frames)
    for done, i in enumerate(views):
        report(Stage.CAPTURE, done, len(views))
        result[i] = scene.capture(frames[i])
        if result[i].given_up:
            break
    return tuple(result)


def fit_views(
    scene: Scene,
    frames: Sequence[Frame],
    taken: Sequence[int],
    before: State | None = None,
    train: TrainSettings | None = None,
) -> tuple[Fit, np.ndarray | None]:
    """Fit to the views taken; returns the fit, and the exposure of these views [V,3], if estimated.

    frames: all frames, those taken as they were captured. before: the last state, where the fit
    starts; by default it starts at the prior. train: settings of the fit, by default the scene's.
    """
    shown = tuple(frames[i] for i in taken)
    gains = scene.measured_exposure(shown) if scene.settings.exposure else None
    model, settings = scene.start(shown), scene.settings.train
    if before is not None:
        old = scene.start(tuple(frames[i] for i in before.taken))
        model, settings = warm_start(before.gaussians, old, model), scene.settings.train_at(1)
    return scene.fitted(model, shown, gains, train or settings), gains


def learn(
    scene: Scene,
    taken: Sequence[int],
    before: State | None = None,
    frames: tuple[Frame, ...] | None = None,
    choices: Sequence[Choice] = (),
    surface: np.ndarray | None = None,
) -> State:
    """Capture the views that are new in `taken`, fit to all of `taken`, and sum their information.

    before: the last state, whose views `taken` begins with, and where the fit starts; by default it
    starts at the prior, and all of `taken` are seeds. frames: those of `before`, by default, or as
    they are before any capture. choices: recorded in the result. surface: `State.surface` after the
    views in `taken`, if it was measured when they were chosen. Raises DivergedError, and InputError
    if `taken` are no different frames, or one cannot be read."""
    taken, count = tuple(taken), len(scene.frames)
    if not taken or len(set(taken)) < len(taken) or not set(taken) <= set(range(count)):
        raise InputError(f"taken {list(taken)}: give different indices of the {count} frames")
    if before and taken[: len(before.taken)] != before.taken:
        raise InputError(f"taken {list(taken)}: begin with those of `before`, {before.taken}")
    seeds = before.seeds if before else len(taken)
    if frames is None:
        frames = before.frames if before else scene.frames
    new = taken[len(before.taken) :] if before else taken
    frames = captured(scene, frames, new)
    read = scene.image if scene.settings.exposure else scene.target
    for done, i in enumerate(new):
        report(Stage.READ, done, len(new))
        read(frames[i])
    fit, exposure = fit_views(scene, frames, taken, before)
    if fit.stop_reason == StopReason.DIVERGED:
        raise DivergedError(len(taken) - seeds, fit.losses)
    H = information(scene, fit.gaussians, [frames[i] for i in taken])
    state = State(frames, taken, seeds, fit.gaussians, H, H, fit=fit, exposure=exposure)
    if surface is None or before is None or state.moved != before.moved:
        surface = surface_information(scene, state, new, before)
    return replace(state, surface=surface, choices=tuple(choices))


def refine_poses(scene: Scene, noise: PoseNoise) -> tuple[Frame, ...]:
    """All frames with refined poses: fits and Gauss-Newton steps of the poses (`mgs.fit.poses`)
    take turns. Raises InputError if a fit diverges or a frame cannot be read."""
    frames = scene.frames
    settings = scene.settings
    train = settings.train.model_copy(update=ROUND)
    poses = [frame.camera for frame in frames]
    std = most = tau(noise, poses, scene.centre)
    pixels = np.array([[camera.width * camera.height] for camera in poses])
    variance = settings.pixel_noise**2 * pixels / INDEPENDENT
    model = old = scene.start(frames)
    for k in range(ROUNDS):
        start = scene.start(frames)
        model = warm_start(model, old, start)
        gains = scene.measured_exposure(frames) if settings.exposure else None
        fit = scene.fitted(model, frames, gains, train)
        if fit.stop_reason == StopReason.DIVERGED:
            raise InputError("refine_poses: a fit diverged; lower `train.rates`, or leave it out")
        report("refining poses", k, ROUNDS)
        model, old = fit.gaussians, start
        cameras = [frame.camera for frame in frames]
        targets, weight = scene.targets_for(model, frames, gains, train), train.alpha_weight
        goal = objective(model, cameras, targets, cache=scene.cache, alpha_weight=weight)
        moved = pose_steps(goal, as_drjit(model), poses, variance / std**2)
        std = motion_std(poses, moved, most)
        pairs = zip(frames, moved, strict=True)
        frames = tuple(replace(frame, camera=camera) for frame, camera in pairs)
    return frames


def information(scene: Scene, model: Gaussians, frames: Sequence[Frame]) -> np.ndarray:
    """Sum the Fisher information of frames at a model: H [N,P], diagonal of J^T J."""
    H = np.zeros((len(model), len(scene.lam)))
    for done, frame in enumerate(frames):
        report(Stage.INFORMATION, done, len(frames))
        H += scene.fisher(model, frame.camera, scene.settings.estimator)
    return H


def surface_information(
    scene: Scene, state: State, new: Sequence[int], before: State | None = None
) -> np.ndarray:
    """`State.surface` after new views; it depends on poses and the prior alone."""
    surface = scene.surface(state)

    def exact(done: int) -> np.ndarray:  # not kept: used once
        report(Stage.SURFACE, done, len(new))
        return surface.exact(surface.cameras[new[done]])

    of_views = map(exact, range(len(new)))
    if before is None:
        return np.zeros((len(scene.prior.points), len(scene.surface_lam))) + sum(of_views)
    return sum(of_views, before.surface)


def with_view(scene: Scene, state: State, view: int, F: np.ndarray) -> State:
    """The state as if a view were taken, its model unchanged. F: its information [N,P]."""
    surface = surface_information(scene, state, [view], state)
    return replace(state, taken=(*state.taken, view), H=state.H + F, surface=surface)


def images_of(scene: Scene, frames: Sequence[Frame]) -> Images:
    """Input of a fit to frames by `mgs.fit.evidence`: they start at the scene's prior, with colours
    of degree 0. Raises InputError if a frame cannot be read."""
    flat = replace(scene, settings=scene.settings.model_copy(update={"sh": 0}))
    gains = scene.measured_exposure(frames) if scene.settings.exposure else None
    around = azimuths(scene.positions(frames), scene.centre)

    def start(views: Sequence[int]) -> Gaussians:
        return flat.start(tuple(frames[i] for i in views))

    cameras = [frame.camera for frame in frames]
    order = np.argsort(around, kind="stable").tolist()
    return Images(cameras, flat.targets(frames, gains), start, order)
