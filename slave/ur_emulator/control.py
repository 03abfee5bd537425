"""Control line: commands to the emulator; each line gets a line as its answer."""

import json
import math
import re
from typing import TYPE_CHECKING, Any, Final

from haptether.control_line import CommandLine, is_on, numbers, refuse, whole
from haptether.slave.ur.state import SafetyMode
from haptether.slave.ur_emulator.connections import KINDS
from haptether.slave.ur_emulator.controller import START_UP_S
from haptether.slave.ur_emulator.gripper.gripper import EmulatedGripper, GrippedObject
from haptether.slave.ur_emulator.robot.safety import MOVING_MODES
from haptether.slave.ur_emulator.rtde.variables import REGISTERS, ControllerVersion

if TYPE_CHECKING:
    from haptether.slave.ur_emulator.connections import Faults
    from haptether.slave.ur_emulator.controller import Controller
    from haptether.slave.ur_emulator.robot.contact import ToolEnvironment
    from haptether.slave.ur_emulator.server import Server

MAX_FORCE_N: Final = 10_000.0
MAX_CLAMP: Final = 1000.0
"""Largest stiffness in N m/rad, and damping in N m s/rad, of a clamp."""
MAX_START_UP_S: Final = 60.0
SHOWN_LINES: Final = 20
"""Lines of the log if no number is given."""


class ControlLine(CommandLine):
    """Commands of an operator or a test to the emulator.

    Args:
        controller: The controller.
        environment: Environment of its tool.
        faults: Network faults.
        process: Process that runs the controller, if any.
    """

    def __init__(
        self,
        controller: "Controller",
        environment: "ToolEnvironment",
        faults: "Faults",
        process: "Server | None" = None,
    ) -> None:
        self._controller = controller
        self._environment = environment
        self._faults = faults
        self._process = process
        super().__init__(
            {
                "status": lambda _a, _t: json.dumps(self.status()),
                "log": self._log,
                "reset": self._reset,
                "forget-lateness": lambda _a, _t: self._process.reset_lateness() if self._process else None,
                "push": self._push,
                "clamp": self._clamp,
                "engage": lambda _a, _t: self._environment.engage(),
                "anchor": lambda _a, _t: self._environment.anchor(self._controller.robot.measured.pose[:3]),
                "protective-stop": self._protective_stop,
                "unlock": self._unlock,
                "emergency-stop": lambda _a, _t: self._controller.safety.emergency_stop(self._controller.now_s),
                "release-emergency-stop": self._release,
                "safety-fault": lambda _a, _t: self._controller.safety.fault("on command", self._controller.now_s),
                "stop-program": lambda _a, _t: self._controller.stop_program(),
                "pause-program": lambda _a, _t: None if self._controller.pause() else refuse("no program is playing"),
                "play": lambda _a, _t: None if self._controller.play() else refuse("no program is paused or loaded"),
                "power": self._power,
                "remote-control": self._remote_control,
                "slider": self._slider,
                "start-up": self._start_up,
                "freeze": self._freeze,
                "thaw": lambda _a, _t: self._faults.thaw(),
                "late": self._late,
                "drop": self._drop,
                "refuse": self._refuse_connections,
                "version": self._version,
                "in-use": self._in_use,
                "gripper-fault": self._gripper_fault,
                "gripper-object": self._gripper_object,
                "gripper-silent": self._gripper_silent,
            }
        )

    # ------------------------------------------------------------------------------------------------- answers

    def status(self) -> dict[str, Any]:
        """Return state and figures."""
        controller, measured = self._controller, self._controller.robot.measured
        return {
            "model": controller.settings.model.name,
            "version": str(controller.version),
            "time_s": controller.now_s,
            "runtime_state": controller.runtime.name,
            "program": controller.program_name,
            "robot_mode": controller.safety.robot_mode.name,
            "safety_mode": controller.safety.mode.name,
            "reason": controller.safety.reason,
            "remote_control": controller.remote_control,
            "engaged": self._environment.engaged,
            "q": measured.q,
            "tcp_pose": measured.pose,
            "tcp_speed": measured.velocity,
            "tcp_force": measured.force,
            "sensed_force": measured.sensed,
            "tcp_offset": controller.robot.arm.tcp_offset,
            "payload_kg": controller.setup.payload_kg,
            "watchdog_hz": controller.setup.watchdog_hz,
            "digital_outputs": controller.client_settings.bits,
            "refused_packages": controller.inputs.refused,
            "gripper": None if controller.gripper is None else controller.gripper.figures(),
            **(self._process.figures() if self._process is not None else {}),
        }

    def _log(self, arguments: list[str], _now_s: float) -> str:
        return json.dumps(list(self._controller.log)[-whole(arguments, SHOWN_LINES) :])

    def _reset(self, _arguments: list[str], _now_s: float) -> None:
        self._environment.reset()
        self._controller.inputs.blocked = frozenset()
        self._controller.reset()
        self._faults.reset()

    # ---------------------------------------------------------------------------------------------- arm and force

    def _push(self, arguments: list[str], _now_s: float) -> None:
        if not 1 <= len(arguments) <= 2:
            refuse("must be FX or FX,FY,FZ in N, and for how long in s")
        parts = arguments[0].split(",")
        force = [*numbers(parts, len(parts)), 0.0, 0.0][:3]
        if len(parts) not in {1, 3} or max(map(abs, force)) > MAX_FORCE_N:
            refuse(f"force {arguments[0]}: must be one or three numbers of at most {MAX_FORCE_N:g} N")
        duration_s = _positive(arguments[1:], math.inf)
        self._environment.push((force[0], force[1], force[2]), duration_s)

    def _clamp(self, arguments: list[str], _now_s: float) -> None:
        if not 1 <= len(arguments) <= 2:
            refuse("must be a stiffness in N m/rad, and a damping in N m s/rad")
        given = numbers(arguments, len(arguments))
        if not all(0.0 <= number <= MAX_CLAMP for number in given):
            refuse(f"{' '.join(arguments)}: must be between 0 and {MAX_CLAMP:g}")
        self._environment.clamp(*given)

    def _protective_stop(self, arguments: list[str], _now_s: float) -> None:
        self._controller.safety.protective_stop(" ".join(arguments) or "on command", self._controller.now_s)

    def _unlock(self, _arguments: list[str], _now_s: float) -> str:
        safety = self._controller.safety
        if safety.mode != SafetyMode.PROTECTIVE_STOP:
            refuse(f"is in no protective stop but in {safety.mode.name}")
        answer = safety.unlock(self._controller.now_s)
        if safety.mode == SafetyMode.PROTECTIVE_STOP:
            refuse(answer)
        return answer

    def _release(self, _arguments: list[str], _now_s: float) -> None:
        if not self._controller.safety.release_emergency_stop():
            refuse("is not pressed")

    def _power(self, arguments: list[str], _now_s: float) -> None:
        safety = self._controller.safety
        if arguments == ["off"]:
            safety.power_off()
        elif arguments == ["on"]:
            if safety.mode not in MOVING_MODES:
                refuse(f"is in {safety.mode.name}: that must end first")
            safety.release_brakes(self._controller.now_s)
        else:
            refuse("must be on (with the brakes released) or off")

    def _remote_control(self, arguments: list[str], _now_s: float) -> None:
        self._controller.remote_control = is_on(arguments)

    def _slider(self, arguments: list[str], _now_s: float) -> None:
        (fraction,) = numbers(arguments, 1)
        if not 0.0 <= fraction <= 1.0:
            refuse(f"{arguments[0]}: must be between 0 and 1")
        self._controller.client_settings.slider = fraction

    def _start_up(self, arguments: list[str], _now_s: float) -> None:
        start_up_s = _positive(arguments, START_UP_S)
        if start_up_s > MAX_START_UP_S:
            refuse(f"{start_up_s:g}: must be at most {MAX_START_UP_S:g} s")
        self._controller.start_up_s = start_up_s

    # ------------------------------------------------------------------------------------------------- network

    def _freeze(self, arguments: list[str], now_s: float) -> None:
        self._faults.freeze(now_s, _positive(arguments, math.inf))

    def _late(self, arguments: list[str], _now_s: float) -> None:
        late_s, jitter_s = numbers(([*arguments, "0"])[:2] if len(arguments) == 1 else arguments, 2)
        if not (0.0 <= late_s <= 60.0 and 0.0 <= jitter_s <= 60.0):
            refuse("must be between 0 and 60 s")
        self._faults.late_s, self._faults.jitter_s = late_s, jitter_s

    def _drop(self, arguments: list[str], _now_s: float) -> None:
        kinds = KINDS if not arguments or arguments == ["all"] else set(arguments)
        if not kinds <= KINDS:
            refuse(f"must be all or some of {' '.join(sorted(KINDS))}")
        self._faults.dropping |= kinds

    def _refuse_connections(self, arguments: list[str], _now_s: float) -> None:
        self._faults.refusing = is_on(arguments)

    def _version(self, arguments: list[str], _now_s: float) -> None:
        if arguments == ["real"]:
            self._controller.claimed_version = None
            return
        parts = arguments[0].split(".") if len(arguments) == 1 else []
        if not (2 <= len(parts) <= 4 and all(re.fullmatch(r"[0-9]{1,9}", part) for part in parts)):
            refuse("must be real, or like 5.8 or 5.8.0.10253")
        self._controller.claimed_version = ControllerVersion(*map(int, parts))

    def _in_use(self, arguments: list[str], _now_s: float) -> None:
        names = [f"input_{kind}_register_{number}" for kind in ("int", "double") for number in range(REGISTERS)]
        self._controller.inputs.blocked = frozenset(names if is_on(arguments) else ())

    # -------------------------------------------------------------------------------------------------- gripper

    @property
    def _gripper(self) -> EmulatedGripper:
        gripper = self._controller.gripper
        if gripper is None:
            message = "there is no gripper: begin with --gripper"
            raise ValueError(message)
        return gripper

    def _gripper_fault(self, arguments: list[str], _now_s: float) -> None:
        (fault,) = numbers(arguments, 1)
        if fault != int(fault):
            refuse(f"{arguments[0]}: must be a whole number")
        self._gripper.fail(int(fault))

    def _gripper_object(self, arguments: list[str], _now_s: float) -> None:
        if arguments == ["none"]:
            self._gripper.put(None)
            return
        given = [argument for argument in arguments if argument != "inside"]
        if not 1 <= len(given) <= 2:
            refuse("must be none, or a width in mm, 'inside' where the jaws meet it so, and a stiffness in N/mm")
        (width_mm,) = numbers(given[:1], 1)
        stiffness_n_per_m = 1e3 * _positive(given[1:], math.inf)
        inside = "inside" in arguments
        self._gripper.put(GrippedObject(width_m=1e-3 * width_mm, inside=inside, stiffness_n_per_m=stiffness_n_per_m))

    def _gripper_silent(self, arguments: list[str], _now_s: float) -> None:
        self._gripper.silent = is_on(arguments)


def _positive(arguments: list[str], default: float) -> float:
    if not arguments:
        return default
    (number,) = numbers(arguments, 1)
    if number <= 0.0:
        refuse(f"{number:g}: must be positive")
    return number
