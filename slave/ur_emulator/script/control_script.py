"""Control script of ur_rtde: reads commands from registers and writes its answers there.

The emulator does not interpret the script: it recognises the script and reproduces its threads. Every control cycle
the main loop reads a command from the first integer register. Real-time commands are executed and answered by 1
("ready") at once, and repeated as long as the register holds them. Any other command is executed once and answered
by 2 ("done") until the register is 0 again. Command 255 ends the program.

Source: control script of ur_rtde 1.6.5 (SDU Robotics, MIT licence).
"""

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from haptether.slave.ur.kinematics.pose import matrix_from_rotvec, pose_trans
from haptether.slave.ur_emulator.robot.kinematics import Array, Six, six
from haptether.slave.ur_emulator.robot.motions import Move, Torque
from haptether.slave.ur_emulator.script.calls import MAX_SHOWN
from haptether.slave.ur_emulator.script.functions import ScriptFunctions
from haptether.slave.ur_emulator.script.program import Registers, ScriptError, Setup, Steps, Thread

READY, DONE = 1, 2
REALTIME: Final = frozenset({6, 9, 10, 11, 24, 25, 26, 27, 38, 58, *range(66, 72)})
STOP_SCRIPT: Final = 255
FORCE_STOP_DECELERATION, JOG_STOP_DECELERATION, CONTACT_STOP_DECELERATION = 10.0, 1.2, 3.0
JOG_TIME_S: Final = 0.01
RUNNING: Final = 1 << 15
MAX_PROGRESS: Final = RUNNING - 1
COUNT_MODULUS: Final = 128
BASE, TOOL = 0, 1
"""Frames of jogging; any other number is a feature."""
MATRIX_REGISTERS = (*range(24), *range(36, 48))
"""Registers of the 36 numbers of a matrix, column after column."""

Command = Callable[[], Steps | None]


# --------------------------------------------------------------------------------------------------------- uploads

MARKS: Final = ("def process_cmd(", "def rtde_cmd(", "read_input_integer_reg(0)")
"""Lines that only this script has."""
CONTROL_SCRIPT_NAME: Final = "rtde_control"
CONTROL_SCRIPT: Final = "\n".join((f"def {CONTROL_SCRIPT_NAME}():", *(f"  {mark}" for mark in MARKS), "end"))
"""Script on the controller's disk."""
OFFSET: Final = re.compile(r"# int register offset\s*(\d{1,2})\b")
"""The client puts the number after the comment that marks its place, on a line of its own."""
OFFSETS: Final = (0, 24)
"""First register of the client."""
PATH: Final = "def exec_move_path():"
PATH_ENDS: Final = re.compile(r"^[ \t]*end[ \t\r]*$", re.MULTILINE)
"""One line, searched once: backtracking over a text could take minutes."""
MAX_WAYPOINTS: Final = 5000
MAX_MOVE: Final = 1000
"""Characters of a move in a path."""
NUMBER: Final = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
MOVE: Final = re.compile(
    rf"(movej|movel)\((p?)\[([^\]]*)\]\s*,\s*a=({NUMBER})\s*,\s*v=({NUMBER})\s*,\s*r=({NUMBER})\s*\)"
)
PROGRESS: Final = re.compile(r"signal_async_progress\((\d{1,9})\)")


@dataclass(frozen=True, slots=True)
class PathMove:
    """Move to a waypoint."""

    straight: bool
    is_pose: bool
    target: tuple[float, ...]
    acceleration: float
    speed: float


@dataclass(frozen=True, slots=True)
class Upload:
    """Parts in which uploads of the control script differ."""

    offset: int
    path: tuple[PathMove | int, ...] = ()
    """Moves of a path, and the progress reports between them."""

    def move_path(self, functions: ScriptFunctions, progress: Callable[[int], None]) -> Steps:
        """Run the injected moves in order; each ends at rest, whatever its blend radius."""
        for step in self.path:
            if isinstance(step, int):
                progress(step)
                continue
            target = step.target
            if step.straight:
                pose = target if step.is_pose else functions.arm.pose(target)
                yield from functions.movel(pose, step.acceleration, step.speed)
            else:
                q = functions.inverse(target) if step.is_pose else target
                yield from functions.movej(q, step.acceleration, step.speed)


def recognised(text: str) -> Upload | None:
    """Return the upload of the control script in a text, or None for any other program.

    Raises:
        ScriptError: A move of the path cannot be read.
    """
    if not all(mark in text for mark in MARKS):
        return None
    found = OFFSET.search(text)
    offset = int(found[1]) if found else 0
    if offset not in OFFSETS:
        message = f"registers from {offset} on: must be from 0 or 24 on"
        raise ScriptError(message)
    begin = text.find(PATH)
    end = PATH_ENDS.search(text, begin) if begin >= 0 else None
    return Upload(offset, tuple(_path_steps(text[begin + len(PATH) : end.start()])) if end else ())


def _finite_numbers(text: str) -> tuple[float, ...]:
    """Return the finite numbers between commas; none if one is not finite."""
    try:
        numbers = tuple(map(float, text.split(",")))
    except ValueError:
        return ()
    return numbers if all(map(math.isfinite, numbers)) else ()


def _path_steps(body: str) -> Iterator[PathMove | int]:
    moves = 0
    for line in body.splitlines():
        line = line.strip()[: MAX_MOVE + 1]  # noqa: PLW2901
        if found := PROGRESS.match(line):
            yield int(found[1])
        elif line.startswith("move"):
            move = MOVE.match(line) if len(line) <= MAX_MOVE else None
            numbers = _finite_numbers(move[3]) if move else ()
            if move is None or len(numbers) != 6:
                message = f"movePath: {line[:MAX_SHOWN]!r} cannot be read"
                raise ScriptError(message)
            moves += 1
            if moves > MAX_WAYPOINTS:
                message = f"movePath: more than {MAX_WAYPOINTS} waypoints"
                raise ScriptError(message)
            yield PathMove(move[1] == "movel", move[2] == "p", numbers, float(move[4]), float(move[5]))


# --------------------------------------------------------------------------------------------------------- threads


class ControlProgram:
    """Threads and globals of the control script.

    Args:
        upload: Parts that differ in this upload.
        functions: URScript functions of the program with these threads.
        registers: Commands, arguments and answers.
        setup: Settings of the program.
    """

    def __init__(self, upload: Upload, functions: ScriptFunctions, registers: Registers, setup: Setup) -> None:
        self.upload = upload
        self.program = functions.program
        self.functions = functions
        self.registers = registers
        self.setup = setup
        self.progress = AsyncProgress(lambda value: registers.write_integer(2, value))
        self._threads: dict[str, Thread] = {}
        self._servo_target: Six = (0.0,) * 6
        self._servo: tuple[float, float, float] = (0.002, 0.1, 300.0)
        self._circular: tuple[Six, float, float] = ((0.0,) * 6, 0.25, 1.2)
        self._speed: tuple[bool, Six, float, float] = (False, (0.0,) * 6, 0.5, 0.5)
        self._force: tuple[Six, tuple[bool, ...], Six, int, Six] | None = None
        self._jog: JogSpeed | None = None
        self._stops_along_tool = False
        self._step_back = 0
        self._contact_seen = False
        self._commands = self._table()

    def main(self) -> Steps:
        """Run the main thread."""
        force_mode = self.functions.robot.force_mode
        if self.setup.version.has(None, (5, 0)):
            force_mode.gain_scaling = 0.5
        force_mode.damping = 0.025
        self.progress.end()
        self._signal(READY)
        executing = False
        while True:
            command = self.registers.integer(0)
            if command == 0 and self._contact_seen:
                self._contact_seen = False
                yield from self._return_to_contact()
                # The script handles this like a command.
                self._signal(DONE)
                executing = True
            elif command in REALTIME:
                yield from self._process(command)
                self._signal(READY)
            elif command == 0:
                executing = False
                self._signal(READY)
            elif not executing:
                if command == STOP_SCRIPT:
                    return
                yield from self._process(command)
                self._signal(DONE)
                executing = True
            yield

    def _process(self, command: int) -> Steps:
        handler = self._commands.get(command)
        if handler is not None and (steps := handler()) is not None:
            yield from steps

    def _signal(self, value: int) -> None:
        self.registers.write_integer(0, value)

    def _table(self) -> dict[int, Command]:
        return {
            1: lambda: self._move("movej"),
            2: lambda: self._move("movej_ik"),
            3: lambda: self._move("movel"),
            4: lambda: self._move("movel_fk"),
            6: self._force_mode,
            7: self._force_mode_stop,
            9: lambda: self._speeding(along_tool=False),
            10: lambda: self._speeding(along_tool=True),
            11: lambda: self._servoing(self.registers.six(0)),
            12: self._servoc,
            15: self._speed_stop,
            16: self._servo_stop,
            24: lambda: self._servoing(self.functions.inverse(self.registers.six(0))),
            33: self._stop,
            34: self._stop,
            41: self._start_jog,
            42: self._stop_jog,
            45: self._move_path,
            51: self._move_until_contact,
            62: self._start_contact_detection,
            63: self._stop_contact_detection,
            64: lambda: self.registers.write_integer(1, self._step_back),
            **ImmediateCommands(self.functions, self.registers, self.setup).table(),
        }

    # ------------------------------------------------------------------------------------------------- threads

    def _run(self, name: str, steps: Steps) -> None:
        self._threads[name] = self.program.spawn(steps)

    def _keep(self, name: str, loop: Callable[[], Steps]) -> None:
        thread = self._threads.get(name)
        if thread is None or not thread.alive:
            self._run(name, loop())

    def _kill(self, name: str) -> bool:
        thread = self._threads.get(name)
        if thread is None or not thread.alive:
            return False
        thread.kill()
        return True

    # --------------------------------------------------------------------------------------------------- moves

    def _move(self, kind: str) -> Steps:
        target = self.registers.six(0)
        speed, acceleration = self.registers.double(6), self.registers.double(7)
        if kind == "movej_ik":
            target = self.functions.inverse(target)
        elif kind == "movel_fk":
            target = self.functions.arm.pose(target)
        move = self.functions.movej if kind.startswith("movej") else self.functions.movel
        return self._moved(lambda: move(target, acceleration, speed))

    def _moved(self, begin: Callable[[], Steps]) -> Steps:
        self._stop_async_move()
        if self.registers.integer(1) == 1:
            self._run("move", self._async(begin))
        else:
            yield from begin()

    def _async(self, begin: Callable[[], Steps]) -> Steps:
        self.progress.begin()
        yield from begin()
        self.progress.end()

    def _stop_async_move(self) -> None:
        if self._kill("move"):
            # The thread can no longer report it.
            self.progress.end()

    def _move_path(self) -> Steps:
        return self._moved(lambda: self.upload.move_path(self.functions, self.progress.progress))

    def _stop(self) -> Steps:
        # The script does not distinguish stopj from stopl here.
        deceleration, is_async = self.registers.double(0), self.registers.integer(1) == 1
        must_stop = True
        if self._kill("stop"):
            must_stop = False
            self.progress.end()
        self._stop_async_move()
        if not must_stop:
            return
        if is_async:
            self._stops_along_tool = True
            self._run("stop", self._async(lambda: self.functions.stopl(deceleration)))
        else:
            stop = self.functions.stopl if self._stops_along_tool else self.functions.stopj
            yield from stop(deceleration)

    # ------------------------------------------------------------------------------------------ servo and speed

    def _servoing(self, target: Six) -> None:
        registers = self.registers
        self._servo_target = target
        self._servo = registers.double(8), registers.double(9), registers.double(10)
        self.setup.engage()
        self._keep("servo", self._servo_loop)

    def _servo_loop(self) -> Steps:
        while True:
            yield from self.functions.servoj(self._servo_target, *self._servo)

    def _servoc(self) -> None:
        registers = self.registers
        self._circular = registers.six(0), registers.double(6), registers.double(7)
        self.setup.engage()
        self._keep("servoc", self._servoc_loop)

    def _servoc_loop(self) -> Steps:
        while True:
            pose, speed, acceleration = self._circular
            yield from self.functions.movel(pose, acceleration, speed)

    def _servo_stop(self) -> Steps:
        self._kill("servo")
        self._kill("servoc")
        return self.functions.stopj(self.registers.double(0))

    def _speeding(self, *, along_tool: bool) -> None:
        registers = self.registers
        self._speed = along_tool, registers.six(0), registers.double(6), registers.double(7)
        self.setup.engage()
        self._keep("speed", self._speed_loop)

    def _speed_loop(self) -> Steps:
        while True:
            along_tool, velocity, acceleration, time_s = self._speed
            yield from (self.functions.speedl if along_tool else self.functions.speedj)(velocity, acceleration, time_s)

    def _speed_stop(self) -> Steps:
        self._kill("speed")
        stop = self.functions.stopl if self._speed[0] else self.functions.stopj
        return stop(self.registers.double(0))

    # -------------------------------------------------------------------------------------------------- force

    def _force_mode(self) -> None:
        registers = self.registers
        selection = tuple(registers.integer(number) != 0 for number in range(2, 8))
        self._force = registers.six(0), selection, registers.six(6), registers.integer(1), registers.six(12)
        self._keep("force", self._force_loop)

    def _force_loop(self) -> Steps:
        while self._force is not None:
            self.functions.robot.force_mode.begin(*self._force)
            yield

    def _force_mode_stop(self) -> Steps:
        self._kill("force")
        self.functions.robot.end_force_mode()
        return self.functions.stopl(FORCE_STOP_DECELERATION)

    # ----------------------------------------------------------------------------------------------------- jog

    def _start_jog(self) -> None:
        registers = self.registers
        self._jog = JogSpeed(registers.six(0), int(registers.double(6)), registers.double(7), registers.six(8))
        self._keep("jog", self._jog_loop)

    def _jog_loop(self) -> Steps:
        while self._jog is not None:
            velocity = self._jog.in_base(self.functions.robot.measured.tool)
            yield from self.functions.speedl(velocity, self._jog.acceleration, JOG_TIME_S)

    def _stop_jog(self) -> Steps | None:
        return self.functions.stopl(JOG_STOP_DECELERATION) if self._kill("jog") else None

    # ------------------------------------------------------------------------------------------------- contact

    def _start_contact_detection(self) -> None:
        self._kill("contact")
        self._run("contact", self._contact_loop(self.registers.six(0)))

    def _contact_loop(self, direction: Six) -> Steps:
        self._step_back = 0
        follows_tool = max(map(abs, direction)) < 1e-10

        def contact() -> int:
            return self.functions.tool_contact(self.functions.robot.measured.velocity if follows_tool else direction)

        # An existing contact does not count as a new one.
        while contact() > 0:
            yield
        while (step_back := contact()) == 0:
            yield
        self._step_back = step_back
        self._contact_seen = True

    def _stop_contact_detection(self) -> None:
        self._kill("contact")
        self.registers.write_integer(1, self._step_back)

    def _return_to_contact(self) -> Steps:
        self._stop_async_move()
        for name in ("speed", "servo", "jog"):
            self._kill(name)
        yield from self._go_back(self._step_back)

    def _move_until_contact(self) -> Steps:
        registers = self.registers
        velocity, direction, acceleration = registers.six(0), registers.six(6), registers.double(12)
        while (step_back := self.functions.tool_contact(direction)) <= 0:
            yield from self.functions.speedl(velocity, acceleration, self.functions.robot.period_s)
        yield from self._go_back(step_back)

    def _go_back(self, step_back: int) -> Steps:
        """Stop, then move to the position of `step_back` control cycles ago."""
        q = self.functions.positions_before(step_back)
        yield from self.functions.stopl(CONTACT_STOP_DECELERATION)
        yield from self.functions.movel(self.functions.arm.pose(q), 1.2, 0.25)


class AsyncProgress:
    """The register of asynchronous moves: bits 0-14 progress, 15 running, 16-22 writes modulo 128, 24-30 operation.

    Args:
        write: Writes the register.
    """

    def __init__(self, write: Callable[[int], None]) -> None:
        self._write = write
        self._writes = 0
        self._operation = 0

    def begin(self) -> None:
        """Begin a new operation."""
        self._operation = (self._operation + 1) % COUNT_MODULUS
        self._write_low(RUNNING)

    def progress(self, value: int) -> None:
        """Report progress; as in the script, 0 begins a new operation and a negative value ends it."""
        if value == 0:
            self.begin()
        elif value < 0:
            self.end()
        else:
            self._write_low(RUNNING + min(value, MAX_PROGRESS))

    def end(self) -> None:
        """End the operation."""
        self._write_low(0)

    def _write_low(self, low: int) -> None:
        self._writes = (self._writes + 1) % COUNT_MODULUS
        self._write(self._operation << 24 | self._writes << 16 | low)


@dataclass(frozen=True, slots=True)
class JogSpeed:
    """Arguments of jogStart: speeds in the base frame, the tool frame or a feature."""

    speeds: Six
    feature: int
    acceleration: float
    frame: Six

    def in_base(self, tool: Array) -> Six:
        """Return the velocity in the base frame, given base_from_tool, (4, 4)."""
        if self.feature == BASE:
            return self.speeds
        rotation = tool[:3, :3] if self.feature == TOOL else matrix_from_rotvec(self.frame[3:])
        return six((np.array(self.speeds).reshape(2, 3) @ rotation.T).ravel())


# -------------------------------------------------------------------------------------- commands that take no time


class ImmediateCommands:
    """Commands that neither move the arm nor take time.

    Each reads its arguments from registers and writes its result there.
    """

    def __init__(self, functions: ScriptFunctions, registers: Registers, setup: Setup) -> None:
        self.functions = functions
        self.robot = functions.robot
        self.registers = registers
        self.setup = setup

    def table(self) -> dict[int, Command]:
        """Return the commands by number."""
        registers, force_mode = self.registers, self.robot.force_mode
        return {
            8: self.robot.sensing.zero,
            17: lambda: self.setup.set_payload(registers.double(0), registers.six(1)[:3]),
            18: lambda: self._freedrive(on=True),
            19: lambda: self._freedrive(on=False),
            20: lambda: force_mode.set_damping(registers.double(0)),
            21: self._since((5, 0), lambda: force_mode.set_gain_scaling(registers.double(0))),
            25: lambda: registers.write_integer(1, self.functions.tool_contact(registers.six(0))),
            26: lambda: registers.write_double(0, self.robot.period_s),
            27: lambda: registers.write_six(0, self.functions.positions_before(registers.integer(1))),
            28: self._target_waypoint,
            29: lambda: self.robot.set_tcp(registers.six(0)),
            30: lambda: registers.write_six(0, self.functions.inverse(registers.six(0), registers.six(6))),
            31: lambda: self.setup.protective_stop("protective_stop() of the program"),
            35: lambda: self.setup.set_watchdog(registers.command, registers.double(0)),
            36: lambda: self._answer(yes=self.functions.has_inverse(registers.six(0))),
            37: lambda: self._answer(yes=self.functions.arm.is_within_limits(registers.six(0))),
            38: lambda: registers.write_six(0, tuple(-torque for torque in self.robot.measured.torque)),
            39: lambda: registers.write_six(0, six(pose_trans(registers.six(0), registers.six(6)))),
            40: lambda: registers.write_six(0, self.functions.arm.tcp_offset),
            43: lambda: registers.write_six(0, self.robot.measured.pose),
            44: lambda: registers.write_six(0, self.functions.arm.pose(registers.six(0), registers.six(6))),
            46: lambda: registers.write_six(0, self.functions.inverse(registers.six(0))),
            47: lambda: self._answer(yes=self.robot.is_steady),
            52: lambda: self._freedrive(on=True),
            53: lambda: self._freedrive(on=False),
            54: lambda: registers.write_integer(1, int(self.setup.freedrive)),
            56: self._external_sensor,
            57: self._external_sensor,
            58: lambda: registers.write_six(0, self.functions.arm.flange_pose(self.robot.measured.q)),
            59: lambda: self.setup.set_gravity(registers.six(0)[:3]),
            60: self._since((5, 10), lambda: self._has_inverse(None), cb3=(3, 15)),
            61: self._since((5, 10), lambda: self._has_inverse(registers.six(6)), cb3=(3, 15)),
            65: self._since((5, 10), self._set_target_payload),
            66: self._since((5, 26), self._direct_torque),
            67: self._since((5, 23), lambda: self._dynamics("get_mass_matrix")),
            68: self._since((5, 23), lambda: self._dynamics("get_coriolis_and_centrifugal_torques")),
            69: self._since((5, 23), lambda: registers.write_six(0, self.robot.target.qdd)),
            70: self._since((5, 23), self._jacobian),
            71: self._since((5, 23), self._jacobian_rate),
        }

    def _since(self, e_series: tuple[int, ...], command: Command, cb3: tuple[int, ...] | None = None) -> Command:
        """Return a command that older controllers accept and ignore."""
        return command if self.setup.version.has(cb3, e_series) else lambda: None

    def _answer(self, *, yes: bool) -> None:
        self.registers.write_integer(1, int(yes))

    def _freedrive(self, *, on: bool) -> None:
        self.setup.freedrive = on
        self.robot.set_freedrive(on=on)

    def _target_waypoint(self) -> None:
        motion = self.robot.motion
        arm = self.functions.arm
        goal = motion.goal if isinstance(motion, Move) else self.robot.target.q
        along_tool = isinstance(motion, Move) and motion.arm is not None
        self.registers.write_six(0, goal if along_tool else arm.pose(goal))

    def _external_sensor(self) -> None:
        self.setup.external_sensor = self.registers.integer(1) == 1

    def _has_inverse(self, near: Six | None) -> None:
        self._answer(yes=self.functions.has_inverse(self.registers.six(0), near))

    def _set_target_payload(self) -> None:
        self.setup.set_payload(self.registers.double(0), self.registers.six(1)[:3])
        self.setup.payload_inertia = self.registers.six(4)

    def _direct_torque(self) -> None:
        self.functions.begin(Torque(self.registers.six(0), self.robot.loop.inertia, self.robot.friction))

    def _dynamics(self, name: str) -> None:
        message = f"{name}: the emulator has no masses and inertias of the links"
        raise ScriptError(message)

    def _jacobian(self) -> None:
        _, jacobian = self.functions.arm.transform_and_jacobian(self.robot.measured.q)
        self._matrix(jacobian.ravel(order="F").tolist())

    def _jacobian_rate(self) -> None:
        measured = self.robot.measured
        rate = self.functions.arm.jacobian_rate(measured.q, measured.qd)
        self._matrix(rate.ravel(order="F").tolist())

    def _matrix(self, numbers: list[float]) -> None:
        for register, number in zip(MATRIX_REGISTERS, numbers, strict=True):
            self.registers.write_double(register, number)
