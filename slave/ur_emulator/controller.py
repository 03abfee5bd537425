"""Controller: each control cycle reads RTDE inputs, moves the arm, runs programs and sets the outputs."""

import contextlib
import math
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

from haptether.slave.ur.kinematics.pose import pose_from_transform
from haptether.slave.ur.state import RuntimeState
from haptether.slave.ur_emulator.gripper.gripper import EmulatedGripper, GripperSettings
from haptether.slave.ur_emulator.robot.kinematics import Joints, Six, six
from haptether.slave.ur_emulator.robot.robot import Robot
from haptether.slave.ur_emulator.robot.safety import (
    JOINT_MODES,
    JOINT_POWER_OFF,
    POWERED_MODES,
    SafetyLimits,
    SafetySystem,
    safety_status_bits,
)
from haptether.slave.ur_emulator.rtde.variables import (
    ClientSettings,
    ControllerVersion,
    RtdeInputs,
    inputs_of,
    outputs_of,
)
from haptether.slave.ur_emulator.script.calls import CallProgram
from haptether.slave.ur_emulator.script.control_script import (
    CONTROL_SCRIPT,
    CONTROL_SCRIPT_NAME,
    ControlProgram,
    recognised,
)
from haptether.slave.ur_emulator.script.functions import ScriptFunctions
from haptether.slave.ur_emulator.script.port import Submitted, ignored
from haptether.slave.ur_emulator.script.program import Program, Registers, ScriptError, Setup, Thread

if TYPE_CHECKING:
    from collections.abc import Callable, Generator

    from haptether.slave.ur.kinematics.models import UrModel
    from haptether.slave.ur_emulator.robot.contact import ToolEnvironment, WrenchSensing
    from haptether.slave.ur_emulator.rtde.variables import Value

START_UP_S: Final = 0.02
STOP_DECELERATION: Final = 20.0
"""Deceleration in rad/s² of a stop by the safety system."""
UPTIME_S: Final = 100.0
"""Age of the controller at the start: some clients wait for a controller that has just booted."""
LOG_LINES: Final = 1000
MAX_LOG_LINE: Final = 500
"""Characters of a line; a client's text may have a million."""
MAX_NAME: Final = 80
SIGNAL: Final = "write_output_integer_register("
MAX_SECONDARY: Final = 5_000
"""Characters of a secondary program, which is parsed at once."""
MAX_WRENCH: Final = 1e5
"""Largest value in N and N m of a client's force sensor; squares of larger numbers overflow."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ControllerSettings:
    """Arm, software version and initial state of a controller."""

    model: "UrModel"
    version: ControllerVersion
    start: Joints
    """Initial joint angles in rad."""
    tcp: tuple[float, ...] = (0.0,) * 6
    """Initial tool in the flange frame, in m and rad."""
    serial_number: str = "20240000001"
    remote_control: bool = True
    unlock_after_s: float = 5.0
    limits: SafetyLimits = field(default_factory=SafetyLimits)
    gripper: GripperSettings | None = None
    """Gripper on the flange and its URCap server; None without a gripper."""


class Controller:
    """State machine without sockets and clock: `cycle` advances it by one control cycle.

    Args:
        settings: Arm, software version, initial state.
        touch: Environment of the tool.
        sensing: The force sensor.

    Raises:
        ValueError: A start is outside the limits of a joint.
    """

    def __init__(
        self,
        settings: ControllerSettings,
        touch: "ToolEnvironment | None" = None,
        sensing: "WrenchSensing | None" = None,
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
        self.safety = SafetySystem(settings.unlock_after_s, self._safety_stop, self.write_log)
        self.setup = Setup(settings.version, self.protective_stop, self._engaged)
        self.client_settings = ClientSettings(self.inputs)
        self.gripper = None if settings.gripper is None else EmulatedGripper(settings.gripper)
        self.on_engaged: Callable[[], None] = lambda: None
        """Called at the first servo or speed command."""
        self.limiter = 1.0
        """Share of the speed that the tool speed limit leaves, apart from the slider: RTDE's `speed_scaling`."""
        self.start_up_s = START_UP_S
        """Time from a program's last line to its first step."""
        self.operational_mode: str | None = None
        """Mode set by the dashboard; None if the dashboard controls no mode."""
        self.claimed_version: ControllerVersion | None = None
        """Version that clients see instead of the true one."""
        self._program: Program | None = None
        self._starts: tuple[int, Submitted] | None = None
        self._reading: Generator[None, None, None] | None = None
        """Parser of the next program."""
        self._failed: Callable[[str], None] = ignored
        """Receives the error that stops the running program."""
        self._stop_reason = ""
        self._watched = (0, 0)
        """Number of writes of the watchdog's input, and the control cycle of the last one."""
        self._has_engaged = False
        self._tool_velocities: tuple[Six, Six] = ((0.0,) * 6, (0.0,) * 6)
        """Velocities of the previous cycle: target and measured."""
        self._update_outputs()

    @property
    def now_s(self) -> float:
        """Time in s since the controller started."""
        return self.cycles * self.period_s

    @property
    def timestamp(self) -> float:
        """RTDE's `timestamp`, in s."""
        return UPTIME_S + self.now_s

    @property
    def reported_version(self) -> ControllerVersion:
        """Version that clients see."""
        return self.claimed_version or self.version

    def write_log(self, text: str) -> None:
        """Write a line to the log."""
        self.log.append(f"{self.now_s:.3f} {text[:MAX_LOG_LINE]}")

    # ---------------------------------------------------------------------------------------------------- cycle

    def cycle(self) -> None:
        """Run one control cycle."""
        self.cycles += 1
        self.safety.advance(self.now_s)
        self._scale_speed()
        wrench = self.inputs.values["external_force_torque"]
        self.robot.sensing.external = _within(wrench) if self.setup.external_sensor else None  # type: ignore[arg-type]
        # The commands of the previous cycle have moved the arm until now.
        self._move()
        self._check_limits()
        self._start_program()
        self._run_programs()
        if self.gripper is not None:
            self.gripper.advance(self.now_s)
        self._update_outputs()

    def _scale_speed(self) -> None:
        speed = max(1e-9, self.robot.tool_speed)
        # The controller slows its own moves down to respect the tool speed limit.
        room = max(0.9 * self.settings.limits.tool_speed / speed * self.robot.speed_scaling, 0.01)
        self.robot.speed_scaling = min(self.client_settings.slider, room)
        # Clients multiply it by target_speed_fraction, which is the slider.
        self.limiter = min(1.0, room / self.client_settings.slider) if self.client_settings.slider > 0.0 else 1.0

    def _start_program(self) -> None:
        if self._starts is None or self.cycles < self._starts[0]:
            return
        submitted = self._starts[1]
        self._reading = self._reading or self._started(submitted)
        try:
            if next(self._reading, True):
                self._starts = self._reading = None
        except ScriptError as error:
            self._starts = self._reading = None
            self._fail(submitted.failed, f"{_name(submitted)}: {error}")
            self._signal_end(submitted)

    def _signal_end(self, submitted: Submitted) -> None:
        """Execute the last register write of a program that cannot be read.

        ur_rtde waits 5 minutes for this write in any program state.
        """
        lines = [line.strip() for line in submitted.text.splitlines() if line.strip().startswith(SIGNAL)]
        if lines:
            with contextlib.suppress(ScriptError):
                Thread(self._calls(self._program_of(submitted)[1]).steps(lines[-1])).run()

    def _started(self, submitted: Submitted) -> "Generator[None, None, None]":
        """Parse a program, a part in each control cycle, then start it.

        Raises:
            ScriptError: The program cannot be parsed.
        """
        program, functions = self._program_of(submitted)
        upload = recognised(submitted.text)
        if upload is not None:
            registers = Registers(self.inputs.values, self.outputs, upload.offset)
            steps = ControlProgram(upload, functions, registers, self.setup).main()
        else:
            steps = yield from self._calls(functions).read(submitted.text)
        program.main = Thread(steps)
        self._program, self._failed = program, submitted.failed
        self.program_name = program.name
        self.runtime = RuntimeState.PLAYING

    def _fail(self, failed: "Callable[[str], None]", text: str) -> None:
        """Report the error of a program to the log and to its sender."""
        self.write_log(text)
        failed(text)

    def _run_secondary(self, submitted: Submitted) -> None:
        """Run a program beside the running one; it may take no time."""
        program, functions = self._program_of(submitted)
        try:
            if len(submitted.text) > MAX_SECONDARY:
                message = f"{len(submitted.text)} characters: a secondary program must have at most {MAX_SECONDARY}"
                raise ScriptError(message)
            program.main = Thread(self._calls(functions).steps(submitted.text))
            if program.cycle():
                program.kill()
                message = "a secondary program must not take time"
                raise ScriptError(message)
        except ScriptError as error:
            self._fail(submitted.failed, f"{program.name}: {error}")

    def _program_of(self, submitted: Submitted) -> tuple[Program, ScriptFunctions]:
        program = Program(_name(submitted))
        return program, ScriptFunctions(self.robot, program, self.settings.limits.jump, self.protective_stop)

    def _calls(self, functions: ScriptFunctions) -> CallProgram:
        registers = Registers(self.inputs.values, self.outputs)
        return CallProgram(functions, registers, self.setup, self.client_settings, self.write_log)

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
        if self._stop_reason:
            reason, self._stop_reason = self._stop_reason, ""
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
        self.write_log(f"{program.name}: watchdog of {self.setup.watched} at {self.setup.watchdog_hz:g} Hz")
        self.stop_program()
        return True

    def _move(self) -> None:
        try:
            self.robot.step(self.now_s)
        except ScriptError as error:
            self._fail(self._failed, f"{self.program_name}: {error}")
            self.stop_program()

    def _check_limits(self) -> None:
        if self.safety.may_move and (violation := self.settings.limits.violation(self.robot)) is not None:
            self.safety.protective_stop(violation, self.now_s)

    # -------------------------------------------------------------------------------------------------- outputs

    def _update_outputs(self) -> None:
        """Set the outputs that the emulator models; all others stay zero."""
        outputs, robot = self.outputs, self.robot
        measured, target = robot.measured, robot.target
        tool, jacobian = robot.arm.transform_and_jacobian(target.q)
        robot.tool_speed = math.hypot(*(target_velocity := six(jacobian @ np.array(target.qd)))[:3])
        elbow, elbow_velocity = robot.arm.elbow(measured.q, measured.qd)
        velocities = target_velocity, measured.velocity
        target_acceleration, acceleration = (
            tuple([(new - old) / self.period_s for new, old in zip(now, before, strict=True)])
            for now, before in zip(velocities, self._tool_velocities, strict=True)
        )
        self._tool_velocities = velocities
        powered, playing = self.safety.robot_mode in POWERED_MODES, self.runtime == RuntimeState.PLAYING
        values: dict[str, Value] = {
            "timestamp": self.timestamp,
            "speed_scaling": self.limiter,
            "target_speed_fraction": self.client_settings.slider,
            "tcp_force_scalar": math.hypot(*measured.sensed[:3]),
            "target_q": target.q,
            "target_qd": target.qd,
            "target_qdd": target.qdd,
            "actual_q": measured.q,
            "actual_qd": measured.qd,
            "actual_TCP_pose": measured.pose,
            "actual_TCP_speed": measured.velocity,
            "actual_TCP_force": measured.sensed,
            "target_TCP_pose": six(pose_from_transform(tool)),
            "target_TCP_speed": target_velocity,
            "target_TCP_acceleration": target_acceleration,
            "actual_TCP_acceleration": acceleration,
            "elbow_position": elbow,
            "elbow_velocity": elbow_velocity,
            "control_step": self.cycles,
            "tcp_offset": robot.arm.tcp_offset,
            "ft_raw_wrench": robot.sensing.raw(
                robot.arm.flange_rotation(measured.tool),
                robot.arm.lever(measured.tool),
                # `set_gravity` takes the acceleration that holds the base up.
                np.array(self.setup.gravity) * -self.setup.payload_kg,
                self.setup.payload_cog,
            ),
            "payload": self.setup.payload_kg,
            "payload_cog": self.setup.payload_cog,
            "payload_inertia": self.setup.payload_inertia,
            "actual_digital_output_bits": self.client_settings.bits,
            "standard_analog_output0": self.client_settings.analog[0],
            "standard_analog_output1": self.client_settings.analog[1],
            "analog_io_types": self.client_settings.analog_types,
            "robot_mode": int(self.safety.robot_mode),
            "safety_mode": int(self.safety.mode),
            "safety_status": int(self.safety.mode),
            "runtime_state": int(self.runtime),
            # Power on, program running, teach button, power button.
            "robot_status_bits": powered << 0 | playing << 1 | self.setup.freedrive << 2 | powered << 3,
            "safety_status_bits": safety_status_bits(self.safety.mode),
            "joint_mode": (JOINT_MODES.get(self.safety.robot_mode, JOINT_POWER_OFF),) * 6,
        }
        outputs.update((name, value) for name, value in values.items() if name in outputs)
        changed, self.inputs.changed = self.inputs.changed, set()
        outputs.update((name, self.inputs.values[name]) for name in changed if name in outputs)

    # ------------------------------------------------------------------------------------------------- programs

    def submit(self, submitted: Submitted) -> bool:
        """Take a program from a script interface; return True if it is accepted. It starts after `start_up_s`."""
        if self.is_local or not self.safety.may_move:
            modes = f"robot mode {self.safety.robot_mode.name}, safety mode {self.safety.mode.name}"
            refusal = "not in remote control" if self.is_local else modes
            self._fail(submitted.failed, f"script {_name(submitted)!r} refused: {refusal}")
            return False
        if submitted.secondary:
            self._run_secondary(submitted)
            return True
        self.stop_program()
        self._starts = (self.cycles + max(1, round(self.start_up_s / self.period_s)), submitted)
        return True

    @property
    def is_local(self) -> bool:
        """Return True if commands from outside are refused; a CB3 controller always accepts them."""
        return not (self.remote_control or self.version.is_cb3)

    def reset(self) -> None:
        """Reset everything except time, log and registers; the arm is at its start at once."""
        self.safety.reset()
        self.stop_program()
        self.remote_control = self.settings.remote_control
        self.claimed_version = None
        self.loaded = self.program_name = ""
        self.operational_mode = None
        self.start_up_s = START_UP_S
        self.setup.reset()
        self.client_settings.reset()
        self.robot.reset(self.settings.start, self.settings.tcp)
        if self.gripper is not None:
            self.gripper.reset()
        self._stop_reason = ""
        self._has_engaged = False

    def stop_program(self) -> None:
        """End the running program; the arm comes to rest."""
        self._starts = self._reading = None
        if self._program is not None:
            self._program.kill()
            self._program, self._failed = None, ignored
        self.robot.end_force_mode()
        self.setup.program_ended()
        self.runtime = RuntimeState.STOPPED

    def pause(self) -> bool:
        """Pause the program; return True if one was running."""
        if self.runtime != RuntimeState.PLAYING:
            return False
        self.runtime = RuntimeState.PAUSED
        self.robot.brake(STOP_DECELERATION)
        return True

    def play(self) -> bool:
        """Resume a paused program or start the loaded one; return True if there was one."""
        if not self.safety.may_move:
            return False
        if self.runtime == RuntimeState.PAUSED:
            self.runtime = RuntimeState.PLAYING
            return True
        return bool(self.loaded) and self.submit(Submitted(CONTROL_SCRIPT_NAME, CONTROL_SCRIPT))

    # --------------------------------------------------------------------------------------------------- safety

    def protective_stop(self, reason: str) -> None:
        """Stop the arm. A running program ends after its control cycle: it cannot end itself within its step."""
        self._stop_reason = self._stop_reason or reason
        if self._program is None or self.runtime != RuntimeState.PLAYING:
            self._stop_reason = ""
            self.safety.protective_stop(reason, self.now_s)

    def _safety_stop(self, reason: str) -> None:  # noqa: ARG002
        self.stop_program()
        self.robot.brake(STOP_DECELERATION)

    def _engaged(self) -> None:
        if not self._has_engaged:
            self._has_engaged = True
            self.on_engaged()


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
