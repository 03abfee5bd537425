"""Hypothesis profiles: `fast` for every run, `slow` for a search that takes its time.

HAPTETHER_HYPOTHESIS_PROFILE chooses. `fast` tries the same examples each time, so that a change is
judged and not the luck of a draw; `slow` draws new ones.

`make test` runs the modules of the list LIVE (marker `live`) three at a time, those of ALONE (`alone`) one after the
other, and all others two at a time.
"""

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("fast", max_examples=50, deadline=None, derandomize=True)
settings.register_profile("slow", max_examples=2000, deadline=None)
settings.load_profile(os.environ.get("HAPTETHER_HYPOTHESIS_PROFILE", "fast"))

# Whoever runs the tests in the background, or under nohup, must not have what they start ignore its signals.
for number, handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, handler)

TESTS = Path(__file__).parent
LIVE = (
    "packaging/test_docs", "packaging/test_examples", "faults/test_faults", "live/test_live",
    "test_netsim_cli_live", "test_netsim_control",
    "live/test_presses_in_vain", "soak/test_soak", "live/test_stop", "test_ur_demo",
   
)  # fmt: skip
"""Processes and sockets that mostly wait: several at once."""
ALONE = (
    "live/test_device_loop", "models/test_stress", "live/test_realtime", "test_netsim_live", "packaging/test_packaging",
    "safety/test_speed", "live/test_true_cause",
    "test_ur_engagements", "test_ur_live", "models/test_work_unit",
)  # fmt: skip
"""Lateness, speed, busy processors, or cargo."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        for marker, modules in (("live", LIVE), ("alone", ALONE)):
            if item.path.relative_to(TESTS).with_suffix("").as_posix() in modules:
                item.add_marker(marker)


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
