"""Emulated servo: its control table and the effects of writes."""

import struct
from enum import IntFlag
from typing import TYPE_CHECKING, Any, Final

from haptether.dynamixel.control_table import CENTRE, RAD_PER_TICK, RAD_S_PER_UNIT, TICKS_PER_TURN, Item
from haptether.dynamixel.emulator.joint import Drive, Joint, JointSettings
from haptether.dynamixel.emulator.protocol import ALERT, MAX_ID, ErrorNumber
from haptether.dynamixel.models import BAUD_RATES, OperatingMode, ServoModel

if TYPE_CHECKING:
    from collections.abc import Callable

FIRMWARE: Final = 52
"""Default firmware version: matches the 330 addresses and supports fast reads."""
REBOOT_S: Final = 0.2
"""Silent time in s of a starting servo; the maker states none."""
ROOM_C: Final = 30.0
GOALS: Final = ("Goal PWM", "Goal Current", "Goal Velocity", "Goal Position")
REVERSE: Final = 1
"""Drive mode bit."""
IN_POSITION, FOLLOWING = 0x01, 0x02
IN_POSITION_TICKS: Final = 20
FORMATS: Final = {(1, False): "B", (1, True): "b", (2, False): "H", (2, True): "h", (4, False): "I", (4, True): "i"}
"""Struct format of an entry by size and sign."""
MEASURED: Final = struct.Struct("<HBBhhiiiiHB")
"""Layout of addresses 120 to 146 of every model."""
SHOWN: Final = range(120, 147)


class HardwareError(IntFlag):
    """Hardware errors, address 70; those in the shutdown mask turn torque off."""

    INPUT_VOLTAGE = 1 << 0
    OVERHEATING = 1 << 2
    ENCODER = 1 << 3
    ELECTRICAL_SHOCK = 1 << 4
    OVERLOAD = 1 << 5


class Servo:
    """Servo as its client sees it; time is an argument.

    Args:
        model: Model of the servo.
        servo_id: Id of the servo.
        baud: Bus rate in bit/s, one of `BAUD_RATES`.
        firmware: Firmware version; fast reads from 45 or 46 on.
        position_rad: Initial angle, from the mechanical centre.
        joint: Load; by default one suited to the model.
        motors: Number of servos that turn the joint; this one answers for all.

    Raises:
        ValueError: Id, rate or version is invalid.
    """

    def __init__(
        self,
        model: ServoModel,
        servo_id: int,
        *,
        baud: int = BAUD_RATES[1],
        firmware: int = FIRMWARE,
        position_rad: float = 0.0,
        joint: JointSettings | None = None,
        motors: int = 1,
    ) -> None:
        rates = BAUD_RATES[: (model.table["Baud Rate"].maximum or 0) + 1]
        if not 0 <= servo_id <= MAX_ID:
            message = f"id {servo_id}: must be 0 to {MAX_ID}"
            raise ValueError(message)
        if baud not in rates:
            message = f"baud = {baud}: a {model.name} must have one of {', '.join(map(str, rates))}"
            raise ValueError(message)
        if not 0 <= firmware <= 255:
            message = f"firmware = {firmware}: must be 0 to 255"
            raise ValueError(message)
        self.model = model
        self.joint = Joint(model, JointSettings.of(model) if joint is None else joint, position_rad, motors)
        self.voltage_v = model.recommended.voltage_v
        self.temperature_c = ROOM_C
        self.silent = False
        """True to execute but not answer."""
        self.restarts = 0
        self._memory = bytearray(model.table.size)
        self._decoded = {
            item.name: (struct.Struct("<" + FORMATS[item.size, item.signed]).unpack_from, item.address)
            for item in model.table.items
        }
        self._offset_turns = 0
        self._current_unit_a = model.current_unit_a
        self._indirect = {
            item.address: item.name.replace("Data", "Address")
            for item in model.table.items
            if item.name.startswith("Indirect Data ")
        }
        self._indirect_from = min(self._indirect, default=len(self._memory))
        self._is_changed = True
        """True if the table changed since the cached values below."""
        self._driven: Drive | None = None
        self._watchdog_s = 0.0
        self._voltages = 0.0, 0.0
        self._hottest_c = 0.0
        self._moved_s = 0.0
        self._is_shown = False
        """True if the table holds the current measurements."""
        self._registered: tuple[int, bytes] | None = None
        self._silent_until_s = -float("inf")
        self._heard_s = 0.0
        self._effects: dict[str, Callable[[int], None]] = {
            "Torque Enable": self._switch_torque,
            "Operating Mode": lambda _value: self._reset_loops(),
        }
        for item in model.table.items:
            self._set(item, item.default)
        self._set_named("Model Number", model.number)
        self._set_named("Firmware Version", firmware)
        self._set_named("ID", servo_id)
        self._set_named("Baud Rate", BAUD_RATES.index(baud))
        self._start()

    # ------------------------------------------------------------------------------------------------ what it is

    @property
    def id(self) -> int:
        """Address 7."""
        return self.value("ID")

    @property
    def baud(self) -> int:
        """Bus rate in bit/s."""
        return BAUD_RATES[self.value("Baud Rate")]

    @property
    def return_delay_s(self) -> float:
        """Delay before an answer in s."""
        return self.value("Return Delay Time") * self.model.table["Return Delay Time"].scale

    @property
    def return_level(self) -> int:
        """Answered instructions: 0 pings, 1 pings and reads, 2 all."""
        return self.value("Status Return Level")

    @property
    def knows_fast_reads(self) -> bool:
        """True if the firmware supports fast reads."""
        return self.value("Firmware Version") >= self.model.fast_read_firmware

    @property
    def alert(self) -> int:
        """Bit of the error byte that signals a non-zero address 70."""
        return ALERT if self.value("Hardware Error Status") else 0

    @property
    def torque(self) -> bool:
        """True if torque is on."""
        return bool(self.value("Torque Enable"))

    @property
    def mode(self) -> OperatingMode:
        """Operating mode."""
        return OperatingMode(self.value("Operating Mode"))

    def is_listening(self, now_s: float) -> bool:
        """Return True if the servo has power and has started."""
        return now_s >= self._silent_until_s

    def value(self, name: str) -> int:
        """Return an entry of the table."""
        unpack, address = self._decoded[name]
        if not self._is_shown and address in SHOWN:
            self._show(self._moved_s)
        return int(unpack(self._memory, address)[0])

    def figures(self) -> dict[str, Any]:
        """Return the state for people and tests."""
        return {
            "id": self.id,
            "model": self.model.name,
            "torque": self.torque,
            "mode": self.mode.name.lower(),
            "position_rad": self.joint.position_rad,
            "velocity_rad_s": self.joint.velocity_rad_s,
            "current_a": self.joint.current_a,
            "torque_nm": self.joint.torque_nm,
            "load_nm": self.joint.load_nm,
            "hand_nm": self.joint.hand_nm,
            "stop_nm": self.joint.stop_nm,
            "hardware_error": [error.name.lower() for error in HardwareError(self.value("Hardware Error Status"))],  # type: ignore[union-attr]
            "bus_watchdog": self.value("Bus Watchdog"),
            "voltage_v": self.voltage_v,
            "temperature_c": self.temperature_c,
            "restarts": self.restarts,
            "silent": self.silent,
        }

    # ------------------------------------------------------------------------------------------------- over time

    def heard(self, now_s: float) -> None:
        """Restart the bus watchdog, because an instruction was on the bus."""
        self._heard_s = now_s

    def advance(self, now_s: float) -> None:
        """Advance to a time."""
        self.move(now_s)
        self._show(now_s)

    def move(self, now_s: float) -> None:
        """Advance to a time; the table is updated when it is read."""
        self._consult()
        allowed_s = self._watchdog_s
        if self._driven is not None and allowed_s > 0.0 and now_s - self._heard_s > allowed_s:
            self.joint.advance(self._heard_s + allowed_s, self._driven)
            self._set_named("Bus Watchdog", -1)
            self._stop()
        self._protect()
        self._consult()
        self.joint.advance(now_s, self._driven if now_s >= self._silent_until_s else None)
        self._moved_s, self._is_shown = now_s, False

    def fail(self, error: HardwareError) -> None:
        """Set a hardware error until the servo restarts."""
        self._set_named("Hardware Error Status", self.value("Hardware Error Status") | error)
        if error & self.value("Shutdown"):
            self._set_named("Torque Enable", 0)

    def reboot(self, now_s: float, silent_s: float = REBOOT_S) -> None:
        """Restart after a time without power; RAM entries get their defaults."""
        for item in self.model.table.items:
            if not item.is_eeprom:
                self._set(item, item.default)
        self.restarts += 1
        self._silent_until_s = now_s + silent_s
        self._heard_s = now_s
        self._registered = None
        self._start()

    def clear_turns(self) -> ErrorNumber:
        """Drop whole turns while standing."""
        if self.value("Moving"):
            return ErrorNumber.RESULT_FAIL
        self._wrap()
        return ErrorNumber.NONE

    def _start(self) -> None:
        self._wrap()
        self._reset_loops()

    def _protect(self) -> None:
        low, high = self._voltages
        if not low - 1e-9 <= self.voltage_v <= high + 1e-9:
            self.fail(HardwareError.INPUT_VOLTAGE)
        if self.temperature_c > self._hottest_c:
            self.fail(HardwareError.OVERHEATING)

    def _consult(self) -> None:
        """Update cached values from a changed table."""
        if self._is_changed:
            self._is_changed = False
            self._driven = self._drive()
            self._watchdog_s = self._scaled("Bus Watchdog")
            self._voltages = 0.1 * self.value("Min Voltage Limit"), 0.1 * self.value("Max Voltage Limit")
            self._hottest_c = self.value("Temperature Limit")

    def _drive(self) -> Drive | None:
        if not self.torque:
            return None
        mode, sign = self.mode, self._sign
        limit_a = float("inf")
        if self.model.has_current_control:
            limit_a = self.value("Current Limit") * self.model.table["Current Limit"].scale
        if mode == OperatingMode.CURRENT:
            return Drive(mode=mode, goal=sign * self._scaled("Goal Current"), limit_a=limit_a)
        if mode == OperatingMode.VELOCITY:
            return Drive(mode=mode, goal=sign * self._scaled("Goal Velocity"), limit_a=limit_a)
        if mode == OperatingMode.PWM:
            return Drive(mode=mode, goal=sign * self.value("Goal PWM") / 885.0, limit_a=limit_a)
        if mode == OperatingMode.CURRENT_BASED_POSITION:
            limit_a = min(limit_a, abs(self._scaled("Goal Current")))
        # 0 means unlimited speed.
        speed = self._scaled("Profile Velocity") or float("inf")
        return Drive(mode=mode, goal=self._goal_rad(), limit_a=limit_a, speed_rad_s=speed)

    def _stop(self) -> None:
        """Apply the bus watchdog: no current, no velocity, hold position."""
        for name in ("Goal PWM", "Goal Current", "Goal Velocity"):
            if name in self.model.table and self.mode != OperatingMode.CURRENT_BASED_POSITION:
                self._set_named(name, 0)
        self._set_named("Goal Position", self._ticks())
        self._set_named("Goal Velocity", 0)

    # ---------------------------------------------------------------------------------------------- the table

    def read(self, address: int, length: int) -> tuple[ErrorNumber, bytes]:
        """Read bytes from an address on; gaps between entries read as 0."""
        if length == 0:
            return ErrorNumber.DATA_LENGTH, b""
        if address + length > len(self._memory) or address not in self.model.table.by_address:
            return ErrorNumber.ACCESS, b""
        if not self._is_shown:
            self._show(self._moved_s)
        if address + length <= self._indirect_from:
            return ErrorNumber.NONE, bytes(self._memory[address : address + length])
        return ErrorNumber.NONE, bytes(self._memory[self._target(at)] for at in range(address, address + length))

    def write(self, address: int, written: bytes, now_s: float) -> ErrorNumber:
        """Write all bytes from an address on, or none and return the reason."""
        error, values = self._checked(address, written)
        if error == ErrorNumber.NONE:
            for item, value in values:
                self._apply(item, value, now_s)
            if any(item.name == "Torque Enable" and value and not self.torque for item, value in values):
                return ErrorNumber.RESULT_FAIL
        return error

    def register(self, address: int, written: bytes) -> ErrorNumber:
        """Store a write for `act`."""
        error, _ = self._checked(address, written)
        if error == ErrorNumber.NONE:
            self._registered = address, written
            self._set_named("Registered Instruction", 1)
        return error

    def act(self, now_s: float) -> ErrorNumber:
        """Execute the stored write."""
        if self._registered is None:
            return ErrorNumber.INSTRUCTION
        address, written = self._registered
        self._registered = None
        self._set_named("Registered Instruction", 0)
        return self.write(address, written, now_s)

    def _target(self, address: int) -> int:
        """Return the accessed byte of an address, resolving indirect data."""
        indirect = self._indirect.get(address)
        return address if indirect is None else self.value(indirect)

    def _checked(self, address: int, written: bytes) -> tuple[ErrorNumber, list[tuple[Item, int]]]:
        bytes_of: dict[int, int] = {}
        for offset, byte in enumerate(written):
            target = self._target(address + offset)
            if target not in self.model.table.by_address:
                return ErrorNumber.ACCESS, []
            bytes_of[target] = byte
        items = list(dict.fromkeys(self.model.table.by_address[target] for target in bytes_of))
        if not items:
            return ErrorNumber.DATA_LENGTH, []
        values = []
        for item in items:
            if not item.writable or (item.is_eeprom and self.torque):
                return ErrorNumber.ACCESS, []
            covered = [bytes_of.get(at) for at in range(item.address, item.address + item.size)]
            encoded = [byte for byte in covered if byte is not None]
            if len(encoded) < item.size:
                return ErrorNumber.DATA_LENGTH, []
            value = item.decoded(bytes(encoded))
            if (error := self._refusal(item, value)) != ErrorNumber.NONE:
                return error, []
            values.append((item, value))
        return ErrorNumber.NONE, values

    def _refusal(self, item: Item, value: int) -> ErrorNumber:
        latched = self.value("Bus Watchdog") < 0
        if latched and (item.name in GOALS or (item.name == "Bus Watchdog" and value != 0)):
            return ErrorNumber.DATA_RANGE
        if item.name == "Operating Mode" and value not in self.model.operating_modes:
            return ErrorNumber.DATA_RANGE
        if item.maximum is not None and not item.minimum <= value <= item.maximum:
            return ErrorNumber.DATA_RANGE
        low, high = item.minimum, value
        if item.limit is not None:
            low, high = -self.value(item.limit), self.value(item.limit)
        elif item.name == "Goal Position" and self.mode == OperatingMode.POSITION:
            low, high = self.value("Min Position Limit"), self.value("Max Position Limit")
        return ErrorNumber.NONE if low <= value <= high else ErrorNumber.DATA_LIMIT

    def _apply(self, item: Item, value: int, now_s: float) -> None:
        self._set(item, value)
        if item.name in {"Bus Watchdog", "Torque Enable"}:
            self._heard_s = now_s
        if (effect := self._effects.get(item.name)) is not None:
            effect(value)
            self._show(now_s)

    def _switch_torque(self, value: int) -> None:
        if value and self.value("Hardware Error Status") & self.value("Shutdown"):
            self._set_named("Torque Enable", 0)
            return
        if value:
            if self.mode == OperatingMode.POSITION:
                self._wrap()
            # Hold the position, whatever the previous goal.
            self._set_named("Goal Position", self._ticks())

    def _reset_loops(self) -> None:
        """Apply a mode change: default gains and profile, PWM and current goals at their limits."""
        table = self.model.table
        for item in table.items:
            if item.name.endswith("Gain") or item.name.startswith("Profile"):
                self._set(item, item.default)
        for name in ("Goal PWM", "Goal Current"):
            if name in table:
                self._set_named(name, self.value(table[name].limit or name))
        self._set_named("Goal Velocity", 0)
        if self.mode == OperatingMode.POSITION:
            self._wrap()
        self._set_named("Goal Position", self._ticks())

    # ------------------------------------------------------------------------------------------------- positions

    @property
    def _sign(self) -> float:
        return -1.0 if self.value("Drive Mode") & REVERSE else 1.0

    def _raw_ticks(self) -> int:
        return round(self._sign * self.joint.position_rad / RAD_PER_TICK) + CENTRE

    def _ticks(self) -> int:
        """Return Present Position with turns and homing offset."""
        return self._raw_ticks() + TICKS_PER_TURN * self._offset_turns + self.value("Homing Offset")

    def _wrap(self) -> None:
        """Drop whole turns, because the encoder covers one."""
        self._offset_turns = -(self._raw_ticks() // TICKS_PER_TURN)
        self._is_changed = True

    def _goal_rad(self) -> float:
        ticks = self.value("Goal Position") - self.value("Homing Offset") - TICKS_PER_TURN * self._offset_turns
        return self._sign * (ticks - CENTRE) * RAD_PER_TICK

    def _show(self, now_s: float) -> None:
        """Write the measurements, Realtime Tick to Present Temperature, into the table."""
        self._is_shown = True
        joint, sign = self.joint, self._sign
        velocity, position, goal = (
            round(sign * joint.velocity_rad_s / RAD_S_PER_UNIT), self._ticks(), self.value("Goal Position")
        )  # fmt: skip
        drawn = 1000.0 * joint.load if self._current_unit_a is None else joint.current_a / self._current_unit_a
        MEASURED.pack_into(
            self._memory,
            self.model.table["Realtime Tick"].address,
            int(1000.0 * now_s) % 32768,
            abs(velocity) > self.value("Moving Threshold"),
            IN_POSITION if abs(position - goal) <= IN_POSITION_TICKS else FOLLOWING,
            _word(885.0 * sign * joint.load),
            _word(sign * drawn),
            velocity,
            position,
            self.value("Goal Velocity"),
            goal,
            round(10.0 * self.voltage_v),
            round(min(max(self.temperature_c, 0.0), 255.0)),
        )

    def _scaled(self, name: str) -> float:
        return self.value(name) * self.model.table[name].scale

    def _set_named(self, name: str, value: int) -> None:
        self._set(self.model.table[name], value)

    def _set(self, item: Item, value: int) -> None:
        low = -(1 << (8 * item.size - 1)) if item.signed else 0
        high = (1 << (8 * item.size - item.signed)) - 1
        self._memory[item.address : item.address + item.size] = item.encoded(min(max(value, low), high))
        self._is_changed = True


def _word(value: float) -> int:
    return round(min(max(value, -32768.0), 32767.0))
