"""Exposure that differs between images: gains are found, and fits with them are as good."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import synthetic
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import ExifTags, Image
from program import command, said, stop_at, table_numbers

from mgs import evaluate_run, resume_nbv, run_nbv
from mgs.data.dataset import Dataset, load_dataset, write_transforms
from mgs.files import read_json
from mgs.images import exif_exposure, write_png
from mgs.metrics import colour_corrected
from mgs.prior.build import load_prior
from mgs.prior.exposure import DARK, GAIN_STD, RATIO_STD, SATURATED, exposure_of, solve_gains
from mgs.reports.tables import markdown_table
from mgs.run.folder import Checkpoint, read_checkpoint


def normalised(gains: np.ndarray) -> np.ndarray:
    return gains / np.exp(np.log(gains).mean(axis=0))


def shown(rng: np.random.Generator, views: int, samples: int, gains: np.ndarray) -> np.ndarray:
    """What images with these gains show of a surface; each sees about half of it."""
    colours = rng.uniform(0.05, 0.4, (samples, 3)) * gains[:, None]
    colours[rng.random((views, samples)) < 0.5] = np.nan
    return colours


def slow_gains(colours: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """`solve_gains` from its definition: a least-squares row for each pair and each image."""
    found, one = [], np.eye(len(colours))
    bright = np.nan_to_num(colours, nan=9).max(axis=2) > SATURATED
    for channel in range(3):
        rows, values = [row / GAIN_STD for row in one], [0.0] * len(one)
        for i in range(len(colours)):
            for j in range(i):
                both = ~bright[i] & ~bright[j]
                weight = (weights[i] * weights[j])[both]
                if weight.sum() == 0:
                    continue
                means = [weight @ colours[k][both] / weight.sum() for k in (i, j)]
                if np.min(means) >= DARK:
                    scale = np.sqrt(weight.sum()) / RATIO_STD
                    rows.append(scale * (one[i] - one[j]))
                    values.append(scale * np.log(means[0][channel] / means[1][channel]))
        found.append(np.linalg.lstsq(np.array(rows), np.array(values), rcond=None)[0])
    return normalised(np.exp(np.array(found).T))


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), views=st.integers(1, 7))
def test_gains_are_the_least_squares_solution_of_the_ratios_of_all_pairs(seed, views):
    rng = np.random.default_rng(seed)
    gains = np.exp(rng.normal(0, 0.3, (views, 3)))
    colours = shown(rng, views, 90, gains) * rng.lognormal(0, 0.2, (views, 90, 1))
    weights = rng.random((views, 90))
    found = solve_gains(colours, weights)
    assert np.allclose(found, slow_gains(colours, weights), rtol=1e-9)
    assert np.allclose(np.log(found).mean(axis=0), 0, atol=1e-12)


def test_images_that_share_nothing_or_only_darkness_or_light_have_a_gain_of_one():
    colours = np.full((2, 200, 3), np.nan)
    colours[0, :100], colours[1, 100:] = 0.3, 0.1
    assert np.array_equal(solve_gains(colours, np.ones((2, 200))), np.ones((2, 3)))
    for one, other in ((1e-4, 5e-4), (0.95, 0.4)):
        uniform = np.stack([np.full((99, 3), one), np.full((99, 3), other)])
        assert np.array_equal(solve_gains(uniform, np.ones((2, 99))), np.ones((2, 3)))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_a_corrected_render_is_the_nearest_of_all_that_differ_by_gains(seed):
    rng = np.random.default_rng(seed)
    truth, rendered, mask = rng.random((5, 6, 3)), rng.random((5, 6, 3)), rng.random((5, 6)) < 0.7
    corrected = colour_corrected(truth, rendered, mask)

    def error(image: np.ndarray) -> np.ndarray:
        return ((image - truth)[mask] ** 2).sum(axis=0)

    for factor in (0.99, 1.01):
        assert (error(factor * corrected) >= error(corrected)).all()
    tinted = truth * [0.5, 2, 1.3]
    assert np.allclose(colour_corrected(truth, tinted, mask), truth if mask.any() else tinted)
    assert np.array_equal(colour_corrected(truth, 0 * rendered, mask), 0 * rendered)


# Runs


@pytest.fixture(scope="module")
def rock(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of constant exposure, dark enough for gains of up to 1.3, and its prior."""
    root = tmp_path_factory.mktemp("rock") / "dataset"

    def albedo(x: np.ndarray) -> np.ndarray:
        return 0.3 + 0.15 * np.sin(6 * x[..., [1, 2, 0]] + np.array([0, 1, 2]))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(synthetic, "albedo", albedo)
        return synthetic.write_rock(root, synthetic.orbit_cameras(16, 64, 48), 600).root


def gain_of(dataset: Dataset) -> np.ndarray:
    """Up to 0.3 stops more or less of exposure, and a white balance of a third of that."""
    rng = np.random.default_rng(5)
    count = len(dataset)
    stops, balance = rng.uniform(-0.3, 0.3, (count, 1)), rng.uniform(-0.1, 0.1, (count, 3))
    return 2.0 ** (stops + balance * [1, 0, 1])


@pytest.fixture(scope="module")
def varied(rock: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same dataset, photographed with exposures that differ."""
    root = tmp_path_factory.mktemp("varied") / "dataset"
    shutil.copytree(rock, root)
    dataset = load_dataset(root)
    for frame, gain in zip(dataset.frames, gain_of(dataset), strict=True):
        write_png(frame.image_path, frame.rgb() * gain.astype(np.float32))
    return root


def test_gains_of_refined_poses_are_measured_anew(varied):
    frames, prior = load_dataset(varied).frames, load_prior(varied / "prior")
    turned = replace(frames[0].camera, world_to_camera=frames[1].camera.world_to_camera)
    moved = (replace(frames[0], camera=turned), *frames[1:])
    gains = exposure_of(prior)
    before = gains(frames)
    assert np.array_equal(gains(moved), exposure_of(prior)(moved))
    assert not np.array_equal(gains(moved), before)


Runs = dict[str, tuple[Checkpoint, Path]]

RUN = {"policy": "uniform", "seeds": 4, "budget": 5, "train": {"passes": 10}}


@pytest.fixture(scope="module")
def runs(rock: Path, varied: Path, tmp_path_factory: pytest.TempPathFactory) -> Runs:
    """Runs of constant exposure, and of differing exposure without and with the setting."""
    folder = tmp_path_factory.mktemp("runs")
    made = {}
    kinds = {"constant": (rock, False), "without": (varied, False), "with": (varied, True)}
    for name, (root, exposure) in kinds.items():
        state = run_nbv(root, folder / name, exposure=exposure, evaluate_every=5, **RUN).state
        evaluate_run(folder / name, pictures=False)
        made[name] = state, folder / name
    return made


def test_a_run_finds_the_gains_of_its_images(runs, varied):
    state, out = runs["with"]
    dataset = load_dataset(varied)
    true = dict(zip([frame.name for frame in dataset.frames], gain_of(dataset), strict=True))
    for line in state.steps:
        names = list(line["exposure"])
        assert names == [dataset.frames[i].name for i in state.taken[: line["images"]]]
        both = line["exposure"], true
        found, expected = (normalised(np.array([of[name] for name in names])) for of in both)
        assert np.abs(np.log(found / expected)).max() < 0.03
        assert np.allclose(np.log(list(line["exposure"].values())).mean(axis=0), 0, atol=1e-12)
    assert read_json(out / "config.json")["settings"]["exposure"] is True
    assert not any("exposure" in line for line in runs["without"][0].steps)


def test_a_fit_with_gains_is_nearly_as_good_as_one_of_constant_exposure(runs):
    metrics = {name: read_json(out / "metrics.json") for name, (_, out) in runs.items()}
    held_out = {name: found["held_out"] for name, found in metrics.items()}
    corrected = {name: found["psnr_mask_corrected"] for name, found in held_out.items()}
    assert corrected["with"] > corrected["constant"] - 0.5
    assert corrected["without"] < corrected["constant"] - 1.5
    assert held_out["with"]["psnr_mask"] < corrected["with"] - 1  # what is not corrected says so
    for name, (_, out) in runs.items():
        table = markdown_table(table_numbers([out]))
        assert ("exposure fitted (dB)" in table) == (name == "with")
    measured = runs["with"][0].steps[-1]
    assert measured["held_out_psnr_mask_corrected"] == pytest.approx(corrected["with"], abs=1e-3)
    assert not any("corrected" in key for key in runs["constant"][0].steps[-1])


def test_the_alarm_of_exposure_is_silent_where_gains_explain_it(runs):
    alarmed = {}
    for name, (state, _) in runs.items():
        warnings = [warning for line in state.steps for warning in line.get("warnings", [])]
        alarmed[name] = any("exposure drifts" in warning for warning in warnings)
    assert alarmed == {"constant": False, "without": True, "with": False}


def test_an_interrupted_run_goes_on_bit_for_bit(varied, runs, tmp_path):
    given = {"exposure": True, "evaluate_every": 3, **RUN}
    with pytest.raises(KeyboardInterrupt):
        run_nbv(varied, tmp_path / "run", on_step=stop_at(2), **given)
    resume_nbv(tmp_path / "run")
    one, other = read_checkpoint(runs["with"][1]), read_checkpoint(tmp_path / "run")
    assert np.array_equal(one.H, other.H)
    assert np.array_equal(one.gaussians.sh, other.gaussians.sh)
    assert [line["exposure"] for line in one.steps] == [line["exposure"] for line in other.steps]


# What photographs say themselves


def photograph(path: Path, time: float | None, speed: int = 100, number: float = 2.0) -> Path:
    exif = Image.Exif()
    if time is not None:
        tags, base = exif.get_ifd(ExifTags.IFD.Exif), ExifTags.Base
        tags |= {base.ExposureTime: time, base.FNumber: number, base.ISOSpeedRatings: speed}
    Image.new("RGB", (64, 48), (90, 80, 70)).save(path, exif=exif)
    return path


def test_stops_of_exif_are_those_of_time_speed_and_aperture(tmp_path):
    stops = exif_exposure(photograph(tmp_path / "a.jpg", 0.01))
    assert stops is not None
    for change, expected in (((0.02,), 1), ((0.01, 400), 2), ((0.01, 100, 4.0), -2)):
        found = exif_exposure(photograph(tmp_path / "b.jpg", *change))
        assert found == pytest.approx(stops + expected, abs=1e-5)
    assert exif_exposure(photograph(tmp_path / "c.jpg", None)) is None
    assert exif_exposure(photograph(tmp_path / "c.jpg", 0.0)) is None
    assert exif_exposure(tmp_path / "none.jpg") is None
    (tmp_path / "d.jpg").write_bytes(b"no image")
    assert exif_exposure(tmp_path / "d.jpg") is None


@pytest.mark.parametrize("differs", [True, False])
def test_an_import_tells_of_exposure_that_differs(tmp_path, capsys, differs):
    frames = []
    for k, frame in enumerate(synthetic.write_dataset(tmp_path, depth=False).frames):
        time = 0.01 * 2 ** (0.5 * (k % 2) * differs)
        image = photograph(frame.image_path.with_suffix(".jpg"), time)
        frames.append(replace(frame, image_path=image, mask_path=None))
    write_transforms(tmp_path, frames)
    command("import", tmp_path, "--out", tmp_path / "out")
    message = "exposure differs by up to 0.5 stops between photographs"
    assert (message in said(capsys)[1]) == differs
