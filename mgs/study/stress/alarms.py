"""Experiments on faults of images and of priors, and on the detectors that should tell of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mgs.run.detectors import DETECTORS
from mgs.study.stress.experiment import Experiment, Panel
from mgs.study.stress.faults import IMAGE_FAULTS, PRIOR_FAULTS, fault_cells
from mgs.study.stress.lab import Preset
from mgs.study.stress.verdict import Claim, Row, roc_area, single
from mgs.study.sweep import Cell

OWN = {
    "unconverged": ("few passes",),
    "prior": (*PRIOR_FAULTS, "another rock's prior", "shifted mask", "wrong mask"),
    "exposure": ("exposure",),
    "pose": ("pose noise", "one bad pose"),
    "outlier": ("one bad pose",),
    "means": ("free means",),
    "residual": (*IMAGE_FAULTS, *PRIOR_FAULTS, "another rock's prior"),
}
"""The faults that each sign is meant for. The other signs of `mgs.run.detectors` have no fault
here."""

ALARM_GOAL, AREA_GOAL = 1 / 30, 0.9


def areas(rows: Sequence[Row], sign: str) -> list[float]:
    """Area under the ROC of one sign, scene by scene: failed runs of the faults that it is meant
    for against all clean runs and all runs of those faults that did not fail."""
    found = []
    for of_scene in _by_scene(rows).values():
        of_it = [row for row in of_scene if row["fault"] in (*OWN[sign], "none")]
        area = roc_area(
            [row.get(f"sign {sign}", -np.inf) for row in of_it], [row["failed"] for row in of_it]
        )
        found += [] if area is None else [area]
    return found


def any_area(rows: Sequence[Row]) -> list[float]:
    """The same for all signs together and all faults: the largest of the signs, each over the
    largest value that it has in clean runs of the other scenes."""
    scenes, found = _by_scene(rows), []
    for scene, of_scene in scenes.items():
        others = [row for name, of_one in scenes.items() if name != scene for row in of_one]
        limits = clean_limits(others)
        worst = [
            max(row.get(f"sign {sign}", 0.0) / limit for sign, limit in limits.items())
            for row in of_scene
        ]
        area = roc_area(worst, [row["failed"] for row in of_scene])
        found += [] if area is None else [area]
    return found


def clean_limits(rows: Sequence[Row]) -> dict[str, float]:
    """The largest value of each sign in clean runs; signs that are zero or less in all of them are
    left out."""
    clean = [row for row in rows if row["fault"] == "none"]
    largest = {
        sign: max((row.get(f"sign {sign}", 0.0) for row in clean), default=0.0)
        for sign in DETECTORS
    }
    return {sign: value for sign, value in largest.items() if value > 0}


def roc_curves(rows: Sequence[Row]) -> list[Row]:
    """Points of the ROC of every sign over its own faults, all scenes together, for the picture."""
    found = []
    for sign in OWN:
        of_it = [
            row for row in rows if row["fault"] in (*OWN[sign], "none") and f"sign {sign}" in row
        ]
        good = np.array([row[f"sign {sign}"] for row in of_it if not row["failed"]])
        bad = np.array([row[f"sign {sign}"] for row in of_it if row["failed"]])
        if not len(good) or not len(bad):
            continue
        corners = {0.0: 0.0, 1.0: 1.0}
        for limit in sorted({*good, *bad}, reverse=True):
            corners[float((good >= limit).mean())] = float((bad >= limit).mean())
        found += [
            {"run": "all", "sign": sign, "false alarms": x, "caught": y} for x, y in corners.items()
        ]
    return found


def false_alarms(rows: Sequence[Row]) -> list[float]:
    """For each clean run, 1 where it raises an alarm. The faults of images and those of priors have
    some clean runs in common, which count once."""
    clean = {(row["run"], row["size"]): row for row in rows if row["fault"] == "none"}
    return [_alarm(row) for row in clean.values()]


def caught(rows: Sequence[Row]) -> list[float]:
    """For each failed run, 1 where it raises an alarm."""
    return [_alarm(row) for row in rows if row["failed"]]


def _alarm(row: Row) -> float:
    """1 where any sign is beyond its limit in `mgs.run.detectors`, else 0."""
    return float(
        any(
            row.get(f"sign {sign}", -np.inf) > detector.limit
            for sign, detector in DETECTORS.items()
        )
    )


def _by_scene(rows: Sequence[Row]) -> dict[str, list[Row]]:
    scenes: dict[str, list[Row]] = {}
    for row in rows:
        scenes.setdefault(row["scene"], []).append(row)
    return scenes


def _harm(fault: str, size: float, words: str, bound: float = 1.0, harmless: bool = False) -> Claim:
    """The claim that a fault of this size costs more, or no more, than the bound."""
    amount = f"at most {bound:g} dB" if harmless else f"{bound:g} dB or more"
    hypothesis = f"{words} costs {amount} on the test views."
    lost = single("lost", {"fault": fault, "size": size})
    return Claim(hypothesis, lost, "dB", "below" if harmless else "above", bound, "rock and draw")


LOST = Panel("label", "lost", "fault and its size", "PSNR lost on test views (dB)")

DATA_FAULTS = Experiment(
    "Which faults of the images spoil a model?",
    lambda preset: fault_cells(preset, "images"),
    (
        _harm("pose noise", 1.0, "Pose noise of 1 degree and 1 cm"),
        _harm("image noise", 0.1, "Image noise of a tenth of the range", harmless=True),
        _harm("exposure", 0.3, "Exposure that varies by 0.3 stops"),
        _harm("motion blur", 5.0, "Motion blur of 5 pixels"),
        _harm("defocus", 1.5, "Defocus of 1.5 pixels"),
        _harm(
            "missing depth",
            0.6,
            "Depth missing in 60 % of the pixels (with the prior as it was)",
            0.5,
            harmless=True,
        ),
        _harm("shifted mask", 4.0, "A mask that is off by 4 pixels"),
        _harm("wrong mask", 3.0, "A mask that is 3 pixels too large or too small"),
    ),
    (LOST,),
)

PRIOR_EXPERIMENT = Experiment(
    "Which faults of the prior spoil a model?",
    lambda preset: fault_cells(preset, "prior"),
    (
        _harm("noisy prior", 2.0, "Noise of 2 spacings on the prior's points"),
        _harm("smoothed prior", 10.0, "Over-smoothing the prior (10 rounds)", harmless=True),
        _harm("holes", 0.2, "A hole of a fifth of the surface"),
        _harm("shifted prior", 0.1, "A prior that is shifted by 10 cm"),
        _harm("scaled prior", 1.1, "A prior that is 10 % too large"),
        _harm("turned prior", 15.0, "A prior that is turned by 15 degrees"),
        _harm("another rock's prior", 0, "The prior of another rock"),
    ),
    (LOST,),
)


def _cells(preset: Preset) -> list[Cell]:
    return [*fault_cells(preset, "images"), *fault_cells(preset, "prior")]


def _area_claim(sign: str) -> Claim:
    hypothesis = f"The sign `{sign}` tells runs that its own faults spoil from good ones: the area under its ROC is at least 0.9."
    return Claim(hypothesis, lambda rows: areas(rows, sign), "area", "above", AREA_GOAL, "rock")


ALARMS = Experiment(
    "Do the detectors tell failed runs from good ones?",
    _cells,
    (
        *(_area_claim(sign) for sign in OWN),
        Claim("All signs together tell failed runs of all faults from good ones: the area is at least 0.9, scenes held out.",
              any_area, "area", "above", AREA_GOAL, "rock held out"),
        Claim("At most one in thirty clean runs raises an alarm.", false_alarms, "share", "below", ALARM_GOAL, "clean run"),
        Claim("At least nine of ten failed runs raise an alarm.", caught, "share", "above", AREA_GOAL, "failed run"),
    ),
    (
        Panel("false alarms", "caught", "good runs with an alarm (share)", "failed runs with an alarm (share)", "sign"),
        Panel("fault", "failed", "fault, at all its sizes", "runs that failed (share)"),
    ),
    roc_curves,
)  # fmt: skip
