"""Arithmetic that the kernels do themselves, and the order in which they do it."""

import os
import subprocess
import sys

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mgs.splat import ListCache, as_drjit, kernels, walking
from mgs.splat.blocks import BLOCK_X, BLOCK_Y
from mgs.splat.projection import camera_array, project
from mgs.splat.walking import CENTRE, exp2, in_order

from .scenes import make_camera, make_gaussians


@pytest.mark.parametrize(("real", "bound"), [("Float", 1e-7), ("Float64", 3e-9)])
def test_exp2_is_as_exact_as_it_says(real, bound):
    real = getattr(mi, real)
    x = np.concatenate([np.random.default_rng(0).uniform(-120, 120, 100_000), np.arange(-119.5, 120, 0.5)])
    x = np.asarray(real(x), np.float64)
    error = np.asarray(exp2(real(x)), np.float64) / np.exp2(x) - 1
    assert np.abs(error).max() < bound
    assert np.asarray(exp2(real(0.0)))[0] == 1


@pytest.mark.parametrize("real", ["Float", "Float64"])
def test_exp2_far_below_is_nothing(real):
    """Pixels far from a splat: exponents of any size, down to -inf, give what no threshold of alpha lets through."""
    real = getattr(mi, real)
    values = np.asarray(exp2(real([-120.5, -127, -150, -1100, -1e10, -3e38, -np.inf])))
    assert (values > 0).all()
    assert (values < 1e-35).all()
    assert dr.all(exp2(real(np.nan)) < 1e-35), "NaN draws nothing"


def built(gaussians, camera):
    """Splats, their block lists, and the splats packed."""
    splats = project(as_drjit(gaussians), camera_array(camera))
    lists, packed = ListCache().get(camera, splats)
    return splats, lists, packed


@pytest.mark.parametrize("log_scales", [(-9.0, -6.0), (-7.0, 1.0), (-3.0, -1.0)])
def test_no_alpha_underflows_on_the_way_through_a_block(log_scales):
    """What `block_rows` relies on: at the centre of every row of every block that lists a splat, the exponent is above -113.
    Points, needles and broad footprints, with exponents as far below zero as they get."""
    splats, lists, _ = built(make_gaussians(400, 5, log_scales=log_scales, logits=(5, 9)), make_camera((200, 120), 160))
    start, end = np.asarray(lists.start), np.asarray(lists.end)
    of = np.empty(len(np.asarray(lists.place)), int)
    of[np.asarray(lists.place)] = np.arange(len(of))
    lane = np.repeat(np.arange(len(start)), end - start)
    pair = np.concatenate([np.arange(a, b) for a, b in zip(start, end, strict=True)])
    splat, block, across = of[np.asarray(lists.splat)[pair]], np.asarray(lists.block)[lane], int(lists.blocks_x[0])
    u, v, k, p, e, opacity = (
        np.asarray(getattr(splats, name), np.float64)[splat]
        for name in ("mean_x", "mean_y", "shear", "white_x", "white_y", "log2_opacity")
    )
    rows = np.arange(BLOCK_Y)[:, None]
    dx = block % across * BLOCK_X + CENTRE + 0.5 - u
    dy = block // across * BLOCK_Y + rows + 0.5 - v
    exponent = opacity - (p * (dx - k * dy)) ** 2 - (e * dy) ** 2
    assert len(pair) > 400
    assert exponent.min() > -113
    assert log_scales[0] == -3.0 or exponent.min() < -50, "the scene shows how far it goes"


def test_splats_are_drawn_alike_one_or_several_at_a_time(monkeypatch):
    """Lists of every length, bit for bit; `__wrapped__` is the function that is recorded."""
    splats, lists, packed = built(make_gaussians(60, 3), make_camera())
    tangents = kernels.pack_tangents(splats, splats, lists.place)
    assert {0, 1} <= {int(n) % 2 for n in np.asarray(lists.end) - np.asarray(lists.start)}
    found = []
    for together in (1, 2, 3):
        monkeypatch.setattr(walking, "TOGETHER", together)
        images = [*kernels.forward.__wrapped__(lists, packed, True), *kernels.jvp.__wrapped__(lists, packed, tangents)]
        found.append([np.asarray(image).tobytes() for image in images])
    assert found[0] == found[1] == found[2]


def test_the_order_of_instructions_changes_no_bit(tmp_path):
    """With LLVM's machine scheduler and without: each in a process of its own, with no kernels on the disk."""
    code = """
import hashlib, sys
import numpy as np
from mgs import runtime
if sys.argv[1] == "llvm":
    runtime._keep_order = lambda: None
runtime.start()
from mgs.splat import fisher, render
from splat.scenes import make_camera, make_gaussians
gaussians, camera = make_gaussians(40, 1), make_camera()
images = [np.asarray(render(gaussians, camera).rgb), fisher(gaussians, camera)]
print(hashlib.sha256(b"".join(image.tobytes() for image in images)).hexdigest())
"""
    root = __file__.rsplit("/splat/", 1)[0]
    said = []
    for order in ("llvm", "ours"):
        (tmp_path / order).mkdir()
        run = [sys.executable, "-c", code, order]
        done = subprocess.run(
            run, cwd=root, env={**os.environ, "HOME": str(tmp_path / order)}, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        assert any((tmp_path / order).rglob("*")), "kernels were compiled here"
        said.append(done.stdout)
    assert said[0] == said[1]


def test_what_comes_after_is_the_same_number():
    x = mi.Float([0.0, -0.0, 1.5, -3e38, np.inf])
    y = in_order(x, [mi.Float([1.0, -2.0, np.nan, 3.0, np.inf]), mi.Float(7.0)])
    assert np.asarray(y).tobytes() == np.asarray(x).tobytes()
    assert in_order(x, []) is x
    z = in_order(mi.Float64(x), [mi.Float(1, 2, 3, 4, 5)])
    assert np.asarray(z).tobytes() == np.asarray(mi.Float64(x)).tobytes()
