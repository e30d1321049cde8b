"""Pictures of a model of Gaussians through given cameras: `mgs render`."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from mgs.camera import Camera
from mgs.colour import linear_from_srgb
from mgs.gaussians import Gaussians
from mgs.images import write_exr, write_png


def draw_views(
    out: Path,
    gaussians: Gaussians,
    views: Sequence[tuple[str, Camera]],
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    exr: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Draw a model through every camera; write one PNG for each into the folder `out`.

    views: (path of the view's image, camera); a picture takes the name of the image (`file_names`).
    background: sRGB in [0,1]. exr: write an OpenEXR file too, with linear R G B over the
    background, opacity A and expected z-depth Z in metres, 0 where nothing is drawn. progress:
    called as progress(views done, all). Raises InputError as `mgs.splat.render`, and if a file
    cannot be written."""
    from mgs.splat import as_drjit, render

    model, linear = as_drjit(gaussians), gaussians.linear
    behind = linear_from_srgb(background) if linear else np.asarray(background, np.float32)
    names = file_names([path for path, _ in views])
    for done, (name, (_, camera)) in enumerate(zip(names, views, strict=True)):
        progress(done, len(views))
        image = render(model, camera, behind.tolist())
        rgb = np.asarray(image.rgb)
        write_png(out / f"{name}.png", rgb, linear=linear)
        if exr:
            r, g, b = np.moveaxis(rgb if linear else linear_from_srgb(rgb), -1, 0)
            alpha, depth = np.asarray(image.alpha), np.asarray(image.depth)
            channels = {"R": r, "G": g, "B": b, "A": alpha, "Z": depth}
            write_exr(out / f"{name}.exr", channels, camera)
    progress(len(views), len(views))


def file_names(paths: Sequence[str]) -> list[str]:
    """File names without suffix for image paths; numbered if some are equal."""
    stems = [Path(path).stem for path in paths]
    if len(set(stems)) == len(stems):
        return stems
    return [f"{i:04d}_{stem}" for i, stem in enumerate(stems)]
