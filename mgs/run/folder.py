"""The folder of a run. docs/nbv.md lists its files and the keys of steps.jsonl. `config.json` is
written first. `checkpoint.npz` is replaced atomically: the commit of a step."""

import json
import warnings
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from mgs.data.dataset import Dataset, load_dataset
from mgs.data.frames import Frame, has_masks
from mgs.data.structure import POSES
from mgs.data.world import PLUS_Z, Vector, unit_up
from mgs.errors import InputError, Notice
from mgs.files import (
    atomic_path,
    check_unlocked,
    parsing,
    read_json,
    reading,
    remove_file,
    stored_array,
    write_json,
    write_text,
)
from mgs.gaussians import ARRAYS, Gaussians
from mgs.notebook import cloud, html, thumbnails
from mgs.policy.criteria import observed, regularisation
from mgs.prior.build import Prior, load_prior
from mgs.provenance import versions
from mgs.run.ending import RunEnd
from mgs.run.policy_file import label
from mgs.run.records import Config, Metrics, Record, parse_record, read_checked
from mgs.run.settings import NbvSettings, validated
from mgs.splat_places import to_source
from mgs.splat_ply import read_ply, write_ply

CHECKPOINT, STEPS, POLICY_SOURCE = "checkpoint.npz", "steps.jsonl", "policy.py"
UNFINISHED = "fit.npz"  # state of the fit at work, until its step is in the checkpoint

FILES = [
    *("config.json", CHECKPOINT, UNFINISHED, STEPS, "metrics.json", "gaussians*", POLICY_SOURCE),
    *("prior", "dataset", "renders", "diagnostics", "export.*", "video.*"),
]
"""Names in the folder of a run, with what commands add to it."""

DATASET = "dataset"  # of a run whose pictures are taken meanwhile (`mgs.run.live`)


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """State of a run after a step, as the run folder holds it.

    gaussians, H, surface, taken: as `mgs.scene.State`. steps: lines of steps.jsonl. inputs: hashes
    of the inputs (`mgs.run.inputs`). upright: whether the model's world has +Z up."""

    gaussians: Gaussians
    H: np.ndarray
    surface: np.ndarray
    taken: list[int]
    steps: list[dict[str, Any]] = field(default_factory=list)
    inputs: dict[str, Any] = field(default_factory=dict)
    upright: bool = True


class Run:
    """A run folder: its settings, and what its files hold, each read once at first use. Can be
    given wherever a folder is wanted.

    settings: from config.json. policy: as it was given in this process. Properties raise InputError
    if a file is missing or damaged; `steps` and `state` if no step is finished; `dataset` if its
    frames changed."""

    def __init__(
        self,
        folder: Path,
        settings: NbvSettings,
        dataset: Dataset | None = None,
        prior: Prior | None = None,
        policy: str | Callable[..., Any] | None = None,
        state: Checkpoint | None = None,
    ) -> None:
        self.folder, self.settings, self.policy = folder, settings, policy
        for name, value in (("dataset", dataset), ("prior", prior), ("state", state)):
            if value is not None:
                self.__dict__[name] = value

    def __fspath__(self) -> str:
        return str(self.folder)

    def __repr__(self) -> str:
        views = len(self.indices) if self.begun else 0
        return f"Run({self.folder}: {self.label}, {views} of {self.planned} views)"

    def _repr_html_(self) -> str:
        if not self.begun:
            return html(repr(self), [])
        taken, g = thumbnails([frame.image_path for frame in self.taken]), self.gaussians
        return html(repr(self), [*taken, cloud(g.means, g.linear_rgb(g.rgb))])

    @property
    def label(self) -> str:
        """Name of the policy; "fit" if the run chooses no view."""
        return label(self.settings.policy, self.settings.budget)

    @property
    def of_scene(self) -> bool:
        """Whether its model is of a whole scene, not of one object: no surface and no masks."""
        return not has_masks(self.dataset.frames) and self.prior.kind == "random"

    @property
    def shown(self) -> np.ndarray:
        """Mask [N] of the Gaussians to show and to export: in a whole scene those about which the
        views taken say more than a colour's prior (`mgs.policy.criteria.observed`), and black
        ones that they see. The surface of an object is the prior's where no view saw it, and all of
        it is shown."""
        if not self.of_scene:
            return np.ones(len(self.gaussians), bool)
        H = self.state.H
        black = ~H[:, :3].any(axis=1) & H.any(axis=1)  # clamped at 0, with information on the rest
        return black | observed(H, regularisation({"colour": slice(3)}))

    @property
    def planned(self) -> int:
        """Number of seeds and of views to choose."""
        return self.settings.seeds + self.settings.budget

    @property
    def begun(self) -> bool:
        """Whether a step is finished."""
        return "state" in self.__dict__ or (self.folder / CHECKPOINT).is_file()

    @cached_property
    def config(self) -> dict[str, Any]:
        """Contents of config.json: `settings`, `versions` and the names of all `frames`."""
        return read_config(self.folder)

    @cached_property
    def dataset(self) -> Dataset:
        """The dataset of the settings, in the upright world of the prior."""
        dataset = load_dataset(self.settings.dataset, up=up_of_prior(self.settings.prior))
        self.check_frames(dataset)
        return dataset

    def check_frames(self, dataset: Dataset) -> None:
        """Raises InputError if a dataset has other frames than the run was started on."""
        if self.config["frames"] != [frame.name for frame in dataset.frames]:
            differ = f"its frames differ from those {self.folder} was started on"
            raise InputError(f"{dataset.root}: {differ}; restore them or start a new run")

    @cached_property
    def prior(self) -> Prior:
        path = self.settings.prior
        if not path.is_dir():
            where = f"{self.folder / 'config.json'}: prior {path}"
            raise InputError(f"{where} is not there; if it was moved, correct `prior` there")
        return load_prior(path)

    @cached_property
    def steps(self) -> list[dict[str, Any]]:
        """Lines of the finished steps, those of steps.jsonl (`mgs.run.folder`)."""
        if "state" in self.__dict__:
            return self.state.steps
        steps: list[dict[str, Any]] = self._existing(read_record(self.folder))["steps"]
        return steps

    @cached_property
    def state(self) -> Checkpoint:
        """The state after the last finished step."""
        state = self._existing(read_checkpoint(self.folder))
        if not state.upright and self.dataset.world.up != PLUS_Z:
            old = "an older mgs made it in a world that is not upright; start the run anew"
            raise InputError(f"{self.folder}: {old}")
        if "ended" in state.steps[-1]:
            self._repair(state)
        return state

    def _existing(self, found: Any) -> Any:
        if found is None:
            resume = f"`mgs nbv --resume {self.folder}`"
            raise InputError(f"{self.folder}: has no finished step yet; continue it with {resume}")
        return found

    def _repair(self, state: Checkpoint) -> None:
        path, model = self.folder / "gaussians.ply", to_source(state.gaussians, self.dataset.world)
        try:
            check_unlocked(self.folder)
        except InputError:
            return  # the process at work there writes the file next
        try:
            intact = read_ply(path) == model
        except InputError:
            intact = False
        if not intact:
            write_ply(path, model)
            said = f"{path}: was damaged; restored from checkpoint.npz"
            warnings.warn(Notice(said), stacklevel=3)

    @property
    def gaussians(self) -> Gaussians:
        """The model after the last finished step."""
        return self.state.gaussians

    @property
    def model(self) -> Gaussians:
        """`gaussians` in the world of the dataset's files, as gaussians.ply has them."""
        return to_source(self.gaussians, self.dataset.world)

    @property
    def indices(self) -> list[int]:
        """Indices of the frames trained on, in the order of their choice."""
        return [*self.steps[0]["seeds"], *(line["frame"] for line in self.steps[1:])]

    @property
    def taken(self) -> list[Frame]:
        """The frames trained on, in the order of their choice."""
        return [self.dataset.frames[i] for i in self.indices]

    @property
    def ended(self) -> dict[str, Any] | None:
        """Why the run ended (`mgs.run.ending.run_end`); None for an unfinished run, also where the
        budget was raised after it was spent."""
        ended: dict[str, Any] | None = self.steps[-1].get("ended")
        spent = ended is not None and ended["reason"] == RunEnd.BUDGET
        return None if spent and len(self.indices) < self.planned else ended

    @cached_property
    def metrics(self) -> dict[str, Any] | None:
        """Contents of metrics.json; None if the run was not evaluated."""
        path, cure = self.folder / "metrics.json", f"measure it again with `mgs eval {self.folder}`"
        return read_checked(Metrics, path, cure) if path.exists() else None

    @cached_property
    def poses_moved(self) -> dict[str, dict[str, float]]:
        """Move of each pose by `refine_poses`, "degrees" and "length", by frame name."""
        path = self.settings.dataset / POSES
        if not self.settings.refine_poses:
            return {}
        with parsing(path, "record of poses", "start the run anew"):
            moved: dict[str, dict[str, float]] = read_json(path)["moved"]
            return {
                name: {k: float(move[k]) for k in ("degrees", "length")}
                for name, move in moved.items()
            }

    @property
    def measured(self) -> dict[str, Any] | None:
        """`metrics`, if they are of the model after the last step."""
        fresh = self.metrics is not None and self.metrics["images"] == len(self.indices)
        return self.metrics if fresh else None


def up_of_prior(folder: Path) -> Vector | None:
    """Upward direction by a prior's folder, in the world of its dataset's files; None where there
    is none. A run goes by it before the dataset's own."""
    file = folder / "prior.json"
    numbers = read_json(file) if file.is_file() else None
    return unit_up(numbers["up"]) if isinstance(numbers, dict) and "up" in numbers else None


def open_run(folder: str | PathLike[str]) -> Run:
    """Open a run folder; a `Run` stays as it is. Raises InputError as `read_config`, where a
    setting is wrong, and where the dataset is gone."""
    if isinstance(folder, Run):
        return folder
    folder = Path(folder)
    path = folder / "config.json"
    settings = validated(NbvSettings, read_config(folder)["settings"], path)
    if not settings.dataset.is_dir():
        where = f"{path}: dataset {settings.dataset} is not there"
        raise InputError(f"{where}; if it was moved, correct `dataset` in this file")
    return Run(folder, settings)


def write_config(out: Path, settings: NbvSettings, dataset: Dataset) -> None:
    """Write config.json, the first file of a run."""
    frames = [frame.name for frame in dataset.frames]
    config = {"settings": settings.model_dump(mode="json"), "versions": versions()}
    write_json(out / "config.json", config | {"frames": frames})


def read_config(out: Path) -> dict[str, Any]:
    """Read config.json of a run. Raises InputError where there is none, or it is damaged."""
    path = out / "config.json"
    if (out / "transforms.json").is_file():
        raise InputError(f"{out}: is a dataset; make a run of it: `mgs nbv {out} --out RUN`")
    if not path.is_file():
        raise InputError(f"{out}: holds no run; start one with `mgs nbv DATASET --out {out}`")
    return read_checked(Config, path, "start the run anew")


def holds_run(out: Path) -> bool:
    """Whether a folder holds a run. A dataset has a config.json too, without settings of a run."""
    try:
        read_config(out)
    except (InputError, OSError):  # OSError: a name that is too long
        return False
    return True


def write_checkpoint(out: Path, state: Checkpoint) -> None:
    """Commit a step: the state in one file, renamed into place; then the readable lines."""
    g, record = state.gaussians, {"taken": state.taken, "steps": state.steps}
    record |= {"inputs": state.inputs, "upright": True}
    record |= {"antialiased": g.antialiased, "linear": g.linear}
    text = json.dumps(record, allow_nan=False)
    arrays = {name: getattr(g, name) for name in ARRAYS}
    with atomic_path(out / CHECKPOINT) as temporary, open(temporary, "wb") as file:
        np.savez(file, H=state.H, surface=state.surface, json=np.array(text), **arrays)
    remove_file(out, out / UNFINISHED)
    write_steps(out, state)


def write_steps(out: Path, state: Checkpoint) -> None:
    write_text(out / STEPS, text_of(state.steps))


def text_of(steps: Sequence[dict[str, Any]]) -> str:
    return "".join(json.dumps(line, allow_nan=False) + "\n" for line in steps)


@contextmanager
def _checkpoint(out: Path) -> Iterator[zipfile.ZipFile | None]:
    """Open the checkpoint of a run; None before the first step. Damage becomes an InputError."""
    path = out / CHECKPOINT
    if not path.is_file():
        yield None
        return
    cure = "delete it to start again from the seeds"
    with reading(path), parsing(path, "checkpoint", cure), zipfile.ZipFile(path) as file:
        yield file


def read_record(out: Path) -> dict[str, Any] | None:
    """Read the `mgs.run.records.Record` of the last finished step; None before the first. Raises
    InputError where the file is damaged, or claims more than it holds."""
    with _checkpoint(out) as file:
        if file is None:
            return None
        record = parse_record(Record, str(stored_array(file, "json", "U")[()]))
    frames = read_config(out)["frames"]
    if not all(0 <= frame < len(frames) for frame in record["taken"]):
        raise InputError(f"{out / CHECKPOINT}: takes frames that the run lacks; start the run anew")
    return record


def read_checkpoint(out: Path) -> Checkpoint | None:
    """Read the state after the last finished step; None before the first. Raises InputError as
    `read_record`."""
    record = read_record(out)
    if record is None:
        return None
    with _checkpoint(out) as file:
        assert file is not None
        arrays: dict[str, Any]
        arrays = {name: stored_array(file, name, "f") for name in (*ARRAYS, "H", "surface")}
        H, surface = arrays.pop("H"), arrays.pop("surface")
        antialiased, linear = record.pop("antialiased"), record.pop("linear")
        gaussians = Gaussians(**arrays, antialiased=antialiased, linear=linear)
        gaussians.check(f"{out / CHECKPOINT}: not a readable checkpoint")
        if H.ndim != 2 or surface.ndim != 2 or len(H) != len(gaussians):
            raise ValueError(f"H has shape {H.shape} of {len(gaussians)} Gaussians")
    return Checkpoint(gaussians, H, surface, **{"upright": False} | record)
