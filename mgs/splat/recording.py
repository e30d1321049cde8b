"""Record a kernel once per set of sizes and replay it: tracing costs more than a small image does."""

from __future__ import annotations

import functools
import gc
import threading
from collections.abc import Callable
from typing import Any

import drjit as dr

_one_at_a_time = threading.RLock()
"""Held during a recording or replay: Dr.Jit 1.5 hangs or fails where two threads record, and the collector is the process's."""


def frozen(baked: Callable[..., tuple[int, ...]]) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorate with `dr.freeze`; baked(*arguments) are the lengths and plain numbers that a recording bakes in.

    They are compared as one string: of a small number that also stands elsewhere among the inputs or the function's globals
    `dr.freeze` notes only that it was seen before, not which it is, and replays what was recorded for another (Dr.Jit 1.5).
    Python's cycle collector waits meanwhile: a Mitsuba scene that it frees during a recording ends the process
    ("enqueue_host_func(): this function cannot be recorded", Dr.Jit 1.5).

    Threads: all decorated functions together run one at a time, so threads may draw at once, each with a `ListCache` of its
    own, and the collector is as it was once none runs. Not guarded: a `ListCache` or a gradient that threads share, and
    another thread that switches the collector itself.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        recorded = dr.freeze(function, state_fn=lambda *a, **k: repr(baked(*a, **k)), limit=64, warn_after=1 << 30)

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
