"""Limits of a flight: which poses a camera may take, and how far it still comes.

A flight starts at the first view taken, its home, and ends there. `FlightLimits.length` and `time`
limit the whole flight, `no_fly` and `clearance` each pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mgs.policy import tour
from mgs.policy.criteria import Array
from mgs.run.settings import FlightLimits


def allowed_poses(
    positions: Array, centre: Array, ground: float, limits: FlightLimits
) -> NDArray[np.bool_]:
    """Whether the camera may be at each position [V,3]: outside `no_fly`, above `clearance`.

    centre: middle of the object [3]. ground: height of its lowest point. Metres, +Z up.
    """
    out = np.linalg.norm(positions[:, :2] - centre[:2], axis=1)
    allowed = out >= (limits.no_fly or 0.0)
    if limits.clearance is not None:
        allowed &= positions[:, 2] >= ground + limits.clearance
    return np.asarray(allowed)


@dataclass(frozen=True)
class Flight:
    """The legs of a flight, metres [V,V] (`mgs.policy.tour.legs`), and its limits.

    home: pose where it ends. skipped: number of views taken before it; it starts at the last one.
    tours: those planned, by the views taken and the candidates.
    """

    limits: FlightLimits
    legs: NDArray[np.float64]
    home: int
    skipped: int = 0
    tours: dict[tuple[tuple[int, ...], tuple[int, ...]], list[int]] = field(default_factory=dict)

    def share(self, metres: float | Array, pictures: int) -> NDArray[np.float64]:
        """Share of the limits that a flight of this length and number of pictures takes."""
        seconds = np.asarray(metres) / self.limits.speed + self.limits.hover * pictures
        of_length = np.asarray(metres) / (self.limits.length or np.inf)
        return np.maximum(of_length, seconds / (self.limits.time or np.inf))

    def flown(self, taken: Sequence[int]) -> float:
        """Metres from the start to the last view taken."""
        return tour.tour_length(self.legs, taken[max(self.skipped - 1, 0) :])

    def metres(self, taken: Sequence[int]) -> float:
        """Metres through all views taken, and home."""
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
        fits = self.share(metres, len(taken) - self.skipped + 1) <= 1
        return [stop for stop, fit in zip(stops, fits, strict=True) if fit]
