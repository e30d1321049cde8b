"""How the ranking of candidates depends on lambda: `python benchmarks/lambda_ranking.py RUN
PREFIX`.

Scores every candidate of a run's last state by Eq. 7 with the default lambda (one number per kind
of parameter, see `mgs.policy.criteria.regularisation`) times 10^-8 ... 10^8, and with a single
number for all parameters, as in the paper; prints Spearman's rank correlation with the default's
ranking and which view would be chosen, and writes PREFIX.json and PREFIX.png.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from scipy.stats import spearmanr

from mgs import runtime
from mgs.data.dataset import load_dataset
from mgs.files import write_json
from mgs.policy import criteria
from mgs.run import folder as run_folder

FACTORS = 10.0 ** np.arange(-8, 9)
SINGLE = 10.0 ** np.arange(-12, 3)
"""Values found in public code lie between 4e-12 and 2."""


def main(run: Path, prefix: str) -> None:
    """Print the table, write it, draw the figure."""
    runtime.start()
    from mgs.provenance import command_line, versions
    from mgs.splat import fisher, groups

    settings, state = run_folder.read_settings(run), run_folder.read_checkpoint(run)
    if state is None:
        raise SystemExit(f"{run}: has no finished step")
    frames = load_dataset(settings.dataset).frames
    left = [i for i in range(len(frames)) if i not in state.taken]
    default = criteria.regularisation(groups(0), settings.pixel_noise, settings.prior_std)
    kinds = {
        "default times": [(f, f * default) for f in FACTORS],
        "single": [(s, np.full_like(default, s)) for s in SINGLE],
    }
    scores = {kind: np.empty((len(rows), len(left))) for kind, rows in kinds.items()}
    reference = np.empty(len(left))
    for column, i in enumerate(left):
        F = fisher(state.gaussians, frames[i].camera)
        reference[column] = criteria.d_optimal(F, state.H, default)
        for kind, rows in kinds.items():
            scores[kind][:, column] = [criteria.d_optimal(F, state.H, lam) for _, lam in rows]
    print(
        f"{len(state.taken)} images, {len(left)} candidates; default chooses {frames[left[int(reference.argmax())]].name}"
    )
    curves, found = {}, []
    for kind, rows in kinds.items():
        values, correlations = (
            [value for value, _ in rows],
            [spearmanr(row, reference).statistic for row in scores[kind]],
        )
        curves[kind] = values, correlations
        for value, correlation, row in zip(values, correlations, scores[kind], strict=True):
            best = frames[left[int(row.argmax())]].name
            print(
                f"{kind:14} {value:7.0e}  Spearman {correlation:+.3f}  chooses {best}  gain {row.max():.4g}"
            )
            found.append(
                {
                    "kind": kind,
                    "value": value,
                    "spearman": correlation,
                    "chosen": best,
                    "gain": row.max(),
                }
            )
    write_json(f"{prefix}.json", {"command": command_line(), "rows": found, "versions": versions()})
    draw(Path(f"{prefix}.png"), curves)


def draw(out: Path, curves: dict[str, tuple[list[float], list[float]]]) -> None:
    """Rank correlation against lambda."""
    import matplotlib

    from mgs.plotting import STYLE

    with matplotlib.rc_context(STYLE):
        from matplotlib.figure import Figure

        figure = Figure(figsize=(6.4, 2.8), dpi=150, layout="constrained")
        axes = figure.subplots(1, 2, sharey=True)
        labels = (
            r"$\lambda$ over the default (per kind of parameter)",
            r"one $\lambda$ for all parameters",
        )
        for axis, (values, correlations), label in zip(axes, curves.values(), labels, strict=True):
            axis.semilogx(values, correlations, "o-", color="#0072B2")
            axis.set(xlabel=label)
        axes[0].set(ylabel="rank correlation")
        figure.savefig(out)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
