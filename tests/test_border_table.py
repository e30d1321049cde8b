"""Imports judged by pixels: balls drawn through lenses of our own formulas must lie in the imported
pictures where the imported cameras project them."""

import codecs
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from program import command, said
from test_recordings import MOUNT, OPTICAL, Bag, quaternion

from mgs import look_at

RADIUS = 0.09
"""Radius of a ball, metres."""

rng = np.random.default_rng(5)
BALLS = np.array([[x, y, z] for x in (-0.5, 0, 0.5) for y in (-0.4, 0.4) for z in (0.1, 0.7)])
BALLS += rng.uniform(-0.1, 0.1, BALLS.shape)
COLOURS = np.array([[r, g, b] for r in (0, 120, 240) for g in (0, 240) for b in (60, 255)])
"""Centres [12,3] and sRGB colours of the balls."""


@dataclass(frozen=True)
class View:
    """A camera with a lens. The picture of a ray (u, v) is at f * bent(u, v) + centre; u and v are
    tangents of the angles to the axis, in a fisheye the angles themselves."""

    pose: np.ndarray
    width: int = 160
    height: int = 120
    f: float = 150.0
    fisheye: bool = False
    lens: dict[str, float] = field(default_factory=dict)
    centre: tuple[float, float] = (80.0, 60.0)

    def bent(self, u, v):
        """Brown's model in the order and with the names of COLMAP."""
        k = self.lens.get
        s = u * u + v * v
        radial = 1 + s * (k("k1", 0) + s * (k("k2", 0) + s * (k("k3", 0) + s * k("k4", 0))))
        p1, p2 = k("p1", 0), k("p2", 0)
        across = 2 * p1 * u * v + p2 * (s + 2 * u * u) + k("sx1", 0) * s
        down = 2 * p2 * u * v + p1 * (s + 2 * v * v) + k("sy1", 0) * s
        return u * radial + across, v * radial + down

    def rays(self) -> np.ndarray:
        """Directions of the pixels in the camera, [H,W,3]."""
        y, x = np.mgrid[: self.height, : self.width] + 0.5
        x, y = (x - self.centre[0]) / self.f, (y - self.centre[1]) / self.f
        u, v = x, y
        for _ in range(60):
            bent = self.bent(u, v)
            u, v = u + x - bent[0], v + y - bent[1]
        if not self.fisheye:
            return np.stack([u, v, np.ones_like(u)], -1)
        angle = np.hypot(u, v) + 1e-12
        return np.stack([u * np.sin(angle) / angle, v * np.sin(angle) / angle, np.cos(angle)], -1)

    def drawn(self) -> tuple[np.ndarray, np.ndarray]:
        """Picture [H,W,3] sRGB on grey, and z-depth [H,W], 0 beside the balls."""
        rays = self.rays()
        nearest = np.full(rays.shape[:2], np.inf)
        picture = np.full(rays.shape, 90, np.uint8)
        for place, colour in zip(BALLS, COLOURS, strict=True):
            c = self.pose[:3, :3] @ place + self.pose[:3, 3]
            a, b = (rays**2).sum(-1), rays @ c
            root = b * b - a * (c @ c - RADIUS**2)
            t = np.where(root > 0, (b - np.sqrt(np.abs(root))) / a, np.inf)
            nearer = (t > 0) & (t < nearest)
            nearest[nearer], picture[nearer] = t[nearer], colour
        return picture, np.where(np.isfinite(nearest), nearest * rays[..., 2], 0)


def orbit(count: int = 6, **changes) -> list[View]:
    angles = 2 * np.pi * np.arange(count) / count
    eyes = [(2.4 * np.cos(a), 2.4 * np.sin(a), 1.5) for a in angles]
    return [View(look_at(eye, (0, 0, 0.35)), **changes) for eye in eyes]


def misses(root: Path, balls: np.ndarray) -> np.ndarray:
    """Distances, pixels, of the balls in the pictures of a transforms.json from where its cameras
    project them; of those that are seen whole."""
    data, found = json.loads((root / "transforms.json").read_text()), []
    for record in data["frames"]:
        own = {**data, **record}
        pose = np.linalg.inv(np.array(record["transform_matrix"]) @ np.diag([1, -1, -1, 1]))
        pixels = np.asarray(Image.open(root / record["file_path"]).convert("RGB"), int)
        for place, colour in zip(balls - data.get("origin", [0, 0, 0]), COLOURS, strict=True):
            x, y, z = pose[:3, :3] @ place + pose[:3, 3]
            if z < RADIUS:
                continue
            rows, columns = np.nonzero(np.abs(pixels - colour).max(-1) < 60)
            whole = np.pi * (own["fl_x"] * RADIUS / z) * (own["fl_y"] * RADIUS / z)
            if not 0.8 * whole < len(rows) < 1.2 * whole:
                continue
            u, v = own["fl_x"] * x / z + own["cx"], own["fl_y"] * y / z + own["cy"]
            found.append(np.hypot(columns.mean() + 0.5 - u, rows.mean() + 0.5 - v))
    return np.array(found)


def nerfstudio(root: Path, views: list[View], name: str = "images/{}.png", **header) -> Path:
    """transforms.json of these views, each with its own lens. header: other entries."""
    frames = []
    for k, view in enumerate(views):
        path = root / name.format(k)
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(view.drawn()[0]).save(path)
        pose = np.linalg.inv(view.pose) @ np.diag([1, -1, -1, 1])
        frame = {"file_path": name.format(k), "transform_matrix": pose.tolist(), "fl_x": view.f}
        frame |= {"fl_y": view.f, "cx": view.centre[0], "cy": view.centre[1], "w": view.width}
        model = "OPENCV_FISHEYE" if view.fisheye else "OPENCV"
        frames.append({**frame, "h": view.height, "camera_model": model, **view.lens})
    (root / "transforms.json").write_text(json.dumps({**header, "frames": frames}))
    return root


def colmap(root: Path, views: list[View], model: str, names: str = "{}.png") -> Path:
    """COLMAP text without points. model: of the cameras, with its parameters."""
    (root / "sparse/0").mkdir(parents=True)
    lines = []
    for k, view in enumerate(views):
        path = root / "images" / names.format(k)
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(view.drawn()[0]).save(path)
        x, y, z, w = quaternion(view.pose)
        values = [k + 1, w, x, y, z, *view.pose[:3, 3], 1]
        lines += [" ".join(map(str, values)) + f" {names.format(k)}", ""]
    texts = {"cameras": [f"1 {model}"], "images": lines, "points3D": []}
    for name, text in texts.items():
        (root / f"sparse/0/{name}.txt").write_text("# comment\n" + "\n".join([*text, ""]))
    return root


def rewritten(change: Callable[[bytes], bytes], root: Path) -> Path:
    """The files of a COLMAP text, each changed."""
    for path in (root / "sparse/0").iterdir():
        path.write_bytes(change(path.read_bytes()))
    return root


def bag(root: Path, views: list[View], model: str) -> Path:
    """A ROS 2 bag of a robot. model: of the distortion; its numbers are those of the views."""
    recorded = Bag(root, 2)
    with recorded.writer:
        recorded.tf("/tf_static", 99, "base_link", OPTICAL, MOUNT)
        for k, view in enumerate(views):
            time = 100 + 0.5 * k
            body = np.linalg.inv(view.pose) @ np.linalg.inv(MOUNT)
            recorded.tf("/tf", time, "odom", "base_link", body)
            recorded.image("/cam/image_raw", time, "rgb8", view.drawn()[0])
            (x, y), D = view.centre, np.array([*view.lens.values()])
            K = np.array([view.f, 0, x - 0.5, 0, view.f, y - 0.5, 0, 0, 1])
            numbers = D, K, np.eye(3).ravel(), np.eye(3, 4).ravel()
            roi = recorded.make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
            head, size = recorded.header(time, OPTICAL), (view.height, view.width, model)
            kind = "sensor_msgs/msg/CameraInfo"
            recorded.write("/cam/camera_info", kind, time, head, *size, *numbers, 0, 0, roi)
    return root


def turned(root: Path, tag: int) -> Path:
    """transforms.json of pictures that are stored on their side, with the EXIF that turns them."""
    nerfstudio(root, orbit(), "images/{}.jpg")
    for path in (root / "images").iterdir():
        exif, pixels = Image.Exif(), np.asarray(Image.open(path))
        exif[0x112] = tag
        stored = np.rot90(orbit()[int(path.stem)].drawn()[0], {6: 1, 8: 3}[tag])
        assert pixels.shape[:2] == stored.shape[1::-1]
        Image.fromarray(stored.copy()).save(path, exif=exif, quality=97, subsampling=0)
    return root


def tum(root: Path, views: list[View], moved: Sequence[float] = (0, 0, 0)) -> Path:
    """TUM RGB-D whose poses come late, in reverse order, and of which two are missing."""
    (root / "rgb").mkdir(parents=True)
    poses = []
    for k, view in enumerate(views):
        Image.fromarray(view.drawn()[0]).save(root / f"rgb/{k}.png")
        pose = np.linalg.inv(view.pose)
        poses.append(" ".join(map(str, [1e9 + k, *pose[:3, 3] + moved, *quaternion(pose)])))
    (root / "rgb.txt").write_text("".join(f"{1e9 + k} rgb/{k}.png\n" for k in range(len(views))))
    (root / "groundtruth.txt").write_text("\n".join(poses[1:-1][::-1]))
    f, (x, y) = views[0].f, views[0].centre
    (root / "calibration.txt").write_text(f"{f} {f} {x - 0.5} {y - 0.5}")
    return root


UTM = np.array([448262.0, 5411932.0, 412.0])


def changed(root: Path, change: Callable[[dict], object]) -> Path:
    """transforms.json each of whose frames is changed."""
    data = json.loads((root / "transforms.json").read_text())
    for record in data["frames"]:
        change(record)
    (root / "transforms.json").write_text(json.dumps(data))
    return root


def far(record: dict) -> None:
    for row, step in zip(record["transform_matrix"], UTM, strict=False):
        row[3] += step


def old_fisheye(record: dict) -> None:
    """As programs wrote it before camera_model."""
    del record["camera_model"]
    record["is_fisheye"] = True


BROWN = {"k1": -0.12, "k2": 0.05, "p1": 0.004, "p2": -0.003}
ANGLES = {"k1": 0.08, "k2": -0.03, "k3": 0.01, "k4": -0.002}
PRISM = {"k1": 0.05, "k2": 0.01, "p1": 0.003, "p2": -0.002, "sx1": 0.004, "sy1": -0.003}
WIDE = {"f": 110.0, "fisheye": True}
SOURCES: dict[str, Callable[[Path], Path]] = {
    # 1: poses
    "ROS bag, equidistant": lambda r: bag(r, orbit(lens=ANGLES, **WIDE), "equidistant"),
    "ROS bag, plumb_bob": lambda r: bag(r, orbit(lens=BROWN, centre=(76, 63)), "plumb_bob"),
    "TUM, poses in another order": lambda r: tum(r, orbit(9)),
    # 2: lens
    "Brown and fisheye mixed": lambda r: nerfstudio(
        r, [*orbit(4, lens=BROWN), *orbit(3, lens=ANGLES, **WIDE)]
    ),
    "is_fisheye": lambda r: changed(nerfstudio(r, orbit(lens=ANGLES, **WIDE)), old_fisheye),
    "thin prism": lambda r: colmap(
        r,
        orbit(lens=PRISM, **WIDE),
        "THIN_PRISM_FISHEYE 160 120 110 110 80 60 .05 .01 .003 -.002 0 0 .004 -.003",
    ),
    # 3: orientation, names
    "EXIF 6": lambda r: turned(r, 6),
    "EXIF 8": lambda r: turned(r, 8),
    "byte-order mark": lambda r: rewritten(
        lambda text: codecs.BOM_UTF8 + text, colmap(r, orbit(), "SIMPLE_PINHOLE 160 120 150 80 60")
    ),
    "Windows lines, names with dots": lambda r: rewritten(
        lambda text: text.replace(b"\n", b"\r\n"),
        colmap(r, orbit(), "PINHOLE 160 120 150 150 80 60", "Süd 1/b.v{}.png"),
    ),
    # 6: far from the origin
    "UTM": lambda r: changed(nerfstudio(r, orbit()), far),
    "UTM, TUM": lambda r: tum(r, orbit(9), UTM),
}


@pytest.mark.slow
@pytest.mark.parametrize("source", SOURCES)
def test_balls_lie_where_the_imported_cameras_project_them(tmp_path, source):
    command("import", SOURCES[source](tmp_path / "source"), "--out", tmp_path / "out")
    found = misses(tmp_path / "out", BALLS + UTM if source.startswith("UTM") else BALLS)
    assert len(found) > 25
    assert np.median(found) < 0.25
    assert np.quantile(found, 0.9) < 0.6


CONVENTIONS = {
    "OpenCV": (np.eye(4), "have the camera axes of OpenCV"),
    "body": (
        np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]).T,
        "are of a body whose x axis points forward",
    ),
}
"""Camera axes of poses that are of no camera of OpenGL, and what is said of them."""


@pytest.mark.slow
@pytest.mark.parametrize("axes", CONVENTIONS)
def test_poses_of_other_axes_are_named_without_matches(tmp_path, axes, capsys):
    turn, problem = CONVENTIONS[axes]

    def turned_axes(record):
        pose = np.array(record["transform_matrix"]) @ np.diag([1, -1, -1, 1]) @ turn
        record["transform_matrix"] = pose.tolist()

    root = changed(nerfstudio(tmp_path / "source", orbit()), turned_axes)
    command("import", root, "--out", tmp_path / "out")
    assert problem in said(capsys)[1]
