"""Checks before a servo arm gets torque: one line each, with a remedy."""

import contextlib
import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import Final

from haptether._core import DynamixelBus
from haptether.checklist import Checklist, RefusedError
from haptether.dynamixel.arm.faults import HARDWARE_ERRORS
from haptether.dynamixel.arm.settings import MAX_ID, ArmSettings, ServoSettings
from haptether.dynamixel.control_table import STATUS_RETURN_LEVEL
from haptether.dynamixel.models import BAUD_RATES, SERVO_MODELS_BY_NUMBER

LATENCY_MS: Final = 1
TRIES: Final = 3
"""Number of pings before a servo counts as silent."""
MARGIN_C: Final = 5
"""Margin in degrees C below the temperature limit at the start."""
PROTECTS: Final = 1 << 2 | 1 << 5
"""Shutdown mask bits for overheating and overload."""
TORQUE_BY_GOAL: Final = 1 << 3
"""Drive mode bit."""
TORQUE_AT_START: Final = 1 << 0
"""Startup configuration bit; newer firmware only."""
UNKNOWN_ADDRESS: Final = "access error"
"""Error text of a servo without the address."""
ANSWERS_ALL: Final = 2
"""Status return level that answers every instruction."""
BESIDE_RAD: Final = 0.1
"""Largest angle in rad beyond its limits for a joint at the start."""
PROFILES: Final = ("Profile Acceleration", "Profile Velocity")
"""0 is no profile; a profile of another program would lag behind the driver's goals."""
SYSTEM: Final = Path("/sys")
NO_PORT: Final = (errno.ENOTTY, errno.EISDIR)
"""Error numbers of a file, folder or device that is no serial port."""


class ArmRefusedError(RefusedError):
    """The arm must not get torque now."""


def check_port(port: str, checklist: Checklist, system: Path = SYSTEM) -> float:
    """Check that the port exists, is accessible and forwards answers at once; return its latency timer in s.

    Args:
        port: Path of the port.
        checklist: Takes the lines.
        system: Mount point of sysfs.
    """
    path = Path(port)
    if not path.exists():
        checklist.refuse("port", "is not there", "plug the adapter in; /dev/serial/by-id names those that are")
        return 0.0
    if not os.access(path, os.R_OK | os.W_OK):
        checklist.refuse(
            "port", "may not be read and written", "add yourself to the group of the device (dialout), and log in anew"
        )
        return 0.0
    checklist.ok("port", "may be read and written")
    timer = system / "class/tty" / path.resolve().name / "device/latency_timer"
    if not timer.exists():
        checklist.ok("latency timer", "not checked: this port has none")
        return 0.0
    found_ms = int(timer.read_text())
    checklist.check(
        "latency timer", f"{found_ms} ms", good=found_ms <= LATENCY_MS,
        remedy=f"echo {LATENCY_MS} | sudo tee {timer}, or the udev rule of docs/dynamixel.md",
    )  # fmt: skip
    return found_ms * 1e-3


def opened_bus(port: str, baud: int, timeout_s: float) -> DynamixelBus:
    """Open a bus.

    Raises:
        OSError: The path is no serial port, or the port cannot be opened at this rate.
    """
    try:
        return DynamixelBus(port, baud=baud, timeout_s=timeout_s)
    except OSError as error:
        if error.errno in NO_PORT:
            raise OSError(error.errno, "is no serial port", port) from None
        raise


def answering_rate(settings: ArmSettings, go_on: Callable[[], None]) -> int | None:
    """Return another rate at which a servo answers, or None; `go_on` is called before each attempt and may raise."""
    for baud in BAUD_RATES:
        if baud == settings.baud:
            continue
        bus = None
        try:
            bus = DynamixelBus(settings.port, baud=baud, timeout_s=settings.timeout_s)
            for servo in settings.servos:
                go_on()
                with contextlib.suppress(TimeoutError, RuntimeError):
                    bus.ping(servo.servo_id)
                    return baud
        except (OSError, ValueError):
            continue
        finally:
            if bus is not None:
                bus.close()
    return None


def check_present(
    bus: DynamixelBus, settings: ArmSettings, checklist: Checklist, go_on: Callable[[], None]
) -> tuple[set[int], dict[int, int]]:
    """Check that the named servos are present; return ids that answer, and firmware of each valid servo.

    `go_on` is called before each servo, and may raise.

    Raises:
        OSError: The port is gone.
    """
    answered, found = set(), {}
    for servo in (*settings.servos, *(shadow for shadow, _ in settings.shadows)):
        what = f"servo {servo.servo_id}"
        try:
            (number, firmware), tries = _pinged(bus, servo.servo_id, go_on)
        except TimeoutError:
            checklist.refuse(
                what, f"does not answer at {settings.baud} bit/s",
                "see its power and cable; haptether dynamixel find shows which ids answer, and at which rate",
            )  # fmt: skip
            continue
        except RuntimeError as error:
            checklist.refuse(what, str(error), "see cables and terminations, and that no two servos have one id")
            continue
        answered.add(servo.servo_id)
        model = SERVO_MODELS_BY_NUMBER.get(number)
        name = f"model {number}" if model is None else model.name
        late = f", answered at try {tries}" if tries > 1 else ""
        checklist.check(
            what, f"{name}, firmware {firmware}{late}", good=number == servo.servo.number,
            remedy=f"the options have a {servo.model} there: mend them, or the id",
        )  # fmt: skip
        if number == servo.servo.number:
            found[servo.servo_id] = firmware
    return answered, found


def _pinged(bus: DynamixelBus, servo_id: int, go_on: Callable[[], None]) -> tuple[tuple[int, int], int]:
    """Return model number and firmware, and the number of the successful try; one lost or late answer is retried.

    Raises:
        TimeoutError: No ping was answered.
        RuntimeError: The last answer was invalid.
        OSError: The port is gone.
    """
    for number in range(1, TRIES):
        go_on()
        with contextlib.suppress(TimeoutError, RuntimeError):
            return bus.ping(servo_id), number
    go_on()
    return bus.ping(servo_id), TRIES


def knows_fast_reads(settings: ArmSettings, firmware: dict[int, int]) -> bool:
    """Return True if all servos support fast sync read."""
    servos = (*settings.servos, *(shadow for shadow, _ in settings.shadows))
    return all(firmware[one.servo_id] >= one.servo.fast_read_firmware for one in servos)


def answer_all(bus: DynamixelBus, servo_id: int) -> int:
    """Make a servo answer all instructions; return its previous status return level, in RAM.

    At level 0 it answers no read, and at 0 and 1 no write, so the level is set by an unacknowledged write.

    Raises:
        TimeoutError: It still does not answer reads.
        OSError: The port is gone.
        RuntimeError: Its answer is invalid, or it does not accept the level.
    """
    level = 0
    for _ in range(TRIES):
        with contextlib.suppress(TimeoutError):
            level = bus.read(servo_id, STATUS_RETURN_LEVEL, 1)[0]
            break
    if level != ANSWERS_ALL:
        bus.sync_write(STATUS_RETURN_LEVEL, 1, bytes((servo_id,)), bytes((ANSWERS_ALL,)))
        if bus.read(servo_id, STATUS_RETURN_LEVEL, 1)[0] != ANSWERS_ALL:
            message = f"servo {servo_id}: status return level {level}: it does not take {ANSWERS_ALL}: see its firmware"
            raise RuntimeError(message)
    return level


class ServoRegisters:
    """Control table of one servo by name, each entry as an integer.

    Args:
        bus: Bus of the servo.
        servo: Settings of the servo.
    """

    def __init__(self, bus: DynamixelBus, servo: ServoSettings) -> None:
        self._bus = bus
        self._servo_id = servo.servo_id
        self._table = servo.servo.table

    def __getitem__(self, name: str) -> int:
        item = self._table[name]
        return item.decoded(self._bus.read(self._servo_id, item.address, item.size))

    def __setitem__(self, name: str, value: int) -> None:
        item = self._table[name]
        self._bus.write(self._servo_id, item.address, item.encoded(value))

    def scaled(self, name: str) -> float:
        """Return an entry in its unit."""
        return self[name] * self._table[name].scale


class _ServoLine:
    """Findings at one servo: one line for valid items, one for each problem."""

    def __init__(self, servo: ServoSettings, checklist: Checklist, what: str | None = None) -> None:
        self.what = what or f"servo {servo.servo_id}"
        self._checklist = checklist
        self._good: list[str] = []

    def check(self, found: str, *, good: bool = True, remedy: str = "") -> None:
        if good:
            self._good.append(found)
        else:
            self._checklist.refuse(self.what, found, remedy)

    def finish(self) -> None:
        self._checklist.ok(self.what, ", ".join(self._good))


def check_servo(bus: DynamixelBus, servo: ServoSettings, checklist: Checklist, obeys: int | None = None) -> None:
    """Turn off a servo's torque, set mode, profile and return delay, and check its state.

    Args:
        bus: Bus of the servo.
        servo: Settings of the servo.
        checklist: Takes the lines.
        obeys: For a shadow, the id that it obeys in addition to its own.

    Raises:
        OSError: The servo does not answer, or the port is gone.
        RuntimeError: The servo refuses, or its answer is invalid.
    """
    line = _ServoLine(servo, checklist)
    registers = ServoRegisters(bus, servo)
    # An unacknowledged write may be lost.
    if (level := answer_all(bus, servo.servo_id)) != ANSWERS_ALL:
        line.check(f"status return level was {level}, and is {ANSWERS_ALL} now")
    if registers["Torque Enable"]:
        registers["Torque Enable"] = 0
        line.check("had torque, and has none now")
    _check_secondary_id(registers, servo, line, obeys)
    _check_health(registers, servo, line)
    if delay := registers["Return Delay Time"]:
        registers["Return Delay Time"] = 0
        line.check(f"return delay was {2 * delay} us, and is 0 now")
    if registers["Operating Mode"] != servo.mode:
        registers["Operating Mode"] = servo.mode
    line.check(
        f"operating mode {servo.mode.value}", good=registers["Operating Mode"] == servo.mode,
        remedy="it does not take it: see its firmware",
    )  # fmt: skip
    _end_profile(registers, line)
    drive_mode = registers["Drive Mode"]
    line.check(
        f"drive mode {drive_mode}", good=not drive_mode & TORQUE_BY_GOAL,
        remedy="a goal must not switch torque on: clear bit 3 of address 10",
    )  # fmt: skip
    if (startup := _startup(registers)) is not None:
        line.check(
            f"startup configuration {startup}", good=not startup & TORQUE_AT_START,
            remedy="it must not start with torque: clear bit 0 of address 60",
        )  # fmt: skip
    _check_shutdown(registers, line)
    if servo.servo.has_current_control:
        limit_a = registers.scaled("Current Limit")
        line.check(
            f"cap {servo.current_cap_a:.3f} A of {limit_a:.3f} A", good=servo.current_cap_a <= limit_a + 1e-9,
            remedy="lower cap_a, or raise address 38",
        )  # fmt: skip
    offset = registers["Homing Offset"]
    if offset or drive_mode & 1:
        # Present Position includes both, so a change requires a new calibration.
        line.check(
            f"homing offset {offset} ticks{', reversed' if drive_mode & 1 else ''} (offset_rad counts from there)"
        )
    line.finish()


def check_servo_health(registers: ServoRegisters, servo: ServoSettings, checklist: Checklist, what: str) -> None:
    """Check hardware error, supply, temperature and shutdown of a servo without changing its torque.

    Raises:
        OSError: The servo does not answer, or the port is gone.
        RuntimeError: The servo refuses, or its answer is invalid.
    """
    line = _ServoLine(servo, checklist, what)
    _check_health(registers, servo, line)
    _check_shutdown(registers, line)
    line.finish()


def _startup(registers: ServoRegisters) -> int | None:
    """Return Startup Configuration, or None if the firmware lacks it.

    Raises:
        OSError: The servo does not answer, or the port is gone.
        RuntimeError: Its answer is invalid.
    """
    try:
        return registers["Startup Configuration"]
    except RuntimeError as error:
        if UNKNOWN_ADDRESS not in str(error):
            raise
        return None


def _end_profile(registers: ServoRegisters, line: _ServoLine) -> None:
    for name in PROFILES:
        if before := registers[name]:
            registers[name] = 0
            after = registers[name]
            now = f"was {before}, and is 0 now" if after == 0 else f"is {after}"
            line.check(f"{name.lower()} {now}", good=after == 0, remedy="it does not take 0: see its firmware")


def _check_shutdown(registers: ServoRegisters, line: _ServoLine) -> None:
    shutdown = registers["Shutdown"]
    line.check(
        f"shutdown {shutdown}", good=shutdown & PROTECTS == PROTECTS,
        remedy=f"it must end its torque when overheated or overloaded: set address 63 to {shutdown | PROTECTS}",
    )  # fmt: skip


def _check_secondary_id(registers: ServoRegisters, servo: ServoSettings, line: _ServoLine, obeys: int | None) -> None:
    secondary = registers["Secondary(Shadow) ID"]
    if obeys is not None:
        turned = ", reversed" if registers["Drive Mode"] & 1 else ""
        line.check(
            f"obeys id {obeys}{turned}" if secondary == obeys else f"secondary id {secondary}", good=secondary == obeys,
            remedy=f"it turns the joint of servo {obeys}: set address 12 to {obeys}",
        )  # fmt: skip
    elif secondary <= MAX_ID and secondary != servo.servo_id:
        line.check(
            f"obeys id {secondary}, too", good=False,
            remedy="it would do what is meant for that one: set address 12 to 255, or name it as its shadow",
        )  # fmt: skip


def _check_health(registers: ServoRegisters, servo: ServoSettings, line: _ServoLine) -> None:
    status = registers["Hardware Error Status"]
    named = ", ".join(kind for bit, (kind, _) in HARDWARE_ERRORS.items() if status & (1 << bit)) or f"code {status}"
    line.check(
        f"hardware error: {named}" if status else "no hardware error", good=status == 0,
        remedy="mend its cause, then take its supply away and give it again",
    )  # fmt: skip
    volts, low, high = (
        registers.scaled(name) for name in ("Present Input Voltage", "Min Voltage Limit", "Max Voltage Limit")
    )
    line.check(
        f"supply {volts:.1f} V", good=low <= volts <= high,
        remedy=f"a {servo.model} must have {low:.1f} to {high:.1f} V",
    )  # fmt: skip
    degrees, limit = registers["Present Temperature"], registers["Temperature Limit"]
    line.check(f"{degrees} of {limit} degC", good=degrees <= limit - MARGIN_C, remedy="let it cool down")


def check_place(servo: ServoSettings, q: float, checklist: Checklist) -> None:
    """Check that a joint is within its limits."""
    beyond = max(servo.low_rad - q, q - servo.high_rad, 0.0)
    checklist.check(
        f"servo {servo.servo_id}", f"stands at {q:+.3f} rad of {servo.low_rad:+.3f} to {servo.high_rad:+.3f}",
        good=beyond <= BESIDE_RAD, remedy="move it within, or calibrate: haptether dynamixel calibrate",
    )  # fmt: skip
