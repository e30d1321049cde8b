"""How much model a scene needs: N from what pixels resolve, and the study of it."""

import json

import numpy as np
import pytest
import synthetic
import trimesh
from program import command, study
from refusals import fails

from mgs import PriorSettings
from mgs.data.meshes import Mesh
from mgs.prior.build import _samples, build_prior, prior_from_mesh
from mgs.prior.surface import PIXELS_OF_PHOTOGRAPHS, PIXELS_PER_SAMPLE, resolution
from studies import parsimony
from studies.frame.output import read_rows
from studies.setups import SetupSize


def square():
    """The unit square in the plane z = 0, made of triangles that face upwards."""
    corners = [[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]]
    mesh = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]])
    for _ in range(4):
        mesh = mesh.subdivide()
    return Mesh(mesh.vertices, mesh.faces, np.ones(len(mesh.faces), bool))


def camera_above(height, focal=100.0, size=400, x=0.0):
    return synthetic.pinhole(focal, size, size, (x, 1e-6, height), (x, 0, 0))


@pytest.mark.parametrize(("height", "focal"), [(2, 100), (2, 200), (1, 100)])
def test_a_flat_square_asks_for_one_sample_in_so_many_pixels(height, focal):
    found = resolution(square(), [camera_above(height, focal), camera_above(3.0)])
    assert found.pixel == pytest.approx(height / focal, rel=1e-6)
    assert found.spacing == pytest.approx(PIXELS_PER_SAMPLE * found.pixel)
    assert found.area == pytest.approx(1)
    assert found.samples == round((1 / (PIXELS_PER_SAMPLE * height / focal)) ** 2)


def test_a_density_is_samples_for_each_pixel():
    settings = (PriorSettings(density=density) for density in (1, 4))
    once, four = (len(_samples(square(), one, None, 0.05)[0]) for one in settings)
    assert four / once == pytest.approx(4, rel=0.05)
    fails("density 0 must be positive", PriorSettings, density=0)


def test_only_cameras_count_that_see_the_face():
    mesh, first = square(), camera_above(2.0)
    alone = resolution(mesh, [first])
    assert resolution(mesh, [first, camera_above(-0.5)]) == alone, "from below"
    assert resolution(mesh, [first, camera_above(0.5, x=50)]) == alone, "beside the image"
    middle = resolution(mesh, [first, camera_above(0.2, focal=400)])
    whole = resolution(mesh, [camera_above(0.2, focal=400, size=4000)])
    assert alone.samples < middle.samples < whole.samples
    fails("give `gaussians`", resolution, mesh, [camera_above(-2.0)])


@pytest.fixture(scope="module")
def data(tmp_path_factory, coarse_priors):
    return synthetic.orbit(tmp_path_factory.mktemp("parsimony") / "data")


def test_a_prior_takes_its_number_from_the_pixels(data, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    command("prior", data.root, "--out", tmp_path / "p")
    numbers = json.loads((tmp_path / "p/prior.json").read_text())
    pixel = numbers["resolution"]["pixel"]
    assert numbers["spacing"] == pytest.approx(PIXELS_PER_SAMPLE * pixel, rel=0.01)
    assert 1.4 / 52.8 < pixel < 2.6 / 52.8  # between the nearest and the farthest point of the rock
    said = capsys.readouterr().out
    assert f"samples lie {PIXELS_PER_SAMPLE:.3g} pixels apart" in said
    assert f"{numbers['n'] + numbers['backed']:,}: a sample each" in said


def test_surfaces_from_photographs_have_fewer_samples(data):
    numbers = build_prior(data.root, source="hull").numbers
    pixel = numbers["resolution"]["pixel"]
    assert numbers["spacing"] == pytest.approx(PIXELS_OF_PHOTOGRAPHS * pixel, rel=0.01)


def test_a_given_mesh_takes_its_number_from_the_pixels_too(data, tmp_path):
    synthetic.rock_mesh().export(tmp_path / "rock.ply")
    command("prior", data.root, "--out", tmp_path / "p", "--mesh", tmp_path / "rock.ply")
    assert "resolution" in json.loads((tmp_path / "p/prior.json").read_text())
    fails("a density", prior_from_mesh, tmp_path / "rock.ply", PriorSettings(density=0.5))


def test_the_automatic_number_has_a_limit(data, monkeypatch):
    monkeypatch.setattr("mgs.prior.build.MOST_GAUSSIANS", 100)
    prior = build_prior(data)
    assert len(prior.points) + prior.backed == 100


def test_tables_compare_choices_with_the_default():
    def row(rock, choice, psnr, share, **more):
        about = {"rock": rock, "scene": rock, "choice": choice, "gaussians": 1000, "degree": 0}
        about |= {"asked": 0, "learned": parsimony.ALL, "share": share}
        over = {"psnr_inside": 30 + psnr, "psnr_inside_over": psnr, "psnr_over": 0.0}
        return about | over | more

    rows = []
    for rock, less in (("a", 0.5), ("b", 0.7)):
        rows += [row(rock, parsimony.DEFAULT, 0.0, 1.0), row(rock, parsimony.REFIT, -less, 0.4)]
        rows += [row(rock, parsimony.NUMBER, -less, 0.1, asked=n) for n in parsimony.COUNTS]
        rows += [row(rock, parsimony.PRUNED, -0.1, 0.8, noise=0.2)]
    choices, rocks = parsimony.tables(rows).split("\n\n")
    refit = next(line for line in choices.splitlines() if "`refit`" in line)
    assert "| 29.40 | -0.60 [-1.87, +0.67] |" in refit
    assert refit.endswith("| 40% |")
    assert "pruned, 0.2 sigma" in choices
    assert rocks.splitlines()[-1].startswith("| b | 1,000 | -0.70 | -0.70 | -0.70 | -0.70 | 40% |")


@pytest.mark.slow
def test_the_command_does_the_study_and_goes_on(tmp_path, capsys, ellipsoids, figures, monkeypatch):
    monkeypatch.setattr(parsimony, "COUNTS", (60, 200))
    size = SetupSize(48, 36, tests=3, fewer=3)
    out = tmp_path / "out"
    for _ in range(2):
        study("parsimony", out, "--rocks", "1", sizes={"quick": size})
    assert len(list(out.glob("cells/dataset/**/result.json"))) == 1
    rows = read_rows(out / "parsimony.csv")
    assert len(rows) == 2 + 1 + 3 + 2 + 3 + 1 + 3
    assert (out / "parsimony.png").stat().st_size > 10_000
    by = {(one["choice"], one["asked"] or one["learned"], one["degree"]): one for one in rows}
    default = by[parsimony.DEFAULT, parsimony.ALL, 0]
    assert by[parsimony.NUMBER, 60, 0]["parameters"] == 60 * 11
    assert by[parsimony.KINDS, "colour", 0]["parameters"] == 3 * default["gaussians"]
    assert by[parsimony.DEGREE, parsimony.ALL, 1]["parameters"] == 20 * default["gaussians"]
    assert by[parsimony.NUMBER, 200, 0]["psnr_inside"] > by[parsimony.NUMBER, 60, 0]["psnr_inside"]
    refit = next(one for one in rows if one["choice"] == parsimony.REFIT)
    assert 3 * refit["gaussians"] <= refit["parameters"] < default["parameters"]
    assert "boulder" in capsys.readouterr().out
