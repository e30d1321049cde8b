"""Figures and tables from run folders: right numbers and sizes, a line where a file is missing."""

import io
import re
import shutil
from itertools import pairwise

import numpy as np
import pytest
import tiny
from PIL import Image
from program import change_settings, change_steps, command, table_numbers
from refusals import fails

from mgs import load_dataset, open_run, plotting
from mgs.cli import terminal
from mgs.cli.terminal import Terminal
from mgs.colour import srgb_from_linear
from mgs.evaluation import render_view
from mgs.files import read_json, write_json
from mgs.reports import figures, tables
from mgs.reports.figures import POLICY_STYLE
from mgs.reports.page_plots import SYMBOLS
from mgs.reports.tables import compare_runs
from mgs.run.policies import POLICIES

FIGURES = ("orbit", "gain", "coverage", "comparison", "psnr")


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two runs on a dataset with three test views, evaluated with a renderer of one grey."""
    root = tmp_path_factory.mktemp("report")
    tiny.write_dataset(root / "data/test", frames=3)
    dataset = load_dataset(tiny.write_dataset(root / "data"))
    names = [f"{views}psnr{mask}" for views in ("", "test_") for mask in ("", "_mask")]

    def measure(gaussians, taken):
        return {name: float(len(taken) * (1 + len(name))) for name in names}

    how = {"parts": {"measure": measure}, "evaluate_every": 1}
    greys = {"d-optimal": 0.3, "random": 0.2}
    return [
        tiny.write_measured_run(root / policy, dataset, grey, policy=policy, **how)
        for policy, grey in greys.items()
    ]


def without(word, values):
    """The values of a dict without the keys that have this word."""
    return {key: value for key, value in values.items() if word not in key}


def no_line_has(word):
    """A change of lines: keys with this word are left out."""
    return lambda lines: [without(word, line) for line in lines]


@pytest.fixture
def drawn(figures, monkeypatch):
    """{file name: figure} of every figure that is saved, and the style that extents depend on."""
    found, save = {}, plotting.save_figure

    def keep(figure, path):
        found[path.name] = figure
        save(figure, path)

    monkeypatch.setattr(plotting, "save_figure", keep)
    with plotting.styled(plotting.STYLE):
        yield found


def curves(axis):
    """{label: points} of the lines of an axis."""
    return {line.get_label(): [tuple(xy) for xy in line.get_xydata()] for line in axis.lines}


def images(figure):
    """{first line of the title: axis} of the axes that show an image."""
    return {axis.get_title().split("\n")[0]: axis for axis in figure.axes if axis.images}


def test_report_writes_every_figure(runs, tmp_path, drawn):
    out = tmp_path / "report"
    written = tables.report(runs, out)
    names = [*(f"{name}.png" for name in FIGURES), "table.md", "table.json"]
    assert [path.name for path in written] == names
    assert {path.name for path in out.iterdir()} == set(names)
    for path in written[:-2]:
        with Image.open(path) as picture:
            picture.load()
            assert picture.size == tuple(drawn[path.name].canvas.get_width_height())
        assert path.stat().st_size < 400_000
    assert read_json(out / "table.json") == table_numbers(runs)

    read = {run.label: run for run in map(open_run, runs)}
    assert len(set(read["d-optimal"].indices)) == 8

    def numbers(x, y, factor=1, first=0):
        return {
            policy: [(s[x], factor * s[y]) for s in run.steps[first:]]
            for policy, run in read.items()
        }

    gains = numbers("step", "information_gain", first=1)
    assert curves(drawn["gain.png"].axes[0]) == gains
    assert curves(drawn["coverage.png"].axes[0]) == numbers("images", "coverage", 100)
    panels = {
        "PSNR, test views (dB)": "test_psnr",
        "masked PSNR, test views (dB)": "test_psnr_mask",
    }
    assert [axis.get_ylabel() for axis in drawn["psnr.png"].axes] == list(panels)
    for axis, key in zip(drawn["psnr.png"].axes, panels.values(), strict=True):
        assert curves(axis) == numbers("images", key)
    positions = np.array([camera.position[:2] for camera in tiny.orbit()])
    for axis, run in zip(drawn["orbit.png"].axes, read.values(), strict=False):
        shown = {points.get_label(): points.get_offsets() for points in axis.collections}
        frames = {
            "candidate": range(tiny.FRAMES),
            "seed": run.indices[:3],
            "chosen, in this order": run.indices[3:],
        }
        for label, indices in frames.items():
            np.testing.assert_allclose(shown[label], positions[list(indices)], atol=1e-9)
    shown = images(drawn["comparison.png"])
    assert list(shown) == ["truth", "d-optimal", "random", ""]

    def off(i):
        both = (run.metrics for run in read.values())
        return sum((one["test_views"][i]["psnr"] - one["test"]["psnr"]) ** 2 for one in both)

    nearest = min(range(3), key=off)
    view = read["d-optimal"].metrics["test_views"][nearest]
    frame = read["random"].dataset.test_views().frames[nearest]
    window = plotting.crop(frame.masked_rgb().max(axis=2) > 0)
    for policy, run in read.items():
        expected = srgb_from_linear(render_view(run.gaussians, frame.camera)[0])[window]
        np.testing.assert_allclose(shown[policy].images[0].get_array(), expected, atol=1e-6)
    assert shown["truth"].get_title() == f"truth\n{view['name']}"
    assert f"{view['psnr']:.2f} dB" in shown["d-optimal"].get_title()
    assert "trained" not in shown["d-optimal"].get_title()


def test_figures_are_written_as_asked_for_and_those_left_out_are_named(runs, tmp_path, capsys):
    run = shutil.copytree(runs[0], tmp_path / "run")
    change_steps(run, no_line_has("psnr"))
    command("report", run, "--out", tmp_path / "report", "--figures", "pdf")
    names = {path.name for path in (tmp_path / "report").iterdir()}
    written = {f"{name}.pdf" for name in FIGURES if name != "psnr"}
    assert names == written | {"table.md", "table.json"}
    assert (tmp_path / "report/gain.pdf").read_bytes().startswith(b"%PDF")
    said = capsys.readouterr().out
    left_out = "PSNR against images is left out: make all runs with evaluate_every to have it"
    assert left_out in said
    assert said.count("left out") == 1
    ending = r"gain\.eps: figures are written as png, pdf, svg; choose another ending"
    fails(ending, figures.curves_figure, tmp_path / "gain.eps", "gain", {"gain": {}})


def test_table(runs):
    rows, run = table_numbers(runs), open_run(runs[1])
    means = {
        f"{views}.{name}": value
        for views in ("test", "all", "held_out")
        for name, value in run.metrics[views].items()
    }
    positions = [tiny.orbit()[i].position for i in run.indices]
    path = sum(np.linalg.norm(b - a) for a, b in pairwise(positions))
    known = {"policy": "random", "images": 8, "coverage": 100 * run.steps[-1]["coverage"]}
    assert rows[1] == means | known | {"path": pytest.approx(path), "unit": "m"}
    table = tables.markdown_table(rows).splitlines()
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table]
    assert len(lines) == 4
    row = dict(zip(lines[0], lines[3], strict=True))
    assert (row["policy"], row["images"]) == ("random", "8")
    assert row["PSNR, test views (dB)"] == f"{run.metrics['test']['psnr']:.2f}"
    assert row["PSNR, all views (dB)"] == f"{run.metrics['all']['psnr']:.2f}"
    assert row["masked SSIM, held-out views"] == f"{run.metrics['held_out']['ssim_mask']:.4f}"
    assert row["path (m)"] == f"{path:.2f}"
    assert len(row) == 14
    assert "| path (units) |" in tables.markdown_table([row | {"unit": "units"} for row in rows])


def test_a_run_that_was_not_measured_on_the_test_views_is_compared_on_the_others(
    runs, tmp_path, drawn
):
    run = shutil.copytree(runs[1], tmp_path / "random")
    change_steps(run, no_line_has("test"))
    write_json(run / "metrics.json", without("test", read_json(run / "metrics.json")))
    tables.report([runs[0], run], tmp_path / "report")
    read = [open_run(folder) for folder in (runs[0], run)]
    axis = drawn["psnr.png"].axes[0]
    assert axis.get_ylabel() == "PSNR, all views (dB)"
    assert curves(axis)["random"] == [(s["images"], s["psnr"]) for s in read[1].steps]
    index = int(drawn["comparison.png"].axes[0].get_title().removeprefix("truth\nkf_"))
    counts = [sum(i in run.indices for run in read) for i in range(tiny.FRAMES)]
    assert counts[index] == min(counts)
    lines = (tmp_path / "report/table.md").read_text().splitlines()
    assert [line.count("–") for line in lines[2:]] == [0, 4]


def test_runs_of_one_policy_are_told_apart_by_their_folders(runs, tmp_path):
    other = shutil.copytree(runs[1], tmp_path / "again")
    labels = ["d-optimal", "random (random)", "random (again)"]
    assert list(compare_runs([*runs, other])) == labels
    assert list(compare_runs([runs[0].parent])) == ["d-optimal", "random"]
    fails("same policy and folder name", compare_runs, [runs[1], runs[1]])
    fails("there are no runs", compare_runs, [])


def edit(name, **values):
    """A change of a run: other values in a JSON file."""
    return lambda run: write_json(run / name, read_json(run / name) | values)


def remove(name):
    """A change of a run: a file is gone."""
    return lambda run: (run / name).unlink()


def unfinished(run):
    """A change of a run: it was stopped and evaluated after two steps."""
    taken = open_run(run).indices[:5]
    change_steps(run, lambda lines: lines[:3], taken=taken)
    edit("metrics.json", images=5)(run)


def turned(run):
    """A change of a run: its prior was built when another direction was up."""
    (run / "prior").mkdir()
    write_json(run / "prior/prior.json", {"up": [0, 1, 0]})
    change_settings(run, prior=str(run / "prior"))


UNFIT = {
    "measured before": (edit("metrics.json", images=7), "not evaluated since its last step"),
    "damaged metrics": (edit("metrics.json", views=[{}]), "is damaged (views.0.name: "),
    "view not measured": (edit("metrics.json", views=[], test_views=[]), "no view on which all"),
    "another dataset": (lambda run: change_settings(run, dataset="/"), "another dataset"),
    "another up": (turned, "its prior has another upward direction"),
    "frames changed": (edit("config.json", frames=[]), "its frames differ"),
    "budget of words": (lambda run: change_settings(run, budget="many"), "budget = 'many': "),
    "budget raised": (lambda run: change_settings(run, budget=7), "with 8 of 10 views; go on"),
    "unfinished": (unfinished, "is unfinished, with 5 of 8 views; go on with `mgs nbv --resume"),
    "no step": (remove("checkpoint.npz"), "has no finished step yet; continue it"),
    "no lines": (remove("steps.jsonl"), "steps.jsonl: is missing or damaged"),
    "no frame": (lambda run: change_steps(run, no_line_has("frame")), "frames are not those"),
}


@pytest.mark.parametrize(("change", "named"), UNFIT.values(), ids=UNFIT)
def test_runs_that_cannot_be_reported(runs, tmp_path, change, named):
    run = shutil.copytree(runs[1], tmp_path / "run")
    change(run)
    fails(re.escape(named), tables.report, [runs[0], run], tmp_path / "report")
    assert not (tmp_path / "report").exists()


def within(figure, box):
    page = figure.bbox
    across = page.x0 <= box.x0 < box.x1 <= page.x1
    return across and page.y0 <= box.y0 < box.y1 <= page.y1


LONG = "DJI_20231105103211_0004_W_some_flight_over_some_rock_with_a_long_name"


@pytest.mark.parametrize(
    "labels", [["random (a folder of a long name)"], ["random (a)", "random (b)", "mine"]]
)
def test_no_word_of_a_comparison_is_cut_off_or_written_over(tmp_path, drawn, labels):
    truth = np.zeros((60, 80, 3))
    truth[10:50, 20:60] = 0.5
    captions = dict.fromkeys(labels, "100 images, trained on; 30.09 dB, SSIM 0.9301")
    renders = dict.fromkeys(labels, truth + 0.1)
    figures.comparison_figure(tmp_path / "a.png", truth, renders, LONG, captions)
    figure = drawn["a.png"]
    texts = [text for axis in figure.axes for text in (axis.title, *axis.texts)]
    texts.append(figure.axes[-1].xaxis.label)
    boxes = [text.get_window_extent() for text in texts if text.get_text()]
    assert len(boxes) == 3 + len(labels)
    assert all(within(figure, box) for box in boxes)
    titles = [axis.title.get_window_extent() for axis in figure.axes if axis.title.get_text()]
    assert len(titles) == 1 + len(labels)
    assert all(a.x1 < b.x0 for a, b in pairwise(titles))


def test_a_legend_covers_no_line(tmp_path, drawn):
    """It stands beside the axes, which keep their size, whole."""
    labels = [f"random (a folder of a long name {i})" for i in range(20)]
    lines = dict.fromkeys(labels, ((4, 5, 6), (0.1, 0.2, 0.3)))
    figures.curves_figure(tmp_path / "a.png", "gain", {"gain": lines})
    figures.curves_figure(tmp_path / "b.png", "PSNR", {"test views": lines, "masked PSNR": lines})
    for figure in drawn.values():
        legend = figure.legends[0].get_window_extent()
        assert [text.get_text() for text in figure.legends[0].get_texts()] == labels
        assert within(figure, legend)
        for axis in figure.axes:
            assert axis.get_legend() is None
            assert axis.get_tightbbox().x1 <= legend.x0
            assert axis.bbox.width > 2.3 * figure.dpi


def test_every_line_of_a_figure_looks_different():
    labels = ["mine", "d-optimal", "random (a)", "random (b)", *(f"mine-{i}" for i in range(30))]
    styles = figures.line_styles(labels)
    assert [style["label"] for style in styles] == labels
    looks = {(style["color"], style["marker"], style["linestyle"]) for style in styles}
    assert len(looks) == len(labels)
    # Of two runs of a policy, the first has its style.
    for style, policy in ((styles[1], "d-optimal"), (styles[2], "random")):
        assert (style["color"], style["marker"]) == POLICY_STYLE[policy]


def test_every_policy_has_a_colour_and_a_marker_of_its_own():
    assert set(POLICY_STYLE) == set(POLICIES)
    colours, markers = zip(*figures.STYLES, strict=True)
    assert len(set(colours)) == len(set(markers)) == len({SYMBOLS[one] for one in markers})


@pytest.mark.parametrize(("inside", "shown"), [(20.0, ""), (25.0, "_mask")])
def test_values_in_masks_stand_only_where_there_are_masks(inside, shown):
    ends = {"": 20.0, "_mask": inside, "_corrected": 21.0, "_mask_corrected": inside + 1}
    row = {f"test.psnr{end}": value for end, value in ends.items()} | {"exposure": True}
    expected = dict.fromkeys(["test.psnr", f"test.psnr{shown}", f"test.psnr{shown}_corrected"])
    assert tables.table_columns([row]) == list(expected)
    fit = {key.replace("test.", "all."): value for key, value in row.items()}
    assert tables.table_columns([fit]) == [key.replace("test.", "all.") for key in expected]


@pytest.mark.parametrize(("held_out", "apart"), [(0, 10.0), (3, 0.0)])
def test_test_views_far_behind_those_fitted_are_told_of(held_out, apart):
    row = {"all.psnr": 30.0, "test.psnr": 20.0, "held_out.count": held_out}
    assert terminal._apart(row) == apart


@pytest.mark.parametrize("exposure", [False, True])
@pytest.mark.parametrize("views", terminal.SHOWN)
def test_a_long_name_cuts_no_number_and_is_not_cut(views, exposure):
    name = "random (a [second] run in a folder with a long name" + "x" * 80 + ")"
    console = Terminal(width=80, record=True, file=io.StringIO())
    end = "_corrected" if exposure else ""
    shown = [key if "ssim" in key else key + end for key in terminal.SHOWN[views]]
    values = enumerate(shown)
    row = {key: i / 8 if "ssim" in key else 30.125 + i for i, key in values} | {"coverage": 100.0}
    about = {"images": 12, "exposure": exposure, "held_out.count": int(views != "all")}
    about |= {key: i for i, key in enumerate(terminal.SHOWN[views])}  # with the exposure as it is
    rows = [{"policy": policy, **about, **row} for policy in (name, "directional-i")]
    terminal.print_quality(console, rows)
    text = console.export_text()
    assert "directional-i" in text
    assert all(text.count(tables.table_cell(key, value)) == 2 for key, value in row.items())
    assert "…" not in text
    assert text.count("x") == name.count("x")
    assert max(len(line) for line in text.splitlines()) <= 80
