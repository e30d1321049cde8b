"""The paper's Eq. 13, tested: `python benchmarks/single_seed.py RUN OUT.png`, RUN made with `mgs
nbv ... --seeds 1 --budget 0`.

The paper expects that after a single seed the gain of a view is near zero where it sees only
unobserved Gaussians, so that the drone stays pinned near its first image. Prints and draws Eq. 7 of
every candidate against its azimuth from the seed, with the exact diagonal of J^T J, with
Hutchinson's estimate of it, with the exact 11x11 blocks, and with squared gradients of one scalar
loss per image (Eq. 7 to the letter).
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from mgs import runtime
from mgs.data.dataset import load_dataset
from mgs.policy import criteria
from mgs.policy import poses as pose_policies
from mgs.prior.build import load_prior
from mgs.run import folder as run_folder

ESTIMATORS = {
    "exact": "exact $J^TJ$", "hutchinson": "Hutchinson's estimate", "block": "exact blocks",
    "loss-gradient": "squared gradient of a scalar loss",
}  # fmt: skip


def main(run: Path, out: Path) -> None:
    """Print the table, draw the figure."""
    runtime.start()
    from mgs.splat import fisher, groups

    settings, state = run_folder.read_settings(run), run_folder.read_checkpoint(run)
    if state is None or len(state.taken) != 1:
        raise SystemExit(f"{run}: is not a run of one seed; make it with --seeds 1 --budget 0")
    frames = load_dataset(settings.dataset).frames
    lam = criteria.regularisation(groups(0), settings.pixel_noise, settings.prior_std)
    angles = pose_policies.azimuths(
        np.array([f.camera.position for f in frames]), load_prior(settings.prior).points.mean(0)
    )
    away = np.degrees((angles - angles[state.taken[0]] + np.pi) % (2 * np.pi) - np.pi)
    left = [i for i in np.argsort(away) if i != state.taken[0]]
    gains: dict[str, np.ndarray] = {}
    means: dict[str, float] = {}
    for estimator in ESTIMATORS:

        def information(i: int, estimator: str = estimator) -> np.ndarray:
            return fisher(state.gaussians, frames[i].camera, estimator=estimator).astype(np.float64)

        H = information(state.taken[0])
        if estimator == "block":
            before = criteria.block_log_determinant(H, lam)
            gains[estimator] = np.array(
                [criteria.block_log_determinant(H + information(i), lam) - before for i in left]
            )
            continue
        means[estimator] = float(H.mean())
        scaled = (
            lam * means[estimator] / means["exact"]
        )  # lambda in the units of a mean loss, which it would swamp otherwise
        gains[estimator] = np.array([criteria.d_optimal(information(i), H, scaled) for i in left])
    for k, i in enumerate(left):
        print(
            f"{frames[i].name}  {away[i]:+6.0f} degrees  "
            + "  ".join(f"{e} {g[k]:.4f}" for e, g in gains.items())
        )
    draw(out, away[left], gains)


def draw(out: Path, away: np.ndarray, gains: dict[str, np.ndarray]) -> None:
    """Gain against azimuth."""
    import matplotlib
    from matplotlib.figure import Figure

    from mgs.plotting import STYLE

    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(4.8, 3.2), dpi=150, layout="constrained")
        axis = figure.subplots()
        for (estimator, values), colour in zip(
            gains.items(), ("#0072B2", "#56B4E9", "#009E73", "#D55E00"), strict=True
        ):
            axis.plot(away, values / values.max(), "o-", color=colour, label=ESTIMATORS[estimator])
        axis.set(
            xlabel="azimuth from the seed (degrees)",
            ylabel="gain over the largest",
            ylim=(0, None),
            xticks=range(-180, 181, 60),
        )
        figure.legend(loc="outside lower center", ncols=2)
        figure.savefig(out)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
