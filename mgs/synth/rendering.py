"""Render an orbit around a rock into a dataset folder."""

import importlib.util
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
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
    load_dataset,
    resumes,
    write_transforms,
)
from mgs.data.frames import Frame, write_rock_image
from mgs.data.meshes import to_glb
from mgs.errors import InputError, row_named
from mgs.files import atomic_path, copy_file, fingerprint, folder_locked, reading, write_json
from mgs.images import write_exr, write_png, write_sheet
from mgs.memory import check_room
from mgs.progress import report
from mgs.provenance import versions
from mgs.seeds import derive_seed, generator
from mgs.synth.orbit import PoseNoise, evaluation_cameras, perturb, rock_cameras
from mgs.synth.rock import load_rock, make_rock, up_axis
from mgs.synth.scene import GUIDES_PER_SAMPLE, MitsubaScene, Traced, whole_grid
from mgs.synth.scene_file import SceneFile, load_scene_file

NOISY_FACTOR = 8  # factor on the samples per pixel if pyoidn, the denoiser, is not installed
ROCK_EXPOSURE = 0.2  # mean linear value of the rock over the orbit, which is metered once
# A dark rock must not blow out bright ground; the scenes of mgs clip at most 0.04.
MAX_CLIPPED = 0.2  # largest share of rock and ground pixels that the exposure may clip
MOST_SAMPLES = 2**32  # in a view; a slip, which would take hours
PIXEL_BYTES, VIEW_BYTES, IMAGE_BYTES = 4, 2_000, 200  # on disk; in memory
SHEET_COLUMNS, SHEET_WIDTH, SHEET_FRAMES = 8, 160, 32  # pictures in a row, pixels, most pictures


@dataclass(frozen=True)
class RenderPreset:
    """Size of a rendered dataset: image size in pixels, number of frames, and samples per
    pixel, rounded up by `whole_grid`."""

    width: int
    height: int
    frames: int
    spp: int


PRESETS = {"quick": RenderPreset(320, 240, 32, 8), "paper": RenderPreset(640, 480, 100, 9)}


def synth_orbit(
    out: str | Path,
    scene: SceneFile | str | Path = "boulder",
    preset: RenderPreset | str = "quick",
    seed: int = 0,
    mesh: str | Path | None = None,
    pose_noise: PoseNoise | None = None,
    say: Callable[[str], None] = lambda message: None,
    mesh_up: str | None = None,
    test_views: int = 0,
    on_demand: bool = False,
    *,
    frames: int | None = None,
    size: tuple[int, int] | None = None,
    spp: int | None = None,
) -> Dataset:
    """Render a scene as a dataset into the folder `out` (files: docs/data.md); return the dataset.

    - scene: name of a scene of mgs, path of a TOML file, or a loaded scene.
    - preset: a name of PRESETS, or a `RenderPreset`. frames, size (width, height) and spp replace
      its numbers.
    - seed: of all random draws in rock, ground and rendering.
    - mesh: file of a rock in place of the procedural one. mesh_up: its up axis, "y" or "z"; by
      default `up_axis`.
    - pose_noise: error of the poses in transforms.json; true_poses.json then holds the exact ones.
    - test_views: number of views on a dome to render into `out`/test, with exact poses.
    - on_demand: render only the survey and the test views; a run renders the frames it takes.
    - say: called with lines for the user.

    An interrupted call is completed by a second one, with the same files as after one call. A
    finished dataset is loaded as it is. Raises InputError if the scene or preset is unknown, `out`
    is not empty, not writable or locked by another process, the mesh is bad, or the rock is not
    wholly in every view or is hidden."""
    runtime.start()
    out = Path(out)
    settings = scene if isinstance(scene, SceneFile) else load_scene_file(scene)
    preset = row_named(PRESETS, preset, "preset") if isinstance(preset, str) else preset
    width, height = size or (None, None)
    numbers = {"width": width, "height": height, "frames": frames, "spp": spp}
    preset = replace(preset, **{key: n for key, n in numbers.items() if n is not None})
    denoise = importlib.util.find_spec("pyoidn") is not None
    spp = whole_grid(preset.spp * (1 if denoise else NOISY_FACTOR))
    made_of = None
    if mesh is not None:
        with reading(Path(mesh), "mesh; give a GLB, OBJ or PLY file"):
            made_of = fingerprint(mesh) | {"up": mesh_up or up_axis(mesh)}
    # All that decides what the dataset holds; an interrupted run continues only if it is the same.
    resolved: dict[str, Any] = {
        "scene": settings.model_dump(mode="json"),
        "preset": asdict(preset),
        "seed": seed,
        "mesh": made_of,
        "denoise": denoise,
        "pose_noise": None if pose_noise is None else asdict(pose_noise),
        "test_views": test_views,
        "on_demand": {"mesh": mesh and str(Path(mesh).resolve())} if on_demand else None,
    }
    with folder_locked(out):
        if resumes(out, "config.json", resolved) and (out / "transforms.json").is_file():
            say(f"{out}: is finished already; nothing is rendered")
            return load_dataset(out)
        check_cost(out, preset, preset.frames + test_views, spp)
        rock, scale = rock_of(settings, seed, mesh, mesh_up, say)
        size = preset.width, preset.height
        cameras = rock_cameras(settings, size, preset.frames, rock)
        orbit = orbit_frames(out, cameras)
        dome = evaluation_cameras(settings, size, test_views, rock)
        tests = orbit_frames(out / TEST_FOLDER, dome, "tv")
        own = rock.copy(include_cache=True)  # the scene adds its attributes to the mesh
        with ThreadPoolExecutor(1) as pool:
            glb = pool.submit(to_glb, own)
            world = MitsubaScene(settings, rock, cameras[0], seed)
        if not denoise:
            say(
                f"pyoidn is not installed: {spp} samples per pixel in place of denoising; "
                '`pip install "mgs[denoise]"` makes it faster'
            )
        exposure = _meter(world, cameras, seed, spp, denoise, say)
        if not (out / "config.json").is_file():
            write_json(out / "config.json", resolved)
        with atomic_path(out / "rock.glb") as temporary:
            temporary.write_bytes(glb.result())
        photographer = Photographer(world, exposure, spp, seed, denoise)
        views = tests if on_demand else [*orbit, *tests]
        _render_frames(photographer, views)
        if views:
            write_contact_sheet(out / "contact_sheet.png", tests if on_demand else orbit)
        resolved |= {"mesh_scale": scale, "exposure": exposure, "samples_per_pixel": spp}
        write_json(out / "config.json", resolved | {"versions": versions()})
        if tests:
            write_transforms(out / TEST_FOLDER, tests)
        published = orbit if pose_noise is None else _with_noise(out, orbit, pose_noise, seed)
        if on_demand:
            published = [replace(frame, on_demand=True) for frame in published]
            copy_file(out / "rock.glb", out / SURVEY_FOLDER / "rock.glb")
            _write_survey(out / SURVEY_FOLDER, world, cameras, published)
        write_transforms(out, published)
        return load_dataset(out)


def check_cost(out: Path, preset: RenderPreset, views: int, spp: int) -> None:
    """Raise InputError if a frame has more samples than Mitsuba renders at once, or if memory or
    disk do not suffice."""
    pixels = preset.width * preset.height
    what = f"{views:,} views of {preset.width}x{preset.height} with {spp:,} samples per pixel"
    instead = "lower `frames`, `test_views`, `size` or `spp`"
    disk = views * pixels * PIXEL_BYTES
    free = shutil.disk_usage(next(p for p in out.resolve().parents if p.exists())).free
    if pixels * whole_grid(GUIDES_PER_SAMPLE * spp) >= MOST_SAMPLES or disk > free:
        raise InputError(
            f"synth-orbit: {what} take {disk / 2**30:,.1f} GiB on disk; {free / 2**30:,.1f} GiB "
            f"and {MOST_SAMPLES // GUIDES_PER_SAMPLE:,} samples per view are possible; {instead}"
        )
    memory = views * VIEW_BYTES + pixels * IMAGE_BYTES
    check_room(memory, f"synth-orbit: {what}", instead)


def rock_of(
    settings: SceneFile,
    seed: int,
    mesh: str | Path | None,
    mesh_up: str | None,
    say: Callable[[str], None] = lambda message: None,
) -> tuple[trimesh.Trimesh, float]:
    """The rock, standing in the ground, and its scale: procedural, or from the file `mesh`."""
    if mesh is None:
        return make_rock(settings.rock, generator(seed, "rock")), 1.0
    rock, scale = load_rock(mesh, settings.rock, mesh_up)
    extents = " x ".join(f"{x:.2f}" for x in rock.extents)
    up = (mesh_up or up_axis(mesh)).upper()
    say(
        f"{mesh}: +{up} is up (`mesh_up` tells); scaled {scale:.4g} times to the scene's rock "
        f"size, now {extents} m"
    )
    return rock, scale


def _with_noise(out: Path, frames: list[Frame], noise: PoseNoise, seed: int) -> list[Frame]:
    """Frames with noisy poses; writes the exact ones to true_poses.json."""
    cameras = [frame.camera for frame in frames]
    noisy = perturb(cameras, noise.position, noise.rotation, generator(seed, "pose noise"))
    poses = {
        frame.name: opengl_from_opencv(frame.camera.world_to_camera).tolist() for frame in frames
    }
    convention = "OpenGL camera-to-world, as transforms.json"
    write_json(out / "true_poses.json", {"convention": convention, "poses": poses})
    return [replace(frame, camera=camera) for frame, camera in zip(frames, noisy, strict=True)]


@dataclass(frozen=True)
class Photographer:
    """Renders frames of one scene."""

    scene: MitsubaScene
    exposure: float  # factor on radiance
    spp: int  # samples per pixel
    seed: int  # root seed of the rendering
    denoise: bool  # as `MitsubaScene.render`

    def take(self, frame: Frame) -> None:
        """Render a frame and write its files, which depend on its name and camera alone."""
        self.develop(frame, self.expose(frame))

    def expose(self, frame: Frame) -> Traced:
        """Trace a frame."""
        seed = derive_seed(self.seed, frame.name)
        return self.scene.trace(frame.camera, self.spp, seed, self.denoise)

    def develop(self, frame: Frame, traced: Traced) -> None:
        """Denoise a traced frame and write its files."""
        image = traced.developed()
        assert frame.depth_path
        assert frame.mask_path
        assert frame.rock_path
        write_exr(frame.depth_path, {"Z": image.depth})
        write_png(frame.mask_path, image.mask)
        gain = [self.exposure, self.exposure, self.exposure, 1]
        write_rock_image(frame.rock_path, image.rock * gain)
        write_png(frame.image_path, image.rgb * self.exposure)


def _write_survey(
    folder: Path, scene: MitsubaScene, cameras: list[Camera], published: list[Frame]
) -> None:
    """Write the survey of an on-demand dataset: depth and masks seen by `cameras`, with the poses
    of the frames `published`."""
    frames = []
    for frame, other in zip(orbit_frames(folder, cameras), published, strict=True):
        assert frame.depth_path
        assert frame.mask_path
        depth, mask = scene.cast(frame.camera)
        write_exr(frame.depth_path, {"Z": depth})
        write_png(frame.mask_path, mask)
        frames.append(replace(frame, rock_path=None, on_demand=True, camera=other.camera))
    write_transforms(folder, frames)


def _render_frames(photographer: Photographer, frames: list[Frame]) -> None:
    """Render the frames that are not done, each while the one before is denoised and written."""
    with ThreadPoolExecutor(1) as developer:
        last = developer.submit(lambda: None)
        for index, frame in enumerate(frames):
            traced = None if is_done(frame) else photographer.expose(frame)
            last.result()
            report("rendering", index, len(frames))
            if traced:
                last = developer.submit(photographer.develop, frame, traced)
        last.result()
    report("rendering", len(frames), len(frames))


def write_contact_sheet(path: str | Path, frames: list[Frame]) -> None:
    """Write up to SHEET_FRAMES of the frames, evenly chosen, as small pictures in one PNG."""
    count = min(SHEET_FRAMES, len(frames))
    height = round(SHEET_WIDTH * frames[0].camera.height / frames[0].camera.width)
    pictures = []
    for i in np.unique(np.linspace(0, len(frames) - 1, count).astype(int)):
        with Image.open(frames[i].image_path, formats=["PNG"]) as image:
            small = image.convert("RGB").resize((SHEET_WIDTH, height), Image.Resampling.LANCZOS)
        pictures.append(np.asarray(small))
    write_sheet(Path(path), pictures, SHEET_COLUMNS)


def orbit_frames(out: Path, cameras: list[Camera], prefix: str = "kf") -> list[Frame]:
    """Frames of an orbit, kf_0000 and so on, with their files in the folder `out`."""
    frames = []
    for i, camera in enumerate(cameras):
        name = f"{prefix}_{i:04d}"
        image, mask, rock = (out / f"{kind}/{name}.png" for kind in ("images", "masks", "rock"))
        depth = out / f"depth/{name}.exr"
        frames.append(Frame(name, camera, FRAME_INTERVAL * i, image, depth, mask, rock))
    return frames


def is_done(frame: Frame) -> bool:
    """Whether all files of a frame exist; files appear complete."""
    paths = frame.image_path, frame.depth_path, frame.mask_path, frame.rock_path
    return all(path is not None and path.is_file() for path in paths)


def _meter(
    scene: MitsubaScene,
    cameras: list[Camera],
    seed: int,
    spp: int,
    denoise: bool,
    say: Callable[[str], None],
) -> float:
    """Exposure for the whole orbit, metered on the rock in four evenly spaced cameras. Where that
    would clip more than MAX_CLIPPED of rock and ground, it is lowered, which `say` reports; that is
    judged in final quality, since the noise of few samples makes too many pixels bright."""
    indices = np.unique(np.linspace(0, len(cameras), 4, endpoint=False).astype(int))
    means, values = [], []
    for index in indices:
        meter_seed = derive_seed(seed, f"meter {index}")
        rgb, _, _ = scene.light(cameras[index], 2, meter_seed)
        depth, mask = scene.cast(cameras[index])
        if not mask.any():
            cure = "raise orbit.altitude, or lower rock.buried"
            raise InputError(f"scene: frame {index} shows no rock; {cure}")
        means.append(float(rgb[mask].mean()))
        if not np.isfinite(means[-1]):
            bad = f"the rock has pixels that are NaN or infinite in frame {index}"
            raise InputError(f"scene: {bad}; repair its mesh")
        values.append(rgb.max(-1)[depth > 0])
    target = ROCK_EXPOSURE / float(np.mean(means))
    if np.quantile(np.concatenate(values), 1 - MAX_CLIPPED) * target <= 1:
        return target
    values = []
    for index in indices:
        image = scene.render(cameras[index], spp, derive_seed(seed, f"meter {index}"), denoise)
        values.append(image.rgb.max(-1)[image.depth > 0])
    exposure = 1 / float(np.quantile(np.concatenate(values), 1 - MAX_CLIPPED))
    if exposure >= target:
        return target
    say(
        f"exposure: {target / exposure:.3g} times lower than so dark a rock needs, so that about "
        f"{MAX_CLIPPED:.0%} of rock and ground clips, not more"
    )
    return exposure
