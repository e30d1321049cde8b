"""Images of an on-demand dataset (`mgs synth-orbit --on-demand`), each rendered when a run takes
it.

The variant must be set before this module is imported (`mgs.runtime.start`).
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from mgs.camera import Camera
from mgs.data.dataset import Dataset, Frame
from mgs.errors import InputError
from mgs.files import fingerprint, read_json, reading
from mgs.synth.rendering import Photographer, Preset, is_done, orbit_frames, rock_cameras, rock_of
from mgs.synth.scene import Scene
from mgs.synth.scene_file import SceneFile

POSE_TOLERANCE = 1e-9
"""By how much an entry of a pose (metres, cosines) may change when it is written as text and
read."""


def capture_of(dataset: Dataset) -> Callable[[Frame], None]:
    """capture(frame): render a frame of an on-demand dataset, unless all its files exist.

    What is written is bit for bit what `mgs.synth.rendering.synthesise` writes without `on_demand`.
    The scene is built when the first image is asked for, in seconds. capture raises InputError
    where the dataset has no config.json of `mgs synth-orbit
    --on-demand`, the mesh that it was made of has changed or is gone, the denoiser that it was made
    with is not installed, or a frame is not one of the scene's orbit.
    """
    prepared = cache(lambda: _prepared(dataset.root))

    def capture(frame: Frame) -> None:
        if is_done(frame):
            return
        photographer, orbit, exact = prepared()
        known = orbit.get(frame.name)
        if known is None or (exact and not _same_pose(known.camera, frame.camera)):
            where = f"{dataset.root / 'transforms.json'}: frame {frame.name}"
            raise InputError(
                f"{where} is not one of the scene's orbit, so it cannot be rendered; restore or remove it"
            )
        photographer.take(known)

    return capture


def _same_pose(a: Camera, b: Camera) -> bool:
    return bool(np.abs(a.world_to_camera - b.world_to_camera).max() < POSE_TOLERANCE)


def _prepared(root: Path) -> tuple[Photographer, dict[str, Frame], bool]:
    """The photographer of an on-demand dataset, its frames as they are rendered, by name, and
    whether their poses are told without noise."""
    path = root / "config.json"
    config: Any = read_json(path)
    try:
        settings, preset = SceneFile.model_validate(config["scene"]), Preset(**config["preset"])
        seed, mesh, denoise = (
            int(config["seed"]),
            config["on_demand"]["mesh"],
            bool(config["denoise"]),
        )
        exposure, spp = float(config["exposure"]), int(config["samples_per_pixel"])
        exact, made_of = config["pose_noise"] is None, config["mesh"]
    except (KeyError, TypeError, ValueError, ValidationError):
        raise InputError(
            f"{path}: is not of `mgs synth-orbit --on-demand`, or damaged; make the dataset again"
        ) from None
    if denoise and importlib.util.find_spec("pyoidn") is None:
        raise InputError(
            f"{path}: its images are denoised by pyoidn, which is not installed; `pip install pyoidn`"
        )
    if mesh is not None:
        with reading(Path(mesh), f"mesh, of which {root} is made"):
            if made_of != fingerprint(mesh) | {"up": made_of["up"]}:
                raise InputError(
                    f"{mesh}: has changed since {root} was made of it; restore it, or make the dataset again"
                )
    rock, _ = rock_of(settings, seed, mesh, made_of and made_of["up"], lambda line: None)
    cameras = rock_cameras(settings, preset, rock)
    scene = Scene(settings, rock, cameras[0], seed)
    frames = {frame.name: frame for frame in orbit_frames(root, cameras)}
    return Photographer(scene, exposure, spp, seed, denoise), frames, exact
