"""`mgs nbv`: choose views one by one, as the paper does."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mgs.fit.settings import ALPHA_WEIGHT, PASSES, RATES, WARM_PASSES
from mgs.policy.criteria import PIXEL_NOISE, PRIOR_STD
from mgs.policy.registry import policy_names
from mgs.run.ending import fit_line, why_ended
from mgs.run.settings import PRESETS

if TYPE_CHECKING:
    from rich.console import Console

    from mgs.run.folder import State

DIGITS = {"psnr": 2, "ssim": 4, "psnr_mask": 2, "ssim_mask": 4}
"""Decimals of the qualities that are printed."""


def _numbers(defaults: dict[str, float]) -> str:
    return ", ".join(f"{kind}={value:g}" for kind, value in defaults.items())


def nbv(
    context: typer.Context,
    dataset: Annotated[
        Path | None,
        typer.Argument(help="Dataset folder (transforms.json). Not needed with --resume."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="New folder for the run.")] = None,
    capture: Annotated[
        str | None,
        typer.Option(
            metavar="SCENE",
            help="In place of DATASET, a scene (name or .toml): an image is rendered only when it is chosen.",
        ),
    ] = None,
    prior: Annotated[
        Path | None,
        typer.Option(
            help="Folder of `mgs prior`; default DATASET/prior, or built inside the run where there is none."
        ),
    ] = None,
    gaussians: Annotated[
        str | None,
        typer.Option(
            metavar="N|auto",
            help="Build a prior of this many Gaussians (`mgs prior`) inside the run.",
        ),
    ] = None,
    policy: Annotated[
        str,
        typer.Option(
            help=f"One of {', '.join(policy_names())}; or FILE.py:FUNCTION, a function of your own."
        ),
    ] = "d-optimal",
    nearest: Annotated[
        int | None,
        typer.Option(
            help="Move only to one of so many views that are nearest to the last one. Default: to any."
        ),
    ] = None,
    travel: Annotated[
        float | None,
        typer.Option(
            metavar="METRES",
            help="Distance that costs as much as taking an image: scores are divided by 1 + distance/METRES.",
        ),
    ] = None,
    budget: Annotated[
        int | None,
        typer.Option(
            help="Most views chosen beyond the seeds; default 50, or all candidates where they are fewer."
        ),
    ] = None,
    batch: Annotated[
        int,
        typer.Option(
            metavar="K",
            help="Choose so many views, one after the other, before their images are read and fitted.",
        ),
    ] = 1,
    stop_gain: Annotated[
        float | None,
        typer.Option(
            metavar="GAIN",
            help="End the run before a view whose `information_gain` (Eq. 7, in steps.jsonl) is less than this.",
        ),
    ] = None,
    stop_uncertainty: Annotated[
        float | None,
        typer.Option(
            metavar="SHARE",
            help="End the run when no more than this share (0 to 1) of the prior's variance is left.",
        ),
    ] = None,
    seeds: Annotated[
        int, typer.Option(help="Views at evenly spaced azimuths that start the model.")
    ] = 4,
    seed: Annotated[int, typer.Option(min=0, help="Root of every random draw.")] = 0,
    estimator: Annotated[
        str,
        typer.Option(
            help="How Fisher information is computed: exact, hutchinson, or loss-gradient (the paper's)."
        ),
    ] = "exact",
    lam: Annotated[
        float | None,
        typer.Option(
            help="One lambda for all parameters, as in the paper; default: (pixel noise / prior std)^2."
        ),
    ] = None,
    pixel_noise: Annotated[
        float, typer.Option(help="Residual of a pixel, linear RGB: sets lambda of every criterion.")
    ] = PIXEL_NOISE,
    prior_std: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KIND=NUMBER",
            help=f"Prior standard deviation of a kind of parameter; default: {_numbers(PRIOR_STD)}.",
        ),
    ] = None,
    means: Annotated[
        str,
        typer.Option(
            help="What the means may do: frozen (stay), normal (move along the prior's normals), or free."
        ),
    ] = "frozen",
    optimiser: Annotated[
        str, typer.Option(help="Optimiser of the fit: natural or adam.")
    ] = "natural",
    alpha_weight: Annotated[
        float | None,
        typer.Option(
            metavar="WEIGHT",
            help="Weight of a pixel's alpha in the fit, (sigma_rgb / sigma_alpha)^2; 0: none, as in the paper. Default: "
            f"{ALPHA_WEIGHT}, or 0 where frames have neither mask nor alpha.",
        ),
    ] = None,
    rate: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KIND=NUMBER",
            help=f"Learning rate of a kind of parameter; default: {_numbers(RATES)}. 0: not learned.",
        ),
    ] = None,
    exposure: Annotated[
        bool,
        typer.Option(
            "--exposure",
            help="Exposure and white balance differ between images: estimate a gain of each image and channel.",
        ),
    ] = False,
    passes: Annotated[
        int | None, typer.Option(help=f"Most passes over the images in any fit; default {PASSES}.")
    ] = None,
    warm_passes: Annotated[
        int | None,
        typer.Option(help=f"Most passes of the fits after the first; default {WARM_PASSES}."),
    ] = None,
    preset: Annotated[
        str | None,
        typer.Option(
            help=f"Defaults of passes and of the number of Gaussians: {', '.join(PRESETS)}. Other options win."
        ),
    ] = None,
    evaluate_every: Annotated[
        int,
        typer.Option(
            help="Measure PSNR every so many chosen views, of a batch at its end; 0: only at the end of the run."
        ),
    ] = 0,
    resume: Annotated[
        Path | None,
        typer.Option(help="Continue this run; every other setting comes from its config.json."),
    ] = None,
) -> None:
    """Fit to the seeds, then choose a view (with --batch several), read its image and fit again,
    until the budget is spent, or
    --stop-gain or --stop-uncertainty ends the run.

    Writes config.json, steps.jsonl (a line for the seeds, then one for each chosen view),
    checkpoint.npz, gaussians.ply and metrics.json into the run folder. Once the folder is there, a
    run that was interrupted at any moment, kill -9 included, goes on with --resume and takes the
    same views; before that, give the same command again.
    """
    from rich.console import Console

    from mgs.cli.options import parse_gaussians
    from mgs.errors import InputError

    console = Console(highlight=False)
    if resume is not None:
        if dataset is not None or out is not None or capture is not None:
            raise InputError(
                "nbv: --resume RUN continues RUN as it was started; leave DATASET, --out and --capture out"
            )
        for name in context.params:
            source = context.get_parameter_source(name)
            if name != "resume" and source is not None and source.name == "COMMANDLINE":
                option = f"--{name.replace('_', '-')}"
                raise InputError(
                    f"nbv: {option}: --resume takes its settings from {resume / 'config.json'}; change it there"
                )
        resume_and_print(resume, console)
        return
    if (dataset is None) == (capture is None) or out is None:
        raise InputError("nbv: give a DATASET or --capture SCENE, and --out RUN; or --resume RUN")
    train: dict[str, Any] = {
        "means": means, "optimiser": optimiser, "rates": pairs("--rate", rate),
    }  # fmt: skip
    train |= {
        name: value
        for name, value in {"passes": passes, "alpha_weight": alpha_weight}.items()
        if value is not None
    }
    settings: dict[str, Any] = {
        "policy": policy, "nearest": nearest, "travel": travel, "batch": batch, "stop_gain": stop_gain,
        "stop_uncertainty": stop_uncertainty, "seeds": seeds, "seed": seed, "estimator": estimator, "lam": lam,
        "pixel_noise": pixel_noise, "prior_std": pairs("--prior-std", prior_std), "evaluate_every": evaluate_every,
        "exposure": exposure, "train": train,
    }  # fmt: skip
    settings |= {
        name: value
        for name, value in {"budget": budget, "warm_passes": warm_passes}.items()
        if value is not None
    }
    start_and_print(
        dataset,
        out,
        console,
        capture=capture,
        prior=prior,
        gaussians=parse_gaussians(gaussians),
        preset=preset,
        **settings,
    )
    resume_and_print(out, console)


def pairs(option: str, given: list[str] | None) -> dict[str, float]:
    """`KIND=NUMBER` options as a table. Raises InputError for one that is not of this form."""
    from mgs.errors import InputError

    table = {}
    for text in given or []:
        kind, _, number = text.partition("=")
        try:
            table[kind] = float(number)
        except ValueError:
            raise InputError(
                f"{option} {text}: expected KIND=NUMBER, as in {option} colour=0.01"
            ) from None
    return table


def start_and_print(dataset: Path | None, out: Path, console: Console, **settings: Any) -> None:
    """`mgs.run.nbv.start_run` under a spinner; says which prior it found."""
    from mgs.run.nbv import start_run

    with console.status("starting") as status:
        found = start_run(
            dataset, out, progress=lambda stage, done, total: status.update(stage), **settings
        )
    if (
        settings.get("prior") is None
        and dataset is not None
        and found.prior.parent == dataset.resolve()
    ):
        console.print(f"prior: {found.prior}", soft_wrap=True)


def resume_and_print(out: Path, console: Console, pictures: bool = False) -> None:
    """Run or resume the loop in a run folder, evaluate (with pictures where asked), print the
    table."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from mgs.report.evaluation import evaluate_run
    from mgs.run.folder import read_settings
    from mgs.run.nbv import resume_nbv

    settings = read_settings(out)
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
            line = state.steps[-1]
            for warning in line.get("warnings", []):
                bar.print(f"step {line['step']}: {warning}", soft_wrap=True)

        state = resume_nbv(
            out,
            on_step=on_step,
            progress=progress,
            say=lambda text: bar.print(text, soft_wrap=True),
        )
        metrics = evaluate_run(
            out, pictures=pictures, progress=lambda done, total: progress("evaluating", done, total)
        )
    print_run(out, state, metrics, console)


def print_run(out: Path, state: State, metrics: dict[str, Any], console: Console) -> None:
    """The steps as a table, then the quality of the model. Names too long for the console have a
    table of their own."""
    from rich.table import Column, Table
    from rich.text import Text

    columns = ("step", "image", "score", "coverage", "iterations", "loss", "stopped", "seconds")
    rows = []
    for line in state.steps:
        names = [line["name"]] if line["name"] else line["seed_names"]
        score = "" if line["score"] is None else f"{line['score']:.4g}"
        rows.append((
            str(line["step"]), "\n".join(names), score, f"{100 * line['coverage']:.2f} %",
            *((str(line["iterations"]), f"{line['loss']:.3g}", line["stop_reason"]) if "loss" in line else ("", "", "")),
            f"{sum(line['seconds'].values()):.1f}",
        ))  # fmt: skip

    def table(*shown: int) -> Table:
        made = Table(
            *(Column(columns[i], no_wrap=i != 1, overflow="fold") for i in shown), box=None
        )
        for row in rows:
            made.add_row(*(Text(row[i]) for i in shown))
        return made

    whole = table(*range(len(columns)))
    if (
        console.measure(whole, options=console.options.update(max_width=1 << 16)).maximum
        <= console.width
    ):
        console.print(whole)
    else:
        console.print(table(0, *range(2, len(columns))))
        console.print(table(0, 1))
    every = "all views" if metrics.get("held_out", {}).get("count") else "views trained on"
    for name, label in (
        ("test", "test views"),
        ("all", every),
        ("held_out", "views never trained on"),
    ):
        mean = metrics.get(name, {"count": 0})
        if mean["count"]:
            shown = {
                key: "–" if mean[key] is None else f"{mean[key]:.{digits}f}"
                for key, digits in DIGITS.items()
            }
            console.print(
                f"{label} ({mean['count']}): PSNR {shown['psnr']} dB, SSIM {shown['ssim']}; "
                f"inside the rock mask PSNR {shown['psnr_mask']} dB, SSIM {shown['ssim_mask']}"
            )
            if any("exposure" in step for step in state.steps):
                found = [
                    "–" if mean.get(key) is None else f"{mean[key]:.2f}"
                    for key in ("psnr_corrected", "psnr_mask_corrected")
                ]
                console.print(
                    f"{label}, with a gain per channel fitted to each view itself: PSNR {found[0]} dB; "
                    f"inside the rock mask {found[1]} dB"
                )
    if "fit" in metrics:
        console.print(fit_line(metrics["fit"], state.steps[-1]["stop_reason"]))
    if state.steps and "ended" in state.steps[-1]:
        console.print(f"the run has ended: {why_ended(state.steps[-1]['ended'])}", soft_wrap=True)
    console.print(f"wrote {out}", soft_wrap=True)
