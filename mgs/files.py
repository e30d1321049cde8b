"""Files: nothing is ever half-written. Outputs go to a temporary name beside the target and are renamed."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, TextIO

from mgs.errors import InputError


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path` (same suffix); rename it on success, delete it on failure.

    Raises InputError where it cannot be written: no permission, a file in place of a folder, a full disk.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise _not_writable(path, error) from None
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def _not_writable(path: Path, error: OSError) -> InputError:
    return InputError(f"{path}: cannot be written ({error.strerror or error}); choose a place you may write to, with room")


def check_writable(path: str | Path) -> Path:
    """The path, where a file or folder could be made there. Makes nothing. Raises InputError where it could not."""
    path = Path(path)
    try:
        there = next(parent for parent in (path, *path.absolute().parents) if parent.exists())
        with TemporaryFile(dir=there if there.is_dir() or there != path else there.parent):
            return path
    except OSError as error:
        raise _not_writable(path, error) from None


@contextmanager
def reading(path: Path, what: str = "file") -> Iterator[None]:
    """While `path` is read, errors of the file system become one line: InputError, no such `what`, or why it cannot be read."""
    try:
        yield
    except FileNotFoundError:
        raise InputError(f"{path}: no such {what}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); give a file that can be read") from None


def copy_file(source: Path, path: Path) -> None:
    """Copy a file, atomically. Raises InputError where the source cannot be read or the copy cannot be written."""
    with reading(source):
        data = source.read_bytes()
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def fingerprint(path: str | Path) -> dict[str, str]:
    """Name and SHA-256 of a file, to tell later whether it is still the same."""
    return {"name": Path(path).name, "sha256": hashlib.sha256(Path(path).read_bytes()).hexdigest()}


def write_json(path: str | Path, data: Any) -> None:
    """Write JSON (indented, UTF-8), atomically. Raises ValueError for NaN and infinities, which JSON has not: use None."""
    text = json.dumps(data, indent=2, allow_nan=False)
    with atomic_path(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def read_json(path: str | Path) -> Any:
    """Read JSON. Raises InputError where the file is missing, not a file that can be read, or not JSON."""
    path = Path(path)
    with reading(path):
        data = path.read_bytes()
    try:
        return json.loads(data.decode("utf-8-sig"))  # some tools put a byte-order mark in front
    except (ValueError, RecursionError) as error:  # also of numbers or nestings that Python refuses
        raise InputError(f"{path}: not valid JSON ({error}); the file is damaged, write it again") from None


def check_new_folder(path: str | Path) -> Path:
    """The path, where an output folder could be made there; makes nothing. Raises InputError as `new_folder`."""
    path = check_writable(path)
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file, not a folder; choose another output folder")
    if path.is_dir() and any(path.iterdir()):
        raise InputError(f"{path}: the output folder is not empty; choose a new one or delete it")
    return path


def new_folder(path: str | Path) -> Path:
    """Create an output folder. Raises InputError where it is a file, is not empty, or cannot be written."""
    path = check_new_folder(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _not_writable(path, error) from None
    return path


@contextmanager
def folder_or_nothing(path: str | Path) -> Iterator[Path]:
    """Yield a new folder; where the block fails, all is as it was: no folder, no parents, or the empty one there was."""
    path = check_new_folder(path)
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    new_folder(path)
    try:
        yield path
    except BaseException:
        if made:
            shutil.rmtree(path, ignore_errors=True)
        else:
            for child in path.iterdir():
                shutil.rmtree(child) if child.is_dir() else child.unlink()
        with suppress(OSError):
            for folder in made[1:]:
                folder.rmdir()
        raise


@contextmanager
def atomic_folder(path: str | Path) -> Iterator[Path]:
    """Yield a temporary folder beside `path`, which becomes `path` at the end: a kill leaves no half of it.

    Raises InputError as `new_folder`.
    """
    path = check_new_folder(path).resolve()
    with folder_or_nothing(path.with_name(f".{path.name}.{os.getpid()}.part")) as temporary:
        yield temporary
        try:
            os.replace(temporary, path)
        except OSError as error:
            raise _not_writable(path, error) from None


@contextmanager
def locked(folder: str | Path) -> Iterator[None]:
    """Keep every other process that asks for this lock out of a folder while the block runs.

    Raises InputError where another one has it (names its id), or the folder cannot be written. The lock is the kernel's, on the
    file FOLDER/.lock: it ends with the process, however that ends, so a file that a killed process left locks nothing.
    """
    path = Path(folder) / ".lock"
    try:
        file = _lock(path)
    except OSError as error:
        raise _not_writable(path, error) from None
    with file:
        try:
            yield
        finally:
            with suppress(OSError):
                path.unlink()


def _lock(path: Path) -> TextIO:
    """The file, locked and with this process's id in it. Raises InputError where another process has it."""
    while True:
        with ExitStack() as closed_on_failure:
            file = closed_on_failure.enter_context(open(path, "a+", encoding="ascii"))
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                file.seek(0)
                raise InputError(f"{path.parent}: process {file.read()} works on it; wait until it has ended") from None
            try:
                ours = os.path.samestat(os.fstat(file.fileno()), os.stat(path))
            except FileNotFoundError:
                ours = False
            if ours:  # not a file that its last owner removed after we opened it
                file.truncate(0)
                print(os.getpid(), end="", file=file, flush=True)
                closed_on_failure.pop_all()
                return file
