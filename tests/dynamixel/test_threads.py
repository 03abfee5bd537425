"""Several threads and one bus: calls in sequence, and a stop at any time."""

import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
from tests.dynamixel.emulated import BAUD, EmulatedBus, emulated_bus
from tests.dynamixel.test_arm import arm_of, opened, torques, until

from haptether.dynamixel import DynamixelBus, SyncRead
from haptether.dynamixel.arm import ArmRefusedError, FaultKind, ServoArm, ServoSettings

pytestmark = pytest.mark.live

IDS = (1, 2)
TORQUE_ENABLE, PRESENT_POSITION = 64, 132
LONG_S = 2.0
"""Timeout in s of a call that nobody answers."""
SOON_S = 1.0
"""Time in s in which a stop has to end the torque while such a call waits."""
PATIENCE_S = 20.0


@pytest.fixture(scope="module")
def shared() -> Iterator[EmulatedBus]:
    with emulated_bus("--servos", "1=XM430-W350", "2=XM430-W350", "--start", "0.3", "0.5") as running:
        yield running


class Call:
    """A call on another thread."""

    def __init__(self, run: Callable[[], object]) -> None:
        self.error: BaseException | None = None
        self._run = run
        self._thread = threading.Thread(target=self._do, daemon=True)
        self._thread.start()

    def _do(self) -> None:
        try:
            self._run()
        except BaseException as error:
            self.error = error

    @property
    def is_running(self) -> bool:
        return self._thread.is_alive()

    def end(self) -> None:
        self._thread.join(PATIENCE_S)
        assert not self.is_running


@contextmanager
def soon() -> Iterator[None]:
    begin = time.monotonic()
    yield
    assert time.monotonic() - begin < SOON_S


def instructions(emulated: EmulatedBus) -> int:
    return int(emulated.status()["instructions"])


# ------------------------------------------------------------------------------------------------------------- bus


def test_a_stop_goes_out_while_another_thread_waits_for_an_answer(emulated: EmulatedBus) -> None:
    bus = DynamixelBus(emulated.port, baud=BAUD, timeout_s=LONG_S)
    read = SyncRead(PRESENT_POSITION, 4, list(IDS))
    calls: tuple[Callable[[], object], ...] = (
        lambda: bus.sync_read(read),
        lambda: bus.read(2, PRESENT_POSITION, 4),
    )
    for call in calls:
        # The first call waits for the line to fall silent.
        bus.write(1, TORQUE_ENABLE, b"\1")
        bus.write(2, TORQUE_ENABLE, b"\1")
        assert torques(emulated) == [True, True]
        emulated.do("silent 2 on")
        before = instructions(emulated)
        waiting = Call(call)
        until(lambda before=before: instructions(emulated) > before)  # type: ignore[misc]
        assert waiting.is_running
        with soon():
            bus.stop(TORQUE_ENABLE, 1, bytes(IDS), bytes(2))
            until(lambda: torques(emulated) == [False, False])
        waiting.end()
        assert isinstance(waiting.error, RuntimeError)
        assert "a stop cut this call off" in str(waiting.error)
        emulated.do("silent 2 off")
    bus.close()


def test_calls_of_several_threads_are_one_after_the_other(emulated: EmulatedBus) -> None:
    bus = DynamixelBus(emulated.port, baud=BAUD, timeout_s=0.5)
    shared = SyncRead(PRESENT_POSITION, 4, list(IDS))
    expected = bus.sync_read(shared)
    assert len(expected) == 8

    def cycle() -> None:
        own = SyncRead(PRESENT_POSITION, 4, list(IDS), fast=False)
        for _ in range(50):
            assert bus.sync_read(shared) == expected
            assert shared.alerts == ()
            assert bus.sync_read(own) == expected
            assert struct.pack("<HB", *bus.ping(1)) == struct.pack("<HB", 1020, 52)
            assert bus.read(2, PRESENT_POSITION, 4) == expected[4:]
            bus.sync_write(65, 1, bytes(IDS), bytes(2))
            assert bus.write(1, 65, b"\0") is False

    cycles = [Call(cycle) for _ in range(4)]
    for one in cycles:
        one.end()
        assert one.error is None
    bus.close()


def test_a_bus_is_closed_once_a_call_of_another_thread_is_over(emulated: EmulatedBus) -> None:
    bus = DynamixelBus(emulated.port, baud=BAUD, timeout_s=0.3)
    bus.ping(1)
    emulated.do("silent 2 on")
    before = instructions(emulated)
    waiting = Call(lambda: bus.ping(2))
    until(lambda: instructions(emulated) > before)
    bus.close()
    waiting.end()
    assert isinstance(waiting.error, TimeoutError)
    with pytest.raises(ValueError, match="is closed"):
        bus.stop(TORQUE_ENABLE, 1, bytes(IDS), bytes(2))


# ------------------------------------------------------------------------------------------------------------- arm

SERVOS = tuple(ServoSettings(servo_id=servo_id, model="XM430-W350") for servo_id in IDS)


def test_an_arm_is_stopped_while_another_thread_reads(emulated: EmulatedBus) -> None:
    """Neither the timeout of the read nor a watchdog ends the torque this soon."""
    with opened(emulated, servos=SERVOS, timeout_s=1.0, watchdog_s=2.54, lost_after_s=1.0) as arm:
        assert arm.read()
        emulated.do("silent 2 on")
        before = instructions(emulated)
        reading = Call(arm.read)
        until(lambda: instructions(emulated) > before)
        begin = time.monotonic()
        arm.stop(FaultKind.JUMP, "of a test")
        until(lambda: torques(emulated) == [False, False])
        # The read itself times out after 1 s.
        assert time.monotonic() - begin < 0.9
        reading.end()
        assert reading.error is None
        assert arm.fault_kind == FaultKind.JUMP
        assert str(arm.fault).endswith("of a test")
        assert emulated.servo(1)["bus_watchdog"] != -1
        emulated.do("silent 2 off")


def paused(arm: ServoArm, monkeypatch: pytest.MonkeyPatch) -> tuple[threading.Event, threading.Event]:
    """Pause `open` or recovery with torque on; return the events for arriving there and for continuing."""
    come, on = threading.Event(), threading.Event()
    real = arm._hold

    def hold() -> None:
        come.set()
        assert on.wait(PATIENCE_S)
        real()

    monkeypatch.setattr(arm, "_hold", hold)
    return come, on


def test_an_arm_that_is_stopped_while_it_opens_does_not_open(
    emulated: EmulatedBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    arm = arm_of(emulated.port, servos=SERVOS, watchdog_s=2.54)
    come, on = paused(arm, monkeypatch)
    opening = Call(arm.open)
    assert come.wait(PATIENCE_S)
    assert torques(emulated) == [True, True]
    with soon():
        arm.stop(FaultKind.JUMP, "of a test")
        until(lambda: torques(emulated) == [False, False])
    on.set()
    opening.end()
    assert isinstance(opening.error, ArmRefusedError)
    assert torques(emulated) == [False, False]
    arm.close()


def test_an_arm_that_is_stopped_while_it_recovers_stays_without_torque(
    emulated: EmulatedBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    with opened(emulated, servos=SERVOS, watchdog_s=2.54) as arm:
        arm.stop(FaultKind.JUMP, "of a test")
        come, on = paused(arm, monkeypatch)
        arm.acknowledge(arm.fault)
        assert come.wait(PATIENCE_S)
        assert torques(emulated) == [True, True]
        with soon():
            arm.stop(FaultKind.NOT_READY, "stopped anew")
            until(lambda: torques(emulated) == [False, False])
        on.set()
        until(lambda: not (arm.read() or arm.recovering))
        assert arm.fault_kind == FaultKind.NOT_READY
        assert torques(emulated) == [False, False]
        # An acknowledgement lets it recover.
        arm.acknowledge(arm.fault)
        until(lambda: arm.read() and arm.fault is None)
        assert torques(emulated) == [True, True]


def test_a_stop_between_a_recovery_and_the_next_read_is_a_fault(emulated: EmulatedBus) -> None:
    with opened(emulated, servos=SERVOS, watchdog_s=2.54) as arm:
        arm.stop(FaultKind.JUMP, "of a test")
        arm.acknowledge(arm.fault)
        assert arm._recovery is not None
        arm._recovery.join(PATIENCE_S)
        assert torques(emulated) == [True, True]
        arm.stop(FaultKind.NOT_READY, "stopped anew")
        until(lambda: torques(emulated) == [False, False])
        assert not arm.read()
        assert str(arm.fault).endswith("stopped anew")
        assert torques(emulated) == [False, False]


def test_torque_that_comes_after_a_stop_ends_at_once(emulated: EmulatedBus, monkeypatch: pytest.MonkeyPatch) -> None:
    """The stop comes between the last check of `open` and its write."""
    arm = arm_of(emulated.port, servos=SERVOS[:1], watchdog_s=2.54)
    said: list[str] = []
    go_on, looks = arm._go_on, [0]

    def looked() -> None:
        go_on()
        looks[0] += 1
        if arm._bus is not None and arm._bus.read(1, 98, 1) != b"\0" and not said:
            # The watchdog is armed: torque comes next.
            said.append("stopped")
            arm.stop(FaultKind.JUMP, "of a test")

    monkeypatch.setattr(arm, "_go_on", looked)
    monkeypatch.setattr(arm, "_hold", lambda: said.append("held"))
    with pytest.raises(ArmRefusedError, match="stopped before it was open"):
        arm.open()
    assert said == ["stopped"]
    assert torques(emulated)[0] is False
    arm.close()


def test_a_close_stops_first_and_waits_then(emulated: EmulatedBus, monkeypatch: pytest.MonkeyPatch) -> None:
    """`open` hangs with torque on, and does not return."""
    monkeypatch.setattr("haptether.dynamixel.arm.arm.CLOSED_S", 2.0)
    arm = arm_of(emulated.port, servos=SERVOS, watchdog_s=2.54)
    come, on = paused(arm, monkeypatch)
    opening = Call(arm.open)
    assert come.wait(PATIENCE_S)
    assert torques(emulated) == [True, True]
    closing = Call(arm.close)
    with soon():
        until(lambda: torques(emulated) == [False, False])
    assert closing.is_running
    closing.end()
    assert "may KEEP torque" in str(closing.error)
    on.set()
    opening.end()
    assert "closed before it was open" in str(opening.error)
    arm.close()
    assert torques(emulated) == [False, False]


def test_a_stop_that_could_not_be_sent_is_reported_once(emulated: EmulatedBus) -> None:
    said: list[str] = []
    arm = ServoArm(arm_of(emulated.port, servos=SERVOS).settings, report=said.append)
    arm.open()
    emulated.do("unplug")
    for _ in range(3):
        arm.stop(FaultKind.JUMP, "of a test")
    arm.close()
    (reported,) = [line for line in said if "the stop could not be sent" in line]
    assert "Input/output error" in reported
    assert "after 500 ms of silence" in reported


def test_a_close_ends_the_arm_for_the_thread_that_leads_it(emulated: EmulatedBus) -> None:
    """Otherwise the thread that leads the arm would go on to command it."""
    with opened(emulated, servos=SERVOS, watchdog_s=2.54, release_s=2.0) as arm:
        ends = threading.Event()
        ticks = [0, 0]

        def leads() -> None:
            while not ends.is_set():
                arm.read()
                arm.write_currents((0.3, 0.0))
                ticks[arm.fault is not None] += 1
                time.sleep(0.002)

        leading = Call(leads)
        until(lambda: ticks[0] > 20)
        with soon():
            arm.close()
        assert torques(emulated) == [False, False]
        closed = ticks[1]
        # The thread goes on, without effect.
        until(lambda: ticks[1] > closed + 20)
        assert torques(emulated) == [False, False]
        assert all(servo["current_a"] == 0.0 for servo in emulated.status()["servos"])
        assert "closed by another thread" in str(arm.fault)
        ends.set()
        leading.end()
        assert leading.error is None
        arm.open()
        assert arm.fault is None
        assert torques(emulated) == [True, True]


def test_a_thread_that_has_ended_leaves_an_arm_that_is_let_down(emulated: EmulatedBus) -> None:
    with opened(emulated, servos=SERVOS, watchdog_s=2.54, release_s=0.3) as arm:
        reading = Call(arm.read)
        reading.end()
        begin = time.monotonic()
        arm.close()
        assert time.monotonic() - begin > 0.3
        assert arm.fault is None


def test_an_acknowledgement_of_one_fault_is_none_of_a_stop_after_it(emulated: EmulatedBus) -> None:
    with opened(emulated, servos=SERVOS, watchdog_s=2.54) as arm:
        arm.stop(FaultKind.JUMP, "the first")
        shown = arm.fault
        arm.stop(FaultKind.NOT_FINITE, "the second")
        assert str(arm.fault).endswith("the second")
        arm.acknowledge(shown)
        assert not arm.recovering
        until(lambda: torques(emulated) == [False, False])
        arm.acknowledge(arm.fault)
        until(lambda: arm.read() and arm.fault is None)


def test_an_arm_that_was_closed_while_its_open_waited_does_not_open(emulated: EmulatedBus) -> None:
    arm = arm_of(emulated.port, servos=SERVOS)
    with arm._connecting:
        opening = Call(arm.open)
        time.sleep(0.1)
        arm.stop(FaultKind.JUMP, "of a test")
    opening.end()
    assert isinstance(opening.error, ArmRefusedError)
    assert torques(emulated) == [False, False]
    arm.close()


def test_what_does_not_let_go_is_said_whoever_closes(emulated: EmulatedBus, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("haptether.dynamixel.arm.arm.CLOSED_S", 0.2)
    said: list[str] = []
    arm = ServoArm(arm_of(emulated.port, servos=SERVOS, watchdog_s=2.54).settings, report=said.append)
    come, on = paused(arm, monkeypatch)
    opening = Call(arm.open)
    assert come.wait(PATIENCE_S)
    with pytest.raises(RuntimeError, match="may KEEP torque"):
        arm.close()
    assert any("may KEEP torque, cut their supply" in line for line in said)
    on.set()
    opening.end()
    arm.close()
