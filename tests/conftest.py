"""Hypothesis profiles: `fast` for every run, `slow` for a long search.

HAPTETHER_HYPOTHESIS_PROFILE chooses. `fast` tries the same examples each time, so that it judges the change and not the
luck of a draw. `slow` draws new ones.

`make test` runs modules with the marker `live` five at a time, because they mostly wait. It runs modules with `alone`
one after the other, and all others two at a time. It leaves out `thorough` tests, which `make thorough` also runs: slow
tests whose subject other tests cover. Of a test with `sampled(n)`, all but n cases are `thorough`.
"""

import os
import re
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("fast", max_examples=50, deadline=None, derandomize=True)
settings.register_profile("slow", max_examples=2000, deadline=None)
settings.load_profile(os.environ.get("HAPTETHER_HYPOTHESIS_PROFILE", "fast"))

# Processes that tests start must not ignore signals, even if the tests run in the background or under nohup.
for number, handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, handler)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark all but n evenly spaced cases of a test with `sampled(n)` as `thorough`."""
    cases: dict[str, list[pytest.Item]] = {}
    for item in items:
        if item.get_closest_marker("sampled"):
            cases.setdefault(item.nodeid.partition("[")[0], []).append(item)
    for of_one in cases.values():
        (kept,) = of_one[0].iter_markers("sampled")
        wanted, count = kept.args[0], len(of_one)
        for at, item in enumerate(of_one):
            if wanted < count and (at + 1) * wanted // count == at * wanted // count:
                item.add_marker(pytest.mark.thorough)


@pytest.fixture(autouse=True)
def own_controllers() -> Iterator[None]:
    """Forget the controllers that a test has registered: later tests name some that must not exist."""
    module = "haptether.bridge.scene.research"
    before = dict(sys.modules[module]._REGISTERED) if module in sys.modules else {}
    yield
    if module in sys.modules and before != sys.modules[module]._REGISTERED:
        sys.modules[module]._REGISTERED.clear()
        sys.modules[module]._REGISTERED.update(before)


@pytest.fixture(autouse=True)
def ordinary_scheduling() -> Iterator[None]:
    """Fail a test that leaves real time to its thread: all later tests would starve others."""
    before = _scheduling()
    yield
    left = _scheduling()
    if "haptether.bridge.devices.loop" in sys.modules:
        from tests.left_runs import end_left_runs  # most tests have no driver

        end_left_runs()
    if left != before:
        policy, parameter = before
        os.sched_setscheduler(0, policy, os.sched_param(parameter))
        pytest.fail(f"the thread of the tests was left under scheduling policy and priority {left}, not {before}")


def _scheduling() -> tuple[int, int]:
    if not hasattr(os, "sched_getscheduler"):
        return 0, 0
    return os.sched_getscheduler(0), os.sched_getparam(0).sched_priority


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Skip modules without the wanted marker, so that several processes do not load them all for nothing."""
    if collection_path.suffix != ".py":
        return None
    text = collection_path.read_text("utf-8")
    if wanted := re.match(r"(live|alone)\b", config.option.markexpr):
        return f"mark.{wanted[1]}" not in text or None
    if config.option.markexpr.startswith("not live and not alone"):
        return re.search(r"^pytestmark = pytest\.mark\.(live|alone)$", text, re.MULTILINE) is not None or None
    return None
