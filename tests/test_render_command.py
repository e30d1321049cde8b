"""`mgs render`: PLY files of any order, encoding and degree, drawn through cameras without
images."""

import json
import struct

import numpy as np
import pytest
from PIL import Image

from mgs.camera import Camera, look_at, opengl_from_opencv
from mgs.cli import app
from mgs.colour import linear_from_srgb, srgb_from_linear
from mgs.gaussians import Gaussians
from mgs.images import read_exr
from mgs.splat import render
from mgs.splat_ply import ply_colour_space, read_ply, write_ply

WIDTH, HEIGHT = 48, 32
EYES = [(0.0, -2.0, 0.5), (1.6, 1.2, 0.4)]
CAMERAS = [
    Camera(
        np.array([[55.0, 0, 24], [0, 55, 16], [0, 0, 1]]), WIDTH, HEIGHT, look_at(eye, (0, 0, 0))
    )
    for eye in EYES
]


def gaussians(degree: int, n: int = 40) -> Gaussians:
    rng = np.random.default_rng(degree)
    parts = (
        rng.normal(0, 0.3, (n, 3)),
        rng.normal(-2.3, 0.4, (n, 3)),
        rng.normal(size=(n, 4)),
        rng.normal(1, 2, n),
        0.3 * rng.normal(size=(n, (degree + 1) ** 2, 3)),
    )
    return Gaussians(*(part.astype(np.float32) for part in parts))


def columns(g: Gaussians) -> dict[str, np.ndarray]:
    """The properties of the 3DGS layout, written out from its definition: f_rest holds all of red,
    then green, then blue."""
    named = {name: g.means[:, i] for i, name in enumerate("xyz")}
    named |= {f"f_dc_{c}": g.sh[:, 0, c] for c in range(3)}
    rest = g.sh.shape[1] - 1
    named |= {f"f_rest_{c * rest + k}": g.sh[:, 1 + k, c] for c in range(3) for k in range(rest)}
    named |= {f"scale_{i}": g.log_scales[:, i] for i in range(3)} | {
        f"rot_{i}": g.quats[:, i] for i in range(4)
    }
    return named | {"opacity": g.logit_opacities}


def foreign_ply(path, g: Gaussians, encoding: str, extra: bool = True, seed: int = 0) -> None:
    """A PLY as some other tool might write it: properties shuffled, properties that nobody asked
    for, another element first."""
    rng = np.random.default_rng(seed)
    named = {name: ("float", "f", values) for name, values in columns(g).items()}
    if extra:
        named |= {
            "red": ("uchar", "B", rng.integers(0, 255, len(g))),
            "confidence": ("double", "d", rng.random(len(g))),
        }
        named |= {
            "nx": ("float", "f", np.zeros(len(g))),
            "f_rest_of_it": ("float", "f", np.ones(len(g))),
        }
        named |= {"label": ("int", "i", rng.integers(-9, 9, len(g)))}
    order = rng.permutation(sorted(named))
    header = [
        "ply",
        f"format {encoding} 1.0",
        "comment from another tool",
        "element camera 1",
        "property float focal",
    ]
    header += [
        f"element vertex {len(g)}",
        *(f"property {named[name][0]} {name}" for name in order),
        "end_header",
        "",
    ]
    rows = list(zip(*(named[name][2].tolist() for name in order), strict=True))
    if encoding == "ascii":
        body = "\n".join(
            ["1.5", *(" ".join(repr(value) for value in row) for row in rows), ""]
        ).encode()
    else:
        endian = "<" if "little" in encoding else ">"
        layout = endian + "".join(named[name][1] for name in order)
        body = struct.pack(f"{endian}f", 1.5) + b"".join(struct.pack(layout, *row) for row in rows)
    path.write_bytes("\n".join(header).encode() + body)


def write_cameras(path, names=("images/a.png", "images/b.png"), cameras=CAMERAS) -> None:
    """A transforms.json whose images do not exist."""
    K = cameras[0].K
    data = {
        "fl_x": K[0, 0],
        "fl_y": K[1, 1],
        "cx": K[0, 2],
        "cy": K[1, 2],
        "w": cameras[0].width,
        "h": cameras[0].height,
    }
    poses = [opengl_from_opencv(camera.world_to_camera).tolist() for camera in cameras]
    frames = [
        {"file_path": name, "transform_matrix": pose}
        for name, pose in zip(names, poses, strict=True)
    ]
    path.write_text(json.dumps(data | {"frames": frames}))


def pixels(path) -> np.ndarray:
    with Image.open(path) as picture:
        return np.asarray(picture, np.float32) / 255


def run(*arguments) -> None:
    with pytest.raises(SystemExit) as end:
        app.main(["render", *map(str, arguments)])
    assert end.value.code in (0, None)


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_any_ply(tmp_path, degree, encoding):
    """Every camera gets the picture of the model, whatever the order of its properties; other
    tools' colours are sRGB."""
    model = gaussians(degree)
    foreign_ply(tmp_path / "x.ply", model, encoding, seed=degree)
    write_cameras(tmp_path / "transforms.json")
    run(tmp_path / "x.ply", "--cameras", tmp_path / "transforms.json", "--out", tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["a.png", "b.png"]
    for name, camera in zip("ab", CAMERAS, strict=True):
        truth = np.clip(np.asarray(render(model, camera).rgb), 0, 1)
        assert truth.max() > 0.3
        np.testing.assert_allclose(pixels(tmp_path / f"out/{name}.png"), truth, atol=0.51 / 255)


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
"""Real spherical harmonics with the signs of the 3DGS paper's code; directions from the camera to
the Gaussian."""


def test_harmonics_are_those_of_3dgs(tmp_path):
    """One opaque Gaussian before the camera, colour of degree 3 from the published polynomials: the
    pixel at its centre."""
    rng = np.random.default_rng(5)
    sh = 0.12 * rng.normal(size=(1, 16, 3))
    model = Gaussians(np.zeros((1, 3)), np.full((1, 3), -1.0), np.eye(4)[[0]], np.array([20.0]), sh)
    foreign_ply(
        tmp_path / "x.ply",
        Gaussians(*(np.asarray(v, np.float32) for v in vars(model).values())),
        "ascii",
    )
    K = np.array([[55.0, 0, 16.5], [0, 55, 16.5], [0, 0, 1]])
    cameras = [Camera(K, 33, 33, look_at(eye, (0, 0, 0))) for eye in EYES]
    write_cameras(tmp_path / "transforms.json", cameras=cameras)
    run(tmp_path / "x.ply", "--cameras", tmp_path, "--out", tmp_path / "out")
    for name, eye in zip("ab", EYES, strict=True):
        x, y, z = -np.array(eye) / np.linalg.norm(eye)
        colour = 0.5 + sum(basis(x, y, z) * sh[0, k] for k, basis in enumerate(SH_AS_PUBLISHED))
        assert ((colour > 0.02) & (colour < 0.98)).all()
        np.testing.assert_allclose(
            pixels(tmp_path / f"out/{name}.png")[16, 16], 0.999 * colour, atol=0.51 / 255
        )


def test_colour_spaces(tmp_path):
    """Our own files are linear and say so; the option overrules; the EXR is linear in any case,
    with alpha and depth."""
    model = gaussians(1)
    write_ply(tmp_path / "ours.ply", model)
    foreign_ply(tmp_path / "theirs.ply", model, "ascii")
    assert ply_colour_space(tmp_path / "ours.ply") == "linear"
    assert ply_colour_space(tmp_path / "theirs.ply") == "srgb"
    write_cameras(tmp_path / "transforms.json")
    image = render(model, CAMERAS[0])
    truth, alpha, depth = (np.asarray(part) for part in (image.rgb, image.alpha, image.depth))
    as_linear, as_srgb = srgb_from_linear(truth), np.clip(truth, 0, 1)
    cases = {
        ("ours", "auto"): as_linear,
        ("ours", "srgb"): as_srgb,
        ("theirs", "auto"): as_srgb,
        ("theirs", "linear"): as_linear,
    }
    for (file, space), display in cases.items():
        out = tmp_path / f"{file}-{space}"
        run(
            tmp_path / f"{file}.ply",
            "--cameras",
            tmp_path,
            "--out",
            out,
            "--colour-space",
            space,
            "--exr",
        )
        np.testing.assert_allclose(pixels(out / "a.png"), display, atol=0.51 / 255)
        channels = read_exr(out / "a.exr")
        rgb = np.stack([channels[c] for c in "RGB"], -1)
        np.testing.assert_allclose(
            rgb, truth if display is as_linear else linear_from_srgb(truth), atol=1e-5
        )
        np.testing.assert_allclose(channels["A"], alpha, atol=1e-6)
        np.testing.assert_allclose(channels["Z"], depth, rtol=1e-5)
    assert np.abs(as_linear - as_srgb).max() > 0.1


@pytest.mark.parametrize("space", ["linear", "srgb"])
def test_background_is_as_displayed(tmp_path, space):
    foreign_ply(tmp_path / "x.ply", gaussians(0, n=1), "ascii")
    write_cameras(tmp_path / "transforms.json")
    arguments = ["--colour-space", space, "--background", 1, 0.5, 0.25]
    run(tmp_path / "x.ply", "--cameras", tmp_path, "--out", tmp_path / "out", *arguments)
    np.testing.assert_allclose(
        pixels(tmp_path / "out/a.png")[0, 0], [1, 0.5, 0.25], atol=0.51 / 255
    )


def test_width(tmp_path):
    """Twice the width is the same view: every 2x2 pixels average to one of the small image's,
    smooth as this one is."""
    model = gaussians(0)
    model.log_scales[:] = -1.2
    foreign_ply(tmp_path / "x.ply", model, "ascii")
    write_cameras(tmp_path / "transforms.json")
    run(tmp_path / "x.ply", "--cameras", tmp_path, "--out", tmp_path / "small")
    run(
        tmp_path / "x.ply", "--cameras", tmp_path, "--out", tmp_path / "large", "--width", 2 * WIDTH
    )
    small, large = pixels(tmp_path / "small/a.png"), pixels(tmp_path / "large/a.png")
    assert large.shape == (2 * HEIGHT, 2 * WIDTH, 3)
    assert np.ptp(small) > 0.3
    np.testing.assert_allclose(large.reshape(HEIGHT, 2, WIDTH, 2, 3).mean((1, 3)), small, atol=0.02)


def test_images_of_one_name_in_two_folders(tmp_path):
    foreign_ply(tmp_path / "x.ply", gaussians(0), "ascii")
    write_cameras(tmp_path / "transforms.json", names=("left/0001.png", "right/0001.png"))
    run(tmp_path / "x.ply", "--cameras", tmp_path, "--out", tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "0000_0001.png",
        "0001_0001.png",
    ]


def test_no_gaussians(tmp_path):
    foreign_ply(tmp_path / "x.ply", gaussians(0, n=0), "ascii")
    write_cameras(tmp_path / "transforms.json")
    run(
        tmp_path / "x.ply",
        "--cameras",
        tmp_path,
        "--out",
        tmp_path / "out",
        "--background",
        0,
        0,
        1,
    )
    assert (pixels(tmp_path / "out/a.png") == [0, 0, 1]).all()


def broken(change):
    """A foreign PLY as text, changed."""

    def make(tmp_path):
        foreign_ply(tmp_path / "x.ply", gaussians(0, n=3), "ascii", extra=False)
        (tmp_path / "x.ply").write_text(change((tmp_path / "x.ply").read_text()))

    return make


def infinite_opacity(tmp_path):
    model = gaussians(0)
    model.logit_opacities[5] = np.inf
    foreign_ply(tmp_path / "x.ply", model, "binary_little_endian")


BAD = {
    "no PLY": (lambda tmp: (tmp / "x.ply").unlink(), [], "x.ply: no such file; give a 3DGS PLY"),
    "not a PLY": (broken(lambda text: "solid " + text), [], "not a readable 3DGS PLY"),
    "truncated": (broken(lambda text: text[:-60]), [], "not a readable 3DGS PLY"),
    "a point cloud": (
        broken(lambda text: text.replace("opacity", "quality")),
        [],
        "property 'opacity' is missing",
    ),
    "odd f_rest": (
        broken(lambda text: text.replace("opacity", "f_rest_0")),
        [],
        "1 f_rest properties fit no SH degree",
    ),
    "a list for a number": (
        broken(
            lambda text: text.replace("property float opacity", "property list uchar float opacity")
        ),
        [],
        "x.ply: not a",
    ),
    "more vertices than memory": (
        broken(lambda text: text.replace("element vertex 3", "element vertex 2147483648")),
        [],
        "not a readable 3DGS PLY",
    ),
    "more vertices than an integer": (
        lambda tmp: (tmp / "x.ply").write_text(
            "ply\nformat binary_little_endian 1.0\nelement vertex 9223372036854775808\nproperty float x\nend_header\n"
        ),
        [],
        "not a readable 3DGS PLY",
    ),
    "no vertices": (
        lambda tmp: (tmp / "x.ply").write_text(
            "ply\nformat ascii 1.0\nelement point 0\nproperty float x\nend_header\n"
        ),
        [],
        "it has no vertices",
    ),
    "infinite opacity": (
        infinite_opacity,
        [],
        "logit_opacities is NaN or infinite, first at Gaussian 5",
    ),
    "no cameras": (
        lambda tmp: (tmp / "transforms.json").unlink(),
        [],
        "transforms.json: no such file",
    ),
    "frames of another shape": (
        lambda tmp: (tmp / "transforms.json").write_text('{"frames": [1]}'),
        [],
        "frame 0 lacks file_path",
    ),
    "a path with a zero byte": (
        lambda tmp: (tmp / "transforms.json").write_text(
            json.dumps(
                {"frames": [{"file_path": "a\0b.png", "transform_matrix": np.eye(4).tolist()}]}
            )
        ),
        [],
        "frame 0 has a file_path that is no text or cannot be a path",
    ),
    "brackets without end": (
        lambda tmp: (tmp / "transforms.json").write_text("[" * 100_000),
        [],
        "transforms.json: not valid JSON",
    ),
    "a number of 5000 digits": (
        lambda tmp: (tmp / "transforms.json").write_text('{"w": ' + "9" * 5000 + "}"),
        [],
        "transforms.json: not valid JSON",
    ),
    "no intrinsics": (
        lambda tmp: (tmp / "transforms.json").write_text(
            json.dumps({"frames": [{"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}]})
        ),
        [],
        "frame 0 lacks fl_x; correct the intrinsics",
    ),
    "output not empty": (
        lambda tmp: ((tmp / "out").mkdir(), (tmp / "out/kept").touch()),
        [],
        "the output folder is not empty",
    ),
    "background": (
        lambda tmp: None,
        ["--background", "255", "255", "255"],
        "must be three numbers from 0 to 1",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input(tmp_path, capsys, case):
    """One line, exit code 2, nothing written."""
    change, arguments, message = BAD[case]
    foreign_ply(tmp_path / "x.ply", gaussians(0), "ascii")
    write_cameras(tmp_path / "transforms.json")
    change(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(SystemExit) as end:
        app.main(
            [
                "render",
                str(tmp_path / "x.ply"),
                "--cameras",
                str(tmp_path / "transforms.json"),
                "--out",
                str(tmp_path / "out"),
                *arguments,
            ]
        )
    assert end.value.code == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("mgs: ")
    assert message in lines[0]
    assert sorted(tmp_path.rglob("*")) == before


def test_a_ply_written_by_us_is_read_back(tmp_path):
    for degree in range(4):
        model = gaussians(degree)
        write_ply(tmp_path / "x.ply", model)
        for name, values in vars(read_ply(tmp_path / "x.ply")).items():
            np.testing.assert_array_equal(values, getattr(model, name))
