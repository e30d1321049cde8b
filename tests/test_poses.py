"""Refinement of poses: its Jacobian, poses found again, and `mgs fit --refine-poses`."""

from dataclasses import replace

import numpy as np
import pytest
import synthetic
from program import command, said
from splat import reference
from splat.scenes import calm, make_camera, make_clamped, relative_error

from mgs import read_ply
from mgs.data.clouds import SparseCloud, read_cloud, write_cloud
from mgs.data.dataset import load_dataset, write_transforms
from mgs.data.structure import write_refined
from mgs.fit import poses
from mgs.fit.objective import objective
from mgs.run.folder import open_run
from mgs.splat import as_drjit, render

EYES = [(2.0, 0.4, 1.1), (-0.5, 2.1, 0.9), (-1.8, -1.1, 1.0), (0.6, -2.0, 1.3)]


def drawn(model, camera):
    return np.asarray(render(model, camera).rgb)


def test_the_jacobian_is_that_of_the_reference():
    camera = make_camera()
    model = calm(lambda seed: make_clamped(seed, n=10), camera, 30, least=3e-4)
    target = np.random.default_rng(0).random((camera.height, camera.width, 3), np.float32)
    goal = objective(model, [camera], [target])
    residual, J = poses.residual_and_jacobian(goal, as_drjit(model), goal.photos[0])
    assert residual == pytest.approx((drawn(model, camera) - target).ravel(), abs=1e-5)
    for row, step in zip(J, 2e-7 * np.eye(6), strict=True):
        moved = [poses.displaced(camera, way) for way in (step, -step)]
        ends = [reference.render(model, there)["rgb"] for there in moved]
        assert relative_error(row, (ends[0] - ends[1]) / 4e-7) < 1e-4


def test_poses_are_found_again_under_the_true_model():
    true = [make_camera(eye=eye) for eye in EYES]
    model = calm(lambda seed: make_clamped(seed, n=10), true[0], 30)
    rng, std = np.random.default_rng(1), np.array([4e-3] * 3 + [8e-3] * 3)
    given = [poses.displaced(camera, rng.normal(0, std)) for camera in true]
    targets = [drawn(model, camera) for camera in true]
    lam = np.tile((1e-3 / std) ** 2, (len(given), 1))
    cameras = given
    for _ in range(4):
        goal = objective(model, cameras, targets)
        cameras = poses.pose_steps(goal, as_drjit(model), given, lam)
    for camera, start, exact, target in zip(cameras, given, true, targets, strict=True):
        before, after = (np.abs(drawn(model, one) - target).mean() for one in (start, camera))
        assert after < 0.02 * before
        assert np.abs(poses.motion_between(exact, camera)).max() < 1e-4
    goal = objective(model, given, targets)
    held = poses.pose_steps(goal, as_drjit(model), given, np.full_like(lam, 1e12))
    for camera, start in zip(held, given, strict=True):
        assert np.abs(poses.motion_between(start, camera)).max() < 1e-6


def write_noisy(root, cameras):
    """A dataset whose poses are wrong by about half a degree."""
    data = synthetic.write_dataset(root, cameras)
    rng, std = np.random.default_rng(0), [0.008] * 3 + [0.002] * 3
    noisy = [poses.displaced(camera, rng.normal(0, std)) for camera in data.cameras]
    pairs = zip(data.frames, noisy, strict=True)
    write_transforms(root, [replace(frame, camera=camera) for frame, camera in pairs])
    return data


def test_the_command_refines_the_poses_of_a_run(tmp_path, coarse_priors, capsys):
    cameras = synthetic.orbit_cameras(8, 48, 36)
    data = write_noisy(tmp_path / "data", cameras)
    fit = ["fit", data.root, "--gaussians", 400]
    command(*fit, "--out", tmp_path / "as-given")
    capsys.readouterr()
    command(*fit, "--refine-poses", "--set", "pose_noise.degrees=0.5", "--out", tmp_path / "run")
    run, given = open_run(tmp_path / "run"), open_run(tmp_path / "as-given")
    assert "poses moved" in said(capsys)[0]
    metrics = run.metrics
    assert set(metrics["poses_moved"]) == {frame.name for frame in data.frames}
    assert 0.1 < np.mean([move["degrees"] for move in metrics["poses_moved"].values()]) < 2
    assert metrics["all"]["psnr_mask"] > given.metrics["all"]["psnr_mask"] + 1

    def pixels_off(dataset):
        sides = dataset.cameras, cameras
        ends = [[camera.project(run.prior.points)[0] for camera in side] for side in sides]
        return np.linalg.norm(np.subtract(*ends), axis=-1).mean()

    assert pixels_off(run.dataset) < 0.5 * pixels_off(given.dataset)
    command("export", tmp_path / "run", "--to", "nerfstudio", "--out", tmp_path / "views")
    views = load_dataset(tmp_path / "views").cameras
    for one, other in zip(views, run.dataset.cameras, strict=True):
        assert np.allclose(one.world_to_camera, other.world_to_camera)


def test_a_refinement_with_free_means_is_bitwise_the_same_again(tmp_path, coarse_priors):
    write_noisy(tmp_path / "data", synthetic.orbit_cameras(5, 32, 24))
    fit = ["fit", tmp_path / "data", "--gaussians", 100, "--passes", 2, "--means", "free"]
    fit += ["--refine-poses", "--set", "train.density=split"]
    files = "gaussians.ply", "poses.json", "dataset/transforms.json"
    found = []
    for out in (tmp_path / "once", tmp_path / "again"):
        command(*fit, "--out", out)
        found.append([(out / file).read_bytes() for file in files if (out / file).exists()])
    assert len(found[0]) > 1
    assert found[0] == found[1]
    assert len(read_ply(tmp_path / "once/gaussians.ply")) > 100


def test_refined_poses_keep_the_points(tmp_path):
    data = synthetic.orbit(tmp_path / "data", 8, 32, 24)
    write_cloud(data.root / "sparse.ply", SparseCloud(np.eye(3)))
    write_refined(tmp_path / "run", data, data.frames)
    assert np.array_equal(read_cloud(tmp_path / "run/sparse.ply").points, np.eye(3))
