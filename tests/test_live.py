"""Live capture: poses out, pictures back, by a command, a folder or a function."""

import itertools
import json
import shutil
import sys
import threading
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny
from program import command, steps, timeless
from refusals import refused
from scipy.ndimage import gaussian_filter

from mgs.camera import Camera, heading_and_pitch, look_at, opengl_from_opencv
from mgs.data.dataset import load_dataset
from mgs.data.up import upright
from mgs.errors import InputError, Notice
from mgs.images import read_exr, read_rgba, write_png
from mgs.prior.build import load_prior
from mgs.run import live, transports
from mgs.run.live import check_photograph

SCRIPT = """
name=$(basename "$2" .pose.json)
stem="${{3%.png}}"
trouble() {{ {trouble}; }}
cp "$1/masks/$name.png" "$stem.mask.png"
cp "$1/images/$name.png" "$3"
[ $name = {at} ] && {tries} && trouble "$@"
exit 0
"""
"""A drone that copies what a dataset has, in trouble at one pose, at its first try or always."""

FIRST = 'grep -q \'"attempt": 1\' "$2"'

TROUBLES = {
    "exit code": ("echo no link >&2; exit 7", "exit code 7: no link"),
    "nothing": ("rm $3", "the picture is missing"),
    "half a file": ('head -c 90 "$1/images/$name.png" > "$3"', "the file is damaged"),
    "another size": ('cp "$1/other.png" "$3"', "is 8x6, but its camera is 16x12"),
    "white": ('cp "$1/white.png" "$3"', "overexposed, 100 % of the object"),
    "no object": ('cp "$1/empty.png" "$stem.mask.png"', "the object is not in the picture"),
    "no pose": ('echo "{}" > "$stem.flown.json"', "has no transform_matrix"),
    "far away": ('cp "$1/far.json" "$stem.flown.json"', "from the pose asked for, more than"),
}


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A complete dataset, with what goes wrong beside it."""
    root = tiny.write_dataset(tmp_path_factory.mktemp("live") / "data")
    write_png(root / "other.png", np.full((6, 8, 3), 0.5))
    write_png(root / "white.png", np.ones((tiny.HEIGHT, tiny.WIDTH, 3)))
    write_png(root / "empty.png", np.zeros((tiny.HEIGHT, tiny.WIDTH), bool))
    matrix = opengl_from_opencv(look_at((9, 9, 9), (0, 0, 0))).tolist()
    (root / "far.json").write_text(json.dumps({"transform_matrix": matrix}))
    return root


@pytest.fixture(scope="module")
def whole(data, tmp_path_factory):
    """The run on the complete dataset."""
    out = tmp_path_factory.mktemp("whole") / "run"
    tiny.run(out, load_dataset(data))
    return out


@pytest.fixture
def prior(tmp_path):
    return load_prior(tiny.write_prior(tmp_path / "prior"))


@pytest.fixture
def poses(data, tmp_path):
    """A folder of the poses alone."""
    (tmp_path / "poses").mkdir()
    shutil.copy(data / "transforms.json", tmp_path / "poses")
    return tmp_path / "poses"


class Flight:
    """A live run with the operations of tests/tiny.py."""

    def __init__(self, root, poses, prior):
        self.out, self.prior = root / "run", prior
        self.dataset = self.out / "dataset"
        live.begin(self.dataset, load_dataset(poses, to_capture=True), prior)
        tiny.start(self.out, load_dataset(self.dataset))

    def fly(self, deliver, **options):
        """Run to the end; returns the notices."""
        dataset = load_dataset(self.dataset)
        capture = live.live_capture(dataset, self.prior, live.Live(deliver, **options))
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            tiny.resume(self.out, dataset, tiny.operations(capture=capture))
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


def drone(data, folder, trouble=":", at="none", tries="true"):
    """Transport of SCRIPT."""
    script = folder / "drone.sh"
    script.write_text(SCRIPT.format(trouble=trouble, at=at, tries=tries))
    return transports.command(f"sh '{script}' '{data}' {{pose}} {{out}}", 600)


def copying(data, change=lambda pose, out: None):
    """A transport that copies the image and mask of a dataset."""

    def deliver(pose: Path, out: Path) -> None:
        shutil.copy(data / "masks" / out.name, out.with_suffix(".mask.png"))
        shutil.copy(data / "images" / out.name, out)
        change(pose, out)

    return deliver


def test_the_run_is_that_on_the_complete_dataset(flight, data, whole, tmp_path):
    assert flight.fly(drone(data, tmp_path)) == []
    assert flight.steps == timeless(steps(whole))
    assert (flight.out / "gaussians.ply").read_bytes() == (whole / "gaussians.ply").read_bytes()
    assert {path.stem for path in (flight.dataset / "captured").iterdir()} == set(flight.taken)


@pytest.mark.parametrize("case", TROUBLES)
def test_what_goes_wrong_is_one_line_and_is_tried_again(flight, data, whole, tmp_path, case):
    trouble, message = TROUBLES[case]
    said = flight.fly(drone(data, tmp_path, trouble, "kf_0004", FIRST))
    assert len(said) == 1
    assert said[0].startswith("kf_0004, try 1 of 3: ")
    assert message in said[0]
    assert "\n" not in said[0]
    assert flight.steps == timeless(steps(whole))
    refused = [path.name for path in (flight.dataset / "flight").glob("*refused-1*")]
    assert ("kf_0004.refused-1.png" in refused) == (case != "nothing")


def test_a_command_that_hangs_is_ended_with_its_children(tmp_path):
    deliver = transports.command("sh -c 'sleep 60 & wait' {pose} {out}", 0.3)
    with pytest.raises(InputError, match=r"the command did not end within 0\.3 s"):
        deliver(tmp_path / "a.pose.json", tmp_path / "a.png")


@pytest.mark.parametrize("seed", [True, False])
def test_a_pose_without_a_picture_is_skipped_or_stops_the_run(flight, data, whole, tmp_path, seed):
    names = [line["name"] for line in steps(whole)]
    lost = "kf_0004" if seed else names[2]
    lose = drone(data, tmp_path, "exit 1", lost)
    with pytest.raises(InputError, match=f"{lost}: no picture after 2 tries .*exit code 1.*resume"):
        flight.fly(lose, tries=2, failure="stop")
    said = flight.fly(lose, tries=2)
    assert len(said) == 2
    assert lost not in flight.taken
    assert len(flight.taken) == 8
    assert not seed or steps(flight.out)[0]["seed_names"][1] in ("kf_0003", "kf_0005")
    other = Flight(tmp_path / "other", tmp_path / "poses", flight.prior)
    other.fly(lose, tries=1)  # without an interruption
    assert other.steps == flight.steps


def test_a_run_ends_when_no_candidate_is_left(flight, data):
    def lose(pose, out):
        if out.stem not in ("kf_0000", "kf_0004", "kf_0008", "kf_0009"):
            raise InputError("no link")

    assert len(flight.fly(copying(data, lose), tries=1)) == 8
    assert steps(flight.out)[-1]["ended"]["reason"] == "flight"
    assert flight.fly(copying(data, lose)) == []


def aside(pose: Path, out: Path) -> None:
    """Fly 5 cm beside the pose asked for, with a slightly different lens."""
    asked = json.loads(pose.read_text())
    matrix = np.array(asked["transform_matrix"])
    matrix[:3, 3] += 0.05
    flown = {"transform_matrix": matrix.tolist(), "fl_x": asked["fl_x"] + 0.5}
    out.with_suffix(".flown.json").write_text(json.dumps(flown))


def test_no_distance_from_the_pose_may_be_allowed(flight, data):
    with pytest.raises(InputError, match=r"is 0\.0866 from the pose asked for, more than 0"):
        flight.fly(copying(data, aside), tries=1, failure="stop", distance=0.0)


def test_the_pose_flown_counts_and_a_resumed_run_is_the_same(flight, data, whole, tmp_path):
    calls = []

    def interrupt(pose, out):
        aside(pose, out)
        calls.append(out.stem)
        if len(calls) == 6:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        flight.fly(copying(data, interrupt))
    flight.fly(copying(data, aside))
    other = Flight(tmp_path / "other", tmp_path / "poses", flight.prior)
    other.fly(copying(data, aside))
    assert flight.steps == other.steps != timeless(steps(whole))
    asked = {
        frame.name: frame.camera
        for frame in load_dataset(tmp_path / "poses", to_capture=True).frames
    }
    for frame in load_dataset(flight.dataset).frames:
        moved = frame.camera.position - asked[frame.name].position
        np.testing.assert_allclose(moved, 0.05 * (frame.name in flight.taken), atol=1e-12)
        assert frame.name not in flight.taken or frame.camera.K[0, 0] == 16.5
    for camera, before in zip(load_dataset(flight.dataset).cameras, asked.values(), strict=True):
        np.testing.assert_array_equal(camera.position, before.position)
        np.testing.assert_array_equal(camera.K, before.K)
    record = flight.dataset / "captured/kf_0000.json"
    record.write_text(record.read_text().replace("16.5", "16.6"))
    with pytest.raises(InputError, match=r"kf_0000\.json has changed since"):
        flight.fly(copying(data, aside))


def test_depth_and_images_that_exist_are_kept(data, prior, tmp_path):
    shutil.copytree(data / "images", tmp_path / "poses/images")
    shutil.copytree(data / "masks", tmp_path / "poses/masks")
    shutil.copytree(data / "depth", tmp_path / "poses/depth")
    shutil.copy(data / "transforms.json", tmp_path / "poses")
    (tmp_path / "poses/images/kf_0004.png").unlink()
    flight, asked = Flight(tmp_path, tmp_path / "poses", prior), []

    def deliver(pose, out):
        asked.append(out.stem)
        shutil.copy(data / "depth/kf_0004.exr", out.with_suffix(".depth.exr"))

    flight.fly(copying(data, deliver))
    assert asked == ["kf_0004"]
    depth = load_dataset(flight.dataset).frames[4].depth_path
    assert np.array_equal(read_exr(depth)["Z"], read_exr(data / "depth/kf_0004.exr")["Z"])


def test_the_pose_file_says_where_to_be_and_look(flight, data):
    flight.fly(copying(data))
    asked = json.loads((flight.dataset / "flight/kf_0000.pose.json").read_text())
    assert asked["position"] == pytest.approx([row[3] for row in asked["transform_matrix"][:3]])
    assert asked["pitch"] == pytest.approx(-np.degrees(np.arctan2(1.5, 3)))
    assert (asked["w"], asked["h"], asked["fl_x"]) == (16, 12, 16.0)
    assert "camera-to-world" in asked["convention"]


@pytest.mark.parametrize(
    ("target", "heading"), [((0, 1, 0), 0), ((1, 0, 0), 90), ((0, -1, 0), 180), ((-1, 0, 0), 270)]
)
def test_heading_is_clockwise_from_y(target, heading):
    camera = Camera(np.diag([9.0, 9, 1]), 9, 9, look_at((0, 0, 0), target))
    assert heading_and_pitch(camera) == pytest.approx((heading, 0))
    x, y, z = target
    turned = Camera(np.diag([9.0, 9, 1]), 9, 9, look_at((0, 0, 0), (x, -z, y), (0, -1, 0)))
    assert heading_and_pitch(turned, upright((0, -1, 0))) == pytest.approx((heading, 0))


def test_a_watched_folder(flight, data, whole, tmp_path, monkeypatch):
    """Somebody puts pictures there, one of them in two halves, while the clock jumps by days."""
    monkeypatch.setattr(transports, "POLL", 0.02)
    days = itertools.cycle([0.0, 9e5, -9e5])
    monkeypatch.setattr(transports.time, "time", lambda: next(days))
    folder, end = tmp_path / "sync", threading.Event()
    folder.mkdir()

    def somebody():
        while not end.wait(0.01):
            for pose in folder.glob("*.pose.json"):
                name = pose.name.removesuffix(".pose.json")
                if not (folder / f"{name}.png").exists():
                    shutil.copy(data / f"masks/{name}.png", folder / f"{name}.mask.png")
                    whole = (data / f"images/{name}.png").read_bytes()
                    (folder / f"{name}.png").write_bytes(whole[:90])
                    end.wait(0.1)
                    (folder / f"{name}.png").write_bytes(whole)

    thread = threading.Thread(target=somebody)
    thread.start()
    try:
        said = flight.fly(transports.watched(60), folder=folder)
    finally:
        end.set()
        thread.join()
    assert len(said) == 8
    assert f"waiting at most 60 s for {folder}/kf_0000.png" in said[0]
    assert flight.steps == timeless(steps(whole))
    other = Flight(tmp_path / "other", tmp_path / "poses", flight.prior)
    (folder / "kf_0000.pose.json").unlink()
    with pytest.raises(InputError, match="lay there before its pose was asked for"):
        other.fly(transports.watched(1), folder=folder)


def test_nobody_comes(flight, tmp_path, monkeypatch):
    monkeypatch.setattr(transports, "POLL", 0.01)
    with pytest.raises(InputError, match=r"no picture after 1 tries .*nothing within 0.05 s"):
        flight.fly(transports.watched(0.05), folder=tmp_path, tries=1, failure="stop")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda grey: grey, None),
        (lambda grey: 0 * grey, "underexposed"),
        (lambda grey: grey + 1, "overexposed"),
        (
            lambda grey: gaussian_filter(grey, 4),
            "blur",
        ),
    ],
)
def test_photographs_are_checked(tmp_path, data, change, said):
    stripes = np.random.default_rng(0).random((96, 128)) > 0.5
    frame, path = load_dataset(data).frames[0], tmp_path / "one.png"
    write_png(path, np.repeat(change(0.1 + 0.5 * stripes)[..., None], 3, axis=-1))
    frame = replace(frame, image_path=path, mask_path=None, camera=frame.camera.resized(128))
    if said is None:
        check_photograph(frame)
        return
    with pytest.raises(InputError, match=said):
        check_photograph(frame)


def test_bad_options_are_one_line(capsys, data, poses, tmp_path):
    begin = ["nbv", poses, "--prior", tiny.write_prior(tmp_path / "p"), "--out", tmp_path / "run"]
    program = "--capture-command"
    for arguments, message in (
        ([program, "true {out}"], "has no {pose}"),
        ([program, "true '{pose} {out}"], "No closing quotation"),
        ([program, "nosuchprogram {pose} {out}"], "there is no program nosuchprogram"),
        ([program, "true {pose} {out}", "--capture-failure", "never"], "choose skip or stop"),
        ([program, "true {pose} {out}", "--capture-folder", tmp_path], "give either"),
        ([program, "true {pose} {out}", "--capture", "boulder"], "give a DATASET or --capture"),
    ):
        assert message in refused(capsys, [*begin, *arguments], tmp_path)
    begin[1] = data
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
    flying = ["--capture-command", program, "--capture-tries", 4, "--capture-timeout", 200]
    settings = ["--seed-views", 3, "--budget", 2, "--passes", 2, "--gaussians", 200]
    command("nbv", world, *settings, *flying, "--out", run)
    assert "try 1 of 4" in capfd.readouterr().err
    assert len(steps(run)) == 3
    shutil.rmtree(run / "dataset/flight")
    (run / "checkpoint.npz").unlink()
    before = (run / "gaussians.ply").read_bytes()
    command("nbv", "--resume", run)  # all pictures are there already
    assert (run / "gaussians.ply").read_bytes() == before
    command("eval", run)
    assert read_rgba(next((run / "dataset/images").iterdir())).shape == (48, 64, 4)
