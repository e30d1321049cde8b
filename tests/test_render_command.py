"""PLY files of any tool, order and encoding, compressed ones too; and `mgs render`, which draws."""

import base64
import json
from dataclasses import replace

import numpy as np
import OpenEXR
import pytest
from PIL import Image
from plyfile import PlyData, PlyElement
from program import command
from refusals import fails

from mgs import Gaussians, read_ply, render, write_ply
from mgs.camera import Camera, look_at, opengl_from_opencv
from mgs.colour import SH_C0, linear_from_srgb, srgb_from_linear
from mgs.images import read_exr
from mgs.splat_ply import write_compressed_ply

WIDTH, HEIGHT = 48, 32
EYES = [(0.0, -2.0, 0.5), (1.6, 1.2, 0.4)]
K = np.array([[55.0, 0, 24], [0, 55, 16], [0, 0, 1]])
CAMERAS = [Camera(K, WIDTH, HEIGHT, look_at(eye, (0, 0, 0))) for eye in EYES]


def gaussians(degree: int, n: int = 40) -> Gaussians:
    rng = np.random.default_rng(degree)
    parts = (
        rng.normal(0, 0.3, (n, 3)),
        rng.normal(-2.3, 0.4, (n, 3)),
        rng.normal(size=(n, 4)),
        rng.normal(1, 2, n),
        0.3 * rng.normal(size=(n, (degree + 1) ** 2, 3)),
    )
    return Gaussians(*(part.astype(np.float32) for part in parts), antialiased=False)


def columns(g: Gaussians) -> dict[str, np.ndarray]:
    """Properties of the 3DGS layout: f_rest holds all of red, then green, then blue."""
    named = {name: g.means[:, i] for i, name in enumerate("xyz")}
    named |= {f"f_dc_{c}": g.sh[:, 0, c] for c in range(3)}
    rest = g.sh.shape[1] - 1
    named |= {f"f_rest_{c * rest + k}": g.sh[:, 1 + k, c] for c in range(3) for k in range(rest)}
    named |= {f"scale_{i}": g.log_scales[:, i] for i in range(3)}
    named |= {f"rot_{i}": g.quats[:, i] for i in range(4)}
    return named | {"opacity": g.logit_opacities}


def foreign_ply(path, g: Gaussians, encoding: str = "ascii") -> None:
    """Write a PLY of another tool: shuffled, unknown properties, another element first."""
    rng, n = np.random.default_rng(g.sh_degree), len(g)
    named = columns(g) | {"red": rng.integers(0, 255, n, np.uint8), "confidence": rng.random(n)}
    named |= {"nx": np.zeros(n, np.float32), "f_rest_of_it": np.ones(n, np.float32)}
    named["label"] = rng.integers(-9, 9, n, np.int32)
    order = rng.permutation(sorted(named))
    table = np.empty(n, [(name, named[name].dtype) for name in order])
    for name in order:
        table[name] = named[name]
    focal = np.array([(1.5,)], [("focal", "f4")])
    parts = [PlyElement.describe(focal, "camera"), PlyElement.describe(table, "vertex")]
    how = {"text": encoding == "ascii", "byte_order": ">" if "big" in encoding else "<"}
    PlyData(parts, comments=["from another tool"], **how).write(path)


def camera_in(path) -> np.ndarray:
    """World to camera [4,4], OpenCV axes, of the header of an EXR."""
    with OpenEXR.File(str(path), header_only=True) as file:
        header = dict(file.header())
    assert header["software"].startswith("mgs ")
    assert header["fx"] == K[0, 0]
    return np.diag([1, -1, -1, 1]) @ np.asarray(header["worldToCamera"]).T


def write_cameras(path, names=("images/a.png", "images/b.png"), cameras=CAMERAS) -> None:
    """Write a transforms.json whose images do not exist."""
    K, poses = cameras[0].K, [opengl_from_opencv(camera.world_to_camera) for camera in cameras]
    lens = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    size = {"w": cameras[0].width, "h": cameras[0].height}
    pairs = zip(names, poses, strict=True)
    frames = [{"file_path": name, "transform_matrix": pose.tolist()} for name, pose in pairs]
    path.write_text(json.dumps(lens | size | {"frames": frames}))


def pixels(path) -> np.ndarray:
    with Image.open(path) as picture:
        return np.asarray(picture, np.float32) / 255


def run(folder, *arguments, ply="x.ply", out="out") -> None:
    """Render FOLDER/x.ply through FOLDER/transforms.json to FOLDER/out."""
    command("render", folder / ply, "--cameras", folder, "--out", folder / out, *arguments)


@pytest.fixture
def folder(tmp_path):
    """Folder with the cameras, for `run`."""
    write_cameras(tmp_path / "transforms.json")
    return tmp_path


SH_AS_PUBLISHED = [
    lambda x, y, z: 0.28209479177387814,
    lambda x, y, z: -0.4886025119029199 * y,
    lambda x, y, z: 0.4886025119029199 * z,
    lambda x, y, z: -0.4886025119029199 * x,
    lambda x, y, z: 1.0925484305920792 * x * y,
    lambda x, y, z: -1.0925484305920792 * y * z,
    lambda x, y, z: 0.31539156525252005 * (2 * z * z - x * x - y * y),
    lambda x, y, z: -1.0925484305920792 * x * z,
    lambda x, y, z: 0.5462742152960396 * (x * x - y * y),
    lambda x, y, z: -0.5900435899266435 * y * (3 * x * x - y * y),
    lambda x, y, z: 2.890611442640554 * x * y * z,
    lambda x, y, z: -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
    lambda x, y, z: 0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
    lambda x, y, z: -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
    lambda x, y, z: 1.445305721320277 * z * (x * x - y * y),
    lambda x, y, z: -0.5900435899266435 * x * (x * x - 3 * y * y),
]
"""Real harmonics with the signs of 3DGS; directions from the camera to the Gaussian."""


def test_harmonics_are_those_of_3dgs(tmp_path):
    """Colour of one opaque Gaussian at its centre, degree 3, against the published polynomials."""
    sh = 0.12 * np.random.default_rng(5).normal(size=(1, 16, 3))
    parts = np.zeros((1, 3)), np.full((1, 3), -1.0), np.eye(4)[[0]], np.array([20.0]), sh
    foreign_ply(tmp_path / "x.ply", Gaussians(*(part.astype(np.float32) for part in parts)))
    K = np.array([[55.0, 0, 16.5], [0, 55, 16.5], [0, 0, 1]])
    cameras = [Camera(K, 33, 33, look_at(eye, (0, 0, 0))) for eye in EYES]
    write_cameras(tmp_path / "transforms.json", cameras=cameras)
    run(tmp_path)
    for name, eye in zip("ab", EYES, strict=True):
        x, y, z = -np.array(eye) / np.linalg.norm(eye)
        colour = 0.5 + sum(basis(x, y, z) * sh[0, k] for k, basis in enumerate(SH_AS_PUBLISHED))
        assert ((colour > 0.02) & (colour < 0.98)).all()
        centre = pixels(tmp_path / f"out/{name}.png")[16, 16]
        np.testing.assert_allclose(centre, 0.999 * colour, atol=0.51 / 255)


def test_colour_spaces(folder):
    """Ours are marked linear; the option overrules; an EXR is always linear."""
    model = gaussians(1)
    write_ply(folder / "ours.ply", model)
    foreign_ply(folder / "theirs.ply", model)
    image = render(model, CAMERAS[0])
    truth, alpha, depth = (np.asarray(part) for part in (image.rgb, image.alpha, image.depth))
    as_linear, as_srgb = srgb_from_linear(truth), np.clip(truth, 0, 1)
    assert np.abs(as_linear - as_srgb).max() > 0.1
    for file, space, linear in (
        ("ours", "auto", True),
        ("ours", "srgb", False),
        ("theirs", "auto", False),
        ("theirs", "linear", True),
    ):
        out = f"{file}-{space}"
        run(folder, "--colour-space", space, "--exr", ply=f"{file}.ply", out=out)
        display = as_linear if linear else as_srgb
        np.testing.assert_allclose(pixels(folder / out / "a.png"), display, atol=0.51 / 255)
        channels = read_exr(folder / out / "a.exr")
        rgb = np.stack([channels[c] for c in "RGB"], -1)
        expected = truth if linear else linear_from_srgb(truth)
        np.testing.assert_allclose(rgb, expected, atol=1e-5)
        np.testing.assert_allclose(channels["A"], alpha, atol=1e-6)
        assert np.allclose(camera_in(folder / out / "a.exr"), CAMERAS[0].world_to_camera)
        np.testing.assert_allclose(channels["Z"], depth, rtol=1e-5)


@pytest.mark.parametrize("marked", [True, False])
def test_antialiasing(folder, marked):
    """The file says whether its Gaussians are antialiased; the option overrules."""
    model = gaussians(1)
    model = replace(model, log_scales=model.log_scales - 2, antialiased=marked)
    write_ply(folder / "x.ply", model)
    run(folder)
    run(folder, "--no-antialiased" if marked else "--antialiased", out="other")
    models = model, replace(model, antialiased=not marked)
    images = (np.asarray(render(one, CAMERAS[0]).rgb) for one in models)
    as_marked, otherwise = map(srgb_from_linear, images)
    assert np.abs(as_marked - otherwise).max() > 0.05
    np.testing.assert_allclose(pixels(folder / "out/a.png"), as_marked, atol=0.51 / 255)
    np.testing.assert_allclose(pixels(folder / "other/a.png"), otherwise, atol=0.51 / 255)


@pytest.mark.parametrize("space", ["linear", "srgb"])
def test_background_is_as_displayed(folder, space):
    foreign_ply(folder / "x.ply", gaussians(0, n=0))
    run(folder, "--colour-space", space, "--background", 1, 0.5, 0.25)
    expected = np.broadcast_to([1, 0.5, 0.25], (HEIGHT, WIDTH, 3))
    np.testing.assert_allclose(pixels(folder / "out/a.png"), expected, atol=0.51 / 255)


def test_width(folder):
    """Twice the width is the same view: 2x2 pixels average to one of the small, smooth image."""
    model = gaussians(0)
    model.log_scales[:] = -1.2
    foreign_ply(folder / "x.ply", model)
    run(folder, out="small")
    run(folder, "--width", 2 * WIDTH, out="large")
    small, large = pixels(folder / "small/a.png"), pixels(folder / "large/a.png")
    assert large.shape == (2 * HEIGHT, 2 * WIDTH, 3)
    assert np.ptp(small) > 0.3
    np.testing.assert_allclose(large.reshape(HEIGHT, 2, WIDTH, 2, 3).mean((1, 3)), small, atol=0.02)


def test_images_of_one_name_in_two_folders(folder):
    foreign_ply(folder / "x.ply", gaussians(0))
    write_cameras(folder / "transforms.json", names=("left/0001.png", "right/0001.png"))
    run(folder)
    names = sorted(path.name for path in (folder / "out").iterdir())
    assert names == ["0000_0001.png", "0001_0001.png"]


RANGES = [
    f"{end}_{name}"
    for names in ("xyz", ("scale_x", "scale_y", "scale_z"), "rgb")
    for end in ("min", "max")
    for name in names
]
PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]


def assert_close(read: Gaussians, model: Gaussians, ranges: np.ndarray) -> None:
    """Check equality within half a step; ranges [9]: of position, log-scale and colour."""
    half = 0.5 * ranges / [2047, 1023, 2047, 2047, 1023, 2047, 255, 255, 255] * 1.001 + 1e-6
    assert (np.abs(read.means - model.means) <= half[:3]).all()
    assert (np.abs(read.log_scales - model.log_scales) <= half[3:6]).all()
    assert (SH_C0 * np.abs(read.sh[:, 0] - model.sh[:, 0]) <= half[6:]).all()
    np.testing.assert_allclose(read.opacities, model.opacities, atol=0.501 / 255)
    unit = model.quats / np.linalg.norm(model.quats, axis=1, keepdims=True)
    unit = unit * np.sign((unit * read.quats).sum(1, keepdims=True))
    np.testing.assert_allclose(read.quats, unit, atol=2.5e-3)
    assert read.sh.shape == model.sh.shape
    np.testing.assert_allclose(read.sh[:, 1:], np.clip(model.sh[:, 1:], -4, 4), atol=1 / 64 + 1e-6)


SPLAT_TRANSFORM = (
    "AAAAvwAAAMAAAAC+AACAPwAAgD4AAEBAAABAwAAAgMAAAMDAAACAvwAAIMAAAKDAiyJfPlHk2z4AAAA/XTdIP68bJD8M"
    "U2w/APgfAJlY++gAVPX/+oAA/1JoXFUmmXRb/wcAAB7//wD/B+D/37OVJAD4H4CfAFWAhI5oiJFki5Rhg3OWhnCZiWxj"
    "oIDgYIEgwH6Q"
)
"""Body that PlayCanvas' splat-transform 3.7.0 wrote of THREE, in its own order."""

SH = [
    [[1, -0.25, 0.75], [0.15, 0.25, 0.35], [0.45, 0.55, 0.65], [-0.75, -0.85, -0.95]],
    [[-1, 0.5, 1.5], [0.1, 0.2, 0.3], [-0.4, -0.5, -0.6], [0.7, 0.8, -0.9]],
    [[0, 0, 0], [1, -1, 2], [0, 0.05, -0.05], [3, -3, 0.5]],
]
THREE = Gaussians(
    means=np.array([[-0.5, 0.25, -0.125], [0, 0, 0], [1, -2, 3]], np.float32),
    log_scales=np.array([[-1, -3, -5.5], [-3, -4, -5], [-2, -2.5, -6]], np.float32),
    quats=np.array(
        [[0.2, 0.3, -0.5, 0.8], [0.1, -0.9, 0.3, 0.3], [0.7, 0.1, -0.2, 0.65]], np.float32
    ),
    logit_opacities=np.array([4, -2, 0.5], np.float32),
    sh=np.array(SH, np.float32),
)


@pytest.mark.parametrize("coloured", [True, False])
def test_a_file_of_playcanvas(tmp_path, coloured):
    body, model = base64.b64decode(SPLAT_TRANSFORM), THREE.map(np.copy)
    table = np.hstack([THREE.means, THREE.log_scales, 0.5 + SH_C0 * THREE.sh[:, 0]])
    low, ranges = table.min(0), np.ptp(table, 0)
    if not coloured:
        body = body[: 4 * 12] + body[4 * 18 :]
        model.sh[:, 0] = ((table - low)[:, 6:] / ranges[6:] - 0.5) / SH_C0
        ranges[6:] = 1
    lines = ["ply", "format binary_little_endian 1.0", "comment Generated by SuperSplat 2.4.1"]
    lines += ["element chunk 1"]
    lines += [f"property float {name}" for name in RANGES[: 18 if coloured else 12]]
    lines += ["element vertex 3", *(f"property uint {name}" for name in PACKED)]
    lines += ["element sh 3", *(f"property uchar f_rest_{i}" for i in range(9)), "end_header", ""]
    path = tmp_path / "x.ply"
    path.write_bytes("\n".join(lines).encode() + body)
    read = read_ply(path)
    assert_close(read, model, ranges)
    assert not read.linear


def test_opacities_of_0_and_1_are_drawn(tmp_path):
    model = gaussians(0, n=2)
    model.logit_opacities[:] = -30, 30
    write_compressed_ply(tmp_path / "x.ply", model)
    opacities = np.sort(read_ply(tmp_path / "x.ply").opacities)
    np.testing.assert_allclose(opacities, [0, 1], atol=1e-3)
    assert (opacities > 1 / 255).tolist() == [False, True]  # below, nothing is drawn


ANY = [
    (0, "ascii", b"made elsewhere"),
    (2, "binary_big_endian", "été, 岩".encode()),
    (3, "binary_little_endian", "été".encode("latin-1")),
]


@pytest.mark.parametrize(("degree", "encoding", "comment"), ANY)
def test_any_ply(tmp_path, degree, encoding, comment):
    """Properties in any order, others that are ignored, and a comment in any script."""
    path, model = tmp_path / "x.ply", gaussians(degree)
    foreign_ply(path, model, encoding)
    path.write_bytes(path.read_bytes().replace(b"from another tool", comment, 1))
    assert read_ply(path) == replace(model, linear=False)


COMMENTS = [
    (b"SplatRenderMode: mip", True),
    (b"splatrendermode: default", False),
    (b"antialiased 1", True),
    (b"antialiased 0", False),
    (b"not antialiased at all", False),
]


@pytest.mark.parametrize(("comment", "antialiased"), COMMENTS)
def test_comments_of_other_tools_about_antialiasing(tmp_path, comment, antialiased):
    path = tmp_path / "x.ply"
    foreign_ply(path, gaussians(0), "ascii")
    path.write_bytes(path.read_bytes().replace(b"from another tool", comment, 1))
    assert read_ply(path).antialiased == antialiased
    path.write_bytes(path.read_bytes().replace(comment, b"SplatRenderMode: 2dgs", 1))
    fails("2DGS", read_ply, path)


def test_the_filter_of_mip_splatting_is_applied(tmp_path):
    """As Mip-Splatting's own export to other viewers: wider, and fainter in proportion."""
    model, path = gaussians(1), tmp_path / "x.ply"
    write_ply(path, replace(model, linear=False))
    ply = PlyData.read(path)
    table = ply["vertex"].data
    named = [(name, "f4") for name in (*table.dtype.names, "filter_3D")]
    wide = np.empty(len(table), named)
    for name in table.dtype.names:
        wide[name] = table[name]
    wide["filter_3D"] = 0.1
    PlyData([PlyElement.describe(wide, "vertex")], comments=ply.comments).write(path)
    read = read_ply(path)
    variances = np.exp(2 * model.log_scales)
    np.testing.assert_allclose(np.exp(2 * read.log_scales), variances + 0.01, rtol=1e-5)
    mass = [one.opacities * np.exp(one.log_scales.astype(float).sum(1)) for one in (model, read)]
    np.testing.assert_allclose(*mass, rtol=1e-4)
