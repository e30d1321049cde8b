"""The paper's loop: fit, information, choose, capture, again. No candidate's image is read."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from mgs.data.frames import Frame
from mgs.errors import InputError
from mgs.learning import captured, learn, with_view
from mgs.policy import criteria, poses
from mgs.progress import report
from mgs.run.choosing import choose
from mgs.run.flight import allowed, reachable, seed_views, views_left
from mgs.run.policies import Policy
from mgs.run.policy_file import policy_of
from mgs.run.settings import Mission
from mgs.scene import Choice, Scene, State


def select_views(
    scene: Scene, policy: Any, mission: Mission = Mission(), state: State | None = None
) -> Iterator[State | Choice]:
    """Run the loop from the seeds, or from a state; yield the state after every fit, and after a
    pose was given up.

    The loop ends when the budget is spent, when no pose is in reach, or by `stop_uncertainty` or
    `stop_gain`. After `stop_gain` the last item is the choice that was refused. policy: as in
    `choose`. Raises InputError as `choose` and `learn`."""
    policy = policy_of(policy)
    if state is None:
        seeds, frames = first_views(scene, mission)
        key = "seeds", tuple(seeds), frames
        state = scene.once(key, lambda: learn(scene, seeds, frames=frames))
        yield state
    while not finished(scene, state, mission):
        planned, choices, refused = choose_batch(scene, state, policy, mission)
        if refused and not choices:
            yield refused
            return
        frames = captured(scene, state.frames, planned.taken[len(state.taken) :])
        if any(frames[i].given_up for i in planned.taken):
            # Choose again without it. Others of its batch are not taken, and stay as asked for.
            pairs = zip(state.frames, frames, strict=True)
            lost = tuple(new if new.given_up else old for old, new in pairs)
            yield (state := replace(state, frames=lost))
            continue
        state = learn(scene, planned.taken, state, frames, choices, planned.surface)
        yield state


def first_views(scene: Scene, mission: Mission) -> tuple[list[int], tuple[Frame, ...]]:
    """Capture the seed views: (their indices, all frames). The nearest other pose replaces one that
    was given up. Raises InputError where no other is left."""
    seeds, positions = seed_views(scene, mission), scene.positions(scene.frames)
    frames, may = scene.frames, np.flatnonzero(allowed(scene, mission)).tolist()
    while any((frames := captured(scene, frames, seeds))[i].given_up for i in seeds):
        failed = next(i for i in seeds if frames[i].given_up)
        others = [i for i in may if i not in seeds and not frames[i].given_up]
        if not others:
            count = sum(frame.given_up for frame in frames)
            few = f"too few poses are left for the seeds, {count} gave no picture"
            cure = "mend the capture and resume the run, or start again with fewer `seeds`"
            raise InputError(f"{scene.dataset.root}: {few}; {cure}")
        nearest = poses.nearest_poses(positions[others], positions[failed], 1)[0]
        seeds = [others[nearest] if i == failed else i for i in seeds]
    return seeds, frames


def finished(scene: Scene, state: State, mission: Mission) -> bool:
    """Whether the budget, the poses in reach or the uncertainty is used up."""
    if views_left(state, mission) <= 0 or not reachable(scene, state, mission):
        return True
    limit = mission.stop_uncertainty
    return limit is not None and mean_uncertainty(scene, state) <= limit


def mean_uncertainty(scene: Scene, state: State) -> float:
    """Mean over all parameters of the variance that is left, over that of the prior."""
    return float(criteria.uncertainty(state.H, scene.lam).mean())


def choose_batch(
    scene: Scene, state: State, policy: Policy, mission: Mission
) -> tuple[State, list[Choice], Choice | None]:
    """Choose up to `batch` views about one model, each as if those before it were taken. Returns
    (the state as if they were taken, choices, the choice whose gain is below `stop_gain`)."""
    planned, choices = state, list[Choice]()
    for _ in range(min(mission.batch, views_left(state, mission))):
        if not reachable(scene, planned, mission):
            break
        view, score = choose(scene, planned, policy, mission)
        choice, after = appraised(scene, planned, view, score)
        if mission.stop_gain is not None and choice.information_gain < mission.stop_gain:
            return planned, choices, choice
        choices.append(choice)
        report("chosen", len(choices), mission.batch)
        planned = after
    return planned, choices, None


def appraised(scene: Scene, state: State, view: int, score: float) -> tuple[Choice, State]:
    """A choice with its gain and coverage, and the state as if its view were taken."""
    F = scene.information(state, view)
    after, gain = with_view(scene, state, view, F), criteria.d_optimal(F, state.H, scene.lam)
    return Choice(view, score, gain, criteria.coverage(after.surface, scene.surface_lam)), after
