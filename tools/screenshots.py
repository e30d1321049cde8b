"""Draw the pictures of docs/images that show the demo: `python tools/screenshots.py demo`.

`product.png` (first picture of the README) needs the demo alone. `report_html.png` and `view.png`
also need a headless Chromium.
"""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from PIL import Image

import mgs
from mgs.cli.demo import POLICIES
from mgs.colour import srgb_from_linear
from mgs.plotting import STYLE, crop, new_figure, save_figure
from mgs.policy.criteria import regularisation, uncertainty
from mgs.report.diagnostics import view_maps
from mgs.report.page import write_page
from mgs.splat import groups

IMAGES = Path(__file__).parent.parent / "docs/images"

ARGUMENTS = [
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
]
"""WebGL without a graphics card."""


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
        save_figure(figure, IMAGES / "product.png")


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


def report(browser: Any, demo: Path, folder: Path) -> None:
    """Draw the page of the demo's runs, on a desk and on a phone, side by side."""
    page = folder / "page.html"
    write_page(page, [demo / policy for policy in POLICIES])
    both = Image.new("RGB", (1510, 1180), "white")
    for x, width, scheme, section in ((0, 1100, "light", "steps"), (1120, 390, "dark", "compare")):
        tab = browser.new_context(
            viewport={"width": width, "height": both.height}, color_scheme=scheme
        ).new_page()
        tab.goto(page.as_uri())
        tab.locator("#step").fill("6")
        tab.evaluate(f"document.getElementById('{section}').scrollIntoView()")
        tab.wait_for_timeout(4000)
        tab.screenshot(path=folder / f"{section}.png")
        both.paste(Image.open(folder / f"{section}.png"), (x, 0))
    save(both, "report_html.png")


def viewer(browser: Any, demo: Path, folder: Path) -> None:
    """Draw the viewer of a run, with a camera selected."""
    command = [sys.executable, "-m", "mgs", "view", str(demo / "d-optimal"), "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        address = process.stdout.readline().split()[1]
        tab = browser.new_context(viewport={"width": 1100, "height": 760}).new_page()
        tab.goto(address)
        tab.get_by_label("View", exact=True).first.click()
        tab.get_by_role("option", name="kf_0028", exact=True).click()
        for x in range(420, 520, 20):  # until the notice about software rendering has gone
            tab.mouse.move(x, 500)
            tab.mouse.down()
        tab.mouse.up()
        tab.locator("button[class*=CloseButton]").first.click()
        tab.wait_for_timeout(5000)
        tab.screenshot(path=folder / "view.png")
        process.send_signal(signal.SIGINT)
    save(Image.open(folder / "view.png"), "view.png")


def save(picture: Image.Image, name: str) -> None:
    """Write a picture at two thirds of its size."""
    size = picture.width * 2 // 3, picture.height * 2 // 3
    picture.convert("RGB").resize(size, Image.Resampling.LANCZOS).save(IMAGES / name, optimize=True)


def main(demo: Path) -> None:
    """Draw all pictures from the folder of the demo."""
    from playwright.sync_api import sync_playwright

    product(demo)
    with sync_playwright() as driver, tempfile.TemporaryDirectory() as folder:
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=ARGUMENTS)
        report(browser, demo, Path(folder))
        viewer(browser, demo, Path(folder))
        browser.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
