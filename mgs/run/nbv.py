"""The whole of `mgs nbv` for programs: start a run, run it, resume it. Prints nothing."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial import cKDTree

from mgs import runtime
from mgs.data.dataset import Dataset, load_dataset
from mgs.errors import InputError, row_named
from mgs.files import atomic_folder
from mgs.fit.settings import ALPHA_WEIGHT
from mgs.policy.from_file import absolute
from mgs.prior.build import Prior, build_prior, load_prior, save_prior
from mgs.prior.settings import PriorSettings
from mgs.run import loop
from mgs.run.folder import (
    DATASET,
    State,
    check_same_frames,
    check_settings,
    holds_run,
    read_settings,
    start,
)
from mgs.run.settings import PRESETS, NbvSettings, validated, with_defaults
from mgs.run.stations import real_stations
from mgs.splat.constants import NEAR
from mgs.synth.scene_file import load_scene_file

CAPTURE_PRESET = "quick"
"""Size and number of the images that a run captures, a row of `mgs.synth.rendering.PRESETS`."""

CAPTURE_TEST_VIEWS = 12
"""Number of test views that judge a run with captured images, which has no view that is held
out."""


def _silent(*_: Any) -> None:
    """What is called where nobody listens."""


def run_nbv(
    dataset: str | Path | None,
    out: str | Path,
    *,
    capture: str | Path | None = None,
    prior: str | Path | None = None,
    gaussians: int | Literal["auto"] | None = None,
    preset: str | None = None,
    on_step: Callable[[State], None] = _silent,
    progress: Callable[[str, int, int], None] = _silent,
    say: Callable[[str], None] = _silent,
    **settings: Any,
) -> State:
    """Choose views one by one, as the paper does: `start_run`, then `resume_nbv`.

    dataset: a dataset folder. out: the run's folder, new. capture, prior, gaussians, preset,
    settings: see `start_run`.
    on_step(state): called after every step, or batch of steps, that is finished and on disk;
    state.steps[-1] is its (last) line of steps.jsonl.
    progress(stage, done, total): called while a step is worked on. say(text): called with what a
    person should know.
    Returns the last state: gaussians, H, taken (frame indices in the order of their choice), steps.
    Raises InputError as `start_run` and `resume_nbv`.
    """
    start_run(
        dataset,
        out,
        capture=capture,
        prior=prior,
        gaussians=gaussians,
        preset=preset,
        progress=progress,
        **settings,
    )
    return resume_nbv(out, on_step=on_step, progress=progress, say=say)


def start_run(
    dataset: str | Path | None,
    out: str | Path,
    *,
    capture: str | Path | None = None,
    prior: str | Path | None = None,
    gaussians: int | Literal["auto"] | None = None,
    preset: str | None = None,
    progress: Callable[[str, int, int], None] = _silent,
    **settings: Any,
) -> NbvSettings:
    """Check everything, find or build the prior, and write the run's config.json with every setting
    resolved.

    capture: a scene (`mgs.synth.scene_file.load_scene_file`) in place of a dataset, which is None
    then. The run has a dataset of its own, OUT/dataset, as `mgs synth-orbit --on-demand` writes it
    with the run's seed: the poses of the scene's orbit, images of which are rendered when they are
    chosen, and CAPTURE_TEST_VIEWS test views.
    prior: folder of a prior; without it DATASET/prior where there is one, otherwise a prior is
    built inside the run, of this many `gaussians` (`mgs.prior.settings.PriorSettings`; by default,
    as many as the images can tell apart); of an on-demand
    dataset it is built of its survey. preset: a row of `mgs.run.settings.PRESETS`, whose values are
    the defaults of what is
    not given. settings: fields of `mgs.run.settings.NbvSettings`; the budget is 50 views, or all
    candidates where they are fewer; where `train` does not name alpha_weight, it is ALPHA_WEIGHT,
    or 0 where frames have neither mask nor alpha. Leaves no folder behind where it fails. Raises
    InputError where the output folder is not empty, a setting is wrong, the dataset is too small
    for it, the dataset, the scene or the prior is missing or damaged, or the cameras are so near to
    the prior that it would not be drawn.
    """
    out = Path(out)
    if (dataset is None) == (capture is None):
        raise InputError("nbv: give either a DATASET or --capture SCENE")
    if holds_run(out):
        raise InputError(
            f"{out}: holds a run; `mgs nbv --resume {out}` goes on with it; for another, choose a new folder"
        )
    dataset = out / DATASET if dataset is None else Path(dataset)
    if prior is not None and gaussians is not None:
        raise InputError(
            "nbv: --gaussians is for a prior that is built here; leave it out, or leave out --prior"
        )
    if prior is None and gaussians is None and (dataset / "prior/prior.json").is_file():
        prior = dataset / "prior"
    row = None if preset is None else row_named(PRESETS, preset, "--preset")
    loaded = load_dataset(dataset) if capture is None else None
    outlined = loaded is None or all(frame.mask_path or frame.rock_path for frame in loaded.frames)
    settings = with_defaults(settings, row, ALPHA_WEIGHT if outlined else 0.0)
    where = out / "prior" if prior is None else Path(prior)
    given = validated(
        NbvSettings, {"dataset": dataset.resolve(), "prior": where.resolve(), **settings}
    )
    count = _candidates(capture) if capture is not None else len(loaded or ())
    own_seed = "seed" in given.train.model_fields_set
    resolved: dict[str, Any] = {"policy": absolute(given.policy)}
    resolved |= {
        "train": given.train if own_seed else given.train.model_copy(update={"seed": given.seed})
    }
    if "budget" not in settings:
        resolved["budget"] = min(given.budget, max(0, count - given.seeds))
    complete = given.model_copy(update=resolved)
    check_settings(complete, count)
    found = None if prior is None else load_prior(prior)
    with atomic_folder(out) as unfinished:
        frames = loaded or _poses(unfinished / DATASET, str(capture), complete.seed, progress)
        if found is None:
            asked = PriorSettings(
                gaussians=gaussians, seed=complete.seed, density=row.density if row else None
            )
            found, _ = build_prior(
                frames.survey(), asked, on_stage=lambda stage: progress(f"prior: {stage}", 0, 1)
            )
            save_prior(unfinished / "prior", found)
        _check_near(found, frames, where)
        complete = complete.with_spacing(found.spacing)
        start(unfinished, complete, frames)
    return complete


def _check_near(prior: Prior, dataset: Dataset, where: Path) -> None:
    """Raises InputError where most cameras are nearer to the prior than NEAR: a length of 1 then
    stands for many metres. where: the folder of the prior."""
    positions = np.stack([frame.camera.position for frame in dataset.frames])
    nearest = float(np.median(cKDTree(prior.points).query(positions)[0]))
    if nearest < NEAR:
        raise InputError(
            f"{where}: the cameras are {nearest:.2g} {dataset.unit} from it, and nothing nearer than {NEAR} is drawn; import "
            "the data with --unit M, the metres in a length of 1, and build the prior again"
        )


def _candidates(scene: str | Path) -> int:
    """Number of poses that a run captures a scene from. Raises InputError where there is no such
    scene, or its file is bad."""
    load_scene_file(scene)
    runtime.start()
    from mgs.synth.rendering import PRESETS

    return PRESETS[CAPTURE_PRESET].frames


def _poses(
    folder: Path, scene: str | Path, seed: int, progress: Callable[[str, int, int], None]
) -> Dataset:
    """The on-demand dataset of a run that captures a scene, written into a folder."""
    from mgs.synth.rendering import synthesise  # which needs the variant that `_candidates` sets

    def rendered(done: int, total: int) -> None:
        progress("rendering test views", done, total)

    views = CAPTURE_TEST_VIEWS
    return synthesise(
        folder, scene, CAPTURE_PRESET, seed, progress=rendered, test_views=views, on_demand=True
    )


def resume_nbv(
    out: str | Path,
    *,
    on_step: Callable[[State], None] = _silent,
    progress: Callable[[str, int, int], None] = _silent,
    say: Callable[[str], None] = _silent,
) -> State:
    """Run the loop in a run's folder from where it stands to its end. A finished run gives the same
    files again.

    Why it ended is `ended` of the last of state.steps (`mgs.run.ending.run_end`).

    Callbacks and result as `run_nbv`. Raises InputError where the folder holds no run, its dataset
    or prior is missing or has changed, another process works on it, or a fit diverged (the steps
    before it are kept).
    """
    out = Path(out)
    settings = read_settings(out)
    if not settings.prior.is_dir():
        raise InputError(
            f"{out / 'config.json'}: prior {settings.prior} is not there; if it was moved, correct `prior` there"
        )
    dataset = load_dataset(settings.dataset)
    check_same_frames(out, dataset)
    stations = real_stations(dataset, load_prior(settings.prior), settings)
    return loop.run(out, settings, dataset, stations, progress, on_step, say)
