"""A stranger's folder or file cannot write elsewhere, nest without end, or run."""

import os
from pathlib import Path

import pytest
from program import command
from refusals import refused

from mgs.errors import InputError
from mgs.files import (
    atomic_folder,
    atomic_path,
    below,
    check_writable,
    folder_locked,
    locked,
    remove_file,
    remove_leftovers,
    scratch_folder,
    write_csv,
)


@pytest.fixture
def outside(tmp_path):
    """A folder with a file that must stay as it is."""
    folder = tmp_path / "outside"
    folder.mkdir()
    (folder / "a").write_text("mine")
    yield folder
    assert [path.name for path in folder.iterdir()] == ["a"]
    assert (folder / "a").read_text() == "mine"


def test_nothing_below_a_locked_folder_is_written_through_a_link(outside, tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    (run / "renders").symlink_to(outside)
    (run / "b").symlink_to(outside / "a")
    with locked(run):
        for path in (run / "renders/a", run / "renders/new/a"):
            with pytest.raises(InputError, match="leads out of"), atomic_path(path):
                pass
        for path in (run / "renders/a", outside / "a"):
            with pytest.raises(InputError, match=r"leads out of|is not in"):
                remove_file(run, path)
        with atomic_path(run / "b") as temporary:  # the link itself is replaced
            temporary.write_text("ours")
        remove_leftovers(run)
        assert (run / "b").read_text() == "ours"
        assert not (run / "b").is_symlink()
    with pytest.raises(InputError, match="leads out of"):
        below(run, "renders")
    for name in ("../outside", str(outside)):
        with pytest.raises(InputError, match="leads out of"):
            below(run, name)


@pytest.mark.parametrize("use", [locked, folder_locked])
@pytest.mark.parametrize("kind", ["link", "text", "folder"])
def test_a_lock_that_mgs_did_not_make(outside, tmp_path, use, kind):
    run = tmp_path / "run"
    run.mkdir()
    lock = run / ".lock"
    {
        "link": lambda: lock.symlink_to(outside / "a"),
        "text": lambda: lock.write_text("mine"),
        "folder": lock.mkdir,
    }[kind]()
    with pytest.raises(InputError, match=r"\.lock: is in the way"), use(run):
        pass
    assert os.path.lexists(lock)


@pytest.mark.parametrize("kind", ["link", "folder"])
def test_a_folder_named_as_a_leftover_is_not_deleted(outside, tmp_path, kind):
    for name in (".out.part", ".out.old", "scratch"):
        place = tmp_path / name
        if kind == "link":
            place.symlink_to(outside)
        else:
            place.mkdir()
            (place / "b").touch()
    for make in (lambda: atomic_folder(tmp_path / "out"), lambda: scratch_folder(place)):
        with pytest.raises(InputError, match="is in the way, and mgs did not make it"), make():
            pass
    assert kind == "link" or (place / "b").is_file()


def test_a_scratch_folder_leaves_nothing(tmp_path):
    for _ in range(2):
        with scratch_folder(tmp_path / "x") as made:
            assert [path.name for path in made.iterdir()] == [".lock"]
            (made / "a").touch()
        assert not made.exists()
        (tmp_path / "x").mkdir()  # as a killed process leaves it
        (tmp_path / "x/.lock").write_text("mgs 1")
        (tmp_path / "x/a").touch()


@pytest.mark.parametrize("make", [atomic_path, lambda path: locked(path.parent)])
def test_a_device_is_not_replaced(tmp_path, make):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for path in (pipe, Path("/dev/null")):
        with pytest.raises(InputError, match="is a device or a pipe"):
            check_writable(path)
        with pytest.raises(InputError, match="is a device or a pipe"), atomic_path(path):
            pass
    assert pipe.is_fifo()


def test_half_characters_of_names_are_written(tmp_path):
    write_csv(tmp_path / "a.csv", [{"name": "a\udcff"}])
    assert (tmp_path / "a.csv").read_bytes() == b"name\na\\udcff\n"


def test_a_name_is_no_markup_and_controls_no_terminal(tmp_path, dataset, capsys):
    folder = tmp_path / "a[" / "b]\x1b[31m"
    folder.parent.mkdir()
    folder.symlink_to(dataset)
    command("dataset", "check", folder)
    text = "".join(capsys.readouterr())
    assert "a[/b]\\x1b[31m: " in text.replace("\n", "")
    assert "\x1b" not in text


def test_a_name_that_is_not_utf_8_is_refused(capsys):
    assert "a\\udcff: is not UTF-8" in refused(capsys, ["dataset", "check", "a\udcff"])


def test_a_strangers_settings_name_a_program_that_is_not_run(tmp_path, dataset, capsys):
    (tmp_path / "evil.py").write_text("raise SystemExit")
    (tmp_path / "a.toml").write_text(f'policy = "{tmp_path}/evil.py:f"')
    asked = ["nbv", dataset, "--config", tmp_path / "a.toml", "--out", tmp_path / "run"]
    assert f"to run it, add --policy {tmp_path}/evil.py:f" in refused(capsys, asked)
