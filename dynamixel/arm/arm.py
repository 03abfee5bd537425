"""Servos as joints of an arm: measured angles, commanded currents or angles, no torque after a fault."""

import contextlib
import errno
import math
import struct
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final, NoReturn

import numpy as np
from numpy.typing import NDArray

from haptether._core import DynamixelBus, SyncRead
from haptether.checklist import Checklist
from haptether.dynamixel.arm.checks import (
    ANSWERS_ALL,
    NO_PORT,
    ArmRefusedError,
    ServoRegisters,
    answer_all,
    answering_rate,
    check_place,
    check_port,
    check_present,
    check_servo,
    knows_fast_reads,
    opened_bus,
)
from haptether.dynamixel.arm.cycle import cycle_s
from haptether.dynamixel.arm.faults import ArmFaultError, FaultKind, hardware_error
from haptether.dynamixel.arm.grip import GripServo
from haptether.dynamixel.arm.plausible import PlausibleReads
from haptether.dynamixel.arm.roll_call import RollCall
from haptether.dynamixel.arm.settings import TURN, ArmSettings, ServoSettings
from haptether.dynamixel.control_table import (
    BUS_WATCHDOG,
    CENTRE,
    GOAL_CURRENT,
    GOAL_POSITION,
    GOAL_PWM,
    HARDWARE_STATUS,
    PRESENT_CURRENT,
    RAD_PER_TICK,
    RAD_S_PER_UNIT,
    STATUS_SIZE,
    TORQUE_ENABLE,
)
from haptether.dynamixel.models import OperatingMode
from haptether.printed import printed

Vector = NDArray[np.float64]

MEASURED: Final = np.dtype([("current", "<i2"), ("velocity", "<i4"), ("position", "<i4")])
"""Registers from Present Current on; a load in servos without current control."""
ONE_MEASURED: Final = struct.Struct("<hii")
STOPS: Final = 3
"""Number of times a stop is sent, because it is not acknowledged."""
FIRED: Final = 0xFF
"""Bus Watchdog value after it has tripped."""
GONE: Final = (
    errno.EIO, errno.ENODEV, errno.ENXIO, errno.EBADF, errno.ENOENT, errno.EPIPE, errno.ECONNRESET, errno.ECONNREFUSED,
)  # fmt: skip
"""Error numbers of an unplugged port."""
MOVED_RAD: Final = 0.2
"""Largest motion in rad of a joint while its torque comes on without a command."""
STILL_S: Final = 0.1
"""Interval in s of checks of an arm with a fault."""
RESTART_S: Final = 3.0
HELD_S: Final = 3.0
"""Time in s for a person to hold an arm before another program's torque is removed."""
BEGUN_S: Final = 3.0
"""Largest time in s from `open` to torque; afterwards the person who started it may have left."""
CLOSED_S: Final = 15.0
"""Longest duration in s of a step of `open` or of a recovery, with many silent servos."""


class ServoArm:
    """Arm of servos on one bus, for one thread; `stop` and `close` may come from any thread.

    `close` ends the arm for every thread. Measured values are in joint order and frame: q = sign (p - offset) + 2 pi k.
    A current has the sign of its torque. Values are NaN before the first read and after a failed read.

    Args:
        settings: Settings of bus and servos.
        report: Takes each line of the checklist and each event; by default standard error.
        grip: Servo of a gripper on the same bus. It is read and written with the joints, but keeps its torque when
            theirs ends.

    Raises:
        ValueError: The gripper has the id of a joint.
    """

    _roll_call: RollCall | None = None
    """Search for answering servos on a silent bus, while it runs."""
    cycle_s: float | None = None
    """Shortest time in s to read and write all servos, by their bytes; None before `open`."""
    _latency_s = 0.0
    """Latency timer of the adapter in s."""

    def __init__(
        self, settings: ArmSettings, report: Callable[[str], None] | None = None, grip: GripServo | None = None
    ) -> None:
        self.settings = settings
        self.grip = grip
        self._every = settings if grip is None else replace(settings, servos=(*settings.servos, grip.settings.servo))
        """Joints and gripper."""
        self.name = f"dynamixel {settings.port}"
        servos = settings.servos
        count = len(servos)
        self.position: Vector = np.full(count, np.nan)
        """q in rad, shape (n,)."""
        self.velocity: Vector = np.full(count, np.nan)
        """Velocities in rad/s, shape (n,)."""
        self.current: Vector = np.full(count, np.nan)
        """Currents in A, shape (n,); NaN for a servo without current control."""
        self.kept: tuple[int, ...] = ()
        """After `close`: ids of servos whose torque is not confirmed off."""
        self._report = report or _to_stderr
        self._ids = bytes(servo.servo_id for servo in servos)
        # Includes the shadows, which obey the id of their main servo.
        self._members = self._ids + bytes(shadow.servo_id for shadow, _ in settings.shadows)
        sign = np.array([float(servo.sign) for servo in servos])
        self._position_scale = sign * RAD_PER_TICK
        # For turn k = 0.
        self._shift = -sign * np.array([CENTRE * RAD_PER_TICK + servo.offset_rad for servo in servos])
        self._velocity_scale = sign * RAD_S_PER_UNIT
        self._current_scale = sign * np.array([servo.servo.current_unit_a or math.nan for servo in servos])
        self._sort_by_mode(settings.servos)
        self.plausible = PlausibleReads(servos)
        """Goals and compensation follow its joint angles."""
        self._bus: DynamixelBus | None = None
        self._read: SyncRead
        self._read_joints: SyncRead
        """Read without the gripper, for a gripper fault."""
        self._status = SyncRead(TORQUE_ENABLE, STATUS_SIZE, list(self._members))
        self._watchdogs = SyncRead(BUS_WATCHDOG, 1, list(self._members))
        self._ramp = self._ramp_begin_s = self._heard_s = self._watch_at_s = self._watched_s = self._alive_s = 0.0
        self._fault: ArmFaultError | None = None
        self._stopped: ArmFaultError | None = None
        """Set by `stop` since the last `open` or acknowledgement; ends any start of torque."""
        self._unsent: str | None = None
        """Error of the last stop that could not be sent."""
        self._recovery: threading.Thread | None = None
        self._recovered: BaseException | None = None
        self._ending = self._is_waiting = False
        """`_ending`: a close is in progress. `_is_waiting`: opened, torque not yet given."""
        self._ends = 0
        """Number of stops and closes; one that arrives while `open` waits applies to it."""
        self._ticking: int | None = None
        """Thread that reads; a close by another thread does not wait for it."""
        self._held: frozenset[int] = frozenset()
        """Servos whose torque this arm may end; torque of another program was announced first."""
        self._connecting, self._faulting = threading.Lock(), threading.Lock()
        """`_connecting` is held during `open` and recovery, which `close` of another thread may interrupt. `_faulting`
        is held briefly by stop, close and acknowledge.
        """

    def _sort_by_mode(self, servos: Sequence[ServoSettings]) -> None:
        """Group the servos into current and position mode, with caps, limits and units."""
        count, grip = len(servos), self.grip
        in_position = [i for i, s in enumerate(servos) if s.mode != OperatingMode.CURRENT]
        self._in_current = np.array([i for i in range(count) if i not in in_position], dtype=int)
        self._in_position = np.array(in_position, dtype=int)
        self._capped = np.array([i for i, s in enumerate(servos) if s.limits_current], dtype=int)
        self._limited, self._driven = (
            np.array([i for i in in_position if (i in self._capped) == limits], dtype=int) for limits in (True, False)
        )
        self._caps = np.array([servo.current_cap_a for servo in servos])
        self._cap_units = np.array([math.floor(s.current_cap_a / (s.servo.current_unit_a or 1.0)) for s in servos])
        self._pwm_units = np.zeros(count)
        self._current_ids = bytes(self._ids[i] for i in self._in_current)
        self._position_ids = bytes(self._ids[i] for i in self._in_position)
        self._grip_ids = self._position_ids if grip is None else self._position_ids + bytes((grip.servo_id,))
        self._units_per_a = 1.0 / self._current_scale[self._in_current]
        self._current_cap = self._caps[self._in_current]
        self._wanted_a, self._wanted_rad = np.empty(len(self._in_current)), np.empty(len(self._in_position))
        self._ticks_per_rad = 1.0 / self._position_scale[self._in_position]
        self._goal_shift = self._shift[self._in_position]
        self._low_goal, self._high_goal = np.array([(s.low_rad, s.high_rad) for s in servos])[self._in_position].T

    # ----------------------------------------------------------------------------------------------- begin and end

    def open(self, *, give_torque: bool = True) -> None:
        """Run the checklist; then give torque without a command and raise the caps from 0.

        Args:
            give_torque: False defers the torque to `begin`, because a delay before the first `read` would trip the
                watchdogs.

        Raises:
            ArmRefusedError: Lists every problem with its remedy.
        """
        if self._bus is not None:
            message = f"{self.name}: is open"
            raise ValueError(message)
        begun = self._ends
        with self._connecting:
            with self._faulting:
                if self._ends != begun:
                    message = f"{self.name}: closed or stopped before it was open"
                    raise ArmRefusedError(message)
                self._fault = self._stopped = self._unsent = self._ticking = self._roll_call = None
                self._ending, self._held = False, frozenset()
                self._is_waiting = not give_torque
                self._alive_s = _awake_s()
            try:
                self._connect()
                if self._is_waiting:
                    self._rest()
                    self._alive_s = _awake_s()
            except BaseException:
                self._disconnect()
                raise

    def begin(self) -> None:
        """Give torque to an arm that was opened without it, before the first `read`; otherwise no effect.

        Raises:
            ArmRefusedError: Gives the problem; or the arm was opened more than 3 s ago.
        """
        if not self._is_waiting or self._fault is not None or self._bus is None:
            return
        self._is_waiting = False
        late_s, self._alive_s = _awake_s() - self._alive_s, _awake_s()
        with self._connecting:
            try:
                if late_s > BEGUN_S:
                    message = f"{self.name}: it was opened {late_s:.0f} s ago and not read since: start anew"
                    raise ArmRefusedError(message)
                self._go_on()
                # Valid items were reported by `open`.
                checklist = Checklist(self.name, lambda _: None, ArmRefusedError)
                try:
                    self._place(checklist)
                    checklist.finish()
                    self._torque_on(checklist, verify=False)
                except (OSError, RuntimeError) as error:
                    self._go_on()
                    if isinstance(error, ArmRefusedError):
                        raise
                    checklist.refuse("bus", str(error), "see cables and supply, then try again")
                checklist.finish()
            except BaseException:
                self._disconnect()
                raise
        self._report(f"{self.name}: has torque")

    def _rest(self) -> None:
        """End the torque, verify it, and disable the watchdogs."""
        self._end_torque()
        kept = [str(one) for one in self._members if not _is_off(self._opened, one)]
        if kept:
            message = f"{self.name}: servo {', '.join(kept)} does not say that its torque is off: see its cable"
            raise ArmRefusedError(message)

    def close(self) -> None:
        """Lower the arm if its modes allow it, end all torque, and name each servo that keeps it.

        May be repeated, and called after any exception. Stops and awaits an `open` or a recovery in progress. Called
        from another thread than the reading one, it ends torque at once, because that thread may hang and resume at any
        time.

        Raises:
            RuntimeError: The `open` or recovery does not end.
        """
        with self._faulting:
            self._ending = True
            self._ends += 1
            others = {thread.ident for thread in threading.enumerate()} - {threading.get_ident()}
            if self._ticking in others and self._fault is None:
                # The reading thread must not command anything further.
                self._fault = ArmFaultError(FaultKind.NOT_READY, "closed by another thread")
        if not self._connecting.acquire(blocking=False):
            # The other thread may be giving torque.
            self._end_torque()
            if not self._connecting.acquire(timeout=CLOSED_S):
                self._refuse_to_end()
        self._connecting.release()
        if (recovery := self._recovery) is not None:
            # A recovery that has not begun must not begin after a later `open`.
            recovery.join(CLOSED_S)
            if recovery.is_alive():
                self._refuse_to_end()
        self._recovery = None
        if self._bus is None:
            return
        try:
            if self._fault is None and not self._is_waiting:
                self._let_down()
        finally:
            self._disconnect()

    @property
    def close_s(self) -> float:
        """Time in s for which `close` lowers the arm."""
        return self.settings.release_s

    def _refuse_to_end(self) -> NoReturn:
        """End the torque if an `open` or a recovery does not end."""
        self._end_torque()
        message = f"{self.name}: the bus does not let go of its port: its servos may KEEP torque, cut their supply"
        # Report here too, because a caller that closes after an error may ignore another one.
        self._report(message)
        raise RuntimeError(message)

    # -------------------------------------------------------------------------------------------------- every tick

    @property
    def fault(self) -> str | None:
        """Current fault, or None; the arm has no torque during a fault."""
        return None if self._fault is None else str(self._fault)

    @property
    def fault_kind(self) -> FaultKind | None:
        """Kind of the fault, or None."""
        return None if self._fault is None else self._fault.kind

    @property
    def ramp(self) -> float:
        """Fraction of the caps in force, 0 to 1."""
        return self._ramp

    def read(self) -> bool:
        """Measure, and return True if the values are current. Faults of the arm are reported by `fault`, not raised."""
        self._ticking = threading.get_ident()
        if self._fault is not None:
            roll_call = None if self._bus is None else self._roll_call
            return self._read_at_rest() if roll_call is None else self._ask_next(roll_call)
        now_s = time.monotonic()
        try:
            read = self._measure()
        except (OSError, RuntimeError) as error:
            self._nothing()
            self._missed(error, now_s)
            return False
        if (text := self.plausible.take(self.position, now_s)) is not None:
            self._nothing()
            self._latch(ArmFaultError(FaultKind.JUMP, text))
            return False
        if read.alerts:
            self._look_at_alert(read.alerts[0])
        if self._fault is None and (now_s > self._watch_at_s or now_s - self._heard_s > 0.5 * self.settings.watchdog_s):
            self._watch(now_s)
        elif self.grip is not None and self._fault is None:
            self._look_at_grip(self.grip, now_s)
        self._heard_s = now_s
        return self._fault is None

    def write_currents(self, currents_a: Sequence[float] | Vector) -> None:
        """Write currents in A of the servos in mode 0, in order, positive in the direction of q; saturated at the caps.

        Sends nothing during a fault; an invalid number is a fault.
        """
        wanted = self._wanted_a
        if not self._takes(("a current", "currents"), currents_a, wanted):
            return
        np.minimum(wanted, self._current_cap, out=wanted)
        np.maximum(wanted, -self._current_cap, out=wanted)
        wanted *= self._units_per_a
        wanted *= self._ramp
        # Round toward zero, so that the cap is not exceeded.
        self._send(GOAL_CURRENT, 2, self._current_ids, wanted.astype("<i2").tobytes())

    def write_positions(self, positions_rad: Sequence[float] | Vector) -> None:
        """Write goals q in rad of the servos in modes 4 and 5, in order; saturated at the joint limits.

        Sends nothing during a fault; an invalid number is a fault.
        """
        wanted, rises = self._wanted_rad, self._ramp < 1.0
        if not self._takes(("an angle", "angles"), positions_rad, wanted):
            return
        if rises:
            self._limit(self._ramp)
        np.minimum(wanted, self._high_goal, out=wanted)
        np.maximum(wanted, self._low_goal, out=wanted)
        ids, goals, grip = self._position_ids, self._goal_ticks(wanted), self.grip
        if grip is not None and grip.fault is None:
            if grip.are_limits_due:
                self.send_grip()
            ids, goals = self._grip_ids, goals + grip.goal
        self._send(GOAL_POSITION, 4, ids, goals)

    def send_grip(self) -> None:
        """Send the gripper a pending goal in a separate write, even during a fault of the arm."""
        if self.grip is None or self._bus is None or self._recovery is not None:
            return
        # A lost write is sent again.
        with contextlib.suppress(OSError, RuntimeError):
            self.grip.send(self._bus)

    def _takes(self, what: tuple[str, str], given: Sequence[float] | Vector, wanted: Vector) -> bool:
        """Copy a command and advance the ramp; return False during a fault. An invalid number is a fault."""
        if self._fault is not None:
            return False
        if len(given) != len(wanted):
            message = f"{self.name}: {len(given)} {what[1]}: must be {len(wanted)}, one of each servo that takes them"
            raise ValueError(message)
        wanted[:] = given
        if not math.isfinite(wanted.sum()):
            self._latch(ArmFaultError(FaultKind.NOT_FINITE, f"{what[0]} was commanded that is no number"))
            return False
        if self._ramp < 1.0:
            self._rise(time.monotonic())
        return True

    def stop(self, kind: FaultKind, text: str) -> None:
        """End all torque for a reason of the driver, as a fault.

        May be called from any thread at any time. It takes precedence over bus requests of other threads, and makes an
        `open` or a recovery in progress fail.
        """
        error = ArmFaultError(kind, text)
        with self._faulting:
            self._stopped = error
            self._ends += 1
            # Show the latest fault, so that an acknowledgement of an earlier one does not apply to it.
            is_first, self._fault = self._fault is None, error
        if is_first:
            self._latch(error)
        else:
            self._end_torque()
            self._report(f"{self.name}: fault: {printed(str(error))}")

    # ------------------------------------------------------------------------------------------------ after a fault

    @property
    def recovering(self) -> bool:
        """True while an acknowledged fault is being repaired."""
        return self._recovery is not None

    def acknowledge(self, shown: str | None) -> None:
        """Acknowledge a fixed fault: the checklist runs on a separate thread until `fault` is None.

        Reboots servos with a hardware error.

        Args:
            shown: The `fault` that the person saw; no effect if the fault has changed.
        """
        with self._faulting:
            if self._fault is None or str(self._fault) != shown or self._recovery is not None or self._ending:
                return
            self._recovered = self._stopped = self._roll_call = None
            self._alive_s = _awake_s()
        self._recovery = threading.Thread(target=self._recover, name="dynamixel-recovery", daemon=True)
        self._recovery.start()

    # ------------------------------------------------------------------------------------------------------ begin

    @property
    def _opened(self) -> DynamixelBus:
        if (bus := self._bus) is None:
            message = f"{self.name}: is not open"
            # Closed by another thread within a tick, or never opened.
            raise RuntimeError(message) if self._fault is not None else ValueError(message)
        return bus

    def _go_on(self) -> None:
        """Abort an `open` or a recovery if the arm is closed or stopped, or if the process was suspended."""
        before_s, self._alive_s = self._alive_s, _awake_s()
        # Silent servos and the watchdog test take the longest time between two calls.
        if (still_s := self._alive_s - before_s) > BEGUN_S + self.settings.watchdog_s:
            message = (
                f"{self.name}: this process stood still for {still_s:.0f} s: whoever began it may be gone: begin anew"
            )
            raise ArmRefusedError(message)
        if self._ending:
            message = f"{self.name}: closed before it was open"
            raise ArmRefusedError(message)
        if (stopped := self._stopped) is not None:
            message = f"{self.name}: stopped before it was open: {stopped}"
            raise ArmRefusedError(message)

    def _connect(self, *, restart: bool = False) -> None:
        """Run the checklist; with `restart`, first reboot servos with a hardware error."""
        self._go_on()
        checklist = Checklist(self.name, self._report, ArmRefusedError)
        settings = self.settings
        self._latency_s = check_port(settings.port, checklist)
        checklist.finish()
        if self._bus is None:
            try:
                self._bus = opened_bus(settings.port, settings.baud, settings.timeout_s)
            except OSError as error:
                if error.errno in NO_PORT:
                    found, remedy = str(error.strerror), "/dev/serial/by-id names the ports of adapters"
                else:
                    found, remedy = str(error), "end what else has it, and see that the adapter knows this rate"
                checklist.refuse("port", found, remedy)
                checklist.finish()
        try:
            if restart:
                self._restart()
            self._check(checklist)
            checklist.finish()
            self._place(checklist)
            checklist.finish()
            self._torque_on(checklist)
        except (OSError, RuntimeError) as error:
            # If a stop or close caused the failure, report that.
            self._go_on()
            if isinstance(error, ArmRefusedError):
                raise
            checklist.refuse("bus", str(error), "see cables and supply, then try again")
        checklist.finish()

    def _check(self, checklist: Checklist) -> None:
        settings, bus = self.settings, self._opened
        answered, firmware = check_present(bus, self._every, checklist, self._go_on)
        if not answered:
            bus.close()
            self._bus = None
            if (rate := answering_rate(settings, self._go_on)) is not None:
                checklist.refuse("baud", f"servos answer at {rate} bit/s", f"set baud = {rate}, or address 8 of each")
            return
        for servo_id in sorted(answered):
            self._go_on()
            # A servo that does not answer reads is reported below.
            with contextlib.suppress(TimeoutError, RuntimeError):
                if (level := answer_all(bus, servo_id)) != ANSWERS_ALL:
                    found = f"status return level was {level}, and is {ANSWERS_ALL} now"
                    checklist.ok(f"servo {servo_id}", found)
        self._caution_of_torque(answered, checklist)
        for servo, obeys in (*((servo, None) for servo in settings.servos), *settings.shadows):
            if servo.servo_id not in firmware:
                continue
            self._go_on()
            try:
                check_servo(bus, servo, checklist, obeys)
                if obeys is None:
                    registers = ServoRegisters(bus, servo)
                    self._pwm_units[self._ids.index(servo.servo_id)] = registers["PWM Limit"]
            except (OSError, RuntimeError) as error:
                checklist.refuse(f"servo {servo.servo_id}", str(error), "see its cables, then try again")
        if self.grip is not None and self.grip.servo_id in firmware:
            try:
                self.grip.check(bus, checklist)
            except (OSError, RuntimeError) as error:
                checklist.refuse(f"servo {self.grip.servo_id}", str(error), "see its cables, then try again")
        if len(firmware) < len(self._members) + (self.grip is not None):
            return
        fast = knows_fast_reads(self._every, firmware)
        every = [servo.servo_id for servo in self._every.servos]
        self._read = SyncRead(PRESENT_CURRENT, MEASURED.itemsize, every, fast=fast)
        self._read_joints, self._status, self._watchdogs = (
            SyncRead(address, length, list(ids), fast=fast)
            for address, length, ids in (
                (PRESENT_CURRENT, MEASURED.itemsize, self._ids),
                (TORQUE_ENABLE, STATUS_SIZE, self._members),
                (BUS_WATCHDOG, 1, self._members),
            )
        )
        checklist.ok("reads", "fast" if fast else "not fast: the firmware of a servo is too old; update it for 1 kHz")
        self.cycle_s = cycle_s(self._every, fast=fast)
        later = f", and up to {1e3 * self._latency_s:g} ms of the latency timer" if self._latency_s else ""
        checklist.ok("cycle", f"{1e3 * self.cycle_s:.2f} ms of bytes at {settings.baud} bit/s{later}")

    def _caution_of_torque(self, present: set[int], checklist: Checklist) -> None:
        """Announce the servos whose torque will be removed, and leave time to support their load."""
        loaded = [str(one) for one in self._members if one in present and not self._is_without_torque(one)]
        if not loaded:
            self._held = frozenset(one for one in self._members if one in present)
            return
        found = f"has torque already, or does not say: whoever had this bus before gave it; it is off in {HELD_S:g} s"
        checklist.caution(f"servo {', '.join(loaded)}", found, "HOLD THE ARM: what it bears falls")
        end_s = time.monotonic() + HELD_S
        while time.monotonic() < end_s:
            self._go_on()
            time.sleep(0.02)
        self._held = frozenset(one for one in self._members if one in present)

    def _is_without_torque(self, servo_id: int) -> bool:
        """Return True if the servo reports no torque; a silent servo counts as having torque."""
        for _ in range(STOPS):
            with contextlib.suppress(TimeoutError, RuntimeError):
                return self._opened.read(servo_id, TORQUE_ENABLE, 1) == b"\0"
        return False

    def _place(self, checklist: Checklist) -> None:
        """Determine the turn of each servo, and check that the joints are within their limits."""
        near = np.array([servo.middle_rad for servo in self.settings.servos])
        self._take(self._opened.sync_read(self._read_joints))
        if self.grip is not None:
            self.grip.place(self._opened, checklist)
        self._turn_towards(near)
        for index, servo in enumerate(self.settings.servos):
            q = float(self.position[index])
            if servo.low_rad <= q <= servo.high_rad:
                check_place(servo, q, checklist)
                continue
            # Another turn may fit better than the one nearest to the middle.
            options = (q - TURN, q, q + TURN)
            best = min(options, key=lambda one: max(servo.low_rad - one, one - servo.high_rad))
            self._shift[index] += best - q
            self.position[index] = best
            check_place(servo, best, checklist)

    def _turn_towards(self, near: Vector) -> None:
        turns = TURN * np.round((near - self.position) / TURN)
        self._shift += turns
        self.position += turns
        self.plausible.restart(self.position)
        self._goal_shift = self._shift[self._in_position]

    def _torque_on(self, checklist: Checklist, *, verify: bool = True) -> None:
        bus, ids, units = self._opened, self._members, self.settings.watchdog_units
        self._arm_watchdogs(checklist)
        servos = (*self.settings.servos, *(shadow for shadow, _ in self.settings.shadows))
        for servo_id, servo in zip(ids, servos, strict=True):
            # A mode change has set them to their limits.
            address = GOAL_CURRENT if servo.limits_current else GOAL_PWM
            bus.write(servo_id, address, b"\0\0")
            if bus.read(servo_id, address, 2) != b"\0\0":
                checklist.refuse(f"servo {servo_id}", "its goal is not 0", "it does not take it: see its firmware")
        checklist.finish()
        before = self.position.copy()
        for servo_id in ids:
            self._go_on()
            bus.write(servo_id, TORQUE_ENABLE, b"\1")
        # A stop between the check before and the write was sent before the torque.
        self._go_on()
        self._take(bus.sync_read(self._read_joints))
        # Torque may recount the angle by whole turns.
        self._turn_towards(before)
        self._hold()
        if verify and self.settings.verify_watchdog:
            silent_s = 0.02 * units + 0.05
            found = f"are tried now: for {silent_s:.2f} s the arm bears nothing, as without torque"
            checklist.caution("bus watchdogs", found, "SUPPORT THE ARM where it would fall")
            time.sleep(silent_s)
            fired = bus.sync_read(self._watchdogs)
            self._arm_watchdogs(checklist, tried=fired)
            checklist.finish()
            self._take(bus.sync_read(self._read_joints))
            self._hold()
        status = bus.sync_read(self._status)[::STATUS_SIZE]
        for servo_id, torque in zip(ids, status, strict=True):
            if not torque:
                checklist.refuse(
                    f"servo {servo_id}", "its torque does not stay on", "see hardware error and supply, then try again"
                )
        moved = float(np.abs(self.position - before).max())
        taken = "took" if self._is_waiting else "has"
        checklist.check(
            "arm", f"{taken} torque, and moved {moved:.3f} rad meanwhile", good=moved <= MOVED_RAD,
            remedy="support it, and do not move it meanwhile",
        )  # fmt: skip
        checklist.finish()
        self._go_on()
        # The gripper keeps its torque independent of the arm.
        if self.grip is not None and verify:
            self.grip.begin(bus)
        self._ramp = 0.0
        self._ramp_begin_s = self._heard_s = time.monotonic()
        self._watched_s = self._heard_s
        self._watch_at_s = self._heard_s + self.settings.watch_s

    def _arm_watchdogs(self, checklist: Checklist, tried: bytes | None = None) -> None:
        bus, units = self._opened, self.settings.watchdog_units
        for index, servo_id in enumerate(self._members):
            # A tripped watchdog accepts only 0.
            bus.write(servo_id, BUS_WATCHDOG, b"\0")
            bus.write(servo_id, BUS_WATCHDOG, bytes((units,)))
            if bus.read(servo_id, BUS_WATCHDOG, 1)[0] != units:
                checklist.refuse(
                    f"servo {servo_id}", "its bus watchdog is not armed",
                    "it would keep its torque when this process ends: see its firmware",
                )  # fmt: skip
            if tried is not None and tried[index] != FIRED:
                checklist.refuse(f"servo {servo_id}", "its bus watchdog did not fire", "see its firmware")
        checklist.finish()
        checklist.ok("bus watchdogs", f"{20 * units} ms, {'armed' if tried is None else 'tried: they end the torque'}")

    def _hold(self) -> None:
        """Set goals to the current angles, which the servos acknowledge."""
        goals = self._goal_ticks(self.position[self._in_position])
        for at, servo_id in enumerate(self._position_ids):
            self._opened.write(servo_id, GOAL_POSITION, goals[4 * at : 4 * at + 4])

    # ------------------------------------------------------------------------------------------------- every tick

    def _measure(self) -> SyncRead:
        """Measure all servos; skip a gripper with a fault."""
        if self.grip is None or self.grip.fault is not None:
            self._take(self._opened.sync_read(self._read_joints))
            return self._read_joints
        received = self._opened.sync_read(self._read)
        self.grip.take(ONE_MEASURED.unpack_from(received, len(self._ids) * MEASURED.itemsize), time.monotonic())
        self._take(received)
        return self._read

    def _take(self, received: bytes) -> None:
        fields = np.frombuffer(received, MEASURED, len(self._ids))
        np.multiply(fields["position"], self._position_scale, out=self.position)
        self.position += self._shift
        np.multiply(fields["velocity"], self._velocity_scale, out=self.velocity)
        np.multiply(fields["current"], self._current_scale, out=self.current)

    def _nothing(self) -> None:
        self.position.fill(np.nan)
        self.velocity.fill(np.nan)
        self.current.fill(np.nan)

    def _goal_ticks(self, wanted: Vector) -> bytes:
        ticks = (wanted - self._goal_shift) * self._ticks_per_rad
        return bytes(np.rint(ticks).astype("<i4"))

    def _rise(self, now_s: float) -> None:
        ramp_s = self.settings.ramp_s
        self._ramp = 1.0 if ramp_s <= 0.0 else min((now_s - self._ramp_begin_s) / ramp_s, 1.0)

    def _limit(self, share: float) -> None:
        """Set the fraction of current or supply for servos in position mode."""
        for members, units, address in (
            (self._limited, self._cap_units, GOAL_CURRENT),
            (self._driven, self._pwm_units, GOAL_PWM),
        ):
            if len(members):
                goals = (share * units[members]).astype("<i2").tobytes()
                self._send(address, 2, bytes(self._ids[i] for i in members), goals)

    def _send(self, address: int, length: int, ids: bytes, goals: bytes) -> None:
        try:
            self._opened.sync_write(address, length, ids, goals)
        except (OSError, RuntimeError) as error:
            self._missed(error, time.monotonic())

    # ----------------------------------------------------------------------------------------------------- faults

    def _missed(self, error: Exception, now_s: float, since_s: float | None = None) -> None:
        """Handle a failed exchange: a fault if none has succeeded for too long."""
        if self._fault is not None:
            # A stop of another thread interrupted it.
            return
        if isinstance(error, OSError) and error.errno in GONE:
            self._latch(ArmFaultError(FaultKind.UNPLUGGED, f"{error}: plug the adapter in, then acknowledge"))
        elif now_s - (self._heard_s if since_s is None else since_s) > self.settings.lost_after_s and (
            since_s is not None or not self._misses_grip_alone()
        ):
            self._lose(error)

    def _misses_grip_alone(self) -> bool:
        """Return True if the joints answer and the gripper does not, which is a gripper fault."""
        grip = self.grip
        if grip is None or grip.fault is not None:
            return False
        try:
            self._opened.sync_read(self._read_joints)
        except (OSError, RuntimeError):
            return False
        text = f"of servo {grip.servo_id} (gripper): see its cable and its supply, then acknowledge"
        self._fail_grip(ArmFaultError(FaultKind.SILENT, text))
        return True

    def _look_at_grip(self, grip: GripServo, now_s: float) -> None:
        before = grip.fault
        if (said := grip.look(self._opened, now_s)) is not None:
            self._report(f"{self.name}: {said}")
        if grip.fault is not None and grip.fault is not before:
            self._report(f"{self.name}: fault of the gripper: {grip.fault}")

    def _fail_grip(self, error: ArmFaultError) -> None:
        assert self.grip is not None
        self.grip.fail(error)
        self._report(f"{self.name}: fault of the gripper: {error}")

    def _lose(self, error: Exception) -> None:
        """Handle a silent bus: end torque at once; later reads find the silent servos."""
        silent = isinstance(error, TimeoutError)
        kind = FaultKind.SILENT if silent else FaultKind.UNREADABLE
        seen = "supply and cables" if silent else "cables and rate"
        lost = ArmFaultError(kind, f"{error}: see {seen}, then acknowledge")
        self._latch(lost)
        with self._faulting:
            if self._fault is lost:
                self._roll_call = RollCall(lost, self._members)

    def _ask_next(self, roll_call: RollCall) -> bool:
        """Ask one servo on a silent bus; name the silent ones after all were asked."""
        found = roll_call.ask(self._opened)
        with self._faulting:
            if roll_call.is_over and self._roll_call is roll_call:
                self._roll_call = None
            if found is None or self._fault is not roll_call.lost:
                return False
            self._fault = found
        self._report(f"{self.name}: fault: {printed(str(found))}")
        return False

    def _look_at_alert(self, servo_id: int) -> None:
        try:
            status = self._opened.read(servo_id, HARDWARE_STATUS, 1)[0]
        except (OSError, RuntimeError) as error:
            self._missed(error, time.monotonic())
            return
        if status and self.grip is not None and servo_id == self.grip.servo_id:
            self._fail_grip(hardware_error(servo_id, status))
        elif status:
            self._latch(hardware_error(servo_id, status))

    def _watch(self, now_s: float) -> None:
        """Check that each servo has torque and that its watchdog has not tripped."""
        self._watch_at_s = now_s + self.settings.watch_s
        try:
            watchdogs = self._opened.sync_read(self._watchdogs)
            torque = self._opened.sync_read(self._status)[::STATUS_SIZE]
        except (OSError, RuntimeError) as error:
            # Measurements may still arrive, but do not prove that torque is on.
            self._missed(error, now_s, self._watched_s + self.settings.watch_s)
            self._watch_at_s = now_s
            return
        self._watched_s = now_s
        if self._status.alerts:
            self._look_at_alert(self._status.alerts[0])
            if self._fault is not None:
                return
        units = self.settings.watchdog_units
        for servo_id, watchdog, on in zip(self._members, watchdogs, torque, strict=True):
            if watchdog == FIRED:
                text = (
                    f"servo {servo_id} heard nothing for {20 * units} ms and ended its torque: this process was halted,"
                    " or its cable is loose; acknowledge"
                )
                self._latch(ArmFaultError(FaultKind.WATCHDOG, text))
            elif not on:
                # State that a servo loses on a restart.
                text = (
                    "has started anew: see its supply" if watchdog != units else "ended its torque: see who else writes"
                )
                kind = FaultKind.REBOOTED if watchdog != units else FaultKind.TORQUE_OFF
                self._latch(ArmFaultError(kind, f"servo {servo_id} {text}, then acknowledge"))
            elif watchdog != units:
                text = (
                    f"servo {servo_id} has torque, and its watchdog is {20 * watchdog} ms: was {20 * units}: see who"
                    " else writes, then acknowledge"
                )
                self._latch(ArmFaultError(FaultKind.WATCHDOG, text))
            else:
                continue
            return

    def _latch(self, error: ArmFaultError) -> None:
        # Other threads send nothing from here on.
        self._fault = error
        # Stop the arm first, because the report handler may be slow.
        self._end_torque()
        self._ramp = 0.0
        self._watch_at_s = 0.0
        self._report(f"{self.name}: fault: {printed(str(error))}")

    def _end_torque(self) -> None:
        """Send zero currents and torque off, several times, ahead of the bus requests of other threads.

        Reports a failure to send, once per series.
        """
        bus = self._bus
        if bus is None:
            return
        unsent = None
        for address, size, ids in ((GOAL_CURRENT, 2, self._current_ids), (TORQUE_ENABLE, 1, self._members)):
            try:
                # Unannounced torque may bear a load for another program.
                if held := bytes(one for one in ids if one in self._held):
                    bus.stop(address, size, held, bytes(size * len(held)))
            except (OSError, RuntimeError, ValueError) as error:
                unsent = str(error)
        before, self._unsent = self._unsent, unsent
        if unsent is not None and unsent != before:
            self._report(
                f"{self.name}: the stop could not be sent: {unsent}. Bus watchdogs, where they were armed, end the"
                f" torque after {20 * self.settings.watchdog_units} ms of silence"
            )

    def _read_at_rest(self) -> bool:
        """During a fault, check periodically and resend the stop until all servos confirm no torque."""
        if self._recovery is not None:
            if self._recovery.is_alive():
                return False
            self._recovery = None
            if self._recovered is None:
                self._fault = None
                # The order matters: a stop of another thread either finds no fault, or is seen here.
                if (stopped := self._stopped) is not None:
                    self._latch(stopped)
                    return False
                self._report(f"{self.name}: ready: acknowledge once more, so that the two sides may engage")
                return self.read()
            text = " ".join(str(self._recovered).split())
            self._fault = ArmFaultError(FaultKind.NOT_READY, text)
            self._report(f"{self.name}: fault: {printed(str(self._fault))}")
        now_s = time.monotonic()
        if self._bus is None or now_s < self._watch_at_s:
            return False
        self._watch_at_s = now_s + STILL_S
        try:
            if any(self._opened.sync_read(self._status)[::STATUS_SIZE]):
                self._end_torque()
            self._measure()
        except (OSError, RuntimeError):
            self._nothing()
            self._end_torque()
            return False
        return True

    def _recover(self) -> None:
        with self._connecting:
            try:
                self._is_waiting = False
                self._go_on()
                if self.fault_kind in {FaultKind.UNPLUGGED, FaultKind.NOT_READY}:
                    # The port may no longer exist.
                    self._disconnect(quiet=True)
                self._connect(restart=True)
            except Exception as error:  # whatever the error, the arm stays without torque and reports it
                self._end_torque()
                self._recovered = error

    def _restart(self) -> None:
        """Reboot servos with a hardware error, and wait until they answer."""
        if self._bus is None:
            return
        restarted = []
        failed = self.grip is not None and self.grip.fault is not None
        for servo_id in (*self._members, *self._grip_ids[len(self._position_ids) :]) if failed else self._members:
            with contextlib.suppress(OSError, RuntimeError):
                if self._bus.read(servo_id, HARDWARE_STATUS, 1) != b"\0":
                    self._bus.reboot(servo_id)
                    restarted.append(servo_id)
        end_s = time.monotonic() + RESTART_S
        while restarted and time.monotonic() < end_s:
            self._go_on()
            with contextlib.suppress(OSError, RuntimeError):
                self._bus.ping(restarted[0])
                restarted.pop(0)

    # -------------------------------------------------------------------------------------------------------- end

    def _let_down(self) -> None:
        """Lower the arm: damp joints in mode 0 for a while; reduce current or supply of the others to 0."""
        begin_s = time.monotonic()
        release_s = self.settings.release_s
        self._ramp = min(self._ramp, 1.0)
        begun, damping = self._ramp, self.settings.release_damping * self._current_cap
        while self._fault is None and (passed_s := time.monotonic() - begin_s) < release_s:
            if self.read():
                self._ramp = 1.0
                if len(self._in_current):
                    self.write_currents(-damping * self.velocity[self._in_current])
                if len(self._in_position):
                    self._limit(begun * (1.0 - passed_s / release_s))
            time.sleep(0.002)

    def _disconnect(self, *, quiet: bool = False) -> None:
        """End all torque, verify it, and close the port."""
        if self._bus is None:
            return
        bus = self._bus
        try:
            self._end_torque()
            if self.grip is not None and self._held:
                self.grip.hold()
                self.send_grip()
            self.kept = tuple(one for one in self._members if one in self._held and not _is_off(bus, one))
        finally:
            bus.close()
            self._bus = None
            self._nothing()
        if self.kept and not quiet:
            names = ", ".join(map(str, self.kept))
            self._report(
                f"{self.name}: servo {names} may KEEP torque: it does not say that it is off. Its bus watchdog, where"
                f" it was armed, ends it after {20 * self.settings.watchdog_units} ms of silence; if it is stiff, cut"
                " its supply"
            )


def _is_off(bus: DynamixelBus, servo_id: int) -> bool:
    for _ in range(STOPS):
        try:
            bus.write(servo_id, TORQUE_ENABLE, b"\0")
            if bus.read(servo_id, TORQUE_ENABLE, 1) == b"\0":
                # Leave no armed watchdog for other software.
                bus.write(servo_id, BUS_WATCHDOG, b"\0")
                return True
        except TimeoutError:
            continue
        except (OSError, RuntimeError) as error:
            if isinstance(error, OSError) and error.errno in GONE:
                return False
    return False


def _awake_s() -> float:
    """Return the time in s, including system sleep."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def _to_stderr(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
