"""The console in Chromium, with two live sides: every button, and pages that close, stall, hide, or are the second."""

import contextlib
import os
import signal
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from tests.view.console.browser import change, hold, press, said
from tests.view.console.served import Served, served, wait_for

if TYPE_CHECKING:
    from collections.abc import Iterator

    from playwright.sync_api import Browser, Page

# The browser draws on all processors and would delay real-time loops beside it.
pytestmark = pytest.mark.alone


@pytest.fixture
def page(browser: "Browser", runs: Served) -> "Iterator[Page]":
    with_errors = opened(browser, runs)
    yield with_errors
    with_errors.context.close()


def opened(browser: "Browser", runs: Served) -> "Page":
    page = browser.new_context(viewport={"width": 1280, "height": 900}).new_page()
    page.set_default_timeout(30_000)
    page.goto(runs.console.address)
    page.wait_for_selector("#side-master .headline")
    page.wait_for_selector("#side-slave .headline")
    return page


def coupled(runs: Served, page: "Page") -> None:
    hold(page, 1.3)
    wait_for(lambda: runs.master.state == "engaged")


def test_every_button(runs: Served, page: "Page") -> None:
    errors: list[Any] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    # A short click, and a hold that is released.
    page.click("#engage")
    hold(page, 0.7)
    said(page, "let go too early")
    # Script events do not count as input of a person.
    page.evaluate("""() => { for (const name of ['pointerdown', 'mousedown', 'click'])
        document.getElementById('engage').dispatchEvent(
            new PointerEvent(name, {bubbles: true, button: 0, pointerId: 1})); }""")
    page.wait_for_timeout(1300)
    assert runs.master.state == "disengaged"
    coupled(runs, page)
    page.wait_for_selector("#side-master .headline .engaged")
    # The scales are those of the scene until a person types.
    assert [page.input_value(f"#{name}-scale") for name in ("force", "position")] == ["1", "1"]
    for form, value, text in (
        ("force", "0.5", "master: the scale goes to 0.5"),
        ("position", "0.8", "slave: the scale goes to 0.8"),
        ("force", "5", "must be between 0.5 and 2, with an open clutch between 0.01 and 100; release the clutch first"),
        ("force", "1e308", "set coupling.force_scale in the scene"),
    ):
        change(page, form, value)
        said(page, text)
    # The page asks, and a script or Cancel answers: nothing is sent.
    before = page.inner_text("#said")
    page.fill("#force-scale", "0.9")
    page.click("#set-force")
    page.evaluate("document.getElementById('confirm-yes').click()")
    assert page.is_visible("#confirm")
    page.click("#confirm-no")
    assert page.is_hidden("#confirm")
    page.wait_for_timeout(200)
    assert page.inner_text("#said") == before
    page.fill("#force-scale", "much")
    page.click("#set-force")
    said(page, "must be a number")
    page.click("#acknowledge-slave")
    said(page, "slave: what was wrong")
    page.click("#acknowledge-master")
    said(page, "master: what was wrong")
    page.click("#release")
    said(page, "the clutch is released")
    wait_for(lambda: runs.master.state != "engaged")
    coupled(runs, page)
    page.focus("#engage")
    page.keyboard.press(" ")
    said(page, "no force, no motion")
    wait_for(lambda: runs.master.finished and runs.slave.finished)
    page.wait_for_selector("#side-master .trouble")
    assert not errors


def test_pages_that_are_closed_stalled_hidden_or_second(browser: "Browser", runs: Served, page: "Page") -> None:
    second = opened(browser, runs)
    # Only one page holds at a time; the other gets a message.
    press(page)
    press(second)
    said(second, "another page")
    page.mouse.up()
    second.mouse.up()
    page.click("#release")
    said(page, "the clutch is released")
    wait_for(lambda: runs.master.state != "engaged")
    # A hidden page releases its hold.
    press(page)
    page.evaluate("""() => { Object.defineProperty(document, 'hidden', {value: true, configurable: true});
        document.dispatchEvent(new Event('visibilitychange')); }""")
    page.wait_for_timeout(1200)
    page.mouse.up()
    assert runs.master.state != "engaged"
    page.evaluate("() => delete document.hidden")
    # The page's script hangs during a hold: beats sent late do not count as a hold.
    press(page)
    page.wait_for_timeout(200)
    page.evaluate("() => { const end = performance.now() + 1100; while (performance.now() < end); }")
    said(page, "let go, and hold again")
    page.mouse.up()
    assert runs.master.state != "engaged"
    coupled(runs, page)
    # A page closes during a hold, stalls, and is killed: the loop stays coupled.
    skipped = runs.master.ticks
    press(second)
    second.wait_for_timeout(300)
    second.context.close()
    renderers = renderers_of(os.getpid())
    assert renderers
    for renderer in renderers:
        # The renderer of the closed page may be ending at this moment.
        with contextlib.suppress(ProcessLookupError):
            os.kill(renderer, signal.SIGSTOP)
    begun_s, ticks = time.monotonic(), runs.master.ticks
    time.sleep(1.0)
    rate = (runs.master.ticks - ticks) / (time.monotonic() - begun_s)
    for renderer in renderers:
        # The renderer of the closed page may be ending at this moment.
        with contextlib.suppress(ProcessLookupError):
            os.kill(renderer, signal.SIGCONT)
    assert runs.master.state == "engaged"
    assert rate > 500.0
    assert runs.master.ticks > skipped
    for renderer in renderers:
        # The renderer of the closed page may be ending at this moment.
        with contextlib.suppress(ProcessLookupError):
            os.kill(renderer, signal.SIGKILL)
    time.sleep(0.5)
    assert runs.master.state == "engaged"
    # Another page can still stop.
    third = opened(browser, runs)
    third.click("#stop")
    said(third, "no force, no motion")
    third.context.close()
    wait_for(lambda: runs.master.finished and runs.slave.finished)


def test_another_origin_reads_and_commands_nothing(browser: "Browser", runs: Served, tmp_path: Path) -> None:
    """Use a page that even knows the token."""
    folder = tmp_path / "other"
    folder.mkdir()
    with served(folder) as attacker:
        # Bypass the attacker's own policy: the test is about the console's refusals.
        context = browser.new_context(bypass_csp=True)
        page = context.new_page()
        page.goto(attacker.console.address)
        found = page.evaluate(
            """async address => {
                const found = {};
                try { found.read = await (await fetch(address)).text(); } catch (error) { found.read = 'refused'; }
                try { found.stop = (await fetch(address + 'stop', {method: 'POST', mode: 'no-cors'})).type; }
                catch (error) { found.stop = 'refused'; }
                found.live = await new Promise(done => {
                    const socket = new WebSocket(address.replace('http', 'ws') + 'live');
                    socket.onopen = () => { socket.send('{"do":"stop"}'); done('open'); };
                    socket.onerror = () => done('refused');
                });
                return found;
            }""",
            runs.console.address,
        )
        context.close()
    # The page cannot read the answer.
    assert found["stop"] in {"opaque", "refused"}
    assert found["read"] == "refused"
    assert found["live"] == "refused"
    time.sleep(0.2)
    assert not runs.master.finished


def renderers_of(pid: int) -> list[int]:
    """Return the Chromium renderers among the descendants of a process."""
    parents: dict[int, int] = {}
    renderers: list[int] = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            parents[int(entry.name)] = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            if b"--type=renderer" in (entry / "cmdline").read_bytes():
                renderers.append(int(entry.name))
        except (OSError, ValueError, IndexError):
            continue

    def descends(process: int) -> bool:
        while process not in (0, 1):
            if process == pid:
                return True
            process = parents.get(process, 0)
        return False

    return [renderer for renderer in renderers if descends(renderer)]
