"""A headless Chromium for the tests, by playwright: the system's own, as playwright's cannot be
installed everywhere."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome")

SOFTWARE_GL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")
"""WebGL without a graphics card."""


@contextmanager
def chromium() -> Iterator[Any]:
    """Context manager that gives a browser of playwright; skips the test where there is none."""
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="playwright is not installed (pip install playwright)"
    )
    path = next((found for name in NAMES if (found := shutil.which(name))), None)
    if path is None:
        pytest.skip("no Chromium on this machine (apt-get install chromium)")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=path, args=["--no-sandbox", *SOFTWARE_GL])
        try:
            yield browser
        finally:
            browser.close()


@contextmanager
def opened(
    browser: Any,
    address: str,
    width: int,
    height: int,
    scheme: str = "light",
    known: Callable[[Any], bool] = lambda message: False,
) -> Iterator[tuple[Any, list[str]]]:
    """Context manager that opens an address in a window of this size, and gives the page and what
    went wrong on it: errors on its console but those that are known, exceptions, and requests to
    places other than the address's own host and the disk.

    known: of an error on the console, a ConsoleMessage of playwright, whether it is left out."""
    context = browser.new_context(
        viewport={"width": width, "height": height}, color_scheme=scheme, has_touch=width < 600
    )
    page, wrong = context.new_page(), []
    page.on(
        "console",
        lambda message: (
            wrong.append(message.text) if message.type == "error" and not known(message) else None
        ),
    )
    page.on("pageerror", lambda error: wrong.append(str(error)))
    own = ("data:", "blob:", "file:", "about:", address, address.replace("http", "ws"))
    page.on(
        "request",
        lambda request: wrong.append(request.url) if not request.url.startswith(own) else None,
    )
    page.goto(address)
    try:
        yield page, wrong
    finally:
        context.close()
