"""PSNR and SSIM against their definitions, and the evaluation of a model on a dataset."""

import json
import math

import numpy as np
import pytest
import tiny
from PIL import Image
from refusals import listing
from synthetic import orbit_cameras, write_dataset

from mgs.colour import srgb_from_linear
from mgs.errors import InputError
from mgs.files import write_json
from mgs.gaussians import Gaussians, sh_from_rgb
from mgs.images import write_png
from mgs.metrics import METRICS, PSNR_LIMIT, psnr, ssim
from mgs.report import evaluation
from mgs.report.evaluation import evaluate, evaluate_run, read_comparison, write_comparison


@pytest.fixture
def images():
    rng = np.random.default_rng(0)
    a = rng.random((24, 32, 3))
    return a, np.clip(a + rng.normal(0, 0.05, a.shape), 0, 1)


def test_psnr_of_a_constant_error():
    a = np.full((8, 8, 3), 0.5)
    assert psnr(a, a + 0.1) == pytest.approx(20.0)
    assert psnr(a, a) == PSNR_LIMIT


def test_psnr_inside_a_mask(images):
    a, b = images
    mask = np.zeros(a.shape[:2], bool)
    mask[5:9, 4:20] = True
    assert psnr(a, b, mask) == pytest.approx(-10 * math.log10(((a - b)[5:9, 4:20] ** 2).mean()))
    outside = b.copy()
    outside[~mask] = 0
    assert psnr(a, outside, mask) == psnr(a, b, mask)
    assert psnr(a, outside) < psnr(a, b)


def test_ssim_follows_its_definition(images):
    """Wang et al. 2004 at one pixel: an 11 x 11 Gaussian window with sigma 1.5, K1 = 0.01, K2 = 0.03."""
    a, b = images
    y, x = 12, 15
    one = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 1.5**2))
    window = np.outer(one, one)[..., None] / np.outer(one, one).sum()
    p, q = (image[y - 5 : y + 6, x - 5 : x + 6] for image in (a, b))
    mean_p, mean_q = (window * p).sum((0, 1)), (window * q).sum((0, 1))
    var_p, var_q = (window * p * p).sum((0, 1)) - mean_p**2, (window * q * q).sum((0, 1)) - mean_q**2
    cov = (window * p * q).sum((0, 1)) - mean_p * mean_q
    c1, c2 = 0.01**2, 0.03**2
    expected = (2 * mean_p * mean_q + c1) * (2 * cov + c2) / ((mean_p**2 + mean_q**2 + c1) * (var_p + var_q + c2))
    mask = np.zeros(a.shape[:2], bool)
    mask[y, x] = True
    assert ssim(a, b, mask) == pytest.approx(expected.mean(), abs=1e-12)
    assert ssim(a, a) == pytest.approx(1.0)
    assert ssim(a, b) < 1


def test_empty_masks_have_no_metric(images):
    a, b = images
    nothing = np.zeros(a.shape[:2], bool)
    assert math.isnan(psnr(a, b, nothing))
    assert math.isnan(ssim(a, b, nothing))


def test_bad_images_are_named():
    with pytest.raises(InputError, match="cannot be compared"):
        psnr(np.zeros((4, 4, 3)), np.zeros((4, 5, 3)))
    with pytest.raises(InputError, match="at least 11x11"):
        ssim(np.zeros((8, 40, 3)), np.zeros((8, 40, 3)))


def grey(n: int = 1) -> Gaussians:
    return Gaussians(
        np.zeros((n, 3), "f4"),
        np.zeros((n, 3), "f4"),
        np.eye(4, dtype="f4")[[0] * n],
        np.zeros(n, "f4"),
        sh_from_rgb(np.ones((n, 3))),
    )


def test_evaluate(tmp_path):
    """A model that renders one grey: each metric is that of the grey image, and the averages leave out what was trained on."""
    dataset = write_dataset(tmp_path / "data", orbit_cameras(4))

    def renderer(gaussians, camera):
        return np.full((camera.height, camera.width, 3), 0.2, np.float32)

    calls = []
    result = evaluate(
        grey(),
        dataset.frames,
        {"kf_0001"},
        renderer=renderer,
        pictures=tmp_path / "renders",
        progress=lambda done, total: calls.append((done, total)),
    )
    assert [view["name"] for view in result["views"]] == ["kf_0000", "kf_0001", "kf_0002", "kf_0003"]
    assert [view["trained"] for view in result["views"]] == [False, True, False, False]
    assert (result["images"], result["all"]["count"], result["held_out"]["count"]) == (1, 4, 3)
    truth = srgb_from_linear(dataset.frames[2].masked_rgb())
    flat = srgb_from_linear(np.full_like(truth, 0.2))
    mask, known = dataset.frames[2].mask(), dataset.frames[2].target()[1] > 0
    assert 0 < mask.mean() < 1
    assert 0.9 < known.mean() < 1  # all but the outline of a mask without an image of the rock
    assert result["views"][2]["psnr"] == pytest.approx(psnr(truth, flat, known))
    assert result["views"][2]["ssim"] == pytest.approx(ssim(truth, flat, known))
    assert result["views"][2]["ssim_mask"] == pytest.approx(ssim(truth, flat, mask & known))
    assert result["views"][2]["psnr_inside"] == pytest.approx(psnr(truth, flat, mask & known))
    for name in METRICS:
        values = [view[name] for view in result["views"]]
        assert result["all"][name] == pytest.approx(np.mean(values))
        assert result["held_out"][name] == pytest.approx(np.mean([values[i] for i in (0, 2, 3)]))
    assert calls == [(i, 4) for i in range(5)]
    assert json.loads(json.dumps(result, allow_nan=False)) == result
    assert len(list((tmp_path / "renders").iterdir())) == 4


def test_evaluate_a_perfect_model_and_nothing_held_out(tmp_path):
    dataset = write_dataset(tmp_path, orbit_cameras(2))
    truths = {id(frame.camera): frame.masked_rgb() for frame in dataset.frames}
    result = evaluate(grey(), dataset.frames, ["kf_0000", "kf_0001"], renderer=lambda g, camera: truths[id(camera)])
    assert result["all"]["psnr"] == result["all"]["psnr_mask"] == PSNR_LIMIT
    assert result["all"]["ssim"] == pytest.approx(1)
    assert result["held_out"] == {"count": 0} | dict.fromkeys(METRICS)


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
    camera = orbit_cameras(1)[0]
    for written, read in zip((truth, rendered), read_comparison(tmp_path / "a.png", camera), strict=True):
        np.testing.assert_allclose(srgb_from_linear(read), srgb_from_linear(written), atol=0.51 / 255)
    with pytest.raises(InputError, match="not a comparison of 60x48"):
        read_comparison(tmp_path / "a.png", orbit_cameras(1, 60)[0])


def test_ssim_of_a_frame_leaves_out_its_border_and_ssim_of_a_mask_does_not():
    truth = np.random.default_rng(0).random((40, 40, 3))
    wrong = truth.copy()
    wrong[0, 0] = 1 - wrong[0, 0]
    assert ssim(truth, wrong) == pytest.approx(1, abs=1e-6)
    assert ssim(truth, wrong, np.ones((40, 40), bool)) < 1 - 1e-4


@pytest.fixture
def work(monkeypatch):
    """How many views were measured, and how many drawn, since last asked."""
    calls = []
    for name in ("compare", "write_comparison"):
        function = getattr(evaluation, name)
        monkeypatch.setattr(evaluation, name, lambda *given, f=function, n=name: calls.append(n) or f(*given))

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
    assert work() == (12, 0)
    assert said.pop() == f"wrote {run}/metrics.json"
    assert again(pictures=False) == first
    assert work() == (0, 0)
    assert said.pop() == f"kept {run}/metrics.json, measured before on this very model and dataset"
    drawn = again()
    assert drawn == first | {"pictures": True} == json.loads((run / "metrics.json").read_text())
    assert work() == (0, 12)
    assert said.pop().endswith(f"dataset; wrote {run}/renders")
    pictures = listing(run / "renders")
    assert again() == again(pictures=False) == drawn
    assert work() == (0, 0)
    assert said.pop(0).endswith(f"dataset, and {run}/renders")
    (run / "renders/kf_0003.png").unlink()
    again()
    assert work() == (0, 12)
    (run / "metrics.json").unlink()
    assert again() == drawn
    assert work() == (12, 12)
    assert listing(run / "renders") == pictures


def brighten(path):
    with np.load(path) as data:
        arrays = dict(data)
    np.savez(path, **arrays | {"sh": arrays["sh"] + np.float32(0.1)})


@pytest.mark.parametrize(
    ("what", "change"),
    [
        ("model", lambda run, dataset: brighten(run / "checkpoint.npz")),
        ("image", lambda run, dataset: write_png(dataset / "images/kf_0003.png", np.ones((tiny.HEIGHT, tiny.WIDTH, 3)))),
        ("mask", lambda run, dataset: write_png(dataset / "masks/kf_0003.png", np.ones((tiny.HEIGHT, tiny.WIDTH), bool))),
        ("older version", lambda run, dataset: write_json(run / "metrics.json", {"images": 3})),
        ("damaged", lambda run, dataset: (run / "metrics.json").write_text("{")),
    ],
)
def test_what_has_changed_is_measured_again(dataset, prior, tmp_path, work, what, change):
    run = tiny.write_run(tmp_path / "run", dataset, prior)
    before = evaluate_run(run)
    change(run, dataset)
    work()
    after = evaluate_run(run, pictures=False)
    assert work() == (12, 0)
    assert (after["all"] == before["all"]) == (what in ("older version", "damaged"))
    assert after["pictures"] is False  # those that are there may be of another model
    evaluate_run(run)
    assert work() == (0, 12)
