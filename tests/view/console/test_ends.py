"""Both ends in three dimensions on the page: drawn, moving, of one side alone, and not while the page is hidden."""

import json
from typing import TYPE_CHECKING, Any

import pytest
from tests.view.console.served import Served, wait_for

from haptether.bridge import TelemetryHello, TelemetryReader
from haptether.view.console.bodies import WAITING, Bodies

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = pytest.mark.alone

SHADES = """station => {
    const canvas = document.querySelector(`#end-${station} canvas`), gl = canvas.getContext('webgl');
    const pixels = new Uint8Array(4 * canvas.width * canvas.height);
    gl.readPixels(0, 0, canvas.width, canvas.height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
    const shades = new Set();
    for (let n = 0; n < pixels.length; n += 4) shades.add(pixels[n] << 16 | pixels[n + 1] << 8 | pixels[n + 2]);
    return shades.size;
}"""
"""Returns the number of colours of a picture."""


def test_page_draws_both_ends_and_nothing_while_it_is_hidden(browser: "Browser", runs: Served) -> None:
    context = browser.new_context(viewport={"width": 1280, "height": 900})
    page = context.new_page()
    errors: list[Any] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    # Requests of the page: it reads from its own server only.
    asked: set[str] = set()
    page.on("request", lambda request: asked.add(request.url))
    page.goto(runs.console.address)
    page.wait_for_selector("#end-robot canvas")
    wait_for(lambda: all(page.evaluate(SHADES, station) > 20 for station in ("hand", "robot")))
    assert {url.partition("/" + runs.token)[0] for url in asked} == {f"http://127.0.0.1:{runs.console.port}"}
    drawn = count_draws(page)
    # A person turns the view.
    box = page.locator("#end-robot canvas").bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + 100, box["y"] + 100)
    before = page.evaluate("() => ends.views.robot.azimuth")
    page.mouse.down()
    page.mouse.move(box["x"] + 160, box["y"] + 100)
    page.mouse.up()
    assert page.evaluate("() => ends.views.robot.azimuth") != before
    wait_for(lambda: drawn() > 3)
    page.evaluate("() => Object.defineProperty(document, 'hidden', {value: true, configurable: true})")
    page.wait_for_timeout(100)
    hidden = drawn()
    page.wait_for_timeout(300)
    assert drawn() == hidden
    # A page whose renderer fails still has its buttons.
    page.evaluate("() => { delete document.hidden; View.prototype.draw = () => { throw new Error('lost'); }; }")
    page.wait_for_function("() => document.getElementById('ends-notes').textContent === 'not drawn: lost'")
    page.click("#stop")
    wait_for(lambda: runs.master.finished and runs.slave.finished)
    assert not errors
    context.close()
    wait_for(lambda: not runs.console.bodies.is_watched)


def count_draws(page: "Page") -> Any:  # noqa: ANN401  # a function
    page.evaluate("""() => { window.draws = 0; const draw = View.prototype.draw;
        View.prototype.draw = function (...of) { window.draws++; return draw.apply(this, of); }; }""")
    return lambda: page.evaluate("() => window.draws")


@pytest.mark.parametrize(("side", "station"), [("m", "hand"), ("s", "robot")])
def test_of_one_side_there_is_one_end(runs: Served, side: str, station: str) -> None:
    bodies = Bodies()
    bodies.is_watched = True
    with TelemetryReader(runs.folder / f"{side}.sock") as reader:
        bodies.take(reader.hello)
        bodies.start()
        for message in reader:
            bodies.take(reader.hello, message)
            if bodies.frame is not None:
                break
    bodies.close()
    whole = json.loads(bodies.geometry)
    assert set(whole["views"]) == {station} == {part["station"] for part in whole["parts"]}
    assert bodies.frame is not None
    assert bodies.frame["generation"] == whole["generation"]


def test_what_comes_faster_than_it_is_drawn_waits_for_nobody(runs: Served) -> None:
    with TelemetryReader(runs.folder / "m.sock") as reader:
        hello: TelemetryHello = reader.hello
        message = next(iter(reader))
    # No thread takes from the queue.
    bodies = Bodies()
    for _ in range(2 * WAITING):
        bodies.take(hello, message)
    assert bodies.frame is None
