"""State of a fit after a step, and the file from which an interrupted fit continues bit for bit."""

import json
import math
import time
import warnings
import zipfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from mgs.errors import InputError, Notice
from mgs.files import atomic_path, parsing, reading, stored_array
from mgs.fit.objective import ParameterPrior
from mgs.gaussians import ARRAYS, Gaussians
from mgs.memory import padded
from mgs.splat import as_drjit

SECONDS = 60.0  # of a fit between two states on disk: what an interruption loses at most


@dataclass
class FitState:
    """All that the next step of a fit depends on, besides the fit's arguments.

    - best: model after the pass with the lowest loss. prior: its start and lam change with a
      density control. buffers, information, slopes: as in `mgs.fit.fitting`.
    - losses: of the given model, then of each finished pass. steps: of each step since, before it.
    - images: number of times that an image was used. changed: passes before the last call of the
      density control. draws: random generator of that.
    """

    model: Gaussians
    best: Gaussians
    prior: ParameterPrior
    buffers: list[list[Any]]
    information: list[Any]
    draws: np.random.Generator
    slopes: list[Any] = field(default_factory=list)
    losses: list[float] = field(default_factory=list)
    steps: list[Any] = field(default_factory=list)
    images: int = 0
    changed: int = 0


@dataclass
class Unfinished:
    """File of an unfinished fit. key: text that differs for other arguments of the fit; a file with
    another key, or a damaged one, is not continued."""

    path: Path
    key: str

    def __post_init__(self) -> None:
        self._since = time.monotonic()

    def save(self, state: FitState) -> None:
        """Write a state where SECONDS have passed since the last. Raises InputError as
        `mgs.files.atomic_path`."""
        if time.monotonic() < self._since + SECONDS:
            return
        numbers = {
            "key": self.key,
            "losses": state.losses,
            "steps": [float(loss[0]) for loss in state.steps],
            "images": state.images,
            "changed": state.changed,
            "draws": state.draws.bit_generator.state,
        }
        arrays: dict[str, Any] = {name: np.asarray(each) for name, each in _arrays(state).items()}
        with atomic_path(self.path) as temporary, open(temporary, "wb") as file:
            np.savez(file, json=np.array(json.dumps(numbers)), **arrays)
        self._since = time.monotonic()

    def load(self, new: FitState) -> FitState | None:
        """Read the state of this fit; None where there is no file, and with a Notice where it is of
        another fit or damaged. new: state before any step."""
        if not self.path.is_file():
            return None
        with (
            suppress(InputError),
            reading(self.path),
            parsing(self.path, "fit", ""),
            zipfile.ZipFile(self.path) as file,
        ):
            numbers = json.loads(str(stored_array(file, "json", "U")[()]))
            if numbers.pop("key") == self.key:
                return _loaded(file, new, **numbers)
        why = "is of other pictures, settings or versions, or damaged"
        warnings.warn(Notice(f"{self.path}: {why}; the fit starts anew"), stacklevel=2)
        return None


def _arrays(state: FitState) -> dict[str, Any]:
    """Arrays of a state by their names in the file."""
    models = {"model": state.model, "best": state.best, "start": state.prior.start}
    arrays = {
        f"{part}.{name}": getattr(model, name) for part, model in models.items() for name in ARRAYS
    }
    for k, (name, lam) in enumerate(state.prior.lam.items()):
        arrays[f"lam.{name}"] = lam
        arrays |= {f"buffer.{name}.{i}": each for i, each in enumerate(state.buffers[k])}
        if state.information[k] is not None:
            arrays[f"information.{name}"] = state.information[k]
    return arrays | {f"slopes.{i}": each for i, each in enumerate(state.slopes)}


def _loaded(
    file: zipfile.ZipFile,
    new: FitState,
    losses: Sequence[float],
    steps: Sequence[float],
    images: int,
    changed: int,
    draws: dict[str, Any],
) -> FitState:
    """Raises an error of any type where the file is damaged."""

    def array(name: str, shape: tuple[int, ...] | None = None) -> np.ndarray:
        values = padded(stored_array(file, name, "f"))
        if shape and values.shape != shape:
            raise ValueError(f"{name} has shape {values.shape}, expected {shape}")
        return values

    def gaussians(part: str) -> Gaussians:
        arrays: dict[str, Any] = {name: array(f"{part}.{name}") for name in ARRAYS}
        return as_drjit(replace(new.model, **arrays))

    model, best, start = (gaussians(part) for part in ("model", "best", "start"))
    names = list(new.prior.lam)
    shapes = {name: tuple(getattr(model, name).shape) for name in names}
    degrees = {one.sh_degree for one in (model, best, start, new.model)}
    if len(degrees) > 1 or len(start) != len(model) or not losses:
        raise ValueError("parts do not fit together")
    lam = {
        name: mi.Float(array(f"lam.{name}", (1 if len(old) == 1 else math.prod(shapes[name]),)))
        for name, old in new.prior.lam.items()
    }
    state = FitState(
        model,
        best,
        replace(new.prior, start=start, lam=lam),
        [
            [
                mi.TensorXf(array(f"buffer.{name}.{i}", shapes[name]))
                for i in range(len(new.buffers[0]))
            ]
            for name in names
        ],
        [
            None if old is None else mi.TensorXf(array(f"information.{name}", shapes[name]))
            for name, old in zip(names, new.information, strict=True)
        ],
        new.draws,
        [
            mi.Float(array(f"slopes.{i}", shapes[names[0]][:1]))
            for i in range(2)
            if "slopes.0.npy" in file.namelist()
        ],
        [float(loss) for loss in losses],
        [mi.Float(loss) for loss in steps],
        int(images),
        int(changed),
    )
    new.draws.bit_generator.state = draws  # last: `new` stays as it is where an error is raised
    return state
