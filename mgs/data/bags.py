"""ROS 1 and ROS 2 bags, read by rosbags: camera_info, colour, depth, and poses.

Poses come from tf, odometry or PoseStamped, as a chain of frames from that of the images to the
root, which becomes the world. Keyframes are unpacked into files.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from mgs.camera import Camera
from mgs.data.tracks import Spacing, Track, rigid
from mgs.errors import InputError
from mgs.files import atomic_path, parsing
from mgs.images import read_values, write_png

KINDS = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")

COLOURS = {
    "rgb8": [0, 1, 2],
    "bgr8": [2, 1, 0],
    "rgba8": [0, 1, 2],
    "bgra8": [2, 1, 0],
    "mono8": [0, 0, 0],
    "8UC3": [2, 1, 0],
}
"""Encoding of a colour image -> its channels in the order R, G, B."""

DEPTHS = {"16UC1": ("u2", 1e-3), "mono16": ("u2", 1e-3), "32FC1": ("f4", 1.0)}
"""Encoding of a depth image -> type of its numbers, and metres in a step (REP 118)."""

DEPTH_HEADER = 12
"""Bytes before the PNG of a compressedDepth image: a number, and a and b as float32."""

LENSES = ("plumb_bob", "rational_polynomial", "")

SYNCHRONOUS = 0.05
"""Largest difference of the times of a colour and its depth image, seconds."""


def is_bag(path: Path) -> bool:
    """Whether a path is a ROS 1 bag file or a ROS 2 bag folder."""
    return (path.is_file() and path.suffix == ".bag") or (path / "metadata.yaml").is_file()


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """Context manager: the reader of a bag. Raises InputError where rosbags is not installed, and
    where the bag is damaged."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise InputError(
            f"{path}: is a ROS bag, and rosbags, which reads it, is not installed; "
            "`pip install mgs[ros]`"
        ) from None
    with (
        parsing(path, "ROS bag", "record it again"),
        AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader,
    ):
        yield reader


def messages(reader: Any, *kinds: str, topic: str | None = None) -> Iterator[tuple[str, Any]]:
    """(topic, message) of the messages of some types, or of a topic, in order of recording."""
    short = {kind.rpartition("/")[2] for kind in kinds}
    chosen = [
        connection
        for connection in reader.connections
        if connection.topic == topic or connection.msgtype.rpartition("/")[2] in short
    ]
    if chosen:
        for connection, _, raw in reader.messages(connections=chosen):
            yield connection.topic, reader.deserialize(raw, connection.msgtype)


def seconds(message: Any) -> float:
    """Time in the header of a message."""
    stamp = message.header.stamp
    return float(stamp.sec + 1e-9 * stamp.nanosec)


def frame_of(message: Any) -> str:
    """Name of the frame in the header of a message; tf once allowed a slash before it."""
    return str(message.header.frame_id).lstrip("/")


class Tree:
    """Frames of a bag: each with its parent, and the transforms to that over time."""

    def __init__(self, reader: Any, camera: str) -> None:
        samples: dict[str, list[tuple[float, np.ndarray]]] = defaultdict(list)
        self.parents: dict[str, str] = {}
        for topic, message in messages(reader, "TFMessage", "tfMessage", "Odometry", "PoseStamped"):
            for time, parent, child, pose in self._edges(message, camera):
                if parent != child and (child not in self.parents or self.parents[child] == parent):
                    self.parents[child] = parent
                    samples[child].append((0.0 if "static" in topic else time, pose))
        self.tracks = {child: Track.of(given) for child, given in samples.items()}

    @staticmethod
    def _edges(message: Any, camera: str) -> Iterator[tuple[float, str, str, np.ndarray]]:
        """(time, parent, child, child-to-parent) of a message."""
        for each in getattr(message, "transforms", None) or [message]:
            if hasattr(each, "transform"):
                place, turn = each.transform.translation, each.transform.rotation
            else:
                pose = getattr(each.pose, "pose", each.pose)
                place, turn = pose.position, pose.orientation
            child = str(getattr(each, "child_frame_id", "")).lstrip("/") or camera
            matrix = rigid((place.x, place.y, place.z), (turn.x, turn.y, turn.z, turn.w))
            yield seconds(each), frame_of(each), child, matrix

    def pose(self, camera: str, time: float) -> np.ndarray | None:
        """Camera-to-world [4,4]; None where a transform is not known at this time."""
        frame, pose, seen = camera, np.eye(4), set[str]()
        while frame in self.parents and frame not in seen:
            seen.add(frame)
            step = self.tracks[frame].at(time)
            if step is None:
                return None
            frame, pose = self.parents[frame], step @ pose
        return pose


def read_bag(path: Path, unpack: Path, topic: str | None, spacing: Spacing) -> list[dict[str, Any]]:
    """Keyframes of a bag, unpacked into a folder: name, camera, distortion, timestamp, image, depth
    and depth_unit of each, fields of `mgs.data.sources.Shot`.

    topic: of the colour images; needed where there are several. Raises InputError where the bag has
    no colour images, calibration or poses of them, and as `opened`.
    """
    with opened(path) as reader:
        topic = colour_topic(path, reader, topic)
        camera_at, distortion, frame = _lens(path, reader, topic)
        tree = Tree(reader, frame)
        if frame not in tree.parents:
            raise InputError(
                f"{path}: no tf, odometry or pose leads to {frame or 'the frame'} of {topic}; "
                "record /tf and /tf_static with it"
            )
        times = [seconds(message) for _, message in messages(reader, topic=topic)]
        posed = [(t, pose) for t in times if (pose := tree.pose(frame, t)) is not None]
        if not posed:
            raise InputError(
                f"{path}: no image of {topic} has a pose at its time; "
                "record poses and images together, by one clock"
            )
        kept = dict(posed[k] for k in spacing.choose(posed))
        shots: dict[float, dict[str, Any]] = {}
        for _, message in messages(reader, topic=topic):
            if (time := seconds(message)) in kept and time not in shots:
                name = f"kf_{len(shots):04d}"
                shots[time] = {
                    "name": name,
                    "camera": camera_at(np.linalg.inv(kept[time])),
                    "distortion": distortion,
                    "timestamp": time - times[0],
                    "image": unpack_colour(path, message, unpack / name),
                }
        _unpack_depth(reader, unpack, frame, shots)
    return list(shots.values())


def colour_topic(path: Path, reader: Any, topic: str | None) -> str:
    """The topic of the colour images. Raises InputError where it is not there, or one of many."""
    topics = sorted({one.topic for one in reader.connections if one.msgtype in KINDS})
    colours = [name for name in topics if "depth" not in name.lower()]
    if topic is not None and topic in topics:
        return topic
    if topic is not None or len(colours) != 1:
        listed = ", ".join(colours) or "none"
        raise InputError(f"{path}: its topics of colour images are {listed}; give one as `images`")
    return colours[0]


def _lens(path: Path, reader: Any, topic: str) -> tuple[Any, np.ndarray, str]:
    """Camera of a pose, distortion, and frame of the images of a topic, by its camera_info."""
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
    if rectified:
        P = np.asarray(getattr(info, "p", getattr(info, "P", None)), np.float64)
        K, D = P.reshape(3, 4)[:, :3].copy(), np.zeros(5)
    if D.any() and (info.distortion_model not in LENSES or len(D) > 8):
        raise InputError(
            f"{path}: the lens of {topic} is {info.distortion_model}, which is not supported; "
            "give the topic of its rectified images as `images`"
        )
    K[:2, 2] += 0.5  # from pixel centres at whole numbers to ours
    D = np.concatenate([D, np.zeros(max(0, 5 - len(D)))])
    size = int(info.width), int(info.height)
    return lambda pose: Camera(K, *size, pose), D, frame_of(image)


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
        known = ", ".join(COLOURS)
        raise InputError(
            f"{path}: colour images of encoding {message.encoding!r} are not supported, "
            f"but {known}; convert them"
        )
    pixels = _rows(message, "u1")[..., COLOURS[message.encoding]]
    write_png(stem.with_suffix(".png"), np.ascontiguousarray(pixels))
    return stem.with_suffix(".png")


def _rows(message: Any, kind: str) -> np.ndarray:
    """Numbers of an image [H,W,C] without the padding of its rows."""
    kind = (">" if message.is_bigendian else "<") + kind
    rows = np.asarray(message.data, np.uint8).reshape(message.height, message.step)
    size = np.dtype(kind).itemsize
    channels = message.step // (message.width * size)
    used = np.ascontiguousarray(rows[:, : message.width * channels * size])
    return used.view(kind).reshape(message.height, message.width, channels)


def _metres(message: Any, scratch: Path) -> np.ndarray | None:
    """Depth of an image [H,W] float32, metres; None for an encoding that is not supported.

    A compressedDepth image holds a PNG. Its numbers are millimetres, or for 32FC1 a / depth + b,
    with 0 for no depth (compressed_depth_image_transport). scratch: temporary file. Raises
    InputError if the PNG is damaged.
    """
    if not hasattr(message, "format"):
        if message.encoding not in DEPTHS:
            return None
        kind, unit = DEPTHS[message.encoding]
        return _rows(message, kind)[..., 0].astype(np.float32) * np.float32(unit)
    encoding, _, how = message.format.replace(" ", "").partition(";")
    if encoding not in DEPTHS or how not in ("compressedDepth", "compressedDepthpng"):
        return None
    data = bytes(message.data)
    scratch.write_bytes(data[DEPTH_HEADER:])
    steps = read_values(scratch).astype(np.float32)
    scratch.unlink()
    if DEPTHS[encoding][0] == "u2":
        return steps * np.float32(DEPTHS[encoding][1])
    a, b = np.frombuffer(data[4:DEPTH_HEADER], "<f4")
    with np.errstate(divide="ignore"):
        return np.where(steps > 0, a / (steps - b), np.float32(0))


def _unpack_depth(
    reader: Any, unpack: Path, frame: str, shots: dict[float, dict[str, Any]]
) -> None:
    """Write the depth image nearest in time to each keyframe, and add it to the keyframe.

    Only images in the frame of the colour images count: others are not aligned with them.
    """
    from mgs.images import write_exr

    times, gaps = np.array(list(shots)), dict.fromkeys(shots, SYNCHRONOUS)
    for topic, message in messages(reader, *KINDS):
        if "depth" not in topic.lower() or frame_of(message) != frame:
            continue
        time = float(times[np.argmin(np.abs(times - seconds(message)))])
        gap = abs(time - seconds(message))
        if gap >= gaps[time]:
            continue
        file = unpack / f"{shots[time]['name']}.exr"
        metres = _metres(message, file.with_suffix(".depth"))
        if metres is not None:
            write_exr(file, {"Z": np.nan_to_num(metres, posinf=0, neginf=0)})
            gaps[time], shots[time]["depth"] = gap, file
