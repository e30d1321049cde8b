"""`mgs suggest`: the next pictures to take, from the images so far and candidate poses."""

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
from pydantic import Field, field_validator
from rich.table import Table

from mgs import runtime
from mgs.cli.options import (
    Count,
    Settings,
    not_none,
    parse_gaussians,
    parse_settings,
    refuse_unused,
    with_keys,
)
from mgs.cli.terminal import Terminal, progress_bar
from mgs.data.dataset import load_dataset, read_records
from mgs.data.flight_plan import Stop, check_plan_path, parse_origin, write_flight_plan
from mgs.data.on_site import dataset_at, holds_photographs
from mgs.data.photographs import photographs_in
from mgs.data.structure import CLOUD
from mgs.errors import InputError
from mgs.files import Ours, atomic_folder, check_new_file, check_new_folder
from mgs.fit.settings import Frozen
from mgs.policy.criteria import GAIN_UNIT
from mgs.prior.photographs import check_enough, choose_source
from mgs.reports.suggestion import write_suggestion
from mgs.run.candidates import MOST_POSES, Named, inside, place_poses, read_poses
from mgs.run.folder import Run, holds_run, open_run
from mgs.run.nbv import resume_nbv, start_fit, start_of_fit, start_run
from mgs.run.settings import FlightLimits, Positive, SearchLimits, validated
from mgs.run.suggest import Suggestion, View, site_of, taken_in_order
from mgs.run.suggest import suggest as suggested

Degrees = Annotated[float, Field(ge=-90, le=90)]

DOME = 100  # candidates where none are given
SHOWN = 10  # rows of the table of one view to take; suggestions.json has all
SITE, NEXT = ".site", "next"  # beside photographs alone: end of a folder's name, and --out in it
PASSES = 2  # passes of its own fit to a whole scene: enough to choose a view by, too few to show
FILES = ("suggestions.json", "suggestions.png", "transforms.json")  # names in the folder --out


class Candidates(Frozen):
    """Settings of candidates, and limits of the flight."""

    ring: Annotated[int, Field(ge=1)] | None = None
    """Candidates: this many poses on a ring."""
    grid: Annotated[int, Field(ge=1)] | None = None
    """Candidates: about this many poses of a cubic lattice."""
    radius: Annotated[float, Field(ge=1e-6, le=1e6)] | None = None
    """Radius of dome, ring or grid. Default: median distance of the images."""
    elevations: tuple[Degrees, Degrees] | None = None
    """Lowest and highest elevation, degrees. Default: 10,80 with dome, ring or grid, else any."""
    safe_distance: Positive | None = None
    """Least distance from the prior's mesh, or from the points of a whole scene. Default: half that
    of the images with dome, ring or grid, else 0."""
    flight: FlightLimits = FlightLimits()
    """Limits of the flight and of its poses."""
    certificate: SearchLimits = SearchLimits()
    """Limits of the search for a better set than the plan."""
    refine: bool = False
    """Move each planned pose to where its gain (Eq. 7) is largest near it, within the limits."""
    enough: Annotated[float, Field(gt=0, le=1)] | None = None
    """Share of the criterion's gain of all candidates, with --views auto. Default: 0.95."""

    @field_validator("elevations")
    @classmethod
    def _rise(cls, band: tuple[float, float] | None) -> tuple[float, float] | None:
        if band and band[0] > band[1]:
            raise ValueError("expected lowest, highest, as in 10,80")
        return band


@with_keys(Candidates)
def suggest(
    source: Path,
    poses: Path | None = None,
    dome: Count = None,
    views: str = "1",
    out: Path | None = None,
    plan: list[Path] | None = None,
    origin: str | None = None,
    policy: str | None = None,
    prior: Path | None = None,
    gaussians: str | None = None,
    settings: Settings = None,
    force: bool = False,
) -> None:
    """Rank candidate poses by what a picture from each would add; plan the next flight.

    Given a dataset, fits a model to all its images and scores 100 poses on a dome, or the
    candidates that you choose; they need no images. Given a run, uses its model as it is; its
    candidates are by default the frames that it has not taken. Given photographs alone, places
    them first, in SOURCE.site; the same command again takes the photographs since then. With
    --views K it plans K views together and puts them into flying order, from the first image and
    back to it. Lengths are in the dataset's unit.

    - source DATASET|RUN|PHOTOGRAPHS: Dataset folder, folder of a run, or of photographs alone.
    - poses: Candidates: a transforms.json without images, or a CSV with columns x,y,z.
    - dome N: Candidates: poses on a dome.
    - views N|auto: Views to plan together, in flying order; with a limit of the flight, at most.
      auto: as few as have the share `enough` of the gain of all candidates.
    - out: New folder for suggestions.json, transforms.json and suggestions.png. Default:
      SOURCE.site/next of photographs alone, else none.
    - plan: Flight plan to write: .plan, .waypoints or .kml; repeatable. Needs --origin, or
      photographs with GPS.
    - origin: Where the world's origin is: LAT,LON,ALT or, if +Y is not north, ...,BEARING.
    - policy: Default: that of the run, or of `mgs nbv`.
    - prior: Folder of `mgs prior`. Default: DATASET/prior, or one built now.
    - gaussians N|auto: Build a prior of this many Gaussians."""
    console = Terminal()
    for path in plan or ():
        check_plan_path(path)
        check_new_file(path, force)
    values = parse_settings(settings, suggest)
    if views != "auto":
        refuse_unused("without --views auto", **{"set enough": values.get("enough")})
    asked = validated(Candidates, values)
    shape = _shape(poses, dome, asked)
    own = ("flight", "enough", "certificate")
    changes = {key: values[key] for key in own if key in values} | not_none(policy=policy)
    count = parse_gaussians(views, "views") or 1
    fit: dict[str, Any] = {"prior": prior, "gaussians": parse_gaussians(gaussians)}
    fit["policy"] = policy
    if out is not None and not force:
        check_new_folder(out)
    if holds_photographs(source):
        site = Path(f"{source.resolve()}{SITE}")
        source = _placed(source, site, console)
        out, force = out or site / NEXT, force or out is None
        fit["train"] = {"passes": PASSES}
    place = parse_origin(origin) if origin else _place(source)
    if plan and place is None:
        zero = "the place of the world's 0 as LAT,LON,ALT, which only photographs with GPS have"
        raise InputError(f"suggest: `plan` needs `origin`, {zero}")
    ours = Ours(FILES, [path for path in (source, poses, prior) if path]) if force else None
    if out is not None:
        check_new_folder(out, ours)
    runtime.start()
    with TemporaryDirectory() as scratch, progress_bar("reading", console):
        run = _run(source, Path(scratch) / "run", fit)
        if plan and run.dataset.unit != "m":
            raise InputError(f"{source}: a flight plan needs metres; import the data with `unit`")
        candidates, safe, band = _candidates(run, poses, shape, asked)
        changes |= {"safe_distance": safe, "elevations": band, "refine": asked.refine}
        result = suggested(run, candidates, count, **changes)
        crossed = _crossed(run, result)
        if crossed and plan:
            cure = "so no flight plan is written; give flight.no_fly"
            raise InputError(f"suggest: {crossed}, {cure}")
        if out is not None:
            with atomic_folder(out, ours) as unfinished:
                write_suggestion(unfinished, run, result)
        for path in plan or ():
            _write_plan(path, run, result, place, asked.flight)
    _print(console, result, run, crossed, place)
    for written in [*([f"{out}: {', '.join(FILES)}"] if out else []), *(plan or ())]:
        console.print(f"wrote {written}", soft_wrap=True)


def _placed(photographs: Path, site: Path, console: Terminal) -> Path:
    # Refuses minutes before pictures are placed.
    check_enough(len(photographs_in(photographs)), str(photographs))
    with progress_bar("reading", console):
        dataset, notes = dataset_at(photographs, site)
    for note in notes:
        console.print(note, soft_wrap=True)
    return dataset.root


def _place(source: Path) -> Any:
    """Place of the world's origin, as the import of photographs with GPS wrote it; else None."""
    root = open_run(source).settings.dataset if holds_run(source) else source
    if not (root / "transforms.json").is_file():  # which `load_dataset` says better
        return None
    text = read_records(root / "transforms.json")[0].get("place")
    return parse_origin(text) if isinstance(text, str) else None


def _run(source: Path, scratch: Path, settings: dict[str, Any]) -> Run:
    """The run itself, or a new one in `scratch`, fitted to all images of a dataset, of a room with
    depth as `mgs fit` does it: no surface is in its middle."""
    if holds_run(source):
        for name in ("prior", "gaussians"):
            if settings[name] is not None:
                raise InputError(f"suggest: {source} is a run with its model; leave out `{name}`")
        return open_run(source)
    data, given = load_dataset(source), not_none(**settings)
    deep = settings["prior"] is None and choose_source(data.survey()) == "depth"
    if deep and start_of_fit(data, None, None, {}).source:
        quick = {"train": {"passes": PASSES}}
        return resume_nbv(start_fit(source, scratch, **quick | given))
    return resume_nbv(start_run(data, scratch, seeds=len(data), budget=0, **given))


def _shape(poses: Path | None, dome: int | None, asked: Candidates) -> tuple[str, int] | None:
    """Kind and number of the candidates that are asked for, if they are. Raises InputError where
    there are two kinds, too many, or no file of them: placing and fitting pictures takes long."""
    shapes = not_none(dome=dome, ring=asked.ring, grid=asked.grid)
    if len(shapes) + (poses is not None) > 1:
        raise InputError("suggest: `poses`, `dome`, `ring`, `grid`: give one of them")
    if poses is not None and not poses.exists():
        raise InputError(f"{poses}: no such file; give a transforms.json or a CSV of poses")
    for kind, count in shapes.items():
        if count > MOST_POSES:
            raise InputError(f"suggest: {kind} {count:,}: give at most {MOST_POSES:,} poses")
    return next(iter(shapes.items()), None)


def _candidates(
    run: Run, poses: Path | None, shape: tuple[str, int] | None, asked: Candidates
) -> tuple[Sequence[Named], float, tuple[float, float] | None]:
    """Candidates, their least distance from the mesh, and their elevations."""
    site = site_of(run)
    left = [frame for frame in run.dataset.frames if frame not in run.taken]
    safe, band = asked.safe_distance, asked.elevations
    if poses is not None:
        return read_poses(poses, site), safe or 0.0, band
    if shape is None and left:
        return [(frame.name, frame.camera) for frame in left], safe or 0.0, band
    kind, count = shape or ("dome", DOME)
    eyes = np.stack([frame.camera.position for frame in run.taken])
    band = band or (10.0, 80.0)
    if safe is None:
        safe = float(site.clearance(eyes).min()) / 2
    far = float(np.median(np.linalg.norm(eyes - site.centre, axis=1)))
    return place_poses(kind, count, asked.radius or far, band, site), safe, band


def _crossed(run: Run, result: Suggestion) -> str:
    """Say which leg crosses the object, if one does; a whole scene has none."""
    if site_of(run).whole:
        return ""
    home = taken_in_order(run)[0].camera.position
    ends = [*(view.camera.position for view in result.plan), home]
    names = [*(view.name for view in result.plan), "the first image"]
    for here, corners, end, name in zip([home, *ends], result.corners, ends, names, strict=False):
        way = np.array([here, *corners, end])
        steps = np.linspace(0, 1, 50)[:, None, None]
        points = (way[:-1] + steps * np.diff(way, axis=0)).reshape(-1, 3)
        if inside(run.prior.mesh, points).any():
            return f"the leg to {name} crosses the object"
    return ""


def _write_plan(path: Path, run: Run, result: Suggestion, place: Any, limits: FlightLimits) -> None:
    """Write a flight plan; home is on the ground under the first image."""
    home = taken_in_order(run)[0].camera.position
    stops = [Stop(np.array([*home[:2], site_of(run).ground]))]
    for corners, view in zip(result.corners, [*result.plan, None], strict=True):
        stops += [Stop(corner) for corner in corners]
        if view is not None:
            stops.append(Stop(view.camera.position, view.name, view.camera))
    write_flight_plan(path, stops, place, limits.hover, limits.speed)


def _print(console: Terminal, result: Suggestion, run: Run, crossed: str, place: Any) -> None:
    if run.prior.kind == "random":
        lacks = "the model has no surface of an object: nothing tells seen from unseen"
        deep = any(frame.depth_path for frame in run.dataset.frames)  # of a room, which has none
        cure = f"import with masks{'' if deep else ' or depth'}, or fit with `prior`"
        if (run.dataset.root / CLOUD).is_file():
            cure = f"`mgs suggest {run.dataset.root}` builds one of the points"
        console.print(f"{lacks}, and gains are no guide; {cure}", soft_wrap=True)
    for reason, count in result.dropped.items():
        console.print(f"candidates left out: {count} {reason}")
    rows, unit = result.plan if len(result.plan) > 1 else result.ranking[:SHOWN], run.dataset.unit
    table = Table(box=None)
    known = unit != "unit"  # else lengths say nothing
    length = [f"distance ({unit})"] if known else []
    numbers = ("score", "gain", *length, "azimuth", "elevation", "unseen", "unknown")
    for heading in ("", "pose", *numbers):
        table.add_column(heading, justify="left" if heading == "pose" else "right", overflow="fold")
    for number, view in enumerate(rows, 1):
        table.add_row(str(number), view.name, *_cells(view, known))
    console.print(table)
    north = place.bearing if place else 0.0
    for number, view in enumerate(result.plan, 1):
        bearing, _ = Stop(view.camera.position, "", view.camera).heading_and_pitch(north)
        facing = f"; bearing {bearing:.0f}°" if place else ""
        moved = f"; moved {view.moved:.2f} {unit}" if result.refined and known else ""
        console.print(f"{number}: {view.way}{facing}{moved}", soft_wrap=True)
    time = f" and {result.seconds:.0f} s" if unit == "m" else ""  # its speed is in metres
    plan = f"{len(result.plan)} view{'s' if len(result.plan) > 1 else ''}"
    console.print(f"gain: Eq. 7, {GAIN_UNIT}; unseen, unknown: shares of what the picture shows")
    if known:
        flight = f"{result.metres:.1f} {unit}{time} from the first image through {plan} and back"
        console.print(f"flight: {flight}")
    if result.refined:
        console.print("refined: gain of the plan from {:.4f} to {:.4f}".format(*result.refined))
    if result.certificate and len(result.plan) > 1:  # the best of the table needs no proof
        console.print(result.certificate.sentence(), soft_wrap=True)
    if crossed:
        console.print(f"{crossed}; give flight.no_fly to plan around it")


def _cells(view: View, distance: bool) -> tuple[str, ...]:
    return (
        f"{view.score:.4g}",
        f"{view.information_gain:.4f}",
        *([f"{view.distance:.2f}"] if distance else []),
        f"{view.azimuth:.0f}°",
        f"{view.elevation:.0f}°",
        f"{100 * view.unseen:.1f} %",
        f"{100 * view.unknown:.0f} %",
    )
