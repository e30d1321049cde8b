"""Options that cannot be, through the real command line: one line, exit code 2, nothing written."""

import shlex

import pytest
import synthetic
import tiny
from refusals import refused

from mgs.splat_ply import write_ply

OPTIONS = {
    "": [
        "fly",
        "dataset check {long}",
        "eval {out}",
        "dataset check {out}",
        "render {ply} --cameras {data} --out {out} --width 100000000",
        "render {ply} --cameras {data} --out {out} --background 255 255 255",
        "video {run} --out {out}.avi",
    ],
    "view": [
        "{out}.ply",
        "{root}",
        "{ply} --follow",
        "{run} --host 192.0.2.1",  # of an example network
    ],
    "report {run}": [
        "--figures eps",
        "--html {out}.html --figures pdf",
    ],
    "diagnose {run}": [
        "--views kf_9999",
        "--views ''",
    ],
    "simplify {run} --method refit": [
        "--learn some",
        "--learn all --sh 0",
        "--loss nan",
        "--noise 0.1",
    ],
    "nbv": [
        "--resume {run} --budget 9",
        "--resume {run} --policy random",
        "{data} --prior {prior} --out {run}",
    ],
    "nbv {data} --prior {prior} --seeds 3 --budget 1 --out {out}": [
        "--set estimator=block",
        "--set train.optimiser=hope",
        "--set train.rates.colour",
        "--set train.rates.hue=1",
        "--set pases=1",
        "--set passes=1",
        "--set prior_std.scale=inf",
        "--batch 0",
        "--set stop_gain=0",
        "--set stop_uncertainty=1",
        "--policy best",
        "--seeds 13",
        "--set train.means=loose",
        "--set train.means=free --set estimator=loss-gradient",
        "--set train.means=free --policy paper",
        "--set flight.length=9",
        "--set flight.no_fly=4",
        "--set flight.clearance=30",
        "--set flight.length=30 --set travel=2",
    ],
    "synth-orbit {out}": [
        "--scene moon",
        "--scene nowhere/x.toml",
        "--preset huge",
        "--orbit figure-eight",
        "--distances 1,far",
        "--size 320",
        "--size 99999999x99999999",
        "--size 3²x24",
        "--mesh nowhere.glb",
        "--mesh-up y",
        "--spp 100000000000",
        "--pose-noise 1e300",
    ],
    "survey {rock} --out {out}": [
        "--drift nan",
    ],
    "prior {rock} --out {out}": [
        "--gaussians 0",
        "--gaussians many",
        "--gaussians 50 --spacing 0.1",
        "--spacing 9",
        "--spacing nan",
        "--poisson-depth 0",
        "--up skyward",
        "--up 0,0,0",
        "--source dreams",
        "--source mesh",
        "--source hull --mesh rock.glb",
        "--source hull --poisson-depth 6",
    ],
    "prior {rock} --out {out} --mesh {rock}/rock.glb": [
        "--spacing 1e-300",
        "--gaussians 100 --poisson-depth 6",
    ],
}
"""Beginning of a command -> its options or arguments, some of which cannot be."""
ROWS = [(begin, end) for begin, ends in OPTIONS.items() for end in ends]


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    root = tmp_path_factory.mktemp("options")
    data, prior = tiny.write_dataset(root / "data"), tiny.write_prior(root / "prior")
    run = tiny.write_run(root / "run", data, prior)
    write_ply(root / "splats.ply", tiny.initial([]))
    rock = synthetic.write_dataset(root / "rock").root
    made = {"root": root, "data": data, "prior": prior, "run": run, "ply": root / "splats.ply"}
    return made | {"rock": rock, "out": root / "out", "long": "a" * 5000}


def names(end: str) -> set[str]:
    """Names of the options and settings in these words, or else the last word."""
    words = shlex.split(end)
    options = {word[2:].replace("-", "_") for word in words if word.startswith("--")} - {"set"}
    settings = {word.partition("=")[0].rpartition(".")[2] for word in words if "=" in word}
    long = {word for word in words[-1:] if len(word) > 3}
    return options | settings | long or {words[-1]}


@pytest.mark.parametrize(("begin", "end"), ROWS, ids=[" ".join(row) for row in ROWS])
def test_what_cannot_be_is_one_line_that_names_it(capsys, places, begin, end):
    end = end.format(**places)
    line = refused(capsys, shlex.split(f"{begin.format(**places)} {end}"), places["root"])
    assert any(name[:100].replace("-", "_") in line.replace("-", "_") for name in names(end)), line
    assert len(line) < 600
