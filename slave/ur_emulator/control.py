"""The control line: one line of text comes in, one line goes out."""

import json
import math
import re
from typing import TYPE_CHECKING, Any, Protocol

from haptether.slave.ur_emulator.faults import KINDS
from haptether.slave.ur_emulator.robot_state import MOVES, SafetyMode
from haptether.slave.ur_emulator.rtde.variables import REGISTERS
from haptether.slave.ur_emulator.version import ControllerVersion

if TYPE_CHECKING:
    from collections.abc import Callable

    from haptether.slave.ur_emulator.controller import Controller
    from haptether.slave.ur_emulator.faults import Faults
    from haptether.slave.ur_emulator.robot.contact import ToolEnvironment

MAX_FORCE_N = 10_000.0
SHOWN_LINES = 20
"""Lines of the log where no number is given."""


class Process(Protocol):
    """What runs the controller."""

    def figures(self) -> dict[str, Any]:
        """How it does."""

    def forget_lateness(self) -> None:
        """Begins to measure its lateness anew."""


class ControlLine:
    """What a person or a test does to the controller from outside.

    Args:
        controller: The controller.
        environment: What its tool touches.
        faults: What lies between it and its clients.
        process: The process that all this runs in, if any.
    """

    def __init__(
        self,
        controller: "Controller",
        environment: "ToolEnvironment",
        faults: "Faults",
        process: "Process | None" = None,
    ) -> None:
        self._of = controller
        self._environment = environment
        self._faults = faults
        self._process = process
        self.quit = False
        """Whether the process is to end."""
        self._commands: dict[str, Callable[[list[str], float], str | None]] = {
            "help": lambda _w, _t: " ".join(sorted(self._commands)),
            "status": lambda _w, _t: json.dumps(self._status()),
            "log": self._log,
            "quit": self._quit,
            "reset": self._reset,
            "forget-lateness": lambda _w, _t: self._process.forget_lateness() if self._process else None,
            "push": self._push,
            "engage": lambda _w, _t: self._environment.engage(),
            "anchor": lambda _w, _t: self._environment.anchor(self._of.robot.measured.pose[:3]),
            "protective-stop": self._protective_stop,
            "unlock": self._unlock,
            "emergency-stop": lambda _w, _t: self._of.safety.emergency_stop(self._of.now_s),
            "release-emergency-stop": self._release,
            "safety-fault": lambda _w, _t: self._of.safety.fault("on command", self._of.now_s),
            "stop-program": lambda _w, _t: self._of.stop_program(),
            "pause-program": lambda _w, _t: None if self._of.pause() else _refuse("no program is playing"),
            "play": lambda _w, _t: None if self._of.play() else _refuse("no program is paused or loaded"),
            "power": self._power,
            "remote-control": self._remote_control,
            "slider": self._slider,
            "freeze": self._freeze,
            "thaw": lambda _w, _t: self._faults.thaw(),
            "late": self._late,
            "drop": self._drop,
            "refuse": self._refuse_connections,
            "version": self._version,
            "in-use": self._in_use,
        }

    def answer(self, line: str, now_s: float) -> str:
        """The answer to a line: `ok`, `ok RESULT`, or `error: WHY`.

        Args:
            line: What came.
            now_s: Time of the process in s.
        """
        name, *words = line.split() or [""]
        command = self._commands.get(name)
        if command is None:
            seen = repr(name) if name else "an empty line"
            return f"error: {seen}: must be one of {' '.join(sorted(self._commands))}"
        try:
            said = command(words, now_s)
        except ValueError as error:
            return f"error: {name}: {error}"
        return f"ok {said}" if said else "ok"

    # ------------------------------------------------------------------------------------------------- answers

    def status_json(self) -> bytes:
        """State and figures, as the line `status` gives them."""
        return json.dumps(self._status(), indent=2).encode()

    def _status(self) -> dict[str, Any]:
        of, measured = self._of, self._of.robot.measured
        return {
            "model": of.settings.model.name,
            "version": str(of.version),
            "time_s": of.now_s,
            "runtime_state": of.runtime.name,
            "program": of.program_name,
            "robot_mode": of.safety.robot_mode.name,
            "safety_mode": of.safety.mode.name,
            "reason": of.safety.reason,
            "remote_control": of.remote_control,
            "engaged": self._environment.engaged,
            "q": measured.q,
            "tcp_pose": measured.pose,
            "tcp_speed": measured.velocity,
            "tcp_force": measured.force,
            "sensed_force": measured.sensed,
            "tcp_offset": of.robot.arm.tcp_offset,
            "payload_kg": of.setup.payload_kg,
            "watchdog_hz": of.setup.watchdog_hz,
            "digital_outputs": of.digital.bits,
            "refused_packages": of.inputs.refused,
            **(self._process.figures() if self._process is not None else {}),
        }

    def _log(self, words: list[str], _now_s: float) -> str:
        (count,) = _numbers(words or [str(SHOWN_LINES)], 1)
        if count < 1.0 or count != int(count):
            _refuse(f"{count:g}: must be a whole number of lines, 1 or more")
        return json.dumps(list(self._of.log)[-int(count) :])

    def _quit(self, _words: list[str], _now_s: float) -> None:
        self.quit = True

    def _reset(self, _words: list[str], _now_s: float) -> None:
        self._environment.reset()
        self._of.inputs.blocked = frozenset()
        self._of.reset()
        self._faults.reset()

    # ---------------------------------------------------------------------------------------------- arm and force

    def _push(self, words: list[str], _now_s: float) -> None:
        if not 1 <= len(words) <= 2:
            _refuse("must be FX or FX,FY,FZ in N, and for how long in s")
        parts = words[0].split(",")
        force = [*_numbers(parts, len(parts)), 0.0, 0.0][:3]
        if len(parts) not in {1, 3} or max(map(abs, force)) > MAX_FORCE_N:
            _refuse(f"force {words[0]}: must be one or three numbers of at most {MAX_FORCE_N:g} N")
        duration_s = _positive(words[1:], math.inf)
        self._environment.push((force[0], force[1], force[2]), duration_s)

    def _protective_stop(self, words: list[str], _now_s: float) -> None:
        self._of.safety.protective_stop(" ".join(words) or "on command", self._of.now_s)

    def _unlock(self, _words: list[str], _now_s: float) -> str:
        safety = self._of.safety
        if safety.mode != SafetyMode.PROTECTIVE_STOP:
            _refuse(f"is in no protective stop but in {safety.mode.name}")
        said = safety.unlock(self._of.now_s)
        if safety.mode == SafetyMode.PROTECTIVE_STOP:
            _refuse(said)
        return said

    def _release(self, _words: list[str], _now_s: float) -> None:
        if not self._of.safety.release_emergency_stop():
            _refuse("is not pressed")

    def _power(self, words: list[str], _now_s: float) -> None:
        safety = self._of.safety
        if words == ["off"]:
            safety.power_off()
        elif words == ["on"]:
            if safety.mode not in MOVES:
                _refuse(f"is in {safety.mode.name}: that must end first")
            safety.release_brakes(self._of.now_s)
        else:
            _refuse("must be on (with the brakes released) or off")

    def _remote_control(self, words: list[str], _now_s: float) -> None:
        self._of.remote_control = _switch(words)

    def _slider(self, words: list[str], _now_s: float) -> None:
        (fraction,) = _numbers(words, 1)
        if not 0.0 <= fraction <= 1.0:
            _refuse(f"{words[0]}: must be between 0 and 1")
        self._of.slider = fraction

    # ------------------------------------------------------------------------------------------------- network

    def _freeze(self, words: list[str], now_s: float) -> None:
        self._faults.freeze(now_s, _positive(words, math.inf))

    def _late(self, words: list[str], _now_s: float) -> None:
        late_s, jitter_s = _numbers(([*words, "0"])[:2] if len(words) == 1 else words, 2)
        if not (0.0 <= late_s <= 60.0 and 0.0 <= jitter_s <= 60.0):
            _refuse("must be between 0 and 60 s")
        self._faults.late_s, self._faults.jitter_s = late_s, jitter_s

    def _drop(self, words: list[str], _now_s: float) -> None:
        kinds = KINDS if not words or words == ["all"] else set(words)
        if not kinds <= KINDS:
            _refuse(f"must be all or some of {' '.join(sorted(KINDS))}")
        self._faults.dropping |= kinds

    def _refuse_connections(self, words: list[str], _now_s: float) -> None:
        self._faults.refusing = _switch(words)

    def _version(self, words: list[str], _now_s: float) -> None:
        if words == ["real"]:
            self._of.claimed_version = None
            return
        numbers = words[0].split(".") if len(words) == 1 else []
        if not (2 <= len(numbers) <= 4 and all(re.fullmatch(r"[0-9]{1,9}", part) for part in numbers)):
            _refuse("must be real, or like 5.8 or 5.8.0.10253")
        self._of.claimed_version = ControllerVersion(*map(int, numbers))

    def _in_use(self, words: list[str], _now_s: float) -> None:
        names = [f"input_{kind}_register_{number}" for kind in ("int", "double") for number in range(REGISTERS)]
        self._of.inputs.blocked = frozenset(names if _switch(words) else ())


def _refuse(message: str) -> None:
    raise ValueError(message)


def _numbers(words: list[str], count: int) -> list[float]:
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        _refuse(f"{' '.join(words)!r}: must be {count} finite number{'s' if count > 1 else ''}")
    return numbers


def _positive(words: list[str], default: float) -> float:
    if not words:
        return default
    (number,) = _numbers(words, 1)
    if number <= 0.0:
        _refuse(f"{number:g}: must be positive")
    return number


def _switch(words: list[str]) -> bool:
    if words not in (["on"], ["off"]):
        _refuse("must be on or off")
    return words == ["on"]
