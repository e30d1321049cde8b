"""The folder of a run: its files, how they are read and written.

- `config.json`: settings, versions and the names of all frames; written first.
- `checkpoint.npz`: the state after the last finished step, replaced atomically: the commit.
- `steps.jsonl`: one line a step, written after the checkpoint.
- `gaussians.ply`: the model, once the run has ended.
- `policy.py`: source of a policy that is a Python function; read, never run.

A step is one chosen view; of a batch only the last step has a fit. A line of `steps.jsonl` holds:

- `step`: 0 for the seeds. `frame`, `name`: the chosen view; at step 0 `seeds`, `seed_names`.
- `images`: number of views taken. `score`: the policy's own number.
- `information_gain`: Eq. 7 of the chosen view by the run's estimator, whatever the policy.
- `coverage`: Eq. 9. `uncertainty`: mean variance that is left, over that of the prior.
- `iterations`, `loss`, `stop_reason`: of the fit.
- `residual`: rms difference of the new images to the model before, linear RGB.
- `exposure`: gains (red, green, blue) by frame name, with the setting `exposure`.
- `prediction`: predicted masked PSNR of the views not taken, dB, and what it is computed from
  (`mgs.run.checks.predicted_psnr`); if the policy plans all views or `stop_psnr` is set.
- `indicators`, `warnings`: of `mgs.run.detectors`. `seconds`: by stage.
- `test_psnr`, `test_psnr_mask`, dB, where it was evaluated; without test views `psnr`, `psnr_mask`
  over all views, and `held_out_...`.
- `ended`: in the last line of a run that has ended (`mgs.run.ending.run_end`).
"""

from __future__ import annotations

import json
import math
import warnings
import zipfile
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict

from mgs.data.dataset import Dataset, load_dataset
from mgs.data.frames import Frame
from mgs.data.up import upright
from mgs.errors import InputError, Notice
from mgs.files import atomic_path, parsing, read_json, reading, write_json
from mgs.gaussians import ARRAYS, Gaussians
from mgs.notebook import cloud, html, thumbnails
from mgs.policy.from_file import label
from mgs.prior.build import Prior, load_prior
from mgs.provenance import versions
from mgs.run.ending import RunEnd
from mgs.run.settings import NbvSettings, check_settings, validated
from mgs.run.state import State
from mgs.splat_ply import read_ply, write_ply

POLICY_SOURCE = "policy.py"

FILES = [
    *("config.json", "checkpoint.npz", "steps.jsonl", "metrics.json", "gaussians*", POLICY_SOURCE),
    *("prior", "dataset", "renders", "diagnostics", "tensorboard", "export.*", "video.*"),
]
"""Names in the folder of a run, with what commands add to it."""

DATASET = "dataset"
"""Folder of a run that holds its dataset, where the run captures images (`mgs nbv --capture`)."""


class Run:
    """A run folder, its settings, and its dataset, prior and state, each read once at first use.

    settings: from the folder's config.json. policy: as it was given in this process, if it was. A
    Run can be given wherever a folder is wanted. Properties raise InputError if a file is missing
    or damaged; `state` also if no step is finished yet; `dataset` also if its frames changed.
    """

    def __init__(
        self,
        folder: Path,
        settings: NbvSettings,
        dataset: Dataset | None = None,
        prior: Prior | None = None,
        policy: str | Callable[..., Any] | None = None,
        state: State | None = None,
    ) -> None:
        self.folder, self.settings, self.policy = folder, settings, policy
        self._dataset, self._prior, self._state = dataset, prior, state

    def __fspath__(self) -> str:
        return str(self.folder)

    def __repr__(self) -> str:
        planned = self.settings.seeds + self.settings.budget
        path = self.folder / "checkpoint.npz"
        views = len(self.state.taken) if self._state or path.is_file() else 0
        return f"Run({self.folder}: {self.label}, {views} of {planned} views)"

    def _repr_html_(self) -> str:
        if not (self._state or (self.folder / "checkpoint.npz").is_file()):
            return html(repr(self), [])
        taken, g = thumbnails([frame.image_path for frame in self.taken]), self.gaussians
        turn = upright(self.prior.up)
        return html(repr(self), [*taken, cloud(g.means @ turn.T, g.rgb)])

    @cached_property
    def dataset(self) -> Dataset:
        """The dataset of the run."""
        if self._dataset is not None:
            return self._dataset
        dataset = load_dataset(self.settings.dataset)
        check_same_frames(self.folder, dataset)
        return dataset

    @cached_property
    def prior(self) -> Prior:
        """The prior of the run."""
        if self._prior is not None:
            return self._prior

        path = self.settings.prior
        if not path.is_dir():
            where = f"{self.folder / 'config.json'}: prior {path}"
            raise InputError(f"{where} is not there; if it was moved, correct `prior` there")
        return load_prior(path)

    @cached_property
    def state(self) -> State:
        """The state after the last finished step."""
        if self._state is not None:
            return self._state
        state = read_checkpoint(self.folder)
        if state is None:
            resume = f"`mgs nbv --resume {self.folder}`"
            raise InputError(f"{self.folder}: has no finished step yet; continue it with {resume}")
        if "ended" in state.steps[-1]:
            self._repair(state)
        return state

    def _repair(self, state: State) -> None:
        """Write gaussians.ply again where it is not the model of the checkpoint, and warn."""
        path = self.folder / "gaussians.ply"
        try:
            intact = read_ply(path) == state.gaussians
        except InputError:
            intact = False
        if not intact:
            write_ply(path, state.gaussians)
            warnings.warn(
                Notice(f"{path}: was damaged; restored from checkpoint.npz"), stacklevel=3
            )

    @property
    def gaussians(self) -> Gaussians:
        """The model after the last finished step."""
        return self.state.gaussians

    @property
    def taken(self) -> list[Frame]:
        """The frames trained on, in the order of their choice."""
        return [self.dataset.frames[i] for i in self.state.taken]

    @property
    def label(self) -> str:
        """Name of the policy; "fit" if the run chooses no view."""
        return label(self.settings.policy, self.settings.budget)


def open_run(folder: str | Path) -> Run:
    """Open a run folder.

    Raises InputError as `read_config`, where a setting is wrong, and where the dataset is gone.
    """
    folder = Path(folder)
    path = folder / "config.json"
    settings = validated(NbvSettings, read_config(folder)["settings"], path)
    if not settings.dataset.is_dir():
        where = f"{path}: dataset {settings.dataset} is not there"
        raise InputError(f"{where}; if it was moved, correct `dataset` in this file")
    return Run(folder, settings)


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
    """Read config.json of a run. Raises InputError where there is none, or it is damaged."""
    path = out / "config.json"
    if (out / "transforms.json").is_file():
        raise InputError(f"{out}: is a dataset; make a run of it: `mgs nbv {out} --out RUN`")
    if not path.is_file():
        raise InputError(
            f"{out}: holds no run (no config.json); start one with `mgs nbv DATASET --out {out}`"
        )
    config = read_json(path)
    if not isinstance(config, dict) or not isinstance(config.get("settings"), dict):
        raise InputError(f"{path}: has no settings; the file is damaged, start the run anew")
    return config


def holds_run(out: Path) -> bool:
    """Whether a folder holds a run. A dataset has a config.json too, without settings of a run."""
    try:
        read_config(out)
    except (InputError, OSError):  # OSError: a name that is too long
        return False
    return True


def check_same_frames(out: Path, dataset: Dataset) -> None:
    """Raises InputError where the dataset has other frames than the run was started on."""
    if read_config(out).get("frames") != [frame.name for frame in dataset.frames]:
        raise InputError(
            f"{dataset.root}: its frames differ from those {out} was started on; "
            "restore them or start a new run"
        )


def write_checkpoint(out: Path, state: State) -> None:
    """Commit a step: the state in one file, renamed into place; then the readable lines."""
    text = json.dumps(
        {
            "taken": state.taken,
            "steps": state.steps,
            "inputs": state.inputs,
            "antialiased": state.gaussians.antialiased,
        },
        allow_nan=False,
    )
    arrays = {name: getattr(state.gaussians, name) for name in ARRAYS}
    with atomic_path(out / "checkpoint.npz") as temporary, open(temporary, "wb") as file:
        np.savez(file, H=state.H, surface=state.surface, json=np.array(text), **arrays)
    write_steps(out, state)


def write_steps(out: Path, state: State) -> None:
    """Write steps.jsonl from the state, atomically."""
    text = "".join(json.dumps(line, allow_nan=False) + "\n" for line in state.steps)
    with atomic_path(out / "steps.jsonl") as temporary:
        temporary.write_text(text, encoding="utf-8")


def read_checkpoint(out: Path) -> State | None:
    """Read the state after the last finished step; None before the first.

    Raises InputError where the file is damaged, or claims more than it holds.
    """
    path = out / "checkpoint.npz"
    if not path.is_file():
        return None
    kinds = {"json": "U", "H": "f", "surface": "f"} | dict.fromkeys(ARRAYS, "f")
    cure = "delete it to start again from the seeds"
    with reading(path), parsing(path, "checkpoint", cure), zipfile.ZipFile(path) as file:
        arrays: dict[str, Any] = {n: _member(file, n, kind) for n, kind in kinds.items()}
        record = json.loads(str(arrays.pop("json")[()]))
        H, surface = arrays.pop("H"), arrays.pop("surface")
        gaussians = Gaussians(**arrays, antialiased=record.pop("antialiased") is True)
        gaussians.check(f"{path}: not a readable checkpoint")
        state = State(gaussians, H, surface, **record)
        for number, line in enumerate(state.steps, 1):
            check_line(number, line)
        if not isinstance(state.inputs, dict) or frames_of(state.steps) != state.taken:
            raise ValueError("its frames are not those of its steps")
        if H.ndim != 2 or surface.ndim != 2 or len(H) != len(state.gaussians):
            raise ValueError(f"H has shape {H.shape} of {len(state.gaussians)} Gaussians")
    frames = read_config(out).get("frames")
    check_frames(path, state.taken, len(frames) if isinstance(frames, list) else 0)
    return state


def _member(file: zipfile.ZipFile, name: str, kind: str) -> np.ndarray:
    """An array of a checkpoint. Raises ValueError unless it is stored as it is, its dtype is of
    this kind, and it is as long as its header says, so that it takes no more memory than disk."""
    known = file.getinfo(f"{name}.npy")
    if known.compress_type != zipfile.ZIP_STORED or known.flag_bits & 1:
        raise ValueError(f"{name} is compressed")
    with file.open(known) as member:
        version = np.lib.format.read_magic(member)
        if version not in ((1, 0), (2, 0)):
            raise ValueError(f"{name} has a header of another version")
        read = np.lib.format.read_array_header_1_0
        read = read if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran, dtype = read(member)
        if dtype.kind != kind or dtype.hasobject:
            raise ValueError(f"{name} has dtype {dtype}")
        data = member.read()
    if math.prod(shape) * dtype.itemsize != len(data):
        raise ValueError(f"{name} has shape {shape} in {len(data)} bytes")
    return np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C").copy("K")


def check_frames(path: Path, taken: Sequence[int], count: int) -> None:
    """Raises InputError where frames taken, as a file says, are not among this number."""
    if not all(0 <= frame < count for frame in taken):
        raise InputError(f"{path}: takes frames beyond the {count} of the run; start the run anew")


class _Checked(BaseModel):
    model_config = ConfigDict(allow_inf_nan=False)


class _Ended(_Checked):
    reason: RunEnd
    views: int
    name: str = ""
    limit: float = 0.0
    uncertainty: float = 0.0
    information_gain: float = 0.0
    metres: float = 0.0


class _Line(_Checked):
    """Keys of every line, and the types of optional ones."""

    images: int
    coverage: float
    ended: _Ended | None = None
    step: int = 0
    name: str | None = None
    warnings: list[str] = []
    seconds: dict[str, float] = {}
    exposure: dict[str, list[float]] | None = None


class _SeedLine(_Line):
    """The first line, which is about the seeds."""

    seeds: list[int]


class _ChoiceLine(_Line):
    """Any other line, which is about one chosen view."""

    frame: int
    information_gain: float


def check_line(number: int, line: Any) -> None:
    """Raises ValueError (pydantic's ValidationError) where a line, counted from 1, is damaged."""
    (_SeedLine if number == 1 else _ChoiceLine).model_validate(line)


def frames_of(lines: Sequence[dict[str, Any]]) -> list[int]:
    """Indices of the frames taken, by checked lines: seeds, then chosen ones."""
    return [*lines[0]["seeds"], *(int(line["frame"]) for line in lines[1:])]
