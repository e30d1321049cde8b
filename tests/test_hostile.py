"""Hostile input: one line, exit code 2, nothing lost, nothing decoded that is too large."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageFile
from refusals import refused

from mgs.data.dataset import load_dataset
from mgs.errors import InputError
from mgs.files import read_json
from mgs.images import image_size, read_exr, read_rgba, write_exr


def bomb(path: Path, side: int, kind: str = "PNG") -> Path:
    """A black image of few bytes. Beyond 20,000 pixels only the header says so."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if side <= 20_000:
        Image.new("1" if kind == "PNG" else "L", (side, side)).save(path, kind)
        return path
    header = b"IHDR" + struct.pack(">IIBBBBB", side, side, 1, 0, 0, 0, 0)
    chunk = struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk + struct.pack(">I", 0) + b"IDAT" + b"\0" * 64)
    return path


def exr_bomb(path: Path) -> Path:
    """An EXR file of 4x4 pixels whose header says 2^21 x 4."""
    write_exr(path, {"Z": np.zeros((4, 4))})
    window = b"dataWindow\0box2i\0" + struct.pack("<i", 16)
    said = window + struct.pack("<iiii", 0, 0, 2**21 - 1, 3)
    small = window + struct.pack("<iiii", 0, 0, 3, 3)
    assert small in path.read_bytes()
    path.write_bytes(path.read_bytes().replace(small, said))
    return path


@pytest.mark.parametrize("side", [4_000, 13_300, 200_000])
@pytest.mark.parametrize("command", ["check", "import"])
def test_an_image_is_measured_by_its_header(capsys, dataset, tmp_path, monkeypatch, side, command):
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", None)
    bomb(dataset / "images/kf_0000.png", side)
    for name in ("load", "verify"):
        monkeypatch.setattr(ImageFile.ImageFile, name, None)  # decoding would fail
    if command == "import":
        line = refused(capsys, ["import", dataset, "--out", tmp_path / "out"], tmp_path / "out")
    else:
        with pytest.raises(InputError) as error:
            load_dataset(dataset).frames[0].rgb()
        line = str(error.value)
    assert f"{side}x{side}" in line or "too large" in line
    assert "kf_0000.png" in line


def test_other_bombs(tmp_path, monkeypatch):
    with pytest.raises(InputError, match="2097152x4 pixels"):
        read_exr(exr_bomb(tmp_path / "a.exr"))
    with pytest.raises(InputError, match=r"too large|13300x13300"):
        read_rgba(bomb(tmp_path / "a.jpg", 13_300, "JPEG"))
    monkeypatch.setattr("mgs.memory.MEMORY_FILE", tmp_path / "meminfo")
    (tmp_path / "meminfo").write_text("MemAvailable: 1000 kB")
    with pytest.raises(InputError, match="GiB are free"):
        image_size(bomb(tmp_path / "b.png", 11_000))


def test_a_file_larger_than_the_memory_is_not_read(tmp_path):
    with (tmp_path / "a.json").open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(InputError, match="GiB are free"):
        read_json(tmp_path / "a.json")


def test_json_of_other_encodings_is_read(tmp_path):
    for encoding in ("utf-8-sig", "utf-16", "utf-32-le"):
        (tmp_path / "a.json").write_text('{"ä": 1}', encoding=encoding)
        assert read_json(tmp_path / "a.json") == {"ä": 1}


def test_a_damaged_exr_is_one_line(tmp_path, capfd):
    write_exr(tmp_path / "a.exr", {"Z": np.random.default_rng(0).normal(size=(48, 64))})
    data = (tmp_path / "a.exr").read_bytes()
    (tmp_path / "a.exr").write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match="not a readable EXR"):
        read_exr(tmp_path / "a.exr")
    assert capfd.readouterr().err == ""


LONG = "a" * 5000


@pytest.mark.parametrize(
    "arguments",
    [
        ["dataset", "check", LONG],
        ["synth-orbit", "out", "--scene", f"{LONG}.toml"],
        ["import", LONG, "--out", "out"],
        ["survey", LONG],
        ["report", LONG],
        ["eval", LONG],
    ],
    ids=lambda arguments: arguments[0],
)
def test_a_name_of_5000_characters(capsys, tmp_path, monkeypatch, arguments):
    monkeypatch.chdir(tmp_path)
    assert len(refused(capsys, arguments, tmp_path)) < 300


def program(*arguments: object, **options) -> subprocess.CompletedProcess:
    """Run `mgs` as a process of its own. A value None removes a variable of its environment."""
    changed = options.pop("env", {})
    env = {key: value for key, value in (os.environ | changed).items() if value is not None}
    command = [sys.executable, "-m", "mgs", *map(str, arguments)]
    return subprocess.run(command, env=env, timeout=120, text=True, **options)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs Linux's /dev/full")
def test_a_full_disk_behind_the_standard_output():
    with open("/dev/full", "w") as full:
        ended = program("--version", stdout=full, stderr=subprocess.PIPE)
    line = "mgs: standard output: No space left on device; make room\n"
    assert (ended.returncode, ended.stderr) == (2, line)


def test_a_terminal_of_ascii_and_no_home():
    script = (
        "import typer; from mgs.cli import app; from mgs import runtime\n"
        "def show():\n    runtime.start(); import mitsuba as mi; mi.Float(1, 2) + 1\n"
        "    print('1 m²')\n"
        "app.app.command('show')(show); app.main(['show'])"
    )
    env = {key: value for key, value in os.environ.items() if key != "HOME"}
    ended = subprocess.run(
        [sys.executable, "-c", script],
        env=env | {"PYTHONIOENCODING": "ascii"},
        capture_output=True,
        text=True,
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "1 m?\n", "")
