"""Makes the screenshots of docs/images with a headless Chromium: `python tools/screenshots.py demo`, after `make demo`."""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

from PIL import Image

from mgs.report.page import write_page

IMAGES = Path(__file__).parent.parent / "docs/images"

ARGUMENTS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
"""WebGL without a graphics card."""


def save(picture: Image.Image, name: str) -> None:
    """Write a picture at two thirds of its size, which is enough to see what is where."""
    small = picture.convert("RGB").resize((picture.width * 2 // 3, picture.height * 2 // 3), Image.Resampling.LANCZOS)
    small.save(IMAGES / name, optimize=True)
    print(f"wrote {IMAGES / name}")


def report(browser: Any, demo: Path, folder: Path) -> None:
    """The page of the demo's runs: its step by step on a desk, light, and the comparison on a phone, dark."""
    page = folder / "page.html"
    write_page(page, [demo / policy for policy in ("d-optimal", "coverage", "random")])
    shots = []
    for width, height, scheme, section in ((1100, 1180, "light", "steps"), (390, 1180, "dark", "compare")):
        tab = browser.new_context(viewport={"width": width, "height": height}, color_scheme=scheme).new_page()
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


def main(demo: Path) -> None:
    """Make all screenshots from the folder of the demo."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver, tempfile.TemporaryDirectory() as folder:
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=ARGUMENTS)
        report(browser, demo, Path(folder))
        browser.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
