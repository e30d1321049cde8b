"""An interrupted import, and the same command again: the same dataset, bit for bit."""

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import synthetic
import trimesh
from program import command, exit_code, said
from refusals import listing, refused

from mgs.data import importers
from mgs.images import write_png

STRUCK = """
import os, signal, sys
from mgs.data import importers
from mgs.cli.app import main

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background may ignore it
write, calls, end = importers.write_png, [], int(sys.argv.pop())

def strike(path, *arguments, **options):
    calls.append(path.parent.name)
    if calls.count("images") == 4:
        os.kill(os.getpid(), end)
    write(path, *arguments, **options)

importers.write_png = strike
main()
"""
"""The program, which sends itself the signal that is its last argument, after three images and all
of the fourth frame but its image."""


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """Eight distorted frames with depth."""
    root = synthetic.write_dataset(tmp_path / "data").root
    synthetic.edit(root, lambda data: data.update(k1=-0.15, k2=0.04, p1=0.002))
    return root


@pytest.fixture
def many(source: Path) -> list:
    """Its arguments, with masks from a mesh."""
    return ["import", source, "--mesh", source / "rock.glb", "--out"]


@pytest.mark.parametrize(("end", "code"), [(signal.SIGKILL, -signal.SIGKILL), (signal.SIGINT, 130)])
def test_ended_in_the_middle_and_given_again(many, tmp_path, monkeypatch, end, code):
    """A real process, a real signal; then no finished frame is read again."""
    out = tmp_path / "out"
    program = [sys.executable, "-c", STRUCK, *map(str, [*many, out, int(end)])]
    process = subprocess.run(program, capture_output=True, text=True)
    assert process.returncode == code, process.stderr
    assert not (out / "transforms.json").exists()
    assert len(list((out / "images").iterdir())) == 3
    (out / "images/.kf_0003.1073741824-01234567.part.png").touch()  # of a killed process
    kept = {path: path.stat().st_mtime_ns for path in (out / "images").glob("kf_*")}

    read, load = [], importers.read_rgba
    with monkeypatch.context() as patch:
        patch.setattr(importers, "read_rgba", lambda path: (read.append(path.stem), load(path))[1])
        command(*many, out)
    assert read == [f"kf_{k:04d}" for k in range(3, 8)]
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    command(*many, tmp_path / "whole")
    assert listing(out) == listing(tmp_path / "whole")


def unfinished(source: Path, arguments: list, out: Path, capsys) -> None:
    """Import the four frames before a damaged image, and mend it."""
    image = source / "images/kf_0004.png"
    whole = image.read_bytes()
    image.write_bytes(whole[:100])
    assert exit_code(*arguments, out) == 2
    assert "kf_0004.png: not a readable image" in said(capsys)[1]
    assert len(list((out / "images").iterdir())) == 4
    image.write_bytes(whole)


def test_an_unfinished_import_of_something_else_is_refused(source, many, tmp_path, capsys):
    out = tmp_path / "out"
    unfinished(source, many, out, capsys)
    other = synthetic.write_dataset(tmp_path / "other").root
    trimesh.creation.icosphere(subdivisions=2).export(tmp_path / "ball.ply")
    masks, ball = ["--masks", source / "masks"], ["--mesh", tmp_path / "ball.ply"]
    smaller = [source, "--mesh", source / "rock.glb", "--downscale", "2"]
    for arguments in ([other], [source, *masks], [source, *ball], smaller):
        line = refused(capsys, ["import", *arguments, "--out", out], out)
        assert "unfinished dataset of other settings or sources" in line
    synthetic.edit(source, lambda data: data.update(cx=30.0))
    assert "unfinished dataset" in refused(capsys, [*many, out], out)


def test_a_frame_whose_files_changed_is_made_again(source, many, tmp_path, capsys):
    unfinished(source, many, tmp_path / "out", capsys)
    write_png(source / "images/kf_0000.png", np.full((48, 64, 3), 0.5))
    command(*many, tmp_path / "out")
    command(*many, tmp_path / "whole")
    assert listing(tmp_path / "out") == listing(tmp_path / "whole")


def test_killed_before_the_first_frame(many, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out/.import.1073741824-01234567.part.json").touch()
    command(*many, tmp_path / "out")
    assert not list((tmp_path / "out").glob(".*"))
