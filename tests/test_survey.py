"""The survey: sensor, odometry, registration, loop closure and pose graph, against the truth."""

from dataclasses import replace

import numpy as np
import pytest
import synthetic
from program import command, said
from scipy.spatial.transform import Rotation

from mgs import Camera, PriorSettings, build_prior, look_at
from mgs.data.dataset import TEST_FOLDER, Dataset, load_dataset, write_transforms
from mgs.data.frames import write_rock_image
from mgs.files import read_json, write_json
from mgs.images import write_png
from mgs.survey import depth_sensor
from mgs.survey.depth_sensor import AXIAL_GROWTH, QUANTUM, depth_noise, filter_depth, noisy_depth
from mgs.survey.flight import SurveySettings, fly, survey_numbers, trajectory_error, write_survey
from mgs.survey.fusion import fuse_frames
from mgs.survey.registration import Edge, chain, drifting_odometry, loop_candidates, optimise

CENTRES = [[0.1, -0.05, 0.2], [0.7, 0.5, 0.05], [-0.6, 0.6, 0], [-0.4, -0.8, 0.05], [1, -0.6, 0]]
AXES = [[0.6, 0.4, 0.5], [0.2, 0.3, 0.25], [0.3, 0.15, 0.3], [0.15, 0.25, 0.2], [0.25, 0.15, 0.35]]
ROCKS = list(zip(np.array(CENTRES), np.array(AXES), strict=True))
"""One smooth ellipsoid looks the same from everywhere; stones around it pin registration down."""


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    cameras = synthetic.orbit_cameras(24, 128, 96)
    return synthetic.write_dataset(tmp_path_factory.mktemp("orbit"), cameras, ROCKS)


@pytest.fixture(scope="module")
def survey(dataset: Dataset):
    return fly(dataset, SurveySettings(sensor=0.2, drift=1.0))


def _wall(z: float, tilt: float = 0.0) -> tuple[np.ndarray, Camera]:
    """Depth of a wall z metres away, turned by `tilt` radians, and its camera."""
    camera = Camera(np.array([[600.0, 0, 320], [0, 600.0, 240], [0, 0, 1]]), 640, 480, np.eye(4))
    x = (np.arange(640) + 0.5 - 320) / 600
    return np.broadcast_to(z / (1 - x * np.tan(tilt)), (480, 640)).copy(), camera


@pytest.mark.parametrize("z", [1.0, 2.0, 4.0])
def test_axial_noise_grows_as_published(z):
    depth, camera = _wall(z)
    measured = noisy_depth(depth, camera, np.random.default_rng(0))
    error = (measured - depth)[measured > 0]
    assert len(error) > 0.99 * (depth.size - 2 * (640 + 480))
    axial = depth_sensor.AXIAL_FLOOR + AXIAL_GROWTH * (z - depth_sensor.AXIAL_START) ** 2
    expected = np.hypot(axial, QUANTUM * z * z / np.sqrt(12))
    assert error.std() == pytest.approx(expected, rel=0.15)
    # A coarse step rounds z itself, so the mean may be off by a part of it, never by all.
    assert abs(error.mean()) < 0.5 * QUANTUM * z * z


def test_sensor_scale_and_missing_returns():
    depth, camera = _wall(3.0)
    depth[:100] = 0
    rng = np.random.default_rng(0)
    assert np.array_equal(noisy_depth(depth, camera, rng, 0.0), depth)
    full, half = (noisy_depth(depth, camera, np.random.default_rng(0), s) for s in (1.0, 0.5))
    assert not full[:100].any()
    inner = np.s_[110:-10, 10:-10]
    assert (half - depth)[inner].std() == pytest.approx(0.5 * (full - depth)[inner].std(), rel=0.2)
    depth, camera = _wall(2.0)
    levels = np.unique(noisy_depth(depth, camera, np.random.default_rng(0)))
    assert np.allclose(np.diff(levels[1:]), QUANTUM * 4, rtol=1e-6)


def test_grazing_returns_are_lost():
    for degrees, least, most in ((30, 0, 0.01), (75, 0.3, 0.7), (84, 0.85, 1)):
        depth, camera = _wall(2.0, np.radians(degrees))
        depth = np.where((depth > 0) & (depth < 5), depth, 0)
        noisy = noisy_depth(depth, camera, np.random.default_rng(0))
        assert least <= (noisy == 0)[200:280, 300:340].mean() <= most


def test_noise_is_measured_and_filtered_without_blurring_edges():
    depth, _ = _wall(2.0)
    depth[:, 320:] = 3.0
    noisy = depth + 0.02 * np.random.default_rng(0).standard_normal(depth.shape)
    assert depth_noise(noisy) == pytest.approx(0.02, rel=0.05)
    assert depth_noise(depth) < 1e-6
    smooth = filter_depth(noisy, 0.02)
    assert (smooth - depth).std() < 0.3 * 0.02
    assert np.abs(smooth - depth)[:, 318:322].max() < 0.06
    assert filter_depth(depth, 0.0) is depth
    noisy[100, 100] = 0
    assert filter_depth(noisy, 0.02)[100, 100] == 0


def _circle(count: int = 24, turns: float = 1.0) -> np.ndarray:
    angles = 2 * np.pi * turns * np.arange(count) / count
    eyes = np.stack([3 * np.cos(angles), 3 * np.sin(angles), np.full(count, 1.5)], 1)
    return np.stack([np.linalg.inv(look_at(eye, [0, 0, 0])) for eye in eyes])


def test_odometry_without_drift_is_exact_and_with_it_drifts():
    truth = _circle()
    exact = drifting_odometry(truth, 0.0, np.random.default_rng(0))
    assert np.allclose(chain(truth[0], exact), truth, atol=1e-12)
    drift = []
    for factor in (0.5, 1.0, 2.0):
        steps = drifting_odometry(truth, factor, np.random.default_rng(0))
        drift.append(trajectory_error(chain(truth[0], steps), truth)["ate_rms"])
    assert 0 < drift[0] < drift[1] < drift[2]


def test_loops_are_where_the_flight_returns():
    circle = _circle()
    assert (0, 23) in loop_candidates(circle)
    assert all(j - i >= 20 for i, j in loop_candidates(circle))
    assert loop_candidates(_circle(24, 0.5)) == []
    twice = loop_candidates(_circle(48, 2.0))
    assert (3, 27) in twice
    assert (0, 12) not in twice


def test_trajectory_error_of_known_displacements():
    truth = _circle()
    moved = truth.copy()
    moved[:, :3, 3] += [0.3, 0, 0.4]
    error = trajectory_error(moved, truth)
    assert error["ate_rms"] == pytest.approx(0.5)
    assert error["ate_max"] == pytest.approx(0.5)
    assert error["rotation_rms"] == pytest.approx(0, abs=1e-5)
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("z", 10, degrees=True).as_matrix()
    error = trajectory_error(turn @ truth, truth)
    assert error["rotation_rms"] == pytest.approx(10)
    assert error["ate_rms"] == pytest.approx(2 * 3 * np.sin(np.radians(5)))


def test_a_loop_closure_spreads_the_error_and_a_wrong_one_is_outvoted():
    truth = _circle()
    inverse = np.linalg.inv(truth)
    steps = inverse[:-1] @ truth[1:]
    for step, pose in zip(steps, truth[1:], strict=True):  # odometry with a bias of yaw
        step[:3, :3] @= Rotation.from_rotvec(np.radians(0.2) * pose[2, :3]).as_matrix()
    registered = chain(truth[0], steps)
    edges = [Edge(k, k + 1, step, 1.0) for k, step in enumerate(steps)]
    loop = Edge(0, 23, inverse[0] @ truth[23], 1.0)
    optimised = optimise(registered, steps, edges, [loop], 1.0, 0.03)
    assert np.allclose(optimised[0], truth[0], atol=1e-9)
    before, after = trajectory_error(registered, truth), trajectory_error(optimised, truth)
    assert after["ate_rms"] < 0.5 * before["ate_rms"]
    assert np.array_equal(optimise(registered, steps, edges, [], 1.0, 0.03), registered)
    loops = [Edge(i, j, inverse[i] @ truth[j], 1.0) for i in range(2) for j in (23, 22)]
    wrong = inverse[2] @ truth[23]
    wrong[:3, 3] += [0.5, 0, 0]
    optimised = optimise(registered, steps, edges, [*loops, Edge(2, 23, wrong, 1.0)], 1.0, 0.03)
    assert trajectory_error(optimised, truth)["ate_rms"] < before["ate_rms"]


def test_registration_and_loop_closure_beat_odometry(dataset, survey):
    settings = SurveySettings(sensor=0.2, drift=1.0)
    numbers = survey_numbers(dataset, survey, settings)
    error = {name: value["ate_rms"] for name, value in numbers["error"].items()}
    assert (0, 23) in [(loop.i, loop.j) for loop in survey.loops]
    assert error["optimised"] < 0.25 * error["odometry"]
    assert error["registered"] < 0.5 * error["odometry"]
    assert error["optimised"] < 0.03
    assert numbers["steps_by_odometry"] <= 3


def test_the_survey_repeats_by_seed(dataset, survey):
    again = fly(dataset, SurveySettings(sensor=0.2, drift=1.0))
    assert np.array_equal(again.optimised, survey.optimised)
    assert all(np.array_equal(a, b) for a, b in zip(again.depths, survey.depths, strict=True))
    few = Dataset(dataset.root, dataset.frames[:3])
    other = fly(few, SurveySettings(sensor=0.2, drift=1.0, seed=1))
    assert not np.array_equal(other.depths[0], survey.depths[0])


def test_a_featureless_orbit_falls_back_on_odometry(tmp_path):
    """Registration slides on a smooth ellipsoid, and must not make odometry worse."""
    flat = synthetic.write_dataset(tmp_path)
    survey = fly(flat, SurveySettings(sensor=0.0, drift=1.0))
    flown = survey.odometry, survey.optimised
    odometry, optimised = (trajectory_error(poses, survey.truth)["ate_rms"] for poses in flown)
    assert sum(not edge.registered for edge in survey.edges) > 0
    assert optimised < 1.5 * odometry


def test_the_survey_is_a_dataset_and_gives_a_prior(dataset, survey, tmp_path):
    result = write_survey(tmp_path, dataset, survey)
    assert [frame.name for frame in result.frames] == [frame.name for frame in dataset.frames]
    assert np.allclose(result.frames[5].camera.camera_to_world, survey.optimised[5], atol=1e-9)
    assert np.allclose(result.frames[5].depth(), survey.depths[5], atol=1e-6)
    assert np.array_equal(result.frames[5].rgb(), dataset.frames[5].rgb())
    for frame in result.frames:  # the masks of the dataset have all rocks, rock.glb the first
        write_png(frame.mask_path, synthetic.cast(frame.camera, ROCKS[:1])[1])
    prior = build_prior(result, PriorSettings(gaussians=1000, backing=0, poisson_depth=6))
    assert prior.numbers["truth"]["accuracy"] < 0.04


def test_files_of_one_name_in_different_folders_stay_apart(tmp_path):
    dataset = synthetic.write_dataset(tmp_path / "data")
    frames = []
    for frame in dataset.frames:
        mask, rock = (dataset.root / f"{frame.name}/{kind}.png" for kind in ("mask", "rock"))
        write_rock_image(rock, np.dstack([frame.masked_rgb(), frame.mask()]) / 2)
        frame.mask_path.rename(mask)
        frames.append(replace(frame, mask_path=mask, rock_path=rock))
    write_transforms(dataset.root, frames)
    synthetic.write_dataset(dataset.root / TEST_FOLDER)
    dataset = load_dataset(dataset.root)
    flight = fly(dataset, SurveySettings(exact_poses=True))
    assert np.array_equal(flight.optimised, flight.truth)
    assert not flight.loops
    assert not np.array_equal(flight.depths[0], dataset.frames[0].depth())
    result = write_survey(tmp_path / "survey", dataset, flight)
    tests, exact = result.test_views(), dataset.test_views()
    assert tests.root == tmp_path / "survey" / TEST_FOLDER
    for made, flown in ((result, dataset), (tests, exact)):
        for one, other in zip(made.frames, flown.frames, strict=True):
            poses = (frame.camera.world_to_camera for frame in (one, other))
            assert np.allclose(*poses, atol=1e-12)
            assert np.array_equal(one.mask(), other.mask())
            assert np.array_equal(one.rgb(), other.rgb())
            assert np.array_equal(one.target()[0], other.target()[0])


def test_command_writes_a_dataset_with_its_figure(tmp_path, capsys):
    cameras = synthetic.orbit_cameras(12, 64, 48)
    root = synthetic.write_dataset(tmp_path / "data", cameras, ROCKS).root
    write_json(root / "config.json", {"scene": {"sensor": {"noise": 5.0, "drift": 0.5}}})
    command("survey", root, "--sensor-noise", "0.2")
    out = root / "survey"
    settings = read_json(out / "survey.json")["settings"]
    # An option goes before the scene, the scene before 1.
    assert (settings["sensor"], settings["drift"]) == (0.2, 0.5)
    files = {"transforms.json", "cloud.ply", "survey.json", "survey.png", "depth"}
    assert {path.name for path in out.iterdir()} >= files
    assert len(load_dataset(out)) == 12
    assert "after loop closure" in said(capsys)[0]


def test_duplicate_frames_are_no_trouble(tmp_path):
    dataset = synthetic.write_dataset(tmp_path, synthetic.orbit_cameras(12, 96, 72), ROCKS)
    again = replace(dataset.frames[1], name="again", timestamp=0.7)
    twice = (*dataset.frames[:2], again, *dataset.frames[2:])
    survey = fly(Dataset(tmp_path, twice), SurveySettings(sensor=0.0))
    assert np.isfinite(survey.optimised).all()
    assert np.linalg.norm(survey.optimised[1, :3, 3] - survey.optimised[2, :3, 3]) < 0.02


def test_a_cloud_of_uneven_pixels_is_as_fine_as_their_area(tmp_path):
    cameras, voxels = synthetic.orbit_cameras(6, 48, 36), []
    for across in (True, False):
        frames = synthetic.write_dataset(tmp_path / f"{across}", synthetic.halved(cameras, across))
        voxels.append(fuse_frames(frames.frames).voxel)
    assert voxels[0] == pytest.approx(voxels[1], rel=0.05)
