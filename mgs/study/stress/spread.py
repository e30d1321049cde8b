"""How much models of few views depend on chance: on which splats are left out, and on the order in
which images are fitted.

Splats that make up for one another's errors in the views fitted give wrong images elsewhere
(co-adaptation). It is measured as
in the literature on few views: random halves of the splats are drawn, and the spread of these
images is the root of the mean variance of a pixel. Here images are divided by their alpha, which
half of the splats cannot fill; a pixel counts where alpha is above LEAST_ALPHA.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mgs.data.dataset import target_of
from mgs.gaussians import Gaussians
from mgs.metrics import masked_squares
from mgs.seeds import generator
from mgs.splat import render
from mgs.study.stress.experiment import Experiment, Panel, cells_per_rock, turns
from mgs.study.stress.lab import Array, Lab, open_lab
from mgs.study.stress.verdict import Claim, paired, single

DRAWS = 6
"""Random halves of the splats, and orders of the images."""

JUDGED = 6
"""Views on which spread and error are measured, of those that are not fitted."""

LEAST_ALPHA = 0.5


def images_of(lab: Lab, models: Sequence[Gaussians], views: Sequence[int]) -> Array:
    """[models,pixels,3] linear RGB over alpha, of the pixels inside the masks of some views where
    all models have enough."""
    found = []
    for view in views:
        renders = [render(model, lab.cameras[view], cache=lab.cache) for model in models]
        alpha = np.array([np.asarray(image.alpha) for image in renders])
        rgb = (
            np.array([np.asarray(image.rgb) for image in renders], np.float64)
            / np.maximum(alpha, LEAST_ALPHA)[..., None]
        )
        found.append(rgb[:, lab.frames[view].mask() & (alpha > LEAST_ALPHA).all(axis=0)])
    return np.concatenate(found, axis=1)


def spread_of(images: Array) -> float:
    """Root of the mean variance of a pixel value over the models; images as `images_of` returns
    them."""
    return float(np.sqrt(images.var(axis=0).mean()))


def spread(root: Path, out: Path, scene: str, turns_: int, counts: list[int]) -> dict[str, Any]:
    """Spread over halves of the splats before and after a fit, and over fits with other orders of
    the images; and the error."""
    lab, rows = open_lab(root, scene), []
    for suffix, turn in turns(turns_):
        for count in counts:
            taken = lab.even(count, turn)
            left = lab.left(taken)
            views = left[:: len(left) // JUDGED][:JUDGED]
            start, fits = (
                lab.start(taken),
                [lab.fit(taken, seed=seed).gaussians for seed in range(DRAWS)],
            )
            rng = generator(0, f"stress/spread/{scene}/{suffix}/{count}")
            halves = [rng.random(len(start)) < 0.5 for _ in range(DRAWS)]
            found = {
                "before the fit": spread_of(
                    images_of(lab, [start[half] for half in halves], views)
                ),
                "after the fit": spread_of(
                    images_of(lab, [fits[0][half] for half in halves], views)
                ),
                "other orders": spread_of(images_of(lab, fits, views)),
            }
            named, error = (
                {"run": f"{scene}, {suffix}", "views": count},
                error_of(lab, fits[0], views),
            )
            rows += [
                named | {"of": of, "spread": value, "error": error, "share": value / error}
                for of, value in found.items()
            ]
    return {"rows": rows}


def error_of(lab: Lab, model: Gaussians, views: Sequence[int]) -> float:
    """Root of the mean squared error inside the masks, linear RGB."""
    squares = [
        masked_squares(
            np.asarray(render(model, frame.camera, cache=lab.cache).rgb),
            target_of(frame),
            frame.mask(),
        )
        for frame in (lab.frames[view] for view in views)
    ]
    return float(np.sqrt(np.mean(np.concatenate(squares))))


SPREAD = Experiment(
    "How much do models of few views depend on chance?",
    cells_per_rock("spread", f"{__name__}:spread", lambda preset: {"turns_": preset.turns, "counts": list(preset.few_views)}),
    (
        Claim("A fit to 4 views makes splats lean on one another: random halves of them spread more than before it.",
              paired("spread", {"views": 4, "of": "after the fit"}, {"views": 4, "of": "before the fit"}),
              "linear RGB", "above", 0.0, "rock and set of views"),
        Claim("The fewer views, the more: after a fit to 2 views random halves spread more than after one to 8.",
              paired("spread", {"views": 2, "of": "after the fit"}, {"views": 8, "of": "after the fit"}),
              "linear RGB", "above", 0.0, "rock and set of views"),
        Claim("On 4 views, fits with other orders of the images spread by at most a tenth of their error.",
              single("share", {"views": 4, "of": "other orders"}), "share", "below", 0.1, "rock and set of views"),
    ),
    (
        Panel("views", "spread", "views", "spread (linear RGB)", "of"),
        Panel("views", "share", "views", "spread over rms error", "of"),
    ),
)  # fmt: skip
