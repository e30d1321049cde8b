"""HTML of objects for notebooks: a line of text and small pictures."""

from base64 import b64encode
from collections.abc import Sequence
from html import escape
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image

from mgs.colour import srgb_from_linear

HEIGHT = 120  # height of a picture, pixels
MOST_POINTS = 20_000  # most points of a picture; of more, every n-th is drawn
MOST_FILES = 6  # most pictures of files
FORMATS = ("PNG", "JPEG", "TIFF", "WEBP", "BMP")  # not PostScript, which Pillow would run


def html(text: str, pictures: Sequence[Image.Image]) -> str:
    """A line of text above a row of pictures, which are part of the HTML."""
    row = "".join(f'<img src="{data_uri(one, "PNG")}" style="margin:2px">' for one in pictures)
    return f"<div>{escape(text)}</div><div>{row}</div>"


def data_uri(picture: Image.Image, kind: str, **options: int) -> str:
    """A picture as the address of an <img>. kind, options: of its file, as Pillow takes them."""
    buffer = BytesIO()
    picture.save(buffer, kind, **options)
    return f"data:image/{kind.lower()};base64,{b64encode(buffer.getvalue()).decode()}"


def thumbnails(paths: Sequence[Path]) -> list[Image.Image]:
    """Small pictures of up to MOST_FILES of the files that exist and can be read, evenly chosen."""
    files = [path for path in paths if path.is_file()]
    indices = np.unique(np.linspace(0, len(files) - 1, min(MOST_FILES, len(files))).astype(int))
    pictures = []
    for i in indices:
        try:
            with Image.open(files[i], formats=FORMATS) as image:
                small = image.convert("RGB")
        except OSError:
            continue
        small.thumbnail((4 * HEIGHT, HEIGHT))
        pictures.append(small)
    return pictures


def picture(rgb: np.ndarray) -> Image.Image:
    return Image.fromarray(np.round(255 * srgb_from_linear(rgb)).astype(np.uint8))


def cloud(points: np.ndarray, colours: np.ndarray) -> Image.Image:
    """Picture of points [N,3], +Z up, seen from above one side; nearer points hide others.

    colours: [N,3] linear RGB."""
    every = max(1, len(points) // MOST_POINTS)
    points, colours = points[::every], np.clip(colours[::every], 0, 1)
    towards = np.array([0.6, -0.6, 0.53])
    right = np.array([0.707, 0.707, 0.0])
    across, up = points @ right, points @ np.cross(towards, right)
    middle = [(axis.min() + axis.max()) / 2 for axis in (across, up)]
    scale = (HEIGHT - 12) / max(np.ptp(across), np.ptp(up), 1e-9)
    place = np.stack([middle[1] - up, across - middle[0]]) * scale + HEIGHT / 2
    far_first = np.argsort(points @ towards)
    radius = max(1, round(1.2 * HEIGHT / len(points) ** 0.5))
    picture = Image.new("RGB", (HEIGHT, HEIGHT), "white")
    pixels = np.round(srgb_from_linear(colours) * 255).astype(int)
    for i in far_first:
        y, x = place[:, i]
        box = (round(x - radius), round(y - radius), round(x + radius), round(y + radius))
        picture.paste(tuple(pixels[i].tolist()), box)
    return picture
