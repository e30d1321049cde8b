"""Draw the pictures of docs/data.md: frames of each scene, a rock's outline, the four orbits.

    python benchmarks/scene_gallery.py DATASETS docs/images

DATASETS is a folder of datasets, one for each scene, as `mgs synth-orbit DATASETS/boulder --scene
boulder --frames 8` makes them.
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

from mgs.colour import srgb_from_linear
from mgs.data.dataset import load_dataset
from mgs.synth.orbit import orbit_positions
from mgs.synth.scene_file import ORBITS, load_scene_file

WIDTH = 232
"""Width of one frame in a strip, pixels."""


def strip(folder: Path, columns: int = 4) -> Image.Image:
    """Put evenly spaced frames of a dataset side by side."""
    frames = load_dataset(folder).frames
    chosen = [frames[i * len(frames) // columns] for i in range(columns)]
    height = round(WIDTH * chosen[0].camera.height / chosen[0].camera.width)
    picture = Image.new("RGB", (columns * WIDTH, height))
    for i, frame in enumerate(chosen):
        with Image.open(frame.image_path) as image:
            picture.paste(
                image.convert("RGB").resize((WIDTH, height), Image.Resampling.LANCZOS),
                (i * WIDTH, 0),
            )
    return picture


def draw_outline(folder: Path, size: int = 56, zoom: int = 5) -> Image.Image:
    """Draw the left edge of the rock in the first frame: image times mask, and the rock alone, each
    in front of black and of white."""
    frame = load_dataset(folder).frames[0]
    (rgba, _), mask = frame.target(), frame.mask()
    column = np.flatnonzero(mask.any(0))[0]
    row = np.flatnonzero(mask[:, column])[0]
    window = slice(row - size // 2, row + size // 2), slice(column - 8, column - 8 + size)
    parts = [
        layer[..., :3] + (1 - layer[..., 3:]) * backdrop
        for backdrop in (0, 1)
        for layer in (np.dstack([frame.rgb() * mask[..., None], mask]), rgba)
    ]
    row_of_parts = np.hstack([srgb_from_linear(part[window]) for part in parts])
    picture = Image.fromarray(np.round(row_of_parts * 255).astype(np.uint8))
    return picture.resize((picture.width * zoom, picture.height * zoom), Image.Resampling.NEAREST)


def draw_orbits(path: Path, frames: int = 60) -> None:
    """Draw the camera centres of the default scene's four orbits, coloured in order of flight."""
    settings = load_scene_file("boulder").orbit
    figure = plt.figure(figsize=(10, 2.7), constrained_layout=True)
    for i, kind in enumerate(ORBITS):
        x, y, z = orbit_positions(
            settings.model_copy(update={"kind": kind}), frames, np.array([0, 0, 0.6])
        ).T
        axes = figure.add_subplot(1, 4, i + 1, projection="3d")
        axes.plot(x, y, z, color="0.75", linewidth=0.8)
        axes.scatter(x, y, z, c=np.arange(frames), s=8, cmap="viridis", depthshade=False)
        axes.scatter(0, 0, 0.6, color="saddlebrown", s=60)
        axes.set(title=kind, xlim=(-4, 4), ylim=(-4, 4), zlim=(0, 4))
        axes.set(xticks=[-4, 0, 4], yticks=[-4, 0, 4], zticks=[0, 2, 4])
        axes.set_box_aspect((2, 2, 1))
    figure.savefig(path, dpi=110)


def main(datasets: Path, out: Path) -> None:
    """Draw all pictures into the folder `out`."""
    out.mkdir(parents=True, exist_ok=True)
    for dataset in sorted(path.parent for path in datasets.glob("*/transforms.json")):
        strip(dataset).save(out / f"scene_{dataset.name}.png", optimize=True)
        if dataset.name == "boulder":
            draw_outline(dataset).save(out / "outline.png", optimize=True)
    draw_orbits(out / "orbits.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
