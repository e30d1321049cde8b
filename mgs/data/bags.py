"""ROS 1 and ROS 2 bags, read by rosbags: images, camera_info, and poses as a chain of frames of tf
or odometry from that of the images to the root, which becomes the world. Keyframes are unpacked."""

from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mgs.camera import Camera
from mgs.data.lens import Lens
from mgs.data.rgbd_folders import opencv_lens
from mgs.data.shots import Shot, Source, Spacing, Track, posed, rigid
from mgs.errors import InputError
from mgs.files import atomic_path, parsing, read_bytes, reading
from mgs.images import UNKNOWN_DEPTH, read_values, write_exr, write_png

STORAGE = (".mcap", ".db3")  # endings of the files of a ROS 2 bag
KINDS = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
COLOURS = {  # encoding of a colour image -> its channels in the order R, G, B
    "rgb8": [0, 1, 2],
    "bgr8": [2, 1, 0],
    "rgba8": [0, 1, 2],
    "bgra8": [2, 1, 0],
    "mono8": [0, 0, 0],
    "8UC3": [2, 1, 0],
}

# Encoding of a depth image -> type of its numbers, and metres in a step (REP 118).
DEPTHS = {"16UC1": ("u2", 1e-3), "mono16": ("u2", 1e-3), "32FC1": ("f4", 1.0)}
DEPTH_HEADER = 12  # bytes before the PNG of a compressedDepth image: a number; a and b as float32
# Distortion models of a camera_info: those of `opencv_lens`, and fisheyes.
LENSES, FISHEYES = ("plumb_bob", "rational_polynomial", ""), ("equidistant", "fisheye")

YAML_BYTES = 1 << 20  # most bytes of the metadata of a bag
UNMOVED = 1e-6  # change of all entries of a pose, up to which a camera does not move
SYNCHRONOUS = 0.05  # largest difference of the times of a colour and its depth image, seconds


def is_bag(path: Path) -> bool:
    """Whether a path is a ROS 1 bag file, or a ROS 2 bag: its folder, or a file of it."""
    by_name = path.suffix in (".bag", *STORAGE) and not path.is_dir()
    return by_name or (path / "metadata.yaml").exists()


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """Context manager: the reader of a bag. Raises InputError where the bag is damaged."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    if path.suffix in STORAGE and (path.parent / "metadata.yaml").is_file():
        path = path.parent
    for file in path.iterdir() if path.is_dir() else [path]:
        with reading(file, "ROS bag"):  # no pipe, which would never end
            pass
    if (path / "metadata.yaml").is_file():
        read_bytes(path / "metadata.yaml", most=YAML_BYTES)
    with (
        parsing(path, "ROS bag", "record it again"),
        AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader,
    ):
        yield reader


def messages(reader: Any, *kinds: str, topic: str | None = None) -> Iterator[tuple[str, Any]]:
    """(topic, message) of the messages of some types, or of a topic, in order of recording."""
    short = {kind.rpartition("/")[2] for kind in kinds}
    connections = [
        connection
        for connection in reader.connections
        if connection.topic == topic or connection.msgtype.rpartition("/")[2] in short
    ]
    if connections:
        for connection, _, raw in reader.messages(connections=connections):
            yield connection.topic, reader.deserialize(raw, connection.msgtype)


def seconds(message: Any) -> float:
    """Time in the header of a message."""
    stamp = message.header.stamp
    return float(stamp.sec + 1e-9 * stamp.nanosec)


def frame_of(message: Any) -> str:
    """Name of the frame in the header of a message; tf once allowed a slash before it."""
    return str(message.header.frame_id).lstrip("/")


def message_of(pose: Any) -> np.ndarray:
    """Matrix [4,4] of a Transform, Pose, or PoseWithCovariance."""
    pose = getattr(pose, "pose", pose)
    place = getattr(pose, "translation", None) or pose.position
    turn = getattr(pose, "rotation", None) or pose.orientation
    return rigid((place.x, place.y, place.z), (turn.x, turn.y, turn.z, turn.w))


Samples = dict[str, list[tuple[float, np.ndarray]]]  # parent -> (time, child-to-parent)


class Tree:
    """Frames of a bag: each with its parent, and the transforms to that over time.

    topic: of poses that take precedence; of a PoseStamped they are those of the frame that static
    transforms make the root of the camera, or of the camera. Raises InputError where a step has two
    sources, or the topic no poses."""

    def __init__(self, path: Path, reader: Any, camera: str, topic: str | None) -> None:
        sources: dict[str, dict[str, Samples]] = defaultdict(lambda: defaultdict(dict))
        main = "" if topic is None else topic
        for name, message in messages(reader, "TFMessage", "tfMessage", "Odometry", topic=topic):
            several = hasattr(message, "transforms")
            for each in message.transforms if several else [message]:
                child = str(getattr(each, "child_frame_id", "")).lstrip("/")
                pose = message_of(each.transform if hasattr(each, "transform") else each.pose)
                kind = "tf" if several else name
                time = 0.0 if "static" in name else seconds(each)
                if frame_of(each) != child:
                    steps = sources[child][kind].setdefault(frame_of(each), [])
                    steps.append((time, pose))
        stamped = sources.pop("", {})  # a PoseStamped names no child
        self.parents: dict[str, str] = {}
        self.tracks: dict[str, Track] = {}
        self.unused: list[str] = []
        for child, by_kind in sources.items():
            self._add(path, child, by_kind, main)
        if topic is not None and stamped:
            body = camera
            while body in self.parents and len(self.tracks[body].times) == 1:
                body = self.parents[body]
            self._add(path, body, stamped, main)
        elif topic is not None and not any(topic in by_kind for by_kind in sources.values()):
            raise InputError(f"{path}: pose {topic} has no poses; it has {_pose_topics(reader)}")

    def _add(self, path: Path, child: str, by_kind: dict[str, Samples], main: str) -> None:
        """Add the step of a frame: by the topic `main`, else tf, else the only one."""
        kind = next((name for name in (main, "tf") if name in by_kind), min(by_kind))
        others = sorted({*by_kind} - {kind})
        if others and kind not in (main, "tf"):
            cure = "give one as pose"
            raise InputError(f"{path}: poses of {child} come from {kind} and {others[0]}; {cure}")
        self.unused += [f"{name} (tf has the poses of {child})" for name in others]
        parent = max(by_kind[kind], key=lambda name: len(by_kind[kind][name]))
        if len(by_kind[kind]) > 1:
            why = f"{kind} has two parents of {child}: {', '.join(sorted(by_kind[kind]))}"
            raise InputError(f"{path}: {why}; give the topic of the right poses as pose")
        self.parents[child], self.tracks[child] = parent, Track.of(by_kind[kind][parent])

    def pose(self, camera: str, time: float) -> np.ndarray | None:
        """Camera-to-world [4,4]; None where a transform is not known at this time."""
        frame, pose, path = camera, np.eye(4), set[str]()
        while frame in self.parents and frame not in path:
            path.add(frame)
            step = self.tracks[frame].at(time)
            if step is None:
                return None
            frame, pose = self.parents[frame], step @ pose
        return pose


def _pose_topics(reader: Any) -> str:
    kinds = ("PoseStamped", "PoseWithCovarianceStamped", "Odometry", "TransformStamped")
    topics = [one.topic for one in reader.connections if one.msgtype.rpartition("/")[2] in kinds]
    return ", ".join(sorted(set(topics))) or "none"


def read_bag(
    path: Path, images: Path | None, spacing: Spacing, unpack: Path, poses: str | None
) -> Source:
    """Keyframes of a bag, unpacked into a folder. images: topic of the colour images; needed where
    there are several. poses: topic of poses, `Tree`. Raises InputError where the bag has no colour
    images, calibration or poses of them, or they never move, and as `opened`."""
    with opened(path) as reader:
        topic = colour_topic(path, reader, str(images) if images else None)
        camera_at, lens, frame = _lens(path, reader, topic)
        tree = Tree(path, reader, frame, poses)
        times = dict.fromkeys(seconds(message) for _, message in messages(reader, topic=topic))
        left_out = Counter[str]()
        there = posed(times, lambda time: tree.pose(frame, time), left_out)
        others = _pose_topics(reader)
        give = f"; if {others} has the camera's poses, give it as pose" if others != "none" else ""
        if frame not in tree.parents:
            why = f"no tf or odometry leads to {frame or 'the frame'} of {topic}"
            raise InputError(f"{path}: {why}; record /tf and /tf_static with it{give}")
        if not there:
            cure = "record poses and images together, by one clock"
            raise InputError(f"{path}: no image of {topic} has a pose at its time; {cure}")
        if len(there) > 1 and np.ptp([pose for _, pose in there], axis=0).max() < UNMOVED:
            why = f"the camera does not move: the transforms that lead to {frame} are constant"
            raise InputError(f"{path}: {why}; record what moves it{give}")
        keyframes = dict(there[k] for k in spacing.choose(there))
        shots: dict[float, Shot] = {}
        start = next(iter(times))
        for _, message in messages(reader, topic=topic):
            if (time := seconds(message)) in keyframes and time not in shots:
                name, camera = f"kf_{len(shots):04d}", camera_at(np.linalg.inv(keyframes[time]))
                image = unpack_colour(path, message, unpack / name)
                shots[time] = Shot(name, camera, lens, time - start, image)
        notes = [f"did not use the poses of {name}" for name in tree.unused]
        if "optical" not in frame.lower() and "optical" not in topic:
            notes.append(
                f"frame {frame} of {topic} is not named an optical one; the camera is taken to "
                "look along its z axis, with y down (REP 103)"
            )
        notes += _unpack_depth(reader, unpack, frame, shots)
    return Source("ROS bag", [*shots.values()], +left_out, tuple(notes), unit="m")


def colour_topic(path: Path, reader: Any, topic: str | None) -> str:
    """The topic of the colour images. Raises InputError where it is not there, or one of many."""
    topics = sorted({one.topic for one in reader.connections if one.msgtype in KINDS})
    colours = [name for name in topics if "depth" not in name.lower()]
    if topic is not None and topic in topics:
        return topic
    if topic is not None or len(colours) != 1:
        names = ", ".join(colours) or "none"
        raise InputError(f"{path}: its topics of colour images are {names}; give one as `images`")
    return colours[0]


def _lens(path: Path, reader: Any, topic: str) -> tuple[Any, Lens | None, str]:
    """Camera of a pose, lens, and frame of the images of a topic, by its camera_info."""
    _, image = next(messages(reader, topic=topic), (None, None))
    if image is None:
        raise InputError(f"{path}: {topic} has no images; record it again")
    infos = dict(messages(reader, "CameraInfo"))
    folder = topic.removesuffix("/compressed").rpartition("/")[0]
    same = [info for name, info in infos.items() if name.rpartition("/")[0] == folder]
    same = same or [info for info in infos.values() if frame_of(info) == frame_of(image)]
    if not same:
        raise InputError(f"{path}: has no camera_info of {topic}; record {folder}/camera_info too")
    info, rectified = same[0], "rect" in topic.rpartition("/")[2] or "/image_rect" in topic
    K = np.asarray(getattr(info, "k", getattr(info, "K", None)), np.float64).reshape(3, 3).copy()
    D = np.asarray(getattr(info, "d", getattr(info, "D", None)), np.float64)
    model, where = info.distortion_model, f"{path}: {topic}"
    if rectified:
        P = np.asarray(getattr(info, "p", getattr(info, "P", None)), np.float64)
        K, D, model = P.reshape(3, 4)[:, :3].copy(), np.zeros(5), ""
    if D.any() and (model not in (*LENSES, *FISHEYES) or len(D) > 8):
        why = f"the lens of {topic} is {model}, which is not supported"
        raise InputError(f"{path}: {why}; give the topic of its rectified images as `images`")
    K[:2, 2] += 0.5  # from pixel centres at whole numbers to ours
    size, window = (int(info.width), int(info.height)), info.roi
    cut = size != (getattr(image, "width", 0), getattr(image, "height", 0))
    if cut and window.width and window.height:  # binning shows by the size of the images
        K[:2, 2] -= window.x_offset, window.y_offset
        size = int(window.width), int(window.height)
    if model in FISHEYES:
        values = dict(zip(("k1", "k2", "k3", "k4"), D.tolist(), strict=False))
        lens = Lens.of(where, "OPENCV_FISHEYE", K, values)
    else:
        lens = opencv_lens(where, K, D.tolist())
    return lambda pose: Camera(K, *size, pose), lens, frame_of(image)


def unpack_colour(path: Path, message: Any, stem: Path) -> Path:
    """Write a colour image as it was recorded: PNG, or the JPEG it is. Raises InputError for an
    encoding that is not in COLOURS."""
    if hasattr(message, "format"):
        data = bytes(message.data)
        file = stem.with_suffix(".jpg" if data[:2] == b"\xff\xd8" else ".png")
        with atomic_path(file) as temporary:
            temporary.write_bytes(data)
        return file
    if message.encoding not in COLOURS:
        encodings = ", ".join(COLOURS)
        why = f"colour images of encoding {message.encoding!r} are not supported, but {encodings}"
        raise InputError(f"{path}: {why}; convert them")
    pixels = _rows(message, "u1")[..., COLOURS[message.encoding]]
    write_png(stem.with_suffix(".png"), np.ascontiguousarray(pixels))
    return stem.with_suffix(".png")


def _rows(message: Any, kind: str) -> np.ndarray:
    """Numbers of an image [H,W,C] without the padding of its rows."""
    kind = (">" if message.is_bigendian else "<") + kind
    rows = np.asarray(message.data, np.uint8).reshape(message.height, message.step)
    size = np.dtype(kind).itemsize
    channels = message.step // (message.width * size)
    pixels = np.ascontiguousarray(rows[:, : message.width * channels * size])
    return pixels.view(kind).reshape(message.height, message.width, channels)


def _metres(message: Any, scratch: Path) -> np.ndarray | None:
    """Depth of an image [H,W] float32, metres; None for an encoding that is not supported. A
    compressedDepth image holds a PNG. Its numbers are millimetres, or for 32FC1 a / depth + b, with
    0 for no depth (compressed_depth_image_transport). scratch: temporary file."""
    if not hasattr(message, "format"):
        if message.encoding not in DEPTHS:
            return None
        encoding = message.encoding
        return _scaled(_rows(message, DEPTHS[encoding][0])[..., 0], encoding)
    encoding, _, how = message.format.replace(" ", "").partition(";")
    if encoding not in DEPTHS or how not in ("compressedDepth", "compressedDepthpng"):
        return None
    data = bytes(message.data)
    scratch.write_bytes(data[DEPTH_HEADER:])
    steps = read_values(scratch)
    scratch.unlink()
    if DEPTHS[encoding][0] == "u2":
        return _scaled(steps, encoding)
    a, b = np.frombuffer(data[4:DEPTH_HEADER], "<f4")
    with np.errstate(divide="ignore"):
        return np.where(steps > 0, a / (steps.astype(np.float32) - b), np.float32(0))


def _scaled(values: np.ndarray, encoding: str) -> np.ndarray:
    """Metres, float32 [H,W], of the numbers of an encoding; 0 for UNKNOWN_DEPTH."""
    metres = values.astype(np.float32) * np.float32(DEPTHS[encoding][1])
    return np.where(values == UNKNOWN_DEPTH, np.float32(0), metres)


def _unpack_depth(reader: Any, unpack: Path, frame: str, shots: dict[float, Shot]) -> list[str]:
    """Write the depth image nearest in time to each keyframe, and add it to the keyframe; notes for
    the user. Only images in the frame of the colour images count: others are not aligned with
    them."""
    times, gaps = np.array(list(shots)), dict.fromkeys(shots, SYNCHRONOUS)
    notes = dict[str, None]()
    for topic, message in messages(reader, *KINDS):
        if "depth" not in topic.lower():
            continue
        if frame_of(message) != frame:
            why = f"it is of frame {frame_of(message)}, not aligned with the colour images"
            notes[f"left out the depth of {topic}: {why} of {frame}"] = None
            continue
        time = float(times[np.argmin(np.abs(times - seconds(message)))])
        gap = abs(time - seconds(message))
        if gap >= gaps[time]:
            continue
        file = unpack / f"{shots[time].name}.exr"
        metres = _metres(message, file.with_suffix(".depth"))
        if metres is None:
            kind = getattr(message, "encoding", "") or message.format
            notes[f"left out the depth of {topic}: {kind!r} is not supported"] = None
            continue
        write_exr(file, {"Z": np.nan_to_num(metres, posinf=0, neginf=0)})
        gaps[time], shots[time] = gap, replace(shots[time], depth=file)
    return [*notes]
