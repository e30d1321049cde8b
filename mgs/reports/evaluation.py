"""Evaluation of runs and of models in files: metrics.json, and pictures beside it."""

import gc
import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mgs.data.dataset import TEST_FOLDER, Dataset, load_dataset
from mgs.data.frames import Frame
from mgs.errors import InputError
from mgs.evaluation import evaluate_model
from mgs.files import working_in, write_json
from mgs.gaussians import ARRAYS, Gaussians
from mgs.memory import KEPT_BYTES, release
from mgs.progress import listening, no_progress
from mgs.provenance import versions
from mgs.run.folder import Run, holds_run, open_run, read_config
from mgs.run.inputs import array_digest, camera_digest, frame_digests
from mgs.splat_files import load_gaussians
from mgs.splat_places import from_source


def evaluate_run(
    run: str | Path | Run, *, pictures: bool = True, say: Callable[[str], None] = lambda text: None
) -> dict[str, Any]:
    """Evaluate a run of `mgs nbv` on its dataset and its test views; write RUN/metrics.json and,
    with `pictures`, RUN/renders. Returns the contents of metrics.json.

    - run: folder or opened run.
    - say: called with lines for the user: files written and kept.

    Metrics and pictures of the same model, dataset and version of mgs are kept, if all are there.
    In an on-demand dataset only frames that the run has taken have an image, so none is held out.
    Raises InputError as `open_run`, if the test views cannot be read, and if another process works
    on the run."""
    from mgs.splat import as_drjit

    run = open_run(run)
    gc.collect()  # images and lists of the run itself, if it ended in this process
    release(KEPT_BYTES)
    file, folder = run.folder / "metrics.json", run.folder / "renders"
    with working_in(run.folder):
        trained, tests = [frame.name for frame in run.taken], run.dataset.test_views()
        frames = run.dataset.with_images(trained)
        test_frames = () if tests is None else tests.frames
        subject = _subject(run, [*frames, *test_frames], trained)
        files = [folder / f"{frame.name}.png" for frame in frames]
        files += [folder / TEST_FOLDER / f"{frame.name}.png" for frame in test_frames]
        metrics = _measured_before(run, subject)
        whole = bool(metrics.get("pictures")) and all(path.is_file() for path in files)
        if metrics and (whole or not pictures):
            also = f", and {folder}" if pictures else ""
            say(f"kept {file}, measured before on this very model and dataset{also}")
            return metrics
        metrics = {"policy": run.label, "of": subject, "pictures": pictures}
        metrics |= {"informed": _informed(run)}
        metrics |= {"poses_moved": run.poses_moved} if run.poses_moved else {}
        model, shown = as_drjit(run.gaussians), folder if pictures else None
        metrics |= evaluate_model(model, frames, trained, test_frames=test_frames, pictures=shown)
        write_json(file, metrics)
        run.metrics = metrics
        say(f"wrote {file}" + (f" and {folder}" if pictures else ""))
        return metrics


def drawn_test_view(run: Run, model: Gaussians) -> tuple[Path, float]:
    """Draw a model in the middle test view of a run, or without one in the middle frame, into
    RUN/renders beside the truth; returns the picture's path and the PSNR, dB. The first is often at
    the edge of what photographs show."""
    tests, folder = run.dataset.test_views(), run.folder / "renders"
    views = (tests or run.dataset).frames
    frame = views[len(views) // 2]
    folder = folder / TEST_FOLDER if tests else folder
    with listening(no_progress):  # of the fit at work
        metrics = evaluate_model(model, [frame], [], pictures=folder)
    return folder / f"{frame.name}.png", metrics["all"]["psnr"]


def _informed(run: Run) -> dict[str, dict[str, int]]:
    """Parameters by kind ("of"), and those with H > lambda ("informed")."""
    from mgs.splat import groups

    state, settings = run.state, run.settings
    columns = groups(state.gaussians.sh_degree, settings.train.means)
    more = settings.regularisation(columns) < state.H
    parts = {kind: more[:, of] for kind, of in columns.items()}
    return {kind: {"of": part.size, "informed": int(part.sum())} for kind, part in parts.items()}


def _subject(run: Run, frames: Sequence[Frame], trained: list[str]) -> str:
    """Hash of all that the metrics of a run depend on."""
    kinds = ("image", "mask", "rock", "depth")
    views = [[f.name, camera_digest(f.camera), frame_digests(f, kinds)] for f in frames]
    software = {name: version for name, version in versions().items() if name != "commit"}
    gaussians, settings = run.gaussians, run.settings
    marks = gaussians.antialiased, gaussians.linear
    lam = settings.lam, settings.pixel_noise, settings.prior_std, settings.estimator
    model = array_digest(getattr(gaussians, name) for name in ARRAYS), *marks
    text = json.dumps([*model, *lam, views, trained, software])
    return array_digest([np.frombuffer(text.encode(), np.uint8)])


def _measured_before(run: Run, subject: str) -> dict[str, Any]:
    """Contents of metrics.json if it exists and is of this subject, else nothing."""
    try:
        metrics = run.metrics or {}
    except InputError:
        return {}
    return metrics if metrics.get("of") == subject else {}


def compare_models(models: Sequence[Gaussians], run: Run) -> tuple[str, list[float] | None]:
    """Mean PSNR of each model, dB, full frame, on views that a run did not train on. Returns the
    name of the set, "test" if the dataset has test views, else "held-out", and the means, None if
    there is no such view."""
    tests, taken = run.dataset.test_views(), [frame.name for frame in run.taken]
    name, frames = "test", tests.frames if tests else ()
    if not tests:
        name = "held-out"
        frames = tuple(f for f in run.dataset.with_images(taken) if f.name not in taken)
    if not frames:
        return name, None
    return name, [float(evaluate_model(model, frames, ())["all"]["psnr"]) for model in models]


def evaluate(
    subject: str | Path | Run | Gaussians,
    dataset: str | Path | Dataset | None = None,
    *,
    trained: Iterable[str] = (),
    prior: str | Path | None = None,
    **options: Any,
) -> dict[str, Any]:
    """Measure PSNR and SSIM of a run or a model; return the contents of metrics.json.

    - subject: a run or its folder, measured by `evaluate_run` with its options; or Gaussians, or a
      file of them, whose metrics are written beside it, as a.ply.metrics.json.
    - dataset: of Gaussians or a file. Default for a file in a run folder: the run's.
    - trained: names of the frames that the model was trained on. Default for a file in a run
      folder, on the run's dataset: the views taken.
    - prior: of a file, as in `load_gaussians`.

    Raises InputError as `evaluate_run`, `load_gaussians` and `load_dataset`, if a model comes
    without a dataset, if trained names no frame of it, and if dataset or trained are given for a
    run."""
    if isinstance(subject, Run) or (not isinstance(subject, Gaussians) and Path(subject).is_dir()):
        if dataset is not None or trained:
            own = "is a run, with its own dataset; leave out dataset and trained"
            raise InputError(f"{subject}: {own}")
        return evaluate_run(subject, **options)
    path = None
    if not isinstance(subject, Gaussians):
        path = Path(subject)
        if not path.exists():
            raise InputError(f"{path}: no such run folder or file of Gaussians")
        subject = load_gaussians(path, prior)
        if holds_run(path.parent):
            root = dataset.root if isinstance(dataset, Dataset) else dataset
            of_run = read_config(path.parent)["settings"].get("dataset")
            if root is None or str(Path(root).resolve()) == of_run:
                run = open_run(path.parent)
                dataset = run.dataset
                trained = list(trained) or [frame.name for frame in run.taken]
    if dataset is None:
        raise InputError(f"{path or 'the model'}: is in no run folder; give its `dataset`")
    views = dataset if isinstance(dataset, Dataset) else load_dataset(dataset)
    subject = from_source(subject, views.world)
    names, tests = list(trained), views.test_views()
    if unknown := sorted(set(names) - {frame.name for frame in views.frames}):
        raise InputError(f"{views.root}: has no frame {unknown[0]}, which `trained` names")
    frames, test_frames = views.with_images(names), tests.frames if tests else ()
    metrics = evaluate_model(subject, frames, names, test_frames=test_frames)
    if path is not None:
        write_json(path.with_name(f"{path.name}.metrics.json"), metrics)
    return metrics
