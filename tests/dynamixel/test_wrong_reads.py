"""Wrong reads of a servo arm in virtual time: what goals, compensation and faults make of them."""

import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from haptether.dynamixel.arm import ArmFaultError, ArmSettings, FaultKind, ServoArm, ServoSettings, write_calibration
from haptether.dynamixel.arm.plausible import FASTEST_SHARE, PAUSE_S, QUANTA_RAD
from haptether.master.dynamixel.driver import DynamixelMaster
from haptether.slave.dynamixel.driver import DynamixelSlave

TICK_S = 0.002


class Clock:
    """Virtual time in s."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Iterator[Clock]:
    now = Clock()
    with monkeypatch.context() as patched:
        patched.setattr(time, "monotonic", now)
        yield now


class Scripted(ServoArm):
    """Arm whose bus is replaced: each read returns `true + off` and the speeds `fast`."""

    def __init__(self, settings: ArmSettings) -> None:
        super().__init__(settings)
        count = len(self.position)
        self.true, self.off, self.fast = np.zeros(count), np.zeros(count), np.zeros(count)
        self.goals: list[np.ndarray] = []
        self.ends: list[ArmFaultError] = []

    def begin(self) -> None:
        self.plausible.restart(np.zeros(len(self.position)))
        self._watch_at_s = self._heard_s = np.inf
        self._ramp = 1.0

    def _measure(self) -> Any:  # noqa: ANN401
        self.position[:] = self.true + self.off
        self.velocity[:] = self.fast
        self.current[:] = 0.0
        return SimpleNamespace(alerts=())

    def _watch(self, now_s: float) -> None:
        """Ask nothing on the bus."""

    def _latch(self, fault: ArmFaultError) -> None:
        self._fault = fault
        self.ends.append(fault)

    def stop(self, kind: FaultKind, text: str) -> None:
        self._latch(ArmFaultError(kind, text))

    def write_positions(self, positions_rad: Any) -> None:  # noqa: ANN401
        self.goals.append(np.array(positions_rad))

    def write_currents(self, currents_a: Any) -> None:  # noqa: ANN401
        self.goals.append(np.array(currents_a))


def scripted(device: DynamixelMaster | DynamixelSlave) -> Scripted:
    arm = Scripted(device.servos.settings)
    device.servos = arm
    return arm


def follower(folder: Path, **options: Any) -> tuple[DynamixelSlave, Scripted]:  # noqa: ANN401
    path = folder / "arm.toml"
    write_calibration(path, 4_000_000, tuple(ServoSettings(servo_id=one, model="XM430-W350") for one in (1, 2)))
    device = DynamixelSlave(port="unused", arm=str(path), **options)
    return device, scripted(device)


FASTEST = FASTEST_SHARE * ServoSettings(servo_id=1, model="XM430-W350").servo.no_load_rad_s


@pytest.mark.parametrize("size_rad", [0.05, 0.5, -1.5, 3.0])
@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize("at", [0, 60])
@pytest.mark.parametrize("is_led", [True, False])
def test_wrong_reads_do_not_move_the_goal_of_a_follower(
    tmp_path: Path, clock: Clock, size_rad: float, count: int, at: int, *, is_led: bool
) -> None:
    device, arm = follower(tmp_path, max_lag=0.05)
    for n in range(100):
        device.read()
        if is_led:
            # 0.5 rad/s; the joint follows exactly.
            goal = 1e-3 * max(n - 5, 0)
            device.write((goal, 0.0), (0.5, 0.0))
            arm.true[0] = goal
        else:
            device.stop()
        arm.off[0] = size_rad if at <= n + 1 < at + count else 0.0
        clock.now_s += TICK_S
    steps = np.abs(np.diff(np.array(arm.goals)[:, 0]))
    assert steps.max() < 3e-3
    assert not arm.ends
    assert abs(arm.goals[-1][0] - arm.true[0]) < 2e-3


@pytest.mark.parametrize("size_rad", [0.2, -1.2])
def test_a_jump_that_stays_is_a_fault_at_the_fourth_read_and_moves_no_goal(
    tmp_path: Path, clock: Clock, size_rad: float
) -> None:
    device, arm = follower(tmp_path)
    for n in range(60):
        arm.off[0] = size_rad if n >= 50 else 0.0
        sample = device.read()
        device.stop()
        assert (sample.fault is None) == (n < 53), n
        clock.now_s += TICK_S
    assert np.abs(np.array(arm.goals)).max() == 0.0
    (fault,) = arm.ends
    assert fault.kind == FaultKind.JUMP
    assert f"servo 1 went {abs(size_rad):.2f} rad in 8 ms: must be at most 9.6 rad/s" in str(fault)


@pytest.mark.parametrize(
    ("speed", "pause_s", "is_fault"),
    [
        (0.98 * FASTEST, TICK_S, False),
        (0.98 * FASTEST, 0.3 * PAUSE_S, False),
        # Longer than PAUSE_S: the fourth read compares with the whole time.
        (0.9 * FASTEST, 0.2, False),
        (2.0 * FASTEST, TICK_S, True),
    ],
)
def test_fast_motion_is_accepted_up_to_twice_the_no_load_speed(
    tmp_path: Path, clock: Clock, speed: float, pause_s: float, *, is_fault: bool
) -> None:
    device, arm = follower(tmp_path)
    device.read()
    arm._low_goal, arm._high_goal = arm._low_goal - 10.0, arm._high_goal + 10.0
    for n in range(20):
        elapsed_s = pause_s if n == 10 else TICK_S
        clock.now_s += elapsed_s
        arm.true[0] += speed * elapsed_s
        device.read()
        if not is_fault:
            behind = arm.true[0] - arm.plausible.position[0]
            assert behind <= QUANTA_RAD or 10 <= n < 13, n
    assert bool(arm.ends) == is_fault


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_a_leader_ends_its_torque_at_the_fourth_fast_read(clock: Clock, count: int) -> None:
    device = DynamixelMaster(port="unused", arm="gello-ur", offsets=[0.0] * 6, signs=[1] * 6)
    arm = scripted(device)
    for n in range(20):
        arm.fast[0] = 1.01 * device.max_speed[0] if 10 <= n < 10 + count else 0.0
        device.read()
        clock.now_s += TICK_S
    assert [fault.kind for fault in arm.ends] == [FaultKind.OVER_SPEED] * (count > 3)


@pytest.mark.parametrize("size_rad", [0.3, -1.0, 2.0])
@pytest.mark.parametrize("joint", [0, 1, 2])
def test_wrong_angles_do_not_change_the_compensation_of_a_leader(clock: Clock, size_rad: float, joint: int) -> None:
    device = DynamixelMaster(port="unused", arm="gello-ur", offsets=[0.0] * 6, signs=[1] * 6)
    arm = scripted(device)
    seen = []
    for n in range(30):
        arm.off[joint] = size_rad if 10 <= n < 13 else 0.0
        device.read()
        device.write((0.0,) * 6)
        seen.append(device.compensated_nm)
        clock.now_s += TICK_S
    assert not cast("Any", arm).ends
    assert np.ptp(np.array(seen), axis=0).max() == 0.0
    assert np.abs(seen[0]).max() > 0.01
