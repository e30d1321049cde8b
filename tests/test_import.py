"""Importing other people's data: cameras to 1e-9, the same pixels, distortion undone, bad input in
one line."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

sys.path.insert(0, str(Path(__file__).parent))
import synthetic

from mgs.camera import Camera, look_at, opengl_from_opencv
from mgs.cli.app import main
from mgs.colour import linear_from_srgb, srgb_from_linear
from mgs.data.check import check_dataset
from mgs.data.dataset import Dataset, Frame, load_dataset, write_transforms
from mgs.data.importers import import_source
from mgs.data.lens import undistorter
from mgs.data.sources import read_source
from mgs.files import read_json, write_json
from mgs.images import write_png
from mgs.prior.build import build_prior, load_prior
from mgs.prior.settings import PriorSettings


def _import(source: Path, out: Path, **options: Any) -> Dataset:
    out.mkdir(parents=True)
    return import_source(read_source(source), out, **options)


def _same_cameras(a: Dataset, b: Dataset) -> None:
    assert [frame.name for frame in a.frames] == [frame.name for frame in b.frames]
    for one, other in zip(a.frames, b.frames, strict=True):
        assert np.allclose(
            one.camera.world_to_camera, other.camera.world_to_camera, atol=1e-9, rtol=0
        )
        assert np.allclose(one.camera.K, other.camera.K, atol=1e-9, rtol=0)
        assert (one.camera.width, one.camera.height) == (other.camera.width, other.camera.height)


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    return synthetic.write_dataset(tmp_path / "data")


def test_a_dataset_imports_as_itself(dataset: Dataset, tmp_path: Path) -> None:
    copy = _import(dataset.root, tmp_path / "copy")
    _same_cameras(dataset, copy)
    for one, other in zip(dataset.frames, copy.frames, strict=True):
        assert np.array_equal(one.rgb(), other.rgb())
        assert np.array_equal(one.mask(), other.mask())
        assert np.array_equal(one.depth(), other.depth())
        assert one.timestamp == other.timestamp


@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_any_camera_and_any_pixels_survive_export_and_import(
    data: st.DataObject, tmp_path_factory
) -> None:
    root = tmp_path_factory.mktemp("any")
    number = st.floats(-1, 1)
    frames = []
    for k in range(data.draw(st.integers(1, 3))):
        width, height = data.draw(st.integers(1, 9)), data.draw(st.integers(1, 9))
        fx, fy = data.draw(st.floats(0.1, 1e4)), data.draw(st.floats(0.1, 1e4))
        K = np.array([[fx, 0, data.draw(number) * 10], [0, fy, data.draw(number) * 10], [0, 0, 1]])
        eye = np.array([data.draw(number), data.draw(number), data.draw(number)]) * 100 + [
            0,
            0,
            200,
        ]
        camera = Camera(K, width, height, look_at(eye, [data.draw(number), data.draw(number), 0]))
        pixels = np.random.default_rng(data.draw(st.integers(0, 99))).integers(
            0, 256, (height, width, 3)
        )
        path = root / f"images/kf_{k:04d}.png"
        write_png(path, pixels / 255, linear=False)
        frames.append(Frame(path.stem, camera, data.draw(st.floats(0, 1e6)) + k * 1e7, path))
    write_transforms(root, frames)
    copy = _import(root, root / "copy")
    _same_cameras(Dataset(root, tuple(frames)), copy)
    for one, other in zip(frames, copy.frames, strict=True):
        assert np.array_equal(one.rgb(), other.rgb())
        assert one.timestamp == other.timestamp


@pytest.mark.parametrize("binary", [True, False])
def test_colmap_export_and_import(dataset: Dataset, tmp_path: Path, binary: bool) -> None:
    synthetic.write_colmap(dataset, tmp_path / "colmap", binary)
    copy = _import(tmp_path / "colmap", tmp_path / "copy")
    _same_cameras(dataset, copy)
    assert all(
        np.array_equal(a.rgb(), b.rgb()) for a, b in zip(dataset.frames, copy.frames, strict=True)
    )


def test_a_prior_from_sparse_points(dataset: Dataset, tmp_path: Path) -> None:
    synthetic.write_colmap(dataset, tmp_path / "colmap", True)
    copy = _import(tmp_path / "colmap", tmp_path / "copy")
    prior, rock = build_prior(copy, PriorSettings(gaussians=800, backing=0))
    on_rock = np.sqrt((((prior.points - synthetic.CENTRE) / synthetic.AXES) ** 2).sum(1))
    assert np.median(np.abs(on_rock - 1)) < 0.02
    assert len(rock.rock_points) > 2000


def _soft(mask: np.ndarray, full: int) -> np.ndarray:
    """A mask as an alpha with a soft edge, 0 to `full`."""
    return np.round(cv2.GaussianBlur(mask.astype(np.float64), (5, 5), 1) * full).astype(
        np.uint8 if full == 255 else np.uint16
    )


def _with_alpha(dataset: Dataset, kind: str) -> list[np.ndarray]:
    """Give the images of a dataset a soft alpha and take its masks away; returns the pixels."""
    data, images = read_json(dataset.root / "transforms.json"), []
    for frame, record in zip(dataset.frames, data["frames"], strict=True):
        del record["mask_path"]
        full = 65535 if kind == "16 bit" else 255
        rgb = cv2.imread(str(frame.image_path)).astype(np.uint16)[..., ::-1] * (full // 255)
        alpha = _soft(frame.mask(), full) if kind != "binary" else frame.mask() * np.uint8(255)
        pixels = np.dstack([rgb.astype(alpha.dtype), alpha])
        cv2.imwrite(str(frame.image_path), pixels[..., [2, 1, 0, 3]])
        images.append(pixels)
    write_json(dataset.root / "transforms.json", data)
    return images


@pytest.mark.parametrize("kind", ["8 bit", "16 bit"])
def test_a_soft_alpha_becomes_images_of_the_rock_alone(
    dataset: Dataset, tmp_path: Path, kind: str
) -> None:
    images = _with_alpha(dataset, kind)
    copy = _import(dataset.root, tmp_path / "copy")
    assert not [problem for problem in check_dataset(copy).problems if "contradicts" in problem]
    for frame, pixels in zip(copy.frames, images, strict=True):
        straight = pixels / np.iinfo(pixels.dtype).max
        rgba, weight = frame.target()
        assert np.abs(rgba[..., 3] - straight[..., 3]).max() <= 0.5 / 255 + 1e-6
        assert (
            np.abs(rgba[..., :3] - linear_from_srgb(straight[..., :3]) * straight[..., 3:]).max()
            < 6e-3
        )
        assert weight.all()
        assert np.array_equal(frame.mask(), straight[..., 3] >= 0.5)
        assert (
            np.abs(frame.rgb() - linear_from_srgb(straight[..., :3])).max() < 5e-3
        )  # as it was, whatever alpha says
    again = _import(copy.root, tmp_path / "again")
    for one, other in zip(copy.frames, again.frames, strict=True):
        assert one.rock_path is not None
        assert other.rock_path is not None
        assert one.rock_path.read_bytes() == other.rock_path.read_bytes()


@pytest.mark.parametrize("case", ["binary", "masks", "mesh", "mask files"])
def test_without_a_soft_alpha_that_gives_the_mask_there_are_no_images_of_the_rock(
    dataset: Dataset, tmp_path: Path, case: str
) -> None:
    _with_alpha(dataset, "binary" if case == "binary" else "8 bit")
    options = {
        "masks": {"masks": dataset.root / "masks"},
        "mesh": {"mesh": dataset.root / "rock.glb"},
    }.get(case, {})
    if case == "mask files":
        data = read_json(dataset.root / "transforms.json")
        for frame, record in zip(dataset.frames, data["frames"], strict=True):
            record["mask_path"] = f"masks/{frame.name}.png"
        write_json(dataset.root / "transforms.json", data)
    copy = _import(dataset.root, tmp_path / "copy", **options)
    for frame, original in zip(copy.frames, dataset.frames, strict=True):
        assert frame.rock_path is None
        assert case == "mesh" or np.array_equal(frame.mask(), original.mask())
    assert not (copy.root / "rock").exists()


def test_a_soft_alpha_is_undistorted_without_a_fringe(dataset: Dataset, tmp_path: Path) -> None:
    """A grey rock over transparent black: resampled straight, its rim would turn dark;
    premultiplied, it stays grey."""
    data = read_json(dataset.root / "transforms.json") | dict(
        zip(("k1", "k2"), DISTORTION, strict=False)
    )
    for frame, record in zip(dataset.frames, data["frames"], strict=True):
        del record["mask_path"]
        alpha = _soft(frame.mask(), 255)
        grey = np.where(alpha > 0, np.uint8(128), np.uint8(0))
        cv2.imwrite(str(frame.image_path), np.dstack([grey, grey, grey, alpha]))
    write_json(dataset.root / "transforms.json", data)
    copy = _import(dataset.root, tmp_path / "copy")
    assert not [problem for problem in check_dataset(copy).problems if "contradicts" in problem]
    for frame in copy.frames:
        rgba = frame.target()[0]
        rim = (rgba[..., 3] > 0.02) & (rgba[..., 3] < 0.98)
        assert rim.sum() > 50
        straight = srgb_from_linear(rgba[..., :3] / np.maximum(rgba[..., 3:], 1e-9))[rim] * 255
        assert np.abs(straight - 128).max() < 1


def test_nerf_synthetic_with_alpha(dataset: Dataset, tmp_path: Path) -> None:
    root = tmp_path / "lego"
    (root / "train").mkdir(parents=True)
    records = []
    camera = dataset.frames[0].camera
    for k, frame in enumerate(dataset.frames):
        rgb = np.asarray(Image.open(frame.image_path))
        alpha = frame.mask().astype(np.uint8) * 255
        Image.fromarray(np.dstack([rgb, alpha])).save(root / f"train/r_{k}.png")
        pose = opengl_from_opencv(frame.camera.world_to_camera).tolist()
        records.append({"file_path": f"./train/r_{k}", "transform_matrix": pose, "rotation": 0.1})
    angle = 2 * np.arctan(camera.width / 2 / camera.K[0, 0])
    write_json(root / "transforms_train.json", {"camera_angle_x": angle, "frames": records})
    copy = _import(root, tmp_path / "copy")
    assert read_source(root).kind == "NeRF-synthetic"
    for one, other in zip(dataset.frames, copy.frames, strict=True):
        assert np.allclose(one.camera.world_to_camera, other.camera.world_to_camera, atol=1e-9)
        assert np.allclose(one.camera.K, other.camera.K, atol=1e-9)
        assert np.array_equal(one.rgb(), other.rgb())
        assert np.array_equal(one.mask(), other.mask())


DISTORTION = np.array([-0.15, 0.04, 0.002, -0.003, 0.0])


def _distorted(camera: Camera) -> np.ndarray:
    """What a lens with DISTORTION sees of a pattern in the plane z = 1 of the camera: albedo at the
    undistorted rays."""
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    shift = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    rays = cv2.undistortPoints(
        np.stack([u, v], -1).reshape(-1, 1, 2), camera.K - shift, DISTORTION
    ).reshape(*u.shape, 2)
    return synthetic.albedo(np.dstack([rays, np.ones_like(u)]))


def test_distortion_is_undone() -> None:
    camera = Camera(np.array([[110.0, 0, 83], [0, 108.0, 57], [0, 0, 1]]), 160, 120, np.eye(4))
    straight, undo = undistorter(camera, DISTORTION)
    pixels = undo(_distorted(camera).astype(np.float32), True)
    rays = straight.unproject(np.ones((120, 160)))
    error = np.abs(pixels - synthetic.albedo(rays))
    assert not np.allclose(straight.K, camera.K, atol=0.1)
    assert error[2:-2, 2:-2].max() < 5e-3
    # Half a pixel of shift, the mistake that mixes the two pixel-centre conventions, would show.
    shifted = np.abs(pixels - synthetic.albedo(rays + np.array([0.5 / 110, 0.5 / 108, 0])))
    assert np.median(shifted) > 5 * np.median(error)
    same, keep = undistorter(camera, np.zeros(5))
    assert same is camera
    assert keep(pixels, True) is pixels


def test_nerfstudio_with_distortion_in_the_frames(tmp_path: Path) -> None:
    keys = dict(zip(("k1", "k2", "p1", "p2"), DISTORTION, strict=False))
    source = synthetic.write_dataset(tmp_path / "src").frames[0]
    write_json(tmp_path / "src/transforms.json", read_json(tmp_path / "src/transforms.json") | keys)
    copy = _import(tmp_path / "src", tmp_path / "copy")
    expected, _ = undistorter(source.camera, DISTORTION)
    assert np.allclose(copy.frames[0].camera.K, expected.K)
    # Depth is resampled to the nearest pixel, never blended, and the mask stays a mask.
    assert np.isin(copy.frames[0].depth(), source.depth()).all()
    assert 0.3 < copy.frames[0].mask().sum() / source.mask().sum() < 3


def test_depth_in_16_bit_png(dataset: Dataset, tmp_path: Path) -> None:
    data = read_json(dataset.root / "transforms.json")
    for frame, record in zip(dataset.frames, data["frames"], strict=True):
        path = dataset.root / f"depth/{frame.name}.png"
        cv2.imwrite(str(path), np.round(frame.depth() * 1000).astype(np.uint16))
        record["depth_file_path"] = f"depth/{frame.name}.png"
    write_json(dataset.root / "transforms.json", data)
    copy = _import(dataset.root, tmp_path / "copy")
    for one, other in zip(dataset.frames, copy.frames, strict=True):
        assert np.abs(one.depth() - other.depth()).max() < 5.1e-4


def test_images_of_16_bits(dataset: Dataset, tmp_path: Path) -> None:
    data = read_json(dataset.root / "transforms.json")
    written = np.random.default_rng(0).integers(0, 65536, (48, 64, 4), np.uint16)
    for frame, record in zip(dataset.frames, data["frames"], strict=True):
        del record["mask_path"]
        cv2.imwrite(str(frame.image_path), written[..., [2, 1, 0, 3]])
    write_json(dataset.root / "transforms.json", data)
    frame = _import(dataset.root, tmp_path / "copy").frames[0]
    assert (
        np.abs(cv2.imread(str(frame.image_path))[..., ::-1] - written[..., :3] / 257).max() <= 0.5
    )
    assert np.array_equal(frame.mask(), written[..., 3] >= 32768)


@pytest.mark.parametrize(
    "kind", ["plain", "alpha", "grey", "palette", "16 bit", "jpeg", "distorted"]
)
def test_only_an_image_that_stays_as_it_is_is_copied(
    dataset: Dataset, tmp_path: Path, kind: str
) -> None:
    path = dataset.frames[0].image_path
    with Image.open(path) as image:
        pixels = np.asarray(image)
    kinds = {"alpha": "RGBA", "grey": "L", "palette": "P"}
    if kind in kinds:
        Image.fromarray(pixels).convert(kinds[kind]).save(path)
    elif kind == "jpeg":
        Image.fromarray(pixels).save(path, format="JPEG")
    elif kind == "16 bit":
        cv2.imwrite(str(path), pixels.astype(np.uint16)[..., ::-1] * 257)
    elif kind == "distorted":
        write_json(
            dataset.root / "transforms.json",
            read_json(dataset.root / "transforms.json") | {"k1": -0.1},
        )
    else:
        Image.fromarray(pixels).save(path, compress_level=9)  # other bytes than ours would be
    copy = _import(dataset.root, tmp_path / "copy").frames[0]
    assert (copy.image_path.read_bytes() == path.read_bytes()) == (kind == "plain")
    assert np.array_equal(copy.rgb(), replace(copy, image_path=path).rgb()) == (kind != "distorted")


def test_missing_images_are_skipped_and_counted(
    dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for frame in dataset.frames[:3]:
        frame.image_path.unlink()
    with pytest.raises(SystemExit) as exit_:
        main(["import", str(dataset.root), "--out", str(tmp_path / "copy")])
    output = capsys.readouterr()
    assert exit_.value.code == 0
    assert len(load_dataset(tmp_path / "copy")) == 5
    assert "3 of 8 listed images do not exist" in " ".join(output.err.split())
    assert output.err.count("mgs:") == 1
    assert "5 frames" in output.out


def test_images_are_set_apart_as_test_views(
    dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["import", str(dataset.root), "--out", str(tmp_path / "out"), "--test-every", "3"]
    for part in (
        "transforms.json",
        "test/transforms.json",
    ):  # the second time it had been interrupted before its end
        with pytest.raises(SystemExit) as stop:
            main(arguments)
        assert stop.value.code == 0, capsys.readouterr().err
        assert "images, which are no candidates; wrote" in capsys.readouterr().out
        assert (tmp_path / "out" / part).is_file()
        if part == "transforms.json":
            (tmp_path / "out" / part).unlink()
    made = load_dataset(tmp_path / "out")
    tests = made.test_views()
    assert tests is not None
    names = [frame.name for frame in dataset.frames]
    assert [frame.name for frame in tests.frames] == names[::3]
    assert [frame.name for frame in made.frames] == [name for i, name in enumerate(names) if i % 3]
    assert tests.up == made.up
    whole = {frame.name: frame for frame in dataset.frames}
    for frame in [*made.frames, *tests.frames]:
        assert np.array_equal(frame.rgb(), whole[frame.name].rgb())
        assert np.allclose(frame.camera.world_to_camera, whole[frame.name].camera.world_to_camera)
    few = [frame.image_path for frame in dataset.frames][1:]
    for path in few:
        path.unlink()
    with pytest.raises(SystemExit) as stop:
        main([*arguments[:3], str(tmp_path / "none"), *arguments[4:]])
    assert stop.value.code == 2
    assert "--test-every 3 of 1 images leaves none to choose from" in capsys.readouterr().err


def test_a_named_cloud_that_is_not_there_is_said(
    dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = dataset.root / "transforms.json"
    for cloud, said in (("sparse_pc.ply", 1), (None, 0)):
        write_json(path, read_json(path) | {"ply_file_path": cloud})
        with pytest.raises(SystemExit) as exit_:
            main(["import", str(dataset.root), "--out", str(tmp_path / str(said))])
        output = capsys.readouterr()
        assert exit_.value.code == 0
        text = "".join(output.err.split())  # a long path is broken into lines
        assert (f"{dataset.root / 'sparse_pc.ply'},donotexist;importedwithoutthem" in text) == bool(
            said
        ), text
        assert " 0 points" in " ".join(output.out.split())
        assert not (tmp_path / str(said) / "sparse.ply").exists()


def test_masks_by_projecting_a_mesh_or_from_files(dataset: Dataset, tmp_path: Path) -> None:
    data = read_json(dataset.root / "transforms.json")
    for record in data["frames"]:
        del record["mask_path"]
    write_json(dataset.root / "transforms.json", data)
    options = ["import", str(dataset.root), "--out"]
    with pytest.raises(SystemExit):
        main([*options, str(tmp_path / "mesh"), "--mesh", str(dataset.root / "rock.glb")])
    with pytest.raises(SystemExit):
        main([*options, str(tmp_path / "files"), "--masks", str(dataset.root / "masks")])
    projected, given, none = (load_dataset(tmp_path / name) for name in ("mesh", "files", "data"))
    for a, b, original, plain in zip(
        projected.frames, given.frames, dataset.frames, none.frames, strict=True
    ):
        true = original.mask()
        assert np.array_equal(b.mask(), true)
        assert plain.mask_path is None
        # The mesh reaches below the ground, where the image shows ground.
        assert (a.mask() & true).sum() > 0.97 * true.sum()
        assert (a.mask() & ~true).sum() < 0.15 * true.sum()


def test_masks_may_be_named_as_colmap_names_them(tmp_path: Path) -> None:
    """0001.jpg.png is the mask of 0001.jpg."""
    root = synthetic.write_dataset(tmp_path / "data").root
    true = [frame.mask() for frame in load_dataset(root).frames]
    for path in list((root / "masks").iterdir()):
        path.rename(path.with_name(f"{path.name}.png"))
    imported = import_source(read_source(root), tmp_path / "out", masks=root / "masks")
    assert all(
        np.array_equal(frame.mask(), mask)
        for frame, mask in zip(imported.frames, true, strict=True)
    )


def test_a_prior_of_a_given_mesh(dataset: Dataset, tmp_path: Path) -> None:
    options = [
        "prior",
        str(dataset.root),
        "--mesh",
        str(dataset.root / "rock.glb"),
        "--gaussians",
        "300",
        "--backing",
        "0",
    ]
    with pytest.raises(SystemExit) as exit_:
        main([*options, "--out", str(tmp_path / "prior")])
    assert exit_.value.code == 0
    prior = load_prior(tmp_path / "prior")
    on_rock = np.sqrt((((prior.points - synthetic.CENTRE) / synthetic.AXES) ** 2).sum(1))
    assert len(prior.points) == 300
    assert np.abs(on_rock - 1).max() < 0.01
    assert (tmp_path / "prior/prior.png").is_file()


def _edit(root: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    synthetic.write_dataset(root)
    data = read_json(root / "transforms.json")
    change(data)
    (root / "transforms.json").write_text(json.dumps(data))
    return root


def _colmap(root: Path, damage: Callable[[Path], None]) -> Path:
    synthetic.write_colmap(synthetic.write_dataset(root / "data"), root / "colmap", True)
    damage(root / "colmap/sparse/0")
    return root / "colmap"


def _no_images(root: Path) -> Path:
    dataset = synthetic.write_dataset(root)
    for frame in dataset.frames:
        frame.image_path.unlink()
    return root


def _truncated_image(root: Path) -> Path:
    path = synthetic.write_dataset(root).frames[0].image_path
    path.write_bytes(path.read_bytes()[:100])
    return root


def _corrupt_jpeg(root: Path) -> Path:
    """The header is whole, the pixels are cut off."""
    dataset = synthetic.write_dataset(root)
    jpeg = root / "images/kf_0000.jpg"
    Image.open(dataset.frames[0].image_path).save(jpeg, quality=95)
    jpeg.write_bytes(jpeg.read_bytes()[:-500])
    records = read_json(root / "transforms.json")
    records["frames"][0]["file_path"] = "images/kf_0000.jpg"
    (root / "transforms.json").write_text(json.dumps(records))
    return root


def _mask(root: Path, spoil: Callable[[Path], object]) -> Path:
    """The masks of all frames are in order but one."""
    synthetic.write_dataset(root)
    spoil(root / "masks/kf_0000.png")
    return root


def _cloud(vertices: str) -> Callable[[Path], Path]:
    """A transforms.json that names a PLY file of these points."""

    def make(root: Path) -> Path:
        _edit(root, lambda data: data.update(ply_file_path="points.ply"))
        columns = "".join(f"property float {name}\n" for name in "xyz")
        count = len(vertices.splitlines())
        (root / "points.ply").write_text(
            f"ply\nformat ascii 1.0\nelement vertex {count}\n{columns}end_header\n{vertices}"
        )
        return root

    return make


def _empty(root: Path) -> Path:
    root.mkdir()
    return root


def _first(key: str, value: Any) -> Callable[[dict[str, Any]], None]:
    return lambda data: data["frames"][0].update({key: value})


def _truncate(model: Path) -> None:
    path = model / "images.bin"
    path.write_bytes(path.read_bytes()[:2000])


BAD: dict[str, tuple[Callable[[Path], Path], list[str], str]] = {
    "missing": (lambda root: root / "nowhere", [], "no such file or folder"),
    "empty folder": (_empty, [], "holds no transforms.json"),
    "no frames": (
        lambda root: _edit(root, lambda data: data.update(frames=[])),
        [],
        "lists no frames",
    ),
    "no intrinsics": (
        lambda root: _edit(root, lambda data: data.pop("fl_x")),
        [],
        "no usable intrinsics",
    ),
    "fisheye": (
        lambda root: _edit(root, lambda data: data.update(camera_model="OPENCV_FISHEYE")),
        [],
        "not supported",
    ),
    "k4": (lambda root: _edit(root, lambda data: data.update(k4=0.1)), [], "has k4"),
    "nan distortion": (
        lambda root: _edit(root, lambda data: data.update(k1=float("nan"))),
        [],
        "not finite",
    ),
    "nan pose": (
        lambda root: _edit(root, _first("transform_matrix", [[float("nan")] * 4] * 4)),
        [],
        "not finite",
    ),
    "singular pose": (
        lambda root: _edit(root, _first("transform_matrix", [[0.0] * 4] * 4)),
        [],
        "correct the pose",
    ),
    "short pose": (
        lambda root: _edit(root, _first("transform_matrix", [[1.0] * 4] * 2)),
        [],
        "no 4x4 matrix",
    ),
    "duplicate frames": (
        lambda root: _edit(root, _first("file_path", "images/kf_0001.png")),
        [],
        "more than once",
    ),
    "wrong size": (
        lambda root: _edit(root, lambda data: data.update(w=100)),
        [],
        "is 64x48, but its camera is 100x48",
    ),
    "a folder for depth": (
        lambda root: _edit(root, _first("depth_file_path", "depth")),
        [],
        "depth: cannot be read (Is a dir",
    ),
    "no depth file": (
        lambda root: _edit(root, _first("depth_file_path", "depth/none.exr")),
        [],
        "no such EXR",
    ),
    "image path a number": (lambda root: _edit(root, _first("file_path", 5)), [], "frame 0"),
    "image path empty": (lambda root: _edit(root, _first("file_path", "")), [], "frame 0"),
    "no rock file": (
        lambda root: _edit(root, _first("rock_file_path", "rock/none.png")),
        [],
        "no such image",
    ),
    "mask path a list": (lambda root: _edit(root, _first("mask_path", ["a"])), [], "frame 0"),
    "nan time": (lambda root: _edit(root, _first("timestamp", float("nan"))), [], "frame 0"),
    "time of words": (lambda root: _edit(root, _first("timestamp", "noon")), [], "frame 0"),
    "infinite width": (
        lambda root: _edit(root, lambda data: data.update(w=float("inf"))),
        [],
        "frame 0",
    ),
    "unit of words": (
        lambda root: _edit(root, lambda data: data.update(depth_unit_scale_factor="mm")),
        [],
        "depth_unit",
    ),
    "no images": (_no_images, [], "none of the 8 images"),
    "truncated image": (_truncated_image, [], "not a readable image"),
    "corrupt JPEG": (_corrupt_jpeg, [], "kf_0000.jpg: not a readable image"),
    "up of words": (
        lambda root: _edit(root, lambda data: data.update(up="skyward")),
        [],
        "up: must be three finite numbers",
    ),
    "angle of view of 0": (
        lambda root: _edit(root, lambda data: (data.pop("fl_x"), data.update(camera_angle_x=0))),
        [],
        "no usable intrinsics",
    ),
    "no points in the cloud": (
        _cloud(""),
        [],
        "points.ply: has values that are not finite, or fewer than two different",
    ),
    "all points in one place": (
        _cloud("1 2 3\n" * 500),
        [],
        "points.ply: has values that are not finite, or fewer than two",
    ),
    "no model in sparse": (
        lambda root: _colmap(root, shutil.rmtree),
        [],
        "COLMAP model (cameras, images and points3D",
    ),
    "truncated colmap": (lambda root: _colmap(root, _truncate), [], "not a readable COLMAP model"),
    "no mask": (
        lambda root: synthetic.write_dataset(root).root,
        ["--masks", "."],
        "no mask for image",
    ),
    "one mask missing": (
        lambda root: _mask(root, Path.unlink),
        ["--masks", "{source}/masks"],
        "no mask for image kf_0000.png",
    ),
    "one mask of another size": (
        lambda root: _mask(root, lambda path: write_png(path, np.ones((24, 32), bool))),
        ["--masks", "{source}/masks"],
        "kf_0000.png: is 32x24, but its camera is 64x48",
    ),
    "no mask folder": (
        lambda root: synthetic.write_dataset(root).root,
        ["--masks", "none"],
        "none: no such folder",
    ),
    "no mesh": (
        lambda root: synthetic.write_dataset(root).root,
        ["--mesh", "none.glb"],
        "no such mesh",
    ),
    "both masks": (
        lambda root: synthetic.write_dataset(root).root,
        ["--mesh", "a.glb", "--masks", "b"],
        "give one of them",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_line_and_leaves_nothing(
    case: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    make, options, message = BAD[case]
    source = make(tmp_path / "src")
    with pytest.raises(SystemExit) as exit_:
        main(
            [
                "import",
                str(source),
                "--out",
                str(tmp_path / "out"),
                *(option.format(source=source) for option in options),
            ]
        )
    error = capfd.readouterr().err.strip()
    assert exit_.value.code == 2
    assert message in error
    assert "\n" not in error
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", ["import", "prior"])
def test_a_mesh_is_said_to_be_turned_only_where_it_could_be_read(
    dataset: Dataset, tmp_path: Path, command: str, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "broken.glb").write_text("this is no mesh")
    options = ["--gaussians", "300"] if command == "prior" else []
    said = {}
    for mesh in (tmp_path / "broken.glb", dataset.root / "rock.glb"):
        with pytest.raises(SystemExit):
            main(
                [
                    command,
                    str(dataset.root),
                    "--out",
                    str(tmp_path / "out"),
                    "--mesh",
                    str(mesh),
                    *options,
                ]
            )
        said[mesh.stem] = "turned from +Y up" in capfd.readouterr().out.replace("\n", " ")
    assert said == {"broken": False, "rock": True}


def test_an_empty_mask_in_every_frame_is_one_line(dataset: Dataset) -> None:
    from mgs.errors import InputError

    empty = dataset.root / "masks/empty.png"
    write_png(empty, np.zeros((48, 64), bool))
    blind = Dataset(
        dataset.root, tuple(replace(frame, mask_path=empty) for frame in dataset.frames)
    )
    with pytest.raises(InputError, match="masks are black in every frame"):
        build_prior(blind, PriorSettings(gaussians=100, backing=0))
