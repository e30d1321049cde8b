"""What keeps a model a surface? `python benchmarks/surface.py PREFIX DATASET...` writes PREFIX.json
and PREFIX.png.

Fits of 10,000 Gaussians to 12 views spread evenly in azimuth, with and without the backing, and
with what else could keep a
model opaque: alpha as a fourth channel of a pixel, with several weights (sigma_rgb /
sigma_alpha)^2; opacities held to the prior more tightly, or not learned; Gaussians ten times
thinner, as in 2D Gaussian splatting. Measured on the test views, drawn
whole as any viewer does: PSNR in the full frame and inside the rock, and what `backing.py`
measures. Means over the datasets, which need exact depth and test views.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from backing import measure

from mgs import runtime
from mgs.data.dataset import load_dataset, target_of
from mgs.files import write_json
from mgs.fit.fitting import fit
from mgs.fit.settings import TrainSettings
from mgs.gaussians import Gaussians
from mgs.plotting import STYLE, new_figure, save_figure
from mgs.policy.criteria import PRIOR_STD, lam_by_kind, regularisation
from mgs.policy.poses import seed_views
from mgs.prior.build import build_prior
from mgs.prior.initial import initial_gaussians
from mgs.prior.settings import PriorSettings
from mgs.provenance import command_line, versions
from mgs.run.operations import psnr_measure
from mgs.splat import ListCache, groups

VIEWS, GAUSSIANS = 12, 10_000
BACKINGS, WEIGHTS = (0.0, 0.5), (0.0, 0.03, 0.1, 0.3, 1.0)
OTHERS = {
    "tau of opacity x 0.25": {"opacity": 0.25},
    "opacity not learned": {"opacity": 1e-3},
    "ten times thinner": {"thinner": 10.0},
}
"""What else is tried, without alpha as a channel: factors of tau, or of the thickness."""


def thinner(start: Gaussians, factor: float) -> Gaussians:
    """The Gaussians with their shortest axis so many times shorter."""
    scales = start.log_scales.copy()
    scales[np.arange(len(scales)), scales.argmin(axis=1)] -= np.log(factor)
    return replace(start, log_scales=scales)


def record(
    root: Path, backing: float, what: str, weight: float, factors: Mapping[str, float]
) -> dict[str, Any]:
    """One fit, and what it is like on the test views."""
    dataset, cache = load_dataset(root), ListCache()
    prior, _ = build_prior(dataset, PriorSettings(gaussians=GAUSSIANS, backing=backing))
    positions = np.array([frame.camera.position for frame in dataset.frames])
    frames = [dataset.frames[i] for i in seed_views(positions, prior.points.mean(0), VIEWS)]
    start = initial_gaussians(prior, frames)[0]
    start = thinner(start, factors["thinner"]) if "thinner" in factors else start
    taus = {kind: tau * factors.get(kind, 1.0) for kind, tau in PRIOR_STD.items()}
    lam = lam_by_kind(regularisation(groups(0), prior_std=taus), groups(0))
    cameras, targets = (
        [frame.camera for frame in frames],
        [target_of(frame, True) for frame in frames],
    )
    settings = TrainSettings(alpha_weight=weight, tolerance=0.0)
    model = fit(start, cameras, targets, settings, cache=cache, start=start, lam=lam).gaussians
    tests = dataset.test_views()
    found = measure(model, tests.frames, prior.spacing) | {
        "psnr": psnr_measure(tests, ListCache())(model, [])["psnr"]
    }
    return {
        "dataset": root.as_posix(),
        "backing": backing,
        "what": what,
        "alpha_weight": weight,
    } | found


def means(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The records of each setting as one, numbers as means over the datasets; "gain" and
    "gain_inside": least and most by which PSNR is above that of weight 0 on the same dataset,
    dB."""
    plain = {
        (r["dataset"], r["backing"]): r
        for r in records
        if r["what"].startswith("alpha") and not r["alpha_weight"]
    }
    together: dict[tuple[float, str], list[dict[str, Any]]] = {}
    for r in records:
        together.setdefault((r["backing"], r["what"]), []).append(r)
    rows = []
    for same in together.values():
        row = {
            key: float(np.mean([r[key] for r in same]))
            for key, value in same[0].items()
            if isinstance(value, float)
        }
        for name, key in (("gain", "psnr"), ("gain_inside", "psnr_inside")):
            gains = [r[key] - plain[r["dataset"], r["backing"]][key] for r in same]
            row[name] = [min(gains), max(gains)]
        rows.append({"what": same[0]["what"]} | row)
    return rows


def draw(path: Path, records: list[dict[str, Any]]) -> None:
    """PSNR inside the rock against the share of pixels that are too deep."""
    import matplotlib

    with matplotlib.rc_context(STYLE):
        figure = new_figure(7.2, 3.6)
        axis = figure.subplots()
        for backing, colour in zip(BACKINGS, ("#D55E00", "#0072B2"), strict=True):
            of = [r for r in records if r["backing"] == backing]
            line = [r for r in of if r["what"].startswith("alpha")]
            name = "all on the surface" if backing == 0 else "a third behind it"
            x, y = "too_deep", "psnr_inside"
            axis.plot(
                [100 * r[x] for r in line],
                [r[y] for r in line],
                "o-",
                color=colour,
                label=f"{name}, alpha weight",
            )
            for r in line:
                axis.annotate(
                    f"{r['alpha_weight']:g}",
                    (100 * r[x], r[y]),
                    xytext=(4, 4),
                    textcoords="offset points",
                    fontsize=8,
                )
            for r, marker in zip((r for r in of if r not in line), "sv*", strict=True):
                axis.plot(100 * r[x], r[y], marker, color=colour, label=f"{name}, {r['what']}")
        axis.set(
            xlabel="pixels more than 5 cm too deep (%)",
            ylabel="PSNR inside the rock, test views (dB)",
            xscale="log",
        )
        axis.xaxis.set_major_formatter("{x:g}")
        figure.legend(loc="outside right center", fontsize=8)
        save_figure(figure, path)


def main(prefix: Path, roots: list[Path]) -> None:
    """Measure, write, draw."""
    runtime.start()
    records = []
    tried = [(f"alpha, weight {weight:g}", weight, {}) for weight in WEIGHTS] + [
        (k, 0.0, v) for k, v in OTHERS.items()
    ]
    for root in roots:
        for backing in BACKINGS:
            for what, weight, factors in tried:
                records.append(record(root, backing, what, weight, factors))
                print(records[-1], flush=True)
    made = {"command": command_line(), "machine": runtime.processor(), "versions": versions()}
    write_json(prefix.with_suffix(".json"), made | {"records": records, "means": means(records)})
    draw(prefix.with_suffix(".png"), means(records))


if __name__ == "__main__":
    main(Path(sys.argv[1]), [Path(root) for root in sys.argv[2:]])
