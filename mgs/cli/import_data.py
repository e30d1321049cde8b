"""`mgs import`: make a dataset of cameras and images in other formats (docs/howto/data.md)."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from mgs.cli.options import parse_up
from mgs.cli.terminal import Terminal, progress_bar
from mgs.data.agreement import MATCHED, Agreement, agreement
from mgs.data.bags import is_bag
from mgs.data.check import blur_problems
from mgs.data.clouds import SparseCloud, write_cloud
from mgs.data.colmap import models_in
from mgs.data.dataset import Dataset
from mgs.data.depth_beside import depth_files
from mgs.data.frames import frame_blur
from mgs.data.importers import RECORD, import_source, least_factor
from mgs.data.meshes import GLTF
from mgs.data.photographs import KIND as PHOTOGRAPHS
from mgs.data.photographs import PLACED, depth_places, photographs_in
from mgs.data.shots import Shot, Source
from mgs.data.sources import KEYFRAMES, read_source
from mgs.data.structure import CLOUD, WIDEST, Matcher, lacks_points, refined
from mgs.errors import InputError
from mgs.files import Ours, read_json, scratch_folder, write_json
from mgs.images import exif_exposure, exif_orientation
from mgs.progress import report

EXPOSURE_DIFFERS = 0.1  # stops by EXIF beyond which --exposure is recommended
SHARP = 0.3  # error of right poses in small pictures, pixels: 0.11 measured, with a margin
WHITE_RIM = 0.9  # share of white along the border of masks that may be inverted
MOSTLY = 0.3  # share of empty masks beyond which a line says so

FILES = ("import.json", "transforms.json", "images", "depth", "masks", "rock", "sparse.ply", "test")
"""Names in a folder of this command."""


def import_data(
    source: Path,
    out: Annotated[Path, typer.Option()],
    images: Path | None = None,
    keyframes: str = KEYFRAMES,
    masks: Path | None = None,
    mesh: Path | None = None,
    downscale: Annotated[int | None, typer.Option(min=1)] = None,
    up: str = "auto",
    unit: float | None = None,
    distance: str | None = None,
    test_every: Annotated[int | None, typer.Option(min=2)] = None,
    pose: str | None = None,
    exclude: list[str] | None = None,
    refine_poses: bool = False,
    test_split: str | None = None,
    force: bool = False,
) -> None:
    """Make a dataset from your own data: cameras and images, with depth and masks if there are any.
    Lens distortion is undone.

    Masks come from --masks, else from --mesh, the source's own mask files, or the images' alpha.
    Partial alpha is kept in rock/, images of the object alone. Points that came with the cameras
    are kept in sparse.ply for `mgs prior`. The same command continues an interrupted import.

    - source: A transforms.json or a folder with one, a COLMAP model (sparse/0), ROS bag, Metashape
      XML, a folder of TUM RGB-D, Open3D, 7-Scenes, 3D Scanner App, Polycam, Record3D (or .r3d),
      RTAB-Map, OpenSfM or ODM, Bundler, LLFF, MVSNet, openMVG's benchmark or 3D Gaussian Splatting,
      a folder of photographs alone, or a video.
    - out: Folder to write: new, empty, or left by an interrupted import.
    - images: Folder of the images (default: SOURCE/images), or topic of a bag.
    - keyframes: Of a recording or video, import frames at least this time or distance apart: 0.5s
      or 0.2m; of a video the sharpest.
    - masks: Folder of masks, named like the images; the object is white.
    - mesh: Mesh of the object, world coordinates; masks are its projections. GLB is converted from
      +Y up to +Z up.
    - downscale K: Average blocks of K x K pixels. Default: the least K that leaves at most 2.1
      megapixels, since a fit has by default at most 200,000 Gaussians.
    - up: Up direction: X,Y,Z in the source's world, or auto: from how cameras were held.
    - unit: Metres per unit of length of the source. Default: as the source says, if it does.
    - distance A,B,METRES: Distance between the cameras of two images, which gives the scale.
      Without it, GPS in photographs does, else their depth images, in a folder `depth` beside them.
    - test_every N: Make the first and every further Nth image, by name, a test view; 8 is usual.
    - pose TOPIC: Topic of a bag's poses of the camera, or of the body that carries it.
    - exclude NAME: Leave this image out; repeat for more.
    - refine_poses: Adjust the poses that came with the images, also those of test views, to the
      points that pictures share; for poses that are a little wrong. Needs texture.
    - test_split: Split of NeRF-synthetic data that becomes the test views; publications take test.
    """
    options = {key: value for key, value in locals().items() if key not in ("out", "force")}
    console, notes = Terminal(), Terminal(stderr=True)
    for one, other, what in (
        (masks, mesh, "--masks and --mesh both give masks"),
        (unit, distance, "--unit and --distance both give the scale"),
        (test_split, test_every, "--test-split and --test-every both choose test views"),
    ):
        if one is not None and other is not None:
            raise InputError(f"import: {what}; give one of them")
    axis = parse_up(up)
    given = [path for path in (source, images, masks, mesh) if path]
    options = _resolved(options | {"up": axis})
    record = {} if force else _finished(out)
    _check_same(out, record, options)
    beside = [*given, *(photographs_in(masks) if masks else ())]
    model = [path for folder in models_in(source) for path in folder.iterdir()]
    beside += [path for path in model if path.suffix in (".bin", ".txt")]  # others add to it

    def photographs() -> list[Path]:
        depth = depth_files(*depth_places(source, images))
        return [*photographs_in(images or source), *depth, source / "transforms.json"]

    if record.get("kind") == PHOTOGRAPHS and "files" in record:  # to place them again takes long
        with progress_bar("reading", console):
            _check_unchanged(out, record, _stamp([*beside, *photographs()]))
        console.print(f"{out} is finished already; {_again(record)}", soft_wrap=True)
        return
    unpacked = Path(f"{os.path.abspath(out)}.unpacked")
    with (
        scratch_folder(unpacked, "" if is_bag(source) else f"*/{PLACED}") as scratch,
        progress_bar("reading", console),
    ):
        shots = read_source(
            source,
            images,
            keyframes=keyframes,
            unpack=unpacked,
            pose=pose,
            exclude=exclude or [],
            test_split=test_split,
            unit=unit,
            distance=distance,
            refine_poses=refine_poses,
        )
        upward, reason = shots.up_or_estimate() if axis is None else (axis, "as --up says")
        read = [path for shot in shots.shots for path in shot.files]
        files = _stamp([*beside, *(photographs() if shots.kind == PHOTOGRAPHS else read)])
        _check_unchanged(out, record, files)
        replaced = Ours(FILES, [*given, *read]) if force else None
        trained, tests = shots.set_apart(test_every)
        how: Any = {"masks": masks, "mesh": mesh, "downscale": downscale, "up": upward}
        result = import_source(trained, out, **how, tests=tests, options=options, replaced=replaced)
        fit, cloud = shots.fit, shots.sparse
        if shots.kind != PHOTOGRAPHS:
            larger = trained.shots if (downscale or least_factor(shots.shots)) > 1 else []
            refine = refine_poses and not record
            about = shots, larger, scratch, mesh is None, console if refine else None
            result, fit, cloud = _checked(result, *about)
        advice = list(_advice(shots, result))
        if not record:
            write_json(out / RECORD, read_json(out / RECORD) | files)
    if mesh is not None and mesh.suffix.lower() in GLTF:
        console.print(f"{mesh}: turned from +Y up, as its format prescribes, to +Z up")
    for note in [*shots.notes, *advice]:
        notes.print(f"mgs: {note}", soft_wrap=True)
    if fit and fit.problem:
        cure = "correct them, and import with --force"
        notes.print(f"mgs: the poses {fit.problem} ({_evidence(fit)}); {cure}", soft_wrap=True)
    elif not refine_poses and _is_loose(fit, shots, result):
        cure = "--refine-poses adjusts them, with --force"
        notes.print(f"mgs: the poses are a little wrong ({_evidence(fit)}); {cure}", soft_wrap=True)
    alone = shots.kind == PHOTOGRAPHS  # whose poses follow from their points, in a world of its own
    evidence = _points(cloud) if alone and cloud else _evidence(fit, cloud, refine_poses)
    upward_at = "" if alone and axis is None else f" {_numbers(upward)},"
    _print_summary(console, shots, tests, result, [evidence, f"up{upward_at} {reason}"])
    console.print(f"{out} is finished already" if record else f"wrote {out}", soft_wrap=True)


def _checked(
    result: Dataset,
    source: Source,
    larger: Sequence[Shot],
    scratch: Path,
    masked: bool,
    refining: Terminal | None,
) -> tuple[Dataset, Agreement | None, SparseCloud | None]:
    """Compare the poses of an import with its pictures. If they fit, refine them, or else
    triangulate points where nothing tells where the surfaces are. Returns the dataset, the
    comparison, and the points. larger: source pictures of `_triangulated`. masked: as in
    `agreement`. refining: where to print how far poses moved; None: they are not refined."""
    from mgs.cli.nbv import moves_in_words

    matcher, fit, cloud = Matcher.of_frames(result.frames, scratch / "matches"), source.fit, None
    compared = agreement(result.frames, matcher, masked=masked)
    fit = fit if compared is None or (fit and fit.problem) else compared
    if fit and fit.problem:
        return result, fit, source.sparse
    if refining:
        result, cloud, moves = refined(result, scratch / "every")
        refining.print(moves_in_words(moves, result.unit), soft_wrap=True)
    elif lacks_points(result):
        cloud = _triangulated(result, matcher, larger, scratch / "source")
    if cloud is None:
        return result, fit, source.sparse
    write_cloud(result.root / CLOUD, cloud)
    return result, fit, cloud


def _is_loose(fit: Agreement | None, source: Source, result: Dataset) -> bool:
    """Whether points matched in pictures of a dataset are farther from its poses than those of
    right poses, which are found to a pixel of WIDEST of the source, or to SHARP of the dataset."""
    whole, width = source.shots[0].camera.width, result.frames[0].camera.width
    right = max(SHARP, max(1.0, whole / WIDEST) * width / whole)
    return bool(fit and fit.error and fit.evidence.endswith(MATCHED) and fit.error > right)


def _evidence(
    fit: Agreement | None, cloud: SparseCloud | None = None, refined: bool = False
) -> str:
    """How poses were compared with pictures, after the points. refined: they are others now."""
    text = "poses not compared with the pictures, which share too few points"
    if fit:
        error = "" if fit.error is None else f": reprojection error {fit.error:.2f} pixels"
        text = f"{'given ' if refined else ''}poses compared by {fit.evidence}{error}"
    return text if cloud is None else f"{_points(cloud)}; {text}"


def _resolved(options: dict[str, Any]) -> dict[str, Any]:
    """Options as values of JSON that are the same for other words of the same."""
    values: dict[str, Any] = {"exclude": sorted(set(options["exclude"] or ()))}
    paths = {key: one for key, one in options.items() if isinstance(one, Path)}
    values |= {key: os.path.realpath(path) for key, path in paths.items()}
    resolved: dict[str, Any] = json.loads(json.dumps(options | values))
    return resolved


def _stamp(files: Sequence[Path]) -> dict[str, Any]:
    """Number of the files that exist, and SHA-256 of their paths and contents, for the record."""
    digest = hashlib.sha256()
    paths = sorted({path.resolve() for path in files if path.is_file()})
    for k, path in enumerate(paths):
        report("reading files", k, len(paths))
        digest.update(os.fsencode(path))
        with suppress(OSError), path.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return {"files": len(paths), "sha256_of_files": digest.hexdigest()}


def _finished(out: Path) -> dict[str, Any]:
    """Record of the finished import in a folder. Empty where there is none. Records of earlier
    versions lack options, files or their digest."""
    if not all((out / name).is_file() for name in (RECORD, "transforms.json")):
        return {}
    record: Any = read_json(out / RECORD)
    whole = isinstance(record, dict) and ("files" in record or "options" not in record)
    return dict(record) if whole else {}


def _check_same(out: Path, record: dict[str, Any], options: dict[str, Any]) -> None:
    """Raise InputError where a finished import has other options, as far as its record says."""
    before: Any = record.get("options")
    known: dict[str, Any] = before if isinstance(before, dict) else {}
    for key, value in known.items():
        same = value, record.get(key, value)  # of downscale also what the default came to
        if options.get(key, value) not in same:
            what = key if key == "source" else f"--{key.replace('_', '-')}"
            raise InputError(f"{out}: is finished with another {what}; {_again(record)}")


def _check_unchanged(out: Path, record: dict[str, Any], files: dict[str, Any]) -> None:
    """Raise InputError where a finished import has other files, as far as its record says. files:
    `_stamp`."""
    key = "sha256_of_files"
    if record.get(key, files[key]) != files[key]:
        why = "its pictures, masks, mesh or model have changed since"
        raise InputError(f"{out}: is finished, and {why}; {_again(record)}")


def _again(record: dict[str, Any]) -> str:
    """What --force does to a finished import of this record, in words."""
    placed = ", and places all photographs again" if record.get("kind") == PHOTOGRAPHS else ""
    return f"--force makes it again{placed}"


def _triangulated(
    result: Dataset, matcher: Matcher, larger: Sequence[Shot], folder: Path
) -> SparseCloud | None:
    """Triangulate points at the dataset's poses: in the source pictures `larger`, else in its own.
    The former give several times as many. matcher: of its own pictures. folder: for matches of
    `larger`."""
    cameras = [result.world.leave(frame.camera) for frame in result.frames]
    upright = {s.name: s for s in larger if s.turned or exif_orientation(s.image) == 1}
    cloud = None
    if len(upright) == len(cameras):
        shots = [upright[frame.name] for frame in result.frames]
        pictures = [(shot.image, shot.camera, shot.lens) for shot in shots]
        cloud = Matcher.of_lenses(pictures, folder).triangulated(cameras)
    return matcher.triangulated(cameras) if cloud is None else cloud


def _points(cloud: SparseCloud) -> str:
    text = f"{len(cloud.points):,} points"
    if cloud.error is None or cloud.track is None:
        return text
    error = float(np.average(cloud.error, weights=cloud.track))
    return f"{text} with a reprojection error of {error:.2f} pixels"


def _advice(source: Source, result: Dataset) -> Iterator[str]:
    if source.no_cloud:
        yield f"the points that the source names, {source.no_cloud}, do not exist"
    if any(source.origin):
        far = "the cameras are far from the origin, where float32 is coarse"
        place = f"{_numbers(source.origin)} is the origin now; exports and suggested poses add it"
        plan = "a flight plan needs its latitude and longitude as `mgs suggest --origin`"
        yield f"{far}: {place} again, and {plan}"
    some = result.frames[:: max(1, len(result) // 10)]
    masks = [frame.mask() for frame in some if frame.mask_path]
    empty = sum(not mask.any() for mask in masks)
    if empty > MOSTLY * len(masks):
        many = f"{empty} of {len(masks)} masks looked at are empty"
        yield f"{many}: the object must be white in them, and a mesh in the cameras' axes"
    rims = [(mask[0], mask[-1], mask[:, 0], mask[:, -1]) for mask in masks]
    if masks and min(np.concatenate(rim).mean() for rim in rims) > WHITE_RIM:
        yield "the masks are white along their borders: only the object must be white in them"
    blurs: dict[str, float] = {}
    for done, frame in enumerate(result.frames):
        report("looking for blur", done, len(result))
        blurs[frame.name] = frame_blur(frame, frame.mask())
    yield from blur_problems(blurs)
    stops = [value for shot in source.shots if (value := exif_exposure(shot.image)) is not None]
    if stops and max(stops) - min(stops) > EXPOSURE_DIFFERS:
        most = f"by up to {max(stops) - min(stops):.1f} stops between photographs"
        cure = "`mgs fit --exposure` estimates a gain for each"
        yield f"by their EXIF, exposure differs {most}; {cure}"


def _print_summary(
    console: Terminal, source: Source, tests: Source | None, result: Dataset, more: Sequence[str]
) -> None:
    frames, apart = result.frames, len(tests.shots) if tests else 0
    total, alone = len(source.shots) + source.left_out.total(), source.kind == PHOTOGRAPHS
    placed = f"{len(source.shots)} of {total} photographs placed"
    scale = "--distance A,B,METRES" if alone else "--unit"
    without = ", ".join(f"{count} {reason}" for reason, count in source.left_out.items())
    counts = {
        "with mask": sum(frame.mask_path is not None for frame in frames),
        "with alpha": sum(frame.rock_path is not None for frame in frames),
        "with depth": sum(frame.depth_path is not None for frame in frames),
        "undistorted": sum(shot.lens is not None for shot in source.shots),
        "turned by EXIF": sum(shot.turned for shot in source.shots),
    }
    lengths = "metres" if result.unit == "m" else f"{result.unit}s ({scale} gives metres)"
    parts = [
        placed if alone else f"{source.kind}: {len(frames)} frames of {total} images",
        *([f"{apart} set apart as test views, never fitted"] if apart else []),
        *([f"left out {without}"] if without else []),
        *(f"{count} {what}" for what, count in counts.items() if count),
        *more,
        f"lengths in {lengths}",
        *([f"origin {_numbers(source.origin)}"] if any(source.origin) else []),
    ]
    console.print("; ".join(parts), soft_wrap=True)


def _numbers(vector: Sequence[float]) -> str:
    return f"({', '.join(f'{value:.10g}' for value in np.round(vector, 4) + 0.0)})"
