"""Makes the screenshots of docs/images with a headless Chromium: `python tools/screenshots.py
demo`, after `make demo`."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from PIL import Image

from mgs.cli.demo import POLICIES
from mgs.report.page import write_page

IMAGES = Path(__file__).parent.parent / "docs/images"

ARGUMENTS = [
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
]
"""WebGL without a graphics card."""


def save(picture: Image.Image, name: str) -> None:
    """Write a picture at two thirds of its size, which is enough to see what is where."""
    small = picture.convert("RGB").resize(
        (picture.width * 2 // 3, picture.height * 2 // 3), Image.Resampling.LANCZOS
    )
    small.save(IMAGES / name, optimize=True)
    print(f"wrote {IMAGES / name}")


def report(browser: Any, demo: Path, folder: Path) -> None:
    """The page of the demo's runs: its step by step on a desk, light, and the comparison on a
    phone, dark."""
    page = folder / "page.html"
    write_page(page, [demo / policy for policy in POLICIES])
    shots = []
    for width, height, scheme, section in (
        (1100, 1180, "light", "steps"),
        (390, 1180, "dark", "compare"),
    ):
        tab = browser.new_context(
            viewport={"width": width, "height": height}, color_scheme=scheme
        ).new_page()
        tab.goto(page.as_uri())
        tab.locator("#step").fill("6")
        tab.evaluate(f"document.getElementById('{section}').scrollIntoView()")
        tab.wait_for_timeout(4000)
        tab.screenshot(path=folder / f"{section}.png")
        shots.append(Image.open(folder / f"{section}.png"))
    both = Image.new("RGB", (sum(shot.width for shot in shots) + 20, shots[0].height), "white")
    both.paste(shots[0], (0, 0))
    both.paste(shots[1], (shots[0].width + 20, 0))
    save(both, "report_html.png")


def viewer(browser: Any, demo: Path, folder: Path) -> None:
    """The viewer of a run: a camera selected, with the colours of the model and with its
    uncertainty."""
    command = [sys.executable, "-m", "mgs", "view", str(demo / "d-optimal"), "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        address = process.stdout.readline().split()[1]
        tab = browser.new_context(viewport={"width": 1100, "height": 760}).new_page()
        tab.goto(address)
        tab.get_by_label("View", exact=True).first.click()
        tab.get_by_role("option", name="kf_0028", exact=True).click()
        for x in range(
            420, 520, 20
        ):  # turns, so that the notice about software rendering has time to go, too
            tab.mouse.move(x, 500)
            tab.mouse.down()
        tab.mouse.up()
        tab.locator("button[class*=CloseButton]").first.click()
        tab.wait_for_timeout(5000)
        tab.screenshot(path=folder / "view.png")
        process.send_signal(signal.SIGINT)
    save(Image.open(folder / "view.png"), "view.png")


def main(demo: Path) -> None:
    """Make all screenshots from the folder of the demo."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver, tempfile.TemporaryDirectory() as folder:
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=ARGUMENTS)
        report(browser, demo, Path(folder))
        viewer(browser, demo, Path(folder))
        browser.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
