"""The folder of a run: what is in it, how it is read and written.

- `config.json`: settings, versions and the names of all frames; written first;
- `checkpoint.npz`: the whole state after the last finished step, replaced atomically: this is the
commit of a step;
- `steps.jsonl`: one line a step, rebuilt from the checkpoint, so it can lag behind by a killed step
but never disagree;
- `gaussians.ply`: the model, once the run has ended.

A step is one chosen view, whatever the size of a batch; only the last step of a batch has a fit,
and what is measured after it. A line of `steps.jsonl` holds: `step` (0 = the seeds), `frame` and
`name` of the chosen view (null at step 0, which has `seeds` and `seed_names` instead), `images`
(how many are taken by then), `score` (the policy's own number; of random, the draw),
`information_gain` (Eq. 7 of the chosen view by the run's estimator, whatever the policy),
`coverage` (Eq. 9 of all images), `uncertainty` (the mean over all parameters of the variance that
is left, over that of the prior), `iterations`, `loss` and `stop_reason` of the fit, and from step 1
`residual`, by how much the new images differed from the model before it; with the setting
`exposure`, under that name, the gains (red, green, blue) by which the image of each frame was
divided; `signs` of what may go wrong (`mgs.run.detectors`) and, where one of them has just gone
beyond its limit, `warnings`, sentences; `seconds` per stage, and, where the step was evaluated,
mean PSNR in dB over all views (`psnr`; `psnr_mask` in the rock mask), over those never trained on
(`held_out_psnr`, `held_out_psnr_mask`), and over the test views of the dataset where it has some
(`test_psnr`, `test_psnr_mask`). The last line of a run that has ended has `ended`, which says why
(`mgs.run.ending.run_end`).
"""

from __future__ import annotations

import json
import zipfile
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mgs.data.dataset import Dataset, load_dataset
from mgs.errors import InputError, row_named
from mgs.files import atomic_path, read_json, write_json
from mgs.gaussians import Gaussians
from mgs.policy.from_file import label
from mgs.policy.registry import policy_named
from mgs.provenance import versions
from mgs.run.settings import NbvSettings, validated

DATASET = "dataset"
"""Folder of a run that holds its dataset, where the run captures images (`mgs nbv --capture`)."""


@dataclass
class State:
    """What is known after a step.

    gaussians: the fitted model. H [N,P]: information of the training set at that model. surface
    [S,P]: its information about the S Gaussians on the prior's surface as they were before
    training, which is what the views see of the surface; of learned
    means, H has columns and surface has none. taken:
    frame indices in the order in which they were taken. steps: all lines of steps.jsonl. inputs:
    what the run was made from, a record of `mgs.run.inputs`, empty in runs of versions that kept
    none.
    """

    gaussians: Gaussians
    H: np.ndarray
    surface: np.ndarray
    taken: list[int]
    steps: list[dict[str, Any]]
    inputs: dict[str, Any] = field(default_factory=dict)


def check_settings(settings: NbvSettings, frames: int) -> None:
    """Raises InputError where the policy, the estimator or the optimiser is unknown, estimator or
    policy knows nothing of means that are learned, or the dataset has too few frames for the seeds
    and the budget."""
    from mgs.fit.optimisers import OPTIMISERS  # these two need Dr.Jit, which reading a run does not
    from mgs.splat import ESTIMATORS

    diagonal = [name for name in ESTIMATORS if name != "block"]
    policy_named(settings.policy)
    if settings.estimator not in diagonal:
        known = ", ".join(diagonal)
        raise InputError(
            f"--estimator {settings.estimator}: gives no diagonal, or is unknown; choose one of {known}"
        )
    blind = [f"--estimator {settings.estimator}"] if settings.estimator != "exact" else []
    blind += ["--policy paper"] if settings.policy == "paper" else []
    if settings.train.means != "frozen" and blind:
        raise InputError(
            f"--means {settings.train.means}: {blind[0]} knows nothing of means; leave out either"
        )
    row_named(OPTIMISERS, settings.train.optimiser, "--optimiser")
    if frames < settings.seeds:
        raise InputError(
            f"{settings.dataset}: has {frames} frames, fewer than {settings.seeds} seeds; lower --seeds"
        )
    left = frames - settings.seeds
    if settings.budget > left:
        raise InputError(
            f"{settings.dataset}: --budget {settings.budget} exceeds its {left} candidates; lower --budget"
        )


def start(out: Path, settings: NbvSettings, dataset: Dataset) -> None:
    """Write config.json, the first file of a run. Raises InputError as `check_settings`."""
    check_settings(settings, len(dataset))
    config = {
        "settings": settings.model_dump(mode="json"),
        "versions": versions(),
        "frames": [frame.name for frame in dataset.frames],
    }
    write_json(out / "config.json", config)


def read_config(out: Path) -> dict[str, Any]:
    """What config.json of a run folder holds. Raises InputError where there is no run, and where
    its config.json is damaged."""
    path = out / "config.json"
    if not path.is_file():
        raise InputError(
            f"{out}: holds no run (no config.json); start one with `mgs nbv DATASET --out {out}`"
        )
    config = read_json(path)
    if not isinstance(config, dict) or not isinstance(config.get("settings"), dict):
        raise InputError(f"{path}: has no settings; the file is damaged, start the run anew")
    return config


def holds_run(out: Path) -> bool:
    """Whether a folder holds a run that can be read. A dataset has a config.json, too, but no
    settings of a run."""
    try:
        read_config(out)
    except (InputError, OSError):  # OSError: not even the name can be looked up
        return False
    return True


def read_settings(out: Path) -> NbvSettings:
    """Settings of a run folder. Raises InputError as `read_config`, where a setting is wrong, and
    if the dataset is gone."""
    path = out / "config.json"
    settings = validated(NbvSettings, read_config(out)["settings"], path)
    if not settings.dataset.is_dir():
        raise InputError(
            f"{path}: dataset {settings.dataset} is not there; if it was moved, correct `dataset` in this file"
        )
    return settings


def check_same_frames(out: Path, dataset: Dataset) -> None:
    """Raises InputError where the dataset is no longer the one the run was started on."""
    if read_json(out / "config.json").get("frames") != [frame.name for frame in dataset.frames]:
        raise InputError(
            f"{dataset.root}: its frames differ from those {out} was started on; restore them or start a new run"
        )


def write_checkpoint(out: Path, state: State) -> None:
    """Commit a step: the state in one file, renamed into place; then the readable lines."""
    text = json.dumps(
        {"taken": state.taken, "steps": state.steps, "inputs": state.inputs}, allow_nan=False
    )
    with atomic_path(out / "checkpoint.npz") as temporary, open(temporary, "wb") as file:
        np.savez(
            file, H=state.H, surface=state.surface, json=np.array(text), **asdict(state.gaussians)
        )
    write_steps(out, state)


def write_steps(out: Path, state: State) -> None:
    """Write steps.jsonl from the state, atomically."""
    text = "".join(json.dumps(line, allow_nan=False) + "\n" for line in state.steps)
    with atomic_path(out / "steps.jsonl") as temporary:
        temporary.write_text(text, encoding="utf-8")


def read_checkpoint(out: Path) -> State | None:
    """State after the last finished step; None before the first. Raises InputError where the file
    is damaged."""
    path = out / "checkpoint.npz"
    if not path.is_file():
        return None
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as data:
            record = json.loads(
                str(data["json"]), parse_constant=lambda _: None
            )  # older runs could hold NaN
            gaussians = Gaussians(
                *(data[name] for name in ("means", "log_scales", "quats", "logit_opacities", "sh"))
            )
            return State(
                gaussians,
                data["H"],
                data["surface"],
                record["taken"],
                record["steps"],
                record.get("inputs", {}),
            )
    except (zipfile.BadZipFile, KeyError, ValueError, OSError, EOFError) as error:
        raise InputError(
            f"{path}: not a readable checkpoint ({error}); delete it to start the run from its seeds"
        ) from None


def load_run(run: Path) -> tuple[Gaussians, Dataset, list[str], str]:
    """(model, dataset, names of the views trained on in order, policy) of a run folder.

    Raises InputError where the run is missing, it has no finished step, or its dataset has changed.
    """
    settings = read_settings(run)
    state = read_checkpoint(run)
    if state is None:
        raise InputError(
            f"{run}: has no finished step yet; continue it with `mgs nbv --resume {run}`"
        )
    dataset = load_dataset(settings.dataset)
    check_same_frames(run, dataset)
    return (
        state.gaussians,
        dataset,
        [dataset.frames[i].name for i in state.taken],
        label(settings.policy),
    )
