"""The paper's loop: fit, information, choose, capture, again.

Each step is a function of a `Problem` and plain data. `select_views` is the whole loop. Candidates'
images are never read: until a view is chosen, only its camera is used.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from mgs.fit.stopping import StopReason
from mgs.gaussians import Gaussians
from mgs.policy import criteria
from mgs.prior.initial import warm_start
from mgs.run.ending import FitDivergedError
from mgs.run.planning import plan_flight, rated, surface_information, with_view
from mgs.run.problem import Problem
from mgs.run.state import Choice, Fitted, Learned

if TYPE_CHECKING:
    from mgs.fit.fitting import Fit


Chooser = Callable[[Problem, Fitted, Callable[[int], np.ndarray]], tuple[int, float]]
"""A function as `choose`."""


def select_views(
    problem: Problem, state: Fitted | None = None, chooser: Chooser | None = None
) -> Iterator[Learned | Choice]:
    """Run the loop from the seeds, or from a state; yield the state after every fit.

    chooser: function to use in place of `choose`. The loop ends when the budget is spent, when no
    pose is in reach, or by `stop_uncertainty` or `stop_gain`. After `stop_gain` the last item is
    the choice that was refused. Raises InputError as `choose` and `learn`.
    """
    if state is None:
        problem.make_seeds()
        state = learn(problem, problem.seeds)
        yield state
    while not finished(problem, state):
        planned, choices, refused = choose_batch(problem, state, chooser or choose)
        if refused and not choices:
            yield refused
            return
        if not problem.make_images(planned.taken[len(state.taken) :]):
            continue  # a pose was given up: choose again without it
        state = learn(problem, planned.taken, state, planned.surface, choices)
        yield state


def finished(problem: Problem, state: Fitted) -> bool:
    """Whether the budget, the poses in reach or the uncertainty is used up."""
    settings = problem.settings
    if len(state.taken) - settings.seeds >= settings.budget:
        return True
    if not problem.reachable(state.taken):
        return True
    limit = settings.stop_uncertainty
    return limit is not None and uncertainty(problem, state) <= limit


def uncertainty(problem: Problem, state: Fitted) -> float:
    """Mean over all parameters of the variance that is left, over that of the prior."""
    return float(criteria.uncertainty(state.H, problem.lam).mean())


def learn(
    problem: Problem,
    taken: list[int],
    before: Fitted | None = None,
    surface: np.ndarray | None = None,
    choices: Sequence[Choice] = (),
) -> Learned:
    """Capture the views that are new in `taken`, fit to all of `taken`, and sum their information.

    before: the model of the last step, where the fit starts. surface: `Fitted.surface` of `taken`,
    if it is known already. choices: recorded in the result. Raises FitDivergedError, and InputError
    if a frame cannot be read.
    """
    new = taken[len(before.taken) :] if before else taken
    gains = capture(problem, new, taken)
    if surface is None or problem.moved(new):
        surface = surface_information(problem, new, before)
    fit = fit_views(problem, taken, before, gains)
    if fit.stop_reason == StopReason.DIVERGED:
        raise FitDivergedError(len(taken) - problem.settings.seeds, fit.losses)
    H = information(problem, fit.gaussians, taken)
    model = before.gaussians if before else None
    return Learned(fit.gaussians, H, surface, taken, fit, gains, model, list(choices))


def capture(problem: Problem, new: Sequence[int], taken: Sequence[int]) -> np.ndarray | None:
    """Make and read the images of new views.

    Returns the gains [V,3] of the exposure of all views taken; None where they are not estimated.
    """
    problem.make_images(new)
    for i in new:
        problem.image(i)
    if problem.operations.exposure is None:
        return None
    return problem.operations.exposure([problem.frames[i] for i in taken])


def fit_views(
    problem: Problem,
    taken: list[int],
    before: Fitted | None = None,
    gains: np.ndarray | None = None,
) -> Fit:
    """Fit to the views taken, starting at the model of the last step (`before`), else at the prior.

    gains: [V,3] exposures of the views taken, None if they are not estimated.
    """
    problem.progress("fitting", 0, 1)
    start = problem.start_of(tuple(taken))
    step, model = 0, start
    if before is not None:
        step = len(taken) - problem.settings.seeds
        model = warm_start(before.gaussians, problem.start_of(tuple(before.taken)), start)
    cameras = [problem.cameras[i] for i in taken]
    given = problem.targets(taken, gains)
    train, on_pass = problem.settings.train_at(step), partial(problem.progress, "fitting")
    return problem.operations.fit(model, start, cameras, given, train, on_pass)


def information(problem: Problem, model: Gaussians, taken: Sequence[int]) -> np.ndarray:
    """Sum the Fisher information of the views taken, at a model: H [N,P], diagonal of J^T J."""
    H = np.zeros((len(model), len(problem.lam)))
    for done, i in enumerate(taken):
        problem.progress("information of the training set", done, len(taken))
        H += problem.operations.fisher(model, problem.cameras[i])
    return H


def choose_batch(
    problem: Problem, state: Fitted, chooser: Chooser
) -> tuple[Fitted, list[Choice], Choice | None]:
    """Choose up to `batch` views about one model, each as if those before it were taken.

    Returns (the state as if they were taken, choices, the choice whose gain is below `stop_gain`).
    """
    settings, choices = problem.settings, list[Choice]()
    fisher = problem.view_information(state.gaussians)
    left = problem.views_left(state.taken)
    planned = state
    for _ in range(min(settings.batch, left)):
        if not problem.reachable(planned.taken):
            break
        frame, score = chooser(problem, planned, fisher)
        F = fisher(frame)
        gain = criteria.d_optimal(F, planned.H, problem.lam)
        after = with_view(problem, planned, frame, F)
        covered = criteria.coverage(after.surface, problem.prior_lam)
        choice = Choice(frame, score, gain, covered)
        if settings.stop_gain is not None and gain < settings.stop_gain:
            return planned, choices, choice
        choices.append(choice)
        problem.progress("chosen", len(choices), settings.batch)
        planned = after
    return planned, choices, None


def choose(
    problem: Problem, state: Fitted, fisher: Callable[[int], np.ndarray] | None = None
) -> tuple[int, float]:
    """Choose the next view; return (frame, score) of the largest score / travel cost in reach.

    Of equal views, the one farthest from those taken is chosen. A policy that plans chooses among
    the views of its plan (`Problem.planned`). If the flight has a limit, the result is the first
    stop of `plan_flight`. fisher: function frame -> information [N,P] of its view at the model,
    computed by default. Raises InputError if the policy returns no valid score.
    """
    fisher = fisher or problem.view_information(state.gaussians)
    if problem.settings.flies:
        return next(plan_flight(problem, state, fisher))
    left = problem.planned(state.taken, problem.reachable(state.taken))
    context = problem.context(state, left, fisher)
    return rated(problem, context, problem.travel_cost(context))[0]
