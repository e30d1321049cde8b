"""How far a prior is from the true rock, for datasets that hold the true rock (rock.glb)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mgs.data.dataset import Frame
from mgs.data.meshes import Mesh, distances_to_mesh, read_mesh
from mgs.data.visibility import visible
from mgs.errors import InputError
from mgs.prior.segmentation import SegmentedCloud
from mgs.seeds import derive_seed

TRUTH_SAMPLES = 50_000
"""Number of random points on the true rock whose distance to the prior is measured."""


def error_to_truth(
    points: np.ndarray,
    spacing: float,
    mesh: Mesh,
    truth: Path,
    frames: Sequence[Frame],
    segmented: SegmentedCloud,
    seed: int,
) -> dict[str, float]:
    """How far a prior is from the true rock, metres.

    points: [N,3] the prior's samples; spacing: theirs, metres; mesh: the prior's; truth: file of
    the true rock; frames: of the dataset, with depth; segmented: the cloud that the mesh was built
    from; seed: root of the random points.
    Returns these numbers, of which the first two are named as in Knapitsch et al. 2017:

    - accuracy: mean distance from the prior's samples to the true surface.
    - completeness: mean distance from the true surface, as far as some frame sees it, to the
    prior's mesh.
    - chamfer: the mean of these two.
    - hausdorff: the largest distance in either direction.
    - visible_within_2_spacing: share of the true surface that some frame sees which is within two
    spacings of the mesh.
    - visible_share: share of the true surface above the ground that some frame sees.

    Raises InputError if the rock's file or a depth image cannot be read, or no frame sees the rock.
    """
    import trimesh

    known = read_mesh(truth)
    true = trimesh.Trimesh(known.vertices, known.faces, process=False)
    surface, face = trimesh.sample.sample_surface(
        true, TRUTH_SAMPLES, seed=derive_seed(seed, "prior/truth")
    )
    exposed = (
        np.ones(len(surface), bool)
        if segmented.plane is None
        else segmented.plane.height(np.asarray(surface)) > 0
    )
    surface, normals = np.asarray(surface)[exposed], true.face_normals[face[exposed]]
    tolerance = max(spacing / 2, 2 * segmented.cloud.noise)
    seen = np.zeros(len(surface), bool)
    for frame in frames:
        # Both sides of a face count, because the faces of a scanned rock may be wound either way.
        seen |= visible(surface, normals, frame.camera, frame.depth(), tolerance, two_sided=True)
    if not seen.any():
        raise InputError(
            f"{truth}: no frame sees the true rock; it is another dataset's, or in another coordinate system"
        )
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
