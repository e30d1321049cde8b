"""Outputs: whole or not at all, and a line where a disk says no."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mgs.errors import InputError
from mgs.files import (
    atomic_folder,
    atomic_path,
    check_writable,
    copy_file,
    folder_or_nothing,
    read_json,
    write_exr,
    write_json,
    write_png,
)


class Stop(BaseException):
    """As Ctrl-C is."""


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EACCES])
def test_what_the_disk_says_is_one_line(tmp_path, number):
    (tmp_path / "a.txt").write_text("before")

    def write():
        with atomic_path(tmp_path / "a.txt") as temporary:
            temporary.write_text("half")
            raise OSError(number, os.strerror(number))

    with pytest.raises(InputError, match=os.strerror(number)):
        write()
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]
    assert (tmp_path / "a.txt").read_text() == "before"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs Linux's device that is always full")
@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("a.json", lambda path: write_json(path, {"a": 1})),
        ("a.png", lambda path: write_png(path, np.random.default_rng(0).random((90, 90, 3)))),
        ("a.glb", lambda path: copy_file(Path(__file__), path)),
        ("a.exr", lambda path: write_exr(path, {"Z": np.random.default_rng(0).random((90, 90))})),
    ],
)
def test_a_full_disk_is_one_line(tmp_path, name, write):
    stem, suffix = name.split(".")
    (tmp_path / f".{stem}.{os.getpid()}.part.{suffix}").symlink_to("/dev/full")
    with pytest.raises(InputError, match="No space left"):
        write(tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_a_folder_in_place_of_a_file(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        read_json(tmp_path)


def test_under_a_file(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot be written"), atomic_path(tmp_path / "file/a.txt"):
        pass
    with pytest.raises(InputError, match="cannot be written"):
        check_writable(tmp_path / "file/deeper/a.txt")


@pytest.mark.parametrize("there", [False, True])
@pytest.mark.parametrize("folder", [folder_or_nothing, atomic_folder])
def test_a_folder_that_fails_leaves_all_as_it_was(tmp_path, folder, there):
    out = tmp_path / "new/deeper/out"
    if there:
        out.mkdir(parents=True)
    before = list(tmp_path.rglob("*"))

    def fill():
        with folder(out) as made:
            (made / "sub").mkdir()
            (made / "sub/file").touch()
            (made / "file").touch()
            raise Stop

    with pytest.raises(Stop):
        fill()
    assert list(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("folder", [folder_or_nothing, atomic_folder])
def test_what_is_in_a_folder_is_never_touched(tmp_path, folder):
    (tmp_path / "precious.txt").touch()
    with pytest.raises(InputError, match="not empty"), folder(tmp_path):
        pass
    assert (tmp_path / "precious.txt").exists()


@pytest.mark.parametrize("there", [False, True])
def test_an_atomic_folder_appears_whole(tmp_path, there):
    out = tmp_path / "new/out"
    if there:
        out.mkdir(parents=True)
    with atomic_folder(out) as made:
        (made / "file").touch()
        assert not (out / "file").exists()
    assert [path.name for path in out.parent.iterdir()] == ["out"]
    assert (out / "file").exists()


def test_a_png_holds_the_pixels_and_is_packed_fast(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (30, 40, 3), np.uint8)
    write_png(tmp_path / "display.png", pixels / 255, linear=False)
    write_png(tmp_path / "bytes.png", pixels)
    write_png(tmp_path / "mask.png", pixels[..., 0] > 99)
    for name, expected in (("display", pixels), ("bytes", pixels), ("mask", np.where(pixels[..., 0] > 99, 255, 0))):
        content = (tmp_path / f"{name}.png").read_bytes()
        with Image.open(tmp_path / f"{name}.png") as image:
            assert np.array_equal(np.asarray(image), expected)
        assert content[content.index(b"IDAT") + 4 :].startswith(b"\x78\x01")  # zlib's header of its fastest level
