"""Control line of the emulated bus: one-line commands with one-line answers."""

import json
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from haptether.control_line import CommandLine, numbers, refuse, whole
from haptether.dynamixel.emulator.joint import HeldBy
from haptether.dynamixel.emulator.servo import HardwareError
from haptether.input_file import read_text

if TYPE_CHECKING:
    from collections.abc import Callable

    from haptether.dynamixel.emulator.bus import Bus
    from haptether.dynamixel.emulator.joint import Joint
    from haptether.dynamixel.emulator.server import Server
    from haptether.dynamixel.emulator.servo import Servo

MAX_TORQUE_NM: Final = 1000.0
MAX_STIFFNESS: Final = 1e4
"""Largest stiffness and damping of a hand, in N m/rad and N m s/rad."""
MAX_STOP_RAD: Final = 1000.0
MAX_PATH_BYTES: Final = 1 << 22
MAX_LINE: Final = 1 << 12
"""Longest line of a path file that is read."""
MAX_DURATION_S: Final = 3600.0
SHOWN_LINES: Final = 20
"""Default number of log lines shown."""


class ControlLine(CommandLine):
    """Commands of an operator or a test to the emulator.

    Args:
        bus: Bus with the servos.
        process: Process of the bus, if any.
        made: Factory of the initial bus, for `reset`.
    """

    def __init__(self, bus: "Bus", process: "Server | None" = None, made: "Callable[[], Bus] | None" = None) -> None:
        self._bus = bus
        self._process = process
        self._made = made
        super().__init__(
            {
                "status": lambda _a, now_s: json.dumps(self.status(now_s)),
                "log": self._log,
                "reset": self._reset,
                "drop": self._fault("drop"),
                "corrupt": self._fault("corrupt"),
                "mute": self._fault("mute"),
                "silent": self._silent,
                "unplug": self._unplug,
                "plug": self._plug,
                "brown-out": self._brown_out,
                "hardware-error": self._hardware_error,
                "voltage": self._voltage,
                "temperature": self._temperature,
                "push": self._push,
                "place": self._place,
                "stops": self._stops,
                "hand": self._hand,
                "lead": self._lead,
            }
        )

    def status(self, now_s: float) -> dict[str, Any]:
        """Return state and figures."""
        self._bus.advance(now_s)
        return {**self._bus.figures(), **(self._process.figures() if self._process is not None else {})}

    def _log(self, arguments: list[str], _now_s: float) -> str:
        return json.dumps(list(self._bus.log)[-whole(arguments, SHOWN_LINES) :])

    def _reset(self, _arguments: list[str], _now_s: float) -> None:
        if self._made is None:
            refuse("the bus cannot be made a second time")
        else:
            self._bus = self._server.bus = self._made()

    def _fault(self, name: str) -> "Callable[[list[str], float], None]":
        def set_fault(arguments: list[str], _now_s: float) -> None:
            setattr(self._bus.faults, name, whole(arguments, 1, 0))

        return set_fault

    def _silent(self, arguments: list[str], _now_s: float) -> None:
        servo = self._servo(arguments)
        if arguments[1:] not in (["on"], ["off"]):
            refuse("must be an id, and on or off")
        servo.silent = arguments[1] == "on"

    def _unplug(self, _arguments: list[str], _now_s: float) -> None:
        self._server.unplug()

    def _plug(self, _arguments: list[str], _now_s: float) -> str:
        return self._server.plug()

    def _brown_out(self, arguments: list[str], now_s: float) -> None:
        (duration_s,) = numbers(arguments, 1)
        if not 0.0 <= duration_s <= MAX_DURATION_S:
            refuse(f"{duration_s:g}: must be 0 to {MAX_DURATION_S:g} s")
        self._bus.brown_out(duration_s, now_s)

    def _hardware_error(self, arguments: list[str], _now_s: float) -> None:
        servo = self._servo(arguments)
        names = {error.name.lower().replace("_", "-"): error for error in HardwareError if error.name}
        if len(arguments) != 2 or arguments[1] not in names:
            refuse(f"must be an id and one of {' '.join(names)}")
        servo.fail(names[arguments[1]])

    def _voltage(self, arguments: list[str], _now_s: float) -> None:
        (voltage_v,) = numbers(arguments[:1], 1)
        if not 0.0 <= voltage_v <= 100.0:
            refuse(f"{voltage_v:g}: must be 0 to 100 V")
        for servo in [self._servo(arguments[1:])] if arguments[1:] else self._bus.servos:
            servo.voltage_v = voltage_v

    def _temperature(self, arguments: list[str], _now_s: float) -> None:
        servo = self._servo(arguments)
        (temperature_c,) = numbers(arguments[1:], 1)
        if not 0.0 <= temperature_c <= 255.0:
            refuse(f"{temperature_c:g}: must be 0 to 255 degC")
        servo.temperature_c = temperature_c

    def _push(self, arguments: list[str], now_s: float) -> None:
        servo = self._servo(arguments)
        (torque_nm,) = numbers(arguments[1:], 1)
        if abs(torque_nm) > MAX_TORQUE_NM:
            refuse(f"{torque_nm:g}: must be at most {MAX_TORQUE_NM:g} N m")
        servo.advance(now_s)
        servo.joint.pushed_nm = torque_nm

    def _place(self, arguments: list[str], now_s: float) -> None:
        servo = self._servo(arguments)
        (position_rad,) = numbers(arguments[1:], 1)
        if abs(position_rad) > 1000.0:
            refuse(f"{position_rad:g}: must be at most 1000 rad")
        servo.advance(now_s)
        servo.joint.position_rad, servo.joint.velocity_rad_s = position_rad, 0.0
        servo.advance(now_s)

    def _stops(self, arguments: list[str], now_s: float) -> None:
        servo = self._servo(arguments)
        servo.advance(now_s)
        set_stops(servo.joint, arguments[1:])

    def _hand(self, arguments: list[str], now_s: float) -> None:
        if arguments == ["off"]:
            for servo in self._bus.servos:
                servo.joint.hand = None
            return
        servo = self._servo(arguments)
        self._bus.advance(now_s)
        if arguments[1:] == ["off"]:
            servo.joint.hand = None
            return
        given = [*arguments[1:], "0"] if len(arguments) == 4 else arguments[1:]
        goal_rad, stiffness, damping, duration_s = numbers(given, 4)
        if abs(goal_rad) > 1000.0:
            refuse(f"{goal_rad:g}: must be at most 1000 rad")
        if not (0.0 <= stiffness <= MAX_STIFFNESS and 0.0 <= damping <= MAX_STIFFNESS):
            refuse(f"{stiffness:g} {damping:g}: stiffness and damping must be 0 to {MAX_STIFFNESS:g}")
        if not 0.0 <= duration_s <= MAX_DURATION_S:
            refuse(f"{duration_s:g}: must be 0 to {MAX_DURATION_S:g} s")
        joint = servo.joint
        begun = joint.position_rad if joint.hand is None else joint.hand.place_rad(now_s)
        joint.hand = HeldBy(
            goal_rad=goal_rad, stiffness=stiffness, damping=damping,
            from_rad=begun, begin_s=now_s, duration_s=duration_s,
        )  # fmt: skip

    def _lead(self, arguments: list[str], now_s: float) -> None:
        if len(arguments) != 1:
            refuse("must be the path of a file")
        times, places = _path(Path(arguments[0]))
        hands = {}
        for servo_id in places:
            joint = self._bus.servo(servo_id).joint
            if joint.hand is None:
                refuse(f"no hand holds servo {servo_id}: must be held first, by `hand`")
            hands[servo_id] = joint
        self._bus.advance(now_s)
        for servo_id, joint in hands.items():
            assert joint.hand is not None
            joint.hand = HeldBy(
                goal_rad=places[servo_id][-1], stiffness=joint.hand.stiffness, damping=joint.hand.damping,
                begin_s=now_s, path=(times, places[servo_id]),
            )  # fmt: skip

    @property
    def _server(self) -> "Server":
        if self._process is None:
            message = "there is no port: the bus runs without a process"
            raise ValueError(message)
        return self._process

    def _servo(self, arguments: list[str]) -> "Servo":
        if not arguments or not arguments[0].isdecimal():
            refuse("the first must be the id of a servo")
        return self._bus.servo(int(arguments[0][:6]))


def set_stops(joint: "Joint", given: list[str]) -> None:
    """Set end stops: two angles in rad, in either order, then K in N m/rad (rigid) and D in N m s/rad (a ratio of 0.7).

    Raises:
        ValueError: The angles, the stiffness or the damping are invalid.
    """
    if given == ["off"]:
        joint.stops = None
        return
    low, high = sorted(numbers(given[:2], 2))
    if not (low < high and max(-low, high) <= MAX_STOP_RAD):
        refuse(f"{low:g} {high:g}: must be two angles within {MAX_STOP_RAD:g} rad")
    (stiffness,) = numbers(given[2:3], 1) if given[2:] else (joint.rigid,)
    (damping,) = numbers(given[3:], 1) if given[3:] else (None,)
    if not 0.0 < stiffness <= joint.rigid:
        refuse(f"{stiffness:g}: stiffness must be above 0 and at most {joint.rigid:g} N m/rad, that of a rigid stop")
    if damping is not None and not 0.0 <= damping <= MAX_STIFFNESS:
        refuse(f"{damping:g}: damping must be 0 to {MAX_STIFFNESS:g} N m s/rad")
    joint.stops, joint.stop_stiffness, joint.stop_damping = (low, high), stiffness, damping


def _path(path: Path) -> tuple[tuple[float, ...], dict[int, tuple[float, ...]]]:
    """Read times, relative to the first row, and angles of each servo from a CSV with the header `time_s,ID,...`."""
    try:
        text = read_text(path, MAX_PATH_BYTES)
    except ValueError as error:
        refuse(f"{path}: {error}")
    header, *lines = text.replace('"', "").splitlines() or [""]
    first, *ids = header.split(",")
    if first != "time_s" or not ids or not all(one.isdecimal() for one in ids):
        refuse(f"{path}: its header must be time_s and ids of servos")
    rows = []
    for number, line in enumerate(lines, start=2):
        try:
            rows.append(numbers(line[:MAX_LINE].split(","), 1 + len(ids)))
        except ValueError as error:
            refuse(f"{path}: line {number}: {error}")
    times = tuple(row[0] - rows[0][0] for row in rows)
    if not rows or any(later <= earlier for earlier, later in pairwise(times)):
        refuse(f"{path}: its times must increase")
    if any(abs(place) > 1000.0 for row in rows for place in row[1:]):
        refuse(f"{path}: its angles must be at most 1000 rad")
    return times, {int(one): tuple(row[1 + at] for row in rows) for at, one in enumerate(ids)}
