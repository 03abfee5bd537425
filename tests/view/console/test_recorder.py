"""The flight recorder on the page: its words and ticks match the file, and an invalid file is named."""

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from tests.view.console.browser import change, hold, said
from tests.view.console.served import served, wait_for

from haptether.bridge import load_scene
from haptether.bridge.flight import read_flight
from haptether.view.console.recorder import FlightWatch

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.alone


def test_page_says_why_the_master_stopped_and_scales_rotation(browser: "Browser", tmp_path: Path) -> None:
    with served(tmp_path, of=load_scene("torque_release")) as runs:
        context = browser.new_context(viewport={"width": 1280, "height": 900})
        page = context.new_page()
        errors: list[Any] = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(runs.console.address)
        page.wait_for_selector("#side-slave .headline")
        assert page.locator(".flight").count() == 0
        # Each acts at its side, if the sides are of kind pose.
        for name, side in (("torque", "master"), ("rotation", "slave")):
            change(page, name, "0.7")
            said(page, f"{side}: the scale goes to 0.7")
        hold(page, 1.3)
        wait_for(lambda: runs.master.state == "engaged")
        runs.slave.stop()
        wait_for(lambda: runs.master.cause() is not None)
        page.click("#stop")
        # The file of a side appears at its end.
        runs.master.finish()
        text = runs.master.flight()
        assert text is not None
        path = tmp_path / "m.flight"
        path.write_text(text)
        flight = read_flight(path)
        cause = flight.causes[-1]
        page.wait_for_selector("#flight-master .cause")
        shown = page.inner_text("#flight-master")
        assert cause.text in shown
        assert all(step.text in shown for step in cause.steps)
        assert flight.transitions[-1].reason in shown
        times = page.locator("#flight-master tbody td:first-child").all_inner_texts()
        assert times == [f"{tick.time_s:.4f}" for tick in (flight.at_hold or flight.latest)[-10:]]
        path.write_text("{}")
        page.wait_for_selector(".flight .trouble")
        assert "is no file of a flight recorder" in page.inner_text(".flight")
        assert not errors
        context.close()


def test_file_that_grew_beyond_its_bound_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "m.flight"
    watch = FlightWatch(path)
    assert not watch.read()
    path.write_bytes(b" " * ((1 << 20) + 1))
    assert watch.read()
    assert watch.content is not None
    assert re.search("must be a file of at most 1048576 bytes", watch.content["error"])
    assert not watch.read()
