"""`mgs nbv`: choose views one by one, as the paper does."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_type_hints

import typer

from mgs.cli.options import argument, option
from mgs.errors import FLAGS, flag
from mgs.fit.settings import TrainSettings
from mgs.policy.from_file import in_file
from mgs.policy.registry import policy_names
from mgs.run.settings import PRESETS, NbvSettings, settings_in

if TYPE_CHECKING:
    from mgs.cli.terminal import Terminal
    from mgs.run.folder import Run
    from mgs.run.live import Live
    from mgs.run.state import State

PANELS = {
    "Main options": ("policy", "budget", "seeds"),
    "Choosing": ("batch", "nearest", "travel", "stop_gain", "stop_uncertainty", "stop_psnr"),
    "Flight": ("flight_length", "flight_time", "speed", "hover", "no_fly", "clearance"),
    "Fitting": (
        *("passes", "warm_passes", "means", "sh", "exposure", "antialiased", "alpha_weight"),
        *("optimiser", "rates"),
    ),
    "Advanced": ("estimator", "lam", "pixel_noise", "prior_std", "evaluate_every", "seed"),
}
"""Settings with an option of the same name (`rates`: --rate), by panel of the help."""

METAVARS = {
    "batch": "K",
    "travel": "METRES",
    "flight_length": "METRES",
    "flight_time": "SECONDS",
    "speed": "M/S",
    "hover": "SECONDS",
    "no_fly": "METRES",
    "clearance": "METRES",
    "stop_gain": "GAIN",
    "stop_uncertainty": "SHARE",
    "stop_psnr": "DB",
    "alpha_weight": "WEIGHT",
    "rates": "KIND=NUMBER",
    "prior_std": "KIND=NUMBER",
}

MORE_HELP = {
    "policy": f" Names (docs/nbv.md): {', '.join(policy_names())}.",
    "alpha_weight": " Default: 0.1, or 0 where frames have neither mask nor alpha.",
}

main = partial(option, rich_help_panel="Main options")
data = partial(option, rich_help_panel="Data")
capturing = partial(option, rich_help_panel="Live capture")


def nbv(
    context: typer.Context,
    dataset: Annotated[
        Path | None, argument("Dataset folder (transforms.json). Not needed with --resume.")
    ] = None,
    out: Annotated[Path | None, main("New folder for the run.")] = None,
    prior: Annotated[
        Path | None, main("Folder of `mgs prior`. Default: DATASET/prior, or one built in the run.")
    ] = None,
    resume: Annotated[
        Path | None,
        main(
            "Continue this run with the settings of its config.json. Give --policy FILE.py and "
            "--capture-... options again.",
            metavar="RUN",
        ),
    ] = None,
    capture: Annotated[
        str | None,
        data(
            "Scene (name or .toml) in place of DATASET; each view is rendered when it is chosen.",
            metavar="SCENE",
        ),
    ] = None,
    config: Annotated[
        Path | None,
        main(
            "File of settings with the keys of config.json, or a run's config.json. "
            "Options override it.",
            metavar="FILE.toml",
        ),
    ] = None,
    capture_command: Annotated[
        str | None,
        capturing(
            "Program that takes a picture: 'CMD {pose} {out}' reads a JSON file, writes a PNG.",
            metavar="COMMAND",
        ),
    ] = None,
    capture_folder: Annotated[
        Path | None,
        capturing("Folder to which poses are written; pictures are awaited there."),
    ] = None,
    capture_timeout: Annotated[
        float, capturing("Longest wait for a picture, seconds.", min=0.01)
    ] = 600.0,
    capture_tries: Annotated[int, capturing("Most attempts at a pose.", min=1)] = 3,
    capture_failure: Annotated[
        str,
        capturing(
            "After the last attempt: choose the next best pose in its place, or stop the run.",
            metavar="skip|stop",
        ),
    ] = "skip",
    capture_distance: Annotated[
        float | None,
        capturing(
            "Largest distance of a picture from its pose, in the dataset's unit. "
            "Default: a quarter of the distance to the object.",
            min=0.0,
        ),
    ] = None,
    gaussians: Annotated[
        str | None,
        data("Build a prior of this many Gaussians in the run folder.", metavar="N|auto"),
    ] = None,
    preset: Annotated[
        str | None,
        option(
            f"Defaults for passes and the number of Gaussians: {', '.join(PRESETS)}.",
            rich_help_panel="Fitting",
        ),
    ] = None,
    force: Annotated[bool, main("Replace an existing run.", "--force")] = False,
    tensorboard: Annotated[
        bool,
        typer.Option(
            "--tensorboard", help="Also log to RUN/tensorboard.", rich_help_panel="Main options"
        ),
    ] = False,
    **options: Any,
) -> None:
    """Choose the next best views: fit to a few seed views, choose a view, read its image, fit
    again.

    Ends when the budget is spent, or earlier by a --stop option or a limit of the flight. Writes
    config.json, steps.jsonl (a line for each view), checkpoint.npz, gaussians.ply and metrics.json
    into the run folder. An interrupted run continues with --resume and chooses the same views.
    """
    from mgs.cli.options import parse_gaussians
    from mgs.cli.terminal import Terminal
    from mgs.errors import InputError
    from mgs.run.folder import open_run

    if tensorboard:
        import tensorboardX  # noqa: F401  # its absence is known before the work
    console = Terminal()
    given = {name: options[name] for name in options if options[name] not in (None, [])}
    live = live_capture(
        capture_command,
        capture_folder,
        capture_timeout,
        tries=capture_tries,
        failure=capture_failure,
        distance=capture_distance,
    )
    if resume is not None:
        refuse_others(context, resume)
        logged = _logged(open_run(resume), tensorboard)
        resume_and_print(resume, console, given.get("policy"), live=live, on_state=logged)
        return
    settings: dict[str, Any] = settings_in(config) if config else {}
    own = settings.get("policy", "")
    if in_file(own) and "policy" not in given:
        raise InputError(f"{config}: its policy is a program, {own}; to run it, add --policy {own}")
    dataset = dataset or (None if capture else settings.get("dataset"))
    if gaussians is None:
        prior = prior or settings.get("prior")
    train = dict(settings.get("train", {}))
    if (dataset is None) == (capture is None) or out is None:
        raise InputError("nbv: give a DATASET or --capture SCENE, and --out RUN; or --resume RUN")
    settings = {k: v for k, v in settings.items() if k not in ("dataset", "prior", "train")}
    settings |= settings_of(given, train)
    run = start_and_print(
        dataset,
        out,
        console,
        capture=capture,
        live=live,
        prior=prior,
        gaussians=parse_gaussians(gaussians),
        preset=preset,
        force=force,
        **settings,
    )
    logged = _logged(run, tensorboard)
    resume_and_print(run, console, run.settings.policy, live=live, on_state=logged)


def _logged(run: Run, wanted: bool) -> Callable[[State], None]:
    """Callback that logs steps to RUN/tensorboard, or does nothing."""
    from mgs.files import below
    from mgs.run import tensorboard

    if not wanted:
        return lambda state: None
    return tensorboard.tensorboard(below(run.folder, "tensorboard"), run.dataset)


def live_capture(
    command: str | None, folder: Path | None, timeout: float, **rest: Any
) -> Live | None:
    """`Live` of the options of a live capture, None without one. Raises InputError as `command`,
    and where options do not go together."""
    from mgs.errors import InputError
    from mgs.files import check_writable
    from mgs.run import transports
    from mgs.run.live import Live

    if rest["failure"] not in ("skip", "stop"):
        raise InputError(f"--capture-failure {rest['failure']}: choose skip or stop")
    if command is not None and folder is not None:
        raise InputError("nbv: give either --capture-command or --capture-folder")
    if command is not None:
        return Live(transports.command(command, timeout), **rest)
    if folder is not None:
        return Live(transports.watched(timeout), check_writable(folder), **rest)
    return None


def settings_of(given: dict[str, Any], fit: dict[str, Any] | None = None) -> dict[str, Any]:
    """Fields of `NbvSettings` from options; those of a fit, added to `fit`, under `train`."""
    settings, train = dict[str, Any](), dict(fit or {})
    for name, value in given.items():
        where = train if name in TrainSettings.model_fields and name != "seed" else settings
        where[name] = pairs(name, value) if isinstance(value, list) else value
    return settings | {"train": train}


def with_settings_as_options(
    function: Any,
    panels: dict[str, tuple[str, ...]] = PANELS,
    more_help: dict[str, str] = MORE_HELP,
) -> Any:
    """Give a command an option for each setting in `panels`, passed as `**options`."""
    signature = inspect.signature(function, eval_str=True)
    parameters = [p for p in signature.parameters.values() if p.kind is not p.VAR_KEYWORD]
    for panel, names in panels.items():
        parameters += [_option(name, panel, more_help.get(name, "")) for name in names]
    function.__signature__ = signature.replace(parameters=parameters)
    function.__annotations__ = {p.name: p.annotation for p in parameters}
    return function


def _option(name: str, panel: str, more_help: str) -> inspect.Parameter:
    """The option of a setting: type, help and default from its model."""
    model = NbvSettings if name in NbvSettings.model_fields else TrainSettings
    hint, field = get_type_hints(model)[name], model.model_fields[name]
    kind = next((part for part in get_args(hint) if part in (int, float, str)), hint)
    kind = {int: int, float: float, bool: bool, dict[str, float]: list[str]}.get(kind, str)
    text, default = (field.description or "") + more_help, field.default
    if isinstance(default, dict):
        kind, default = list[str], ", ".join(f"{k}={v:g}" for k, v in default.items())
    if default is not None and not isinstance(default, bool) and "Default:" not in text:
        text += f" Default: {default}."
    flags = [FLAGS[name]] if name in FLAGS else []
    if kind is bool:
        flags = [f"{flag(name)}/--no-{name}" if default else flag(name)]
    option = typer.Option(
        *flags, metavar=METAVARS.get(name), help=text, rich_help_panel=panel, show_default=False
    )
    annotation: Any = Annotated[kind | None, option]  # type: ignore[valid-type]
    return inspect.Parameter(
        name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation
    )


with_settings_as_options(nbv)


def refuse_others(context: typer.Context, resume: Path) -> None:
    """Raises InputError where an option is given beside --resume."""
    from mgs.errors import InputError

    for name in context.params:
        source = context.get_parameter_source(name)
        again = name in ("resume", "policy", "tensorboard") or name.startswith("capture_")
        if again or source is None or source.name != "COMMANDLINE":
            continue
        option = flag(name)
        where = f"--resume takes its settings from {resume / 'config.json'}; change it there"
        raise InputError(f"nbv: {'DATASET' if name == 'dataset' else option}: {where}")


def pairs(name: str, given: list[str]) -> dict[str, float]:
    """Parse `KIND=NUMBER` options. Raises InputError for one that is not of this form."""
    from mgs.errors import InputError

    option, table = flag(name), {}
    for text in given:
        kind, _, number = text.partition("=")
        try:
            table[kind] = float(number)
        except ValueError:
            form = f"expected KIND=NUMBER, as in {option} colour=0.01"
            raise InputError(f"{option} {text}: {form}") from None
    return table


def start_and_print(
    dataset: Path | None,
    out: Path,
    console: Terminal,
    start: Callable[..., Run] | None = None,
    **settings: Any,
) -> Run:
    """`mgs.run.nbv.start_run`, or another start, with its progress; print which prior was found in
    the dataset."""
    from mgs.cli.progress import progress_bar
    from mgs.run.nbv import problem_of, start_run

    with progress_bar("starting", console) as progress:
        run = (start or start_run)(dataset, out, progress=progress, **settings)
    found = run.settings.prior
    if settings.get("prior") is None and dataset and found.parent == dataset.resolve():
        console.print(f"prior: {found}", soft_wrap=True)
    if run.settings.no_fly or run.settings.clearance is not None:
        allowed = problem_of(run, policy=run.settings.policy).allowed
        where = f"of {len(allowed)} poses are ruled out by --no-fly and --clearance"
        console.print(f"{len(allowed) - allowed.sum()} {where}")
    return run


def resume_and_print(
    run: Path | Run,
    console: Terminal,
    policy: str | None = None,
    pictures: bool = False,
    live: Live | None = None,
    on_state: Callable[[State], None] = lambda state: None,
) -> None:
    """Run or resume the loop of a run, evaluate (with pictures where asked), print the table of
    steps; where the output is no terminal, a line after each step instead.

    policy: FILE.py:FUNCTION where the run has a policy of the user's own. live: of its pictures.
    on_state: called with every state that is on disk.
    """
    from functools import partial

    from mgs.cli.printing import print_run, step_line
    from mgs.cli.progress import progress_bar
    from mgs.report.evaluation import evaluate_run
    from mgs.run.folder import Run, open_run
    from mgs.run.nbv import resume_nbv

    run = run if isinstance(run, Run) else open_run(run)
    total, known = run.settings.seeds + run.settings.budget, list[dict[str, Any]]()
    with progress_bar("reading", console) as progress:

        def on_step(state: State) -> None:
            on_state(state)
            progress.whole(f"{run.folder.name}: images", len(state.taken), total)
            new = state.steps[len(known) :]
            known.extend(new)
            for line in new:
                if not console.is_terminal:
                    progress.print(step_line(line))
                for warning in line.get("warnings", []):
                    progress.print(f"step {line['step']}: {warning}")

        state = resume_nbv(run, on_step, progress, policy, live).state
        metrics = evaluate_run(
            run.folder, pictures=pictures, progress=partial(progress, "evaluating")
        )
    print_run(run.folder, state, metrics, console)
