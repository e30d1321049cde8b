"""Record a kernel once per set of sizes and replay it: tracing costs more than a small image does."""

from __future__ import annotations

import functools
import gc
from collections.abc import Callable
from typing import Any

import drjit as dr


def frozen(sizes: Callable[..., tuple[int, ...]]) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorate with `dr.freeze`; sizes(*arguments) are the lengths that a recording bakes in.

    Python's cycle collector waits meanwhile: a Mitsuba scene that it frees during a recording ends the process
    ("enqueue_host_func(): this function cannot be recorded", Dr.Jit 1.5).
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        recorded = dr.freeze(function, state_fn=sizes, limit=64, warn_after=1 << 30)

        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            collecting = gc.isenabled()
            gc.disable()
            try:
                return recorded(*args, **kwargs)
            finally:
                if collecting:
                    gc.enable()

        return call

    return decorate
