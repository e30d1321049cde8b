"""Live capture: a pose goes out as JSON, and a picture comes back (docs/howto/on-site.md).

A transport is a function deliver(pose, out) by which a pose file reaches a camera. It returns once
the picture is complete in `out`, with its COMPANIONS, or raises InputError or OSError."""

import os
import re
import secrets
import shlex
import shutil
import signal
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from subprocess import DEVNULL, STDOUT, Popen, TimeoutExpired
from typing import Any, Literal

import numpy as np

from mgs.camera import Camera, heading_and_pitch, opengl_from_opencv
from mgs.colour import srgb_from_linear
from mgs.data.dataset import FILES, Dataset, intrinsics, load_dataset, read_records
from mgs.data.frames import Frame, as_captured, capture_record, frame_blur
from mgs.data.importers import Silhouette, import_shot, silhouette_of
from mgs.data.lens import Lens, fitted
from mgs.data.shots import Shot
from mgs.data.sources import record_camera
from mgs.data.world import World
from mgs.errors import InputError, Notice
from mgs.files import below, read_json, remove_file, write_json
from mgs.images import read_rgba
from mgs.metrics import MOST_BLUR
from mgs.prior.build import Prior

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
            process = Popen(
                arguments, stdin=DEVNULL, stdout=file, stderr=STDOUT, start_new_session=True
            )
            try:
                code = process.wait(timeout)
            except TimeoutExpired:
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


CONVENTION = (
    "transform_matrix is camera-to-world, camera axes x right, y up, z backward (OpenGL, "
    "nerfstudio); lengths in the unit; heading in degrees clockwise from +Y made level (+Z if +Y "
    "is steep), pitch above the horizon, seen with `up` upwards; pixels from the image's corner"
)

SAME = 1e-9  # largest difference of an entry of a pose that came back unchanged through JSON
REACH = 0.25  # default of `Live.distance`, as a share of the distance to the object
DEPTH_UNIT = 1e-3  # metres in a step of a PNG depth image
WHITE, MOST_WHITE = 254 / 255, 0.5  # least white sRGB value, most of the object that may be
BLACK, MOST_BLACK = 2 / 255, 0.95  # the same of black. Shadows on the Moon are black
REFUSED_BLUR = 2 * MOST_BLUR  # pixels; some lenses are never as sharp as MOST_BLUR


@dataclass(frozen=True)
class Live:
    """Settings of live capture. deliver: a transport (`mgs.run.live`), or your own
    function(pose file, picture file). folder: of both, by default RUN/dataset/flight. tries: for
    each pose. failure: then skip (take the next best pose) or stop. distance: largest from the pose
    asked for, by default REACH."""

    deliver: Transport
    folder: Path | None = None
    tries: int = 3
    failure: Literal["skip", "stop"] = "skip"
    distance: float | None = None


def write_live_dataset(folder: Path, poses: Dataset, prior: Prior) -> None:
    """Write the dataset of a live run: all poses, and the images that exist already."""
    data, records = read_records(poses.root / "transforms.json")
    for record in records:
        name = Path(record["file_path"]).stem
        for key in FILES.values():
            record.pop(key, None)
        record |= {"file_path": f"images/{name}.png", "mask_path": f"masks/{name}.png"}
    demand = {"on_demand": True, "token": secrets.token_hex(4), "frames": records}
    write_json(folder / "transforms.json", data | demand)
    frames = load_dataset(folder, up=poses.world.up).frames
    silhouette = cache(lambda: silhouette_of(prior.mesh))
    for pose, frame in zip(poses.frames, frames, strict=True):
        if not pose.on_demand:
            files = pose.image_path, pose.depth_path, DEPTH_UNIT, pose.mask_path, pose.rock_path
            shot = Shot(frame.name, frame.camera, None, frame.timestamp, *files)
            _commit(folder, frame, shot, silhouette, poses.world)


def live_capture(dataset: Dataset, prior: Prior, live: Live | None) -> Callable[[Frame], Frame]:
    """Return capture(frame) -> the frame as it was captured; at once if it was captured or given up
    before. Refused pictures are asked for again, `live.tries` times in all. Raises InputError where
    the run then stops, and where a picture is needed without `live`."""
    silhouette = cache(lambda: silhouette_of(prior.mesh))
    centre = prior.points.mean(axis=0)
    token = token_of(dataset) if live and live.folder else ""
    files = dict[Path, set[str]]()

    def capture(frame: Frame) -> Frame:
        current = as_captured(frame, dataset.world)
        if current.capture_path or current.given_up:
            return current
        if live is None:
            where = f"{dataset.root}: frame {frame.name} has no image"
            raise InputError(f"{where}; give `capture_command` or `capture_folder`")
        folder, reason = live.folder or below(dataset.root, "flight"), ""
        for attempt in range(1, live.tries + 1):
            pose, out = ask(folder, frame, dataset, attempt, token)
            try:
                live.deliver(pose, out)
                _warn_of_late(files)
                received = _received(dataset, frame, out, live, centre, silhouette)
                files[out] = {*answers(out)}
                return received
            except (InputError, OSError) as error:
                reason = str(error)
                _set_aside(out)
                said = f"{frame.name}, try {attempt} of {live.tries}: {reason}"
                warnings.warn(Notice(said), stacklevel=2)
        if live.failure == "skip":
            write_json(capture_record(frame), {"given_up": reason})
            return as_captured(frame, dataset.world)
        tries = f"{frame.name}: no picture after {live.tries} tries ({reason})"
        raise InputError(f"{tries}; mend it and resume the run")

    return capture


def token_of(dataset: Dataset) -> str:
    """Token of a live run, which tells its pictures from those of other runs in a folder; empty in
    a dataset that has none."""
    token = read_json(dataset.root / "transforms.json").get("token", "")
    return token if isinstance(token, str) and re.fullmatch(r"[0-9a-f]{8}", token) else ""


def _warn_of_late(files: dict[Path, set[str]]) -> None:
    for out, ends in files.items():
        for end, path in answers(out).items():
            if end not in ends:
                ends.add(end)
                said = "came after its picture and is not used; write it before the picture"
                warnings.warn(Notice(f"{path}: {said}"), stacklevel=3)


def ask(
    folder: Path, frame: Frame, dataset: Dataset, attempt: int, token: str = ""
) -> tuple[Path, Path]:
    """Write the pose file of a frame; return its path, and that of the picture to come. Both names
    end with the token, if any. Raises InputError where an answer lies there already though this
    pose was never asked for."""
    heading, pitch = heading_and_pitch(frame.camera)
    camera = dataset.world.leave(frame.camera)
    name = f"{frame.name}-{token}" if token else frame.name
    request = {
        "name": frame.name,
        "picture": f"{name}.png",
        "convention": CONVENTION,
        "unit": dataset.unit,
        "up": list(dataset.world.up),
        "transform_matrix": opengl_from_opencv(camera.world_to_camera).tolist(),
        "position": camera.position.tolist(),
        "heading": heading,
        "pitch": pitch,
        "camera_model": "OPENCV",
        **intrinsics(camera),
    }
    pose, out = folder / f"{name}.pose.json", folder / f"{name}.png"
    old: Any = read_json(pose) if pose.is_file() else {}
    same = isinstance(old, dict) and old == request | {"attempt": old.get("attempt")}
    if not same and (there := [*answers(out).values()]):
        raise InputError(f"{there[0]}: lay there before its pose was asked for; move it away")
    write_json(pose, request | {"attempt": attempt})
    return pose, out


def _received(
    dataset: Dataset,
    frame: Frame,
    out: Path,
    live: Live,
    centre: np.ndarray,
    silhouette: Callable[[], Silhouette],
) -> Frame:
    image, files = picture(out), answers(out)
    camera, lens = frame.camera, None
    if flown := files.get(".flown.json"):
        camera, lens = _flown(flown, frame, image, dataset.world)
    away = float(np.linalg.norm(camera.position - frame.camera.position))
    limit = live.distance
    if limit is None:
        limit = REACH * float(np.linalg.norm(frame.camera.position - centre))
    if away > limit:
        raise InputError(f"{flown}: is {away:.3g} from the pose asked for, more than {limit:.3g}")
    depth = files.get(".depth.exr") or files.get(".depth.png")
    unit = DEPTH_UNIT if depth and depth.suffix == ".png" else 1.0
    mask = files.get(".mask.png")
    shot = Shot(frame.name, camera, lens, frame.timestamp, image, depth, unit, mask)
    return _commit(dataset.root, frame, shot, silhouette, dataset.world)


def _flown(path: Path, frame: Frame, image: Path, world: World) -> tuple[Camera, Lens | None]:
    """Camera and lens by a flown pose; the lens is that asked for where it says nothing."""
    record: Any = read_json(path)
    if not isinstance(record, dict) or "transform_matrix" not in record:
        raise InputError(f"{path}: has no transform_matrix")
    camera, lens, _ = record_camera(str(path), intrinsics(frame.camera) | record, image)
    camera, lens = fitted(camera, lens, image)
    plan, camera = frame.camera, world.enter(camera)
    size = (camera.width, camera.height) == (plan.width, plan.height)
    pose = np.allclose(camera.world_to_camera, plan.world_to_camera, rtol=0, atol=SAME)
    same = size and pose and np.allclose(camera.K, plan.K, rtol=0, atol=SAME)
    return plan if same else camera, lens


def _commit(
    root: Path, frame: Frame, shot: Shot, silhouette: Callable[[], Silhouette], world: World
) -> Frame:
    """Import a picture, check it, and write its record, which comes last."""
    remove_file(root, frame.image_path)  # of a picture that was refused or interrupted
    outline = None if shot.mask or shot.rock else silhouette()
    result = import_shot(shot, root, outline, 1, lambda: None)
    if result.mask_path is None:
        raise InputError(f"{shot.mask}: is no mask")
    check_photograph(result)
    camera = world.leave(result.camera)
    own: dict[str, Any] = {"K": camera.K.tolist(), "width": camera.width, "height": camera.height}
    own |= {"world_to_camera": camera.world_to_camera.tolist()}
    other = None if result.camera == frame.camera else own
    write_json(capture_record(frame), {"camera": other, "depth": shot.depth is not None})
    return as_captured(frame, world)


def _set_aside(out: Path) -> None:
    """Rename a refused answer, so that another can come in its place."""
    if not out.parent.is_dir():  # the command removed it
        return
    names = {path.name.partition(f"{out.stem}.refused-")[2] for path in out.parent.iterdir()}
    numbers = [number for name in names if (number := name.split(".")[0]).isdecimal()]
    last = max(map(int, numbers), default=0)
    for end, path in answers(out).items():
        path.rename(out.with_name(f"{out.stem}.refused-{last + 1}{end}"))


def check_photograph(frame: Frame) -> None:
    """Raises InputError where an image does not show the object, is black or white, or blurred."""
    mask, path = frame.mask(), frame.image_path.name
    if not mask.any():
        raise InputError(f"{path}: the object is not in the picture")
    grey = srgb_from_linear(frame.rgb()).mean(axis=-1)
    for name, share, most in (
        ("over", float((grey[mask] >= WHITE).mean()), MOST_WHITE),
        ("under", float((grey[mask] <= BLACK).mean()), MOST_BLACK),
    ):
        if share > most:
            raise InputError(f"{path}: {name}exposed, {100 * share:.0f} % of the object")
    if (blur := frame_blur(frame, mask)) > REFUSED_BLUR:
        raise InputError(f"{path}: blurred by {blur:.1f} pixels, more than {REFUSED_BLUR:.1f}")
