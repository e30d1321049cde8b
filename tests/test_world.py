"""Reports of a world whose up axis is not +Z and whose unit is unknown: figures, page, maps,
viewer."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny
from matplotlib.figure import Figure

from mgs import plotting
from mgs.data.dataset import load_dataset, write_transforms
from mgs.data.up import PLUS_Z, unit_up, upright
from mgs.files import write_json
from mgs.gaussians import Gaussians
from mgs.reports import diagnostics
from mgs.reports.page import write_page
from mgs.reports.writing import report
from mgs.run.folder import Run, open_run
from mgs.view import layers
from mgs.view.subject import read_subject

UP = unit_up([0.3, -0.8, 0.2])


def make_run(root: Path, tilted: bool) -> Path:
    """A measured run; tilted: in the same world turned so that UP is up, and in units."""
    dataset = load_dataset(tiny.write_dataset(root / "dataset"))
    turn = upright(UP).T if tilted else np.eye(3)
    frames = []
    for frame in dataset.frames:
        pose = frame.camera.world_to_camera.copy()
        pose[:3, :3] = pose[:3, :3] @ turn.T
        frames.append(replace(frame, camera=replace(frame.camera, world_to_camera=pose)))
    write_transforms(dataset.root, frames, UP if tilted else PLUS_Z, "unit" if tilted else "m")
    dataset = load_dataset(dataset.root)

    def turned(g: Gaussians) -> Gaussians:
        return replace(g, means=(g.means @ turn.T).astype(np.float32))

    def initial(frames):
        return turned(tiny.initial(frames))

    there = tiny.prior(dataset.up)
    parts = {"initial": initial, "prior": there}
    return tiny.write_measured_run(root / "run", dataset, 0.0, parts, policy="uniform")


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return [make_run(tmp_path_factory.mktemp("run"), tilted) for tilted in (False, True)]


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
        assert length in [text.get_text() for text in axis.texts]
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
    assert titles == ["z (m)", "up (unit)"]
    assert "path (unit)" in text
    assert "(m)" not in text.split("<script")[0]


def test_maps_of_depth_name_the_unit(runs, drawn):
    for run, unit in zip(runs, ("m", "unit"), strict=True):
        diagnostics.diagnose(run, ["kf_0001"])
        assert f"depth ({unit})" in [axis.get_title() for axis in drawn["kf_0001.png"].axes]


def test_the_viewer_knows_both(runs):
    for run, up, unit in zip(runs, (PLUS_Z, UP), ("m", "unit"), strict=True):
        subject = read_subject(run)
        assert subject.up == pytest.approx(up)
        assert f"3 {unit}" in layers.legend("depth", (1.0, 3.0), subject.unit)


def test_the_axis_of_the_prior_goes_before_that_of_the_dataset(runs, tmp_path):
    run = open_run(runs[1])
    settings = run.settings.model_copy(update={"prior": tmp_path})
    assert Run(run.folder, settings).up == run.dataset.up
    write_json(tmp_path / "prior.json", {"up": [0, 2, 0]})
    assert Run(run.folder, settings).up == (0, 1, 0)
