"""Visibility of the prior's surface from camera poses, measured once per run, and plans by it."""

from collections.abc import Callable, Sequence
from functools import cache, cached_property

import numpy as np

from mgs.camera import Camera
from mgs.memory import VIEW_BYTES, kept_within
from mgs.policy.criteria import BETTER, Array
from mgs.policy.directional import Views, dome_cameras, of_points, squared_weights
from mgs.policy.pool_gains import PoolGains
from mgs.policy.poses import nearest_poses
from mgs.policy.relaxation import Relaxation, directional
from mgs.progress import Stage, report

Model = tuple[int, float, bool]
"""SH degree, tau, and whether gains are those of I-optimality over the dome, else D-optimality."""

FEW = 500  # about the number of Gaussians by which a flight is planned; chosen
# Pairs of a pose and a Gaussian: most for which gains of all Gaussians are computed, and about how
# many otherwise. Chosen on training rocks: plans lose next to nothing of the gain by it.
MOST_PAIRS, COARSE_PAIRS = 1 << 22, 1 << 21
MATRICES = 18  # 45 numbers of 16 bytes for a Gaussian, degree 2 (`PoolGains`), over 40 for a pair
WIDTH = 16  # paths that `planned_path` keeps at each step; chosen


class Visibility:
    """Visibility of the Gaussians on a surface from the cameras of a run and from a dome.

    Each view is measured at its first use, and each result kept, that of `exact` only in
    `information`.

    Arguments:
    - cameras: of the run.
    - exact(camera): exact information about the Gaussians before any training [N,P].
      colour(camera): its columns of the colours.
    - points: their means [N,3], metres. centre: middle of the rock [3]. lam: lambda of colours.
    - stands_for: number of Gaussians for which each stands; gains are those of all.

    Attributes:
    - positions: camera centres [V,3], metres.
    - colours(frame): information of one view about the colours of degree 0 [N,3]. seen(frame): its
      squared blending weights [N]. information(frame): `exact` of it.
    - pool, dome: `Views` of all cameras of the run, and of a dome around the rock.
    - planned(taken, candidates, count, model): at most `count` views to take next, as a set
      (`planned_views`); all candidates where there are no `plan_gains`.
    - path(taken, candidates, count, nearest, model): the same in order, each among the `nearest`
      to the one before (`planned_path`); none where there are no `plan_gains`."""

    def __init__(
        self,
        cameras: Sequence[Camera],
        exact: Callable[[Camera], Array],
        colour: Callable[[Camera], Array],
        points: Array,
        centre: Array,
        lam: float,
        stands_for: int = 1,
    ) -> None:
        self.cameras, self.exact, self.colour = cameras, exact, colour
        self.stands_for = stands_for
        self.points, self.centre, self.lam = points, centre, lam
        self.positions = np.array([camera.position for camera in cameras])
        self.colours = cache(lambda frame: np.array(colour(cameras[frame])[:, :3]))
        self.seen = cache(lambda frame: squared_weights(colour(cameras[frame])))
        self.planned, self.path = cache(self._planned), cache(self._path)
        self.states: dict[Model, PoolGains] = {}
        # A copy, because the kernel returns part of a larger array.
        copied = lambda frame: np.array(exact(cameras[frame]))  # noqa: E731
        self.information = kept_within(VIEW_BYTES, copied, lambda F: F.nbytes)

    def gains(self, taken: Sequence[int], candidates: Sequence[int], model: Model) -> Array:
        """Directional gain of each candidate after the views taken [C]. It is fast if the views
        taken begin with those of the call before."""
        state = self.states.get(model)
        if state is None or state.taken != list(taken[: len(state.taken)]):
            state = self.plan_gains(model)
            if state is None:
                return np.zeros(len(candidates))
            self.states[model] = state
        state.take(taken[len(state.taken) :])
        return self.stands_for * state.of_poses(candidates)

    def relaxation(
        self, taken: Sequence[int], candidates: Sequence[int], model: Model
    ) -> Relaxation:
        """Criterion of the candidates after the views taken."""
        degree, tau, over_dome = model
        views = self.pool.of(taken), self.pool.of(candidates), self.dome if over_dome else None
        return directional(self.points, self.lam, degree, tau, *views)

    def _planned(
        self, taken: tuple[int, ...], candidates: tuple[int, ...], count: int, model: Model
    ) -> Sequence[int]:
        state = self.plan_gains(model) if count < len(candidates) else None
        if state is None:
            return candidates
        state.take(taken)
        return planned_views(state, candidates, count)

    def _path(
        self,
        taken: tuple[int, ...],
        candidates: tuple[int, ...],
        count: int,
        nearest: int,
        model: Model,
    ) -> list[int]:
        def reach(views: Sequence[int]) -> list[int]:
            rest = [i for i in candidates if i not in views]
            near = nearest_poses(self.positions[rest], self.positions[views[-1]], nearest)
            return [rest[k] for k in near]

        state = self.plan_gains(model, FEW)
        if state is None:
            return []
        state.take(taken)
        return planned_path(state, reach, count)

    def plan_gains(self, model: Model, most: int | None = None) -> PoolGains | None:
        """Gains of all cameras for about `most` of the Gaussians, by default all, before any view
        is taken; None where no camera sees any."""
        from mgs.policy.pool_gains import PoolGains  # here because it loads Dr.Jit

        degree, tau, over_dome = model
        some = slice(None, None, max(len(self.points) // most, 1) if most else None)
        pool = of_points(self.pool, some)
        if not pool.seen.any():
            return None
        dome = of_points(self.dome, some) if over_dome else None
        return PoolGains(self.points[some], pool, self.lam, degree, tau, dome)

    @cached_property
    def pool(self) -> Views:
        seen = []
        for frame in range(len(self.cameras)):
            report(Stage.SCORE, frame, len(self.cameras))
            seen.append(self.seen(frame))
        return Views(self.positions, np.stack(seen))

    @cached_property
    def dome(self) -> Views:
        cameras = dome_cameras(self.cameras[0], self.positions, self.centre)
        seen = np.stack([squared_weights(self.colour(camera)) for camera in cameras])
        return Views(np.array([camera.position for camera in cameras]), seen)


def one_in(points: int, views: int) -> int:
    """Which part of the Gaussians on a surface is enough to plan by: one in so many."""
    pairs = points * (views + MATRICES)
    return 1 if pairs <= MOST_PAIRS else -(-pairs // COARSE_PAIRS)


def planned_views(gains: PoolGains, candidates: Sequence[int], count: int) -> list[int]:
    """Views to take next, as a set: greedily, then exchanged one by one until no exchange has a
    larger gain (V. V. Fedorov, Theory of Optimal Experiments, 1972).

    gains: after the views taken; changed. candidates: poses, more than `count`."""
    views: list[int] = []
    for _ in range(count):
        free = [view for view in candidates if view not in views]
        views.append(free[int(gains.of_poses(free).argmax())])
        gains.take(views[-1:])
    k, kept = 0, 0  # next view to exchange, and how many in a row were kept
    while kept < count:
        left = gains.without(views[k])
        free = [views[k]] + [view for view in candidates if view not in views]
        values = left.of_poses(free)
        best = int(values.argmax())
        kept += 1
        if values[best] > BETTER * values[0]:
            views[k], gains, kept = free[best], left, 1
            gains.take([views[k]])
        k = (k + 1) % count
    return views


def planned_path(
    gains: PoolGains, reach: Callable[[Sequence[int]], Sequence[int]], count: int
) -> list[int]:
    """Views to take next, in this order and each in reach: a beam search for the largest gain of
    all together. Fewer than `count` where nothing is left in reach.

    gains: after the views taken. reach(views): poses in reach after these views."""
    paths = [(0.0, gains)]
    for _ in range(count):
        longer: dict[tuple[frozenset[int], int], tuple[float, int, PoolGains]] = {}
        for total, path in paths:
            near = reach(path.taken)
            for view, gain in zip(near, path.of_poses(near), strict=True):
                key = frozenset([*path.taken, view]), view
                better = total + float(gain), view, path
                longer[key] = max(longer.get(key, better), better, key=lambda one: one[0])
        best = sorted(longer.values(), key=lambda one: one[0], reverse=True)[:WIDTH]
        if not best:
            break
        paths = [(total, path.copy()) for total, _, path in best]
        for (_, path), (_, view, _) in zip(paths, best, strict=True):
            path.take([view])
    return paths[0][1].taken[len(gains.taken) :]
