"""Registers the Mitsuba plugins of mgs when imported: the files in `plugins/` run for the current
variant, and again for every variant set later, to which their classes belong."""

import importlib.util
import sys
from typing import Any

import drjit as dr
import mitsuba as mi

from mgs.errors import InputError
from mgs.resources import resource_folder


def register(*_: Any) -> None:
    """Run every file in `plugins/` as module `mgs_plugins.<file>`. Raises InputError if the folder
    is missing. In a variant that is not differentiable RGB, their names refuse to be loaded."""
    if mi.variant() is None:
        return
    if not (dr.is_diff_v(mi.Float) and mi.is_rgb):
        mi.register_integrator("mgs_splat", _refuse)
        return
    for path in sorted(resource_folder("plugins").glob("*.py")):
        spec = importlib.util.spec_from_file_location(f"mgs_plugins.{path.stem}", path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module
        spec.loader.exec_module(module)


def _refuse(_: Any) -> Any:
    raise InputError(f"mgs_splat: has no {mi.variant()}; set a differentiable RGB variant")


mi.detail.add_variant_callback(register)


register()
