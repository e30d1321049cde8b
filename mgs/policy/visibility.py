"""What poses see of the prior's surface. That depends on poses and surface alone, so it is measured
once for a whole run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, cached_property

import numpy as np

from mgs.camera import Camera
from mgs.memory import IMAGE_BYTES, kept_within
from mgs.policy.context import Gains
from mgs.policy.criteria import Array
from mgs.policy.directional import Views, dome_cameras, squared_weights


class Visibility:
    """What a pool of poses sees of the Gaussians on a surface, each measured when it is asked for
    first.

    cameras: of the pool. look(camera) -> exact information [N,P] about the Gaussians before any
    training. points: [N,3] their means, metres; centre: [3] the middle of the rock; lam: of
    colours. turn: [3,3] rotates the cameras' world into that of points and centre, in which +Z
    points upwards; None: they are the same. told(done, total): called in a pass over all poses.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        look: Callable[[Camera], Array],
        points: Array,
        centre: Array,
        lam: float,
        turn: Array | None = None,
        told: Callable[[int, int], None] = lambda done, total: None,
    ) -> None:
        self.cameras, self.look, self.points, self.centre, self.lam, self.told = (
            cameras,
            look,
            points,
            centre,
            lam,
            told,
        )
        self.turn = np.eye(3) if turn is None else turn
        self.positions = np.array([camera.position for camera in cameras]) @ self.turn.T
        self.seen, self.pool, self.dome = cache(self._seen), cache(self._pool), cache(self._dome)
        # A copy, because what the kernel returns is part of a larger array.
        self.information = kept_within(
            IMAGE_BYTES, lambda view: np.array(look(cameras[view])), lambda F: F.nbytes
        )
        """(view) -> `look` from its pose."""

    @cached_property
    def gains(self) -> Gains:
        """Directional gains of the poses."""
        from mgs.policy.pool_gains import pool_gains  # imported here because it loads Dr.Jit

        return pool_gains(self.points, self.lam, self.pool, self.dome)

    def _seen(self, view: int) -> Array:
        """[N] squared blending weights of the Gaussians in one view."""
        return squared_weights(self.look(self.cameras[view]))

    def _pool(self) -> Views:
        """All poses, and what they see."""
        seen = []
        for view in range(len(self.cameras)):
            self.told(view, len(self.cameras))
            seen.append(self.seen(view))
        return Views(self.positions, np.stack(seen))

    def _dome(self) -> Views:
        """A dome of poses around the rock, and what they see."""
        upright = dome_cameras(self.cameras[0], self.positions, self.centre)
        to_upright = np.eye(4)
        to_upright[:3, :3] = self.turn
        cameras = [
            replace(camera, world_to_camera=camera.world_to_camera @ to_upright)
            for camera in upright
        ]
        seen = np.stack([squared_weights(self.look(camera)) for camera in cameras])
        return Views(np.array([camera.position for camera in upright]), seen)
