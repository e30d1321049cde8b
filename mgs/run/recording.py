"""Run the loop in a folder: checkpoints, times, warnings and evaluation around `select_views`."""

import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mgs.data.dataset import Dataset
from mgs.data.frames import capture_record
from mgs.errors import InputError, Notice
from mgs.evaluation import psnr_measure
from mgs.files import remove_file, working_in
from mgs.fit.stopping import DivergedError
from mgs.learning import captured
from mgs.policy import criteria
from mgs.progress import Progress, Stage, listening, report
from mgs.provenance import versions
from mgs.run import inputs
from mgs.run.checks import Checks
from mgs.run.ending import RunEnd, diverged, run_end
from mgs.run.flight import flight_of, free, reachable
from mgs.run.folder import Checkpoint, read_checkpoint, read_config, write_checkpoint, write_steps
from mgs.run.loop import mean_uncertainty, select_views
from mgs.run.policies import Policy
from mgs.run.policy_file import policy_of
from mgs.run.settings import NbvSettings, check_settings
from mgs.run.worth import planned_certificate
from mgs.scene import Choice, Scene, State
from mgs.splat_places import to_source
from mgs.splat_ply import write_ply


def run(
    out: Path,
    settings: NbvSettings,
    scene: Scene,
    policy: Policy | None = None,
    *,
    on_step: Callable[[Checkpoint], None] = lambda state: None,
    progress: Progress | None = None,
    retry: bool = False,
) -> Checkpoint:
    """Run or resume the loop in `out`, which has its config.json, to its end; give the last state.

    - on_step(checkpoint): called after every step, or batch of steps, that is on disk.
    - policy: in place of that of the settings.
    - retry: ask again for poses that were given up, if the run has no model yet or no pose left.

    Killed at any moment and called again, it takes the same views as an uninterrupted run. Raises
    InputError as `check_settings`, where another process works on the folder, and where a fit
    diverged. Also where the prior, a pose or a file of a frame taken has changed. Also where a
    frame that it takes cannot be read or has an empty mask. The steps before are kept."""
    check_settings(settings, len(scene.dataset))
    with working_in(out), listening(progress) as outer, listening(stopwatch := Stopwatch(outer)):
        checkpoint = read_checkpoint(out)
        if checkpoint is not None:
            digest = inputs.prior_digest(scene.prior)
            inputs.check_unchanged(out, checkpoint.inputs, digest, settings, scene.dataset)
        ended = checkpoint.steps[-1].get("ended", {}) if checkpoint else {}
        if retry and (checkpoint is None or ended.get("reason") == RunEnd.FLIGHT):
            scene = replace(scene, dataset=asked_again(scene.dataset))
        policy = policy or policy_of(settings.policy)
        recorder = Recorder(scene, settings, policy, stopwatch)
        state = None
        if checkpoint is not None:
            state = resumed(scene, checkpoint)
            check_model(out, scene, settings, state)
            before, checkpoint = checkpoint, recorder.marked(state, checkpoint)
            if before.steps != checkpoint.steps:
                write_checkpoint(out, checkpoint)
            on_step(checkpoint)
        if checkpoint is None or "ended" not in checkpoint.steps[-1]:
            if other := other_versions(read_config(out).get("versions", {})):
                text = f"{out}: was started with {other}; the next steps may differ from its own"
                warnings.warn(Notice(text), stacklevel=2)
            checkpoint = _go_on(out, recorder, state, checkpoint, on_step)
        write_steps(out, checkpoint)
        write_ply(out / "gaussians.ply", to_source(checkpoint.gaussians, scene.dataset.world))
        return checkpoint


def other_versions(began: Mapping[str, str]) -> str:
    """Format those versions that results depend on and that are others now."""
    now = versions()
    names = [name for name in began if name not in ("commit", "python")]
    return ", ".join(f"{name} {began[name]}" for name in names if began[name] != now.get(name))


def asked_again(dataset: Dataset) -> Dataset:
    """The dataset with those frames as candidates again that were given up."""
    frames = []
    for frame in dataset.frames:
        if frame.given_up:
            remove_file(dataset.root, capture_record(frame))
        frames.append(replace(frame, given_up=False))
    return replace(dataset, frames=tuple(frames))


def resumed(scene: Scene, checkpoint: Checkpoint) -> State:
    frames = captured(scene, scene.frames, checkpoint.taken)
    taken, seeds = tuple(checkpoint.taken), len(checkpoint.steps[0]["seeds"])
    return State(frames, taken, seeds, checkpoint.gaussians, checkpoint.H, checkpoint.surface)


def _go_on(
    out: Path,
    recorder: "Recorder",
    state: State | None,
    checkpoint: Checkpoint | None,
    on_step: Callable[[Checkpoint], None],
) -> Checkpoint:
    settings = recorder.settings
    try:
        for item in select_views(recorder.scene, recorder.policy, settings, state):
            if isinstance(item, Choice):
                assert state is not None
                assert checkpoint is not None
                checkpoint = recorder.marked(state, checkpoint, item)
                write_checkpoint(out, checkpoint)
                continue
            before, state = state, item
            if before is not None and before.taken == state.taken:  # a pose was given up
                continue
            checkpoint = recorder.recorded(state, checkpoint)
            write_checkpoint(out, checkpoint)
            on_step(checkpoint)
            if "ended" in checkpoint.steps[-1]:
                break
    except DivergedError as error:
        steps = len(checkpoint.steps) if checkpoint else 0
        raise InputError(diverged(out, error.step, steps, error.losses)) from None
    assert state is not None
    assert checkpoint is not None
    ended = recorder.marked(state, checkpoint)
    if ended.steps != checkpoint.steps:  # the last candidates were given up
        write_checkpoint(out, ended)
    return ended


def check_model(out: Path, scene: Scene, settings: NbvSettings, state: State) -> None:
    """Raises InputError where a state does not belong to a run of these settings and this prior.
    Its means must be those of the prior where they are frozen, its seeds and parameters as many as
    the run has."""
    changed = {
        "seeds": state.seeds != settings.seeds,
        "sh": state.gaussians.sh_degree != settings.sh,
        "train.means": state.H.shape[1] != len(scene.lam),
    }
    if name := next((name for name, differs in changed.items() if differs), None):
        where = f"{out / 'config.json'}: settings.{name}"
        raise InputError(f"{where} has changed since {out} was started; restore it")
    frozen = settings.train.means == "frozen"
    if frozen and not np.array_equal(state.gaussians.means, scene.untrained(state).means):
        raise InputError(inputs.changed_prior(out, settings.prior))


class Stopwatch:
    """A progress callback that passes on and measures: seconds between calls, by `Stage`. Where a
    choice is finished (stage "chosen"), its seconds are set apart in `laps`."""

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
        if isinstance(self.stage, Stage):
            key = self.stage.name.lower()
            self.seconds[key] = round(self.seconds.get(key, 0.0) + now - self.since, 4)
        self.stage, self.since = stage, now

    def take(self) -> dict[str, float]:
        self.switch("")
        seconds, self.seconds = self.seconds, {}
        return seconds


class Recorder:
    """Turns states of the loop into lines of steps.jsonl, with warnings and evaluation."""

    def __init__(
        self, scene: Scene, settings: NbvSettings, policy: Policy, stopwatch: Stopwatch
    ) -> None:
        self.scene, self.settings, self.policy = scene, settings, policy
        self.stopwatch, self.checks = stopwatch, Checks(scene, settings, policy)
        self.measure = psnr_measure(scene.dataset, scene.cache, settings.exposure)
        self.made_from = {
            "prior": inputs.prior_digest(scene.prior),
            "cameras": {f.name: inputs.camera_digest(f.camera) for f in scene.frames},
            **inputs.policy_record(settings.policy),
        }

    def recorded(self, state: State, before: Checkpoint | None) -> Checkpoint:
        """The checkpoint after a fit: a line for the seeds, or for each view chosen since."""
        assert state.fit is not None
        lines, steps = self.lines(state), before.steps if before else []
        new = state.taken[len(before.taken) if before else 0 :]
        fit, line = state.fit, lines[-1]
        line |= {
            "uncertainty": mean_uncertainty(self.scene, state),
            "iterations": int(fit.iterations),
            "loss": float(fit.loss),
            "stop_reason": str(fit.stop_reason),
        }
        if not state.choices:
            line |= self.certificate(state)
        if state.exposure is not None:
            names = [state.frames[i].name for i in state.taken]
            line["exposure"] = dict(zip(names, state.exposure.tolist(), strict=True))
        report(Stage.CHECK, 0, 1)
        model = before.gaussians if before else None
        line |= self.checks.entries(state, model, new, [*steps, *lines])
        every, first, step = self.settings.evaluate_every, len(steps), line["step"]
        if every and any(k % every == 0 for k in range(first, step + 1)):
            report(Stage.EVALUATE, 0, 1)
            line |= self.measure(fit.gaussians, list(state.taken))
        line["seconds"] |= self.stopwatch.take()
        kinds = ["image", "mask", "rock", "depth", "capture"]
        files = dict(before.inputs["files"]) if before else {}
        for frame in (state.frames[i] for i in new):
            files[frame.name] = inputs.frame_digests(frame, kinds)
        made_from = {**self.made_from, "files": files}
        model, taken = fit.gaussians, list(state.taken)
        checkpoint = Checkpoint(model, state.H, state.surface, taken, [*steps, *lines], made_from)
        return self.marked(state, checkpoint)

    def certificate(self, state: State) -> dict[str, Any]:
        """Entry of the seeds' line: what the plan of all views to come is worth."""
        scene, policy, settings = self.scene, self.policy, self.settings
        worth = planned_certificate(scene, state, policy, settings)
        names = [state.frames[i].name for i in free(scene, state, settings)]
        return {"certificate": worth.record(names)} if worth else {}

    def lines(self, state: State) -> list[dict[str, Any]]:
        """Lines of the new steps, with all that is known before their images are read."""
        seeds = state.seeds
        if not state.choices:
            names = [state.frames[i].name for i in state.taken]
            coverage = criteria.coverage(state.surface, self.scene.surface_lam)
            line: dict[str, Any] = {"step": 0, "frame": None, "name": None}
            line |= {"seeds": list(state.taken), "seed_names": names}
            line |= {"score": None, "information_gain": None}
            return [line | {"images": seeds, "coverage": coverage, "seconds": {}}]
        first = state.step - len(state.choices) + 1
        laps = self.stopwatch.laps[-len(state.choices) :]  # without choices that were given up
        self.stopwatch.laps = []
        return [
            {
                "step": first + k,
                "frame": choice.view,
                "name": state.frames[choice.view].name,
                "score": choice.score,
                "information_gain": choice.information_gain,
                "images": seeds + first + k,
                "coverage": choice.coverage,
                "seconds": seconds,
            }
            for k, (choice, seconds) in enumerate(zip(state.choices, laps, strict=True))
        ]

    def marked(
        self, state: State, checkpoint: Checkpoint, refused: Choice | None = None
    ) -> Checkpoint:
        """The checkpoint with `ended` in its last step where the run ends there by its settings.

        refused: the next step if it was already chosen, else the one recorded when the run ended.
        """
        scene, settings, steps = self.scene, self.settings, checkpoint.steps
        last = {key: value for key, value in steps[-1].items() if key != "ended"}
        next_view: dict[str, Any] | None = steps[-1].get("ended")
        if refused is not None:
            name = state.frames[refused.view].name
            next_view = {"name": name, "information_gain": refused.information_gain}
        metres = None
        if not reachable(scene, state, settings):
            metres = flight_of(scene, state, settings).metres(state.taken)
        predicted = last.get("prediction", {}).get("psnr")
        given_up = sum(frame.given_up for frame in state.frames)
        uncertain = mean_uncertainty(scene, state)
        end = run_end(settings, state.step, uncertain, next_view, metres, predicted, given_up)
        last |= {"ended": end} if end else {}
        return replace(checkpoint, steps=[*steps[:-1], last])
