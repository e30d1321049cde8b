"""Models in the formats of other programs: round trips, colours, and files that are refused."""

import gzip
import json
import re
import struct
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from program import command, output
from refusals import fails, refused
from splat import reference
from test_meshes import glb, parts_of
from test_render_command import CAMERAS, assert_close, gaussians

import mgs
from mgs import Gaussians, load_cameras, load_dataset, read_ply, write_ply
from mgs.colour import sh_basis, srgb_from_linear
from mgs.errors import InputError, Notice
from mgs.images import read_mask
from mgs.reports.evaluation import compare_models, evaluate
from mgs.reports.exporting import in_srgb, to_y_up
from mgs.rotation import rotmat_from_quat
from mgs.run.folder import Run, open_run, write_checkpoint
from mgs.splat import render
from mgs.splat_files import FORMATS, load_gaussians, upward, write_gaussians
from mgs.splat_places import mirrored

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


def covariances(model: Gaussians) -> np.ndarray:
    axes = rotmat_from_quat(model.quats) * np.exp(model.log_scales.astype(float))[:, None]
    return axes @ axes.transpose(0, 2, 1)


def colours(model: Gaussians, directions: np.ndarray) -> np.ndarray:
    """Colours [N,D,3] in directions [D,3], for SH of degree 3."""
    return np.einsum("dk,nkc->ndc", sh_basis(directions, 3), model.sh)


def written(tmp_path, kind: str, model: Gaussians, turn=to_y_up((0, 0, 1))):
    path = tmp_path / f"x{FORMATS[kind]}"
    write_gaussians(path, model, kind, turn)
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
    model = gaussians(0, n=30)
    document, _ = parts_of(written(tmp_path, "glb", model, np.eye(3)))
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
    higher = mirrored(model, (1, -1, -1)).sh[:, 1:]
    np.testing.assert_allclose(raw["shN"], higher, atol=TOLERANCES["spz"][-1])


@pytest.mark.parametrize("signs", [(1, -1, -1), (-1, -1, 1), (-1, 1, 1)])
def test_a_mirrored_model_looks_the_same_from_the_mirrored_side(signs):
    directions = np.random.default_rng(0).normal(size=(100, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    model = gaussians(3, n=5)
    turned = mirrored(model, signs)
    mirror_image = colours(turned, directions * signs)
    np.testing.assert_allclose(mirror_image, colours(model, directions), atol=1e-6)
    expected = covariances(model) * np.outer(signs, signs)
    np.testing.assert_allclose(covariances(turned), expected, atol=1e-7)


@pytest.mark.parametrize("degree", [0, 3])
def test_a_compressed_ply_holds_the_same_gaussians(tmp_path, degree):
    model = gaussians(degree, n=600)
    read = load_gaussians(written(tmp_path, "compressed-ply", model))
    nearest = np.abs(read.means[:, None] - model.means).sum(-1).argmin(1)
    assert sorted(nearest) == list(range(600))
    table = np.hstack([model.means, model.log_scales, 0.5 + 0.28209479 * model.sh[:, 0]])
    assert_close(read, model[nearest], np.ptp(table, 0))
    padded = load_gaussians(written(tmp_path, "compressed-ply", model.with_degree(3)))
    assert degree or abs(padded.sh[:, 1:].mean(axis=(0, 1))).max() < 1e-3


@pytest.mark.parametrize("kind", FORMATS)
def test_antialiasing_and_the_space_of_colours_are_kept_where_a_format_can(tmp_path, kind):
    pytest.importorskip("gsply_cpp")
    for marked in (True, False):
        model = replace(gaussians(0), antialiased=marked, linear=marked)
        read = load_gaussians(written(tmp_path, kind, model))
        assert read.antialiased == marked
        assert read.linear == (marked and kind in ("ply", "glb"))


def test_a_model_far_from_the_origin(tmp_path):
    """Its positions are doubles in a PLY and a translation in a GLB; it is drawn without loss."""
    place = (448262.0, 5411932.0, 412.0)
    near = gaussians(1)
    far = replace(near, origin=place)
    for kind in ("ply", "glb"):
        read = load_gaussians(written(tmp_path, kind, far))
        assert np.abs(np.add(read.means, read.origin) - near.means - place).max() < 1e-6
        shifted = CAMERAS[0].seen_from(np.negative(place))
        drawn = render(near, CAMERAS[0]), render(read, shifted)
        np.testing.assert_allclose(*(np.asarray(image.rgb) for image in drawn), atol=2e-5)
    pixels = shifted.project(np.add(near.means, place))[0]
    np.testing.assert_allclose(pixels, CAMERAS[0].project(near.means)[0], atol=1e-4)
    exact = reference.render(far, shifted)["rgb"]
    np.testing.assert_allclose(exact, reference.render(near, CAMERAS[0])["rgb"], atol=1e-5)
    with pytest.warns(Notice, match="count from 448262, 5411932, 412"):
        written(tmp_path, "compressed-ply", far)
    assert far.counted_from(np.subtract(place, 1)).origin == (1, 1, 1)
    assert near.counted_from(place) == near


def test_numbers_that_mean_no_number(tmp_path):
    """Infinite logits and flat Gaussians are drawn; others that are not finite are counted."""
    model = gaussians(0)
    model.logit_opacities[:2] = np.inf, -np.inf
    model.log_scales[2, 1] = -np.inf
    model.means[3, 0] = model.sh[4, 0, 0] = np.nan
    model.log_scales[5, 0] = np.inf
    with pytest.warns(Notice, match="3 Gaussians"):
        read = load_gaussians(written(tmp_path, "ply", model))
    assert len(read) == len(model) - 3
    np.testing.assert_allclose(read.opacities[:2], [1, 0], atol=2e-6)
    assert np.exp(read.log_scales[2, 1]) < 1e-6
    model.means[:] = np.nan
    fails("no Gaussian has finite numbers", load_gaussians, written(tmp_path, "ply", model))


def tilted(scale, shear: float = 0.0) -> np.ndarray:
    """A transform [4,4]: turned, scaled, sheared, shifted."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotmat_from_quat([0.8, 0.3, -0.4, 0.2]) * np.broadcast_to(scale, 3)
    matrix[:3, 3] = 1, -2, 3
    matrix[:3, 1] += shear * matrix[:3, 0]
    return matrix


def glb_with(path, change) -> None:
    """Change the JSON of a GLB in place."""
    content, body = parts_of(path)
    change(content)
    path.write_bytes(glb(content, body))


@pytest.mark.parametrize("scale", [2.0, -0.5, (2.0, 0.5, 1.0)])
def test_the_transforms_of_nodes_are_applied(tmp_path, scale):
    """Means and covariances under any scale, colours by the direction in the node's own axes."""
    model, matrix = gaussians(3), tilted(scale)
    path = written(tmp_path, "glb", model, np.eye(3))
    half = {"matrix": np.diag([0.5, 0.5, 0.5, 1]).ravel().tolist(), "children": [1]}
    inner = {"mesh": 0, "matrix": (np.diag([2, 2, 2, 1]) @ matrix).T.ravel().tolist()}
    glb_with(path, lambda content: content.update(nodes=[half, inner]))
    read, A = load_gaussians(path), matrix[:3, :3]
    np.testing.assert_allclose(read.means, model.means @ A.T + matrix[:3, 3], atol=1e-5)
    np.testing.assert_allclose(covariances(read), A @ covariances(model) @ A.T, atol=1e-5)
    directions = np.random.default_rng(0).normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    own = directions @ (A / np.linalg.norm(A, axis=0))
    np.testing.assert_allclose(colours(read, directions), colours(model, own), atol=1e-5)


def test_shear_is_refused(tmp_path):
    path = written(tmp_path, "glb", gaussians(0), np.eye(3))
    sheared = {"mesh": 0, "matrix": tilted(1.0, shear=0.3).T.ravel().tolist()}
    glb_with(path, lambda content: content.update(nodes=[sheared]))
    fails("has shear", load_gaussians, path)


def test_all_primitives_are_read(tmp_path):
    model = gaussians(1)
    path = written(tmp_path, "glb", model, np.eye(3))
    shifted = [{"mesh": 0}, {"mesh": 0, "translation": [0, 0, 2]}]

    def twice(content):
        content["meshes"][0]["primitives"] *= 2
        content.update(nodes=shifted, scenes=[{"nodes": [0, 1]}])

    glb_with(path, twice)
    heights = np.concatenate([model.means[:, 2] + z for z in (0, 0, 2, 2)])
    np.testing.assert_allclose(load_gaussians(path).means[:, 2], heights, atol=1e-6)


def test_a_model_that_is_not_z_up_comes_back_in_its_own_axes(tmp_path):
    model, up = gaussians(0), (0.6, 0.0, 0.8)
    path = written(tmp_path, "glb", model, to_y_up(up))
    np.testing.assert_array_equal(load_gaussians(path).means, model.means)
    np.testing.assert_allclose(upward(path), up, atol=1e-12)


RDF = struct.pack("<III", 0xADBE0003, 4, 6)
"""Extension of an SPZ: axes right, down, front, those of a PLY."""


def test_an_spz_that_names_its_axes(tmp_path):
    pytest.importorskip("gsply_cpp")
    model = gaussians(1)
    path = written(tmp_path, "spz", mirrored(model, (1, -1, -1)))  # so they are stored as a PLY's
    data = bytearray(gzip.decompress(path.read_bytes()))
    data[14] |= 2
    path.write_bytes(gzip.compress(bytes(data) + RDF))
    assert np.abs(load_gaussians(path).means - model.means).max() < 1e-6


def test_short_quaternions_are_rotations(tmp_path):
    model = gaussians(0)
    write_ply(tmp_path / "x.ply", replace(model, quats=model.quats * np.float32(1e-20)))
    read = load_gaussians(tmp_path / "x.ply")
    np.testing.assert_allclose(covariances(read), covariances(model), atol=1e-6)


def test_an_spz_that_is_cut_off_when_written_is_refused(tmp_path, monkeypatch):
    codec = pytest.importorskip("gsply_cpp")
    monkeypatch.setattr(codec, "write_spz", lambda path, *_, **__: Path(path).touch())
    fails("No space left on device", written, tmp_path, "spz", gaussians(0))
    assert not list(tmp_path.iterdir())


def test_float32_too_far_from_the_origin_is_noticed(tmp_path):
    model = gaussians(0)
    write_ply(tmp_path / "x.ply", replace(model, means=model.means + np.float32(5e6)))
    with pytest.warns(Notice, match=r"steps of 0\.5 so far from the origin"):
        load_gaussians(tmp_path / "x.ply")
    write_ply(tmp_path / "x.ply", replace(model, log_scales=0 * model.log_scales + 3e38))
    assert load_gaussians(tmp_path / "x.ply").means.shape == model.means.shape


def test_scales_that_are_logarithms_are_refused(tmp_path):
    path = written(tmp_path, "glb", gaussians(0, n=1), np.eye(3))
    scale = np.exp(gaussians(0, n=1).log_scales).astype("<f4").tobytes()
    path.write_bytes(path.read_bytes().replace(scale, np.full(3, -2, "<f4").tobytes()))
    fails("negative scales, which are probably logarithms", load_gaussians, path)


def test_an_spz_that_unpacks_to_more_than_its_header_says(tmp_path):
    pytest.importorskip("gsply_cpp")
    written(tmp_path, "spz", gaussians(0))
    (path,) = tmp_path.iterdir()
    path.write_bytes(gzip.compress(gzip.decompress(path.read_bytes()) + bytes(1 << 21)))
    fails("more than its header says", load_gaussians, path)


def test_an_spz_of_version_1_has_positions_of_float16(tmp_path):
    """Its encoder: the streams in their order, after the published description."""
    pytest.importorskip("gsply_cpp")
    model = mirrored(gaussians(1, n=9), (1, -1, -1))
    units = model.quats / np.linalg.norm(model.quats, axis=1, keepdims=True)
    units = np.where(units[:, :1] < 0, -units, units)
    levels = [
        255 * model.opacities,
        255 * (0.15 * model.sh[:, 0] + 0.5),
        16 * (model.log_scales + 10),
        127.5 * units[:, 1:] + 127.5,
        128 * model.sh[:, 1:] + 128,
    ]
    steps = [np.clip(np.round(level), 0, 255).astype(np.uint8).tobytes() for level in levels]
    head = struct.pack("<4sIIBBBB", b"NGSP", 1, 9, 1, 0, 1, 0)
    data = head + model.means.astype("<f2").tobytes() + b"".join(steps)
    (tmp_path / "x.spz").write_bytes(gzip.compress(data))
    read = mirrored(load_gaussians(tmp_path / "x.spz"), (1, -1, -1))
    assert read.antialiased
    np.testing.assert_array_equal(read.means, model.means.astype(np.float16))
    np.testing.assert_allclose(read.log_scales, model.log_scales, atol=1 / 32 + 1e-6)
    np.testing.assert_allclose(read.sh[:, 1:], model.sh[:, 1:], atol=1 / 256 + 1e-6)
    np.testing.assert_allclose(covariances(read), covariances(model), rtol=0.2, atol=0.01)


def test_colours_become_srgb():
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
    given = ["export", tmp_path / "a.ply", "--sh", 3, "--out", tmp_path / "b.glb"]
    assert "wrote 40 Gaussians" in output(capsys, *given)
    read = load_gaussians(tmp_path / "b.glb")
    assert np.array_equal(read.means, model.means)
    assert read.sh.shape == (40, 16, 3)
    assert "is there already" in refused(capsys, given, tmp_path)


def test_the_export_of_a_run_fits_its_colours_again(dataset, prior, tmp_path, capsys):
    """The printed PSNR is measured; of a file alone each colour is converted."""
    settings = {"prior": prior, "seeds": 4, "budget": 0, "train": {"passes": 10, "space": "linear"}}
    run = mgs.run_nbv(dataset, tmp_path / "run", **settings)
    command("export", tmp_path / "run", "--to", "ply", "--out", tmp_path / "fitted.ply")
    said = [float(number) for number in re.findall(r"([0-9.]+) dB", capsys.readouterr().out)]
    command("export", tmp_path / "run", "--to", "ply", "--bytes", "1M", "--out", tmp_path / "sized")
    sized = load_gaussians(tmp_path / "sized")
    fitted, converted = read_ply(tmp_path / "fitted.ply"), in_srgb(run.state.gaussians)
    measured = compare_models([run.state.gaussians, fitted, converted, sized], run)[1]
    np.testing.assert_allclose(measured[:2], said, atol=0.006)
    assert measured[2] < min(measured[1], measured[3]), "colours that are fitted again are better"
    assert replace(fitted, sh=converted.sh) == converted, "only colours change"
    file = tmp_path / "run/gaussians.ply"
    command("export", file, "--to", "ply", "--out", tmp_path / "alone.ply")
    assert "one by one" in capsys.readouterr().out
    assert read_ply(tmp_path / "alone.ply") == converted
    command("export", tmp_path / "fitted.ply", "--to", "ply", "--out", tmp_path / "same.ply")
    assert "one by one" not in capsys.readouterr().out
    assert read_ply(tmp_path / "same.ply") == fitted


def test_a_scene_is_exported_without_what_no_view_shows(
    dataset, prior, tmp_path, capsys, monkeypatch
):
    """A Gaussian behind all cameras goes, and the views taken stay; of an object all stay."""
    settings = {"prior": prior, "seeds": 4, "budget": 0, "train": {"passes": 1}}
    run = mgs.run_nbv(dataset, tmp_path / "run", **settings)
    cameras = [frame.camera for frame in run.taken]
    model = run.gaussians[[*range(len(run.gaussians)), 0]]
    model.means[-1, 2] = 1e3
    black = int(run.state.H[:, -1].argmax())
    model.sh[black] = -10  # black, which hides what is behind it, but has no information on colour
    H = sum(mgs.fisher(model, camera) for camera in cameras)
    write_checkpoint(run.folder, replace(run.state, gaussians=model, H=H))
    for of_scene in (False, True):
        monkeypatch.setattr(Run, "of_scene", of_scene)
        command("export", run.folder, "--to", "ply", "--out", tmp_path / "x.ply", "--force")
        said, left = capsys.readouterr().out, read_ply(tmp_path / "x.ply")
        assert ("no view taken shows" in said) is of_scene
        assert (left.means[:, 2].max() > 100) is not of_scene
        assert left.sh.min() == -10
        for camera in cameras:
            rgb = [np.asarray(render(one, camera).rgb) for one in (model, left)]
            np.testing.assert_allclose(*rgb, atol=0.02)


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


@pytest.fixture(scope="module")
def chosen(whole):
    """A run of a dataset with masks and depth."""
    return open_run(whole)


def test_the_views_taken_as_colmap_reads_them(chosen, tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    command("export", chosen.folder, "--to", "colmap", "--out", tmp_path / "c")
    model, taken = pycolmap.Reconstruction(tmp_path / "c/sparse/0"), chosen.taken
    images = {image.name: image for image in model.images.values()}
    assert sorted(images) == sorted(frame.image_path.name for frame in taken)
    places = np.random.default_rng(0).normal(size=(5, 3)) * 0.3
    for frame in taken:
        image = images[frame.image_path.name]
        ours = frame.camera.project(places)[0]
        theirs = [image.project_point(point) for point in places]
        np.testing.assert_allclose(theirs, ours, atol=1e-6)
        mask = read_mask(tmp_path / "c/masks" / f"{image.name}.png")
        assert np.array_equal(mask, frame.mask())
        copy = tmp_path / "c/images" / image.name
        assert copy.read_bytes() == frame.image_path.read_bytes()
    points = np.array([model.points3D[number].xyz for number in sorted(model.points3D)])
    opaque = chosen.gaussians.opacities >= 0.5
    np.testing.assert_allclose(points, chosen.gaussians.means[opaque], atol=1e-6)


def test_all_views_as_nerfstudio_reads_them(chosen, tmp_path):
    """`mgs import` reads them back: cameras, masks, depth and its unit."""
    given = ["export", chosen.folder, "--to", "nerfstudio", "--out", tmp_path / "n"]
    command(*given, "--views", "all")
    content = json.loads((tmp_path / "n/transforms.json").read_text())
    assert (tmp_path / "n" / content["ply_file_path"]).is_file()
    assert content["depth_unit_scale_factor"] == 1e-3
    command("import", tmp_path / "n", "--unit", 1, "--out", tmp_path / "back")
    back = load_dataset(tmp_path / "back")
    assert len(back) == len(chosen.dataset)
    for one, frame in zip(back.frames, chosen.dataset.frames, strict=True):
        assert np.abs(one.camera.world_to_camera - frame.camera.world_to_camera).max() < 1e-12
        np.testing.assert_allclose(one.depth(), frame.depth(), atol=0.51e-3)
        assert np.array_equal(one.mask(), frame.mask())
    command(*given, "--force")
    assert len(load_cameras(tmp_path / "n")) == len(chosen.taken)


@pytest.mark.parametrize("kind", ["glb", "spz", "compressed-ply"])
def test_every_format_is_measured(chosen, tmp_path, kind):
    pytest.importorskip("gsply_cpp")
    model = in_srgb(chosen.gaussians)
    right = evaluate(model, chosen.dataset)["all"]["psnr"]
    path = written(tmp_path, kind, model)
    assert evaluate(path, chosen.dataset)["all"]["psnr"] == pytest.approx(right, abs=0.1)
    assert path.with_name(f"{path.name}.metrics.json").is_file()  # others may differ in the end
