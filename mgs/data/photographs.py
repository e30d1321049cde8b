"""Photographs alone, or the sharpest frames of a video, as a source: their poses by incremental
structure from motion (pycolmap)."""

import hashlib
import os
import re
import shutil
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import cKDTree

from mgs.data.colmap import image_count, is_whole_model, source_of
from mgs.data.depth_beside import depth_beside, depth_files, with_depth
from mgs.data.shots import PICTURE_SUFFIXES, Shot, Source, Spacing, frame_name, natural
from mgs.data.structure import Matcher
from mgs.data.world import PLUS_Z
from mgs.errors import InputError, Notice
from mgs.files import read_leftover, write_json
from mgs.images import exif_orientation, read_rgba, write_png
from mgs.progress import report

if TYPE_CHECKING:
    from cv2 import VideoCapture

KIND = "photographs"
FEWEST = 3  # fewest photographs that can be placed
EXHAUSTIVE = 150  # most photographs of which all pairs are matched; of more, those near in order
NEAR = 10  # photographs after each in order it is matched with, at distances of powers of 2, by GPS
LEAST_FEATURES = 100  # fewest features of a photograph that is neither blurred nor blank
LEAST_MATCHES = 15  # matches that one epipolar geometry explains, for two photographs to overlap
GPS_ERROR = 0.1  # largest median distance of cameras from GPS, over the extent, to scale by GPS
UNREAD = (".heic", ".heif", ".dng", ".cr2", ".cr3", ".nef", ".arw")  # left out with a line
PLACED = "models/*/images.bin"  # files of a folder of matches where photographs are placed
STATES = "states"  # its folder of models that are not finished, from which another call continues
STEP = 100  # photographs that are placed from one state to the next
# Files that hold poses by their name, or that of their folder.
POSES = re.compile(
    r"(?<![a-z])((pose|traj|ground_?truth|odometry)[^/]*(/[^/]+)?|cameras/[^/]+)\.(txt|csv|log|json)$",
    re.I,
)
NAMED = 10  # most photographs that a line names


def pictures_of(source: Path) -> Path:
    """Folder of the pictures of a folder of photographs: its folder `images`, or itself."""
    return source / "images" if (source / "images").is_dir() else source


def depth_places(source: Path, images: Path | None = None) -> list[Path]:
    """Folders that may hold the depth of photographs, those in `images` or else in `source`."""
    return [pictures_of(images or source), images or source, source]


def photographs_in(source: Path) -> list[Path]:
    """Pictures in `pictures_of` a folder and the folders in it, without `depth_files`; none if it
    is none."""
    endings, root = (*PICTURE_SUFFIXES, *UNREAD), pictures_of(source)
    paths = {path for path in root.rglob("*") if path.suffix.lower() in endings}
    return sorted((path for path in paths - {*depth_files(root)} if path.is_file()), key=natural)


def check_alone(source: Path) -> None:
    """Raise InputError where poses lie in a folder of photographs, or among them."""
    inside = (pictures_of(source).rglob(name) for name in ("transforms*.json", "cameras.bin"))
    for poses in chain(source.glob("transforms*.json"), *inside):
        cure = "give it, or its folder, as the source, or move it away"
        raise InputError(f"{poses}: its poses would be ignored; {cure}")
    others = (path for path in source.rglob("*") if POSES.search(f"{path.relative_to(source)}"))
    if other := min(others, default=None):
        cure = "give its folder if that can be read, or make a transforms.json, or move it away"
        raise InputError(f"{other}: its poses would be ignored; {cure}")


def read_photographs(
    source: Path,
    paths: Sequence[Path],
    folder: Path,
    exclude: Sequence[str],
    places: Sequence[Path] = (),
) -> Source:
    """Poses, lenses and points of photographs, of the largest part that hangs together. folder: for
    matches, which a later call continues. exclude: names of photographs to leave out; they do not
    place others either. places: folders in which `depth_beside` looks. With GPS in their EXIF that
    fits, the world is in metres, +Y north and +Z up. Raises InputError if fewer than FEWEST can be
    placed, and as `depth_beside`."""
    import pycolmap

    names = [frame_name(path.relative_to(source).as_posix()) for path in paths]
    out = {frame_name(name) for name in exclude}
    if unknown := out - set(names):
        raise InputError(f"import: exclude {min(unknown)!r}: is no photograph of {source}")
    paths = [path for name, path in zip(names, paths, strict=True) if name not in out]
    paths, dropped = _usable(source, paths)
    if len(paths) < FEWEST:
        raise InputError(
            f"{source}: of its photographs {len(paths)} can be used; take at least {FEWEST}, "
            f"better 20, that overlap{_and_names(dropped)}"
        )
    depths = depth_beside(pictures_of(source), paths, places)
    matcher = Matcher(paths, folder)
    matcher.match(_pairs(len(paths)))
    if len(paths) > EXHAUSTIVE:
        matcher.match(_near_by_gps(matcher))
    models = _models(matcher, len(paths))
    with closing(pycolmap.Database.open(matcher.database)) as database:
        numbers = {image.name: image.image_id for image in database.read_all_images()}
        files = {
            numbers[name]: (path.relative_to(source).as_posix(), path)
            for name, path in zip(matcher.names, paths, strict=True)
            if name in numbers
        }
        why = _reasons(database, files, models)
        if not models:
            raise InputError(
                f"{source}: none of {len(paths)} photographs can be placed; take sharp ones, each "
                f"of which shows most of what the one before shows{_and_names(why | dropped)}"
            )
        georeferenced = _to_gps(models[0], database)
    largest = source_of(models[0], files, f"{source}: photograph", KIND)
    shots = [_turned(shot) for shot in largest.shots]
    why |= dropped
    lines = (f"left out {names}" for names in _by_reason(why))
    left_out = Counter(why.values())
    result = replace(largest, shots=shots, left_out=left_out, notes=tuple(lines))
    result = with_depth(result, depths, models[0], {path: k for k, (_, path) in files.items()})
    if georeferenced is None:
        return result
    note = f"GPS gives scale and place: the world's 0 is at {georeferenced}"
    notes = (*result.notes, note)
    return replace(result, up=PLUS_Z, unit="m", place=georeferenced, notes=notes)


def _usable(source: Path, paths: Sequence[Path]) -> tuple[list[Path], dict[str, str]]:
    """Photographs that can be read and are no copies, also by the name of their frame, and why the
    others are left out, by name."""
    usable, dropped, seen, deep = [], dict[str, str](), set[str](), []
    for k, path in enumerate(paths):
        report("reading photographs", k, len(paths))
        name = path.relative_to(source).as_posix()
        if path.suffix.lower() in UNREAD:
            dropped[name] = "in HEIC or a raw format: convert to JPEG"
            continue
        if not name.isprintable():
            dropped[ascii(name)] = "with a name that cannot be printed: rename"
            continue
        try:
            pixels = read_rgba(path)
        except InputError:
            dropped[name] = "not readable: damaged, or neither grey nor RGB"
            continue
        same = {hashlib.sha256(path.read_bytes()).hexdigest(), frame_name(name)}
        if same & seen:
            dropped[name] = "with the content or name of another"
            continue
        seen |= same
        usable.append(path)
        if pixels.dtype == np.uint16 and (pixels[..., :2] == pixels[..., 1:3]).all():
            deep.append(path)
    if len(deep) < len(usable):
        why = "grey of 16 bits, as depth: its place is a folder `depth` in the source"
        dropped |= {path.relative_to(source).as_posix(): why for path in deep}
        usable = [path for path in usable if path not in deep]
    return usable, dropped


def _pairs(count: int) -> list[tuple[int, int]]:
    steps = list(range(1, count))
    if count > EXHAUSTIVE:
        steps = [*range(1, NEAR + 1), *(2**k for k in range(4, count.bit_length()))]
    return [(one, one + step) for step in steps for one in range(count - step)]


def _near_by_gps(matcher: Matcher) -> list[tuple[int, int]]:
    """Pairs of photographs that are near by GPS, as neighbouring strips of a survey are: each with
    the NEAR nearest. The database has their EXIF since they were matched by order."""
    import pycolmap

    with closing(pycolmap.Database.open(matcher.database)) as database:
        gps = _gps(database)
        numbers = {image.name: image.image_id for image in database.read_all_images()}
    places = [place for place, name in enumerate(matcher.names) if numbers.get(name) in gps]
    if len(places) < 2:
        return []
    geodetic = np.stack([gps[numbers[matcher.names[place]]] for place in places])
    metres = pycolmap.GPSTransform().ellipsoid_to_enu(geodetic, *geodetic[0])
    near = cKDTree(metres).query(metres, min(NEAR + 1, len(places)))[1]
    pairs = [(one, other) for one, row in enumerate(near) for other in row if other != one]
    return [(places[one], places[other]) for one, other in pairs]


def _gps(database: Any) -> dict[int, np.ndarray]:
    """Latitude, longitude and altitude of the photographs with GPS in their EXIF, by number."""
    import pycolmap

    wgs84 = pycolmap.PosePriorCoordinateSystem.WGS84
    return {
        prior.corr_data_id.id: prior.position.ravel()
        for prior in database.read_all_pose_priors()
        if prior.coordinate_system == wgs84 and np.isfinite(prior.position).all()
    }


def _models(matcher: Matcher, count: int) -> list[Any]:
    """Reconstructions of the photographs, the largest first; those of a call before, if any. Where
    that had fewer photographs and one model, the others are registered to it. Where it was
    interrupted, the largest of its states is continued, unless it is of under half the photographs,
    since another model may be larger."""
    import pycolmap

    folder, states = matcher.folder / "models", matcher.folder / STATES
    done = folder / "done.json"
    if read_leftover(done) != count:
        before = [path for path in folder.glob("*") if path.is_dir()]
        if done.is_file() and len(before) == 1:
            _map(matcher, count, before[0], before[0])
        else:
            shutil.rmtree(folder, ignore_errors=True)
            (folder / "0").mkdir(parents=True)
            whole = [path for path in states.glob("*") if is_whole_model(path)]
            state = max(whole, key=image_count, default=None)
            if state is None or 2 * _map(matcher, count, folder / "0", state) < count:
                shutil.rmtree(states, ignore_errors=True)
                shutil.rmtree(folder)
                folder.mkdir()
                _map(matcher, count, folder)
        write_json(done, count)
        shutil.rmtree(states, ignore_errors=True)
    models = [pycolmap.Reconstruction(path) for path in sorted(folder.iterdir()) if path.is_dir()]
    models = [model for model in models if model.num_reg_images() >= FEWEST]
    return sorted(models, key=lambda model: -model.num_reg_images())


def _map(matcher: Matcher, count: int, out: Path, first: Path | None = None) -> int:
    """Reconstruct photographs, or register them to the model `first`, and return how many the
    largest model has. out: folder of the model, or without `first` of the models."""
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions(
        min_model_size=FEWEST, extract_colors=False, random_seed=0
    )
    if count <= EXHAUSTIVE:  # with threads, which of several results comes out is chance
        options.num_threads = 1
    options.mapper.random_seed = options.triangulation.random_seed = 0
    options.snapshot_path, options.snapshot_frames_freq = matcher.folder / STATES, STEP
    options.snapshot_path.mkdir(exist_ok=True)
    start = image_count(first) if first else 0
    placed = iter(range(start + 2, count * options.max_num_models))
    report("placing photographs", start, count)
    matcher.check_disk()
    models = pycolmap.incremental_mapping(
        matcher.database,
        matcher.folder,
        out,
        options=options,
        input_path=first or "",
        next_image_callback=lambda: report("placing photographs", min(next(placed), count), count),
    )
    return max((model.num_reg_images() for model in models.values()), default=0)


def _reasons(
    database: Any, files: dict[int, tuple[str, Path]], models: Sequence[Any]
) -> dict[str, str]:
    """Reason why each photograph is not in the first model, by its name."""
    pairs, matches = database.read_two_view_geometry_num_inliers()
    import pycolmap

    overlapping = set()
    for pair, number in zip(pairs, matches, strict=True):
        if number >= LEAST_MATCHES:
            overlapping |= set(pycolmap.pair_id_to_image_pair(pair))
    placed = [
        {image.image_id for image in model.images.values() if image.has_pose} for model in models
    ]
    why = {}
    for number, (name, _) in files.items():
        if placed and number in placed[0]:
            continue
        if any(number in others for others in placed[1:]):
            why[name] = "of another scene, or of a part that nothing joins to the largest"
        elif database.num_keypoints_for_image(number) < LEAST_FEATURES:
            why[name] = "blurred or blank"
        elif number not in overlapping:
            why[name] = "without overlap with any other"
        elif not placed:
            why[name] = "with too few shared points, or all taken from one place"
        else:
            why[name] = "with too few points in common with those placed"
    return why


def _by_reason(why: dict[str, str]) -> list[str]:
    """Names of photographs, at most NAMED, with the reason they have in common."""
    lines = []
    for reason in dict.fromkeys(why.values()):
        names = [name for name, own in why.items() if own == reason]
        more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
        lines.append(f"{', '.join(names[:NAMED])}{more}, {reason}")
    return lines


def _and_names(why: dict[str, str]) -> str:
    return "".join(f"; {line}" for line in _by_reason(why))


def _turned(shot: Shot) -> Shot:
    return replace(shot, turned=True) if exif_orientation(shot.image) > 1 else shot


def _to_gps(model: Any, database: Any) -> str | None:
    """Move a reconstruction to metres east, north and up of its first camera by the GPS positions
    in EXIF; latitude, longitude and altitude of that, or None where they do not fit."""
    import pycolmap

    places = _gps(database)
    images = [image for image in model.images.values() if image.has_pose]
    images = [image for image in images if image.image_id in places]
    if len(images) < FEWEST:
        return None
    geodetic = np.stack([places[image.image_id] for image in images])
    first = geodetic[0]
    metres = pycolmap.GPSTransform().ellipsoid_to_enu(geodetic, *first)
    eyes = np.stack([image.projection_center() for image in images])
    extent = float(np.linalg.norm(np.ptp(metres, axis=0)))
    spread = np.linalg.svd(metres - metres.mean(0), compute_uv=False)
    if extent == 0 or spread[1] < GPS_ERROR * spread[0]:  # on a line, which may turn about itself
        return None
    options = pycolmap.RANSACOptions(max_error=GPS_ERROR * extent, random_seed=0)
    estimate = pycolmap.estimate_sim3d_robust(eyes, metres, options)
    if estimate is None:
        return None
    similarity = estimate["tgt_from_src"] if isinstance(estimate, dict) else estimate
    moved = np.stack([similarity * eye for eye in eyes])
    if np.median(np.linalg.norm(moved - metres, axis=1)) > GPS_ERROR * extent:
        return None
    model.transform(similarity)
    return ",".join(f"{value:.8g}" for value in first)


VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
JUDGED = 640  # longer side, pixels, to which frames are reduced to compare how sharp they are
WHOLE = 0.95  # least share of a video's frames that can be read; their number may be an estimate


@contextmanager
def _opened(video: Path) -> Iterator["VideoCapture"]:
    """Context manager: a video, whose faults OpenCV does not print meanwhile."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # else FFmpeg prints them, too
    import cv2

    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    capture = cv2.VideoCapture(str(video), cv2.CAP_FFMPEG)  # others look for pictures
    try:
        yield capture
    finally:
        capture.release()
        cv2.utils.logging.setLogLevel(level)


def sharpest_frames(video: Path, folder: Path, spacing: Spacing) -> list[Path]:
    """Write the sharpest frame of each time of `spacing` into a folder, and return their files. The
    sharpest has the largest variance of the Laplacian. A video that ends in the middle gives the
    frames before and a warning. A folder that already holds them is taken as it is. Raises
    InputError for a spacing in metres, if the video cannot be read, and if it is so short, or cut
    off so early, that it gives under FEWEST frames."""
    import cv2

    if spacing.metres:
        raise InputError(f"{video}: a video has no distances; give keyframes in seconds, as 0.5s")
    about = [str(video.resolve()), video.stat().st_mtime_ns, spacing.least]
    record = folder / "video.json"
    if read_leftover(record) == about:
        return sorted(folder.glob("*.png"))
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("*.png"):
        old.unlink()
    with _opened(video) as capture:
        rate, total = capture.get(cv2.CAP_PROP_FPS), int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        window, number = max(1, round(rate * spacing.least)), 0
        best, sharpest = None, -1.0
        while True:
            there, frame = capture.read()
            if best is not None and (not there or number % window == 0):
                write_png(folder / f"{number:06d}.png", cv2.cvtColor(best, cv2.COLOR_BGR2RGB))
                best, sharpest = None, -1.0
            if not there:
                break
            if number % window == 0:
                report("frames of the video", number, max(total, number))
            scale = min(1.0, JUDGED / max(frame.shape))
            small = cv2.resize(frame, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
            grey = cv2.cvtColor(small, cv2.COLOR_BGR2GRAY)
            if (sharpness := float(cv2.Laplacian(grey, cv2.CV_64F).var())) > sharpest:
                best, sharpest = frame, sharpness
            number += 1
    if number == 0:
        raise InputError(f"{video}: not a readable video, or cut off; convert it to MP4 (H.264)")
    if number <= (FEWEST - 1) * window:
        if number < WHOLE * total:
            read = f"only {number} of {total} frames can be read"
            raise InputError(f"{video}: {read}, under {FEWEST} keyframes; copy the file again")
        cure = "give a longer one, or keyframes nearer in time, as 0.1s"
        raise InputError(f"{video}: its {number} frames give under {FEWEST} keyframes; {cure}")
    if number < WHOLE * total:
        read = f"only {number} of {total} frames can be read, and are used"
        warnings.warn(
            Notice(f"{video}: {read}; copy the file again if it is cut off"), stacklevel=2
        )
    write_json(record, about)
    return sorted(folder.glob("*.png"))
