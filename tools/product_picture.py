"""Draw docs/images/product.png, the README's first picture, from the folder of `make demo`.

python tools/product_picture.py demo
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

import mgs
from mgs.colour import srgb_from_linear
from mgs.plotting import STYLE, crop, new_figure, save_figure
from mgs.policy.criteria import regularisation, uncertainty
from mgs.report.diagnostics import view_maps
from mgs.splat import groups

PICTURE = Path(__file__).parent.parent / "docs/images/product.png"


def product(demo: Path, run: str = "d-optimal", view: str = "kf_0013") -> None:
    """Draw a run: orbit, truth and render of a view never trained on, and what is unknown there."""
    dataset = mgs.load_dataset(demo / "dataset")
    gaussians = mgs.read_ply(demo / run / "gaussians.ply")
    steps = [json.loads(line) for line in (demo / run / "steps.jsonl").read_text().splitlines()]
    seeds, chosen = steps[0]["seeds"], [step["frame"] for step in steps[1:]]
    frame = next(frame for frame in dataset.frames if frame.name == view)

    lam = regularisation(groups(gaussians.sh_degree))
    views = [mgs.fisher(gaussians, dataset.frames[i].camera) for i in (*seeds, *chosen)]
    unknown = {
        "unknown after 1 image": uncertainty(views[0], lam),
        f"unknown after {len(views)} images": uncertainty(np.sum(views, axis=0), lam),
    }
    maps = view_maps(gaussians, frame.camera, unknown)
    window = crop(maps["A"] > 0.5)

    with matplotlib.rc_context(STYLE | {"axes.grid": False}):
        figure = new_figure(10, 2.6, dpi=140)
        axes = figure.subplots(1, 5, gridspec_kw={"width_ratios": [1.3, 1, 1, 1, 1]})
        _orbit(axes[0], dataset, gaussians.means[::4], seeds, chosen)
        axes[1].imshow(srgb_from_linear(frame.masked_rgb())[window])
        axes[1].set_title("truth")
        drawn = np.stack([maps[channel] for channel in "RGB"], axis=-1)
        axes[2].imshow(np.clip(srgb_from_linear(drawn), 0, 1)[window])
        axes[2].set_title(f"render, from {len(views)} images")
        for axis, title in zip(axes[3:], unknown, strict=True):
            shown = np.ma.masked_where(maps["A"] < 0.5, maps[title])[window]
            mapped = axis.imshow(shown, cmap="cividis", vmin=0, vmax=1)
            axis.set_title(title)
        for axis in axes:
            axis.set(xticks=[], yticks=[])
            axis.spines[:].set_visible(False)
        bar = figure.colorbar(
            mapped, ax=axes[3:], orientation="horizontal", shrink=0.6, aspect=40, pad=0.03
        )
        bar.set_label("posterior variance / prior variance")
        for _ in range(3):  # the layout of panels with a fixed aspect settles in a few passes
            figure.draw_without_rendering()
        save_figure(figure, PICTURE)


def _orbit(axis: Any, dataset: Any, rock: np.ndarray, seeds: list[int], chosen: list[int]) -> None:
    centres = np.array([frame.camera.position for frame in dataset.frames])[:, :2]
    style: dict[str, Any] = {"linewidths": 0}
    axis.scatter(rock[:, 0], rock[:, 1], s=0.6, color="#b9b4ab", **style)
    axis.scatter(
        *centres.T,
        s=12,
        facecolors="white",
        edgecolors="#9a9a9a",
        linewidths=0.6,
        label="not taken",
    )
    axis.scatter(*centres[seeds].T, s=50, marker="*", color="#D55E00", label="first views", **style)
    axis.scatter(*centres[chosen].T, s=40, color="#0072B2", label="chosen", **style)
    for number, index in enumerate(chosen, 1):
        text = axis.annotate(str(number), centres[index], fontsize=7, ha="center", va="center")
        text.set(color="white", bbox={"boxstyle": "circle,pad=0.25", "fc": "#0072B2", "lw": 0})
    axis.set(title="orbit from above", aspect="equal")
    axis.margins(0.1)
    axis.legend(loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=3, fontsize=8, handletextpad=0)


if __name__ == "__main__":
    product(Path(sys.argv[1]))
