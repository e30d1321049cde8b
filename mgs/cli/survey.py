"""`mgs survey`: fly an orbit with a noisy depth camera and drifting odometry."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer


class Poses(StrEnum):
    """Where the poses of the survey come from."""

    estimated = "estimated"
    exact = "exact"


def survey(
    dataset: Annotated[
        Path, typer.Argument(help="Dataset folder (transforms.json) with exact depth images.")
    ],
    out: Annotated[
        Path | None, typer.Option(help="Folder to write, new or empty. Default: DATASET/survey.")
    ] = None,
    poses: Annotated[
        Poses,
        typer.Option(
            help="estimated: from odometry, registration and loop closure. exact: as flown."
        ),
    ] = Poses.estimated,
    sensor_noise: Annotated[
        float | None,
        typer.Option(
            help="Factor on the depth camera's noise; 0: exact depth. Default: as the dataset's scene says, else 1."
        ),
    ] = None,
    drift: Annotated[
        float | None,
        typer.Option(
            help="Factor on the errors of odometry. Default: as the dataset's scene says, else 1."
        ),
    ] = None,
    seed: Annotated[
        int, typer.Option(min=0, help="Root seed: the same seed gives the same survey.")
    ] = 0,
) -> None:
    """Fly a dataset's orbit with a noisy depth camera and drifting odometry; register the frames,
    close loops, fuse the cloud.

    The result is a dataset again, with estimated poses and measured depth, so `mgs prior OUT`
    builds the prior that such a flight would have given. The folder also holds cloud.ply,
    survey.json and survey.png.
    """
    from rich.console import Console
    from rich.progress import Progress

    from mgs.data.dataset import load_dataset
    from mgs.files import atomic_folder, check_new_folder
    from mgs.survey.flight import SurveySettings, fly
    from mgs.survey.folder import save_survey
    from mgs.synth.scene_file import sensor_of

    console = Console()
    frames = load_dataset(dataset)
    folder = check_new_folder(
        out if out is not None else dataset / "survey"
    )  # before the work, not after it
    sensor = sensor_of(dataset)
    noise, drift = (
        own if given is None else given
        for given, own in ((sensor_noise, sensor.noise), (drift, sensor.drift))
    )
    settings = SurveySettings(noise, drift, poses is Poses.exact, seed)
    with Progress(console=console, transient=True) as progress:
        bar = progress.add_task("survey")
        flown = fly(
            frames,
            settings,
            lambda name, done, total: progress.update(
                bar, description=name, completed=done, total=total
            ),
        )
    with atomic_folder(folder) as unfinished, console.status("writing"):
        numbers = save_survey(unfinished, frames, flown, settings)
    console.print(_table(numbers))
    console.print(
        f"wrote {folder}: a dataset with estimated poses and measured depth, cloud.ply, survey.json, survey.png"
    )


def _table(numbers: dict[str, Any]) -> Any:
    """The table that is printed, from the numbers of survey.json."""
    from rich.table import Table

    from mgs.survey.flight import STAGES

    table = Table("survey", "number", title="Survey")
    table.add_row(
        "frames, length of the flight", f"{numbers['frames']}, {numbers['path_length']:.1f} m"
    )
    table.add_row(
        "depth error on the rock (robust sigma)", f"{1e3 * numbers['depth_error_on_rock']:.1f} mm"
    )
    table.add_row("returns lost", f"{numbers['returns_lost']:.1%}")
    table.add_row("points of the fused cloud", f"{numbers['points']:,}")
    if numbers["settings"]["exact_poses"]:
        table.add_row("poses", "as flown, no odometry")
        return table
    table.add_row("steps where registration failed", str(numbers["steps_by_odometry"]))
    table.add_row("loop closures", ", ".join(f"{i}-{j}" for i, j, _ in numbers["loops"]) or "none")
    table.add_section()
    for name, label in STAGES.items():
        error = numbers["error"][name]
        text = f"{1e3 * error['ate_rms']:.1f} mm rms, {1e3 * error['ate_max']:.1f} mm at most, {error['rotation_rms']:.2f} degrees"
        table.add_row(f"trajectory error, {label}", text)
    return table
