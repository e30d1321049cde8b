"""The pictures of the report page: truth, render, error and uncertainty of views, small enough to
stand inside a page.

They show the model that a run folder holds now: that of its last finished step, or, where there is
no checkpoint, its
gaussians.ply. Models of earlier steps are not kept by a run. What does change from step to step is
what was known: the maps of uncertainty are by the exact Fisher information, at that model, of the
views taken until then.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mgs.colour import srgb_from_linear
from mgs.data.dataset import Frame
from mgs.gaussians import Gaussians
from mgs.plotting import crop
from mgs.policy.criteria import regularisation, uncertainty
from mgs.report.diagnostics import VISIBLE, view_maps

PIXELS = 40e6
"""Most pixels of all pictures of a page together. At the 0.1 to 0.2 bytes that WebP takes for a
pixel of a rock, they are 4 to 8 MB. With more views or runs, the pictures become smaller instead of
the page larger."""

WIDEST = 640
"""Most pixels across a picture."""

QUALITY = 85
"""Of WebP, 0 to 100."""

ERROR_COLOURS, UNCERTAINTY_COLOURS = "magma", "cividis"
"""Colour maps (matplotlib's names), both perceptually uniform."""

GREY = (232, 232, 232)
"""Colour of pixels that show no model, in maps of uncertainty."""


@dataclass
class Album:
    """Pictures of equal size, by name, and the scale of the errors among them.

    window: rows and columns of an image that are shown; width: of a picture, pixels, at most.
    pictures: name -> data URI.
    errors: name -> error map [h,w], until `finish` gives it colours.
    """

    window: tuple[slice, slice]
    width: int
    pictures: dict[str, str] = field(default_factory=dict)
    errors: dict[str, np.ndarray] = field(default_factory=dict)

    def add_colours(self, name: str, linear: np.ndarray) -> None:
        """A picture of linear RGB [H,W,3]."""
        self.pictures[name] = data_uri(
            self._small(np.round(srgb_from_linear(linear) * 255).astype(np.uint8))
        )

    def add_error(self, name: str, truth: np.ndarray, rendered: np.ndarray) -> None:
        """The mean absolute difference of the sRGB channels of two images, linear RGB [H,W,3]."""
        difference = np.abs(srgb_from_linear(truth) - srgb_from_linear(rendered)).mean(axis=2)
        self.errors[name] = self._small(difference).astype(np.float16)

    def add_uncertainty(self, name: str, values: np.ndarray, alpha: np.ndarray) -> None:
        """A map of values in [0,1], [H,W], grey where the model's opacity alpha [H,W] is less than
        VISIBLE."""
        import matplotlib

        colours = matplotlib.colormaps[UNCERTAINTY_COLOURS](np.clip(values, 0, 1), bytes=True)[
            ..., :3
        ].copy()
        colours[alpha < VISIBLE] = GREY
        self.pictures[name] = data_uri(self._small(colours))

    def finish(self) -> float:
        """Give the error maps their colours, on one scale from 0 to the returned value: 99.5 % of
        the pixels are below it."""
        import matplotlib

        # A view can be all equal to the truth: the scale is then 0 to the smallest step of 8 bits.
        limit = max((float(np.quantile(e, 0.995)) for e in self.errors.values()), default=0.0)
        limit = max(round(limit, 3), 1 / 255)
        for name, error in self.errors.items():
            shown = np.clip(error.astype(np.float32) / limit, 0, 1)
            self.pictures[name] = data_uri(
                matplotlib.colormaps[ERROR_COLOURS](shown, bytes=True)[..., :3]
            )
        self.errors.clear()
        return limit

    def _small(self, image: np.ndarray) -> np.ndarray:
        """The window of an image, uint8 [H,W,3] or float32 [H,W], at no more than the album's
        width."""
        from PIL import Image

        picture = Image.fromarray(np.ascontiguousarray(image[self.window]))
        if picture.width > self.width:
            height = max(1, round(picture.height * self.width / picture.width))
            picture = picture.resize((self.width, height), Image.Resampling.BOX)
        return np.asarray(picture)


def data_uri(pixels: np.ndarray) -> str:
    """sRGB pixels, uint8 [h,w,3] -> a WebP picture as the address that an <img> shows."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(
        file, format="WEBP", quality=QUALITY, method=4
    )
    return "data:image/webp;base64," + base64.b64encode(file.getvalue()).decode("ascii")


def new_album(frames: Sequence[Frame], count: int) -> Album:
    """An empty album for `count` pictures of views of these frames, all cropped alike: to what any
    mask holds, with a margin.

    Frames of different sizes are not cropped. Raises InputError if a mask cannot be read.
    """
    sizes = {(frame.camera.height, frame.camera.width) for frame in frames}
    window: tuple[slice, slice] = (slice(None), slice(None))
    if len(sizes) == 1:
        window = crop(np.logical_or.reduce([frame.mask() for frame in frames]))
    height, width = np.zeros(max(sizes), bool)[window].shape
    fits = (PIXELS / max(count, 1) * width / height) ** 0.5
    return Album(window, max(1, int(min(width, WIDEST, fits))))


def draw_taken(
    album: Album,
    label: str,
    gaussians: Gaussians,
    taken: Sequence[Frame],
    noise: tuple[float, dict[str, float]],
    drawn: Callable[[], None],
) -> None:
    """Draw the views that a run has taken, in their order: for each, `truth/NAME`,
    `render/NAME/LABEL`, `error/...`, and `before/...` and `after/...`, the uncertainty of the model
    seen from there before and after the view was taken.

    noise: the settings `pixel_noise` and `prior_std` of the run. drawn: called after each view.
    Raises InputError if a file of a frame cannot be read.
    """
    from mgs.splat import fisher, groups

    lam = regularisation(groups(gaussians.sh_degree), *noise)
    H = np.zeros((len(gaussians), len(lam)))
    for frame in taken:
        before = uncertainty(H, lam)
        H += fisher(gaussians, frame.camera)
        maps = view_maps(gaussians, frame.camera, {"before": before, "after": uncertainty(H, lam)})
        draw_render(
            album,
            f"{frame.name}/{label}",
            frame,
            np.stack([maps[channel] for channel in "RGB"], axis=-1),
        )
        for when in ("before", "after"):
            album.add_uncertainty(f"{when}/{frame.name}/{label}", maps[when], maps["A"])
        drawn()


def draw_render(album: Album, name: str, frame: Frame, rendered: np.ndarray) -> None:
    """Add `render/NAME`, `error/NAME`, and the frame's truth where it is not there yet. rendered:
    linear RGB [H,W,3]."""
    truth = frame.masked_rgb()
    if f"truth/{frame.name}" not in album.pictures:
        album.add_colours(f"truth/{frame.name}", truth)
    album.add_colours(f"render/{name}", rendered)
    album.add_error(f"error/{name}", truth, rendered)


def colour_scale(name: str) -> list[str]:
    """Colours of a colour map from its low to its high end, as CSS writes them: for the legend of
    maps."""
    import matplotlib

    rows: Any = matplotlib.colormaps[name](np.linspace(0, 1, 16), bytes=True)
    return [f"#{r:02x}{g:02x}{b:02x}" for r, g, b, _ in rows.tolist()]
