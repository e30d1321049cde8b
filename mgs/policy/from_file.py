"""Policies of a user's own: from a file, named FILE.py:FUNCTION, or a Python function."""

from __future__ import annotations

import inspect
import sys
import traceback
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from mgs.errors import InputError
from mgs.policy.context import Policy, PolicyContext

CONTEXT_ARGUMENTS: dict[str, Callable[[PolicyContext], Any]] = {
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
    "seen": lambda context: context.views(context.candidate_frames).seen,
    "seen_taken": lambda context: context.views(context.taken_frames).seen,
}
"""Arguments that are the same for all candidates of a step, by parameter name. seen, seen_taken:
squared blending weights of the surface's Gaussians in the candidates [C,N] and in the views taken
[T,N]. For the others see `PolicyContext`."""

CANDIDATE_ARGUMENTS: dict[str, Callable[[PolicyContext, int], Any]] = {
    "F": lambda context, frame: context.information(frame),
    "surface_F": lambda context, frame: context.surface_information(frame),
    "candidate": lambda context, frame: context.positions[frame],
}
"""Arguments of one candidate, by parameter name: its information about the model and about the
surface, and its camera centre [3]."""


FUNCTION = "python:"
"""Start of the name of a policy that is a Python function: python:MODULE.NAME."""


def name_of(policy: str | Callable[..., Any]) -> str:
    """Name of a policy: itself, or the import path of a function."""
    if isinstance(policy, str):
        return absolute(policy)
    name = getattr(policy, "__qualname__", type(policy).__qualname__)
    return f"{FUNCTION}{policy.__module__}.{name}"


def is_function(name: str) -> bool:
    """Whether the name of a policy is that of a Python function."""
    return name.startswith(FUNCTION)


def source_of(function: Callable[..., Any]) -> str:
    """Source text of a function; empty where Python does not know it."""
    try:
        return inspect.getsource(function)
    except (OSError, TypeError):
        return ""


def in_file(name: str) -> bool:
    """Whether the name of a policy has the form FILE.py:FUNCTION."""
    return ".py:" in name


def absolute(name: str) -> str:
    """The name of a policy, with the absolute path of its file if it has one."""
    return str(Path(name).resolve()) if in_file(name) else name


def label(name: str, budget: int = 1) -> str:
    """The name of a policy without the folder of its file, or its module; "fit" if no view is to be
    chosen, as in a run of `mgs fit`."""
    if budget == 0:
        return "fit"
    if is_function(name):
        return name.rpartition(".")[2]
    return Path(name).name if in_file(name) else name


def file_of(name: str) -> Path:
    """The file of a policy FILE.py:FUNCTION."""
    return Path(name.rpartition(":")[0])


def load(name: str) -> Policy:
    """The policy FILE.py:FUNCTION. A file is executed once per process, unless it changes.

    A function with a parameter of CANDIDATE_ARGUMENTS is called once per candidate and returns its
    score. Any other is called once per step and returns the scores of all candidates [C].

    Raises InputError if the file is missing or fails, has no such function, or the function has an
    unknown parameter.
    """
    path = file_of(name)
    if not path.is_file():
        raise InputError(
            f"policy {name}: no such file {path}; correct the path "
            "(for a run, `policy` in its config.json)"
        )
    try:
        module = _executed(path, path.read_bytes())
    except (Exception, SystemExit) as error:
        raise InputError(f"policy {name}: {_failed(path, error)}") from error
    wanted = name.rpartition(":")[2]
    function = getattr(module, wanted, None)
    if not callable(function):
        raise InputError(
            f"policy {name}: {path} has no function {wanted}; give the name of one that it has"
        )
    return by_parameter_name(name, function, path)


@cache
def _executed(path: Path, source: bytes) -> ModuleType:
    module = ModuleType(f"policy {path.resolve()}")
    sys.modules[module.__name__] = module  # dataclasses look up their annotations there
    exec(compile(source, str(path), "exec"), module.__dict__)
    return module


def by_parameter_name(name: str, function: Callable[..., Any], path: Path | None = None) -> Policy:
    """Wrap a function as a policy; its arguments are passed by parameter name.

    path: its file, where the user named one: then its errors are InputError, with their line.
    Raises InputError for an unknown parameter without a default.
    """
    known = [*CANDIDATE_ARGUMENTS, *CONTEXT_ARGUMENTS]
    parameters = [
        parameter.name
        for parameter in inspect.signature(function).parameters.values()
        if parameter.default is parameter.empty or parameter.name in known
    ]
    if unknown := [parameter for parameter in parameters if parameter not in known]:
        raise InputError(
            f"policy {name}: unknown parameter {unknown[0]}; choose from {', '.join(known)}"
        )
    shared = {p: CONTEXT_ARGUMENTS[p] for p in parameters if p in CONTEXT_ARGUMENTS}
    single = {p: CANDIDATE_ARGUMENTS[p] for p in parameters if p in CANDIDATE_ARGUMENTS}

    def policy(context: PolicyContext) -> Any:
        arguments = {p: value(context) for p, value in shared.items()}
        try:
            if not single:
                return function(**arguments)
            return [
                function(**arguments, **{p: value(context, i) for p, value in single.items()})
                for i in context.candidate_frames
            ]
        except InputError:
            raise
        except (Exception, SystemExit) as error:
            if path is None:
                raise
            raise InputError(f"policy {name}: {_failed(path, error)}") from error

    return policy


def _failed(path: Path, error: BaseException) -> str:
    """Message for an exception of a user's file: the last line of that file in the traceback."""
    if isinstance(error, SyntaxError):
        line, message = error.lineno, error.msg
    else:
        frames = traceback.extract_tb(error.__traceback__)
        lines = [frame.lineno for frame in frames if frame.filename == str(path)]
        line, message = lines[-1] if lines else None, str(error)
    where = f"line {line} of {path}" if line else str(path)
    return f"{where} failed: {type(error).__name__}: {message}"
