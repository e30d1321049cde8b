"""Limits of a flight, which starts at the first view taken, its home, and ends there."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mgs.errors import InputError
from mgs.policy import poses, tour
from mgs.policy.criteria import Array
from mgs.run.settings import FlightLimits, Mission
from mgs.scene import Scene, State


def allowed(scene: Scene, mission: Mission, positions: Array | None = None) -> NDArray[np.bool_]:
    """Whether the camera may be at each position [V,3], by default of the frames: outside `no_fly`,
    above `clearance`."""
    if positions is None:
        positions = scene.positions(scene.frames)
    out = np.linalg.norm(positions[:, :2] - scene.centre[:2], axis=1)
    inside = out >= (mission.flight.no_fly or 0.0)
    if mission.flight.clearance is not None:
        inside &= positions[:, 2] >= scene.ground + mission.flight.clearance
    return np.asarray(inside)


def free(scene: Scene, state: State, mission: Mission) -> list[int]:
    """Views that are allowed, and neither taken nor given up."""
    key = "allowed", mission.flight.no_fly, mission.flight.clearance
    may = scene.once(key, lambda: allowed(scene, mission))
    views = range(len(state.frames))
    return [i for i in views if may[i] and i not in state.taken and not state.frames[i].given_up]


def reachable(scene: Scene, state: State, mission: Mission) -> list[int]:
    """Views of `free` within the limits of the flight; with the setting `nearest`, those nearest to
    the last view."""
    views = free(scene, state, mission)
    if mission.flies:
        views = flight_of(scene, state, mission).in_reach(state.taken, views)
    if mission.nearest is None:
        return views
    positions = scene.positions(state.frames)
    near = poses.nearest_poses(positions[views], positions[state.taken[-1]], mission.nearest)
    return [views[k] for k in near]


def views_left(state: State, mission: Mission) -> int:
    return mission.budget - state.step


def flight_of(scene: Scene, state: State, mission: Mission) -> "Flight":
    home, skipped = state.taken[max(state.skipped - 1, 0)], state.skipped
    no_fly = mission.flight.no_fly or 0.0

    def legs() -> NDArray[np.float64]:
        return tour.legs(scene.positions(state.frames), scene.centre[:2], no_fly)

    matrix = scene.latest("legs", (state.moved, no_fly), legs)
    key = state.moved, mission.flight, home, skipped
    return scene.latest("flight", key, lambda: Flight(mission.flight, matrix, home, skipped))


def check_seeds(scene: Scene, mission: Mission) -> None:
    """Raise InputError where the flight over the seeds and home exceeds the limits."""
    seeds, limits = seed_views(scene, mission), mission.flight
    positions = scene.positions(scene.frames)
    matrix = tour.legs(positions, scene.centre[:2], limits.no_fly or 0.0)
    flight = Flight(limits, matrix, seeds[0])
    metres = flight.metres(seeds)
    if flight.share(metres, len(seeds)) > 1:
        seconds = metres / limits.speed + limits.hover * len(seeds)
        long = f"the flight over {len(seeds)} seeds and home takes {metres:.1f} m, {seconds:.0f} s"
        cure = "raise `flight.length` or `flight.time`, or lower `seeds`"
        raise InputError(f"nbv: {long}; {cure}")


def seed_views(scene: Scene, mission: Mission) -> list[int]:
    """Views to begin with, spread over the directions of the near poses allowed. Raises InputError
    if fewer are allowed than seeds are needed."""
    may = np.flatnonzero(allowed(scene, mission))
    if len(may) < mission.seeds:
        allow = f"flight.no_fly and flight.clearance allow {len(may)} of {len(scene.frames)} poses"
        few = f"{allow}, fewer than {mission.seeds} seeds; lower one of them"
        raise InputError(f"{scene.dataset.root}: {few}")
    return scene.seeds(mission.seeds, may.tolist())


@dataclass(frozen=True)
class Flight:
    """The legs of a flight, metres [V,V] (`mgs.policy.tour.legs`), and its limits.

    home: pose where it ends. skipped: number of views taken before it; it starts at the last one.
    tours: policies and the stops that they planned, by policy (`id`), most stops, views taken and
    candidates."""

    limits: FlightLimits
    legs: NDArray[np.float64]
    home: int
    skipped: int = 0
    tours: dict[Any, tuple[Any, list[int]]] = field(default_factory=dict)

    def share(self, metres: float | Array, pictures: int) -> NDArray[np.float64]:
        """Share of the limits that a flight of this length and number of pictures takes."""
        seconds = np.asarray(metres) / self.limits.speed + self.limits.hover * pictures
        of_length = np.asarray(metres) / (self.limits.length or np.inf)
        return np.maximum(of_length, seconds / (self.limits.time or np.inf))

    def flown(self, taken: Sequence[int]) -> float:
        """Metres from the start to the last view taken."""
        return tour.tour_length(self.legs, taken[max(self.skipped - 1, 0) :])

    def metres(self, taken: Sequence[int]) -> float:
        return self.flown(taken) + float(self.legs[taken[-1], self.home])

    def share_from(self, taken: Sequence[int], most: int) -> tour.Share:
        """Share of the limits that the flight takes with a tour after the views taken; infinite
        with more than `most` stops."""
        flown, pictures = self.flown(taken), len(taken) - self.skipped

        def share(metres: Array, stops: int) -> NDArray[np.float64]:
            whole = self.share(flown + metres, pictures + stops)
            return whole if stops <= most else np.full_like(whole, np.inf)

        return share

    def in_reach(self, taken: Sequence[int], stops: Sequence[int]) -> list[int]:
        """The stops that leave enough of the limits to come home."""
        metres = self.flown(taken) + self.legs[taken[-1], stops] + self.legs[stops, self.home]
        metres = np.maximum(metres, self.metres(taken))  # as `tour.insertions`: no stop is a gain
        fits = self.share(metres, len(taken) - self.skipped + 1) <= 1
        return [stop for stop, fit in zip(stops, fits, strict=True) if fit]
