"""What the backing is worth: `python benchmarks/backing.py DATASET PREFIX` writes PREFIX.json and
PREFIX.png.

Fits models of several sizes, with and without Gaussians behind the surface, to 12 views spread
evenly in azimuth, and
measures on the test views: PSNR inside the rock (pixels at least two from its silhouette), and the
shares of those pixels whose expected depth is more than 5 cm or more than 3 spacings too deep, or
whose opacity is below 0.9. The dataset needs exact depth.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import binary_erosion

from mgs import runtime
from mgs.colour import srgb_from_linear
from mgs.data.dataset import Frame, load_dataset, target_of
from mgs.files import write_json
from mgs.fit.fitting import fit
from mgs.fit.settings import TrainSettings
from mgs.gaussians import Gaussians
from mgs.metrics import psnr
from mgs.plotting import STYLE, new_figure, save_figure
from mgs.policy.criteria import lam_by_kind, regularisation
from mgs.policy.poses import seed_views
from mgs.prior.build import build_prior
from mgs.prior.initial import initial_gaussians
from mgs.prior.settings import PriorSettings
from mgs.provenance import command_line, versions
from mgs.splat import ListCache, groups, render

VIEWS = 12
SIZES = (2_500, 5_000, 10_000, 20_000, 40_000)
BACKINGS = (0.0, 0.5)
PASSES = (10, 100)
"""Passes of the fits; the longer one, of one size, shows what fitting on does."""
DEEP = 0.05
"""Metres."""
OPAQUE = 0.9


def measure(gaussians: Gaussians, frames: Sequence[Frame], spacing: float) -> dict[str, float]:
    """PSNR in dB and shares, over the pixels of the frames that lie inside the rock."""
    cache, decibels, pixels = ListCache(), [], []
    for frame in frames:
        image, depth = render(gaussians, frame.camera, cache=cache), frame.depth()
        inside = binary_erosion(frame.mask(), iterations=2)
        truth, rendered = (
            srgb_from_linear(frame.target()[0][..., :3]),
            srgb_from_linear(np.asarray(image.rgb)),
        )
        decibels.append(psnr(rendered, truth, inside))
        behind, alpha = (np.asarray(image.depth) - depth)[inside], np.asarray(image.alpha)[inside]
        pixels.append(np.stack([behind > DEEP, behind > 3 * spacing, alpha < OPAQUE], 1))
    shares = np.concatenate(pixels).mean(0)
    names = ("too_deep", "three_spacings_deep", "see_through")
    return {"psnr_inside": float(np.mean(decibels))} | dict(
        zip(names, shares.tolist(), strict=True)
    )


def study(root: Path) -> list[dict[str, Any]]:
    """One record per model: its size, backing, passes, and what `measure` says of it."""
    dataset = load_dataset(root)
    tests = dataset.test_views().frames
    frames, cache, lam = (
        dataset.frames,
        ListCache(),
        lam_by_kind(regularisation(groups(0)), groups(0)),
    )
    positions = np.array([frame.camera.position for frame in frames])
    settings = [(n, backing, PASSES[0]) for n in SIZES for backing in BACKINGS]
    settings += [(10_000, backing, PASSES[1]) for backing in BACKINGS]
    records = []
    for n, backing, passes in settings:
        prior, _ = build_prior(dataset, PriorSettings(gaussians=n, backing=backing))
        taken = seed_views(positions, prior.points.mean(0), VIEWS)
        chosen = [frames[i] for i in taken]
        start = initial_gaussians(prior, chosen)[0]
        train = TrainSettings(passes=passes, tolerance=0.0)
        cameras, targets = (
            [frame.camera for frame in chosen],
            [target_of(frame) for frame in chosen],
        )
        fitted = fit(start, cameras, targets, train, cache=cache, start=start, lam=lam).gaussians
        found = measure(fitted, tests, prior.spacing)
        records.append(
            {"gaussians": n, "backing": backing, "passes": passes, "spacing": prior.spacing} | found
        )
        print(records[-1], flush=True)
    return records


def draw(path: Path, records: Sequence[dict[str, Any]]) -> None:
    """PSNR and see-through against the number of Gaussians, a line a backing."""
    import matplotlib

    panels = (
        ("psnr_inside", "PSNR inside the rock, test views (dB)", 1),
        ("too_deep", "pixels more than 5 cm too deep (%)", 100),
    )
    with matplotlib.rc_context(STYLE):
        figure = new_figure(7.2, 3.1)
        for axis, (key, label, scale) in zip(figure.subplots(1, 2), panels, strict=True):
            for backing, colour, marker in zip(BACKINGS, ("#D55E00", "#0072B2"), "so", strict=True):
                shown = [r for r in records if r["backing"] == backing and r["passes"] == PASSES[0]]
                name = "all on the surface" if backing == 0 else "a third behind it"
                values = [scale * r[key] for r in shown]
                axis.plot(
                    [r["gaussians"] for r in shown], values, color=colour, marker=marker, label=name
                )
            axis.set(xscale="log", xlabel="Gaussians, on the surface and behind it", ylabel=label)
            axis.set_xticks(SIZES, labels=[f"{size:,}" for size in SIZES])
            axis.minorticks_off()
            axis.set_ylim(bottom=0 if scale == 100 else None)
            axis.legend()
        save_figure(figure, path)


def main(root: Path, prefix: Path) -> None:
    """Measure, write, draw."""
    runtime.start()
    records = study(root)
    result = {
        "command": command_line(),
        "machine": runtime.processor(),
        "versions": versions(),
        "records": records,
    }
    write_json(prefix.with_suffix(".json"), result)
    draw(prefix.with_suffix(".png"), records)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
