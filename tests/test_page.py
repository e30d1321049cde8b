"""The report page: what stands in it, whatever the runs; and in a real browser."""

import json
import re
import shutil
from types import SimpleNamespace
from unittest.mock import MagicMock
from urllib.parse import unquote

import numpy as np
import pytest
import synthetic
import tiny
from browser import opened
from program import change_settings, change_steps, command
from program import steps as read_steps
from refusals import refused

from mgs import Camera, evaluate_run, load_dataset, open_run, write_page
from mgs.files import read_json, write_json
from mgs.reports import page as pages
from mgs.reports.page_plots import corners_at


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two runs: one finished and measured, one stopped two steps before its end."""
    root = tmp_path_factory.mktemp("a <b> & c")  # to be escaped, in an address and in text
    tiny.write_dataset(root / "data/test", frames=3)
    dataset = load_dataset(tiny.write_dataset(root / "data"))
    for policy, budget in (("d-optimal", 3), ("random", 1)):
        out = root / policy
        settings = tiny.start(out, dataset, policy=policy, budget=3, evaluate_every=1)
        settings = settings.model_copy(update={"budget": budget})
        tiny.go(out, settings, dataset)
    evaluate_run(root / "d-optimal", pictures=False)
    (root / "d-optimal/diagnostics").mkdir()
    (root / "d-optimal/diagnostics/kf_0001.exr").write_bytes(b"")
    return [root / "d-optimal", root / "random"]


@pytest.fixture(scope="module")
def page(runs):
    path = runs[0].parent / "pages/page.html"
    size = write_page(path, runs)
    assert size == path.stat().st_size
    return path


def read_page(path):
    """Links, addresses that are loaded, text outside of scripts, and the data of a page."""
    page = path.read_text()
    data = re.search(r'<script[^>]* id="data"[^>]*>(.*?)</script>', page, re.DOTALL)
    tags = re.sub(r"(<(script|style)\b[^>]*>).*?</\2>", r"\1", page, flags=re.DOTALL)
    return SimpleNamespace(
        links=re.findall(r'<a [^>]*href="([^"]*)"', tags),
        loaded=re.findall(r'<(?:link\b[^>]* href|\w+\b[^>]* src)="([^"]*)"', tags),
        text=" ".join(re.sub(r"<[^>]*>", " ", tags).split()),
        data=json.loads(data[1]),
    )


def test_the_page_says_what_the_files_say(page, runs):
    parsed, metrics = read_page(page), read_json(runs[0] / "metrics.json")
    data = parsed.data
    assert parsed.loaded == ["data:,"]
    for group in ("all", "held_out"):
        assert f"{metrics[group]['psnr']:.2f}" in parsed.text
    assert "Unfinished: 4 of 6 views are taken" in parsed.text
    assert parsed.text.count("Unfinished") == 1
    assert "Not measured: `mgs eval" in parsed.text
    steps = read_steps(runs[0])
    plots = {plot["title"]: plot["data"] for plot in data["plots"]}
    gain, both = plots["Information gain of each chosen view (the paper's Fig. 2)"]
    assert gain["y"] == [step["information_gain"] for step in steps[1:]]
    assert len(both["y"]) == 1
    covered = plots["Gaussians observed (coverage, Fig. 3)"][0]["y"]
    assert covered == [100 * step["coverage"] for step in steps]
    views = data["runs"][0]["views"]
    taken = [*steps[0]["seed_names"], *(step["name"] for step in steps[1:])]
    assert [view["name"] for view in views] == taken
    psnr = {view["name"]: f"{view['psnr']:.2f} dB" for view in metrics["views"]}
    captions = [view["pictures"][1]["caption"] for view in views]
    assert captions == [f"render, {psnr[name]}" for name in taken]
    facts = {key for view in views for key in dict(view["facts"])}
    assert facts >= {"information gain", "Gaussians observed", "PSNR (dB)"}
    shown = [view for one in data["runs"] for view in one["views"]]
    for picture in (picture for view in shown for picture in view["pictures"]):
        assert picture["alt"]
        assert data["pictures"][picture["name"]].startswith("data:image/webp;base64,")
    trained = {view["name"] for view in shown}
    assert not trained & {view["view"] for view in data["compared"]}


def test_the_page_of_a_fit_without_masks_speaks_of_photographs(page, runs, tmp_path):
    root = tmp_path / "fit"
    shutil.copytree(runs[0].parent, root)
    change_settings(root / "d-optimal", dataset=str(root / "data"), seeds=6, budget=0)
    synthetic.edit(root / "data", lambda data: [f.pop("mask_path") for f in data["frames"]])
    synthetic.edit(root / "data", lambda data: data.update(unit="unit"))
    steps = read_steps(root / "d-optimal")
    steps = [line | {"warnings": ["few passes"] * (not line["step"])} for line in steps]
    change_steps(root / "d-optimal", lambda _: steps)
    write_page(tmp_path / "fit.html", [root / "d-optimal"])
    parsed, masked = read_page(tmp_path / "fit.html"), read_page(page)
    assert "Run of mgs fit on" in parsed.text
    views = [view["name"] for view in parsed.data["runs"][0]["views"]]
    assert views == sorted(views) != [frame.name for frame in open_run(runs[0]).taken]
    assert "The truth is the photograph." in parsed.text
    assert "object in front of black" not in json.dumps(parsed.data)
    assert "few passes" in parsed.text
    for words in (
        "step 0",
        "of the step",
        "Step by step",
        "coverage (%)",
        "path (",
        "(unit",
        "Time,",
    ):
        assert words not in parsed.text
    shown = json.dumps(parsed.data["runs"])
    for words in ("seed", "Seed", "Chosen", "Gaussians observed", "(unit", "step (0"):
        assert words not in shown
    assert "Runs of mgs nbv on" in masked.text
    assert "The truth is the object alone in front of black." in masked.text


def test_links_lead_to_the_files(page):
    links = read_page(page).links
    assert all((page.parent / unquote(link)).is_file() for link in links)
    names = {link.rsplit("/", 1)[-1] for link in links}
    assert names >= {"gaussians.ply", "kf_0001.exr", "config.json", "metrics.json"}
    assert sum(link.endswith("gaussians.ply") for link in links) == 2


def test_the_page_is_the_same_every_time(page, runs):
    write_page(page.parent / "again.html", runs)
    assert (page.parent / "again.html").read_bytes() == page.read_bytes()


def test_uncertainty_falls_with_every_view(runs):
    """Maps before and after a view are of the exact information of the views until then."""
    from mgs.policy.criteria import regularisation
    from mgs.splat import fisher, groups

    run, album = open_run(runs[0]), MagicMock()
    frames, model = run.taken, run.state.gaussians
    pages.draw_taken(album, "a", run, lambda: None)
    shown = {name: values for (name, values, _), _ in album.add_uncertainty.call_args_list}
    lam = regularisation(groups(0), run.settings.pixel_noise, run.settings.prior_std)
    H = np.zeros((tiny.POINTS, 11))
    for frame in frames:
        before = shown[f"before/{frame.name}/a"]
        H += fisher(model, frame.camera)
        after = shown[f"after/{frame.name}/a"]
        assert before.max() <= 1 + 1e-5
        assert (after <= before + 1e-6).all()
    seen = after > 0
    least = (lam / (H + lam)).mean(axis=1).min()
    assert after[seen].min() >= least - 1e-5
    first = shown[f"before/{frames[0].name}/a"]
    np.testing.assert_array_equal(first > 0.99, first > 0)


def test_pictures_stay_within_their_share(monkeypatch, runs):
    dataset = open_run(runs[0]).dataset
    album = pages.new_album(dataset.frames, 1)
    rows, columns = album.window
    mask = np.logical_or.reduce([frame.mask() for frame in dataset.frames])
    assert mask[rows, columns].sum() == mask.sum()
    monkeypatch.setattr(pages, "PIXELS", 1000)
    small = pages.new_album(dataset.frames, 50)
    assert small.width**2 * mask[rows, columns].shape[0] / mask[rows, columns].shape[1] <= 1000 / 50


def test_corners_of_a_camera_project_to_those_of_its_image():
    camera: Camera = tiny.orbit()[1]
    pixels, depth = camera.project(corners_at(camera, 0.5))
    np.testing.assert_allclose(pixels, [[0, 0], [16, 0], [16, 12], [0, 12]], atol=1e-9)
    np.testing.assert_allclose(depth, 0.5)


def test_old_metrics_are_left_out(runs, tmp_path):
    run = shutil.copytree(runs[0], tmp_path / "run")
    metrics = read_json(run / "metrics.json")
    write_json(run / "metrics.json", metrics | {"images": 5})
    write_page(tmp_path / "with.html", [run])
    parsed = read_page(tmp_path / "with.html")
    captions = [view["pictures"][1]["caption"] for view in parsed.data["runs"][0]["views"]]
    assert set(captions) == {"render"}
    assert "metrics.json is of 5 images, the model of 6" in parsed.text
    assert f"{metrics['held_out']['psnr']:.4f}" not in parsed.text
    assert "PSNR, held-out views" not in parsed.text


def test_test_views_are_compared_and_their_metrics_shown(runs, tmp_path):
    """Under names unlike those of the dataset's own views; the first is the most typical."""
    metrics = read_json(runs[0] / "metrics.json")
    mean = metrics["test"]["psnr"]
    typical = min(metrics["test_views"], key=lambda view: abs(view["psnr"] - mean))
    write_page(tmp_path / "page.html", runs[:1])
    parsed = read_page(tmp_path / "page.html")
    compared = parsed.data["compared"]
    tests = [one["view"] for one in compared if one["view"].startswith("test/")]
    assert sorted(tests) == ["test/kf_0000", "test/kf_0001", "test/kf_0002"]
    assert compared[0]["view"] == f"test/{typical['name']}"
    assert compared[0]["sides"][1]["label"] == f"d-optimal, {typical['psnr']:.2f} dB"
    assert f"PSNR, test views (dB) {mean:.2f}" in parsed.text
    assert "test/kf_0001" in parsed.data["plots"][-1]["data"][1]["x"]


def test_the_command(runs, tmp_path, capsys):
    command("report", runs[1], "--html", tmp_path / "page.html")
    said = capsys.readouterr().out.replace("\n", "")
    assert re.search(r"wrote .*page\.html \(\d+\.\d MB\)", said)
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]
    assert "is a folder" in refused(capsys, ["report", runs[0], "--html", tmp_path], tmp_path)


EVIL = "<img src=x onerror=owned=1>$\\x{1+1}<script>owned=1<a href='https:evil.example'>"
"""A name that is markup for a browser, for Plotly and for matplotlib."""


@pytest.fixture(scope="module")
def hostile(tmp_path_factory):
    """The page of a run by a stranger, whose names and texts are markup."""
    root = tmp_path_factory.mktemp("hostile") / EVIL
    dataset = tiny.write_dataset(root / "data", 6)
    text = (dataset / "transforms.json").read_text().replace("kf_0001", EVIL.replace('"', ""))
    for path in [*dataset.rglob("kf_0001.*")]:
        path.rename(path.with_stem(EVIL))
    (dataset / "transforms.json").write_text(text.replace("\\", "\\\\"))
    loaded = load_dataset(dataset)
    run = root / EVIL
    tiny.run(run, loaded, budget=2, evaluate_every=1)
    evaluate_run(run)
    config = read_json(run / "config.json")
    config["settings"]["policy"] = f"/a/{EVIL}.py:{EVIL}"
    config["versions"] = {EVIL: EVIL}
    write_json(run / "config.json", config)
    change_steps(run, lambda lines: [line | {"warnings": [EVIL]} for line in lines])
    write_page(root / "page.html", [run])
    return root / "page.html"


def test_figures_and_pages_take_names_literally(hostile):
    command("diagnose", hostile.parent / EVIL, "--views", EVIL)
    assert EVIL not in hostile.read_text()


@pytest.mark.parametrize("scripts", [True, False])
def test_a_page_about_a_strangers_run_is_safe(browser, hostile, tmp_path, scripts):
    """Nothing of the run is executed or loaded, with scripts and without; and if markup got in, the
    policy of the page would stop it."""
    with opened(browser, hostile.as_uri(), 800, 500, scripts=scripts) as (tab, wrong):
        assert tab.locator(f"text={EVIL}").first.is_visible()
        if scripts:
            views = tab.locator(".figures .plot").last  # names its views
            views.scroll_into_view_if_needed()
            views.locator(".main-svg").first.wait_for(state="attached")
            assert tab.evaluate("typeof owned") == "undefined"
        assert tab.locator("svg a, a[href^='https:']").count() == 0
        assert tab.locator("img[src=x]").count() == 0
        assert wrong == []
    text = hostile.read_text().replace("<h1>", "<h1><script>owned=1</script>" + EVIL)
    (tmp_path / "injected.html").write_text(text)
    address = (tmp_path / "injected.html").as_uri()
    with opened(browser, address, 800, 500, scripts=scripts) as (tab, wrong):
        assert tab.locator("h1 img").count() == 1
        if scripts:
            assert tab.evaluate("typeof owned") == "undefined"


@pytest.mark.parametrize(("width", "height", "scheme"), [(900, 600, "light"), (390, 600, "dark")])
def test_the_page_in_a_browser(browser, page, width, height, scheme):
    with opened(browser, page.as_uri(), width, height, scheme) as (tab, wrong):
        assert tab.evaluate("document.documentElement.scrollWidth") <= width
        background = tab.evaluate("getComputedStyle(document.body).backgroundColor")
        assert (background == "rgb(255, 255, 255)") == (scheme == "light")
        for name in ("plot-0", "time-0", "orbit-0"):
            tab.locator(f"#{name}").scroll_into_view_if_needed()
            tab.wait_for_selector(f"#{name} .main-svg", state="attached")
        tab.wait_for_selector("#orbit-0 canvas")
        tab.evaluate("dispatchEvent(new Event('beforeprint'))")  # figures below are printed, too
        assert tab.locator(".plot:visible:not(:has(.main-svg))").count() == 0
        assert tab.locator("img:not([alt]), img[alt='']").count() == 0
        assert tab.locator(".plot:not([aria-label])").count() == 0

        def shown():
            return tab.locator("#pictures img").evaluate_all(
                "all => all.map(i => [i.alt, i.naturalWidth, i.complete])"
            )

        def fact(name):
            return tab.locator(f"#facts dt:text-is('{name}') + dd").inner_text()

        assert len(shown()) == 5
        assert fact("taken as") == "seed 1 of 3"
        tab.locator("#step").focus()
        for _ in range(3):
            tab.keyboard.press("ArrowRight")
        assert fact("taken as") == "step 1"
        images = "[...document.querySelectorAll('#pictures img')]"
        tab.wait_for_function(f"{images}.every(i => i.complete && i.naturalWidth)")
        assert all(fact("view") in alt for alt, *_ in shown())
        marked = tab.evaluate("document.getElementById('orbit-0').data.at(-1).x[0]")
        assert marked == pytest.approx(tab.evaluate("data.runs[0].views[3].eye[0]"))
        tab.locator("#run").select_option("1")
        assert tab.locator("#orbit-1").is_visible()
        assert not tab.locator("#orbit-0").is_visible()

        divider = tab.locator("#divider")
        divider.scroll_into_view_if_needed()
        box = divider.bounding_box()
        tab.mouse.click(box["x"] + 0.25 * box["width"], box["y"] + 0.5 * box["height"])
        style = "getComputedStyle(document.getElementById('divider'))"
        at = tab.evaluate(f"{style}.getPropertyValue('--at')").strip("%")
        assert float(at) == pytest.approx(25, abs=3)
        before = tab.locator("#compare-b").get_attribute("src")
        tab.locator("#compare-right").select_option("2")
        assert tab.locator("#compare-b").get_attribute("src") != before
        assert "random" in tab.locator("#compare-b").get_attribute("alt")

        tab.locator("#theme").click()
        assert tab.evaluate("getComputedStyle(document.body).backgroundColor") != background
        assert wrong == []
