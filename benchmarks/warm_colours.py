"""In whose colours should a fit start that goes on with more images? `python
benchmarks/warm_colours.py OUT.json DATASET...`

Takes views one by one, each the one farthest from those taken, and fits as `mgs nbv` does it. Three
ways: the Gaussians before training, where the prior holds the parameters, stay in the colours of
the seeds, as in the paper; they are in the mean colours of all images taken, and the model moves
with them (`mgs.prior.initial.warm_start`); or every fit starts anew from these, with
as many passes as the first. Judges on the test views: PSNR, in the full frame and inside the mask.
Datasets need test views.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mgs import runtime
from mgs.data.dataset import Dataset, load_dataset, target_of
from mgs.errors import InputError
from mgs.files import write_json
from mgs.gaussians import Gaussians
from mgs.policy.poses import farthest_pose, seed_views
from mgs.prior.build import Prior, build_prior
from mgs.prior.initial import warm_start
from mgs.prior.settings import PriorSettings
from mgs.provenance import command_line, versions
from mgs.run.operations import operations_of
from mgs.run.settings import NbvSettings

SEEDS = (1, 2, 4)
JUDGED = (6, 8, 12)
"""Numbers of images, after which the model is judged."""

GAUSSIANS = 10_000
WAYS = ("colours of the seeds", "colours of all images", "fitted anew")


def order_of_views(dataset: Dataset, centre: np.ndarray, seeds: int, most: int) -> list[int]:
    """The seeds, then each time the view that is farthest from those taken."""
    positions = np.array([frame.camera.position for frame in dataset.frames])
    taken = list(seed_views(positions, centre, seeds))
    while len(taken) < most:
        left = [i for i in range(len(positions)) if i not in taken]
        distance = farthest_pose(
            positions[left], positions[taken], centre, np.random.default_rng(0)
        )
        taken.append(left[int(np.argmax(distance))])
    return taken


def models(
    dataset: Dataset, prior: Prior, order: list[int], seeds: int, way: str
) -> Iterator[tuple[list[int], Gaussians]]:
    """Views taken, and the model fitted to them, for each number of images from the seeds on."""
    settings = NbvSettings(dataset=dataset.root, prior=dataset.root, seeds=seeds)
    stations = operations_of(dataset, prior, settings)
    of_seeds = before = model = stations.initial([dataset.frames[i] for i in order[:seeds]])
    for count in range(seeds, len(order) + 1):
        frames = [dataset.frames[i] for i in order[:count]]
        start = of_seeds if way == WAYS[0] else replace(of_seeds, sh=stations.initial(frames).sh)
        model, before = start if way == WAYS[2] else warm_start(model, before, start), start
        train = settings.train if way == WAYS[2] else settings.train_at(count - seeds)
        targets = [target_of(frame) for frame in frames]
        model = stations.fit(
            model, start, [f.camera for f in frames], targets, train, lambda done, most: None
        ).gaussians
        yield order[:count], model


def study(root: Path) -> list[dict[str, Any]]:
    """One record for each of SEEDS, WAYS and JUDGED."""
    dataset = load_dataset(root)
    if dataset.test_views() is None:
        raise InputError(
            f"{root}: has no test views; make it with `mgs synth-orbit --test-views 12`"
        )
    prior, _ = build_prior(dataset, PriorSettings(gaussians=GAUSSIANS))
    measure = operations_of(dataset, prior, NbvSettings(dataset=root, prior=root)).measure
    records = []
    for seeds in SEEDS:
        order = order_of_views(dataset, prior.points.mean(0), seeds, max(JUDGED))
        for way in WAYS:
            for taken, model in models(dataset, prior, order, seeds, way):
                if len(taken) in JUDGED:
                    found = measure(model, taken)
                    about = {"seeds": seeds, "way": way, "images": len(taken)}
                    records.append(
                        about | {key: found[f"test_{key}"] for key in ("psnr", "psnr_mask")}
                    )
                    print(root, records[-1], flush=True)
    return records


def main(out: Path, *roots: Path) -> None:
    """Measure and write."""
    runtime.start()
    scenes = [{"dataset": str(root), "records": study(root)} for root in roots]
    made = {"command": command_line(), "machine": runtime.processor(), "versions": versions()}
    write_json(out, made | {"gaussians": GAUSSIANS, "scenes": scenes})


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
