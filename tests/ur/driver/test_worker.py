"""Calls that never return."""

import threading
import time
from collections.abc import Callable, Iterator
from functools import partial

import pytest

from haptether.slave.ur.worker import CallTimeoutError, TimedWorker

LONG_S = 20.0


@pytest.fixture
def gate() -> Iterator[threading.Event]:
    event = threading.Event()
    yield event
    event.set()


def until(holds: Callable[[], bool]) -> bool:
    end_s = time.monotonic() + LONG_S
    while not holds():
        if time.monotonic() > end_s:
            return False
        time.sleep(0.001)
    return True


def test_a_call_gives_what_it_gave_or_raised() -> None:
    worker = TimedWorker("worker")
    assert worker.run("one", lambda: 1, LONG_S) == 1
    with pytest.raises(ZeroDivisionError):
        worker.run("divide", lambda: 1 / 0, LONG_S)
    assert worker.run("two", lambda: 2, LONG_S) == 2
    worker.end()


def test_a_call_that_does_not_return_is_never_waited_for_again(gate: threading.Event) -> None:
    worker = TimedWorker("worker")
    begun_s = time.monotonic()
    with pytest.raises(CallTimeoutError, match=r"stopScript: has not returned within 0.05 s"):
        worker.run("stopScript", lambda: gate.wait(LONG_S), 0.05)
    assert worker.stuck is not None
    # Neither of these calls waits for the hanging one.
    later = worker.start("later", lambda: 1, LONG_S)
    assert later.done
    assert later.failure == "later: worker: does not answer"
    worker.stream("newest", lambda: True, LONG_S)
    with pytest.raises(CallTimeoutError):
        worker.run("again", lambda: 1, LONG_S)
    worker.end()
    assert time.monotonic() - begun_s < LONG_S / 2
    # A call that returns late changes nothing.
    gate.set()
    assert worker.stuck is not None


def test_a_streamed_call_that_blocks_is_seen_without_waiting_for_it(gate: threading.Event) -> None:
    worker = TimedWorker("worker")
    worker.stream("servoJ", lambda: gate.wait(LONG_S), 0.02)
    assert until(lambda: worker.stuck is not None)
    assert worker.stuck is not None
    assert worker.stuck.name == "servoJ"
    worker.end()


def test_of_what_is_streamed_only_the_newest_counts(gate: threading.Event) -> None:
    worker = TimedWorker("worker")
    seen: list[int] = []
    worker.start("first", lambda: gate.wait(LONG_S), LONG_S)

    def order(number: int) -> bool:
        seen.append(number)
        return False

    for number in range(5):
        worker.stream("order", partial(order, number), LONG_S)
    gate.set()
    assert until(lambda: worker.streamed is not None)
    assert seen == [4]
    assert worker.streamed is not None
    assert worker.streamed.failure == "order was refused"
    worker.end()


def test_a_command_that_is_queued_takes_the_place_of_what_was_streamed(gate: threading.Event) -> None:
    worker = TimedWorker("worker")
    seen: list[str] = []
    worker.start("first", lambda: gate.wait(LONG_S), LONG_S)
    worker.stream("move", lambda: seen.append("move"), LONG_S)
    stop = worker.start("stop", lambda: seen.append("stop"), LONG_S)
    gate.set()
    assert stop.wait(LONG_S)
    # A motion after the stop would be the old one.
    assert worker.run("last", lambda: list(seen), LONG_S) == ["stop"]
    worker.end()
