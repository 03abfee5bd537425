"""Servos as the joints of an arm: angles in, currents or angles out, and no torque where something is wrong."""

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
    ArmRefusedError,
    ServoRegisters,
    answer_all,
    answering_rate,
    check_place,
    check_port,
    check_present,
    check_servo,
    knows_fast_reads,
)
from haptether.dynamixel.arm.cycle import cycle_s
from haptether.dynamixel.arm.faults import ArmFaultError, FaultKind, hardware_error
from haptether.dynamixel.arm.grip import GripServo
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

Vector = NDArray[np.float64]

MEASURED: Final = np.dtype([("current", "<i2"), ("velocity", "<i4"), ("position", "<i4")])
"""From Present Current on; it is a load in servos without current control."""
ONE_MEASURED: Final = struct.Struct("<hii")
STOPS: Final = 3
"""So often a stop is sent: nobody answers it."""
FIRED: Final = 0xFF
"""Of the bus watchdog."""
GONE: Final = (
    errno.EIO, errno.ENODEV, errno.ENXIO, errno.EBADF, errno.ENOENT, errno.EPIPE, errno.ECONNRESET, errno.ECONNREFUSED,
)  # fmt: skip
"""What a port says that was unplugged."""
MOVED_RAD: Final = 0.2
"""At most so far a joint may move while its torque comes on with nothing commanded."""
STILL_S: Final = 0.1
"""Between two looks at an arm with a fault."""
RESTART_S: Final = 3.0
HELD_S: Final = 3.0
"""In which a person takes hold of an arm whose torque, another program's, is taken off."""
BEGUN_S: Final = 3.0
"""Longest after `open` that an arm is given torque: whoever started it is not known to be there any more."""
CLOSED_S: Final = 15.0
"""Longest that a step of an `open` or a recovery takes, of many silent servos."""


class ServoArm:
    """An arm of servos on one bus, for one thread; `stop` and `close` may come from any other, which `close` ends then.

    Measured values are in the order and in the frame of the joints: q = sign (p - offset) + 2 pi k, and a current is
    positive where its torque is. They are NaN until the first read, and after each that failed.

    Args:
        settings: Bus and servos.
        report: Takes each line of the checklist and of what happens; by default they go to standard error.
        grip: The servo of a gripper on the same bus: it is in the reads and writes of the joints, and keeps its torque
            whatever becomes of theirs.

    Raises:
        ValueError: The gripper has the id of a joint.
    """

    _roll_call: RollCall | None = None
    """Who answers of a bus that fell silent, while that is asked."""
    cycle_s: float | None = None
    """Least time in s of a read and a write of all servos, by their bytes; none before `open`."""
    _latency_s = 0.0
    """The latency timer of the adapter in s."""

    def __init__(
        self, settings: ArmSettings, report: Callable[[str], None] | None = None, grip: GripServo | None = None
    ) -> None:
        self.settings = settings
        self.grip = grip
        self._every = settings if grip is None else replace(settings, servos=(*settings.servos, grip.settings.servo))
        """The joints and the gripper."""
        self.name = f"dynamixel {settings.port}"
        servos = settings.servos
        count = len(servos)
        self.position: Vector = np.full(count, np.nan)
        """q in rad, shape (n,)."""
        self.velocity: Vector = np.full(count, np.nan)
        """In rad/s, shape (n,)."""
        self.current: Vector = np.full(count, np.nan)
        """In A, shape (n,); NaN of a servo without current control."""
        self.kept: tuple[int, ...] = ()
        """After `close`: ids of the servos whose torque is not known to be off."""
        self._report = report or _to_stderr
        self._ids = bytes(servo.servo_id for servo in servos)
        # With the shadows, which obey an id of those before them.
        self._members = self._ids + bytes(shadow.servo_id for shadow, _ in settings.shadows)
        sign = np.array([float(servo.sign) for servo in servos])
        self._position_scale = sign * RAD_PER_TICK
        # Of the first turn.
        self._shift = -sign * np.array([CENTRE * RAD_PER_TICK + servo.offset_rad for servo in servos])
        self._velocity_scale = sign * RAD_S_PER_UNIT
        units = np.array([servo.servo.current_unit_a or math.nan for servo in servos])
        self._current_scale = sign * units
        self._sort_by_mode(settings.servos)
        self._before, self._moved = np.empty(count), np.empty(count)
        self._bus: DynamixelBus | None = None
        self._read: SyncRead
        self._read_joints: SyncRead
        """Without the gripper, which has a fault."""
        self._status = SyncRead(TORQUE_ENABLE, STATUS_SIZE, list(self._members))
        self._watchdogs = SyncRead(BUS_WATCHDOG, 1, list(self._members))
        self._ramp = self._ramp_begin_s = self._heard_s = self._watch_at_s = self._watched_s = self._alive_s = 0.0
        self._fault: ArmFaultError | None = None
        self._stopped: ArmFaultError | None = None
        """By `stop`, since the last `open` or acknowledgement: what gives torque ends."""
        self._unsent: str | None = None
        """Why the last stop could not be sent."""
        self._recovery: threading.Thread | None = None
        self._recovered: BaseException | None = None
        self._ending = self._is_waiting = False
        """Whether it is being closed; whether it was opened, and is still to be given torque."""
        self._ends = 0
        """Stops and closes so far: one that comes while an `open` waits counts for it."""
        self._ticking: int | None = None
        """The thread that reads; another that closes does so without it."""
        self._held: frozenset[int] = frozenset()
        """Servos whose torque is this arm's to end: those of before were announced."""
        self._connecting, self._faulting = threading.Lock(), threading.Lock()
        """Held by whoever opens or recovers, during which `close` may come from another thread; and, for a moment, by
        whoever stops, closes or acknowledges."""

    def _sort_by_mode(self, servos: Sequence[ServoSettings]) -> None:
        """Who takes currents and who goals, and their caps, limits and units."""
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
        """Goes through the checklist; then the servos have torque with nothing commanded, and their caps rise from 0.

        Args:
            give_torque: False leaves them without it once all is checked, until `begin`: what takes its time before the
                first `read` would else meet watchdogs that have fired.

        Raises:
            ArmRefusedError: What is wrong, all of it, each with what to do.
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
        """Before the first `read` of an arm that was opened without torque: gives it; nothing to any other.

        Raises:
            ArmRefusedError: What is wrong; or it was opened more than 3 s ago.
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
                # What is in order was reported at the open.
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
        """No torque, verified, and no watchdog that would fire."""
        self._end_torque()
        kept = [str(one) for one in self._members if not _is_off(self._opened, one)]
        if kept:
            message = f"{self.name}: servo {', '.join(kept)} does not say that its torque is off: see its cable"
            raise ArmRefusedError(message)

    def close(self) -> None:
        """Lets the arm down where its modes allow it, ends all torque, and names each servo that keeps it.

        May be called again, and after any exception. An `open` or a recovery in progress is stopped first, then waited
        for. From another thread than the one that reads, torque ends at once: that one may hang, and go on any time.

        Raises:
            RuntimeError: That does not end.
        """
        with self._faulting:
            self._ending = True
            self._ends += 1
            others = {thread.ident for thread in threading.enumerate()} - {threading.get_ident()}
            if self._ticking in others and self._fault is None:
                # Whoever reads meanwhile commands nothing more.
                self._fault = ArmFaultError(FaultKind.NOT_READY, "closed by another thread")
        if not self._connecting.acquire(blocking=False):
            # It may be giving torque.
            self._end_torque()
            if not self._connecting.acquire(timeout=CLOSED_S):
                self._refuse_to_end()
        self._connecting.release()
        if (recovery := self._recovery) is not None:
            # One that has not begun yet must not begin in the next life of this arm.
            recovery.join(CLOSED_S)
            if recovery.is_alive():
                self._refuse_to_end()
        self._recovery = None
        if self._bus is None:
            return
        try:
            if self._fault is None:
                self._let_down()
        finally:
            self._disconnect()

    def _refuse_to_end(self) -> NoReturn:
        """What opens or recovers does not end: its torque does."""
        self._end_torque()
        message = f"{self.name}: the bus does not let go of its port: its servos may KEEP torque, cut their supply"
        # Here as well: who closes after an error may not look at another.
        self._report(message)
        raise RuntimeError(message)

    # -------------------------------------------------------------------------------------------------- every tick

    @property
    def fault(self) -> str | None:
        """What is wrong; the arm has no torque while there is something."""
        return None if self._fault is None else str(self._fault)

    @property
    def fault_kind(self) -> FaultKind | None:
        """Its name."""
        return None if self._fault is None else self._fault.kind

    @property
    def ramp(self) -> float:
        """Share of the caps that is in force, 0 to 1."""
        return self._ramp

    def read(self) -> bool:
        """Measures; whether the values are those of now. It never raises for what an arm can do: see `fault`."""
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
        np.subtract(self.position, self._before, out=self._moved)
        np.abs(self._moved, out=self._moved)
        if self._moved.max() > math.pi:
            index = int(self._moved.argmax())
            text = f"servo {self._ids[index]} went {self._moved[index]:.2f} rad between two reads: see its supply"
            self._nothing()
            self._latch(ArmFaultError(FaultKind.JUMP, text))
            return False
        np.copyto(self._before, self.position)
        if read.alerts:
            self._look_at_alert(read.alerts[0])
        if self._fault is None and (now_s > self._watch_at_s or now_s - self._heard_s > 0.5 * self.settings.watchdog_s):
            self._watch(now_s)
        elif self.grip is not None and self._fault is None:
            self._look_at_grip(self.grip, now_s)
        self._heard_s = now_s
        return self._fault is None

    def write_currents(self, currents_a: Sequence[float] | Vector) -> None:
        """Currents in A of the servos in mode 0, in their order, positive in the direction of q; kept within the caps.

        Nothing is sent while there is a fault; a number that is none is one.
        """
        if self._fault is not None:
            return
        wanted = self._wanted_a
        self._check_count("currents", currents_a, wanted)
        wanted[:] = currents_a
        if not math.isfinite(wanted.sum()):
            self._latch(ArmFaultError(FaultKind.NOT_FINITE, "a current was commanded that is no number"))
            return
        if self._ramp < 1.0:
            self._rise(time.monotonic())
        np.minimum(wanted, self._current_cap, out=wanted)
        np.maximum(wanted, -self._current_cap, out=wanted)
        wanted *= self._units_per_a
        wanted *= self._ramp
        # Toward zero: the cap is not rounded up.
        self._send(GOAL_CURRENT, 2, self._current_ids, wanted.astype("<i2").tobytes())

    def write_positions(self, positions_rad: Sequence[float] | Vector) -> None:
        """Goals q in rad of the servos in modes 4 and 5, in their order; kept within the limits of the joints.

        Nothing is sent while there is a fault; a number that is none is one.
        """
        if self._fault is not None:
            return
        wanted = self._wanted_rad
        self._check_count("angles", positions_rad, wanted)
        wanted[:] = positions_rad
        if not math.isfinite(wanted.sum()):
            self._latch(ArmFaultError(FaultKind.NOT_FINITE, "an angle was commanded that is no number"))
            return
        if self._ramp < 1.0:
            self._rise(time.monotonic())
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
        """Sends the gripper its goal in a write of its own, where it does not have it; with a fault of the arm, too."""
        if self.grip is None or self._bus is None or self._recovery is not None:
            return
        # What is lost is sent again.
        with contextlib.suppress(OSError, RuntimeError):
            self.grip.send(self._bus)

    def _check_count(self, what: str, given: Sequence[float] | Vector, wanted: Vector) -> None:
        if len(given) != len(wanted):
            message = f"{self.name}: {len(given)} {what}: must be {len(wanted)}, one of each servo that takes them"
            raise ValueError(message)

    def stop(self, kind: FaultKind, text: str) -> None:
        """Ends all torque for a reason of the driver's: a fault like the others.

        From any thread, at any time: it is sent before what other threads have the bus do, and an `open` or a recovery
        in progress fails.
        """
        error = ArmFaultError(kind, text)
        with self._faulting:
            self._stopped = error
            self._ends += 1
            # The newest is the one that is shown: an acknowledgement of the one before does not count for it.
            is_first, self._fault = self._fault is None, error
        if is_first:
            self._latch(error)
        else:
            self._end_torque()
            self._report(f"{self.name}: fault: {error}")

    # ------------------------------------------------------------------------------------------------ after a fault

    @property
    def recovering(self) -> bool:
        """Whether an acknowledged fault is being mended."""
        return self._recovery is not None

    def acknowledge(self, shown: str | None) -> None:
        """A person has seen to the fault: the checklist runs again, on a thread of its own, until `fault` is none.

        Servos with a hardware error are started anew.

        Args:
            shown: The `fault` that the person saw; where there is another by now, nothing happens.
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
            # Closed by another thread in the middle of a tick, or never opened.
            raise RuntimeError(message) if self._fault is not None else ValueError(message)
        return bus

    def _go_on(self) -> None:
        """Ends an `open` or a recovery whose arm is being closed or stopped, or whose process stood still meanwhile."""
        before_s, self._alive_s = self._alive_s, _awake_s()
        # What lies between two calls is silent servos and the trial of the watchdogs at most.
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
        """Goes through the checklist; with `restart` those servos start anew first that have a hardware error."""
        self._go_on()
        checklist = Checklist(self.name, self._report, ArmRefusedError)
        settings = self.settings
        self._latency_s = check_port(settings.port, checklist)
        checklist.finish()
        if self._bus is None:
            try:
                self._bus = DynamixelBus(settings.port, baud=settings.baud, timeout_s=settings.timeout_s)
            except OSError as error:
                checklist.refuse("port", str(error), "end what else has it, and see that the adapter knows this rate")
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
            # What fails because of a stop or a close says so.
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
            # One that does not answer reads is reported below.
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
        """Says which servos have torque before it is taken off them, and leaves time to hold what they bear."""
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
        """Whether it says so; one that does not is taken to have some."""
        for _ in range(STOPS):
            with contextlib.suppress(TimeoutError, RuntimeError):
                return self._opened.read(servo_id, TORQUE_ENABLE, 1) == b"\0"
        return False

    def _place(self, checklist: Checklist) -> None:
        """Finds the turn of each servo, and whether the joints are within their limits."""
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
            # Another turn may fit better than the nearest to the middle.
            options = (q - TURN, q, q + TURN)
            best = min(options, key=lambda one: max(servo.low_rad - one, one - servo.high_rad))
            self._shift[index] += best - q
            self.position[index] = best
            check_place(servo, best, checklist)

    def _turn_towards(self, near: Vector) -> None:
        turns = TURN * np.round((near - self.position) / TURN)
        self._shift += turns
        self.position += turns
        self._before[:] = self.position
        self._goal_shift = self._shift[self._in_position]

    def _torque_on(self, checklist: Checklist, *, verify: bool = True) -> None:
        bus, ids, units = self._opened, self._members, self.settings.watchdog_units
        self._arm_watchdogs(checklist)
        servos = (*self.settings.servos, *(shadow for shadow, _ in self.settings.shadows))
        for servo_id, servo in zip(ids, servos, strict=True):
            # A change of the mode has set them to their limits.
            address = GOAL_CURRENT if servo.limits_current else GOAL_PWM
            bus.write(servo_id, address, b"\0\0")
            if bus.read(servo_id, address, 2) != b"\0\0":
                checklist.refuse(f"servo {servo_id}", "its goal is not 0", "it does not take it: see its firmware")
        checklist.finish()
        before = self.position.copy()
        for servo_id in ids:
            self._go_on()
            bus.write(servo_id, TORQUE_ENABLE, b"\1")
        # A stop between the look before and the write went out before the torque.
        self._go_on()
        self._take(bus.sync_read(self._read_joints))
        # Torque may count the angle anew, by whole turns.
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
        # It keeps its torque, whether that of the arm waits or not.
        if self.grip is not None and verify:
            self.grip.begin(bus)
        self._ramp = 0.0
        self._ramp_begin_s = self._heard_s = time.monotonic()
        self._watched_s = self._heard_s
        self._watch_at_s = self._heard_s + self.settings.watch_s

    def _arm_watchdogs(self, checklist: Checklist, tried: bytes | None = None) -> None:
        bus, units = self._opened, self.settings.watchdog_units
        for index, servo_id in enumerate(self._members):
            # Only 0 is taken by one that has fired.
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
        """Goals where the joints are, which the servos confirm."""
        goals = self._goal_ticks(self.position[self._in_position])
        for at, servo_id in enumerate(self._position_ids):
            self._opened.write(servo_id, GOAL_POSITION, goals[4 * at : 4 * at + 4])

    # ------------------------------------------------------------------------------------------------- every tick

    def _measure(self) -> SyncRead:
        """Takes what all servos measure; of a gripper with a fault nothing is asked."""
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
        """Of servos that hold positions: the share of their current, or of their supply, that they may take."""
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
        """An exchange that failed: a fault where none succeeded for too long."""
        if self._fault is not None:
            # A stop of another thread cut it off.
            return
        if isinstance(error, OSError) and error.errno in GONE:
            self._latch(ArmFaultError(FaultKind.UNPLUGGED, f"{error}: plug the adapter in, then acknowledge"))
        elif now_s - (self._heard_s if since_s is None else since_s) > self.settings.lost_after_s and (
            since_s is not None or not self._misses_grip_alone()
        ):
            self._lose(error)

    def _misses_grip_alone(self) -> bool:
        """Whether the joints answer and the gripper does not, which is a fault of the gripper."""
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
        """Nothing was heard for too long: torque ends at once, and the reads that follow find who does not answer."""
        silent = isinstance(error, TimeoutError)
        kind = FaultKind.SILENT if silent else FaultKind.UNREADABLE
        seen = "supply and cables" if silent else "cables and rate"
        lost = ArmFaultError(kind, f"{error}: see {seen}, then acknowledge")
        self._latch(lost)
        with self._faulting:
            if self._fault is lost:
                self._roll_call = RollCall(lost, self._members)

    def _ask_next(self, roll_call: RollCall) -> bool:
        """With a bus that fell silent: asks one servo; names those that do not answer once all were asked."""
        found = roll_call.ask(self._opened)
        with self._faulting:
            if roll_call.is_over and self._roll_call is roll_call:
                self._roll_call = None
            if found is None or self._fault is not roll_call.lost:
                return False
            self._fault = found
        self._report(f"{self.name}: fault: {found}")
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
        """Whether each servo has torque, and its watchdog has not fired."""
        self._watch_at_s = now_s + self.settings.watch_s
        try:
            watchdogs = self._opened.sync_read(self._watchdogs)
            torque = self._opened.sync_read(self._status)[::STATUS_SIZE]
        except (OSError, RuntimeError) as error:
            # What is measured may come all the same: it does not say that the torque is on.
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
                # What a servo forgets when it starts anew.
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
        # Other threads send nothing more.
        self._fault = error
        # Then the arm: whoever reads the report may be slow.
        self._end_torque()
        self._ramp = 0.0
        self._watch_at_s = 0.0
        self._report(f"{self.name}: fault: {error}")

    def _end_torque(self) -> None:
        """Zero currents and no torque, each sent several times, before what other threads have the bus do.

        Why it could not be sent is reported, the first time of several in a row.
        """
        bus = self._bus
        if bus is None:
            return
        unsent = None
        for address, size, ids in ((GOAL_CURRENT, 2, self._current_ids), (TORQUE_ENABLE, 1, self._members)):
            try:
                # Of one that was not announced yet the torque may bear a load for another program.
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
        """With a fault: looks from time to time, and sends the stop again until all are known to be without torque."""
        if self._recovery is not None:
            if self._recovery.is_alive():
                return False
            self._recovery = None
            if self._recovered is None:
                self._fault = None
                # In this order: a stop of another thread either sees that there is no fault, or is seen here.
                if (stopped := self._stopped) is not None:
                    self._latch(stopped)
                    return False
                self._report(f"{self.name}: ready: acknowledge once more, so that the two sides may engage")
                return self.read()
            text = " ".join(str(self._recovered).split())
            self._fault = ArmFaultError(FaultKind.NOT_READY, text)
            self._report(f"{self.name}: fault: {self._fault}")
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
                    # Its port may be one that is gone.
                    self._disconnect(quiet=True)
                self._connect(restart=True)
            except Exception as error:  # whatever it is, the arm stays without torque and says it
                self._end_torque()
                self._recovered = error

    def _restart(self) -> None:
        """Starts servos anew that have a hardware error, and waits until they answer."""
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
        """Joints in mode 0 are damped for a while; of the others current or supply falls to 0."""
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
        """Ends all torque, verifies it, and closes the port."""
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
                # Other software shall find none armed.
                bus.write(servo_id, BUS_WATCHDOG, b"\0")
                return True
        except TimeoutError:
            continue
        except (OSError, RuntimeError) as error:
            if isinstance(error, OSError) and error.errno in GONE:
                return False
    return False


def _awake_s() -> float:
    """Time in s that a machine's sleep counts for, too."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def _to_stderr(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
