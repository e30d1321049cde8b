"""Outputs: whole or not at all, and a line where a disk says no."""

from __future__ import annotations

import errno
import fcntl
import os
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from mgs.errors import InputError
from mgs.files import (
    atomic_folder,
    atomic_path,
    check_writable,
    copy_file,
    folder_or_nothing,
    locked,
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


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_what_is_no_json_is_not_written(tmp_path, value):
    write_json(tmp_path / "a.json", {"a": 1})
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "a.json", {"a": [value]})
    assert read_json(tmp_path / "a.json") == {"a": 1}
    assert len(list(tmp_path.iterdir())) == 1


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


HOLDER = """
import sys, time
from mgs.files import locked
with locked(sys.argv[1]):
    print("locked", flush=True)
    sys.stdin.read()
"""
"""A process that works on a folder until its standard input is closed."""


@contextmanager
def holder(folder):
    command = [sys.executable, "-c", HOLDER, str(folder)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "locked\n"
        yield process


@pytest.mark.parametrize("end", ["itself", "killed"])
def test_one_process_at_a_time_works_on_a_folder(tmp_path, end):
    with holder(tmp_path) as process:
        for _ in range(2):  # being refused changes nothing
            with pytest.raises(InputError, match=f"process {process.pid} works on it; wait until"), locked(tmp_path):
                pass
        if end == "killed":
            process.send_signal(signal.SIGKILL)
    assert [path.name for path in tmp_path.iterdir()] == ([".lock"] if end == "killed" else [])
    with locked(tmp_path):
        assert (tmp_path / ".lock").read_text() == str(os.getpid())
    assert not list(tmp_path.iterdir())


def test_a_lock_that_its_owner_removed_is_no_lock(tmp_path, monkeypatch):
    """Opened while another process had it, taken after that one had removed it: a third would find no lock there."""
    flock, calls = fcntl.flock, []

    def slow(file, operation):
        calls.append(operation)
        if len(calls) == 1:
            (tmp_path / ".lock").unlink()
        flock(file, operation)

    monkeypatch.setattr(fcntl, "flock", slow)
    with locked(tmp_path):
        assert (tmp_path / ".lock").is_file()
        with pytest.raises(InputError, match=f"process {os.getpid()} works on it"), locked(tmp_path):
            pass
    assert len(calls) == 3


def test_a_folder_that_cannot_be_locked(tmp_path):
    with pytest.raises(InputError, match="cannot be written"), locked(tmp_path / "missing"):
        pass
