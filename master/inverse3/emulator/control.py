"""Control line of the emulated service: one-line commands with one-line answers."""

import json
import math
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Callable

    from haptether.master.inverse3.emulator.server import Server
    from haptether.master.inverse3.emulator.service import Service

from haptether.master.inverse3.emulator.service import DEVICE_ID

MAX_COUNT: Final = 1_000_000
GARBLED: Final = {
    "text": "no JSON",
    "nan": '{"inverse3":[{"device_id":"0E30","state":{"cursor_position":{"x":NaN,"y":0,"z":0}}}]}',
    "infinite": '{"inverse3":[{"device_id":"0E30","state":{"cursor_position":{"x":1e999,"y":0,"z":0},'
    '"cursor_velocity":{"x":0,"y":0,"z":0}},"status":{"calibrated":true,"in_use":false,"power_supply":true,'
    '"ready":true,"started":true}}]}',
    "statusless": '{"inverse3":[{"device_id":"0E30","state":{"cursor_position":{"x":0,"y":0,"z":0},'
    '"cursor_velocity":{"x":0,"y":0,"z":0}}}]}',
}
TRIPS: Final = {"stall": "stall_detected", "ceiling": "stability_ceiling", "overload": "fod_stage_changed"}


class ControlLine:
    """Commands of an operator or a test to the emulated service.

    Args:
        service: Emulated service.
        server: Server of the connections.
    """

    def __init__(self, service: "Service", server: "Server") -> None:
        self._service = service
        self._server = server
        self.quit = False
        """True if the process must end."""
        self._commands: dict[str, Callable[[list[str]], str | None]] = {
            "help": lambda _: " ".join(sorted(self._commands)),
            "status": lambda _: json.dumps(self.figures()),
            "log": lambda _: json.dumps(list(service.log)),
            "quit": self._quit,
            "hand": self._hand,
            "release": self._release,
            "turn": self._turn,
            "buttons": self._buttons,
            "ebrake": self._ebrake,
            "trip": self._trip,
            "set": self._set,
            "grip": self._grip,
            "unplug": lambda _: self._plugged(present=False),
            "plug": lambda _: self._plugged(present=True),
            "disconnect": lambda _: server.disconnect(),
            "drop": self._drop,
            "twice": self._twice,
            "delay": self._delay,
            "stall": self._stall,
            "garble": self._garble,
            "push": self._push,
        }

    def answer(self, line: str, now_s: float) -> str:
        """Return the answer to a line: `ok`, `ok RESULT`, or `error: WHY`."""
        name, *arguments = line.split() or [""]
        command = self._commands.get(name)
        if command is None:
            shown = repr(name) if name else "an empty line"
            return f"error: {shown}: must be one of {' '.join(sorted(self._commands))}"
        self._service.advance(now_s)
        try:
            result = command(arguments)
        except ValueError as error:
            return f"error: {name}: {error}"
        return f"ok {result}" if result else "ok"

    def figures(self) -> dict[str, Any]:
        """Return state and figures."""
        return {**self._service.figures(), **self._server.figures()}

    def _quit(self, _arguments: list[str]) -> None:
        self.quit = True

    def _hand(self, arguments: list[str]) -> None:
        x, y, z = _numbers(arguments, 3, 1.0)
        self._service.device.hand = x, y, z

    def _release(self, _arguments: list[str]) -> None:
        self._service.device.hand = None

    def _turn(self, arguments: list[str]) -> None:
        w, x, y, z = _numbers(arguments, 4, 2.0)
        self._service.orientation = w, x, y, z

    def _buttons(self, arguments: list[str]) -> None:
        if not set(arguments) <= {"a", "b", "c"}:
            _refuse("must be those of a, b, c that are pressed, or none")
        self._service.buttons = {name: name in arguments for name in "abc"}

    def _ebrake(self, arguments: list[str]) -> None:
        self._service.brake(on=_on(arguments))

    def _trip(self, arguments: list[str]) -> None:
        if len(arguments) != 1 or arguments[0] not in TRIPS:
            _refuse(f"must be one of {' '.join(TRIPS)}")
        details = {"device_id": DEVICE_ID, "safety_type": TRIPS[arguments[0]]}
        self._service.tell("device-safety-triggered", details, "critical")

    def _set(self, arguments: list[str]) -> None:
        status = self._service.status
        if len(arguments) != 2 or arguments[0] not in status:
            _refuse(f"must be one of {' '.join(status)}, and on or off")
        status[arguments[0]] = _on(arguments[1:])

    def _grip(self, arguments: list[str]) -> None:
        if arguments not in (["sleep"], ["wake"], ["gone"], ["back"]):
            _refuse("must be sleep, wake, gone or back")
        if arguments[0] in {"gone", "back"}:
            self._service.grip = arguments == ["back"]
        else:
            self._service.sleep(awake=arguments == ["wake"])

    def _plugged(self, *, present: bool) -> None:
        self._service.present = present
        name = "device-connected" if present else "device-disconnected"
        self._service.tell(name, {"device_family": "inverse3", "device_id": DEVICE_ID})

    def _drop(self, arguments: list[str]) -> None:
        self._service.faults.drop = _count(arguments)

    def _twice(self, arguments: list[str]) -> None:
        self._service.faults.twice = _count(arguments)

    def _delay(self, arguments: list[str]) -> None:
        self._service.faults.delay_s = _seconds(arguments)

    def _stall(self, arguments: list[str]) -> None:
        self._service.faults.stall_s = _seconds(arguments)

    def _garble(self, arguments: list[str]) -> None:
        if len(arguments) != 1 or arguments[0] not in GARBLED:
            _refuse(f"must be one of {' '.join(GARBLED)}")
        self._service.faults.garble = GARBLED[arguments[0]]

    def _push(self, arguments: list[str]) -> None:
        x, y, z = _numbers(arguments, 3, 100.0)
        self._service.faults.added = x, y, z


def _refuse(message: str) -> None:
    raise ValueError(message)


def _on(arguments: list[str]) -> bool:
    if arguments not in (["on"], ["off"]):
        _refuse("must be on or off")
    return arguments == ["on"]


def _numbers(arguments: list[str], count: int, largest: float) -> list[float]:
    try:
        numbers = [float(argument) for argument in arguments]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(math.isfinite(number) and abs(number) <= largest for number in numbers):
        _refuse(f"{' '.join(arguments)!r}: must be {count} number{'s' if count > 1 else ''} of at most {largest:g}")
    return numbers


def _seconds(arguments: list[str]) -> float:
    """Convert a number in ms to s."""
    (milliseconds,) = _numbers(arguments, 1, 10_000.0)
    if milliseconds < 0.0:
        _refuse(f"{milliseconds:g}: must be at least 0 ms")
    return 1e-3 * milliseconds


def _count(arguments: list[str]) -> int:
    (number,) = _numbers(arguments or ["1"], 1, MAX_COUNT)
    if number != int(number) or number < 0:
        _refuse(f"{number:g}: must be a whole number")
    return int(number)
