"""Wrong packages of a UR controller, up to three in a row: none begins, moves or stops the arm."""

import math
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.ur.fake_rtde import START_POSE, START_Q, Arm, install

from haptether.slave import UrSlave
from haptether.slave.ur.checks import UrRefusedError, check_after
from haptether.slave.ur.connection import RtdeConnection
from haptether.slave.ur.plausible import MAX_CHANGE, MAX_WRONG, PAUSE_S, PlausibleStates
from haptether.slave.ur.state import Numbers, UrState
from haptether.slave.ur.stop import Phase

PERIOD_S = 0.002
LONG_S = 20.0
TICKS = 12
MODES = ("servoj", "servol", "speedl", "direct-torque")
HOME = START_POSE[:3]
REST = (0.0, 0.0, 0.0)
ORDERS = {"servoJ": START_Q, "servoL": START_POSE, "speedL": (0.0,) * 6, "directTorque": (0.0,) * 6}
"""Order of each mode that keeps the arm where it is."""
TOLERANCE = 1e-6

Wrong = Callable[[UrState, float], UrState]


def changed(numbers: Numbers, place: int, by: float) -> Numbers:
    return (*numbers[:place], numbers[place] + by, *numbers[place + 1 :])


def wrong_q(state: UrState, by: float) -> UrState:
    return state._replace(q=changed(state.q, 1, by))


def wrong_rotation(state: UrState, by: float) -> UrState:
    return state._replace(pose=changed(state.pose, 3, by))


def wrong_qd(state: UrState, by: float) -> UrState:
    return state._replace(qd=changed(state.qd, 1, by))


def wrong_q_and_pose(state: UrState, by: float) -> UrState:
    return state._replace(q=changed(state.q, 2, by), pose=changed(state.pose, 0, 0.3 * by))


def wrong_speed(state: UrState, by: float) -> UrState:
    return state._replace(speed=changed(state.speed, 1, by))


CASES: tuple[tuple[Wrong, tuple[float, ...]], ...] = (
    (wrong_q, (0.01, 0.17, -0.4)), (wrong_rotation, (0.02, -0.4, 2.0)), (wrong_qd, (1.5, -9.0)),
    (wrong_q_and_pose, (0.02, 0.4)), (wrong_speed, (1.5,)),
)  # fmt: skip


@pytest.fixture
def arm(monkeypatch: pytest.MonkeyPatch) -> Iterator[Arm]:
    arm = Arm(version=(5, 26, 0, 0), watchdog_bites=False)
    install(monkeypatch, arm)
    yield arm
    arm.released.set()


class Driven:
    """An open driver whose packages can be made wrong; each has the next time, however long a machine stalls."""

    def __init__(self, arm: Arm, **options: Any) -> None:  # noqa: ANN401
        self.arm = arm
        self.driver = UrSlave(host="fake", axes=3, verify_watchdog=False, watchdog_hz=5.0, **options)
        self.driver.open()
        connection: Any = self.driver._connection
        self._receive, self._timestamp = connection.state, self.driver._state.timestamp
        connection.state = self._state
        self._wrong: tuple[Wrong, float] | None = None
        self._left = 0
        self._tolerance_m = TOLERANCE
        self.until(lambda: self.driver._watchdog.armed)

    def _state(self) -> UrState:
        self._timestamp += PERIOD_S
        state: UrState = self._receive()._replace(timestamp=self._timestamp)
        if self._wrong is None or self._left == 0:
            return state
        self._left -= 1
        change, by = self._wrong
        return change(state, by)

    def wrong(self, change: Wrong, by: float, count: int) -> None:
        """Make the next packages wrong."""
        self._wrong, self._left = (change, by), count

    def step(self, *, moving: bool = False) -> None:
        sample = self.driver.read()
        assert sample.fault is None
        assert sample.position == pytest.approx(HOME, abs=self._tolerance_m)
        if moving:
            self.driver.write(HOME, REST)

    def until(self, holds: Callable[[], bool], *, moving: bool = False) -> None:
        end_s = time.monotonic() + LONG_S
        while not holds():
            assert time.monotonic() < end_s, self.arm.names[-20:]
            self.step(moving=moving)

    def phase(self, phase: Phase, *, moving: bool = False) -> None:
        self.until(lambda: self.driver._soft_stop.phase is phase, moving=moving)

    def rests(self) -> None:
        self.driver.stop()
        self.phase(Phase.AT_REST)

    def pauses(self) -> None:
        """Make the side stall in the middle of a motion."""
        self.phase(Phase.MOVING, moving=True)
        time.sleep(2.5 * PAUSE_S)
        self._timestamp += 2.5 * PAUSE_S
        # For the first package afterwards.
        self._tolerance_m = MAX_CHANGE * PAUSE_S
        if self.driver._motion is not None and self.driver._motion.mode.goes_on:
            self.phase(Phase.PAUSED)

    def moves(self) -> None:
        self.phase(Phase.MOVING, moving=True)
        for _ in range(MAX_WRONG + 1):
            self.step(moving=True)

    def largest_error(self) -> float:
        """Return the largest deviation of the orders from those that keep the arm where it is."""
        orders = [(call[1], ORDERS[call[0]]) for call in self.arm.said if call[0] in ORDERS]
        assert orders
        return max(float(np.abs(np.subtract(order, rest)).max()) for order, rest in orders)


@pytest.mark.slow
@pytest.mark.parametrize("when", ["rests", "pauses", "moves"])
@pytest.mark.parametrize("mode", MODES)
def test_wrong_packages_move_no_arm(arm: Arm, mode: str, when: str) -> None:
    driven = Driven(arm, mode=mode)
    errors = {}
    for change, sizes in CASES:
        for by in sizes:
            for count in (1, MAX_WRONG):
                getattr(driven, when)()
                arm.said.clear()
                driven.wrong(change, by, count)
                for _ in range(TICKS):
                    driven.step(moving=True)
                driven.phase(Phase.MOVING, moving=True)
                driven.until(lambda: any(name in ORDERS for name in arm.names), moving=True)
                if (error := driven.largest_error()) > TOLERANCE:
                    errors[change.__name__, by, count] = error
    assert errors == {}
    driven.driver.close()


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, MAX_WRONG])
@pytest.mark.parametrize("mode", MODES)
def test_wrong_packages_at_the_start_move_no_arm(
    arm: Arm, monkeypatch: pytest.MonkeyPatch, mode: str, count: int
) -> None:
    """The first packages that the driver keeps have a wrong joint, orientation and force."""
    receive, seen = RtdeConnection.state, list[float]()

    def state(connection: RtdeConnection) -> UrState:
        state = receive(connection)
        if seen and state.timestamp not in seen:
            seen.append(state.timestamp)
        if not 1 < len(seen) <= 1 + count:
            return state
        return wrong_rotation(wrong_q(state, 0.17), 0.4)._replace(wrench=(40.0, 0.0, 0.0, 0.0, 0.0, 4.0))

    def checked(*arguments: Any, **named: Any) -> UrState:  # noqa: ANN401
        state = check_after(*arguments, **named)
        seen.append(state.timestamp)
        return state

    monkeypatch.setattr(RtdeConnection, "state", state)
    monkeypatch.setattr("haptether.slave.ur.driver.check_after", checked)
    driven = Driven(arm, mode=mode, force_source="raw")
    assert len(seen) > count + 1
    driven.moves()
    driven.until(lambda: any(name in ORDERS for name in arm.names), moving=True)
    assert driven.largest_error() < TOLERANCE
    assert driven.driver.read().force == (0.0, 0.0, 0.0)
    driven.driver.close()


@pytest.mark.slow
def test_a_change_that_stays_is_accepted_and_the_first_command_is_away_from_it(arm: Arm) -> None:
    driven = Driven(arm, mode="servol")
    driven.wrong(wrong_q_and_pose, 0.4, 1000)
    for _ in range(MAX_WRONG):
        driven.step(moving=True)
    sample = driven.driver.read()
    assert sample.fault is None
    assert sample.position == pytest.approx((HOME[0] + 0.12, *HOME[1:]), abs=TOLERANCE)
    for _ in range(MAX_WRONG + 1):
        driven.driver.write(HOME, REST)
        sample = driven.driver.read()
    assert "commanded to begin 120.0 mm away from where the tool is" in str(sample.fault)
    assert "servoL" not in arm.names
    driven.driver.close()


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
def test_a_change_that_stays_is_an_arm_that_does_not_follow(
    arm: Arm, monkeypatch: pytest.MonkeyPatch, mode: str
) -> None:
    # A machine that stalls must not pause the motion.
    monkeypatch.setattr("haptether.slave.ur.stop.SILENCE_S", LONG_S)
    driven = Driven(arm, mode=mode)
    driven.moves()
    driven.wrong(wrong_q_and_pose, 4.0, MAX_WRONG + 1)
    for _ in range(MAX_WRONG):
        driven.step(moving=True)
    driven.driver.read()
    driven.driver.write(HOME, REST)
    assert "the arm does not follow: 1200 mm behind its command" in str(driven.driver.read().fault)
    assert driven.largest_error() < TOLERANCE
    driven.driver.close()


@pytest.mark.slow
def test_packages_that_never_follow_from_each_other_are_refused(arm: Arm, monkeypatch: pytest.MonkeyPatch) -> None:
    receive, sign = RtdeConnection.state, [0.1]

    def state(connection: RtdeConnection) -> UrState:
        sign[0] = -sign[0]
        return wrong_q(receive(connection), sign[0])

    monkeypatch.setattr(RtdeConnection, "state", state)
    with pytest.raises(UrRefusedError, match="9 packages that follow from each other: not within 2 s"):
        Driven(arm, mode="servol")


@pytest.mark.slow
def test_a_motion_that_waits_for_packages_too_long_is_a_fault(arm: Arm) -> None:
    """Every second package is wrong."""
    driven = Driven(arm, mode="servol")
    end_s, fault = time.monotonic() + LONG_S, None
    while fault is None:
        assert time.monotonic() < end_s
        driven.wrong(wrong_q, 0.1, 1)
        driven.step(moving=True)
        fault = driven.driver.read().fault
        driven.driver.write(HOME, REST)
    assert "the controller's packages do not follow from each other" in fault
    assert "servoL" not in arm.names
    driven.driver.close()


# ------------------------------------------------------------------------------------------------------- the rule


def moving(time_s: float) -> UrState:
    """Return a package of a constant motion that turns past half a turn."""
    qd, speed = (0.5, -1.0, 2.0, 0.0, 0.3, -3.0), (0.2, -0.1, 0.05, 2.0, 0.0, 0.0)
    q = tuple(a + b * time_s for a, b in zip(START_Q, qd, strict=True))
    x, y, z = (a + b * time_s for a, b in zip(START_POSE[:3], speed[:3], strict=True))
    rotvec = (Rotation.from_rotvec(np.array(speed[3:]) * time_s) * Rotation.from_rotvec((3.1, 0.0, 0.0))).as_rotvec()
    return UrState(10.0 + time_s, q, q, qd, (x, y, z, *rotvec), speed, (1.0,) * 6, 7, 1, 1, 2, 1.0)


def distance(state: UrState, other: UrState) -> float:
    turned = (Rotation.from_rotvec(state.pose[3:]) * Rotation.from_rotvec(other.pose[3:]).inv()).magnitude()
    return max(math.dist(state.q, other.q), math.dist(state.pose[:3], other.pose[:3]), float(turned))


@pytest.mark.parametrize("count", [1, 2, MAX_WRONG])
@pytest.mark.parametrize(("change", "sizes"), CASES)
def test_the_prediction_replaces_wrong_packages_in_motion(change: Wrong, sizes: tuple[float, ...], count: int) -> None:
    for by in sizes:
        states = PlausibleStates(PERIOD_S)
        for tick in range(60):
            true = moving(tick * PERIOD_S)
            is_wrong = 20 <= tick < 20 + count
            taken = states.take(change(true, by) if is_wrong else true)
            assert distance(taken, true) < 1e-9, (by, tick)
            assert (taken.qd, taken.speed) == (true.qd, true.speed)
            assert taken.timestamp == true.timestamp
            assert states.confirmed == (tick >= MAX_WRONG if tick < 20 else tick >= 20 + count + MAX_WRONG), (by, tick)
        assert states.replaced == count


def test_the_status_of_a_wrong_package_counts() -> None:
    states = PlausibleStates(PERIOD_S)
    states.take(moving(0.0))
    stopped = wrong_q(moving(PERIOD_S), 0.4)._replace(safety_bits=4, runtime_state=1)
    assert states.take(stopped)[-5:] == stopped[-5:]


def test_a_blow_is_accepted_with_the_fourth_package() -> None:
    states = PlausibleStates(PERIOD_S)
    states.take(moving(0.0))
    still = moving(0.0)._replace(qd=(0.0,) * 6, speed=(0.0,) * 6)
    for tick in range(1, MAX_WRONG + 1):
        assert states.take(still._replace(timestamp=10.0 + tick * PERIOD_S)).qd != still.qd
    assert states.take(still._replace(timestamp=10.0 + (MAX_WRONG + 1) * PERIOD_S)).qd == still.qd
    assert states.confirmed


def test_an_acceleration_within_the_bound_passes() -> None:
    """A joint that accelerates by 0.9 `MAX_CHANGE` a period is never replaced."""
    states, q, qd = PlausibleStates(PERIOD_S), 0.0, 0.0
    for tick in range(1000):
        state = moving(0.0)._replace(timestamp=tick * PERIOD_S, q=(q,) * 6, qd=(qd,) * 6, speed=(0.0,) * 6)
        assert states.take(state) is state
        change = 0.9 * MAX_CHANGE * math.sin(0.5 * tick)
        q, qd = q + (qd + 0.5 * change) * PERIOD_S, qd + change


@pytest.mark.parametrize("gap_s", [1.01 * PAUSE_S, 5.0])
def test_after_a_pause_packages_must_confirm_again(gap_s: float) -> None:
    states = PlausibleStates(PERIOD_S)
    for tick in range(10):
        states.take(moving(tick * PERIOD_S))
    for tick in range(MAX_WRONG + 1):
        assert states.confirmed == (tick == 0)
        states.take(moving(9 * PERIOD_S + gap_s + tick * PERIOD_S))
    assert states.confirmed
