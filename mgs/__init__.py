"""mgs: active Gaussian splatting with exact Fisher information, on Mitsuba 3 and Dr.Jit.

`import mgs` loads nothing else: each public name is loaded when it is first used, and Mitsuba's
variant is set (`llvm_ad_rgb`, where none is set) when something first computes with it.

Arrays: everything takes and gives NumPy arrays, with one exception. `render` and `jvp` give Dr.Jit
tensors, because `dr.backward` has to find the way back from an image to the Gaussians;
`numpy.asarray` turns them into arrays. Gaussians may have NumPy or Dr.Jit fields wherever they are
taken (`as_drjit`).

Lengths are metres, the world is +Z up, cameras are OpenCV's (x right, y down, z forward), colours
are linear RGB.
"""

from __future__ import annotations

import ast
from importlib import import_module
from pathlib import Path
from typing import Any

__version__ = "0.1.0"

_MODULES = {
    alias.name: f"mgs.{statement.module}"
    for statement in ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")).body
    if isinstance(statement, ast.ImportFrom)
    for alias in statement.names
}
"""Public name -> module that has it, read from the stub file, which type checkers read too."""

__all__ = list(_MODULES)


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'mgs' has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_MODULES[name]), name)
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
