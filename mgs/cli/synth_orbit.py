"""`mgs synth-orbit`: render a dataset, an orbit around a rock."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import typer

from mgs import runtime
from mgs.camera import MAX_PIXELS
from mgs.cli.options import Count, Seed
from mgs.cli.progress import progress_bar
from mgs.cli.terminal import Terminal
from mgs.errors import InputError, row_named
from mgs.files import Ours, clear_folder
from mgs.synth.scene_file import ORBITS, load_scene_file

FILES = [
    *("config.json", "transforms.json", "images", "depth", "masks", "rock", "rock.glb", "test"),
    *("survey", "timings.json", "true_poses.json", "contact_sheet.png"),
]
"""Names in a folder of this command."""


def synth_orbit(
    out: Path,
    scene: str = "boulder",
    orbit: str | None = None,
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
    - orbit: circle, rings, spiral or hemisphere. Default: the scene's.
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
    - rotation_noise: The same of camera rotations, degrees.
    """
    runtime.start()
    from mgs.synth.orbit import PoseNoise
    from mgs.synth.rendering import PRESETS
    from mgs.synth.rendering import synth_orbit as rendered

    settings = load_scene_file(scene)
    if orbit is not None and orbit not in ORBITS:
        raise InputError(f"--orbit {orbit!r}: unknown; choose one of {', '.join(ORBITS)}")
    changes = {"kind": orbit, "distances": distances and _parse_distances(distances)}
    chosen = settings.orbit.model_copy(update={k: v for k, v in changes.items() if v})
    settings = settings.model_copy(update={"orbit": chosen})
    if mesh_up is not None and mesh is None:
        raise InputError("--mesh-up: says how a mesh stands, but there is none; give --mesh too")
    given = {"spp": spp, "frames": frames, **_parse_size(size)}
    images = row_named(PRESETS, preset, "preset")
    images = replace(images, **{key: value for key, value in given.items() if value is not None})
    noise = PoseNoise(pose_noise, rotation_noise) if pose_noise or rotation_noise else None
    views = f"{images.frames} frames" + (", none rendered" if on_demand else "")
    views += f" and {test_views} test views" if test_views else ""
    stage = f"{views}, {images.width}x{images.height}"
    console = Terminal()
    if force:
        clear_folder(out, Ours(FILES, [path for path in (mesh, Path(scene)) if path]))
    with progress_bar(stage, console) as progress:
        rendered(
            out,
            settings,
            images,
            seed,
            mesh,
            noise,
            progress=partial(progress, stage),
            say=partial(console.print, markup=False),
            mesh_up=mesh_up,
            test_views=test_views,
            on_demand=on_demand,
        )
    look = "" if on_demand and not test_views else f"; look at {out / 'contact_sheet.png'}"
    console.print(f"{out}: {views}{look}")


def _parse_distances(text: str) -> tuple[float, ...]:
    """Factors of an option like 1,2,3. Raises InputError if one is no positive number."""
    try:
        factors = tuple(float(part) for part in text.split(","))
    except ValueError:
        factors = (0.0,)
    if not all(0 < factor < math.inf for factor in factors):
        raise InputError(f"--distances {text!r}: expected positive numbers, as in 1,2,3")
    return factors


def _parse_size(size: str | None) -> dict[str, int]:
    """Width and height of an option like 320x240; {} for None. Raises InputError if malformed."""
    if size is None:
        return {}
    found = re.fullmatch(r"(\d{1,9})x(\d{1,9})", size.lower(), re.ASCII)
    width, height = (int(side) for side in found.groups()) if found else (0, 0)
    if not 0 < width * height <= MAX_PIXELS:
        raise InputError(
            f"--size {size!r}: expected WIDTHxHEIGHT, at most {MAX_PIXELS:,} pixels in all, "
            "as in 320x240"
        )
    return {"width": width, "height": height}
