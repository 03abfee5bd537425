"""Control line of the emulated service: one-line commands with one-line answers."""

import json
from typing import TYPE_CHECKING, Any, Final

from haptether.control_line import CommandLine, is_on, numbers, refuse, whole

if TYPE_CHECKING:
    from haptether.master.inverse3.emulator.server import Server
    from haptether.master.inverse3.emulator.service import Service

from haptether.master.inverse3.emulator.service import DEVICE_ID

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


class ControlLine(CommandLine):
    """Commands of an operator or a test to the emulated service.

    Args:
        service: Emulated service.
        server: Server of the connections.
    """

    def __init__(self, service: "Service", server: "Server") -> None:
        self._service = service
        self._server = server
        super().__init__(
            {
                "status": lambda _a, _t: json.dumps(self.figures()),
                "log": lambda _a, _t: json.dumps(list(service.log)),
                "hand": self._hand,
                "release": self._release,
                "turn": self._turn,
                "buttons": self._buttons,
                "ebrake": self._ebrake,
                "trip": self._trip,
                "set": self._set,
                "grip": self._grip,
                "unplug": lambda _a, _t: self._plugged(present=False),
                "plug": lambda _a, _t: self._plugged(present=True),
                "disconnect": lambda _a, _t: server.disconnect(),
                "drop": self._drop,
                "twice": self._twice,
                "delay": self._delay,
                "stall": self._stall,
                "garble": self._garble,
                "push": self._push,
            }
        )

    def answer(self, line: str, now_s: float) -> str:
        """Advance the service, then return the answer to a line."""
        self._service.advance(now_s)
        return super().answer(line, now_s)

    def figures(self) -> dict[str, Any]:
        """Return state and figures."""
        return {**self._service.figures(), **self._server.figures()}

    def _hand(self, arguments: list[str], _now_s: float) -> None:
        x, y, z = numbers(arguments, 3, 1.0)
        self._service.device.hand = x, y, z

    def _release(self, _arguments: list[str], _now_s: float) -> None:
        self._service.device.hand = None

    def _turn(self, arguments: list[str], _now_s: float) -> None:
        w, x, y, z = numbers(arguments, 4, 2.0)
        self._service.orientation = w, x, y, z

    def _buttons(self, arguments: list[str], _now_s: float) -> None:
        if not set(arguments) <= {"a", "b", "c"}:
            refuse("must be those of a, b, c that are pressed, or none")
        self._service.buttons = {name: name in arguments for name in "abc"}

    def _ebrake(self, arguments: list[str], _now_s: float) -> None:
        self._service.brake(on=is_on(arguments))

    def _trip(self, arguments: list[str], _now_s: float) -> None:
        if len(arguments) != 1 or arguments[0] not in TRIPS:
            refuse(f"must be one of {' '.join(TRIPS)}")
        details = {"device_id": DEVICE_ID, "safety_type": TRIPS[arguments[0]]}
        self._service.tell("device-safety-triggered", details, "critical")

    def _set(self, arguments: list[str], _now_s: float) -> None:
        status = self._service.status
        if len(arguments) != 2 or arguments[0] not in status:
            refuse(f"must be one of {' '.join(status)}, and on or off")
        status[arguments[0]] = is_on(arguments[1:])

    def _grip(self, arguments: list[str], _now_s: float) -> None:
        if arguments not in (["sleep"], ["wake"], ["gone"], ["back"]):
            refuse("must be sleep, wake, gone or back")
        if arguments[0] in {"gone", "back"}:
            self._service.grip = arguments == ["back"]
        else:
            self._service.sleep(awake=arguments == ["wake"])

    def _plugged(self, *, present: bool) -> None:
        self._service.present = present
        name = "device-connected" if present else "device-disconnected"
        self._service.tell(name, {"device_family": "inverse3", "device_id": DEVICE_ID})

    def _drop(self, arguments: list[str], _now_s: float) -> None:
        self._service.faults.drop = whole(arguments, 1, 0)

    def _twice(self, arguments: list[str], _now_s: float) -> None:
        self._service.faults.twice = whole(arguments, 1, 0)

    def _delay(self, arguments: list[str], _now_s: float) -> None:
        self._service.faults.delay_s = _seconds(arguments)

    def _stall(self, arguments: list[str], _now_s: float) -> None:
        self._service.faults.stall_s = _seconds(arguments)

    def _garble(self, arguments: list[str], _now_s: float) -> None:
        if len(arguments) != 1 or arguments[0] not in GARBLED:
            refuse(f"must be one of {' '.join(GARBLED)}")
        self._service.faults.garble = GARBLED[arguments[0]]

    def _push(self, arguments: list[str], _now_s: float) -> None:
        x, y, z = numbers(arguments, 3, 100.0)
        self._service.faults.added = x, y, z


def _seconds(arguments: list[str]) -> float:
    """Convert a number in ms to s."""
    (milliseconds,) = numbers(arguments, 1, 10_000.0)
    if milliseconds < 0.0:
        refuse(f"{milliseconds:g}: must be at least 0 ms")
    return 1e-3 * milliseconds
