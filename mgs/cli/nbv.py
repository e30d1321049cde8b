"""`mgs nbv`: choose views one by one, as the paper does. `mgs fit`: fit a model to all images."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from pydantic import Field

from mgs.cli.options import (
    Settings,
    merged,
    not_none,
    parse_gaussians,
    parse_settings,
    refuse_unused,
    with_keys,
)
from mgs.cli.terminal import Terminal, progress_bar
from mgs.errors import InputError
from mgs.files import check_writable
from mgs.fit.settings import Frozen
from mgs.run.policies import POLICIES
from mgs.run.policy_file import in_file
from mgs.run.settings import NbvSettings, Positive, settings_in, validated

if TYPE_CHECKING:
    from mgs.gaussians import Gaussians
    from mgs.run.folder import Checkpoint, Run
    from mgs.run.live import Live
    from mgs.scene import Scene

NAMES = f"""Names (docs/nbv.md): {", ".join(POLICIES)}.
Of views at one distance and in reach, cover and farthest choose as well to 0.1 and 0.2 dB."""


class Capture(Frozen):
    """Settings of live capture, given again when a run is resumed."""

    timeout: Positive = 600.0
    """Longest wait for a picture, seconds."""
    tries: Annotated[int, Field(ge=1)] = 3
    """Most attempts at a pose."""
    failure: Literal["skip", "stop"] = "skip"
    """After the last attempt: skip (choose the next best pose in its place), or stop the run."""
    distance: Annotated[float, Field(ge=0, allow_inf_nan=False)] | None = None
    """Largest distance of a picture from its pose, in the dataset's unit. Default: a quarter of the
    distance to the object."""


class _Keys(NbvSettings):
    capture: Capture = Capture()


@with_keys(_Keys)
def nbv(
    dataset: Annotated[Path | None, typer.Argument()] = None,
    out: Path | None = None,
    prior: Path | None = None,
    gaussians: str | None = None,
    source: str | None = None,
    policy: Annotated[str | None, typer.Option(help=NAMES)] = None,
    budget: str | None = None,
    seeds: int | None = None,
    batch: int | None = None,
    seed: int | None = None,
    resume: Path | None = None,
    capture_command: str | None = None,
    capture_folder: Path | None = None,
    settings: Settings = None,
    config: Path | None = None,
    force: bool = False,
) -> None:
    """Choose the next best views: fit to a few seed views, choose a view, read its image, fit
    again.

    Ends when the budget is spent, or earlier by a `stop_` setting or a limit of the flight. Writes
    config.json, steps.jsonl (a line for each view), checkpoint.npz, gaussians.ply and metrics.json
    into the run folder. An interrupted run continues with --resume and chooses the same views.

    - dataset: Dataset folder (transforms.json). Not needed with --resume.
    - out: New folder for the run.
    - source: Source of a prior built in the run, as of `mgs prior`; random: random points with free
      means, and no mask is read but those of views taken.
    - budget N|auto: auto: as few as have the share `enough` of the gain of all candidates.
    - resume RUN: Continue this run with the settings of its config.json. Give --policy FILE.py and
      options of live capture again.
    - capture_command COMMAND: Program that takes a picture: 'CMD {pose} {out}' reads a JSON file,
      writes a PNG.
    - capture_folder: Folder to which poses are written; pictures are awaited there."""
    console = Terminal()
    values = parse_settings(settings, nbv)
    if budget != "auto":
        refuse_unused("without --budget auto", **{"set enough": values.get("enough")})
    live = live_from(capture_command, capture_folder, values.pop("capture", {}))
    own = not_none(budget=budget, seeds=seeds, batch=batch, seed=seed)
    if resume is not None:
        others = not_none(dataset=dataset, out=out, prior=prior, gaussians=gaussians, source=source)
        others |= not_none(config=config, force=force or None)
        for name in others | own | values:
            where = f"--resume takes its settings from {resume / 'config.json'}; change it there"
            raise InputError(f"nbv: {name}: {where}")
        resume_and_print(resume, console, policy=policy, live=live)
        return
    recorded = settings_in(config) if config else {}
    rule = recorded.get("policy", "")
    if in_file(rule) and policy is None:
        program = f"its policy is a program, {rule}"
        raise InputError(f"{config}: {program}; to run it, add --policy {rule}")
    values = merged(recorded, values) | not_none(policy=policy) | own
    dataset = dataset or values.get("dataset")
    if gaussians is None and source is None:
        prior = prior or values.get("prior")
    if dataset is None or out is None:
        raise InputError("nbv: give a DATASET and --out RUN; or --resume RUN")
    values |= {"prior": prior, "gaussians": parse_gaussians(gaussians), "source": source}
    values.pop("dataset", None)
    run = start_and_print(dataset, out, console, live=live, force=force, **values)
    resume_and_print(run, console, policy=run.settings.policy, live=live)


PASSES_BETWEEN = 5  # passes of a fit to all images between two pictures of a test view


def live_from(command: str | None, folder: Path | None, values: dict[str, Any]) -> Live | None:
    """`Live` of the options of a live capture, None without one. Raises InputError as `command`,
    and where options are wrong or do not go together."""
    from mgs.run import live

    rest = validated(Capture, values, within="capture").model_dump()
    timeout = rest.pop("timeout")
    if command is not None and folder is not None:
        raise InputError("nbv: give either --capture-command or --capture-folder")
    if command is not None:
        return live.Live(live.command(command, timeout), **rest)
    if folder is not None:
        return live.Live(live.watched(timeout), check_writable(folder), **rest)
    return None


def start_and_print(
    dataset: Path,
    out: Path,
    console: Terminal,
    start: Callable[..., Run] | None = None,
    **settings: Any,
) -> Run:
    """`mgs.run.nbv.start_run`, or another start, with its progress; say whether the dataset's own
    prior is used."""
    from mgs.run.flight import allowed
    from mgs.run.nbv import scene_of, start_run

    with progress_bar("starting", console) as progress:
        run = (start or start_run)(dataset, out, progress=progress, **settings)
    own = (dataset / "prior").resolve()
    if settings.get("prior") is None and (own / "prior.json").is_file():
        unused = "" if own == run.settings.prior else f"built in the run; not used: {own}"
        console.print(f"prior: {unused or own}", soft_wrap=True)
    if run.settings.flight.limits_poses:
        may = allowed(scene_of(run), run.settings)
        where = f"of {len(may)} poses are ruled out by flight.no_fly and flight.clearance"
        console.print(f"{len(may) - may.sum()} {where}")
    return run


def resume_and_print(
    run: Path | Run,
    console: Terminal,
    policy: str | None = None,
    live: Live | None = None,
    like: Scene | None = None,
) -> None:
    """Run or resume the loop of a run with a line for each step, evaluate, print the quality.

    policy: FILE.py:FUNCTION where the run has a policy of the user's own. live: of its pictures.
    like: as in `mgs.run.nbv.scene_of`."""
    from mgs.cli.terminal import print_run, step_lines
    from mgs.reports.evaluation import drawn_test_view, evaluate_run
    from mgs.run.folder import open_run
    from mgs.run.nbv import resume_nbv

    run = open_run(run)
    total, steps = run.settings.seeds + run.settings.budget, list[dict[str, Any]]()
    with progress_bar("reading", console) as progress:

        def on_step(state: Checkpoint) -> None:
            progress.whole(f"{run.folder.name}: images", len(state.taken), total)
            new = state.steps[len(steps) :]
            steps.extend(new)
            of_fit = run.settings.budget == 0
            for line in [line for step in new for line in step_lines(step, of_fit)]:
                progress.print(line)

        def on_pass(done: int, most: int, model: Gaussians) -> None:
            if run.settings.budget == 0 and (done == 1 or done % PASSES_BETWEEN == 0):
                path, psnr = drawn_test_view(run, model)
                progress.print(f"pass {done} of {most}: {psnr:.2f} dB, {path}")

        state = resume_nbv(run, on_step, progress, policy, live, on_pass, like).state
        metrics = evaluate_run(run.folder, pictures=False)
    print_run(run.folder, state, metrics, console)


@with_keys(
    NbvSettings,
    *("train", "sh", "exposure", "pixel_noise", "prior_std", "seed", "refine_poses", "pose_noise"),
)
def fit(
    dataset: Path,
    out: Annotated[Path, typer.Option()],
    prior: Path | None = None,
    gaussians: str | None = None,
    passes: int | None = None,
    means: str | None = None,
    sh: int | None = None,
    density: str | None = None,
    loss: str | None = None,
    exposure: bool | None = None,
    refine_poses: bool | None = None,
    seed: int | None = None,
    settings: Settings = None,
    force: bool = False,
) -> None:
    """Fit a model to all images of a dataset, and measure it.

    By default means are free if the prior comes from photographs (points, masks or random), and
    colours have SH degree 1 if it comes from points or masks. Otherwise means are frozen and
    colours have degree 0. Photographs without masks are fitted whole, unless --prior is given. Test
    views are never fitted. The output is a run folder like that of `mgs nbv`, so all commands for
    runs accept it.

    Of photographs with free means, train.decay is 0.02 and train.tolerance 0 by default, and
    prior_std is 4 times as in the table, with random points 40 times.

    - out: New folder for the run.
    - passes: Default: 60 with adaptive density or free means from photographs (of more than 100
      images fewer, 30 at least), else 10.
    - means: Default: free from photographs or with adaptive density, else frozen.
    - sh: Default: 3 with adaptive density, 1 with free means from photographs, else 0.
    - density: The defaults of adaptive are those of 3DGS. Default: split of photographs without a
      prior (of whole scenes without --gaussians), else fixed.
    - prior: Folder of `mgs prior`. Default: DATASET/prior, or one built in the run. Without masks,
      a prior from points is used only if it is given here.
    - gaussians N|auto: Gaussians of a prior built in the run. Photographs of an object start with a
      fifth of them, and are split up to about this number."""
    from mgs.run.nbv import start_fit

    console = Terminal()
    train = not_none(passes=passes, means=means, density=density, loss=loss)
    options = not_none(sh=sh, exposure=exposure, seed=seed, refine_poses=refine_poses)
    values = merged(parse_settings(settings, fit), options | {"train": train})
    values |= {"prior": prior, "gaussians": parse_gaussians(gaussians), "force": force}
    run = start_and_print(dataset, out, console, start_fit, **values)
    if run.poses_moved:
        console.print(moves_in_words(run.poses_moved, run.dataset.unit))
    if prior is None and (seen := run.prior.numbers.get("triangulated")) is not None:
        others = len(run.prior.points) - seen
        console.print(f"start: {seen:,} points of the cameras and {others:,} random ones")
    resume_and_print(run, console, policy=run.settings.policy)


def moves_in_words(moves: dict[str, dict[str, float]], unit: str) -> str:
    """Format the mean and largest move of poses. moves: by frame, degrees and length."""
    name = max(moves, key=lambda one: moves[one]["degrees"])
    degrees = sum(move["degrees"] for move in moves.values()) / len(moves)
    length = sum(move["length"] for move in moves.values()) / len(moves)
    most = f"{name} most: {moves[name]['degrees']:.2f} and {moves[name]['length']:.3g}"
    return f"poses moved {degrees:.2f} degrees and {length:.3g} {unit} in the mean, {most}"
