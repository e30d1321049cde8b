"""The same input gives bitwise the same image, gradient and Fisher information: reruns, 1 or 2
threads, a new process."""

import hashlib
import json
import subprocess
import sys

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mgs.splat import ListCache, as_drjit, fisher, render

from .scenes import PARAMETERS, make_camera, make_gaussians

BACKGROUND = (0.1, 0.2, 0.7)


def results(threads: int | None = None, degree: int = 1) -> dict[str, bytes]:
    """Bytes of every output: images, gradients of all parameters, Fisher information by every
    estimator."""
    before = dr.thread_count()
    if threads is not None:
        dr.set_thread_count(threads)
    try:
        camera = make_camera((200, 150), focal=200.0)
        gaussians = make_gaussians(1500, 11, degree, log_scales=(-6.0, -2.5))
        watched = as_drjit(gaussians)
        for name in PARAMETERS:
            setattr(watched, name, dr.copy(getattr(watched, name)))
            dr.enable_grad(getattr(watched, name))
        image = render(watched, camera, BACKGROUND)
        out = {
            name: np.asarray(dr.detach(getattr(image, name))) for name in ("rgb", "alpha", "depth")
        }
        loss = dr.sum(dr.square(image.rgb - 0.3), axis=None) + dr.sum(
            image.alpha * image.depth, axis=None
        )
        dr.backward(loss)
        out |= {f"d {name}": np.asarray(dr.grad(getattr(watched, name))) for name in PARAMETERS}
        cache = ListCache()
        for estimator in ("exact", "block", "loss-gradient"):
            out[estimator] = fisher(gaussians, camera, estimator, BACKGROUND, cache)
        for estimator in ("exact", "block"):
            out[f"{estimator}, means and alpha"] = fisher(
                gaussians, camera, estimator, BACKGROUND, cache, means="free", alpha_weight=0.3
            )
        assert all(np.isfinite(a).all() and np.any(a) for a in out.values())
        return {name: a.tobytes() for name, a in out.items()}
    finally:
        dr.set_thread_count(before)


def differing(a: dict, b: dict) -> list[str]:
    assert a.keys() == b.keys()
    return [name for name in a if a[name] != b[name]]


@pytest.fixture(scope="module")
def first():
    return results()


def test_reruns_are_bitwise_equal(first):
    assert differing(first, results()) == []


@pytest.mark.parametrize("threads", [1, 2])
def test_threads_change_nothing(first, threads):
    assert differing(first, results(threads)) == []


@pytest.mark.parametrize("scale", [1e-12, 1e-20, 1e-28, 1e-36])
def test_faint_gradients_are_deterministic_too(scale):
    """Denormal numbers are flushed by some threads and not by others: they must not reach a
    result."""
    camera = make_camera((200, 150), focal=200.0)
    gaussians = make_gaussians(1500, 11, 1, log_scales=(-6.0, -2.5))
    weight = mi.TensorXf(
        np.float32(scale) * np.random.default_rng(0).normal(size=(150, 200, 3)).astype(np.float32)
    )
    gradients = []
    for threads in (1, 2):
        before = dr.thread_count()
        dr.set_thread_count(threads)
        watched = as_drjit(gaussians)
        for name in PARAMETERS:
            setattr(watched, name, dr.copy(getattr(watched, name)))
            dr.enable_grad(getattr(watched, name))
        dr.backward(dr.sum(render(watched, camera).rgb * weight, axis=None))
        gradients.append(
            {name: np.asarray(dr.grad(getattr(watched, name))).tobytes() for name in PARAMETERS}
        )
        dr.set_thread_count(before)
    assert differing(*gradients) == []


def test_faint_information_is_deterministic_too():
    """Splats of a micrometre far away carry information that float32 can only hold as a
    denormal."""
    camera = make_camera((200, 150), focal=200.0, eye=(180.0, 40.0, 90.0))
    gaussians = make_gaussians(3000, 12, 0, log_scales=(-16.0, -12.0), logits=(-4, 20))
    information = []
    for threads in (1, 2):
        before = dr.thread_count()
        dr.set_thread_count(threads)
        information.append({e: fisher(gaussians, camera, e).tobytes() for e in ("exact", "block")})
        dr.set_thread_count(before)
        values = fisher(gaussians, camera, "block")
        assert not ((values != 0) & (np.abs(values) < np.finfo(np.float32).tiny)).any()
    assert differing(*information) == []


def test_hutchinson_draws_the_same_probes():
    camera, gaussians = make_camera(), make_gaussians(16, 2)
    a, b = (fisher(gaussians, camera, "hutchinson") for _ in range(2))
    np.testing.assert_array_equal(a, b)


def test_garbage_is_not_collected_while_a_kernel_is_recorded():
    """A Mitsuba scene that Python frees during a recording would end the process: so in a process
    of its own."""
    code = """
from mgs import runtime; runtime.start()
import gc
import mitsuba as mi
from mgs.splat import kernels, render
from splat.scenes import make_camera, make_gaussians

scenes, walk = [mi.load_dict({"type": "scene", "ball": {"type": "sphere"}})], kernels.walk

def littering(*arguments):
    cycle = [scenes.pop()]
    cycle.append(cycle)
    del cycle
    keep = [[] for _ in range(100_000)]
    return walk(*arguments)

gc.set_threshold(10)
kernels.walk = littering
render(make_gaussians(20, 0), make_camera())
print("drawn")
"""
    root = __file__.rsplit("/splat/", 1)[0]
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=root,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.stdout == "drawn\n", done.stderr


def test_threads_may_draw_at_once():
    """Same bits as one after the other; the collector is off in every recording and on in the end.
    In a process of its own, since two recordings at a time hang or end it."""
    code = """
from mgs import runtime; runtime.start()
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
    root = __file__.rsplit("/splat/", 1)[0]
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=root,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.stdout == "drawn\n", done.stderr


def test_another_process_with_one_thread_agrees(first):
    """A fresh process: no recorded kernels, another thread pool, another memory layout."""
    code = (
        "from mgs import runtime; runtime.start()\n"
        "import json, hashlib\n"
        "from splat.test_determinism import results\n"
        "print(json.dumps({k: hashlib.sha256(v).hexdigest() for k, v in results(1).items()}))\n"
    )
    root = __file__.rsplit("/splat/", 1)[0]
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=root,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    other = json.loads(done.stdout.splitlines()[-1])
    assert differing({k: hashlib.sha256(v).hexdigest() for k, v in first.items()}, other) == []
