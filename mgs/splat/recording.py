"""Record a kernel once per set of sizes and replay it afterwards: tracing it anew takes longer than
drawing a small image."""

from __future__ import annotations

import functools
import gc
import threading
from collections.abc import Callable
from typing import Any, TypeVar, cast

import drjit as dr

_one_at_a_time = threading.RLock()
"""Held during every recording and replay, and by all that `one_at_a_time` decorates. Dr.Jit 1.5
hangs or fails where two threads record at once; and the garbage collector, which must rest
meanwhile, is one for the whole process."""

Function = TypeVar("Function", bound=Callable[..., Any])


def one_at_a_time(function: Function) -> Function:
    """Decorator: of all decorated functions together, one runs at a time; other threads wait.

    While Dr.Jit 1.5 replays a recording, it holds a lock of its own and calls Python. If Python
    then switches to another thread which calls Dr.Jit, that one waits for the lock, the first one
    for Python, and both wait for ever. The lock here covers everything between the start and the
    end of a drawing, so that the other thread does not get so far.
    """

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        with _one_at_a_time:
            return function(*args, **kwargs)

    return cast(Function, call)


def frozen(
    sizes: Callable[..., tuple[int, ...]],
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorator: `dr.freeze`, which records the kernels of a function's first call and replays them
    in later calls.

    sizes(*arguments) must return the lengths of arrays and the plain numbers that a recording holds
    as constants; a call with
    other sizes is recorded anew. They are handed to Dr.Jit as one string. As numbers they would not
    be safe: where a small number also occurs elsewhere among the inputs or the function's globals,
    `dr.freeze` (Dr.Jit 1.5) only compares that it occurs again, not its value, and replays a
    recording of other sizes.

    Python's garbage collector is off during the call: if it frees a Mitsuba scene while Dr.Jit
    records, the process ends ("enqueue_host_func(): this function cannot be recorded", Dr.Jit 1.5).

    Threads: all decorated functions together run one at a time, with those of `one_at_a_time`. So
    threads may draw at once if each has a `ListCache` of its own, and afterwards the collector is
    on again if it was before. Not protected: a `ListCache` or a gradient that threads share, and a
    thread that switches the collector on or off by itself.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        recorded = dr.freeze(
            function, state_fn=lambda *a, **k: repr(sizes(*a, **k)), limit=64, warn_after=1 << 30
        )

        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            with _one_at_a_time:
                collecting = gc.isenabled()
                gc.disable()
                try:
                    return recorded(*args, **kwargs)
                finally:
                    if collecting:
                        gc.enable()

        return call

    return decorate
