"""What if the fit's colours depended on the direction, too? `python benchmarks/fitted_degree.py
OUT.json DATASET:PRIOR...`

`directional-i` chooses by colours that depend on the direction, while the fit gives each Gaussian
one. Here the model is fitted with spherical harmonics of degree 0, 1 and 2, each coefficient above
degree 0 with a prior TAU times as wide as that of degree 0, and `d-optimal` scores all of them at
the fitted model. For every degree: runs of four seeds and eight views by several policies; PSNR
over the test views of the model they end with, and of a model of degree 0 that is fitted to the
same views from the start, which says what the choice alone is worth. The runs are the loop's own,
with another model. Records that are in OUT.json are not made again.
"""

from __future__ import annotations

import json
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mgs import runtime
from mgs.data.dataset import load_dataset
from mgs.files import write_json
from mgs.fit.fitting import fit
from mgs.fit.settings import TrainSettings
from mgs.policy.criteria import lam_by_kind
from mgs.policy.directional import precision
from mgs.prior.build import load_prior
from mgs.provenance import command_line, versions
from mgs.run.loop import Loop, Stations
from mgs.run.operations import operations_of, psnr_measure
from mgs.run.settings import NbvSettings
from mgs.splat import ListCache, fisher, groups
from mgs.study.material import test_views_of

DEGREES, TAU = (0, 1, 2), 0.3
POLICIES = ("d-optimal", "directional-i", "uniform", "farthest")
SEEDS, BUDGET = 4, 8


def with_degree(
    stations: Stations, settings: NbvSettings, degree: int
) -> tuple[Stations, np.ndarray]:
    """Stations whose model has colours of that degree, and lambda [P] of its parameters."""
    cache, columns = ListCache(), groups(degree)
    lam = settings.regularisation(columns)
    by_degree = precision(degree, TAU, lam[0])  # [K]
    lam[columns["colour"]] = np.repeat(by_degree, 3)
    by_kind: dict[str, float | np.ndarray] = {
        **lam_by_kind(lam, columns),
        "colour": by_degree[None, :, None],
    }
    changed = replace(
        stations,
        groups=columns,
        initial=lambda frames: stations.initial(frames).with_degree(degree),
        fit=lambda model, start, cameras, targets, train, told: fit(
            model, cameras, targets, train, told, cache, start, by_kind
        ),
        fisher=lambda model, camera: fisher(model, camera, cache=cache),
        exact=lambda model, camera: fisher(model, camera, cache=cache),
        look=None,
    )
    return changed, lam


def record(dataset_path: Path, prior_path: Path, degree: int, policy: str) -> dict[str, Any]:
    """One run: PSNR of its model, and of one of degree 0 fitted to the same views; full frame and
    inside the mask."""
    dataset, prior = load_dataset(dataset_path), load_prior(prior_path)
    settings = NbvSettings(
        dataset=dataset_path, prior=prior_path, policy=policy, seeds=SEEDS, budget=BUDGET
    )
    plain = operations_of(dataset, prior, settings)
    stations, lam = with_degree(plain, settings, degree)
    with tempfile.TemporaryDirectory() as folder:
        loop = Loop(Path(folder), settings, dataset, stations, lambda stage, done, total: None)
        loop.lam = lam
        state = loop.first()
        while "ended" not in state.steps[-1]:
            state = loop.next(state)
    judge = psnr_measure(test_views_of(dataset), ListCache())
    frames = [dataset.frames[i] for i in state.taken]
    start, cameras = plain.initial(frames), [frame.camera for frame in frames]
    again = plain.fit(
        start, start, cameras, loop.targets(state.taken), TrainSettings(), lambda done, most: None
    )
    own, same_views = judge(state.gaussians, []), judge(again.gaussians, [])
    return {
        "dataset": str(dataset_path), "degree": degree, "policy": policy, "taken": state.taken,
        "psnr": own["psnr"], "psnr_mask": own["psnr_mask"],
        "degree_0_psnr": same_views["psnr"], "degree_0_psnr_mask": same_views["psnr_mask"],
    }  # fmt: skip


def main(out: Path, given: list[str]) -> None:
    """Make what is missing, write after every record."""
    runtime.start()
    records = json.loads(out.read_text())["records"] if out.is_file() else []
    for dataset, prior in (pair.split(":") for pair in given):
        for degree in DEGREES:
            for policy in POLICIES:
                if any(
                    (r["dataset"], r["degree"], r["policy"]) == (dataset, degree, policy)
                    for r in records
                ):
                    continue
                records.append(record(Path(dataset), Path(prior), degree, policy))
                print(records[-1], flush=True)
                made = {
                    "command": command_line(),
                    "machine": runtime.processor(),
                    "versions": versions(),
                }
                write_json(out, made | {"records": records})


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
