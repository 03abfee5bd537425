"""The driver of a UR arm: `device = "ur"`."""

import sys
import time
from typing import Any, Final

from msgspec.structs import replace

from haptether.checklist import Checklist
from haptether.slave.device import SlaveSample
from haptether.slave.ur.checks import (
    REMOTE_SINCE,
    UrRefusedError,
    check_address,
    check_after,
    check_before,
    check_model,
    check_workspace,
    recover,
)
from haptether.slave.ur.connection import RtdeConnection, RtdeConnectionError, vendor_module
from haptether.slave.ur.kinematics.pose import quat_wxyz_from_rotvec
from haptether.slave.ur.modes import check_mode, model_distance, ur_mode
from haptether.slave.ur.motion import Motion, MotionError, along
from haptether.slave.ur.options import UrOptions, ur_options
from haptether.slave.ur.set_point import ORIGIN
from haptether.slave.ur.state import UrState, safety_stop
from haptether.slave.ur.stop import SoftStop, Watchdog
from haptether.slave.ur.worker import Call, TimedWorker
from haptether.slave.ur.wrench import UrWrench

READ_S: Final = 0.025
"""Longest that `read` waits for a package: beyond the 20 ms that make the ladder hold."""
STALE_S: Final = 0.1
"""Age of the newest package that is a fault."""
POLL_S: Final = 1e-4
EARLY: Final = 0.7
"""Share of the period after which a package is looked for."""


class UrSlave:
    """A UR arm through ur_rtde, for one thread; see `SlaveDevice` and docs/ur.md.

    Args:
        options: Those of `UrOptions`.

    Raises:
        ValueError: Options that cannot be. From `open` also `UrRefusedError` and `RtdeConnectionError`: the arm is not
            ready, or ur-rtde is missing.
    """

    paces = True

    @property
    def kinds(self) -> tuple[str, ...]:
        """Of the sides that it can be."""
        return ("linear", "pose") if self.options.axes == 3 else ("linear",)

    @property
    def axes(self) -> int:
        """Number of axes of a sample."""
        return self.options.axes

    @property
    def period_s(self) -> float | None:
        """Between two samples in s, once it is open: that of the controller's packages."""
        return self._period_s if self._opened else None

    @property
    def max_speed(self) -> float:
        """Largest speed of the tool in m/s; behind a faster command the arm would go on after it was let go."""
        return self.options.max_speed

    speed_bound = 10.0
    """Speed bound of the tool in m/s. One joint at 3.7 rad/s and a reach of 1.8 m gives 6.4 m/s; joints add up."""

    @property
    def max_angular_speed(self) -> float:
        """Largest angular speed of the tool in rad/s, for the same reason."""
        return self.options.max_angular_speed

    def __init__(self, **options: Any) -> None:  # noqa: ANN401  # what a scene has
        self.options: UrOptions = ur_options(options)
        self._connection: RtdeConnection
        self._soft_stop: SoftStop
        self._watchdog: Watchdog
        self._motion: Motion | None = None
        self._wrench: UrWrench
        self._state: UrState
        self._before: UrState | None = None
        """The last state in which the arm was allowed to move."""
        self._opened = False
        self._closed = False
        """Maybe while it still opens."""
        self._period_s = 0.002
        self._arrived_s = self._read_s = 0.0
        self._fault: str | None = None
        self._shown: str | None = None
        """The fault of the last sample."""
        self._fault_s = 0.0
        self._recovery: Call | None = None

    # ---------------------------------------------------------------------------------------------- SlaveDevice

    def open(self) -> None:
        """Goes through the checklist and connects; the arm does not move."""
        vendor_module()
        self._closed = False
        checklist = Checklist(f"ur {self.options.host}", error=UrRefusedError)
        options = self.options = replace(self.options, host=check_address(self.options.host, checklist))
        seen = check_before(options, checklist)
        check_mode(options, seen.version)
        self._connection = RtdeConnection(options, seen.version)
        self._watchdog = Watchdog(options, self._connection, watches_remote=seen.version[:2] >= REMOTE_SINCE)
        self._period_s = 1.0 / self._connection.rate_hz
        self._aside = TimedWorker("ur-aside")
        self._soft_stop = SoftStop(self._connection, options.host, self._report)
        if self._closed:
            message = "closed before it was open"
            raise RtdeConnectionError(message)
        self._opened = True
        self._connection.connect()
        x, y, z, rx, ry, rz = options.tool or (self._connection.setting("tool", self._connection.control.getTCPOffset))
        offset = (x, y, z, rx, ry, rz)
        # With CasADi, which takes its time: before the watchdog listens.
        mode = ur_mode(options, self._period_s, offset)
        self._motion = motion = Motion(
            options, self._connection, self._soft_stop, mode, self._period_s, report=self._report
        )
        self._wrench = UrWrench(
            raw=options.force_source == "raw", tool=offset, filter_hz=options.force_filter_hz,
            deadband_n=options.force_deadband_n, payload_kg=options.payload_kg or 0.0,
            payload_cog=options.payload_cog or ORIGIN,
        )  # fmt: skip
        self._state = check_after(options, self._connection, checklist)
        check_workspace(motion.outside(self._state), motion.tilted(self._state), options, checklist)
        mode.begin(self._state)
        distance_m = model_distance(mode)
        if distance_m is not None and mode.finds_joints:
            check_model(distance_m, options, checklist)
        # What is imported and compiled at the first order takes longer than the watchdog waits.
        motion.rehearse(self._state)
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
            if self._fault is None:
                self._soft_stop.update()
                self._watchdog.service(now_s, self._aside, idle=not self._soft_stop.heard)
        why = self._soft_stop.check(self._state, stale=time.monotonic() - self._arrived_s > STALE_S)
        if why is not None:
            text = f"a soft stop {why}: the program is ended; see the arm, then acknowledge"
            if self._fault is None:
                self._latch(text)
            else:
                # The fault that it was stopped for stands; this is graver.
                self._report(f"{text}; if it moves, press its emergency stop")
            self._soft_stop.cut()
        return self._sample()

    def write(
        self,
        position: tuple[float, ...],
        velocity: tuple[float, ...],
        orientation: tuple[float, ...] | None = None,
        angular_velocity: tuple[float, ...] | None = None,
    ) -> None:
        """Sends the tool on, within its bounds; nothing where there is a fault or the watchdog is not armed."""
        if self._recovery is not None:
            self._latch("engaged before the arm was ready: acknowledge again, and wait for the line that says so")
        if self._fault is not None or not self._watchdog.armed or self._motion is None:
            return
        try:
            self._motion.send(self._state, position, velocity, orientation, angular_velocity)
        except MotionError as error:
            self._latch(str(error))

    def stop(self) -> None:
        """Has the arm come to rest; returns at once, `read` sees to it that it does."""
        # One that was never led may have no state yet.
        if self._motion is not None and self._soft_stop.commanded:
            self._soft_stop.stop(self._motion.mode.brake(self._state))

    def acknowledge(self) -> None:
        """The operator has removed the fault: unlocks, connects and uploads again, and says when the arm is ready."""
        if self._fault is None or self._fault is not self._shown or self._recovery is not None:
            # A fault since the last sample was not shown to anybody.
            return
        self._fault = None
        self._watchdog.reset()
        pending = self._soft_stop.acknowledge()
        if self._aside.stuck is not None:
            self._aside.end()
            self._aside = TimedWorker("ur-aside")
        options, connection, stopped_s = self.options, self._connection, self._fault_s

        def recovered() -> UrState:
            for call in pending:
                call.wait(call.limit_s)
            return recover(options, connection, stopped_s)

        self._recovery = self._aside.start("recovery", recovered, 60.0)

    def close(self) -> None:
        """Ends the control script and disconnects: within 5 s where the controller answers, else 20 s."""
        self._closed = True
        if not self._opened:
            return
        self._opened = False
        self.stop()
        self._soft_stop.close()
        for failed in self._connection.close():
            self._report(f"at the end: {failed}")
        self._aside.end()
        if (latency_s := self.latency_s) is not None:
            self._report(f"the arm followed {1e3 * latency_s:.0f} ms late")

    # ------------------------------------------------------------------------------------------------- figures

    @property
    def latency_s(self) -> float | None:
        """From what was written to where the arm was, in s, over the last seconds of motion; none without motion."""
        return None if self._motion is None else self._motion.latency.seconds

    # ---------------------------------------------------------------------------------------------------- read

    def _await_package(self) -> None:
        receive, before = self._connection.receive, self._state.timestamp
        begun_s = time.monotonic()
        early_s = self._arrived_s + EARLY * self._period_s - begun_s
        if early_s > 0.0:
            time.sleep(early_s)
        while receive.getTimestamp() == before:
            if time.monotonic() - begun_s > (READ_S if self._fault is None else self._period_s):
                return
            time.sleep(POLL_S)
        state = self._connection.state()
        self._arrived_s = time.monotonic()
        if state.finite:
            self._state = state
        else:
            # None of it is used: a filter would keep a number that is none for ever.
            self._state = self._state._replace(timestamp=state.timestamp)
            self._latch("the controller has sent a number that is none: see its log, then acknowledge")

    def _look_for_faults(self, now_s: float) -> None:
        lost = not self._connection.receive.isConnected() or now_s - self._arrived_s > STALE_S
        if self._fault is not None:
            if lost and self._connection.control is not None:
                # The library would connect again by itself, and upload a script without a watchdog.
                self._soft_stop.cut()
            return
        state = self._state
        stop = safety_stop(state, self._before)
        if stop is not None:
            self._latch(stop)
        elif not self._connection.receive.isConnected():
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
        elif (fault := self._watchdog.fault()) is not None:
            self._latch(fault, lost=self._connection.broken)
        else:
            self._before = state

    def _look_at_recovery(self, recovery: Call) -> None:
        if not recovery.done:
            return
        self._recovery = None
        if recovery.error is not None:
            stopped_s, text = self._fault_s, " ".join(str(recovery.error).split())
            if self._fault is not None:
                # Somebody has engaged too early; the cause is reported all the same.
                self._report(f"not ready: {text}")
            # The next acknowledgement connects anew: what failed may be a connection that nothing else shows is gone.
            self._latch(text, lost=True)
            # Still the same stop.
            self._fault_s = stopped_s
            return
        self._state = recovery.result
        self._before = None
        self._arrived_s = time.monotonic()
        self._report("ready: it may be engaged")

    def _sample(self) -> SlaveSample:
        state, now_s, self._shown = self._state, time.monotonic(), self._fault
        force, torque = self._wrench.felt(state.wrench, state.pose, now_s - self._read_s)
        self._read_s = now_s
        rotation = quat_wxyz_from_rotvec(state.pose[3:]), state.speed[3:], torque
        if self.options.axes == 1:
            position, velocity, felt = (along(self.options, of) for of in (state.pose, state.speed, force))
            return SlaveSample(position, velocity, felt, self._fault, *rotation)
        return SlaveSample(state.pose[:3], state.speed[:3], force, self._fault, *rotation)

    # -------------------------------------------------------------------------------------------------- faults

    def _latch(self, text: str, *, lost: bool = False) -> None:
        """A fault stays until it is acknowledged; the arm is stopped, or the connection cut where it is lost."""
        if self._fault is None:
            self._fault, self._fault_s = text, time.monotonic()
            # First the arm: whoever reads the report may be slow, or stopped.
            if lost:
                self._soft_stop.cut()
            else:
                self.stop()
            self._report(f"fault: {text}")

    def _report(self, text: str) -> None:
        print(f"ur {self.options.host}: {text}", file=sys.stderr, flush=True)
