"""Imports of recordings: ROS bags, TUM RGB-D, Open3D, 7-Scenes, RTAB-Map, Metashape."""

import json
import shutil
import struct
import zipfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import synthetic
from PIL import Image
from program import command, said
from refusals import fails, refused
from scipy.spatial.transform import Rotation

from mgs import Camera, load_dataset
from mgs.data import shots
from mgs.data.peers import is_peer
from mgs.data.sources import read_source

MOUNT = shots.rigid((0.1, -0.2, 0.3), (0.5, -0.5, 0.5, -0.5))
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
        steps = in_millimetres(metres) if encoding == "16UC1" else np.round(steps)
        png = cv2.imencode(".png", steps.astype(np.uint16))[1]
        data = np.frombuffer(struct.pack("<iff", 0, 60000, -10) + png.tobytes(), np.uint8)
        head, form = self.header(time, OPTICAL), f"{encoding}; compressedDepth png"
        self.write(topic, "sensor_msgs/msg/CompressedImage", time, head, form, data)

    def lens(self, topic: str, time: float, camera, model: str, distortion, window) -> None:
        D, K = np.array(distortion), opencv_K(camera).ravel()
        numbers = D, K, np.eye(3).ravel(), np.eye(3, 4).ravel()
        roi = self.make("sensor_msgs/msg/RegionOfInterest", *window, False)
        size = camera.height, camera.width, model
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


def in_millimetres(metres: np.ndarray) -> np.ndarray:
    """Numbers of a depth camera that gives 65535 where it sees nothing."""
    return np.where(metres > 0, np.round(1000 * metres), 65535).astype(np.uint16)


def slipped(pose: np.ndarray, k: int) -> np.ndarray:
    """A pose of wheels that slip."""
    return shots.rigid((0.3 * k, 0, 0), (0, 0, np.sin(0.1 * k), np.cos(0.1 * k))) @ pose


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
    path, dataset, version=2, leave_out="", poses=("mount", "tf"), storage="SQLITE3", compressed="",
    depth=True, distortion=("plumb_bob", np.zeros(5)), whole=lambda camera: camera,
    window=(0, 0, 0, 0),
):  # fmt: skip
    """Write a bag without the topics whose names contain `leave_out`. compressed: encoding of
    compressed depth. depth: with depth, and images that are no keyframes. distortion: model of
    the lens, and its numbers. whole: camera of all pixels of the sensor. window: x, y, height and
    width of the part of them that is recorded."""
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
                lens = whole(camera), *distortion, window
                bag.lens("/camera/color/camera_info", time, *lens)
            topic = "/camera/aligned_depth/image_raw"
            if not depth:
                continue
            if compressed:
                topic = f"{topic}/compressedDepth"
                bag.compressed_depth(topic, time + 0.01, compressed, frame.depth())
            else:
                millimetres = in_millimetres(frame.depth())
                bag.image(topic, time + 0.01, "16UC1", millimetres)
    return path


def write_tum(root: Path, dataset) -> Path:
    """Folder as of the benchmark."""
    copy_images(dataset, root / "rgb", root / "depth", unit=1 / 5000)
    frames = list(enumerate(dataset.frames))
    poses = [pose_line(100.0 + k, frame) for k, frame in frames]
    for kind, lines in {
        "rgb": [f"{100 + k} rgb/{k}.png" for k, _ in frames],
        "depth": [f"{100.01 + k} depth/{k}.png" for k, _ in frames],
        "groundtruth": ["# timestamp tx ty tz qx qy qz qw", *poses],
    }.items():
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


def write_seven_scenes(root: Path, dataset) -> Path:
    """Folder of NAME.color.png, NAME.depth.png and NAME.pose.txt, one of which is lost."""
    copy_images(dataset, root / "color", root / "depth")
    for k, frame in enumerate(dataset.frames):
        for kind in ("color", "depth"):
            (root / kind / f"{k}.png").rename(root / f"frame-{k:06d}.{kind}.png")
        np.savetxt(root / f"frame-{k:06d}.pose.txt", frame.camera.camera_to_world)
    shutil.copy(root / "frame-000000.color.png", root / "frame-000099.color.png")
    (root / "frame-000099.pose.txt").write_text("-1.#INF 0 0 0\n" * 4)
    np.savetxt(root.parent / "camera-intrinsics.txt", opencv_K(dataset.frames[0].camera))
    return root


TO_ARKIT = np.array([[-1.0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


def opengl(frame) -> np.ndarray:
    """Camera-to-world of a frame, with the camera axes of OpenGL."""
    return frame.camera.camera_to_world @ np.diag([1, -1, -1, 1])


def write_scanner(root: Path, dataset) -> Path:
    """Export "All Data" of 3D Scanner App: ARKit's world is +Y up, and most poses have no image."""
    copy_images(dataset, root / "colour", root / "depth")
    for k, frame in enumerate(dataset.frames):
        camera, number, pose = frame.camera, f"{6 * k:05d}", TO_ARKIT @ opengl(frame)
        record = {"cameraPoseARFrame": pose.ravel().tolist(), "time": 90 + frame.timestamp}
        (root / f"frame_{number}.json").write_text(
            json.dumps(record | {"intrinsics": camera.K.ravel().tolist()})
        )
        (root / f"frame_{6 * k + 1:05d}.json").write_text(json.dumps(record))
        # A PNG by content, so that pixels stay; the program writes JPEG.
        (root / f"colour/{k}.png").rename(root / f"frame_{number}.jpg")
        (root / f"depth/{k}.png").rename(root / f"depth_{number}.png")
        Image.new("L", (8, 6), 2).save(root / f"conf_{number}.png")
        Image.new("RGB", (8, 6)).save(root / f"thumb_{number}.jpg")
    return root


def write_polycam(root: Path, dataset, corrected: str = "") -> Path:
    """Raw data of Polycam. corrected: beginning of the names of the folders of its pictures."""
    folder = root / "keyframes"
    copy_images(dataset, folder / f"{corrected}images", folder / "depth")
    for name in (f"{corrected}cameras", "confidence"):
        (folder / name).mkdir()
    for k, frame in enumerate(dataset.frames):
        camera, name = frame.camera, f"{2_350_514_675_632 + round(1e6 * frame.timestamp)}"
        numbers = zip(("fx", "cx", "fy", "cy"), camera.K[[0, 0, 1, 1], [0, 2, 1, 2]], strict=True)
        pose = (TO_ARKIT @ opengl(frame))[:3]
        record = dict(numbers) | {f"t_{i}{j}": value for (i, j), value in np.ndenumerate(pose)}
        if not corrected:  # as newer versions
            record |= {"width": camera.width, "height": camera.height}
        (folder / f"{corrected}cameras/{name}.json").write_text(json.dumps(record))
        image = folder / f"{corrected}images"
        (image / f"{k}.png").rename(image / f"{name}.jpg")
        (folder / f"depth/{k}.png").rename(folder / f"depth/{name}.png")
        Image.new("L", (16, 12), 255).save(folder / f"confidence/{name}.png")
    return root


def write_record3d(root: Path, dataset, exported: bool) -> Path:
    """What Record3D exports as EXR + RGB, or as .r3d with depth that cannot be read."""
    camera = dataset.frames[0].camera
    poses = [[*quaternion(opengl(f)), *f.camera.position.tolist()] for f in dataset.frames]
    about = {"K": camera.K.T.ravel().tolist(), "w": camera.width, "h": camera.height}
    metadata = json.dumps(about | {"fps": 2, "poses": poses})
    if exported:
        copy_images(dataset, root / "rgb", root / "depth")
        (root / "metadata.json").write_text(metadata)
        for k, frame in enumerate(dataset.frames):
            (root / f"rgb/{k}.png").rename(root / f"rgb/{k}.jpg")
            shutil.copy(frame.depth_path, root / f"depth/{k}.exr")
        return root
    with zipfile.ZipFile(root / "scan.r3d", "w") as archive:
        archive.writestr("metadata", metadata)
        for k, frame in enumerate(dataset.frames):
            archive.write(frame.image_path, f"rgbd/{k}.jpg", zipfile.ZIP_DEFLATED)
            archive.writestr(f"rgbd/{k}.depth", b"bvx2")
    return root / "scan.r3d"


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


def peer_parts(root: Path, dataset) -> list[tuple[str, np.ndarray, Camera]]:
    """Name, world to camera and camera of each frame; the images lie in root/images."""
    shutil.copytree(dataset.root / "images", root / "images")
    return [(f.image_path.name, f.camera.world_to_camera, f.camera) for f in dataset.frames]


def write_opensfm(root: Path, dataset) -> Path:
    shots, camera = {}, dataset.frames[0].camera
    for name, pose, _ in peer_parts(root, dataset):
        rotation = Rotation.from_matrix(pose[:3, :3]).as_rotvec().tolist()
        shots[name] = {"camera": "c", "rotation": rotation, "translation": pose[:3, 3].tolist()}
    lens = {"projection_type": "perspective", "width": camera.width, "height": camera.height}
    lens |= {"focal": camera.K[0, 0] / camera.width, "k1": 0.0, "k2": 0.0}
    place = {"latitude": 47.0, "longitude": 8.0, "altitude": 400.0}
    part = {"cameras": {"c": lens}, "shots": shots, "points": {}, "reference_lla": place}
    (root / "opensfm").mkdir()
    (root / "opensfm/reconstruction.json").write_text(json.dumps([part]))
    return root


def write_bundler(root: Path, dataset) -> Path:
    """y up, z backwards; one camera more that is not placed."""
    parts = peer_parts(root, dataset)
    listed = [f"./images/{name} 0 70.4" for name, *_ in parts] + ["./images/lost.jpg"]
    lines = ["# Bundle file v0.3", f"{len(listed)} 1"]
    for _, pose, camera in parts:
        turned = [[1], [-1], [-1]] * pose[:3]
        rows = [*turned[:, :3].tolist(), turned[:, 3].tolist()]
        lines += [f"{camera.K[0, 0]} 0 0", *(" ".join(map(repr, row)) for row in rows)]
    lines += ["0 0 0", *["0 0 0"] * 4, "0.1 0.2 0.3", "255 0 0", "2 0 5 1.5 2.5 1 6 3.5 4.5"]
    (root / "list.txt").write_text("\n".join(listed))
    (root / "bundle").mkdir()
    (root / "bundle/bundle.out").write_text("\n".join(lines))
    return root


def write_llff(root: Path, dataset) -> Path:
    rows = []
    for _, pose, camera in peer_parts(root, dataset):
        right, down, ahead, eye = np.linalg.inv(pose)[:3].T
        shape = [camera.height, camera.width, camera.K[0, 0]]
        rows.append([*np.column_stack([down, right, -ahead, eye, shape]).ravel(), 1.0, 9.0])
    np.save(root / "poses_bounds.npy", np.array(rows))
    return root


def write_mvsnet(root: Path, dataset) -> Path:
    (root / "cams").mkdir(parents=True)
    for name, pose, camera in peer_parts(root, dataset):
        text = ["\n".join(" ".join(map(repr, row)) for row in m.tolist()) for m in (pose, camera.K)]
        words = f"extrinsic\n{text[0]}\n\nintrinsic\n{text[1]}\n\n0.5 0.1\n"
        (root / f"cams/{Path(name).stem}_cam.txt").write_text(words)
    return root


def write_benchmark(root: Path, dataset) -> Path:
    (root / "gt_dense_cameras").mkdir(parents=True)
    for name, pose, camera in peer_parts(root, dataset):
        back, size = np.linalg.inv(pose), (camera.width, camera.height)
        parts = *camera.K, (0, 0, 0), *back[:3, :3], back[:3, 3], size
        text = "\n".join(" ".join(repr(float(number)) for number in row) for row in parts)
        (root / f"gt_dense_cameras/{name}.camera").write_text(text)
    return root


def write_splatting(root: Path, dataset) -> Path:
    rows = []
    for name, pose, camera in peer_parts(root, dataset):
        back, (fx, fy) = np.linalg.inv(pose), np.diag(camera.K)[:2].tolist()
        row = {"img_name": Path(name).stem, "fx": fx, "fy": fy}
        row |= {"width": camera.width, "height": camera.height}
        rows.append(row | {"position": back[:3, 3].tolist(), "rotation": back[:3, :3].tolist()})
    (root / "cameras.json").write_text(json.dumps(rows))
    return root


WRITERS = {
    "ROS bag 2": lambda root, data: write_bag(root / "bag", data),
    "ROS bag MCAP": lambda root, data: write_bag(
        root / "bag", data, storage="MCAP", poses=("camera",), compressed="16UC1"
    ),
    "ROS bag 1": lambda root, data: write_bag(root / "one.bag", data, 1, compressed="32FC1"),
    "TUM RGB-D": lambda root, data: write_tum(root / "tum", data),
    "Open3D": lambda root, data: write_open3d(root / "open3d", data),
    "7-Scenes": lambda root, data: write_seven_scenes(root / "seq-01", data),
    "3D Scanner App": lambda root, data: write_scanner(root / "scan", data),
    "RTAB-Map": lambda root, data: write_rtabmap(root / "rtabmap", data),
    "Polycam": lambda root, data: write_polycam(root / "polycam", data),
    "Record3D": lambda root, data: write_record3d(root / "record3d", data, exported=True),
    "Metashape": lambda root, data: write_metashape(root / "metashape", data),
    "Record3D r3d": lambda root, data: write_record3d(root, data, exported=False),
    "OpenSfM": lambda root, data: write_opensfm(root / "opensfm", data),
    "Bundler": lambda root, data: write_bundler(root / "bundler", data),
    "LLFF": lambda root, data: write_llff(root / "llff", data),
    "MVSNet": lambda root, data: write_mvsnet(root / "mvsnet", data),
    "openMVG benchmark": lambda root, data: write_benchmark(root / "benchmark", data),
    "3D Gaussian Splatting": lambda root, data: write_splatting(root / "splats", data),
}
OPTIONS = {
    "ROS bag MCAP": ("--pose", "/slam/pose"),
    **dict.fromkeys(("Record3D", "Record3D r3d"), ("--up", "0,0,1")),
    **dict.fromkeys([*WRITERS][-5:], ("--unit", 1, "--up", "0,0,1")),
}
"""Options for facts that the files of these programs lack."""


@pytest.mark.parametrize("kind", WRITERS)
def test_cameras_pixels_and_depth_are_those_recorded(dataset, tmp_path, capsys, kind):
    source, out = WRITERS[kind](tmp_path, dataset), tmp_path / "out"
    command("import", source, "--out", out, *OPTIONS.get(kind, ()))
    printed, _ = said(capsys)
    assert "lengths in metres" in printed
    assert not (tmp_path / "out.unpacked").exists()
    made = load_dataset(out)
    assert len(made) == len(dataset)
    upward = (0, 1, 0) if kind in ("3D Scanner App", "Polycam") else (0, 0, 1)
    assert np.allclose(made.world.up, upward, atol=1e-9)
    for one, other in zip(dataset.frames, made.frames, strict=True):
        assert np.allclose(one.camera.world_to_camera, other.camera.world_to_camera, atol=1e-6)
        assert np.allclose(one.camera.K, other.camera.K, atol=1e-9)
        assert np.array_equal(one.rgb(), other.rgb())
        if [*WRITERS].index(kind) < [*WRITERS].index("Metashape"):
            assert np.abs(one.depth() - other.depth()).max() < 6e-4


@pytest.mark.parametrize("kind", ["3D Scanner App", "Polycam"])
def test_depth_of_the_lowest_confidence_is_none(dataset, tmp_path, kind):
    source = WRITERS[kind](tmp_path, dataset)
    path = min((*source.glob("conf_*"), *source.glob("keyframes/confidence/*")))
    levels = np.array([[0, 1], [2, 0]], np.uint8).repeat(3, 0).repeat(4, 1)
    Image.fromarray(levels).save(path)
    command("import", source, "--out", tmp_path / "out")
    low = (levels == 0).repeat(8, 0).repeat(8, 1)
    one, other = dataset.frames[0].depth(), load_dataset(tmp_path / "out").frames[0].depth()
    assert np.abs(np.where(low, 0, one) - other).max() < 6e-4


def test_corrected_pictures_of_polycam_lose_their_rim(dataset, tmp_path):
    """They are taken where there are others, which are distorted."""
    source = write_polycam(tmp_path / "polycam", dataset, "corrected_")
    for name in ("images", "cameras"):
        (source / "keyframes" / name).mkdir()
    command("import", source, "--out", tmp_path / "out")
    made = load_dataset(tmp_path / "out").frames
    assert len(made) == len(dataset)
    for one, frame in zip(dataset.frames, made, strict=True):
        assert (frame.camera.width, frame.camera.height) == (62, 46)
        assert np.allclose(frame.camera.K, one.camera.K - [[0, 0, 1], [0, 0, 1], [0, 0, 0]])
        assert np.allclose(frame.camera.world_to_camera, one.camera.world_to_camera, atol=1e-6)
        assert np.array_equal(frame.rgb(), one.rgb()[1:-1, 1:-1])
        assert np.abs(frame.depth() - one.depth()[1:-1, 1:-1]).max() < 6e-4


def test_an_unzipped_r3d_is_read_as_the_zip(dataset, tmp_path):
    source = write_record3d(tmp_path, dataset, exported=False)
    shutil.unpack_archive(source, tmp_path / "folder", "zip")
    one, other = (
        read_source(path, unpack=tmp_path / "u") for path in (source, tmp_path / "folder")
    )
    assert [shot.camera for shot in one.shots] == [shot.camera for shot in other.shots]
    assert [shot.image.read_bytes() for shot in one.shots] == [
        shot.image.read_bytes() for shot in other.shots
    ]
    assert one.notes == other.notes == (one.notes[0],)
    assert "LZFSE" in one.notes[0]


@pytest.mark.parametrize("size", [(16, 12), (13, 10)])
def test_reduced_pictures_of_llff_scale_each_axis_of_its_cameras(dataset, tmp_path, size):
    """In images_4, where they have other names in the same order."""
    root, out = write_llff(tmp_path / "llff", dataset), tmp_path / "out"
    (root / "images_4").mkdir()
    for k, frame in enumerate(dataset.frames):
        with Image.open(frame.image_path) as image:
            image.resize(size).save(root / f"images_4/image{k:03d}.png")
    (root / "sparse").mkdir()
    for name in ("cameras.txt", "images.txt", "points3D.txt"):
        (root / "sparse" / name).touch()  # a model is taken before LLFF, unless this is the source
    given = root / "poses_bounds.npy", "--images", root / "images_4", "--up", "0,0,1"
    command("import", *given, "--out", out)
    for one, other in zip(dataset.frames, load_dataset(out).frames, strict=True):
        assert (other.camera.width, other.camera.height) == size
        across, down = np.divide(size, (one.camera.width, one.camera.height))
        assert np.allclose(other.camera.K, one.camera.K * [[across], [down], [1]])
        assert np.allclose(one.camera.world_to_camera, other.camera.world_to_camera, atol=1e-6)


def test_a_bag_moves_without_turning_or_climbing_far_from_the_origin(dataset, tmp_path):
    """In UTM, where its steps are small against its coordinates."""
    turn, frames = dataset.frames[0].camera.world_to_camera[:3, :3], []
    for k, frame in enumerate(dataset.frames):
        pose = np.block([[turn, -turn @ [[5e5 + k / 4], [5e6], [3]]], [np.eye(4)[3]]])
        frames.append(replace(frame, camera=replace(frame.camera, world_to_camera=pose)))
    bag = write_bag(tmp_path / "bag", replace(dataset, frames=tuple(frames)))
    shots = read_source(bag, unpack=tmp_path / "unpacked").shots
    steps = np.diff([shot.camera.position for shot in shots], axis=0)
    assert np.allclose(steps, [0.25, 0, 0], atol=1e-6)


def opensfm_pixels(root: Path, points: np.ndarray) -> np.ndarray:
    """Pixels of points [N,3] in the first image by OpenSfM's formulas of the brown camera, after
    the lens was made one."""
    c = {"focal_x": 1.2, "focal_y": 1.1, "c_x": 0.03, "c_y": -0.05}
    c |= {"k1": -0.1, "k2": 0.03, "k3": 0.01, "p1": 0.004, "p2": -0.006}
    path = root / "opensfm/reconstruction.json"
    data = json.loads(path.read_text())
    lens, shot = data[0]["cameras"]["c"], data[0]["shots"]["kf_0000.png"]
    lens.update(c, projection_type="brown")
    path.write_text(json.dumps(data))
    x, y, z = (Rotation.from_rotvec(shot["rotation"]).apply(points) + shot["translation"]).T
    u, v = x / z, y / z
    r2 = u * u + v * v
    radial = 1 + r2 * (c["k1"] + r2 * (c["k2"] + r2 * c["k3"]))
    across = u * radial + 2 * c["p1"] * u * v + c["p2"] * (r2 + 2 * u * u)
    down = v * radial + 2 * c["p2"] * u * v + c["p1"] * (r2 + 2 * v * v)
    normalised = np.column_stack([c["focal_x"] * across + c["c_x"], c["focal_y"] * down + c["c_y"]])
    size = np.array([lens["width"], lens["height"]])
    return normalised * size.max() + (size - 1) / 2 + 0.5  # its first pixel's centre is 0


def bundler_pixels(root: Path, points: np.ndarray) -> np.ndarray:
    """Follow the formulas of Bundler's manual, y up from the middle of the image."""
    path = root / "bundle/bundle.out"
    lines = path.read_text().splitlines()
    f, k1, k2 = 60.0, -0.1, 0.03
    lines[2] = f"{f} {k1} {k2}"
    path.write_text("\n".join(lines))
    *R, t = (np.array(line.split(), float) for line in lines[3:7])
    P = points @ np.array(R).T + t
    p = -P[:, :2] / P[:, 2:]
    r2 = (p * p).sum(1, keepdims=True)
    return [32, 24] + f * (1 + k1 * r2 + k2 * r2**2) * p * [1, -1]


def mvsnet_pixels(root: Path, points: np.ndarray) -> np.ndarray:
    path = root / "cams/kf_0000_cam.txt"
    rows = [line.split() for line in path.read_text().splitlines()]
    pose, K = np.array(rows[1:5], float), np.array([[70.0, 0, 30], [0, 71, 27], [0, 0, 1]])
    rows[7:10] = K.astype(str).tolist()
    path.write_text("\n".join(" ".join(row) for row in rows))
    x = (points @ pose[:3, :3].T + pose[:3, 3]) @ K.T
    return x[:, :2] / x[:, 2:]


@pytest.mark.parametrize(
    ("kind", "pixels_of"),
    [("OpenSfM", opensfm_pixels), ("Bundler", bundler_pixels), ("MVSNet", mvsnet_pixels)],
)
def test_lenses_and_centres_are_those_of_the_programs(dataset, tmp_path, kind, pixels_of):
    source, points = WRITERS[kind](tmp_path, dataset), synthetic.rock_mesh().vertices[::20]
    expected = pixels_of(source, points)
    shot = read_source(source).shots[0]
    pixels = shot.camera.project(points)[0]
    if shot.lens is not None:
        pose = shot.camera.world_to_camera
        lens = shot.lens.camera(shot.camera.width, shot.camera.height)
        pixels = lens.img_from_cam(points @ pose[:3, :3].T + pose[:3, 3])
    np.testing.assert_allclose(pixels, expected, atol=1e-6)


def test_an_object_named_as_another_programs_list_is_no_source_of_it(dataset, tmp_path):
    """ODM writes an object of lenses as cameras.json; a transforms.json may have any name."""
    shutil.copytree(dataset.root / "images", tmp_path / "images")
    path = tmp_path / "cameras.json"
    shutil.copy(dataset.root / "transforms.json", path)
    assert not is_peer("3D Gaussian Splatting", tmp_path)
    assert len(read_source(path).shots) == len(dataset)


def test_a_name_without_an_ending_is_a_photograph_in_metashape_and_a_png_elsewhere(
    dataset, tmp_path
):
    """A cut-out as PNG may lie beside a photograph, and a preview as JPEG beside a PNG."""
    metashape = write_metashape(tmp_path / "metashape", dataset)

    def bare(data):
        for record in data["frames"]:
            record["file_path"] = record["file_path"].removesuffix(".png")

    copy = shutil.copytree(dataset.root, tmp_path / "copy")
    synthetic.edit(copy, bare)
    for source, ending in ((metashape, ".jpg"), (copy / "transforms.json", ".png")):
        for path in list((source.parent / "images").glob("*.png")):
            shutil.copy(path, path.with_suffix(".jpg"))
        assert {shot.image.suffix for shot in read_source(source).shots} == {ending}


def test_keyframes_by_distance(dataset, tmp_path):
    source = write_tum(tmp_path / "tum", dataset)
    eyes = np.array([frame.camera.position for frame in dataset.frames])
    step = np.linalg.norm(eyes[1] - eyes[0])
    command("import", source, "--out", tmp_path / "out", "--keyframes", f"{1.5 * step}m")
    chosen = [frame.camera.position for frame in load_dataset(tmp_path / "out").frames]
    assert np.allclose(chosen, eyes[::2], atol=1e-6)


def test_poses_are_interpolated():
    start, end = np.eye(4), shots.rigid((2, 0, 0), (0, 0, 1, 1))
    track = shots.Track.of([(3.0, end), (1.0, start)])
    middle = track.at(2.0)
    assert np.allclose(middle[:3, 3], [1, 0, 0])
    assert np.allclose(Rotation.from_matrix(middle[:3, :3]).as_rotvec(degrees=True), [0, 0, 45])
    assert track.at(0.9) is None
    assert track.at(3.1) is None
    assert shots.Track.of([(1.0, end)]).at(9.0)[0, 3] == 2
    lost = shots.Track.of([(t, start) for t in (0.0, 0.1, 0.2, 0.3, 2.0)] + [(4.0, end)])
    assert lost.at(1.0) is not None, "it did not move"
    assert lost.at(3.0) is None
    assert np.allclose(lost.at(4.0), end)


@pytest.mark.parametrize("text", ["", "0.5", "-1s", "1 km"])
def test_bad_spacings(text):
    fails("expected seconds or metres", shots.Spacing.parse, text)


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


def unmeasured(path: Path) -> None:
    text = path.read_text()
    for name in ("intrinsics", "fx", "K"):
        text = text.replace(f'"{name}"', '"lens"')
    path.write_text(text)


def untimed(path: Path) -> None:
    image = path.parents[1] / "images" / path.stem
    image.with_suffix(".jpg").rename(image.with_name("a.jpg"))
    path.rename(path.with_name("a.json"))


def wide(path: Path) -> None:
    path.write_text(path.read_text().replace(": 64,", ": 641,"))


def with_poses(path: Path, change) -> None:
    about = json.loads(path.read_text())
    change(about["poses"])
    path.write_text(json.dumps(about))


def unturned(path: Path) -> None:
    with_poses(path, lambda poses: poses[3].__setitem__(slice(4), [0, 0, 0, 0]))


def still(path: Path) -> None:
    with_poses(path, lambda poses: poses.__setitem__(slice(None), poses[:1] * len(poses)))


def emptied(path: Path) -> None:
    shutil.rmtree(path)
    path.mkdir()


def bomb(path: Path, size: int = (1 << 25) + 1) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("metadata", b" " * size)


def lying_bomb(path: Path) -> None:
    """A member larger than the directory of its zip says."""
    bomb(path)
    data = bytearray(path.read_bytes())
    data[(at := data.rindex(b"PK\1\2") + 24) : at + 4] = struct.pack("<I", 99)
    path.write_bytes(data)


def no_members(path: Path) -> None:
    zipfile.ZipFile(path, "w").close()


def b2(path: Path) -> None:
    path.write_text(path.read_text().replace("</f>", "</f><b2>1</b2>"))


def skewed(path: Path) -> None:
    lines = path.read_text().split("\n")
    row = lines.index("intrinsic") + 1
    lines[row] = lines[row].replace(" 0.0 ", " 9.0 ", 1)
    path.write_text("\n".join(lines))


def pickled(path: Path) -> None:
    np.save(path, np.array([{}]), allow_pickle=True)


@pytest.mark.parametrize(
    ("kind", "name", "damage", "message"),
    [
        ("ROS bag 1", "one.bag", halved, "not a readable ROS bag"),
        ("TUM RGB-D", "calibration.txt", Path.unlink, "fx fy cx cy"),
        ("TUM RGB-D", "calibration.txt", nonsense, "not all numbers"),
        ("TUM RGB-D", "groundtruth.txt", nonsense, "fewer than 8"),
        ("Metashape", "cameras.xml", halved, "not valid XML"),
        ("Metashape", "cameras.xml", b2, "b2 or k4"),
        ("7-Scenes", "frame-000001.pose.txt", halved, "has 8 numbers; give a 4x4 matrix"),
        ("7-Scenes", "camera-intrinsics.txt", Path.unlink, "no calibration; write fx fy cx cy"),
        ("3D Scanner App", "frame_00006.json", halved, "not valid JSON"),
        ("3D Scanner App", "frame_00006.json", unmeasured, "has no cameraPoseARFrame of 16"),
        ("Polycam", "2350515175632.json", halved, "not valid JSON"),
        ("Polycam", "2350514675632.json", unmeasured, "has no fx, fy, cx, cy and t_00"),
        ("Polycam", "2350514675632.json", untimed, "or no time as its name"),
        ("Polycam", "2350514675632.json", wide, "is 64x48, but its camera is 641x48"),
        ("Polycam", "images", shutil.rmtree, "has no picture of a camera"),
        ("Polycam", "2350514675632.png", halved, "not a readable image"),
        ("Record3D", "metadata.json", halved, "not valid JSON"),
        ("Record3D", "metadata.json", unmeasured, "poses of 7 numbers with a quaternion"),
        ("Record3D", "metadata.json", unturned, "with a quaternion of length 1; export it again"),
        ("Record3D", "metadata.json", wide, "is 64x48, but its camera is 641x48"),
        ("Record3D", "metadata.json", still, "no poses that move, as of the front camera"),
        ("Record3D", "rgb", emptied, "none of its pictures is there, as rgb/0.jpg"),
        ("Record3D r3d", "scan.r3d", halved, "scan.r3d: not a readable zip"),
        ("Record3D r3d", "scan.r3d", bomb, "metadata has 33,554,433 bytes"),
        ("Record3D r3d", "scan.r3d", lying_bomb, "not a readable zip (Bad CRC-32"),
        ("Record3D r3d", "scan.r3d", no_members, "metadata: no such file"),
        ("RTAB-Map", "3.yaml", halved, "camera_matrix"),
        ("OpenSfM", "reconstruction.json", halved, "not valid JSON"),
        ("Bundler", "bundle.out", halved, "9 cameras and 1 points of 9 listed images"),
        ("Bundler", "list.txt", Path.unlink, "list.txt: no such file"),
        ("LLFF", "poses_bounds.npy", halved, "not a readable file of LLFF"),
        ("LLFF", "kf_0003.png", Path.unlink, "has 8 poses for 7 pictures in"),
        ("LLFF", "images", shutil.rmtree, "has no pictures; give their folder as `images`"),
        ("LLFF", "poses_bounds.npy", pickled, "allow_pickle=False"),
        ("MVSNet", "kf_0000_cam.txt", halved, "not a readable file of MVSNet"),
        ("MVSNet", "kf_0000_cam.txt", skewed, "has skew, 9; resample the images"),
        ("openMVG benchmark", "kf_0000.png.camera", halved, "not a readable file of openMVG"),
        ("3D Gaussian Splatting", "cameras.json", nonsense, "not valid JSON"),
    ],
)
def test_damaged_recordings_are_one_line(dataset, tmp_path, capsys, kind, name, damage, message):
    source = WRITERS[kind](tmp_path, dataset)
    damage(next(tmp_path.rglob(name)))
    assert message in refused(capsys, ["import", source, "--out", tmp_path / "out"], tmp_path)
