"""Distance of a prior from the true rock, for datasets that hold it (rock.glb)."""

from pathlib import Path

import numpy as np

from mgs.data.dataset import Dataset
from mgs.data.meshes import Mesh, distances_to_mesh, read_mesh
from mgs.data.visibility import visible
from mgs.errors import InputError
from mgs.prior.segmentation import SegmentedCloud
from mgs.seeds import derive_seed

TRUTH_SAMPLES = 50_000  # random points on the true rock whose distance to the prior is measured


def error_to_truth(
    points: np.ndarray,
    spacing: float,
    mesh: Mesh,
    truth: Path,
    dataset: Dataset,
    segmented: SegmentedCloud,
    seed: int,
) -> dict[str, float]:
    """Distances between a prior and the true rock, metres.

    points: [N,3] samples, `spacing` metres apart; truth: file of the rock; dataset: with depth;
    segmented: the cloud of the mesh; seed: root of the random points. Returns:

    - accuracy, completeness (Knapitsch et al. 2017): mean distance from the samples to the true
      surface, and from the seen true surface to the mesh;
    - chamfer: the mean of the two; hausdorff: the largest distance in either direction;
    - visible_within_2_spacing: share of the seen true surface within two spacings of the mesh;
    - visible_share: share of the true surface above the ground that some frame sees.

    Raises InputError if the rock's file or a depth image cannot be read, or no frame sees the rock.
    """
    import trimesh

    rock = read_mesh(truth)
    vertices = dataset.world.enter(rock.vertices)
    true = trimesh.Trimesh(vertices, rock.faces, process=False)
    sample_seed = derive_seed(seed, "prior/truth")
    surface, face = trimesh.sample.sample_surface(true, TRUTH_SAMPLES, seed=sample_seed)
    surface, normals = np.asarray(surface), true.face_normals[face]
    if segmented.plane is not None:
        exposed = segmented.plane.height(surface) > 0
        surface, normals = surface[exposed], normals[exposed]
    tolerance = max(spacing / 2, 2 * segmented.cloud.noise)
    seen = np.zeros(len(surface), bool)
    for frame in dataset.frames:
        # Faces of a scanned rock may be wound either way.
        seen |= visible(surface, normals, frame.camera, frame.depth(), tolerance, two_sided=True)
    if not seen.any():
        cure = "it is of another dataset or in other coordinates, so remove or replace it"
        raise InputError(f"{truth}: no frame sees the true rock; {cure}")
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
