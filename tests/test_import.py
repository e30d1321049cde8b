"""Importing other people's data: cameras to 1e-9, the same pixels, distortion undone, bad input in one line."""

from __future__ import annotations

import json
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
from mgs.data.dataset import Dataset, Frame, load_dataset, write_transforms
from mgs.data.importers import import_source, read_source, undistorter
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
        assert np.allclose(one.camera.world_to_camera, other.camera.world_to_camera, atol=1e-9, rtol=0)
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
def test_any_camera_and_any_pixels_survive_export_and_import(data: st.DataObject, tmp_path_factory) -> None:
    root = tmp_path_factory.mktemp("any")
    number = st.floats(-1, 1)
    frames = []
    for k in range(data.draw(st.integers(1, 3))):
        width, height = data.draw(st.integers(1, 9)), data.draw(st.integers(1, 9))
        fx, fy = data.draw(st.floats(0.1, 1e4)), data.draw(st.floats(0.1, 1e4))
        K = np.array([[fx, 0, data.draw(number) * 10], [0, fy, data.draw(number) * 10], [0, 0, 1]])
        eye = np.array([data.draw(number), data.draw(number), data.draw(number)]) * 100 + [0, 0, 200]
        camera = Camera(K, width, height, look_at(eye, [data.draw(number), data.draw(number), 0]))
        pixels = np.random.default_rng(data.draw(st.integers(0, 99))).integers(0, 256, (height, width, 3))
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
    assert all(np.array_equal(a.rgb(), b.rgb()) for a, b in zip(dataset.frames, copy.frames, strict=True))


def test_a_prior_from_sparse_points(dataset: Dataset, tmp_path: Path) -> None:
    synthetic.write_colmap(dataset, tmp_path / "colmap", True)
    copy = _import(tmp_path / "colmap", tmp_path / "copy")
    prior, rock = build_prior(copy, PriorSettings(gaussians=800))
    on_rock = np.sqrt((((prior.points - synthetic.CENTRE) / synthetic.AXES) ** 2).sum(1))
    assert np.median(np.abs(on_rock - 1)) < 0.02
    assert len(rock.rock_points) > 2000


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
    """What a lens with DISTORTION sees of a pattern in the plane z = 1 of the camera: albedo at the undistorted rays."""
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    shift = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    rays = cv2.undistortPoints(np.stack([u, v], -1).reshape(-1, 1, 2), camera.K - shift, DISTORTION).reshape(*u.shape, 2)
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
    assert np.abs(cv2.imread(str(frame.image_path))[..., ::-1] - written[..., :3] / 257).max() <= 0.5
    assert np.array_equal(frame.mask(), written[..., 3] >= 32768)


@pytest.mark.parametrize("kind", ["plain", "alpha", "grey", "palette", "16 bit", "jpeg", "distorted"])
def test_only_an_image_that_stays_as_it_is_is_copied(dataset: Dataset, tmp_path: Path, kind: str) -> None:
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
        write_json(dataset.root / "transforms.json", read_json(dataset.root / "transforms.json") | {"k1": -0.1})
    else:
        Image.fromarray(pixels).save(path, compress_level=9)  # other bytes than ours would be
    copy = _import(dataset.root, tmp_path / "copy").frames[0]
    assert (copy.image_path.read_bytes() == path.read_bytes()) == (kind == "plain")
    assert np.array_equal(copy.rgb(), replace(copy, image_path=path).rgb()) == (kind != "distorted")


def test_missing_images_are_skipped_and_counted(dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
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
    for a, b, original, plain in zip(projected.frames, given.frames, dataset.frames, none.frames, strict=True):
        true = original.mask()
        assert np.array_equal(b.mask(), true)
        assert plain.mask_path is None
        # The mesh reaches below the ground, where the image shows ground.
        assert (a.mask() & true).sum() > 0.97 * true.sum()
        assert (a.mask() & ~true).sum() < 0.15 * true.sum()


def test_a_prior_of_a_given_mesh(dataset: Dataset, tmp_path: Path) -> None:
    options = ["prior", str(dataset.root), "--mesh", str(dataset.root / "rock.glb"), "--gaussians", "300"]
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
    "no frames": (lambda root: _edit(root, lambda data: data.update(frames=[])), [], "lists no frames"),
    "no intrinsics": (lambda root: _edit(root, lambda data: data.pop("fl_x")), [], "no usable intrinsics"),
    "fisheye": (lambda root: _edit(root, lambda data: data.update(camera_model="OPENCV_FISHEYE")), [], "not supported"),
    "k4": (lambda root: _edit(root, lambda data: data.update(k4=0.1)), [], "has k4"),
    "nan distortion": (lambda root: _edit(root, lambda data: data.update(k1=float("nan"))), [], "not finite"),
    "nan pose": (lambda root: _edit(root, _first("transform_matrix", [[float("nan")] * 4] * 4)), [], "not finite"),
    "singular pose": (lambda root: _edit(root, _first("transform_matrix", [[0.0] * 4] * 4)), [], "correct the pose"),
    "short pose": (lambda root: _edit(root, _first("transform_matrix", [[1.0] * 4] * 2)), [], "no 4x4 matrix"),
    "duplicate frames": (lambda root: _edit(root, _first("file_path", "images/kf_0001.png")), [], "more than once"),
    "wrong size": (lambda root: _edit(root, lambda data: data.update(w=100)), [], "is 64x48, but its camera is 100x48"),
    "a folder for depth": (lambda root: _edit(root, _first("depth_file_path", "depth")), [], "depth: cannot be read (Is a dir"),
    "no depth file": (lambda root: _edit(root, _first("depth_file_path", "depth/none.exr")), [], "no such EXR"),
    "image path a number": (lambda root: _edit(root, _first("file_path", 5)), [], "frame 0"),
    "image path empty": (lambda root: _edit(root, _first("file_path", "")), [], "frame 0"),
    "mask path a list": (lambda root: _edit(root, _first("mask_path", ["a"])), [], "frame 0"),
    "nan time": (lambda root: _edit(root, _first("timestamp", float("nan"))), [], "frame 0"),
    "time of words": (lambda root: _edit(root, _first("timestamp", "noon")), [], "frame 0"),
    "infinite width": (lambda root: _edit(root, lambda data: data.update(w=float("inf"))), [], "frame 0"),
    "unit of words": (lambda root: _edit(root, lambda data: data.update(depth_unit_scale_factor="mm")), [], "depth_unit"),
    "no images": (_no_images, [], "none of the 8 images"),
    "truncated image": (_truncated_image, [], "not a readable image"),
    "truncated colmap": (lambda root: _colmap(root, _truncate), [], "not a readable COLMAP model"),
    "no mask": (lambda root: synthetic.write_dataset(root).root, ["--masks", "images/none"], "no mask for image"),
    "no mesh": (lambda root: synthetic.write_dataset(root).root, ["--mesh", "none.glb"], "no such mesh"),
    "both masks": (lambda root: synthetic.write_dataset(root).root, ["--mesh", "a.glb", "--masks", "b"], "give one of them"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_line_and_leaves_nothing(case: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    make, options, message = BAD[case]
    source = make(tmp_path / "src")
    with pytest.raises(SystemExit) as exit_:
        main(["import", str(source), "--out", str(tmp_path / "out"), *options])
    error = capfd.readouterr().err.strip()
    assert exit_.value.code == 2
    assert message in error
    assert "\n" not in error
    assert not (tmp_path / "out").exists()


def test_an_empty_mask_in_every_frame_is_one_line(dataset: Dataset) -> None:
    from mgs.errors import InputError

    empty = dataset.root / "masks/empty.png"
    write_png(empty, np.zeros((48, 64), bool))
    blind = Dataset(dataset.root, tuple(replace(frame, mask_path=empty) for frame in dataset.frames))
    with pytest.raises(InputError, match="rock mask"):
        build_prior(blind, PriorSettings(gaussians=100))
