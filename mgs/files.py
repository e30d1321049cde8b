"""Files: nothing is ever half-written. Outputs go to a temporary name beside the target and are renamed."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, TextIO

import numpy as np

from mgs.conventions import linear_from_srgb, srgb_from_linear
from mgs.errors import InputError

PNG_BIT_DEPTH = 24
"""Where a PNG holds its number of bits per sample: in the header, the first chunk (PNG specification, section 11.2.1)."""
EIGHT_BIT_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA")
"""Pillow's names of pixels that it converts to 8-bit RGBA without loss: grey, palette and RGB, with and without alpha."""
LUMA = np.array([0.299, 0.587, 0.114])
"""Weights of R, G and B in grey (ITU-R BT.601)."""
PNG_LEVEL = 1
"""zlib's level, of 9. Against Pillow's 6: a render takes 62 instead of 236 ms (0.56 Mpixel) and as many bytes, a smooth photo
413 instead of 644 ms (3 Mpixel) and 7 % more, a mask 9 instead of 14 ms and 16 instead of 5 kB."""


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path` (same suffix); rename it on success, delete it on failure.

    Raises InputError where it cannot be written: no permission, a file in place of a folder, a full disk.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise _not_writable(path, error) from None
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def _not_writable(path: Path, error: OSError) -> InputError:
    return InputError(f"{path}: cannot be written ({error.strerror or error}); choose a place you may write to, with room")


def check_writable(path: str | Path) -> Path:
    """The path, where a file or folder could be made there. Makes nothing. Raises InputError where it could not."""
    path = Path(path)
    try:
        there = next(parent for parent in (path, *path.absolute().parents) if parent.exists())
        with TemporaryFile(dir=there if there.is_dir() or there != path else there.parent):
            return path
    except OSError as error:
        raise _not_writable(path, error) from None


@contextmanager
def reading(path: Path, what: str = "file") -> Iterator[None]:
    """While `path` is read, errors of the file system become one line: InputError, no such `what`, or why it cannot be read."""
    try:
        yield
    except FileNotFoundError:
        raise InputError(f"{path}: no such {what}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); give a file that can be read") from None


def copy_file(source: Path, path: Path) -> None:
    """Copy a file, atomically. Raises InputError where the source cannot be read or the copy cannot be written."""
    with reading(source):
        data = source.read_bytes()
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def fingerprint(path: str | Path) -> dict[str, str]:
    """Name and SHA-256 of a file, to tell later whether it is still the same."""
    return {"name": Path(path).name, "sha256": hashlib.sha256(Path(path).read_bytes()).hexdigest()}


def write_json(path: str | Path, data: Any) -> None:
    """Write JSON (indented, UTF-8), atomically. Raises ValueError for NaN and infinities, which JSON has not: use None."""
    text = json.dumps(data, indent=2, allow_nan=False)
    with atomic_path(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def read_json(path: str | Path) -> Any:
    """Read JSON. Raises InputError where the file is missing, not a file that can be read, or not JSON."""
    path = Path(path)
    with reading(path):
        data = path.read_bytes()
    try:
        return json.loads(data.decode("utf-8-sig"))  # some tools put a byte-order mark in front
    except (ValueError, RecursionError) as error:  # also of numbers or nestings that Python refuses
        raise InputError(f"{path}: not valid JSON ({error}); the file is damaged, write it again") from None


def check_new_folder(path: str | Path) -> Path:
    """The path, where an output folder could be made there; makes nothing. Raises InputError as `new_folder`."""
    path = check_writable(path)
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file, not a folder; choose another output folder")
    if path.is_dir() and any(path.iterdir()):
        raise InputError(f"{path}: the output folder is not empty; choose a new one or delete it")
    return path


def new_folder(path: str | Path) -> Path:
    """Create an output folder. Raises InputError where it is a file, is not empty, or cannot be written."""
    path = check_new_folder(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _not_writable(path, error) from None
    return path


@contextmanager
def folder_or_nothing(path: str | Path) -> Iterator[Path]:
    """Yield a new folder; where the block fails, all is as it was: no folder, no parents, or the empty one there was."""
    path = check_new_folder(path)
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    new_folder(path)
    try:
        yield path
    except BaseException:
        if made:
            shutil.rmtree(path, ignore_errors=True)
        else:
            for child in path.iterdir():
                shutil.rmtree(child) if child.is_dir() else child.unlink()
        with suppress(OSError):
            for folder in made[1:]:
                folder.rmdir()
        raise


@contextmanager
def atomic_folder(path: str | Path) -> Iterator[Path]:
    """Yield a temporary folder beside `path`, which becomes `path` at the end: a kill leaves no half of it.

    Raises InputError as `new_folder`.
    """
    path = check_new_folder(path).resolve()
    with folder_or_nothing(path.with_name(f".{path.name}.{os.getpid()}.part")) as temporary:
        yield temporary
        try:
            os.replace(temporary, path)
        except OSError as error:
            raise _not_writable(path, error) from None


@contextmanager
def locked(folder: str | Path) -> Iterator[None]:
    """Keep every other process that asks for this lock out of a folder while the block runs.

    Raises InputError where another one has it (names its id), or the folder cannot be written. The lock is the kernel's, on the
    file FOLDER/.lock: it ends with the process, however that ends, so a file that a killed process left locks nothing.
    """
    path = Path(folder) / ".lock"
    try:
        file = _lock(path)
    except OSError as error:
        raise _not_writable(path, error) from None
    with file:
        try:
            yield
        finally:
            with suppress(OSError):
                path.unlink()


def _lock(path: Path) -> TextIO:
    """The file, locked and with this process's id in it. Raises InputError where another process has it."""
    while True:
        with ExitStack() as closed_on_failure:
            file = closed_on_failure.enter_context(open(path, "a+", encoding="ascii"))
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                file.seek(0)
                raise InputError(f"{path.parent}: process {file.read()} works on it; wait until it has ended") from None
            try:
                ours = os.path.samestat(os.fstat(file.fileno()), os.stat(path))
            except FileNotFoundError:
                ours = False
            if ours:  # not a file that its last owner removed after we opened it
                file.truncate(0)
                print(os.getpid(), end="", file=file, flush=True)
                closed_on_failure.pop_all()
                return file


def write_png(path: str | Path, image: np.ndarray, *, linear: bool = True) -> None:
    """Write an 8-bit PNG: linear RGB [H,W,3] (converted to sRGB), display values with linear=False, or, as they are, a bool
    mask [H,W] or uint8 sRGB [H,W,3]."""
    from PIL import Image

    if image.dtype == bool:
        pixels = image.astype(np.uint8) * 255
    elif image.dtype == np.uint8:
        pixels = image
    else:
        display = srgb_from_linear(image) if linear else np.clip(image, 0, 1)
        pixels = np.round(display * 255).astype(np.uint8)
    with atomic_path(path) as temporary:
        Image.fromarray(pixels).save(temporary, format="PNG", compress_level=PNG_LEVEL)


def _open_image(path: Path) -> tuple[Any, bytes]:
    """A decoded Pillow image and its file's bytes. Raises InputError where it is missing, cannot be read, or is damaged."""
    from PIL import Image, UnidentifiedImageError

    with reading(path, "image"):
        data = path.read_bytes()
    try:
        with Image.open(BytesIO(data)) as image:
            image.load()
    except UnidentifiedImageError:
        raise InputError(f"{path}: not a readable image; give a PNG or JPEG, or write it again if it is damaged") from None
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise InputError(f"{path}: not a readable image ({error}); the file is damaged, write it again") from None
    return image, data


def read_values(path: str | Path) -> np.ndarray:
    """An image of one channel, such as depth, as it is: [H,W] uint8 or uint16 (TIFF: int32 or float32 too).

    Raises InputError where it is missing, cannot be read, is damaged, or has other channels.
    """
    path = Path(path)
    image, _ = _open_image(path)
    if image.mode not in ("L", "I;16", "I", "F"):
        raise InputError(f"{path}: not a depth image, its pixels are of kind {image.mode}; give one channel of 16 bits, or EXR")
    return np.asarray(image)


def read_rgba(path: str | Path) -> np.ndarray:
    """PNG, JPEG or another image -> [H,W,4], sRGB and straight alpha (full where it has none).

    uint16 for a PNG of 16 bits per sample, uint8 for all others: full is 65535 or 255.
    Raises InputError where it is missing, cannot be read, is damaged, or is neither grey nor RGB (no CMYK: what its numbers
    look like is known to its colour profile alone).
    """
    import cv2

    path = Path(path)
    image, data = _open_image(path)
    bits = data[PNG_BIT_DEPTH] if image.format == "PNG" else 8
    if image.mode not in EIGHT_BIT_MODES and bits < 16:
        raise InputError(f"{path}: pixels of kind {image.mode} are not supported; convert it to grey or RGB of 8 or 16 bits")
    if bits in (2, 4, 16) and image.mode in ("L", "I", "I;16") and "transparency" in image.info:
        # Pillow and OpenCV both get these wrong; at 1 and 8 bits Pillow is right.
        raise InputError(f"{path}: a grey of {bits} bits that stands for transparent is not supported; convert it to RGBA")
    if bits < 16:
        return np.asarray(image.convert("RGBA"))
    # Pillow keeps only the upper 8 bits of 16-bit colour.
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype != np.uint16:
        raise InputError(f"{path}: not a readable 16-bit PNG; the file is damaged, write it again")
    conversions = {1: cv2.COLOR_GRAY2RGBA, 3: cv2.COLOR_BGR2RGBA, 4: cv2.COLOR_BGRA2RGBA}
    return cv2.cvtColor(pixels, conversions[pixels.shape[2] if pixels.ndim == 3 else 1])


def read_png(path: str | Path) -> np.ndarray:
    """sRGB image of 8 or 16 bits -> linear RGB float32 [H,W,3], alpha ignored. Raises InputError as `read_rgba`."""
    rgba = read_rgba(path)
    return linear_from_srgb(rgba[..., :3].astype(np.float32) / np.iinfo(rgba.dtype).max)


def read_mask(path: str | Path) -> np.ndarray:
    """Mask image -> bool [H,W] (at least half white is inside, alpha ignored). Raises InputError as `read_rgba`."""
    rgba = read_rgba(path)
    return rgba[..., :3] @ LUMA >= 0.5 * np.iinfo(rgba.dtype).max


def write_exr(path: str | Path, channels: dict[str, np.ndarray]) -> None:
    """Write a float32 OpenEXR with one named channel per [H,W] array (linear)."""
    import OpenEXR

    data = {name: np.ascontiguousarray(array, np.float32) for name, array in channels.items()}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with atomic_path(path) as temporary, OpenEXR.File(header, data) as file:
        try:
            file.write(str(temporary))
        except RuntimeError as error:  # how OpenEXR says that the disk is full
            raise InputError(f"{path}: cannot be written ({error}); choose a place you may write to, with room") from None


def read_exr(path: str | Path) -> dict[str, np.ndarray]:
    """OpenEXR -> {channel: float32 [H,W]}. Raises InputError where it is missing, cannot be read, or is damaged."""
    import OpenEXR

    path = Path(path)
    with reading(path, "EXR file"), path.open("rb") as opened:  # of a file that it cannot open OpenEXR does not say why
        opened.read(1)
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            return {name: np.asarray(channel.pixels, np.float32) for name, channel in file.channels().items()}
    except (RuntimeError, OSError, ValueError, TypeError) as error:
        raise InputError(f"{path}: not a readable EXR ({error}); the file is damaged, write it again") from None
