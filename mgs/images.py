"""Images on disk: PNG and JPEG hold sRGB; OpenEXR holds linear colour, depth and other numbers."""

import math
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from io import BytesIO
from pathlib import Path
from threading import Lock, get_ident
from typing import Any

import numpy as np

import mgs
from mgs.camera import MAX_PIXELS, MAX_SIDE, Camera
from mgs.colour import linear_from_pixels, srgb_from_linear
from mgs.errors import InputError
from mgs.files import DAMAGED, atomic_path, not_writable, parsing, reading
from mgs.memory import check_room

PNG_BIT_DEPTH = 24  # byte of a PNG file with the bits of a sample (PNG specification, 11.2.1)
EIGHT_BIT_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA")  # Pillow's, become RGBA exactly
LUMA = np.array([0.299, 0.587, 0.114])  # weights of R, G and B in grey (ITU-R BT.601)
EXR_MAGIC = b"v/1\1"  # first bytes of every OpenEXR file
DECODED_BYTES = 16  # a pixel takes at most while an image is decoded: RGBA of 16 bits, and its file
UNKNOWN_DEPTH = 0xFFFF  # by which depth cameras, as the Kinect, mark that they measured nothing
PNG_LEVEL = 1  # of zlib, 1 to 9: files as large as by Pillow's 6, in a quarter of the time


def around(mask: np.ndarray, margin: int) -> tuple[slice, ...]:
    """Slices of the bounding box of a mask [H,W] with a true pixel, widened by pixels."""
    return tuple(slice(max(i.min() - margin, 0), i.max() + 1 + margin) for i in np.nonzero(mask))


def write_png(path: str | Path, image: np.ndarray, *, linear: bool = True) -> None:
    """Write a PNG; the file appears complete. The type of `image` decides:

    - bool [H,W]: a mask, black and white.
    - uint8 [H,W,3]: sRGB, unchanged. uint16 [H,W]: other numbers, of 16 bits.
    - float [H,W,3]: linear RGB, converted to sRGB; with linear=False, sRGB in [0,1].

    Raises InputError as `mgs.files.atomic_path`."""
    from PIL import Image

    if image.dtype == bool:
        pixels = image.astype(np.uint8) * 255
    elif image.dtype in (np.uint8, np.uint16):
        pixels = image
    else:
        display = srgb_from_linear(image) if linear else np.clip(image, 0, 1)
        pixels = np.round(display * 255).astype(np.uint8)
    with atomic_path(path) as temporary:
        Image.fromarray(pixels).save(temporary, format="PNG", compress_level=PNG_LEVEL)


def image_size(path: str | Path) -> tuple[int, int]:
    """Width and height of an image or EXR file, pixels, read from its header alone. Raises
    InputError if it is missing or unreadable, or has more pixels than MAX_PIXELS or the free memory
    allows."""
    path = Path(path)
    what = "EXR file" if path.suffix.lower() == ".exr" else "image"
    with reading(path, what), path.open("rb") as file:
        is_exr = file.read(4) == EXR_MAGIC
    return _exr_size(path) if is_exr else _open_image(path, decode=False)[0].size


def check_pixels(path: Path, width: int, height: int, pixel_bytes: int = DECODED_BYTES) -> None:
    """Raise InputError if an image has more than MAX_PIXELS or takes more than the free memory."""
    size = f"{path}: has {width}x{height} pixels"
    if width < 1 or height < 1 or width * height > MAX_PIXELS or max(width, height) > MAX_SIDE:
        raise InputError(f"{size}; images hold 1 to {MAX_PIXELS:,}, resize it")
    check_room(width * height * pixel_bytes, f"{size}, which", "resize it")


@contextmanager
def unlimited_headers() -> Iterator[None]:
    """Context manager in which Pillow opens images of any size, for `check_pixels` to judge. It
    also switches off Ghostscript, to which Pillow would give a PostScript file of any name."""
    from PIL import EpsImagePlugin, Image

    EpsImagePlugin.gs_binary = False
    limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
    try:
        yield
    finally:
        Image.MAX_IMAGE_PIXELS = limit


def _open_image(path: Path, decode: bool = True) -> tuple[Any, bytes]:
    """Pillow image, decoded or its header alone, and the bytes of its file. Raises InputError."""
    from PIL import Image, UnidentifiedImageError

    with reading(path, "image"):
        data = path.read_bytes() if decode else b""
    try:
        with unlimited_headers(), Image.open(BytesIO(data) if decode else path) as image:
            check_pixels(path, *image.size)
            if decode:
                image.load()
    except InputError:
        raise
    except UnidentifiedImageError:
        cure = "give a PNG or JPEG, or write it again if it is damaged"
        raise InputError(f"{path}: not a readable image; {cure}") from None
    except (OSError, SyntaxError, ValueError) as error:
        raise InputError(f"{path}: not a readable image ({error}); {DAMAGED}") from None
    return image, data


def exif_orientation(path: str | Path) -> int:
    """EXIF orientation of an image, 1 (upright) to 8; 1 if absent. From 5 on, width and height are
    exchanged."""
    from PIL import ExifTags, Image

    try:
        with unlimited_headers(), Image.open(path) as image:
            if image.format == "PNG" and "exif" not in image.info:  # Pillow would decode it all
                return 1
            tag = image.getexif().get(ExifTags.Base.Orientation, 1)
    except (OSError, SyntaxError, ValueError):  # reading it will say why
        return 1
    return tag if tag in range(1, 9) else 1


def exif_exposure(path: str | Path) -> float | None:
    """Exposure in stops, log2(time ISO / f-number^2), from the EXIF header; None if it lacks that
    or cannot be read."""
    from PIL import ExifTags, Image

    base = ExifTags.Base
    try:
        with unlimited_headers(), Image.open(path) as image:
            exif = image.getexif().get_ifd(ExifTags.IFD.Exif)
        tags = base.ExposureTime, base.ISOSpeedRatings, base.FNumber
        time, speed, number = (float(exif[tag]) for tag in tags)
        return math.log2(time * speed / number**2)
    except (OSError, SyntaxError, KeyError, TypeError, ValueError, ZeroDivisionError):
        return None


NO_RETURN = 1e6  # metres of depth that stand for none: renderers write 1e10


def read_values(path: str | Path) -> np.ndarray:
    """Numbers of an image of one channel, such as depth, unchanged: [H,W] uint8 or uint16, of a
    TIFF also int32 or float32. Raises InputError if it is missing, unreadable, damaged, or does not
    have one channel."""
    path = Path(path)
    image, _ = _open_image(path)
    if image.mode not in ("L", "I;16", "I", "F"):
        cure = "give one channel of 16 bits, or EXR"
        raise InputError(f"{path}: not a depth image, pixels of kind {image.mode}; {cure}")
    return np.asarray(image)


def read_depth(path: str | Path, unit: float = 1e-3, float_unit: float = 1.0) -> np.ndarray:
    """Depth in metres, float32 [H,W], from EXR, or an image in steps of `unit` metres, of a TIFF of
    floats `float_unit`. Negative numbers, those beyond NO_RETURN and UNKNOWN_DEPTH become 0.

    Raises InputError as `read_exr` and `read_values`, for 8 bits, if most numbers are negative, and
    where no channel of an EXR is the depth: named Z or depth, the only one, or R, G and B alike."""
    path = Path(path)
    if path.suffix.lower() == ".exr":
        depth = _depth_channel(path)
    else:
        values = read_values(path)
        if values.dtype == np.uint8:
            cure = "give 16 bits, TIFF of float32, or EXR"
            raise InputError(f"{path}: a picture of 8 bits is no depth; {cure}")
        depth = values.astype(np.float32) * (unit if values.dtype.kind in "ui" else float_unit)
        if values.dtype == np.uint16:
            depth[values == UNKNOWN_DEPTH] = 0
    if (depth < 0).sum() > (depth > 0).sum():
        raise InputError(f"{path}: its depths are negative; give distances in front of the camera")
    return np.where((depth < 0) | (depth > NO_RETURN), np.float32(0), depth)


def _depth_channel(path: Path) -> np.ndarray:
    channels = read_exr(path)
    depths = [name for name in channels if name.rpartition(".")[2].lower() in ("z", "depth")]
    if len(depths) == 1 or len(channels) == 1:
        return channels[(depths or [*channels])[0]]
    if "Z" in channels:
        return channels["Z"]
    colours = [channels[name] for name in "RGB" if name in channels]
    grey = all(np.array_equal(one, colours[0], equal_nan=True) for one in colours)
    if colours and set(channels) <= set("RGBA") and grey:
        return colours[0]
    names = ", ".join(channels)
    raise InputError(f"{path}: which of {names} is the depth is not plain; write one channel, Z")


def read_rgba(path: str | Path) -> np.ndarray:
    """Read an image as sRGB and alpha, not premultiplied: [H,W,4].

    uint16 (largest value 65535) for a PNG of 16 bits per sample, uint8 (255) for all others. An
    image without alpha is opaque. Raises InputError if the file is missing, unreadable, damaged, or
    neither grey nor RGB. CMYK is refused: its colours depend on the file's colour profile."""
    path = Path(path)
    image, data = _open_image(path)
    bits = data[PNG_BIT_DEPTH] if image.format == "PNG" else 8
    if image.mode not in EIGHT_BIT_MODES and bits < 16:
        raise InputError(f"{path}: pixels of kind {image.mode} are not supported; make it RGB")
    if bits in (2, 4, 16) and image.mode in ("L", "I", "I;16") and "transparency" in image.info:
        # A PNG may declare one grey value transparent. Pillow and OpenCV read it wrongly here.
        raise InputError(f"{path}: transparent grey of {bits} bits is not read; make it RGBA")
    if bits < 16:
        return np.asarray(image.convert("RGBA"))
    import cv2  # Pillow keeps only the upper 8 bits of 16-bit colour

    with _silent():
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype != np.uint16:
        raise InputError(f"{path}: not a readable 16-bit PNG; the file is damaged, write it again")
    conversions = {1: cv2.COLOR_GRAY2RGBA, 3: cv2.COLOR_BGR2RGBA, 4: cv2.COLOR_BGRA2RGBA}
    return cv2.cvtColor(pixels, conversions[pixels.shape[2] if pixels.ndim == 3 else 1])


def read_png(path: str | Path) -> np.ndarray:
    """Read an sRGB image of 8 or 16 bits as linear RGB float32 [H,W,3], without alpha. Raises
    InputError as `read_rgba`."""
    return linear_from_pixels(read_rgba(path)[..., :3])


def read_mask(path: str | Path) -> np.ndarray:
    """Read a mask image as bool [H,W], True where it is at least half white. Of a picture of one
    colour the alpha counts. Of one with two values, the lower 0 and the other under half white
    (labels 0 and 1, a palette), the other is True. Raises InputError as `read_rgba`."""
    rgba = read_rgba(path)
    layer = rgba[..., :3] @ LUMA
    if np.ptp(layer) == 0 < np.ptp(rgba[..., 3]):
        layer = rgba[..., 3].astype(layer.dtype)
    half, highest = 0.5 * np.iinfo(rgba.dtype).max, layer.max()
    if 0 < highest < half and ((layer == 0) | (layer == highest)).all():
        return layer > 0
    return layer >= half


def write_sheet(path: Path, pictures: list[np.ndarray], across: int) -> None:
    """Write pictures uint8 [H,W,3] of the same width as a PNG, `across` in a row."""
    height = max(len(picture) for picture in pictures)
    padded = [np.pad(picture, ((0, height - len(picture)), (0, 0), (0, 0))) for picture in pictures]
    padded += [np.zeros_like(padded[0])] * (-len(padded) % across)
    rows = [np.hstack(padded[k : k + across]) for k in range(0, len(padded), across)]
    write_png(path, np.vstack(rows))


def write_exr(
    path: str | Path,
    channels: Mapping[str, np.ndarray],
    camera: Camera | None = None,
    unit: str = "",
) -> None:
    """Write an OpenEXR file with a float32 channel for each named array [H,W]; the file appears
    complete.

    The header names the program, the unit of lengths, and the camera: `fx`, `fy`, `cx`, `cy`,
    pixels, and `worldToCamera` as OpenEXR defines it (a row vector times the matrix; x right, y up,
    z backward). Raises InputError if it cannot be written."""
    import OpenEXR

    data = {name: np.ascontiguousarray(array, np.float32) for name, array in channels.items()}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    header |= {"software": f"mgs {mgs.__version__}"}
    header |= {"unit": unit} if unit else {}
    if camera is not None:
        K, pose = camera.K, np.diag([1.0, -1, -1, 1]) @ camera.world_to_camera
        header |= {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
        header |= {"worldToCamera": np.ascontiguousarray(pose.T, np.float32)}
    with atomic_path(path) as temporary, OpenEXR.File(header, data) as file:
        try:
            file.write(str(temporary))
        except RuntimeError as error:  # OpenEXR raises this if the disk is full
            raise not_writable(Path(path), error) from None


def read_exr(path: str | Path) -> dict[str, np.ndarray]:
    """Channels of an OpenEXR file, {name: float32 [H,W]}. Raises InputError as `image_size`, and if
    it is damaged."""
    import OpenEXR

    path = Path(path)
    _exr_size(path)
    with _reading_exr(path), OpenEXR.File(str(path), separate_channels=True) as file:
        channels = file.channels().items()
        return {name: np.asarray(one.pixels, np.float32) for name, one in channels}


def _exr_size(path: Path) -> tuple[int, int]:
    import OpenEXR

    with reading(path, "EXR file"), path.open("rb") as opened:
        opened.read(1)  # OpenEXR would not say why it cannot open a file

    def unsupported(what: str, instead: str) -> InputError:
        return InputError(f"{path}: has {what}, which mgs does not read; save {instead} as EXR")

    with _reading_exr(path), OpenEXR.File(str(path), header_only=True) as file:
        if len(file.parts) != 1:
            raise unsupported(f"{len(file.parts)} parts", "one of them")
        if file.header()["type"] in (OpenEXR.deepscanline, OpenEXR.deeptile):
            raise unsupported("several samples in a pixel (deep)", "a flat image")
        low, high = (np.asarray(corner, np.int64) for corner in file.header()["dataWindow"])
        channels = file.header()["channels"]
        if any((one.xSampling, one.ySampling) != (1, 1) for one in channels):
            raise unsupported("subsampled channels (luminance and chroma)", "RGB")
    width, height = (int(side) for side in high - low + 1)
    check_pixels(path, width, height, 8 * len(channels))
    return width, height


@contextmanager
def _reading_exr(path: Path) -> Iterator[None]:
    """Context manager: turns errors of OpenEXR into InputError, and hides what it prints."""
    with parsing(path, "EXR", DAMAGED), _silent():
        yield


_redirecting = Lock()  # held while output is redirected: two threads would not restore it


class _OtherThreads:
    """A stream without what the thread that made this writes; progress in others goes on."""

    def __init__(self, stream: Any) -> None:
        self.stream, self.thread = stream, get_ident()

    def write(self, text: str) -> int:
        return len(text) if get_ident() == self.thread else self.stream.write(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


@contextmanager
def _silent() -> Iterator[None]:
    """Context manager: drops what libraries print to the standard error, and in this thread to
    Python's standard output."""
    with _redirecting, open(os.devnull, "wb") as nowhere:
        others: Any = _OtherThreads(sys.stdout)
        stderr = os.dup(2)
        try:
            os.dup2(nowhere.fileno(), 2)
            with redirect_stdout(others):
                yield
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
