"""Learned means: steps of a fit, and runs of `mgs nbv`."""

import shutil

import numpy as np
import pytest
import synthetic
import tiny
from program import change_settings
from refusals import fails, refused

from mgs import Camera, diagnose, fit_gaussians, load_dataset, load_prior
from mgs.fit.objective import objective
from mgs.fit.settings import MEAN_RATE, TrainSettings
from mgs.gaussians import LEARNED, Gaussians, learned, sh_from_rgb
from mgs.policy.criteria import DIRECTIONAL_STD, MEAN_STD
from mgs.rotation import quat_from_normals
from mgs.run import folder as run_folder
from mgs.run.nbv import run_nbv, start_run
from mgs.run.settings import NbvSettings
from mgs.splat import MEANS, as_drjit, fisher, groups, render
from mgs.view.layers import SCALARS, read_subject

N, SPACING = 300, (4 * np.pi / 300) ** 0.5


def ball(offsets: np.ndarray | float = 0.0) -> Gaussians:
    """A speckled unit sphere of flat, opaque Gaussians; offsets [N] from the surface, metres."""
    n = synthetic.sphere(N)
    return Gaussians(
        means=(n * (1 + np.broadcast_to(offsets, N))[:, None]).astype(np.float32),
        log_scales=np.tile(np.log(SPACING * np.array([0.5, 0.5, 0.1])), (N, 1)).astype(np.float32),
        quats=quat_from_normals(n).astype(np.float32),
        logit_opacities=np.full(N, 4.0, np.float32),
        sh=sh_from_rgb(np.random.default_rng(2).uniform(0.05, 0.95, (N, 3))),
    )


@pytest.fixture(scope="module")
def cameras() -> list[Camera]:
    azimuths = np.arange(5) * 2 * np.pi / 5
    eyes = [(3 * np.cos(a), 3 * np.sin(a), z) for z in (-1.2, 1.2) for a in azimuths]
    return [synthetic.pinhole(60.0, 48, 40, eye) for eye in eyes]


@pytest.fixture(scope="module")
def targets(cameras) -> list[np.ndarray]:
    return [np.asarray(render(ball(), camera).rgb) for camera in cameras]


def settings(means: str, passes: int, rate: float = MEAN_RATE * SPACING) -> TrainSettings:
    return TrainSettings(means=means, rates={"mean": rate}, passes=passes, tolerance=0.0)


LAM = {"colour": 4e-4, "scale": 1.6e-3, "rotation": 1.6e-3, "opacity": 1e-4}
LAM["mean"] = (0.02 / (MEAN_STD * SPACING)) ** 2


def fitted(begun, cameras, targets, train, start=None):
    """A fit from `begun`; start: the mean of the prior, by default the same."""
    start = begun if start is None else start
    return fit_gaussians(begun, cameras, targets, train, start=start, lam=LAM)


def test_frozen_is_the_default_and_ignores_the_lam_of_means(cameras, targets):
    start, lam = ball(0.05), {kind: value for kind, value in LAM.items() if kind != "mean"}
    plain = fit_gaussians(start, cameras, targets, TrainSettings(passes=3), start=start, lam=lam)
    frozen = fitted(start, cameras, targets, settings("frozen", 3))
    assert plain.gaussians == frozen.gaussians
    assert plain.losses == frozen.losses
    assert np.array_equal(plain.gaussians.means, start.means)
    assert not np.array_equal(plain.gaussians.sh, start.sh)


def test_one_step_is_natural_on_the_gradient_of_the_objective(cameras, targets):
    """The first step is minus a tenth of the gradient over four times the information, at most the
    rate. The second round is replayed."""
    start, rng = ball(0.02), np.random.default_rng(1)
    for _ in range(2):
        begun = ball(0.02 + 0.01 * rng.standard_normal(N))
        begun.sh, begun.log_scales = begun.sh - np.float32(0.1), begun.log_scales + np.float32(0.1)
        begun.logit_opacities -= np.float32(0.3)
        train = settings("free", 1, 0.002).model_copy(update={"loss": "squared"})
        goal = objective(begun, cameras[:1], targets[:1], start, LAM, means="free")
        found = fitted(begun, cameras[:1], targets[:1], train, start)
        assert found.losses == pytest.approx([goal.loss(as_drjit(begun))] * 2, rel=1e-4)
        moved = found.gaussians
        parts = goal.gradient(as_drjit(begun)), goal.diagonal(as_drjit(begun))
        for (name, kind), *of_kind in zip(learned("free").items(), *parts, strict=True):
            g, d = map(np.asarray, of_kind)
            rate = train.rates[kind]
            expected = np.clip(-0.1 * g / (4 * d), -rate, rate)
            step = getattr(moved, name).astype(np.float64) - getattr(begun, name)
            assert 0.2 < (np.abs(step) < 0.95 * rate).mean() < 1, kind  # not all are cut
            assert np.allclose(step, expected, atol=3e-7 + 2e-3 * np.abs(expected)), kind
            assert np.abs(step).max() > rate / 2


def test_displaced_means_move_back_to_the_surface(cameras, targets):
    offsets = 0.4 * SPACING * np.random.default_rng(3).standard_normal(N)
    start = ball(offsets)
    both = settings("frozen", 10), settings("free", 10)
    frozen, moved = (fitted(start, cameras, targets, train) for train in both)
    seen = sum(fisher(start, camera)[:, 0] for camera in cameras) > 0.3
    assert seen.sum() > 0.8 * N
    radii = (np.linalg.norm(g.means, axis=1)[seen] for g in (start, moved.gaussians))
    before, after = (np.abs(radius - 1) for radius in radii)
    assert np.median(after) < 0.4 * np.median(before)
    assert (after**2).mean() < 0.5 * (before**2).mean()
    assert moved.loss < 0.5 * frozen.loss


def test_a_rate_that_is_missing_is_named(cameras, targets):
    fails("no rate of mean", fit_gaussians, ball(), cameras, targets, TrainSettings(means="free"))
    wanted = NbvSettings(dataset=".", prior=".", train=TrainSettings(means="free"))
    fails("prior_std: has no number for mean", wanted.regularisation, groups(0, "free"))


@pytest.fixture(scope="module")
def files(tmp_path_factory, pristine):
    return pristine, tiny.write_prior(tmp_path_factory.mktemp("means") / "prior")


def options(files, means: str, **values):
    train = {"means": means, "passes": 3}
    start = {"prior": files[1], "budget": 2, "seeds": 3, "sh": int(means == "free")}
    return start | {"train": train} | values


@pytest.fixture(scope="module")
def whole(files, tmp_path_factory):
    """(run folder, last state) of a complete run with free means."""
    out = tmp_path_factory.mktemp("free") / "run"
    return out, run_nbv(files[0], out, **options(files, "free")).state


def test_units_are_spacings_of_the_prior_unless_given(files, tmp_path):
    made = start_run(files[0], tmp_path / "run", **options(files, "free")).settings
    assert made.prior_std["mean"] == MEAN_STD * 0.5
    assert made.train.rates["mean"] == MEAN_RATE * 0.5
    assert run_folder.open_run(tmp_path / "run").settings == made
    train = {"means": "free", "rates": {"mean": 0.01}}
    given = options(files, "free", prior_std={"mean": 0.3}, train=train)
    own = start_run(files[0], tmp_path / "own", **given).settings
    assert (own.prior_std["mean"], own.train.rates["mean"]) == (0.3, 0.01)
    frozen = start_run(files[0], tmp_path / "frozen", **options(files, "frozen")).settings
    assert "mean" not in frozen.prior_std


def test_criteria_see_the_means_and_coverage_does_not(files, whole):
    out, state = whole
    made, prior = run_folder.open_run(out).settings, load_prior(files[1])
    dataset = load_dataset(files[0])
    frames = [dataset.frames[i] for i in state.taken]
    H = sum(fisher(state.gaussians, frame.camera, means="free").astype(float) for frame in frames)
    np.testing.assert_array_equal(state.H, H)
    flat = 8 + 3 * 4
    assert state.H.shape[1] == flat + MEANS["free"]
    lam = made.regularisation(groups(1, "free"))
    assert lam[flat:] == pytest.approx((0.02 / (MEAN_STD * prior.spacing)) ** 2)
    assert lam[3 : flat - 8] == pytest.approx((0.02 / DIRECTIONAL_STD) ** 2)
    assert state.surface.shape == (len(prior.points), flat)
    assert state.gaussians.sh[:, 1:].any()
    frozen = run_nbv(files[0], out.parent / "frozen", **options(files, "frozen", budget=0)).state
    assert frozen.steps[0]["coverage"] == state.steps[0]["coverage"]
    assert np.abs(state.gaussians.means - prior.points).max() > 1e-3


@pytest.mark.parametrize("policy", ["d-optimal", "coverage", "directional-d"])
def test_policies_choose_with_learned_means(files, tmp_path, policy):
    given = options(files, "free", budget=1, policy=policy)
    state = run_nbv(files[0], tmp_path / "run", **given).state
    assert len(state.taken) == 4
    assert np.isfinite(state.steps[1]["score"])


def test_means_that_changed_since_the_start_are_one_line(whole, tmp_path, capsys):
    out, _ = whole
    run = shutil.copytree(out, tmp_path / "run")
    train = run_folder.open_run(run).settings.train.model_dump(mode="json")
    change_settings(run, train=train | {"means": "frozen"})
    said = refused(capsys, ["nbv", "--resume", run], run)
    assert f"settings.train.means has changed since {run} was started; restore it" in said


def test_diagnostics_and_viewer_read_such_a_run(files, whole):
    out, state = whole
    written = diagnose(out, [load_dataset(files[0]).frames[0].name])
    assert out / "diagnostics/information.ply" in written
    found = read_subject(out)
    assert set(found.scalars) == set(SCALARS)
    lam = run_folder.open_run(out).settings.regularisation(groups(1, "free"))
    assert found.scalars["information"] == pytest.approx(0.5 * np.log1p(state.H / lam).sum(1))
    for name in LEARNED:
        assert getattr(found.gaussians, name).shape == getattr(state.gaussians, name).shape
