"""Progress of long work: what works reports it, and what shows it listens."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from enum import StrEnum


class Stage(StrEnum):
    """Stages of a run that are timed. Values are shown; `seconds` in steps.jsonl has the names."""

    CAPTURE = "capturing"
    READ = "reading images"
    FIT = "fitting"
    INFORMATION = "information of the training set"
    SURFACE = "information of the surface"
    SCORE = "scoring candidates"
    CHECK = "checking"
    EVALUATE = "evaluating"


Progress = Callable[[str, int, int], None]
"""Called as progress(stage, done, total)."""


def no_progress(stage: str, done: int, total: int) -> None:
    """Default callback: does nothing."""


_listener: ContextVar[Progress] = ContextVar("progress", default=no_progress)


def report(stage: str, done: int = 0, total: int = 0) -> None:
    """Tell the listener how far a stage is. total: 0 if unknown."""
    _listener.get()(stage, done, total)


@contextmanager
def listening(progress: Progress | None) -> Iterator[Progress]:
    """Context manager in which `report` calls `progress`, or as before for None; gives which."""
    token = _listener.set(progress or _listener.get())
    try:
        yield _listener.get()
    finally:
        _listener.reset(token)
