"""A world whose up axis is not +Z and whose unit is unknown: mgs turns it upright when it reads it,
and turns back what leaves."""

import json
import shutil
from operator import attrgetter
from pathlib import Path

import numpy as np
import pytest
import synthetic
import tiny
from matplotlib.figure import Figure
from matplotlib.text import Text
from plyfile import PlyData
from program import change_checkpoint, command
from refusals import fails
from scipy.spatial import cKDTree

import mgs
from mgs import Run, open_run, plotting, report, write_page
from mgs.camera import opencv_from_opengl
from mgs.data.dataset import load_cameras, load_dataset, write_transforms
from mgs.data.world import UPRIGHT, World, unit_up
from mgs.files import write_json
from mgs.reports import diagnostics
from mgs.splat_files import load_gaussians
from mgs.view import layers
from mgs.view.layers import read_subject

TILTED = World(unit_up([0.3, -0.8, 0.2]), "unit")
WORLDS = UPRIGHT, TILTED


def make_run(root: Path, world: World) -> Path:
    """A measured run of a dataset whose files are in this world."""
    dataset = load_dataset(tiny.write_dataset(root / "dataset"))
    write_transforms(dataset.root, dataset.frames, world)
    parts = {"prior": tiny.prior(world.up)}
    dataset = load_dataset(dataset.root)
    return tiny.write_measured_run(root / "run", dataset, 0.0, parts, policy="uniform")


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return [make_run(tmp_path_factory.mktemp("run"), world) for world in WORLDS]


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> dict[str, Figure]:
    """The last figure of each name that was saved."""
    found: dict[str, Figure] = {}

    def keep(figure: Figure, path: Path) -> None:
        found[Path(path).name] = figure

    monkeypatch.setattr(plotting, "save_figure", keep)
    return found


def test_the_orbit_of_a_tilted_world_is_drawn_as_that_of_the_upright_one(runs, drawn, tmp_path):
    shown = []
    for run, length in zip(runs, ("1 m", "1 unit"), strict=True):
        report(run, tmp_path / "report")
        axis = drawn["orbit.png"].axes[0]
        assert length in [text.get_text() for text in axis.findobj(Text)]
        shown.append([np.asarray(points.get_offsets()) for points in axis.collections])
        assert len(shown[-1]) == 4
    for level, tilted in zip(*shown, strict=True):
        np.testing.assert_allclose(tilted, level, atol=1e-5)


def test_the_page_draws_it_upright_too_and_names_the_unit(runs, tmp_path):
    data = []
    for run in runs:
        write_page(tmp_path / "page.html", [run])
        text = (tmp_path / "page.html").read_text()
        embedded = text.split('type="application/json">')[1].split("</script>")[0]
        data.append(json.loads(embedded)["runs"][0])
    level, tilted = data
    for one, other in zip(level["orbit"]["data"], tilted["orbit"]["data"], strict=True):
        for axis in "xyz":
            drawn = (np.array(line[axis], float) for line in (other, one))
            np.testing.assert_allclose(*drawn, atol=2e-4, err_msg=one["name"])
    eyes = ([view["eye"] for view in run["views"]] for run in (tilted, level))
    np.testing.assert_allclose(*eyes, atol=1e-9)
    titles = [run["orbit"]["layout"]["scene"]["zaxis"]["title"]["text"] for run in data]
    assert titles == ["z (m)", "z"]
    assert "path (units)" in text
    assert "(m)" not in text.split("<script")[0]


def test_maps_of_depth_name_the_unit(runs, drawn):
    for run, unit in zip(runs, ("m", "unit"), strict=True):
        diagnostics.diagnose(run, ["kf_0001"])
        assert f"depth ({unit})" in [axis.get_title() for axis in drawn["kf_0001.png"].axes]


def test_the_viewer_stands_upright_and_names_the_unit(runs):
    level, tilted = (read_subject(run) for run in runs)
    assert "3 unit" in layers.legend("depth", (1.0, 3.0), tilted.unit)
    np.testing.assert_allclose(tilted.eyes, level.eyes, atol=1e-9)


def test_the_up_of_the_prior_goes_before_that_of_the_dataset(runs, tmp_path):
    run = open_run(runs[1])
    settings = run.settings.model_copy(update={"prior": tmp_path})
    assert Run(run.folder, settings).dataset.world == TILTED
    write_json(tmp_path / "prior.json", {"up": [0, 2, 0]})
    assert Run(run.folder, settings).dataset.world == World((0.0, 1.0, 0.0), "unit")


def test_a_scene_of_two_worlds_is_refused(runs):
    dataset = open_run(runs[1]).dataset
    fails("was built with up", mgs.Scene, dataset, tiny.prior())


def test_a_tilted_run_of_an_older_version_is_refused(runs, tmp_path):
    folder = shutil.copytree(runs[1], tmp_path / "run")
    change_checkpoint(folder / "checkpoint.npz", lambda record: record.pop("upright"))
    fails("older mgs", getattr, open_run(folder), "state")


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory, coarse_priors) -> list[Path]:
    """The same run in both worlds, each with its prior, with colours of degree 1."""
    made = []
    for world in WORLDS:
        root = tmp_path_factory.mktemp("fitted")
        data = synthetic.orbit(root / "data", 10)
        write_transforms(data.root, data.frames, world)
        mgs.save_prior(root / "prior", mgs.build_prior(data.root, gaussians=300))
        options = {"prior": root / "prior", "seeds": 3, "budget": 2, "sh": 1}
        made.append(Path(mgs.run_nbv(data.root, root / "run", **options).folder))
    return made


def test_a_run_chooses_the_same_and_its_files_are_in_the_worlds_own_coordinates(fitted):
    level, tilted = (open_run(run) for run in fitted)
    assert level.indices == tilted.indices
    # Rounding moves vertices of the prior by 1e-4, and a sample near an edge to another face.
    for kind in ("gaussians.means", "prior.points"):
        one, other = (attrgetter(kind)(run) for run in (level, tilted))
        assert np.quantile(np.linalg.norm(one - other, axis=1), 0.9) < 1e-3
        assert cKDTree(one).query(other)[0].max() < level.prior.spacing
    diagnostics.diagnose(tilted, [level.taken[0].name])
    vertex = PlyData.read(str(tilted.folder / "diagnostics/information.ply"))["vertex"]
    drawn = np.stack([vertex[axis] for axis in "xyz"], axis=1)
    for means in (load_gaussians(tilted.folder / "gaussians.ply").means, drawn):
        np.testing.assert_allclose(TILTED.enter(means), tilted.gaussians.means, atol=1e-5)
    prior = mgs.load_prior(tilted.settings.prior)
    np.testing.assert_allclose(prior.points, tilted.prior.points, atol=1e-5)


@pytest.mark.parametrize("kind", ["ply", "glb"])
def test_exports_are_in_the_worlds_own_coordinates_and_are_measured_alike(fitted, tmp_path, kind):
    run, path = open_run(fitted[1]), tmp_path / f"a.{kind}"
    command("export", run.folder, "--to", kind, "--out", path)
    means = TILTED.enter(load_gaussians(path).means)
    np.testing.assert_allclose(means, run.gaussians.means, atol=1e-5)
    own = mgs.evaluate(run)["all"]["psnr"]
    names = [frame.name for frame in run.taken]
    of_file = mgs.evaluate(path, dataset=run.dataset.root, trained=names)["all"]["psnr"]
    assert of_file == pytest.approx(own, abs=0.05)


def test_views_and_suggestions_are_in_the_worlds_own_coordinates(fitted, tmp_path):
    run = open_run(fitted[1])
    poses = {Path(name).stem: camera for name, camera in load_cameras(run.dataset.root)}
    command("export", run.folder, "--to", "nerfstudio", "--out", tmp_path / "views")
    command("suggest", run.folder, "--views", 2, "--out", tmp_path / "next")
    for name, camera in load_cameras(tmp_path / "views") + load_cameras(tmp_path / "next"):
        own = poses[Path(name).stem].world_to_camera
        np.testing.assert_allclose(camera.world_to_camera, own, atol=1e-9)
    for view in json.loads((tmp_path / "next/suggestions.json").read_text())["ranking"]:
        pose = opencv_from_opengl(view["transform_matrix"])
        np.testing.assert_allclose(pose, poses[view["name"]].world_to_camera, atol=1e-9)
