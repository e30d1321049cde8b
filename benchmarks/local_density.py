"""More Gaussians where the rock has texture? `python benchmarks/local_density.py OUT.json
DATASET:VIEWS...`

For the same number of Gaussians, samples of the prior lie closer together where the images change
more. The texture g of a place is the standard deviation of the colours (linear RGB) of the surface
around it, over the NEIGHBOURS nearest of many dense samples; the colours are those of the images
that are fitted, so this is more than a flight would know when it starts. Spacings are proportional
to (g + mean g)^(-strength / 2), and a Gaussian's scales to its spacing; 0 is even spacing. (The
error of a
piecewise constant function is least where the density of its pieces is proportional to the slope: a
strength of 1, without the mean.) The Gaussians behind the surface stay evenly spread. Models are
fitted to VIEWS views spread evenly in azimuth, and measured on the dataset's test views.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from mgs import runtime
from mgs.colour import SH_C0
from mgs.data.dataset import Dataset, Frame, load_dataset, target_of
from mgs.errors import InputError
from mgs.files import write_json
from mgs.fit.fitting import fit
from mgs.gaussians import Gaussians
from mgs.policy.criteria import regularisation
from mgs.policy.poses import seed_views
from mgs.prior.build import Prior, build_prior
from mgs.prior.initial import initial_gaussians
from mgs.prior.settings import PriorSettings
from mgs.prior.surface import _independent
from mgs.provenance import command_line, versions
from mgs.report.evaluation import evaluate
from mgs.splat import ListCache, groups

SIZES = (2_500, 5_000, 10_000, 20_000)
STRENGTHS = (0.0, 0.5, 1.0)
DENSE = 10
"""Dense samples for each that is kept."""

NEIGHBOURS = 24


def texture(dense: Prior, frames: Sequence[Frame]) -> np.ndarray:
    """[N] standard deviation of the colours around each sample."""
    colours = SH_C0 * initial_gaussians(dense, frames)[0].sh[: len(dense.points), 0]
    near = cKDTree(dense.points).query(dense.points, NEIGHBOURS)[1]
    return np.asarray(np.sqrt(colours[near].var(axis=1).sum(axis=1)))


def thinned(points: np.ndarray, relative: np.ndarray, count: int, spacing: float) -> np.ndarray:
    """Indices of about `count` of the points [M,3], neighbours `relative` [M] times a common
    distance apart."""
    pairs = cKDTree(points).query_pairs(float(relative.max()) * spacing, output_type="ndarray")
    distance = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1) / relative[
        pairs
    ].mean(axis=1)
    low, high = 0.0, spacing
    for _ in range(14):
        radius = (low + high) / 2
        kept = _independent(pairs[distance < radius], len(points))
        low, high = (radius, high) if len(kept) > count else (low, radius)
    return kept


def start_of(
    prior: Prior, dense: Prior, g: np.ndarray, strength: float, frames: Sequence[Frame]
) -> tuple[Gaussians, float]:
    """The Gaussians before training, and the ratio of the largest spacing to the smallest."""
    relative = (g + g.mean()) ** (-strength / 2)
    relative /= np.sqrt((relative**2).mean())
    order = np.random.default_rng(0).permutation(len(g))
    kept = order[thinned(dense.points[order], relative[order], len(prior.points), prior.spacing)]
    local = replace(prior, points=dense.points[kept], normals=dense.normals[kept], backed=0)
    local = replace(local, spacing=prior.spacing * float(np.sqrt(len(prior.points) / len(kept))))
    surface = initial_gaussians(local, frames)[0]
    own = relative[kept] / np.sqrt((relative[kept] ** 2).mean())
    surface = replace(
        surface, log_scales=(surface.log_scales + np.log(own)[:, None]).astype(np.float32)
    )
    backing = initial_gaussians(prior, frames)[0][len(prior.points) :]
    both = [
        np.concatenate([getattr(part, field.name) for part in (surface, backing)])
        for field in fields(Gaussians)
    ]
    return Gaussians(*both), float(own.max() / own.min())


def study(root: Path, views: int) -> list[dict[str, Any]]:
    """One record for each of SIZES and STRENGTHS, and for the prior as it is (strength None)."""
    dataset: Dataset = load_dataset(root)
    tests = dataset.test_views()
    if tests is None:
        raise InputError(
            f"{root}: has no test views; make it with `mgs synth-orbit --test-views 12`"
        )
    lam = {
        kind: float(regularisation(groups(0))[columns][0]) for kind, columns in groups(0).items()
    }
    records = []
    for n in SIZES:
        prior, _ = build_prior(dataset, PriorSettings(gaussians=n))
        dense, _ = build_prior(
            dataset, PriorSettings(gaussians=DENSE * len(prior.points), backing=0)
        )
        taken = seed_views(
            np.array([frame.camera.position for frame in dataset.frames]),
            prior.points.mean(0),
            views,
        )
        frames = [dataset.frames[i] for i in taken]
        g = texture(dense, frames)
        cameras, targets = (
            [frame.camera for frame in frames],
            [target_of(frame) for frame in frames],
        )
        for strength in (None, *STRENGTHS):
            start, ratio = initial_gaussians(prior, frames)[0], 1.0
            if strength is not None:
                start, ratio = start_of(prior, dense, g, strength, frames)
            model = fit(start, cameras, targets, cache=ListCache(), start=start, lam=lam).gaussians
            found = evaluate(model, tests.frames, ())["all"]
            record = {"gaussians": len(start), "asked": n, "strength": strength, "spacings": ratio}
            records.append(
                record | {key: found[key] for key in ("psnr", "psnr_mask", "psnr_inside")}
            )
            print(root, records[-1], flush=True)
    return records


def main(out: Path, *asked: str) -> None:
    """Measure and write."""
    runtime.start()
    scenes = []
    for root, _, views in (text.rpartition(":") for text in asked):
        scenes.append(
            {"dataset": root, "views": int(views), "records": study(Path(root), int(views))}
        )
    write_json(
        out,
        {
            "command": command_line(),
            "machine": runtime.processor(),
            "versions": versions(),
            "scenes": scenes,
        },
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
