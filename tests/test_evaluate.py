"""PSNR and SSIM against their definitions, and the evaluation of a model on a dataset."""

import json
import math
import threading
import time
import weakref
from dataclasses import replace

import numpy as np
import pytest
import tiny
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from program import change_checkpoint
from refusals import fails, listing
from synthetic import orbit_cameras, write_dataset

from mgs import Gaussians, evaluate_run, evaluation, sh_from_rgb, write_ply
from mgs.colour import linear_from_srgb, srgb_from_linear
from mgs.evaluation import evaluate_model, write_comparison
from mgs.files import read_json, write_json
from mgs.images import write_exr, write_png
from mgs.metrics import METRICS, OPAQUE, PSNR_LIMIT, SURFACE_METRICS, compare_surface, psnr, ssim
from mgs.progress import listening
from mgs.reports import evaluation as measuring
from mgs.run.folder import read_checkpoint


@pytest.fixture
def images():
    rng = np.random.default_rng(0)
    a = rng.random((24, 32, 3))
    return a, np.clip(a + rng.normal(0, 0.05, a.shape), 0, 1)


def flat(gaussians, camera):
    """A renderer of one grey, opaque, at 1 m."""
    one = np.ones((camera.height, camera.width), np.float32)
    return np.repeat(0.2 * one[..., None], 3, axis=2), one, one


def test_psnr_of_a_constant_error_and_inside_a_mask(images):
    a, b = images
    assert psnr(a, a + 0.1) == pytest.approx(20.0)
    assert psnr(a, a) == PSNR_LIMIT
    mask = np.zeros(a.shape[:2], bool)
    mask[5:9, 4:20] = True
    assert psnr(a, b, mask) == pytest.approx(-10 * math.log10(((a - b)[mask] ** 2).mean()))
    nothing = np.zeros(a.shape[:2], bool)
    assert math.isnan(psnr(a, b, nothing))
    assert math.isnan(ssim(a, b, nothing))


def test_ssim_is_that_of_wang(images):
    """Compare with scikit-image, which has the paper's window and constants with these options;
    also where all around a part is black, and inside a mask."""
    from skimage.metrics import structural_similarity

    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    options |= {"channel_axis": -1, "data_range": 1.0}
    rng, black = np.random.default_rng(2), np.zeros((30, 40, 3))
    for box in (np.s_[:0], np.s_[3:9, 20:33], np.s_[:1, :1], np.s_[25:, 12:]):
        a, b = black.copy(), black.copy()
        a[box], b[box] = rng.random(black[box].shape), rng.random(black[box].shape)
        assert ssim(a, b) == structural_similarity(a, b, **options)
    a, b = images
    mask = rng.random(a.shape[:2]) < 0.2
    whole, each = structural_similarity(a, b, full=True, **options)
    assert ssim(a, b) == pytest.approx(whole, abs=1e-12)
    assert ssim(a, b, mask) == pytest.approx(each[mask].mean(), abs=1e-12)


def test_bad_images_are_named():
    fails("cannot be compared", psnr, np.zeros((4, 4, 3)), np.zeros((4, 5, 3)))
    fails("at least 11x11", ssim, np.zeros((8, 40, 3)), np.zeros((8, 40, 3)))


def grey() -> Gaussians:
    parts = np.zeros((1, 3), "f4"), np.zeros((1, 3), "f4"), np.eye(1, 4, dtype="f4")
    return Gaussians(*parts, np.zeros(1, "f4"), sh_from_rgb(np.ones((1, 3))))


@pytest.mark.parametrize(("pixels", "most"), [(4_000_000, 4), (1, 1)])
def test_views_are_measured_beside_each_other_but_large_ones_alone(
    tmp_path, monkeypatch, pixels, most
):
    """The drawing thread frees a renderer's result: if another thread frees memory of Dr.Jit while
    the next view is drawn, both can stop for ever."""
    dataset = write_dataset(tmp_path / "data", orbit_cameras(8))
    active, seen, freed = [], [], []

    def renderer(gaussians, camera):
        drawn = tuple(np.zeros((2, 2)) for _ in range(3))
        for part in drawn:
            weakref.finalize(part, lambda: freed.append(threading.current_thread()))
        return drawn

    def measured(view, *rendered):
        active.append(view)
        seen.append(len(active))
        time.sleep(0.02)
        active.pop()
        return {"psnr": float(view[0].name[-1])}

    monkeypatch.setattr(evaluation, "_measured", measured)
    monkeypatch.setattr(evaluation, "PIXELS_AT_ONCE", pixels)
    result = evaluate_model(grey(), dataset.frames, (), renderer=renderer)
    assert [view["psnr"] for view in result["views"]] == list(range(8)), "in their order"
    assert len(seen) == 8
    assert (max(seen) == 1) if most == 1 else (1 < max(seen) <= most)
    assert freed == [threading.main_thread()] * 24


def test_evaluate(tmp_path):
    """A model that renders one grey: each metric is that of the grey image, and the averages leave
    out what was trained on. Test views may have names of training views."""
    dataset, calls = write_dataset(tmp_path / "data", orbit_cameras(4)), []
    tests = write_dataset(tmp_path / "test", orbit_cameras(3, 40, 30)).frames
    options = {"test_frames": tests, "renderer": flat, "pictures": tmp_path / "renders"}
    with listening(lambda _stage, *how: calls.append(how)):
        result = evaluate_model(grey(), dataset.frames, {"kf_0001"}, **options)
    assert [view["name"] for view in result["views"]] == [f"kf_000{i}" for i in range(4)]
    assert [view["trained"] for view in result["views"]] == [False, True, False, False]
    assert [view["trained"] for view in result["test_views"]] == [False] * 3
    assert (result["images"], result["all"]["count"], result["held_out"]["count"]) == (1, 4, 3)
    alone = evaluate_model(grey(), tests, (), renderer=flat)
    assert (result["test"], result["test_views"]) == (alone["all"], alone["views"])
    assert "test" not in alone
    assert "test_views" not in alone
    truth = srgb_from_linear(dataset.frames[2].masked_rgb())
    shown = srgb_from_linear(np.full_like(truth, 0.2))
    mask, known = dataset.frames[2].mask(), dataset.frames[2].target()[1] > 0
    assert 0 < mask.mean() < 1
    assert 0.9 < known.mean() < 1  # all but the outline of a mask without an image of the rock
    view = result["views"][2]
    assert view["psnr"] == pytest.approx(psnr(truth, shown, known))
    assert view["ssim"] == pytest.approx(ssim(truth, shown, known))
    assert view["ssim_mask"] == pytest.approx(ssim(truth, shown, mask & known))
    assert view["psnr_inside"] == pytest.approx(psnr(truth, shown, mask & known))
    for name in METRICS:
        values = [view[name] for view in result["views"]]
        assert result["all"][name] == pytest.approx(np.mean(values))
        assert result["held_out"][name] == pytest.approx(np.mean([values[i] for i in (0, 2, 3)]))
    assert calls == [(i, 7) for i in range(1, 8)]
    assert json.loads(json.dumps(result, allow_nan=False)) == result
    pictures = {path.relative_to(tmp_path).as_posix() for path in tmp_path.glob("renders/**/*.png")}
    names = *(f"kf_000{i}" for i in range(4)), *(f"test/kf_000{i}" for i in range(3))
    assert pictures == {f"renders/{name}.png" for name in names}


def random_view(rng):
    """Truth [H,W,4] of any alphas, weight, mask, depth with holes; alpha and depth of a render."""
    shape = (6, 5)
    alpha = rng.choice([0.0, 0.3, 1.0], shape)
    truth = np.dstack([np.zeros((*shape, 3)), alpha])
    weight, mask = rng.choice([0.0, 1.0], shape, p=[0.2, 0.8]), alpha > 0.2
    true_depth = np.where(mask, rng.choice([0.0, 2.0], shape, p=[0.2, 0.8]), 0)
    drawn = rng.choice([0.0, 0.8, 0.95, 1.0], shape)
    return truth, weight, mask, true_depth, drawn, np.where(drawn > 0, rng.normal(2, 0.5, shape), 0)


@given(seed=st.integers(0, 10_000))
def test_surface_metrics_follow_their_definitions(seed):
    truth, weight, mask, true_depth, alpha, depth = random_view(np.random.default_rng(seed))
    options = {"fractional": True, "true_depth": true_depth}
    found = compare_surface(truth, alpha, depth, mask, weight, **options)
    assert tuple(found) == SURFACE_METRICS
    errors, see_through, behind = [], [], []
    for at in np.ndindex(mask.shape):
        if weight[at] == 0:
            continue
        errors.append(abs(alpha[at] - truth[at][3]))
        if truth[at][3] == 1:
            see_through.append(alpha[at] < OPAQUE)
        if mask[at] and true_depth[at] > 0:
            behind.append(depth[at] - true_depth[at] if alpha[at] > 0 else math.inf)
    assert found["alpha_mae"] == pytest.approx(np.mean(errors))
    median = np.median(np.abs(behind)) if behind else math.nan
    expected = {
        "see_through": np.mean(see_through) if see_through else math.nan,
        "depth_error": median if median < math.inf else math.nan,
    }
    for name, value in expected.items():
        assert found[name] == pytest.approx(value, nan_ok=True)


def test_evaluate_a_perfect_model_and_nothing_held_out(tmp_path):
    dataset = write_dataset(tmp_path, orbit_cameras(2))
    shown = [(frame.masked_rgb(), 1.0 * frame.mask(), frame.depth()) for frame in dataset.frames]
    truths = dict(zip(map(id, dataset.cameras), shown, strict=True))
    names, perfect = ["kf_0000", "kf_0001"], lambda g, camera: truths[id(camera)]
    result = evaluate_model(grey(), dataset.frames, names, renderer=perfect)
    assert result["all"]["psnr"] == result["all"]["psnr_mask"] == PSNR_LIMIT
    assert result["all"]["ssim"] == pytest.approx(1)
    # A mask does not say which share of a pixel is rock.
    surface = [name for name in SURFACE_METRICS if name != "alpha_mae"]
    assert [result["all"][name] for name in surface] == [0] * len(surface)
    assert result["held_out"] == {"count": 0} | dict.fromkeys([*METRICS, *surface])


def test_comparison_picture(tmp_path):
    truth = np.full((48, 64, 3), 0.5, np.float32)
    rendered = truth.copy()
    rendered[30:, 40:] = 0.4
    write_comparison(tmp_path / "a.png", truth, rendered, 20.0)
    strip = 20
    picture = np.asarray(Image.open(tmp_path / "a.png")) / 255
    assert picture.shape == (48 + strip, 192, 3)
    expected = 4 * (srgb_from_linear([0.5]) - srgb_from_linear([0.4]))[0]
    assert picture[strip + 40, 128 + 50, 0] == pytest.approx(expected, abs=2 / 255)
    assert picture[strip + 40, 128 + 10].max() == 0
    for first, image in ((0, truth), (64, rendered)):
        read = picture[strip:, first : first + 64]
        np.testing.assert_allclose(read, srgb_from_linear(image), atol=0.51 / 255)


VIEWS = 5 + 3


@pytest.fixture
def dataset(tmp_path):
    tiny.write_dataset(tmp_path / "dataset/test", 3)
    return tiny.write_dataset(tmp_path / "dataset", 5)


@pytest.fixture
def work(monkeypatch):
    """A function: number of views measured, and number drawn, since its last call."""
    calls = []
    for name in ("compare", "write_comparison"):

        def counted(*given, function=getattr(evaluation, name), name=name):
            calls.append(name)
            return function(*given)

        monkeypatch.setattr(evaluation, name, counted)

    def done():
        counts = calls.count("compare"), calls.count("write_comparison")
        calls.clear()
        return counts

    return done


def test_what_is_known_of_a_model_is_not_measured_again(dataset, prior, tmp_path, work):
    run, said = tiny.write_run(tmp_path / "run", dataset, prior), []

    def again(**options):
        return evaluate_run(run, say=said.append, **options)

    first = again(pictures=False)
    assert work() == (VIEWS, 0)
    assert said == [f"wrote {run}/metrics.json"]
    assert {"depth_error", "see_through"} < set(first["all"])
    assert (first["all"]["count"], first["test"]["count"]) == (5, 3)
    assert again(pictures=False) == first
    assert work() == (0, 0)
    kept = f"kept {run}/metrics.json, measured before on this very model and dataset"
    assert said[1:] == [kept]
    drawn = again()
    assert drawn == first | {"pictures": True} == json.loads((run / "metrics.json").read_text())
    assert work() == (VIEWS, VIEWS)
    pictures = listing(run / "renders")
    assert again() == again(pictures=False) == drawn
    assert work() == (0, 0)
    assert said.pop(-2) == f"{kept}, and {run}/renders"
    (run / "renders/test/kf_0002.png").unlink()
    assert again() == drawn
    assert work() == (VIEWS, VIEWS)
    assert listing(run / "renders") == pictures


def brighten(run):
    """Make the model of a run brighter, in both of its files."""
    brighter = read_checkpoint(run).gaussians.sh + np.float32(0.1)
    change_checkpoint(run / "checkpoint.npz", sh=brighter)
    write_ply(run / "gaussians.ply", read_checkpoint(run).gaussians)


def set_noise(run):
    """Correct the noise of pixels by hand, which decides how many parameters are informed."""
    config = read_json(run / "config.json")
    config["settings"]["pixel_noise"] *= 100
    write_json(run / "config.json", config)


WHITE = np.ones((tiny.HEIGHT, tiny.WIDTH, 3))
CHANGES = {
    "model": lambda run, data: brighten(run),
    "settings": lambda run, data: set_noise(run),
    "image": lambda run, data: write_png(data / "images/kf_0003.png", WHITE),
    "test view": lambda run, data: write_png(data / "test/images/kf_0002.png", WHITE),
    "mask": lambda run, data: write_png(data / "masks/kf_0003.png", WHITE[..., 0] > 0),
    "depth": lambda run, data: write_exr(data / "depth/kf_0003.exr", {"Z": WHITE[..., 0]}),
    "damaged": lambda run, data: (run / "metrics.json").write_text("{"),
}


def test_another_commit_keeps_the_metrics_and_another_version_does_not(
    dataset, prior, tmp_path, work, monkeypatch
):
    run, versions = tiny.write_run(tmp_path / "run", dataset, prior), measuring.versions()
    monkeypatch.setattr(measuring, "versions", lambda: versions)
    for name, measured in (("mgs", VIEWS), ("commit", 0), ("mitsuba", VIEWS)):
        versions[name] = "1234567"
        evaluate_run(run)
        assert work()[0] == measured


@pytest.mark.filterwarnings("ignore::mgs.errors.Notice")  # a model of another step is restored
def test_what_has_changed_is_measured_again(dataset, prior, tmp_path, work):
    run = tiny.write_run(tmp_path / "run", dataset, prior)
    before = evaluate_run(run)
    for what, change in CHANGES.items():
        change(run, dataset)
        work()
        after = evaluate_run(run, pictures=False)
        assert work() == (VIEWS, 0), what
        assert (after["all"] == before["all"]) == (what in ("settings", "damaged", "test view"))
        assert (after["test"] == before["test"]) == (what not in ("model", "test view"))
        assert (after["informed"] == before["informed"]) == (what != "settings")
        assert after["pictures"] is False  # those that are there may be of another model
        before = after
    evaluate_run(run)
    assert work() == (VIEWS, VIEWS)


def test_srgb_models_are_measured_as_they_blend():
    ours, camera = tiny.initial([]), tiny.orbit()[0]
    blended = evaluation.render_view(ours, camera)[0]
    found = evaluation.render_view(replace(ours, linear=False), camera)[0]
    assert blended.max() > 0.2
    np.testing.assert_array_equal(found, linear_from_srgb(np.clip(blended, 0, 1)))


def test_a_run_is_measured_on_its_own_dataset(dataset, prior, tmp_path):
    run = tiny.write_run(tmp_path / "run", dataset, prior)
    fails("is a run, with its own dataset", measuring.evaluate, run, dataset)
    write_json(run / "config.json", read_json(run / "config.json") | {"settings": {}})
    write_ply(run / "gaussians.ply", read_checkpoint(run).gaussians)
    fails("dataset = ", measuring.evaluate, run / "gaussians.ply")
