"""Hypothesis profiles: `fast` for every run, `slow` for a search that takes its time.

HAPTETHER_HYPOTHESIS_PROFILE chooses. `fast` tries the same examples each time, so that a change is
judged and not the luck of a draw; `slow` draws new ones.

Modules of the list ALONE have the marker `alone`: `make test` runs them one after the other, and all others on two
processors at once.
"""

import os

import pytest
from hypothesis import settings

settings.register_profile("fast", max_examples=50, deadline=None, derandomize=True)
settings.register_profile("slow", max_examples=2000, deadline=None)
settings.load_profile(os.environ.get("HAPTETHER_HYPOTHESIS_PROFILE", "fast"))

ALONE = (
    "test_device_loop", "test_docs", "test_engine_stress", "test_examples", "test_faults", "test_live",
    "test_live_realtime", "test_netsim_cli_live", "test_netsim_control", "test_netsim_live", "test_packaging",
    "test_safety_speed", "test_soak", "test_stop", "test_true_cause", "test_ur_demo", "test_ur_emulator_bounds",
    "test_ur_emulator_calls", "test_ur_emulator_letter", "test_ur_emulator_live", "test_ur_emulator_process",
    "test_ur_engagements", "test_ur_live", "test_work_unit",
)  # fmt: skip
"""Real time, real sockets, or cargo."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.path.stem in ALONE:
            item.add_marker(pytest.mark.alone)
