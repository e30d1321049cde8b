"""A rock of a few pixels: a dataset on disk, and a scene that is fitted in NumPy.

`python tiny.py DATASET OUT MOMENT COUNT` starts a run and kills itself (SIGKILL) at the COUNT-th
MOMENT (`dying_parts`).
"""

import os
import signal
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
from synthetic import pinhole, sphere

from mgs import Camera, Checkpoint, Frame, Gaussians, Scene, sh_from_rgb
from mgs.data.dataset import Dataset, load_dataset, write_transforms
from mgs.data.meshes import Mesh
from mgs.files import write_json
from mgs.fit.stopping import StopReason
from mgs.images import write_exr, write_png
from mgs.memory import VIEW_BYTES
from mgs.prior.build import Prior, load_prior, save_prior
from mgs.progress import Stage, report
from mgs.rotation import quat_from_normals
from mgs.run import folder as run_folder
from mgs.run import recording
from mgs.run.settings import NbvSettings

FRAMES, POINTS, WIDTH, HEIGHT = 12, 40, 16, 12
GROUPS = {"colour": slice(0, 3), "scale": slice(3, 6), "rotation": slice(6, 10)}
GROUPS["opacity"] = slice(10, 11)


def orbit(frames: int = FRAMES) -> list[Camera]:
    """Cameras on a circle of 3 m at 1.5 m around a unit sphere at the origin."""
    angles = 2 * np.pi * np.arange(frames) / frames
    eyes = [(3 * np.cos(a), 3 * np.sin(a), 1.5) for a in angles]
    return [pinhole(16.0, WIDTH, HEIGHT, eye) for eye in eyes]


def write_dataset(root: Path, frames: int = FRAMES) -> Path:
    """A coloured unit sphere on black, with exact depth and masks."""
    records = []
    for i, camera in enumerate(orbit(frames)):
        directions = camera.unproject(np.ones((HEIGHT, WIDTH))) - camera.position
        a, b = (directions**2).sum(-1), directions @ camera.position
        root_term = b**2 - a * (camera.position @ camera.position - 1)
        mask = root_term > 0
        depth = np.where(mask, (-b - np.sqrt(np.maximum(root_term, 0))) / a, 0)
        points = camera.unproject(depth)
        colour = 0.4 + 0.3 * np.sin(5 * points + [0, 1, 2])
        rgb = np.where(mask[..., None], colour, 0).astype(np.float32)
        name = f"kf_{i:04d}"
        paths = root / f"images/{name}.png", root / f"depth/{name}.exr", root / f"masks/{name}.png"
        frame = Frame(name, camera, 0.5 * i, *paths)
        write_png(frame.image_path, rgb)
        write_exr(frame.depth_path, {"Z": depth.astype(np.float32)})
        write_png(frame.mask_path, mask)
        records.append(frame)
    write_transforms(root, records)
    return root


@dataclass
class Fit:
    gaussians: Gaussians
    loss: float
    iterations: int
    losses: tuple[float, ...] = ()
    stop_reason: StopReason = StopReason.SETTLED


def initial(seed_frames: list[Frame]) -> Gaussians:
    """Grey discs on the sphere."""
    n = sphere(POINTS)
    means, quats = n.astype(np.float32), quat_from_normals(n).astype(np.float32)
    scales, opacities = np.full((POINTS, 3), -1.5, np.float32), np.zeros(POINTS, np.float32)
    return Gaussians(means, scales, quats, opacities, sh_from_rgb(np.full((POINTS, 3), 0.5)))


def _facing(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """Cosine between normal and camera, less 0.2; 0 where a point of the sphere is turned away."""
    to_camera = camera.position - gaussians.means
    cosine = (gaussians.means * to_camera).sum(1) / np.linalg.norm(to_camera, axis=1)
    return np.maximum(cosine - 0.2, 0)


def fisher(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """Information [POINTS,11] of a view: larger for bright points, so it depends on the model."""
    each = _facing(gaussians, camera) ** 2 * gaussians.rgb.mean(1)
    return each[:, None].astype(np.float32) * np.linspace(1, 2, 11, dtype=np.float32)


def estimate(gaussians: Gaussians, camera: Camera, estimator: str) -> np.ndarray:
    """The information of `fisher`, by any estimator; of `block` as diagonal blocks."""
    F = fisher(gaussians, camera)
    return F[:, None] * np.eye(11, dtype=np.float32) if estimator == "block" else F


def fit(gaussians: Gaussians, start: Gaussians, cameras, targets, train, on_pass) -> Fit:
    """Move each point's colour half way to the mean of its pixels."""
    on_pass(0, 1)
    total, weight = np.zeros((POINTS, 3)), np.full(POINTS, 1e-6)
    for camera, target in zip(cameras, targets, strict=True):
        pixels, _ = camera.project(gaussians.means)
        u, v = np.clip(pixels.astype(int), 0, [WIDTH - 1, HEIGHT - 1]).T
        facing = _facing(gaussians, camera)
        total += facing[:, None] * target[v, u, :3]
        weight += facing
    rgb = 0.5 * gaussians.rgb + 0.5 * total / weight[:, None]
    g = gaussians
    fitted = Gaussians(g.means, g.log_scales, g.quats, g.logit_opacities, sh_from_rgb(rgb))
    return Fit(fitted, float(np.abs(rgb - g.rgb).mean()), 7)


@dataclass(frozen=True, eq=False)
class TinyScene(Scene):
    """A scene with functions of this module in place of the splat core's.

    parts: other functions in place of `initial`, `fit`, `fisher`; `exact`, of views of the
    Gaussians before training."""

    parts: dict[str, Callable[..., Any]] = field(default_factory=dict)
    centre = np.zeros(3)
    ground = -np.inf

    def initial(self, frames):
        made = self.parts.get("initial", initial)(frames)
        self.once("starts", list).append(made)
        return made

    def fitted(self, model, frames, gains=None, train=None):
        cameras = [frame.camera for frame in frames]
        targets, start = self.targets(frames, gains), self.start(tuple(frames))
        on_pass = lambda done, total: report(Stage.FIT, done, total)  # noqa: E731
        fit_to = self.parts.get("fit", fit)
        return fit_to(model, start, cameras, targets, train or self.settings.train, on_pass)

    def fisher(self, model, camera, estimator="exact"):
        if any(model is start for start in self.memo["starts"]) and "exact" in self.parts:
            return self.parts["exact"](model, camera)
        if estimator == "exact":
            return self.parts.get("fisher", fisher)(model, camera)
        return estimate(model, camera, estimator)

    def fisher_of_colours(self, model, camera):
        return self.fisher(model, camera)[:, :3]


def prior(up=(0, 0, 1)) -> Prior:
    """The sphere's points. up: of the world of its files."""
    n = sphere(POINTS)
    mesh = Mesh(n[:3], np.array([[0, 1, 2]]), np.zeros(1, bool))
    numbers = {"spacing": 0.5, "depth_tolerance": 0.2, "n": POINTS, "backed": 0, "up": list(up)}
    return Prior(mesh, n, n, 0.5, 0.2, numbers)


def scene(dataset: Dataset, settings: NbvSettings, **parts) -> TinyScene:
    """The scene of a dataset. parts: of `TinyScene`; `capture`, `prior`, `keep` of `Scene`."""
    of_scene = {key: parts.pop(key) for key in ("capture", "keep") if key in parts}
    of_scene = {"keep": VIEW_BYTES if settings.batch > 1 or settings.flies else 0} | of_scene
    made_from = parts.pop("prior", None) or prior()
    return TinyScene(dataset, made_from, settings, **of_scene, parts=parts)


def start(out: Path, dataset: Dataset, **values) -> NbvSettings:
    """Begin a run folder with these settings over small defaults."""
    defaults = {"dataset": dataset.root, "prior": dataset.root, "budget": 5, "seeds": 3}
    defaults |= {"policy": "d-optimal"}
    settings = NbvSettings(**(defaults | values))
    run_folder.write_config(out, settings, dataset)
    return settings


def run(out: Path, dataset: Dataset, *, on_step=None, parts=(), **values) -> Checkpoint:
    """Start a run and run it to its end; its last state. values: settings."""
    return go(out, start(out, dataset, **values), dataset, on_step=on_step, **dict(parts))


def resume(out: Path, dataset: Dataset, *, on_step=None, **parts) -> Checkpoint:
    """Run a started run to its end; its last state. parts: as in `go`."""
    return go(out, run_folder.open_run(out).settings, dataset, on_step=on_step, **parts)


def go(out: Path, settings: NbvSettings, dataset: Dataset, *, on_step=None, **parts) -> Checkpoint:
    """Run or resume in a folder by these settings. parts: as in `scene`, and `measure`."""
    measure = parts.pop("measure", lambda gaussians, taken: {"psnr": float(len(taken))})
    made, on_step = scene(dataset, settings, **parts), on_step or (lambda _: None)
    unchecked = SimpleNamespace(entries=lambda *_: {})
    with (
        patch.object(recording, "psnr_measure", lambda *_: measure),
        patch.object(recording, "Checks", lambda *_: unchecked),
    ):
        return recording.run(out, settings, made, on_step=on_step)


def write_prior(out: Path) -> Path:
    """A prior folder of the sphere's points, as `mgs prior` would write it."""
    return save_prior(out, prior())


def write_run(out: Path, root: Path, prior: Path) -> Path:
    """A run folder of the seeds alone, by the functions of this module."""
    from mgs.prior.initial import initial_gaussians, pixel_on

    dataset, loaded = load_dataset(root), load_prior(prior)
    settings = start(out, dataset, prior=prior, budget=2).model_copy(update={"budget": 0})
    pixel = pixel_on(loaded, [frame.camera for frame in dataset.frames])
    initial = lambda frames: initial_gaussians(loaded, frames, pixel)[0]  # noqa: E731
    go(out, settings, dataset, prior=loaded, initial=initial)
    return out


def write_measured_run(out: Path, dataset: Dataset, grey: float, parts=(), **values) -> Path:
    """A finished run with pictures and metrics.json, as if every render were of one grey."""
    from mgs.evaluation import evaluate_model

    run(out, dataset, parts=parts, **values)
    made, tests = run_folder.open_run(out), dataset.test_views()

    def wall(_, camera):
        one = np.ones((camera.height, camera.width))
        return np.full((*one.shape, 3), grey, np.float32), one, one

    options = {"test_frames": tests.frames if tests else (), "pictures": out / "renders"}
    model, names = made.state.gaussians, [frame.name for frame in made.taken]
    metrics = evaluate_model(model, dataset.frames, names, renderer=wall, **options)
    write_json(out / "metrics.json", {"policy": values["policy"]} | metrics)
    return out


def dying_parts(moment: str, count: int) -> dict[str, Callable[..., Any]]:
    """Parts of a scene; the count-th call of one of them, or of a write, kills this process."""
    calls = {"n": 0}

    def dying(function):
        def call(*arguments, **keywords):
            calls["n"] += 1
            if calls["n"] == count:
                os.kill(os.getpid(), signal.SIGKILL)
            return function(*arguments, **keywords)

        return call

    if moment == "fisher":
        return {"fisher": dying(fisher)}
    if moment == "before the lines are written":
        run_folder.write_steps = dying(run_folder.write_steps)
    if moment == "while the checkpoint is written":
        savez = np.savez

        def half_then_die(file, **arrays):
            calls["n"] += 1
            if calls["n"] == count:
                file.write(b"half")
                file.flush()
                os.kill(os.getpid(), signal.SIGKILL)
            savez(file, **arrays)

        np.savez = half_then_die
    return {}


if __name__ == "__main__":
    loaded, folder = load_dataset(sys.argv[1]), Path(sys.argv[2])
    run(folder, loaded, parts=dying_parts(sys.argv[3], int(sys.argv[4])), seed=3)
