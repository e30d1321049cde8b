"""Imports judged by the truth: cameras of a scene in closed form, written as other programs do."""

import codecs
import shutil

import cv2
import numpy as np
import OpenEXR
import pytest
import synthetic
from PIL import Image
from program import command, said
from refusals import fails, refused
from test_recordings import write_bag, write_metashape, write_open3d, write_rtabmap

from mgs.camera import Camera
from mgs.data.clouds import read_cloud
from mgs.data.dataset import load_dataset, write_transforms
from mgs.data.lens import Lens
from mgs.data.sources import read_source
from mgs.images import read_depth, read_mask


@pytest.fixture
def data(tmp_path):
    """Twelve views, so that names without zeros are not in the order of text."""
    return synthetic.orbit(tmp_path / "data", 12, 32, 24)


def errors(dataset, shots) -> np.ndarray:
    """Largest difference of a pose's entries from the truth, by the place of its pixels."""
    found = []
    for shot in shots:
        with Image.open(shot.image) as image:
            pixels = np.asarray(image.convert("RGB"))
        true = next(f for f in dataset.frames if np.array_equal(Image.open(f.image_path), pixels))
        found.append(np.abs(shot.camera.camera_to_world - true.camera.camera_to_world).max())
    return np.array(found)


@pytest.mark.parametrize(
    ("poses", "topic", "frames"),
    [
        (("mount", "tf", "wheels"), None, 12),
        (("mount", "tf", "goal"), None, 12),
        (("mount", "gap"), None, 8),
        (("mount", "wheels", "filter"), "/filter", 12),
        (("mount", "body"), "/slam/pose", 12),
        (("camera",), "/slam/pose", 12),
        (("mount", "motion capture"), "/mocap/robot", 12),
    ],
)
def test_poses_of_a_bag_are_those_that_move_the_camera(tmp_path, data, poses, topic, frames):
    bag = write_bag(tmp_path / "bag", data, poses=poses, depth=False)
    source = read_source(bag, unpack=tmp_path / "x", pose=topic)
    assert errors(data, source.shots).max() < 1e-6
    assert len(source.shots) == frames
    assert source.left_out.total() == 12 - frames


@pytest.mark.parametrize("pose", [(), ("wheels", "filter"), ("body",), ("motion capture",)])
def test_a_bag_whose_poses_are_not_plain_is_refused(tmp_path, data, pose):
    bag = write_bag(tmp_path / "bag", data, poses=("mount", *pose), depth=False)
    fails("does not move|come from|no tf", read_source, bag, unpack=tmp_path / "x")


@pytest.mark.parametrize(
    ("kind", "model"), [("plumb_bob", "FULL_OPENCV"), ("equidistant", "OPENCV_FISHEYE")]
)
def test_the_lens_of_a_bag(tmp_path, data, kind, model):
    """D in the order of ROS: k1 k2 p1 p2 k3, of a fisheye k1 to k4."""
    D = [-0.12, 0.05, 0.004, -0.003, 0.01][: 5 if kind == "plumb_bob" else 4]
    bag = write_bag(tmp_path / "bag", data, depth=False, distortion=(kind, D))
    lens = read_source(bag, unpack=tmp_path / "x").shots[0].lens
    assert lens.model == model
    assert list(lens.parameters[4 : 4 + len(D)]) == D


@pytest.mark.parametrize(
    ("binning", "window"),
    [(1, (0, 0, 0, 0)), (2, (0, 0, 0, 0)), (1, (12, 6, 24, 32)), (2, (12, 6, 48, 64))],
)
def test_images_of_a_bag_are_binned_or_a_window_of_the_sensor(tmp_path, data, binning, window):
    """Its camera_info is of all pixels of the sensor; a window of half its sides is not binned."""
    left, top = window[:2]

    def whole(camera):
        size = np.array([camera.width, camera.height]) * binning * (2 if any(window) else 1)
        K = camera.K * [[binning], [binning], [1]] + [[0, 0, left], [0, 0, top], [0, 0, 0]]
        return Camera(K, *size.tolist(), camera.world_to_camera)

    bag = write_bag(tmp_path / "bag", data, depth=False, whole=whole, window=window)
    for shot in read_source(bag, unpack=tmp_path / "x").shots:
        assert (shot.camera.width, shot.camera.height) == (32, 24)
        np.testing.assert_allclose(shot.camera.K, data.frames[0].camera.K, atol=1e-9)


def test_a_frame_that_is_no_optical_one_is_named(tmp_path, data, monkeypatch):
    monkeypatch.setattr("test_recordings.OPTICAL", "camera_link")
    source = read_source(write_bag(tmp_path / "bag", data, depth=False), unpack=tmp_path / "x")
    assert any("frame camera_link of" in note for note in source.notes)


def test_names_with_numbers_are_in_their_order(tmp_path, data):
    source = read_source(write_open3d(tmp_path / "o", data))
    assert errors(data, source.shots).max() < 1e-9
    (tmp_path / "o/color/11.png").unlink()
    fails("12 poses for 11 images in color", read_source, tmp_path / "o")
    (tmp_path / "o/color/10.png").rename(tmp_path / "o/color/11.png")
    (tmp_path / "o/color/0.png").rename(tmp_path / "o/color/first.png")
    shutil.copy(tmp_path / "o/color/11.png", tmp_path / "o/color/10.png")
    fails(r"first\.png: its name has no number", read_source, tmp_path / "o")
    folder = write_rtabmap(tmp_path / "r", data)
    with open(folder / "rtabmap_camera_poses.txt", "a") as file:
        file.write("\n0 1 2 3 0 0 0 1 -7\n")
    source = read_source(folder)
    assert errors(data, source.shots).max() < 1e-9
    assert source.left_out == {"landmark": 1}


def test_a_transforms_json_is_read_as_its_authors_mean_it(data):
    def change(json):
        json["test_filenames"] = [json["frames"][k]["file_path"] for k in (0, 5)]
        json["camera_angle_x"] = 2 * np.arctan(json["w"] / 2 / json.pop("fl_x"))
        json["camera_angle_y"] = 2 * np.arctan(json["h"] / 2 / (1.25 * json.pop("fl_y")))
        for k, frame in enumerate(json["frames"]):
            name = f"images/r.{k}"
            shutil.move(data.root / frame["file_path"], data.root / f"{name}.png")
            frame["file_path"] = name.replace("/", "\\")
            frame["transform_matrix"] = np.round(frame["transform_matrix"], 4).tolist()
        json["test_filenames"] = [json["frames"][k]["file_path"] for k in (0, 5)]

    frames = data.frames
    synthetic.edit(data.root, change)
    source = read_source(data.root)
    assert source.tests == {"r.0", "r.5"}
    train, tests = source.set_apart(None)
    assert (len(train.shots), len(tests.shots)) == (10, 2)
    for shot, frame in zip(source.shots, frames, strict=True):
        K = frame.camera.K
        assert np.allclose(shot.camera.K, np.diag([1, 1.25, 1]) @ K * [1, 1, 0] + K * [0, 0, 1])
        assert np.abs(shot.camera.world_to_camera - frame.camera.world_to_camera).max() < 2e-3
    assert source.notes[0] == "rotations that were rounded, and are made orthonormal: 12"


@pytest.mark.parametrize("windows", [True, False])
def test_absolute_paths_give_names_of_what_differs(data, windows):
    """Also of a folder that is elsewhere, whose pictures are found by their names' ends, in
    capitals or not."""

    def change(json):
        for k, frame in enumerate(json["frames"]):
            path = data.root / f"images/{'ab'[k % 2]}/{k}.{'PNG' if windows else 'png'}"
            path.parent.mkdir(exist_ok=True)
            shutil.move(data.root / frame["file_path"], path)
            old = f"C:\\of\\a person\\{'ab'[k % 2]}\\{k}.png"
            frame["file_path"] = old if windows else str(path)
        json["test_filenames"] = [json["frames"][1]["file_path"]]

    synthetic.edit(data.root, change)
    source = read_source(data.root, data.root / "images" if windows else None)
    assert [shot.name for shot in source.shots] == [f"{'ab'[k % 2]}_{k}" for k in range(12)]
    assert source.tests == {"b_1"}
    first = source.shots[0].image
    left = read_source(data.root, first.parents[1], exclude=[str(first)]).shots
    assert [shot.name for shot in left] == [shot.name for shot in source.shots[1:]]


FISHEYE = "OPENCV_FISHEYE"
MODELS = {
    "SIMPLE_RADIAL": {"k1": 0.1},
    "RADIAL_FISHEYE": {"k1": 0.02, "k2": -0.01},
    FISHEYE: {"k1": 0.02, "k4": 0.001},
    "THIN_PRISM_FISHEYE": {"k1": 0.02, "p1": 0.001, "sx1": 0.001},
    "FOV": {"omega": 0.6},
}


@pytest.mark.parametrize(("model", "old"), [*((model, False) for model in MODELS), (FISHEYE, True)])
def test_every_lens_of_colmap_may_be_that_of_a_frame(data, model, old):
    """old: as programs wrote a fisheye before camera_model."""
    import pycolmap

    change = ({"is_fisheye": True} if old else {"camera_model": model}) | MODELS[model]
    synthetic.edit(data.root, lambda json: json["frames"][1].update(change))
    first, shot = read_source(data.root).shots[:2]
    assert first.lens is None
    K = shot.camera.K
    names = {"k1": "k"} if model == "SIMPLE_RADIAL" else {}
    values = {names.get(key, key): value for key, value in MODELS[model].items()}
    number = pycolmap.CameraModelId.__members__[model]
    lens = pycolmap.Camera.create_from_model_id(1, number, K[0, 0], 32, 24)
    place = [name.strip() for name in lens.params_info.split(",")]
    known = {"f": K[0, 0], "fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    lens.params = [{**known, **values}.get(name, 0.0) for name in place]
    rays = np.array([[0.2, 0.1, 1.0], [-0.3, 0.25, 1.0]])
    ours = shot.lens.camera(32, 24).img_from_cam(rays)
    assert np.allclose(ours, lens.img_from_cam(rays), atol=1e-9)


def test_a_coefficient_that_a_model_lacks_is_named():
    fails("p1, which .*FISHEYE lacks", Lens.of, "a", "OPENCV_FISHEYE", np.eye(3), {"p1": 0.1})


def colmap_text(data, tmp_path, rename=str):
    synthetic.write_colmap(data, tmp_path / "c", False)
    path = tmp_path / "c/sparse/0/images.txt"
    text = path.read_text()
    for frame in data.frames:
        text = text.replace(frame.image_path.name, rename(frame.image_path.name))
    path.write_text(text)
    return tmp_path / "c", path


@pytest.mark.parametrize(
    ("folder", "encoded"),
    [
        ("left cam", lambda text: text),
        ("left cam", lambda text: codecs.BOM_UTF8 + text),
        ("Süd 1/b.v1", lambda text: text.replace(b"\n", b"\r\n")),
    ],
    ids=["plain", "byte-order mark", "Windows lines"],
)
def test_colmap_text_keeps_names_and_loses_no_image(data, tmp_path, folder, encoded):
    source, path = colmap_text(data, tmp_path, lambda name: f"{folder}/{name[:-3]}PNG")
    (source / "images").unlink()
    shutil.copytree(data.root / "images", source / "images" / folder)
    for file in path.parent.iterdir():
        file.write_bytes(encoded(file.read_bytes()))
    shots = read_source(source).shots
    assert errors(data, shots).max() < 1e-9
    assert np.allclose(shots[0].camera.K, data.frames[0].camera.K)
    named = folder.replace("/", "_")
    assert [shot.name for shot in shots[:2]] == [f"{named}_kf_0000", f"{named}_kf_0001"]
    image = source / f"images/{folder}/kf_0000.png"
    image.rename(image.with_suffix(".PNG.png"))  # a mask, as COLMAP names it, is no picture
    assert read_source(source).left_out["whose file is missing"] == 1
    lines = [line for line in path.read_text().splitlines() if line.endswith(".PNG")]
    path.write_text("\n".join(lines) + "\n")
    fails("has no line of points after that of image", read_source, source)
    path.write_text(lines[0] + "\n\n" + lines[1][:40])
    fails("is no line of an image", read_source, source)


def test_the_largest_model_is_taken_and_far_origins_are_moved(data, tmp_path):
    import pycolmap

    synthetic.write_colmap(data, tmp_path / "c", True)
    model = pycolmap.Reconstruction(tmp_path / "c/sparse/0")
    (tmp_path / "c/sparse/10").mkdir()
    far = np.array([448262.0, 5411932.0, 412.0])
    model.transform(pycolmap.Sim3d(1, pycolmap.Rotation3d(), far))
    model.write_binary(tmp_path / "c/sparse/10")
    for number in list(model.images)[:9]:
        model.deregister_frame(number)
    model.write_binary(tmp_path / "c/sparse/0")
    command("import", tmp_path / "c", "--out", tmp_path / "out", "--mesh", write_far(tmp_path, far))
    made = load_dataset(tmp_path / "out")
    moved = np.subtract(far, made.world.origin)
    scaled = read_source(tmp_path / "c").in_metres(0.5)
    assert np.allclose(scaled.origin, np.divide(made.world.origin, 2))
    for one, other in zip(made.frames, data.frames, strict=True):
        own = made.world.leave(one.camera).position
        assert np.allclose(own, other.camera.position + moved, atol=1e-6)
        assert (one.mask() ^ other.mask()).mean() < 0.01
    points = read_cloud(tmp_path / "out/sparse.ply").points - moved
    on_rock = points[:, 2] > 0.02
    assert np.abs(synthetic.level(points[on_rock])).max() < 1e-4


def write_far(tmp_path, far):
    mesh = synthetic.rock_mesh()
    text = "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in (mesh.vertices + far).tolist())
    text += "".join(f"f {a} {b} {c}\n" for a, b, c in (mesh.faces + 1).tolist())
    (tmp_path / "far.obj").write_text(text)
    return tmp_path / "far.obj"


def test_masks_in_folders_are_those_of_their_images(data, tmp_path, capsys):

    def change(json):
        for k, frame in enumerate(json["frames"]):
            name = f"images/cam{k % 2}/{k // 2:03d}.png"
            (data.root / name).parent.mkdir(exist_ok=True)
            shutil.move(data.root / frame["file_path"], data.root / name)
            mask = tmp_path / "m" / f"cam{k % 2}" / f"{k // 2:03d}.png.png"
            mask.parent.mkdir(parents=True, exist_ok=True)
            shutil.move(data.root / frame.pop("mask_path"), mask)
            frame["file_path"] = name

    true = [frame.mask() for frame in data.frames]
    synthetic.edit(data.root, change)
    asked = ["import", data.root, "--masks", tmp_path / "m", "--out"]
    command(*asked, tmp_path / "out")
    made = load_dataset(tmp_path / "out").frames
    assert all(np.array_equal(one.mask(), mask) for one, mask in zip(made, true, strict=True))
    shutil.rmtree(tmp_path / "m/cam1")
    for path in (tmp_path / "m/cam0").iterdir():
        path.rename(tmp_path / "m" / path.name)
    assert "2 images have this name" in refused(capsys, [*asked, tmp_path / "no"], tmp_path)


MASKS = {
    "labels 0 and 1": lambda mask: Image.fromarray(mask),
    "a palette": lambda mask: labelled(mask, [0, 0, 0, 128, 0, 0]),
    "alpha of one colour": lambda mask: Image.fromarray(
        np.dstack([0 * mask + 255] * 3 + [255 * mask])
    ),
    "a soft edge": lambda mask: Image.fromarray(np.where(mask, 200, 90).astype(np.uint8)),
}


def labelled(mask, colours):
    image = Image.fromarray(mask).convert("P")
    image.putpalette(colours + [0] * (768 - len(colours)))
    return image


@pytest.mark.parametrize("kind", MASKS)
def test_masks_of_other_programs(tmp_path, kind):
    mask = np.eye(5, dtype=np.uint8)
    MASKS[kind](mask).save(tmp_path / "a.png")
    assert np.array_equal(read_mask(tmp_path / "a.png"), mask > 0)


def test_masks_and_test_views_without_effect_are_noticed(data, tmp_path, capsys):
    for frame in data.frames:
        frame.mask_path.unlink()
        Image.new("L", (32, 24)).save(frame.mask_path)
    synthetic.edit(data.root, lambda json: json.update(test_filenames=["images/none.png"]))
    command("import", data.root, "--out", tmp_path / "out")
    errors = said(capsys)[1]
    assert "12 of 12 masks looked at are empty" in errors
    assert "test views that are no frame: 1, as none" in errors
    inverted = np.pad(np.zeros((20, 28), np.uint8), 2, constant_values=255)
    for frame in data.frames:
        Image.fromarray(inverted).save(frame.mask_path)
    command("import", data.root, "--out", tmp_path / "inverted")
    assert "white along their borders" in said(capsys)[1]


def test_frames_elsewhere_stay_there_when_transforms_json_is_written(data, tmp_path):
    place = shutil.move(data.frames[0].image_path, tmp_path / "else.png")
    synthetic.edit(data.root, lambda json: json["frames"][0].update(file_path=str(place)))
    write_transforms(data.root, load_dataset(data.root).frames)
    assert load_dataset(data.root).frames[0].image_path == place


def test_depth_is_right_or_refused(tmp_path):
    def write_channels(path, channels):
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        with OpenEXR.File(header, channels) as file:
            file.write(str(path))

    depth = np.linspace(1, 3, 12, dtype=np.float32).reshape(3, 4)
    grey = np.full((3, 4), 0.5, np.float32)
    exr, tiff, png = (tmp_path / f"a.{end}" for end in ("exr", "tif", "png"))
    layers = {f"Layer.Combined.{c}": grey for c in "RGB"} | {"Layer.Depth.Z": depth}
    for channels in (layers, {"R": depth, "G": depth, "B": depth, "A": grey}, {"V": depth}):
        write_channels(exr, channels)
        assert np.array_equal(read_depth(exr), depth)
    for channels in ({"R": depth, "G": grey, "B": grey}, {"a.Z": depth, "b.Z": grey}):
        write_channels(exr, channels)
        fails("is not plain", read_depth, exr)
    write_channels(exr, {"Z": np.where(depth > 2, 1e10, depth).astype(np.float32)})
    assert np.array_equal(read_depth(exr), np.where(depth > 2, 0, depth))
    write_channels(exr, {"Z": -depth})
    fails("its depths are negative", read_depth, exr)
    Image.fromarray(depth).save(tiff)
    assert np.array_equal(read_depth(tiff), depth)
    cv2.imwrite(str(png), np.round(1000 * depth).astype(np.uint16))
    assert np.abs(read_depth(png) - depth).max() < 6e-4
    cv2.imwrite(str(png), np.uint8(80 * depth))
    fails("a picture of 8 bits is no depth", read_depth, png)


@pytest.mark.parametrize("applied", [True, False])
def test_a_set_shows_whether_its_cameras_are_of_turned_pictures(data, applied):
    """One picture on its side tells, also for one that is upside down."""

    def change(json):
        for k, tag in ((3, 6), (5, 3)):
            path = data.root / json["frames"][k]["file_path"]
            with Image.open(path) as image:
                pixels, exif = np.asarray(image), Image.Exif()
            exif[0x112] = tag
            stored = np.rot90(pixels, {6: 1, 3: 2}[tag]) if applied else pixels
            Image.fromarray(np.ascontiguousarray(stored)).save(path, exif=exif)

    true = [frame.rgb() for frame in data.frames]
    synthetic.edit(data.root, change)
    source = read_source(data.root)
    assert all(shot.turned == applied for shot in source.shots)
    command("import", data.root, "--out", data.root.with_name("out"))
    made = load_dataset(data.root.with_name("out")).frames
    assert all(np.array_equal(one.rgb(), rgb) for one, rgb in zip(made, true, strict=True))


def test_dark_pictures_of_12_bits_are_noticed(data, capsys):
    for frame in data.frames:
        pixels = np.asarray(Image.open(frame.image_path)).astype(np.uint16)
        cv2.imwrite(str(frame.image_path), pixels * 16)
    command("import", data.root, "--out", data.root.with_name("out"))
    text = said(capsys)[1]
    assert "use 12 of 16 bits, so the pictures are nearly black; multiply them by 16" in text


def test_cameras_of_metashape_that_are_disabled_are_left_out(data, tmp_path):
    path, camera = write_metashape(tmp_path / "m", data), data.frames[0].camera
    still = " ".join(map(repr, np.eye(4).ravel().tolist()))
    above = f'<camera id="50" sensor_id="0" label="../../up"><transform>{still}</transform>'
    text = path.read_text().replace("</cameras>", f"{above}</camera></cameras>")
    for k in (2, 7):
        text = text.replace(f'<camera id="{k}"', f'<camera id="{k}" enabled="false"')
    text = text.replace("</f>", "</f><k1>0.05</k1><p1>.001</p1>").replace('"frame"', '"fisheye"')
    path.write_text(text)
    source = read_source(path)
    assert len(source.shots) == 10
    assert source.left_out["disabled"] == 2
    assert errors(data, source.shots).max() < 1e-9
    path.write_text(text.replace("<transform><scale>2</scale></transform>", ""))
    small = read_source(path).shots[0].camera.position
    assert np.allclose(2 * small, source.shots[0].camera.position), "lengths without a scale"
    assert source.shots[0].lens.model == "THIN_PRISM_FISHEYE"
    point = np.array([[0.3, 0.2, 1.0]])
    theta = np.arctan(np.hypot(0.3, 0.2))
    x, y = theta / np.hypot(0.3, 0.2) * point[0, :2]
    radial, r2 = 1 + 0.05 * theta**2, theta**2
    expected = [x * radial + 0.001 * (r2 + 2 * x * x), y * radial + 2 * 0.001 * x * y]
    found = source.shots[0].lens.camera(32, 24).img_from_cam(point)[0]
    assert np.allclose(found, np.array(expected) * camera.K[0, 0] + camera.K[:2, 2], atol=1e-9)
