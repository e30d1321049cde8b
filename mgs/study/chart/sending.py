"""Bytes against accuracy: what a drone would send, its images or its model, and how finely the
model's numbers need be told.

Both sides are taken to have the prior, so the means and the start of scales, rotations and
opacities. Sent are the differences from these, and colours as differences from their mean. A number
is sent as a whole multiple of a *step*. The image errs by J delta where the parameters err by
delta, so its expected squared error is the sum of H_i step_i^2 / 12: for as many bits it is least
where all terms are equal, so for steps proportional to 1 / sqrt(H + lambda) (Gersho and Gray 1992,
high resolution).

The number of bytes is estimated as the empirical entropy of the whole numbers, each column (and the
exponents) by itself: what an adaptive arithmetic coder comes close to, without its tables and
headers.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mgs.data.dataset import load_dataset
from mgs.fit.settings import COLOURS_ALONE
from mgs.gaussians import Gaussians
from mgs.policy.criteria import PIXEL_NOISE
from mgs.study.chart.pareto import pareto_front
from mgs.study.chart.plan import DENSITY, PLANS, Data, Plan
from mgs.study.chart.subject import quality
from mgs.study.sweep import Cell

Array = NDArray[np.float64]


def entropy_bytes(symbols: NDArray[np.integer]) -> float:
    """Empirical entropy of whole numbers [N] times their count, bytes."""
    counts = np.unique(symbols, return_counts=True)[1]
    return float(-(counts * np.log2(counts / counts.sum())).sum() / 8)


def as_matrix(gaussians: Gaussians) -> Array:
    """[N,11] the learned parameters of Gaussians of degree 0, in the order of the columns of their
    information."""
    parts = [
        gaussians.sh[:, 0],
        gaussians.log_scales,
        gaussians.quats,
        gaussians.logit_opacities[:, None],
    ]
    return np.concatenate(parts, axis=1).astype(np.float64)


def as_gaussians(matrix: Array, means: NDArray[np.float32]) -> Gaussians:
    """The way back."""
    m = matrix.astype(np.float32)
    return Gaussians(means, m[:, 3:6], m[:, 6:10], m[:, 10], m[:, None, :3])


def one_step(H: Array, lam: Array) -> tuple[Array, float]:
    """(steps [N,P], their bytes): one step for each column, by its mean information, which is best
    for equal steps."""
    return np.broadcast_to(1 / np.sqrt(H.mean(0) + lam), H.shape), 0.0


def step_of_gaussian(H: Array, lam: Array) -> tuple[Array, float]:
    """A step for each column times a power of two for each Gaussian, which is sent: together about
    1 / sqrt(H + lam)."""
    log2 = -0.5 * np.log2(H + lam)
    column = np.median(log2, axis=0)
    exponents = np.rint((log2 - column).mean(axis=1))
    return np.exp2(column + exponents[:, None]), entropy_bytes(exponents.astype(np.int64))


def step_of_number(H: Array, lam: Array) -> tuple[Array, float]:
    """1 / sqrt(H + lam) itself, as if the receiver knew H: a bound, no code."""
    return 1 / np.sqrt(H + lam), 0.0


QUANTISERS: dict[str, Callable[[Array, Array], tuple[Array, float]]] = {
    "one step": one_step,
    "by H": step_of_gaussian,
    "by H, known": step_of_number,
}
"""Steps by name: (H [N,P], lam [P]) -> (steps for a factor of 1 [N,P], bytes to tell them)."""


def quantised(values: Array, base: Array, steps: Array) -> tuple[Array, float]:
    """(values rounded to whole multiples of the steps from the base, bytes of these multiples). All
    [N,P]."""
    symbols = np.rint((values - base) / steps)
    return base + symbols * steps, sum(
        entropy_bytes(column) for column in symbols.astype(np.int64).T
    )


def models(plan: Plan) -> list[tuple[float, int]]:
    """(density, images) of the models that are sent."""
    pairs = [(d, plan.images) for d in plan.densities] + [(DENSITY, n) for n in plan.image_counts]
    return list(dict.fromkeys(pairs))


def cells(plan: Plan, data: Data, preset: str) -> list[Cell]:
    """A cell for each model. preset: the name of the plan."""
    found = {cell.name: cell for cell in data.cells}
    for density, images in models(plan):
        prior = data.prior(density)
        arguments = {
            "dataset": data.folder,
            "prior": f"cells/{prior.name}/prior",
            "images": images,
            "preset": preset,
        }
        name = cell_name(data, density, images)
        found |= {
            prior.name: prior,
            name: Cell(name, "mgs.study.chart.sending:measure", arguments, (prior.name,)),
        }
    return list(found.values())


def cell_name(data: Data, density: float, images: int) -> str:
    """The name of the cell of a model."""
    return f"bytes/{data.label}/d{1 / density:g}-i{images}"


def measure(
    root: Path, out: Path, dataset: str, prior: str, images: int, preset: str
) -> dict[str, Any]:
    """Fit a model to images spread evenly in azimuth, and send it in every way.

    Returns rows: what is sent ("images" as their files, or "model"), quantiser and step (times
    sigma_e / sqrt(H + lambda)), bytes, and the qualities of the model as received.
    """
    from mgs.prior.build import load_prior
    from mgs.run.folder import read_settings
    from mgs.run.nbv import run_nbv
    from mgs.run.operations import operations_of

    data, run = load_dataset(root / dataset), out / "run"
    shutil.rmtree(run, ignore_errors=True)  # what an interrupted call left
    state = run_nbv(
        root / dataset, run, prior=root / prior, seeds=images, budget=0, train=COLOURS_ALONE
    )
    settings = read_settings(run)
    stations = operations_of(data, load_prior(root / prior), settings)
    lam, model = settings.regularisation(stations.groups), as_matrix(state.gaussians)
    start = as_matrix(stations.initial([data.frames[i] for i in state.taken]))
    start[:, :3] = model[:, :3].mean(0)
    sent = sum(data.frames[i].image_path.stat().st_size for i in state.taken)
    exact = quality(state.gaussians, data)
    rows: list[dict[str, Any]] = [
        {"sent": "images", "quantiser": "PNG", "step": 0.0, "bytes": float(sent), **exact},
        {"sent": "model", "quantiser": "float32", "step": 0.0, "bytes": 4.0 * model.size, **exact},
    ]
    for name, quantiser in QUANTISERS.items():
        steps, told = quantiser(state.H.astype(np.float64), lam)
        for factor in PLANS[preset].step_sizes:
            received, bytes_ = quantised(model, start, factor * PIXEL_NOISE * steps)
            quality_then = quality(as_gaussians(received, state.gaussians.means), data)
            rows.append(
                {
                    "sent": "model",
                    "quantiser": name,
                    "step": factor,
                    "bytes": bytes_ + told,
                    **quality_then,
                }
            )
    return {"rows": rows, "gaussians": len(model)}


def rows(plan: Plan, data: Data, found: dict[str, Any], command: str) -> list[dict[str, Any]]:
    """A row for each model and way to send it; front: whether it lies on the front of bytes against
    PSNR, bounds left out."""
    made = []
    for density, images in models(plan):
        result = found[cell_name(data, density, images)]
        about = {"density": density, "gaussians": result["gaussians"], "images": images}
        made += [about | row | {"command": command} for row in result["rows"]]
    costs = [np.nan if row["quantiser"] == "by H, known" else row["bytes"] for row in made]
    front = pareto_front(costs, [row["psnr"] for row in made])
    return [row | {"front": bool(on)} for row, on in zip(made, front, strict=True)]
