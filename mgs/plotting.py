"""Style, creation and writing of figures."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mgs.errors import InputError
from mgs.files import atomic_path

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STYLE: dict[str, Any] = {
    "font.family": "serif",
    "font.serif": ["STIXGeneral", "DejaVu Serif"],
    "mathtext.fontset": "stix",
    "font.size": 10,
    "axes.titlesize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "lines.linewidth": 1.5,
    "lines.markersize": 4,
}
"""Settings for `styled`."""

NO_GRID = STYLE | {"axes.grid": False}  # STYLE for images and maps
DPI = 200  # pixels per inch of a figure
FORMATS = ("png", "pdf", "svg")  # file formats of figures


def new_figure(width: float, height: float, dpi: int = DPI) -> "Figure":
    """Empty figure of this width and height, inches. It needs no display."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), dpi=dpi, layout="constrained")


def literal(text: str) -> str:
    """Text for a figure in which matplotlib takes no $ as the start of a formula."""
    return text.replace("$", r"\$")


def save_figure(figure: "Figure", path: str | Path) -> None:
    """Write a figure in the format of its suffix: .png, .pdf or .svg; the file appears complete.
    Raises InputError for another suffix, and as `mgs.files.atomic_path`."""
    kind = Path(path).suffix.lower()[1:]
    if kind not in FORMATS:
        kinds = ", ".join(FORMATS)
        raise InputError(f"{path}: figures are written as {kinds}; choose another ending")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format=kind)


@contextmanager
def styled(style: dict[str, Any]) -> Iterator[None]:
    """Context with these settings and matplotlib's defaults. A matplotlibrc does not count: one in
    the current folder may be a stranger's, and have LaTeX set every text."""
    import matplotlib

    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(style)
        yield


@contextmanager
def drawing(
    path: str | Path, width: float, height: float, style: dict[str, Any] = STYLE, dpi: int = DPI
) -> "Iterator[Figure]":
    """Context with an empty figure, which is written to `path` when the block ends without error.

    width, height: inches. style: settings while it is drawn. Raises as `save_figure`."""
    with styled(style):
        figure = new_figure(width, height, dpi)
        yield figure
        save_figure(figure, path)


def painted(values: np.ndarray, colours: str, low: float = 0.0, high: float = 1.0) -> np.ndarray:
    """Values of any shape -> sRGB uint8 of that shape and 3, by a colour map from low to high."""
    import matplotlib

    share = np.clip((np.asarray(values, np.float64) - low) / max(high - low, 1e-12), 0, 1)
    return np.ascontiguousarray(matplotlib.colormaps[colours](share, bytes=True)[..., :3])


def crop(mask: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns of an image that hold its mask [H,W] and a margin of 6 % of the image's
    sides; all if the mask is empty."""
    if not mask.any():
        return slice(None), slice(None)

    def span(indices: np.ndarray, size: int) -> slice:
        more = round(0.06 * size)
        return slice(max(0, int(indices.min()) - more), min(size, int(indices.max()) + more + 1))

    rows, columns = map(span, np.nonzero(mask), mask.shape)
    return rows, columns
