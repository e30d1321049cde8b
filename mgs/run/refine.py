"""Move planned poses to the best places near them, by the derivatives of their information."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from mgs.camera import Camera
from mgs.fit.poses import displaced
from mgs.policy import tour
from mgs.policy.criteria import d_optimal
from mgs.run.flight import Flight, allowed
from mgs.run.settings import Mission
from mgs.scene import Scene, State

LARGEST_SHIFT = 0.1
"""Largest shift of a pose over its distance from the object. A chosen constant."""

SHORTEST, MOST = LARGEST_SHIFT / 32, 12
"""Step at which a climb ends, over the distance, and most steps of it. Chosen constants."""

Information = Callable[[Camera], np.ndarray]


def refined(
    scene: Scene,
    state: State,
    mission: Mission,
    way: list[int],
    derivatives: Information,
    flyable: Callable[[Camera], bool],
) -> tuple[State, tuple[float, float]]:
    """State whose planned views, way[1:-1], are each at the best place near them by Eq. 7, and the
    gain of all together before and after.

    A view climbs with the others where they are, within the limits of the flight.
    derivatives(camera): as `mgs.fisher_derivatives`. flyable(camera): other limits of a pose."""
    home, frames = state.frames[way[0]].camera, list(state.frames)

    def F(camera: Camera) -> np.ndarray:
        return scene.fisher(state.gaussians, camera)

    def plan() -> list[Camera]:
        return [frames[view].camera for view in way[1:-1]]

    def may(camera: Camera, view: int) -> bool:
        stops = [camera if i == view else frames[i].camera for i in way[1:-1]]
        at = np.array([stop.position for stop in (home, *stops, home)])
        legs = tour.legs(at, scene.centre[:2], mission.flight.no_fly or 0.0)
        metres = tour.tour_length(legs, range(len(at)))
        inside = allowed(scene, mission, at[1:-1]).all() and flyable(camera)
        return bool(inside and Flight(mission.flight, legs, 0).share(metres, len(stops)) <= 1)

    before = d_optimal(sum(map(F, plan())), state.H, scene.lam)  # type: ignore[arg-type]
    for view in way[1:-1]:
        old = frames[view].camera
        H = state.H + sum(map(F, plan())) - F(old)

        def gain(camera: Camera, H: np.ndarray = H) -> float:
            return d_optimal(F(camera), H, scene.lam)

        def slope(camera: Camera, H: np.ndarray = H) -> np.ndarray:
            # d Eq. 7 = sum of dF / (H + F + lam); means have no derivatives.
            dF = derivatives(camera)[:6]
            weights = 1 / (H + F(camera) + scene.lam)[:, : dF.shape[2]]
            return np.tensordot(dF, weights, 2)

        new = _climb(old, scene.centre, gain, slope, partial(may, view=view))
        if new is not old:
            frames[view] = replace(frames[view], camera=new, asked=old)
    after = d_optimal(sum(map(F, plan())), state.H, scene.lam)  # type: ignore[arg-type]
    return replace(state, frames=tuple(frames)), (before, after)


def _climb(
    camera: Camera,
    centre: np.ndarray,
    gain: Callable[[Camera], float],
    slope: Information,
    may: Callable[[Camera], bool],
) -> Camera:
    """Camera of larger gain near `camera`, or itself: steps uphill, or along one axis uphill,
    halved until one raises the gain at a pose that `may` be. `centre` [3] keeps its place in the
    image. slope(camera): derivative of the gain by the pose [6], times any factor."""
    best, value, reach = camera, gain(camera), float(np.linalg.norm(centre - camera.position))
    step = LARGEST_SHIFT / 2 * reach
    for _ in range(MOST):
        by_turn, by_shift = slope(best).reshape(2, 3)
        # A shift t turns the camera by -(c x t) / |c|^2, with c the centre in its axes.
        c = best.world_to_camera[:3, :3] @ (centre - best.position)
        turns = np.cross(np.eye(3), c) / (c @ c)  # row k: of a unit shift along axis k
        uphill = by_shift + turns @ by_turn
        ways = [way / max(np.linalg.norm(way), 1e-300) for way in (uphill, *np.diag(uphill))]
        start = best
        while best is start and step > SHORTEST * reach:
            for way in ways:
                there = displaced(start, step * np.r_[way @ turns, way])
                near = np.linalg.norm(there.position - camera.position) <= LARGEST_SHIFT * reach
                if near and may(there) and gain(there) > value:
                    best, value = there, gain(there)
                    break
            else:
                step /= 2
        if best is start:
            break
    return best
