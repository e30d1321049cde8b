"""Do views that are left out say whether colours depend on the direction? `python
benchmarks/left_out.py OUT.json FOLDER`

Rocks are rendered into FOLDER, matt ones and the same rocks shining. Each is fitted with colours of
degree 0 and of degree 1, to some views spread evenly in azimuth, and both models are judged on test
views from all sides, which no rule sees. Beside that stands what
`mgs.report.evidence.directional_gain` says from the views that are fitted alone: blocks of
neighbours are left out. And for comparison the same with every BLOCKS-th view left out together,
each of which lies between others that are fitted.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mgs import runtime
from mgs.files import write_json
from mgs.fit.settings import TrainSettings
from mgs.policy.poses import seed_views
from mgs.provenance import command_line, versions
from mgs.report.evaluation import evaluate
from mgs.report.evidence import BLOCKS, LeftOut, directional_gain, fitted, last_images
from mgs.run.settings import NbvSettings
from mgs.splat import ListCache
from mgs.study.material import made_dataset, made_prior, test_views_of
from mgs.synth.scene_file import load_scene_file

ROCKS = (("boulder", 0), ("strata", 1), ("pebbles", 2), ("contact-binary", 0))
"""Scenes and seeds."""

MATERIALS: dict[str, dict[str, float]] = {
    "matt": {},
    "shining": {"specular": 0.5, "roughness": 0.3},
}
"""Keys of [rock] of a scene file."""

WIDTH, HEIGHT, FRAMES, TESTS, SAMPLES = 160, 120, 16, 6, 8
VIEWS = (8, 16)


def judged(root: Path, scene: str, seed: int, material: str) -> list[dict[str, Any]]:
    """A record for each number of views of a rock."""
    from mgs.synth.rendering import Preset

    loaded, folder = load_scene_file(scene), root / f"{scene}-{seed}-{material}"
    loaded = loaded.model_copy(update={"rock": loaded.rock.model_copy(update=MATERIALS[material])})
    dataset = made_dataset(
        folder / "data", loaded, Preset(WIDTH, HEIGHT, FRAMES, SAMPLES), seed, TESTS
    )
    prior = made_prior(folder / "prior", folder / "data", gaussians="auto", seed=seed)
    positions, tests, records = (
        np.array([frame.camera.position for frame in dataset.frames]),
        test_views_of(dataset),
        [],
    )
    for views in VIEWS:
        frames = [dataset.frames[i] for i in seed_views(positions, prior.points.mean(0), views)]
        settings = NbvSettings(
            dataset=folder / "data", prior=folder / "prior", seeds=views, train=TrainSettings()
        )
        images, cache = last_images(settings, prior, frames), ListCache()
        models = [fitted(images, range(views), settings, degree, cache) for degree in (0, 1)]
        psnr = [
            evaluate(model, (), (), test_frames=tests.frames)["test"]["psnr_inside"]
            for model in models
        ]
        between = replace(
            images, order=[i for first in range(BLOCKS) for i in images.order[first::BLOCKS]]
        )
        records.append({
            "rock": f"{scene} {seed}", "material": material, "views": views, "psnr": psnr,
            "blocks": _numbers(directional_gain(images, settings, cache)),
            "between": _numbers(directional_gain(between, settings, cache)),
        })  # fmt: skip
        print(records[-1], flush=True)
    return records


def _numbers(found: LeftOut) -> dict[str, float | bool]:
    return {"gain": found.gain, "error": found.error, "pays": found.pays}


def main(out: Path, root: Path) -> None:
    """Measure and write."""
    runtime.start()
    records = [
        record
        for material in MATERIALS
        for rock in ROCKS
        for record in judged(root, *rock, material)
    ]
    about = {"command": command_line(), "machine": runtime.processor(), "versions": versions()}
    write_json(out, about | {"records": records})


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
