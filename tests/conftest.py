"""Hypothesis profiles: `fast` for every run, `slow` for a search that takes its time.

HAPTETHER_HYPOTHESIS_PROFILE chooses. `fast` tries the same examples each time, so that a change is
judged and not the luck of a draw; `slow` draws new ones.

`make test` runs modules with the marker `live` three at a time, those with `alone` one after the other, and all others
two at a time.
"""

import os
import signal
from collections.abc import Iterator

import pytest
from hypothesis import settings

settings.register_profile("fast", max_examples=50, deadline=None, derandomize=True)
settings.register_profile("slow", max_examples=2000, deadline=None)
settings.load_profile(os.environ.get("HAPTETHER_HYPOTHESIS_PROFILE", "fast"))

# Whoever runs the tests in the background, or under nohup, must not have what they start ignore its signals.
for number, handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, handler)


@pytest.fixture(autouse=True)
def ordinary_scheduling() -> Iterator[None]:
    """Real time that a test leaves to its thread is a fault of what it tests: all later ones would starve others."""
    before = _scheduling()
    yield
    if (left := _scheduling()) != before:
        policy, parameter = before
        os.sched_setscheduler(0, policy, os.sched_param(parameter))
        pytest.fail(f"the thread of the tests was left under scheduling policy and priority {left}, not {before}")


def _scheduling() -> tuple[int, int]:
    if not hasattr(os, "sched_getscheduler"):
        return 0, 0
    return os.sched_getscheduler(0), os.sched_getparam(0).sched_priority
