"""`mgs nbv`: choose views one by one, as the paper does."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mgs.policies import PIXEL_NOISE, policy_names

if TYPE_CHECKING:
    from rich.console import Console

    from mgs.nbv import State
    from mgs.train import TrainSettings

DIGITS = {"psnr": 2, "ssim": 4, "psnr_mask": 2, "ssim_mask": 4}
"""Decimals of the qualities that are printed."""


def nbv(
    dataset: Annotated[Path | None, typer.Argument(help="Dataset folder (transforms.json). Not needed with --resume.")] = None,
    out: Annotated[Path | None, typer.Option(help="New folder for the run.")] = None,
    prior: Annotated[
        Path | None,
        typer.Option(help="Folder of `mgs prior`; default DATASET/prior, or built inside the run where there is none."),
    ] = None,
    gaussians: Annotated[int | None, typer.Option(help="Build a prior of this many Gaussians inside the run.")] = None,
    policy: Annotated[str, typer.Option(help=f"One of {', '.join(policy_names())}.")] = "d-optimal",
    budget: Annotated[
        int | None, typer.Option(help="Views chosen beyond the seeds; default 50, or all candidates where they are fewer.")
    ] = None,
    seeds: Annotated[int, typer.Option(help="Views at evenly spaced azimuths that start the model.")] = 4,
    seed: Annotated[int, typer.Option(min=0, help="Root of every random draw.")] = 0,
    pixel_noise: Annotated[
        float, typer.Option(help="Residual of a pixel, linear RGB: sets lambda of every criterion.")
    ] = PIXEL_NOISE,
    passes: Annotated[int | None, typer.Option(help="Most passes over the images of one fit.")] = None,
    evaluate_every: Annotated[int, typer.Option(help="Measure PSNR on all views every so many steps; 0: only at the end.")] = 0,
    resume: Annotated[
        Path | None, typer.Option(help="Continue this run; every other setting comes from its config.json.")
    ] = None,
) -> None:
    """Fit to the seeds, then choose, capture and fit again, view by view, until the budget is spent.

    Writes config.json, steps.jsonl (one line a step), checkpoint.npz, gaussians.ply and metrics.json into the run folder. A run
    that was interrupted at any moment, kill -9 included, goes on with --resume and takes the same views.
    """
    from rich.console import Console

    from mgs import runtime
    from mgs.errors import InputError

    runtime.start()
    console = Console(highlight=False)
    if resume is not None:
        if dataset is not None or out is not None:
            raise InputError("nbv: --resume RUN continues RUN as it was started; leave DATASET and --out out")
        run_folder(resume, console)
        return
    if dataset is None or out is None:
        raise InputError("nbv: give a DATASET and --out RUN, or --resume RUN")
    values = {
        "policy": policy, "seeds": seeds, "seed": seed, "pixel_noise": pixel_noise, "evaluate_every": evaluate_every,
    }  # fmt: skip
    if budget is not None:
        values["budget"] = budget
    start_run(dataset, out, prior, gaussians, values, console, passes)
    run_folder(out, console)


def train_settings(passes: int | None, seed: int) -> dict[str, Any]:
    """Every setting of the fit, resolved; `mgs.train.fit` derives its draws by name from the run's root seed.

    Raises InputError for fewer than one pass.
    """
    from dataclasses import asdict

    from mgs.errors import InputError
    from mgs.train import TrainSettings

    if passes is not None and passes < 1:
        raise InputError(f"--passes {passes}: a fit needs at least one pass; raise it")
    return asdict(TrainSettings(seed=seed) if passes is None else TrainSettings(seed=seed, passes=passes))


def read_train_settings(out: Path, values: dict[str, Any]) -> TrainSettings:
    """Settings of the fit from `train` of a run's config.json. Raises InputError for one that is unknown or wrong."""
    from dataclasses import asdict

    from pydantic import ConfigDict, ValidationError
    from pydantic.dataclasses import dataclass

    from mgs.errors import InputError
    from mgs.train import TrainSettings

    checked: Any = dataclass(TrainSettings, frozen=True, config=ConfigDict(extra="forbid", allow_inf_nan=False))
    try:
        return TrainSettings(**asdict(checked(**values)))
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        key = ".".join(str(part) for part in ("train", *first["loc"]))
        raise InputError(f"{out / 'config.json'}: {key}: {first['msg']}; correct it, or start the run anew") from None


def start_run(
    dataset: Path,
    out: Path,
    prior: Path | None,
    gaussians: int | None,
    values: dict[str, Any],
    console: Console,
    passes: int | None = None,
) -> None:
    """Check everything, find or build the prior, write config.json with every setting resolved.

    values: fields of `mgs.config.NbvSettings`. Leaves no folder behind where it fails.
    """
    from mgs.config import NbvSettings, validated
    from mgs.dataset import load_dataset
    from mgs.errors import InputError
    from mgs.files import atomic_folder
    from mgs.nbv import check_settings, start
    from mgs.prior import PriorSettings, build_prior, load_prior, save_prior

    if prior is not None and gaussians is not None:
        raise InputError("nbv: --gaussians is for a prior that is built here; leave it out, or leave out --prior")
    if prior is None and gaussians is None and (dataset / "prior/prior.json").is_file():
        prior = dataset / "prior"
        console.print(f"prior: {prior}", soft_wrap=True)
    where = prior or out / "prior"
    given = validated(NbvSettings, {"dataset": dataset.resolve(), "prior": where.resolve(), **values})
    frames = load_dataset(dataset)
    resolved: dict[str, Any] = {"train": train_settings(passes, given.seed)}
    if "budget" not in values:
        resolved["budget"] = min(given.budget, max(0, len(frames) - given.seeds))
    settings = given.model_copy(update=resolved)
    check_settings(settings, len(frames))
    if prior is not None:
        load_prior(prior)
    with atomic_folder(out) as unfinished:
        if prior is None:
            with console.status("building the prior") as status:
                built, stages = build_prior(
                    frames,
                    PriorSettings(gaussians=gaussians, seed=settings.seed),
                    on_stage=lambda stage: status.update(f"prior: {stage}"),
                )
            save_prior(unfinished / "prior", built, stages.mesh)
        start(unfinished, settings, frames)


def run_folder(out: Path, console: Console, pictures: bool = False) -> None:
    """Run or resume the loop in a run folder, evaluate (with pictures where asked), print the table."""
    from mgs import nbv as loop
    from mgs.dataset import load_dataset
    from mgs.errors import InputError
    from mgs.prior import load_prior

    settings = loop.read_settings(out)
    if not settings.prior.is_dir():
        raise InputError(f"{out / 'config.json'}: prior {settings.prior} is not there; if it was moved, correct `prior` there")
    train = read_train_settings(out, settings.train)
    dataset = load_dataset(settings.dataset)
    loop.check_same_frames(out, dataset)
    prior = load_prior(settings.prior)
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from mgs.evaluate import evaluate_run
    from mgs.stations import real_stations

    stations = real_stations(dataset, prior, train)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed:.0f}/{task.total:.0f}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console, transient=True) as bar:
        whole = bar.add_task(f"{out.name}: images", total=settings.seeds + settings.budget)
        part = bar.add_task("reading", total=1)

        def progress(stage: str, done: int, total: int) -> None:
            bar.update(part, description=stage, completed=done, total=total)

        def on_step(state: State) -> None:
            bar.update(whole, completed=len(state.taken))

        state = loop.run(out, settings, dataset, stations, progress, on_step, say=lambda text: bar.print(text, soft_wrap=True))
        metrics = evaluate_run(out, pictures=pictures, progress=lambda done, total: progress("evaluating", done, total))
    print_run(out, state, metrics, console)


def print_run(out: Path, state: State, metrics: dict[str, Any], console: Console) -> None:
    """The steps as a table, then the quality of the model. Names too long for the console have a table of their own."""
    from rich.table import Column, Table
    from rich.text import Text

    columns = ("step", "image", "gain", "coverage", "iterations", "loss", "stopped", "seconds")
    rows = []
    for line in state.steps:
        names = [line["name"]] if line["name"] else line["seed_names"]
        gain = "" if line["gain"] is None else f"{line['gain']:.4g}"
        rows.append((
            str(line["step"]), "\n".join(names), gain, f"{100 * line['coverage']:.2f} %",
            str(line["iterations"]), f"{line['loss']:.3g}", line["stop_reason"], f"{sum(line['seconds'].values()):.1f}",
        ))  # fmt: skip

    def table(*shown: int) -> Table:
        made = Table(*(Column(columns[i], no_wrap=i != 1, overflow="fold") for i in shown), box=None)
        for row in rows:
            made.add_row(*(Text(row[i]) for i in shown))
        return made

    whole = table(*range(len(columns)))
    if console.measure(whole, options=console.options.update(max_width=1 << 16)).maximum <= console.width:
        console.print(whole)
    else:
        console.print(table(0, *range(2, len(columns))))
        console.print(table(0, 1))
    for name, label in (("all", "all views"), ("held_out", "views never trained on")):
        mean = metrics[name]
        if mean["count"]:
            shown = {key: "–" if mean[key] is None else f"{mean[key]:.{digits}f}" for key, digits in DIGITS.items()}
            console.print(
                f"{label} ({mean['count']}): PSNR {shown['psnr']} dB, SSIM {shown['ssim']}; "
                f"inside the rock mask PSNR {shown['psnr_mask']} dB, SSIM {shown['ssim_mask']}"
            )
    console.print(f"wrote {out}", soft_wrap=True)
