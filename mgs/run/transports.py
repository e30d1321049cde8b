"""Transports: functions deliver(pose, out) by which a pose file reaches a camera. They return once
the picture is complete in `out`, with its COMPANIONS, or raise InputError or OSError."""

import os
import re
import shlex
import shutil
import signal
import subprocess
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from mgs.errors import InputError, Notice
from mgs.images import read_rgba

Transport = Callable[[Path, Path], None]

PICTURES = (".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")
COMPANIONS = (".flown.json", ".depth.exr", ".depth.png", ".mask.png")
"""Ends of the names of a picture, and of what may come with it."""

POLL = 0.5  # seconds between two looks into a watched folder
LOG_TAIL = 2000  # last bytes of a command's output that are searched for its last line


def answers(out: Path) -> dict[str, Path]:
    """Files there are of an answer, by the end of their names; a picture comes first."""
    stem = out.with_suffix("")
    paths = {end: stem.with_name(stem.name + end) for end in (*PICTURES, *COMPANIONS)}
    return {end: path for end, path in paths.items() if path.is_file()}


def picture(out: Path) -> Path:
    """The picture of an answer. Raises InputError where there is none."""
    for end, path in answers(out).items():
        if end in PICTURES:
            return path
    raise InputError(f"{out}: the picture is missing")


def command(text: str, timeout: float) -> Transport:
    """Transport that runs a program; `{pose}` and `{out}` in its arguments become the two paths. No
    shell reads the text. timeout: seconds after which the program is ended. Raises InputError
    unless both fields are there and the program exists."""
    try:
        words = shlex.split(text)
    except ValueError as error:
        raise InputError(f"capture_command {text!r}: {error}; correct the quotes") from None
    absent = [field for field in ("{pose}", "{out}") if not any(field in word for word in words)]
    if absent:
        raise InputError(f"capture_command {text!r}: has no {absent[0]}; add it")
    if shutil.which(words[0]) is None:
        raise InputError(f"capture_command {text!r}: there is no program {words[0]}")

    def deliver(pose: Path, out: Path) -> None:
        for old in answers(out).values():
            old.unlink()  # of a program that was interrupted
        paths = {"pose": str(pose), "out": str(out)}
        arguments = [re.sub(r"\{(pose|out)\}", lambda field: paths[field[1]], w) for w in words]
        log = out.with_suffix(".log")
        log.unlink(missing_ok=True)  # it may be a link
        with open(log, "wb") as file:
            process = subprocess.Popen(
                arguments,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
            try:
                code = process.wait(timeout)
            except subprocess.TimeoutExpired:
                raise InputError(f"the command did not end within {timeout:g} s") from None
            finally:
                if process.poll() is None:
                    with suppress(ProcessLookupError):
                        os.killpg(process.pid, signal.SIGKILL)
                    process.wait()
        if code:
            raise InputError(f"the command ended with exit code {code}{_last_line(log)}")

    return deliver


def _last_line(log: Path) -> str:
    lines = log.read_bytes()[-LOG_TAIL:].decode(errors="replace").split("\n")
    texts = ["".join(filter(str.isprintable, line)).strip() for line in lines]
    last = next((line for line in reversed(texts) if line), "")
    return f": {last[:200]}" if last else ""


def watched(timeout: float) -> Transport:
    """Transport that waits until somebody puts the picture beside the pose. A picture is complete
    when it can be read and no file of the answer changed between two looks. timeout: seconds."""

    def deliver(pose: Path, out: Path) -> None:
        said = f"waiting at most {timeout:g} s for {out} (pose in {pose.name})"
        warnings.warn(Notice(said), stacklevel=2)
        end, before, reason = time.monotonic() + timeout, None, "the picture is missing"
        while time.monotonic() < end:
            now = [(path, path.stat().st_size) for path in answers(out).values()]
            if now and now == before:
                try:
                    read_rgba(picture(out))
                    return
                except InputError as error:
                    reason = str(error)
            before = now
            time.sleep(min(POLL, timeout))
        raise InputError(f"{out}: nothing within {timeout:g} s ({reason})")

    return deliver
