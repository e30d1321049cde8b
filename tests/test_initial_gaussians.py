"""Initial Gaussians on an analytic scene with known colours."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.special import spence

sys.path.insert(0, str(Path(__file__).parent))
import synthetic

from mgs.data.dataset import Dataset
from mgs.prior.build import Prior, build_prior
from mgs.prior.initial import GREY, IN_PLANE_SCALE, INITIAL_OPACITY, THICKNESS, initial_gaussians
from mgs.prior.settings import PriorSettings
from mgs.rotation import rotmat_from_quat


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return synthetic.write_dataset(tmp_path_factory.mktemp("orbit"), synthetic.orbit_cameras(12, 96, 72))


@pytest.fixture(scope="module")
def prior(dataset: Dataset) -> Prior:
    return build_prior(dataset, PriorSettings(gaussians=2000, backing=0))[0]


def test_shapes_scales_and_rotations(prior: Prior, dataset: Dataset) -> None:
    gaussians, seen = initial_gaussians(prior, dataset.frames[::3])
    assert gaussians.check() is gaussians
    assert all(getattr(gaussians, name).dtype == np.float32 for name in ("means", "log_scales", "quats", "sh"))
    assert seen.shape == (2000,)
    assert np.allclose(gaussians.means, prior.points, atol=1e-6)
    expected = prior.spacing * np.array([IN_PLANE_SCALE, IN_PLANE_SCALE, THICKNESS])
    assert np.allclose(np.exp(gaussians.log_scales), expected, rtol=1e-5)
    thin = rotmat_from_quat(gaussians.quats)[:, :, 2]
    assert np.allclose(thin, prior.normals, atol=1e-5)
    assert np.allclose(gaussians.opacities, INITIAL_OPACITY, atol=1e-6)


def test_one_layer_hides_what_is_behind_it() -> None:
    """The mean log-transmittance stated in `mgs.prior.initial`, in closed form and by summing over a lattice."""
    dilogarithm = spence(1 - INITIAL_OPACITY)
    closed = -2 * np.pi * IN_PLANE_SCALE**2 * dilogarithm
    x = np.arange(-8, 8) + 0.0
    lattice = np.stack(np.meshgrid(x, x), -1).reshape(-1, 2)
    at = np.random.default_rng(0).uniform(-0.5, 0.5, (500, 2))
    square = ((at[:, None] - lattice) ** 2).sum(-1)
    summed = np.log1p(-INITIAL_OPACITY * np.exp(-square / (2 * IN_PLANE_SCALE**2))).sum(1).mean()
    assert closed == pytest.approx(summed, rel=0.01)
    assert np.exp(closed) < 0.04


def test_colours_are_those_of_the_seen_surface(prior: Prior, dataset: Dataset) -> None:
    gaussians, seen = initial_gaussians(prior, dataset.frames)
    # 12 views from above see all but the foot of the rock, where a pixel's mask may miss.
    assert seen[prior.points[:, 2] > 0.1].mean() > 0.99
    error = np.abs(gaussians.rgb - synthetic.albedo(prior.points))[seen]
    assert np.median(error) < 0.01
    assert np.quantile(error, 0.99) < 0.1  # a pixel at the rim mixes rock and ground


def test_the_far_side_of_one_frame_stays_grey(prior: Prior, dataset: Dataset) -> None:
    frame = dataset.frames[0]
    gaussians, seen = initial_gaussians(prior, [frame])
    towards = np.einsum("nk,nk->n", prior.normals, frame.camera.position - prior.points)
    towards /= np.linalg.norm(frame.camera.position - prior.points, axis=1)
    assert not seen[towards < 0].any()
    assert seen[(towards > 0.3) & (prior.points[:, 2] > 0.1)].mean() > 0.98
    assert np.allclose(gaussians.rgb[~seen], GREY, atol=1e-6)


def test_the_mesh_stands_in_for_missing_depth(prior: Prior, dataset: Dataset) -> None:
    frames = dataset.frames[::3]
    _, by_depth = initial_gaussians(prior, frames)
    gaussians, by_mesh = initial_gaussians(prior, [replace(frame, depth_path=None) for frame in frames])
    assert (by_depth == by_mesh).mean() > 0.93
    error = np.abs(gaussians.rgb - synthetic.albedo(prior.points))[by_mesh]
    assert np.quantile(error, 0.95) < 0.08


def test_colours_are_averaged_and_the_mask_counts(prior: Prior, dataset: Dataset, tmp_path: Path) -> None:
    from mgs.images import write_png

    frame = dataset.frames[0]
    shape = (frame.camera.height, frame.camera.width, 3)
    images = []
    for name, value in (("dark", 0.2), ("light", 0.6)):
        write_png(tmp_path / f"{name}.png", np.full(shape, value, np.float32))
        images.append(replace(frame, name=name, image_path=tmp_path / f"{name}.png"))
    gaussians, seen = initial_gaussians(prior, images)
    assert np.allclose(gaussians.rgb[seen], 0.4, atol=5e-3)
    write_png(tmp_path / "empty.png", np.zeros(shape[:2], bool))
    _, seen = initial_gaussians(prior, [replace(frame, mask_path=tmp_path / "empty.png")])
    assert not seen.any()


def test_no_seed_frames_is_all_grey(prior: Prior) -> None:
    gaussians, seen = initial_gaussians(prior, [])
    assert not seen.any()
    assert np.allclose(gaussians.rgb, GREY, atol=1e-6)
