"""Initial Gaussians on an analytic scene with known colours."""

import json
from dataclasses import replace

import numpy as np
import pytest
import synthetic
from refusals import fails
from scipy.ndimage import binary_erosion
from scipy.spatial import cKDTree

from mgs import Dataset, PriorSettings, render
from mgs.images import write_png
from mgs.prior import initial
from mgs.prior.build import Prior, build_prior, load_prior, prior_from_mesh, save_prior
from mgs.prior.initial import GREY, IN_PLANE_SCALE, THICKNESS, initial_gaussians, pixel_on
from mgs.rotation import rotmat_from_quat
from mgs.run.inputs import prior_digest


@pytest.fixture(scope="module")
def prior(orbit: Dataset) -> Prior:
    return build_prior(orbit, PriorSettings(gaussians=2000, backing=0, poisson_depth=5))


def test_shapes_scales_and_rotations(prior, orbit):
    gaussians, seen = initial_gaussians(prior, orbit.frames[::3])
    assert gaussians.check() is gaussians
    for name in ("means", "log_scales", "quats", "sh"):
        assert getattr(gaussians, name).dtype == np.float32
    assert seen.shape == (2000,)
    off = gaussians.means - prior.points
    pixel = pixel_on(prior, [frame.camera for frame in orbit.frames[::3]])
    assert np.allclose(off, -initial.INSET[True] * pixel * prior.normals, atol=1e-6)
    on_it = initial_gaussians(prior, orbit.frames[::3], pixel=0)[0]
    assert np.allclose(on_it.means, prior.points, atol=1e-6)
    expected = prior.spacing * np.array([IN_PLANE_SCALE, IN_PLANE_SCALE, THICKNESS])
    assert np.allclose(np.exp(gaussians.log_scales), expected, rtol=1e-5)
    thin = rotmat_from_quat(gaussians.quats)[:, :, 2]
    assert np.allclose(thin, prior.normals, atol=1e-5)
    assert np.allclose(gaussians.opacities, initial.INITIAL_OPACITY, atol=1e-6)


def test_a_warm_start_gives_new_images_to_what_none_saw_before(prior, orbit):
    """A newly seen Gaussian takes the new colour plus what was learned; all else stays."""
    before, seen_before = initial_gaussians(prior, orbit.frames[:1])
    start, seen = initial_gaussians(prior, orbit.frames[:2])
    new = seen & ~seen_before
    assert new.mean() > 0.05
    learned = np.random.default_rng(0).normal(0, 0.1, before.sh.shape).astype(np.float32)
    model = replace(before, sh=before.sh + learned, log_scales=before.log_scales + 1)
    found = initial.warm_start(model, before, start)
    np.testing.assert_allclose(found.sh[new], start.sh[new] + learned[new], atol=1e-6)
    seen_now = initial_gaussians(prior, orbit.frames[1:2])[1]
    np.testing.assert_array_equal(found.sh[~seen_now], model.sh[~seen_now])
    assert found.log_scales is model.log_scales
    assert found.sh.dtype == np.float32


def test_a_pixel_on_the_surface(prior):
    """depth / focal length; of several cameras about the closest, of none in front 0."""
    centre, x = np.median(prior.points, axis=0), np.array([1.0, 0, 0])
    near, far, turned = (
        synthetic.pinhole(100.0, 40, 30, centre + d * x, centre + (d - sign) * x)
        for d, sign in ((5, 1), (10, 1), (10, -1))
    )
    assert pixel_on(prior, [near]) == pytest.approx(0.05, rel=0.01)
    assert pixel_on(prior, [near, far, turned]) == pytest.approx(0.055, rel=0.01)
    assert pixel_on(prior, [near, *[far] * 99]) == pytest.approx(0.1, rel=0.01)
    assert pixel_on(prior, [turned]) == 0


@pytest.mark.parametrize("antialiased", [True, False])
def test_outlines_are_where_they_are_in_the_images(orbit, prior, antialiased):
    """Drawn from below the surface the rock covers about its masks; from the surface, more."""

    def excess(pixel: float | None) -> float:
        frames = orbit.frames[::3]
        gaussians = initial_gaussians(prior, frames, pixel, antialiased=antialiased)[0]
        shares = []
        for frame in orbit.frames:
            alpha = np.asarray(render(gaussians, frame.camera).alpha)
            shares.append(alpha.sum() / frame.mask().sum())
        return float(np.mean(shares)) - 1

    assert excess(0) > 2 * abs(excess(None))


def test_colours_are_those_of_the_seen_surface(prior, orbit):
    gaussians, seen = initial_gaussians(prior, orbit.frames)
    # 12 views from above see all but the foot of the rock, where a pixel's mask may miss.
    assert seen[prior.points[:, 2] > 0.1].mean() > 0.99
    error = np.abs(gaussians.rgb - synthetic.albedo(prior.points))[seen]
    assert np.median(error) < 0.01
    assert np.quantile(error, 0.99) < 0.1  # a pixel at the rim mixes rock and ground


def test_the_far_side_of_one_frame_stays_grey(prior, orbit):
    frame = orbit.frames[0]
    gaussians, seen = initial_gaussians(prior, [frame])
    towards = np.einsum("nk,nk->n", prior.normals, frame.camera.position - prior.points)
    towards /= np.linalg.norm(frame.camera.position - prior.points, axis=1)
    assert not seen[towards < 0].any()
    assert seen[(towards > 0.3) & (prior.points[:, 2] > 0.1)].mean() > 0.98
    assert np.allclose(gaussians.rgb[~seen], GREY, atol=1e-6)


def test_the_mesh_stands_in_for_missing_depth(prior, orbit):
    frames = orbit.frames[::3]
    _, by_depth = initial_gaussians(prior, frames)
    without = [replace(frame, depth_path=None) for frame in frames]
    gaussians, by_mesh = initial_gaussians(prior, without)
    assert (by_depth == by_mesh).mean() > 0.93
    error = np.abs(gaussians.rgb - synthetic.albedo(prior.points))[by_mesh]
    assert np.quantile(error, 0.95) < 0.08


def test_colours_are_averaged_and_the_mask_counts(prior, orbit, tmp_path):
    frame = orbit.frames[0]
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
    gaussians, seen = initial_gaussians(prior, [])
    assert not seen.any()
    assert np.allclose(gaussians.rgb, GREY, atol=1e-6)


@pytest.fixture(scope="module")
def backed(orbit: Dataset) -> Prior:
    return prior_from_mesh(orbit.root / "rock.glb", PriorSettings(gaussians=1200))


def test_behind_the_surface_lies_an_opaque_backing(orbit, backed):
    """A third of the Gaussians, evenly spread, a spacing inside, opaque, coloured as above them."""
    prior = backed
    gaussians, seen = initial_gaussians(prior, orbit.frames)
    assert (len(gaussians), len(prior.points), len(seen), prior.backed) == (1200, 800, 800, 400)
    surface, backing, over = gaussians[:800], gaussians[800:], slice(0, 400)
    inward = np.einsum("nk,nk->n", surface.means[over] - backing.means, prior.normals[over])
    np.testing.assert_allclose(inward, prior.spacing, rtol=1e-3)
    np.testing.assert_array_equal(backing.sh, surface.sh[over])
    both = prior.points, prior.points[over]
    apart = [cKDTree(points).query(points, 2)[0][:, 1] for points in both]
    assert apart[1].min() > 1.1 * apart[0].mean()  # a random subset would have nearer neighbours

    opacities = np.full(800, -3, np.float32)
    faded = replace(surface, logit_opacities=opacities)
    opacities = np.concatenate([opacities, gaussians.logit_opacities[800:]])
    both = replace(gaussians, logit_opacities=opacities)
    for frame in orbit.frames[:3]:
        inner = binary_erosion(frame.mask(), iterations=3)
        alpha, hidden = (np.asarray(render(g, frame.camera).alpha)[inner] for g in (faded, both))
        assert alpha.mean() < 0.6
        assert hidden.min() > 0.9


def test_the_backing_survives_the_file_and_is_part_of_what_a_run_goes_on_from(
    orbit, backed, tmp_path
):
    loaded = load_prior(save_prior(tmp_path / "prior", backed))
    assert loaded.backed == backed.backed == 400
    assert len(initial_gaussians(loaded, orbit.frames[:2])[0]) == 1200
    assert prior_digest(replace(loaded, backed=99)) != prior_digest(loaded)
    numbers = json.loads((tmp_path / "prior/prior.json").read_text())
    (tmp_path / "prior/prior.json").write_text(json.dumps(numbers | {"backed": 1000}))
    fails("backed and triangulated must be numbers of the points", load_prior, tmp_path / "prior")
    fails("0 to 1; correct `backing`", PriorSettings, gaussians=300, backing=1.5)
