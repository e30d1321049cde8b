"""What photographs lose against exact data: `python benchmarks/own_data.py DATASET OUT.json`.

Makes the data of strangers from an exact dataset (tools/photographs.py), imports them at half their
size, builds a prior by
each source that they offer, fits a model to 12 views spread evenly in azimuth, and measures PSNR on
the others: over all known pixels, and inside the rock. Beside each stands the same fit to the same
photographs from the exact prior, that of DATASET's depth turned into the world of the photographs,
with the true masks. The difference is what prior and masks lose.
"""

from __future__ import annotations

import importlib
import json
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mgs import runtime
from mgs.cli.dataset import UNCERTAINTY
from mgs.colour import srgb_from_linear
from mgs.data.dataset import Dataset, Frame, load_dataset, target_of
from mgs.data.importers import import_source
from mgs.data.masks import make_masks
from mgs.data.meshes import Mesh, distances_to_mesh, read_mesh
from mgs.data.sources import read_source
from mgs.data.up import upright
from mgs.files import write_json
from mgs.fit.fitting import fit
from mgs.fit.settings import TrainSettings
from mgs.metrics import psnr
from mgs.policy.poses import seed_views
from mgs.prior.build import Prior, build_prior
from mgs.prior.initial import initial_gaussians
from mgs.prior.settings import PriorSettings
from mgs.provenance import command_line, versions
from mgs.splat import ListCache, render

VIEWS = 12
GAUSSIANS = 4_000
DOWNSCALE = 2

GIVEN, PROJECTED, REFINED = "given", "of the prior", "of the prior, refined"
"""Where masks come from."""

WAYS = (
    ("colmap-binary", "points", GIVEN),
    ("colmap-binary", "hull", GIVEN),
    ("colmap-binary", "points", PROJECTED),
    ("colmap-binary", "points", REFINED),
    ("nerfstudio", "points", GIVEN),
    ("nerfstudio", "points", PROJECTED),
    ("nerfstudio", "points", REFINED),
    ("nerf-synthetic", "hull", GIVEN),
    ("rgbd", "depth", GIVEN),
)
"""Kind of data, source of the prior, and where the masks come from."""


def photographs() -> Any:
    """tools/photographs.py, which is no part of the package."""
    sys.path.insert(0, str(Path(__file__).parent.parent / "tools"))
    return importlib.import_module("photographs")


def imported(data: Path, out: Path, masks: bool) -> Dataset:
    """The data as a dataset, with the true masks or without any."""
    source = read_source(data)
    if not masks:
        source = replace(
            source, shots=[replace(shot, mask=None, rock=None) for shot in source.shots]
        )
    given = data / "masks" if masks and source.kind != "NeRF-synthetic" else None
    return import_source(
        source, out, masks=given, downscale=DOWNSCALE, up=source.up_or_estimate()[0]
    )


def turned(prior: Prior, truth: dict[str, Any]) -> Prior:
    """A prior of the exact dataset in the world of the photographs."""
    R, scale, shift = np.array(truth["rotation"]), truth["scale"], np.array(truth["shift"])
    mesh = Mesh(scale * prior.mesh.vertices @ R.T + shift, prior.mesh.faces, prior.mesh.seen)
    points, normals = scale * prior.points @ R.T + shift, prior.normals @ R.T
    x, y, z = R[:, 2].tolist()
    spacing, tolerance = scale * prior.spacing, scale * prior.depth_tolerance
    return replace(
        prior,
        mesh=mesh,
        points=points,
        normals=normals,
        spacing=spacing,
        depth_tolerance=tolerance,
        up=(x, y, z),
    )


def fitted_psnr(prior: Prior, frames: Sequence[Frame], judged: Sequence[Frame]) -> dict[str, float]:
    """Held-out PSNR in dB of a model that is fitted to VIEWS of `frames`, against the same views of
    `judged`."""
    cache, turn = ListCache(), upright(prior.up)
    positions = np.array([frame.camera.position for frame in frames]) @ turn.T
    taken = seed_views(positions, turn @ prior.points.mean(0), VIEWS)
    chosen = [replace(frames[i], depth_path=None) for i in taken]
    start = initial_gaussians(prior, chosen)[0]
    model = fit(
        start,
        [f.camera for f in chosen],
        [target_of(f) for f in chosen],
        TrainSettings(),
        cache=cache,
    ).gaussians
    values = []
    for i in sorted(set(range(len(frames))) - set(taken)):
        rgba, weight = judged[i].target()
        image = srgb_from_linear(np.asarray(render(model, judged[i].camera, cache=cache).rgb))
        truth, known = srgb_from_linear(rgba[..., :3]), weight > 0
        values.append((psnr(image, truth, known), psnr(image, truth, known & judged[i].mask())))
    whole, rock = np.mean(values, 0).tolist()
    return {"psnr": whole, "psnr_rock": rock}


def overlap(frames: Sequence[Frame], judged: Sequence[Frame]) -> float:
    """Mean intersection over union of the masks of two lists of frames."""
    pairs = [(one.mask(), other.mask()) for one, other in zip(frames, judged, strict=True)]
    return float(np.mean([(a & b).sum() / (a | b).sum() for a, b in pairs]))


def way(data: Path, work: Path, kind: str, source: str, masks: str, exact: Prior) -> dict[str, Any]:
    """One record: a kind of data, the source of the prior, and where the masks come from."""
    settings, truth = (
        PriorSettings(gaussians=GAUSSIANS),
        json.loads((data / "truth.json").read_text()),
    )
    judged = imported(data, work / "judged", True)
    dataset = judged if masks == GIVEN else imported(data, work / "bare", False)
    prior, _ = build_prior(dataset, settings, source=source)
    record: dict[str, Any] = {"kind": kind, "from": source, "masks": masks}
    if masks != GIVEN:
        dataset = make_masks(
            dataset, prior.mesh, UNCERTAINTY * prior.depth_tolerance, refine=masks == REFINED
        )
        record["masks_overlap"] = overlap(dataset.frames, judged.frames)
    rock = read_mesh(data / "truth.ply")
    distance = distances_to_mesh(prior.points, rock.vertices, rock.faces) / truth["scale"]
    record["accuracy"], record["accuracy_p90"] = (
        float(distance.mean()),
        float(np.quantile(distance, 0.9)),
    )
    record["up_error"] = float(np.degrees(np.arccos(np.clip(np.dot(prior.up, truth["up"]), -1, 1))))
    best = fitted_psnr(turned(exact, truth), judged.frames, judged.frames)
    found = fitted_psnr(prior, dataset.frames, judged.frames)
    record |= found | {f"exact_{key}": value for key, value in best.items()}
    return record | {
        "loss": best["psnr"] - found["psnr"],
        "loss_rock": best["psnr_rock"] - found["psnr_rock"],
    }


def main(root: Path, out: Path) -> None:
    """Measure and write."""
    runtime.start()
    make, exact = (
        photographs(),
        build_prior(load_dataset(root), PriorSettings(gaussians=GAUSSIANS))[0],
    )
    records = []
    with tempfile.TemporaryDirectory() as folder:
        for kind in dict.fromkeys(kind for kind, _, _ in WAYS):
            make.make(root, Path(folder) / kind, kind)
        for k, (kind, source, masks) in enumerate(WAYS):
            records.append(
                way(Path(folder) / kind, Path(folder) / f"way{k}", kind, source, masks, exact)
            )
            print(records[-1], flush=True)
    result = {"command": command_line(), "machine": runtime.processor(), "versions": versions()}
    size = {"views": VIEWS, "gaussians": GAUSSIANS, "downscale": DOWNSCALE}
    write_json(out, result | size | {"records": records})


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
