"""The picture of docs/splatting.md shows the kernels' own data."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from matplotlib.patches import Rectangle

from mgs.bench.core import surface_camera, surface_gaussians
from mgs.colour import SH_C0
from mgs.splat import fisher, reference
from mgs.splat.blocks import BLOCK_X, BLOCK_Y

SCRIPT = Path(__file__).parents[2] / "benchmarks/splatting_figure.py"
COUNT = 300


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("splatting_figure", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_figure_of_the_splat_kernel_shows_what_the_oracle_says(script, tmp_path, monkeypatch):
    """Blocks, list lengths and sums of the showcase, read back from the figure."""
    drawn, save = [], script.save_figure
    keep = lambda figure, path: (drawn.append(figure), save(figure, path))  # noqa: E731
    monkeypatch.setattr(script, "save_figure", keep)
    script.main(str(tmp_path / "figure.png"), COUNT)
    assert (tmp_path / "figure.png").is_file()
    (figure,) = drawn
    top, bottom = figure.subfigs
    footprint, lists, lanes = (axis for axis in top.axes if axis.get_label() != "<colorbar>")

    gaussians = surface_gaussians(COUNT)
    camera = surface_camera(gaussians, 160, 120)
    chosen = script.showcase(gaussians, camera)
    y, x = np.nonzero(reference.render(gaussians[chosen], camera)["alpha"])
    touched = {(i // BLOCK_X * BLOCK_X, j // BLOCK_Y * BLOCK_Y) for i, j in zip(x, y, strict=True)}
    corners = {patch.get_xy() for patch in footprint.patches if isinstance(patch, Rectangle)}
    assert touched <= corners
    assert len(corners) < 1.5 * len(touched)

    lengths = np.asarray(lists.images[0].get_array())
    assert sum(bar.get_height() for bar in lanes.patches) == lengths.sum()

    w2 = fisher(gaussians, camera)[chosen, 0] / SH_C0**2
    assert float(bottom.axes[0].get_title().rpartition(" ")[2]) == pytest.approx(w2, rel=6e-3)
