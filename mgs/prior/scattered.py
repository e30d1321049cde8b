"""Random start: a prior for photographs whose object has no known surface. Points that came with
the cameras take the place of as many random ones."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from mgs.data.clouds import read_cloud, views_of
from mgs.data.dataset import Dataset
from mgs.data.frames import Frame
from mgs.data.meshes import Mesh
from mgs.data.structure import CLOUD
from mgs.data.visibility import has_masks, mask_share
from mgs.errors import InputError
from mgs.prior.points import MASK_SHARE, reliable
from mgs.prior.resolution import MOST_GAUSSIANS
from mgs.prior.settings import PriorSettings
from mgs.seeds import generator
from mgs.survey.fusion import focus

GAUSSIANS = 10_000  # fewest Gaussians where no number is given
PIXELS = 100  # of all images, in the masks, per Gaussian where no number is given. Chosen
# Most random points per point that came with the cameras where no number is given and these are
# many: they hide what is behind them, and a fit splits Gaussians where more are needed. A chosen
# constant.
MOST_RANDOM = 0.1
FAR = 10.0  # radius of the random background, over that of the ball that the cameras look at
DRAWS = 64  # draws per Gaussian after which too few lie inside the masks


def scattered(
    dataset: Dataset, settings: PriorSettings, shown: Sequence[Frame] | None = None
) -> tuple[Mesh, np.ndarray, np.ndarray, float, dict[str, Any]]:
    """Mesh, points [N,3], unit normals [N,3], spacing and items of prior.json of a random start.

    shown: the frames whose masks are read, by default all. Points fill the ball that all cameras
    see, about the point they look at, inside these masks if each has one. Otherwise half of them
    lie outside, evenly in the logarithm of their distance, as background. Well triangulated points
    of the dataset's cloud, in the masks, come first. The mesh is the ball; normals point outwards,
    those of the cloud to its cameras. Raises InputError if the settings shape a surface, or the
    masks share no point of the ball.
    """
    import trimesh  # here, because it takes 0.2 s and no other prior needs it

    shown = dataset.frames if shown is None else shown
    settings.refuse_shaping("a random start has no surface")
    gaussians, rng = settings.gaussians, generator(settings.seed, "prior/random")
    pixels = sum(int(frame.mask().sum()) for frame in shown)
    count = min(max(pixels // PIXELS, GAUSSIANS), MOST_GAUSSIANS)
    count = gaussians if isinstance(gaussians, int) else count
    cloud, views_of_cloud = _triangulated(dataset, shown, count, rng)
    if len(cloud) and not isinstance(gaussians, int):
        count = min(count, max(round((1 + MOST_RANDOM) * len(cloud)), GAUSSIANS))
    middle = focus(dataset.frames).point
    reach = [
        np.linalg.norm(frame.camera.position - middle)
        * np.sin(np.arctan(min(frame.camera.width, frame.camera.height) / 2 / frame.camera.K[0, 0]))
        for frame in dataset.frames
    ]
    radius, masked = float(np.median(reach)), has_masks(shown)
    parts, tries = [cloud], 0
    while sum(map(len, parts)) < count and tries < DRAWS * count:
        directions = rng.normal(size=(count, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        distance = rng.random(count) ** (1 / 3)
        if not masked:
            distance = np.where(rng.random(count) < 0.5, distance, FAR ** rng.random(count))
        points = middle + radius * distance[:, None] * directions
        share, views = mask_share(points, shown)
        parts.append(points[(views > 0) & (share >= MASK_SHARE)])
        tries += count
    points = np.concatenate(parts)[:count]
    if len(points) < count and len(cloud) and not masked:
        count = len(points)  # few places near what the cameras look at are in a picture
    if len(points) < count:
        raise InputError(
            f"{dataset.root}: only {len(points)} of {tries} random points lie inside all masks; "
            "poses and masks do not fit, correct or remove frames"
        )
    outwards = points - middle
    normals = outwards / np.maximum(np.linalg.norm(outwards, axis=1, keepdims=True), 1e-9)
    normals[: len(cloud)] = views_of_cloud
    spacing = float(np.median(cKDTree(points).query(points, 2)[0][:, 1]))
    ball = trimesh.creation.icosphere(3, radius)
    mesh = Mesh(ball.vertices + middle, ball.faces, np.ones(len(ball.faces), bool))
    numbers: dict[str, Any] = {"n": count, "triangulated": len(cloud), "spacing": spacing}
    numbers |= {"radius": radius, "depth_tolerance": 2 * radius, "backed": 0}
    numbers |= {"settings": asdict(settings)}
    return mesh, points, normals, spacing, numbers


def _triangulated(
    dataset: Dataset, shown: Sequence[Frame], most: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Reliable points [N,3] of the dataset's cloud, at most `most`, that lie in some of the frames
    shown and in all their masks, and unit directions to their cameras [N,3]; none without a cloud.
    """
    if not (dataset.root / CLOUD).is_file():
        return np.zeros((0, 3)), np.zeros((0, 3))
    cloud = read_cloud(dataset.root / CLOUD).upright(dataset.world)
    share, count = mask_share(cloud.points, shown)
    indices = np.flatnonzero(reliable(cloud) & (count > 0) & (share >= MASK_SHARE))
    indices = np.sort(rng.permutation(indices)[:most])
    views = views_of(cloud, [frame.camera for frame in dataset.frames])
    return cloud.points[indices], views[indices]
