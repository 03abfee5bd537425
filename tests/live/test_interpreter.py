"""Python's interpreter beside a loop: objects made while a device opened, and the priority of threads."""

import gc
import os
import threading
from collections.abc import Iterator
from typing import Any

import pytest

from haptether.bridge.devices.open import DeviceNotes, opened
from haptether.bridge.interpreter import HOLDER_PRIORITY, TUNING

YOUNG = 100_000


class Heavy:
    """A device that makes many objects while it opens, like an import of CasADi."""

    paces = False

    def __init__(self) -> None:
        self.kept: list[list[int]] = []

    def open(self) -> None:
        self.kept = [[n] for n in range(YOUNG)]

    def close(self) -> None:
        self.kept = []


@pytest.fixture
def quiet() -> Iterator[None]:
    TUNING.begin()
    try:
        yield
    finally:
        TUNING.end()


def test_objects_made_while_opening_are_not_collected_in_the_loop(quiet: None) -> None:  # noqa: ARG001
    device: Any = Heavy()
    with opened(device, DeviceNotes(), "period_s", None):
        # These objects are visited by the first `poll` of a run while the loop waits for the interpreter.
        assert len(gc.get_objects(generation=0)) < YOUNG / 100


def test_without_a_loop_the_collector_is_left_alone() -> None:
    frozen = gc.get_freeze_count()
    with opened(Heavy(), DeviceNotes(), "period_s", None):  # type: ignore[arg-type]  # as much of a device as it takes
        assert gc.get_freeze_count() == frozen


def in_realtime(call: Any) -> bool:  # noqa: ANN401  # a function
    """Call a function on a thread with SCHED_FIFO, if granted; return true if it was."""
    granted: list[bool] = []

    def run() -> None:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(2))
        except OSError:
            return
        granted.append(True)
        call()

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    return bool(granted)


def test_interpreter_holder_precedes_ordinary_processes(quiet: None) -> None:  # noqa: ARG001
    before = os.sched_getscheduler(0)
    seen: list[tuple[int, int]] = []
    me = threading.get_native_id()

    def raised() -> None:
        TUNING.prioritise()
        seen.append((os.sched_getscheduler(me), os.sched_getparam(me).sched_priority))

    TUNING.begin()
    try:
        if not in_realtime(raised):
            pytest.skip("this system grants no SCHED_FIFO")
        assert seen == [(os.SCHED_FIFO, HOLDER_PRIORITY)]
        # One of two loops ends: the other still needs the priority.
        TUNING.end()
        assert os.sched_getscheduler(0) == os.SCHED_FIFO
        TUNING.end()
        assert os.sched_getscheduler(0) == before
    finally:
        while TUNING.loops < 1:
            TUNING.begin()


def test_a_loop_without_real_time_raises_nobody(quiet: None) -> None:  # noqa: ARG001
    before = os.sched_getscheduler(0)
    TUNING.prioritise()
    assert os.sched_getscheduler(0) == before
