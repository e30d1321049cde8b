"""Atomic reading and writing of files and folders: output gets a temporary name in the same folder
and is renamed when complete, so a killed process leaves no incomplete file."""

import csv
import fcntl
import hashlib
import io
import json
import math
import os
import re
import secrets
import shutil
import stat
import tomllib
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from fnmatch import fnmatch
from itertools import islice
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, TextIO

from mgs.errors import InputError, NoRoom
from mgs.memory import check_room, decoding


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Context manager: a temporary path with the same suffix, renamed to `path` after the block.

    If the block fails, the temporary file is deleted. Missing parent folders are made. Raises
    InputError if the path cannot be written: no permission, a file in place of a folder, a full
    disk, a device, or a symbolic link on the way (`check_place`)."""
    path = Path(path)
    check_place(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}-{TOKEN}.part{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise not_writable(path, error) from None
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


TOKEN = secrets.token_hex(4)  # in names of temporary files: nobody can put a link there
LEFTOVER = re.compile(r"\..*\.(\d+)-[0-9a-f]{8}\.part(\..*)?")  # with the number of its process


def check_place(path: Path) -> None:
    """Raise InputError if writing or removing `path` would leave a folder that this process has
    locked, through a symbolic link, or would replace a device or a pipe."""
    path = Path(os.path.abspath(path))
    streams = path.parent.resolve()  # /dev/stdout may lead to a file, and would be replaced
    special = streams == Path("/dev") or Path("/proc") in streams.parents
    if special or (path.exists() and not (path.is_file() or path.is_dir())):
        raise InputError(f"{path}: is a device or a pipe; name a file to write")
    for root in _held:
        if root in path.parents:
            below(root, path.parent.relative_to(root))


def below(root: str | Path, *names: str | Path) -> Path:
    """Path below a folder. Raises InputError if it leads out of it: a symbolic link, or `..`."""
    path = Path(root)
    for name in Path(*names).parts:
        path /= name
        if name in ("..", os.sep) or path.is_symlink():
            raise InputError(f"{path}: leads out of {root}; remove the link, or copy what it names")
    return path


def remove_file(root: Path, path: Path) -> None:
    """Remove a file below a folder, if it exists. Raises InputError if it is elsewhere or stays."""
    if not path.is_relative_to(root):
        raise InputError(f"{path}: is not in {root}, and is not removed; correct its path")
    below(root, path.relative_to(root).parent)
    try:
        path.unlink(missing_ok=True)
    except (OSError, ValueError) as error:  # ValueError: no name of a file
        raise not_writable(path, error) from None


def remove_leftovers(folder: Path, below_it: bool = True) -> None:
    """Remove the temporary files that ended processes left in a folder, and those below it."""
    for where, _, names in islice(os.walk(folder), None if below_it else 1):
        for name in names:
            match, path = LEFTOVER.fullmatch(name), Path(where, name)
            if match and not path.is_symlink() and path.is_file():
                mine = int(match[1]) == os.getpid()
                if mine or not Path("/proc", match[1]).exists():
                    path.unlink(missing_ok=True)


def not_writable(path: Path, error: Exception) -> InputError:
    """InputError for a path that cannot be written, with the reason of the system."""
    reason = getattr(error, "strerror", None) or str(error).partition("\n")[0]
    cure = "choose a place you may write to, with room"
    return InputError(f"{path}: cannot be written ({reason}); {cure}")


def check_writable(path: str | Path) -> Path:
    """Check that a file or folder could be written at `path`, and return it as a Path. Makes
    nothing; commands call it before long work. Raises InputError if it could not be written."""
    path = Path(path)
    check_place(path)
    try:
        there = next(parent for parent in (path, *path.absolute().parents) if parent.exists())
        with TemporaryFile(dir=there if there.is_dir() or there != path else there.parent):
            return path
    except OSError as error:
        raise not_writable(path, error) from None


@contextmanager
def reading(path: Path, what: str = "file") -> Iterator[None]:
    """Context manager: turns an OSError of its block into an InputError. Its line says that there
    is no such `what`, or why it cannot be read. Pipes and devices are refused, since reading one
    may never end, and files larger than the free memory."""
    try:
        about = path.stat()
        if stat.S_IFMT(about.st_mode) not in (stat.S_IFREG, stat.S_IFDIR):
            raise InputError(f"{path}: is no regular file; give a file, not a pipe or a device")
        check_room(about.st_size, f"{path}: reading it", "give a smaller file")
        yield
    except FileNotFoundError:
        raise InputError(f"{path}: no such {what}") from None
    except OSError as error:
        why = error.strerror or error
        raise InputError(f"{path}: cannot be read ({why}); give one that can be read") from None


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
    """Write data as indented JSON; the file appears complete. Raises ValueError for NaN and
    infinities, which JSON cannot express (write None instead), and InputError as `atomic_path`."""
    write_text(path, json.dumps(data, indent=2, allow_nan=False) + "\n")


def write_text(path: str | Path, text: str) -> None:
    """Write text as UTF-8; the file appears complete. Half characters of file names are escaped.
    Raises InputError as `atomic_path`."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(text.encode(errors="backslashreplace"))


LARGEST = 1 << 25  # most bytes of a text file that is read whole: 30,000 frames of transforms.json
LARGEST_TOML, LONGEST_LINE = 1 << 16, 1 << 12  # bytes of a file, a line: a.a.a = 1 takes cubic time


def write_columns(
    path: str | Path,
    elements: Mapping[str, Mapping[str, tuple[Any, str]]],
    comments: Sequence[str] = (),
) -> None:
    """Write a binary PLY, atomically. elements: the properties of each, name -> (values [N], type
    of NumPy). Raises InputError if it cannot be written."""
    import numpy as np
    from plyfile import PlyData, PlyElement

    tables = []
    for element, columns in elements.items():
        layout = [(name, kind) for name, (_, kind) in columns.items()]
        table = np.rec.fromarrays([values for values, _ in columns.values()], dtype=layout)
        tables.append(PlyElement.describe(table, element))
    with atomic_path(path) as temporary:
        PlyData(tables, byte_order="<", comments=list(comments)).write(str(temporary))


def read_bytes(path: str | Path, what: str = "file", most: int = LARGEST) -> bytes:
    """Contents of a file. Raises InputError if it is missing, unreadable or larger than `most`."""
    path = Path(path)
    with reading(path, what):
        if (size := path.stat().st_size) > most:
            raise InputError(f"{path}: has {size:,} bytes, more than {most:,}; give another file")
        return path.read_bytes()


def read_text(path: str | Path) -> str:
    """Text of a file in UTF-8; what is not UTF-8 is replaced. Raises InputError as `read_bytes`."""
    return read_bytes(path).decode("utf-8-sig", errors="replace")


def read_json(path: str | Path) -> Any:
    """Contents of a JSON file. Raises InputError if it is missing, unreadable or not valid JSON."""
    return _parsed(path, "JSON", lambda data: json.loads(data.decode(json.detect_encoding(data))))


def read_leftover(path: Path) -> Any:
    """Read JSON that a process left in a folder of its own. None where it is missing or damaged."""
    try:
        return read_json(path) if path.is_file() else None
    except InputError:
        return None


def stored_array(file: zipfile.ZipFile, name: str, kind: str) -> Any:
    """An array of an NPZ file. Raises ValueError unless it is stored as it is, its dtype is of
    this kind, and it is as long as its header says, so that it takes no more memory than disk."""
    import numpy as np

    info = file.getinfo(f"{name}.npy")
    if info.compress_type != zipfile.ZIP_STORED or info.flag_bits & 1:
        raise ValueError(f"{name} is compressed")
    with file.open(info) as member:
        version = np.lib.format.read_magic(member)
        if version not in ((1, 0), (2, 0)):
            raise ValueError(f"{name} has a header of another version")
        read = np.lib.format.read_array_header_1_0
        read = read if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran, dtype = read(member)
        if dtype.kind != kind or dtype.hasobject:
            raise ValueError(f"{name} has dtype {dtype}")
        data = member.read()
    if math.prod(shape) * dtype.itemsize != len(data):
        raise ValueError(f"{name} has shape {shape} in {len(data)} bytes")
    return np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C").copy("K")


def read_toml(path: str | Path) -> dict[str, Any]:
    """Contents of a TOML file. Raises InputError if it is missing, unreadable or not valid TOML."""

    def values(data: bytes) -> dict[str, Any]:
        if max(map(len, data.splitlines()), default=0) > LONGEST_LINE:
            raise ValueError(f"a line has more than {LONGEST_LINE:,} characters")
        return tomllib.loads(data.decode())

    table: dict[str, Any] = _parsed(path, "TOML", values, LARGEST_TOML)
    return table


def read_csv(path: str | Path) -> list[tuple[int, list[str]]]:
    """Rows of a CSV file that are not empty, each after the number of its last line. Raises
    InputError if it is missing, unreadable or not valid CSV."""

    def rows(data: bytes) -> list[tuple[int, list[str]]]:
        table = csv.reader(io.StringIO(data.decode("utf-8-sig", errors="replace"), newline=""))
        return [(table.line_num, row) for row in table if any(cell.strip() for cell in row)]

    lines: list[tuple[int, list[str]]] = _parsed(path, "CSV", rows)
    return lines


def read_xml(path: str | Path) -> Any:
    """Root element of an XML file without entities. Raises InputError if it is missing, unreadable
    or not valid XML."""
    from defusedxml.ElementTree import fromstring

    return _parsed(path, "XML", fromstring)


def _parsed(path: str | Path, kind: str, parse: Callable[[bytes], Any], most: int = LARGEST) -> Any:
    """Contents of a text file. Raises InputError where `parse` fails on them, and beyond `most`."""
    data = read_bytes(path, most=most)
    try:
        with decoding(Path(path)):
            return parse(data)
    except (ValueError, RecursionError, SyntaxError, LookupError, csv.Error) as error:
        # RecursionError: nested too deeply; SyntaxError: of XML; LookupError: of its encoding
        reason = "nested too deeply" if isinstance(error, RecursionError) else str(error)[:200]
        raise InputError(f"{path}: not valid {kind} ({reason}); {DAMAGED}") from None


DAMAGED = "the file is damaged, write it again"
THERE = "is there already; choose another place, or replace it with `force`"
"""End of the message of every command whose output exists."""


def check_new_file(path: str | Path, force: bool = False) -> Path:
    """Check that a file may be written at `path`, and return it as a Path. Raises InputError if it
    could not be written, or if it exists and is a folder or not to be replaced (force)."""
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
        own = (*self.names, LOCK, ".*.part*")
        other = [name for name in sorted(there) if not any(fnmatch(name, one) for one in own)]
        place = folder.resolve()
        inputs = [str(path) for path in self.reads if Path(path).resolve().is_relative_to(place)]
        why = ""
        if inputs:
            why = f"{inputs[0]} is in it and is read"
        elif other or self.names[0] not in there:
            why = f"it holds {other[0]}" if other else f"it has no {self.names[0]}"
            why = f"this command did not make it, since {why}"
        if why:
            raise InputError(f"{folder}: `force` leaves it alone: {why}; choose another folder")


def check_new_folder(path: str | Path, ours: Ours | None = None) -> Path:
    """Check that an output folder can be made at `path`, and return it as a Path. Makes nothing.

    ours: kind of folder that may be there, to be replaced. Raises InputError if `path` is a file,
    is a folder that is not empty or in which another process works, or could not be written."""
    path = check_writable(path)
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file, not a folder; choose another output folder")
    if path.is_dir() and any(there.name != LOCK for there in path.iterdir()):
        check_unlocked(path)
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
    `check_new_folder`, and if another process makes the same folder."""
    path = check_new_folder(path, ours).resolve()
    temporary, replaced = (path.with_name(f".{path.name}.{end}") for end in ("part", "old"))
    for each in (temporary, replaced):
        check_leftover(each)
    try:
        with folder_locked(temporary):
            try:
                _clear(temporary)
                yield temporary
                try:
                    if any(check_new_folder(path, ours).glob("*")):
                        shutil.rmtree(replaced, ignore_errors=True)
                        if not _is_lock(path / LOCK):
                            _lock(path / LOCK).close()  # the token of `check_leftover`
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


def check_leftover(folder: Path) -> None:
    """Raise InputError unless a folder is missing, empty, or left by a killed process."""
    if not os.path.lexists(folder):
        return
    if not folder.is_symlink() and folder.is_dir():
        names = [path.name for path in folder.iterdir()]
        if not names or _is_lock(folder / LOCK, names == [LOCK]):
            return
    raise in_the_way(folder)


def in_the_way(path: Path) -> InputError:
    """InputError for a path that mgs needs and did not make."""
    return InputError(f"{path}: is in the way, and mgs did not make it; move it away")


def _is_lock(path: Path, or_empty: bool = False) -> bool:
    """Whether a path is a lock file of mgs, or an empty file."""
    if path.is_symlink() or not path.is_file():
        return False
    with path.open("rb") as file:
        data = file.read(len(MARK))  # of a file of any length
    return data == MARK.encode() or (or_empty and not data)


@contextmanager
def scratch_folder(path: str | Path, resumable: str = "") -> Iterator[Path]:
    """Context manager: a folder for temporary files, removed after the block with all its contents.

    resumable: pattern of files worth keeping. Empty: the folder is cleared before and after. Else
    an interruption or NoRoom keeps it, and a refused input does where it holds such a file or was
    not empty. Raises InputError if a folder of this name is there that mgs did not make, or that
    another process uses."""
    path = Path(path)
    check_leftover(path)
    ended = True
    try:
        with folder_locked(path):
            if not resumable:
                _clear(path)
            before = any(entry.name != LOCK for entry in path.iterdir())
            try:
                yield path
            except BaseException as error:
                worth = before or isinstance(error, NoRoom) or not isinstance(error, InputError)
                ended = not (resumable and (worth or any(path.glob(resumable))))
                raise
            finally:
                if ended:
                    _clear(path)
    finally:
        if not ended and path.is_dir():  # which has something to continue
            (path / LOCK).write_text(MARK, encoding="ascii")
        with suppress(OSError):
            path.rmdir()


def _clear(folder: Path) -> None:
    with suppress(OSError):
        for entry in folder.iterdir():
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry, ignore_errors=True)
            elif entry.name != LOCK:
                entry.unlink()


@contextmanager
def folder_locked(folder: str | Path) -> Iterator[None]:
    """Context manager: makes a folder and its parents, and holds its lock. Afterwards, those that
    it made and that are still empty are removed. Raises InputError as `locked`."""
    folder = Path(folder)
    try:
        new = [each for each in (folder, *folder.parents) if not each.exists()]
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        why = "is a file, not a folder; choose another output folder"
        raise InputError(f"{folder}: {why}") from None
    except OSError as error:
        raise not_writable(folder, error) from None
    try:
        with locked(folder):
            yield
    finally:
        with suppress(OSError):
            for each in new:
                each.rmdir()


LOCK = ".lock"  # file in a folder that the process that works in it has locked
MARK = "mgs "  # start of a lock file, before the process: mgs made the folder's leftovers

_held: set[Path] = set()  # folders that this process has locked


@contextmanager
def locked(folder: str | Path) -> Iterator[None]:
    """Context manager: holds the lock of a folder, which no other process gets meanwhile.

    Raises InputError if another process holds it, naming that process, and if the folder cannot be
    written. The system keeps the lock on the file FOLDER/.lock and releases it when the process
    ends, so a file .lock that is left over locks nothing."""
    path = Path(folder) / LOCK
    try:
        file = _lock(path)
    except OSError as error:
        raise not_writable(path, error) from None
    root = Path(os.path.abspath(folder))
    with file:
        _held.add(root)
        try:
            yield
        finally:
            _held.discard(root)
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
    """Open and lock the file, and write this process's id into it."""
    if os.path.lexists(path) and not _is_lock(path, or_empty=True):
        raise in_the_way(path)
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
                print(f"{MARK}{os.getpid()}", end="", file=file, flush=True)
                closed_on_failure.pop_all()
                return file


def _flock(path: Path, file: TextIO) -> None:
    """Lock an open file. Raises InputError, with the process, if another one has locked it."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.seek(0)
        process = file.read(len(MARK) + 20).removeprefix(MARK)
        by = f"process {process} works on it"
        raise InputError(f"{path.parent}: {by}; wait until it has ended") from None


def check_unlocked(folder: Path) -> None:
    """Raise InputError if another process works in a folder. Its lock is not taken."""
    path = folder / LOCK
    if Path(os.path.abspath(folder)) in _held or not _is_lock(path):
        return
    with suppress(OSError), open(path, encoding="ascii") as file:
        _flock(path, file)
