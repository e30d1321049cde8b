"""A stranger's folder or file: one line, exit code 2; nothing is lost, written elsewhere or run."""

import json
import math
import os
import shutil
import struct
import subprocess
import sys
import tracemalloc
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
import synthetic
import tiny
from PIL import EpsImagePlugin
from program import change_checkpoint, command, output
from refusals import fails, listing, refused

from mgs import InputError, files, load_dataset, write_ply
from mgs.cli.terminal import step_lines
from mgs.data.on_site import dataset_at
from mgs.files import atomic_folder, atomic_path, below, folder_locked, locked, scratch_folder
from mgs.images import image_size, read_rgba
from mgs.notebook import thumbnails
from mgs.reports.page_plots import curve_plot
from mgs.run.checks import predicted_psnr
from mgs.run.detectors import alarms
from mgs.run.folder import open_run, text_of
from mgs.run.records import Record, parse_record
from mgs.view.layers import read_subject
from studies.frame.output import write_csv


def bomb(path: Path, side: int) -> Path:
    """A PNG file of few bytes whose header says this many pixels either way."""
    header = b"IHDR" + struct.pack(">IIBBBBB", side, side, 1, 0, 0, 0, 0)
    chunk = struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk + struct.pack(">I", 0) + b"IDAT" + b"\0" * 64)
    return path


def test_an_image_is_measured_by_its_header(capsys, dataset, tmp_path, monkeypatch):
    out = tmp_path / "out"
    for side in (4_000, 13_300, 200_000):
        bomb(dataset / "images/kf_0000.png", side)
        fails(f"kf_0000.png.*{side}x{side}", load_dataset(dataset).frames[0].rgb)
        line = refused(capsys, ["import", dataset, "--out", out], out)
        assert f"{side}x{side}" in line
    monkeypatch.setattr("mgs.memory.MEMORY_FILE", tmp_path / "meminfo")
    (tmp_path / "meminfo").write_text("MemAvailable: 1000 kB")
    fails("GiB are free", image_size, bomb(tmp_path / "b.png", 11_000))


def test_images_too_large_for_a_fit_are_named_before_it_starts(
    capsys, dataset, tmp_path, monkeypatch
):
    monkeypatch.setattr("mgs.memory.MEMORY_FILE", tmp_path / "meminfo")
    (tmp_path / "meminfo").write_text("MemAvailable: 8000000 kB")
    path = dataset / "transforms.json"
    data = json.loads(path.read_text())
    for frame in [data, *data["frames"]]:
        frame |= {"w": 8192, "h": 5464}
    path.write_text(json.dumps(data))
    line = refused(capsys, ["fit", dataset, "--out", tmp_path / "fit"], tmp_path / "fit")
    assert "8192x5464 may take 16.7 GiB, 7.6 GiB are free; import them smaller" in line


def test_postscript_in_a_picture_is_not_run(tmp_path, monkeypatch):
    """Pillow would give it to Ghostscript, whatever the name of the file."""
    program, ran = tmp_path / "gs", tmp_path / "ran"
    program.write_text(f"#!/bin/sh\ntouch {ran}")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    monkeypatch.setattr(EpsImagePlugin, "gs_binary", None)
    header = "%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 32 24\n%%EndComments\n"
    (tmp_path / "a.png").write_text(header)
    fails("not a readable image", read_rgba, tmp_path / "a.png")
    assert thumbnails([tmp_path / "a.png"]) == []
    assert not ran.exists()


def test_a_full_disk_behind_the_standard_output():
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "mgs", "--version"]
        ended = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    assert ended.stderr == "mgs: standard output: No space left on device; make room\n"
    assert ended.returncode == 2


def test_a_standard_output_that_is_closed():
    words = f"exec {sys.executable} -m mgs doctor --help >&-"
    ended = subprocess.run(words, shell=True, capture_output=True, text=True)
    assert (ended.returncode, ended.stderr) == (0, "")


def test_a_terminal_of_ascii_and_no_home():
    script = (
        "import typer; from mgs.cli import app; from mgs import runtime\n"
        "def show():\n    'Show.'\n    runtime.start(); import mitsuba as mi; mi.Float(1, 2) + 1\n"
        "    print('1 m²')\n"
        "app.show = show; app.COMMANDS['show'] = ('app.show', ''); app.main(['show'])"
    )
    env = {key: value for key, value in os.environ.items() if key != "HOME"}
    command = [sys.executable, "-c", script]
    env |= {"PYTHONIOENCODING": "ascii"}
    ended = subprocess.run(command, env=env, capture_output=True, text=True)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "1 m?\n", "")


def test_a_pipe_is_no_file(capsys, dataset, tmp_path):
    os.mkfifo(tmp_path / "pipe.glb")
    pipe, out = tmp_path / "pipe.glb", tmp_path / "out"
    for arguments in (
        ["render", pipe, "--cameras", dataset, "--out", out],
        ["import", dataset, "--mesh", pipe, "--out", out],
        ["synth-orbit", out, "--mesh", pipe],
        ["render", dataset, "--cameras", pipe, "--out", out],
    ):
        assert "is no regular file" in refused(capsys, arguments, out)


def test_the_loser_is_told_who_works_there(capsys, dataset, prior, tmp_path):
    """One lock for all who write a folder, held from the start to the end of their work."""
    out = tmp_path / "out"
    write_ply(tmp_path / "a.ply", tiny.initial([]))
    writers = {
        folder_locked: [
            ["synth-orbit", out],
            ["import", dataset, "--out", out],
            ["render", tmp_path / "a.ply", "--cameras", dataset, "--out", out],
        ],
        atomic_folder: [["survey", dataset, "--out", out], ["prior", dataset, "--out", out]],
    }
    for lock, losers in writers.items():
        with lock(out):
            for arguments in losers:
                assert f"process {os.getpid()} works on it" in refused(capsys, arguments, out)
        shutil.rmtree(out, ignore_errors=True)


def test_a_finished_import_says_so(capsys, dataset, tmp_path):
    arguments = ["import", dataset, "--out", tmp_path / "out"]
    for words in ("wrote", "is finished already"):
        assert words in output(capsys, *arguments)
    picture = sorted((dataset / "images").iterdir())[2]
    whole, time = picture.read_bytes(), picture.stat().st_mtime_ns
    os.utime(picture)
    assert "is finished already" in output(capsys, *arguments)
    picture.write_bytes(whole[:-1] + b"?")
    os.utime(picture, ns=(time, time))
    line = refused(capsys, arguments, tmp_path / "out")
    assert "its pictures, masks, mesh or model have changed since; --force" in line
    record = files.read_json(tmp_path / "out/import.json")
    older = {key: value for key, value in record.items() if key != "sha256_of_files"}
    files.write_json(tmp_path / "out/import.json", older | {"files": "digest of times"})
    assert "is finished already" in output(capsys, *arguments)
    picture.write_bytes(whole)
    synthetic.edit(dataset, lambda data: data["frames"][2].update(timestamp=99))
    assert "a finished dataset of other" in refused(capsys, arguments, tmp_path / "out")


@pytest.fixture
def stranger(seeded, tmp_path):
    """A run that anyone may have made."""
    return Path(shutil.copytree(seeded, tmp_path / "run"))


def members(**changed: object):
    """Damage of a checkpoint: with other arrays, None to leave one out."""
    return lambda path: change_checkpoint(path, **changed)


def record(**changed: object):
    """Damage of a checkpoint: with other entries of its JSON."""
    return lambda path: change_checkpoint(path, lambda known: known.update(changed))


def zip_bomb(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file, file.open("json.npy", "w") as a:
        for _ in range(64):
            a.write(bytes(1 << 20))


def endless_shape(path: Path) -> None:
    """H of a petabyte in its header."""
    with np.load(path) as data:
        arrays = {name: data[name] for name in data.files}
    with zipfile.ZipFile(path, "w") as file:
        for name, values in arrays.items():
            with file.open(f"{name}.npy", "w") as member:
                shape = (10**12, 128) if name == "H" else values.shape
                head = {"descr": values.dtype.str, "fortran_order": False, "shape": shape}
                np.lib.format.write_array_header_1_0(member, head)
                member.write(values.tobytes())


CHECKPOINTS = {
    "zip bomb": zip_bomb,
    "endless shape": endless_shape,
    "no archive": lambda path: path.write_bytes(b"no archive"),
    "objects": members(H=np.array([{}], object)),
    "no H": members(H=None),
    "H of another shape": members(H=np.zeros((3, 11))),
    "other Gaussians": members(quats=np.zeros((3, 4), np.float32)),
    "deep JSON": members(json=np.array("[" * 100_000)),
    "other keys": record(evil=1),
    "steps of words": record(steps=["a", "b"]),
    "a frame beyond": record(taken=[0, 10**9]),
    "a frame beyond, twice": record(
        taken=[0, 10**9],
        steps=[
            {"seeds": [0], "images": 1, "coverage": 0.1},
            {"frame": 10**9, "images": 2, "coverage": 0.1, "information_gain": 1},
        ],
    ),
}


PLACES = {"report": "report", "diagnose": "diagnostics", "eval": "", "simplify": ""}
"""Command on a run -> folder in the run that it locks."""


def test_two_commands_on_one_run(capsys, stranger, monkeypatch):
    """The second one would remove the half-written files of the first."""
    monkeypatch.setattr("mgs.reports.tables.compare_runs", lambda runs: runs)
    for name, place in PLACES.items():
        with folder_locked(stranger / place):
            (stranger / ".checkpoint.1073741824-01234567.part.npz").write_bytes(b"half")
            given = ["--out", stranger / place] if name == "report" else []
            line = refused(capsys, [name, stranger, *given], stranger)
            assert f"process {os.getpid()} works on it" in line
    with folder_locked(stranger):
        assert "works on it" in refused(capsys, ["nbv", "--resume", stranger], stranger)


LINKED = {
    "eval {run}": (".lock", "renders"),
    "diagnose {run} --force": ("diagnostics", "diagnostics/.lock"),
    "simplify {run} --force": (".lock",),
    "nbv --resume {run}": (".lock",),
    "prior {data} --force": ("dataset/prior", "dataset/.prior.part", "dataset/.prior.old"),
    "survey {data} --force": ("dataset/survey", "dataset/.survey.part"),
    "fit {data} --prior {prior} --out {run}/fit": (".fit.part", ".fit.old"),
    "synth-orbit {run}/new": ("new/.lock",),
    "render {run} --out {run}/new --force": ("new/.lock",),
    "import {data} --out {run}/new": ("new.unpacked", "new/.lock"),
    "video {run} --seconds 0.1 --width 16 --force": ("video.mp4",),
    "report {run} --html {run}/a.html --force": ("a.html",),
}
"""Command -> names below the run that are links; those of a file are replaced themselves."""
LINKS = [(words, place) for words, places in LINKED.items() for place in places]


@pytest.mark.parametrize(("words", "place"), LINKS)
def test_no_link_is_written_through(stranger, dataset, prior, tmp_path, words, place, capsys):
    """The link leads to a folder, or for a file to a file, that stays as it is."""
    data = shutil.copytree(dataset, stranger / "dataset")
    outside, link = tmp_path / "outside", stranger / place
    outside.mkdir()
    (outside / "kf_0000.png").write_text("mine")
    link.parent.mkdir(exist_ok=True)
    whole = link.suffix in (".mp4", ".html")
    link.symlink_to(outside / "kf_0000.png" if whole or link.name == ".lock" else outside)
    given = words.format(run=stranger, data=data, prior=prior).split()
    if whole:
        before = listing(outside)
        command(*given)
        assert listing(outside) == before
        assert not link.is_symlink()
        return
    line = refused(capsys, given, outside)
    assert f"{place}: leads out of" in line or f"{place}: is in the way" in line


@pytest.mark.parametrize("damage", CHECKPOINTS)
def test_the_checkpoint_of_a_stranger(capsys, stranger, damage):
    CHECKPOINTS[damage](stranger / "checkpoint.npz")
    tracemalloc.start()
    fails("", getattr, open_run(stranger), "state")
    assert tracemalloc.get_traced_memory()[1] < 32 << 20
    tracemalloc.stop()
    assert "checkpoint.npz: " in refused(capsys, ["eval", stranger], stranger)


SOUND = {"images": 3, "all": {"count": 0}, "held_out": {"count": 0}, "views": []}
METRICS = [
    {"images": 0}, {"images": True}, {"all": {"psnr": "30"}}, {"all": {"psnr": 1e300}},
    {"views": [{"name": 1}]},
    {"pictures": "no"}, {"test_views": {}}, {"held_out": None},
]  # fmt: skip
LINES = {
    "config.json": dict.fromkeys(('{"settings": 1}', '{"settings": {}, "frames": 7}', "[]"), ""),
    "steps.jsonl": dict.fromkeys(("", "[]", "[" * 100_000), ""),
    "metrics.json": {
        **{json.dumps(SOUND | change): f"({next(iter(change))}" for change in METRICS},
        "[]": "",
        "[" * 100_000: "",
    },
}
"""File of a run -> damaged contents -> key that the line names."""


@pytest.mark.parametrize("file", LINES)
def test_the_text_files_of_a_stranger(capsys, stranger, file):
    for text, key in LINES[file].items():
        (stranger / file).write_text(text)
        line = refused(capsys, ["report", stranger, "--html", stranger / "a.html"], stranger)
        assert str(stranger / file) in line
        assert key in line
    if file == "metrics.json":
        fails(r"metrics\.json", read_subject, stranger)


FIT = {"iterations": 6, "loss": 0.1, "stop_reason": "settled", "uncertainty": 0.1, "psnr": 30.0}
FIT |= {"indicators": {"prior": 0.1}, "warnings": ["one"], "seconds": {"fit": 0.1}}
SEEDS = {"step": 0, "images": 1, "coverage": 0.5, "seeds": [0], "seed_names": ["a"], **FIT}
SEEDS |= {"name": None, "score": None, "information_gain": None, "prediction": {"fitted": 0.1}}
SEEDS["certificate"] = {
    "criterion": "d-optimal",
    "views": 1,
    "candidates": 2,
    "share": 0.9,
    "best": 1.0,
    "nodes": 9,
    "stopped": "gap",
    "fewer": None,
    "of_all": 0.5,
    "prices": {"b": 0.1},
    "curve": [{"views": 1, "bound": 0.9, "plan": 0.8, "even": 0.7, "random": 0.6}],
}
CHOSEN = {"step": 1, "images": 2, "coverage": 0.9, "frame": 1, "name": "b", "score": 1.0, **FIT}
CHOSEN |= {"information_gain": 1.0, "exposure": {"a": [1.0, 1.0, 1.0], "b": [1.0, 1.0, 1.0]}}
CHOSEN |= {"prediction": {"fitted": 0.1, "new": 0.2, "gain": 1.0, "left": 0.5, "psnr": 9.0}}
CHOSEN["ended"] = {"reason": "budget", "views": 1}
INPUTS = {"prior": "a", "cameras": {"a": "b"}, "files": {"a": {"image": "b"}}}
RECORD = {"taken": [0, 1], "steps": [SEEDS, CHOSEN], "inputs": INPUTS, "antialiased": True}

VALUES = [0, -1, 1.5, math.nan, "", "a", True, None, [], [1], ["a"], {}, {"a": 1}, {"a": []}, ...]


def replaced(data):
    """The data with each of their values in turn replaced by each of VALUES; ... : left out."""
    for value in VALUES:
        if value is not ...:
            yield value
    items = data.items() if isinstance(data, dict) else enumerate(data)
    for key, inner in items if isinstance(data, dict | list) else ():
        for value in replaced(inner) if isinstance(inner, dict | list) else VALUES:
            yield {**data, key: value} if isinstance(data, dict) else [*data[:key], value]
        if isinstance(data, dict):
            yield {one: data[one] for one in data if one != key}


def test_no_value_of_a_wrong_type_in_a_step_is_read():
    """Print, draw and continue whatever is read."""
    read = len(parse_record(Record, json.dumps(RECORD))["steps"]) - 2
    for data in replaced(RECORD):
        text = json.dumps(data, default=lambda _: "a")
        try:
            steps = parse_record(Record, text)["steps"]
        except ValueError:
            continue
        read += 1
        assert all(list(step_lines(step)) for step in steps)
        if steps[0].get("certificate", {}).get("curve"):
            curve_plot("a", steps[0]["certificate"])
        predicted_psnr([step["prediction"] for step in steps if "prediction" in step])
        json.dumps(alarms({"prior": 0.1}, steps[-1].get("indicators")))
        text_of(steps)
    assert 20 < read < 600


def test_no_character_of_a_name_is_markup_or_controls_the_terminal(tmp_path, dataset, capsys):
    name = tmp_path / "a\n\x1b[2J"
    line = refused(capsys, ["nbv", name, "--out", tmp_path / "run"], tmp_path / "run")
    assert "a\\n\\x1b[2J" in line
    assert "a\\udcff: is not UTF-8" in refused(capsys, ["dataset", "check", "a\udcff"])
    assert str(InputError("\udcff ä")) == "\\udcff ä"
    write_csv(tmp_path / "a.csv", [{"name": "a\udcff"}])
    assert (tmp_path / "a.csv").read_bytes() == b"name\na\\udcff\n"
    folder = tmp_path / "a[" / "b]\x1b[31m"
    folder.parent.mkdir()
    folder.symlink_to(dataset)
    command("dataset", "check", folder)
    text = "".join(capsys.readouterr())
    assert "a[/b]\\x1b[31m: " in text.replace("\n", "")
    assert "\x1b" not in text


@pytest.fixture
def outside(tmp_path):
    """A folder with a file that must stay as it is."""
    folder = tmp_path / "outside"
    folder.mkdir()
    (folder / "a").write_text("mine")
    yield folder
    assert [path.name for path in folder.iterdir()] == ["a"]
    assert (folder / "a").read_text() == "mine"


SITES = {
    "not a readable list": lambda site, _: (site / "copies.json").write_text("5"),
    "is not in|leads out of": lambda site, _: (site / "copies.json").write_text(
        '["../../outside/a"]'
    ),
    "cannot be written.*null": lambda site, _: (site / "copies.json").write_text('["a\\u0000"]'),
    "cannot be written": lambda site, _: (site / "photographs").touch(),
    "photographs: leads out of": lambda site, outside: (site / "photographs").symlink_to(outside),
    "matches: leads out of": lambda site, outside: (site / "matches").symlink_to(outside),
    "is in the way": lambda site, _: (site / "copies.json").rename(site / "a"),
}
"""Damage of the folder beside photographs in which `mgs suggest` places them, by its message."""


@pytest.mark.parametrize("words", SITES)
def test_the_site_of_a_stranger(outside, dataset, tmp_path, words):
    site = tmp_path / "images.site"
    site.mkdir()
    (site / "copies.json").write_text("[]")
    SITES[words](site, outside)
    fails(words, dataset_at, dataset / "images", site)


def test_nothing_below_a_locked_folder_is_written_through_a_link(outside, tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    (run / "renders").symlink_to(outside)
    (run / "b").symlink_to(outside / "a")
    with locked(run):
        for path in (run / "renders/a", run / "renders/new/a"):
            with pytest.raises(InputError, match="leads out of"), atomic_path(path):
                pass
        for path in (run / "renders/a", outside / "a", run / ".."):
            fails("leads out of|is not in|cannot be written", files.remove_file, run, path)
        with atomic_path(run / "b") as temporary:  # the link itself is replaced
            temporary.write_text("ours")
        files.remove_leftovers(run)
        assert (run / "b").read_text() == "ours"
        assert not (run / "b").is_symlink()
    fails("leads out of", below, run, "renders")
    for name in ("../outside", str(outside)):
        fails("leads out of", below, run, name)


@pytest.mark.parametrize("use", [locked, folder_locked])
@pytest.mark.parametrize("kind", ["link", "text", "huge", "folder"])
def test_a_lock_that_mgs_did_not_make(outside, tmp_path, use, kind):
    run = tmp_path / "run"
    run.mkdir()
    lock = run / ".lock"
    {
        "link": lambda: lock.symlink_to(outside / "a"),
        "text": lambda: lock.write_text("mine"),
        "huge": lambda: (lock.touch(), os.truncate(lock, 1 << 40)),
        "folder": lock.mkdir,
    }[kind]()
    with pytest.raises(InputError, match=r"\.lock: is in the way"), use(run):
        pass
    assert os.path.lexists(lock)


@pytest.mark.parametrize("kind", ["link", "folder"])
def test_a_folder_named_as_a_leftover_is_not_deleted(outside, tmp_path, kind):
    for name in (".out.part", ".out.old", "scratch"):
        place = tmp_path / name
        if kind == "link":
            place.symlink_to(outside)
        else:
            place.mkdir()
            (place / "b").touch()
    for make in (lambda: atomic_folder(tmp_path / "out"), lambda: scratch_folder(place)):
        with pytest.raises(InputError, match="is in the way, and mgs did not make it"), make():
            pass
    assert kind == "link" or (place / "b").is_file()


def test_a_scratch_folder_leaves_nothing(tmp_path):
    for _ in range(2):
        with scratch_folder(tmp_path / "x") as made:
            assert [path.name for path in made.iterdir()] == [".lock"]
            (made / "a").touch()
        assert not made.exists()
        (tmp_path / "x").mkdir()  # as a killed process leaves it
        (tmp_path / "x/.lock").write_text("mgs 1")
        (tmp_path / "x/a").touch()


def test_a_device_is_not_replaced(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for path in (pipe, Path("/dev/null"), Path("/dev/stdout")):
        fails("is a device or a pipe", files.check_writable, path)
        with pytest.raises(InputError, match="is a device or a pipe"), atomic_path(path):
            pass
    assert pipe.is_fifo()


def test_a_strangers_settings_name_a_program_that_is_not_run(tmp_path, dataset, capsys):
    (tmp_path / "evil.py").write_text("raise SystemExit")
    (tmp_path / "a.toml").write_text(f'policy = "{tmp_path}/evil.py:f"')
    asked = ["nbv", dataset, "--config", tmp_path / "a.toml", "--out", tmp_path / "run"]
    assert f"to run it, add --policy {tmp_path}/evil.py:f" in refused(capsys, asked)
