"""Atomic reading and writing of files and folders.

Output goes to a temporary name in the same folder and is renamed when complete. A process that is
killed meanwhile leaves the temporary file, but never an incomplete file under the real name.
"""

from __future__ import annotations

import csv
import fcntl
import hashlib
import json
import os
import shutil
import stat
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, TextIO

from mgs.errors import InputError
from mgs.memory import check_room, decoding


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Context manager: a temporary path with the same suffix, renamed to `path` after the block.

    If the block fails, the temporary file is deleted. Missing parent folders are made. Raises
    InputError if the path cannot be written: no permission, a file in place of a folder, a full
    disk.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise not_writable(path, error) from None
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def remove_leftovers(folder: Path) -> None:
    """Remove the temporary files that ended processes left in a folder and below it."""
    for left in folder.rglob(".*.[0-9]*.part*"):
        process = left.name.partition(".part")[0].rpartition(".")[2]
        if process == str(os.getpid()) or not Path("/proc", process).exists():
            left.unlink(missing_ok=True)


def not_writable(path: Path, error: Exception) -> InputError:
    """InputError for a path that cannot be written, with the reason of the system."""
    return InputError(
        f"{path}: cannot be written ({getattr(error, 'strerror', None) or error}); "
        "choose a place you may write to, with room"
    )


def check_writable(path: str | Path) -> Path:
    """Check that a file or folder could be written at `path`, and return it as a Path.

    Makes nothing; commands call it before long work. Raises InputError if it could not be written.
    """
    path = Path(path)
    try:
        there = next(parent for parent in (path, *path.absolute().parents) if parent.exists())
        with TemporaryFile(dir=there if there.is_dir() or there != path else there.parent):
            return path
    except OSError as error:
        raise not_writable(path, error) from None


@contextmanager
def reading(path: Path, what: str = "file") -> Iterator[None]:
    """Context manager: turns an OSError of its block into an InputError.

    Its line says that there is no such `what`, or why it cannot be read. Pipes and devices are
    refused, since reading one may never end, and files larger than the free memory.
    """
    try:
        found = path.stat()
        if stat.S_IFMT(found.st_mode) not in (stat.S_IFREG, stat.S_IFDIR):
            raise InputError(f"{path}: is no regular file; give a file, not a pipe or a device")
        check_room(found.st_size, f"{path}: reading it", "give a smaller file")
        yield
    except FileNotFoundError:
        raise InputError(f"{path}: no such {what}") from None
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror or error}); give a file that can be read"
        ) from None


@contextmanager
def parsing(path: Path, what: str, cure: str) -> Iterator[None]:
    """Context manager: turns errors of a damaged file into an InputError, and bounds the memory
    (`mgs.memory.decoding`).

    what: kind of file. cure: end of the line. All errors count, since libraries raise many types.
    """
    try:
        with decoding(path):
            yield
    except InputError:
        raise
    except Exception as error:
        reason = " ".join(str(error).split())[:120]
        raise InputError(f"{path}: not a readable {what} ({reason}); {cure}") from None


def copy_file(source: Path, path: Path) -> None:
    """Copy a file; the copy appears complete. Raises InputError if the source cannot be read or the
    copy cannot be written."""
    with reading(source):
        data = source.read_bytes()
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def fingerprint(path: str | Path) -> dict[str, str]:
    """Name (without folders) and SHA-256 hash of a file. Raises OSError."""
    return {"name": Path(path).name, "sha256": hashlib.sha256(Path(path).read_bytes()).hexdigest()}


def write_json(path: str | Path, data: Any) -> None:
    """Write data as indented JSON in UTF-8; the file appears complete.

    Raises ValueError for NaN and infinities, which JSON cannot express (write None instead), and
    InputError as `atomic_path`.
    """
    text = json.dumps(data, indent=2, allow_nan=False)
    with atomic_path(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def write_csv(path: str | Path, rows: Sequence[Mapping[str, Any]]) -> Path:
    """Write records as CSV in UTF-8 and return the path; the file appears complete.

    Columns are all keys in order of appearance. None and missing keys give empty cells. Raises
    InputError as `atomic_path`.
    """
    columns = list(dict.fromkeys(key for row in rows for key in row))
    with atomic_path(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return Path(path)


def read_json(path: str | Path) -> Any:
    """Contents of a JSON file. Raises InputError if it is missing, unreadable or not valid JSON."""
    path = Path(path)
    with reading(path):
        data = path.read_bytes()
    try:
        return json.loads(data.decode(json.detect_encoding(data)))  # UTF-8, -16 or -32
    except (ValueError, RecursionError) as error:  # RecursionError: nested too deeply
        raise InputError(
            f"{path}: not valid JSON ({error}); the file is damaged, write it again"
        ) from None


THERE = "is there already; choose another place, or replace it with --force"
"""End of the message of every command whose output exists."""


def check_new_file(path: str | Path, force: bool = False) -> Path:
    """Check that a file may be written at `path`, and return it as a Path.

    Raises InputError if it could not be written, or if it exists and is a folder or not to be
    replaced (force).
    """
    path = check_writable(path)
    if path.is_dir():
        raise InputError(f"{path}: is a folder; name a file to write")
    if path.exists() and not force:
        raise InputError(f"{path}: {THERE}")
    return path


@dataclass(frozen=True)
class Ours:
    """A kind of output folder that `--force` may replace.

    names: patterns of what the command writes there; the first is in every such folder. A folder
    with anything else is left alone. reads: paths that the command reads, which it must not delete.
    """

    names: Sequence[str]
    reads: Sequence[str | Path] = ()

    def check(self, folder: Path) -> None:
        """Raises InputError where a folder is not of this kind, or holds a path that is read."""
        there = {path.name for path in folder.iterdir()}
        known = (*self.names, LOCK, ".*.part*")
        other = [name for name in sorted(there) if not any(fnmatch(name, one) for one in known)]
        kept = [str(path) for path in self.reads if folder.resolve() in resolved_parents(path)]
        why = ""
        if kept:
            why = f"{kept[0]} is in it and is read"
        elif other or self.names[0] not in there:
            why = f"it holds {other[0]}" if other else f"it has no {self.names[0]}"
            why = f"this command did not make it, since {why}"
        if why:
            raise InputError(f"{folder}: --force leaves it alone: {why}; choose another folder")


def resolved_parents(path: str | Path) -> list[Path]:
    """The path itself and all folders that hold it, without symbolic links."""
    whole = Path(path).resolve()
    return [whole, *whole.parents]


def check_new_folder(path: str | Path, ours: Ours | None = None) -> Path:
    """Check that an output folder can be made at `path`, and return it as a Path. Makes nothing.

    ours: kind of folder that may be there, to be replaced. Raises InputError if `path` is a file,
    is a folder that is not empty or in which another process works, or could not be written.
    """
    path = check_writable(path)
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file, not a folder; choose another output folder")
    if path.is_dir() and any(there.name != LOCK for there in path.iterdir()):
        _check_unlocked(path / LOCK)
        if ours is None:
            raise InputError(f"{path}: {THERE}")
        ours.check(path)
    return path


def clear_folder(path: Path, ours: Ours) -> None:
    """Delete what a folder of this kind holds. Raises InputError as `check_new_folder`."""
    if check_new_folder(path, ours).is_dir():
        with locked(path):
            _clear(path)


@contextmanager
def atomic_folder(path: str | Path, ours: Ours | None = None) -> Iterator[Path]:
    """Context manager: a temporary folder beside `path`, renamed to it after the block.

    So a folder named `path` is always complete. The temporary folder is locked. If the block fails,
    it and the parents made for it are removed; what a killed process left in it is removed first.
    ours: kind of folder that may be there, which the new one replaces. Raises InputError as
    `check_new_folder`, and if another process makes the same folder.
    """
    path = check_new_folder(path, ours).resolve()
    temporary, replaced = (path.with_name(f".{path.name}.{end}") for end in ("part", "old"))
    try:
        with folder_locked(temporary):
            try:
                _clear(temporary)
                yield temporary
                try:
                    if any(check_new_folder(path, ours).glob("*")):
                        shutil.rmtree(replaced, ignore_errors=True)
                        os.replace(path, replaced)
                    (path / LOCK).unlink(missing_ok=True)  # of a killed process
                    os.replace(temporary, path)
                    (path / LOCK).unlink()
                    shutil.rmtree(replaced, ignore_errors=True)
                except OSError as error:
                    raise not_writable(path, error) from None
            except BaseException:
                _clear(temporary)
                raise
    finally:
        with suppress(OSError):
            temporary.rmdir()


def _clear(folder: Path) -> None:
    """Remove everything in a folder but its lock."""
    with suppress(OSError):
        for left in folder.iterdir():
            if left.is_dir() and not left.is_symlink():
                shutil.rmtree(left, ignore_errors=True)
            elif left.name != LOCK:
                left.unlink()


@contextmanager
def folder_locked(folder: str | Path) -> Iterator[None]:
    """Context manager: makes a folder and its parents, and holds its lock. Afterwards, those that
    it made and that are still empty are removed. Raises InputError as `locked`."""
    folder = Path(folder)
    try:
        made = [each for each in (folder, *folder.parents) if not each.exists()]
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise InputError(
            f"{folder}: is a file, not a folder; choose another output folder"
        ) from None
    except OSError as error:
        raise not_writable(folder, error) from None
    try:
        with locked(folder):
            yield
    finally:
        with suppress(OSError):
            for each in made:
                each.rmdir()


LOCK = ".lock"
"""File in a folder that the process that works in it has locked."""

_held: set[Path] = set()
"""Locks that this process holds."""


@contextmanager
def locked(folder: str | Path) -> Iterator[None]:
    """Context manager: holds the lock of a folder, which no other process gets meanwhile.

    Raises InputError if another process holds it, naming that process, and if the folder cannot be
    written. The system keeps the lock on the file FOLDER/.lock and releases it when the process
    ends, so a file .lock that is left over locks nothing.
    """
    path = Path(folder) / LOCK
    try:
        file = _lock(path)
    except OSError as error:
        raise not_writable(path, error) from None
    with file:
        _held.add(path.resolve())
        try:
            yield
        finally:
            _held.discard(path.resolve())
            with suppress(OSError):
                path.unlink()


@contextmanager
def working_in(folder: str | Path) -> Iterator[None]:
    """Context manager: holds the lock of a folder of mgs, without what ended processes left in it.
    Raises InputError as `locked`."""
    with locked(folder):
        remove_leftovers(Path(folder))
        yield


def _lock(path: Path) -> TextIO:
    """Open and lock the file, and write this process's id into it. Raises InputError if another
    process has locked it."""
    while True:  # until the locked file is the one of this name
        with ExitStack() as closed_on_failure:
            file = closed_on_failure.enter_context(open(path, "a+", encoding="ascii"))
            _flock(path, file)
            try:
                ours = os.path.samestat(os.fstat(file.fileno()), os.stat(path))
            except FileNotFoundError:
                ours = False
            if ours:  # else the process that had the lock removed the file after we opened it
                file.truncate(0)
                print(os.getpid(), end="", file=file, flush=True)
                closed_on_failure.pop_all()
                return file


def _flock(path: Path, file: TextIO) -> None:
    """Lock an open file. Raises InputError, with the process, if another one has locked it."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.seek(0)
        raise InputError(
            f"{path.parent}: process {file.read()} works on it; wait until it has ended"
        ) from None


def _check_unlocked(path: Path) -> None:
    """Raise InputError if another process holds a lock, which is not taken."""
    if path.resolve() in _held:
        return
    with suppress(OSError), open(path, encoding="ascii") as file:
        _flock(path, file)
