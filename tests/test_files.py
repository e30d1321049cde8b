"""Files and images: complete or absent, errors in one line, and every kind of PNG."""

import errno
import fcntl
import os
import signal
import struct
import subprocess
import sys
import zlib
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from refusals import fails

from mgs import InputError, files
from mgs.colour import linear_from_srgb
from mgs.data.meshes import load_mesh
from mgs.files import (
    TOKEN,
    atomic_folder,
    atomic_path,
    copy_file,
    locked,
    read_json,
    read_leftover,
    write_json,
)
from mgs.images import read_exr, read_mask, read_png, read_rgba, read_values, write_exr, write_png
from studies.frame.output import write_csv


def test_what_the_disk_says_is_one_line(tmp_path):
    (tmp_path / "a.txt").write_text("before")

    def write():
        with atomic_path(tmp_path / "a.txt") as temporary:
            temporary.write_text("half")
            raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    fails(os.strerror(errno.EROFS), write)
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]
    assert (tmp_path / "a.txt").read_text() == "before"


def test_records_with_other_keys_share_one_csv(tmp_path):
    records = [{"a": 1, "b": None}, {"c": "x, y", "a": 0.5}]
    assert write_csv(tmp_path / "a.csv", records) == tmp_path / "a.csv"
    assert (tmp_path / "a.csv").read_bytes() == b'a,b,c\n1,,\n0.5,,"x, y"\n'


NOISE = np.random.default_rng(0).random((90, 90, 3))
WRITERS = {
    "a.json": lambda path: write_json(path, {"a": 1}),
    "a.png": lambda path: write_png(path, NOISE),
    "a.glb": lambda path: copy_file(Path(__file__), path),
    "a.exr": lambda path: write_exr(path, {"Z": NOISE[..., 0]}),
}


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs Linux's /dev/full")
@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_is_one_line(tmp_path, name):
    stem, suffix = name.split(".")
    (tmp_path / f".{stem}.{os.getpid()}-{TOKEN}.part.{suffix}").symlink_to("/dev/full")
    fails("No space left", WRITERS[name], tmp_path / name)
    assert not list(tmp_path.iterdir())


def forbid(path):
    path.touch()
    path.chmod(0)
    if os.access(path, os.R_OK):  # root may read all files
        path.unlink()
        path.symlink_to("/proc/self/mem")  # opens, and fails when its first byte is read


UNREADABLE = {
    "missing": (lambda path: None, "no such "),
    "a folder": (lambda path: path.mkdir(), r"cannot be read \(Is a directory\)"),
    "forbidden": (forbid, r"cannot be read \((Permission denied|Input/output error)\)"),
}
READERS = {
    "a.json": read_json,
    "a.png": read_png,
    "depth.png": read_values,
    "a.exr": read_exr,
    "a.glb": load_mesh,
    "source.png": lambda path: copy_file(path, path.with_name("copy.png")),
}


@pytest.mark.skipif(not Path("/proc/self/mem").exists(), reason="needs Linux's /proc")
@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("case", UNREADABLE)
def test_what_cannot_be_read_is_named_with_its_cause(tmp_path, case, name):
    make, cause = UNREADABLE[case]
    make(tmp_path / name)
    line = fails(f"^{tmp_path / name}: {cause}", READERS[name], tmp_path / name)
    assert "damaged" not in line
    assert not (tmp_path / "copy.png").exists()


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_what_is_no_json_is_not_written(tmp_path, value):
    write_json(tmp_path / "a.json", {"a": 1})
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "a.json", {"a": [value]})
    assert read_json(tmp_path / "a.json") == {"a": 1}
    assert len(list(tmp_path.iterdir())) == 1


def test_a_damaged_leftover_counts_as_none(tmp_path):
    assert read_leftover(tmp_path / "a.json") is None
    for text, found in (("{", None), ("[1]", [1])):
        (tmp_path / "a.json").write_text(text)
        assert read_leftover(tmp_path / "a.json") == found


@pytest.mark.parametrize("there", [False, True])
def test_a_folder_that_fails_leaves_all_as_it_was(tmp_path, there):
    out = tmp_path / "new/deeper/out"
    if there:
        out.mkdir(parents=True)
    before = list(tmp_path.rglob("*"))

    def fill():
        with atomic_folder(out) as made:
            (made / "sub").mkdir()
            (made / "sub/file").touch()
            (made / "file").touch()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fill()
    assert list(tmp_path.rglob("*")) == before


def test_what_ended_processes_left_in_a_folder_is_removed(tmp_path):
    (tmp_path / "renders").mkdir()
    ended = [f".a.{process}-{TOKEN}.part.ply" for process in (os.getpid(), 2**30)]
    kept = {f".a.1-{TOKEN}.part.ply", ".a.part", f".a.{2**30}.part.ply", f".b.{2**30}-{TOKEN}.part"}
    for name in [*ended, *sorted(kept)[:-1]]:
        (tmp_path / "renders" / name).touch()
    (tmp_path / "renders" / max(kept)).mkdir()
    with files.working_in(tmp_path):
        assert {path.name for path in (tmp_path / "renders").iterdir()} == kept


def test_what_a_killed_process_left_of_an_atomic_folder_is_removed(tmp_path):
    for name in (".out.part/images", ".other.part", "out"):
        (tmp_path / name).mkdir(parents=True)
    for name in (".out.part", "out"):
        (tmp_path / name / ".lock").write_text("mgs 1")
    with atomic_folder(tmp_path / "out") as made:
        (made / "file").touch()
    assert {path.name for path in tmp_path.iterdir()} == {"out", ".other.part"}
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["file"]


def encode_png(samples, bits, colour, palette=b"", transparent=b""):
    """A PNG of samples [H,W,C] by its specification. palette: PLTE; transparent: tRNS."""
    digits = (samples[..., None] >> np.arange(bits)[::-1]) & 1
    rows = np.packbits(digits.reshape(len(samples), -1).astype(bool), axis=1)
    chunks = {
        b"IHDR": struct.pack(">IIBBBBB", samples.shape[1], len(samples), bits, colour, 0, 0, 0),
        b"PLTE": palette,
        b"tRNS": transparent,
        b"IDAT": zlib.compress(b"".join(b"\0" + row.tobytes() for row in rows)),
        b"IEND": b"",
    }
    data = b"\x89PNG\r\n\x1a\n"
    for kind, content in chunks.items():
        if content or kind == b"IEND":
            checksum = struct.pack(">I", zlib.crc32(kind + content))
            data += struct.pack(">I", len(content)) + kind + content + checksum
    return data


GREY, RGB, PALETTE, GREY_ALPHA, RGBA = 0, 2, 3, 4, 6
CHANNELS = {GREY: 1, RGB: 3, PALETTE: 1, GREY_ALPHA: 2, RGBA: 4}
PNGS = [
    *((bits, GREY, False) for bits in (1, 2, 4, 8, 16)),
    *((bits, PALETTE, transparent) for bits in (1, 2, 4, 8) for transparent in (False, True)),
    *((bits, colour, False) for bits in (8, 16) for colour in (GREY_ALPHA, RGB, RGBA)),
    *((bits, GREY, True) for bits in (1, 8)),
    *((bits, RGB, True) for bits in (8, 16)),
]
"""All kinds of PNG: bits per sample, colour type, whether a colour or palette is transparent."""


@pytest.mark.parametrize(("bits", "colour", "transparent"), PNGS)
def test_every_kind_of_png(tmp_path, bits, colour, transparent):
    rng = np.random.default_rng(bits)
    levels, full = 2**bits, 65535 if bits == 16 else 255
    samples = rng.integers(0, levels, (5, 7, CHANNELS[colour]))
    if colour == PALETTE:
        palette = rng.integers(0, 256, (levels, 3), np.uint8)
        alphas = rng.integers(0, 256, levels) if transparent else np.full(levels, 255)
        expected = np.dstack([palette[samples[..., 0]], alphas[samples[..., 0]]])
        key = bytes(alphas.tolist()) if transparent else b""
        data = encode_png(samples, bits, colour, palette.tobytes(), key)
    else:
        scaled = samples * full // (levels - 1)
        rgb = scaled[..., :3] if colour in (RGB, RGBA) else np.repeat(scaled[..., :1], 3, axis=-1)
        alpha = scaled[..., -1] if colour in (GREY_ALPHA, RGBA) else np.full((5, 7), full)
        if transparent:
            alpha = np.where((samples == samples[2, 3]).all(-1), 0, full)
        key = samples[2, 3].astype(">u2").tobytes() if transparent else b""
        expected = np.dstack([rgb, alpha])
        data = encode_png(samples, bits, colour, transparent=key)
    (tmp_path / "a.png").write_bytes(data)
    rgba = read_rgba(tmp_path / "a.png")
    assert rgba.dtype == (np.uint16 if bits == 16 else np.uint8)
    np.testing.assert_array_equal(rgba, expected)
    linear = linear_from_srgb(expected[..., :3] / full)
    np.testing.assert_allclose(read_png(tmp_path / "a.png"), linear, atol=1e-6)
    grey = expected[..., :3] @ [0.299, 0.587, 0.114] / full
    sure = np.abs(grey - 0.5) > 1e-3
    np.testing.assert_array_equal(read_mask(tmp_path / "a.png")[sure], (grey > 0.5)[sure])


@pytest.mark.parametrize("mode", ["L", "RGB"])
def test_jpeg(tmp_path, mode):
    ramp = np.linspace(20, 230, 32).astype(np.uint8)[None].repeat(24, 0)
    values = ramp if mode == "L" else np.dstack([ramp, 255 - ramp, ramp // 2])
    Image.fromarray(values).save(tmp_path / "a.jpg", quality=100, subsampling=0)
    rgba = read_rgba(tmp_path / "a.jpg")
    assert (rgba[..., 3] == 255).all()
    expected = values if mode == "RGB" else np.dstack([values] * 3)
    np.testing.assert_allclose(rgba[..., :3], expected, atol=3)


def transparent_grey(bits):
    """A PNG that no library reads right."""
    samples = np.arange(4).reshape(2, 2, 1)
    return lambda path: path.write_bytes(encode_png(samples, bits, GREY, transparent=b"\0\1"))


def half(colour):
    samples = np.random.default_rng(0).integers(0, 65536, (40, 50, CHANNELS[colour]))
    data = encode_png(samples, 16, colour)
    return lambda path: path.write_bytes(data[: len(data) // 2])


def pillow(mode):
    return lambda path: Image.new(mode, (4, 3)).save(path)


NO_IMAGE = {
    **{f"grey{bits}.png": transparent_grey(bits) for bits in (2, 4, 16)},
    **{f"half{colour}.png": half(colour) for colour in (GREY, RGB)},
    **{f"{mode}.tif": pillow(mode) for mode in ("CMYK", "I", "F", "I;16")},
    "CMYK.jpg": pillow("CMYK"),
}


@pytest.mark.parametrize("name", NO_IMAGE)
def test_an_image_that_cannot_be_is_named(tmp_path, name):
    NO_IMAGE[name](tmp_path / name)
    for read in (read_png, read_rgba, read_mask):
        fails(name, read, tmp_path / name)
    write_png(tmp_path / "rgb.png", np.zeros((3, 4, 3)))
    fails(r"rgb\.png", read_values, tmp_path / "rgb.png")  # of three channels


HOLDER = """
import sys, time
from mgs.files import locked
with locked(sys.argv[1]):
    print("locked", flush=True)
    sys.stdin.read()
"""
"""Program that locks a folder until its standard input is closed."""


@contextmanager
def holder(folder):
    command, pipe = [sys.executable, "-c", HOLDER, str(folder)], subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as process:
        assert process.stdout.readline() == "locked\n"
        yield process


@pytest.mark.parametrize("end", ["itself", "killed"])
def test_one_process_at_a_time_works_on_a_folder(tmp_path, end):
    with holder(tmp_path) as process:
        said = f"process {process.pid} works on it; wait until"
        for _ in range(2):  # a refusal changes nothing
            with pytest.raises(InputError, match=said), locked(tmp_path):
                pass
        if end == "killed":
            process.send_signal(signal.SIGKILL)
    assert [path.name for path in tmp_path.iterdir()] == ([".lock"] if end == "killed" else [])
    with locked(tmp_path):
        assert (tmp_path / ".lock").read_text() == f"mgs {os.getpid()}"
    assert not list(tmp_path.iterdir())


def test_a_lock_that_its_owner_removed_is_no_lock(tmp_path, monkeypatch):
    """Opened while another process had it, and locked after that one removed the file."""
    flock, calls = fcntl.flock, []

    def slow(file, operation):
        calls.append(operation)
        if len(calls) == 1:
            (tmp_path / ".lock").unlink()
        flock(file, operation)

    monkeypatch.setattr(fcntl, "flock", slow)
    with locked(tmp_path):
        assert (tmp_path / ".lock").is_file()
        said = f"process {os.getpid()} works on it"
        with pytest.raises(InputError, match=said), locked(tmp_path):
            pass
    assert len(calls) == 3


def test_a_folder_that_cannot_be_locked(tmp_path):
    with pytest.raises(InputError, match="cannot be written"), locked(tmp_path / "missing"):
        pass


def test_a_png_holds_the_pixels(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (30, 40, 3), np.uint8)
    mask = pixels[..., 0] > 99
    write_png(tmp_path / "display.png", pixels / 255, linear=False)
    write_png(tmp_path / "bytes.png", pixels)
    write_png(tmp_path / "mask.png", mask)
    for name, expected in (("display", pixels), ("bytes", pixels), ("mask", 255 * mask)):
        with Image.open(tmp_path / f"{name}.png") as image:
            assert np.array_equal(np.asarray(image), expected)
