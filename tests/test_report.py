"""Figures and tables from run folders: right numbers, right picture sizes, and a clear line where a
file is missing."""

import io
import json
import re
import shutil
from itertools import pairwise

import numpy as np
import pytest
import tiny
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from PIL import Image
from refusals import refused
from rich.console import Console
from skimage.color import rgb2lab

from mgs import plotting
from mgs.cli import printing
from mgs.cli.app import main
from mgs.colour import linear_from_srgb, srgb_from_linear
from mgs.data.dataset import load_dataset
from mgs.errors import InputError
from mgs.files import write_json
from mgs.policy.registry import policy_names
from mgs.report import figures, tables, writing
from mgs.report.evaluation import evaluate
from mgs.report.figures import POLICY_STYLE
from mgs.report.page_plots import SYMBOLS
from mgs.report.runs import compare_runs, read_run
from mgs.run import recording
from mgs.run.folder import load_run


def flat(camera, grey):
    """An opaque grey wall."""
    shape = camera.height, camera.width
    return np.full((*shape, 3), grey, np.float32), np.ones(shape), np.ones(shape)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two runs of the real loop on stand-in stations, evaluated with a renderer of one grey."""
    return write_runs(tmp_path_factory.mktemp("report"))


@pytest.fixture(scope="module")
def tested(tmp_path_factory):
    """The same, on a dataset with three test views."""
    root = tmp_path_factory.mktemp("tested")
    tiny.write_dataset(root / "data/test", frames=3)
    return write_runs(root)


def write_runs(root):
    dataset = load_dataset(tiny.write_dataset(root / "data"))
    tests = dataset.test_views()
    sets = ("", "test_") if tests else ("",)
    folders = []
    for policy in ("d-optimal", "random"):
        out = root / policy
        settings = tiny.start(out, dataset, policy=policy, evaluate_every=1)
        recording.run(
            out,
            settings,
            dataset,
            tiny.operations(
                measure=lambda gaussians, taken: {
                    f"{views}psnr{mask}": len(taken) * (1 + len(views + mask))
                    for views in sets
                    for mask in ("", "_mask")
                }
            ),
            tiny.silent,
        )
        gaussians, _, trained, _ = load_run(out)
        grey = 0.2 if policy == "random" else 0.3
        metrics = evaluate(
            gaussians,
            dataset.frames,
            trained,
            test_frames=tests.frames if tests else (),
            renderer=lambda g, camera, grey=grey: flat(camera, grey),
            pictures=out / "renders",
        )
        write_json(out / "metrics.json", {"policy": policy} | metrics)
        folders.append(out)
    return folders


def test_run_folder(runs):
    run = read_run(runs[0])
    assert run.policy == "d-optimal"
    assert len(run.seeds) == 3
    assert len(set(run.seeds + run.chosen)) == 8
    assert [run.settings["budget"], len(run.steps)] == [5, 6]


@pytest.fixture
def drawn(monkeypatch):
    """{file name: figure} of every figure that is saved."""
    found, save = {}, plotting.save_figure
    monkeypatch.setattr(
        figures,
        "save_figure",
        lambda figure, path: (found.update({path.name: figure}), save(figure, path)),
    )
    return found


def curves(axis) -> dict[str, list[tuple[float, float]]]:
    """{label: points} of the lines of an axis."""
    return {line.get_label(): [tuple(xy) for xy in line.get_xydata()] for line in axis.lines}


def test_report_writes_every_figure(runs, tmp_path, drawn):
    """Each shows the numbers of the runs."""
    written = writing.write_report(tmp_path / "report", runs)
    assert [path.name for path in written] == [
        "orbit.png",
        "gain.png",
        "coverage.png",
        "comparison.png",
        "psnr.png",
        "table.md",
        "table.json",
    ]
    for path in written[:-2]:
        with Image.open(path) as picture:
            picture.load()
            assert picture.size == tuple(drawn[path.name].canvas.get_width_height())
        assert path.stat().st_size < 400_000
    assert {path.name for path in (tmp_path / "report").iterdir()} == {
        path.name for path in written
    }
    assert json.loads((tmp_path / "report/table.json").read_text()) == tables.table_numbers(runs)

    read = {run.policy: run for run in map(read_run, runs)}
    steps = {policy: run.steps for policy, run in read.items()}
    gains = {
        policy: [(s["step"], s["information_gain"]) for s in lines[1:]]
        for policy, lines in steps.items()
    }
    assert curves(drawn["gain.png"].axes[0]) == gains
    covered = {
        policy: [(s["images"], 100 * s["coverage"]) for s in lines]
        for policy, lines in steps.items()
    }
    assert curves(drawn["coverage.png"].axes[0]) == covered
    for axis, key in zip(drawn["psnr.png"].axes, ("psnr", "psnr_mask"), strict=True):
        assert curves(axis) == {
            policy: [(s["images"], s[key]) for s in lines] for policy, lines in steps.items()
        }
    positions = np.array([camera.position[:2] for camera in tiny.orbit()])
    for axis, run in zip(drawn["orbit.png"].axes, read.values(), strict=False):
        shown = {points.get_label(): points.get_offsets() for points in axis.collections}
        for label, frames in (
            ("candidate", range(tiny.FRAMES)),
            ("seed", run.seeds),
            ("chosen", run.chosen),
        ):
            np.testing.assert_allclose(shown[label], positions[list(frames)], atol=1e-9)
    shown = {
        axis.get_title().split("\n")[0]: axis
        for axis in drawn["comparison.png"].axes
        if axis.images
    }
    assert list(shown) == ["truth", "d-optimal", "random", ""]
    for policy, grey in (("d-optimal", 0.3), ("random", 0.2)):
        np.testing.assert_allclose(
            shown[policy].images[0].get_array(), srgb_from_linear(np.float64(grey)), atol=1 / 255
        )


def test_figures_are_written_as_asked_for(runs, tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        main(["report", *map(str, runs), "--out", str(tmp_path / "report"), "--figures", "pdf"])
    assert stop.value.code == 0
    assert "left out" not in capsys.readouterr().out
    names = {path.name for path in (tmp_path / "report").iterdir()}
    assert names == {
        *(f"{name}.pdf" for name in ("orbit", "gain", "coverage", "comparison", "psnr")),
        "table.md",
        "table.json",
    }
    assert (tmp_path / "report/gain.pdf").read_bytes().startswith(b"%PDF")
    figures.gain_figure(tmp_path / "gain.svg", {"random": [0.2, 0.1]})
    assert "<svg" in (tmp_path / "gain.svg").read_text()
    with pytest.raises(
        InputError, match=r"gain\.eps: figures are written as png, pdf, svg; choose another ending"
    ):
        figures.gain_figure(tmp_path / "gain.eps", {"random": [0.2, 0.1]})
    assert "--figures eps: unknown; choose one of png, pdf, svg" in refused(
        capsys, ["report", *runs, "--figures", "eps"]
    )
    page = ["--html", tmp_path / "page.html", "--figures", "pdf"]
    assert "--html alone writes no figures" in refused(capsys, ["report", *runs, *page])


def test_a_figure_that_is_left_out_is_named(runs, tmp_path, capsys):
    copies = [tmp_path / run.name for run in runs]
    for run, copy in zip(runs, copies, strict=True):
        shutil.copytree(run, copy)
        lines = [json.loads(line) for line in (copy / "steps.jsonl").read_text().splitlines()]
        bare = [{key: value for key, value in line.items() if "psnr" not in key} for line in lines]
        (copy / "steps.jsonl").write_text("".join(json.dumps(line) + "\n" for line in bare))
    with pytest.raises(SystemExit) as stop:
        main(["report", *map(str, copies), "--out", str(tmp_path / "report")])
    assert stop.value.code == 0
    assert (
        "PSNR against images is left out: it needs that all runs were made with --evaluate-every"
        in capsys.readouterr().out
    )
    assert not (tmp_path / "report/psnr.png").exists()


def test_unseen_view(runs):
    read = [read_run(folder) for folder in runs]
    index = writing.unseen_view(read, range(tiny.FRAMES))
    counts = [sum(i in run.seeds + run.chosen for run in read) for i in range(tiny.FRAMES)]
    assert counts[index] == min(counts)


@pytest.mark.parametrize("sets", [["all", "held_out"], ["test", "all", "held_out"]])
def test_table(request, sets):
    runs = request.getfixturevalue("tested" if "test" in sets else "runs")
    rows = tables.table_numbers(runs)
    metrics = json.loads((runs[1] / "metrics.json").read_text())
    means = {f"{views}.{name}": value for views in sets for name, value in metrics[views].items()}
    last = json.loads((runs[1] / "steps.jsonl").read_text().splitlines()[-1])
    run = read_run(runs[1])
    positions = [tiny.orbit()[i].position for i in run.seeds + run.chosen]
    path = pytest.approx(sum(np.linalg.norm(b - a) for a, b in pairwise(positions)))
    known = {
        "policy": "random",
        "images": 8,
        "coverage": 100 * last["coverage"],
        "path": path,
        "unit": "m",
    }
    assert rows[1] == means | known
    lines = [
        [cell.strip() for cell in line.split("|")[1:-1]]
        for line in tables.markdown_table(rows).splitlines()
    ]
    assert len(lines) == 4
    row = dict(zip(lines[0], lines[3], strict=True))
    assert row["policy"] == "random"
    assert row["images"] == "8"
    assert row["PSNR, all (dB)"] == f"{metrics['all']['psnr']:.2f}"
    assert row["SSIM, held out, rock only"] == f"{metrics['held_out']['ssim_mask']:.4f}"
    assert row["path (m)"] == f"{rows[1]['path']:.2f}"
    assert len(row) == 10 + 4 * ("test" in sets)
    nobody_knows = tables.markdown_table([row | {"unit": "unit"} for row in rows])
    assert "| path (unit) |" in nobody_knows
    if "test" in sets:
        assert lines[0][2] == "PSNR, test views (dB)"
        assert lines[3][2] == f"{metrics['test']['psnr']:.2f}"
    console = Console(width=80, file=io.StringIO())
    printing.print_quality(console, rows)
    printed = console.file.getvalue()
    assert max(map(len, printed.splitlines())) <= 80
    for key in printing.SHOWN["test" in sets]:
        assert tables.table_cell(key, rows[1][key]) in printed


def test_the_views_that_were_not_measured_have_a_dash(runs, tested):
    rows = [*tables.table_numbers(runs), *tables.table_numbers(tested)]
    lines = tables.markdown_table(rows).splitlines()
    assert len({line.count("|") for line in lines}) == 1
    assert lines[2].count("–") == 4
    assert lines[4].count("–") == 0


def test_a_report_shows_test_views_where_there_are_some(tested, tmp_path, drawn):
    writing.write_report(tmp_path / "report", tested)
    lines = {run.policy: run.steps for run in map(read_run, tested)}
    axes = drawn["psnr.png"].axes
    assert [axis.get_ylabel() for axis in axes] == [
        "PSNR, test views (dB)",
        "PSNR, test views, rock only (dB)",
    ]
    for axis, key in zip(axes, ("test_psnr", "test_psnr_mask"), strict=True):
        assert curves(axis) == {
            policy: [(s["images"], s[key]) for s in steps] for policy, steps in lines.items()
        }
    metrics = json.loads((tested[0] / "metrics.json").read_text())
    shown = {
        axis.get_title().split("\n")[0]: axis
        for axis in drawn["comparison.png"].axes
        if axis.images
    }
    assert shown["truth"].get_title() == "truth\nkf_0001"
    assert f"{metrics['test_views'][1]['psnr']:.2f} dB" in shown["d-optimal"].get_title()
    assert "trained" not in shown["d-optimal"].get_title()


def test_a_run_that_was_not_measured_on_the_test_views_is_compared_on_the_others(
    tested, tmp_path, drawn
):
    run = shutil.copytree(tested[1], tmp_path / "random")
    metrics = json.loads((run / "metrics.json").read_text())
    write_json(
        run / "metrics.json",
        {key: value for key, value in metrics.items() if not key.startswith("test")},
    )
    lines = [json.loads(line) for line in (run / "steps.jsonl").read_text().splitlines()]
    kept = [
        {key: value for key, value in line.items() if not key.startswith("test")} for line in lines
    ]
    (run / "steps.jsonl").write_text("".join(json.dumps(line) + "\n" for line in kept))
    writing.write_report(tmp_path / "report", [tested[0], run])
    assert drawn["psnr.png"].axes[0].get_ylabel() == "PSNR, all views (dB)"
    read = [read_run(folder) for folder in (tested[0], run)]
    shown = f"kf_{writing.unseen_view(read, range(tiny.FRAMES)):04d}"
    assert drawn["comparison.png"].axes[0].get_title() == f"truth\n{shown}"


def test_runs_of_one_policy_are_told_apart_by_their_folders(runs, tmp_path):
    other = shutil.copytree(runs[1], tmp_path / "again")
    assert list(compare_runs([*runs, other]).runs) == [
        "d-optimal",
        "random (random)",
        "random (again)",
    ]
    with pytest.raises(InputError, match="same policy and folder name"):
        compare_runs([runs[1], runs[1]])


def test_runs_that_cannot_be_compared(runs, tmp_path):
    other = shutil.copytree(runs[1], tmp_path / "other")
    metrics = json.loads((other / "metrics.json").read_text())
    (other / "metrics.json").write_text(json.dumps(metrics | {"images": 7}))
    with pytest.raises(
        InputError, match="not evaluated since its last step; measure it with `mgs eval"
    ):
        writing.write_report(tmp_path / "report", [runs[0], other])
    (other / "metrics.json").write_text(json.dumps(metrics))
    config = json.loads((other / "config.json").read_text())
    config["settings"]["dataset"] = "/elsewhere"
    (other / "config.json").write_text(json.dumps(config))
    with pytest.raises(InputError, match="another dataset"):
        writing.write_report(tmp_path / "report", [runs[0], other])
    shutil.rmtree(shutil.copytree(runs[0], tmp_path / "undrawn") / "renders")
    with pytest.raises(InputError, match="draw it with `mgs eval"):
        writing.write_report(tmp_path / "report", [tmp_path / "undrawn"])
    assert not (tmp_path / "report").exists()


def test_pictures_of_an_earlier_model_are_not_shown(runs, tmp_path):
    """A run that went on was measured without pictures: those that are there are of fewer images
    than the caption says."""
    run = shutil.copytree(runs[0], tmp_path / "run")
    write_json(
        run / "metrics.json", json.loads((run / "metrics.json").read_text()) | {"pictures": False}
    )
    with pytest.raises(InputError, match="no picture of this model; draw it with `mgs eval"):
        writing.write_report(tmp_path / "report", [run])


def test_missing_and_damaged_files(runs, tmp_path):
    with pytest.raises(InputError, match=r"holds no run \(no config\.json\)"):
        read_run(tmp_path)
    (tmp_path / "config.json").write_text((runs[0] / "config.json").read_text())
    with pytest.raises(InputError, match=r"steps\.jsonl: no such file; .*--resume"):
        read_run(tmp_path)
    for damaged, cause in {"": "no JSON", "{": "no JSON", "{}\n": "images: Field required"}.items():
        (tmp_path / "steps.jsonl").write_text(damaged)
        with pytest.raises(
            InputError,
            match=rf"steps\.jsonl: line 1 is damaged \({cause}\); write the file anew with `mgs nbv --r",
        ):
            read_run(tmp_path)
    (tmp_path / "steps.jsonl").write_text((runs[0] / "steps.jsonl").read_text())
    with pytest.raises(InputError, match="mgs eval"):
        tables.table_numbers([tmp_path])


DAMAGED = [
    (key, value)
    for key in ("coverage", "images", "information_gain", "frame")
    for value in (None, "a", ...)
]


@pytest.mark.parametrize(
    ("key", "value"), [*DAMAGED, ("ended", "gain"), ("ended", {"reason": "tired", "views": 1})]
)
def test_a_damaged_line(runs, tmp_path, key, value):
    run = shutil.copytree(runs[0], tmp_path / "run")
    lines = [json.loads(line) for line in (run / "steps.jsonl").read_text().splitlines()]
    lines[2] = {k: v for k, v in (lines[2] | {key: value}).items() if v is not ...}
    (run / "steps.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    with pytest.raises(
        InputError,
        match=rf"steps\.jsonl: line 3 is damaged \({key}\b.*: .*anew with `mgs nbv --resume",
    ):
        writing.write_report(tmp_path / "report", [run])


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda config: config.pop("settings"), "has no settings"),
        (lambda config: config["settings"].pop("policy"), "settings.policy: Field required"),
        (
            lambda config: config["settings"].update(budget="many"),
            "settings.budget: Input should be a valid integer",
        ),
    ],
)
def test_a_damaged_config(runs, tmp_path, change, named):
    """Resuming does not write it anew, and would not read it."""
    run = shutil.copytree(runs[0], tmp_path / "run")
    config = json.loads((run / "config.json").read_text())
    change(config)
    write_json(run / "config.json", config)
    with pytest.raises(InputError, match=rf"config\.json: {named}.*start the run anew"):
        read_run(run)


def test_an_unfinished_run(runs, tmp_path):
    """Evaluated on the way or not: what is missing is the rest of it."""
    run = shutil.copytree(runs[0], tmp_path / "run")
    lines = (run / "steps.jsonl").read_text().splitlines(keepends=True)
    (run / "steps.jsonl").write_text("".join(lines[:3]))
    (run / "gaussians.ply").unlink()
    expected = f"{run}: is unfinished, with 5 of 8 views; go on with `mgs nbv --resume {run}`"
    metrics = json.loads((run / "metrics.json").read_text())
    for change in (
        lambda: None,
        lambda: write_json(run / "metrics.json", metrics | {"images": 5}),
        (run / "metrics.json").unlink,
    ):
        change()
        with pytest.raises(InputError, match=re.escape(expected)):
            writing.write_report(tmp_path / "report", [runs[1], run])
    (run / "steps.jsonl").write_text("".join(lines))
    with pytest.raises(
        InputError,
        match=r"run: has all 8 views, but no gaussians\.ply; write it with `mgs nbv --resume",
    ):
        writing.write_report(tmp_path / "report", [run])
    assert not (tmp_path / "report").exists()


@pytest.mark.parametrize(
    "metrics", [{}, [], 1, {"all": {}}, {"images": 8, "all": {}, "held_out": {}, "views": [{}]}]
)
def test_damaged_metrics(runs, tmp_path, metrics):
    run = shutil.copytree(runs[0], tmp_path / "run")
    write_json(run / "metrics.json", metrics)
    with pytest.raises(InputError, match=r"metrics\.json: is damaged; measure"):
        writing.write_report(tmp_path / "report", [run])


def test_a_view_that_was_not_evaluated(runs, tmp_path):
    run = shutil.copytree(runs[0], tmp_path / "run")
    metrics = json.loads((run / "metrics.json").read_text())
    write_json(run / "metrics.json", metrics | {"views": []})
    with pytest.raises(InputError, match="was not evaluated on kf_"):
        writing.write_report(tmp_path / "report", [run])
    assert not (tmp_path / "report").exists()


def test_a_report_of_a_dataset_that_has_changed(runs, tmp_path):
    run = shutil.copytree(runs[0], tmp_path / "run")
    config = json.loads((run / "config.json").read_text())
    write_json(run / "config.json", config | {"frames": config["frames"][:-1]})
    with pytest.raises(InputError, match="its frames differ"):
        writing.write_report(tmp_path / "report", [run])
    config["settings"]["dataset"] = str(tmp_path / "moved")
    write_json(run / "config.json", config)
    with pytest.raises(InputError, match="correct `dataset` in this file"):
        writing.write_report(tmp_path / "report", [run])


def test_comparison_is_cropped_to_the_rock():
    mask = np.zeros((100, 200), bool)
    mask[40:60, 50:80] = True
    rows, columns = plotting.crop(mask)
    assert (rows.start, rows.stop, columns.start, columns.stop) == (34, 66, 38, 92)
    assert plotting.crop(np.zeros((4, 4), bool)) == (slice(None), slice(None))


@pytest.mark.parametrize(
    "labels",
    [["d-optimal"], ["random (a folder of a long name)"], ["random (a)", "random (b)", "mine"]],
)
@pytest.mark.parametrize(
    "title", ["kf_0001", "DJI_20231105103211_0004_W_some_flight_over_some_rock_with_a_long_name"]
)
def test_no_word_of_a_comparison_is_cut_off_or_written_over(tmp_path, monkeypatch, labels, title):
    drawn = []
    monkeypatch.setattr(figures, "save_figure", lambda figure, path: drawn.append(figure))
    truth = np.zeros((60, 80, 3))
    truth[10:50, 20:60] = 0.5
    captions = dict.fromkeys(labels, "100 images, trained on; 30.09 dB, SSIM 0.9301")
    renders = dict.fromkeys(labels, truth + 0.1)
    figures.comparison_figure(tmp_path / "a.png", truth, renders, title=title, captions=captions)
    figure = drawn[0]
    with rc_context(plotting.STYLE):
        FigureCanvasAgg(figure).draw()
    texts = [text for axis in figure.axes for text in (axis.title, *axis.texts)] + [
        figure.axes[-1].xaxis.label
    ]
    boxes = [text.get_window_extent() for text in texts if text.get_text()]
    assert len(boxes) == 3 + len(labels)
    for box in boxes:
        assert figure.bbox.x0 <= box.x0 < box.x1 <= figure.bbox.x1
        assert figure.bbox.y0 <= box.y0 < box.y1 <= figure.bbox.y1
    titles = [axis.title.get_window_extent() for axis in figure.axes if axis.title.get_text()]
    assert len(titles) == 1 + len(labels)
    assert all(a.x1 < b.x0 for a, b in pairwise(titles))


@pytest.mark.parametrize("runs", [1, 2, 4, 8])
@pytest.mark.parametrize("name", ["d-optimal", "random (a folder of a long name)"])
def test_no_word_of_an_orbit_is_cut_off_or_written_over(tmp_path, monkeypatch, runs, name):
    drawn = []
    monkeypatch.setattr(figures, "save_figure", lambda figure, path: drawn.append(figure))
    figures.orbit_figure(
        tmp_path / "a.png", np.eye(3), None, {f"{name} {i}": ([0], [1]) for i in range(runs)}
    )
    figure, *axes = drawn[0], *drawn[0].axes[:runs]
    with rc_context(plotting.STYLE):
        FigureCanvasAgg(figure).draw()
    titles = [axis.title.get_window_extent() for axis in axes]
    assert all(a.x1 < b.x0 for a, b in pairwise(titles))
    assert 0 <= titles[0].x0 < titles[-1].x1 <= figure.bbox.x1
    assert all(box.y1 <= figure.bbox.y1 for box in titles)
    legend = figure.legends[0].get_window_extent()
    assert legend.y0 >= 0
    assert all(legend.y1 <= axis.xaxis.label.get_window_extent().y0 for axis in axes)


@pytest.mark.parametrize("runs", [1, 4, 8, 20])
def test_a_legend_covers_no_line(tmp_path, monkeypatch, runs):
    """It stands beside the axes, which keep their size, whole."""
    drawn = []
    monkeypatch.setattr(figures, "save_figure", lambda figure, path: drawn.append(figure))
    labels = [f"random (a folder of a long name {i})" for i in range(runs)]
    curve = ([4, 5, 6], [0.1, 0.2, 0.3])
    figures.gain_figure(tmp_path / "a.png", dict.fromkeys(labels, curve[1]))
    figures.coverage_figure(tmp_path / "a.png", dict.fromkeys(labels, curve))
    figures.psnr_figure(
        tmp_path / "a.png",
        {what: dict.fromkeys(labels, curve) for what in ("test views", "rock only")},
    )
    assert len(drawn) == 3
    for figure in drawn:
        with rc_context(plotting.STYLE):
            FigureCanvasAgg(figure).draw()
        legend = figure.legends[0].get_window_extent()
        assert [text.get_text() for text in figure.legends[0].get_texts()] == labels
        assert figure.bbox.x0 <= legend.x0 < legend.x1 <= figure.bbox.x1
        assert figure.bbox.y0 <= legend.y0 < legend.y1 <= figure.bbox.y1
        for axis in figure.axes:
            assert axis.get_legend() is None
            assert axis.get_tightbbox().x1 <= legend.x0
            assert axis.bbox.width > 2.3 * figure.dpi


@pytest.mark.parametrize(
    "labels",
    [
        list(POLICY_STYLE),
        ["mine", "d-optimal", "yours"],
        ["random (a)", "random (b)"],
        [f"mine-{i}" for i in range(15)],
    ],
)
def test_every_line_of_a_figure_looks_different(labels):
    styles = figures.line_styles(labels)
    assert [style["label"] for style in styles] == labels
    assert len({(style["color"], style["marker"], style["linestyle"]) for style in styles}) == len(
        labels
    )


SEEN = {
    "normal": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "protanopia": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deuteranopia": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "tritanopia": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
}
"""Linear RGB as colour-blind people see it (Machado, Oliveira, Fernandes 2009)."""


@pytest.mark.parametrize("eyes", SEEN)
def test_every_policy_has_a_colour_and_a_marker_of_its_own(eyes):
    assert set(POLICY_STYLE) >= set(policy_names())
    colours, markers = zip(*POLICY_STYLE.values(), strict=True)
    assert len(set(markers)) == len(markers) == len({SYMBOLS[marker] for marker in markers})
    linear = (
        linear_from_srgb(np.array([to_rgb(colour) for colour in colours])) @ np.array(SEEN[eyes]).T
    )
    seen = rgb2lab(srgb_from_linear(np.clip(linear, 0, 1)))
    apart = np.linalg.norm(seen[:, None] - seen[None], axis=2) + 100 * np.eye(len(seen))
    assert apart.min() > 9  # a difference of 2 is just seen where patches touch
    assert seen[:, 0].max() < 80  # and all are seen on white


def test_a_policy_keeps_its_style_whatever_it_is_compared_with():
    ours = figures.line_styles(["mine", "random (a)", "random (b)"])[1]
    assert (ours["color"], ours["marker"]) == POLICY_STYLE["random"]


@pytest.mark.parametrize(
    "name", ["random (a [second] run in a folder with a long name)", "random" * 20, "d-optimal"]
)
def test_a_long_name_cuts_no_number_and_is_not_cut(name):
    console = Console(width=80, record=True, file=io.StringIO())
    values = dict(
        zip(printing.SHOWN[False], (30.09, 0.9426, 29.56, 0.9362, 27.54, 0.7538), strict=True)
    )
    row = {"images": 12, "coverage": 100.0} | values
    printing.print_quality(console, [{"policy": name} | row, {"policy": "random"} | row])
    text = console.export_text()
    assert all(
        text.count(tables.table_cell(key, value)) == 2
        for key, value in row.items()
        if key != "images"
    )
    assert "…" not in text
    assert any(name in line for line in text.splitlines())
    assert max(len(line) for line in text.splitlines() if name not in line) <= 80
