"""How much model a scene needs: N from what pixels resolve, the study of it, and a pruned run."""

import csv
import json

import numpy as np
import pytest
import synthetic
from matplotlib.image import imread

from mgs.camera import Camera, look_at
from mgs.cli.app import main
from mgs.data.meshes import Mesh
from mgs.errors import InputError
from mgs.policy.criteria import PIXEL_NOISE, PRIOR_STD
from mgs.prior.build import build_prior, prior_from_mesh
from mgs.prior.resolution import PIXELS_PER_SAMPLE, resolution
from mgs.prior.settings import PriorSettings
from mgs.report.evaluation import evaluate_run
from mgs.run.folder import read_checkpoint
from mgs.run.nbv import run_nbv
from mgs.splat_ply import read_ply
from mgs.study import parsimony
from mgs.study.sweep import Cell


def square(side=20):
    """The unit square in the plane z = 0, made of triangles that face upwards."""
    x, y = (grid.ravel() / side - 0.5 for grid in np.mgrid[: side + 1, : side + 1])
    i, j = (grid.ravel() for grid in np.mgrid[:side, :side])
    a = i * (side + 1) + j
    faces = np.concatenate(
        [np.stack([a, a + side + 1, a + 1], 1), np.stack([a + 1, a + side + 1, a + side + 2], 1)]
    )
    return Mesh(np.stack([x, y, 0 * x], 1), faces, np.ones(len(faces), bool))


def camera_above(height, focal=100.0, size=400, x=0.0):
    K = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    return Camera(K, size, size, look_at((x, 1e-6, height), (x, 0, 0)))


def test_a_flat_square_asks_for_one_sample_in_so_many_pixels():
    mesh = square()
    found = resolution(mesh, [camera_above(2.0), camera_above(3.0)])
    assert found.pixel == pytest.approx(2.0 / 100, rel=1e-6)
    assert found.spacing == pytest.approx(PIXELS_PER_SAMPLE * found.pixel)
    assert found.area == pytest.approx(1)
    assert found.samples == round((1 / (PIXELS_PER_SAMPLE * 0.02)) ** 2)


def test_twice_the_focal_length_or_half_the_distance_is_four_times_the_samples():
    mesh = square()
    once = resolution(mesh, [camera_above(2.0)]).samples
    assert resolution(mesh, [camera_above(2.0, focal=200)]).samples == pytest.approx(
        4 * once, abs=4
    )
    assert resolution(mesh, [camera_above(1.0)]).samples == pytest.approx(4 * once, abs=4)


def test_only_cameras_count_that_see_the_face():
    mesh = square()
    alone = resolution(mesh, [camera_above(2.0)])
    assert resolution(mesh, [camera_above(2.0), camera_above(-0.5)]) == alone  # from below
    assert (
        resolution(mesh, [camera_above(2.0), camera_above(0.5, x=50)]) == alone
    )  # beside the image
    near = resolution(
        mesh, [camera_above(2.0), camera_above(0.2, focal=400)]
    )  # sees the middle alone
    assert (
        alone.samples
        < near.samples
        < resolution(mesh, [camera_above(0.2, focal=400, size=4000)]).samples
    )
    with pytest.raises(InputError, match="give --gaussians N"):
        resolution(mesh, [camera_above(-2.0)])


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write_data(tmp_path_factory.mktemp("parsimony") / "data")


def write_data(root, size=(48, 36)):
    synthetic.write_dataset(root / "test", synthetic.orbit_cameras(3, *size, altitude=2.0))
    return synthetic.write_dataset(root, synthetic.orbit_cameras(12, *size))


@pytest.mark.parametrize("asked", [[], ["--gaussians", "auto"]], ids=["default", "auto"])
def test_a_prior_takes_its_number_from_the_pixels(data, tmp_path, capsys, asked):
    with pytest.raises(SystemExit) as exit_:
        main(["prior", str(data.root), "--out", str(tmp_path / "p"), *asked])
    assert exit_.value.code == 0
    numbers = json.loads((tmp_path / "p/prior.json").read_text())
    pixel = numbers["resolution"]["pixel"]
    assert numbers["spacing"] == pytest.approx(PIXELS_PER_SAMPLE * pixel, rel=0.01)
    assert 1.4 / 52.8 < pixel < 2.6 / 52.8  # between the nearest and the farthest point of the rock
    said = capsys.readouterr().out
    assert f"{numbers['n'] + numbers['backed']:,} Gaussians, since the closest pixel covers" in said
    double, _ = build_prior(
        write_data(tmp_path / "double", (96, 72)), PriorSettings(gaussians="auto")
    )
    assert len(double.points) / numbers["n"] == pytest.approx(4, rel=0.15)


def test_a_given_mesh_takes_its_number_from_the_pixels_too(data, tmp_path, capsys):
    synthetic.rock_mesh().export(tmp_path / "rock.ply")
    with pytest.raises(SystemExit):
        main(
            [
                "prior",
                str(data.root),
                "--out",
                str(tmp_path / "p"),
                "--mesh",
                str(tmp_path / "rock.ply"),
            ]
        )
    assert "resolution" in json.loads((tmp_path / "p/prior.json").read_text())
    with pytest.raises(InputError, match="a density counts by the voxels of a cloud"):
        prior_from_mesh(tmp_path / "rock.ply", PriorSettings(density=0.5))


@pytest.mark.parametrize("command", ["prior", "nbv"])
def test_a_number_that_is_none_is_one_line(data, tmp_path, capsys, command):
    with pytest.raises(SystemExit) as exit_:
        main([command, str(data.root), "--out", str(tmp_path / "x"), "--gaussians", "many"])
    assert exit_.value.code == 2
    assert "--gaussians 'many': expected a whole number, or auto" in capsys.readouterr().err


def test_views_are_spread_evenly_from_the_first_on():
    angles = 2 * np.pi * np.arange(24) / 24
    positions = np.stack([np.cos(angles), np.sin(angles), np.ones(24)], 1)
    order = parsimony.views_in_order(positions, np.zeros(3), 12, 4)
    assert sorted(order[:4]) == [0, 6, 12, 18]
    assert sorted(order) == list(range(0, 24, 2))


def row(
    asked, learned=parsimony.ALL, degree=0, psnr=25.0, parameters=100, predictive=1.0, evidence=1.0
):
    return {
        "scene": "boulder", "asked": asked, "learned": learned, "degree": degree, "psnr_inside": psnr, "parameters": parameters,
        "gaussians": parameters // 11, "predictive": predictive, "evidence": evidence, "seconds": 1.0, "next_error": 1 / psnr,
    }  # fmt: skip


def rows(auto=26.0, parameters=200):
    fixed = [
        row("100", psnr=25, parameters=110),
        row("200", psnr=26.05, parameters=220),
        row("400", psnr=26.1, parameters=440),
    ]
    lean = {
        key: value
        for key, value in row("auto", "auto", psnr=auto, parameters=parameters).items()
        if key != "evidence"
    }
    chosen = [row("auto", psnr=25.5, parameters=500, predictive=3), lean]
    chosen += [
        row("auto", learned, psnr=20 + i, predictive=i)
        for i, learned in enumerate(parsimony.LEARNED)
        if i < 3
    ]
    degrees = [
        row("auto", degree=degree, psnr=27 - degree, parameters=1000, evidence=2 * degree)
        for degree in (1, 2)
    ]
    return fixed + chosen + degrees


def test_the_verdict_compares_with_the_smallest_that_is_as_good():
    found = parsimony.verdict(rows())
    assert (found["best"], found["auto"], found["smallest"], found["parameters"]) == (
        26.1,
        26.0,
        220,
        200,
    )
    assert found["loss"] == pytest.approx(0.1)
    assert found["number"] == 25.5
    assert found["small"]
    assert not parsimony.verdict(rows(parameters=221))["small"]
    assert not parsimony.verdict(rows(auto=25.9))["close"]
    assert parsimony.verdict(rows(auto=26.03))["close"]
    kinds = [
        *rows(),
        row("auto", "+ opacity", psnr=26.05, parameters=90),
    ]  # fewer kinds of parameters are a fixed choice, too
    assert parsimony.verdict(kinds)["smallest"] == 90
    assert found["chosen"]["learned by predictive"] == {"value": parsimony.ALL, "loss": 0.0}
    assert found["chosen"]["degree by evidence"] == {"value": 2, "loss": 1.0}
    assert found["chosen"]["gaussians by next_error"] == found["chosen"]["gaussians by psnr_inside"]
    assert found["chosen"]["gaussians by psnr_inside"] == {"value": 40, "loss": 0.0}


def test_every_need_of_a_cell_is_a_cell():
    for size in parsimony.PRESETS.values():
        cells = parsimony.cells_of(size)
        names = [cell.name for cell in cells]
        assert (
            len(set(names))
            == len(names)
            == len(size.scenes) * (1 + 2 * (len(size.counts) + 1) + 5 + 2)
        )
        assert all(set(cell.needs) <= set(names) for cell in cells)
        assert all(isinstance(cell, Cell) for cell in cells)


def test_the_likelihood_of_the_next_view_falls_with_its_error_and_with_too_close_a_fit():
    same = parsimony.log_likelihood(0.01, 0.01)
    assert same == pytest.approx(-0.5 * np.log(2 * np.pi * 0.01) - 0.5)
    assert parsimony.log_likelihood(0.02, 0.001) < parsimony.log_likelihood(0.02, 0.01) < same


def test_the_command_does_the_study_and_goes_on(tmp_path, capsys, monkeypatch):
    calls = []

    def make_dataset(root, out, scene, **size):
        calls.append(scene)
        write_data(out / "data")
        return {}

    tiny_preset = parsimony.Preset(("boulder",), (60, 200), 48, 36, 12, 3, 4, seeds=3)
    monkeypatch.setattr(parsimony, "DEGREES", (0, 1))
    monkeypatch.setitem(parsimony.PRESETS, "quick", tiny_preset)
    monkeypatch.setattr(parsimony, "make_dataset", make_dataset)
    out = tmp_path / "out"
    for _ in range(2):
        with pytest.raises(SystemExit) as exit_:
            main(["parsimony", str(out)])
        assert exit_.value.code == 0
    assert calls == ["boulder"]
    found = json.loads((out / "parsimony.json").read_text())
    with open(out / "parsimony.csv") as file:
        table = list(csv.DictReader(file))
    assert len(table) == len(found["rows"]) == 8
    assert imread(out / "parsimony.png").shape[1] == 2000
    by = {(one["asked"], one["learned"], one["degree"]): one for one in found["rows"]}
    assert by["60", parsimony.ALL, 0]["parameters"] == 60 * 11
    assert by["auto", "colour", 0]["parameters"] == 3 * by["auto", "colour", 0]["gaussians"]
    assert (
        by["auto", parsimony.ALL, 1]["parameters"]
        == (12 + 8) * by["auto", parsimony.ALL, 0]["gaussians"]
    )
    assert by["200", parsimony.ALL, 0]["psnr_inside"] > by["60", parsimony.ALL, 0]["psnr_inside"]
    lean = by["auto", "auto", 0]
    assert 3 * lean["gaussians"] <= lean["parameters"] < by["auto", parsimony.ALL, 0]["parameters"]
    assert set(found["scenes"]["boulder"]["lean"]["shares"]) == {
        "colour",
        "scale",
        "rotation",
        "opacity",
    }
    assert found["scenes"]["boulder"]["auto"] == lean["psnr_inside"]
    for one in found["rows"]:
        known = [
            "psnr",
            "seconds",
            *(["next_error", "predictive", "evidence"] if one is not lean else []),
        ]
        assert np.isfinite([one[key] for key in known]).all()
    for one in found["scenes"]["boulder"]["pruned"]:
        assert one["actual"] <= one["noise"] * PIXEL_NOISE
    assert "boulder" in capsys.readouterr().out


def test_an_unknown_preset_is_one_line(tmp_path, capsys):
    with pytest.raises(SystemExit) as exit_:
        main(["parsimony", str(tmp_path / "out"), "--preset", "huge"])
    assert exit_.value.code == 2
    assert "--preset 'huge': unknown" in capsys.readouterr().err


def test_a_run_is_pruned_beside_its_model(data, tmp_path, capsys):
    run = tmp_path / "run"
    run_nbv(data.root, run, gaussians=400, budget=1, policy="uniform")
    informed = evaluate_run(run, pictures=False)["informed"]
    assert {kind: number["of"] for kind, number in informed.items()} == {
        "colour": 1200, "scale": 1200, "rotation": 1600, "opacity": 400
    }  # fmt: skip
    H = read_checkpoint(run).H
    assert (
        informed["colour"]["informed"]
        == (H[:, :3] > (PIXEL_NOISE / PRIOR_STD["colour"]) ** 2).sum()
    )
    assert (
        informed["rotation"]["informed"]
        == (H[:, 6:10] > (PIXEL_NOISE / PRIOR_STD["rotation"]) ** 2).sum()
    )
    assert 0 < informed["rotation"]["informed"] < 1600
    whole = (run / "gaussians.ply").read_bytes()
    with pytest.raises(SystemExit) as exit_:
        main(["prune", str(run)])
    assert exit_.value.code == 0
    said = capsys.readouterr().out
    left = read_ply(run / "gaussians_pruned.ply")
    assert 0 < len(left) < 400
    assert f"400 Gaussians, {len(left)} stay" in said
    assert "PSNR on the test views" in said
    assert (run / "gaussians.ply").read_bytes() == whole
    with pytest.raises(SystemExit) as exit_:
        main(["prune", str(run), "--noise", "0"])
    assert exit_.value.code == 2
    assert "noise 0.0 must be positive" in capsys.readouterr().err
