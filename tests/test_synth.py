"""The synthetic dataset: what is on disk agrees with the true rock, to the pixel."""

from types import SimpleNamespace
from typing import get_args

import numpy as np
import pytest
import trimesh
from program import stop_at
from refusals import fails

from mgs.camera import opencv_from_opengl
from mgs.colour import srgb_from_linear
from mgs.data.check import check_dataset
from mgs.data.meshes import distances_to_mesh, read_mesh
from mgs.errors import InputError
from mgs.files import locked, read_json
from mgs.progress import listening
from mgs.resources import resource_folder
from mgs.seeds import generator
from mgs.synth.orbit import evaluation_cameras, rock_cameras
from mgs.synth.rendering import ROCK_EXPOSURE, PoseNoise, RenderPreset, _meter, synth_orbit
from mgs.synth.rock import LATTICE, make_rock
from mgs.synth.scene_file import Arena, Orbit, OrbitKind, Rock, SceneFile, load_scene_file

TINY = RenderPreset(width=64, height=48, frames=5, spp=2)
ONE = RenderPreset(width=32, height=24, frames=1, spp=1)
SCENE = SceneFile(rock=Rock(detail=0.06), arena=Arena(stones=20))


pytestmark = pytest.mark.usefixtures("coarse_arena")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return synth_orbit(tmp_path_factory.mktemp("synth") / "tiny", SCENE, TINY, seed=3)


def test_depth_inside_the_mask_lies_on_the_rock(dataset):
    """Proves camera convention, z-depth (not ray distance) and mask at once, over all azimuths."""
    rock = read_mesh(dataset.root / "rock.glb")
    for frame in dataset.frames:
        points = frame.camera.unproject(frame.depth())[frame.mask()]
        assert len(points) > 200
        assert distances_to_mesh(points, rock.vertices, rock.faces).max() < 1e-4
        rows, columns = np.where(frame.mask())
        assert 0.35 < np.ptp(rows) / frame.camera.height < 0.75
        assert min(rows.min(), columns.min(), frame.camera.width - 1 - columns.max()) > 0


def test_the_rock_alone_agrees_with_image_and_mask(dataset):
    """It is the image inside, empty outside, and partly covered at the rim."""
    for frame in dataset.frames:
        rgba, weight = frame.target()
        alpha, mask = rgba[..., 3], frame.mask()
        assert weight.all()
        assert (alpha[mask] > 0).all()
        assert (alpha[~mask] < 1).all()
        assert 40 < ((alpha > 0) & (alpha < 1)).sum() < 400
        inside = (srgb_from_linear(values[alpha == 1]) for values in (rgba[..., :3], frame.rgb()))
        np.testing.assert_allclose(*inside, atol=1.01 / 255)  # powers differ in the last bit
        assert not rgba[alpha == 0].any()
        np.testing.assert_array_equal(frame.masked_rgb(), rgba[..., :3])


def test_same_seed_same_bytes_and_resume_and_pose_noise_and_test_views(dataset, tmp_path):
    """A completed run has the files of one run; pose noise changes poses and no pixel; test views
    are a dataset of their own, with exact poses."""
    out, made = tmp_path / "again", {"scene": SCENE, "preset": TINY, "seed": 3, "test_views": 4}
    made |= {"pose_noise": PoseNoise(0.01, 0.1)}
    for call, unwritten in ((3, "transforms.json"), (8, "test/transforms.json")):
        with pytest.raises(KeyboardInterrupt), listening(stop_at(call)):
            synth_orbit(out, **made)
        assert not (out / unwritten).exists()
    written = {path: path.stat().st_mtime_ns for path in out.rglob("*_0*.*")}
    assert len(written) == 4 * 7
    left = out / "images/.kf_0003.1073741824-01234567.part.png"
    left.touch()
    with locked(out), pytest.raises(InputError, match="works on it"):
        synth_orbit(out, **made)
    assert left.exists()  # of that process, still at work
    fails("other settings", synth_orbit, out, **made | {"test_views": 5})
    again = synth_orbit(out, **made)
    assert {path: path.stat().st_mtime_ns for path in written} == written
    assert not list(out.rglob(".*"))
    truth = read_json(out / "true_poses.json")["poses"]
    for a, b in zip(dataset.frames, again.frames, strict=True):
        for path in ("image_path", "mask_path", "rock_path", "depth_path"):
            assert getattr(a, path).read_bytes() == getattr(b, path).read_bytes()
        assert 0 < np.linalg.norm(a.camera.position - b.camera.position) < 0.06
        exact = opencv_from_opengl(truth[b.name])
        np.testing.assert_allclose(exact, a.camera.world_to_camera, atol=1e-12)
    assert (dataset.root / "rock.glb").read_bytes() == (out / "rock.glb").read_bytes()

    tests = again.test_views()
    assert dataset.test_views() is None
    assert not [problem for problem in check_dataset(tests).problems if "tv_" in problem]
    rock = make_rock(SCENE.rock, generator(3, "rock"))
    cameras = evaluation_cameras(SCENE, (64, 48), 4, rock)
    for frame, camera in zip(tests.frames, cameras, strict=True):
        poses = frame.camera.world_to_camera, camera.world_to_camera
        np.testing.assert_allclose(*poses, atol=1e-12)


def test_the_dome_of_test_views_has_the_orbits_radius_and_shows_the_whole_rock():
    settings = SceneFile(orbit=Orbit(kind="circle", radius=5, altitude=1))
    rock = make_rock(SCENE.rock, generator(0, "rock"))
    cameras = evaluation_cameras(settings, (640, 480), 60, rock)
    out = np.array([camera.position for camera in cameras]) - [0, 0, rock.bounds[1, 2] / 2]
    np.testing.assert_allclose(np.linalg.norm(out, axis=1), 5)
    elevation = np.sort(np.degrees(np.arcsin(out[:, 2] / 5)))
    assert 5 < elevation[0] < 6
    assert 70 < elevation[-1] < 75
    assert evaluation_cameras(settings, (64, 48), 0, rock) == []
    near = SCENE.model_copy(update={"orbit": Orbit(kind="circle", radius=1.8, altitude=6)})
    assert len(rock_cameras(near, (64, 48), 5, rock)) == 5
    fails("not wholly in test view", evaluation_cameras, near, (64, 48), 10, rock)


def test_another_mesh_of_the_same_name_is_not_gone_on_with(tmp_path):
    path = tmp_path / "rock.ply"
    made = {"scene": SCENE, "preset": ONE, "mesh": path}
    trimesh.creation.icosphere(subdivisions=2).export(path)
    with pytest.raises(KeyboardInterrupt), listening(stop_at(2)):
        synth_orbit(tmp_path / "out", **made)
    trimesh.creation.icosphere(subdivisions=3).export(path)
    fails("other settings", synth_orbit, tmp_path / "out", **made)
    trimesh.creation.icosphere(subdivisions=2).export(path)
    fails("other settings", synth_orbit, tmp_path / "out", **made, mesh_up="y")
    assert len(synth_orbit(tmp_path / "out", **made)) == 1


def test_the_rock_of_a_dataset_given_back_as_mesh_is_the_same_scene(dataset, tmp_path):
    notes = []
    mesh = dataset.root / "rock.glb"
    again = synth_orbit(tmp_path / "again", SCENE, TINY, 3, mesh, say=notes.append)
    assert "rock.glb: +Y is up (`mesh_up` tells); scaled 1 times" in notes[0]
    for a, b in zip(dataset.frames, again.frames, strict=True):
        assert (a.mask() != b.mask()).mean() < 1e-3
        both = a.mask() & b.mask()
        np.testing.assert_allclose(a.depth()[both], b.depth()[both], atol=1e-3)


def test_a_dark_rock_does_not_blow_out_the_ground(tmp_path):
    black, notes = (0.01, 0.01, 0.01), []
    scene = SCENE.model_copy(update={"rock": Rock(detail=0.06, colours=(black, black), dust=black)})
    dataset = synth_orbit(tmp_path / "dark", scene, TINY, seed=3, say=notes.append)
    clipped = [(frame.rgb().max(-1) >= 1)[frame.depth() > 0].mean() for frame in dataset.frames]
    assert 0.05 < np.mean(clipped) < 0.25
    assert "lower than so dark a rock needs, so that about 20% of rock and ground clips" in notes[0]
    assert len(notes) == 1


def test_the_exposure_of_other_rocks_is_that_of_the_rock_alone(tmp_path):
    notes = []
    small = RenderPreset(width=64, height=48, frames=4, spp=2)
    usual = synth_orbit(tmp_path / "usual", SCENE, small, seed=3, say=notes.append)
    assert notes == []
    means = [frame.rgb()[frame.mask()].mean() for frame in usual.frames]
    assert np.mean(means) == pytest.approx(ROCK_EXPOSURE, rel=0.05)


def test_rock_that_does_not_fit_the_frame(tmp_path):
    near = SCENE.model_copy(update={"orbit": Orbit(radius=1.5, altitude=1.5)})
    fails("not wholly in frame 0", synth_orbit, tmp_path / "near", near, TINY)
    assert not (tmp_path / "near").exists()


def test_without_the_denoiser_more_samples_and_a_note(tmp_path, monkeypatch):
    monkeypatch.setattr("mgs.synth.rendering.importlib.util.find_spec", lambda name: None)
    notes = []
    dataset = synth_orbit(tmp_path / "plain", SCENE, ONE, say=notes.append)
    assert '`pip install "mgs[denoise]"`' in notes[0]
    assert read_json(dataset.root / "config.json")["samples_per_pixel"] == 8
    assert dataset.frames[0].rgb()[dataset.frames[0].mask()].mean() == pytest.approx(0.2, rel=0.5)


@pytest.mark.parametrize(
    "scene", sorted(path.stem for path in resource_folder("scenes").glob("*.toml"))
)
def test_every_scene_frames_its_rock_on_every_orbit(scene, monkeypatch):
    monkeypatch.setattr("mgs.synth.rock.LATTICE", LATTICE)
    settings = load_scene_file(scene)
    seed = 11 if scene == "horseshoe" else 0  # rocks of some seeds do not fit; studies use 11
    rock = make_rock(settings.rock.model_copy(update={"detail": 0.06}), generator(seed, "rock"))
    above = rock.vertices[rock.vertices[:, 2] > 0]
    for kind in get_args(OrbitKind):
        orbit = settings.orbit.model_copy(update={"kind": kind})
        flown = settings.model_copy(update={"orbit": orbit})
        cameras = rock_cameras(flown, (640, 480), 36, rock)
        evaluation_cameras(flown, (640, 480), 60, rock)  # refuses a view without the whole rock
        heights = [np.ptp(camera.project(above)[0][:, 1]) / 480 for camera in cameras]
        assert 0.35 < np.mean(heights) < 0.75


def test_a_rock_that_renders_as_nan_is_refused():
    rgb, mask = np.full((2, 2, 3), np.nan, np.float32), np.ones((2, 2), bool)
    scene = SimpleNamespace(light=lambda *_: (rgb, rgb, rgb), cast=lambda _: (mask, mask))
    fails("NaN or infinite in frame 0", _meter, scene, [None] * 4, 0, 1, False, print)
