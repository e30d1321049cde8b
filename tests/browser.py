"""A headless Chromium of this machine, driven by playwright."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome")

SOFTWARE_GL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")
"""WebGL without a graphics card."""


@contextmanager
def chromium() -> Iterator[Any]:
    """Yield a browser of playwright; skip the test if there is none."""
    missing = "playwright is not installed (pip install playwright)"
    playwright = pytest.importorskip("playwright.sync_api", reason=missing)
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
    browser, address, width, height, scheme="light", known=lambda _: False, scripts=True, serve=None
) -> Iterator[tuple[Any, list[str]]]:
    """Open an address in a window of this size; yields the page and a list of what went wrong on
    it: console errors, exceptions, and requests to other hosts.

    known: whether a ConsoleMessage of playwright is an error to pass over. scripts: whether the
    browser runs them. serve: answers each request (a Route of playwright) in place of a server.
    """
    window = {"viewport": {"width": width, "height": height}, "has_touch": width < 600}
    context = browser.new_context(**window, color_scheme=scheme, java_script_enabled=scripts)
    page, wrong = context.new_page(), []
    own = ("data:", "blob:", "file:", "about:", address, address.replace("http", "ws"))

    def on_console(message: Any) -> None:
        if message.type == "error" and not known(message):
            wrong.append(message.text)

    def on_request(request: Any) -> None:
        if not request.url.startswith(own):
            wrong.append(request.url)

    page.on("console", on_console)
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.on("request", on_request)
    if serve is not None:
        page.route("**/*", serve)
    page.set_default_timeout(200_000)  # the machine may be busy
    page.goto(address)
    try:
        yield page, wrong
    finally:
        context.close()
