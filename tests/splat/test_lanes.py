"""Kernels do not depend on the number of lanes of a register."""

import numpy as np
import pytest

from mgs import runtime
from mgs.splat import fisher, render

from .scenes import in_own_process, make_camera, make_gaussians

CODE = """
import ctypes, sys
from pathlib import Path
import drjit as dr
import numpy as np
runtime.start()
core = ctypes.CDLL(str(Path(dr.__file__).parent / "libdrjit-core.so"))
set_target = core._Z19jit_llvm_set_targetPKcS0_j  # jit_llvm_set_target, a C++ function
set_target.argtypes, set_target.restype = [ctypes.c_char_p, ctypes.c_char_p, ctypes.c_uint], None
set_target(b"haswell", b"", 8)
assert runtime.processor()["simd_width"] == 8
from splat.scenes import make_camera, make_gaussians
from mgs.splat import fisher, render
camera, gaussians = make_camera(), make_gaussians(60, 4)
rgb = np.asarray(render(gaussians, camera).rgb)
np.savez(sys.argv[1], rgb=rgb, fisher=fisher(gaussians, camera))
"""


def test_eight_lanes_draw_the_same_image_and_information_as_sixteen(tmp_path):
    runtime.start()
    if runtime.processor()["simd_width"] != 16:
        pytest.skip("this processor has no registers of sixteen lanes")
    in_own_process(CODE, str(tmp_path / "x.npz"))
    camera, gaussians = make_camera(), make_gaussians(60, 4)
    narrow = np.load(tmp_path / "x.npz")
    np.testing.assert_array_equal(narrow["rgb"], np.asarray(render(gaussians, camera).rgb))
    np.testing.assert_array_equal(narrow["fisher"], fisher(gaussians, camera))
