"""mgs: active Gaussian splatting with exact Fisher information, on Mitsuba 3 and Dr.Jit.

`import mgs` loads nothing else. Each public name is loaded at its first use. Mitsuba's variant is
set (`llvm_ad_rgb`, if none is set) when something first computes with it.

Functions take and return NumPy arrays. `render` and `jvp` return Dr.Jit tensors, through which
`dr.backward` differentiates; `numpy.asarray` converts them. Gaussians may have NumPy or Dr.Jit
fields wherever they are accepted (`as_drjit`).

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
"""Public name -> module, read from the stub file, which type checkers read too."""

__all__ = list(_MODULES)


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'mgs' has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_MODULES[name]), name)
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
