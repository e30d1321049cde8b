"""Few views: means that are free to move, and views that all look from one side."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mgs.metrics import agreement
from mgs.policy.poses import azimuths
from mgs.study.stress.experiment import Experiment, Panel, cells_per_rock, turns
from mgs.study.stress.lab import Array, Lab, greedy, open_lab
from mgs.study.stress.verdict import Claim, Effects, paired, single

FREE_PASSES = 40
"""Four times the default: a collapse takes time."""

KINDS = {
    "frozen": ("frozen", True),
    "free": ("free", True),
    "frozen, no prior": ("frozen", False),
    "free, no prior": ("free", False),
}
"""What the means may do, and whether a prior holds all parameters: the paper has none. Free means
are compared with frozen ones of the same prior, since a fit without one loses quality whatever its
means do."""

VIEWS = 8
"""Views of the models whose seeds are compared."""


def free_means(root: Path, out: Path, scene: str, turns_: int, counts: list[int]) -> dict[str, Any]:
    """Fits with frozen and with free means on few views: quality, drift of the means, ranking of
    the other views."""
    lab, rows = open_lab(root, scene), []
    for suffix, turn in turns(turns_):
        for count in counts:
            taken = lab.even(count, turn)
            left, start = lab.left(taken), lab.start(taken)
            references: dict[bool, Array] = {}
            for kind, (means, with_prior) in KINDS.items():
                model = lab.fit(taken, FREE_PASSES, means, with_prior, start=start).gaussians
                scores = lab.scores(model, taken, left, means=means)
                reference = references.setdefault(with_prior, scores)
                drift = np.linalg.norm(model.means - start.means, axis=1) / lab.prior.spacing
                rows.append({
                    "run": f"{scene}, {suffix}", "views": count, "means": kind, **lab.quality(model),
                    "drift": float(np.sqrt(np.mean(drift**2))), **agreement(scores, reference),
                })  # fmt: skip
    return {"rows": rows}


def _difference(views: int, kind: str, other: str) -> Effects:
    return paired("psnr", {"views": views, "means": kind}, {"views": views, "means": other})


FREE_MEANS = Experiment(
    "Do free means collapse on few views?",
    cells_per_rock(
        "free-means", f"{__name__}:free_means", lambda preset: {"turns_": preset.turns, "counts": list(preset.few_views)}
    ),
    (
        Claim("On 4 views, free means lose 1 dB or more against frozen ones, both without a prior (paper, section III).",
              _difference(4, "free, no prior", "frozen, no prior"), "dB", "below", -1.0, "rock and set of views"),
        Claim("On 2 views, free means lose 1 dB or more against frozen ones, both without a prior.",
              _difference(2, "free, no prior", "frozen, no prior"), "dB", "below", -1.0, "rock and set of views"),
        Claim("On 4 views, frozen means lose 0.5 dB or more where no prior holds the other parameters.",
              _difference(4, "frozen, no prior", "frozen"), "dB", "below", -0.5, "rock and set of views"),
        Claim("With the prior on their place, free means lose no more than 0.5 dB on 4 views.",
              _difference(4, "free", "frozen"), "dB", "above", -0.5, "rock and set of views"),
        Claim("On 4 views, freeing the means (no prior) changes the D-optimal ranking: Kendall's tau is at most 0.8.",
              single("tau", {"views": 4, "means": "free, no prior"}), "tau", "below", 0.8,
              "rock and set of views"),
    ),
    (
        Panel("views", "psnr", "views", "PSNR on test views (dB)", "means"),
        Panel("views", "drift", "views", "drift of the means, rms (spacings)", "means"),
        Panel("views", "tau", "views", "Kendall's tau with frozen means of the same prior", "means"),
    ),
)  # fmt: skip


def _around(lab: Lab, turn: float, count: int) -> list[int]:
    """Frames in order of azimuth, beginning at one that depends on the turn."""
    positions = np.array([camera.position for camera in lab.cameras])
    order = np.argsort(azimuths(positions, lab.prior.points.mean(0)), kind="stable")
    return [int(i) for i in np.roll(order, -round(turn * len(order)))[:count]]


def seeds(root: Path, out: Path, scene: str, turns_: int) -> dict[str, Any]:
    """Models of the same number of views from different seeds; and from an orbit of which one half
    cannot be reached."""
    lab, rows = open_lab(root, scene), []
    n = len(lab.frames)
    everything = list(range(n))
    for suffix, turn in turns(turns_):
        even, half = lab.even(4, turn), _around(lab, turn, n // 2)
        states = {
            "4 even seeds": (even, everything), "1 seed": (even[:1], everything),
            "4 seeds side by side": (_around(lab, turn, 4), everything), "half of the orbit": (half[:: n // 8], half),
        }  # fmt: skip
        for name, (taken, allowed) in states.items():
            for policy in ("d-optimal", "uniform"):
                chosen = greedy(lab, taken, allowed, VIEWS - len(taken), policy)
                quality = lab.quality(lab.fit(chosen).gaussians)
                rows.append(
                    {
                        "run": f"{scene}, {suffix}",
                        "seeds": name,
                        "policy": policy,
                        "images": len(chosen),
                        **quality,
                    }
                )
    return {"rows": rows}


def _against_even(name: str, policy: str = "d-optimal") -> Effects:
    return paired(
        "psnr", {"seeds": name, "policy": policy}, {"seeds": "4 even seeds", "policy": policy}
    )


SEEDS = Experiment(
    "How much do the seeds, and a blocked half of the orbit, matter?",
    cells_per_rock("seeds", f"{__name__}:seeds", lambda preset: {"turns_": preset.turns}),
    (
        Claim("At 8 images, D-optimal from one seed is at most 0.5 dB behind D-optimal from four even seeds.",
              _against_even("1 seed"), "dB", "above", -0.5, "rock and set of views"),
        Claim("At 8 images, D-optimal from four seeds side by side is at most 0.5 dB behind four even seeds.",
              _against_even("4 seeds side by side"), "dB", "above", -0.5, "rock and set of views"),
        Claim("Where only half of the orbit can be flown, the model loses 1 dB or more on the test views.",
              _against_even("half of the orbit"), "dB", "below", -1.0, "rock and set of views"),
    ),
    (Panel("seeds", "psnr", "seeds", "PSNR on test views (dB)", "policy"),),
)  # fmt: skip
