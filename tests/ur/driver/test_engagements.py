"""Late frames after an engagement: how they are counted, and their absence at a UR arm's first engagements."""

import importlib.util
import threading

import numpy as np
import pytest
from tests.ur.engagements import WINDOW_S, busy, engagements, measured

from haptether.bridge import ladder_state_name

pytestmark = pytest.mark.alone

CODES = {ladder_state_name(code): code for code in range(7)}


def ticks(*states: tuple[str, float], late_s: float = 0.0) -> dict[str, np.ndarray]:
    """Return a trace of 1 kHz with each state for its time in s."""
    names = [name for name, seconds in states for _ in range(round(1e3 * seconds))]
    overshoot_s = np.zeros(len(names))
    overshoot_s[len(names) // 2] = late_s
    return {"time_s": 1e-3 * np.arange(len(names)), "state": np.array([CODES[n] for n in names]),
            "overshoot_s": overshoot_s}  # fmt: skip


@pytest.mark.parametrize(
    ("states", "late"),
    [
        ([("aligning", 0.01), ("engaged", 1.0)], [[]]),
        ([("aligning", 0.01), ("engaged", 0.012), ("stale", 0.002), ("engaged", 1.0)], [[["stale", 12.0]]]),
        # It holds in the end: one engagement, both states.
        ([("aligning", 0.01), ("engaged", 0.02), ("stale", 0.015), ("hold", 0.5)], [[["stale", 20.0], ["hold", 35.0]]]),
        # Frames after the window do not belong to an engagement.
        ([("aligning", 0.01), ("engaged", WINDOW_S + 0.05), ("stale", 0.01), ("engaged", 0.5)], [[]]),
        # Releasing the clutch ends it: two engagements.
        ([("aligning", 0.01), ("engaged", 0.1), ("disengaged", 0.1), ("aligning", 0.01), ("engaged", 0.5)], [[], []]),
        ([("disengaged", 1.0)], []),
    ],
)
def test_late_frames_are_those_soon_after_an_engagement(
    states: list[tuple[str, float]], late: list[list[list[object]]]
) -> None:
    found = engagements(ticks(*states))
    assert [one["late"] for one in found] == [[[name, pytest.approx(at)] for name, at in of] for of in late]


def test_a_wake_that_is_late_shows() -> None:
    (found,) = engagements(ticks(("aligning", 0.1), ("engaged", 0.3), late_s=0.004))
    assert found["overshoot_ms"] == pytest.approx(4.0)


def test_busy_processes_end_with_the_run() -> None:
    before = threading.active_count()
    with busy(1):
        pass
    assert threading.active_count() == before


@pytest.mark.timeout(240)
@pytest.mark.skipif(importlib.util.find_spec("rtde_control") is None, reason="the extra ur is not installed")
def test_the_first_engagements_of_an_arm_make_no_frame_late() -> None:
    rows: list[str] = []
    result = measured(2, 2, 0, 3, rows.append)
    assert result["good"], rows
    assert len(rows) == result["starts"] == 1
