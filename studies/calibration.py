"""Predict the errors of unseen views of runs and compare them with the true ones.

Writes RUN/diagnostics/uncertainty.json and uncertainty.png, and NAME.errors.exr with the true error
and the predicted standard deviation of some views (`studies.predicted_error`). This module measures
the predictions: its functions are of errors and of predicted standard deviations, both [n].

AUSE and the calibration follow the usual definitions for uncertainty maps (sparsification curves;
probability integral transform).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from mgs import runtime
from mgs.files import folder_locked
from studies.frame.program import Study, Work, study_of

Array = NDArray[np.floating]

LEVELS = (0.5, 0.9)
"""Shares of the errors that intervals should hold."""

STEPS = 100
"""Points of a sparsification curve: 0, 1, ..., 99 % of the pixels are left out."""

BINS = 20
"""Bins of the histogram of the probability integral transform."""

NORMAL = {level: float(ndtri(0.5 + level / 2)) for level in LEVELS}
"""Half-widths of intervals of a normal distribution, standard deviations."""


def sparsification(errors: Array, sigma: Array) -> Array:
    """Mean error without the pixels of the largest sigma, over the mean of all, [STEPS].

    errors: [n], 0 or more. If all errors are 0, the curve is 0.
    """
    total = errors.sum()
    if total == 0:
        return np.zeros(STEPS)
    left_out = (np.arange(STEPS) * len(errors)) // STEPS
    largest_first = errors[np.argsort(-sigma, kind="stable")]
    sums = np.concatenate([[0.0], np.cumsum(largest_first, dtype=np.float64)])
    curve: Array = (total - sums[left_out]) / (len(errors) - left_out) * (len(errors) / total)
    return curve


def ause(errors: Array, sigma: Array) -> float:
    """Area between the sparsification curves by sigma and by the errors [n] themselves."""
    return float((sparsification(errors, sigma) - sparsification(errors, errors)).mean())


def ause_of_constant(errors: Array) -> float:
    """AUSE of a constant sigma, which leaves out pixels at random: its curve is 1 in the mean."""
    return float((1 - sparsification(errors, errors)).mean())


@dataclass(frozen=True)
class Calibration:
    """Weights of the terms of a predicted variance, and widths of intervals.

    weights: by the name of a term; "noise" is a constant variance. widths: half-width of the
    interval of each of LEVELS, in sigmas.
    """

    weights: Mapping[str, float]
    widths: Mapping[float, float]

    def sigma(self, terms: Mapping[str, Array]) -> Array:
        """Standard deviations of the errors, of the shape of each term."""
        named = [weight * terms[name] for name, weight in self.weights.items() if name != "noise"]
        sigma: Array = np.sqrt(sum(named, np.full(1, self.weights["noise"])))
        return sigma


def fit_calibration(terms: Mapping[str, Array], errors: Array) -> Calibration:
    """Fit the weights by maximum likelihood: errors are normal, with the weighted sum of the terms
    as variance.

    terms: name -> [n], variances; errors: [n], signed. Widths are quantiles of |error| / sigma, so
    tails need not be normal.
    """
    from scipy.optimize import minimize  # here, as spearmanr below

    columns = np.stack([*terms.values(), np.ones(len(errors))], axis=1).astype(np.float64)
    scale = np.maximum(columns.mean(axis=0), np.finfo(np.float32).tiny)
    columns, squares = columns / scale, np.square(errors, dtype=np.float64)
    unit = max(float(squares.mean()), np.finfo(np.float32).tiny)

    def loss(logs: Array) -> tuple[float, Array]:
        weights = np.exp(logs)
        variance = columns @ weights
        slope = columns.T @ (1 / variance - squares / unit / variance**2) / len(squares)
        return float((np.log(variance) + squares / unit / variance).mean()), weights * slope

    count = columns.shape[1]
    first = np.full(count, -np.log(count))
    found = minimize(loss, first, jac=True, method="L-BFGS-B", bounds=[(-16.0, 4.0)] * count).x
    weights = dict(zip([*terms, "noise"], (np.exp(found) * unit / scale).tolist(), strict=True))
    z = np.abs(errors) / Calibration(weights, {}).sigma(terms)
    return Calibration(weights, {level: float(np.quantile(z, level)) for level in LEVELS})


def judged(
    errors: Array, sigma: Array, widths: Mapping[float, float], rng: np.random.Generator
) -> dict[str, Any]:
    """Measures of how well sigma [n] predicted the signed errors [n].

    - ause: of absolute errors, with that of a constant sigma, and of this sigma on errors drawn
      from it ("perfect").
    - spearman: rank correlation of sigma with the absolute error.
    - held: share of the errors inside the interval of each of LEVELS, over all pixels and over
      thirds of them by sigma.
    - pit: shares of the probability integral transform in BINS bins.
    """
    from scipy.stats import spearmanr  # here, because it takes 0.2 s

    size, drawn = np.abs(errors), np.abs(sigma * rng.standard_normal(len(sigma)))
    area = {"ause": ause(size, sigma), "constant": ause_of_constant(size)}
    z, order = errors / sigma, np.argsort(sigma, kind="stable")
    parts = (order, *np.array_split(order, 3))
    held = {
        str(level): [float((np.abs(z[part]) <= width).mean()) for part in parts]
        for level, width in widths.items()
    }
    return {
        "count": len(errors),
        "rms": float(np.sqrt(np.square(errors).mean())),
        "ause": area | {"perfect": ause(drawn, sigma)},
        "spearman": float(spearmanr(sigma, size).statistic) if np.ptp(sigma) > 0 else 0.0,
        "held": held,
        "pit": (np.histogram(ndtr(z), BINS, (0, 1))[0] / len(z)).tolist(),
    }


def write(work: Work) -> list[Path]:
    """Calibrate each run."""
    from studies.predicted_error import calibrate_run  # which imports this module

    runtime.start()
    paths = []
    for run in work.options.run:
        with folder_locked(run / "diagnostics"):
            paths += calibrate_run(run)
    return paths


RUNS = {"run": {"nargs": "+", "type": Path, "help": "Folders that `mgs nbv` wrote."}}
STUDY = Study("calibration", __doc__, write, options=RUNS)

if __name__ == "__main__":
    study_of("calibration")()
