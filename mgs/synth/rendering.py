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
from mgs.data.dataset import FRAME_INTERVAL, Dataset, Frame, load_dataset, resumes, write_transforms
from mgs.data.meshes import GLTF, to_glb
from mgs.errors import InputError
from mgs.files import atomic_path, check_new_folder, check_writable, fingerprint, locked, new_folder, write_json
from mgs.images import write_exr, write_png
from mgs.provenance import versions
from mgs.seeds import derive_seed, generator
from mgs.synth.orbit import orbit_cameras, perturb
from mgs.synth.rock import load_rock, make_rock, up_axis
from mgs.synth.scene import Scene
from mgs.synth.scene_file import SceneFile, load_scene_file

NOISY_FACTOR = 8
"""Samples are multiplied by this where pyoidn is not installed."""

ROCK_EXPOSURE = 0.2
"""Mean linear value of the rock's pixels over the orbit: the exposure is metered once on the rock, as a photographer does."""
MAX_CLIPPED = 0.2
"""Largest share of the pixels of rock and ground (the sky may clip) that the exposure may clip: a dark rock would blow bright
ground out. The scenes of mgs clip at most 0.04 of them, on every kind of orbit: there the rock alone decides."""


@dataclass(frozen=True)
class Preset:
    """Image size in pixels, number of frames, samples per pixel."""

    width: int
    height: int
    frames: int
    spp: int


@dataclass(frozen=True)
class PoseNoise:
    """Standard deviations of the poses that the reconstruction is told: metres and degrees, per axis."""

    position: float = 0.0
    rotation: float = 0.0


PRESETS = {"quick": Preset(320, 240, 32, 8), "paper": Preset(640, 480, 100, 16)}


def preset_named(name: str) -> Preset:
    """A row of PRESETS. Raises InputError where there is none of this name."""
    if name not in PRESETS:
        raise InputError(f"preset {name!r}: unknown; choose one of {', '.join(PRESETS)}")
    return PRESETS[name]


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
) -> Dataset:
    """Render the dataset `out`: images, depth, masks, rock.glb, config.json, contact_sheet.png, transforms.json (last).

    scene: the name of a scene of mgs ("boulder"), the path of a TOML file, or a scene that was loaded. preset: "quick",
    "paper", or a `Preset` of your own. mesh: a file in place of the procedural rock; mesh_up: its up axis, "y" or "z", by
    default as `mgs.synth.rock.up_axis`. pose_noise: with it transforms.json holds noisy poses, and true_poses.json the cameras
    that took the images.
    A folder that an interrupted run of the same settings left is completed; the result is the same as in one run.
    Raises InputError: unknown scene or preset, output folder not empty, not writable or worked on by another process, bad mesh,
    rock not wholly in every frame, or nowhere in sight.
    """
    runtime.start()
    started, out = time.perf_counter(), Path(out)
    settings = scene if isinstance(scene, SceneFile) else load_scene_file(scene)
    preset = preset_named(preset) if isinstance(preset, str) else preset
    check_writable(out)
    if (out / "transforms.json").exists() or not (out / "config.json").exists():
        check_new_folder(out)  # before the rock is made, which takes seconds
    if mesh is None:
        rock, scale = make_rock(settings.rock, generator(seed, "rock")), 1.0
    else:
        rock, scale = load_rock(mesh, settings.rock, mesh_up)
        extents = " x ".join(f"{x:.2f}" for x in rock.extents)
        say(f"{mesh}: {_said_up(mesh, mesh_up)}; scaled {scale:.4g} times to the scene's rock size, now {extents} m")
    cameras = rock_cameras(settings, preset, rock)
    frames = _frames(out, cameras)
    denoise = importlib.util.find_spec("pyoidn") is not None
    resolved = _resolved(settings, preset, seed, mesh, mesh_up, denoise, pose_noise)
    goes_on = resumes(out, "config.json", resolved)
    glb = to_glb(rock)  # before the scene adds its attributes to the mesh
    world = Scene(settings, rock, cameras[0], seed)
    spp = preset.spp * (1 if denoise else NOISY_FACTOR)
    if not denoise:
        say(f"pyoidn is not installed: {spp} samples per pixel in place of denoising; `pip install pyoidn` is faster")
    exposure = _meter(world, cameras, seed, spp, denoise, say)
    if not goes_on:
        new_folder(out)
        write_json(out / "config.json", resolved)
    with locked(out):
        with atomic_path(out / "rock.glb") as temporary:
            temporary.write_bytes(glb)

        prepared = time.perf_counter()
        seconds = _render_frames(world, frames, exposure, spp, seed, denoise, progress)
        write_contact_sheet(out / "contact_sheet.png", frames)
        timings = {
            "prepare_s": round(prepared - started, 2),
            "frame_s": round(float(np.median(seconds)), 3) if seconds else None,
            "total_s": round(time.perf_counter() - started, 2),
        }
        record = {"mesh_scale": scale, "exposure": exposure, "samples_per_pixel": spp, "versions": versions()}
        write_json(out / "config.json", resolved | record | {"timings": timings})
        write_transforms(out, frames if pose_noise is None else _told(out, frames, pose_noise, seed))
        return load_dataset(out)


def _said_up(mesh: str | Path, given: str | None) -> str:
    """In words: which axis of a mesh file is taken as up, and why."""
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
) -> dict[str, Any]:
    """All that decides the dataset: what a run that goes on must agree with."""
    return {
        "scene": settings.model_dump(mode="json"),
        "preset": asdict(preset),
        "seed": seed,
        "mesh": None if mesh is None else fingerprint(mesh) | {"up": mesh_up or up_axis(mesh)},
        "denoise": denoise,
        "pose_noise": None if pose_noise is None else asdict(pose_noise),
    }


def _told(out: Path, frames: list[Frame], pose_noise: PoseNoise, seed: int) -> list[Frame]:
    """The frames with noisy poses; writes true_poses.json."""
    cameras = [frame.camera for frame in frames]
    told = perturb(cameras, pose_noise.position, pose_noise.rotation, generator(seed, "pose noise"))
    truth = {frame.name: opengl_from_opencv(frame.camera.world_to_camera).tolist() for frame in frames}
    write_json(out / "true_poses.json", {"convention": "OpenGL camera-to-world, as transforms.json", "poses": truth})
    return [replace(frame, camera=camera) for frame, camera in zip(frames, told, strict=True)]


def _render_frames(
    scene: Scene,
    frames: list[Frame],
    exposure: float,
    spp: int,
    seed: int,
    denoise: bool,
    progress: Callable[[int, int], None],
) -> list[float]:
    """Render and write the frames that are not on disk yet; returns the seconds that each took."""
    seconds = []
    for index, frame in enumerate(frames):
        if not _is_done(frame):
            begun = time.perf_counter()
            rendered = scene.render(frame.camera, spp, derive_seed(seed, frame.name), denoise)
            assert frame.depth_path
            assert frame.mask_path
            write_exr(frame.depth_path, {"Z": rendered.depth})
            write_png(frame.mask_path, rendered.mask)
            write_png(frame.image_path, rendered.rgb * exposure)
            seconds.append(time.perf_counter() - begun)
        progress(index + 1, len(frames))
    return seconds


def rock_cameras(settings: SceneFile, preset: Preset, rock: trimesh.Trimesh) -> list[Camera]:
    """The orbit's cameras, aimed at the middle of the rock above the ground.

    Raises InputError where the rock is not wholly inside a frame.
    """
    target = np.array([0, 0, rock.bounds[1, 2] / 2])
    cameras = orbit_cameras(settings.orbit, preset.frames, target, settings.camera.fov, preset.width, preset.height)
    for index, camera in enumerate(cameras):
        pixels, z = camera.project(rock.vertices[rock.vertices[:, 2] > 0])
        if (z <= 0).any() or (pixels < 1).any() or (pixels > np.array([preset.width, preset.height]) - 1).any():
            raise InputError(f"scene: the rock is not wholly in frame {index}; raise orbit.radius or camera.fov")
    return cameras


def write_contact_sheet(path: str | Path, frames: list[Frame]) -> None:
    """Up to 32 evenly chosen frames, eight side by side, as PNG."""
    columns, width = 8, 160
    chosen = [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, min(32, len(frames))).astype(int))]
    height = round(width * frames[0].camera.height / frames[0].camera.width)
    sheet = Image.new("RGB", (columns * width, -(-len(chosen) // columns) * height))
    for i, frame in enumerate(chosen):
        with Image.open(frame.image_path) as image:
            small = image.convert("RGB").resize((width, height), Image.Resampling.LANCZOS)
        sheet.paste(small, (i % columns * width, i // columns * height))
    with atomic_path(path) as temporary:
        sheet.save(temporary)


def _frames(out: Path, cameras: list[Camera]) -> list[Frame]:
    return [
        Frame(
            name := f"kf_{i:04d}", camera, FRAME_INTERVAL * i,
            out / f"images/{name}.png", out / f"depth/{name}.exr", out / f"masks/{name}.png",
        )
        for i, camera in enumerate(cameras)
    ]  # fmt: skip


def _is_done(frame: Frame) -> bool:
    return all(path is not None and path.is_file() for path in (frame.image_path, frame.depth_path, frame.mask_path))


def _meter(scene: Scene, cameras: list[Camera], seed: int, spp: int, denoise: bool, say: Callable[[str], None]) -> float:
    """One exposure for the whole orbit, from four evenly spaced cameras: that of the rock, or less, and said, where that would
    clip more than MAX_CLIPPED. How much less is seen in the four rendered as the frames will be: the noise of few samples
    makes too many pixels bright. Raises InputError where a camera does not see the rock.
    """
    chosen = np.unique(np.linspace(0, len(cameras), 4, endpoint=False).astype(int))
    means, values = [], []
    for index in chosen:
        rendered = scene.render(cameras[index], 2, derive_seed(seed, f"meter {index}"), denoise=False)
        if not rendered.mask.any():
            raise InputError(f"scene: the rock is hidden in frame {index}; raise orbit.altitude, or lower rock.buried")
        means.append(float(rendered.rgb[rendered.mask].mean()))
        values.append(rendered.rgb.max(-1)[rendered.depth > 0])
    wanted = ROCK_EXPOSURE / float(np.mean(means))
    if np.quantile(np.concatenate(values), 1 - MAX_CLIPPED) * wanted <= 1:
        return wanted
    again = [scene.render(cameras[index], spp, derive_seed(seed, f"meter {index}"), denoise) for index in chosen]
    values = [rendered.rgb.max(-1)[rendered.depth > 0] for rendered in again]
    exposure = 1 / float(np.quantile(np.concatenate(values), 1 - MAX_CLIPPED))
    if exposure >= wanted:
        return wanted
    ratio, share = f"{wanted / exposure:.3g}", f"{MAX_CLIPPED:.0%}"
    say(f"exposure: {ratio} times lower than a rock so dark asks for: about {share} of rock and ground clips")
    return exposure
