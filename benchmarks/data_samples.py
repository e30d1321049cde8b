"""What are more samples a pixel of the data worth to a model? `python benchmarks/data_samples.py
OUT.json WORK [SCENE]`

A dataset of 16 frames of 320x240 is rendered with each number of samples, as `mgs synth-orbit
--spp` does, denoised; 10,000 Gaussians are fitted to all of its frames, at default settings, from
one and the same prior. All models are judged on the test views of one dataset with REFERENCE
samples a pixel, and on those of their own, as a user would judge them. Seconds are those of
rendering the frames, from the dataset's config.json; let nothing else run if they are to count. The
datasets are kept in WORK.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from mgs import runtime
from mgs.data.dataset import load_dataset, target_of
from mgs.files import read_json, write_json
from mgs.fit.fitting import fit
from mgs.fit.settings import TrainSettings
from mgs.policy.criteria import lam_by_kind, regularisation
from mgs.prior.build import build_prior
from mgs.prior.initial import initial_gaussians
from mgs.prior.settings import PriorSettings
from mgs.provenance import command_line, versions
from mgs.report.evaluation import evaluate
from mgs.splat import groups
from mgs.synth.rendering import Preset, synthesise

SAMPLES, REFERENCE = (1, 2, 4, 8, 16, 32), 128
SIZE, FRAMES, TESTS, GAUSSIANS = (320, 240), 16, 8, 10_000


def main(out: Path, work: Path, scene: str = "boulder") -> None:
    """Render, fit, write."""
    runtime.start()
    for samples in (REFERENCE, *SAMPLES):
        if not (work / str(samples) / "transforms.json").is_file():
            synthesise(work / str(samples), scene, Preset(*SIZE, FRAMES, samples), test_views=TESTS)
    judges = load_dataset(work / str(REFERENCE)).test_views().frames
    prior, _ = build_prior(load_dataset(work / str(REFERENCE)), PriorSettings(gaussians=GAUSSIANS))
    lam, records = lam_by_kind(regularisation(groups(0)), groups(0)), list[dict[str, Any]]()
    for samples in (*SAMPLES, REFERENCE):
        dataset = load_dataset(work / str(samples))
        frames = dataset.frames
        start, _ = initial_gaussians(prior, frames)
        cameras, targets = (
            [frame.camera for frame in frames],
            [target_of(frame) for frame in frames],
        )
        model = fit(start, cameras, targets, TrainSettings(), start=start, lam=lam).gaussians
        record: dict[str, Any] = {
            "samples": samples,
            "seconds": read_json(work / f"{samples}/config.json")["timings"],
        }
        for name, tests in (("reference", judges), ("own", dataset.test_views().frames)):
            found = evaluate(model, [], [], test_frames=tests)["test"]
            record |= {f"{name}_{key}": found[key] for key in ("psnr", "psnr_mask", "ssim")}
        records.append(record)
        print(record, flush=True)
    made = {"command": command_line(), "machine": runtime.processor(), "versions": versions()}
    write_json(out, made | {"scene": scene, "records": records})


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), *sys.argv[3:])
