"""`mgs survey`: fly an orbit with a noisy depth camera and drifting odometry."""

from pathlib import Path
from typing import Any, Literal

from rich.table import Table

from mgs.cli.options import Seed
from mgs.cli.terminal import Terminal, progress_bar
from mgs.files import Ours, atomic_folder, below

FILES = [
    *("survey.json", "cloud.ply", "survey.png", "transforms.json", "rock.glb"),
    *("images", "masks", "rock", "depth", "test"),
]
"""Names in a folder of this command."""


def survey(
    dataset: Path,
    out: Path | None = None,
    poses: Literal["estimated", "exact"] = "estimated",
    sensor_noise: float | None = None,
    drift: float | None = None,
    seed: Seed = 0,
    force: bool = False,
) -> None:
    """Simulate a survey flight along a dataset's orbit: noisy depth, drifting odometry,
    registration, loop closure and fusion.

    The result is a dataset with estimated poses and measured depth, from which `mgs prior OUT`
    builds a prior. The folder also holds cloud.ply, survey.json and survey.png.

    - dataset: Dataset folder (transforms.json) with exact depth images.
    - out: Folder to write, new or empty. Default: DATASET/survey.
    - poses: estimated: by odometry, registration and loop closure. exact: the true poses.
    - sensor_noise: Factor on the depth camera's noise; 0: exact depth. Default: as the dataset's
      scene says, else 1.
    - drift: Factor on the errors of odometry. Default: as the dataset's scene says, else 1."""
    from mgs.data.dataset import load_dataset
    from mgs.survey.flight import SurveySettings, fly, save_survey
    from mgs.synth.scene_file import sensor_of

    console = Terminal()
    frames = load_dataset(dataset)
    folder = out if out is not None else below(dataset, "survey")
    sensor = sensor_of(dataset)
    noise = sensor.noise if sensor_noise is None else sensor_noise
    drift = sensor.drift if drift is None else drift
    settings = SurveySettings(noise, drift, poses == "exact", seed)
    # The folder is checked and locked before the work.
    ours = Ours(FILES, [dataset]) if force else None
    with atomic_folder(folder, ours) as unfinished, progress_bar("survey", console) as progress:
        flown = fly(frames, settings)
        progress("writing")
        numbers = save_survey(unfinished, frames, flown, settings)
    console.print(_table(numbers))
    what = "a dataset with estimated poses and measured depth, cloud.ply, survey.json, survey.png"
    console.print(f"wrote {folder}: {what}")


def _table(numbers: dict[str, Any]) -> Table:
    from mgs.survey.flight import STAGES

    rows = {
        "frames, length of the flight": f"{numbers['frames']}, {numbers['path_length']:.1f} m",
        "depth error on the rock (robust sigma)": f"{1e3 * numbers['depth_error_on_rock']:.1f} mm",
        "returns lost": f"{numbers['returns_lost']:.1%}",
        "points of the fused cloud": f"{numbers['points']:,}",
    }
    if not numbers["settings"]["exact_poses"]:
        closed = ", ".join(f"{i}-{j}" for i, j, _ in numbers["loops"])
        rows["steps where registration failed"] = str(numbers["steps_by_odometry"])
        rows["loop closures"] = closed or "none"
        for name, label in STAGES.items():
            rms, most, turn = numbers["error"][name].values()
            text = f"{1e3 * rms:.1f} mm rms, {1e3 * most:.1f} mm at most, {turn:.2f} degrees"
            rows[f"trajectory error, {label}"] = text
    table = Table("survey", "number", title="Survey")
    for row in rows.items():
        table.add_row(*row)
    return table
