"""The paper's loop: seeds -> fit -> information of the training set -> choose a pose -> capture -> fit -> ... until the budget.

A run lives in one folder:

- `config.json`: settings, versions and the names of all frames; written first;
- `checkpoint.npz`: the whole state after the last finished step, replaced atomically: this is the commit of a step; with it
  hashes of all that the state was made from (`mgs.inputs`);
- `steps.jsonl`: one line a step, rebuilt from the checkpoint, so it can lag behind by a killed step but never disagree;
- `gaussians.ply`: the model, once the budget is spent.

A line of `steps.jsonl` holds: `step` (0 = the seeds), `frame` and `name` of the chosen view (null at step 0, which has `seeds`
and `seed_names` instead), `images` (how many the model has now), `gain` (the policy's own score; null for random),
`information_gain` (Eq. 7 of the chosen view, whatever the policy), `coverage` (Eq. 9 of all images), `iterations`, `loss` (of
the pass whose model was kept, `mgs.train.Fit`) and `stop_reason` (`mgs.stopping.StopReason`) of the fit, `seconds` per stage,
and, where the step was evaluated, mean PSNR in dB over all views (`psnr`; `psnr_mask` in the rock mask) and over those never
trained on (`held_out_psnr`, `held_out_psnr_mask`), each left out where there is no such view, or none with a mask.

The candidates' images are never read: only the cameras of frames not taken yet are touched before a choice.
"""

from __future__ import annotations

import json
import time
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from mgs import inputs, policies
from mgs.config import NbvSettings, validated, versions
from mgs.conventions import Camera
from mgs.dataset import Dataset, Frame
from mgs.errors import InputError
from mgs.files import atomic_path, locked, read_json, write_json
from mgs.gaussians import Gaussians
from mgs.seeds import generator
from mgs.splat_ply import write_ply
from mgs.stopping import StopReason

Progress = Callable[[str, int, int], None]
"""Called as progress(stage, done, total)."""


class Fit(Protocol):
    """What a fit returns: `mgs.train.Fit`."""

    @property
    def gaussians(self) -> Gaussians: ...
    @property
    def loss(self) -> float: ...
    @property
    def iterations(self) -> int: ...
    @property
    def losses(self) -> Sequence[float]: ...
    @property
    def stop_reason(self) -> StopReason: ...


@dataclass(frozen=True)
class Stations:
    """The stations the loop calls; NumPy in and out, deterministic.

    centre: [3] the rock, metres; groups: columns of the Fisher information by kind of parameter;
    initial(seed frames) -> Gaussians; fit(gaussians, cameras, targets, rate, on_pass) -> Fit, rate scaling the learning rates;
    fisher(gaussians, camera) -> [N,P]; measure(gaussians, taken frame indices) -> entries for steps.jsonl; prior: hash of what
    `initial` starts from (`mgs.inputs.prior_digest`).
    """

    centre: np.ndarray
    groups: dict[str, slice]
    initial: Callable[[list[Frame]], Gaussians]
    fit: Callable[[Gaussians, list[Camera], list[np.ndarray], float, Callable[[int, int], None]], Fit]
    fisher: Callable[[Gaussians, Camera], np.ndarray]
    measure: Callable[[Gaussians, list[int]], dict[str, float]]
    prior: str = ""


@dataclass
class State:
    """What is known after a step: the model, frames taken in order, all lines, and the information of the training set, H [N,P]
    at that model and surface [N,P] at the prior's Gaussians before training (what the views see of the surface); inputs: what
    it was made from, a record of `mgs.inputs`, empty in runs of versions that kept none."""

    gaussians: Gaussians
    H: np.ndarray
    surface: np.ndarray
    taken: list[int]
    steps: list[dict[str, Any]]
    inputs: dict[str, Any] = field(default_factory=dict)


@dataclass
class _Stopwatch:
    """Seconds per stage."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[stage] = round(time.perf_counter() - start, 4)


def check_settings(settings: NbvSettings, frames: int) -> None:
    """Raises InputError where the policy is unknown, or the dataset has too few frames for the seeds and the budget."""
    if settings.policy not in policies.policy_names():
        known = ", ".join(policies.policy_names())
        raise InputError(f"--policy {settings.policy}: unknown; choose one of {known}, or register your own (docs/nbv.md)")
    if frames < settings.seeds:
        raise InputError(f"{settings.dataset}: has {frames} frames, fewer than {settings.seeds} seeds; lower --seeds")
    left = frames - settings.seeds
    if settings.budget > left:
        raise InputError(f"{settings.dataset}: --budget {settings.budget} exceeds its {left} candidates; lower --budget")


def start(out: Path, settings: NbvSettings, dataset: Dataset) -> None:
    """Write config.json, the first file of a run. Raises InputError as `check_settings`."""
    check_settings(settings, len(dataset))
    config = {
        "settings": settings.model_dump(mode="json"),
        "versions": versions(),
        "frames": [frame.name for frame in dataset.frames],
    }
    write_json(out / "config.json", config)


def read_settings(out: Path) -> NbvSettings:
    """Settings of a run folder. Raises InputError where there is no run, its config.json is damaged, or the dataset is gone."""
    path = out / "config.json"
    if not path.is_file():
        raise InputError(f"{out}: holds no run (no config.json); start one with `mgs nbv DATASET --out {out}`")
    config = read_json(path)
    if not isinstance(config, dict) or not isinstance(config.get("settings"), dict):
        raise InputError(f"{path}: has no settings; the file is damaged, start the run anew")
    settings = validated(NbvSettings, config["settings"], path)
    if not settings.dataset.is_dir():
        raise InputError(f"{path}: dataset {settings.dataset} is not there; if it was moved, correct `dataset` in this file")
    return settings


def check_same_frames(out: Path, dataset: Dataset) -> None:
    """Raises InputError where the dataset is no longer the one the run was started on."""
    if read_json(out / "config.json").get("frames") != [frame.name for frame in dataset.frames]:
        raise InputError(f"{dataset.root}: its frames differ from those {out} was started on; restore them or start a new run")


def run(
    out: Path,
    settings: NbvSettings,
    dataset: Dataset,
    stations: Stations,
    progress: Progress,
    on_step: Callable[[State], None] = lambda state: None,
    say: Callable[[str], None] = lambda text: None,
) -> State:
    """Run or resume the loop in `out` (which has its config.json) until the budget is spent; returns the last state.

    progress is told of the work inside a step, on_step of every state that is committed, say of what a user should know.

    Killed at any moment and called again, it takes the same views as a run that was never interrupted. Raises InputError
    as `check_settings`; where another process works on the folder; where the prior, a pose or a file of a frame taken has
    changed since the steps that are there; before the fit, where a frame it takes cannot be read or has an empty mask; and
    where the fit diverged: the steps before are kept.
    """
    check_settings(settings, len(dataset))
    with locked(out):
        for leftover in out.glob(".*.part*"):  # of a killed write
            leftover.unlink()
        state = read_checkpoint(out)
        if state is not None:
            check_inputs(out, state, settings, dataset, stations.prior, say)
        loop = _Loop(out, settings, dataset, stations, progress)
        if state is not None and not np.array_equal(state.gaussians.means, loop.start.means):
            raise InputError(inputs.changed_prior(out, settings.prior))
        if state is None:
            state = loop.first()
            write_checkpoint(out, state)
        on_step(state)
        while len(state.steps) <= settings.budget:
            state = loop.next(state)
            write_checkpoint(out, state)
            on_step(state)
        write_steps(out, state)
        write_ply(out / "gaussians.ply", state.gaussians)
        return state


def check_inputs(
    out: Path, state: State, settings: NbvSettings, dataset: Dataset, prior: str, say: Callable[[str], None]
) -> None:
    """Raises InputError where the run cannot go on from what it was made from; says so where that was never recorded."""
    if state.inputs:
        inputs.check_unchanged(out, state.inputs, prior, settings.prior, dataset)
    elif len(state.steps) <= settings.budget:
        say(f"{out}: was started by a version that kept no record of its inputs; it goes on with the files as they are now")


class _Loop:
    """What stays the same from step to step; each method is a function of the state."""

    def __init__(self, out: Path, settings: NbvSettings, dataset: Dataset, stations: Stations, progress: Progress) -> None:
        self.out, self.settings, self.frames, self.stations, self.progress = out, settings, dataset.frames, stations, progress
        self.cameras = [frame.camera for frame in dataset.frames]
        self.positions = np.array([camera.position for camera in self.cameras])
        self.lam = policies.regularisation(stations.groups, settings.pixel_noise, settings.prior_std)
        self.images: dict[int, np.ndarray] = {}
        cameras = {frame.name: inputs.camera_digest(frame.camera) for frame in self.frames}
        self.made_from = {"prior": stations.prior, "cameras": cameras}
        self.seeds = policies.seed_views(self.positions, stations.centre, settings.seeds)
        self.start = stations.initial([self.frames[i] for i in self.seeds])

    def first(self) -> State:
        """Step 0: the seeds."""
        names = [self.frames[i].name for i in self.seeds]
        choice = {"frame": None, "name": None, "seeds": self.seeds, "seed_names": names, "gain": None, "information_gain": None}
        nothing = np.zeros((len(self.start), len(self.lam)))
        return self.learn(State(self.start, nothing, nothing, [], []), self.seeds, choice, _Stopwatch())

    def next(self, state: State) -> State:
        """One step: choose a pose, capture its image, learn."""
        watch = _Stopwatch()
        with watch("score"):
            frame, gain = self.choose(state)
            F = self.stations.fisher(state.gaussians, self.cameras[frame])
            information_gain = policies.d_optimal(F, state.H, self.lam)
        choice = {"frame": frame, "name": self.frames[frame].name, "gain": gain, "information_gain": information_gain}
        return self.learn(state, [frame], choice, watch)

    def choose(self, state: State) -> tuple[int, float | None]:
        """Frame with the largest score among those not taken, and its gain: poses only, one candidate in memory at a time."""
        policy = self.settings.policy
        left = [i for i in range(len(self.frames)) if i not in state.taken]
        poses = self.positions[left], self.positions[state.taken], self.stations.centre
        rng = generator(self.settings.seed, f"{policy}/{len(state.steps)}")
        if policy in policies.CRITERIA:
            model, H = (self.start, state.surface) if policy == "coverage" else (state.gaussians, state.H)
            scores: np.ndarray = np.empty(len(left))
            for done, i in enumerate(left):
                self.progress("scoring candidates", done, len(left))
                scores[done] = policies.CRITERIA[policy](self.stations.fisher(model, self.cameras[i]), H, self.lam)
        else:
            scores = policies.POSE_POLICIES[policy](*poses, rng)
        farthest = policies.farthest_pose(*poses, rng)
        best = max(range(len(left)), key=lambda k: (scores[k], farthest[k]))
        if np.isnan(scores).any() or np.isinf(scores[best]):
            raise InputError(f"policy {policy}: gave a score that is NaN or infinite; correct the policy (docs/nbv.md)")
        return left[best], None if policy == "random" else float(scores[best])

    def learn(self, state: State, new: list[int], choice: dict[str, Any], watch: _Stopwatch) -> State:
        """Read the new images, fit to convergence on all so far, sum their information at the new model."""
        step, taken = len(state.steps), [*state.taken, *new]
        cameras = [self.cameras[i] for i in taken]
        with watch("capture"):
            for i in taken:
                if i not in self.images:
                    self.images[i] = _target(self.frames[i])
        with watch("fit"):
            targets = [self.images[i] for i in taken]
            rate = self.settings.warm_rate if step else 1.0
            fit = self.stations.fit(state.gaussians, cameras, targets, rate, partial(self.progress, "fitting"))
        if fit.stop_reason == StopReason.DIVERGED:
            raise InputError(_diverged(self.out, step, fit.losses))
        with watch("information"):
            H = np.zeros((len(fit.gaussians), len(self.lam)))
            for done, camera in enumerate(cameras):
                self.progress("information of the training set", done, len(cameras))
                H += self.stations.fisher(fit.gaussians, camera)
            surface = state.surface + sum(self.stations.fisher(self.start, self.cameras[i]) for i in new)
        kinds = ("image", "mask") if step else ("image", "mask", "depth")  # depth gives the seeds' colours to the surface
        files = {self.frames[i].name: inputs.frame_digests(self.frames[i], kinds) for i in new}
        made_from = {**self.made_from, "files": state.inputs.get("files", {}) | files}
        line = {
            "step": step,
            **choice,
            "images": len(taken),
            "coverage": policies.coverage(surface, self.lam),
            "iterations": int(fit.iterations),
            "loss": float(fit.loss),
            "stop_reason": str(fit.stop_reason),
            "seconds": watch.seconds,
        }
        if self.settings.evaluate_every and step % self.settings.evaluate_every == 0:
            with watch("evaluate"):
                line |= self.stations.measure(fit.gaussians, taken)
        return State(fit.gaussians, H, surface, taken, [*state.steps, line], made_from)


def _target(frame: Frame) -> np.ndarray:
    """`Frame.masked_rgb`. Raises InputError where the mask is empty: a fit to black would hide the rock."""
    if not frame.mask().any():
        raise InputError(f"{frame.mask_path}: the rock mask of frame {frame.name} is empty; correct it, or remove the frame")
    return frame.masked_rgb()


def _diverged(out: Path, step: int, losses: Sequence[float]) -> str:
    """What to say of a fit that diverged: the loss of the model it started from, and of its last passes."""
    first, *passes = (f"{loss:.3g}" for loss in losses)
    fit = "the fit to the seeds" if step == 0 else f"the fit of step {step}"
    kept = {0: "", 1: "; step 0 is kept"}.get(step, f"; steps 0 to {step - 1} are kept")
    rates = "`train.rates`" if step == 0 else "`warm_rate` or `train.rates`"
    return (
        f"{out}: {fit} diverged: its loss was {first} at the start, and {', '.join(passes[-3:])} in the last passes; "
        f"lower the learning rates ({rates} in {out / 'config.json'}) and go on with `mgs nbv --resume {out}`{kept}"
    )


def write_checkpoint(out: Path, state: State) -> None:
    """Commit a step: the state in one file, renamed into place; then the readable lines."""
    text = json.dumps({"taken": state.taken, "steps": state.steps, "inputs": state.inputs}, allow_nan=False)
    with atomic_path(out / "checkpoint.npz") as temporary, open(temporary, "wb") as file:
        np.savez(file, H=state.H, surface=state.surface, json=np.array(text), **asdict(state.gaussians))
    write_steps(out, state)


def write_steps(out: Path, state: State) -> None:
    """Write steps.jsonl from the state, atomically."""
    text = "".join(json.dumps(line, allow_nan=False) + "\n" for line in state.steps)
    with atomic_path(out / "steps.jsonl") as temporary:
        temporary.write_text(text, encoding="utf-8")


def read_checkpoint(out: Path) -> State | None:
    """State after the last finished step; None before the first. Raises InputError where the file is damaged."""
    path = out / "checkpoint.npz"
    if not path.is_file():
        return None
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as data:
            record = json.loads(str(data["json"]), parse_constant=lambda _: None)  # older runs could hold NaN
            gaussians = Gaussians(*(data[name] for name in ("means", "log_scales", "quats", "logit_opacities", "sh")))
            return State(gaussians, data["H"], data["surface"], record["taken"], record["steps"], record.get("inputs", {}))
    except (zipfile.BadZipFile, KeyError, ValueError, OSError, EOFError) as error:
        raise InputError(f"{path}: not a readable checkpoint ({error}); delete it to start the run from its seeds") from None
