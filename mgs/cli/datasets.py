"""`mgs synth-orbit`, `survey`, `dataset`: render a dataset, fly over it, check it."""

import re
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.table import Table

from mgs import runtime
from mgs.camera import MAX_PIXELS
from mgs.cli.options import Count, Seed
from mgs.cli.terminal import Terminal, progress_bar
from mgs.errors import InputError
from mgs.files import Ours, atomic_folder, below, clear_folder, working_in
from mgs.synth.scene_file import OrbitKind, load_scene_file

LEAST_SIDE = 3  # of an image, pixels: the rock is wholly in it, a pixel from each border

RENDERED = ["config.json", "transforms.json", "images", "depth", "masks", "rock", "rock.glb"]
RENDERED += ["test", "survey", "timings.json", "true_poses.json", "contact_sheet.png"]
"""Names in a folder of `mgs synth-orbit`."""


def synth_orbit(
    out: Path,
    scene: str = "boulder",
    orbit: OrbitKind | None = None,
    distances: str | None = None,
    mesh: Path | None = None,
    mesh_up: Literal["y", "z"] | None = None,
    preset: str = "quick",
    spp: Count = None,
    frames: Count = None,
    size: str | None = None,
    test_views: Annotated[int, typer.Option(min=0)] = 0,
    on_demand: bool = False,
    pose_noise: Annotated[float, typer.Option(min=0)] = 0.0,
    rotation_noise: Annotated[float, typer.Option(min=0)] = 0.0,
    seed: Seed = 0,
    force: bool = False,
) -> None:
    """Render a dataset with Mitsuba: an orbit around a rock, with photoreal images, depth, rock
    masks and exact poses.

    Writes transforms.json (nerfstudio's format), images/, depth/, masks/, rock/ (images of the rock
    alone, with alpha), the true rock as rock.glb, config.json and contact_sheet.png. The same
    command continues an interrupted run.

    With --on-demand it writes poses, test views and a survey (depth and masks, in OUT/survey). The
    image of a frame is rendered when `mgs nbv` chooses it.

    - out: Folder to write: new, empty, or left by an interrupted run.
    - scene: Name of a scene that comes with mgs, or path of a .toml file.
    - orbit: Default: the scene's.
    - distances: Factors on the distance of the frames from the rock, in turn, as in 1,2,3. Default:
      the scene's.
    - mesh: A real rock: textured GLB, OBJ or PLY, scaled to the scene.
    - mesh_up: Up axis of --mesh. Default: y for GLB (as glTF says) and OBJ, else z.
    - preset: quick: 32 frames of 320x240. paper: 100 frames of 640x480.
    - spp: Samples per pixel, rounded up to a full grid. Default: as --preset says.
    - frames: Number of views on the orbit. Default: as --preset says.
    - size: Image size WIDTHxHEIGHT, pixels. Default: as --preset says.
    - test_views: Number of test views on a dome around the rock, in OUT/test.
    - on_demand: Render no frames yet, only test views and a survey for `mgs prior`; `mgs nbv OUT`
      renders each frame that it chooses.
    - pose_noise: Error of camera positions in transforms.json: standard deviation per axis, metres.
    - rotation_noise: The same of camera rotations, degrees."""
    sides = _parse_size(size)
    if mesh_up is not None and mesh is None:
        raise InputError("--mesh-up: says how a mesh stands, but there is none; give --mesh too")
    runtime.start()
    from mgs.synth.orbit import PoseNoise
    from mgs.synth.rendering import synth_orbit as rendered

    factors = {"kind": orbit, "distances": distances and distances.split(",")}
    settings = load_scene_file(scene, **{key: value for key, value in factors.items() if value})
    noise = PoseNoise(pose_noise, rotation_noise) if pose_noise or rotation_noise else None
    console = Terminal()
    if force:
        clear_folder(out, Ours(RENDERED, [path for path in (mesh, Path(scene)) if path]))
    with progress_bar("rendering", console):
        dataset = rendered(
            out,
            settings,
            preset,
            seed,
            mesh,
            noise,
            say=console.print,
            mesh_up=mesh_up,
            test_views=test_views,
            on_demand=on_demand,
            frames=frames,
            size=sides,
            spp=spp,
        )
    camera, none = dataset.frames[0].camera, ", none rendered" if on_demand else ""
    look = "" if on_demand and not test_views else f"; look at {out / 'contact_sheet.png'}"
    console.print(
        f"{out}: {len(dataset)} frames{none} and {test_views} test views, "
        f"{camera.width}x{camera.height}{look}"
    )


def _parse_size(size: str | None) -> tuple[int, int] | None:
    """Width and height of an option like 320x240. Raises InputError if malformed."""
    if size is None:
        return None
    sides = re.fullmatch(r"(\d{1,9})x(\d{1,9})", size.lower(), re.ASCII)
    width, height = (int(side) for side in sides.groups()) if sides else (0, 0)
    if min(width, height) < LEAST_SIDE or width * height > MAX_PIXELS:
        form = f"WIDTHxHEIGHT, each {LEAST_SIDE} or more, {MAX_PIXELS:,} pixels at most"
        raise InputError(f"--size {size!r}: expected {form}")
    return width, height


FLOWN = ["survey.json", "cloud.ply", "survey.png", "transforms.json", "rock.glb"]
FLOWN += ["images", "masks", "rock", "depth", "test"]
"""Names in a folder of `mgs survey`."""


def survey(
    dataset: Path,
    out: Path | None = None,
    poses: Literal["estimated", "exact"] = "estimated",
    sensor_noise: float | None = None,
    drift: float | None = None,
    seed: Seed = 0,
    force: bool = False,
) -> None:
    """Simulate a survey flight along a dataset's orbit: noisy depth, drifting odometry,
    registration, loop closure and fusion.

    The result is a dataset with estimated poses and measured depth, from which `mgs prior OUT`
    builds a prior. The folder also holds cloud.ply, survey.json and survey.png.

    - dataset: Dataset folder (transforms.json) with exact depth images.
    - out: Folder to write, new or empty. Default: DATASET/survey.
    - poses: estimated: by odometry, registration and loop closure. exact: the true poses.
    - sensor_noise: Factor on the depth camera's noise; 0: exact depth. Default: as the dataset's
      scene says, else 1.
    - drift: Factor on the errors of odometry. Default: as the dataset's scene says, else 1."""
    from mgs.data.dataset import load_dataset
    from mgs.survey.flight import SurveySettings, fly, save_survey
    from mgs.synth.scene_file import sensor_of

    console = Terminal()
    frames = load_dataset(dataset)
    folder = out if out is not None else below(dataset, "survey")
    sensor = sensor_of(dataset)
    noise = sensor.noise if sensor_noise is None else sensor_noise
    drift = sensor.drift if drift is None else drift
    settings = SurveySettings(noise, drift, poses == "exact", seed)
    # The folder is checked and locked before the work.
    ours = Ours(FLOWN, [dataset]) if force else None
    with atomic_folder(folder, ours) as unfinished, progress_bar("survey", console) as progress:
        flown = fly(frames, settings)
        progress("writing")
        numbers = save_survey(unfinished, frames, flown, settings)
    console.print(_table(numbers))
    what = "a dataset with estimated poses and measured depth, cloud.ply, survey.json, survey.png"
    console.print(f"wrote {folder}: {what}")


def _table(numbers: dict[str, Any]) -> Table:
    from mgs.survey.flight import STAGES

    rows = {
        "frames, length of the flight": f"{numbers['frames']}, {numbers['path_length']:.1f} m",
        "depth error on the rock (robust sigma)": f"{1e3 * numbers['depth_error_on_rock']:.1f} mm",
        "returns lost": f"{numbers['returns_lost']:.1%}",
        "points of the fused cloud": f"{numbers['points']:,}",
    }
    if not numbers["settings"]["exact_poses"]:
        closed = ", ".join(f"{i}-{j}" for i, j, _ in numbers["loops"])
        rows["steps where registration failed"] = str(numbers["steps_by_odometry"])
        rows["loop closures"] = closed or "none"
        for name, label in STAGES.items():
            rms, most, turn = numbers["error"][name].values()
            text = f"{1e3 * rms:.1f} mm rms, {1e3 * most:.1f} mm at most, {turn:.2f} degrees"
            rows[f"trajectory error, {label}"] = text
    table = Table("survey", "number", title="Survey")
    for row in rows.items():
        table.add_row(*row)
    return table


def dataset(action: Literal["check", "masks"], path: Path, prior: Path | None = None) -> None:
    """Check a dataset, or make masks for one that has none.

    `mgs dataset check DATASET` checks that every file can be read and has the right size, and that
    colour, depth, masks and poses agree. It prints every problem and its cure, and exits with code
    2 if there is one. Test views are a dataset of their own: check DATASET/test, too.

    `mgs dataset masks DATASET` projects the prior's mesh into every image and writes masks/. Look
    at masks.png, which shows them, before you use them.

    - action: check or masks: see above.
    - path: Folder of the dataset.
    - prior: For masks: folder of the prior. Default: DATASET/prior."""
    if action == "masks":
        _make_masks(path, prior or path / "prior")
    else:
        _check(path)


def _make_masks(path: Path, prior: Path) -> None:
    from mgs.data.dataset import load_dataset
    from mgs.data.masks import SHEET, make_masks
    from mgs.prior.build import load_prior

    data, mesh_prior = load_dataset(path), load_prior(prior)
    console = Terminal()
    with working_in(path), progress_bar("masks", console):
        masks = make_masks(data, mesh_prior.mesh)
    sheet = path / SHEET
    console.print(f"{path}: {len(masks)} masks of {prior}; look at {sheet} before you use them")


def _check(path: Path) -> None:
    from mgs.data.check import check_dataset, taken_frames
    from mgs.data.dataset import load_dataset
    from mgs.data.frames import has_masks

    data = load_dataset(path)
    console = Terminal()
    with progress_bar("reading", console):
        check = check_dataset(data)
    camera, (low, high) = data.frames[0].camera, check.depth_range
    absent = len(data) - len(taken_frames(data))
    waiting = f" ({absent} of them on demand, not taken yet)" if absent else ""
    size = f"{camera.width}x{camera.height}"
    if has_masks(data.frames):
        size += f", object on {check.mask_share:.0%} of the pixels"
    console.print(f"{path}: {len(data)} frames{waiting}, {size}")
    if high > 0:
        through = f"neighbours see through {check.seen_through:.1%} of it"
        console.print(f"depth of the object {low:.2f} to {high:.2f} m; {through}")
    if check.problems:
        for problem in check.problems:
            console.print(f"- {problem}", soft_wrap=True, highlight=False)
        raise InputError(f"{path}: {len(check.problems)} problem(s), listed above")
    console.print("no problems found")
