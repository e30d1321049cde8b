"""Live capture: poses out, pictures back, by a command, a folder or a function."""

import gc
import itertools
import json
import math
import shutil
import sys
import threading
import warnings
import weakref
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import synthetic
import tiny
from program import change_settings, command, steps, timeless
from refusals import fails, refused
from scipy.ndimage import gaussian_filter

import mgs
from mgs import load_dataset, load_prior
from mgs.camera import look_at, opengl_from_opencv
from mgs.data.frames import write_rock_image
from mgs.data.world import unit_up
from mgs.errors import InputError, Notice
from mgs.evaluation import psnr_measure
from mgs.images import read_exr, read_mask, read_png, read_rgba, write_png
from mgs.run import live
from mgs.run.ending import why_ended
from mgs.run.flight import flight_of
from mgs.run.folder import read_checkpoint
from mgs.run.live import check_photograph
from mgs.run.settings import NbvSettings
from mgs.splat import ListCache

SCRIPT = """
name=$(basename "$2" .pose.json)
cp "$1/masks/$name.png" "${3%.png}.mask.png"
cp "$1/images/$name.png" "$3"
if [ $name = kf_0004 ] && grep -q '"attempt": 1' "$2"; then echo no link >&2; exit 7; fi
"""
"""A drone that copies what a dataset has, and fails at its first try of one pose."""


ONCE = {"tries": 1, "failure": "stop"}


@pytest.fixture
def poses(pristine, tmp_path):
    """A folder of the poses alone."""
    (tmp_path / "poses").mkdir()
    shutil.copy(pristine / "transforms.json", tmp_path / "poses")
    return tmp_path / "poses"


class Flight:
    """A live run with the operations of tests/tiny.py."""

    def __init__(self, root, poses, prior):
        self.out, self.dataset = root / "run", root / "run/dataset"
        self.prior = load_prior(prior)
        live.write_live_dataset(self.dataset, load_dataset(poses, to_capture=True), self.prior)
        tiny.start(self.out, load_dataset(self.dataset))

    def fly(self, deliver, **options):
        """Run to the end; returns the notices."""
        dataset = load_dataset(self.dataset)
        capture = live.live_capture(dataset, self.prior, live.Live(deliver, **options))
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            tiny.resume(self.out, dataset, capture=capture)
        return [str(one.message) for one in said if one.category is Notice]

    @property
    def steps(self):
        return timeless(steps(self.out))

    @property
    def taken(self):
        seeds, *chosen = steps(self.out)
        return [*seeds["seed_names"], *(step["name"] for step in chosen)]


@pytest.fixture
def flight(tmp_path, poses, prior):
    return Flight(tmp_path, poses, prior)


@pytest.fixture
def other(tmp_path, poses, prior):
    return Flight(tmp_path / "other", poses, prior)


def copying(data, change=lambda pose, out: None):
    """A transport that copies the image and mask of a dataset."""

    def deliver(pose: Path, out: Path) -> None:
        shutil.copy(data / "masks" / out.name, out.with_suffix(".mask.png"))
        shutil.copy(data / "images" / out.name, out)
        change(pose, out)

    return deliver


def test_the_run_of_a_command_is_that_on_the_complete_dataset(flight, pristine, whole, tmp_path):
    script = tmp_path / "drone.sh"
    script.write_text(SCRIPT)
    text = f"sh '{script}' '{pristine}' {{pose}} {{out}}"
    (said,) = flight.fly(live.command(text, 600))
    assert said.startswith("kf_0004, try 1 of 3: ")
    assert "exit code 7: no link" in said
    assert flight.steps == timeless(steps(whole))
    assert (flight.out / "gaussians.ply").read_bytes() == (whole / "gaussians.ply").read_bytes()
    assert {path.stem for path in (flight.dataset / "captured").iterdir()} == set(flight.taken)
    asked = json.loads((flight.dataset / "flight/kf_0000.pose.json").read_text())
    assert asked["position"] == pytest.approx([row[3] for row in asked["transform_matrix"][:3]])
    assert asked["pitch"] == pytest.approx(-np.degrees(np.arctan2(1.5, 3)))
    assert (asked["w"], asked["h"], asked["fl_x"]) == (16, 12, 16.0)


def test_headings_are_clockwise_from_the_worlds_own_y(poses, tmp_path):
    dataset = load_dataset(poses, to_capture=True, up=unit_up((-0.6, 0.5, -0.4)))
    up, frame = np.array(dataset.world.up), dataset.frames[4]
    asked = dataset.world.leave(frame.camera)
    pose, _ = live.ask(tmp_path, frame, dataset, 1)
    y, ahead = (v - (v @ up) * up for v in (np.eye(3)[1], asked.world_to_camera[2, :3]))
    heading = math.degrees(math.atan2(-np.cross(y, ahead) @ up, y @ ahead)) % 360
    assert json.loads(pose.read_text())["heading"] == pytest.approx(heading)


def far_away(out: Path) -> None:
    matrix = opengl_from_opencv(look_at((9, 9, 9), (0, 0, 0))).tolist()
    out.with_suffix(".flown.json").write_text(json.dumps({"transform_matrix": matrix}))


NO_MASK = np.zeros((tiny.HEIGHT, tiny.WIDTH), bool)
TROUBLES = {
    "the picture is missing": Path.unlink,
    "the file is damaged": lambda out: out.write_bytes(out.read_bytes()[:90]),
    "is 8x6, but its camera is 16x12": lambda out: write_png(out, np.full((6, 8, 3), 0.5)),
    "the object is not in the picture": (
        lambda out: write_png(out.with_suffix(".mask.png"), NO_MASK)
    ),
    "has no transform_matrix": lambda out: out.with_suffix(".flown.json").write_text("{}"),
    "from the pose asked for, more than": far_away,
}


def test_what_goes_wrong_is_one_line_and_is_tried_again(flight, pristine, whole):
    """Each trouble comes with one of the pictures."""
    troubles = {}

    def trouble(pose, out):
        if json.loads(pose.read_text())["attempt"] == 1 and len(troubles) < len(TROUBLES):
            troubles[out.stem] = message = [*TROUBLES][len(troubles)]
            TROUBLES[message](out)

    said = flight.fly(copying(pristine, trouble))
    assert len(said) == len(TROUBLES)
    for line, (name, message) in zip(said, troubles.items(), strict=True):
        assert line.startswith(f"{name}, try 1 of 3: ")
        assert message in line
        assert "\n" not in line
    assert flight.steps == timeless(steps(whole))
    refused = {path.name for path in (flight.dataset / "flight").glob("*refused-1.png")}
    expected = {n for n, m in troubles.items() if m != "the picture is missing"}
    assert refused == {f"{name}.refused-1.png" for name in expected}


def test_a_command_that_hangs_is_ended_with_its_children(tmp_path):
    deliver = live.command("sh -c 'sleep 60 & wait' {pose} {out}", 0.3)
    fails(r"within 0\.3 s", deliver, tmp_path / "a.pose.json", tmp_path / "a.png")


@pytest.mark.parametrize("seed", [True, False])
def test_a_pose_without_a_picture_is_skipped_or_stops_the_run(flight, other, pristine, whole, seed):
    lost = "kf_0004" if seed else steps(whole)[2]["name"]

    def lose(pose, out):
        if out.stem == lost:
            raise InputError("no link")

    stopped = f"{lost}: no picture after 2 tries .*no link.*resume"
    fails(stopped, flight.fly, copying(pristine, lose), **ONCE | {"tries": 2})
    assert len(flight.fly(copying(pristine, lose), tries=2)) == 2
    assert lost not in flight.taken
    assert len(flight.taken) == 8
    assert not seed or steps(flight.out)[0]["seed_names"][1] in ("kf_0003", "kf_0005")
    other.fly(copying(pristine, lose), tries=1)  # without an interruption
    assert other.steps == flight.steps


def test_a_run_ends_when_no_candidate_is_left(flight, pristine):
    def lose(pose, out):
        if out.stem not in ("kf_0000", "kf_0004", "kf_0008", "kf_0009"):
            raise InputError("no link")

    assert len(flight.fly(copying(pristine, lose), tries=1)) == 8
    assert steps(flight.out)[-1]["ended"]["reason"] == "flight"
    assert flight.fly(copying(pristine, lose)) == []


@pytest.mark.parametrize("pictures", [1, 4])
def test_poses_given_up_in_an_outage_are_asked_for_again(
    poses, prior, pristine, tmp_path, pictures
):
    """The outage comes before the seeds are complete, or after them."""
    out, calls, working = tmp_path / "run", [], copying(pristine)
    settings = {"prior": prior, "seeds": 3, "budget": 3, "train": {"passes": 1}}

    def failing(pose, picture):
        calls.append(picture.stem)
        if len(calls) > pictures:
            raise InputError("no link")
        working(pose, picture)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Notice)
        if pictures < 3:
            never = live.Live(failing, tries=1)
            fails("10 gave no picture", mgs.run_nbv, poses, out, live=never, **settings)
        else:
            run = mgs.run_nbv(poses, out, live=live.Live(failing, tries=1), **settings)
            ended = why_ended(run.state.steps[-1]["ended"])
            assert "8 poses gave no picture, resuming asks" in ended
            assert mgs.resume_nbv(out).state.taken == run.state.taken
        run = mgs.resume_nbv(out, live=working)
    assert run.state.steps[-1]["ended"]["reason"] == "budget"
    assert len(run.state.taken) == 6


def aside(pose: Path, out: Path) -> None:
    """Fly 5 cm beside the pose asked for, with a slightly different lens."""
    asked = json.loads(pose.read_text())
    matrix = np.array(asked["transform_matrix"])
    matrix[:3, 3] += 0.05
    flown = {"transform_matrix": matrix.tolist(), "fl_x": asked["fl_x"] + 0.5}
    out.with_suffix(".flown.json").write_text(json.dumps(flown))


def test_no_distance_from_the_pose_may_be_allowed(flight, pristine):
    fails(r"is 0\.0866 from", flight.fly, copying(pristine, aside), **ONCE, distance=0.0)


def test_the_pose_flown_counts_and_a_resumed_run_is_the_same(flight, other, pristine, poses, whole):
    calls = []

    def interrupt(pose, out):
        aside(pose, out)
        calls.append(out.stem)
        if len(calls) == 6:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        flight.fly(copying(pristine, interrupt))
    flight.fly(copying(pristine, aside))
    other.fly(copying(pristine, aside))
    assert flight.steps == other.steps != timeless(steps(whole))
    asked, flown = load_dataset(poses, to_capture=True), load_dataset(flight.dataset)
    for frame, before in zip(flown.frames, asked.cameras, strict=True):
        moved = frame.camera.position - before.position
        np.testing.assert_allclose(moved, 0.05 * (frame.name in flight.taken), atol=1e-12)
        assert frame.name not in flight.taken or frame.camera.K[0, 0] == 16.5
    for camera, before in zip(flown.cameras, asked.cameras, strict=True):
        np.testing.assert_array_equal(camera.position, before.position)
        np.testing.assert_array_equal(camera.K, before.K)
    record = flight.dataset / "captured/kf_0000.json"
    record.write_text(record.read_text().replace("16.5", "16.6"))
    fails(r"kf_0000\.json has changed since", flight.fly, copying(pristine, aside))


def test_depth_and_images_that_exist_are_kept(dataset, pristine, prior, tmp_path):
    (dataset / "images/kf_0004.png").unlink()
    (dataset / "depth/kf_0004.exr").unlink()
    flight, asked, depth = Flight(tmp_path, dataset, prior), [], pristine / "depth/kf_0004.exr"

    def deliver(pose, out):
        asked.append(out.stem)
        shutil.copy(depth, out.with_suffix(".depth.exr"))

    flight.fly(copying(pristine, deliver))
    assert asked == ["kf_0004"]
    kept = load_dataset(flight.dataset).frames[4].depth_path
    assert np.array_equal(read_exr(kept)["Z"], read_exr(depth)["Z"])


def test_a_watched_folder(flight, other, pristine, whole, tmp_path, monkeypatch):
    """Somebody puts pictures there, in two halves, while the clock jumps by days."""
    monkeypatch.setattr(live, "POLL", 0.02)
    days = itertools.cycle([0.0, 9e5, -9e5])
    monkeypatch.setattr(live.time, "time", lambda: next(days))
    folder, end = tmp_path / "sync", threading.Event()
    folder.mkdir()

    def somebody():
        while not end.wait(0.01):
            for pose in folder.glob("*.pose.json"):
                asked = json.loads(pose.read_text())
                name, out = asked["name"], folder / asked["picture"]
                if not out.exists():
                    shutil.copy(pristine / f"masks/{name}.png", out.with_suffix(".mask.png"))
                    content = (pristine / f"images/{name}.png").read_bytes()
                    out.write_bytes(content[:90])
                    end.wait(0.1)
                    out.write_bytes(content)

    thread = threading.Thread(target=somebody)
    thread.start()
    try:
        said = flight.fly(live.watched(60), folder=folder)
    finally:
        end.set()
        thread.join()
    assert len(said) == 8
    token = json.loads((flight.dataset / "transforms.json").read_text())["token"]
    assert f"waiting at most 60 s for {folder}/kf_0000-{token}.png" in said[0]
    assert flight.steps == timeless(steps(whole))
    before = {path: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(InputError, match=r"gave no|no picture"):  # these are of the first run
        other.fly(live.watched(0.01), folder=folder)
    assert {path: path.read_bytes() for path in before} == before


@pytest.mark.parametrize("end", [".png", ".jpg", ".JPG", ".JPEG"])
def test_a_picture_as_cameras_name_it(tmp_path, end):
    (tmp_path / f"a{end}").touch()
    assert live.picture(tmp_path / "a.png") == tmp_path / f"a{end}"


def test_nobody_comes(flight, tmp_path, monkeypatch):
    monkeypatch.setattr(live, "POLL", 0.01)
    fails(r"within 0\.05 s", flight.fly, live.watched(0.05), folder=tmp_path, **ONCE)


LIGHT = {
    "": lambda grey: grey,
    "underexposed": lambda grey: 0 * grey,
    "overexposed": lambda grey: grey + 1,
    "blur": lambda grey: gaussian_filter(grey, 3),
}


@pytest.mark.parametrize("said", LIGHT)
def test_photographs_are_checked(tmp_path, pristine, said):
    squares = np.random.default_rng(0).random((12, 16)) > 0.5
    squares = squares.repeat(8, axis=0).repeat(8, axis=1)
    frame, path = load_dataset(pristine).frames[0], tmp_path / "one.png"
    write_png(path, np.repeat(LIGHT[said](0.1 + 0.5 * squares)[..., None], 3, axis=-1))
    frame = replace(frame, image_path=path, mask_path=None, camera=frame.camera.resized(128))
    fails(said, check_photograph, frame) if said else check_photograph(frame)


def test_bad_options_are_one_line(capsys, pristine, poses, prior, tmp_path):
    begin = ["nbv", poses, "--prior", prior, "--out", tmp_path / "run"]
    program = "--capture-command"
    for arguments, message in (
        ([program, "true {out}"], "has no {pose}"),
        ([program, "true '{pose} {out}"], "No closing quotation"),
        ([program, "nosuchprogram {pose} {out}"], "there is no program nosuchprogram"),
        ([program, "true {pose} {out}", "--set", "capture.failure=never"], "capture.failure"),
        ([program, "true {pose} {out}", "--capture-folder", tmp_path], "give either"),
    ):
        assert message in refused(capsys, [*begin, *arguments], tmp_path)
    begin[1] = pristine
    line = refused(capsys, [*begin, program, "true {pose} {out}"], tmp_path)
    assert "all its images exist" in line


@pytest.mark.slow
def test_the_simulated_drone(tmp_path, capfd):
    """Poses and prior of a rendered world, flown with failures; `--resume` is the same."""
    world, run = tmp_path / "world", tmp_path / "run"
    (tmp_path / "mine.toml").write_text("[rock]\ndetail = 0.06\n[arena]\nstones = 4\n")
    orbit = ["--scene", tmp_path / "mine.toml", "--frames", 8, "--size", "64x48"]
    command("synth-orbit", world, "--on-demand", *orbit)
    tool = Path(__file__).parent.parent / "tools/drone.py"
    program = f"{sys.executable} {tool} {world} {{pose}} {{out}} --fail 0.4 --noise 0.02"
    settings = "--seeds 3 --budget 2 --gaussians 200 --set train.passes=2 --set capture.tries=4"
    settings += " --set capture.timeout=200"
    command("nbv", world, *settings.split(), "--capture-command", program, "--out", run)
    assert "try 1 of 4" in capfd.readouterr().err
    assert len(steps(run)) == 3
    shutil.rmtree(run / "dataset/flight")
    (run / "checkpoint.npz").unlink()
    before = (run / "gaussians.ply").read_bytes()
    command("nbv", "--resume", run)  # all pictures are there already
    assert (run / "gaussians.ply").read_bytes() == before
    command("eval", run)
    assert read_rgba(next((run / "dataset/images").iterdir())).shape == (48, 64, 4)


def test_a_refused_picture_gets_the_next_number_whatever_lies_beside_it(tmp_path):
    for name in ("kf.png", "kf.refused-1x.png", "kf.refused-2.png"):
        (tmp_path / name).touch()
    live._set_aside(tmp_path / "kf.png")
    assert (tmp_path / "kf.refused-3.png").is_file()


def test_pictures_of_another_size_are_measured_in_the_run_that_took_them(flight, pristine):
    """It has loaded its dataset before."""
    small = {"w": 8, "h": 6, "fl_x": 8.0, "fl_y": 8.0, "cx": 4.0, "cy": 3.0}

    def smaller(pose, out):
        asked = json.loads(pose.read_text())
        out.with_suffix(".flown.json").write_text(json.dumps(asked | small))
        image, mask = read_png(out), read_mask(out.with_suffix(".mask.png"))
        write_png(out, image[::2, ::2])
        write_png(out.with_suffix(".mask.png"), mask[::2, ::2])

    dataset = load_dataset(flight.dataset)
    flight.fly(copying(pristine, smaller))
    measure = psnr_measure(dataset, ListCache())
    taken = [i for i, frame in enumerate(dataset.frames) if frame.name in flight.taken]
    assert measure(read_checkpoint(flight.out).gaussians, taken)["psnr"] > 10


def test_a_resumed_run_knows_as_much_of_a_batch_that_lost_a_pose(flight, other, pristine):
    """The first picture of the batch, taken beside its pose, came before the second was lost."""

    def losing(calls, interrupt):
        def deliver(pose, out):
            calls.append(out.stem)
            if len(calls) == 5:
                raise InputError("no link")
            if len(calls) == 6 and interrupt:
                raise KeyboardInterrupt
            aside(pose, out)

        return copying(pristine, deliver)

    for one in (flight, other):
        change_settings(one.out, batch=2)
    with pytest.raises(KeyboardInterrupt):
        flight.fly(losing([], True), tries=1)
    flight.fly(copying(pristine, aside))
    other.fly(losing([], False), tries=1)
    assert flight.steps == other.steps


def test_depth_in_millimetres_and_outlines_that_exist_are_kept(dataset, prior, tmp_path):
    """The outlines are those of images of the rock alone."""
    frame = load_dataset(dataset).frames[0]
    depth, half = frame.depth(), frame.mask() & (np.arange(tiny.WIDTH) < tiny.WIDTH // 2)
    write_png(dataset / "depth/0.png", np.round(1000 * depth).astype(np.uint16))
    write_rock_image(dataset / "rock/0.png", np.dstack([frame.rgb() * half[..., None], half]))
    files = {"depth_file_path": "depth/0.png", "rock_file_path": "rock/0.png", "mask_path": None}
    synthetic.edit(dataset, lambda data: data["frames"][0].update(files))
    (dataset / "images/kf_0004.png").unlink()
    kept = load_dataset(Flight(tmp_path, dataset, prior).dataset).frames[0]
    np.testing.assert_allclose(kept.depth(), depth, atol=5.1e-4)
    np.testing.assert_array_equal(kept.mask(), half)


def test_what_poses_see_is_forgotten_once_another_is_flown(loaded):
    """Each would take memory in all steps to come."""
    settings = NbvSettings(dataset=loaded.root, prior=loaded.root, policy="directional-i")
    scene = tiny.scene(loaded, settings)
    state = mgs.learn(scene, [0, 4, 8])
    seen, legs = weakref.ref(scene.surface(state)), weakref.ref(flight_of(scene, state, settings))
    assert (seen(), legs()) == (scene.surface(state), flight_of(scene, state, settings))
    flown = replace(state.frames[1], camera=state.frames[2].camera, asked=state.frames[1].camera)
    moved = replace(state, frames=(state.frames[0], flown, *state.frames[2:]))
    scene.surface(moved)
    flight_of(scene, moved, settings)
    gc.collect()
    assert (seen(), legs()) == (None, None)
