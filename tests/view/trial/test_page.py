"""The page of `haptether try` in Chromium on two real pairs: the lessons, STOP, and pages that fail."""

import contextlib
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from tests.view.console.browser import said
from tests.view.console.test_page import renderers_of
from tests.view.trial.pointer import TRIES, coupled, opened, peak_speeds, point, press_in, throw
from tests.view.trial.tried import NAMES, Tried, tried, wait_until

from haptether.bridge import simulate
from haptether.studies.tuning import tune
from haptether.view.trial.server import Choice

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = [pytest.mark.alone, pytest.mark.slow]

HELD_M = -0.02
"""A hand holds a stylus that is deeper in the wall."""


@pytest.fixture
def runs(tmp_path: Path) -> Iterator[Tried]:
    folder = tmp_path / "sockets"
    folder.mkdir(mode=0o700)
    with tried(folder) as found:
        yield found


@pytest.fixture
def bare(tmp_path: Path) -> Iterator[Tried]:
    """Both pairs without a controller, which would keep a stylus in the wall."""
    folder = tmp_path / "sockets"
    folder.mkdir(mode=0o700)
    with tried(folder, choice=Choice(controllers={"left": "none", "right": "none"})) as found:
        yield found


def learnt(page: "Page", lesson: int) -> str:
    """Wait for the end of a lesson; return what it says."""
    page.wait_for_selector("#lesson .next-lesson")
    assert page.evaluate("lessons.at") == lesson
    return page.inner_text("#lesson p")


def is_held(runs: Tried) -> bool:
    return all(at < HELD_M for at in runs.positions().values())


def grip(runs: Tried, page: "Page") -> None:
    """Grip both styluses in the wall; a browser that is held up opens the hand, and a person grips again."""
    for _ in range(TRIES):
        press_in(page, 0.02, -0.04, 0.8)
        with contextlib.suppress(AssertionError):
            wait_until(lambda: is_held(runs), 3.0)
            return
        page.mouse.up()
    raise AssertionError(page.inner_text("#said"))


def has_opened(runs: Tried) -> bool:
    """Return True if the wall has thrown both styluses out of it."""
    return all(at > -0.002 for at in runs.positions().values())


def test_the_three_lessons_and_their_repetition(browser: "Browser", tmp_path: Path) -> None:
    folder, record = tmp_path / "sockets", tmp_path / "record"
    folder.mkdir(mode=0o700)
    record.mkdir()
    errors: list[Any] = []
    with tried(folder, record) as runs:
        page = opened(browser, runs)
        page.on("pageerror", lambda error: errors.append(str(error)))
        assert page.evaluate("[document.documentElement.scrollHeight, document.documentElement.scrollWidth]") == [
            768, 1366,
        ]  # fmt: skip
        coupled(runs, page)
        throw(page, -0.045)
        thrown = [peak_speeds(page)]
        assert "without a controller" in learnt(page, 0)
        # The controller holds the stylus back.
        assert thrown[0]["right"] < 0.6 * thrown[0]["left"]
        page.click("#lesson .next-lesson")
        throw(page, -0.01, seconds=0.6, rest_ms=900.0, push=True)
        thrown.append(peak_speeds(page))
        learnt(page, 1)
        page.click("#lesson .next-lesson")
        page.fill("#set-delay_s", "200")
        page.wait_for_function("() => trial.network.delay_s === 0.2")
        # The first frames are late by more than the ladder allows.
        wait_until(lambda: "hold" in runs.states())
        page.wait_for_timeout(1000)
        coupled(runs, page)
        throw(page, -0.045, rest_ms=900.0)
        thrown.append(peak_speeds(page))
        learnt(page, 2)
        assert runs.states() == {"engaged"}
        page.context.close()
    assert not errors
    for name in NAMES:
        peaks = peak_speeds_repeated(record, name)
        for lesson, speeds in enumerate(thrown, 1):
            # One for each lesson, unless the browser was held up before.
            repeated = min(peaks, key=lambda one: abs(one - speeds[name]))
            print(f"{name}: lesson {lesson}: {speeds[name]:.3f} m/s live, {repeated:.3f} m/s repeated")
            assert repeated == pytest.approx(speeds[name], rel=0.15)


def peak_speeds_repeated(record: Path, name: str) -> list[float]:
    """Return the peak speed in virtual time within 1.5 s of each release of a recorded hand."""
    rows = np.genfromtxt(record / f"{name}-aims.csv", delimiter=",", names=True)
    gripped = rows["strength_n"] > 0.0
    run = simulate(record / f"{name}.toml")
    time_s, speed = run.signals["time_s"], abs(run.signals["velocity"])
    return [
        float(speed[(time_s > opened_s) & (time_s < opened_s + 1.5)].max())
        for opened_s in rows["time_s"][1:][gripped[:-1] & ~gripped[1:]]
    ]


def test_a_run_that_only_holds_is_normal_operation(browser: "Browser", tmp_path: Path) -> None:
    """`tune` takes a run that STOP ends while the hand holds, and refuses one with a release."""
    folder, record = tmp_path / "sockets", tmp_path / "record"
    folder.mkdir(mode=0o700)
    record.mkdir()
    with tried(folder, record) as runs:
        page = opened(browser, runs)
        coupled(runs, page)
        press_in(page, 0.02, -0.03, 2.0)
        assert page.evaluate("() => hand.by === 'pointer'")
        page.keyboard.press("Escape")
        wait_until(lambda: all(feed.summary().get("has_ended") for feed in runs.trial.feeds))
        page.mouse.up()
        page.click("#restart")
        said(page, "both bridges are back, disengaged")
        coupled(runs, page)
        throw(page, -0.045)
        page.context.close()
    tuned = tune([record / "right.mcap"], scene=record / "right.toml", hands=2, releases=1)
    assert tuned.hours * 3600.0 > 2.0
    (threshold,) = tuned.thresholds
    assert threshold.field == "energy_threshold_j"
    with pytest.raises(ValueError, match="a hand that lets go is no normal operation"):
        tune([record / "right-2.mcap"])


def test_stop_ends_all_four_and_restart_couples_none(browser: "Browser", runs: Tried) -> None:
    page = opened(browser, runs)
    coupled(runs, page)
    press_in(page, 0.02, -0.03, 0.5)
    page.keyboard.press(" ")
    wait_until(lambda: all(feed.summary().get("has_ended") for feed in runs.trial.feeds))
    said(page, "no force, no motion")
    page.mouse.up()
    page.wait_for_function("() => document.getElementById('pair-left').textContent.includes('Press Restart')")
    page.select_option("#controller-left", "hsc")
    said(page, "both bridges are back, disengaged")
    page.wait_for_function("() => document.getElementById('pair-left').textContent.includes('HSC')")
    press_in(page, 0.02, 0.0, 0.5)
    assert runs.states() == {"disengaged"}
    page.context.close()


def test_a_page_that_is_duplicated_stalled_or_killed_loses_its_hand(browser: "Browser", bare: Tried) -> None:
    page = opened(browser, bare)
    coupled(bare, page)
    second = opened(browser, bare)
    grip(bare, page)
    point(second, 0.05)
    second.mouse.down()
    said(second, "another page holds the stylus")
    assert is_held(bare)
    second.mouse.up()
    second.context.close()
    # The script of the page hangs: the hand opens, and stays open until the button is pressed again.
    page.evaluate("() => { const end = performance.now() + 1500; while (performance.now() < end); }")
    wait_until(lambda: has_opened(bare), 5.0)
    said(page, "the hand has opened")
    page.wait_for_timeout(700)
    assert has_opened(bare)
    page.mouse.up()
    grip(bare, page)
    # A hidden page opens the hand, too.
    page.evaluate("""() => { Object.defineProperty(document, 'hidden', {value: true, configurable: true});
        document.dispatchEvent(new Event('visibilitychange')); }""")
    wait_until(lambda: has_opened(bare), 5.0)
    page.evaluate("() => delete document.hidden")
    page.mouse.up()
    grip(bare, page)
    for renderer in renderers_of(os.getpid()):
        with contextlib.suppress(ProcessLookupError):
            os.kill(renderer, signal.SIGKILL)
    wait_until(lambda: has_opened(bare), 5.0)


def test_a_page_that_is_killed_while_it_holds_couples_nothing(browser: "Browser", runs: Tried) -> None:
    page = opened(browser, runs)
    box = page.locator("#engage").bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + 10, box["y"] + 10)
    page.mouse.down()
    page.wait_for_timeout(500)
    for renderer in renderers_of(os.getpid()):
        with contextlib.suppress(ProcessLookupError):
            os.kill(renderer, signal.SIGKILL)
    time.sleep(1.2)
    assert runs.states() == {"disengaged"}


def test_keys_and_a_gamepad_move_the_hand_and_press_nothing(browser: "Browser", runs: Tried) -> None:
    page = opened(browser, runs)
    page.keyboard.down("ArrowLeft")
    for _ in range(5):
        # A browser that is held up opens the hand, which then needs another press.
        page.keyboard.down("g")
        page.wait_for_timeout(2e3)
        page.keyboard.up("g")
    assert all(at < -0.03 for at in runs.positions().values())
    page.keyboard.up("ArrowLeft")
    # A stick to the right, and its first button pressed once a second.
    page.evaluate("""() => { navigator.getGamepads = () =>
        [{ axes: [0.5, 0], buttons: [{ pressed: performance.now() % 1000 > 60 }] }]; }""")
    wait_until(lambda: all(at > 0.03 for at in runs.positions().values()))
    page.wait_for_timeout(1500)
    page.evaluate("() => { navigator.getGamepads = () => []; }")
    wait_until(lambda: not page.evaluate("() => hand.by"))
    assert runs.states() == {"disengaged"}
    # Events of a script are no acts of a person.
    page.evaluate("""() => { for (const name of ['pointerdown', 'pointermove'])
        document.getElementById('pad').dispatchEvent(new PointerEvent(name, {bubbles: true, button: 0, pointerId: 1}));
        document.dispatchEvent(new KeyboardEvent('keydown', {key: 'g'})); }""")
    assert page.evaluate("() => hand.by") is None
    page.context.close()


def test_a_late_grip_stays_open_and_a_late_push_is_dropped(browser: "Browser", runs: Tried) -> None:
    page = opened(browser, runs)
    for _ in range(TRIES):
        # A browser that is held up opens the hand before.
        press_in(page, 0.02, 0.0, 0.3)
        if page.evaluate("() => hand.by === 'pointer' && !hand.mustOpen"):
            break
        page.mouse.up()
    late = "hand.isWaiting = false; hand.answered = performance.now() - 300; tickHand(); return hand.by;"
    assert page.evaluate(f"() => {{ {late} }}") is None
    page.wait_for_timeout(500)
    assert page.evaluate("() => hand.by") is None
    page.mouse.up()
    assert page.evaluate("() => { pushArms(); hand.push.pressed -= 300; tickHand(); return hand.push; }") is None
    said(page, "nothing is pushed")
    # A push waits for no other connection.
    page.evaluate("() => { hand.socket.close(); pushArms(); }")
    page.wait_for_function("() => !hand.push")
    # STOP precedes all that may fail on the page.
    page.evaluate("() => { operator.stopped = () => { throw new Error('a fault of the page'); }; }")
    page.keyboard.press("Escape")
    wait_until(lambda: all(feed.summary().get("has_ended") for feed in runs.trial.feeds))
    page.context.close()
