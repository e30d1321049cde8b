"""Fisher information of the means, and of alpha as a fourth channel."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mgs.errors import InputError
from mgs.splat import MEANS, fisher, groups, information, reference

from .scenes import calm, changed, make_camera, make_clamped, make_gaussians
from .test_fisher import BACKGROUND, assert_close, diagonal

MOVING = ("normal", "free")
CORRELATION = {True: 2e-5, False: 1e-5}
"""Tolerance of blocks, as a share of sqrt(H_ii H_jj), because columns have different units, by
`antialiased`."""


def normals_of(gaussians, seed=0) -> np.ndarray:
    """Random directions of various lengths."""
    return np.random.default_rng([seed, 5]).normal(size=(len(gaussians), 3)) * 10


def assert_means_close(
    gaussians, camera, means, alpha_weight=0.0, background=BACKGROUND, normals=None, what=""
):
    """Both exact estimators against the reference: diagonals relatively, blocks as a share of
    sqrt(H_ii H_jj)."""
    normals = normals_of(gaussians) if normals is None else normals
    options = {"means": means, "normals": normals, "alpha_weight": alpha_weight}
    expected = reference.fisher_block(gaussians, camera, background, **options)
    exact = fisher(gaussians, camera, "exact", background, **options)
    block = fisher(gaussians, camera, "block", background, **options)
    for name, columns in groups(gaussians.sh_degree, means).items():
        for found in (exact, diagonal(block)):
            assert_close(found[:, columns], diagonal(expected)[:, columns], f"{what} {name}")
    size = scale_of(expected)
    seen = size > 1e-6 * size.max()
    error = (np.abs(block - expected)[seen] / size[seen]).max()
    print(f"{what} {means} block, worst error over sqrt(H_ii H_jj) {error:.1e}")
    assert error < CORRELATION[gaussians.antialiased]
    np.testing.assert_array_equal(block, block.transpose(0, 2, 1))


def scale_of(blocks) -> np.ndarray:
    """sqrt(H_ii H_jj) of every entry."""
    return np.sqrt(diagonal(blocks)[:, :, None] * diagonal(blocks)[:, None, :])


@pytest.mark.parametrize("means", MOVING)
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_means_against_brute_force(degree, means):
    camera = make_camera()
    g = calm(lambda seed: make_clamped(seed, degree), camera, 20 + degree)
    for weight in (0.0, 0.3, 4.0):
        assert_means_close(g, camera, means, weight, what=f"degree {degree}, alpha {weight}")


@pytest.mark.parametrize("means", MOVING)
@pytest.mark.parametrize(
    ("n", "style", "size", "eye"),
    [
        (1, {"spread": 0.1, "log_scales": (-2, -1), "logits": (1, 2)}, (45, 27), (2.0, 0.4, 1.1)),
        (60, {"log_scales": (-5, -2)}, (150, 70), (0.2, -2.0, 1.0)),
    ],
    ids=["one", "many"],
)
def test_means_of_other_scenes_and_cameras(n, style, size, eye, means):
    camera = make_camera(size, focal=1.1 * size[0], eye=eye)
    g = calm(lambda seed: make_gaussians(n, seed, **style), camera, 3)
    assert_means_close(g, camera, means, 0.1)


@settings(derandomize=True, deadline=None, max_examples=20)
@given(
    seed=st.integers(0, 2**31),
    degree=st.integers(0, 1),
    scale=st.floats(-5, -0.5),
    stretch=st.floats(0.1, 6),
    logit=st.floats(-2, 10),
    azimuth=st.floats(0, 6.28),
    height=st.floats(-2, 2),
    means=st.sampled_from(MOVING),
    to_camera=st.booleans(),
    alpha_weight=st.sampled_from([0, 1e-3, 1, 100]),
    filtered=st.booleans(),
)
def test_means_of_any_scene(
    seed, degree, scale, stretch, logit, azimuth, height, means, to_camera, alpha_weight, filtered
):
    """Normals that point to the camera are the hardest."""
    camera = make_camera(eye=(2 * np.cos(azimuth), 2 * np.sin(azimuth), height))
    style = {"log_scales": (scale - stretch, scale), "logits": (logit - 4, logit)}
    g = calm(lambda s: make_clamped(s, degree, antialiased=filtered, **style), camera, seed)
    normals = camera.position - g.means if to_camera else None
    assert_means_close(g, camera, means, alpha_weight, normals=normals)


def test_blocks_with_means_are_positive_semidefinite():
    g = make_gaussians(60, 4)
    block = fisher(g, make_camera(), "block", means="free", alpha_weight=0.1).astype(np.float64)
    scale = 1 / np.sqrt(diagonal(block) + 1e-30)
    assert (np.linalg.eigvalsh(block * scale[:, :, None] * scale[:, None, :])[:, 0] > -1e-5).all()


@pytest.mark.parametrize("means", MEANS)
@pytest.mark.parametrize("degree", [0, 3])
def test_groups_tile_the_columns_and_means_come_last(degree, means):
    parts = groups(degree, means)
    sizes = {name: part.stop - part.start for name, part in parts.items()}
    expected = {"colour": 3 * (degree + 1) ** 2, "scale": 3, "rotation": 4, "opacity": 1}
    assert sizes == expected | ({"mean": MEANS[means]} if means != "frozen" else {})
    starts, stops = ([getattr(p, end) for p in parts.values()] for end in ("start", "stop"))
    assert starts == [0, *stops[:-1]]
    none = make_gaussians(0, 1, degree)
    empty = fisher(none, make_camera(), "block", means=means, normals=np.zeros((0, 3)))
    assert empty.shape == (0, stops[-1], stops[-1])


def test_unseen_means_and_clamped_alphas_carry_no_information():
    camera, g = make_camera(), make_gaussians(16, 5, 1)
    g.means[3] = camera.position - 2 * camera.world_to_camera[2, :3]
    g.means[4] = camera.position
    exact, block = (
        fisher(g, camera, e, means="free", alpha_weight=2.0) for e in ("exact", "block")
    )
    assert (exact[[3, 4]] == 0).all()
    assert (block[[3, 4]] == 0).all()
    assert (exact[5, -3:] > 0).all()
    shape = {"means": np.zeros((1, 3)), "log_scales": np.full((1, 3), 6.0)}
    wide = changed(g[:1], logit_opacities=[20.0], sh=0 * g.sh[:1], **shape)
    assert (fisher(wide, camera, means="free", alpha_weight=2.0)[:, 12:] == 0).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"means": "fixed"}, "means 'fixed': unknown; choose one of frozen, normal, free"),
        ({"means": "normal"}, r"fisher: means='normal' needs normals \[N,3\]"),
        ({"means": "normal", "normals": np.ones((4, 3))}, r"normals have shape \(4, 3\), expected"),
        ({"means": "normal", "normals": np.eye(5, 3)}, "normal is zero, .* first at Gaussian 3"),
        ({"alpha_weight": -0.1}, r"fisher: alpha_weight -0\.1 must be from 0 to 1e[+]12"),
        ({"estimator": "hutchinson", "means": "free"}, "'hutchinson' supports neither means"),
    ],
)
def test_unusable_options_are_one_line(options, message):
    with pytest.raises(InputError, match=message) as error:
        fisher(make_gaussians(5, 0), make_camera(), **options)
    assert "\n" not in str(error.value)


def test_too_many_sums_are_refused(monkeypatch):
    camera, g = make_camera(), make_gaussians(16, 5)
    monkeypatch.setattr(information, "MAX_SUMS", 1024 * 24 + 1)
    fisher(g, camera, "block")
    with pytest.raises(InputError, match=r"view: 1,024 pairs .* which takes fewer than 682; take"):
        fisher(g, camera, "block", means="free")
