"""Picture of the report of a run in a notebook."""

from pathlib import Path

from tests.view.console.browser import chromium

import haptether


def photograph_report(path: Path) -> None:
    """Write a PNG of `Run._repr_html_`."""
    shown = haptether.simulate("remote_push")._repr_html_()
    with chromium() as browser:
        page = browser.new_page(viewport={"width": 720, "height": 800}, device_scale_factor=1.5)
        style = "font-family:sans-serif;font-size:13px;margin:0;padding:8px;display:inline-block"
        page.set_content(f"<!doctype html><body style='{style}'>{shown}</body>")
        page.locator("body").screenshot(path=path)
