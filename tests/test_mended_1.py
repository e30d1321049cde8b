"""Mended: the hint after Ctrl-C, names of refused pictures, a scene beside live capture."""

import pytest

import mgs
from mgs.cli.app import _hint
from mgs.errors import InputError
from mgs.run.live import _set_aside


def test_the_hint_knows_options_with_an_equals_sign(tmp_path):
    (tmp_path / "config.json").touch()
    given = ["nbv", "data", f"--out={tmp_path}", "--capture-command=fly {pose}", "--seed", "3"]
    again = f"; continue with: mgs nbv --resume {tmp_path} --capture-command 'fly {{pose}}'"
    assert _hint(given) == again
    assert _hint(["fit", "data", "--out", str(tmp_path)]) == again.partition(" --capture")[0]


def test_a_refused_picture_gets_the_next_number_whatever_lies_beside_it(tmp_path):
    for name in ("kf.png", "kf.refused-1x.png", "kf.refused-2.png"):
        (tmp_path / name).touch()
    _set_aside(tmp_path / "kf.png")
    assert (tmp_path / "kf.refused-3.png").is_file()


def test_a_scene_and_live_capture_exclude_each_other(tmp_path):
    with pytest.raises(InputError, match=r"renders images, and .* awaits them"):
        mgs.run_nbv(None, tmp_path / "run", capture="boulder", live=lambda pose, out: None)
