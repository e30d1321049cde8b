"""Films of a run: paths of cameras, the story of its views, and the files."""

import resource
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tiny
from PIL import Image
from program import change_settings, command
from refusals import fails, refused

from mgs.reports.video import _left, _shown_view, camera_path, path_among, write_film
from mgs.run.folder import open_run


@pytest.fixture
def run(seeded, tmp_path):
    return Path(shutil.copytree(seeded, tmp_path / "run"))


def test_a_turntable_goes_around_the_object_and_looks_at_it(loaded):
    cameras = camera_path(loaded, np.zeros((5, 3)), 48, 30)
    eyes = np.array([camera.position for camera in cameras])
    distances = np.linalg.norm(eyes, axis=1)
    np.testing.assert_allclose(distances, np.hypot(3, 1.5), rtol=0.05)
    steps = np.linalg.norm(np.diff(eyes, axis=0, append=eyes[:1]), axis=1)
    assert steps.max() < 0.35 * distances[0], "it jumps, or does not end where it began"
    turned = np.unwrap(np.arctan2(eyes[:, 1], eyes[:, 0]))
    assert abs(turned[-1] - turned[0]) > 2 * np.pi * 0.9
    for camera in cameras[::7]:
        pixel = camera.project(np.zeros((1, 3)))[0][0]
        np.testing.assert_allclose(pixel, camera.K[:2, 2], atol=1e-6)
        assert (camera.width % 2, camera.height % 2) == (0, 0)


def test_a_path_among_cameras_stays_near_them_and_looks_as_they_do(loaded):
    taken = loaded.cameras
    cameras = path_among(taken, 60, 30)
    eyes, given = (np.array([c.position for c in one]) for one in (cameras, taken))
    away = np.linalg.norm(eyes[:, None] - given, axis=2)
    gap = np.linalg.norm(given[0] - given[1])
    assert away.min(axis=1).max() < 0.6 * gap
    steps = np.linalg.norm(np.diff(eyes, axis=0, append=eyes[:1]), axis=1)
    assert steps.max() < 2 * np.median(steps)
    for camera, near in zip(cameras, away.argmin(axis=1), strict=True):
        assert camera.world_to_camera[2, :3] @ taken[near].world_to_camera[2, :3] > 0.9


def grey(values):
    return iter(np.full((8, 10, 3), value, np.uint8) for value in values)


@pytest.mark.parametrize("ending", ["gif", "png", "mp4"])
def test_a_film_has_its_frames_and_their_lengths(tmp_path, ending):
    path = tmp_path / f"a.{ending}"
    if ending == "mp4":
        pytest.importorskip("imageio_ffmpeg")
        write_film(path, grey([0, 120, 250]), [0.1, 0.1, 0.1])
        read = cv2.VideoCapture(str(path))
        about = [read.get(key) for key in (cv2.CAP_PROP_FRAME_COUNT, cv2.CAP_PROP_FPS)]
        assert (about, read.read()[1].shape) == ([3, 10], (8, 10, 3))
        return
    write_film(path, grey([0, 120, 250]), [0.2, 0.2, 0.6])
    with Image.open(path) as image:
        found = []
        for k in range(image.n_frames):
            image.seek(k)
            found.append((image.convert("RGB").getpixel((4, 4))[0], image.info["duration"]))
    assert found == [(0, 200), (120, 200), (250, 600)]


def test_a_film_that_is_cut_off_is_refused(tmp_path):
    """As on a full disk, of which ffmpeg says nothing."""
    pytest.importorskip("imageio_ffmpeg")
    rng, before = np.random.default_rng(0), resource.getrlimit(resource.RLIMIT_FSIZE)
    noise = iter(rng.integers(0, 255, (30, 64, 96, 3), np.uint8))
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))
    try:
        fails("only 0 of 30 frames", write_film, tmp_path / "a.mp4", noise, [0.1] * 30)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(tmp_path.iterdir()) == []


def test_the_command_draws_pictures_side_by_side(run, tmp_path):
    out = tmp_path / "a.png"
    command("video", run, "--out", out, "--seconds", 1, "--beside", "uncertainty", "--fps", 5)
    with Image.open(out) as image:
        assert image.n_frames == 5
        assert image.size == (2 * tiny.WIDTH + 4, tiny.HEIGHT)


def test_the_story_has_a_frame_for_each_view(run, figures, tmp_path, monkeypatch):
    change_settings(run, policy="python:mine.best")  # the story chooses nothing

    def models(run, problem):
        for count in range(1, len(run.state.taken) + 1):
            yield replace(run.state, taken=run.state.taken[:count])

    monkeypatch.setattr("mgs.reports.video.models", models)
    command("video", run, "--out", tmp_path / "a.gif", "--story")
    with Image.open(tmp_path / "a.gif") as image:
        assert image.n_frames > 1
        assert image.size[0] > 800


def test_nothing_is_unknown_in_a_view_of_nothing():
    assert _left({"uncertainty": np.ones((2, 2)), "A": np.zeros((2, 2))}) == 0


def test_a_missing_encoder_is_one_line(run, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    line = refused(capsys, ["video", run, "--out", tmp_path / "a.mp4"], tmp_path)
    assert "`pip install imageio-ffmpeg`, or write a .gif" in line


@pytest.mark.parametrize("on_demand", [False, True])
def test_the_story_shows_a_new_view_where_one_has_an_image(run, on_demand):
    opened = open_run(run)
    names = [frame.name for frame in opened.taken]
    if on_demand:  # then only views that were taken have one
        frames = [replace(frame, on_demand=True) for frame in opened.dataset.frames]
        gone = Path("nowhere.png")
        frames = [f if f.name in names else replace(f, image_path=gone) for f in frames]
        opened.dataset = replace(opened.dataset, frames=tuple(frames))
    unknown = {"uncertainty": np.ones(len(opened.gaussians))}
    shown = _shown_view(opened, opened.state, unknown)
    assert (shown.name in names) == on_demand
