"""How far off an entry of the `block` Fisher information is, against how much its sum cancels.

    python benchmarks/block_accuracy.py docs/benchmarks/block_accuracy [SCENES]

Writes PREFIX.png and PREFIX.json. Random scenes of 16 Gaussians (sizes, anisotropy, opacities and
backgrounds far apart), each entry above 1e-6 of its scene's largest against the float64 oracle.
Diagonal entries are sums of squares; the others are sums of either sign, as small beside sqrt(H_ii
H_jj) as chance makes them.
"""

import sys

import matplotlib
import numpy as np
from rich.progress import track

from mgs import runtime

runtime.start()

from mgs.camera import Camera, look_at  # noqa: E402
from mgs.files import write_json  # noqa: E402
from mgs.gaussians import Gaussians  # noqa: E402
from mgs.plotting import STYLE, new_figure, save_figure  # noqa: E402
from mgs.provenance import command_line, versions  # noqa: E402
from mgs.seeds import generator  # noqa: E402
from mgs.splat import fisher, reference  # noqa: E402

BINS = np.logspace(-6, 0, 25)
N = 16
SIZE = (45, 27)
"""Width and height of the image, pixels: no multiple of the kernels' blocks in either direction."""
TOLERANCE = 1e-3
"""Relative error that the tests ask for."""
FLOOR = 1e-6
"""Entries below this share of the scene's largest are left out."""
LEAST_MARGIN = 3e-5
"""No pixel of a scene is nearer to a decision than this relative error of alpha: float32 must not
decide otherwise."""


def make_camera() -> Camera:
    """Unequal focal lengths, and a principal point that is not the middle."""
    K = np.array([[50.0, 0, 0.52 * SIZE[0]], [0, 1.1 * 50.0, 0.47 * SIZE[1]], [0, 0, 1]])
    return Camera(K, *SIZE, look_at((2.0, 0.4, 1.1), (0.0, 0.0, 0.0)))


def random_scene(
    seed: int, log_scales: tuple[float, float], logits: tuple[float, float]
) -> Gaussians:
    """N Gaussians around the origin, with a wide one whose alpha is clamped in the middle and one
    with colours clamped at 0."""
    rng = np.random.default_rng([seed, N, 0])
    parts = (
        rng.uniform(-0.6, 0.6, (N, 3)),
        rng.uniform(*log_scales, (N, 3)),
        rng.normal(0, 1, (N, 4)),
        rng.uniform(*logits, N),
        rng.normal(0, 2.5, (N, 1, 3)),
    )
    g = Gaussians(*(part.astype(np.float32) for part in parts))
    g.means[0], g.log_scales[0], g.logit_opacities[0] = 0, (-0.5, -0.8, -0.3), 20
    g.sh[1] = (-4, 2, -4)
    return g


def entries(camera: Camera, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """(|H_ij| / sqrt(H_ii H_jj), relative error) of the entries of one random scene that count."""
    scale, stretch, logit = rng.uniform(-5, -0.5), rng.uniform(0.1, 6), rng.uniform(-2, 20)
    background = tuple(rng.choice([0, 1, rng.uniform()], 3))
    seed = int(rng.integers(2**31))
    candidates = (
        random_scene(seed + 1000 * i, (scale - stretch, scale), (logit - 4, logit))
        for i in range(200)
    )
    gaussians = next(g for g in candidates if reference.margins(g, camera).min() > LEAST_MARGIN)
    expected = reference.fisher_block(gaussians, camera, background)
    error = np.abs(fisher(gaussians, camera, "block", background) - expected)
    diagonal = np.einsum("nii->ni", expected)
    size, bound = np.abs(expected), np.sqrt(diagonal[:, :, None] * diagonal[:, None, :])
    counts = (size > FLOOR * size.max()) & (np.tri(size.shape[1]) > 0)
    return size[counts] / bound[counts], error[counts] / size[counts]


def main(prefix: str, scenes: int = 1500) -> None:
    camera, rng = make_camera(), generator(0, "block_accuracy")
    found = [entries(camera, rng) for _ in track(range(scenes), "scenes")]
    worst = np.array([error.max() for _, error in found])
    share, error = (np.concatenate(column) for column in zip(*found, strict=True))
    of_bound = share * error
    summary = {
        "command": command_line(),
        "scenes": scenes,
        "entries": len(error),
        "worst_relative_error": worst.max(),
        "scenes_beyond_tolerance": int((worst >= TOLERANCE).sum()),
        "entries_beyond_tolerance": int((error >= TOLERANCE).sum()),
        "error_over_sqrt_HiiHjj": {
            "median": np.median(of_bound),
            "p99": np.quantile(of_bound, 0.99),
            "max": of_bound.max(),
        },
        "versions": versions(),
    }
    write_json(f"{prefix}.json", summary)
    print({key: value for key, value in summary.items() if key != "versions"})
    part = np.digitize(share, BINS)
    middle = np.sqrt(BINS[1:] * BINS[:-1])
    with matplotlib.rc_context(STYLE):
        figure = new_figure(4.6, 3.4)
        axis = figure.subplots()
        for label, of, colour in (("largest", np.max, "#d55e00"), ("median", np.median, "#0072b2")):
            drawn = [
                of(error[part == i]) if (part == i).any() else np.nan for i in range(1, len(BINS))
            ]
            axis.loglog(middle, drawn, "o-", color=colour, ms=3, label=label)
        axis.axhline(TOLERANCE, color="#999999", ls="--", label="asked for")
        axis.set(
            xlabel=r"$|H_{ij}|\;/\;\sqrt{H_{ii} H_{jj}}$", ylabel=r"relative error of $H_{ij}$"
        )
        axis.legend()
        save_figure(figure, f"{prefix}.png")


if __name__ == "__main__":
    main(sys.argv[1], *(int(n) for n in sys.argv[2:]))
