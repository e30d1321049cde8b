"""On-demand datasets: a frame is rendered when a run takes it; the run is otherwise the same."""

import importlib.util
import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from program import command, exit_code, steps, stop_at, table_numbers
from refusals import fails, listing, refused

from mgs import PriorSettings, build_prior, prior_from_mesh, save_prior
from mgs.data.check import check_dataset
from mgs.data.dataset import FILES, load_dataset
from mgs.progress import listening
from mgs.reports.tables import table_columns
from mgs.run.inputs import prior_digest
from mgs.synth import rendering
from mgs.synth.capture import capture_of
from mgs.synth.rendering import PoseNoise, RenderPreset, synth_orbit
from mgs.synth.scene_file import Arena, Rock, SceneFile
from mgs.view.layers import read_subject

TINY = RenderPreset(width=48, height=36, frames=8, spp=2)
SCENE = SceneFile(rock=Rock(detail=0.06), arena=Arena(stones=0))
RUN = ["--seeds", "3", "--budget", "2", "--set", "train.passes=1", "--set", "evaluate_every=1"]
RUN += ["--seed", "1"]
pytestmark = pytest.mark.usefixtures("coarse_arena", "coarse_priors")


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return tmp_path_factory.mktemp("capture")


@pytest.fixture(scope="module")
def full(root):
    return synth_orbit(root / "full", SCENE, TINY, seed=3, test_views=2)


@pytest.fixture(scope="module")
def poses(root):
    """The same on demand, by the command; none of its frames is ever taken."""
    (root / "mine.toml").write_text("[rock]\ndetail = 0.06\n[arena]\nstones = 0\n")
    given = ["--scene", root / "mine.toml", "--frames", 8, "--size", "48x36", "--spp", 2]
    command("synth-orbit", root / "poses", "--on-demand", *given, "--seed", 3, "--test-views", 2)
    return load_dataset(root / "poses")


@pytest.fixture(scope="module")
def prior(root, full):
    mesh, settings = full.root / "rock.glb", PriorSettings(gaussians=300)
    return save_prior(root / "prior", prior_from_mesh(mesh, settings))


@pytest.fixture(scope="module")
def captured(poses, prior, root):
    shutil.copytree(poses.root, root / "captured-poses")
    command("nbv", root / "captured-poses", "--prior", prior, "--out", root / "captured", *RUN)
    return root / "captured"


@pytest.fixture
def fresh(poses, tmp_path):
    """A copy of the poses, for this test alone."""
    return load_dataset(shutil.copytree(poses.root, tmp_path / "poses"))


def files(frame) -> list[Path]:
    return [getattr(frame, field) for field in FILES]


def there(dataset) -> list[str]:
    """Names of the frames of which some file exists."""
    return [frame.name for frame in dataset.frames if any(path.exists() for path in files(frame))]


def taken(run: Path) -> list[str]:
    seeds, *chosen = steps(run)
    return [*seeds["seed_names"], *(step["name"] for step in chosen)]


def same_files(frame, other) -> bool:
    pairs = zip(files(frame), files(other), strict=True)
    return all(path.read_bytes() == expected.read_bytes() for path, expected in pairs)


def test_only_test_views_are_rendered_in_advance(full, poses):
    assert there(poses) == []
    assert [frame.name for frame in poses.frames] == [frame.name for frame in full.frames]
    for ours, theirs in zip(poses.test_views().frames, full.test_views().frames, strict=True):
        assert same_files(ours, theirs)
    paths = [path.relative_to(poses.root) for path in poses.root.rglob("*") if path.is_file()]
    written = {"transforms.json", "config.json", "contact_sheet.png", "rock.glb"}
    written |= {"survey", "test"}
    assert {path.parts[0] for path in paths} == written


def test_an_interrupted_dataset_goes_on_only_as_on_demand(poses, tmp_path):
    given, out = (SCENE, TINY), tmp_path / "again"
    with pytest.raises(KeyboardInterrupt), listening(stop_at()):
        synth_orbit(out, *given, seed=3, test_views=2, on_demand=True)
    fails("unfinished dataset of other settings", synth_orbit, out, *given, seed=3, test_views=2)
    synth_orbit(out, *given, seed=3, test_views=2, on_demand=True)
    assert listing(out) == listing(poses.root)


def test_a_frame_rendered_alone_is_that_of_the_whole_orbit(full, fresh, monkeypatch):
    """Bit for bit, in any order; a frame that exists is not written again. The disk need not have
    room for all."""
    third = shutil.disk_usage(fresh.root).free // 10_000  # of the free bytes, for a frame's pixels
    monkeypatch.setattr("mgs.synth.rendering.PIXEL_BYTES", third)
    capture = capture_of(fresh)
    capture(fresh.frames[5])
    before = [path.stat().st_mtime_ns for path in files(fresh.frames[5])]
    for index in (5, 1):
        capture(fresh.frames[index])
    assert [path.stat().st_mtime_ns for path in files(fresh.frames[5])] == before
    assert there(fresh) == [fresh.frames[1].name, fresh.frames[5].name]
    for index in (1, 5):
        assert same_files(fresh.frames[index], full.frames[index])


def test_a_mesh_with_noisy_poses_is_captured_from_the_true_ones(full, tmp_path):
    mesh, noise = shutil.copy(full.root / "rock.glb", tmp_path), PoseNoise(0.01, 0.2)
    given = {"scene": SCENE, "preset": RenderPreset(32, 24, 4, 2), "mesh": mesh}
    given |= {"pose_noise": noise}
    whole = synth_orbit(tmp_path / "full", **given)
    poses = synth_orbit(tmp_path / "poses", **given, on_demand=True)
    capture = capture_of(poses)
    capture(poses.frames[2])
    assert same_files(poses.frames[2], whole.frames[2])
    ours, theirs = ((dataset.root / "true_poses.json").read_bytes() for dataset in (poses, whole))
    assert ours == theirs
    (tmp_path / "rock.glb").write_bytes(b"another")
    fails(r"rock\.glb: has changed since .*poses", capture_of(poses), poses.frames[3])
    (tmp_path / "rock.glb").unlink()
    fails(r"rock\.glb: no such mesh", capture_of(poses), poses.frames[3])


def test_the_survey_gives_the_prior_of_the_whole_dataset(full, poses):
    survey = poses.survey()
    for ours, theirs in zip(survey.frames, full.frames, strict=True):
        assert not ours.image_path.exists()
        assert ours.depth_path.read_bytes() == theirs.depth_path.read_bytes()
        assert ours.mask_path.read_bytes() == theirs.mask_path.read_bytes()
    settings = PriorSettings(gaussians=300)
    ours, theirs = (build_prior(dataset, settings) for dataset in (survey, full))
    assert prior_digest(ours) == prior_digest(theirs)
    assert ours.numbers == theirs.numbers
    assert full.survey() is full


def test_the_run_is_that_on_the_whole_dataset(full, prior, captured, tmp_path):
    whole = tmp_path / "whole"
    command("nbv", full.root, "--prior", prior, "--out", whole, *RUN)
    assert taken(captured) == taken(whole)
    assert (captured / "gaussians.ply").read_bytes() == (whole / "gaussians.ply").read_bytes()
    differ = {"seconds", "psnr", "psnr_mask", "held_out_psnr", "held_out_psnr_mask"}
    for ours, theirs in zip(steps(captured), steps(whole), strict=True):
        assert not any(key.startswith("held_out") for key in ours)
        assert "test_psnr" in ours
        assert differ >= ours.keys() ^ theirs.keys()
        assert all(ours[key] == theirs[key] for key in ours.keys() - differ)


def test_a_frame_that_was_never_chosen_has_no_image(captured):
    dataset = load_dataset(captured.parent / "captured-poses")
    assert sorted(there(dataset)) == sorted(taken(captured))
    never = next(frame for frame in dataset.frames if frame.name not in taken(captured))
    message = rf"does not exist, since no run has taken frame {never.name} .* `mgs nbv`"
    for read in (never.rgb, never.mask, never.depth, never.target):
        fails(message, read)


def test_interrupted_while_it_captures_and_resumed(captured, prior, fresh, tmp_path, monkeypatch):
    """Before the second PNG file of the first chosen view, which is the eighth."""
    out, write, struck = tmp_path / "run", rendering.write_png, stop_at(8)
    with monkeypatch.context() as patched:
        patched.setattr(rendering, "write_png", lambda *image: (struck(), write(*image)))
        assert exit_code("nbv", fresh.root, "--prior", prior, "--out", out, *RUN) == 130
    finished = [frame for frame in fresh.frames if rendering.is_done(frame)]
    done = {path: path.stat().st_mtime_ns for frame in finished for path in files(frame)}
    assert len(done) == 4 * 3
    command("nbv", "--resume", out)
    assert taken(out) == taken(captured)
    assert (out / "gaussians.ply").read_bytes() == (captured / "gaussians.ply").read_bytes()
    assert {path: path.stat().st_mtime_ns for path in done} == done, "rendered again"
    assert sorted(there(fresh)) == sorted(taken(captured))


def test_every_command_that_reads_a_run_reads_this_one(captured, tmp_path, capsys):
    """Without the images of frames that were never taken, and without making them."""
    dataset = load_dataset(captured.parent / "captured-poses")
    before, never = there(dataset), {frame.name for frame in dataset.frames} - set(taken(captured))
    metrics = json.loads((captured / "metrics.json").read_text())
    assert [metrics[name]["count"] for name in ("test", "all", "held_out")] == [2, 5, 0]
    columns = table_columns(table_numbers([captured]))
    assert "test.psnr" in columns
    assert not any(key.startswith("held_out") for key in columns)
    command("eval", captured)
    assert "held out" not in capsys.readouterr().out
    assert {path.stem for path in (captured / "renders").glob("*.png")} == set(taken(captured))
    (pose, *_) = never
    command("diagnose", captured, "--views", pose)  # maps of a pose need no image
    assert (captured / f"diagnostics/{pose}.png").is_file()
    page_path = tmp_path / "page.html"
    command("report", captured, "--out", tmp_path / "report", "--html", page_path)
    command("simplify", captured)
    command("simplify", captured, "--method", "refit")
    assert there(dataset) == before
    for checked in (dataset, dataset.survey()):
        assert not any("no run has taken" in line for line in check_dataset(checked).problems)
    page = page_path.read_text()
    assert all(f'"truth/{name}"' in page for name in (*taken(captured), "test/tv_0000"))
    assert not any(f'"truth/{name}"' in page for name in never)
    roles = {view.frame.name: view.role for view in read_subject(captured).views}
    assert {name for name, role in roles.items() if role == "candidate"} == never


def test_a_run_builds_its_prior_from_the_survey(fresh, tmp_path, capsys):
    run = tmp_path / "run"
    command("nbv", fresh.root, "--out", run, "--gaussians", 300, *RUN, "--budget", 1)
    assert sorted(there(fresh)) == sorted(taken(run))
    assert json.loads((run / "prior/prior.json").read_text())["from"] == "depth"
    assert "held" not in capsys.readouterr().out


def test_a_survey_with_noise_of_an_on_demand_dataset(poses, tmp_path):
    """`mgs survey` of the survey, and a prior of that; neither has images."""
    command("survey", poses.root / "survey", "--out", tmp_path / "survey", "--poses", "exact")
    command("prior", tmp_path / "survey", "--out", tmp_path / "prior", "--gaussians", 300)
    assert (tmp_path / "prior/prior.json").is_file()
    assert there(load_dataset(tmp_path / "survey"))
    assert not (tmp_path / "survey/images").exists()


def test_commands_say_which_image_an_on_demand_dataset_lacks(fresh, tmp_path, capsys):
    line = refused(capsys, ["prior", fresh.root, "--gaussians", 300], fresh.root)
    assert "no run has taken frame kf_0000" in line
    shutil.rmtree(fresh.root / "survey")
    out = tmp_path / "run"
    line = refused(capsys, ["nbv", fresh.root, "--out", out, *RUN], fresh.root)
    assert "give one with `prior`" in line
    assert not out.exists()


def test_a_frame_that_cannot_be_rendered_is_refused(fresh):
    first = fresh.frames[0]
    pose = first.camera.world_to_camera.copy()
    pose[0, 3] += 1e-3
    moved = replace(first.camera, world_to_camera=pose)
    for frame in (replace(first, name="kf_9"), replace(first, camera=moved)):
        fails(f"{frame.name} is not one of the scene's orbit", capture_of(fresh), frame)
    (fresh.root / "config.json").write_text("{}")
    fails("is not of `mgs synth-orbit --on-demand`", capture_of(fresh), first)
    (fresh.root / "config.json").unlink()
    fails(r"config\.json: no such file", capture_of(fresh), first)


def test_the_denoiser_that_other_images_have_must_be_there(fresh, monkeypatch):
    config = json.loads((fresh.root / "config.json").read_text())
    (fresh.root / "config.json").write_text(json.dumps(config | {"denoise": True}))
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    fails("denoised by pyoidn, which is not installed", capture_of(fresh), fresh.frames[0])
