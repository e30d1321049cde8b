"""Chart how the `hutchinson` estimate of diag(JᵀJ) approaches `exact` with the number of probes.

    python benchmarks/hutchinson.py docs/benchmarks/hutchinson

Writes PREFIX.png and PREFIX.json. Scene: 1,000 Gaussians of a rock at 64x48; relative L2 error over
all 11,000 entries, each of five seeds; a fit of the slope over 1 to 256 probes, expected -1/2.
"""

import sys

import matplotlib
import numpy as np

from mgs import runtime

runtime.start()

from mgs.bench.core import surface_camera, surface_gaussians  # noqa: E402
from mgs.bench.growth import exponent  # noqa: E402
from mgs.files import write_json  # noqa: E402
from mgs.plotting import STYLE, new_figure, save_figure  # noqa: E402
from mgs.provenance import command_line, versions  # noqa: E402
from mgs.splat import ListCache, as_drjit, fisher  # noqa: E402
from mgs.splat.information import hutchinson  # noqa: E402

PROBES = (1, 4, 16, 64, 256)
SEEDS = range(5)


def main(prefix: str) -> None:
    gaussians = surface_gaussians(1000)
    camera, cache = surface_camera(gaussians, 64, 48), ListCache()
    exact = fisher(gaussians, camera, "exact", cache=cache)
    device = as_drjit(gaussians)
    errors = [
        [
            float(
                np.linalg.norm(
                    hutchinson(device, camera, (0, 0, 0), cache, probes=k, seed=seed) - exact
                )
                / np.linalg.norm(exact)
            )
            for k in PROBES
        ]
        for seed in SEEDS
    ]
    mean = np.mean(errors, axis=0)
    slope = exponent(list(PROBES), mean.tolist())
    write_json(
        f"{prefix}.json",
        {
            "command": command_line(),
            "probes": PROBES,
            "relative_l2": errors,
            "slope": slope,
            "versions": versions(),
        },
    )
    with matplotlib.rc_context(STYLE):
        figure = new_figure(4.6, 3.4)
        axis = figure.subplots()
        for row in errors:
            axis.loglog(PROBES, row, ".", color="#999999", ms=5)
        axis.loglog(
            PROBES,
            mean,
            "o-",
            color="#0072b2",
            label=f"mean of {len(errors)} seeds, slope {slope:.2f}",
        )
        axis.loglog(PROBES, mean[0] / np.sqrt(PROBES), "--", color="#d55e00", label=r"$1/\sqrt{k}$")
        axis.set(xlabel="probes k", ylabel=r"relative $L_2$ error of diag($J^\top J$)")
        axis.legend()
        save_figure(figure, f"{prefix}.png")
    print(f"slope {slope:.3f}; error with 256 probes {mean[-1]:.3f}")


if __name__ == "__main__":
    main(sys.argv[1])
