"""Policies of a user's own: from a file, named FILE.py:NAME, or a Python function or object."""

from __future__ import annotations

import inspect
import re
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from mgs.errors import InputError, from_interrupt
from mgs.policy.relaxation import Bounded
from mgs.progress import Stage, report
from mgs.run.policies import POLICIES, Policy, policy_named

if TYPE_CHECKING:
    from mgs.scene import Scene, State


def _seen(scene: Scene, state: State, views: list[int]) -> np.ndarray:
    return np.stack([scene.surface(state).seen(i) for i in views])


ARGUMENTS: dict[str, Callable[[Scene, State, list[int]], Any]] = {
    "scene": lambda scene, state, views: scene,
    "state": lambda scene, state, views: state,
    "views": lambda scene, state, views: views,
    "candidates": lambda scene, state, views: scene.positions(state.frames)[views],
    "taken": lambda scene, state, views: scene.positions(state.frames)[list(state.taken)],
    "centre": lambda scene, state, views: scene.centre,
    "H": lambda scene, state, views: state.H,
    "lam": lambda scene, state, views: scene.lam,
    "points": lambda scene, state, views: scene.surface(state).points,
    "surface_H": lambda scene, state, views: state.surface,
    "surface_lam": lambda scene, state, views: scene.surface_lam,
    "seen": _seen,
    "seen_taken": lambda scene, state, views: _seen(scene, state, list(state.taken)),
}
"""Arguments that are the same for all candidates of a step, by parameter name. seen, seen_taken:
squared blending weights of the surface's Gaussians [C,N], [T,N]. `rng` is added by the policy."""

OF_ONE: dict[str, Callable[[Scene, State, int], Any]] = {
    "F": lambda scene, state, view: scene.information(state, view),
    "surface_F": lambda scene, state, view: scene.surface(state).information(view),
    "candidate": lambda scene, state, view: scene.positions(state.frames)[view],
}
"""Arguments of one candidate: information about model and surface, and its place [3]."""

OF_THE_FIT = {"scene", "state", "F", "H"}  # arguments that depend on the fitted model
OPTIONAL = ("plan", "tour_gains", "relaxation", "geometric")  # attributes that a policy may have
FUNCTION = "python:"  # start of the name of a policy that is a Python function: python:MODULE.NAME


def name_of(policy: str | Callable[..., Any]) -> str:
    """Name of a policy: itself, or the import path of a function or of an object's class."""
    if isinstance(policy, str):
        return absolute(policy)
    if (name := getattr(policy, "name", None)) in POLICIES and POLICIES[name] == policy:
        return str(name)
    name = getattr(policy, "__qualname__", type(policy).__qualname__)
    return f"{FUNCTION}{policy.__module__}.{name}"


def is_function(name: str) -> bool:
    return name.startswith(FUNCTION)


def code_of(policy: Callable[..., Any]) -> str:
    """Source text of a function, or of an object and its class; empty where Python does not know
    it."""
    plain = inspect.isroutine(policy) or isinstance(policy, type)
    try:
        source = inspect.getsource(policy if plain else type(policy))
    except (OSError, TypeError):
        return ""
    text = re.sub(" at 0x[0-9a-f]+", "", repr(policy))  # of this process alone
    return source if plain else f"{source}\n# {text}\n"


def in_file(name: str) -> bool:
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


def load(name: str) -> Policy:
    """The policy FILE.py:NAME. A file is executed once per process, unless it changes. Raises
    InputError if the file is missing or fails, has no such function, class or object, or it has an
    unknown parameter."""
    file, _, target = name.rpartition(":")
    if not (path := Path(file)).is_file():
        where = f"no such file {path}; correct the path (for a run, in its config.json)"
        raise InputError(f"policy {name}: {where}")
    with _users_code(name, path):
        function = getattr(_executed(path, path.read_bytes()), target, None)
        if not callable(function):
            raise InputError(f"policy {name}: {path} has no function {target}; name one it has")
        return Own(name, function() if isinstance(function, type) else function, path)


@contextmanager
def _users_code(name: str, path: Path | None) -> Iterator[None]:
    """Turn every error of a policy's file, also SystemExit, into an InputError."""
    try:
        yield
    except BaseException as error:
        if path is None or isinstance(error, InputError) or from_interrupt(error):
            raise
        raise InputError(f"policy {name}: {_failed(path, error)}") from error


@cache
def _executed(path: Path, source: bytes) -> ModuleType:
    module = ModuleType(f"policy {path.resolve()}")
    sys.modules[module.__name__] = module  # dataclasses look up their annotations there
    exec(compile(source, str(path), "exec"), module.__dict__)
    return module


def _fixed(value: Any) -> Any:
    """A view of an array that cannot be written, since the run goes on with it."""
    if isinstance(value, np.ndarray):
        value = value.view()
        value.flags.writeable = False
    return value


class Own:
    """A function or an object as a policy; its arguments are passed by parameter name.

    A function with a parameter of OF_ONE is called once for each candidate and returns its score.
    Any other is called once a step and returns the scores of all candidates [C]. An object may have
    the attributes of `mgs.run.policies`.

    path: its file, where the user named one: then its errors are InputError, with their line.
    Raises InputError for an unknown parameter without a default."""

    def __init__(self, name: str, function: Callable[..., Any], path: Path | None = None) -> None:
        self.name, self.full, self.function, self.path = label(name), name, function, path
        names = ["rng", *OF_ONE, *ARGUMENTS]
        every = inspect.signature(function).parameters.values()
        parameters = [p.name for p in every if p.default is p.empty or p.name in names]
        if unknown := next((one for one in parameters if one not in names), None):
            choice = f"choose from {', '.join(names)}"
            raise InputError(f"policy {name}: unknown parameter {unknown}; {choice}")
        self.parameters = parameters
        by_arguments = bool(OF_THE_FIT & set(parameters))
        self.needs_fit = bool(getattr(function, "needs_fit", by_arguments))

    def __getattr__(self, name: str) -> Any:
        if name not in OPTIONAL:
            raise AttributeError(name)
        value = getattr(self.function, name)
        return value if name == "geometric" else partial(self._planned, name, value)

    def _planned(self, name: str, method: Callable[..., Any], *arguments: Any) -> Any:
        with _users_code(self.full, self.path):
            result = method(*arguments)
            if name == "plan":
                result = [int(view) for view in result]
                if not set(result) <= set(arguments[2]):
                    raise TypeError("plan returned views that are no candidates")
            elif name == "relaxation" and not isinstance(result, Bounded):
                raise TypeError(f"relaxation returned {type(result).__name__}, no Relaxation")
            return result

    def __call__(self, scene: Scene, state: State, views: list[int]) -> Any:
        shared = {
            p: _fixed(ARGUMENTS[p](scene, state, views)) for p in self.parameters if p in ARGUMENTS
        }
        if "rng" in self.parameters:
            shared["rng"] = scene.rng(state, self.name)
        single = [p for p in self.parameters if p in OF_ONE]
        with _users_code(self.full, self.path):
            if not single:
                return self.function(**shared)
            scores = []
            for done, i in enumerate(views):
                report(Stage.SCORE, done, len(views))
                of_one = {p: _fixed(OF_ONE[p](scene, state, i)) for p in single}
                scores.append(self.function(**shared, **of_one))
            return scores


def check_policy(name: str) -> None:
    """Raise InputError for a name that is neither a row of POLICIES nor of a user's own policy.

    No file is read: `policy_of` does so."""
    if not in_file(name) and not is_function(name):
        policy_named(name)


def policy_of(policy: Any) -> Policy:
    """The policy of a name, or a Python function or object as one. Executes a user's file. Raises
    InputError as `check_policy` and `load`."""
    if not isinstance(policy, str):
        complete = hasattr(policy, "name") and hasattr(policy, "needs_fit")
        return policy if complete else Own(name_of(policy), policy)
    if in_file(policy):
        return load(policy)
    if is_function(policy):
        raise InputError(f"policy {policy}: is a Python function; give it again in Python")
    return policy_named(policy)


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
