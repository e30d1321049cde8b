"""What the cells of a study do: render a dataset, build a prior, run a policy, time one. All can go
on where they stopped.

Every function is a task of `mgs.study.sweep.Cell`: root is the study's folder, out the cell's own.
A dataset lies in OUT/dataset, a prior in OUT/prior, a run in OUT/run. Other cells are named by
their names.
"""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Callable, Sequence
from dataclasses import asdict
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Thread
from typing import Any

from mgs.data.dataset import TEST_FOLDER, load_dataset, write_transforms
from mgs.errors import InputError
from mgs.files import atomic_folder
from mgs.fit.settings import COLOURS_ALONE
from mgs.run.folder import State
from mgs.run.nbv import resume_nbv, run_nbv
from mgs.study.material import made_dataset, made_prior
from mgs.study.sweep import cell_folder
from mgs.synth.rendering import RenderPreset
from mgs.synth.scene_file import load_scene_file

CURVES = ("images", "coverage", "test_psnr", "test_psnr_mask")
"""What `run_policy` tells of every fit."""


def dataset_of(root: Path, name: str) -> Path:
    """The dataset of a cell."""
    return cell_folder(root, name) / "dataset"


def make_dataset(
    root: Path,
    out: Path,
    scene: str,
    seed: int,
    orbit: str,
    test_views: int,
    preset: dict[str, int],
    distances: Sequence[float] = (1,),
    mesh: str | None = None,
) -> dict[str, Any]:
    """Render a scene's rock of that seed, or a mesh in its place, from an orbit of that kind.
    preset: fields of `mgs.synth.rendering.RenderPreset`; distances: of `mgs.synth.scene_file.Orbit`."""
    loaded = load_scene_file(scene)
    flight = loaded.orbit.model_copy(update={"kind": orbit, "distances": tuple(distances)})
    settings = loaded.model_copy(update={"orbit": flight})
    return {
        "frames": len(
            made_dataset(out / "dataset", settings, RenderPreset(**preset), seed, test_views, mesh)
        )
    }


def make_arc(root: Path, out: Path, ring: str, every: int) -> dict[str, Any]:
    """A biased pool: of the ring's frames all those of the first half, and of the second half only
    one of every so many.

    ring: cell of a dataset whose frames go once around the rock. Its files are copied, and its test
    views too.
    """
    source = load_dataset(dataset_of(root, ring))
    half = len(source) // 2
    kept = [frame for i, frame in enumerate(source.frames) if i < half or (i - half) % every == 0]
    folder = out / "dataset"
    if not folder.is_dir():
        with atomic_folder(folder) as unfinished:
            copies = []
            for frame in kept:
                paths = {key: path for key, path in asdict(frame).items() if isinstance(path, Path)}
                for path in paths.values():
                    target = unfinished / path.relative_to(source.root)
                    target.parent.mkdir(parents=True, exist_ok=True)
                    shutil.copyfile(path, target)
                moved: dict[str, Any] = {
                    key: unfinished / path.relative_to(source.root) for key, path in paths.items()
                }
                copies.append(type(frame)(frame.name, frame.camera, frame.timestamp, **moved))
            shutil.copytree(source.root / TEST_FOLDER, unfinished / TEST_FOLDER)
            write_transforms(unfinished, copies, source.up, source.unit)
    return {"frames": len(kept)}


def make_prior(root: Path, out: Path, dataset: str, gaussians: int, seed: int) -> dict[str, Any]:
    """Build the prior of a dataset."""
    made_prior(out / "prior", dataset_of(root, dataset), gaussians=gaussians, seed=seed)
    return {"gaussians": gaussians}


def run_policy(
    root: Path, out: Path, dataset: str, prior: str, settings: dict[str, Any]
) -> dict[str, Any]:
    """Run a policy, and measure the model on the test views after every fit.

    settings: fields of `mgs.run.settings.NbvSettings`. Returns a list of numbers for each of
    CURVES, a number for each fit (of a batch only the last step has one), and "taken", the frames
    in the order of their choice.
    """
    state = run_or_resume(root, out, dataset, prior, {"evaluate_every": 1, **settings})
    fitted = [step for step in state.steps if "loss" in step]
    return {key: [step[key] for step in fitted] for key in CURVES} | {"taken": state.taken}


def run_or_resume(
    root: Path, out: Path, dataset: str, prior: str, settings: dict[str, Any]
) -> State:
    """The last state of the run in OUT/run, which is begun or continued."""
    for leftover in out.glob(
        ".run.*.part"
    ):  # of a process that was killed before the run had begun
        shutil.rmtree(leftover)
    run = out / "run"
    if (run / "config.json").is_file():
        return resume_nbv(run)
    given = {**settings, "train": {**COLOURS_ALONE, **settings.get("train", {})}}
    return run_nbv(
        dataset_of(root, dataset), run, prior=cell_folder(root, prior) / "prior", **given
    )


def time_policy(
    root: Path, out: Path, dataset: str, prior: str, settings: dict[str, Any]
) -> dict[str, Any]:
    """Run a policy in a process of its own, so that its memory is its own, and measure the model it
    ends with.

    Returns "images"; "test", "all" and "held_out" of `mgs.report.evaluation.evaluate`; "seconds",
    those of all steps without the measuring; "choice_seconds", the mean of one choice (None where
    none is made); "peak_megabytes", the most memory of the process by the end of the run. Raises
    InputError if that process is killed, and what it raises.
    """
    return in_own_process(_timed, out, root, out, dataset, prior, settings)


def in_own_process(
    task: Callable[..., dict[str, Any]], out: Path, *arguments: Any
) -> dict[str, Any]:
    """What a task returns that is done in a new process, so that its memory is its own. out: its
    cell, for messages.

    Raises InputError if that process is killed, and what it raises.
    """
    context = get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_send, args=(sender, task, *arguments))
    process.start()
    sender.close()
    try:
        result = receiver.recv()
    except EOFError:
        raise InputError(
            f"{out}: its process was killed (is there too little memory?); give the command again"
        ) from None
    finally:
        process.join()
    if isinstance(result, Exception):
        raise result
    return dict(result)


def _send(sender: Connection, task: Callable[..., dict[str, Any]], *arguments: Any) -> None:
    """Do a task in this process, which was started for it, and send what it returns or raises.
    Ctrl-C ends it silently."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    Thread(target=_end_with_parent, daemon=True).start()
    try:
        sender.send(task(*arguments))
    except Exception as error:
        sender.send(error)


def _end_with_parent() -> None:
    """End this process when the one that started it has ended. If that was killed, this one would
    work on, for no one."""
    parent = parent_process()
    assert parent
    parent.join()
    os._exit(1)


def _timed(
    root: Path, out: Path, dataset: str, prior: str, settings: dict[str, Any]
) -> dict[str, Any]:
    """What `time_policy` does in its process."""
    from mgs.report.evaluation import evaluate_run

    steps = run_or_resume(root, out, dataset, prior, settings).steps
    peak = peak_megabytes()
    metrics = evaluate_run(out / "run", pictures=False)
    choices = [step["seconds"]["score"] for step in steps[1:]]
    seconds = sum(
        value for step in steps for stage, value in step["seconds"].items() if stage != "evaluate"
    )
    return {key: metrics[key] for key in ("images", "test", "all", "held_out")} | {
        "seconds": seconds,
        "choice_seconds": sum(choices) / len(choices) if choices else None,
        "peak_megabytes": peak,
    }


def peak_megabytes() -> float:
    """Most memory that this process has had, megabytes; not that of the process that started it, as
    `getrusage` may tell."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:")) * 1.024e-3
