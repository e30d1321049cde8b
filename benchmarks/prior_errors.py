"""How far priors are from the true rock: `python benchmarks/prior_errors.py OUT.json WORK
DATASET...`

The datasets are of `mgs synth-orbit`, which leaves the true rock in them. Of each the prior is
built of its exact depth, and of a survey (`mgs survey`): noisy depth and estimated poses. Of the
first dataset also of a survey with exact poses, and of depth
that was made worse on purpose. WORK: a folder for the surveys; one that is there is not flown
again.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from mgs import runtime
from mgs.data.dataset import load_dataset
from mgs.files import atomic_folder, read_json, write_json
from mgs.prior.build import build_prior
from mgs.prior.settings import PriorSettings
from mgs.provenance import command_line, versions
from mgs.survey.flight import STAGES, SurveySettings, fly
from mgs.survey.folder import save_survey
from mgs.synth.scene_file import sensor_of

GAUSSIANS = 15_000
VARIANTS: dict[str, dict[str, Any]] = {
    "--prior-noise 0.01": {"noise": 0.01},
    "--prior-noise 0.03": {"noise": 0.03},
    "--prior-noise 0.06": {"noise": 0.06},
    "--holes 0.1": {"holes": 0.1},
    "--holes 0.4": {"holes": 0.4},
    "--poisson-depth 7": {"poisson_depth": 7},
    "--poisson-depth 6": {"poisson_depth": 6},
    "--poisson-depth 5": {"poisson_depth": 5},
}
"""Options of `mgs prior`, and the settings that they are."""

NUMBERS = (
    "n", "spacing", "pixels", "points", "voxel", "plane_sigma", "clusters", "cluster_size", "eps", "fit_rms", "mesh_faces",
)  # fmt: skip
"""Of prior.json."""


def measured(dataset: Path, **settings: Any) -> dict[str, Any]:
    """What a prior of a dataset says of itself, and its error."""
    numbers = build_prior(load_dataset(dataset), PriorSettings(gaussians=GAUSSIANS, **settings))[
        0
    ].numbers
    return {key: numbers[key] for key in (*NUMBERS, "truth")}


def survey(dataset: Path, folder: Path, exact: bool) -> dict[str, Any]:
    """survey.json of a survey of a dataset, which is flown if it is not there."""
    if not folder.is_dir():
        frames, sensor = load_dataset(dataset), sensor_of(dataset)
        settings = SurveySettings(sensor.noise, sensor.drift, exact, 0)
        flown = fly(frames, settings, lambda name, done, total: None)
        with atomic_folder(folder) as unfinished:
            save_survey(unfinished, frames, flown, settings)
    found: dict[str, Any] = read_json(folder / "survey.json")
    return found


def main(out: Path, work: Path, datasets: list[Path]) -> None:
    """Measure, print, write."""
    runtime.start()
    rows: list[dict[str, Any]] = []

    def record(dataset: Path, what: str, found: dict[str, Any]) -> None:
        rows.append({"scene": dataset.name, "prior": what, **found})
        truth = found["truth"]
        print(
            dataset.name,
            what,
            {key: truth[key] for key in ("accuracy", "completeness", "hausdorff")},
            flush=True,
        )

    for dataset in datasets:
        record(dataset, "exact", measured(dataset))
        if dataset is datasets[0]:
            folder = work / f"{dataset.name}-exact-poses"
            survey(dataset, folder, exact=True)
            record(dataset, "survey, exact poses", measured(folder))
            for option, settings in VARIANTS.items():
                record(dataset, option, measured(dataset, **settings))
        folder = work / dataset.name
        errors = survey(dataset, folder, exact=False)["error"]
        record(
            dataset,
            "survey",
            measured(folder)
            | {"trajectory": {stage: errors[stage]["ate_rms"] for stage in STAGES}},
        )
    write_json(
        out,
        {"command": command_line(), "gaussians": GAUSSIANS, "rows": rows, "versions": versions()},
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), [Path(name) for name in sys.argv[3:]])
