"""Importing this module makes the Mitsuba plugins of mgs known to Mitsuba: `import
mgs.splat.plugins`.

A plugin class belongs to one Mitsuba variant. So the files in `plugins/` are run for the variant
that is set now, and again for every variant that is set later; the import may come before or after
the variant is set.
"""

from __future__ import annotations

import importlib.util
import sys
from typing import Any

import drjit as dr
import mitsuba as mi

from mgs.resources import resource_folder


def register(*_: Any) -> None:
    """Run every file in `plugins/`, under the module name `mgs_plugins.<file>`, if the variant is
    differentiable and RGB.

    Raises InputError where the installation lacks the folder.
    """
    if mi.variant() is None or not (dr.is_diff_v(mi.Float) and mi.is_rgb):
        return
    for path in sorted(resource_folder("plugins").glob("*.py")):
        spec = importlib.util.spec_from_file_location(f"mgs_plugins.{path.stem}", path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module
        spec.loader.exec_module(module)


mi.detail.add_variant_callback(register)


register()
