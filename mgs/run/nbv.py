"""`mgs nbv` for programs: start a run, resume it, or both. Prints nothing."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial import cKDTree

from mgs import runtime
from mgs.camera import extent_of
from mgs.data.dataset import Dataset, load_dataset
from mgs.data.frames import Frame, has_masks
from mgs.data.structure import write_refined
from mgs.errors import InputError
from mgs.files import THERE, Ours, atomic_folder, read_leftover, read_text
from mgs.fit.density import GROWTH, split_times
from mgs.fit.settings import ALPHA_WEIGHT, MOST_OF_FIT, ModelSettings, TrainSettings, as_3dgs
from mgs.gaussians import MAX_SH_DEGREE, Gaussians
from mgs.learning import information, refine_poses, surface_information
from mgs.memory import VIEW_BYTES, check_room
from mgs.policy.poses import seed_views
from mgs.prior.build import Prior, build_prior, load_prior, save_prior
from mgs.prior.photographs import choose_source
from mgs.prior.points import has_points
from mgs.prior.settings import PriorSettings
from mgs.progress import Progress, listening
from mgs.run import recording
from mgs.run.flight import check_seeds
from mgs.run.folder import (
    DATASET,
    FILES,
    POLICY_SOURCE,
    UNFINISHED,
    Checkpoint,
    Run,
    holds_run,
    open_run,
    up_of_prior,
    write_config,
)
from mgs.run.live import Live, Transport, live_capture, write_live_dataset
from mgs.run.loop import first_views
from mgs.run.policies import POLICIES, Policy
from mgs.run.policy_file import code_of, in_file, is_function, label, name_of, policy_of
from mgs.run.settings import ENOUGH, NbvSettings, check_settings, validated
from mgs.run.worth import enough_views
from mgs.scene import Scene, State
from mgs.splat.constants import NEAR
from mgs.survey.fusion import focus

PIXEL_BYTES = 400  # peak memory of a fit for a pixel of its largest image; measured
# Passes of a fit of free means to all images: as many as give so many steps, within these limits.
FREE_STEPS, FREE_PASSES = 6000, (30, 60)  # chosen (docs/fit.md)

FREE_TRAIN = {"decay": 0.02, "tolerance": 0.0}
"""`TrainSettings` of such a fit: all passes, the last at low rates (docs/fit.md). Chosen."""

FREE_SH = {"points": 1, "hull": 1, "random": 0}  # `NbvSettings.sh` of such a fit (docs/fit.md)
LOOSE = {"points": 4.0, "hull": 4.0, "random": 40.0}  # factor on the prior stds of such a fit
WITHOUT_SURFACE = "farthest"  # default policy from random points (docs/results.md)

OnPass = Callable[[int, int, Gaussians], None]
"""on_pass(done, most, model), called after each pass of a fit."""


def run_nbv(
    dataset: str | Path | Dataset,
    out: str | Path,
    *,
    on_step: Callable[[Checkpoint], None] = lambda state: None,
    progress: Progress | None = None,
    **settings: Any,
) -> Run:
    """Choose views one by one, as the paper does; return the finished run. Does the same as `mgs
    nbv`, as in `run_nbv("demo/dataset", "run", policy="d-optimal", budget=8)`: `start_run`, then
    `resume_nbv`, with their arguments and errors."""
    run = start_run(dataset, out, progress=progress, **settings)
    return resume_nbv(run, on_step, progress, run.policy, settings.get("live"))


def nbv(
    scene: Scene,
    policy: str | Callable[..., Any] | None = None,
    *,
    out: str | Path,
    on_step: Callable[[Checkpoint], None] = lambda state: None,
    progress: Progress | None = None,
    **mission: Any,
) -> Run:
    """Choose views of a scene one by one, in a run folder `out`; return the finished run.

    policy: a name, an object, or a function; default as in `start_run`. mission: fields of
    `Mission`. `run_nbv` with the scene's dataset, prior and settings; the prior is copied into the
    run. Raises InputError as `start_run` and `resume_nbv`."""
    model = {name: getattr(scene.settings, name) for name in ModelSettings.model_fields}
    model |= {"prior": scene.prior, "policy": policy, "on_step": on_step, "progress": progress}
    return run_nbv(scene.dataset, out, **model, **mission)


def start_run(
    dataset: str | Path | Dataset,
    out: str | Path,
    *,
    live: Live | Transport | None = None,
    prior: str | Path | Prior | None = None,
    gaussians: int | Literal["auto"] | None = None,
    source: str | None = None,
    loose: float = 1.0,
    parts: float = 1.0,
    force: bool = False,
    progress: Progress | None = None,
    **settings: Any,
) -> Run:
    """Check all inputs, find or build the prior, and write config.json of a new run folder `out`.

    - live: takes the pictures of poses without an image: a `Live`, or a function(pose file, picture
      file) (docs/howto/on-site.md). They are kept in OUT/dataset.
    - prior: a folder, or a Prior, which is copied into the run. Default: DATASET/prior if it
      exists, else a prior of `gaussians` built in the run (default: as many as cameras resolve).
    - source: what a prior built in the run is made from (`mgs.prior.photographs.choose_source`).
      "random" reads no mask but those of the seeds; means are then free and the prior loose.
    - loose: as `NbvSettings.with_spacing`. parts: as `PriorSettings`, of a prior built in the run.
    - force: replace an existing run.
    - settings: fields of `NbvSettings`. `policy` may also be a function (docs/howto/policy.md),
      whose source is kept in the run. Its default from random points is WITHOUT_SURFACE. The
      default of `budget` is 50 views or all candidates; "auto" is the fewest views that have the
      share `enough` of the gain of all candidates by the policy's criterion, at the model before
      training. The default of `alpha_weight` is ALPHA_WEIGHT, or 0 if frames have neither mask nor
      alpha.

    Leaves no folder behind if it fails. Raises InputError if the folder is not empty, a setting is
    invalid, the dataset is too small, an input is missing or damaged, or the cameras are too near
    to the prior to draw it."""
    out = Path(out)
    if holds_run(out) and not force:
        raise InputError(f"{out}: a run {THERE}; `mgs nbv --resume {out}` continues it")
    root = dataset.root if isinstance(dataset, Dataset) else Path(dataset)
    prior = _place_of(root, prior, gaussians, source)
    folder = prior if isinstance(prior, Path) else None
    prior = load_prior(prior) if isinstance(prior, Path) else prior
    up = up_of_prior(folder) if folder else None
    if not isinstance(dataset, Dataset) or (up and not np.allclose(up, dataset.world.up)):
        dataset = load_dataset(root, to_capture=live is not None, up=up)
    _check_images(dataset, live is not None, settings)
    refine = bool(settings.get("refine_poses"))
    images = root if live is None and not refine else out / DATASET
    where = folder or out / "prior"
    if source == "random":
        settings["train"] = {"means": "free"} | dict(settings.get("train", {}))
        loose = LOOSE["random"]
    random = source == "random" or (prior is not None and prior.kind == "random")
    policy = settings.get("policy") or (WITHOUT_SURFACE if random else next(iter(POLICIES)))
    paths = {"dataset": images.resolve(), "prior": where.resolve()}
    mission = _settings(dataset, policy, settings | paths)
    rule = policy_of(policy)  # a user's policy fails here, before there is a folder
    check_settings(mission, len(dataset))
    ours = Ours(FILES, [path for path in (root, folder) if path]) if force else None
    with atomic_folder(out, ours) as unfinished, listening(progress):
        how = PriorSettings(gaussians=gaussians, seed=mission.seed, parts=parts)
        shown = _seed_frames(dataset, mission) if source == "random" else None
        prior = prior or build_prior(dataset.survey(), how, source=source, shown=shown)
        if folder is None:
            save_prior(unfinished / "prior", prior)
        _check_surface(prior, dataset, mission, where)
        mission = mission.with_spacing(prior.spacing, loose)
        if mission.flies or mission.flight.limits_poses:
            check_seeds(Scene(dataset, prior, mission), mission)
        if settings.get("budget") == "auto":
            mission = _automatic(Scene(dataset, prior, mission), mission, rule)
        if live is not None:
            write_live_dataset(unfinished / DATASET, dataset, prior)
        if refine:
            frames = refine_poses(Scene(dataset, prior, mission), mission.pose_noise)
            write_refined(unfinished / DATASET, dataset, frames)
        write_config(unfinished, mission, dataset)
        if not isinstance(policy, str):
            (unfinished / POLICY_SOURCE).write_text(code_of(policy), encoding="utf-8")
    return Run(out, mission, dataset if images == root else None, prior if folder else None, policy)


def _place_of(
    root: Path, prior: str | Path | Prior | None, gaussians: Any, source: str | None = None
) -> Prior | Path | None:
    """Prior given, or its folder, else DATASET/prior; None where it is to be built. Raises
    InputError where one is given and another to be built."""
    builds = [key for key, one in (("gaussians", gaussians), ("source", source)) if one is not None]
    if prior is not None and builds:
        raise InputError(f"nbv: `{builds[0]}` builds a prior; leave it out, or leave out `prior`")
    if prior is None and not builds and (root / "prior/prior.json").is_file():
        prior = root / "prior"
    return prior if prior is None or isinstance(prior, Prior) else Path(prior)


def _check_images(dataset: Dataset, live: bool, settings: dict[str, Any]) -> None:
    """Raises InputError where images lack that a run needs first, or none is to be captured, and
    where the largest need more memory in a fit than is free."""
    largest = max(dataset.cameras, key=lambda camera: camera.width * camera.height)
    width, height = largest.width, largest.height
    what = f"{dataset.root}: fitting images of {width}x{height}"
    check_room(width * height * PIXEL_BYTES, what, "import them smaller (`downscale`)")
    if live and not dataset.on_demand:
        raise InputError(f"{dataset.root}: all its images exist; leave out live capture")
    if settings.get("refine_poses") and dataset.on_demand:
        raise InputError(f"{dataset.root}: has poses without images, which cannot be refined")
    if settings.get("budget") == "auto" and live:
        raise InputError("budget auto: needs the images of the seeds; give a number")


def _seed_frames(dataset: Dataset, mission: NbvSettings) -> list[Frame]:
    """Frames of the seeds of a run from random points, the only ones whose masks exist by then."""
    if mission.flies or mission.flight.limits_poses:
        raise InputError("nbv: limits of a flight need a surface, which a random start lacks")
    positions = np.stack([camera.position for camera in dataset.cameras])
    if mission.seeds == len(dataset):
        return list(dataset.frames)
    seeds = seed_views(positions, focus(dataset.frames).point, mission.seeds)
    return [dataset.frames[i] for i in seeds]


@dataclass(frozen=True)
class FitStart:
    """What decides the start of a fit to all images, as arguments of `start_run`."""

    source: str | None
    train: dict[str, Any]
    sh: int
    loose: float = 1.0
    parts: float = 1.0


def start_fit(
    dataset: str | Path,
    out: str | Path,
    *,
    prior: str | Path | Prior | None = None,
    gaussians: int | Literal["auto"] | None = None,
    progress: Progress | None = None,
    **settings: Any,
) -> Run:
    """`start_run` of a run that takes all images at once and chooses none, from `start_of_fit`.
    Arguments and errors as `start_run`."""
    if own := {"source", "loose", "parts", "live"} & set(settings):
        raise InputError(f"fit: {min(own)} is for start_run; leave it out")
    data = load_dataset(dataset)
    start = start_of_fit(data, prior, gaussians, dict(settings.pop("train", {})))
    every = vars(start) | settings | {"seeds": len(data), "budget": 0}
    return start_run(data, out, prior=prior, gaussians=gaussians, progress=progress, **every)


def start_of_fit(data: Dataset, prior: Any, gaussians: Any, train: dict[str, Any]) -> FitStart:
    """Start of a fit to all images. train: settings given. Others, and errors, as `start_fit`.

    By default means are free where the prior comes from photographs (`LOOSE`), with FREE_TRAIN,
    colours of degree FREE_SH and a looser prior, else frozen. With adaptive density, settings and
    degree are by default those of 3DGS (`as_3dgs`). Photographs without masks are fitted whole,
    from `has_points` and random ones, unless a prior is given: a surface of the object cannot
    explain what is around it. Gaussians of a prior from photographs that is
    built in the run are split where images need more: those of a whole scene unless their number is
    given, those of an object into that number."""
    existing, sh, parts = _place_of(data.root, prior, gaussians), 0, 1.0
    passes = {"passes": int(np.clip(FREE_STEPS // len(data), *FREE_PASSES))}
    if isinstance(existing, Path):  # which `start_run` loads
        numbers = read_leftover(existing / "prior.json")
        kind = str(numbers.get("from", "")) if isinstance(numbers, dict) else ""
    else:
        kind = existing.kind if existing else choose_source(data.survey())
    bare = prior is None and kind in ("points", "depth") and not has_masks(data.frames)
    whole = bare and has_points(data)
    source = "random" if whole and train.get("means", "free") == "free" else None
    kind = source or kind
    if train.get("density") == "adaptive":
        recipe = as_3dgs(extent_of([frame.camera for frame in data.frames]))
        rates = recipe["rates"] | train.get("rates", {})
        train, sh = passes | recipe | train | {"rates": rates}, MAX_SH_DEGREE
    train.setdefault("means", "free" if kind in LOOSE else "frozen")
    if train["means"] != "free" or kind not in LOOSE:
        return FitStart(source, train, sh)
    train, of_object = passes | FREE_TRAIN | train, kind != "random" and existing is None
    few = kind == "random" and has_points(data) and not isinstance(gaussians, int)
    if of_object or few:
        train.setdefault("density", "split")
    if of_object and train["density"] == "split":
        if isinstance(train["passes"], int):  # otherwise `validated` refuses it
            parts = (1 + GROWTH) ** len(split_times(train["passes"]))
        if isinstance(gaussians, int):
            train.setdefault("most_gaussians", min(gaussians, MOST_OF_FIT))
    return FitStart(source, train, sh or FREE_SH[kind], LOOSE[kind], parts)


def _settings(dataset: Dataset, policy: Any, values: dict[str, Any]) -> NbvSettings:
    """Settings of a run with the defaults that depend on the dataset, and the fit's seed."""
    known = isinstance(policy, str) or callable(policy)
    values = values | {"policy": name_of(policy) if known else policy}
    if values.get("budget") == "auto":
        values["budget"] = 1
    train = values.get("train", {})
    train = train.model_dump(exclude_unset=True) if isinstance(train, TrainSettings) else train
    if isinstance(train, Mapping):  # otherwise `validated` refuses it
        weight = ALPHA_WEIGHT if has_masks(dataset.frames) else 0.0
        values["train"] = {"alpha_weight": weight, **train}
    settings = validated(NbvSettings, values)
    resolved: dict[str, Any] = {}
    if "seed" not in settings.train.model_fields_set:
        resolved["train"] = settings.train.model_copy(update={"seed": settings.seed})
    if "budget" not in values:
        resolved["budget"] = min(settings.budget, max(0, len(dataset) - settings.seeds))
    return settings.model_copy(update=resolved)


def _automatic(scene: Scene, settings: NbvSettings, policy: Policy) -> NbvSettings:
    """The settings with the budget of `enough_views`, by the Gaussians before training."""
    seeds, frames = first_views(scene, settings)
    shown = tuple(frames[i] for i in seeds)
    model = scene.start(shown)
    H = information(scene, model, shown)
    state = State(frames, tuple(seeds), len(seeds), model, H, H)
    state = replace(state, surface=surface_information(scene, state, seeds))
    budget = enough_views(scene, state, policy, settings)
    return settings.model_copy(update={"budget": budget, "enough": settings.enough or ENOUGH})


def _check_surface(prior: Prior, dataset: Dataset, settings: NbvSettings, where: Path) -> None:
    """Raises InputError where most cameras are nearer than NEAR, or the start is unusable."""
    positions = np.stack([frame.camera.position for frame in dataset.frames])
    nearest = float(np.median(cKDTree(prior.points).query(positions)[0]))
    if nearest < NEAR:
        near = f"the cameras are {nearest:.2g} from it, and nothing nearer than {NEAR} is drawn"
        unit = "import the data with `unit`, the metres in a length of 1, and build the prior again"
        raise InputError(f"{where}: {near}; {unit}")
    if prior.kind == "random" and settings.train.means != "free":
        free = "let means be free (`train.means`), or give depth, points or masks"
        raise InputError(f"{where}: starts at random points, not on a surface; {free}")
    if settings.exposure and prior.numbers.get("triangulated") == 0:
        lacks = "has no surface on which to compare photographs"
        raise InputError(f"exposure: {where} {lacks}; leave it out, or give points or masks")


def resume_nbv(
    run: str | Path | Run,
    on_step: Callable[[Checkpoint], None] = lambda state: None,
    progress: Progress | None = None,
    policy: str | Callable[..., Any] | None = None,
    live: Live | Transport | None = None,
    on_pass: OnPass = lambda done, most, model: None,
    like: Scene | None = None,
) -> Run:
    """Continue a run from its last finished step to its end; return it, with its state.

    - on_step: called as on_step(state) after every finished step, or batch of steps, on disk.
    - progress: called as progress(stage, done, total) during a step; by default what listens
      already, as `mgs.progress_bar` does.
    - policy: FILE.py:FUNCTION, or the Python function, if the policy is your own. Code is never
      taken from the folder. A Run that was started in this process knows its policy.
    - live: as in `start_run`; give it again if pictures are still to be captured. If no pose was
      left, those that were given up are asked for again.
    - on_pass: called as on_pass(done, most, model) after each pass of a fit; the model has Dr.Jit
      fields.
    - like: as in `scene_of`; `on_pass` is then the scene's own.

    A finished run is returned as it is. Raises InputError if the folder holds no run, its inputs
    are missing or changed, another process works on it, a fit diverged, or `policy` is not the
    run's."""
    run = open_run(run)
    policy = policy or run.policy
    check_named(run, policy)
    live = live if live is None or isinstance(live, Live) else Live(live)
    scores = None if policy is None else policy_of(policy)
    scene, retry = scene_of(run, live, like), bool(live)
    if scene is not like:
        scene = replace(scene, on_pass=on_pass, unfinished=run.folder / UNFINISHED)
    state = recording.run(
        run.folder, run.settings, scene, scores, on_step=on_step, progress=progress, retry=retry
    )
    dataset = None if run.dataset.on_demand else run.dataset  # captured poses are in its files
    return Run(run.folder, run.settings, dataset, run.prior, policy, state)


def check_named(run: Run, policy: str | Callable[..., Any] | None) -> None:
    """Raises InputError where a run's policy is a user's own and `policy` is not the same."""
    own = run.settings.policy
    if policy is not None and name_of(policy) != own:
        raise InputError(f"policy {name_of(policy)}: is not the policy of {run.folder}, {own}")
    if is_function(own):
        call = f"mgs.resume_nbv({str(run.folder)!r}, policy={label(own)})"
        if policy is None or isinstance(policy, str):
            raise InputError(f"{run.folder}: its policy is a Python function; in Python: {call}")
        file = run.folder / POLICY_SOURCE
        if read_text(file) != code_of(policy):
            raise InputError(f"policy {label(own)}: is not as {file} has it; restore it")
    if in_file(own) and policy is None:
        resume = f"`mgs nbv --resume {run.folder} --policy {own}`"
        raise InputError(f"{run.folder}: its policy is a program, {own}; to run it: {resume}")


def scene_of(run: Run, live: Live | None = None, like: Scene | None = None) -> Scene:
    """Scene of a run, with its settings. live: how images are captured that are not rendered.
    like: scene of another run; returned, with all that it has computed, if the settings of the two
    runs differ only in the policy and all images exist."""
    settings, dataset = run.settings, run.dataset
    if like is not None and not dataset.on_demand:
        one, other = (each.model_dump(exclude={"policy"}) for each in (settings, like.settings))
        if one == other:
            return like
    keep = VIEW_BYTES if settings.batch > 1 or settings.flies else 0
    scene = Scene(dataset, run.prior, settings, keep=keep)
    if not dataset.on_demand:
        return scene
    if not (dataset.root / "config.json").is_file():
        return replace(scene, capture=live_capture(dataset, run.prior, live))
    runtime.start()
    from mgs.synth.capture import capture_of  # needs a variant, and only rendered datasets need it

    return replace(scene, capture=capture_of(dataset))
