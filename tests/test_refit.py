"""A model with no more parameters than its images pay for: the evidence, the choice of a degree,
a refitted run and a pruned one."""

import dataclasses
import shutil

import numpy as np
import pytest
import synthetic
from hypothesis import given
from hypothesis import strategies as st
from plyfile import PlyData
from program import change_settings, output
from refusals import fails, refused
from scipy.stats import multivariate_normal
from splat.scenes import cameras_around

from mgs import Scene, evaluate_run, learning, open_run, read_ply, render, run_nbv
from mgs.fit import evidence
from mgs.fit.evidence import BLOCKS, DIRECTIONAL, Worth, kinds, lean_fit, paying, worth
from mgs.fit.fitting import fit_gaussians
from mgs.fit.settings import TrainSettings
from mgs.gaussians import LEARNED
from mgs.policy.criteria import LEARN_LOSS, PIXEL_NOISE, PRIOR_STD
from mgs.reports.simplify import REFITTED, refit_run
from mgs.run.settings import NbvSettings
from studies.frame.timing import surface_gaussians

VIEWS = 8
SETTINGS = NbvSettings(dataset="data", prior="prior", train={"loss": "squared"})


def model(n=500):
    """A closed surface, of degree 0."""
    gaussians = surface_gaussians(n)
    gaussians.logit_opacities[:] = 4.0
    gaussians.log_scales += 0.7
    return gaussians


def images_of(truth, start, views=VIEWS):
    """Images of the truth, with noise, and the start of a fit."""
    rng = np.random.default_rng(0)
    cameras = cameras_around(truth, 2 * np.pi * np.arange(views) / views)
    targets = [np.asarray(render(truth, camera).rgb) for camera in cameras]
    noisy = [target + rng.normal(0, 0.002, target.shape) for target in targets]
    known = [np.dstack([target, np.ones(target.shape[:2])]).astype(np.float32) for target in noisy]
    return evidence.Images(cameras, known, lambda of: start, range(views))


@given(st.integers(1, 6), st.floats(0.01, 3), st.floats(0.05, 4), st.integers(0, 10**6))
def test_the_gain_is_the_logarithm_of_the_ratio_of_two_marginal_likelihoods(
    pixels, sigma, tau, seed
):
    """Exact in a linear model: pixels = slope * parameter + noise, against noise alone."""
    rng = np.random.default_rng(seed)
    slope = rng.normal(size=pixels)
    seen = slope * rng.normal(0, tau) + rng.normal(0, sigma, pixels)
    lam = (sigma / tau) ** 2
    precision = slope @ slope + lam
    away = (slope @ seen) / precision  # the most probable parameter
    noise = sigma**2 * np.eye(pixels)
    zero, both = np.zeros(pixels), noise + tau**2 * np.outer(slope, slope)
    with_it = multivariate_normal(zero, both).logpdf(seen)
    without = multivariate_normal(zero, noise).logpdf(seen)
    numbers = np.array([[away]]), np.array([[precision]]), np.array([lam])
    found = worth(*numbers, sigma, {"one": slice(0, 1)}, 1)
    assert found.gain["one"][0] == pytest.approx(with_it - without, rel=1e-6, abs=1e-6)
    at_start, at_end = seen @ seen / 2, np.square(seen - slope * away).sum() / 2 + lam * away**2 / 2
    assert found.rise["one"][0] == pytest.approx(at_start - at_end, rel=1e-6, abs=1e-9)


@given(st.integers(1, 40), st.floats(0, 3), st.integers(0, 10**6))
def test_what_pays_least_is_left_out_as_long_as_it_is_allowed(n, loss, seed):
    rng, sizes = np.random.default_rng(seed), {"scale": 3, "opacity": 1}
    gain = {kind: rng.normal(1, 1, n) for kind in sizes}
    rise = {kind: rng.gamma(1, 1, n) for kind in sizes}
    expected = {kind: gain[kind] > 0 for kind in sizes}
    per_number = [(gain[kind][i] / sizes[kind], kind, i) for kind in sizes for i in range(n)]
    allowed = 10.0 * (10 ** (loss / 10) - 1)
    for pays, kind, i in sorted(per_number):
        if pays > 0:
            allowed -= rise[kind][i]
            if allowed < 0:
                break
            expected[kind][i] = False
    kept = paying(Worth(gain, rise, 10.0, np.zeros(n, bool)), sizes, loss)
    assert all(np.array_equal(kept[kind], expected[kind]) for kind in sizes)


@pytest.mark.parametrize("optimiser", ["natural", "adam"])
def test_only_those_gaussians_learn_a_kind_that_are_asked_to(optimiser):
    start = model()
    cameras = cameras_around(start, (0.0, 2.1, 4.2))
    targets = [np.full((32, 40, 3), 0.3, np.float32)] * 3
    train = TrainSettings(passes=3, optimiser=optimiser)
    some, n = np.arange(len(start)) % 3 == 0, len(start)
    masks = {"scale": some[:, None], "opacity": some}
    found = fit_gaussians(start, cameras, targets, train, learns=masks).gaussians
    whole = fit_gaussians(start, cameras, targets, train).gaussians
    assert np.array_equal(found.log_scales[~some], start.log_scales[~some])
    assert np.array_equal(found.logit_opacities[~some], start.logit_opacities[~some])
    moved = (whole.log_scales != start.log_scales).any(axis=1)
    assert moved.sum() > 100
    assert np.array_equal((found.log_scales != start.log_scales).any(axis=1), moved & some)
    everyone = {"scale": np.ones((n, 1), bool), "colour": np.ones((n, 1, 1), bool)}
    assert fit_gaussians(start, cameras, targets, train, learns=everyone).gaussians == whole


def test_scales_are_learned_where_they_are_wrong():
    truth = model()
    wrong = np.arange(len(truth)) % 10 == 0
    off = 0.3 * wrong[:, None].astype(np.float32)
    start = dataclasses.replace(truth, log_scales=truth.log_scales + off)
    images = images_of(truth, start)
    found = lean_fit(images, SETTINGS, sh="0")
    scale, colour = found.learned["scale"], found.learned["colour"]
    assert scale[wrong & colour].mean() > 2 * scale[~wrong & colour].mean()
    assert found.left_out is None
    assert set(found.learned) == {"colour", "scale", "rotation", "opacity"}
    for kind, name in zip(("scale", "rotation", "opacity"), LEARNED[1:], strict=True):
        held = ~found.learned[kind]
        assert np.array_equal(getattr(found.gaussians, name)[held], getattr(start, name)[held])
    sizes = {"colour": 3, "scale": 3, "rotation": 4, "opacity": 1}
    counts = {kind: int(mask.sum()) for kind, mask in found.learned.items()}
    assert found.parameters == sum(counts[kind] * size for kind, size in sizes.items())
    everything = lean_fit(images, SETTINGS, learn="all", sh="0")
    assert found.parameters < everything.parameters == 11 * colour.sum()
    assert found.whole == everything.whole == everything.gaussians
    more = lean_fit(images, SETTINGS, sh="0", loss=0.0)
    assert found.parameters < more.parameters < everything.parameters


def test_what_no_image_sees_is_not_learned():
    truth = model()
    hidden = np.arange(len(truth)) >= 450
    truth.means[hidden, 2] += 1000.0  # high above all views
    found = lean_fit(images_of(truth, truth), SETTINGS, sh="0")
    assert not any(mask[hidden].any() for mask in found.learned.values())


@pytest.mark.slow
@pytest.mark.parametrize(("shine", "degree"), [(0.0, 0), (0.3, 1)])
def test_colours_have_a_degree_where_the_truth_has_one(shine, degree):
    start = model()
    truth = start.with_degree(1)  # with colours of its own
    start.sh *= 0.9  # so that there is something to learn
    # All of them shine in the same direction.
    truth.sh[:, 1:] = shine * np.random.default_rng(1).normal(size=(1, 3, 1))
    images = images_of(truth, start, views=2 * VIEWS)
    found = lean_fit(images, SETTINGS, learn="all", loss=0.05)
    assert found.gaussians.sh_degree == degree
    assert found.left_out.pays == bool(degree)
    assert (found.left_out.gain > 0.5) == bool(degree)
    if degree:
        assert 0.3 < found.learned[DIRECTIONAL].mean() <= 1
        assert not found.gaussians.sh[~found.learned[DIRECTIONAL], 1:].any()


def test_few_views_leave_no_choice_of_a_degree():
    start = model()
    found = lean_fit(images_of(start, start, views=BLOCKS - 1), SETTINGS)
    assert (found.gaussians.sh_degree, found.left_out) == (0, None)


def test_lambda_of_each_kind():
    lam, of = evidence.regularisation(SETTINGS, 2), kinds(2)
    assert list(of) == ["colour", DIRECTIONAL, "scale", "rotation", "opacity"]
    assert [columns.stop for columns in of.values()] == [3, 27, 30, 34, 35]
    assert np.allclose(lam[of["colour"]], 0.02**2)
    assert np.allclose(lam[of[DIRECTIONAL]], (0.02 / 0.03) ** 2)
    assert np.allclose(lam[of["opacity"]], 0.01**2)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    root = tmp_path_factory.mktemp("refit")
    synthetic.write_dataset(root / "data/test", synthetic.orbit_cameras(3, 48, 36, altitude=2.0))
    data = synthetic.write_dataset(root / "data", synthetic.orbit_cameras(12, 48, 36))
    train = {"passes": 10, "antialiased": False}
    given = {"gaussians": 400, "budget": 2, "policy": "uniform", "train": train}
    run_nbv(data.root, root / "run", **given)
    return root / "run"


def test_a_run_is_refitted_beside_its_model(run, capsys):
    before = {file.name: file.read_bytes() for file in run.iterdir() if file.is_file()}
    said = output(capsys, "simplify", run, "--method", "refit")
    after = {file.name: file.read_bytes() for file in run.iterdir() if file.is_file()}
    refitted = after.pop(REFITTED)
    assert after == before
    vertices = PlyData.read(str(run / REFITTED))["vertex"].data
    marks = {
        name.removeprefix("learned_"): vertices[name].astype(bool)
        for name in vertices.dtype.names
        if name.startswith("learned_")
    }
    assert {"colour", "scale", "rotation", "opacity"} <= set(marks)
    columns = {"colour": 3, "directional": 9, "scale": 3, "rotation": 4, "opacity": 1}
    parameters = sum(int(mask.sum()) * columns[kind] for kind, mask in marks.items())
    assert f"{parameters:,} parameters are learned" in said
    assert 1200 <= parameters < 4400
    model, whole = read_ply(run / REFITTED), open_run(run).state.gaussians
    assert np.array_equal(model.means, whole.means)
    priors = np.unique(model.logit_opacities[~marks["opacity"]])
    assert len(priors) <= 2  # on the surface, and behind it
    assert "PSNR on the test views" in said
    found = refit_run(run)
    assert (run / REFITTED).read_bytes() == refitted
    assert found.lean.parameters == parameters
    assert found.before == 4400
    own, whole, lean = found.psnr
    assert lean > whole - LEARN_LOSS - 0.15  # on processors of 8 lanes by 0.14
    assert f"{lean:.2f} dB, {whole:.2f} dB where all" in said
    assert f"own model {own:.2f} dB" in said


def test_a_run_is_pruned_beside_its_model(run, capsys):
    informed = evaluate_run(run, pictures=False)["informed"]
    assert {kind: number["of"] for kind, number in informed.items()} == {
        "colour": 1200, "scale": 1200, "rotation": 1600, "opacity": 400
    }  # fmt: skip
    H = open_run(run).state.H
    for kind, columns in (("colour", H[:, :3]), ("rotation", H[:, 6:10])):
        expected = (columns > (PIXEL_NOISE / PRIOR_STD[kind]) ** 2).sum()
        assert informed[kind]["informed"] == expected
    assert 0 < informed["rotation"]["informed"] < 1600
    whole = (run / "gaussians.ply").read_bytes()
    said = output(capsys, "simplify", run)
    left = read_ply(run / "gaussians_pruned.ply")
    assert 0 < len(left) < 400
    assert f"400 Gaussians, {len(left)} stay" in said
    assert "PSNR on the test views" in said
    assert (run / "gaussians.ply").read_bytes() == whole
    said = refused(capsys, ["simplify", run, "--force", "--noise", 0])
    assert "noise 0.0 must be positive" in said


def test_the_images_of_the_last_fit_are_those_of_the_run(run):
    opened = open_run(run)
    images = learning.images_of(Scene(opened.dataset, opened.prior, opened.settings), opened.taken)
    positions = np.array([images.cameras[i].position for i in images.order])
    around = np.unwrap(np.arctan2(positions[:, 1], positions[:, 0]))
    assert (np.diff(around) > 0).all()
    assert around[-1] - around[0] < 2 * np.pi
    start = images.start(range(len(images)))
    assert np.array_equal(start.means, opened.state.gaussians.means)


def test_a_run_that_learns_means_is_refitted_too(run, tmp_path):
    small = {"gaussians": 150, "budget": 1, "policy": "uniform", "exposure": True}
    train = {"means": "free", "passes": 4}
    run_nbv(run.parent / "data", tmp_path / "run", train=train, **small)
    found = refit_run(tmp_path / "run", sh="0")
    assert found.before == 150 * 14
    vertices = PlyData.read(str(tmp_path / "run" / REFITTED))["vertex"].data
    held = vertices["learned_mean"] == 0
    assert 0 < held.mean() < 1
    assert held.mean() == pytest.approx(1 - found.lean.learned["mean"].mean())


def test_a_run_that_cannot_be_refitted_is_one_line(run, tmp_path):
    shutil.copytree(run, tmp_path / "run", ignore=shutil.ignore_patterns(REFITTED))
    change_settings(tmp_path / "run", prior=str(tmp_path / "nowhere"))
    fails("nowhere", refit_run, tmp_path / "run")
    train = {"density": "adaptive", "means": "free"}
    change_settings(tmp_path / "run", budget=0, train=train)
    fails("--density fixed", refit_run, tmp_path / "run")
    assert not (tmp_path / "run" / REFITTED).exists()
