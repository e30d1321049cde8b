"""Options that cannot be, and outputs that cannot be written, through the real command line: known
before any work, one line, exit code 2."""

import importlib
import os
import re
import shlex
from pathlib import Path

import pytest
import synthetic
import tiny
import typer
from program import command, output, steps
from refusals import a_file, listing, occupied, refused

from mgs.cli.app import COMMANDS, app
from mgs.splat_ply import write_ply

OPTIONS = """
mgs: fly; dataset check {long}; eval {out}; dataset check {out};
    render {ply} --cameras {data} --out {out} --width 100000000;
    render {ply} --cameras {data} --out {out} --background 255 255 255; video {run} --out {out}.avi
mgs eval {run}: --dataset {data}; --prior {prior}
mgs video {run} --out {out}.gif --story: --fps 20; --width 20
mgs view: {out}.ply; {root}; {ply} --follow; {run} --host 192.0.2.1
mgs simplify {run}: --noise 1e300
mgs export {run} --out {out}.mgs: --psnr nan
mgs export {run} --out {out}.glb: --views all; --psnr 9 --sh 2
mgs export {run} --out {out} --to colmap: --sh 2; --colour-space linear; --prior {prior}
mgs report {run}: --figures eps; --html {out}.html --figures pdf
mgs diagnose {run}: --views kf_9999; --views ''
mgs simplify {run} --method refit: --learn some; --learn all --sh 0; --loss nan; --noise 0.1
mgs nbv: --resume {run} --budget 9; --resume {run} --policy random;
    {data} --prior {prior} --out {run}
mgs nbv {data} --prior {prior} --seeds 3 --budget 1 --out {out}: --set estimator=block;
    --set train.optimiser=hope; --set train.rates.colour; --set train.rates.hue=1;
    --set train.rates.colour=1 --set train.rates.colour.x=1; --set train.passes=10000000;
    --set pases=1; --set passes=1; --set prior_std.scale=inf; --batch 0; --set stop_gain=0;
    --set stop_uncertainty=1; --policy best; --seeds 13; --set train.means=loose;
    --set train.means=free --set estimator=loss-gradient; --set train.means=free --policy paper;
    --set flight.length=9; --set flight.no_fly=4; --set flight.clearance=30;
    --set flight.length=30 --set travel=2; --set refine_poses=true; --set enough=0.5
mgs suggest {run}: --set enough=0.5
mgs synth-orbit {out}: --scene moon; --scene nowhere/x.toml; --preset huge; --orbit figure-eight;
    --distances 1,far; --distances 1e-300; --size 320; --size 99999999x99999999; --size 3²x24;
    --size 100000x1; --mesh nowhere.glb; --mesh-up y; --spp 100000000000; --pose-noise 1e300
mgs survey {rock} --out {out}: --drift nan
mgs prior {rock} --out {out}: --gaussians 0; --gaussians many; --gaussians 50 --spacing 0.1;
    --spacing 9; --spacing nan; --poisson-depth 0; --up skyward; --up 0,0,0; --source dreams;
    --source mesh; --source hull --mesh rock.glb; --source hull --poisson-depth 6
mgs prior {rock} --out {out} --mesh {rock}/rock.glb: --spacing 1e-300;
    --gaussians 100 --poisson-depth 6
"""
"""A line for each beginning of a command: its options or arguments, some of which cannot be."""
ROWS = [
    (begin, end.strip())
    for line in re.split(r"\n(?=\S)", OPTIONS.strip())
    for begin, _, ends in [line.partition(":")]
    for end in ends.split(";")
]


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
    line = refused(capsys, shlex.split(f"{begin.format(**places)} {end}")[1:], places["root"])
    assert any(name[:100].replace("-", "_") in line.replace("-", "_") for name in names(end)), line
    assert len(line) < 600


pytestmark = pytest.mark.usefixtures("coarse_priors")


def read_only(tmp_path: Path) -> Path:
    """A folder nobody may write to; for root, which permissions do not hold back, the kernel's."""
    if os.geteuid() == 0:
        return Path("/proc/mgs")
    folder = tmp_path / "locked"
    folder.mkdir(mode=0o555)
    return folder / "out"


def writers(dataset: Path, prior: Path, splats: Path, out: Path) -> dict[str, list]:
    """Every command that writes into a folder of one's choice."""
    return {
        "nbv": ["nbv", dataset, "--out", out, "--prior", prior, "--budget", 1],
        "prior": ["prior", dataset, "--out", out, "--gaussians", 40],
        "synth-orbit": ["synth-orbit", out, "--frames", 2, "--size", "16x12"],
        "survey": ["survey", dataset, "--out", out],
        "import": ["import", dataset, "--out", out],
        "render": ["render", splats, "--cameras", dataset, "--out", out],
        "demo": ["demo", out],
    }


IN_THE_WAY = {
    "is there already": lambda tmp_path: occupied(tmp_path / "out"),
    "leaves it alone": lambda tmp_path: occupied(tmp_path / "out"),
    "is a file": lambda tmp_path: a_file(tmp_path / "out"),
    "under a file": lambda tmp_path: a_file(tmp_path / "file") / "out",
    "long name": lambda tmp_path: tmp_path / ("long" * 99),
    "read only": read_only,
}
COMMANDS_THAT_WRITE = list(writers(*[Path()] * 4))


@pytest.mark.parametrize(
    ("command", "place"),
    [(command, "is there already") for command in COMMANDS_THAT_WRITE]
    + [("render", place) for place in ("is a file", "under a file", "long name", "read only")]
    + [("prior", "read only"), ("nbv", "read only"), ("nbv", "leaves it alone")],
)
def test_output_that_is_in_the_way(capsys, dataset, prior, tmp_path, command, place):
    write_ply(tmp_path / "splats.ply", tiny.initial([]))
    out = IN_THE_WAY[place](tmp_path)
    before = listing(tmp_path)
    force = ["--force"] * (place == "leaves it alone")
    line = refused(capsys, writers(dataset, prior, tmp_path / "splats.ply", out)[command] + force)
    said = place if place.startswith(("is ", "leaves ")) else "cannot be written"
    assert said in line
    assert listing(tmp_path) == before


def test_force_replaces_what_the_command_made_and_nothing_else(capsys, dataset, prior, tmp_path):
    out, few = tmp_path / "out", ["--gaussians", 60]
    made = ["prior", dataset, "--out", out, *few]
    command(*made)
    assert "is there already" in refused(capsys, made, out)
    (out / "prior.png").write_text("old")
    command(*made, "--force")
    assert {path.name for path in tmp_path.iterdir()} == {"dataset", "prior", "out"}
    assert (out / "prior.png").read_bytes()[:4] == b"\x89PNG"
    again = [*made, "--force"]
    assert "mesh.ply is in it" in refused(capsys, [*again, "--mesh", out / "mesh.ply"], out)
    (out / "notes.txt").write_text("keep me")
    assert "it holds notes.txt" in refused(capsys, again, out)
    run = tiny.write_run(tmp_path / "run", dataset, prior)
    assert "it holds" in refused(capsys, ["prior", dataset, "--out", run, *few, "--force"], run)
    nbv = ["nbv", dataset, "--prior", prior, "--out", out, "--budget", 1, "--force"]
    assert "it holds mesh.ply" in refused(capsys, nbv, out)
    nbv[nbv.index(out)] = run
    command(*nbv, "--seeds", 3, "--set", "train.passes=1", "--set", "warm_passes=1")
    assert not (run / "renders").exists()
    assert len(steps(run)) == 2


ONE_FILE = {
    "report {run} --html {out}/kept.html": "kept.html",
    "simplify {run}": "run/gaussians_pruned.ply",
    "video {run} --out {out}/kept.gif": "kept.gif",
}
"""Command -> the file that it would write."""


@pytest.mark.parametrize("arguments", ONE_FILE)
def test_a_file_that_is_there_is_kept(capsys, dataset, prior, tmp_path, arguments):
    run = tiny.write_run(tmp_path / "run", dataset, prior)
    a_file(tmp_path / ONE_FILE[arguments])
    words = arguments.format(run=run, out=tmp_path).split()
    assert "is there already; choose another place" in refused(capsys, words, tmp_path)


def test_a_run_is_drawn_through_its_own_cameras(capsys, dataset, prior, tmp_path):
    run, out = tiny.write_run(tmp_path / "run", dataset, prior), tmp_path / "out"
    drawn = ["render", run, "--out", out, "--width", 8]
    command(*drawn)
    pictures = [path.name for path in (dataset / "images").iterdir()]
    assert sorted(path.name for path in out.iterdir()) == sorted(pictures)
    assert "is there already" in refused(capsys, drawn, out)
    command(*drawn, "--force")
    both = ["export", run, run, "--out", out / "a.glb"]
    assert "is one file for 2; leave it out" in refused(capsys, both, tmp_path)


def test_a_file_where_a_run_keeps_its_pictures(capsys, dataset, prior, tmp_path):
    run = tiny.write_run(tmp_path / "run", dataset, prior)
    for folder, name in (("renders", "eval"), ("diagnostics", "diagnose")):
        a_file(run / folder)
        line = refused(capsys, [name, run], run)
        assert "cannot be written" in line or "is a file, not a folder" in line


WHOLE = {
    "prior": ("mgs.prior.figure", "mesh.ply points.ply prior.json prior.png"),
    "survey": ("mgs.survey.flight", "cloud.ply rock.glb survey.json survey.png transforms.json"),
}
"""Command -> module that draws its picture, and the files that it writes."""


@pytest.mark.parametrize("name", WHOLE)
def test_a_result_appears_whole(tmp_path, figures, monkeypatch, name):
    """Nothing is under its name while its picture, the last file, is drawn."""
    module, files = importlib.import_module(WHOLE[name][0]), WHOLE[name][1]
    draw, drawn, out = getattr(module, f"draw_{name}"), [], tmp_path / "out"
    root = synthetic.write_dataset(tmp_path / "data").root

    def watched(path, *rest):
        drawn.append(len(list(path.parent.iterdir())) > 2 and not out.exists())
        draw(path, *rest)

    monkeypatch.setattr(module, f"draw_{name}", watched)
    option = ["--gaussians", 60] if name == "prior" else ["--poses", "exact"]
    command(name, root, "--out", out, *option)
    assert drawn == [True]
    assert sorted(path.name for path in out.iterdir() if path.is_file()) == files.split()
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize("name", COMMANDS)
def test_every_word_of_a_help_text_is_printed(capsys, monkeypatch, name):
    """rich takes a word in brackets, such as [colour=1], for markup and leaves it out."""
    monkeypatch.setenv("COLUMNS", "1000")
    text = output(capsys, name, "--help")
    made = typer.main.get_command(app).commands[name]
    for words in filter(None, [made.help, *(parameter.help for parameter in made.params)]):
        for paragraph in words.split("\n\n"):
            assert " ".join(paragraph.split()) in text
