"""Options that cannot be, through the real command line: one line, exit code 2, nothing written."""

import shlex

import pytest
import synthetic
import tiny
from refusals import refused

from mgs.splat_ply import write_ply

KINDS = "must be a number for each of colour, scale, rotation, opacity"
UP = "expected auto, or three numbers"
OPTIONS: dict[str, list[tuple[str, str]]] = {
    "": [
        ("fly", "fly"),
        ("dataset check {long}", "File name too long"),
        ("eval {out}", "no such run folder or"),
        ("dataset check {out}", "no such dataset folder"),
        ("render {ply} --cameras {data} --out {out} --width 100000000", "100000000x"),
        ("render {ply} --cameras {data} --out {out} --background 255 255 255", "from 0 to 1"),
        ("video {run} --out {out}.avi", "films are written as .mp4, .gif, .png"),
    ],
    "view": [
        ("{out}.ply", "no such run folder or"),
        ("{root}", "holds no run"),
        ("{ply} --follow", "`follow` needs the folder of a run"),
        ("{run} --host 192.0.2.1", "cannot be served there"),  # of an example network
    ],
    "report {run}": [
        ("--figures eps", "--figures eps: unknown; choose one of png, pdf, svg"),
        ("--html {out}.html --figures pdf", "--html alone writes no figures"),
    ],
    "diagnose {run} --views": [
        ("kf_9999", "kf_9999"),
        ("''", "--views"),
    ],
    "simplify {run} --method refit": [
        ("--learn some", "learn 'some': unknown; choose one of all, auto"),
        ("--learn all --sh 0", "leave nothing to choose; leave out one of them"),
        ("--loss nan", "loss nan: must be from 0 to 10 dB"),
        ("--noise 0.1", "--noise: is not used by the method refit"),
    ],
    "nbv": [
        ("--resume {run} --budget 9", "nbv: budget: --resume takes its settings from"),
        ("--resume {run} --policy random", "policy random: is not the policy of"),
        ("{data} --prior {prior} --out {run}", "`force`; `mgs nbv --resume"),
        ("{data} --capture boulder --out {out}", "give a DATASET or --capture"),
    ],
    "nbv {data} --prior {prior} --seeds 3 --budget 1 --out {out}": [
        ("--set estimator=block", "estimator 'block': unknown; choose one of exact, hutchinson"),
        ("--set train.optimiser=hope", "train.optimiser 'hope': unknown; choose one of"),
        ("--set train.rates.colour", "--set train.rates.colour: expected KEY=VALUE"),
        ("--set train.rates.hue=1", f"train.rates = {{'hue': 1}}: {KINDS}"),
        ("--set pases=1", "--set pases=1: unknown setting"),
        ("--set passes=1", "--set passes=1: unknown setting"),
        ("--set prior_std.scale=inf", "prior_std.scale = inf: Input should be a finite number"),
        ("--batch 0", "batch = 0: must be at least 1"),
        ("--set stop_gain=0", "stop_gain = 0: must be more than 0"),
        ("--set stop_uncertainty=1", "stop_uncertainty = 1: must be less than 1"),
        ("--policy best", "policy best: unknown; choose one of"),
        ("--seeds 13", "fewer than 13 seeds"),
        (
            "--set train.means=loose",
            "train.means = 'loose': Input should be",
        ),
        ("--set train.means=free --set estimator=hutchinson", "hutchinson has no information"),
        ("--set train.means=free --policy paper", "policy paper has no information about means"),
        ("--set flight.length=9", "takes 15.2 m and 17 s; raise `flight.length`"),
        ("--set flight.no_fly=4", "allow 0 of its 12 poses, fewer than 3 seeds"),
        ("--set flight.clearance=30", "allow 0 of its 12 poses, fewer than 3 seeds"),
        ("--set flight.length=30 --set travel=2", "leave out `travel`"),
    ],
    "synth-orbit {out}": [
        ("--scene moon", "scene 'moon': unknown; choose one of boulder"),
        ("--scene nowhere/x.toml", "x.toml"),
        ("--preset huge", "preset 'huge': unknown; choose one of quick, paper"),
        ("--orbit figure-eight", "--orbit 'figure-eight': unknown"),
        ("--distances 1,far", "--distances '1,far': expected positive numbers"),
        ("--size 320", "expected WIDTHxHEIGHT"),
        ("--size 99999999x99999999", "--size"),
        ("--size 3²x24", "--size"),
        ("--mesh nowhere.glb", "no such mesh"),
        ("--mesh-up y", "--mesh-up"),
        ("--spp 100000000000", "GiB on disk; at most"),
        ("--pose-noise 1e300", "pose_noise"),
    ],
    "survey {rock} --out {out}": [
        ("--drift nan", "factors of 0 or more"),
    ],
    "prior {rock} --out {out}": [
        ("--gaussians 0", "gaussians '0': expected a whole number"),
        ("--gaussians many", "gaussians 'many': expected a whole number"),
        ("--gaussians 50 --spacing 0.1", "give one of them"),
        ("--spacing 9", "samples are too few"),
        ("--spacing nan", "must be positive"),
        ("--poisson-depth 0", "poisson_depth"),
        ("--up skyward", f"up 'skyward': {UP}"),
        ("--up 0,0,0", f"up '0,0,0': {UP}"),
        ("--source dreams", "choose one of depth, mesh, points, hull, random"),
        ("--source mesh", "give `mesh`"),
        ("--source hull --mesh rock.glb", "give one of them"),
        ("--source hull --poisson-depth 6", "of a cloud, but a hull is carved"),
    ],
    "prior {rock} --out {out} --mesh {rock}/rock.glb": [
        ("--spacing 1e-300", "samples take about"),
        ("--gaussians 100 --poisson-depth 6", "poisson_depth"),
    ],
}
"""Beginning of a command -> its options, and words of the line."""
ROWS = [(f"{begin} {end}", words) for begin, rows in OPTIONS.items() for end, words in rows]


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    root = tmp_path_factory.mktemp("options")
    data, prior = tiny.write_dataset(root / "data"), tiny.write_prior(root / "prior")
    run = tiny.write_run(root / "run", data, prior)
    write_ply(root / "splats.ply", tiny.initial([]))
    rock = synthetic.write_dataset(root / "rock").root
    made = {"root": root, "data": data, "prior": prior, "run": run, "ply": root / "splats.ply"}
    return made | {"rock": rock, "out": root / "out", "long": "a" * 5000}


@pytest.mark.parametrize(("arguments", "words"), ROWS, ids=[row[0] for row in ROWS])
def test_options_that_cannot_be_are_one_line(capsys, places, arguments, words):
    given = shlex.split(arguments.format(**places))
    line = refused(capsys, given, places["root"])
    assert words in line
    assert len(line) < 600
