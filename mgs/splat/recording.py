"""Record kernels once per set of sizes and replay them, since tracing takes longer than drawing a
small image."""

import functools
import gc
import threading
from collections.abc import Callable
from typing import Any, TypeVar, cast

import drjit as dr

# Held during every recording, replay and function of `one_at_a_time`. Dr.Jit 1.5 hangs or fails if
# two threads record at once, and the garbage collector, off meanwhile, is one per process.
_one_at_a_time = threading.RLock()
Function = TypeVar("Function", bound=Callable[..., Any])


def one_at_a_time(function: Function) -> Function:
    """Decorator: of all decorated functions together, one runs at a time.

    While Dr.Jit 1.5 replays a recording, it holds a lock and calls Python. If another thread then
    calls Dr.Jit, it waits for that lock while the first waits for Python: a deadlock. This lock
    covers everything from the start to the end of a drawing.

    Ctrl-C within a call that Dr.Jit makes to Python comes out of it as a RuntimeError, and is
    raised as KeyboardInterrupt again."""

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        with _one_at_a_time:
            try:
                return function(*args, **kwargs)
            except RuntimeError as error:
                cause: BaseException | None = error
                while cause is not None:
                    if isinstance(cause, KeyboardInterrupt):
                        raise KeyboardInterrupt from error
                    cause = cause.__cause__
                raise

    return cast(Function, call)


def frozen(
    sizes: Callable[..., tuple[int, ...]],
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorator: `dr.freeze`, which records a function's kernels at its first call and replays
    them.

    sizes(*arguments) must return the array lengths and plain numbers that a recording holds as
    constants; for other values the function is recorded again. They are passed to Dr.Jit as one
    string, because `dr.freeze` (Dr.Jit 1.5) does not compare the values of numbers that occur
    elsewhere among the inputs, and would replay a recording of other sizes.

    Python's garbage collector is off during the call: freeing a Mitsuba scene while Dr.Jit records
    ends the process (Dr.Jit 1.5).

    Threads may draw at once if each has its own `ListCache`; decorated functions run one at a time.
    Not protected: a `ListCache` or a gradient shared by threads, and threads that switch the
    collector on or off."""

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        recorded = dr.freeze(
            function, state_fn=lambda *a, **k: repr(sizes(*a, **k)), limit=64, warn_after=1 << 30
        )

        @one_at_a_time
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
