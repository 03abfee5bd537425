"""Chromium without a display, and a page of the console in it."""

import shutil
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

    from playwright.sync_api import Browser, Page

ARGUMENTS = (
    "--no-sandbox", "--disable-quic", "--disable-background-networking", "--disable-component-update",
    "--disable-sync", "--no-first-run",
)  # fmt: skip
"""Options: no sandbox, which does not start for root; the others stop connections to other hosts."""


@contextmanager
def chromium() -> "Iterator[Browser]":
    """Start the system's Chromium; Debian's package is `chromium`.

    Raises:
        RuntimeError: No Chromium is installed.
    """
    from playwright.sync_api import sync_playwright

    path = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if path is None:
        message = "chromium is not installed: on Debian and Ubuntu the package is named chromium; .ci/run installs it"
        raise RuntimeError(message)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=list(ARGUMENTS))
        yield browser
        browser.close()


def press(page: "Page") -> None:
    """Press Engage without releasing it."""
    box = page.locator("#engage").bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + 10, box["y"] + 10)
    page.mouse.down()


def hold(page: "Page", seconds: float) -> None:
    """Press Engage, and release it after a time."""
    press(page)
    page.wait_for_timeout(seconds * 1e3)
    page.mouse.up()


def said(page: "Page", text: str) -> None:
    """Wait until the page shows a text."""
    page.wait_for_function("text => document.getElementById('said').textContent.includes(text)", arg=text)


def change(page: "Page", name: str, value: str) -> None:
    """Change a scale, and confirm it."""
    page.fill(f"#{name}-scale", value)
    page.click(f"#set-{name}")
    page.click("#confirm-yes")
