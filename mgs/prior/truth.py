"""How far a prior is from the true rock, where that is known."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mgs.data.dataset import Frame
from mgs.data.meshes import Mesh, distances_to_mesh, read_rock
from mgs.data.visibility import visible
from mgs.errors import InputError
from mgs.prior.segmentation import Rock
from mgs.seeds import derive_seed

TRUTH_SAMPLES = 50_000
"""Samples of the true rock that its errors are measured on."""


def error_to_truth(
    points: np.ndarray, spacing: float, mesh: Mesh, truth: Path, frames: Sequence[Frame], rock: Rock, seed: int
) -> dict[str, float]:
    """How far the prior is from the true rock, metres (Knapitsch et al. 2017 name accuracy and completeness).

    accuracy: mean distance of the prior's samples to the true surface; completeness: mean distance of the true surface that
    some frame sees to the prior's mesh; chamfer: their mean; hausdorff: the largest distance either way;
    visible_within_2_spacing: share of that visible surface within two spacings of the mesh; visible_share: share of the true
    surface above the ground that some frame sees.
    """
    import trimesh

    known = read_rock(truth)
    true = trimesh.Trimesh(known.vertices, known.faces, process=False)
    surface, face = trimesh.sample.sample_surface(true, TRUTH_SAMPLES, seed=derive_seed(seed, "prior/truth"))
    exposed = rock.plane.height(np.asarray(surface)) > 0
    surface, normals = np.asarray(surface)[exposed], true.face_normals[face[exposed]]
    tolerance = max(spacing / 2, 2 * rock.cloud.noise)
    seen = np.zeros(len(surface), bool)
    for frame in frames:
        # Two-sided: scanned rocks come with either winding.
        seen |= visible(surface, normals, frame.camera, frame.depth(), tolerance, two_sided=True)
    if not seen.any():
        raise InputError(f"{truth}: no frame sees the true rock; it does not belong to this dataset (or is in another frame)")
    there = distances_to_mesh(points, true.vertices, true.faces)
    back = distances_to_mesh(surface[seen], mesh.vertices, mesh.faces)
    return {
        "accuracy": float(there.mean()),
        "completeness": float(back.mean()),
        "chamfer": float((there.mean() + back.mean()) / 2),
        "hausdorff": float(max(there.max(), back.max())),
        "visible_within_2_spacing": float((back < 2 * spacing).mean()),
        "visible_share": float(seen.mean()),
    }
