"""Draw docs/images/splatting.png: how the kernels project, list, walk and sum.

    python benchmarks/splatting_figure.py docs/images/splatting.png

Everything drawn is read from the kernels' own data for a rock of 3,000 Gaussians at 160x120.
"""

import sys

import numpy as np
from matplotlib.patches import Rectangle

from mgs import runtime

runtime.start()

from mgs.bench.core import surface_camera, surface_gaussians  # noqa: E402
from mgs.colour import srgb_from_linear  # noqa: E402
from mgs.plotting import new_figure, save_figure  # noqa: E402
from mgs.splat import ListCache, as_drjit, reference, render  # noqa: E402
from mgs.splat.blocks import BLOCK_X, BLOCK_Y, TILE  # noqa: E402
from mgs.splat.projection import camera_array, project  # noqa: E402

ORANGE, BLUE = "#d55e00", "#0072b2"


def main(path: str, count: int = 3000) -> None:
    """Draw the figure of a rock of `count` Gaussians."""
    gaussians = surface_gaussians(count)
    camera = surface_camera(gaussians, 160, 120)
    image = np.asarray(render(gaussians, camera).rgb)
    splats = project(as_drjit(gaussians), camera_array(camera))
    lists, _ = ListCache().get(camera, splats)
    lengths = np.asarray(lists.end).astype(int) - np.asarray(lists.start)
    block = np.asarray(lists.block)
    blocks_x = -(-camera.width // BLOCK_X)

    chosen = showcase(gaussians, camera)
    figure = new_figure(11, 6.4)
    top, bottom = figure.subfigures(2, 1, height_ratios=[1.55, 1])
    axes = top.subplots(1, 3, width_ratios=[1.25, 1.25, 1])

    owners = np.repeat(block, lengths)
    pairs = np.asarray(lists.splat)
    starts = np.asarray(lists.start)
    order = np.concatenate([np.arange(s, s + n) for s, n in zip(starts, lengths, strict=True)])
    mine = owners[pairs[order] == np.asarray(lists.place)[chosen]]
    footprint_panel(axes[0], image, camera, gaussians, chosen, mine, blocks_x)
    lists_panel(axes[1], lengths, block, blocks_x, camera)
    lanes_panel(axes[2], lengths)
    sums_panels(bottom, gaussians, camera, chosen)
    save_figure(figure, path)


def showcase(gaussians, camera) -> int:
    """Index of the visible Gaussian with the most elongated footprint near the image centre."""
    p = reference.project(gaussians, camera)
    order, alpha, T, _ = reference.composite(p, camera)
    weight = np.zeros(len(gaussians))
    weight[order] = (alpha * T).sum(0)
    spread = np.linalg.eigvalsh(p.cov2d)
    near = np.linalg.norm(p.means2d - [camera.width / 2, camera.height / 2], axis=1) < 30
    return int(np.argmax(np.where(near & (weight > 1.5), spread[:, 1] / spread[:, 0], 0)))


def footprint_panel(axis, image, camera, gaussians, j, blocks, blocks_x) -> None:
    """Draw the rim of Gaussian j and the blocks that list it, over the image."""
    p = reference.project(gaussians, camera)
    level = 2 * np.log(255 * p.opacities[j])
    values, vectors = np.linalg.eigh(p.cov2d[j])
    angle = np.linspace(0, 2 * np.pi, 200)
    rim = (
        p.means2d[j]
        + (np.stack([np.cos(angle), np.sin(angle)], 1) * np.sqrt(level * values)) @ vectors.T
    )
    axis.imshow(
        srgb_from_linear(image), extent=(0, camera.width, camera.height, 0), interpolation="nearest"
    )
    for b in blocks:
        corner = (b % blocks_x * BLOCK_X, b // blocks_x * BLOCK_Y)
        axis.add_patch(
            Rectangle(corner, BLOCK_X, BLOCK_Y, fill=True, fc=ORANGE, ec="white", alpha=0.45)
        )
    axis.plot(*rim.T, color="white", lw=2.6)
    axis.plot(*rim.T, color=BLUE, lw=1.4)
    x, y = p.means2d[j]
    axis.set(xlim=(x - 26, x + 26), ylim=(y + 20, y - 20), xlabel="pixels")
    axis.set_title(
        f"1  project: one footprint (alpha = 1/255)\ntouches {len(blocks)} blocks of 8x4 pixels",
        fontsize=9,
    )


def lists_panel(axis, lengths, block, blocks_x, camera) -> None:
    """Draw the length of the list of each block."""
    grid = np.zeros(len(block))
    grid[block] = lengths
    for edge in range(BLOCK_X * TILE, camera.width, BLOCK_X * TILE):
        axis.axvline(edge, color="white", lw=0.8, ls=":")
    for edge in range(BLOCK_Y * TILE, camera.height, BLOCK_Y * TILE):
        axis.axhline(edge, color="white", lw=0.8, ls=":")
    shown = axis.imshow(
        grid.reshape(-1, blocks_x), extent=(0, camera.width, camera.height, 0), cmap="viridis"
    )
    axis.figure.colorbar(shown, ax=axis, shrink=0.75, label="splats in the list")
    axis.set(xlabel="pixels")
    axis.set_title("2  list: for each block its splats,\nfront to back (dotted: tiles)", fontsize=9)


def lanes_panel(axis, lengths) -> None:
    """Draw the length of the list of each SIMD lane."""
    packet = np.arange(len(lengths)) // 16
    axis.bar(
        np.arange(len(lengths)),
        lengths,
        width=1.0,
        color=np.where(packet % 2 == 0, BLUE, "#56b4e9"),
    )
    axis.set(xlabel="lane (colours: packets of 16)", ylabel="list length")
    axis.set_title(
        "3  walk: one lane a block,\nlongest lists of a tile first",
        fontsize=9,
    )


def sums_panels(figure, gaussians, camera, j) -> None:
    """Draw the seven terms of the Fisher pass for Gaussian j per pixel, float64 by the oracle."""
    p = reference.project(gaussians, camera)
    order, alpha, T, _ = reference.composite(p, camera)
    i = int(np.flatnonzero(order == j)[0])
    w = alpha * T
    contribution = w[:, :, None] * p.colours[order]
    behind = contribution.sum(1) - contribution[:, : i + 1].sum(1)
    D = p.colours[j] * T[:, i, None] - behind / (1 - alpha[:, i, None])
    s2 = (D**2).sum(1) * alpha[:, i] ** 2
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    d = np.stack([u.ravel(), v.ravel()], 1) - p.means2d[j]
    c = p.cov2d[j]
    half = 0.5 / np.log(2)
    xi = np.sqrt(half * c[1, 1] / np.linalg.det(c)) * (d[:, 0] - c[0, 1] / c[1, 1] * d[:, 1])
    eta = np.sqrt(half / c[1, 1]) * d[:, 1]
    terms = {
        r"$w^2$": w[:, i] ** 2,
        r"$|s|^2$": s2,
        r"$|s|^2\xi^4$": s2 * xi**4,
        r"$|s|^2\xi^3\eta$": s2 * xi**3 * eta,
        r"$|s|^2\xi^2\eta^2$": s2 * xi**2 * eta**2,
        r"$|s|^2\xi\eta^3$": s2 * xi * eta**3,
        r"$|s|^2\eta^4$": s2 * eta**4,
    }
    figure.suptitle(
        "4  sum: the seven terms of the exact Fisher diagonal of that splat, per pixel "
        "(their sums: one number each)",
        fontsize=9,
    )
    x, y = p.means2d[j]
    for axis, (name, term) in zip(figure.subplots(1, 7), terms.items(), strict=True):
        most = np.abs(term).max()
        axis.imshow(
            term.reshape(camera.height, camera.width),
            extent=(0, camera.width, camera.height, 0),
            cmap="RdBu_r",
            vmin=-most,
            vmax=most,
        )
        axis.set(xlim=(x - 14, x + 14), ylim=(y + 11, y - 11), xticks=[], yticks=[])
        axis.set_title(f"{name}\nsum {term.sum():.3g}", fontsize=9)


if __name__ == "__main__":
    main(sys.argv[1])
