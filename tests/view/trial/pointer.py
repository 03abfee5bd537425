"""A scripted pointer on the page of `haptether try`."""

import contextlib
from typing import TYPE_CHECKING

from tests.view.console.browser import hold
from tests.view.trial.tried import Tried, wait_until

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

SPAN = 0.1
"""Half the width of the field in m."""
STEP_S = 0.03
TRIES = 5


def opened(browser: "Browser", runs: Tried) -> "Page":
    """Return an open page that shows both pairs."""
    page = browser.new_context(viewport={"width": 1366, "height": 768}).new_page()
    page.set_default_timeout(30_000)
    page.goto(runs.trial.address)
    for name in ("left", "right"):
        page.wait_for_selector(f"#pair-{name} .facts")
    return page


def coupled(runs: Tried, page: "Page") -> None:
    """Hold Engage until all four sides are engaged; a person repeats a hold that the browser held up."""
    for _ in range(TRIES):
        hold(page, 1.4)
        with contextlib.suppress(AssertionError):
            wait_until(lambda: runs.states() == {"engaged"}, 2.0)
            return
    message = f"{page.inner_text('#said')}: {page.inner_text('#pairs')}"
    raise AssertionError(message)


def point(page: "Page", metres: float) -> None:
    """Move the pointer to a target."""
    box = page.locator("#pad").bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + (metres / SPAN + 1.0) / 2.0 * box["width"], box["y"] + box["height"] / 2.0)


def press_in(page: "Page", begin: float, end: float, seconds: float) -> None:
    """Grip at one target, and move to another."""
    point(page, begin)
    page.mouse.down()
    steps = round(seconds / STEP_S)
    for step in range(1, steps + 1):
        point(page, begin + (end - begin) * step / steps)
        page.wait_for_timeout(STEP_S * 1e3)


def throw(page: "Page", depth: float, *, seconds: float = 1.5, rest_ms: float = 500.0, push: bool = False) -> None:
    """Press into the wall, let go, and wait for the measurement of both pairs.

    A browser that is held up opens the hand before; a person then tries again.
    """
    for _ in range(TRIES):
        before = page.evaluate("() => (lanes.releases || []).length")
        press_in(page, 0.02, depth, seconds)
        if push:
            page.keyboard.press("p")
        page.wait_for_timeout(rest_ms)
        was_held = page.evaluate("() => hand.by === 'pointer'")
        page.mouse.up()
        if not was_held:
            continue
        page.wait_for_function(
            """before => { const found = (lanes.releases || []).slice(before).filter(row => row.kind === 'let go');
            return found.length && Object.values(found.at(-1).pairs).every(one => one.is_complete); }""",
            arg=before,
        )
        return
    raise AssertionError(page.inner_text("#said"))


def peak_speeds(page: "Page") -> dict[str, float]:
    """Return the peak speeds of the newest measurement by pair."""
    found: dict[str, float] = page.evaluate(
        "Object.fromEntries(Object.entries(lanes.releases.at(-1).pairs).map(([name, one]) => [name, one.peak_speed]))"
    )
    return found
