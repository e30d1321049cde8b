"""Models in the formats of other programs: round trips, colours, and files that are refused."""

import gzip
import json
import struct
import sys
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from program import command
from refusals import refused
from test_render_command import gaussians
from test_splat_ply import assert_close

from mgs.colour import srgb_from_linear
from mgs.errors import InputError
from mgs.gaussians import Gaussians
from mgs.report.exporting import in_srgb, to_y_up
from mgs.splat.reference import sh_basis
from mgs.splat_files import FORMATS, Y_UP_SH, load_gaussians, write_gaussians
from mgs.splat_ply import write_ply

TOLERANCES = {
    "ply": (0, 0, 0, 0, 0),
    "glb": (0, 2e-6, 1e-6, 2e-6, 0),
    "spz": (1e-6, 0.5 / 16 + 1e-5, 3e-3, 0.51 / 255, 0.5 / (0.15 * 255)),
}
"""Largest differences of means, log-scales, unit quaternions, opacities and coefficients."""


def unit(quats: np.ndarray) -> np.ndarray:
    """Unit quaternions [N,4] whose largest component is positive."""
    largest = np.take_along_axis(quats, np.abs(quats).argmax(1)[:, None], 1)
    return quats * np.sign(largest) / np.linalg.norm(quats, axis=1, keepdims=True)


def written(tmp_path, kind: str, model: Gaussians):
    path = tmp_path / f"x{FORMATS[kind]}"
    write_gaussians(path, model, kind, to_y_up((0, 0, 1)))
    return path


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("kind", TOLERANCES)
def test_a_model_comes_back(tmp_path, kind, degree):
    pytest.importorskip("gsply_cpp")
    model = gaussians(degree, n=300)
    model.sh = np.clip(model.sh, -0.99, 0.99)
    read = load_gaussians(written(tmp_path, kind, model))
    mean, scale, quat, opacity, colour = TOLERANCES[kind]
    assert np.abs(read.means - model.means).max() <= mean
    assert np.abs(read.log_scales - model.log_scales).max() <= scale
    assert np.abs(unit(read.quats) - unit(model.quats)).max() <= quat
    assert np.abs(read.opacities - model.opacities).max() <= opacity
    assert np.abs(read.sh - model.sh).max() <= colour


def test_a_glb_says_how_far_its_positions_reach(tmp_path):
    """As glTF requires."""
    model = gaussians(0, n=30)
    path = tmp_path / "x.glb"
    write_gaussians(path, model, "glb", np.eye(3))
    data = path.read_bytes()
    document = json.loads(data[20 : 20 + struct.unpack("<I", data[12:16])[0]])
    position = document["meshes"][0]["primitives"][0]["attributes"]["POSITION"]
    reach = [document["accessors"][position][name] for name in ("min", "max")]
    assert np.array_equal(reach, [model.means.min(0), model.means.max(0)])


def test_an_spz_is_y_up(tmp_path):
    codec = pytest.importorskip("gsply_cpp")
    model = gaussians(3, n=300)
    model.sh = np.clip(model.sh, -0.99, 0.99)
    raw = codec.read_spz(str(written(tmp_path, "spz", model)))
    np.testing.assert_allclose(raw["means"], model.means * (1, -1, -1), atol=1e-6)
    np.testing.assert_allclose(unit(raw["quats"]), unit(model.quats * (1, 1, -1, -1)), atol=3e-3)
    higher = (model.sh * Y_UP_SH[:, None])[:, 1:]
    np.testing.assert_allclose(raw["shN"], higher, atol=TOLERANCES["spz"][-1])


def test_the_signs_of_coefficients_turn_the_basis():
    directions = np.random.default_rng(0).normal(size=(100, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    turned = sh_basis(directions * (1, -1, -1), 3)
    np.testing.assert_allclose(turned, Y_UP_SH * sh_basis(directions, 3), atol=1e-12)


@pytest.mark.parametrize("degree", [0, 3])
def test_a_compressed_ply_holds_the_same_gaussians(tmp_path, degree):
    model = gaussians(degree, n=600)
    read = load_gaussians(written(tmp_path, "compressed-ply", model))
    nearest = np.abs(read.means[:, None] - model.means).sum(-1).argmin(1)
    assert sorted(nearest) == list(range(600))
    table = np.hstack([model.means, model.log_scales, 0.5 + 0.28209479 * model.sh[:, 0]])
    assert_close(read, model[nearest], np.ptp(table, 0))


@pytest.mark.parametrize("kind", FORMATS)
def test_antialiasing_and_the_space_of_colours_are_kept_where_a_format_can(tmp_path, kind):
    pytest.importorskip("gsply_cpp")
    for marked in (True, False):
        model = replace(gaussians(0), antialiased=marked, linear=marked)
        read = load_gaussians(written(tmp_path, kind, model))
        assert read.antialiased == (marked and kind != "spz")
        assert read.linear == (marked and kind in ("ply", "glb"))


def test_colours_become_srgb(tmp_path):
    flat = gaussians(0)
    shown = in_srgb(flat)
    np.testing.assert_allclose(shown.rgb, srgb_from_linear(flat.rgb), atol=1e-5)
    lifted = in_srgb(flat.with_degree(3))
    np.testing.assert_allclose(lifted.rgb, shown.rgb, atol=1e-5)
    np.testing.assert_allclose(lifted.sh[:, 1:], 0, atol=1e-5)


def test_up_becomes_y():
    for up in ((0, 0, 1), (0, -1, 0), (0.6, 0, 0.8)):
        np.testing.assert_allclose(to_y_up(up) @ up, (0, 1, 0), atol=1e-12)


def test_the_command_converts_and_keeps_what_is_there(tmp_path, capsys):
    model = gaussians(1)
    write_ply(tmp_path / "a.ply", model)
    given = ["export", tmp_path / "a.ply", "--out", tmp_path / "b.glb"]
    command(*given)
    assert "wrote 40 Gaussians" in capsys.readouterr().out
    assert np.array_equal(load_gaussians(tmp_path / "b.glb").means, model.means)
    assert "is there already" in refused(capsys, given, tmp_path)


def glb(content: object) -> bytes:
    text = json.dumps(content).encode()
    return struct.pack("<4sIIII", b"glTF", 2, 0, len(text), 0x4E4F534A) + text


SPLATS = {"mode": 0, "attributes": {}, "extensions": {"KHR_gaussian_splatting": {}}}
PACKED = {"KHR_gaussian_splatting": {"extensions": {"KHR_spz": {}}}}
BAD = {
    "a.ksplat": (b"\0" * 64, "npx @playcanvas/splat-transform a.ksplat a.ply"),
    "empty.glb": (b"glTF", "not a readable GLB"),
    "list.glb": (glb([]), "not a readable GLB"),
    "mesh.glb": (glb({"meshes": [{"primitives": [{}]}]}), "no Gaussians in it"),
    "bare.glb": (glb({"meshes": [{"primitives": [SPLATS]}]}), "not a readable GLB"),
    "packed.glb": (
        glb({"meshes": [{"primitives": [SPLATS | {"extensions": PACKED}]}]}),
        "its Gaussians are compressed (KHR_spz)",
    ),
    "cut.spz": (gzip.compress(b"NGSP\3\0\0\0\xff\xff\0\0"), "not a readable SPZ"),
    "few.spz": (
        gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, 10**9, 3, 12, 0, 0) + b"\0" * 99),
        "not a readable SPZ",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_refused(tmp_path, capsys, name):
    if name.endswith("spz"):
        pytest.importorskip("gsply_cpp")
    data, message = BAD[name]
    (tmp_path / name).write_bytes(data)
    line = refused(capsys, ["export", tmp_path / name, "--to", "ply"], tmp_path)
    assert message in line
    assert str(tmp_path / name) in line


def test_a_damaged_glb_is_refused_or_read(tmp_path):
    """No byte of a file makes it fail in another way."""
    path = written(tmp_path, "glb", gaussians(0, n=4))
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    for _ in range(60):
        data = bytearray(whole[: rng.integers(len(whole)) if rng.random() < 0.2 else None])
        for place in rng.integers(len(data), size=3) if len(data) else []:
            data[place] = rng.integers(256)
        path.write_bytes(b"glTF" + bytes(data[4:]))
        with suppress(InputError):
            load_gaussians(path)


def test_spz_without_its_package(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "gsply_cpp", None)
    write_ply(tmp_path / "a.ply", gaussians(0))
    line = refused(capsys, ["export", tmp_path / "a.ply", "--to", "spz"], tmp_path)
    assert "`pip install gsply`" in line
