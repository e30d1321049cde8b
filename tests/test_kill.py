"""Commands killed (SIGKILL) at random moments and run again: their files equal those of an
uninterrupted run bit for bit. Two processes of each. The memory of 1,000 steps.

`pytest -m kill` runs them; KILLS: number of kills, by default 100.
"""

import ctypes
import faulthandler
import gc
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import synthetic
import tiny
from test_structure_from_motion import arc, views

from mgs.run.nbv import resume_nbv, start_run

pytestmark = pytest.mark.kill
MOST_GROWTH = 30 << 20
"""Bytes of memory that the steps from 200 to 1,000 may add: their images and sorted lists."""
KILLS = int(os.environ.get("KILLS", "100"))

PROGRAM = """
from mgs import runtime
runtime.start()
from mgs.cli.app import main
from mgs.synth import arena
arena.ROWS, arena.TEXELS = 60, 64
from mgs.fit import unfinished
unfinished.SECONDS = 0.0
main()
"""
"""mgs, with a coarse ground, and with every step of a fit on disk."""

TOML = "[rock]\ndetail = 0.06\n[arena]\nstones = 20\n"
UNEQUAL = rb'"(commit|\w*seconds\w*)":\s*(\{[^}]*\}|"[^"]*"|[-+.\de]+)'
LOOP = "--seeds 2 --budget 2 --set train.passes=3 --seed 1"
COMMANDS = {
    "nbv": f"nbv {{data}} --prior {{prior}} --out {{out}} {LOOP} --set evaluate_every=1",
    "fit": "fit {data} --prior {prior} --means free --density split --passes 6 --out {out}",
    "synth-orbit": "synth-orbit {out} --scene {scene} --frames 6 --size 64x48 --spp 2",
    "import": "import {data} --mesh {data}/rock.glb --out {out}",
    "photographs": "import {photographs} --out {out}",
    "video": "import {video} --keyframes 0.1s --out {out}",
    "export": "export {run} --to mgs --bytes 3000 --out {out} --force",
    "prune": "simplify {out} --force",
    "refit": "simplify {out} --method refit --force",
    "site": "suggest {out} --gaussians 150",
}
"""Name -> arguments."""
COPIED = {"prune": "run", "refit": "run", "site": "photographs"}
"""Command -> the place of which it gets a copy as {out}."""

LOST = "works on it|is finished already|is there already"
"""Pattern of the loser's line."""


@pytest.fixture(autouse=True)
def _patient() -> None:
    """These tests take longer than the time after which pytest ends a test."""
    faulthandler.cancel_dump_traceback_later()


@pytest.fixture(scope="module")
def places(tmp_path_factory) -> dict[str, Path]:
    """A dataset of 8 frames, its prior, a scene, a finished run, and the folder to write."""
    faulthandler.cancel_dump_traceback_later()
    root = tmp_path_factory.mktemp("kill")
    data = synthetic.write_dataset(root / "data", synthetic.orbit_cameras(8, 48, 36)).root
    paths = {"data": data, "prior": root / "prior", "run": root / "run"}
    paths |= {"scene": root / "scene.toml", "out": root / "work/out"}
    paths["scene"].write_text(TOML)
    paths |= {"photographs": root / "photographs/images", "video": root / "video.avi"}
    shots = views(root / "photographs", arc(8))
    film = cv2.VideoWriter(str(paths["video"]), cv2.VideoWriter.fourcc(*"MJPG"), 10, (320, 240))
    for shot in shots:
        film.write(cv2.imread(str(shot.image_path)))
    film.release()
    made = f"prior {data} --mesh {data}/rock.glb --gaussians 150 --out {paths['prior']}"
    nbv = COMMANDS["nbv"].format(**paths | {"out": paths["run"]})
    for arguments in (made, nbv, f"eval {paths['run']}"):
        subprocess.run([sys.executable, "-c", PROGRAM, *arguments.split()], check=True)
    return paths


def started(name: str, places: dict[str, Path], **pipes: int) -> subprocess.Popen:
    """The process of a command; of a run that has begun, the one that resumes it."""
    arguments = COMMANDS[name].format(**places).split()
    if arguments[0] in ("nbv", "fit") and (places["out"] / "config.json").is_file():
        arguments = ["nbv", "--resume", str(places["out"])]
    program = [sys.executable, "-c", PROGRAM, *arguments]
    return subprocess.Popen(program, stdout=subprocess.DEVNULL, text=True, **pipes)


def cleared(name: str, places: dict[str, Path]) -> Path:
    """The folder around {out}, as it is before the command."""
    work = places["out"].parent
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir()
    if name in COPIED:
        shutil.copytree(places[COPIED[name]], places["out"])
    return work


def contents(work: Path) -> dict[str, object]:
    """Every file below a folder but its commit: bytes, or of checkpoints the arrays. A database has
    its rows in other pages after an interruption, and does not count."""
    found: dict[str, object] = {}
    for path in sorted(work.rglob("*")):
        key, data = str(path.relative_to(work)), path.read_bytes() if path.is_file() else b""
        if path.suffix in (".json", ".jsonl"):
            data = re.sub(UNEQUAL, b"", data)
        if path.suffix == ".db":
            continue
        if path.suffix == ".npz":
            with np.load(path) as arrays:
                found[key] = [arrays[n].tobytes() for n in arrays.files if n != "json"]
        else:
            found[key] = data
    return found


@pytest.mark.parametrize("name", COMMANDS)
def test_killed_at_any_moment(name, places):
    work, begun = cleared(name, places), time.monotonic()
    assert started(name, places).wait() == 0
    took, whole = time.monotonic() - begun, contents(work)
    for moment in np.random.default_rng(0).uniform(0, took, -(-KILLS // len(COMMANDS))):
        cleared(name, places)
        process = started(name, places)
        time.sleep(moment)
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert started(name, places).wait() == 0, f"killed after {moment:.2f} s"
        after = contents(work)
        differ = [key for key in whole | after if whole.get(key) != after.get(key)]
        assert not differ, f"killed after {moment:.2f} s of {took:.2f}"


@pytest.mark.parametrize("name", COMMANDS)
def test_two_processes_of_a_command(name, places):
    """Both leave what one leaves alone, or one ends with code 2 and a line that says why."""
    work = cleared(name, places)
    assert started(name, places).wait() == 0
    whole = contents(work)
    cleared(name, places)
    both = [started(name, places, stderr=subprocess.PIPE) for _ in range(2)]
    ends = [(one.communicate()[1], one.returncode) for one in both]
    lost = [(said, code) for said, code in ends if code != 0]
    assert len(lost) < 2, ends
    for said, code in lost:
        assert (code, said.count("\n")) == (2, 1), said
        assert re.search(LOST, said), said
    assert contents(work) == whole


def test_memory_of_1000_steps_is_flat(tmp_path):
    """A run of 1,000 views on a minute problem, with the kernels of the program. Memory that the
    allocator holds free is given back first: it has come to 40 MB, and nothing keeps it."""
    data, prior = tiny.write_dataset(tmp_path / "data", 1003), tiny.write_prior(tmp_path / "prior")
    fit = {"train": {"passes": 1}, "warm_passes": 1}
    run = start_run(data, tmp_path / "run", prior=prior, seeds=3, budget=1000, batch=100, **fit)
    resident = {}

    def measure(state) -> None:
        gc.collect()
        ctypes.CDLL("libc.so.6").malloc_trim(0)
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        resident[len(state.taken) - 3] = pages * resource.getpagesize()

    resume_nbv(run, on_step=measure)
    assert resident[1000] < resident[200] + MOST_GROWTH, resident
