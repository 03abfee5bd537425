"""Time from the click on STOP to both loops at rest: at most 100 ms."""

import contextlib
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from tests.live.control_client import Control
from tests.view.console.browser import hold
from tests.view.console.served import Served, served, wait_for

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.alone

WATCH = """() => { for (const name of ['pointerdown', 'keydown'])
    document.addEventListener(name, event => { window.pressed ??=
        performance.timeOrigin + event.timeStamp; }, true); }"""


def at_rest(runs: Served, into: list[float]) -> None:
    """Store the time at which both loops are at rest, on the clock of a page; a control socket closes then."""
    with Control(runs.folder / "m.ctl") as master, Control(runs.folder / "s.ctl") as slave:
        for side in (master, slave):
            with contextlib.suppress(OSError):
                while side.ask("status").get("is_at_rest") is False:
                    time.sleep(0.001)
    into.append(time.time() * 1e3)


@pytest.mark.parametrize(("focus", "act"), [("#force-scale", "Escape"), ("#axis", "click")])
def test_a_click_and_a_key_stop_within_100_ms(focus: str, act: str, browser: "Browser", tmp_path: Path) -> None:
    with served(tmp_path) as runs:
        page = browser.new_page()
        page.goto(runs.console.address)
        page.wait_for_selector("#side-master .headline")
        hold(page, 1.3)
        wait_for(lambda: runs.master.state == "engaged")
        page.evaluate(WATCH)
        page.focus(focus)
        ended: list[float] = []
        watching = threading.Thread(target=at_rest, args=(runs, ended))
        watching.start()
        if act == "click":
            page.click("#stop")
        else:
            page.keyboard.press(act)
        watching.join(70.0)
        took_ms = ended[0] - page.evaluate("window.pressed")
        print(f"{act!r}: {took_ms:.0f} ms")
        page.close()
        assert 0.0 < took_ms < 100.0
