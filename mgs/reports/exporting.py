"""Models for viewers of other programs, and views of a run as datasets that other programs train on
(nerfstudio, COLMAP): `mgs export`."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement
from scipy.spatial.transform import Rotation

from mgs.colour import even_directions, sh_basis, srgb_from_linear
from mgs.data.dataset import target_of, write_transforms
from mgs.data.frames import Frame
from mgs.data.world import Vector, World, levelled
from mgs.errors import InputError
from mgs.files import copy_file, write_text
from mgs.fit.settings import RATES, TrainSettings
from mgs.gaussians import Gaussians
from mgs.images import write_png
from mgs.memory import Deferred
from mgs.prior.exposure import exposure_of, without_gain
from mgs.progress import report
from mgs.run.folder import Run, open_run
from mgs.splat_files import load_gaussians, upward
from mgs.splat_places import to_source

REFIT = TrainSettings(
    optimiser="adam", tolerance=0, rates=dict.fromkeys(RATES, 0.0) | {"colour": RATES["colour"]}
)
"""Fit of colours alone, after which a linear model blends well in sRGB."""

PART = 1 << 16  # Gaussians that are converted at a time


def read_model(source: str | Path, prior: str | Path | None = None) -> tuple[Gaussians, Vector]:
    """Read the model that a run shows (`Run.shown`), in the coordinates that its dataset was made
    of, or that of a file with the up that it has (`upward`). prior: as in `load_gaussians`. Raises
    InputError as `open_run`, `Run.state` and `load_gaussians`."""
    source = Path(source)
    if not source.is_dir():
        return load_gaussians(source, prior), upward(source)
    if prior is not None:
        raise InputError(f"{source}: is a run, and needs no prior; leave out `prior`")
    run = open_run(source)
    return as_imported(run, run.gaussians[run.shown]), run.dataset.world.up


def as_imported(run: Run, g: Gaussians) -> Gaussians:
    """A model of a run in the coordinates that its dataset was made of."""
    world = run.dataset.world
    return replace(to_source(g, world), origin=world.origin)


def in_srgb(g: Gaussians) -> Gaussians:
    """Convert linear colours to sRGB, which most viewers blend as it is; the rest is unchanged.

    The colour of each Gaussian is exact at SH degree 0. At higher degrees its coefficients are a
    least-squares fit over `even_directions`. Blending differs in any case: mixtures are a little
    darker.
    """
    if not g.linear:
        return g
    directions = even_directions()
    basis = sh_basis(directions if g.sh_degree else directions[:1], g.sh_degree)
    inverse, sh = np.linalg.pinv(basis), np.empty_like(g.sh)
    for first in range(0, len(g), PART):
        part = slice(first, first + PART)
        colours = srgb_from_linear(0.5 + np.einsum("dk,nkc->ndc", basis, g.sh[part]))
        sh[part] = np.einsum("kd,ndc->nkc", inverse, colours - 0.5)
    return replace(g, sh=sh, linear=False)


def refit_in_srgb(run: Run) -> Gaussians:
    """Fit the colours of a run's linear model, blended in sRGB, to the views taken; the rest is
    unchanged. Raises InputError if a file of a frame or, where exposures differ, of the prior
    cannot be read."""
    from mgs.fit.fitting import fit_gaussians

    frames = run.taken
    gains = exposure_of(run.prior)(frames) if run.settings.exposure else np.ones((len(frames), 3))
    targets = Deferred(range(len(frames)), lambda i: without_gain(target_of(frames[i]), gains[i]))
    cameras, model = [frame.camera for frame in frames], in_srgb(run.gaussians[run.shown])
    on_pass = lambda *how: report("fitting colours, blended in sRGB", *how[:2])  # noqa: E731
    return fit_gaussians(model, cameras, targets, REFIT, on_pass).gaussians


def to_y_up(up: Vector) -> np.ndarray:
    """Rotation [3,3] of a world with this upward direction into glTF's, in which +Y is up."""
    return np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]) @ levelled(up)


OPAQUE = 0.5  # least opacity of the Gaussians whose centres become points
STEP = 1e-3  # least step of depth images of 16 bits, in the world's unit; nerfstudio's default

NAMES = {
    "nerfstudio": ("transforms.json", "images", "masks", "depth", "points.ply"),
    "colmap": ("sparse", "images", "masks"),
}
"""Formats, and what is in their folders."""


def write_views(out: Path, run: Run, kind: str, every: bool = False) -> str:
    """Write the views that a run took, or all that have images, into the new folder `out`.

    kind: a format of NAMES. Images are copied, masks are black and white; the points are centres of
    the model's Gaussians. Returns a line for the user. Raises InputError if a file is missing."""
    frames, world = list(run.taken), run.dataset.world
    if every:
        frames = list(run.dataset.with_images([frame.name for frame in frames]))
    points = _points(as_imported(run, run.gaussians))
    frames = [replace(frame, camera=world.whole(frame.camera)) for frame in frames]
    if kind == "nerfstudio":
        _write_nerfstudio(out, frames, points, world.home)
    else:
        _write_colmap(out, frames, points, world.home)
    masks = sum(frame.mask_path is not None or frame.rock_path is not None for frame in frames)
    return f"{len(frames)} views, {masks} masks and {len(points):,} points"


def _points(gaussians: Gaussians) -> np.ndarray:
    """Table of the centres and sRGB colours of opaque Gaussians."""
    g = gaussians[gaussians.opacities >= OPAQUE]
    colours = np.round(255 * srgb_from_linear(g.rgb) if g.linear else 255 * np.clip(g.rgb, 0, 1))
    columns = [*(g.means.astype(np.float64) + g.origin).T, *colours.astype(np.uint8).T]
    layout = [*((axis, "f8") for axis in "xyz"), *((k, "u1") for k in ("red", "green", "blue"))]
    return np.rec.fromarrays(columns, dtype=layout)


def _copied(out: Path, frame: Frame, mask: str) -> Frame:
    """Copy the image of a frame and write its mask with this ending; return the new frame."""
    image = out / "images" / f"{frame.name}{frame.image_path.suffix}"
    copy_file(frame.image_path, image)
    frame = replace(frame, on_demand=False, image_path=image, depth_path=None)
    if frame.mask_path is None and frame.rock_path is None:
        return frame
    path = out / "masks" / (image.name + mask if mask else f"{frame.name}.png")
    write_png(path, frame.mask())
    return replace(frame, mask_path=path, rock_path=None)


def _write_nerfstudio(out: Path, frames: Sequence[Frame], points: np.ndarray, world: World) -> None:
    deepest = max((frame.depth().max() for frame in frames if frame.depth_path), default=0.0)
    step = max(STEP, float(deepest) / (2**16 - 1))
    copies = []
    for frame in frames:
        copy = _copied(out, frame, "")
        if frame.depth_path is not None:
            path = out / "depth" / f"{frame.name}.png"
            write_png(path, np.round(frame.depth() / step).astype(np.uint16))
            copy = replace(copy, depth_path=path)
        copies.append(copy)
    PlyData([PlyElement.describe(points, "vertex")]).write(str(out / "points.ply"))
    notes: dict[str, str | float] = {"ply_file_path": "points.ply"}
    notes |= {"depth_unit_scale_factor": step} if deepest else {}
    write_transforms(out, copies, world, notes)


def _write_colmap(out: Path, frames: Sequence[Frame], points: np.ndarray, world: World) -> None:
    def numbers(*values: float) -> str:
        return " ".join(repr(float(value)) for value in values)

    cameras: dict[str, int] = {}
    images = []
    for number, frame in enumerate(frames, 1):
        image, camera = _copied(out, frame, ".png").image_path.name, world.leave(frame.camera)
        K, turn, t = camera.K, camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
        lens = numbers(K[0, 0], K[1, 1], K[0, 2], K[1, 2])
        lens = f"PINHOLE {camera.width} {camera.height} {lens}"
        which = cameras.setdefault(lens, len(cameras) + 1)
        x, y, z, w = Rotation.from_matrix(turn).as_quat()
        pose = numbers(w, x, y, z, *t)
        images.append(f"{number} {pose} {which} {image}\n\n")  # the second line: no keypoints
    rows = [
        f"{number} {x!r} {y!r} {z!r} {r} {g} {b} 0\n"
        for number, (x, y, z, r, g, b) in enumerate(points.tolist(), 1)
    ]
    lenses = [f"{number} {camera}\n" for camera, number in cameras.items()]
    files = {"cameras.txt": lenses, "images.txt": images, "points3D.txt": rows}
    for name, lines in files.items():
        write_text(out / "sparse/0" / name, "".join(lines))
