"""Render an orbit around a rock into a dataset folder."""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image

from mgs import runtime
from mgs.camera import Camera, opengl_from_opencv
from mgs.data.dataset import (
    FRAME_INTERVAL,
    SURVEY_FOLDER,
    TEST_FOLDER,
    Dataset,
    Frame,
    load_dataset,
    resumes,
    write_transforms,
)
from mgs.data.meshes import GLTF, to_glb
from mgs.data.rock_image import write_rock_image
from mgs.errors import InputError, row_named
from mgs.files import (
    atomic_path,
    check_new_folder,
    check_writable,
    copy_file,
    fingerprint,
    locked,
    new_folder,
    write_json,
)
from mgs.images import write_exr, write_png
from mgs.provenance import versions
from mgs.seeds import derive_seed, generator
from mgs.synth.orbit import orbit_cameras, perturb
from mgs.synth.rock import load_rock, make_rock, up_axis
from mgs.synth.scene import Scene
from mgs.synth.scene_file import Orbit, SceneFile, load_scene_file

NOISY_FACTOR = 8
"""Factor on the samples per pixel where pyoidn, the denoiser, is not installed."""

DOME_ELEVATIONS = (5.0, 75.0)
"""Lowest and highest elevation of test views, seen from the rock's middle, degrees: the lowest look
over the stones on the ground, the highest down on the rock."""

ROCK_EXPOSURE = 0.2
"""Mean linear value of the rock's pixels over the orbit: the exposure is metered once on the rock,
as a photographer does."""
MAX_CLIPPED = 0.2
"""Largest share of the pixels of rock and ground (the sky may clip) that the exposure may clip: a
dark rock would blow bright
ground out. The scenes of mgs clip at most 0.04 of them, on every kind of orbit: there the rock
alone decides."""


@dataclass(frozen=True)
class Preset:
    """Image size in pixels, number of frames, samples per pixel."""

    width: int
    height: int
    frames: int
    spp: int


@dataclass(frozen=True)
class PoseNoise:
    """Standard deviations, along and about each axis, of the errors of the poses in
    transforms.json: metres and degrees."""

    position: float = 0.0
    rotation: float = 0.0


PRESETS = {"quick": Preset(320, 240, 32, 8), "paper": Preset(640, 480, 100, 16)}


def synthesise(
    out: str | Path,
    scene: SceneFile | str | Path = "boulder",
    preset: Preset | str = "quick",
    seed: int = 0,
    mesh: str | Path | None = None,
    pose_noise: PoseNoise | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
    say: Callable[[str], None] = lambda message: None,
    mesh_up: str | None = None,
    test_views: int = 0,
    on_demand: bool = False,
) -> Dataset:
    """Render a scene as a dataset into the folder `out`; what it holds is listed in docs/data.md.

    scene: the name of a scene of mgs ("boulder"), the path of a TOML file, or a scene that was
    loaded. preset: "quick", "paper", or a `Preset` of your own. seed: root seed of the rock, the
    ground and the rendering. mesh: a file in place of the procedural rock; mesh_up: its up axis,
    "y" or "z", by default that of `mgs.synth.rock.up_axis`. With `pose_noise`, transforms.json
    holds noisy poses, and true_poses.json those of the cameras that took the images.
    test_views: number of views of `dome_cameras` that are rendered into the folder `test` of the
    dataset (`Dataset.test_views`); their poses are exact, and the orbit is the same with and
    without them. on_demand: render no frame of the orbit, only its survey (`Dataset.survey`) and
    the test views; `mgs.synth.capture` renders a frame when a run takes
    it. progress: called as progress(views done, all views); say: called with lines for the user.

    A folder that an interrupted run of the same settings left is completed, and ends with the same
    files as after one run. Raises InputError where the scene or the preset is unknown, where the
    output folder is not empty, cannot be written or is in use by another process, where the mesh is
    bad, or where the rock is not wholly in every view or cannot be seen.
    """
    runtime.start()
    started, out = time.perf_counter(), Path(out)
    settings = scene if isinstance(scene, SceneFile) else load_scene_file(scene)
    preset = row_named(PRESETS, preset, "preset") if isinstance(preset, str) else preset
    check_writable(out)
    if (out / "transforms.json").exists() or not (out / "config.json").exists():
        check_new_folder(out)  # before the rock is made, which takes seconds
    rock, scale = rock_of(settings, seed, mesh, mesh_up, say)
    cameras = rock_cameras(settings, preset, rock)
    frames = orbit_frames(out, cameras)
    tests = _frames(out / TEST_FOLDER, dome_cameras(settings, preset, rock, test_views), "tv")
    denoise = importlib.util.find_spec("pyoidn") is not None
    resolved = _resolved(
        settings, preset, seed, mesh, mesh_up, denoise, pose_noise, test_views, on_demand
    )
    goes_on = resumes(out, "config.json", resolved)
    glb = to_glb(rock)  # before the scene adds its attributes to the mesh
    world = Scene(settings, rock, cameras[0], seed)
    spp = preset.spp * (1 if denoise else NOISY_FACTOR)
    if not denoise:
        say(
            f"pyoidn is not installed: {spp} samples per pixel in place of denoising; `pip install pyoidn` is faster"
        )
    exposure = _meter(world, cameras, seed, spp, denoise, say)
    if not goes_on:
        new_folder(out)
        write_json(out / "config.json", resolved)
    with locked(out):
        with atomic_path(out / "rock.glb") as temporary:
            temporary.write_bytes(glb)

        prepared = time.perf_counter()
        orbit = [] if on_demand else frames
        seconds = _render_frames(
            Photographer(world, exposure, spp, seed, denoise), [*orbit, *tests], progress
        )
        if orbit or tests:
            write_contact_sheet(out / "contact_sheet.png", orbit or tests)
        record = {
            "mesh_scale": scale,
            "exposure": exposure,
            "samples_per_pixel": spp,
            "versions": versions(),
        }
        write_json(
            out / "config.json",
            resolved | record | {"timings": _timings(started, prepared, seconds)},
        )
        if tests:
            write_transforms(out / TEST_FOLDER, tests)
        told = frames if pose_noise is None else _told(out, frames, pose_noise, seed)
        if on_demand:
            told = [replace(frame, on_demand=True) for frame in told]
            copy_file(out / "rock.glb", out / SURVEY_FOLDER / "rock.glb")
            _write_survey(out / SURVEY_FOLDER, world, cameras, told)
        write_transforms(out, told)
        return load_dataset(out)


def rock_of(
    settings: SceneFile,
    seed: int,
    mesh: str | Path | None,
    mesh_up: str | None,
    say: Callable[[str], None],
) -> tuple[trimesh.Trimesh, float]:
    """The procedural rock, or that of the file `mesh`, standing in the ground, and the scale that
    was applied to it."""
    if mesh is None:
        return make_rock(settings.rock, generator(seed, "rock")), 1.0
    rock, scale = load_rock(mesh, settings.rock, mesh_up)
    extents = " x ".join(f"{x:.2f}" for x in rock.extents)
    say(
        f"{mesh}: {_said_up(mesh, mesh_up)}; scaled {scale:.4g} times to the scene's rock size, now {extents} m"
    )
    return rock, scale


def _said_up(mesh: str | Path, given: str | None) -> str:
    """A phrase that says which axis of a mesh file is taken as up, and why."""
    if given:
        return f"+{given.upper()} is up, as told"
    up = up_axis(mesh)
    suffix = Path(mesh).suffix.lower()
    if suffix in GLTF:
        return f"+{up.upper()} is up, as in all {suffix[1:].upper()} files"
    other = "y" if up == "z" else "z"
    return f"+{up.upper()} taken as up, its format has no rule (--mesh-up {other} turns it)"


def _resolved(
    settings: SceneFile,
    preset: Preset,
    seed: int,
    mesh: str | Path | None,
    mesh_up: str | None,
    denoise: bool,
    pose_noise: PoseNoise | None,
    test_views: int,
    on_demand: bool,
) -> dict[str, Any]:
    """All that decides what the dataset holds. An interrupted run is continued only where it is the
    same."""
    return {
        "scene": settings.model_dump(mode="json"),
        "preset": asdict(preset),
        "seed": seed,
        "mesh": None if mesh is None else fingerprint(mesh) | {"up": mesh_up or up_axis(mesh)},
        "denoise": denoise,
        "pose_noise": None if pose_noise is None else asdict(pose_noise),
        "test_views": test_views,
        "on_demand": {"mesh": mesh and str(Path(mesh).resolve())} if on_demand else None,
    }


def _timings(started: float, prepared: float, frames: list[float]) -> dict[str, float | None]:
    """Seconds until the first frame was begun, median of a frame, and seconds in all; for
    config.json."""
    return {
        "prepare_s": round(prepared - started, 2),
        "frame_s": round(float(np.median(frames)), 3) if frames else None,
        "total_s": round(time.perf_counter() - started, 2),
    }


def _told(out: Path, frames: list[Frame], pose_noise: PoseNoise, seed: int) -> list[Frame]:
    """The frames with noisy poses, as they are told to whoever reads the dataset; writes the true
    ones to true_poses.json."""
    cameras = [frame.camera for frame in frames]
    told = perturb(cameras, pose_noise.position, pose_noise.rotation, generator(seed, "pose noise"))
    truth = {
        frame.name: opengl_from_opencv(frame.camera.world_to_camera).tolist() for frame in frames
    }
    write_json(
        out / "true_poses.json",
        {"convention": "OpenGL camera-to-world, as transforms.json", "poses": truth},
    )
    return [replace(frame, camera=camera) for frame, camera in zip(frames, told, strict=True)]


@dataclass(frozen=True)
class Photographer:
    """Renders frames of one scene, all in the same way. exposure: factor on the radiance; spp:
    samples per pixel; seed: root seed of the rendering; denoise: as `Scene.render`."""

    scene: Scene
    exposure: float
    spp: int
    seed: int
    denoise: bool

    def take(self, frame: Frame) -> None:
        """Render a frame and write its files. They depend on its name and camera alone, not on what
        was rendered before."""
        rendered = self.scene.render(
            frame.camera, self.spp, derive_seed(self.seed, frame.name), self.denoise
        )
        assert frame.depth_path
        assert frame.mask_path
        assert frame.rock_path
        write_exr(frame.depth_path, {"Z": rendered.depth})
        write_png(frame.mask_path, rendered.mask)
        write_rock_image(
            frame.rock_path, rendered.rock * [self.exposure, self.exposure, self.exposure, 1]
        )
        write_png(frame.image_path, rendered.rgb * self.exposure)


def _write_survey(folder: Path, scene: Scene, cameras: list[Camera], told: list[Frame]) -> None:
    """Write the survey of an on-demand dataset: depth and mask, as their frames will have them, but
    no image.

    cameras: where the depth is measured; told: the frames with the poses that are told to whoever
    reads the dataset.
    """
    frames = [
        replace(frame, rock_path=None, on_demand=True) for frame in orbit_frames(folder, cameras)
    ]
    for frame in frames:
        assert frame.depth_path
        assert frame.mask_path
        depth, mask = scene.cast(frame.camera)
        write_exr(frame.depth_path, {"Z": depth})
        write_png(frame.mask_path, mask)
    write_transforms(
        folder,
        [replace(frame, camera=known.camera) for frame, known in zip(frames, told, strict=True)],
    )


def _render_frames(
    photographer: Photographer, frames: list[Frame], progress: Callable[[int, int], None]
) -> list[float]:
    """Render and write the frames whose files do not all exist yet; returns the seconds that each
    took."""
    seconds = []
    for index, frame in enumerate(frames):
        if not is_done(frame):
            begun = time.perf_counter()
            photographer.take(frame)
            seconds.append(time.perf_counter() - begun)
        progress(index + 1, len(frames))
    return seconds


def rock_cameras(settings: SceneFile, preset: Preset, rock: trimesh.Trimesh) -> list[Camera]:
    """The cameras of the scene's orbit, aimed at the middle of that part of the rock which is above
    the ground.

    Raises InputError where that part is not wholly inside a frame.
    """
    return _aimed(settings.orbit, settings, preset, preset.frames, rock, "frame")


def dome_cameras(
    settings: SceneFile, preset: Preset, rock: trimesh.Trimesh, count: int
) -> list[Camera]:
    """Cameras for test views: spread evenly over a dome around the rock, at the radius of the
    scene's orbit.

    The dome covers all azimuths and the elevations of DOME_ELEVATIONS. Raises InputError as
    `rock_cameras`.
    """
    dome = settings.orbit.model_copy(
        update={"kind": "hemisphere", "elevations": DOME_ELEVATIONS, "distances": (1,)}
    )
    return _aimed(dome, settings, preset, count, rock, "test view")


def _aimed(
    orbit: Orbit, settings: SceneFile, preset: Preset, count: int, rock: trimesh.Trimesh, what: str
) -> list[Camera]:
    """The cameras of an orbit, aimed and checked as `rock_cameras` says; what: the word for one of
    them in the error."""
    target = np.array([0, 0, rock.bounds[1, 2] / 2])
    cameras = orbit_cameras(orbit, count, target, settings.camera.fov, preset.width, preset.height)
    for index, camera in enumerate(cameras):
        pixels, z = camera.project(rock.vertices[rock.vertices[:, 2] > 0])
        if (
            (z <= 0).any()
            or (pixels < 1).any()
            or (pixels > np.array([preset.width, preset.height]) - 1).any()
        ):
            raise InputError(
                f"scene: the rock is not wholly in {what} {index}; raise orbit.radius or camera.fov"
            )
    return cameras


def write_contact_sheet(path: str | Path, frames: list[Frame]) -> None:
    """Write up to 32 of the frames, evenly chosen, as small pictures in one PNG, eight in a row."""
    columns, width = 8, 160
    chosen = [
        frames[i]
        for i in np.unique(np.linspace(0, len(frames) - 1, min(32, len(frames))).astype(int))
    ]
    height = round(width * frames[0].camera.height / frames[0].camera.width)
    sheet = Image.new("RGB", (columns * width, -(-len(chosen) // columns) * height))
    for i, frame in enumerate(chosen):
        with Image.open(frame.image_path) as image:
            small = image.convert("RGB").resize((width, height), Image.Resampling.LANCZOS)
        sheet.paste(small, (i % columns * width, i // columns * height))
    with atomic_path(path) as temporary:
        sheet.save(temporary)


def orbit_frames(out: Path, cameras: list[Camera]) -> list[Frame]:
    """The frames of an orbit, whose files lie in the folder `out`, in the order of its cameras."""
    return _frames(out, cameras, "kf")


def _frames(out: Path, cameras: list[Camera], prefix: str) -> list[Frame]:
    """Frames named prefix_0000, prefix_0001 and so on, with the files that will hold them in the
    folder `out`."""
    return [
        Frame(
            name := f"{prefix}_{i:04d}", camera, FRAME_INTERVAL * i,
            out / f"images/{name}.png", out / f"depth/{name}.exr", out / f"masks/{name}.png", out / f"rock/{name}.png",
        )
        for i, camera in enumerate(cameras)
    ]  # fmt: skip


def is_done(frame: Frame) -> bool:
    """Whether all files of a frame exist; none exists in part (`mgs.files.atomic_path`)."""
    paths = frame.image_path, frame.depth_path, frame.mask_path, frame.rock_path
    return all(path is not None and path.is_file() for path in paths)


def _meter(
    scene: Scene,
    cameras: list[Camera],
    seed: int,
    spp: int,
    denoise: bool,
    say: Callable[[str], None],
) -> float:
    """One exposure for the whole orbit, from four evenly spaced cameras: that of the rock, or less,
    and said, where that would
    clip more than MAX_CLIPPED. How much less is seen in the four rendered as the frames will be:
    the noise of few samples makes too many pixels bright. Raises InputError where a camera does not
    see the rock, or the rock's brightness is not finite.
    """
    chosen = np.unique(np.linspace(0, len(cameras), 4, endpoint=False).astype(int))
    means, values = [], []
    for index in chosen:
        rendered = scene.render(
            cameras[index], 2, derive_seed(seed, f"meter {index}"), denoise=False
        )
        if not rendered.mask.any():
            raise InputError(
                f"scene: the rock is hidden in frame {index}; raise orbit.altitude, or lower rock.buried"
            )
        means.append(float(rendered.rgb[rendered.mask].mean()))
        if not np.isfinite(means[-1]):
            raise InputError(
                f"scene: the rock has pixels that are NaN or infinite in frame {index}; repair its mesh"
            )
        values.append(rendered.rgb.max(-1)[rendered.depth > 0])
    wanted = ROCK_EXPOSURE / float(np.mean(means))
    if np.quantile(np.concatenate(values), 1 - MAX_CLIPPED) * wanted <= 1:
        return wanted
    again = [
        scene.render(cameras[index], spp, derive_seed(seed, f"meter {index}"), denoise)
        for index in chosen
    ]
    values = [rendered.rgb.max(-1)[rendered.depth > 0] for rendered in again]
    exposure = 1 / float(np.quantile(np.concatenate(values), 1 - MAX_CLIPPED))
    if exposure >= wanted:
        return wanted
    ratio, share = f"{wanted / exposure:.3g}", f"{MAX_CLIPPED:.0%}"
    say(
        f"exposure: {ratio} times lower than a rock so dark asks for: about {share} of rock and ground clips"
    )
    return exposure
