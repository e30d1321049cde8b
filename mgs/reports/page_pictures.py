"""Pictures of the report page: truth, render, error and uncertainty of views, of the last model."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mgs.colour import srgb_from_linear
from mgs.data.frames import Frame
from mgs.notebook import data_uri
from mgs.plotting import crop, painted
from mgs.policy.criteria import uncertainty
from mgs.reports.diagnostics import VISIBLE, view_maps
from mgs.run.folder import Run

PIXELS = 40e6  # most pixels of all pictures of a page: 4 to 8 MB of WebP
WIDEST = 640  # most pixels across a picture
QUALITY = 85  # quality of WebP, 0 to 100
ERROR_COLOURS, UNCERTAINTY_COLOURS = "magma", "cividis"  # perceptually uniform
GREY = (232, 232, 232)  # colour of pixels that show no model, in maps of uncertainty


@dataclass
class Album:
    """Pictures of equal size, by name, and error maps that share a colour scale.

    window: shown rows and columns of an image. width: of a picture, pixels, at most. pictures: name
    -> data URI. errors: name -> error map [h,w], which `finish` turns into pictures."""

    window: tuple[slice, slice] = (slice(None), slice(None))
    width: int = WIDEST
    pictures: dict[str, str] = field(default_factory=dict)
    errors: dict[str, np.ndarray] = field(default_factory=dict)

    def add_colours(self, name: str, linear: np.ndarray) -> None:
        pixels = np.round(srgb_from_linear(linear) * 255).astype(np.uint8)
        self.pictures[name] = web_picture(self._small(pixels))

    def add_error(self, name: str, truth: np.ndarray, rendered: np.ndarray) -> None:
        """Add the mean absolute difference of the sRGB channels of two images, linear RGB
        [H,W,3]."""
        difference = np.abs(srgb_from_linear(truth) - srgb_from_linear(rendered)).mean(axis=2)
        self.errors[name] = self._small(difference).astype(np.float16)

    def add_uncertainty(self, name: str, values: np.ndarray, alpha: np.ndarray) -> None:
        """Add a map of values [H,W] in [0,1], grey where the opacity alpha [H,W] is below
        VISIBLE."""
        colours = painted(values, UNCERTAINTY_COLOURS)
        colours[alpha < VISIBLE] = GREY
        self.pictures[name] = web_picture(self._small(colours))

    def finish(self) -> float:
        """Turn the error maps into pictures; return the error at the end of their colour scale.
        99.5 % of the pixels of every map are below it, and it is at least a step of 8 bits."""
        limit = max((float(np.quantile(e, 0.995)) for e in self.errors.values()), default=0.0)
        limit = max(round(limit, 3), 1 / 255)
        for name, error in self.errors.items():
            image = painted(error.astype(np.float32) / limit, ERROR_COLOURS)
            self.pictures[name] = web_picture(image)
        self.errors.clear()
        return limit

    def _small(self, image: np.ndarray) -> np.ndarray:
        """The window of an image, uint8 [H,W,3] or float32 [H,W], at most as wide as the album."""
        from PIL import Image

        picture = Image.fromarray(np.ascontiguousarray(image[self.window]))
        if picture.width > self.width:
            height = max(1, round(picture.height * self.width / picture.width))
            picture = picture.resize((self.width, height), Image.Resampling.BOX)
        return np.asarray(picture)


def web_picture(pixels: np.ndarray) -> str:
    """Encode sRGB pixels, uint8 [h,w,3], as the WebP address of an <img>."""
    from PIL import Image

    picture = Image.fromarray(np.ascontiguousarray(pixels))
    return data_uri(picture, "WEBP", quality=QUALITY, method=4)


def new_album(frames: Sequence[Frame], count: int) -> Album:
    """An empty album for `count` pictures of views of these frames, all cropped to what any mask
    holds, with a margin. Frames of different sizes are not cropped. Raises InputError if a mask
    cannot be read."""
    sizes = {(frame.camera.height, frame.camera.width) for frame in frames}
    window: tuple[slice, slice] = (slice(None), slice(None))
    if len(sizes) == 1:
        window = crop(np.logical_or.reduce([frame.mask() for frame in frames]))
    height, width = np.zeros(max(sizes), bool)[window].shape
    fits = (PIXELS / max(count, 1) * width / height) ** 0.5
    return Album(window, max(1, int(min(width, WIDEST, fits))))


def draw_taken(album: Album, label: str, run: Run, tick: Callable[[], None]) -> None:
    """Draw the views that a run has taken, in order: `truth/NAME`, `render/NAME/LABEL`,
    `error/NAME/LABEL`, and the uncertainty of the model before and after, `before/...`,
    `after/...`. tick: called after each view. Raises InputError if a file of a frame cannot be
    read."""
    from mgs.splat import fisher, groups

    gaussians = run.gaussians
    lam = run.settings.regularisation(groups(gaussians.sh_degree), surface=True)
    H = np.zeros((len(gaussians), len(lam)))
    for frame in run.taken:
        before = uncertainty(H, lam)
        H += fisher(gaussians, frame.camera)
        maps = view_maps(gaussians, frame.camera, {"before": before, "after": uncertainty(H, lam)})
        rendered = np.stack([maps[channel] for channel in "RGB"], axis=-1)
        draw_render(album, f"{frame.name}/{label}", frame, rendered)
        for when in ("before", "after"):
            album.add_uncertainty(f"{when}/{frame.name}/{label}", maps[when], maps["A"])
        tick()


def draw_render(album: Album, name: str, frame: Frame, rendered: np.ndarray) -> None:
    """Add `render/NAME`, `error/NAME`, and the frame's truth if it is missing. rendered: linear RGB
    [H,W,3]."""
    truth = frame.masked_rgb()
    if f"truth/{frame.name}" not in album.pictures:
        album.add_colours(f"truth/{frame.name}", truth)
    album.add_colours(f"render/{name}", rendered)
    album.add_error(f"error/{name}", truth, rendered)


def colour_scale(name: str) -> list[str]:
    """16 colours of a colour map, from its low to its high end, as CSS writes them."""
    import matplotlib

    rows: Any = matplotlib.colormaps[name](np.linspace(0, 1, 16), bytes=True)
    return [f"#{r:02x}{g:02x}{b:02x}" for r, g, b, _ in rows.tolist()]
