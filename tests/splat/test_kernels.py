"""Arithmetic of the kernels, and the order of their instructions."""

import mitsuba as mi
import numpy as np
import pytest

from mgs.splat import ListCache, as_drjit, fisher, kernels, render, walking
from mgs.splat.blocks import on_cpu
from mgs.splat.projection import camera_array, project
from mgs.splat.walking import exp2

from . import reference
from .scenes import in_own_process, make_camera, make_gaussians, place


@pytest.mark.parametrize(("real", "bound"), [("Float", 1e-7), ("Float64", 3e-9)])
def test_exp2_is_as_exact_as_it_says(real, bound):
    real = getattr(mi, real)
    x = np.random.default_rng(0).uniform(-120, 120, 100_000)
    x = np.asarray(real(np.concatenate([x, np.arange(-119.5, 120, 0.5)])), np.float64)
    error = np.asarray(exp2(real(x)), np.float64) / np.exp2(x) - 1
    assert np.abs(error).max() < bound
    assert np.asarray(exp2(real(0.0)))[0] == 1
    far = np.asarray(exp2(real([-120.5, -127, -1100, -3e38, -np.inf, np.nan])))
    assert ((far > 0) & (far < 1e-35)).all(), "below any threshold of alpha"


def test_lanes_of_one_pixel_draw_the_same(monkeypatch):
    """The lanes of a GPU, here on the processor: each of a block's 32 lanes draws one pixel."""
    if not on_cpu():
        pytest.skip("lanes draw one pixel on a GPU")
    gaussians, camera = make_gaussians(60, 3), make_camera()
    splats = project(as_drjit(gaussians), camera_array(camera))
    lists, packed = ListCache().get(camera, splats)
    tangents = kernels.pack_tangents(splats, splats, lists.place)

    def everything():
        image = kernels.forward(lists, packed, True)
        found = [*image, *kernels.jvp(lists, packed, tangents)]
        found.append(kernels.adjoint(lists, packed, image, image, True, 5))
        found.append(kernels.removal(lists, packed, mi.Color3f(0.3)))
        found = [np.asarray(array, np.float64) for array in found]
        options = {"means": "free", "alpha_weight": 0.5}
        return found + [fisher(gaussians, camera, name, **options) for name in ("exact", "block")]

    whole = everything()
    monkeypatch.setattr(walking, "lane_size", lambda: (1, 1))
    single = everything()
    for one, other in zip(single, whole, strict=True):
        assert np.abs(one - other).max() < 3e-6 * np.abs(other).max()
        assert (one != other).any(), "no recording of the other lanes was replayed"


def test_the_order_of_instructions_changes_no_bit(tmp_path):
    """With and without LLVM's machine scheduler, each with an empty cache of kernels."""
    if not on_cpu():
        pytest.skip("the option is LLVM's")
    code = """
import hashlib, sys
import numpy as np
if sys.argv[1] == "llvm":
    runtime._keep_order = lambda: None
runtime.start()
from mgs.splat import fisher, render
from splat.scenes import make_camera, make_gaussians
gaussians, camera = make_gaussians(40, 1), make_camera()
images = [np.asarray(render(gaussians, camera).rgb), fisher(gaussians, camera)]
print(hashlib.sha256(b"".join(image.tobytes() for image in images)).hexdigest())
"""
    said, kernels = [], []
    for order in ("llvm", "ours"):
        folder = tmp_path / order
        folder.mkdir()
        said.append(in_own_process(code, order, DRJIT_CACHE_DIR=str(folder)))
        files = (path for path in folder.rglob("*") if path.is_file())
        kernels.append({path.name: path.read_bytes() for path in files})
    assert said[0] == said[1]
    assert kernels[0].keys() == kernels[1].keys()
    assert any(kernels[0][name] != kernels[1][name] for name in kernels[0]), "the order is another"


def test_a_footprint_that_single_precision_misplaces_draws_nothing_wrong():
    """Its centre is up to 3e7 pixels away, so its lists may name blocks that it does not reach."""
    camera = make_camera((64, 48), 600)
    depth = 0.05
    for offset in (1e5, 1e6, 1e7, 3e7):
        g = make_gaussians(3, 1, log_scales=(8.5, 9.0), logits=(2, 4))
        means = place(camera, [[offset, 20.0], [30.0, -offset], [offset, offset]], [depth] * 3)
        g.means[:] = means.astype(np.float32)
        image = np.asarray(render(g, camera).alpha)
        expected = reference.render(g, camera)["alpha"]
        assert np.isfinite(image).all()
        assert (image <= 1).all()
        if offset <= 1e6:
            assert np.abs(image - expected).max() < 0.02
