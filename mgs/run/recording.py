"""Run the loop in a folder: checkpoints, times, warnings and evaluation around `select_views`."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mgs.data.dataset import Dataset
from mgs.errors import InputError
from mgs.files import working_in
from mgs.policy import criteria
from mgs.policy.context import Policy
from mgs.run import inputs
from mgs.run.checks import Checks
from mgs.run.ending import FitDivergedError, RunEnd, diverged, run_end
from mgs.run.folder import check_settings, read_checkpoint, write_checkpoint, write_steps
from mgs.run.loop import select_views, uncertainty
from mgs.run.problem import Operations, Problem, Progress
from mgs.run.settings import NbvSettings
from mgs.run.state import Choice, Learned, State
from mgs.splat_ply import write_ply

STAGES = {
    "capturing": "capture",
    "fitting": "fit",
    "information of the training set": "information",
    "scoring candidates": "score",
    "checking": "check",
    "evaluating": "evaluate",
}
"""Stage of the progress -> key of `seconds` in steps.jsonl."""


def run(
    out: Path,
    settings: NbvSettings,
    dataset: Dataset,
    operations: Operations,
    progress: Progress,
    on_step: Callable[[State], None] = lambda state: None,
    policy: Policy | None = None,
    retry: bool = False,
) -> State:
    """Run or resume the loop in `out`, which has its config.json, to its end; give the last state.

    on_step(state): called after every step, or batch of steps, that is on disk. policy: in
    place of that of the settings. retry: ask again for poses that were given up, if the run has no
    model yet or no pose left. Killed at any moment and called again, it takes the same views as an
    uninterrupted run.

    Raises InputError as `check_settings`; where another process works on the folder; where the
    prior, a pose or a file of a frame taken has changed; where a frame it takes cannot be read or
    has an empty mask; and where a fit diverged. The steps before are kept.
    """
    check_settings(settings, len(dataset))
    with working_in(out):
        state = read_checkpoint(out)
        if state is not None:
            inputs.check_unchanged(out, state.inputs, operations.prior, settings, dataset)
        stopwatch = Stopwatch(progress)
        problem = Problem(dataset, settings, operations, stopwatch, policy)
        recorder = Recorder(problem, stopwatch)
        ended = state.steps[-1].get("ended", {}) if state else {}
        if retry and (state is None or ended.get("reason") == RunEnd.FLIGHT):
            problem.retry()
        if state is not None:
            problem.resume(state.taken)
            check_model(out, problem, state)
            known, state = state, mark_end(problem, state)
            if known.steps != state.steps:
                write_checkpoint(out, state)
            on_step(state)
        if state is None or "ended" not in state.steps[-1]:
            state = _go_on(out, problem, recorder, state, on_step)
        write_steps(out, state)
        write_ply(out / "gaussians.ply", state.gaussians)
        return state


def _go_on(
    out: Path,
    problem: Problem,
    recorder: Recorder,
    state: State | None,
    on_step: Callable[[State], None],
) -> State:
    """Run the loop from a state to its end, and commit every step."""
    try:
        for learned in select_views(problem, state):
            if isinstance(learned, Choice):
                assert state is not None
                state = mark_end(problem, state, learned)
                write_checkpoint(out, state)
            else:
                state = recorder.recorded(learned, state)
                write_checkpoint(out, state)
                on_step(state)
                if "ended" in state.steps[-1]:
                    break
    except FitDivergedError as error:
        kept = len(state.steps) if state else 0
        raise InputError(diverged(out, error.step, kept, error.losses)) from None
    assert state is not None
    known, state = state, mark_end(problem, state)
    if state.steps != known.steps:  # the last candidates were given up
        write_checkpoint(out, state)
    return state


def check_model(out: Path, problem: Problem, state: State) -> None:
    """Raises InputError where a state does not belong to a run of these settings and this prior.

    Its means must be those of the prior where they are frozen, and its parameters as many as the
    run learns.
    """
    if state.H.shape[1] != len(problem.lam):
        where = f"{out / 'config.json'}: settings.train.means"
        raise InputError(
            f"{where} has changed since {out} was started; restore it, or start a new run"
        )
    frozen = problem.settings.train.means == "frozen"
    if frozen and not np.array_equal(state.gaussians.means, problem.start.means):
        raise InputError(inputs.changed_prior(out, problem.settings.prior))


def mark_end(problem: Problem, state: State, refused: Choice | None = None) -> State:
    """The state with `ended` in its last step where the run ends there by its settings as they are.

    refused: the next view, where it was refused; by default the one that the last step records.
    """
    last = {key: value for key, value in state.steps[-1].items() if key != "ended"}
    next_view: dict[str, Any] | None = state.steps[-1].get("ended")
    if refused is not None:
        name = problem.frames[refused.frame].name
        next_view = {"name": name, "information_gain": refused.information_gain}
    views = len(state.taken) - problem.settings.seeds
    stuck = not problem.reachable(state.taken)
    metres = problem.flight.metres(state.taken) if stuck else None
    predicted = last.get("prediction", {}).get("psnr")
    left = uncertainty(problem, state)
    given_up = sum(frame.given_up for frame in problem.frames)
    ended = run_end(problem.settings, views, left, next_view, metres, predicted, given_up)
    return replace(state, steps=[*state.steps[:-1], last | ({"ended": ended} if ended else {})])


class Stopwatch:
    """A progress callback that passes on and measures: seconds between calls, by STAGES.

    Where a choice is finished (stage "chosen"), its seconds are set apart in `laps`.
    """

    def __init__(self, progress: Progress) -> None:
        self.progress, self.stage = progress, ""
        self.since = time.perf_counter()
        self.seconds: dict[str, float] = {}
        self.laps: list[dict[str, float]] = []

    def __call__(self, stage: str, done: int, total: int) -> None:
        self.switch(stage)
        if stage == "chosen":
            self.laps.append(self.seconds)
            self.seconds = {}
        else:
            self.progress(stage, done, total)

    def switch(self, stage: str) -> None:
        """Count the seconds since the last call for the stage that ends, and begin another."""
        now = time.perf_counter()
        if key := STAGES.get(self.stage):
            self.seconds[key] = round(self.seconds.get(key, 0.0) + now - self.since, 4)
        self.stage, self.since = stage, now

    def take(self) -> dict[str, float]:
        """Seconds by stage since the last call or lap."""
        self.switch("")
        found, self.seconds = self.seconds, {}
        return found


class Recorder:
    """Turns what the loop learned into lines of steps.jsonl, with warnings and evaluation."""

    def __init__(self, problem: Problem, stopwatch: Stopwatch) -> None:
        self.problem, self.stopwatch = problem, stopwatch
        cameras = {frame.name: inputs.camera_digest(frame.camera) for frame in problem.frames}
        self.made_from = {
            "prior": problem.operations.prior,
            "cameras": cameras,
            **inputs.policy_record(problem.settings.policy),
        }
        render = problem.operations.render
        self.checks = Checks(problem, render) if render else None

    def recorded(self, learned: Learned, state: State | None) -> State:
        """The state after a fit: a line for the seeds, or for each view chosen since `state`."""
        problem, settings = self.problem, self.problem.settings
        lines, known = self.lines(learned), state.steps if state else []
        new = learned.taken[len(state.taken) if state else 0 :]
        fit, line = learned.fit, lines[-1]
        line |= {
            "uncertainty": uncertainty(problem, learned),
            "iterations": int(fit.iterations),
            "loss": float(fit.loss),
            "stop_reason": str(fit.stop_reason),
        }
        if learned.gains is not None:
            names = [problem.frames[i].name for i in learned.taken]
            line["exposure"] = dict(zip(names, learned.gains.tolist(), strict=True))
        if self.checks:
            self.stopwatch("checking", 0, 1)
            line |= self.checks.entries(learned, new, [*known, *lines])
        every, first, step = settings.evaluate_every, len(known), line["step"]
        if every and any(k % every == 0 for k in range(first, step + 1)):
            self.stopwatch("evaluating", 0, 1)
            line |= problem.operations.measure(fit.gaussians, learned.taken)
        line["seconds"] |= self.stopwatch.take()
        kinds = ["image", "mask", "rock", "depth", "capture"]
        files = dict(state.inputs["files"]) if state else {}
        for frame in (problem.frames[i] for i in new):
            files[frame.name] = inputs.frame_digests(frame, kinds)
        made_from = {**self.made_from, "files": files}
        taken, steps = learned.taken, [*known, *lines]
        return mark_end(
            problem, State(fit.gaussians, learned.H, learned.surface, taken, steps, made_from)
        )

    def lines(self, learned: Learned) -> list[dict[str, Any]]:
        """Lines of the new steps, with all that is known before their images are read."""
        problem, seeds = self.problem, self.problem.settings.seeds
        if not learned.choices:
            names = [problem.frames[i].name for i in learned.taken]
            coverage = criteria.coverage(learned.surface, problem.prior_lam)
            line: dict[str, Any] = {"step": 0, "frame": None, "name": None}
            line |= {"seeds": learned.taken, "seed_names": names}
            line |= {"score": None, "information_gain": None}
            return [line | {"images": seeds, "coverage": coverage, "seconds": {}}]
        first = len(learned.taken) - seeds - len(learned.choices) + 1
        laps = self.stopwatch.laps[-len(learned.choices) :]  # without choices that were given up
        self.stopwatch.laps = []
        return [
            {
                "step": first + k,
                "frame": choice.frame,
                "name": problem.frames[choice.frame].name,
                "score": choice.score,
                "information_gain": choice.information_gain,
                "images": seeds + first + k,
                "coverage": choice.coverage,
                "seconds": seconds,
            }
            for k, (choice, seconds) in enumerate(zip(learned.choices, laps, strict=True))
        ]
