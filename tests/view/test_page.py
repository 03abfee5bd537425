"""The page of a run in a browser: it draws, plays and steps by itself, and makes no other request."""

import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image
from tests.view.console.browser import chromium
from tests.view.shown import shown

from haptether.view.page.page import write_page

if TYPE_CHECKING:
    from playwright.sync_api import Page


def picture(page: "Page") -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(page.locator("canvas").first.screenshot())).convert("RGB"))


def test_a_page_draws_and_steps_in_a_browser(tmp_path: Path) -> None:
    path = tmp_path / "push.html"
    write_page(path, [shown("remote_push")[2]], [0.1 * n for n in range(40)])
    troubles: list[str] = []
    asked: list[str] = []
    with chromium() as browser:
        page = browser.new_page(viewport={"width": 800, "height": 480})
        page.on("console", lambda said: troubles.append(said.text) if said.type == "error" else None)
        page.on("pageerror", lambda error: troubles.append(str(error)))
        page.on("request", lambda request: asked.append(request.url))
        page.goto(path.as_uri())
        page.wait_for_selector("canvas")
        page.locator("#play").click()
        before = page.locator("#scrub").input_value()
        first = picture(page)
        page.keyboard.press("t")
        page.wait_for_function("before => document.getElementById('scrub').value !== before", arg=before)
        page.wait_for_timeout(200)
        at_trip = picture(page)
        page.keyboard.press("3")
        page.wait_for_timeout(200)
        from_above = picture(page)
    assert troubles == []
    assert asked == [path.as_uri()]
    assert np.std(first) > 10.0
    for one, other in ((first, at_trip), (at_trip, from_above)):
        assert np.count_nonzero(np.any(one != other, axis=-1)) > 200
