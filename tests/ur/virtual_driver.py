"""The UR driver at an emulated arm in virtual time: the real driver, its worker thread, and the emulated controller.

Only ur_rtde, the network and the clock are replaced. A step of the driver is a control cycle of the controller, so
results do not depend on the machine.
"""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest
from tests.ur.fake_rtde import Arm, install
from tests.ur.virtual import DONE, World

from haptether.slave import SlaveSample, UrSlave

PATIENCE_S = 20.0
"""Longest real time for a call of the library."""
POLL_S = 1e-4
CLOCKS = ("checks", "connection", "driver", "motion", "services", "stop", "worker")


@dataclass
class WorldArm(Arm):
    """The state of an emulated controller, and calls that reach it."""

    version: tuple[int, int, int, int] = (5, 26, 0, 0)
    world: World = field(default_factory=lambda: World("5.26", upload=False))
    guard: Any = field(default_factory=threading.RLock)
    rest_s: float = 0.0
    """Time since the last control cycle, in s."""

    def monotonic(self) -> float:
        """Return the time of the controller in s."""
        return self.world.controller.now_s + self.rest_s

    def sleep(self, seconds: float) -> None:
        """Let time pass."""
        with self.guard:
            self.rest_s += seconds
            while self.rest_s >= self.world.controller.period_s:
                self.rest_s -= self.world.controller.period_s
                self.world.cycles(1)
            self.show()

    def show(self) -> None:
        """Show the state of the controller, as a package does."""
        of = self.world
        self.q[:], self.qd[:] = of.vector("actual_q"), of.vector("actual_qd")
        self.pose[:], self.speed[:] = of.vector("actual_TCP_pose"), of.vector("actual_TCP_speed")
        self.force[:] = of.vector("actual_TCP_force")
        self.runtime_state, self.robot_mode = int(of.number("runtime_state")), int(of.number("robot_mode"))
        self.safety_mode, self.safety_bits = int(of.number("safety_mode")), int(of.number("safety_status_bits"))

    def wait(self, holds: Callable[[], bool]) -> None:
        """Wait on the library's thread while the driver's thread lets time pass."""
        end_s = time.monotonic() + PATIENCE_S
        while not holds():
            assert time.monotonic() < end_s, self.world.controller.log
            time.sleep(POLL_S)


class WorldControl:
    """`rtde_control.RTDEControlInterface` of the emulated controller."""

    def __init__(self, arm: WorldArm) -> None:
        self._arm = arm
        self.alive = True

    def __getattr__(self, name: str) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:  # noqa: ANN401
            arm, world = self._arm, self._arm.world
            arm.said.append((name, *arguments))
            if name == "stopJ":
                return self._stop(*arguments)
            with arm.guard:
                if not world.playing and name not in {"connect", "reuploadScript"}:
                    return False
                doubles = {"directTorque": lambda: world.realtime(66, [*arguments[0], *(0.0,) * 12])}
                other: dict[str, Callable[[], Any]] = {
                    "connect": world.upload,
                    "reuploadScript": world.upload,
                    "setWatchdog": lambda: world.call(35, arguments),
                    "zeroFtSensor": lambda: world.call(8),
                    "kickWatchdog": lambda: world.write(0),
                    "stopScript": lambda: world.write(255),
                    "getTCPOffset": lambda: None,
                }
                (doubles | other)[name]()
                arm.show()
            return [0.0] * 6 if name == "getTCPOffset" else True

        return call

    def kill(self) -> None:
        """Take no further calls."""
        self.alive = False

    def _stop(self, deceleration: float, _asynchronous: bool) -> None:
        arm, world = self._arm, self._arm.world
        with arm.guard:
            world.realtime(34, [deceleration], [0])
        arm.wait(lambda: world.answer == DONE or not world.playing)
        with arm.guard:
            world.write(0)


class WorldReceive:
    """`rtde_receive.RTDEReceiveInterface` of the emulated controller."""

    SHOWN: ClassVar = {
        "getTargetQ": "q", "getActualQ": "q", "getActualQd": "qd", "getActualTCPPose": "pose",
        "getActualTCPSpeed": "speed", "getActualTCPForce": "force", "getRobotMode": "robot_mode",
        "getSafetyMode": "safety_mode", "getSafetyStatusBits": "safety_bits", "getRuntimeState": "runtime_state",
        "getTargetSpeedFraction": "slider", "isConnected": "connected",
    }  # fmt: skip

    def __init__(self, arm: WorldArm) -> None:
        self._arm = arm

    def getTimestamp(self) -> float:  # noqa: N802
        return self._arm.world.controller.now_s

    def disconnect(self) -> None:
        """Do nothing."""

    def __getattr__(self, name: str) -> Callable[[], Any]:
        return lambda: getattr(self._arm, self.SHOWN[name])


class WorldDriven:
    """An open driver at an emulated arm, in mode direct-torque.

    Args:
        monkeypatch: Replaces the library, the network and the clock.
        world: The controller, without a program.
        options: Options of the driver.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, world: World, **options: Any) -> None:  # noqa: ANN401
        self.arm = arm = WorldArm(world=world)
        self.world = world
        world.cycles(1)
        arm.show()
        install(monkeypatch, arm)
        clock = SimpleNamespace(monotonic=arm.monotonic, sleep=arm.sleep)
        for name in CLOCKS:
            monkeypatch.setattr(f"haptether.slave.ur.{name}.time", clock)
        module = SimpleNamespace(RTDEReceiveInterface=lambda *_: WorldReceive(arm))
        for name in ("connection", "driver"):
            monkeypatch.setattr(f"haptether.slave.ur.{name}.vendor_module", lambda: module)
        monkeypatch.setattr("haptether.slave.ur.connection.ControlProcess", lambda *_: WorldControl(arm))
        # Silence is measured in real time: a stalled machine must not stop the arm.
        monkeypatch.setattr("haptether.slave.ur.stop.SILENCE_S", PATIENCE_S)
        given = {"host": "fake", "mode": "direct-torque", "verify_watchdog": False, "force_filter_hz": 1000.0}
        self.driver = UrSlave(**(given | options))
        self.driver.open()
        self.until(lambda _: self.driver._watchdog.armed)

    def step(self, command: Callable[[SlaveSample], None] | None = None) -> SlaveSample:
        """Read a sample, and command the arm."""
        sample = self.driver.read()
        if command is not None and sample.fault is None:
            command(sample)
        worker, end_s = self.driver._connection.worker, time.monotonic() + PATIENCE_S
        while (call := worker._running) or worker._calls or worker._newest:
            if call is not None and call.name == "stop":
                # It takes time that passes only here.
                break
            assert time.monotonic() < end_s, self.arm.names[-20:]
            time.sleep(POLL_S)
        return sample

    def run(self, seconds: float, command: Callable[[SlaveSample], None] | None = None) -> list[SlaveSample]:
        """Step for a time in s; no fault may occur."""
        samples = []
        for _ in range(round(seconds / self.world.controller.period_s)):
            samples.append(self.step(command))
            assert samples[-1].fault is None, samples[-1].fault
        return samples

    def until(
        self, holds: Callable[[SlaveSample], bool], command: Callable[[SlaveSample], None] | None = None
    ) -> SlaveSample:
        """Step until a sample satisfies a condition, for at most 20 s of the controller."""
        for _ in range(10_000):
            if holds(sample := self.step(command)):
                return sample
        message = f"never: {sample}, {self.arm.names[-20:]}"
        raise AssertionError(message)

    def push(self, *force: float, torque: tuple[float, float, float] | None = None) -> Callable[[SlaveSample], None]:
        """Return the command of a constant force."""
        return lambda _: self.driver.write_force(force, torque)

    @property
    def torques(self) -> list[list[float]]:
        """Commanded torques, in order."""
        return [call[1] for call in self.arm.said if call[0] == "directTorque"]
