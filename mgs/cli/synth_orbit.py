"""`mgs synth-orbit`: render a dataset, an orbit around a rock."""

import re
from pathlib import Path
from typing import Annotated, Literal

import typer

from mgs import runtime
from mgs.camera import MAX_PIXELS
from mgs.cli.options import Count, Seed
from mgs.cli.terminal import Terminal, progress_bar
from mgs.errors import InputError
from mgs.files import Ours, clear_folder
from mgs.synth.scene_file import OrbitKind, load_scene_file

FILES = [
    *("config.json", "transforms.json", "images", "depth", "masks", "rock", "rock.glb", "test"),
    *("survey", "timings.json", "true_poses.json", "contact_sheet.png"),
]
"""Names in a folder of this command."""


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
    runtime.start()
    from mgs.synth.orbit import PoseNoise
    from mgs.synth.rendering import synth_orbit as rendered

    factors = {"kind": orbit, "distances": distances and distances.split(",")}
    settings = load_scene_file(scene, **{key: value for key, value in factors.items() if value})
    if mesh_up is not None and mesh is None:
        raise InputError("--mesh-up: says how a mesh stands, but there is none; give --mesh too")
    noise = PoseNoise(pose_noise, rotation_noise) if pose_noise or rotation_noise else None
    console = Terminal()
    if force:
        clear_folder(out, Ours(FILES, [path for path in (mesh, Path(scene)) if path]))
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
            size=_parse_size(size),
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
    if not 0 < width * height <= MAX_PIXELS:
        form = f"WIDTHxHEIGHT, at most {MAX_PIXELS:,} pixels in all, as in 320x240"
        raise InputError(f"--size {size!r}: expected {form}")
    return width, height
