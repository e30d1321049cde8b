"""The prior on an analytic scene: every station against what is known exactly."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import synthetic
import trimesh
from refusals import fails
from scipy.spatial import cKDTree

from mgs import Camera, Dataset, InputError, PriorSettings, look_at
from mgs.data.frames import visible
from mgs.data.meshes import Mesh, distances_to_mesh
from mgs.data.raycast import mesh_depth
from mgs.prior.build import build_prior, load_prior, outline_error, prior_and_cloud, save_prior
from mgs.prior.figure import draw_refused
from mgs.prior.points import GROWN, GROWN_NEIGHBOURS, _grown
from mgs.prior.segmentation import Plane, dbscan, ground_plane, rock_cluster
from mgs.prior.surface import error_to_truth, poisson_mesh, sample_surface
from mgs.survey.fusion import Cloud, focus

X, Y, Z = np.eye(3)


@pytest.fixture(scope="module")
def built(orbit: Dataset):
    return prior_and_cloud(orbit, PriorSettings(gaussians=1500, backing=0))


def _ball() -> Mesh:
    return as_mesh(trimesh.creation.icosphere(4, 0.5), (0, 0, 0.5))


def as_mesh(mesh: trimesh.Trimesh, offset=0.0) -> Mesh:
    vertices, faces = np.asarray(mesh.vertices) + offset, np.asarray(mesh.faces)
    return Mesh(vertices, faces, np.ones(len(faces), bool))


def test_the_focus_is_what_all_cameras_look_at(orbit):
    found = focus(orbit.frames)
    assert np.allclose(found.point, synthetic.CENTRE, atol=1e-9)
    assert found.distance == pytest.approx(np.hypot(2.6, 1.3), rel=0.05)


def test_ground_plane_of_a_tilted_noisy_floor(orbit):
    rng = np.random.default_rng(0)
    normal = np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0])
    xy = rng.uniform(-2, 2, (20_000, 2))
    points = np.column_stack([xy, (0.3 - xy @ normal[:2]) / normal[2]])
    points = points + 0.004 * rng.standard_normal((20_000, 1)) * normal
    rock = rng.uniform([-0.3, -0.3, 0.4], [0.3, 0.3, 1.0], (5_000, 3))
    views = np.tile([0, 0, 1.0], (25_000, 1))
    cloud = Cloud(np.concatenate([points, rock]), views, 0.002, 0.0, 25_000)
    plane = ground_plane(cloud, orbit.frames, seed=2)
    assert plane.normal @ normal > np.cos(np.radians(0.1))
    assert plane.offset == pytest.approx(0.3, abs=1e-3)
    assert plane.sigma == pytest.approx(0.004, rel=0.1)
    points = rng.standard_normal((4000, 3))  # no plane dominates
    with pytest.raises(InputError, match="no ground plane"):
        ground_plane(Cloud(points, points, 0.05, 0.0, 4000), orbit.frames, seed=0)


PARTS = {
    "overhang": [([0, 0, 0.2], [0.35, 0.3, 0.3]), ([0, 0, 1.1], [0.6, 0.5, 0.3])],
    "stack": [
        ([0, 0, 0.15], [0.4, 0.4, 0.2]),
        ([0.05, 0, 0.5], [0.25, 0.25, 0.12]),
        ([-0.05, 0, 0.85], [0.4, 0.35, 0.15]),
    ],
    "arch": [
        ([-0.5, 0, 0.25], [0.15, 0.15, 0.35]),
        ([0.5, 0, 0.25], [0.15, 0.15, 0.35]),
        ([0, 0, 0.72], [0.75, 0.2, 0.12]),
    ],
}
"""Centres and semi-axes, metres, of ellipsoids that make one rock."""


@pytest.mark.parametrize(("shape", "masked"), [*zip(PARTS, (1, 0, 0), strict=True)])
def test_no_part_of_a_rock_is_lost(tmp_path, shape, masked):
    rocks = [(np.array(c), np.array(a)) for c, a in PARTS[shape]]
    cameras = synthetic.orbit_cameras(12, 96, 72, 3.2, 1.0)
    views = synthetic.write_dataset(tmp_path, cameras, rocks)
    if not masked:
        views = replace(views, frames=[replace(f, mask_path=None) for f in views.frames])
    found = build_prior(views, PriorSettings(gaussians=800, backing=0))
    for centre, axes in rocks:
        surface = trimesh.creation.icosphere(3).vertices * axes + centre
        others = [(surface - c) / a for c, a in rocks if c is not centre]
        others = [np.linalg.norm(place, axis=1) > 1.1 for place in others]
        open_sides = surface[np.all(others, axis=0) & (surface[:, 2] > 0.05)]
        assert np.median(cKDTree(found.points).query(open_sides)[0]) < found.spacing


def test_parts_of_an_overhang_are_kept_together(orbit, built):
    """A cap, a base under it, and a stone beside them, of which no point joins them."""
    rng = np.random.default_rng(5)
    cap, base = (rng.uniform([-0.5, -0.5, z], [0.5, 0.5, z + 0.3], (3000, 3)) for z in (0.8, 0.1))
    stone = rng.uniform([2.0, 0, 0.1], [2.3, 0.3, 0.4], (1000, 3))
    points = np.concatenate([cap, base[:2000], stone])
    near = {"belongs": lambda part, rock: part[:, 0].max() < 1}
    inside, _, count = rock_cluster(points, 0.05, X, **near)
    assert count == 3
    assert inside[:5000].mean() > 0.99
    assert not inside[5000:].any()
    mesh, frames = built[0].mesh, orbit.frames
    half = mesh.faces[mesh.vertices[mesh.faces].mean(1)[:, 0] > synthetic.CENTRE[0]]
    assert outline_error(mesh, frames) < 0.02
    assert outline_error(Mesh(mesh.vertices, half, np.ones(len(half), bool)), frames) > 0.1


def test_the_largest_cluster_wins_and_a_low_rise_weighs_little():
    rng = np.random.default_rng(3)
    large, small = rng.uniform(0, 1, (3000, 3)), 3.0 * X + rng.uniform(0, 0.3, (300, 3))
    inside, eps, count = rock_cluster(np.concatenate([small, large]), 0.05, 3.0 * X)
    assert count == 2
    assert inside[300:].mean() > 0.99
    assert not inside[:300].any()
    assert 0.05 < eps < 0.5
    rise = rng.uniform([3, 0, 0.02], [5, 2, 0.05], (6000, 3))
    rock = rng.uniform([0, 0, 0.02], [0.6, 0.6, 0.5], (2500, 3))
    both = np.concatenate([rise, rock])
    inside, _, _ = rock_cluster(both, 0.05, np.zeros(3), weight=lambda points: points[:, 2])
    assert inside[6000:].mean() > 0.99
    assert not inside[:6000].any()


def test_a_wide_low_sheet_over_the_ground_is_closed():
    """Its Poisson surface alone leaves the cube at the open underside."""
    xy = np.random.default_rng(7).uniform(-1, 1, (2_000, 2))
    height = 0.02 + 0.04 * np.cos(np.pi / 2 * xy[:, 0]) * np.cos(np.pi / 2 * xy[:, 1])
    slope = -0.04 * np.pi / 2 * np.sin(np.pi / 2 * xy) * np.cos(np.pi / 2 * xy[:, ::-1])
    normals = np.column_stack([-slope, np.ones(len(xy))])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = np.column_stack([xy, height])
    mesh, _ = poisson_mesh(points, normals, 0.04, Plane(Z, 0.0, 0.001, 0.002), None)
    assert trimesh.Trimesh(mesh.vertices, mesh.faces).is_watertight
    inner = np.abs(xy).max(1) < 0.8
    assert distances_to_mesh(points[inner], mesh.vertices, mesh.faces).max() < 0.01


def test_of_two_equal_clusters_the_one_looked_at_wins_and_a_tie_is_an_error():
    blob = np.random.default_rng(4).uniform(-0.5, 0.5, (2000, 3))
    both = np.concatenate([blob - 2 * X, blob + 2 * X])
    inside, _, _ = rock_cluster(both, 0.05, np.array([1.5, 0.0, 0.0]))
    assert inside[2000:].all()
    assert not inside[:2000].any()
    fails("equally large and equally near", rock_cluster, both, 0.05, np.zeros(3))


@pytest.mark.parametrize("count", [2, 3, 137, 5000])
def test_samples_are_exactly_n_on_the_surface_and_blue(count):
    mesh = _ball()
    points, normals, spacing = sample_surface(mesh, 7, count=count)
    assert points.shape == normals.shape == (count, 3)
    assert spacing == pytest.approx(np.sqrt(mesh.areas.sum() / count))
    outward = (points - [0, 0, 0.5]) / 0.5
    assert np.abs(np.linalg.norm(outward, axis=1) - 1).max() < 5e-3
    assert np.einsum("nk,nk->n", normals, outward).min() > 0.99
    if count > 100:
        nearest = cKDTree(points).query(points, 2)[0][:, 1]
        # Uniform random points have mean 0.5 and least near 0.
        assert nearest.min() > 0.6 * spacing
        assert nearest.mean() > 0.75 * spacing


def test_spacing_sets_n_by_area_and_the_unseen_is_left_out():
    mesh = _ball()
    below = mesh.vertices[mesh.faces].mean(1)[:, 2] < 0.5
    half = Mesh(mesh.vertices, mesh.faces, ~below)
    points, _, spacing = sample_surface(half, 0, spacing=0.02)
    assert len(points) == round(mesh.areas[~below].sum() / 0.02**2)
    assert spacing == pytest.approx(0.02, rel=1e-3)
    assert points[:, 2].min() > 0.5 - 0.05
    a, b, c = (sample_surface(mesh, seed, count=200)[0] for seed in (1, 1, 2))
    assert np.array_equal(a, b)
    assert not np.array_equal(a, c)


def test_distances_to_mesh_are_exact():
    cube = trimesh.creation.box((2, 2, 2))
    points = np.array([[0, 0, 3.0], [2.0, 2.0, 0.0], [0.0, 0.0, 0.4]])
    for some in (slice(3), slice(1), slice(1, 2)):
        distances = distances_to_mesh(points[some], cube.vertices, cube.faces)
        assert np.allclose(distances, np.array([2, np.sqrt(2), 0.6])[some])


@pytest.mark.parametrize("across", [None, True, False])
def test_visible_is_the_near_side(across):
    cameras = synthetic.orbit_cameras(1, 320, 240)
    for _ in range(0 if across is None else 2):
        cameras = synthetic.halved(cameras, across)
    (camera,) = cameras
    depth, _, _ = synthetic.cast(camera, [(synthetic.CENTRE, synthetic.AXES)])
    mesh = synthetic.rock_mesh()
    points, normals = np.asarray(mesh.vertices), np.asarray(mesh.vertex_normals)
    facing = np.einsum("nk,nk->n", normals, camera.position - points)
    facing /= np.linalg.norm(camera.position - points, axis=1)
    above = points[:, 2] > 0.02
    for sides in (1, -1):
        seen = visible(points, sides * normals, camera, depth, 0.005, two_sided=sides < 0)
        assert seen[(facing > 0.25) & above].mean() > 0.999
        assert not seen[facing < (0 if sides > 0 else -0.3)].any()
        assert not seen[points[:, 2] < -0.1].any()


@pytest.mark.parametrize("far", [0.0, 1e6])
def test_depth_of_a_box_is_exact(far):
    """Against the slabs of the box, in float32 even 1,000 km from the origin."""
    size, middle = np.array([1.0, 0.7, 0.5]), np.array([far, -far, 0.3])
    box = trimesh.creation.box(size)
    K = np.array([[80.0, 0, 30.2], [0, 75.0, 25.9], [0, 0, 1]])
    camera = Camera(K, 64, 48, look_at(middle + np.array([1.7, 1.1, 0.9]), middle))
    found = mesh_depth(as_mesh(box, middle))(camera)
    rays = camera.unproject(np.ones((48, 64))) - camera.position
    slabs = np.stack([(side * size / 2 + middle - camera.position) / rays for side in (-1, 1)])
    near, away = slabs.min(0).max(-1), slabs.max(0).min(-1)
    grazing = np.abs(near - away) < 1e-5
    assert found.shape == (48, 64)
    assert 300 < (found > 0).sum() < 2000
    assert np.array_equal((found > 0)[~grazing], (near < away)[~grazing])
    both = (near < away) & (found > 0)
    assert np.allclose(found[both], near[both], rtol=2e-6, atol=0)


def test_depth_of_a_mesh_that_comes_within_a_micrometre_of_the_camera_plane():
    """The sheet x = z - 0.5 of the camera's frame, from z = 1e-6 to 4; a splat of its nearest point
    would fill any image."""
    camera = Camera(np.array([[800.0, 0, 320], [0, 800.0, 240], [0, 0, 1]]), 640, 480, np.eye(4))
    corners = np.array([[z - 0.5, y, z] for z in (1e-6, 4.0) for y in (-9.0, 9.0)])
    found = mesh_depth(Mesh(corners, np.array([[0, 1, 2], [2, 1, 3]]), np.ones(2, bool)))(camera)
    slope = (np.arange(640) + 0.5 - 320) / 800
    assert np.allclose(found, np.broadcast_to(0.5 / (1 - slope), (480, 640)), rtol=1e-5)


def test_prior_of_mixed_distances_is_as_fine_as_that_of_the_nearest(built, tmp_path):
    """Two in three cameras are two and three times as far away."""
    cameras = synthetic.orbit_cameras(12, 96, 72)
    for k, camera in enumerate(cameras):
        eye = synthetic.CENTRE + (1 + k % 3) * (camera.position - synthetic.CENTRE)
        cameras[k] = Camera(camera.K, 96, 72, look_at(eye, synthetic.CENTRE))
    dataset = synthetic.write_dataset(tmp_path, cameras)
    prior, rock = prior_and_cloud(dataset, PriorSettings(gaussians=1500, backing=0))
    voxel = built[1].cloud.voxel
    assert rock.cloud.voxel == pytest.approx(voxel, rel=0.1)
    truth = prior.numbers["truth"]
    assert truth["accuracy"] < 0.2 * voxel
    assert truth["completeness"] < 0.2 * voxel
    assert truth["visible_within_2_spacing"] == 1


def test_prior_is_near_the_truth(built):
    prior, rock = built
    numbers, voxel = prior.numbers, rock.cloud.voxel
    truth = numbers["truth"]
    assert numbers["n"] == len(prior.points) == 1500
    assert numbers["n"] == pytest.approx(numbers["sampled_area"] / prior.spacing**2)
    assert truth["accuracy"] < 0.1 * voxel
    assert truth["completeness"] < 0.1 * voxel
    assert truth["hausdorff"] < voxel
    assert truth["chamfer"] == pytest.approx((truth["accuracy"] + truth["completeness"]) / 2)
    assert truth["visible_within_2_spacing"] == 1
    assert truth["visible_share"] > 0.98
    assert trimesh.Trimesh(prior.mesh.vertices, prior.mesh.faces).is_watertight
    # All but the flat base is seen, and no less of the ellipsoid is sampled than stands above the
    # ground.
    height = rock.plane.height(prior.mesh.vertices[prior.mesh.faces[~prior.mesh.seen]].mean(1))
    assert np.abs(height).max() < 1e-6
    analytic = (prior.points - synthetic.CENTRE) / synthetic.AXES**2
    analytic /= np.linalg.norm(analytic, axis=1, keepdims=True)
    cosine = np.einsum("nk,nk->n", analytic, prior.normals)
    assert np.quantile(cosine, 0.01) > np.cos(np.radians(10))


def test_error_to_truth_sees_a_wrong_prior(built, orbit):
    prior, rock = built
    moved = Mesh(prior.mesh.vertices + 0.05 * Z, prior.mesh.faces, prior.mesh.seen)
    points, truth = prior.points + 0.05 * Z, orbit.root / "rock.glb"
    error = error_to_truth(points, prior.spacing, moved, truth, orbit, rock, 0)
    assert 0.02 < error["accuracy"] < 0.05
    assert error["hausdorff"] == pytest.approx(0.05, abs=0.02)


def test_prior_round_trip_and_determinism(built, orbit, tmp_path):
    prior = built[0]
    again = build_prior(orbit, PriorSettings(gaussians=1500, backing=0))
    assert np.array_equal(prior.points, again.points)
    assert prior.numbers == again.numbers
    loaded = load_prior(save_prior(tmp_path / "prior", prior))
    assert np.allclose(loaded.points, prior.points, atol=1e-6)
    assert np.allclose(loaded.normals, prior.normals, atol=1e-6)
    assert loaded.spacing == prior.spacing
    assert loaded.depth_tolerance == prior.depth_tolerance
    assert trimesh.load(tmp_path / "prior/mesh.ply").is_watertight


@pytest.mark.filterwarnings("error")
def test_refused_clouds_of_one_point_and_of_many_are_drawn(tmp_path, figures):
    points = np.random.default_rng(0).normal(size=(2_000_000, 3))
    draw_refused(tmp_path / "one.png", points[:300], np.arange(300) == 3)
    tracemalloc.start()
    draw_refused(tmp_path / "many.png", points, points[:, 2] > 0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 5e8


@pytest.mark.parametrize("seed", range(8))
def test_dbscan_gives_the_labels_of_scikit_learn(seed):
    from sklearn.cluster import DBSCAN

    rng = np.random.default_rng(seed)
    sizes = [(rng.uniform(-2, 2, 3), rng.uniform(0.05, 0.6), rng.integers(5, 400)) for _ in "abcd"]
    blobs = [rng.normal(middle, width, (count, 3)) for middle, width, count in sizes]
    points = rng.permutation(np.concatenate([*blobs, rng.uniform(-3, 3, (100, 3))]))
    eps, least = rng.uniform(0.1, 0.5), int(rng.integers(2, 12))
    usual = DBSCAN(eps=eps, min_samples=least).fit_predict(points)
    assert usual.max() >= 0
    assert np.array_equal(dbscan(points, eps, least), usual)
    assert (dbscan(points, 1e-9, 2) == -1).all()


@pytest.mark.parametrize("seed", range(3))
def test_a_cluster_grows_as_by_dbscan_in_little_memory(seed):
    rng = np.random.default_rng(seed)
    blobs = [rng.normal((x, 0, 0), 0.1, (1500, 3)) for x in (0, 0.7, 1.4, 2.1, 6.3)]
    points, inside = np.concatenate([*blobs, rng.uniform(-1, 7, (60, 3))]), np.arange(7560) < 3000
    tracemalloc.start()
    grown = _grown(points, inside)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    labels = dbscan(points, GROWN * np.ptp(points[inside], axis=0).max(), GROWN_NEIGHBOURS)
    assert len(set(labels[inside])) == 1
    assert np.array_equal(grown, labels == labels[0])
    assert grown.sum() > 1000 + inside.sum()
    assert peak < 3e6


def test_one_frame_with_depth_gives_what_it_saw(tmp_path):
    """Poisson closes its open far side, and only what the frame saw is sampled."""
    dataset = synthetic.write_dataset(tmp_path)
    dataset = replace(dataset, frames=dataset.frames[:1])
    (tmp_path / "rock.glb").unlink()
    prior = build_prior(dataset, PriorSettings(gaussians=200, backing=0))
    assert trimesh.Trimesh(prior.mesh.vertices, prior.mesh.faces).is_watertight
    away = dataset.frames[0].camera.position - prior.points
    facing = np.einsum("nk,nk->n", prior.normals, away) / np.linalg.norm(away, axis=1)
    assert facing.min() > -0.2  # a face counts as seen where one of its corners is
    assert np.quantile(np.abs(synthetic.level(prior.points)), 0.95) < 0.1


def test_error_grows_with_a_coarse_poisson(built, orbit):
    def error(**options) -> dict[str, float]:
        settings = PriorSettings(gaussians=1500, backing=0, **options)
        return build_prior(orbit, settings).numbers["truth"]

    exact = built[0].numbers["truth"]
    assert exact["chamfer"] < error(poisson_depth=4)["chamfer"]
