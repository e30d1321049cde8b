"""The pictures of `mgs stress`: nothing is cut off, and panels of one row are equally high."""

import numpy as np
import pytest

from mgs.plotting import STYLE, save_figure
from mgs.study.stress import picture
from mgs.study.stress.experiment import Experiment, Panel
from mgs.study.stress.picture import draw_experiment

PANELS = (
    Panel("views", "tau", "views", "Kendall's tau", "policy"),
    Panel("size", "tau", "size", "Kendall's tau", None, True),
    Panel("name", "tau", "a name for each", "Kendall's tau", "policy"),
)


def made_up(names):
    """Rows whose largest value is 1 in every panel."""
    rng = np.random.default_rng(0)
    return [
        {"run": run, "policy": policy, "views": k + 2, "size": 2.0**k, "name": f"a long name, number {k}",
         "tau": 1.0 if policy == "d-optimal" else rng.random()}
        for run in "ab" for policy in ("d-optimal", "uniform") for k in range(names)
    ]  # fmt: skip


@pytest.mark.parametrize(("names", "bands"), [(3, 1), (13, 2)])
def test_no_point_is_cut_off_and_a_row_is_aligned(names, bands, tmp_path, monkeypatch):
    figures, fonts = [], set()

    def saved(figure, path):
        save_figure(figure, path)
        figures.append(figure)
        fonts.update(
            axis.xaxis.label.get_fontname() for axis in figure.axes
        )  # of the style in force where it is saved

    monkeypatch.setattr(picture, "save_figure", saved)
    draw_experiment(
        tmp_path / "it.png", Experiment("?", lambda preset: [], (), PANELS), made_up(names)
    )
    (figure,) = figures
    assert (tmp_path / "it.png").stat().st_size > 0
    for axis in figure.axes:
        box, radius = axis.get_window_extent(), STYLE["lines.markersize"] / 72 * figure.dpi / 2
        for line in axis.lines:
            x, y = axis.transData.transform(line.get_xydata()).T
            assert x.min() > box.x0 + radius
            assert x.max() < box.x1 - radius
            assert y.min() > box.y0 + radius
            assert y.max() < box.y1 - radius
    heights = {
        (round(box.y0), round(box.y1)) for box in (axis.get_window_extent() for axis in figure.axes)
    }
    assert len(heights) == bands
    assert fonts == {"STIXGeneral"}
