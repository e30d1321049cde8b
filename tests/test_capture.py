"""On-demand datasets: images that exist only once a run has taken them, and runs that are otherwise
like any other."""

from __future__ import annotations

import importlib.util
import json
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from refusals import listing, occupied, refused

from mgs.cli.app import main
from mgs.data.check import check_dataset
from mgs.data.dataset import FILES, load_dataset
from mgs.errors import InputError
from mgs.prior.build import build_prior, prior_from_mesh, save_prior
from mgs.prior.settings import PriorSettings
from mgs.report.evaluation import read_comparison
from mgs.report.tables import table_columns, table_numbers
from mgs.run import nbv
from mgs.run.inputs import prior_digest
from mgs.synth import arena, rendering
from mgs.synth.capture import capture_of
from mgs.synth.rendering import PoseNoise, RenderPreset, synthesise
from mgs.synth.scene_file import Arena, Rock, SceneFile
from mgs.view.subject import read_subject

TINY = RenderPreset(width=64, height=48, frames=8, spp=2)
SCENE = SceneFile(rock=Rock(detail=0.06), arena=Arena(stones=20))
TOML = "[rock]\ndetail = 0.06\n[arena]\nstones = 20\n"
RUN = ["--seeds", "3", "--budget", "2", "--passes", "4", "--evaluate-every", "1", "--seed", "1"]
STRUCK = """
import os, signal
from mgs import runtime
from mgs.cli.app import main

runtime.start()
from mgs.synth import arena, rendering

arena.ROWS, arena.TEXELS = {rows}, {texels}
write, written = rendering.write_png, []

def struck(path, image):
    written.append(path)
    if len(written) == {files}:
        os.kill(os.getpid(), signal.SIGKILL)
    write(path, image)

rendering.write_png = struck
main()
"""
"""The program, which kills itself before it writes the PNG file of that number, a mask or an image
of a captured frame."""


pytestmark = pytest.mark.usefixtures("coarse_arena")


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return tmp_path_factory.mktemp("capture")


@pytest.fixture(scope="module")
def full(root):
    """The dataset with all its images."""
    return synthesise(root / "full", SCENE, TINY, seed=3, test_views=2)


@pytest.fixture(scope="module")
def poses(root):
    """The same on demand, of which no frame is ever taken."""
    return synthesise(root / "poses", SCENE, TINY, seed=3, test_views=2, on_demand=True)


@pytest.fixture(scope="module")
def prior(root, full):
    """A prior of few Gaussians."""
    return save_prior(
        root / "prior", prior_from_mesh(full.root / "rock.glb", PriorSettings(gaussians=300))
    )


@pytest.fixture(scope="module")
def whole(full, prior, root):
    """A run on the dataset with all its images."""
    command("nbv", full.root, "--prior", prior, "--out", root / "whole", *RUN)
    return root / "whole"


@pytest.fixture(scope="module")
def captured(poses, prior, root):
    """A run on a copy of the poses."""
    shutil.copytree(poses.root, root / "captured-poses")
    command("nbv", root / "captured-poses", "--prior", prior, "--out", root / "captured", *RUN)
    return root / "captured"


@pytest.fixture
def fresh(poses, tmp_path):
    """A copy of the poses, for this test alone."""
    return load_dataset(shutil.copytree(poses.root, tmp_path / "poses"))


def command(*arguments) -> None:
    """A command of the program, in this process; it must end well."""
    with pytest.raises(SystemExit) as stop:
        main([str(argument) for argument in arguments])
    assert stop.value.code == 0


def files(frame) -> list[Path]:
    return [getattr(frame, field) for field in FILES]


def there(dataset) -> list[str]:
    """Names of the frames of which some file exists."""
    return [frame.name for frame in dataset.frames if any(path.exists() for path in files(frame))]


def steps(run: Path) -> list[dict]:
    return [json.loads(line) for line in (run / "steps.jsonl").read_text().splitlines()]


def taken(run: Path) -> list[str]:
    seeds, *chosen = steps(run)
    return [*seeds["seed_names"], *(step["name"] for step in chosen)]


def same_files(frame, other) -> bool:
    return [path.read_bytes() for path in files(frame)] == [
        path.read_bytes() for path in files(other)
    ]


def test_only_test_views_are_rendered_in_advance(full, poses):
    assert there(poses) == []
    assert [frame.name for frame in poses.frames] == [frame.name for frame in full.frames]
    for ours, theirs in zip(poses.test_views().frames, full.test_views().frames, strict=True):
        assert same_files(ours, theirs)
    inside = {
        path.relative_to(poses.root).parts[0] for path in poses.root.rglob("*") if path.is_file()
    }
    assert inside == {
        "transforms.json",
        "config.json",
        "contact_sheet.png",
        "rock.glb",
        "survey",
        "test",
    }


def test_an_interrupted_dataset_goes_on_as_what_it_was_begun(poses, tmp_path):
    """The same files as after one run; not as a dataset with all its images."""

    def stop(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        synthesise(
            tmp_path / "again", SCENE, TINY, seed=3, test_views=2, on_demand=True, progress=stop
        )
    with pytest.raises(InputError, match="unfinished dataset of other settings"):
        synthesise(tmp_path / "again", SCENE, TINY, seed=3, test_views=2)
    again = synthesise(tmp_path / "again", SCENE, TINY, seed=3, test_views=2, on_demand=True)
    ours, theirs = (
        {k: v for k, v in listing(d.root).items() if k != "config.json"} for d in (again, poses)
    )
    assert ours == theirs  # config.json has timings


def test_the_command_says_what_it_rendered(tmp_path, capsys):
    (tmp_path / "mine.toml").write_text(TOML)
    command(
        "synth-orbit",
        tmp_path / "out",
        "--on-demand",
        "--scene",
        tmp_path / "mine.toml",
        "--frames",
        3,
        "--size",
        "32x24",
    )
    said = capsys.readouterr().out
    assert "3 frames, none rendered" in " ".join(said.split())
    assert "contact_sheet" not in said
    assert there(load_dataset(tmp_path / "out")) == []


def test_a_frame_rendered_alone_is_that_of_the_whole_orbit(full, fresh):
    """Bit for bit, in whatever order frames are taken; what is there is left alone."""
    capture = capture_of(fresh)
    for index in (5, 1):
        capture(fresh.frames[index])
    assert there(fresh) == [fresh.frames[1].name, fresh.frames[5].name]
    before = [path.stat().st_mtime_ns for path in files(fresh.frames[5])]
    for index in (5, 0):
        capture(fresh.frames[index])
    assert [path.stat().st_mtime_ns for path in files(fresh.frames[5])] == before
    for index in (0, 1, 5):
        assert same_files(fresh.frames[index], full.frames[index])


def test_a_mesh_seen_from_noisy_poses_is_captured_from_the_true_ones(full, tmp_path):
    """Of a scene whose poses are told with noise, the images are those of the true poses."""
    mesh, noise = shutil.copy(full.root / "rock.glb", tmp_path), PoseNoise(0.01, 0.2)
    both = [
        synthesise(
            tmp_path / name,
            SCENE,
            RenderPreset(32, 24, 4, 2),
            mesh=mesh,
            pose_noise=noise,
            on_demand=name == "poses",
        )
        for name in ("full", "poses")
    ]
    capture_of(both[1])(both[1].frames[2])
    assert same_files(both[1].frames[2], both[0].frames[2])
    assert (tmp_path / "poses/true_poses.json").read_bytes() == (
        tmp_path / "full/true_poses.json"
    ).read_bytes()
    (tmp_path / "rock.glb").write_bytes(b"another")
    with pytest.raises(InputError, match=r"rock\.glb: has changed since .*poses was made of it"):
        capture_of(both[1])(both[1].frames[3])
    (tmp_path / "rock.glb").unlink()
    with pytest.raises(InputError, match=r"rock\.glb: no such mesh"):
        capture_of(both[1])(both[1].frames[3])


def test_the_survey_gives_the_prior_of_the_whole_dataset(full, poses):
    survey = poses.survey()
    for ours, theirs in zip(survey.frames, full.frames, strict=True):
        assert not ours.image_path.exists()
        assert ours.depth_path.read_bytes() == theirs.depth_path.read_bytes()
        assert ours.mask_path.read_bytes() == theirs.mask_path.read_bytes()
    settings = PriorSettings(gaussians=300)
    ours, theirs = (build_prior(dataset, settings)[0] for dataset in (survey, full))
    assert prior_digest(ours) == prior_digest(theirs)
    assert ours.numbers == theirs.numbers
    assert full.survey() is full


def test_the_run_is_that_on_the_whole_dataset(whole, captured):
    """The same choices and the same model; PSNR too, but over views that have images."""
    assert taken(captured) == taken(whole)
    assert (captured / "gaussians.ply").read_bytes() == (whole / "gaussians.ply").read_bytes()
    differ = {"seconds", "psnr", "psnr_mask", "held_out_psnr", "held_out_psnr_mask"}
    for ours, theirs in zip(steps(captured), steps(whole), strict=True):
        assert {k: v for k, v in ours.items() if k not in differ} == {
            k: v for k, v in theirs.items() if k not in differ
        }
        assert not any(key.startswith("held_out") for key in ours)
        assert "test_psnr" in ours


def test_an_image_that_was_never_chosen_never_exists(captured):
    dataset = load_dataset(captured.parent / "captured-poses")
    assert sorted(there(dataset)) == sorted(taken(captured))
    never = next(frame for frame in dataset.frames if frame.name not in taken(captured))
    for read in (never.rgb, never.mask, never.depth, never.target):
        with pytest.raises(
            InputError,
            match=rf"does not exist, since no run has taken frame {never.name} .* `mgs nbv`",
        ):
            read()


@pytest.mark.parametrize("png", [4, 8])
def test_killed_while_it_captures_and_resumed(captured, poses, prior, fresh, tmp_path, png):
    """Killed with SIGKILL inside the second seed, and inside the first chosen view: two PNG files
    of each frame are written by that function. The same choices, the same model, the same
    images."""
    out, program = tmp_path / "run", STRUCK.format(files=png, rows=arena.ROWS, texels=arena.TEXELS)
    arguments = ["nbv", fresh.root, "--prior", prior, "--out", out, *RUN]
    process = subprocess.run(
        [sys.executable, "-c", program, *map(str, arguments)], capture_output=True, text=True
    )
    assert process.returncode == -signal.SIGKILL, process.stderr
    done = {
        path: path.stat().st_mtime_ns
        for frame in fresh.frames
        if rendering.is_done(frame)
        for path in files(frame)
    }
    assert len(done) == 4 * ((png - 1) // 2)
    command("nbv", "--resume", out)
    assert taken(out) == taken(captured)
    assert (out / "gaussians.ply").read_bytes() == (captured / "gaussians.ply").read_bytes()
    assert {path: path.stat().st_mtime_ns for path in done} == done, "rendered again"
    assert sorted(there(fresh)) == sorted(taken(captured))


def test_it_is_judged_by_its_test_views(captured, capsys):
    """No view is held out where none has an image, so no column says so."""
    metrics = json.loads((captured / "metrics.json").read_text())
    assert [metrics[name]["count"] for name in ("test", "all", "held_out")] == [2, 5, 0]
    assert {view["name"] for view in metrics["views"]} == set(taken(captured))
    rows = table_numbers([captured])
    assert "test.psnr" in table_columns(rows)
    assert not any(key.startswith("held_out") for key in table_columns(rows))
    command("eval", captured)
    said = capsys.readouterr().out
    assert "own: trained on" in said
    assert "new: views" not in said
    drawn = {path.stem for path in (captured / "renders").glob("*.png")}
    assert drawn == set(taken(captured))


def test_every_command_that_reads_a_run_reads_this_one(captured, tmp_path):
    """And none of them makes or needs an image that was never taken."""
    dataset = load_dataset(captured.parent / "captured-poses")
    before = there(dataset)
    command("eval", captured)
    command("diagnose", captured)
    command("report", captured, "--out", tmp_path / "report")
    command("report", captured, "--html", tmp_path / "page.html")
    command("prune", captured)
    command("refit", captured)
    assert there(dataset) == before
    assert not any("no run has taken" in problem for problem in check_dataset(dataset).problems)
    assert not any(
        "no run has taken" in problem for problem in check_dataset(dataset.survey()).problems
    )
    never = {frame.name for frame in dataset.frames} - set(taken(captured))
    assert {
        path.stem for path in (captured / "diagnostics").glob("*.png")
    } == never  # maps of a pose need no image
    middle = dataset.test_views().frames[1]
    truth, _ = read_comparison(captured / "renders/test" / f"{middle.name}.png", middle.camera)
    assert truth.any()
    page = (tmp_path / "page.html").read_text()
    assert all(f'"truth/{name}"' in page for name in (*taken(captured), "test/tv_0000"))
    assert not any(f'"truth/{name}"' in page for name in never)
    roles = {view.frame.name: view.role for view in read_subject(captured).views}
    assert {name for name, role in roles.items() if role == "candidate"} == never


def test_errors_are_judged_on_test_views_alone(poses, prior, fresh, tmp_path):
    """The calibration takes the views that the run has seen, and of those it has not only the ones
    with images."""
    run = tmp_path / "run"
    command("nbv", fresh.root, "--prior", prior, "--out", run, *RUN[:2], "--budget", 3, *RUN[4:])
    command("diagnose", run, "--calibrate")
    assert json.loads((run / "diagnostics/uncertainty.json").read_text())["views"] == {
        "folds": 6,
        "test": 2,
    }


def test_runs_that_share_a_dataset_can_be_compared(prior, fresh, tmp_path, monkeypatch):
    """A frame that another run took is not rendered again. Without test views the report shows a
    frame that both have taken."""
    shutil.rmtree(fresh.root / "test")
    runs = [tmp_path / policy for policy in ("farthest", "d-optimal")]
    command("nbv", fresh.root, "--prior", prior, "--policy", "farthest", "--out", runs[0], *RUN)
    take, rendered = rendering.Photographer.take, []
    monkeypatch.setattr(
        rendering.Photographer,
        "take",
        lambda self, frame: (rendered.append(frame.name), take(self, frame)),
    )
    command("nbv", fresh.root, "--prior", prior, "--out", runs[1], *RUN)
    assert rendered == [name for name in taken(runs[1]) if name not in taken(runs[0])]
    for run in runs:
        command("eval", run)
    command("report", *runs, "--out", tmp_path / "report", "--html", tmp_path / "page.html")
    assert not any(key.startswith("held_out") for key in table_columns(table_numbers(runs)))
    assert (tmp_path / "report/comparison.png").is_file()
    assert (tmp_path / "page.html").is_file()


@pytest.fixture
def small(monkeypatch):
    """What `--capture` makes, small."""
    monkeypatch.setitem(rendering.PRESETS, nbv.CAPTURE_PRESET, TINY)
    monkeypatch.setattr(nbv, "CAPTURE_TEST_VIEWS", 1)


def test_one_command_does_all_of_it(small, tmp_path, capsys):
    """Poses, survey, prior, run, all in the run's folder, which can be resumed."""
    (tmp_path / "mine.toml").write_text(TOML)
    run = tmp_path / "run"
    command("nbv", "--capture", tmp_path / "mine.toml", "--out", run, "--gaussians", 300, *RUN)
    dataset = load_dataset(run / "dataset")
    assert sorted(there(dataset)) == sorted(taken(run))
    assert json.loads((run / "config.json").read_text())["settings"]["dataset"] == str(
        (run / "dataset").resolve()
    )
    assert json.loads((run / "prior/prior.json").read_text())["from"] == "depth"
    said = capsys.readouterr().out
    assert "test views (1)" in said
    assert "views trained on (5)" in said
    assert "never trained on" not in said
    (run / "dataset/images/.kf_0009.1.part.png").write_bytes(b"left by a kill")
    command("nbv", "--resume", run)
    assert not (run / "dataset/images/.kf_0009.1.part.png").exists()


def test_a_survey_can_be_flown_with_noise(poses, tmp_path):
    """`mgs survey` of the survey, and a prior of that; neither has images."""
    command("survey", poses.root / "survey", "--out", tmp_path / "survey", "--poses", "exact")
    command("prior", tmp_path / "survey", "--out", tmp_path / "prior", "--gaussians", 300)
    assert json.loads((tmp_path / "prior/prior.json").read_text())["seen_by_seeds"] > 0.5
    assert there(load_dataset(tmp_path / "survey"))
    assert not (tmp_path / "survey/images").exists()


def test_bad_scenes_and_options_are_refused(small, poses, prior, tmp_path, capsys):
    """With one line, before anything is made."""
    (tmp_path / "bad.toml").write_text("[rock]\nsiez = 1\n")
    out = ["--out", tmp_path / "out"]
    assert "nosuch" in refused(capsys, ["nbv", "--capture", "nosuch", *out], tmp_path)
    assert "rock.siez" in refused(
        capsys, ["nbv", "--capture", tmp_path / "bad.toml", *out], tmp_path
    )
    assert "give a DATASET or --capture" in refused(
        capsys, ["nbv", poses.root, "--capture", "boulder", *out], tmp_path
    )
    assert "--capture: --resume takes its settings" in refused(
        capsys, ["nbv", "--resume", tmp_path, "--capture", "boulder"], tmp_path
    )
    assert "--budget 6 exceeds its 5" in refused(
        capsys, ["nbv", "--capture", "boulder", "--seeds", 3, "--budget", 6, *out], tmp_path
    )
    assert "not empty" in refused(
        capsys, ["nbv", "--capture", "boulder", "--out", occupied(tmp_path / "in")], tmp_path
    )
    assert "no such prior" in refused(
        capsys, ["nbv", "--capture", "boulder", "--prior", tmp_path / "no", *out], tmp_path
    )


def test_what_an_on_demand_dataset_lacks_is_said(poses, fresh, prior, tmp_path, capsys):
    line = refused(capsys, ["prior", fresh.root, "--gaussians", 300], fresh.root)
    assert "no run has taken frame kf_0000" in line
    assert "folder survey" in line
    assert "no run has taken frame kf_0000" in refused(
        capsys, ["survey", fresh.root, "--out", tmp_path / "s"], fresh.root
    )
    shutil.rmtree(fresh.root / "survey")
    out = tmp_path / "run"
    assert "give one with --prior" in refused(
        capsys, ["nbv", fresh.root, "--out", out, *RUN], fresh.root
    )
    assert not out.exists()


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda root: (root / "config.json").unlink(), r"config\.json: no such file"),
        (
            lambda root: (root / "config.json").write_text("{}"),
            "is not of `mgs synth-orbit --on-demand`",
        ),
        (
            lambda root: edit(root, lambda frame: frame.update(file_path="images/kf_9.png")),
            "kf_9 is not one of the scene's",
        ),
        (lambda root: move(root), "kf_0000 is not one of the scene's orbit"),
    ],
)
def test_what_cannot_be_rendered_is_refused(fresh, spoil, said):
    spoil(fresh.root)
    spoilt = load_dataset(fresh.root)
    with pytest.raises(InputError, match=said):
        capture_of(spoilt)(spoilt.frames[0])


def test_the_denoiser_that_other_images_have_must_be_there(fresh, monkeypatch):
    config = json.loads((fresh.root / "config.json").read_text())
    (fresh.root / "config.json").write_text(json.dumps(config | {"denoise": True}))
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match="denoised by pyoidn, which is not installed"):
        capture_of(fresh)(fresh.frames[0])


def edit(root: Path, change) -> None:
    """Change the record of the first frame in transforms.json."""
    data = json.loads((root / "transforms.json").read_text())
    change(data["frames"][0])
    (root / "transforms.json").write_text(json.dumps(data))


def move(root: Path) -> None:
    """Move the first camera by a millimetre."""
    edit(
        root,
        lambda frame: frame["transform_matrix"][0].__setitem__(
            3, frame["transform_matrix"][0][3] + 1e-3
        ),
    )
