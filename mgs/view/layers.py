"""Subject of the viewer, read from a run or a file, and its layers, as colours or as images."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from mgs.camera import Camera
from mgs.colour import srgb_from_linear
from mgs.data.frames import Frame
from mgs.data.meshes import Mesh
from mgs.data.world import World
from mgs.errors import InputError
from mgs.gaussians import Gaussians
from mgs.plotting import painted
from mgs.reports.diagnostics import PANELS, VISIBLE, picture, run_scalars, view_maps
from mgs.reports.page_plots import step_facts
from mgs.rotation import rotmat_from_quat
from mgs.run.ending import RunEnd
from mgs.run.folder import Run, open_run
from mgs.splat_files import load_gaussians, upward
from mgs.splat_places import from_source
from mgs.view.access import plain

SCALARS = ("information", "uncertainty", "unobserved")  # that the viewer shows
LARGEST = 40.0  # largest distance from the middle; depth in a browser ends at about four times this


@dataclass(frozen=True)
class View:
    """A camera of the dataset. role: "seed", "chosen" or "candidate". step: 0 for seeds, None for
    candidates. facts: (name, value) pairs."""

    frame: Frame
    role: str
    step: int | None
    facts: list[tuple[str, str]]


@dataclass(frozen=True)
class Subject:
    """Contents of the viewer.

    gaussians: the model; None before the first finished step. scalars: name -> [N], of SCALARS;
    empty for a PLY. views: of the dataset, in its order; empty for a PLY. unit: of lengths;
    a PLY's unit is "unit". scale: all lengths over those of the world. of_scene: as `Run.of_scene`.
    """

    title: str
    gaussians: Gaussians | None
    scalars: dict[str, np.ndarray] = field(default_factory=dict)
    views: list[View] = field(default_factory=list)
    mesh: Mesh | None = None
    unit: str = "m"
    scale: float = 1.0
    of_scene: bool = False

    @property
    def model(self) -> Gaussians:
        assert self.gaussians is not None
        return self.gaussians

    @property
    def taken(self) -> list[View]:
        taken = [view for view in self.views if view.step is not None]
        return sorted(taken, key=lambda view: view.step or 0)

    @property
    def eyes(self) -> np.ndarray:
        """Positions of the cameras, [V,3]."""
        return np.array([view.frame.camera.position for view in self.views]).reshape(-1, 3)

    @property
    def extent(self) -> tuple[np.ndarray, float]:
        """Middle, and the radius that holds 95 %, of the Gaussians, else of mesh or cameras."""
        points = self.eyes if self.mesh is None else self.mesh.vertices
        if self.gaussians is not None and len(self.gaussians):
            points = self.gaussians.means
        points = points if len(points) else np.zeros((1, 3))
        centre = np.median(points, axis=0).astype(np.float64)
        return centre, max(float(np.quantile(np.linalg.norm(points - centre, axis=1), 0.95)), 1e-6)


def read_subject(path: str | Path, follow: bool = False) -> Subject:
    """Read a run folder or a file of Gaussians. follow: accept a run without a finished step.
    Raises InputError if there is neither, if a file is damaged or the dataset has changed, and,
    unless `follow`, if the run has no finished step."""
    path = Path(path)
    if path.is_dir():
        return scaled(_read_run(open_run(path), follow))
    if follow:
        raise InputError(f"{path}: `follow` needs the folder of a run")
    if not path.is_file():
        raise InputError(f"{path}: no such run folder or PLY file")
    upright = from_source(load_gaussians(path), World(upward(path)))
    return scaled(Subject(path.name, upright, unit="unit"))


def scaled(subject: Subject) -> Subject:
    g, mesh, (centre, size) = subject.gaussians, subject.mesh, subject.extent
    size = max(size, float(np.linalg.norm(subject.eyes - centre, axis=1).max(initial=0)))
    if size <= LARGEST:
        return subject
    scale = LARGEST / size
    frames = [replace(v.frame, camera=v.frame.camera.scaled(scale)) for v in subject.views]
    views = [replace(v, frame=frame) for v, frame in zip(subject.views, frames, strict=True)]
    if g is not None:
        larger = g.log_scales + np.float32(np.log(scale))
        g = replace(g, means=g.means * np.float32(scale), log_scales=larger)
    surface = None if mesh is None else replace(mesh, vertices=mesh.vertices * scale)
    return replace(subject, gaussians=g, views=views, mesh=surface, scale=scale)


def _read_run(run: Run, follow: bool) -> Subject:
    name, prior = run.folder.resolve().name, run.settings.prior
    waiting = Subject(
        f"{name}: no finished step yet",
        None,
        views=[View(frame, "candidate", None, []) for frame in run.dataset.frames],
        mesh=run.prior.mesh if (prior / "prior.json").is_file() else None,
        unit=run.dataset.unit,
    )
    if follow and not run.begun:
        return waiting
    early = run.state.steps[-1].get("ended", {}).get("reason", RunEnd.BUDGET) != RunEnd.BUDGET
    planned = "" if early else f" of {run.planned}"
    count = f"{len(run.indices)}{planned} views, {run.shown.sum():,} Gaussians"
    scalars = run_scalars(run)
    return replace(
        waiting,
        title=f"{name}: {run.label}, {count}",
        gaussians=run.gaussians[run.shown],
        scalars={scalar: scalars[scalar][run.shown] for scalar in SCALARS},
        views=_views(run),
        of_scene=run.of_scene,
    )


def _views(run: Run) -> list[View]:
    psnr = {view["name"]: view["psnr"] for view in (run.measured or {}).get("views", [])}
    lines = {line["frame"]: line for line in run.steps[1:]}
    views = []
    for index, frame in enumerate(run.dataset.frames):
        facts, role, step = [], "candidate", None
        if psnr.get(frame.name) is not None:
            facts.append(("PSNR of the model here", f"{psnr[frame.name]:.2f} dB"))
        if index in run.steps[0]["seeds"]:
            role, step = "seed", 0
        elif line := lines.get(index):
            role, step = "chosen", line["step"]
            facts += [(f"{name} then", value) for name, value in step_facts(line)]
        views.append(View(frame, role, step, facts))
    return views


FAR = 160.0  # depth of pixels that show no model, metres: viser's images of depth end at 167 m

LEGENDS = {
    "colour": "The colours of the model.",
    "alpha": "Opacity: black 0, white 1.",
    "depth": "Depth: dark {low:.3g} {unit}, bright {high:.3g} {unit}. Grey while the camera moves.",
    "information": "Information gained: dark 0, bright {high:.0f} nats and more.",
    "uncertainty": "Variance left over that of the prior: blue 0, all known; yellow 1, nothing.",
    "unobserved": "Yellow: no image has seen this part of the surface.",
}
"""Layers, and the meaning of their colours."""


def layers(subject: Subject) -> list[str]:
    return ["colour", "alpha", "depth", *subject.scalars]


def covariances(g: Gaussians) -> np.ndarray:
    """Covariance matrices of the Gaussians in the world, m², float32 [N,3,3]."""
    axes = rotmat_from_quat(g.quats) * np.exp(g.log_scales.astype(np.float64))[:, None, :]
    return (axes @ axes.transpose(0, 2, 1)).astype(np.float32)


def gaussian_colours(subject: Subject, layer: str) -> np.ndarray:
    """Colours of the Gaussians in a layer, sRGB uint8 [N,3]; grey for depth."""
    g = subject.model
    if layer == "colour":
        srgb = srgb_from_linear(g.linear_rgb(g.rgb))
        return np.round(255 * srgb).astype(np.uint8)
    if layer in subject.scalars:
        return painted(subject.scalars[layer], PANELS[layer][1], *scale(subject, layer))
    return np.full((len(g), 3), 255 if layer == "alpha" else 128, np.uint8)


def kernel_image(
    subject: Subject, camera: Camera, layer: str
) -> tuple[np.ndarray, np.ndarray, tuple[float, float]]:
    """Draw a layer from a camera: sRGB uint8 [H,W,3], z-depth float32 [H,W], and (low, high) of the
    colour scale.

    Camera and depth have the lengths that are shown, the scale of depth those of the world. Behind
    the model it is black, and FAR away. Scalars are drawn where the opacity is at least VISIBLE."""
    scalars = {layer: subject.scalars[layer]} if layer in subject.scalars else {}
    maps = view_maps(subject.model, camera, scalars)
    opaque = maps["A"] >= VISIBLE
    depth = np.where(opaque, maps["Z"], FAR).astype(np.float32)
    if layer == "colour":
        return np.round(255 * picture(maps)).astype(np.uint8), depth, (0.0, 1.0)
    if layer == "alpha":
        grey = np.round(255 * np.clip(maps["A"], 0, 1)).astype(np.uint8)
        return np.stack([grey] * 3, axis=-1), depth, (0.0, 1.0)
    low, high = scale(subject, layer)
    if layer == "depth" and opaque.any():
        low, high = float(depth[opaque].min()), float(depth[opaque].max())
    channel = "Z" if layer == "depth" else layer
    image = painted(maps[channel], PANELS[channel][1], low, high)
    lengths = subject.scale if layer == "depth" else 1.0
    return image * opaque[..., None].astype(np.uint8), depth, (low / lengths, high / lengths)


def scale(subject: Subject, layer: str) -> tuple[float, float]:
    """Ends of the colour scale of a scalar: 0 to 1; of information 0 to its 99.9 %."""
    if layer != "information":
        return 0.0, 1.0
    return 0.0, max(float(np.quantile(subject.scalars[layer], 0.999)), 1e-9)


def legend(layer: str, ends: tuple[float, float], unit: str) -> str:
    """Meaning of the colours of a layer, in one line. unit: name of a length of 1."""
    return LEGENDS[layer].format(low=ends[0], high=ends[1], unit=plain(unit))
