"""Driver of a UR arm: `device = "ur"`."""

import sys
import time
from collections.abc import Callable
from typing import Any, Final

from msgspec.structs import replace

from haptether.checklist import Checklist
from haptether.printed import printed
from haptether.slave.device import SlaveSample
from haptether.slave.ur.checks import (
    REMOTE_SINCE,
    UrRefusedError,
    check_address,
    check_after,
    check_before,
    check_connection,
    check_model,
    check_workspace,
    recover,
)
from haptether.slave.ur.connection import ClosedError, RtdeConnection, RtdeConnectionError, vendor_module
from haptether.slave.ur.kinematics.pose import quat_wxyz_from_rotvec
from haptether.slave.ur.modes import model_distance, ur_mode
from haptether.slave.ur.motion import Motion, MotionError, along
from haptether.slave.ur.options import UrOptions, unit_calibration, ur_options
from haptether.slave.ur.plausible import PlausibleStates
from haptether.slave.ur.set_point import ORIGIN
from haptether.slave.ur.state import Numbers, UrState, safety_stop
from haptether.slave.ur.stop import Phase, SoftStop, Watchdog
from haptether.slave.ur.worker import Call, TimedWorker
from haptether.slave.ur.wrench import UrWrench

READ_S: Final = 0.025
"""Timeout of `read` for a package in s; longer than the 20 ms after which the ladder holds."""
STALE_S: Final = 0.1
"""Age of the latest package in s that is a fault."""
POLL_S: Final = 1e-4
EARLY: Final = 0.7
"""Fraction of the period after which a package is polled."""
OPEN_PACKAGES: Final = 9
"""Number of packages in a row that follow from each other at the start, whose median zeroes the wrench."""
OPEN_S: Final = 2.0
"""Timeout for these packages in s."""
UNCONFIRMED_S: Final = 0.5
"""Time in s for which commands may wait for a state that packages confirm; four packages take 8 or 32 ms."""


class UrSlave:
    """UR arm through ur_rtde, for one thread; see `SlaveDevice` and docs/ur.md.

    Args:
        options: Fields of `UrOptions`.

    Raises:
        ValueError: The options are invalid.
    """

    paces = True

    @property
    def kinds(self) -> tuple[str, ...]:
        """Supported kinds of sides."""
        return ("linear", "pose") if self.options.axes == 3 else ("linear",)

    @property
    def takes_force(self) -> bool:
        """True if `write_force` moves the arm: in mode direct-torque."""
        return self.options.mode == "direct-torque"

    @property
    def max_force(self) -> float:
        """Largest force in N."""
        return self.options.max_force

    @property
    def max_torque(self) -> float:
        """Largest moment in N m about the tool point."""
        return self.options.max_torque

    @property
    def axes(self) -> int:
        """Number of axes of a sample."""
        return self.options.axes

    @property
    def period_s(self) -> float | None:
        """Interval between two samples in s, once open: that of the controller's packages."""
        return self._period_s if self._opened else None

    @property
    def max_speed(self) -> float:
        """Largest tool speed in m/s; behind a faster command the arm would continue to move after the release."""
        return self.options.max_speed

    speed_bound = 10.0
    """Speed bound of the tool in m/s. One joint at 3.7 rad/s and a reach of 1.8 m gives 6.4 m/s; joints add up."""

    @property
    def max_angular_speed(self) -> float:
        """Largest angular speed of the tool in rad/s, for the same reason."""
        return self.options.max_angular_speed

    def __init__(self, **options: Any) -> None:  # noqa: ANN401  # what a scene has
        self.options: UrOptions = ur_options(options)
        # Read the file before anything is connected.
        self._calibration = unit_calibration(self.options)
        self._connection: RtdeConnection
        self._soft_stop: SoftStop
        self._watchdog: Watchdog
        self._motion: Motion | None = None
        self._wrench: UrWrench
        self._states: PlausibleStates
        self._state: UrState
        """Newest state, judged by `_states`."""
        self._waiting = 0
        """Number of commands in a row that found no confirmed state."""
        self._before: UrState | None = None
        """Last state in which the arm was allowed to move."""
        self._opened = False
        self._closed = False
        """May be set during `open`."""
        self._period_s = 0.002
        self._arrived_s = self._read_s = 0.0
        self._fault: str | None = None
        self._shown: str | None = None
        """Fault of the last sample."""
        self._fault_s = 0.0
        self._recovery: Call | None = None

    # ---------------------------------------------------------------------------------------------- SlaveDevice

    def open(self) -> None:
        """Run the checklist and connect; the arm does not move.

        Raises:
            UrRefusedError: The arm is not ready.
            RtdeConnectionError: ur-rtde is missing.
            ClosedError: The driver was closed meanwhile.
        """
        self._closed = False
        vendor_module()
        checklist = Checklist(f"ur {self.options.host}", self._report_check, UrRefusedError)
        options = self.options = replace(self.options, host=check_address(self.options.host, checklist))
        seen = check_before(options, checklist)
        self._connection = RtdeConnection(options, seen.version)
        self._watchdog = Watchdog(options, self._connection, watches_remote=seen.version[:2] >= REMOTE_SINCE)
        self._period_s = 1.0 / self._connection.rate_hz
        self._states = PlausibleStates(self._period_s)
        self._aside = TimedWorker("ur-aside")
        self._soft_stop = SoftStop(self._connection, options.host, self._report)
        if self._closed:
            raise ClosedError
        self._opened = True
        x, y, z, rx, ry, rz = check_connection(options, self._connection, checklist)
        offset = (x, y, z, rx, ry, rz)
        # Loading CasADi takes time, so it precedes the start of the watchdog.
        mode = ur_mode(options, self._period_s, offset, self._calibration)
        self._motion = motion = Motion(
            options, self._connection, self._soft_stop, mode, self._period_s, report=self._report
        )
        self._wrench = UrWrench(
            raw=options.force_source == "raw", tool=offset, filter_hz=options.force_filter_hz,
            deadband_n=options.force_deadband_n, payload_kg=options.payload_kg or 0.0,
            payload_cog=options.payload_cog or ORIGIN,
        )  # fmt: skip
        check_after(options, self._connection, checklist)
        wrenches = self._await_confirmed(checklist)
        check_workspace(motion.outside(self._state), motion.tilted(self._state), options, checklist)
        mode.begin(self._state)
        distance_m = model_distance(mode)
        if distance_m is not None and mode.finds_joints:
            check_model(distance_m, options, checklist)
        # Imports and compilation of the first order would exceed the watchdog's period.
        motion.rehearse(self._state)
        if options.force_source == "raw" and options.zero_ft_sensor:
            self._wrench.zero(wrenches, self._state.pose)
        self._arrived_s = self._read_s = time.monotonic()

    def read(self) -> SlaveSample:
        """Return the next package, or the last one after a timeout; a wrong package is replaced by its prediction."""
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
                # The original fault remains, but this is more serious.
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
        """Send the tool on within its bounds.

        No effect during a fault or without an armed watchdog. A motion begins only from a state that packages confirm.

        Args:
            position: Commanded position in m, shape `(axes,)`.
            velocity: Commanded velocity in m/s, shape `(axes,)`.
            orientation: Unit quaternion w, x, y, z of kind "pose"; None for other kinds.
            angular_velocity: w in rad/s of kind "pose", shape `(3,)`; None for other kinds.
        """
        self._command(lambda motion: motion.send(self._state, position, velocity, orientation, angular_velocity))

    def write_force(self, force: tuple[float, ...], torque: tuple[float, float, float] | None = None) -> None:
        """Exert a force on what the tool touches, until the next command, within the bounds of the options.

        The same conditions as for `write` apply. A `write` continues from the arm's pose and velocity.

        Args:
            force: Force in N, shape `(axes,)`.
            torque: Moment in N m about the tool point in the base frame, of kind "pose"; without it the tool keeps its
                orientation.
        """
        self._command(lambda motion: motion.push(self._state, force, torque))

    def _command(self, send: Callable[[Motion], None]) -> None:
        """Send a command if the arm may move."""
        if self._recovery is not None:
            self._latch("engaged before the arm was ready: acknowledge again, and wait for the line that says so")
        if self._fault is not None or not self._watchdog.armed or self._motion is None:
            return
        if self._soft_stop.phase is not Phase.MOVING and not self._states.confirmed:
            self._waiting += 1
            if self._waiting * self._period_s > UNCONFIRMED_S:
                self._latch(
                    "the controller's packages do not follow from each other: see its log and the network, then"
                    " acknowledge"
                )
            return
        self._waiting = 0
        try:
            send(self._motion)
        except MotionError as error:
            self._latch(str(error))

    def stop(self) -> None:
        """Bring the arm to rest without blocking; `read` supervises it."""
        # An arm without a command may have no state yet.
        if self._motion is not None and self._soft_stop.commanded:
            self._soft_stop.stop(self._motion.mode.brake(self._state))

    def acknowledge(self) -> None:
        """Acknowledge a fixed fault: unlock, connect and upload again; report when the arm is ready."""
        if self._fault is None or self._fault is not self._shown or self._recovery is not None:
            # A fault since the last sample has not been shown yet.
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

    def give_up(self) -> None:
        """Make a running `open` raise an exception soon, from another thread."""
        self._closed = True
        if (connection := getattr(self, "_connection", None)) is not None:
            connection.give_up()

    def close(self) -> None:
        """End the control script and disconnect: within 5 s if the controller answers, otherwise 20 s."""
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
        if replaced := self._states.replaced:
            self._report(f"replaced by their prediction: {replaced} wrong packages of the controller")

    # ------------------------------------------------------------------------------------------------- figures

    @property
    def latency_s(self) -> float | None:
        """Delay in s from command to motion over the last seconds of motion; None without motion."""
        return None if self._motion is None else self._motion.latency.seconds

    # ---------------------------------------------------------------------------------------------------- read

    def _await_confirmed(self, checklist: Checklist) -> list[Numbers]:
        """Wait for the first confirmed state; return the wrenches of the packages that follow from each other."""
        states, at_s = self._states, -1.0
        wrenches: list[Numbers] = []

        def confirmed(package: UrState) -> bool:
            nonlocal at_s
            if package.finite and package.timestamp != at_s:
                at_s = package.timestamp
                self._state = states.take(package)
                wrenches.append(package.wrench)
            return states.in_a_row >= OPEN_PACKAGES

        try:
            self._connection.await_state(f"{OPEN_PACKAGES} packages that follow from each other", confirmed, OPEN_S)
        except RtdeConnectionError as error:
            checklist.refuse("packages", str(error), "see that the arm rests, and the controller's log")
            checklist.finish()
        return wrenches[-OPEN_PACKAGES:]

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
            self._state = self._states.take(state)
        else:
            # Discard the package, because a NaN would persist in the filter.
            self._state = self._state._replace(timestamp=state.timestamp)
            self._latch("the controller has sent a number that is none: see its log, then acknowledge")

    def _look_for_faults(self, now_s: float) -> None:
        lost = not self._connection.receive.isConnected() or now_s - self._arrived_s > STALE_S
        if self._fault is not None:
            if lost and self._connection.control is not None:
                # The library would reconnect, and upload a script without a watchdog.
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
                # A premature engagement occurred; report the cause nevertheless.
                self._report(f"not ready: {text}")
            # The next acknowledgement reconnects, because the failure may be an undetected lost connection.
            self._latch(text, lost=True)
            # Same stop as before.
            self._fault_s = stopped_s
            return
        self._states.restart()
        self._waiting = 0
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
        """Latch a fault until it is acknowledged; stop the arm, or cut a lost connection."""
        if self._fault is None:
            self._fault, self._fault_s = text, time.monotonic()
            # Stop the arm first, because the report handler may be slow or blocked.
            if lost:
                self._soft_stop.cut()
            else:
                self.stop()
            if not self._closed:
                # A closed arm has no fault: this side has ended its program.
                self._report(f"fault: {printed(text)}")

    def _report_check(self, line: str) -> None:
        if self._closed:
            raise ClosedError
        print(line, file=sys.stderr, flush=True)

    def _report(self, text: str) -> None:
        print(f"ur {self.options.host}: {text}", file=sys.stderr, flush=True)
