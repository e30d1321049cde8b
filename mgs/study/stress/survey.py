"""Noise of the depth sensor and drift of the poses, as `mgs survey` flies with them: their cost,
and the order of policies."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from scipy.stats import kendalltau

from mgs.data.dataset import load_dataset
from mgs.files import atomic_folder, read_json, write_json
from mgs.prior.build import build_prior, load_prior, save_prior
from mgs.prior.settings import PriorSettings
from mgs.study.stress.experiment import Experiment, Panel, cells_per_rock, turns
from mgs.study.stress.lab import POLICIES, Lab, by_policy, open_lab
from mgs.study.stress.verdict import Claim, Effects, Row, paired, runs_of
from mgs.study.sweep import cell_folder
from mgs.survey.flight import SurveySettings, fly, survey_numbers
from mgs.survey.folder import write_survey

EXACT, USUAL, WORST = "exact", "noise 1, drift 1", "noise 4, drift 4"

LEVELS: dict[str, tuple[float, float | None]] = {
    EXACT: (0, None), "noise 1": (1, None), "noise 4": (4, None), USUAL: (1, 1), WORST: (4, 4),
}  # fmt: skip
"""Factors on the noise of the depth camera and on the drift of odometry; None: the poses are those
flown."""

COMPARED = (EXACT, USUAL, WORST)
"""Levels at which all policies are compared; at the others, views are spread evenly."""

VIEWS, SEEDS = 8, 4


def surveyed(lab: Lab, root: Path, out: Path, level: str, gaussians: int) -> tuple[Lab, Row]:
    """The lab with the frames and the prior of a survey of its dataset, written into OUT, and how
    wrong the survey is.

    Returns too `depth error`, robust standard deviation on the rock, and `pose error`, rms of the
    positions; millimetres.
    """
    if level == EXACT:
        return lab, {"depth error": 0.0, "pose error": 0.0}
    sensor, drift = LEVELS[level]
    folder = out / level.replace(", ", "-").replace(" ", "-")
    if not folder.is_dir():
        settings = SurveySettings(sensor, drift or 0, drift is None)
        source = load_dataset(cell_folder(root, f"dataset/{lab.name}") / "dataset")
        flown = fly(source, settings)
        with atomic_folder(folder) as unfinished:
            dataset = write_survey(unfinished, source, flown)
            save_prior(
                unfinished / "prior", build_prior(dataset, PriorSettings(gaussians=gaussians))[0]
            )
            write_json(unfinished / "survey.json", survey_numbers(source, flown, settings))
    numbers = read_json(folder / "survey.json")
    pose = numbers["error"]["optimised"]["ate_rms"]
    errors = {"depth error": 1e3 * numbers["depth_error_on_rock"], "pose error": 1e3 * pose}
    return lab.changed(
        frames=load_dataset(folder).frames, prior=load_prior(folder / "prior")
    ), errors


def survey(root: Path, out: Path, scene: str, turns_: int, gaussians: int) -> dict[str, Any]:
    """Models of eight images, four of them seeds, chosen by each policy, of a survey with every
    level of noise and drift. The test views have true poses."""
    lab, rows = open_lab(root, scene), []
    for level in LEVELS:
        found, errors = surveyed(lab, root, out, level, gaussians)
        for suffix, turn in turns(turns_):
            seeds = lab.even(SEEDS, turn)
            policies = POLICIES if level in COMPARED else ("uniform",)
            known = {"run": f"{scene}, {suffix}", "level": level, **errors}
            rows += [known | row for row in by_policy(found, seeds, VIEWS, policies)]
    return {"rows": rows}


def order(level: str) -> Effects:
    """Effects: Kendall's tau of the policies' PSNR at a level with that of exact data, run by
    run."""

    def taus(rows: Sequence[Row]) -> list[float]:
        def of(run: str, level: str) -> list[float]:
            found = {
                row["policy"]: row["psnr"]
                for row in rows
                if row["run"] == run and row["level"] == level
            }
            return [found[policy] for policy in POLICIES]

        return [
            float(kendalltau(of(run, level), of(run, EXACT)).statistic)
            for run in runs_of(rows, {"level": level})
        ]

    return taus


def _cost(level: str) -> Effects:
    return paired(
        "psnr", {"level": EXACT, "policy": "uniform"}, {"level": level, "policy": "uniform"}
    )


def _ahead(policy: str, other: str) -> Effects:
    return paired("psnr", {"level": USUAL, "policy": policy}, {"level": USUAL, "policy": other})


SURVEY = Experiment(
    "What do noise of the depth sensor and drift of the poses cost, and do they change which policy is better?",
    cells_per_rock("survey", f"{__name__}:survey", lambda preset: {"turns_": preset.turns, "gaussians": preset.gaussians}),
    (
        Claim("Depth noise of a Kinect (exact poses) costs at most 0.5 dB on the test views (views spread evenly).",
              _cost("noise 1"), "dB", "below", 0.5, "rock and set of seeds"),
        Claim("Four times that noise costs 1 dB or more.",
              _cost("noise 4"), "dB", "above", 1.0, "rock and set of seeds"),
        Claim("Depth noise and drift as usual, registered, cost 1 dB or more.",
              _cost(USUAL), "dB", "above", 1.0, "rock and set of seeds"),
        Claim("Four times as much of both costs 3 dB or more.",
              _cost(WORST), "dB", "above", 3.0, "rock and set of seeds"),
        Claim("With noise and drift as usual, policies keep the order of exact data: Kendall's tau is at least 0.5.",
              order(USUAL), "tau", "above", 0.5, "rock and set of seeds"),
        Claim("With four times as much of both, they keep it too.",
              order(WORST), "tau", "above", 0.5, "rock and set of seeds"),
        Claim("With noise and drift as usual, D-optimal is not behind random views at 8 images.",
              _ahead("d-optimal", "random"), "dB", "above", 0.0, "rock and set of seeds"),
        Claim("With them, directional I-optimality is not behind views spread evenly in azimuth.",
              _ahead("directional-i", "uniform"), "dB", "above", 0.0, "rock and set of seeds"),
    ),
    (
        Panel("level", "psnr", "noise and drift", "PSNR on test views (dB)", "policy"),
        Panel("level", "depth error", "noise and drift", "error of depth on the rock (mm)"),
        Panel("level", "pose error", "noise and drift", "error of camera positions, rms (mm)"),
    ),
)  # fmt: skip
