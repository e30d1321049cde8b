"""The pictures of docs/data.md: one strip of frames per scene, from datasets in a folder.

for s in boulder contact-binary strata low-sun pebbles; do mgs synth-orbit out/$s --scene $s --frames 8; done
python benchmarks/scene_gallery.py out docs/images
"""

from __future__ import annotations

import argparse
from pathlib import Path

from PIL import Image

from mgs.dataset import load_dataset

WIDTH = 232
"""Of one frame in a strip, pixels."""


def strip(folder: Path, columns: int = 4) -> Image.Image:
    """Evenly spaced frames of a dataset, side by side."""
    frames = load_dataset(folder).frames
    chosen = [frames[i * len(frames) // columns] for i in range(columns)]
    height = round(WIDTH * chosen[0].camera.height / chosen[0].camera.width)
    picture = Image.new("RGB", (columns * WIDTH, height))
    for i, frame in enumerate(chosen):
        with Image.open(frame.image_path) as image:
            picture.paste(image.convert("RGB").resize((WIDTH, height), Image.Resampling.LANCZOS), (i * WIDTH, 0))
    return picture


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("datasets", type=Path)
    parser.add_argument("out", type=Path)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for dataset in sorted(path.parent for path in arguments.datasets.glob("*/transforms.json")):
        strip(dataset).save(arguments.out / f"scene_{dataset.name}.png", optimize=True)
