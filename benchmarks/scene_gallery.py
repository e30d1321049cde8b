"""Draw the pictures of docs/data.md: frames of each scene, a rock's outline, the four orbits.

    python benchmarks/scene_gallery.py DATASETS docs/images

DATASETS is a folder of datasets, one for each scene, as `mgs synth-orbit DATASETS/boulder --scene
boulder --frames 8` makes them. Writes scenes.jpg, outline.png (of boulder) and orbits.png.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from mgs.colour import srgb_from_linear
from mgs.data.dataset import load_dataset
from mgs.plotting import new_figure
from mgs.synth.orbit import orbit_positions
from mgs.synth.scene_file import ORBITS, load_scene_file

WIDTH, COLUMNS = 232, 4
"""Width of one frame, pixels, and frames of a scene."""


def draw_scenes(folders: list[Path]) -> Image.Image:
    """Put evenly spaced frames side by side, a row for each dataset."""
    rows = []
    for folder in folders:
        frames = load_dataset(folder).frames
        chosen = [frames[i * len(frames) // COLUMNS] for i in range(COLUMNS)]
        size = WIDTH, round(WIDTH * chosen[0].camera.height / chosen[0].camera.width)
        images = [Image.open(frame.image_path).convert("RGB") for frame in chosen]
        rows.append(np.hstack([image.resize(size, Image.Resampling.LANCZOS) for image in images]))
    return Image.fromarray(np.vstack(rows))


def draw_outline(folder: Path, size: int = 56, zoom: int = 5) -> Image.Image:
    """Draw the left edge of the rock in the first frame: image times mask, and the rock alone, each
    in front of black and of white."""
    frame = load_dataset(folder).frames[0]
    (rgba, _), mask = frame.target(), frame.mask()
    column = np.flatnonzero(mask.any(0))[0]
    row = np.flatnonzero(mask[:, column])[0]
    window = slice(row - size // 2, row + size // 2), slice(column - 8, column - 8 + size)
    layers = np.dstack([frame.rgb() * mask[..., None], mask]), rgba
    parts = [
        layer[..., :3] + (1 - layer[..., 3:]) * backdrop for backdrop in (0, 1) for layer in layers
    ]
    pixels = np.hstack([srgb_from_linear(part[window]) for part in parts])
    picture = Image.fromarray(np.round(pixels * 255).astype(np.uint8))
    return picture.resize((picture.width * zoom, picture.height * zoom), Image.Resampling.NEAREST)


def draw_orbits(path: Path, frames: int = 60) -> None:
    """Draw the camera centres of the default scene's four orbits, coloured in order of flight."""
    settings, centre = load_scene_file("boulder").orbit, np.array([0, 0, 0.6])
    figure = new_figure(10, 2.7)
    for i, kind in enumerate(ORBITS):
        orbit = settings.model_copy(update={"kind": kind})
        x, y, z = orbit_positions(orbit, frames, centre).T
        axes = figure.add_subplot(1, 4, i + 1, projection="3d")
        axes.plot(x, y, z, color="0.75", linewidth=0.8)
        axes.scatter(x, y, z, c=np.arange(frames), s=8, cmap="viridis", depthshade=False)
        axes.scatter(*centre, color="saddlebrown", s=60)
        axes.set(title=kind, xlim=(-4, 4), ylim=(-4, 4), zlim=(0, 4))
        axes.set(xticks=[-4, 0, 4], yticks=[-4, 0, 4], zticks=[0, 2, 4])
        axes.set_box_aspect((2, 2, 1))
    figure.savefig(path, dpi=110)


def main(datasets: Path, out: Path) -> None:
    """Draw all pictures into the folder `out`."""
    out.mkdir(parents=True, exist_ok=True)
    folders = sorted(path.parent for path in datasets.glob("*/transforms.json"))
    draw_scenes(folders).save(out / "scenes.jpg", quality=85)
    draw_outline(datasets / "boulder").save(out / "outline.png", optimize=True)
    draw_orbits(out / "orbits.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
