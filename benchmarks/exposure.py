"""What `mgs nbv --exposure` brings: `python benchmarks/exposure.py DATASET OUT.json`.

Photographs of an exact dataset as a COLMAP model (tools/photographs.py), of constant exposure and
of exposure and white balance that differ, are imported at half their size with their true masks. A
model is fitted to 12 views spread evenly in azimuth,
without and with gains, and judged on the other 20: by PSNR inside the rock as it is, and after a
gain per channel is fitted to each of these views, because nobody knows their exposure. The gains
that were found are compared with the true ones.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from own_data import photographs

from mgs import runtime
from mgs.data.importers import import_source
from mgs.data.sources import read_source
from mgs.files import write_json
from mgs.fit.settings import COLOURS_ALONE
from mgs.prior.build import build_prior, save_prior
from mgs.prior.settings import PriorSettings
from mgs.provenance import command_line, versions
from mgs.report.evaluation import evaluate_run
from mgs.run.nbv import run_nbv

VIEWS, GAUSSIANS, DOWNSCALE = 12, 4_000, 2

STOPS = (0.0, 0.3, 1.0)
"""By how much exposure differs at most, more or less; white balance by a third of that."""


def gain_errors(found: dict[str, list[float]], true: dict[str, list[float]]) -> dict[str, float]:
    """Errors of gains, shares, after both have a geometric mean of 1: their rms and the largest."""
    logs = [np.log([of.get(name, [1.0] * 3) for name in found]) for of in (found, true)]
    errors = np.subtract(*(log - log.mean(axis=0) for log in logs))
    return {
        "gain_rms": float(np.sqrt(np.mean(errors**2))),
        "gain_worst": float(np.abs(errors).max()),
    }


def records(data: Path, work: Path, stops: float) -> list[dict[str, Any]]:
    """Two records: a fit without gains, and one with."""
    source = read_source(data)
    dataset = import_source(
        source, work / "d", masks=data / "masks", downscale=DOWNSCALE, up=source.up_or_estimate()[0]
    )
    save_prior(work / "d/prior", build_prior(dataset, PriorSettings(gaussians=GAUSSIANS))[0])
    true, rows = json.loads((data / "truth.json").read_text())["gains"], []
    for exposure in (False, True):
        out = work / f"run{exposure}"
        state = run_nbv(
            work / "d",
            out,
            policy="uniform",
            seeds=VIEWS,
            budget=0,
            exposure=exposure,
            train=COLOURS_ALONE,
        )
        metrics = evaluate_run(out, pictures=False)["held_out"]
        row = {"stops": stops, "exposure": exposure}
        row |= {key: metrics[key] for key in ("psnr_mask", "psnr_mask_corrected")}
        rows.append(row | (gain_errors(state.steps[-1]["exposure"], true) if exposure else {}))
    return rows


def main(root: Path, out: Path) -> None:
    """Measure and write."""
    runtime.start()
    make, rows = photographs(), []
    with tempfile.TemporaryDirectory() as folder:
        for k, stops in enumerate(STOPS):
            make.make(root, Path(folder) / f"photos{k}", "colmap-binary", 0, stops)
            rows += records(Path(folder) / f"photos{k}", Path(folder) / f"work{k}", stops)
            print(*rows[-2:], sep="\n", flush=True)
    result = {"command": command_line(), "machine": runtime.processor(), "versions": versions()}
    size = {"views": VIEWS, "gaussians": GAUSSIANS, "downscale": DOWNSCALE}
    write_json(out, result | size | {"records": rows})


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
