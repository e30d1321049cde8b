"""Bitwise equal images, gradients and information: reruns, threads, processes, registers."""

import hashlib
import json

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mgs import ListCache, fisher, jvp, render, runtime
from mgs.gaussians import ARRAYS

from . import scenes
from .scenes import gradients_of, in_own_process, make_camera, make_gaussians, thread_count

BACKGROUND = (0.1, 0.2, 0.7)


def scene():
    gaussians = make_gaussians(1500, 11, 1, log_scales=(-6.0, -2.5))
    return gaussians, make_camera((200, 150), focal=200.0)


def ones(gaussians, scale=1.0) -> dict[str, np.ndarray]:
    """Tangents of all parameters."""
    return {name: np.full(getattr(gaussians, name).shape, scale) for name in ARRAYS}


def results() -> dict[str, bytes]:
    """Bytes of images, of gradients and tangents by all parameters, and of every information."""
    gaussians, camera = scene()
    model = scenes.with_gradients(gaussians)
    image = render(model, camera, BACKGROUND)
    out = {name: np.asarray(dr.detach(value)) for name, value in vars(image).items()}
    of_depth = dr.sum(image.alpha * image.depth, axis=None)
    dr.backward(dr.sum(dr.square(image.rgb - 0.3), axis=None) + of_depth)
    out |= {f"d {name}": value for name, value in gradients_of(model).items()}
    tangents = vars(jvp(gaussians, ones(gaussians), camera))
    out |= {f"tangent of {name}": np.asarray(value) for name, value in tangents.items()}
    cache = ListCache()
    for estimator in ("exact", "block", "loss-gradient"):
        out[estimator] = fisher(gaussians, camera, estimator, BACKGROUND, cache)
    options = {"means": "free", "alpha_weight": 0.3}
    for estimator in ("exact", "block"):
        found = fisher(gaussians, camera, estimator, BACKGROUND, cache, **options)
        out[f"{estimator}, means and alpha"] = found
    assert all(np.isfinite(a).all() and np.any(a) for a in out.values())
    return {name: a.tobytes() for name, a in out.items()}


def differing(a: dict, b: dict) -> list[str]:
    assert a.keys() == b.keys()
    return [name for name in a if a[name] != b[name]]


@pytest.fixture(scope="module")
def first():
    with thread_count(2):
        return results()


def test_reruns_change_nothing(first):
    with thread_count(2):
        assert differing(first, results()) == []


@pytest.mark.parametrize("scale", [1e-20, 1e-36])
def test_faint_derivatives_are_deterministic_too(scale):
    """Some threads flush denormal numbers, so these must not reach a result."""
    gaussians, camera = scene()
    weight = np.random.default_rng(0).normal(size=(150, 200, 3)).astype(np.float32)
    derivatives = []
    for threads in (1, 2):
        with thread_count(threads):
            model = scenes.with_gradients(gaussians)
            rgb = render(model, camera).rgb
            dr.backward(dr.sum(rgb * mi.TensorXf(np.float32(scale) * weight), axis=None))
            tangents = vars(jvp(gaussians, ones(gaussians, scale), camera))
            found = gradients_of(model) | {f"{n}'": np.asarray(v) for n, v in tangents.items()}
        derivatives.append({name: value.tobytes() for name, value in found.items()})
    assert differing(*derivatives) == []


def test_faint_information_is_deterministic_too():
    """Distant splats of a micrometre, whose information would be denormal in float32."""
    camera = make_camera((200, 150), focal=200.0, eye=(180.0, 40.0, 90.0))
    gaussians = make_gaussians(3000, 12, 0, log_scales=(-16.0, -12.0), logits=(-4, 20))
    information = []
    for threads in (1, 2):
        with thread_count(threads):
            found = {e: fisher(gaussians, camera, e) for e in ("exact", "block")}
        information.append({e: values.tobytes() for e, values in found.items()})
        values = found["block"]
        assert not ((values != 0) & (np.abs(values) < np.finfo(np.float32).tiny)).any()
    assert differing(*information) == []


def test_threads_may_draw_at_once():
    """The results are bitwise those of one thread; the collector is off in every recording."""
    code = """
runtime.start()
import gc
import time
from concurrent.futures import ThreadPoolExecutor
import numpy as np
from mgs.splat import fisher, render, walking
from splat.scenes import make_camera, make_gaussians

collecting, walk = [], walking._walk_until_done

def watched(*arguments):
    result = walk(*arguments)
    time.sleep(0.02)  # others try to record now
    collecting.append(gc.isenabled())
    return result

def draw(i):
    gaussians, camera = make_gaussians(20 + 9 * i, i), make_camera((40 + i, 30))
    return np.asarray(render(gaussians, camera).rgb).tobytes() + fisher(gaussians, camera).tobytes()

walking._walk_until_done = watched
with ThreadPoolExecutor(4) as pool:
    at_once = list(pool.map(draw, range(8)))
assert len(collecting) == 24 and not any(collecting), collecting
assert gc.isenabled()
assert at_once == [draw(i) for i in range(8)]
print("drawn")
"""
    assert in_own_process(code) == "drawn\n"


def test_another_process_with_one_thread_agrees(first):
    code = """
runtime.start()
import json, hashlib
from splat.scenes import thread_count
from splat.test_determinism import results
with thread_count(1):
    print(json.dumps({k: hashlib.sha256(v).hexdigest() for k, v in results().items()}))
"""
    other = json.loads(in_own_process(code).splitlines()[-1])
    assert differing({k: hashlib.sha256(v).hexdigest() for k, v in first.items()}, other) == []


EIGHT_LANES = """
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
    if runtime.processor()["simd_width"] != 16:
        pytest.skip("this processor has no registers of sixteen lanes")
    in_own_process(EIGHT_LANES, str(tmp_path / "x.npz"))
    camera, gaussians = make_camera(), make_gaussians(60, 4)
    narrow = np.load(tmp_path / "x.npz")
    np.testing.assert_array_equal(narrow["rgb"], np.asarray(render(gaussians, camera).rgb))
    np.testing.assert_array_equal(narrow["fisher"], fisher(gaussians, camera))
