"""Imports: cameras to 1e-9, the same pixels, distortion undone; interrupted and given again."""

import shutil
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import synthetic
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from program import command, exit_code, output, python, said, stop_at
from refusals import fails, listing, refused
from scipy.ndimage import gaussian_filter

from mgs import Frame
from mgs.camera import Camera, look_at, opengl_from_opencv
from mgs.colour import linear_from_srgb, srgb_from_linear
from mgs.data import importers
from mgs.data.check import check_dataset
from mgs.data.clouds import SparseCloud, read_cloud, write_cloud
from mgs.data.dataset import Dataset, load_dataset, write_transforms
from mgs.data.importers import import_source
from mgs.data.lens import Lens, fitted, undistorter
from mgs.data.sources import read_source
from mgs.files import write_json
from mgs.images import read_depth, read_mask, write_exr, write_png

DISTORTION = np.array([-0.15, 0.04, 0.002, -0.003, 0.0])
LENS = dict(zip(("k1", "k2", "p1", "p2"), DISTORTION.tolist(), strict=False))


def _import(source: Path, out: Path, **options: Any) -> Dataset:
    return import_source(read_source(source), out, **options)


def without_masks(data: dict[str, Any]) -> None:
    for record in data["frames"]:
        del record["mask_path"]


def same_cameras(a: Dataset, b: Dataset) -> None:
    assert [frame.name for frame in a.frames] == [frame.name for frame in b.frames]
    for one, other in zip(a.frames, b.frames, strict=True):
        poses = one.camera.world_to_camera, other.camera.world_to_camera
        assert np.allclose(*poses, atol=1e-9, rtol=0)
        assert np.allclose(one.camera.K, other.camera.K, atol=1e-9, rtol=0)
        assert (one.camera.width, one.camera.height) == (other.camera.width, other.camera.height)
        assert np.array_equal(one.rgb(), other.rgb())


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    return synthetic.write_dataset(tmp_path / "data")


def test_a_dataset_imports_as_itself(dataset, tmp_path):
    points = synthetic.rock_mesh().vertices
    write_cloud(dataset.root / "cloud.ply", SparseCloud(points))
    synthetic.edit(dataset.root, lambda data: data.update(ply_file_path="cloud.ply"))
    copy = _import(dataset.root, tmp_path / "copy")
    same_cameras(dataset, copy)
    assert np.allclose(read_cloud(copy.root / "sparse.ply").points, points, atol=1e-6)
    for one, other in zip(dataset.frames, copy.frames, strict=True):
        assert np.array_equal(one.mask(), other.mask())
        assert np.array_equal(one.depth(), other.depth())
        assert one.timestamp == other.timestamp


@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_any_camera_and_any_pixels_survive(data, tmp_path_factory):
    root = tmp_path_factory.mktemp("any")
    number = st.floats(-1, 1)
    frames = []
    for k in range(data.draw(st.integers(1, 3))):
        width, height = data.draw(st.integers(1, 9)), data.draw(st.integers(1, 9))
        fx, fy = data.draw(st.floats(0.1, 1e4)), data.draw(st.floats(0.1, 1e4))
        K = np.array([[fx, 0, data.draw(number) * 10], [0, fy, data.draw(number) * 10], [0, 0, 1]])
        eye = np.array([data.draw(number) for _ in range(3)]) * 100 + [0, 0, 200]
        camera = Camera(K, width, height, look_at(eye, [data.draw(number), data.draw(number), 0]))
        rng = np.random.default_rng(data.draw(st.integers(0, 99)))
        path = root / f"images/kf_{k:04d}.png"
        write_png(path, rng.integers(0, 256, (height, width, 3)) / 255, linear=False)
        frames.append(Frame(path.stem, camera, data.draw(st.floats(0, 1e6)) + k * 1e7, path))
    write_transforms(root, frames)
    copy = _import(root, root / "copy")
    same_cameras(Dataset(root, tuple(frames)), copy)
    assert [frame.timestamp for frame in frames] == [frame.timestamp for frame in copy.frames]


@pytest.mark.parametrize("binary", [True, False])
def test_colmap_gives_cameras_and_points(dataset, tmp_path, binary):
    synthetic.write_colmap(dataset, tmp_path / "colmap", binary, 2000)
    copy = _import(tmp_path / "colmap", tmp_path / "copy")
    same_cameras(dataset, copy)
    points = read_cloud(copy.root / "sparse.ply").points
    on_rock = np.abs(synthetic.level(points)) < 1e-6
    assert on_rock.sum() > 700
    assert np.abs(points[~on_rock, 2]).max() < 1e-6


def test_pictures_that_colmap_does_not_place_are_counted(dataset, tmp_path, capsys):
    synthetic.write_colmap(replace(dataset, frames=dataset.frames[:-2]), tmp_path / "c", True)
    for image in list((tmp_path / "c/images").iterdir()):
        (image.parent / f"{image.stem}_mask.png").write_bytes(image.read_bytes())
    said = output(capsys, "import", tmp_path / "c", "--out", tmp_path / "copy")
    total = len(dataset)  # and masks are not counted, which may lie beside
    assert f"{total - 2} frames of {total} images; left out 2 that the model does not place" in said


def test_colmap_gives_the_distortion_of_its_lens(dataset, tmp_path):
    import pycolmap

    synthetic.write_colmap(dataset, tmp_path, True)
    model = pycolmap.Reconstruction(tmp_path / "sparse/0")
    lens = model.cameras[1]
    lens.model, lens.params = pycolmap.CameraModelId.OPENCV, [*lens.params, *DISTORTION[:4]]
    model.write_binary(tmp_path / "sparse/0")
    for shot in read_source(tmp_path).shots:
        assert shot.lens.model == "FULL_OPENCV"
        assert np.allclose(shot.lens.parameters[4:], [*DISTORTION, 0, 0, 0])


def _soft(mask: np.ndarray, full: int) -> np.ndarray:
    """A mask as an alpha with a soft edge, 0 to `full`."""
    blurred = np.round(cv2.GaussianBlur(mask.astype(np.float64), (5, 5), 1) * full)
    return blurred.astype(np.uint8 if full == 255 else np.uint16)


def _with_alpha(dataset: Dataset, kind: str) -> list[np.ndarray]:
    """Give the images of a dataset an alpha and take its masks away; returns the pixels."""
    synthetic.edit(dataset.root, without_masks)
    images = []
    for frame in dataset.frames:
        full = 65535 if kind == "16 bit" else 255
        rgb = cv2.imread(str(frame.image_path)).astype(np.uint16)[..., ::-1] * (full // 255)
        alpha = _soft(frame.mask(), full) if kind != "binary" else frame.mask() * np.uint8(255)
        pixels = np.dstack([rgb.astype(alpha.dtype), alpha])
        cv2.imwrite(str(frame.image_path), pixels[..., [2, 1, 0, 3]])
        images.append(pixels)
    return images


def agrees_with_masks(dataset: Dataset) -> bool:
    return not any("contradicts" in problem for problem in check_dataset(dataset).problems)


@pytest.mark.parametrize("kind", ["8 bit", "16 bit"])
def test_a_soft_alpha_becomes_images_of_the_rock_alone(dataset, tmp_path, kind):
    images = _with_alpha(dataset, kind)
    copy = _import(dataset.root, tmp_path / "copy")
    assert agrees_with_masks(copy)
    for frame, pixels in zip(copy.frames, images, strict=True):
        straight = pixels / np.iinfo(pixels.dtype).max
        colour, alpha = linear_from_srgb(straight[..., :3]), straight[..., 3:]
        rgba, weight = frame.target()
        assert np.abs(rgba[..., 3:] - alpha).max() <= 0.5 / 255 + 1e-6
        assert np.abs(rgba[..., :3] - colour * alpha).max() < 6e-3
        assert weight.all()
        assert np.array_equal(frame.mask(), alpha[..., 0] >= 0.5)
        assert np.abs(frame.rgb() - colour).max() < 5e-3  # as it was, whatever alpha says
    again = _import(copy.root, tmp_path / "again")
    for one, other in zip(copy.frames, again.frames, strict=True):
        assert one.rock_path.read_bytes() == other.rock_path.read_bytes()


@pytest.mark.parametrize("case", ["binary", "mask files"])
def test_without_a_soft_alpha_that_gives_the_mask_there_are_no_images_of_the_rock(
    dataset, tmp_path, case
):
    _with_alpha(dataset, "binary" if case == "binary" else "8 bit")
    if case == "mask files":
        write_transforms(dataset.root, dataset.frames)
    copy = _import(dataset.root, tmp_path / "copy")
    for frame, original in zip(copy.frames, dataset.frames, strict=True):
        assert frame.rock_path is None
        assert np.array_equal(frame.mask(), original.mask())


def test_a_soft_alpha_is_undistorted_without_a_fringe(dataset, tmp_path):
    """A grey rock over transparent black: resampled straight, its rim would turn dark."""
    synthetic.edit(dataset.root, lambda data: (without_masks(data), data.update(LENS)))
    for frame in dataset.frames:
        alpha = _soft(frame.mask(), 255)
        grey = np.where(alpha > 0, np.uint8(128), np.uint8(0))
        cv2.imwrite(str(frame.image_path), np.dstack([grey, grey, grey, alpha]))
    copy = _import(dataset.root, tmp_path / "copy")
    assert agrees_with_masks(copy)
    for frame in copy.frames:
        rgba = frame.target()[0]
        rim = (rgba[..., 3] > 0.02) & (rgba[..., 3] < 0.98)
        assert rim.sum() > 50
        straight = srgb_from_linear(rgba[..., :3] / np.maximum(rgba[..., 3:], 1e-9))[rim] * 255
        assert np.abs(straight - 128).max() < 1


def test_nerf_synthetic_with_alpha(dataset, tmp_path):
    _with_alpha(dataset, "binary")
    root, camera = tmp_path / "lego", dataset.frames[0].camera
    shutil.copytree(dataset.root / "images", root / "train")
    records = []
    for frame in dataset.frames:
        pose = opengl_from_opencv(frame.camera.world_to_camera).tolist()
        records.append({"file_path": f"./train/{frame.name}", "transform_matrix": pose})
    angle = 2 * np.arctan(camera.width / 2 / camera.K[0, 0])
    write_json(root / "transforms_train.json", {"camera_angle_x": angle, "frames": records})
    assert read_source(root).kind == "NeRF-synthetic"
    assert read_source(root).up_or_estimate()[0] == (0, 0, 1)
    copy = _import(root, tmp_path / "copy")
    named = tuple(replace(frame, name=f"train_{frame.name}") for frame in dataset.frames)
    same_cameras(replace(dataset, frames=named), copy)
    for one, other in zip(dataset.frames, copy.frames, strict=True):
        assert np.array_equal(one.mask(), other.mask())


def test_images_are_found_by_the_ends_of_paths_that_begin_elsewhere(dataset, tmp_path, capsys):
    """As in transforms.json of a project of which one folder was copied; never outside of it."""
    root = shutil.copytree(dataset.root, tmp_path / "phone")

    def move(folder):
        def edit(data):
            for frame in data["frames"]:
                frame["file_path"] = f"{folder}/images/{Path(frame['file_path']).name}"

        return edit

    for folder in ("./data/phone", "/home/me/phone", "..", "D:\\phone"):
        synthetic.edit(root, move(folder))
        source = read_source(root)
        assert [shot.image.name for shot in source.shots] == [
            frame.image_path.name for frame in dataset.frames
        ]
        found = f"images found in {root} by the ends of their paths, which begin elsewhere: 8"
        assert found in source.notes[-1]
    (root / "images").rename(tmp_path / "images")
    for folder in ("./data/phone", "phone/../.."):
        synthetic.edit(root, move(folder))
        line = refused(capsys, ["import", root, "--out", tmp_path / "out"], tmp_path / "out")
        assert "none of the 8 images it lists exists" in line
    (tmp_path / "images").rename(root / "images")
    synthetic.edit(root, move("a"))
    synthetic.edit(root, lambda d: d["frames"][1].update(file_path="b/images/kf_0000.png"))
    line = refused(capsys, ["import", root, "--out", tmp_path / "out"], tmp_path / "out")
    assert "has the end of several of its paths; give the folder of its images" in line


FISHEYE = np.array([0.05, -0.01, 0.002, 0.001])
UNDISTORTERS: dict[str, tuple[Callable[..., Any], np.ndarray, tuple[str, ...]]] = {
    "OPENCV": (cv2.undistortPoints, DISTORTION, ("k1", "k2", "p1", "p2", "k3")),
    "OPENCV_FISHEYE": (cv2.fisheye.undistortPoints, FISHEYE, ("k1", "k2", "k3", "k4")),
}


@pytest.mark.parametrize("model", UNDISTORTERS)
def test_distortion_is_undone(tmp_path, model):
    points, coefficients, names = UNDISTORTERS[model]
    camera = Camera(np.array([[110.0, 0, 83], [0, 108.0, 57], [0, 0, 1]]), 160, 120, np.eye(4))
    shift = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    pixels = np.indices((120, 160), np.float64)[::-1].reshape(2, -1).T[:, None]
    seen = points(pixels, camera.K - shift, coefficients).reshape(120, 160, 2)
    distorted = synthetic.albedo(np.dstack([seen, np.ones((120, 160))]))
    values = dict(zip(names, coefficients.tolist(), strict=True))
    lens = Lens.of("", model, camera.K, values)
    straight, undo = undistorter(camera, lens)
    undone = undo(distorted.astype(np.float32), True)
    rays = straight.unproject(np.ones((120, 160)))
    error = np.abs(undone - synthetic.albedo(rays))
    assert not np.allclose(straight.K, camera.K, atol=0.1)
    assert error[2:-2, 2:-2].max() < 5e-3
    # Half a pixel of shift, the mistake that mixes the two pixel-centre conventions, would show.
    shifted = np.abs(undone - synthetic.albedo(rays + np.array([0.5 / 110, 0.5 / 108, 0])))
    assert np.median(shifted) > 5 * np.median(error)
    assert Lens.of("", "OPENCV", camera.K, {"k1": 0.0}) is None
    same, keep = undistorter(camera, None)
    assert same is camera
    assert keep(undone, True) is undone

    source = synthetic.write_dataset(tmp_path / "src").frames[0]
    synthetic.edit(tmp_path / "src", lambda data: data.update(values, camera_model=model))
    copy = _import(tmp_path / "src", tmp_path / "copy").frames[0]
    own = Lens.of("", model, source.camera.K, values)
    straight, undo = undistorter(source.camera, own)
    assert np.allclose(copy.camera.K, straight.K)
    assert np.array_equal(copy.depth(), undo(source.depth(), False))
    assert np.isin(copy.depth(), source.depth()).all()  # never blended
    assert 0.3 < copy.mask().sum() / source.mask().sum() < 3


UNIT = "depth_unit_scale_factor"


@pytest.mark.parametrize(
    ("steps", "about", "path"),
    [
        (1000, {}, "depth_file_path"),
        (4000, {UNIT: 0.00025}, "depth_file_path"),
        (0.5, {UNIT: 2.0}, "depth_file_path"),
        (4096, {"integer_depth_scale": 1 / 4096}, "depth_path"),  # instant-ngp, NeRFCapture
        (4096, {"integer_depth_scale": -1, UNIT: 1 / 4096}, "depth_file_path"),
    ],
)
def test_depth_is_in_millimetres_or_the_units_that_are_named(dataset, tmp_path, steps, about, path):
    """As whole numbers of 16 bits, or floats of a TIFF."""
    ending, kind = (".tif", np.float32) if steps < 1 else (".png", np.uint16)
    for frame in dataset.frames:
        depth = frame.depth() * steps if steps < 1 else np.round(frame.depth() * steps)
        cv2.imwrite(str(frame.depth_path.with_suffix(ending)), depth.astype(kind))
    text = (dataset.root / "transforms.json").read_text()
    text = text.replace(".exr", ending).replace("depth_file_path", path)
    (dataset.root / "transforms.json").write_text(text)
    synthetic.edit(dataset.root, lambda data: data.update(about))
    copy = _import(dataset.root, tmp_path / "copy")
    for one, other in zip(dataset.frames, copy.frames, strict=True):
        assert np.abs(one.depth() - other.depth()).max() < 0.51 / 1000


@pytest.mark.parametrize("kind", ["plain", "alpha", "16 bit", "jpeg", "distorted"])
def test_only_an_image_that_stays_as_it_is_is_copied(dataset, tmp_path, kind):
    path = dataset.frames[0].image_path
    with Image.open(path) as image:
        pixels = image.convert("RGBA" if kind == "alpha" else "RGB")
    if kind == "16 bit":
        cv2.imwrite(str(path), np.asarray(pixels).astype(np.uint16)[..., ::-1] * 257)
    elif kind == "jpeg":
        pixels.save(path, format="JPEG")
    else:
        pixels.save(path, compress_level=9)  # other bytes than ours would be
    if kind == "distorted":
        synthetic.edit(dataset.root, lambda data: data.update(k1=-0.1))
    copy = _import(dataset.root, tmp_path / "copy").frames[0]
    assert (copy.image_path.read_bytes() == path.read_bytes()) == (kind == "plain")
    assert np.array_equal(copy.rgb(), replace(copy, image_path=path).rgb()) == (kind != "distorted")


def test_what_others_add_to_a_model_does_not_change_it(dataset, tmp_path, capsys):
    """3D Gaussian Splatting writes points3D.ply."""
    synthetic.write_colmap(dataset, tmp_path / "colmap", binary=True)
    given = ["import", tmp_path / "colmap", "--out", tmp_path / "copy"]
    command(*given)
    (tmp_path / "colmap/sparse/0/points3D.ply").touch()
    assert "is finished already" in output(capsys, *given)
    points = tmp_path / "colmap/sparse/0/points3D.bin"
    points.write_bytes(points.read_bytes() + b"?")
    assert "model have changed since" in refused(capsys, given, tmp_path / "copy")


def test_what_is_missing_is_skipped_and_said(dataset, tmp_path, capsys):
    for frame in dataset.frames[:3]:
        frame.image_path.unlink()
    synthetic.edit(dataset.root, lambda data: data.update(ply_file_path="sparse_pc.ply"))
    command("import", dataset.root, "--out", tmp_path / "copy")
    out, err = said(capsys)
    assert len(load_dataset(tmp_path / "copy")) == 5
    assert "5 frames of 8 images; left out 3 whose file is missing" in out
    assert f"{dataset.root}/sparse_pc.ply,donotexist" in err.replace(" ", "")
    assert "0 points" not in out
    assert not (tmp_path / "copy/sparse.ply").exists()


def test_images_are_excluded_by_name(dataset, tmp_path, capsys):
    names = [frame.name for frame in dataset.frames]
    given = ["import", dataset.root, "--exclude", f"images/{names[2]}.png"]
    assert "left out 1 excluded" in output(capsys, *given, "--out", tmp_path / "copy")
    left = [frame.name for frame in load_dataset(tmp_path / "copy").frames]
    assert left == [*names[:2], *names[3:]]
    fails("exclude 'other'", read_source, dataset.root, exclude=["other"])


@pytest.mark.parametrize("kind", ["nerfstudio", "COLMAP"])
def test_images_may_be_smaller_than_their_cameras(dataset, tmp_path, kind, capsys):
    """Masks of the cameras' size are reduced, too."""
    synthetic.edit(
        dataset.root, lambda data: [one.pop("depth_file_path") for one in data["frames"]]
    )
    source = dataset.root
    if kind == "COLMAP":
        source = tmp_path / "colmap"
        synthetic.write_colmap(dataset, source, True)
    for frame in dataset.frames:
        with Image.open(frame.image_path) as image:
            image.resize((image.width // 4, image.height // 4)).save(frame.image_path)
    masks = ["--masks", dataset.root / "masks"] if kind == "COLMAP" else []
    command("import", source, "--out", tmp_path / "c", *masks)
    assert f"cameras scaled to smaller images: {len(dataset)}" in said(capsys)[1]
    for one, other in zip(dataset.frames, load_dataset(tmp_path / "c").frames, strict=True):
        point = one.camera.camera_to_world[:3] @ [0.1, 0.2, 1, 1]
        pixels = [frame.camera.project(point[None])[0] for frame in (one, other)]
        assert np.allclose(pixels[0], 4 * pixels[1])
        assert (other.mask() == one.mask()[2::4, 2::4]).all()


@pytest.mark.parametrize("own", [(32, 24), (43, 32), (96, 72)])
def test_masks_and_depth_of_another_size_give_the_nearest_pixels(dataset, tmp_path, own, capsys):
    """Proportions may differ by a pixel; other sizes are refused."""
    for frame in dataset.frames:
        depth, mask = (
            cv2.resize(each, own, interpolation=cv2.INTER_NEAREST)
            for each in (frame.depth(), np.uint8(frame.mask()))
        )
        write_exr(frame.depth_path, {"Z": depth})
        write_png(frame.mask_path, mask > 0)
    copy = _import(dataset.root, tmp_path / "copy")
    for one, other in zip(dataset.frames, copy.frames, strict=True):
        rows, columns = (
            ((np.arange(side) + 0.5) * small / side).astype(int)
            for side, small in zip((48, 64), own[::-1], strict=True)
        )
        near = np.ix_(rows, columns)
        assert np.array_equal(other.depth(), read_depth(one.depth_path)[near])
        assert np.array_equal(other.mask(), read_mask(one.mask_path)[near])
    for shape in ((own[1] + 2, own[0]), (1, 1), (2, 3)):
        write_exr(dataset.frames[0].depth_path, {"Z": np.ones(shape, np.float32)})
        line = refused(capsys, ["import", dataset.root, "--out", tmp_path / "out"])
        assert "depth of their cameras' size" in line


@pytest.mark.parametrize("own", [(34, 25), (33, 26), (80, 61)])
def test_a_smaller_image_of_any_factor_is_rounded_up_or_down_and_its_lens_scaled(tmp_path, own):
    K = np.array([[120.0, 0, 66], [0, 121, 52], [0, 0, 1]])
    camera = Camera(K, 133, 102, np.eye(4))
    lens = Lens.of("lens", "OPENCV", K, {"k1": -0.1, "k2": 0.02})
    write_png(tmp_path / "image.png", np.zeros((own[1], own[0], 3)))
    small, scaled = fitted(camera, lens, tmp_path / "image.png")
    assert lens
    assert scaled
    assert (small.width, small.height) == own
    ray = np.array([[0.2, -0.1, 1]])
    a, b = (one.camera(1, 1).img_from_cam(ray)[0] for one in (lens, scaled))
    assert np.allclose(b, a * np.divide(own, (133, 102)))
    assert np.allclose(scaled.parameters[:4], small.K[[0, 1, 0, 1], [0, 1, 2, 2]])


def test_a_smaller_image_that_exif_turns_is_scaled_as_it_is_looked_at(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.new("RGB", (24, 32)).save(tmp_path / "image.jpg", exif=exif)
    small, _ = fitted(Camera(np.eye(3), 64, 48, np.eye(4)), None, tmp_path / "image.jpg")
    assert (small.width, small.height) == (32, 24)


def test_a_pixel_of_all_ones_is_no_depth(tmp_path):
    cv2.imwrite(str(tmp_path / "z.png"), np.array([[1500, 65535]], np.uint16))
    assert read_depth(tmp_path / "z.png").tolist() == [pytest.approx([1.5, 0.0])]


def test_images_are_set_apart_as_test_views(dataset, tmp_path, capsys):
    arguments = ["import", dataset.root, "--test-every", "3", "--out"]
    out = tmp_path / "out"
    apart = "3 set apart as test views, never fitted"
    assert apart in output(capsys, *arguments, out)
    (out / "transforms.json").unlink()  # as if it had been interrupted before its end
    assert apart in output(capsys, *arguments, out)
    made = load_dataset(out)
    tests = made.test_views()
    names = [frame.name for frame in dataset.frames]
    assert [frame.name for frame in tests.frames] == names[::3]
    assert [frame.name for frame in made.frames] == [name for i, name in enumerate(names) if i % 3]
    assert tests.world == made.world
    for frame in dataset.frames[1:]:
        frame.image_path.unlink()
    assert exit_code(*arguments, tmp_path / "none") == 2
    assert "1 test views of 1 images leave none to choose from" in said(capsys)[1]


def test_an_import_of_an_earlier_version_is_continued_as_it_was(
    dataset, tmp_path, capsys, monkeypatch
):
    """Its record has neither options nor files, and its images are whole."""
    out = tmp_path / "out"
    _import(dataset.root, out)
    monkeypatch.setattr(importers, "MOST_PIXELS", 1)
    for words in ("is finished already", "wrote"):
        assert words in output(capsys, "import", dataset.root, "--out", out)
        same_cameras(dataset, load_dataset(out))
        (out / "transforms.json").unlink()
    for damaged in (5, {}):
        write_json(out / "import.json", damaged)
        line = refused(capsys, ["import", dataset.root, "--out", out], out)
        assert "an unfinished dataset of other settings or sources" in line


def test_what_force_replaces_stays_where_masks_lack(dataset, tmp_path, capsys):
    out = tmp_path / "out"
    _import(dataset.root, out)
    (dataset.root / "masks/kf_0003.png").unlink()
    for masks, why in {"masks": "no mask for image", "none": "no such folder"}.items():
        arguments = ["import", dataset.root, "--out", out, "--masks", dataset.root / masks]
        assert why in refused(capsys, [*arguments, "--force"], out)


def test_an_import_interrupted_at_its_last_checks_has_the_same_options(
    dataset, tmp_path, capsys, monkeypatch
):
    out = tmp_path / "out"
    arguments = ["import", dataset.root, "--out", out, "--up"]
    with monkeypatch.context() as patched:
        patched.setattr("mgs.cli.import_data._checked", stop_at())
        assert exit_code(*arguments, "0,0,1") == 130
    assert (out / "transforms.json").is_file()
    assert "of other settings" in refused(capsys, [*arguments, "1,0,0"], out)
    command(*arguments, "0,0,1")


def test_masks_by_projecting_a_mesh_or_from_files(dataset, tmp_path, capsys):
    _with_alpha(dataset, "8 bit")  # which is not looked at
    for k, path in enumerate(sorted((dataset.root / "masks").iterdir())):
        name = (path.name, f"{path.stem}_mask.png", f"{path.name}.png")[k % 3]
        path.rename(path.with_name(name))
    rock = synthetic.CENTRE, synthetic.AXES
    true = [synthetic.cast(frame.camera, [rock])[1] for frame in dataset.frames]
    mesh = ["--mesh", dataset.root / "rock.glb"]
    command("import", dataset.root, "--out", tmp_path / "mesh", *mesh)
    assert "turned from +Y up" in said(capsys)[0]
    for frame in dataset.frames[::3]:  # a photograph beside a mask of its name
        shutil.copy(frame.image_path, dataset.root / f"masks/{frame.name}.jpg")
    masks = ["--masks", dataset.root / "masks"]
    command("import", dataset.root, "--out", tmp_path / "files", *masks)
    projected, given = (load_dataset(tmp_path / name).frames for name in ("mesh", "files"))
    for a, b, mask in zip(projected, given, true, strict=True):
        assert a.rock_path is None
        assert b.rock_path is None
        assert np.array_equal(b.mask(), mask)
        # The mesh reaches below the ground, where the image shows ground.
        assert (a.mask() & mask).sum() > 0.97 * mask.sum()
        assert (a.mask() & ~mask).sum() < 0.15 * mask.sum()


def test_a_mask_beside_its_photograph(dataset, tmp_path):
    folder = dataset.root / "images"
    for frame in dataset.frames:
        frame.mask_path.rename(folder / f"{frame.image_path.stem}_mask.png")
    out = tmp_path / "out"
    command("import", dataset.root, "--out", out, "--masks", folder)
    for made, frame in zip(load_dataset(out).frames, dataset.frames, strict=True):
        mask = synthetic.cast(frame.camera, [(synthetic.CENTRE, synthetic.AXES)])[1]
        assert np.array_equal(made.mask(), mask)


STRUCK = """
import os, signal, sys
from mgs.data import importers
from mgs.cli.app import main

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background may ignore it
write, calls, end = importers.write_png, [], int(sys.argv.pop())

def strike(path, *arguments, **options):
    calls.append(path.parent.name)
    if calls.count("images") == 4:
        os.kill(os.getpid(), end)
    write(path, *arguments, **options)

importers.write_png = strike
main()
"""
"""The program, which sends itself the signal that is its last argument, after three images and all
of the fourth frame but its image."""


@pytest.fixture
def source(dataset) -> Path:
    """Eight distorted frames with depth."""
    synthetic.edit(dataset.root, lambda data: data.update(k1=-0.15, k2=0.04, p1=0.002))
    return dataset.root


@pytest.fixture
def many(source: Path) -> list:
    """Arguments that import it with masks from a mesh."""
    return ["import", source, "--mesh", source / "rock.glb", "--out"]


@pytest.mark.parametrize(("end", "code"), [(signal.SIGKILL, -signal.SIGKILL), (signal.SIGINT, 130)])
def test_ended_in_the_middle_and_given_again(many, tmp_path, monkeypatch, end, code):
    """A real process, a real signal; then no finished frame is read again."""
    out = tmp_path / "out"
    process = python(STRUCK, *many, out, int(end))
    assert process.returncode == code, process.stderr
    assert not (out / "transforms.json").exists()
    assert len(list((out / "images").iterdir())) == 3
    (out / "images/.kf_0003.1073741824-01234567.part.png").touch()  # of a killed process
    kept = {path: path.stat().st_mtime_ns for path in (out / "images").glob("kf_*")}

    read, load = [], importers.read_rgba
    with monkeypatch.context() as patch:
        patch.setattr(importers, "read_rgba", lambda path: (read.append(path.stem), load(path))[1])
        command(*many, out)
    assert read == [f"kf_{k:04d}" for k in range(3, 8)]
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    command(*many, tmp_path / "whole")
    assert listing(out) == listing(tmp_path / "whole")


def unfinished(source: Path, arguments: list, out: Path, capsys) -> None:
    """Import the four frames before a damaged image, and mend it."""
    image = source / "images/kf_0004.png"
    whole = image.read_bytes()
    image.write_bytes(whole[:100])
    assert exit_code(*arguments, out) == 2
    assert "kf_0004.png: not a readable image" in said(capsys)[1]
    assert len(list((out / "images").iterdir())) == 4
    image.write_bytes(whole)


def test_an_unfinished_import_of_something_else_is_refused(source, many, tmp_path, capsys):
    out = tmp_path / "out"
    unfinished(source, many, out, capsys)
    other = synthetic.write_dataset(tmp_path / "other").root
    trimesh.creation.icosphere(subdivisions=2).export(tmp_path / "ball.ply")
    masks, ball = ["--masks", source / "masks"], ["--mesh", tmp_path / "ball.ply"]
    smaller = [source, "--mesh", source / "rock.glb", "--downscale", "2"]
    for arguments in ([other], [source, *masks], [source, *ball], smaller):
        line = refused(capsys, ["import", *arguments, "--out", out], out)
        assert "unfinished dataset of other settings or sources" in line
    synthetic.edit(source, lambda data: data.update(cx=30.0))
    assert "unfinished dataset" in refused(capsys, [*many, out], out)


def test_a_frame_whose_files_changed_is_made_again(source, many, tmp_path, capsys):
    unfinished(source, many, tmp_path / "out", capsys)
    write_png(source / "images/kf_0000.png", np.full((48, 64, 3), 0.5))
    command(*many, tmp_path / "out")
    command(*many, tmp_path / "whole")
    assert listing(tmp_path / "out") == listing(tmp_path / "whole")


def test_killed_before_the_first_frame(many, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out/.import.1073741824-01234567.part.json").touch()
    command(*many, tmp_path / "out")
    assert not list((tmp_path / "out").glob(".*"))


def test_a_folder_of_something_else_keeps_its_temporary_files(many, tmp_path, capsys):
    (tmp_path / "out/deep").mkdir(parents=True)
    (tmp_path / "out/deep/.import.1073741824-01234567.part.json").touch()
    assert "is there already" in refused(capsys, [*many, tmp_path / "out"], tmp_path / "out")


def test_an_import_names_a_blurred_image(dataset, tmp_path, capsys):
    frame = dataset.frames[1]
    write_png(frame.image_path, gaussian_filter(frame.rgb(), (2, 2, 0)))
    command("import", dataset.root, "--out", tmp_path / "out")
    assert f"frame {frame.name}: is blurred, by " in said(capsys)[1]
    command("import", dataset.root, "--out", tmp_path / "left", "--exclude", frame.name)
    assert "blurred" not in said(capsys)[1]
