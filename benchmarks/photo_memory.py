"""Most memory that each station takes for photographs of 12 megapixels: `python
benchmarks/photo_memory.py OUT.json`.

The scene is a ball whose colour changes with height alone, seen by a ring of cameras at one height:
all of them see the same image. So one JPEG and one mask stand for any number of photographs, by
hard links, as a nerfstudio capture with distortion and points. Every station is a process of its
own; what is reported is its largest resident set.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh

from mgs import runtime
from mgs.camera import Camera, look_at, opengl_from_opencv
from mgs.data.dataset import Frame, write_transforms
from mgs.files import write_json
from mgs.images import write_png
from mgs.provenance import command_line, versions

WIDTH, HEIGHT = 4000, 3000
DISTANCE, ALTITUDE = 3.0, 1.2
COUNTS = (8, 100)
"""Numbers of photographs: what is bounded takes no more for the second than for the first."""
DISTORTION = -0.02
"""k1 of the lens."""


def ring(count: int) -> list[Camera]:
    """Cameras around a ball of radius 1 at the origin."""
    K = np.array([[4200.0, 0, WIDTH / 2], [0, 4200.0, HEIGHT / 2], [0, 0, 1]])
    angles = 2 * np.pi * np.arange(count) / count
    eyes = [(DISTANCE * np.cos(a), DISTANCE * np.sin(a), ALTITUDE) for a in angles]
    return [Camera(K, WIDTH, HEIGHT, look_at(eye, (0, 0, 0))) for eye in eyes]


def ball(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """The image of the ball, uint8 [H,W,3], with some grain, and its mask."""
    directions = camera.unproject(np.ones((HEIGHT, WIDTH))) - camera.position
    a, b = (directions**2).sum(-1), directions @ camera.position
    root = b**2 - a * (camera.position @ camera.position - 1)
    height = camera.position[2] + (-b - np.sqrt(np.maximum(root, 0))) / a * directions[..., 2]
    grain = np.random.default_rng(0).integers(0, 25, (HEIGHT, WIDTH, 1))
    colour = 110 + 60 * np.sin(7 * height[..., None] + [0, 1, 2]) + grain
    return np.where(root[..., None] > 0, colour, 40 + grain).astype(np.uint8), root > 0


def capture(folder: Path, image: Path, mask: Path, count: int) -> None:
    """A nerfstudio capture of so many photographs."""
    (folder / "images").mkdir(parents=True)
    (folder / "masks").mkdir()
    cameras, frames = ring(count), []
    for k, camera in enumerate(cameras):
        os.link(image, folder / f"images/{k:03d}.jpg")
        os.link(mask, folder / f"masks/{k:03d}.png")
        pose = opengl_from_opencv(camera.world_to_camera).tolist()
        frames.append(
            {
                "file_path": f"images/{k:03d}.jpg",
                "mask_path": f"masks/{k:03d}.png",
                "transform_matrix": pose,
            }
        )
    K = cameras[0].K
    lens = {
        "fl_x": K[0, 0],
        "fl_y": K[1, 1],
        "cx": K[0, 2],
        "cy": K[1, 2],
        "w": WIDTH,
        "h": HEIGHT,
        "k1": DISTORTION,
    }
    write_json(
        folder / "transforms.json", {**lens, "ply_file_path": "points.ply", "frames": frames}
    )
    points = np.random.default_rng(1).standard_normal((4000, 3))
    trimesh.PointCloud(points / np.linalg.norm(points, axis=1, keepdims=True)).export(
        folder / "points.ply"
    )


def dataset(folder: Path, image: Path, mask: Path | None, count: int) -> None:
    """What a capture without distortion would be imported as, at full size; mask None: without
    masks."""
    frames = []
    for k, camera in enumerate(ring(count)):
        paths = folder / f"images/{k:03d}.png", folder / f"masks/{k:03d}.png"
        for path, source in zip(paths, (image, mask), strict=True):
            if source is not None:
                path.parent.mkdir(parents=True, exist_ok=True)
                os.link(source, path)
        frames.append(
            Frame(f"{k:03d}", camera, float(k), paths[0], mask_path=paths[1] if mask else None)
        )
    write_transforms(folder, frames)
    points = np.random.default_rng(1).standard_normal((4000, 3))
    trimesh.PointCloud(points / np.linalg.norm(points, axis=1, keepdims=True)).export(
        folder / "sparse.ply"
    )


WATCHED = """
import sys
from pathlib import Path
from mgs.cli.app import main
try:
    main(sys.argv[2:])
finally:
    lines = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    Path(sys.argv[1]).write_text(lines["VmHWM"].split()[0])
"""
"""A program that runs `mgs` and writes the largest resident set of its process, kB, into a file.
getrusage is of no use here: a process starts with the number of the one that started it."""


def peak(note: Path, *command: str | Path) -> float:
    """Largest resident set of `mgs COMMAND`, GB. note: a file to write."""
    subprocess.run(
        [sys.executable, "-c", WATCHED, str(note), *map(str, command)],
        stdout=subprocess.DEVNULL,
        check=True,
    )
    return int(note.read_text()) * 1024 / 1e9


def commands(folder: Path, count: int) -> list[tuple[str, list[str | Path]]]:
    """The stations that photographs go through: (what the table calls it, its command line), in the
    order to run them."""
    photos, small, prior = (folder / f"{name}{count}" for name in ("photos", "small", "prior"))
    full, size = folder / f"full{count}", ["--gaussians", "4000"]
    run = [
        "--alpha-weight",
        "0",
        "--policy",
        "uniform",
        "--passes",
        "1",
        "--warm-passes",
        "1",
        "--seeds",
        str(count),
        "--budget",
        "0",
    ]
    return [
        ("mgs import", ["import", photos, "--out", folder / f"imported{count}"]),
        ("mgs import --downscale 4", ["import", photos, "--out", small, "--downscale", "4"]),
        ("mgs prior --from hull", ["prior", full, "--from", "hull", "--out", prior, *size]),
        (
            "mgs prior --from points",
            ["prior", full, "--from", "points", "--out", folder / f"points{count}", *size],
        ),
        ("mgs dataset masks", ["dataset", "masks", folder / f"bare{count}", "--prior", prior]),
        ("mgs nbv", ["nbv", small, "--prior", prior, "--out", folder / f"run{count}", *run]),
    ]


def main(out: Path) -> None:
    """Measure and write."""
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        pixels, mask = ball(ring(1)[0])
        cv2.imwrite(str(folder / "ball.jpg"), np.ascontiguousarray(pixels[..., ::-1]))
        write_png(folder / "ball.png", pixels)
        write_png(folder / "mask.png", mask)
        for count in COUNTS:
            capture(folder / f"photos{count}", folder / "ball.jpg", folder / "mask.png", count)
            dataset(folder / f"full{count}", folder / "ball.png", folder / "mask.png", count)
            dataset(folder / f"bare{count}", folder / "ball.png", None, count)
        for station in zip(*(commands(folder, count) for count in COUNTS), strict=True):
            for count, (name, command) in zip(COUNTS, station, strict=True):
                if name == "mgs import" and count != COUNTS[0]:
                    continue  # takes minutes to write, and --downscale reads and undistorts as many pixels
                rows.append(
                    {
                        "station": name,
                        "photographs": count,
                        "gigabytes": peak(folder / "note", *command),
                    }
                )
                print(rows[-1], flush=True)
    write_json(
        out,
        {
            "command": command_line(),
            "machine": runtime.processor(),
            "versions": versions(),
            "records": rows,
        },
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
