"""Measure a run, or any model on a dataset: `mgs.evaluate`, `mgs eval`."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from mgs.camera import Camera
from mgs.colour import linear_from_srgb
from mgs.data.dataset import Dataset, load_dataset
from mgs.errors import InputError
from mgs.files import write_json
from mgs.gaussians import Gaussians
from mgs.report.evaluation import (
    Progress,
    Renderer,
    evaluate_model,
    evaluate_run,
    no_progress,
    render_view,
)
from mgs.run.folder import Run, holds_run, open_run
from mgs.splat_ply import ply_colour_space, read_ply


def evaluate(
    subject: str | Path | Run | Gaussians,
    dataset: str | Path | Dataset | None = None,
    *,
    trained: Iterable[str] = (),
    progress: Progress = no_progress,
    **options: Any,
) -> dict[str, Any]:
    """Measure a run, or a model on the views of a dataset; return the contents of metrics.json.

    subject: a run or its folder, measured by `evaluate_run` with its options; or Gaussians, or a
    PLY. dataset: of a model; default of a PLY in a run's folder: that of the run. trained: names of
    the frames that the model was trained on; there those of the run. The numbers of a PLY are
    written beside it, as NAME.metrics.json. Raises InputError as `evaluate_run`, `read_ply` and
    `load_dataset`, and where a model comes without a dataset.
    """
    if isinstance(subject, Run) or (not isinstance(subject, Gaussians) and Path(subject).is_dir()):
        return evaluate_run(subject, progress=progress, **options)
    renderer: Renderer = render_view
    path = None
    if not isinstance(subject, Gaussians):
        path = Path(subject)
        if not path.exists():
            raise InputError(f"{path}: no such run folder or PLY file")
        subject, renderer = read_ply(path), _renderer(ply_colour_space(path))
        if dataset is None and holds_run(path.parent):
            run = open_run(path.parent)
            dataset, trained = run.dataset, [frame.name for frame in run.taken]
    if dataset is None:
        raise InputError(f"{path or 'the model'}: is of no run here; give a dataset with --dataset")
    views = dataset if isinstance(dataset, Dataset) else load_dataset(dataset)
    names, tests = list(trained), views.test_views()
    metrics = evaluate_model(
        subject,
        views.with_images(names),
        names,
        test_frames=tests.frames if tests else (),
        renderer=renderer,
        progress=progress,
    )
    if path is not None:
        write_json(path.with_suffix(".metrics.json"), metrics)
    return metrics


def _renderer(space: str) -> Renderer:
    """Renderer of a model whose colours are blended in this space."""
    if space == "linear":
        return render_view

    def render(gaussians: Gaussians, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        rgb, alpha, depth = render_view(gaussians, camera)
        return linear_from_srgb(np.clip(rgb, 0, 1)), alpha, depth

    return render
