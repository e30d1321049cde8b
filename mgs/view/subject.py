"""What the viewer shows, read from a run folder or from a PLY: Gaussians and their scalars,
cameras, the mesh of the prior."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from mgs.data.dataset import Frame, load_dataset
from mgs.data.meshes import Mesh, read_mesh
from mgs.data.up import PLUS_Z, Up
from mgs.errors import InputError
from mgs.files import read_json
from mgs.gaussians import Gaussians
from mgs.policy import criteria
from mgs.policy.from_file import label
from mgs.report.diagnostics import gaussian_scalars
from mgs.report.page_facts import measured
from mgs.report.page_plots import metric_name
from mgs.report.runs import up_of
from mgs.report.tables import table_cell
from mgs.run import folder as run_folder
from mgs.run.ending import RunEnd
from mgs.run.settings import NbvSettings
from mgs.splat_ply import ply_colour_space, read_ply

SCALARS = ("information", "uncertainty", "unobserved")
"""Those of `mgs.report.diagnostics` that the viewer shows."""


LARGEST = 40.0
"""Largest distance of a camera, or of 95 % of the Gaussians, from the middle of what is shown. The
unit of a world may be anything, but depth in a browser ends at about four times of this
(`mgs.view.layers.FAR`)."""


@dataclass(frozen=True)
class View:
    """A camera of the dataset. role: "seed", "chosen" or "candidate"; step: at which it was chosen,
    0 for seeds, None for candidates; facts: (name, value) of what is known about it."""

    frame: Frame
    role: str
    step: int | None
    facts: list[tuple[str, str]]


@dataclass(frozen=True)
class Subject:
    """gaussians: the model; None where a run has no finished step yet. space: "linear" or "srgb",
    in which its colours are
    blended. scalars: name -> [N], of SCALARS; none for a PLY. views: of the dataset, in its order;
    none for a PLY. up, unit: of the world (`mgs.data.dataset.Dataset`); a PLY says nothing of
    either, and is taken to be +Z up. scale: all lengths over those of the world."""

    title: str
    gaussians: Gaussians | None
    space: str = "linear"
    scalars: dict[str, np.ndarray] = field(default_factory=dict)
    views: list[View] = field(default_factory=list)
    mesh: Mesh | None = None
    up: Up = PLUS_Z
    unit: str = "m"
    scale: float = 1.0

    @property
    def taken(self) -> list[View]:
        """The seeds, then the chosen views in their order."""
        return sorted(
            (view for view in self.views if view.step is not None), key=lambda view: view.step or 0
        )


def read_subject(path: str | Path, follow: bool = False) -> Subject:
    """Read a run folder or a PLY of Gaussians. follow: a run without a finished step is shown
    without a model.

    Raises InputError if there is neither, if a file is damaged or the dataset has changed, and,
    unless `follow`, if the run has no finished step.
    """
    path = Path(path)
    if path.is_dir():
        return fitted(_read_run(path, follow))
    if follow:
        raise InputError(f"{path}: --follow needs the folder of a run")
    if not path.is_file():
        raise InputError(f"{path}: no such run folder or PLY file")
    return fitted(Subject(path.name, read_ply(path), ply_colour_space(path), unit="unit"))


def fitted(subject: Subject) -> Subject:
    """The same, with all lengths multiplied such that nothing is farther than LARGEST from the
    middle."""
    g, mesh = subject.gaussians, subject.mesh
    eyes = np.array([view.frame.camera.position for view in subject.views]).reshape(-1, 3)
    means = eyes[:0] if g is None else g.means
    if len(means) + len(eyes) == 0:
        return subject
    centre = np.median(means if len(means) else eyes, axis=0)
    of_means, of_eyes = (np.linalg.norm(points - centre, axis=1) for points in (means, eyes))
    size = max(
        float(np.quantile(of_means, 0.95)) if len(means) else 0.0, float(of_eyes.max(initial=0))
    )
    if size <= LARGEST:
        return subject
    scale = LARGEST / size
    views = [
        replace(view, frame=replace(view.frame, camera=view.frame.camera.scaled(scale)))
        for view in subject.views
    ]
    if g is not None:
        g = replace(
            g,
            means=g.means * np.float32(scale),
            log_scales=g.log_scales + np.float32(np.log(scale)),
        )
    surface = None if mesh is None else replace(mesh, vertices=mesh.vertices * scale)
    return replace(subject, gaussians=g, views=views, mesh=surface, scale=scale)


def _read_run(run: Path, follow: bool) -> Subject:
    """`read_subject` of a run folder."""
    settings = run_folder.read_settings(run)
    if not follow:
        run_folder.load_run(run)  # raises where there is no finished step
    dataset, state = load_dataset(settings.dataset), run_folder.read_checkpoint(run)
    run_folder.check_same_frames(run, dataset)
    mesh_path = settings.prior / "mesh.ply"
    mesh = read_mesh(mesh_path) if mesh_path.is_file() else None
    name, up = run.resolve().name, up_of(settings.prior, dataset)
    if state is None:
        waiting = [View(frame, "candidate", None, []) for frame in dataset.frames]
        return Subject(
            f"{name}: no finished step yet",
            None,
            views=waiting,
            mesh=mesh,
            up=up,
            unit=dataset.unit,
        )
    views = _views(dataset.frames, state, _psnr(run, len(state.taken)))
    early = state.steps[-1].get("ended", {}).get("reason", RunEnd.BUDGET) != RunEnd.BUDGET
    planned = "" if early else f" of {settings.seeds + settings.budget}"
    title = f"{name}: {label(settings.policy)}, {len(state.taken)}{planned} views, {len(state.gaussians):,} Gaussians"
    return Subject(
        title, state.gaussians, "linear", _scalars(settings, state), views, mesh, up, dataset.unit
    )


def _scalars(settings: NbvSettings, state: run_folder.State) -> dict[str, np.ndarray]:
    """SCALARS of the model of a run, as `mgs diagnose` has them."""
    from mgs.splat import groups

    columns = groups(state.gaussians.sh_degree, settings.train.means)
    prior_lam = criteria.regularisation(
        groups(state.gaussians.sh_degree), settings.pixel_noise, settings.prior_std
    )
    found = gaussian_scalars(
        state.H, state.surface, settings.regularisation(columns), prior_lam, columns
    )
    return {name: found[name] for name in SCALARS}


def _psnr(run: Path, images: int) -> dict[str, float]:
    """PSNR of each view by its name, where the run was measured since its last step."""
    metrics: Any = read_json(run / "metrics.json") if (run / "metrics.json").is_file() else None
    if not isinstance(metrics, dict) or metrics.get("images") != images:
        return {}
    return {
        view["name"]: view["psnr"]
        for view in metrics.get("views", [])
        if view.get("psnr") is not None
    }


def _views(
    frames: tuple[Frame, ...], state: run_folder.State, psnr: dict[str, float]
) -> list[View]:
    """The cameras of the dataset, with what the run's state says about each."""
    seeds = state.steps[0]["seeds"]
    steps = {line["frame"]: line for line in state.steps[1:]}
    views = []
    for index, frame in enumerate(frames):
        facts = (
            [("PSNR of the model here", f"{psnr[frame.name]:.2f} dB")] if frame.name in psnr else []
        )
        if index in seeds:
            views.append(View(frame, "seed", 0, facts))
        elif index in steps:
            line = steps[index]
            facts += [
                ("information gain", f"{line['information_gain']:.4g}"),
                ("images then", str(line["images"])),
                ("surface coverage then", f"{100 * line['coverage']:.2f} %"),
                *(
                    (f"{metric_name(key)}, then", table_cell(key, value))
                    for key, value in measured(line).items()
                ),
            ]
            views.append(View(frame, "chosen", line["step"], facts))
        else:
            views.append(View(frame, "candidate", None, facts))
    return views
