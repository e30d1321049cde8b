"""Imports of recordings: ROS bags, TUM RGB-D, Open3D, RTAB-Map, Metashape."""

import json
import shutil
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
import synthetic
from PIL import Image
from program import command, said
from refusals import refused
from scipy.spatial.transform import Rotation

from mgs.data import tracks
from mgs.data.dataset import load_dataset
from mgs.errors import InputError

MOUNT = tracks.rigid((0.1, -0.2, 0.3), (0.5, -0.5, 0.5, -0.5))
"""Camera to body of the robot."""
OPTICAL = "camera_color_optical_frame"


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return synthetic.write_dataset(tmp_path_factory.mktemp("recordings") / "data")


def opencv_K(camera) -> np.ndarray:
    """K with pixel centres at whole numbers, as all of these programs have it."""
    return camera.K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]


def quaternion(pose: np.ndarray) -> list[float]:
    return Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()


def pose_line(time: float, frame, *more: int) -> str:
    """time x y z qx qy qz qw of a frame, and more."""
    pose = frame.camera.camera_to_world
    return " ".join(map(repr, [time, *pose[:3, 3].tolist(), *quaternion(pose), *more]))


def copy_images(dataset, colour: Path, depth: Path, unit: float = 1e-3) -> None:
    """Images of a dataset as 0.png, 1.png and so on, and depth as 16-bit PNG."""
    colour.mkdir(parents=True)
    depth.mkdir()
    for k, frame in enumerate(dataset.frames):
        shutil.copy(frame.image_path, colour / f"{k}.png")
        steps = np.round(frame.depth() / unit).astype(np.uint16)
        Image.fromarray(steps).save(depth / f"{k}.png")


class Bag:
    """A bag in which a robot records the frames of a dataset, two a second."""

    def __init__(self, path: Path, version: int, storage: str = "SQLITE3") -> None:
        pytest.importorskip("rosbags")
        from rosbags.rosbag1 import Writer as Writer1
        from rosbags.rosbag2 import StoragePlugin
        from rosbags.rosbag2 import Writer as Writer2
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.version, self.connections = version, {}
        if version == 1:
            self.store = get_typestore(Stores.ROS1_NOETIC)
            text = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))
            self.writer = Writer1(path)
        else:
            self.store = get_typestore(Stores.ROS2_HUMBLE)
            self.writer = Writer2(path, version=9, storage_plugin=StoragePlugin[storage])

    def make(self, kind: str, *values):
        return self.store.types[kind](*values)

    def header(self, time: float, frame: str):
        stamp = self.make("builtin_interfaces/msg/Time", int(time), round(time % 1 * 1e9))
        sequence = (0,) if self.version == 1 else ()
        return self.make("std_msgs/msg/Header", *sequence, stamp, frame)

    def write(self, topic: str, kind: str, time: float, *values) -> None:
        if topic not in self.connections:
            found = self.writer.add_connection(topic, kind, typestore=self.store)
            self.connections[topic] = found
        message = self.make(kind, *values)
        dump = self.store.serialize_ros1 if self.version == 1 else self.store.serialize_cdr
        self.writer.write(self.connections[topic], int(time * 1e9), dump(message, kind))

    def image(self, topic: str, time: float, encoding: str, pixels: np.ndarray) -> None:
        height, width = pixels.shape[:2]
        data = np.frombuffer(pixels.tobytes(), np.uint8)
        shape = height, width, encoding, 0, len(data) // height
        self.write(topic, "sensor_msgs/msg/Image", time, self.header(time, OPTICAL), *shape, data)

    def compressed_depth(self, topic: str, time: float, encoding: str, metres: np.ndarray) -> None:
        """An image of compressed_depth_image_transport; of 32FC1 with a = 60000 and b = -10."""
        steps = np.where(metres > 0, 60000 / np.maximum(metres, 1e-3) - 10, 0)
        steps = 1000 * metres if encoding == "16UC1" else steps
        png = cv2.imencode(".png", np.round(steps).astype(np.uint16))[1]
        data = np.frombuffer(struct.pack("<iff", 0, 60000, -10) + png.tobytes(), np.uint8)
        head, form = self.header(time, OPTICAL), f"{encoding}; compressedDepth png"
        self.write(topic, "sensor_msgs/msg/CompressedImage", time, head, form, data)

    def lens(self, topic: str, time: float, camera) -> None:
        K = opencv_K(camera).ravel()
        numbers = np.zeros(5), K, np.eye(3).ravel(), np.eye(3, 4).ravel()
        roi = self.make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
        size = camera.height, camera.width, "plumb_bob"
        head = self.header(time, OPTICAL)
        self.write(topic, "sensor_msgs/msg/CameraInfo", time, head, *size, *numbers, 0, 0, roi)

    def pose(self, kind: str, place: str, pose: np.ndarray):
        """A message of a place and a quaternion."""
        at = self.make(f"geometry_msgs/msg/{place}", *pose[:3, 3].tolist())
        turn = self.make("geometry_msgs/msg/Quaternion", *quaternion(pose))
        return self.make(f"geometry_msgs/msg/{kind}", at, turn)

    def tf(self, topic: str, time: float, parent: str, child: str, pose: np.ndarray) -> None:
        head, step = self.header(time, parent), self.pose("Transform", "Vector3", pose)
        stamped = self.make("geometry_msgs/msg/TransformStamped", head, child, step)
        self.write(topic, "tf2_msgs/msg/TFMessage", time, [stamped])

    def stamped(self, topic: str, time: float, pose: np.ndarray) -> None:
        made = self.pose("Pose", "Point", pose)
        self.write(topic, "geometry_msgs/msg/PoseStamped", time, self.header(time, "map"), made)

    def odometry(self, topic: str, time: float, pose: np.ndarray) -> None:
        made = (self.pose("Pose", "Point", pose), np.zeros(36))
        zero = self.make("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
        still = self.make("geometry_msgs/msg/Twist", zero, zero), np.zeros(36)
        values = self.header(time, "odom"), "base_link"
        values += (self.make("geometry_msgs/msg/PoseWithCovariance", *made),)
        values += (self.make("geometry_msgs/msg/TwistWithCovariance", *still),)
        self.write(topic, "nav_msgs/msg/Odometry", time, *values)

    def motion_capture(self, time: float, pose: np.ndarray) -> None:
        values = self.header(time, "room"), "base_link", self.pose("Transform", "Vector3", pose)
        self.write("/mocap/robot", "geometry_msgs/msg/TransformStamped", time, *values)


def slipped(pose: np.ndarray, k: int) -> np.ndarray:
    """A pose of wheels that slip."""
    return tracks.rigid((0.3 * k, 0, 0), (0, 0, np.sin(0.1 * k), np.cos(0.1 * k))) @ pose


POSES = {
    "mount": lambda bag, k, time, body: bag.tf("/tf_static", time, "base_link", OPTICAL, MOUNT),
    "tf": lambda bag, k, time, body: bag.tf("/tf", time, "map", "base_link", body),
    "gap": lambda bag, k, time, body: 3 < k < 8 or POSES["tf"](bag, k, time, body),
    "wheels": lambda bag, k, time, body: bag.odometry("/wheels", time + 0.01, slipped(body, k)),
    "filter": lambda bag, k, time, body: bag.odometry("/filter", time, body),
    "motion capture": lambda bag, k, time, body: bag.motion_capture(time, body),
    "body": lambda bag, k, time, body: bag.stamped("/slam/pose", time, body),
    "camera": lambda bag, k, time, body: bag.stamped("/slam/pose", time, body @ MOUNT),
    "goal": lambda bag, k, time, body: k or bag.stamped("/goal_pose", 99.5, np.eye(4)),
}
"""Writers of the pose topics of a robot, called at each frame."""


def write_bag(
    path: Path,
    dataset,
    version: int = 2,
    leave_out: str = "",
    poses: tuple[str, ...] = ("mount", "tf"),
    storage: str = "SQLITE3",
    compressed: str = "",
    depth: bool = True,
) -> Path:
    """Write a bag without the topics whose names contain `leave_out`. compressed: encoding of
    compressed depth. depth: with depth, and images that are no keyframes."""
    bag = Bag(path, version, storage)
    with bag.writer:
        for k, frame in enumerate(dataset.frames):
            time, camera = 100 + 0.5 * k, frame.camera
            for kind in poses if leave_out != "tf" else ():
                POSES[kind](bag, k, time, camera.camera_to_world @ np.linalg.inv(MOUNT))
            rgb = np.asarray(Image.open(frame.image_path))
            if not depth:
                bag.image("/camera/color/image_raw", time, "rgb8", rgb)
            elif leave_out != "colour":
                bag.image("/camera/color/image_raw", time, "bgr8", rgb[..., ::-1])
                bag.image("/camera/color/image_raw", time + 0.2, "bgr8", 0 * rgb)  # no keyframe
            if leave_out != "camera_info":
                bag.lens("/camera/color/camera_info", time, camera)
            topic = "/camera/aligned_depth/image_raw"
            if not depth:
                continue
            if compressed:
                topic = f"{topic}/compressedDepth"
                bag.compressed_depth(topic, time + 0.01, compressed, frame.depth())
            else:
                millimetres = np.round(1000 * frame.depth()).astype(np.uint16)
                bag.image(topic, time + 0.01, "16UC1", millimetres)
    return path


def write_tum(root: Path, dataset) -> Path:
    """Folder as of the benchmark."""
    copy_images(dataset, root / "rgb", root / "depth", unit=1 / 5000)
    frames = list(enumerate(dataset.frames))
    listed = {
        "rgb": [f"{100 + k} rgb/{k}.png" for k, _ in frames],
        "depth": [f"{100.01 + k} depth/{k}.png" for k, _ in frames],
        "groundtruth": ["# timestamp tx ty tz qx qy qz qw"]
        + [pose_line(100.0 + k, frame) for k, frame in frames],
    }
    for kind, lines in listed.items():
        (root / f"{kind}.txt").write_text("\n".join(lines))
    K = opencv_K(dataset.frames[0].camera)
    (root / "calibration.txt").write_text(f"{K[0, 0]} {K[1, 1]} {K[0, 2]} {K[1, 2]}")
    return root


def write_open3d(root: Path, dataset) -> Path:
    """Folder with color/, depth/, trajectory.log and camera_intrinsic.json."""
    copy_images(dataset, root / "color", root / "depth")
    text, camera = "", dataset.frames[0].camera
    for k, frame in enumerate(dataset.frames):
        rows = [" ".join(map(repr, row)) for row in frame.camera.camera_to_world.tolist()]
        text += "\n".join([f"{k} {k} {k + 1}", *rows, ""])
    (root / "trajectory.log").write_text(text)
    record = {"width": camera.width, "height": camera.height}
    record["intrinsic_matrix"] = opencv_K(camera).T.ravel().tolist()
    (root / "camera_intrinsic.json").write_text(json.dumps(record))
    return root


def write_rtabmap(root: Path, dataset) -> Path:
    """Folder of `rtabmap-export`, with calibrations as OpenCV writes them."""
    copy_images(dataset, root / "rtabmap_rgb", root / "rtabmap_depth")
    (root / "rtabmap_calib").mkdir()
    lines = ["#timestamp x y z qx qy qz qw id"]
    for k, frame in enumerate(dataset.frames):
        file = cv2.FileStorage(str(root / f"rtabmap_calib/{k}.yaml"), cv2.FILE_STORAGE_WRITE)
        file.write("camera_matrix", opencv_K(frame.camera))
        file.write("distortion_coefficients", np.zeros((1, 5)))
        file.release()
        lines.append(pose_line(100.0 + k, frame, k))
    (root / "rtabmap_camera_poses.txt").write_text("\n".join(lines))
    return root


def write_metashape(root: Path, dataset) -> Path:
    """cameras.xml of half the scale, which its chunk states; images beside it."""
    shutil.copytree(dataset.root / "images", root / "images")
    camera, rows = dataset.frames[0].camera, ""
    for k, frame in enumerate(dataset.frames):
        pose = frame.camera.camera_to_world.copy()
        pose[:3, 3] /= 2
        words = " ".join(map(repr, pose.ravel().tolist()))
        rows += f'<camera id="{k}" sensor_id="0" label="{frame.name}">'
        rows += f"<transform>{words}</transform></camera>"
    rows += '<camera id="99" sensor_id="0" label="not_aligned"/>'
    size = f'<resolution width="{camera.width}" height="{camera.height}"/>'
    inner = f"{size}<f>{camera.K[0, 0]}</f>"
    lens = f'<calibration type="frame" class="adjusted">{inner}</calibration>'
    (root / "cameras.xml").write_text(
        '<?xml version="1.0" encoding="UTF-8"?><document version="2.0.0"><chunk label="Chunk 1">'
        f'<sensors><sensor id="0" type="frame">{size}{lens}</sensor></sensors>'
        f"<cameras>{rows}</cameras><transform><scale>2</scale></transform></chunk></document>"
    )
    return root / "cameras.xml"


WRITERS = {
    "ROS bag 2": lambda root, data: write_bag(root / "bag", data),
    "ROS bag MCAP": lambda root, data: write_bag(
        root / "bag", data, storage="MCAP", poses=("camera",), compressed="16UC1"
    ),
    "ROS bag 1": lambda root, data: write_bag(root / "one.bag", data, 1, compressed="32FC1"),
    "TUM RGB-D": lambda root, data: write_tum(root / "tum", data),
    "Open3D": lambda root, data: write_open3d(root / "open3d", data),
    "RTAB-Map": lambda root, data: write_rtabmap(root / "rtabmap", data),
    "Metashape": lambda root, data: write_metashape(root / "metashape", data),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_cameras_pixels_and_depth_are_those_recorded(dataset, tmp_path, capsys, kind):
    source, out = WRITERS[kind](tmp_path, dataset), tmp_path / "out"
    command("import", source, "--out", out, *(("--pose", "/slam/pose") if "MCAP" in kind else ()))
    printed, _ = said(capsys)
    assert "lengths in metres" in printed
    assert not (tmp_path / "out.unpacked").exists()
    made = load_dataset(out)
    assert len(made) == len(dataset)
    assert np.allclose(made.world.up, (0, 0, 1), atol=1e-9)
    for one, other in zip(dataset.frames, made.frames, strict=True):
        assert np.allclose(one.camera.world_to_camera, other.camera.world_to_camera, atol=1e-6)
        assert np.allclose(one.camera.K, other.camera.K, atol=1e-9)
        assert np.array_equal(one.rgb(), other.rgb())
        if kind != "Metashape":
            assert np.abs(one.depth() - other.depth()).max() < 6e-4


def test_keyframes_by_distance(dataset, tmp_path):
    source = write_tum(tmp_path / "tum", dataset)
    eyes = np.array([frame.camera.position for frame in dataset.frames])
    step = np.linalg.norm(eyes[1] - eyes[0])
    command("import", source, "--out", tmp_path / "out", "--keyframes", f"{1.5 * step}m")
    chosen = [frame.camera.position for frame in load_dataset(tmp_path / "out").frames]
    assert np.allclose(chosen, eyes[::2], atol=1e-6)


def test_poses_are_interpolated():
    start, end = np.eye(4), tracks.rigid((2, 0, 0), (0, 0, 1, 1))
    track = tracks.Track.of([(3.0, end), (1.0, start)])
    middle = track.at(2.0)
    assert np.allclose(middle[:3, 3], [1, 0, 0])
    assert np.allclose(Rotation.from_matrix(middle[:3, :3]).as_rotvec(degrees=True), [0, 0, 45])
    assert track.at(0.9) is None
    assert track.at(3.1) is None
    assert tracks.Track.of([(1.0, end)]).at(9.0)[0, 3] == 2
    lost = tracks.Track.of([(t, start) for t in (0.0, 0.1, 0.2, 0.3, 2.0)] + [(4.0, end)])
    assert lost.at(1.0) is not None, "it did not move"
    assert lost.at(3.0) is None
    assert np.allclose(lost.at(4.0), end)


@pytest.mark.parametrize("text", ["", "0.5", "-1s", "1 km"])
def test_bad_spacings(text):
    with pytest.raises(InputError, match="expected seconds or metres"):
        tracks.Spacing.parse(text)


LEFT_OUT = {
    "tf": "record /tf and /tf_static",
    "camera_info": "has no camera_info",
    "colour": "images are none",
}


@pytest.mark.parametrize("topic", LEFT_OUT)
def test_a_bag_without_a_topic_is_one_line(dataset, tmp_path, capsys, topic):
    source = write_bag(tmp_path / "bag", dataset, leave_out=topic)
    line = refused(capsys, ["import", source, "--out", tmp_path / "out"], tmp_path)
    assert LEFT_OUT[topic] in line


def nonsense(path: Path) -> None:
    path.write_text(path.read_text() + "\nnonsense\n")


def halved(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def b2(path: Path) -> None:
    path.write_text(path.read_text().replace("</f>", "</f><b2>1</b2>"))


@pytest.mark.parametrize(
    ("kind", "name", "damage", "message"),
    [
        ("ROS bag 1", "one.bag", halved, "not a readable ROS bag"),
        ("TUM RGB-D", "calibration.txt", Path.unlink, "fx fy cx cy"),
        ("TUM RGB-D", "calibration.txt", nonsense, "not all numbers"),
        ("TUM RGB-D", "groundtruth.txt", nonsense, "fewer than 8"),
        ("Metashape", "cameras.xml", halved, "not valid XML"),
        ("Metashape", "cameras.xml", b2, "b2 or k4"),
        ("RTAB-Map", "3.yaml", halved, "camera_matrix"),
    ],
)
def test_damaged_recordings_are_one_line(dataset, tmp_path, capsys, kind, name, damage, message):
    source = WRITERS[kind](tmp_path, dataset)
    damage(next(tmp_path.rglob(name)))
    assert message in refused(capsys, ["import", source, "--out", tmp_path / "out"], tmp_path)
