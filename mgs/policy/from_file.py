"""A policy in a file of the user's own, FILE.py:FUNCTION. The function is told what its parameters
are named after."""

from __future__ import annotations

import inspect
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

from mgs.errors import InputError
from mgs.policy.context import Policy, PolicyContext

TOLD: dict[str, Callable[[PolicyContext], Any]] = {
    "context": lambda context: context,
    "candidates": lambda context: context.candidates,
    "taken": lambda context: context.taken,
    "centre": lambda context: context.centre,
    "rng": lambda context: context.rng,
    "H": lambda context: context.H,
    "lam": lambda context: context.lam,
    "points": lambda context: context.points,
    "surface_H": lambda context: context.surface_H,
    "prior_lam": lambda context: context.prior_lam,
    "seen": lambda context: context.views(context.left).seen,
    "seen_taken": lambda context: context.views(context.visited).seen,
}
"""What a parameter of each name is given, once in a step (`PolicyContext` says what these are).
seen, seen_taken: [C,N] and [T,N] squared blending weights of the surface's Gaussians in the
candidates and in the views taken."""

EACH: dict[str, Callable[[PolicyContext, int], Any]] = {
    "F": lambda context, view: context.information(view),
    "surface_F": lambda context, view: context.surface_information(view),
    "candidate": lambda context, view: context.positions[view],
}
"""The same for what differs from one candidate to the next: its information, as H and as surface_H,
and its position [3]."""


def in_file(name: str) -> bool:
    """Whether the name of a policy is of the form FILE.py:FUNCTION."""
    return ".py:" in name


def absolute(name: str) -> str:
    """The name of a policy, with the whole path where it is in a file, so that it holds in any
    folder."""
    return str(Path(name).resolve()) if in_file(name) else name


def label(name: str) -> str:
    """The name of a policy without the folder of its file."""
    return Path(name).name if in_file(name) else name


def file_of(name: str) -> Path:
    """The file of a policy FILE.py:FUNCTION."""
    return Path(name.rpartition(":")[0])


def load(name: str) -> Policy:
    """The policy FILE.py:FUNCTION.

    A function with a parameter that is named in EACH is called for every candidate, and returns its
    score; any other is called once in a step, and returns the scores [C] of all candidates. Raises
    InputError where the file is missing or fails to run, where it has no such function, and where a
    parameter is none of those known.
    """
    path, function = file_of(name), name.rpartition(":")[2]
    if not path.is_file():
        raise InputError(
            f"--policy {name}: no such file {path}; correct the path (of a run, `policy` in its config.json)"
        )
    module = ModuleType(f"policy {path.resolve()}")
    sys.modules[module.__name__] = (
        module  # where a dataclass looks for the names in its annotations
    )
    try:
        exec(compile(path.read_bytes(), str(path), "exec"), module.__dict__)
    except Exception as error:
        raise InputError(f"--policy {name}: {_failed(path, error)}") from error
    found = getattr(module, function, None)
    if not callable(found):
        raise InputError(
            f"--policy {name}: {path} has no function {function}; give the name of one that it has"
        )
    return _asking(name, path, found)


def _asking(name: str, path: Path, function: Callable[..., Any]) -> Policy:
    """A function as a policy that gives it what its parameters are named after."""
    names = list(inspect.signature(function).parameters)
    unknown = [parameter for parameter in names if parameter not in TOLD and parameter not in EACH]
    if unknown:
        known = ", ".join([*EACH, *TOLD])
        raise InputError(
            f"--policy {name}: asks for {unknown[0]}, which is not known here; what can be asked for is {known}"
        )
    once, each = (
        [parameter for parameter in names if parameter in table] for table in (TOLD, EACH)
    )

    def policy(context: PolicyContext) -> Any:
        told = {parameter: TOLD[parameter](context) for parameter in once}
        try:
            if not each:
                return function(**told)
            return [
                function(**told, **{p: EACH[p](context, view) for p in each})
                for view in context.left
            ]
        except InputError:
            raise
        except Exception as error:
            raise InputError(f"--policy {name}: {_failed(path, error)}") from error

    return policy


def _failed(path: Path, error: Exception) -> str:
    """What to say of an exception that a file raised: the line of the file where it came from, and
    its message."""
    frames = [
        frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)
    ]
    line = error.lineno if isinstance(error, SyntaxError) else frames[-1].lineno if frames else None
    where = f"line {line} of {path}" if line else str(path)
    message = error.msg if isinstance(error, SyntaxError) else error
    return f"{where} failed: {type(error).__name__}: {message}"
