"""Stress tests on small ellipsoids."""

from dataclasses import replace

import numpy as np
import pytest
import synthetic

from mgs.data.dataset import load_dataset
from mgs.prior.build import load_prior
from mgs.run.detectors import DETECTORS
from studies import faults, stress
from studies.couplings import halved
from studies.frame.case import FRESH

FOLDERS = {"dataset": "dataset", "prior": "dataset/prior"}


def row(rock, fault, size, lost=0.0, warnings=None, kept=1.0):
    about = {"part": "faults", "rock": rock, "scene": rock, "fault": fault, "size": size}
    choices = {f"choice {name}": kept for name in stress.POLICIES}
    return about | {"lost": lost, "warnings": warnings} | choices


def test_tables_give_the_cost_and_the_warnings_of_each_size():
    rows = [row(rock, "none", 0) for rock in "ab"]
    for size, lost in ((0.1, 0.2), (0.3, 2.0), (1.0, 4.0)):
        rows.append(row("a", "exposure", size, lost, "exposure" if lost > 1 else None, 0.5))
        rows.append(row("b", "exposure", size, lost + 1, "exposure" if lost > 2 else None))
    few = {"part": "few_views", "views": 2, "means": "free", "psnr": 30.0, "over": -0.5}
    rows += [few | {"scene": scene, "moved": 0.5, "tau": 0.9} for scene in "ab"]
    of_faults, of_warnings, of_views = stress.tables(rows).split("\n\n")
    cells = [cell.strip() for cell in of_faults.splitlines()[-1].split("|")[1:-1]]
    assert cells[:3] == ["exposure", "0.1 / 0.3 / 1 stops", "0.7 / 2.5 / 4.5"]
    assert cells[3:] == ["0 / 1 / 2", "exposure", *["75 / 75 / 75"] * 2]
    counts = [line.split("|")[2:4] for line in of_warnings.splitlines()[2:]]
    assert [[int(n) for n in line] for line in counts] == [[2, 0], [1, 0], [5, 3]]
    assert "-0.50" in of_views


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Folder with the dataset and the prior of a small rock."""
    folder = tmp_path_factory.mktemp("study")
    synthetic.write_rock(folder / "dataset", synthetic.orbit_cameras(10, 48, 36), 300)
    cameras = synthetic.orbit_cameras(3, 48, 36, altitude=2.0)
    synthetic.write_dataset(folder / "dataset/test", cameras)
    return folder


def test_the_sun_moves_on_over_the_same_views():
    case = stress.case_of(FRESH[0], stress.SETUPS["hemisphere"], stress.SIZES["quick"])
    moved = stress.under_sun(case, 15)
    own, other = (one.cells()[0].arguments for one in (case, moved))
    assert other["changes"].pop("sky") == {"sun_azimuth": 35 + 15}
    assert (other["changes"], other["seed"]) == (own["changes"], own["seed"])
    assert moved.dataset != case.dataset


def test_the_wrong_prior_of_one_rock_is_of_the_same_rocks_as_that_of_eight():
    def others(count):
        size = replace(stress.SIZES["quick"], rocks=FRESH[:count])
        cells = {cell.name: cell for cell in stress.cells_of(size)}
        return cells[f"faults/{FRESH[0].name}"].arguments["others"]

    assert others(1) == others(8)
    assert len(set(others(1))) == 3


def test_a_halved_frame_has_means_of_four_pixels_and_points_at_half_the_place(root):
    whole, point = load_dataset(root / "dataset").frames[0], np.array([[0.1, 0.2, 0.3]])
    small = halved(whole)
    assert small.rgb()[3, 5] == pytest.approx(whole.rgb()[6:8, 10:12].mean((0, 1)), abs=1e-6)
    assert small.rgb().shape == (18, 24, 3)
    pixel, half = (frame.camera.project(point)[0] for frame in (whole, small))
    assert half == pytest.approx(pixel / 2)


@pytest.mark.parametrize("name", faults.IMAGE_FAULTS)
def test_a_fault_of_images_is_a_pure_function_that_grows_with_its_size(root, name):
    frame = faults.captured(load_dataset(root / "dataset").frames[0])
    function, sizes, _ = faults.IMAGE_FAULTS[name]

    def arrays(of):
        return [of.pixels, of.rgba, of.z, of.rock, of.camera.world_to_camera]

    before, changes = [array.copy() for array in arrays(frame)], []
    for size in sizes:
        spoiled, again = (arrays(function(frame, size, np.random.default_rng(3))) for _ in range(2))
        pairs = list(zip(spoiled, before, strict=True))
        assert all(map(np.array_equal, spoiled, again))
        assert all(a.shape == b.shape and np.isfinite(a).all() for a, b in pairs)
        changes.append(sum(np.abs(a.astype(float) - b).sum() for a, b in pairs))
    assert 0 < changes[0] < changes[1] < changes[2]
    assert all(map(np.array_equal, arrays(frame), before))


@pytest.mark.parametrize("name", faults.PRIOR_FAULTS)
def test_a_fault_of_the_prior_leaves_the_prior_as_it_was(root, name):
    function, sizes, _ = faults.PRIOR_FAULTS[name]
    prior = load_prior(root / "dataset/prior")
    before, moved = prior.points.copy(), []
    for size in sizes:
        spoiled = function(prior, size, np.random.default_rng(1))
        assert len(spoiled.points) == len(spoiled.normals) >= spoiled.backed
        lost = len(prior.points) - len(spoiled.points)
        moved.append(lost or float(np.linalg.norm(spoiled.points - prior.points, axis=1).mean()))
    assert 0 < moved[0] < moved[1] < moved[2]
    assert np.array_equal(prior.points, before)


def test_fits_are_measured(root):
    rows = stress.few_views(root, root, **FOLDERS, counts=[4])["rows"]
    by = {row["means"]: row for row in rows}
    assert by["frozen"]["moved"] == 0 < by["free"]["moved"]
    assert by["frozen"]["tau"] == by["frozen, no prior"]["tau"] == pytest.approx(1)


def test_faults_are_measured_against_the_fit_without(root):
    lab = stress.Lab(root, **FOLDERS)
    shifted = faults.shifted(lab.prior, 0.4, lab.rng("shifted prior", 0.4))
    lab.add("shifted prior", 0.4, shifted)
    lab.add(stress.ANOTHER, 0, load_prior(root / FOLDERS["prior"]))
    frames = [faults.exposure(frame, 1.0, lab.rng("", 1)) for frame in lab.data.frames]
    brighter = replace(lab.data, frames=tuple(frames))
    blurred = lab.with_fault(faults.defocus, 2.0, lab.taken, "defocus")
    lab.add("defocus", 2.0, frames=blurred)
    lab.add(stress.SUN, 5, frames=lab.with_later(brighter.frames))
    clean, moved, same, soft, sunny = lab.rows
    assert clean["lost"] == same["lost"] == 0, "the prior of the same rock"
    assert moved["lost"] > stress.FAILURE
    assert moved["sign prior"] > DETECTORS["prior"].limit > clean["sign prior"]
    assert soft["lost"] > 0.1
    assert sunny["lost"] > stress.FAILURE
    for one in lab.rows:
        assert all(0 < one[f"choice {name}"] <= 1 for name in stress.POLICIES)
    assert clean["choice d-optimal"] == soft["choice directional-i"] == 1, "no image, no change"
