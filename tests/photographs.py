"""COLMAP's data of an exact dataset, with the errors of real photographs."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import synthetic
from PIL import Image
from scipy.spatial.transform import Rotation

from mgs.camera import Camera
from mgs.colour import srgb_from_linear
from mgs.data.dataset import Dataset
from mgs.images import write_png
from mgs.synth.orbit import perturb

DISTORTION = np.array([-0.10, 0.03, 0.001, -0.0007])
"""k1 k2 p1 p2 of the lens."""
SCALE, SHIFT = 0.37, np.array([2.0, -1.0, 0.5])
TURN = Rotation.from_rotvec([1.9, -0.7, 0.4]).as_matrix()
"""Similarity from the dataset to the world of COLMAP: SCALE * TURN @ x + SHIFT."""


def make(dataset: Dataset, out: Path) -> None:
    """Write distorted JPEG files (images), true masks (masks) and a sparse model (sparse/0)."""
    import pycolmap

    rng = np.random.default_rng(0)
    found = perturb([frame.camera for frame in dataset.frames], 0.0015, 0.03, rng)
    frames = [
        replace(frame, camera=camera, image_path=frame.image_path.with_suffix(".jpg"))
        for frame, camera in zip(dataset.frames, found, strict=True)
    ]
    synthetic.write_colmap(replace(dataset, frames=tuple(frames)), out, True)
    model = pycolmap.Reconstruction(out / "sparse/0")
    spoil_points(model, rng)
    lens = model.cameras[1]
    lens.model, lens.params = pycolmap.CameraModelId.OPENCV, [*lens.params, *DISTORTION]
    model.transform(pycolmap.Sim3d(SCALE, pycolmap.Rotation3d(TURN), SHIFT))
    model.write_binary(out / "sparse/0")

    (out / "images").unlink()
    (out / "images").mkdir()
    for frame in dataset.frames:
        pixels = distorted(np.round(srgb_from_linear(frame.rgb()) * 255), frame.camera)
        pixels = np.clip(pixels, 0, 255).astype(np.uint8)
        Image.fromarray(pixels).save(out / f"images/{frame.name}.jpg", quality=92)
        mask = distorted(frame.mask().astype(np.float32), frame.camera) >= 0.5
        write_png(out / f"masks/{frame.name}.png", mask)


def distorted(image: np.ndarray, camera: Camera) -> np.ndarray:
    """An image as the lens shows it."""
    K = camera.K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]  # OpenCV counts from pixel centres
    grid = np.stack(np.indices(image.shape[:2])[::-1], -1).reshape(-1, 1, 2).astype(np.float64)
    source = cv2.undistortPoints(grid, K, DISTORTION, P=K).astype(np.float32)
    x, y = source.reshape(*image.shape[:2], 2).transpose(2, 0, 1)
    return cv2.remap(image, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def spoil_points(model, rng: np.random.Generator) -> None:
    """Keep a fifth of the points with noise of 0.7 pixels; one in ten is a wrong match.

    A wrong match lies elsewhere on a ray, and has a short track and a large error.
    """
    eyes = {number: image.projection_center() for number, image in model.images.items()}
    for number, point in list(model.points3D.items()):
        views = [(view.image_id, view.point2D_idx) for view in point.track.elements]
        rays = np.stack([point.xyz - eyes[image] for image, _ in views])
        away = np.linalg.norm(rays, axis=1)
        owner = rng.integers(len(views))
        matches = (rays @ rays[owner] > np.cos(np.radians(45)) * away * away[owner]) & (
            rng.random(len(views)) < 0.7
        )
        wrong = rng.random() < 0.1
        if wrong:
            matches[np.flatnonzero(matches)[rng.integers(2, 4) :]] = False
        if matches.sum() < 2 or rng.random() > 0.2:
            model.delete_point3D(number)
            continue
        stretch = rng.uniform(0.6, 1.6) if wrong else 1
        noise = 0.7 * away[owner] / model.cameras[1].params[0] * rng.standard_normal(3)
        point.xyz = eyes[views[owner][0]] + stretch * rays[owner] + noise
        point.error = rng.uniform(1, 3.9) if wrong else rng.uniform(0.3, 0.8)
        for view, matched in zip(views, matches, strict=True):
            if not matched:
                model.delete_observation(*view)
