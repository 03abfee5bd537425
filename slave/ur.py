"""The driver of a UR arm: `device = "ur"`."""

import sys
import time
from typing import Any, Final

from haptether.slave.device import SlaveSample
from haptether.slave.ur_bounded import Bounded, Call, Idle
from haptether.slave.ur_checks import (
    NO_DASHBOARD_SINCE,
    REMOTE_SINCE,
    Checklist,
    check_after,
    check_before,
    check_model,
)
from haptether.slave.ur_dashboard import is_in_remote_control
from haptether.slave.ur_halting import STOP_S, Halting
from haptether.slave.ur_latency import Latency
from haptether.slave.ur_link import STREAM_S, UrLink, vendor_module
from haptether.slave.ur_modes import Mode, UnreachableError, check_mode, model_distance, ur_mode
from haptether.slave.ur_options import Three, UrOptions, ur_options
from haptether.slave.ur_recovery import recover
from haptether.slave.ur_setpoint import SetPoint
from haptether.slave.ur_state import UrState, safety_stop
from haptether.slave.ur_wrench import UrWrench

READ_S: Final = 0.025
"""Longest that `read` waits for a package: beyond the 20 ms that make the ladder hold."""
STALE_S: Final = 0.1
"""Age of the newest package that is a fault."""
POLL_S: Final = 1e-4
EARLY: Final = 0.7
"""Share of the period after which a package is looked for."""
REFUSED_S: Final = 0.05
"""For how long commands may fail before that is a fault: a stop of the controller's has its own reason by then."""
SILENCE_S: Final = 0.02
"""After which an arm is stopped that would go on by itself and is not led."""
ARMED_S: Final = 1.0
REMOTE_EVERY_S: Final = 1.0
KICKS: Final = 5.0
"""Signs of life in each period of the watchdog, while nothing is commanded."""
MOST_PERIODS: Final = 5.0
"""Time between two commands that is made up for at once."""
ORIGIN: Final[Three] = (0.0, 0.0, 0.0)


class UrSlave:
    """A UR arm through ur_rtde, for one thread; see `SlaveDevice` and docs/ur.md.

    Args:
        options: Those of `UrOptions`.

    Raises:
        ValueError: Options that cannot be. From `open` also `UrRefusedError` and `LinkError`: the arm is not ready, or
            ur-rtde is missing.
    """

    paces = True

    @property
    def axes(self) -> int:
        """Number of axes of a sample."""
        return self.options.axes

    @property
    def max_speed(self) -> float:
        """Largest speed of the tool in m/s; behind a faster command the arm would go on after it was let go."""
        return self.options.max_speed

    def __init__(self, **options: Any) -> None:  # noqa: ANN401  # what a scene has
        self.options: UrOptions = ur_options(options)
        self._link: UrLink
        self._halting: Halting
        self._mode: Mode
        self._point: SetPoint
        self._wrench: UrWrench
        self._state: UrState
        self._latency = Latency(0.002)
        self._before: UrState | None = None
        """The last state in which the arm was allowed to move."""
        self._opened = False
        self._period_s = 0.002
        self._arrived_s = self._read_s = self._written_s = self._kicked_s = self._remote_s = 0.0
        self._taken_s = 0.0
        self._moving = False
        self._fault: str | None = None
        self._fault_s = 0.0
        self._guard: Call | None = None
        """Arming the watchdog."""
        self._recovery: Call | None = None
        self._remote: Call | None = None
        self._watches_remote = False

    # ---------------------------------------------------------------------------------------------- SlaveDevice

    def open(self) -> None:
        """Goes through the checklist and connects; the arm does not move."""
        vendor_module()
        options = self.options
        checklist = Checklist(options.host)
        seen = check_before(options, checklist)
        check_mode(options, seen.version)
        self._watches_remote = REMOTE_SINCE <= seen.version[:2] < NO_DASHBOARD_SINCE
        self._link = UrLink(options, seen.version)
        self._period_s = 1.0 / self._link.rate_hz
        self._aside = Bounded("ur-aside")
        self._halting = Halting(self._link, options.host, self._tell)
        self._opened = True
        self._link.connect()
        x, y, z, rx, ry, rz = options.tool or (self._link.setting("tool", self._link.control.getTCPOffset))
        offset = (x, y, z, rx, ry, rz)
        # With CasADi, which takes its time: before the watchdog listens.
        self._mode = ur_mode(options, self._period_s, offset)
        self._point = SetPoint(options.max_speed, options.max_acceleration, self._period_s, options.workspace)
        self._wrench = UrWrench(
            raw=options.force_source == "raw", tool=offset,
            filter_hz=options.force_filter_hz, deadband_n=options.force_deadband_n,
        )  # fmt: skip
        self._latency = Latency(self._period_s)
        self._state = check_after(options, self._link, checklist)
        distance_m = model_distance(self._mode, self._state)
        if distance_m is not None:
            check_model(distance_m, options, checklist)
        # An order that is thrown away: what is imported and compiled at the first takes longer than the watchdog waits.
        self._at_rest(self._state)
        self._mode.order(self._point, self._state, self._period_s)
        if options.force_source == "raw" and options.zero_ft_sensor:
            self._wrench.zero(self._state.wrench, self._state.pose)
        self._arrived_s = self._read_s = time.monotonic()

    def read(self) -> SlaveSample:
        """The next package, or the last one where none comes in time."""
        if self._recovery is not None:
            self._look_at_recovery(self._recovery)
        if self._recovery is not None:
            time.sleep(self._period_s)
        else:
            self._await_package()
            now_s = time.monotonic()
            self._look_for_faults(now_s)
            self._keep_alive(now_s)
        if self._halting.failed(self._state, stale=time.monotonic() - self._arrived_s > STALE_S):
            self._latch("a soft stop was not acknowledged: the program is ended; see the arm, then acknowledge")
            self._cut()
        return self._sample()

    def write(self, position: tuple[float, ...], velocity: tuple[float, ...]) -> None:
        """Sends the tool on, within its bounds; nothing where there is a fault or the watchdog is not armed."""
        if self._recovery is not None:
            self._latch("engaged before the arm was ready: acknowledge again, and wait for the line that says so")
        guard = self._guard
        if self._fault is not None or guard is None or not guard.over or guard.failed is not None:
            return
        state, now_s = self._state, time.monotonic()
        target = self._placed(position, self._point.position if self._moving else state.pose[:3])
        target_velocity = self._placed(velocity, ORIGIN)
        if not self._moving and (self._halting.busy or not self._begin(state, target)):
            # It still comes to rest from what it did before.
            return
        if self._link.worker.idled is not None:
            # It was stopped meanwhile: on from where it is, as fast as it may.
            self._link.worker.idled = None
            self._point.begin(state.pose[:3])  # type: ignore[arg-type]  # three of six
        elapsed_s = min(max(now_s - self._written_s, 0.25 * self._period_s), MOST_PERIODS * self._period_s)
        self._written_s = now_s
        self._point.step(target, target_velocity, elapsed_s)
        try:
            order = self._mode.order(self._point, state, elapsed_s)
        except UnreachableError as error:
            self._latch(f"{error}: lead it elsewhere, then acknowledge")
            return
        control = self._link.control
        idle = Idle(SILENCE_S, "stop", lambda: self._mode.stop(control), STOP_S) if self._mode.goes_on else None
        self._link.worker.stream(self._mode.name, lambda: order(control), STREAM_S, idle)
        self._latency.add(now_s, self._along(target), self._along(state.pose[:3]))

    def stop(self) -> None:
        """Has the arm come to rest; returns at once, `read` sees to it that it does."""
        if self._moving:
            self._moving = False
            self._halting.stop(self._mode)

    def acknowledge(self) -> None:
        """A person has seen to the fault: unlocks, connects and uploads again, and says when the arm is ready."""
        if self._fault is None or self._recovery is not None:
            return
        self._fault = None
        self._guard = self._remote = None
        self._halting.clear()
        if self._aside.stuck is not None:
            self._aside.end()
            self._aside = Bounded("ur-aside")
        self._link.worker.streamed = self._link.worker.idled = None
        options, link, stopped_s = self.options, self._link, self._fault_s
        self._recovery = self._aside.start("recovery", lambda: recover(options, link, stopped_s), 60.0)

    def close(self) -> None:
        """Ends the control script and disconnects, within 5 s."""
        if not self._opened:
            return
        self._opened = False
        self.stop()
        self._halting.end()
        for failed in self._link.end():
            self._tell(f"at the end: {failed}")
        self._aside.end()
        self._halting.close()
        if (latency_s := self.latency_s) is not None:
            self._tell(f"the arm followed {1e3 * latency_s:.0f} ms late")

    # ------------------------------------------------------------------------------------------------- figures

    @property
    def latency_s(self) -> float | None:
        """From what was written to where the arm was, in s, over the last seconds of motion; none without motion."""
        return self._latency.seconds

    # ---------------------------------------------------------------------------------------------------- read

    def _await_package(self) -> None:
        receive, before = self._link.receive, self._state.timestamp
        begun_s = time.monotonic()
        early_s = self._arrived_s + EARLY * self._period_s - begun_s
        if early_s > 0.0:
            time.sleep(early_s)
        while receive.getTimestamp() == before:
            if time.monotonic() - begun_s > (READ_S if self._fault is None else self._period_s):
                return
            time.sleep(POLL_S)
        state = self._link.state()
        self._arrived_s = time.monotonic()
        if state.finite:
            self._state = state
        else:
            # None of it is used: a filter would keep a number that is none for ever.
            self._state = self._state._replace(timestamp=state.timestamp)
            self._latch("the controller has sent a number that is none: see its log, then acknowledge")

    def _look_for_faults(self, now_s: float) -> None:
        lost = not self._link.receive.isConnected() or now_s - self._arrived_s > STALE_S
        if self._fault is not None:
            if lost and self._link.control is not None:
                # The library would connect again by itself, and upload a script without a watchdog.
                self._cut()
            return
        state = self._state
        stop = safety_stop(state, self._before)
        if stop is not None:
            self._latch(stop)
        elif not self._link.receive.isConnected():
            self._latch(
                "the controller closed the connection: see that it is on and the cable is in, then acknowledge",
                lost=True,
            )
        elif now_s - self._arrived_s > STALE_S:
            self._latch(
                f"nothing has come from the controller for {1e3 * (now_s - self._arrived_s):.0f} ms: see the network,"
                " then acknowledge",
                lost=True,
            )
        elif (trouble := self._trouble()) is not None:
            self._latch(trouble, lost=self._link.worker.stuck is not None or not self._link.control.alive)
        else:
            self._before = state

    def _trouble(self) -> str | None:
        """What is wrong with the calls of the library."""
        worker = self._link.worker
        if (stuck := worker.stuck) is not None:
            return f"{stuck.name} has not returned: the controller does not answer: see the network, then acknowledge"
        if (guard := self._guard) is not None and guard.failed is not None:
            return f"the watchdog was not armed: {guard.failed}"
        streamed = worker.streamed
        if streamed is None or streamed.failed is None:
            self._taken_s = time.monotonic()
        elif time.monotonic() - self._taken_s > REFUSED_S:
            return f"the controller takes no commands: {streamed.failed}: see the pendant, then acknowledge"
        remote = self._remote
        if remote is not None and remote.over:
            if remote.error is None and remote.result is False:
                return "remote control was switched off on the pendant: switch it on there, then acknowledge"
            if remote.error is not None:
                return f"{remote.error}: remote control cannot be looked after"
        return None

    def _keep_alive(self, now_s: float) -> None:
        """Arms the watchdog, kicks it while nothing is commanded, and asks after remote control."""
        if self._fault is not None:
            return
        if self._guard is None:
            control, hz = self._link.control, self.options.watchdog_hz
            self._guard = self._link.worker.start("setWatchdog", lambda: control.setWatchdog(hz), ARMED_S)
        elif (
            not self._moving
            and self._guard.over
            and not self._halting.busy
            and now_s - self._kicked_s > 1.0 / (KICKS * self.options.watchdog_hz)
        ):
            self._link.kick()
            self._kicked_s = now_s
        if self._watches_remote and now_s - self._remote_s > REMOTE_EVERY_S:
            self._remote_s = now_s
            if self._remote is None or self._remote.over:
                host = self.options.host
                self._remote = self._aside.start("remote control", lambda: is_in_remote_control(host), 2.0)

    def _look_at_recovery(self, recovery: Call) -> None:
        if not recovery.over:
            return
        self._recovery = None
        if recovery.error is not None:
            stopped_s, text = self._fault_s, " ".join(str(recovery.error).split())
            if self._fault is not None:
                # Somebody has engaged too early; the cause is told all the same.
                self._tell(f"not ready: {text}")
            # The next acknowledgement connects anew: what failed may be a connection that nothing else shows is gone.
            self._latch(text, lost=True)
            # Still the same stop.
            self._fault_s = stopped_s
            return
        self._state = recovery.result
        self._before = None
        self._arrived_s = time.monotonic()
        self._tell("ready: it may be engaged")

    def _sample(self) -> SlaveSample:
        state, now_s = self._state, time.monotonic()
        force = self._wrench.force(state.wrench, state.pose, now_s - self._read_s)
        self._read_s = now_s
        if self.options.axes == 1:
            along = self._along
            return SlaveSample(along(state.pose[:3]), along(state.speed[:3]), along(force), self._fault)
        return SlaveSample(state.pose[:3], state.speed[:3], force, self._fault)

    # --------------------------------------------------------------------------------------------------- write

    def _begin(self, state: UrState, target: Three) -> bool:
        """Whether motion begins: only from where the arm is."""
        x, y, z = state.pose[:3]
        away = sum((a - b) ** 2 for a, b in zip(target, (x, y, z), strict=True)) ** 0.5
        if away > self.options.max_jump:
            most = 1e3 * self.options.max_jump
            self._latch(
                f"told to begin {1e3 * away:.1f} mm away from where the tool is (max_jump {most:g} mm): acknowledge and"
                " engage anew"
            )
            return False
        if (beyond := self._point.outside((x, y, z))) > self.options.max_jump:
            self._latch(f"the tool is {1e3 * beyond:.1f} mm outside its workspace: move it inside, then acknowledge")
            return False
        self._at_rest(state)
        self._latency.clear()
        self._written_s = time.monotonic() - self._period_s
        self._moving = True
        return True

    def _at_rest(self, state: UrState) -> None:
        x, y, z = state.pose[:3]
        self._point.begin((x, y, z))
        self._mode.begin(state)

    def _placed(self, along: tuple[float, ...], at: tuple[float, ...]) -> Three:
        """A vector of the scene in the frame of the base; one axis leaves the other two as they are in `at`."""
        if len(along) == 3:
            return along[0], along[1], along[2]
        unit = self.options.axis_unit
        off = along[0] - sum(a * b for a, b in zip(unit, at, strict=True))
        return at[0] + off * unit[0], at[1] + off * unit[1], at[2] + off * unit[2]

    def _along(self, vector: tuple[float, ...]) -> float:
        unit = self.options.axis_unit
        return unit[0] * vector[0] + unit[1] * vector[1] + unit[2] * vector[2]

    # -------------------------------------------------------------------------------------------------- faults

    def _latch(self, text: str, *, lost: bool = False) -> None:
        """A fault stays until a person acknowledges it; the arm is stopped, or the connection cut where it is lost."""
        if self._fault is None:
            self._fault, self._fault_s = text, time.monotonic()
            # First the arm: who reads what is told may be slow, or stopped.
            if lost:
                self._cut()
            else:
                self.stop()
            self._tell(f"fault: {text}")

    def _cut(self) -> None:
        self._moving = False
        self._halting.cut()

    def _tell(self, text: str) -> None:
        print(f"ur {self.options.host}: {text}", file=sys.stderr, flush=True)
