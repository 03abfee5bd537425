"""The controller: one control cycle after another, with what clients wrote and what they will read."""

import math
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from haptether.slave.ur_emulator.control_uploads import CONTROL_SCRIPT, CONTROL_SCRIPT_NAME, Upload, recognised
from haptether.slave.ur_emulator.digital_outputs import DigitalOutputs
from haptether.slave.ur_emulator.joint_tracking import Joints
from haptether.slave.ur_emulator.output_values import OutputValues
from haptether.slave.ur_emulator.registers import Registers
from haptether.slave.ur_emulator.robot.robot import Robot
from haptether.slave.ur_emulator.robot.safety import SafetySystem
from haptether.slave.ur_emulator.robot_state import RobotMode, RuntimeState
from haptether.slave.ur_emulator.rtde.variables import inputs_of, outputs_of
from haptether.slave.ur_emulator.rtde_inputs import RtdeInputs
from haptether.slave.ur_emulator.safety_limits import SafetyLimits
from haptether.slave.ur_emulator.script.calls import ScriptLines
from haptether.slave.ur_emulator.script.control_script import ControlProgram
from haptether.slave.ur_emulator.script.functions import ScriptFunctions
from haptether.slave.ur_emulator.script.port import Submitted, nobody
from haptether.slave.ur_emulator.script.program import Program, Steps, Thread
from haptether.slave.ur_emulator.script_error import ScriptError
from haptether.slave.ur_emulator.setup import Setup
from haptether.slave.ur_emulator.version import ControllerVersion

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from haptether.slave.ur_emulator.rtde_types import Value
    from haptether.slave.ur_emulator.touch import Touch
    from haptether.slave.ur_emulator.wrench_sensor import WrenchSensing
    from haptether.slave.ur_models import UrModel

START_UP_S: Final = 0.02
"""How long the controller takes from a program's last line to its first step."""
STOP_DECELERATION: Final = 20.0
"""rad/s² of a stop by the safety system."""
UPTIME_S: Final = 100.0
"""Age of the controller when it begins: some clients wait for one that has just booted."""
LOG_LINES: Final = 1000
MAX_LOG_LINE: Final = 500
"""Characters; a client's text may have a million."""
MAX_NAME: Final = 80
MAX_SECONDARY: Final = 5_000
"""Characters of a secondary program, which is read at once."""
MAX_WRENCH: Final = 1e5
"""N and N m of a client's force sensor; larger numbers overflow in squares."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ControllerSettings:
    """What a controller is."""

    model: "UrModel"
    version: ControllerVersion
    start: Joints
    """Joint angles in rad at the begin."""
    tcp: tuple[float, ...] = (0.0,) * 6
    """The tool in the frame of the flange at the begin, in m and rad."""
    serial_number: str = "20240000001"
    remote_control: bool = True
    unlock_after_s: float = 5.0
    limits: SafetyLimits = field(default_factory=SafetyLimits)


class Controller:
    """A pure state machine: `cycle` advances it by one control cycle.

    Args:
        settings: What it is.
        touch: What the tool touches.
        sensing: The force sensor.

    Raises:
        ValueError: A start beyond the limits of a joint.
    """

    def __init__(
        self, settings: ControllerSettings, touch: "Touch | None" = None, sensing: "WrenchSensing | None" = None
    ) -> None:
        _check_start(settings)
        self.settings = settings
        self.version = settings.version
        self.period_s = 1.0 / settings.version.rate_hz
        self.inputs = RtdeInputs(inputs_of(settings.version))
        self.output_types = outputs_of(settings.version)
        self.outputs: dict[str, Value] = {name: kind.zero for name, kind in self.output_types.items()}
        self.robot = Robot(settings.model, settings.start, settings.tcp, self.period_s, touch=touch, sensing=sensing)
        self.log: deque[str] = deque(maxlen=LOG_LINES)
        self.cycles = 0
        self.remote_control = settings.remote_control
        self.runtime = RuntimeState.STOPPED
        self.program_name = ""
        self.loaded = ""
        self.safety = SafetySystem(settings.unlock_after_s, self._safety_stop, self.tell)
        self.setup = Setup(settings.version, self.protective_stop, self._engaged)
        self.digital = DigitalOutputs(self.inputs)
        self.on_engaged: Callable[[], None] = _nothing
        """Is called when the first servo or speed command has come."""
        self.slider = 1.0
        self.limiter = 1.0
        """Share of the speed that the limit of tool speed leaves, beside the slider: RTDE's `speed_scaling`."""
        self.operational_mode: str | None = None
        """What the dashboard has set; none while it controls no mode."""
        self.claimed_version: ControllerVersion | None = None
        """Another version to tell clients, whatever it is."""
        self._program: Program | None = None
        self._starts: tuple[int, Submitted] | None = None
        self._reading: Iterator[bool] | None = None
        """The program that is being read, and then begins."""
        self._failed: Callable[[str], None] = nobody
        """Of the program that runs: told what stopped it."""
        self._stop_wanted = ""
        self._watched = (0, 0)
        self._has_engaged = False
        self._values = OutputValues(self)
        self._values.update()

    @property
    def now_s(self) -> float:
        """Time in s since it began."""
        return self.cycles * self.period_s

    @property
    def timestamp(self) -> float:
        """Its age in s, as RTDE tells it."""
        return UPTIME_S + self.now_s

    @property
    def reported_version(self) -> ControllerVersion:
        """The version that it says it has."""
        return self.claimed_version or self.version

    def tell(self, text: str) -> None:
        """Writes a line to the log."""
        self.log.append(f"{self.now_s:.3f} {text[:MAX_LOG_LINE]}")

    # ---------------------------------------------------------------------------------------------------- cycle

    def cycle(self) -> None:
        """One control cycle."""
        self.cycles += 1
        self.safety.advance(self.now_s)
        self._slide()
        self.digital.update()
        wrench = self.inputs.values["external_force_torque"]
        self.robot.sensing.external = _within(wrench) if self.setup.external_sensor else None  # type: ignore[arg-type]
        # What was commanded in the cycle before has moved the arm until now; what is commanded now moves it after.
        self._move()
        self._look_at_limits()
        self._start_program()
        self._run_programs()
        self._values.update()

    def _slide(self) -> None:
        values = self.inputs.values
        if values["speed_slider_mask"]:
            self.slider = min(max(float(values["speed_slider_fraction"]), 0.0), 1.0)  # type: ignore[arg-type]
        speed = max(1e-9, self.robot.tool_speed)
        # The controller slows its own moves down rather than breaking the limit of tool speed.
        room = max(0.9 * self.settings.limits.tool_speed / speed * self.robot.share, 0.01)
        self.robot.share = min(self.slider, room)
        # Clients multiply it by the slider's share, which RTDE tells as target_speed_fraction.
        self.limiter = min(1.0, room / self.slider) if self.slider > 0.0 else 1.0

    def _start_program(self) -> None:
        if self._starts is None or self.cycles < self._starts[0]:
            return
        submitted = self._starts[1]
        self._reading = self._reading or self._read(submitted)
        try:
            if next(self._reading):
                self._starts = self._reading = None
        except ScriptError as error:
            self._starts = self._reading = None
            self._fail(submitted.failed, f"{_name(submitted)}: {error}")

    def _read(self, submitted: Submitted) -> "Iterator[bool]":
        """Reads a program, a part of it in each control cycle, then begins it; whether it has begun.

        Raises:
            ScriptError: It cannot be read.
        """
        program = Program(_name(submitted))
        functions = ScriptFunctions(self.robot, program, self.settings.limits.jump, self.protective_stop)
        upload = recognised(submitted.text)
        if upload is not None:
            steps = self._control_program(upload, functions)
        else:
            reading = self._lines(functions).read(submitted.text)
            while True:
                try:
                    next(reading)
                except StopIteration as read:
                    steps = read.value
                    break
                yield False
        program.main = Thread(steps)
        self._program, self._failed = program, submitted.failed
        self.program_name = program.name
        self.runtime = RuntimeState.PLAYING
        yield True

    def _fail(self, failed: "Callable[[str], None]", text: str) -> None:
        """Says what stopped a program, in the log and to who sent it."""
        self.tell(text)
        failed(text)

    def _run_secondary(self, submitted: Submitted) -> None:
        """Runs a program beside the one that runs; it may take no time."""
        program = Program(_name(submitted))
        functions = ScriptFunctions(self.robot, program, self.settings.limits.jump, self.protective_stop)
        try:
            if len(submitted.text) > MAX_SECONDARY:
                message = f"{len(submitted.text)} characters: a secondary program must have at most {MAX_SECONDARY}"
                raise ScriptError(message)
            program.main = Thread(self._lines(functions).steps(submitted.text))
            if program.cycle():
                program.kill()
                message = "a secondary program must not take time"
                raise ScriptError(message)
        except ScriptError as error:
            self._fail(submitted.failed, f"{program.name}: {error}")

    def _lines(self, functions: ScriptFunctions) -> ScriptLines:
        registers = Registers(self.inputs.values, self.outputs)
        return ScriptLines(functions, registers, self.setup, self.digital, self.tell)

    def _control_program(self, upload: Upload, functions: ScriptFunctions) -> Steps:
        registers = Registers(self.inputs.values, self.outputs, upload.offset)
        return ControlProgram(upload, functions, registers, self.setup, self.tell).main()

    def _run_programs(self) -> None:
        program = self._program
        if program is None or self.runtime != RuntimeState.PLAYING:
            return
        if self._watchdog_expired(program):
            return
        try:
            goes_on = program.cycle()
        except ScriptError as error:
            self._fail(self._failed, f"{program.name}: {error}")
            goes_on = False
        if self._stop_wanted:
            reason, self._stop_wanted = self._stop_wanted, ""
            self.safety.protective_stop(reason, self.now_s)
        if not goes_on:
            self.stop_program()

    def _watchdog_expired(self, program: Program) -> bool:
        if self.setup.watchdog_hz is None:
            return False
        writes, seen = self.inputs.writes[self.setup.watched], self._watched
        if writes != seen[0] or self.setup.watchdog_is_new:
            self.setup.watchdog_is_new = False
            self._watched = writes, self.cycles
            return False
        if (self.cycles - seen[1]) * self.period_s <= 1.0 / self.setup.watchdog_hz:
            return False
        self.tell(f"{program.name}: watchdog of {self.setup.watched} at {self.setup.watchdog_hz:g} Hz")
        self.stop_program()
        return True

    def _move(self) -> None:
        try:
            self.robot.step(self.now_s)
        except ScriptError as error:
            self._fail(self._failed, f"{self.program_name}: {error}")
            self.stop_program()

    def _look_at_limits(self) -> None:
        if self.safety.may_move and (broken := self.settings.limits.broken(self.robot)) is not None:
            self.safety.protective_stop(broken, self.now_s)

    # ------------------------------------------------------------------------------------------------- programs

    def submit(self, submitted: Submitted) -> bool:
        """Takes a program from a script interface; it starts soon. Whether it is taken."""
        if not self.may_run:
            self._fail(submitted.failed, f"script {_name(submitted)!r} refused: {self._why_not()}")
            return False
        if submitted.secondary:
            self._run_secondary(submitted)
            return True
        self.stop_program()
        self._starts = (self.cycles + max(1, round(START_UP_S / self.period_s)), submitted)
        return True

    @property
    def may_run(self) -> bool:
        """Whether programs from outside may run."""
        return self.safety.may_move and (self.remote_control or self.version.is_cb3)

    def _why_not(self) -> str:
        if not (self.remote_control or self.version.is_cb3):
            return "not in remote control"
        return f"robot mode {self.safety.robot_mode.name}, safety mode {self.safety.mode.name}"

    def reset(self) -> None:
        """Everything as at the begin, but for time, log and the registers: the arm is back at its start at once."""
        self.safety.reset()
        self.stop_program()
        self.remote_control = self.settings.remote_control
        self.claimed_version = None
        self.loaded = self.program_name = ""
        self.slider = 1.0
        self.operational_mode = None
        self.setup.reset()
        self.digital.reset()
        self.robot.place(self.settings.start, self.settings.tcp)
        self._stop_wanted = ""
        self._has_engaged = False

    def stop_program(self) -> None:
        """Ends the program that runs; the arm comes to rest."""
        self._starts = self._reading = None
        if self._program is not None:
            self._program.kill()
            self._program, self._failed = None, nobody
        self.robot.end_force_mode()
        self.setup.program_ended()
        self.runtime = RuntimeState.STOPPED

    def pause(self) -> bool:
        """Pauses the program; whether one was running."""
        if self.runtime != RuntimeState.PLAYING:
            return False
        self.runtime = RuntimeState.PAUSED
        self.robot.brake(STOP_DECELERATION)
        return True

    def play(self) -> bool:
        """Goes on with a paused program, or starts the one that is loaded; whether there was one."""
        if not self.safety.may_move:
            return False
        if self.runtime == RuntimeState.PAUSED:
            self.runtime = RuntimeState.PLAYING
            return True
        return bool(self.loaded) and self.submit(Submitted(CONTROL_SCRIPT_NAME, CONTROL_SCRIPT))

    # --------------------------------------------------------------------------------------------------- safety

    def protective_stop(self, reason: str) -> None:
        """Stops the arm at the end of the program's turn: a program cannot end itself in its middle."""
        self._stop_wanted = self._stop_wanted or reason
        if self._program is None or self.runtime != RuntimeState.PLAYING:
            self._stop_wanted = ""
            self.safety.protective_stop(reason, self.now_s)

    def _safety_stop(self, reason: str) -> None:  # noqa: ARG002
        self.stop_program()
        self.robot.brake(STOP_DECELERATION)

    def _engaged(self) -> None:
        if not self._has_engaged:
            self._has_engaged = True
            self.on_engaged()

    @property
    def is_powered(self) -> bool:
        """Whether the arm has power."""
        return self.safety.robot_mode in {RobotMode.POWER_ON, RobotMode.IDLE, RobotMode.BACKDRIVE, RobotMode.RUNNING}


def _check_start(settings: ControllerSettings) -> None:
    model = settings.model
    for joint, (low, angle, high) in enumerate(
        zip(model.position_min, settings.start, model.position_max, strict=True), start=1
    ):
        if not low <= angle <= high or not math.isfinite(angle):
            message = f"start: joint {joint} = {angle:g} rad: must be between {low:.4g} and {high:.4g}"
            raise ValueError(message)


def _name(submitted: Submitted) -> str:
    return (submitted.name or submitted.text)[:MAX_NAME]


def _within(wrench: tuple[float, ...]) -> tuple[float, ...]:
    return tuple([min(max(part, -MAX_WRENCH), MAX_WRENCH) for part in wrench])


def _nothing() -> None:
    """Nobody waits for it."""
