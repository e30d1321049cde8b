"""Images of an on-demand dataset, rendered when a run takes them. The variant must be set before
this module is imported (`mgs.runtime.start`)."""

import importlib.util
from collections.abc import Callable
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from mgs.data.dataset import Dataset
from mgs.data.frames import Frame
from mgs.errors import InputError
from mgs.files import fingerprint, read_json, reading
from mgs.synth.orbit import rock_cameras
from mgs.synth.rendering import (
    Photographer,
    RenderPreset,
    check_cost,
    is_done,
    orbit_frames,
    rock_of,
)
from mgs.synth.scene import MitsubaScene
from mgs.synth.scene_file import SceneFile

POSE_TOLERANCE = 1e-9  # largest change of a pose entry (metres, cosines) by writing and reading it


def capture_of(dataset: Dataset) -> Callable[[Frame], Frame]:
    """Return capture(frame) -> frame, which renders a frame of an on-demand dataset unless done.

    The files are bit for bit those of `synth_orbit` without `on_demand`. The scene is built at the
    first call, in seconds. capture raises InputError if the dataset has no config.json of `mgs
    synth-orbit --on-demand`, its mesh has changed or is gone, its denoiser is not installed, or the
    frame is not one of the scene's orbit."""
    prepared = cache(lambda: photographer_of(dataset.root))

    def capture(frame: Frame) -> Frame:
        if is_done(frame):
            return frame
        photographer, orbit, exact = prepared()
        own = orbit.get(frame.name)
        if own is not None:
            change = np.abs(own.camera.world_to_camera - frame.camera.world_to_camera).max()
        if own is None or (exact and change >= POSE_TOLERANCE):
            where = f"{dataset.root / 'transforms.json'}: frame {frame.name}"
            what = f"{where} is not one of the scene's orbit, so it cannot be rendered"
            raise InputError(f"{what}; restore or remove it")
        photographer.take(own)
        return frame

    return capture


def photographer_of(root: Path) -> tuple[Photographer, dict[str, Frame], bool]:
    """Photographer of an on-demand dataset, its frames by name, and whether its poses are exact.
    Raises InputError as `capture_of`."""
    path = root / "config.json"
    config: Any = read_json(path)
    try:
        settings = SceneFile.model_validate(config["scene"])
        preset = RenderPreset(**{key: int(n) for key, n in config["preset"].items()})
        seed, mesh = int(config["seed"]), config["on_demand"]["mesh"]
        denoise = bool(config["denoise"])
        exposure, spp = float(config["exposure"]), int(config["samples_per_pixel"])
        exact, made_of = config["pose_noise"] is None, config["mesh"]
        mesh, up = (None, None) if mesh is None else (Path(mesh), str(made_of["up"]))
        if min(*asdict(preset).values(), spp) < 1 or seed < 0 or not 0 < exposure < np.inf:
            raise ValueError
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError):
        why = "is not of `mgs synth-orbit --on-demand`, or damaged"
        raise InputError(f"{path}: {why}; make the dataset again") from None
    if denoise and importlib.util.find_spec("pyoidn") is None:
        why = "its images are denoised by pyoidn, which is not installed"
        raise InputError(f'{path}: {why}; `pip install "mgs[denoise]"`')
    check_cost(root, preset, 1, spp)
    if mesh is not None:
        with reading(mesh, f"mesh, of which {root} is made"):
            if made_of != fingerprint(mesh) | {"up": up}:
                cure = "restore it, or make the dataset again"
                raise InputError(f"{mesh}: has changed since {root} was made of it; {cure}")
    rock, _ = rock_of(settings, seed, mesh, up)
    cameras = rock_cameras(settings, (preset.width, preset.height), preset.frames, rock)
    scene = MitsubaScene(settings, rock, cameras[0], seed)
    frames = {frame.name: frame for frame in orbit_frames(root, cameras)}
    return Photographer(scene, exposure, spp, seed, denoise), frames, exact
