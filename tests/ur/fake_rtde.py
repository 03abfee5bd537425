"""A controller and ur_rtde as plain objects, as far as the driver uses them.

Tests choose the faults of the real ones; all calls are recorded.
"""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import pytest

from haptether.slave.ur.services import DashboardError, Probe, ProbeError

START_Q = (-1.6, -1.7, -2.2, -0.8, 1.6, 0.0)
START_POSE = (-0.143195, -0.436400, 0.215901, 0.045165, 3.112182, -0.019942)
PLAYING, STOPPED = 2, 1
PERIOD_S = 0.002


@dataclass
class Arm:
    """State of both interfaces, and their faults."""

    version: tuple[int, int, int, int] = (5, 11, 0, 0)
    pose: list[float] = field(default_factory=lambda: list(START_POSE))
    speed: list[float] = field(default_factory=lambda: [0.0] * 6)
    q: list[float] = field(default_factory=lambda: list(START_Q))
    qd: list[float] = field(default_factory=lambda: [0.0] * 6)
    force: list[float] = field(default_factory=lambda: [0.0] * 6)
    slider: float = 1.0
    tool: list[float] = field(default_factory=lambda: [0.0] * 6)
    tool_moves: bool = False
    """True if the pose includes the tool that is set, along z."""
    runtime_state: int = STOPPED
    robot_mode: int = 7
    safety_mode: int = 1
    safety_bits: int = 1
    watchdog_hz: float | None = None
    connected: bool = True
    frozen_at: float | None = None
    blocks: set[str] = field(default_factory=set)
    """Calls of either interface that do not return until `released`."""
    refuses: set[str] = field(default_factory=set)
    raises: set[str] = field(default_factory=set)
    said: list[tuple[Any, ...]] = field(default_factory=list)
    dashboard: list[str] = field(default_factory=list)
    dashboard_gone: bool = False
    remote: bool = True
    scripts_refused: bool = False
    orphaned: bool = False
    """True if the playing program is a control script without a client."""
    ends: int = 0
    """Number of control scripts ended without the library, started or not."""
    watchdog_bites: bool = True
    released: threading.Event = field(default_factory=threading.Event)
    blocked: threading.Event = field(default_factory=threading.Event)
    """Set while or after a call blocks."""
    kicked_s: float = 0.0
    packages: int = 0
    """Number of packages that the driver has seen."""
    clock: Callable[[], float] = time.monotonic
    """Clock of its watchdog, in s."""

    def call(self, name: str, *arguments: Any) -> bool:  # noqa: ANN401
        """Perform any call of the control interface."""
        self.kicked_s = self.clock()
        self.enter(name, *arguments)
        return name not in self.refuses and (self.runtime_state == PLAYING or name == "reuploadScript")

    def enter(self, name: str, *arguments: Any) -> None:  # noqa: ANN401
        """Record a call of either interface, and hang or raise if requested."""
        self.said.append((name, *arguments))
        if name in self.blocks:
            self.blocked.set()
            self.released.wait(30.0)
        if name in self.raises:
            raise RuntimeError(f"{name}: write: Broken pipe")

    def look(self) -> None:
        """Let its watchdog check the time."""
        hz = self.watchdog_hz
        if hz is not None and self.watchdog_bites and self.clock() - self.kicked_s > 1.0 / hz:
            self.runtime_state, self.watchdog_hz = STOPPED, None

    def count_packages(self) -> None:
        """Let its watchdog count packages that the driver has seen: no time passes while a machine stalls."""
        self.packages, self.kicked_s = 0, 0.0
        self.clock = lambda: self.packages * PERIOD_S

    @property
    def names(self) -> list[str]:
        """Names of the calls, in order."""
        return [call[0] for call in self.said]

    def probe(self, _host: str, limit_s: float = 5.0) -> Probe:
        """Replace `services.probe`."""
        del limit_s
        if "probe" in self.blocks:
            self.blocked.set()
            self.released.wait(30.0)
        return Probe(
            version=self.version, robot_mode=self.robot_mode, safety_mode=self.safety_mode,
            safety_bits=self.safety_bits, runtime_state=self.runtime_state, q=tuple(self.q), pose=tuple(self.pose),
            rate_hz=500.0, speed_fraction=self.slider,
        )  # fmt: skip

    def stop_by_protection(self) -> None:
        """Make a protective stop."""
        self.safety_mode, self.safety_bits, self.runtime_state = 3, 1 << 2 | 1 << 10, STOPPED
        self.watchdog_hz = None

    def end_control_script(self, _host: str) -> bool:
        """Replace `services.end_control_script`."""
        self.ends += 1
        if self.orphaned:
            self.runtime_state, self.orphaned = STOPPED, False
        return self.runtime_state != PLAYING

    def check_script_port(self, host: str) -> None:
        """Replace `services.check_script_port`."""
        if self.scripts_refused:
            raise ProbeError(f"{host}:30003: Connection refused")

    def query_dashboard(self, _host: str, *lines: str) -> list[str]:
        """Replace `services.query_dashboard`."""
        self.dashboard.extend(lines)
        if self.dashboard_gone:
            raise DashboardError("dashboard: timed out")
        return [self._answer(line) for line in lines]

    def _answer(self, line: str) -> str:
        if line == "unlock protective stop":
            self.safety_mode, self.safety_bits = 1, 1
            return "Protective stop releasing"
        if line == "is in remote control":
            return str(self.remote).lower()
        if line == "stop":
            self.runtime_state = STOPPED
            return "Stopped"
        return ""


class Control:
    """`rtde_control.RTDEControlInterface`, in a process that can be killed."""

    def __init__(self, arm: Arm) -> None:
        self._arm = arm
        self.alive = True

    def _call(self, name: str, *arguments: Any) -> bool:  # noqa: ANN401
        done = self._arm.call(name, *arguments)
        if not self.alive:
            raise RuntimeError(f"the process of ur_rtde is gone during {name}")
        return done

    def connect(self) -> None:
        self._call("connect")
        self._arm.runtime_state, self._arm.watchdog_hz = PLAYING, None

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401
        return lambda *arguments: self._call(name, *arguments)

    def kill(self) -> None:
        """Let hanging calls return."""
        self.alive = False
        self._arm.said.append(("kill",))

    def setWatchdog(self, hz: float) -> bool:  # noqa: N802
        done = self._call("setWatchdog", hz)
        if done:
            self._arm.watchdog_hz = hz
        return done

    def reuploadScript(self) -> bool:  # noqa: N802
        self._call("reuploadScript")
        self._arm.runtime_state, self._arm.watchdog_hz = PLAYING, None
        return True

    def setTcp(self, tool: list[float]) -> bool:  # noqa: N802
        if self._arm.tool_moves:
            self._arm.pose[2] += tool[2]
        self._arm.tool = list(tool)
        return self._call("setTcp", tool)

    def getTCPOffset(self) -> list[float]:  # noqa: N802
        self._call("getTCPOffset")
        return list(self._arm.tool)


class Receive:
    """`rtde_receive.RTDEReceiveInterface`; a package comes every 2 ms."""

    def __init__(self, arm: Arm) -> None:
        self._arm = arm
        self._stamp = 0.0
        arm.connected, arm.frozen_at = True, None

    def getTimestamp(self) -> float:  # noqa: N802
        self._arm.look()
        if self._arm.frozen_at is not None:
            return self._arm.frozen_at
        stamp = round(time.monotonic() / PERIOD_S) * PERIOD_S
        self._arm.packages += stamp != self._stamp
        self._stamp = stamp
        return stamp

    def isConnected(self) -> bool:  # noqa: N802
        return self._arm.connected

    def disconnect(self) -> None:
        self._arm.enter("disconnect")

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401
        arm = self._arm
        shown: dict[str, Any] = {
            "getTargetQ": arm.q, "getActualQ": arm.q, "getActualQd": arm.qd, "getActualTCPPose": arm.pose,
            "getActualTCPSpeed": arm.speed, "getActualTCPForce": arm.force, "getFtRawWrench": arm.force,
            "getRobotMode": arm.robot_mode, "getSafetyMode": arm.safety_mode,
            "getSafetyStatusBits": arm.safety_bits, "getRuntimeState": arm.runtime_state,
            "getTargetSpeedFraction": arm.slider,
        }  # fmt: skip
        return lambda: shown[name]


def install(monkeypatch: pytest.MonkeyPatch, arm: Arm) -> None:
    """Put the arm in place of the library and the controller."""
    module = SimpleNamespace(RTDEReceiveInterface=lambda *_: Receive(arm))
    for place in ("connection", "driver"):
        monkeypatch.setattr(f"haptether.slave.ur.{place}.vendor_module", lambda: module)
    monkeypatch.setattr("haptether.slave.ur.connection.ControlProcess", lambda *_: Control(arm))
    monkeypatch.setattr("haptether.slave.ur.checks.probe", arm.probe)
    monkeypatch.setattr("haptether.slave.ur.checks.resolved", lambda host: host)
    monkeypatch.setattr("haptether.slave.ur.checks.check_script_port", arm.check_script_port)
    for name in ("query_dashboard", "end_control_script"):
        for place in ("services", "checks", "connection"):
            monkeypatch.setattr(f"haptether.slave.ur.{place}.{name}", getattr(arm, name), raising=False)
