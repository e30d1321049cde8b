"""Commands killed (SIGKILL) at random moments and run again: their files equal those of an
uninterrupted run bit for bit. `pytest -m kill` runs it; KILLS: number of kills, by default 100."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import synthetic

pytestmark = pytest.mark.kill
KILLS = int(os.environ.get("KILLS", "100"))

PROGRAM = """
from mgs import runtime
runtime.start()
from mgs.cli.app import main
from mgs.run.nbv import CAPTURE_PRESET
from mgs.synth import arena, rendering
arena.ROWS, arena.TEXELS = 60, 64
rendering.PRESETS[CAPTURE_PRESET] = rendering.RenderPreset(64, 48, 8, 2)
main()
"""
CELL = """
import sys
from pathlib import Path
from mgs.study.sweep import Cell, run_cells
given = {"data": sys.argv[2]}
run_cells(Path(sys.argv[1]), [Cell("run", "test_sweep:real_run", given)], lambda *_: None)
"""
"""Programs: mgs, with a coarse ground and few pixels; a study of one cell, which is a run."""

TOML = "[rock]\ndetail = 0.06\n[arena]\nstones = 20\n"
UNEQUAL = rb'"(commit|\w*seconds\w*)":\s*(\{[^}]*\}|"[^"]*"|[-+.\de]+)'
LOOP = "--seed-views 2 --budget 2 --passes 3 --random-seed 1"
COMMANDS = {
    "nbv": f"nbv {{data}} --prior {{prior}} --out {{out}} {LOOP} --evaluate-every 1",
    "capture": f"nbv --capture {{scene}} --gaussians 150 --out {{out}} {LOOP}",
    "synth-orbit": "synth-orbit {out} --scene {scene} --frames 6 --size 64x48 --spp 2",
    "import": "import {data} --mesh {data}/rock.glb --out {out}",
    "refit": "refit {out}",
    "study": "{out} {data}",
}
"""Name -> arguments; `refit` gets a copy of {run}."""


@pytest.fixture(scope="module")
def places(tmp_path_factory) -> dict[str, Path]:
    """A dataset of 8 frames, its prior, a scene, a finished run, and the folder to write."""
    root = tmp_path_factory.mktemp("kill")
    data = synthetic.write_dataset(root / "data", synthetic.orbit_cameras(8, 48, 36)).root
    paths = {"data": data, "prior": root / "prior", "run": root / "run"}
    paths |= {"scene": root / "scene.toml", "out": root / "work/out"}
    paths["scene"].write_text(TOML)
    made = f"prior {data} --mesh {data}/rock.glb --gaussians 150 --out {paths['prior']}"
    nbv = COMMANDS["nbv"].format(**paths | {"out": paths["run"]})
    for arguments in (made, nbv):
        subprocess.run([sys.executable, "-c", PROGRAM, *arguments.split()], check=True)
    return paths


def started(name: str, places: dict[str, Path]) -> subprocess.Popen:
    """The process of a command; of a run that has begun, the one that resumes it."""
    arguments = COMMANDS[name].format(**places).split()
    if arguments[0] == "nbv" and (places["out"] / "config.json").is_file():
        arguments = ["nbv", "--resume", str(places["out"])]
    program = [sys.executable, "-c", CELL if name == "study" else PROGRAM, *arguments]
    env = os.environ | {"PYTHONPATH": os.pathsep.join([os.path.dirname(__file__), *sys.path])}
    return subprocess.Popen(program, env=env, stdout=subprocess.DEVNULL)


def cleared(name: str, places: dict[str, Path]) -> Path:
    """The folder around {out}, as it is before the command."""
    work = places["out"].parent
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir()
    if name == "refit":
        shutil.copytree(places["run"], places["out"])
    return work


def contents(work: Path) -> dict[str, object]:
    """Every file below a folder but its timings and commit: bytes, or of checkpoints the arrays."""
    found: dict[str, object] = {}
    for path in sorted(work.rglob("*")):
        key, data = str(path.relative_to(work)), path.read_bytes() if path.is_file() else b""
        if path.suffix in (".json", ".jsonl"):
            data = re.sub(UNEQUAL, b"", data)
        if path.suffix == ".npz":
            with np.load(path) as arrays:
                found[key] = [arrays[n].tobytes() for n in arrays.files if n != "json"]
        elif path.name != "timings.json":
            found[key] = data
    return found


@pytest.mark.parametrize("name", COMMANDS)
def test_killed_at_any_moment(name, places):
    work, begun = cleared(name, places), time.monotonic()
    assert started(name, places).wait() == 0
    took, whole = time.monotonic() - begun, contents(work)
    for moment in np.random.default_rng(KILLS).uniform(0, took, max(1, KILLS // len(COMMANDS))):
        cleared(name, places)
        process = started(name, places)
        time.sleep(moment)
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert started(name, places).wait() == 0, f"killed after {moment:.2f} s"
        after = contents(work)
        differ = [key for key in whole | after if whole.get(key) != after.get(key)]
        assert not differ, f"killed after {moment:.2f} s of {took:.2f}"
