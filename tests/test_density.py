"""Density control of a fit: adaption, bitwise repetition."""

import json
import os
from dataclasses import replace

import numpy as np
import pytest
from refusals import fails
from splat import reference

from mgs import fit_gaussians
from mgs.data.frames import Frame
from mgs.errors import Notice
from mgs.fit import density, fitting, unfinished
from mgs.fit.density import Slopes, adapt, split
from mgs.fit.settings import RATES, TrainSettings
from mgs.provenance import source_digest
from mgs.rotation import rotmat_from_quat
from mgs.scene import _key_of_fit
from mgs.splat import render
from studies.frame.timing import surface_camera, surface_gaussians


@pytest.fixture(scope="module")
def scene():
    """A speckled surface, a camera, its image with weights of 1, and the same surface in grey."""
    truth = surface_gaussians(300)
    truth.log_scales += 0.7
    camera = surface_camera(truth, 40, 32)
    rgb = np.asarray(render(truth, camera).rgb)
    return truth, camera, np.dstack([rgb, np.ones(rgb.shape[:2])]).astype(np.float32)


def slopes(gradient, most=1000, before=500, step=600):
    """Slopes in a scene of 10 m."""
    return Slopes(np.asarray(gradient, float), before, step, 10.0, most)


@pytest.fixture
def mixed():
    """Gaussians, the first half of 0.2 m, others below 0.1 m; gradients, large at every fourth."""
    model = surface_gaussians(200)
    model.log_scales[:] = np.log([0.05, 0.02, 0.01])
    model.log_scales[:100, 1] = np.log(0.2)
    return model, np.where(np.arange(200) % 4 == 0, 3e-4, 1e-4)


def test_small_ones_are_copied_and_large_ones_divided(mixed):
    model, gradient = mixed
    new, kept = adapt(model, slopes(gradient), np.random.default_rng(0))
    assert len(new) == 250
    whole = kept >= 0
    large, small = np.arange(0, 100, 4), np.arange(100, 200, 4)
    assert set(kept[whole]) == set(range(200)) - {*large}
    assert new[whole] == model[kept[whole]]
    assert sorted(~kept[~whole]) == sorted([*small, *large, *large])
    copies = np.isin(~kept, small)
    assert new[copies] == model[~kept[copies]]
    parts = np.isin(~kept, large)
    parents = model[~kept[parts]]
    for name in ("quats", "logit_opacities", "sh"):
        assert np.array_equal(getattr(new[parts], name), getattr(parents, name))
    assert np.allclose(new[parts].log_scales, parents.log_scales - np.log(1.6), atol=1e-6)


def test_halves_have_the_mean_and_nearly_the_covariance_of_the_whole():
    """The third whose gradient is largest is divided along its longest axes; the faint go."""
    model, gradient = surface_gaussians(300), np.random.default_rng(0).random(300)
    model.log_scales[:] = np.log([0.2, 0.3, 0.1])
    model.logit_opacities[:7], gradient[:7] = -6.0, 0.0
    new, kept = split(model, slopes(gradient), np.random.default_rng(0))
    assert np.array_equal(kept[kept >= 0], np.setdiff1d(np.arange(7, 300), ~kept[kept < 0]))
    one, other = np.array_split(np.flatnonzero(kept < 0), 2)
    assert {*~kept[one]} == {*~kept[other]} == {*np.argsort(-gradient)[:90]}
    wholes, apart = model[~kept[one]], new.means[one] - new.means[other]
    assert np.allclose((new.means[one] + new.means[other]) / 2, wholes.means, atol=1e-6)
    local = rotmat_from_quat(wholes.quats).transpose(0, 2, 1) @ apart[..., None].astype(float) / 2
    variances = local[..., 0] ** 2 + np.exp(2.0 * new.log_scales[one])
    assert np.allclose(variances / [0.04, 0.09, 0.01], [1, 0.92, 1], atol=0.01)


def test_the_parts_of_a_divided_gaussian_are_drawn_from_it():
    """Mean and covariance of many parts, along the axes of the Gaussian."""
    model = surface_gaussians(4000)
    model.log_scales[:] = np.log([0.3, 0.2, 0.1])
    rng = np.random.default_rng(0)
    new, kept = adapt(model, slopes(np.ones(4000), most=10_000), rng)
    assert (kept < 0).all()
    offsets = new.means.astype(float) - model.means[~kept]
    local = (rotmat_from_quat(model.quats[~kept]).transpose(0, 2, 1) @ offsets[..., None])[..., 0]
    assert np.allclose(local.mean(0), 0, atol=0.01)
    assert np.allclose(np.cov(local.T), np.diag([0.09, 0.04, 0.01]), atol=0.003)


def test_the_faint_and_too_large_are_removed_and_opacities_reset(mixed):
    model, _ = mixed
    model.logit_opacities[:10] = -6.0
    model.log_scales[10:13] = np.log(1.1)
    none = np.zeros(200)
    new, kept = adapt(model, slopes(none), np.random.default_rng(0))
    assert np.array_equal(kept, np.arange(10, 200))
    assert new == model[kept]
    late = slopes(none, before=2990, step=3010)
    new, kept = adapt(model, late, np.random.default_rng(0))
    assert np.array_equal(kept, np.arange(13, 200))
    assert new.opacities.max() == pytest.approx(0.01)
    assert np.array_equal(new.means, model.means[13:])
    model.logit_opacities[:] = -9.0
    assert len(adapt(model, slopes(none), np.random.default_rng(0))[0]) == 200


def test_no_more_than_the_most_are_added_and_by_gradient(mixed):
    model, gradient = mixed
    gradient[[0, 100, 104]] = 1.0
    new, kept = adapt(model, slopes(gradient, most=203), np.random.default_rng(0))
    assert len(new) == 203
    assert sorted({*~kept[kept < 0]}) == [0, 100, 104]
    assert adapt(model, slopes(gradient, most=7), np.random.default_rng(0))[0] == model


def test_times_of_adaption():
    times = density.DENSITIES["adaptive"].times
    assert times(30, 100) == list(range(6, 15))
    assert times(600, 50) == list(range(12, 300, 2))


def test_slopes_are_those_of_the_reference(scene, monkeypatch):
    """Reference: central differences, in float64, of the mean loss by each splat's centre."""
    truth, camera, target = scene
    model = replace(truth, sh=np.zeros_like(truth.sh))
    found = []
    monkeypatch.setattr(density, "ADAPTION_FROM", 0)
    monkeypatch.setattr(density, "ADAPTION_STEPS", 1)
    monkeypatch.setattr(fitting, "slopes_of", lambda sums, *_: found.append(sums) or 1 / 0)
    control = {"density": "adaptive", "loss": "squared", "passes": 4}
    train = TrainSettings(means="free", rates=RATES | {"mean": 0.0}, **control)
    with pytest.raises(ZeroDivisionError):
        fit_gaussians(model, [camera], [target], train)
    ((norms, drawn),) = found
    projected = reference.project(model, camera)

    def loss(j, shift):
        means2d = projected.means2d.copy()
        means2d[j] += shift
        moved = replace(projected, means2d=means2d)
        order, alpha, T, _ = reference.composite(moved, camera)
        image = (alpha * T) @ moved.colours[order]
        return np.square(image - target[..., :3].reshape(-1, 3)).mean()

    steps = 1e-5 * np.eye(2)
    for j in np.random.default_rng(0).permutation(len(model))[:6]:
        slope = [(loss(j, step) - loss(j, -step)) / 2e-5 for step in steps]
        expected = np.hypot(slope[0] * camera.width / 2, slope[1] * camera.height / 2)
        assert np.array(norms)[j] == pytest.approx(expected, rel=1e-2, abs=1e-7)
    order, alpha, _, _ = reference.composite(projected, camera)
    seen = np.zeros(len(model), bool)
    seen[order] = alpha.any(0)
    assert np.array(drawn)[seen].min() == 1
    assert set(np.unique(np.array(drawn))) <= {0, 1}


@pytest.mark.parametrize("optimiser", ["adam", "natural"])
def test_a_fit_of_changing_number_repeats_bitwise(scene, monkeypatch, optimiser):
    truth, camera, target = scene
    for name, value in (("FROM", 0), ("STEPS", 2)):
        monkeypatch.setattr(density, f"ADAPTION_{name}", value)
    monkeypatch.setattr(density, "LEAST_GRADIENT", 1e-5)
    monkeypatch.setattr(density, "RESET_STEPS", 5)
    start = replace(truth, sh=np.zeros_like(truth.sh)).with_degree(1)
    kinds = {"means": "free", "density": "adaptive", "loss": "l1-dssim", "optimiser": optimiser}
    rates = {"rates": RATES | {"mean": 0.01}, "steady_rates": ("colour",), "directional_rate": 0.5}
    train = TrainSettings(**kinds, **rates, passes=14, most_gaussians=420, sh_steps=2)
    prior = {"scale": 1.0, "colour": np.full((1, 4, 1), 0.1)}
    one, two = (fit_gaussians(start, [camera], [target], train, lam=prior) for _ in range(2))
    assert one.gaussians == two.gaussians
    assert one.losses == two.losses
    assert 300 < len(one.gaussians) <= 420
    assert one.loss < one.losses[0]
    assert np.abs(one.gaussians.sh[:, 1:]).max() > 0
    learns = {"colour": np.ones((300, 1, 1))}  # masks of Gaussians that may be removed
    fails("all learn", fit_gaussians, start, [camera], [target], train, learns=learns)


@pytest.mark.parametrize("optimiser", ["adam", "natural"])
def test_an_interrupted_fit_continues_bit_for_bit(scene, monkeypatch, tmp_path, optimiser):
    """Also in the middle of a pass, and after Gaussians were divided."""
    truth, camera, target = scene
    monkeypatch.setattr(unfinished, "SECONDS", 0.0)
    start = replace(truth, sh=np.zeros_like(truth.sh))
    cameras, targets = [camera, camera, camera], [target, 0.9 * target, 0.8 * target]
    rates = RATES | {"mean": 0.01}
    train = TrainSettings(means="free", density="split", optimiser=optimiser, rates=rates, passes=6)
    saves, used = [unfinished.Unfinished(tmp_path / "fit.npz", "these")], []
    given = start, cameras, targets, train

    def fit(last: int, saved: unfinished.Unfinished | None):
        def on_image(done, most):
            used.append(done)
            assert done < most
            if done == last:
                raise KeyboardInterrupt

        return fit_gaussians(*given, lam={"scale": 1.0}, on_image=on_image, unfinished=saved)

    whole = fit(-1, None)
    assert len(whole.gaussians) > len(truth)
    every = used.copy()
    for last in every[7::5]:
        with pytest.raises(KeyboardInterrupt):
            fit(last, saves[0])
    used.clear()
    found = fit(-1, saves[0])
    assert used[0] > every[-6]
    assert (found.gaussians, found.losses) == (whole.gaussians, whole.losses)
    used.clear()
    assert fit(-1, saves[0]).gaussians == whole.gaussians
    assert not used, "the end is on disk, too"
    with pytest.warns(Notice, match="fit.npz: is of other .*; the fit starts anew"):
        fit(-1, unfinished.Unfinished(saves[0].path, "others"))
    assert used == every
    saves[0].path.write_bytes(b"PK damaged")
    with pytest.raises(KeyboardInterrupt), pytest.warns(Notice, match="damaged; the fit starts"):
        fit(9, saves[0])
    arrays = dict(np.load(saves[0].path))
    empty = json.dumps(json.loads(str(arrays["json"])) | {"losses": []})
    degree = np.zeros((len(truth), 4, 3), np.float32)
    for change in (
        {"json": np.array(empty)},
        {"best.sh": degree},
        {"slopes.1": None},
        {"information.sh": None} if optimiser == "natural" else {"buffer.sh.1": None},
    ):
        parts = {name: part for name, part in (arrays | change).items() if part is not None}
        np.savez(saves[0].path, **parts)
        used.clear()
        with pytest.warns(Notice, match="damaged; the fit starts anew"):
            assert fit(-1, saves[0]).gaussians == whole.gaussians
        assert used == every
    np.savez(saves[0].path, **{name: arrays[name] for name in arrays if "slopes" not in name})
    fit(-1, saves[0])


def test_any_other_number_picture_or_version_is_another_fit(scene, tmp_path, monkeypatch):
    """Also the last bit of one in an array, of which NumPy prints eight digits, and a picture of
    the same size and time."""
    picture, lam = tmp_path / "a.png", np.full((1, 4, 3), 1 / 3)
    given = scene[0], scene[0], [Frame("a", scene[1], 0.0, picture)], None, TrainSettings()
    picture.write_bytes(b"before")
    keys = [_key_of_fit(*given, {"colour": each}) for each in (lam, np.nextafter(lam, 1), 1 / 3)]
    time = picture.stat().st_mtime_ns
    picture.write_bytes(b"edited")
    os.utime(picture, ns=(time, time))
    keys.append(_key_of_fit(*given, {"colour": lam}))
    monkeypatch.setattr("mgs.provenance.__version__", "99")
    keys += [_key_of_fit(*given, {kind: lam}) for kind in ("colour", "scale")]
    for edited in ("a = 1", "a = 2"):  # a source file of mgs, in one commit
        (tmp_path / "fitting.py").write_text(edited)
        monkeypatch.setattr("mgs.provenance.__file__", str(tmp_path / "provenance.py"))
        source_digest.cache_clear()
        keys.append(_key_of_fit(*given, {"colour": lam}))
    source_digest.cache_clear()
    assert len(set(keys)) == len(keys)
