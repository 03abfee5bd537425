"""The control script of ur_rtde: commands come in registers, and answers go there.

It is not interpreted but recognised; this is what it does, thread by thread. Every control cycle the main loop reads a
command from the first integer register. Those of the real-time class are done and answered by 1 ("ready") at once, and
done again for as long as the register keeps them; any other is done once and answered by 2 ("done") until the register
is 0 again. Command 255 ends the program.

Source: control script of ur_rtde 1.6.5 (SDU Robotics, MIT licence).
"""

from collections.abc import Callable
from typing import Final

from haptether.slave.ur_emulator.async_progress import AsyncProgress
from haptether.slave.ur_emulator.control_answers import Answers
from haptether.slave.ur_emulator.control_uploads import Upload
from haptether.slave.ur_emulator.jogging import JogSpeed
from haptether.slave.ur_emulator.registers import Registers, Six
from haptether.slave.ur_emulator.script.functions import ScriptFunctions
from haptether.slave.ur_emulator.script.program import Steps, Thread
from haptether.slave.ur_emulator.script_error import ScriptError
from haptether.slave.ur_emulator.setup import Setup

READY, DONE = 1, 2
REALTIME: Final = frozenset({6, 9, 10, 11, 24, 25, 26, 27, 38, 58, *range(66, 72)})
STOP_SCRIPT, DIRECT_TORQUE = 255, 66
FORCE_STOP_DECELERATION, JOG_STOP_DECELERATION, CONTACT_STOP_DECELERATION = 10.0, 1.2, 3.0
JOG_TIME_S: Final = 0.01

Done = Steps | None


class ControlProgram:
    """Threads and globals of the control script.

    Args:
        upload: What the client sent.
        functions: What URScript can do, in the program whose threads these are.
        registers: Where commands and answers are.
        setup: What is set up: tool, payload, watchdog.
        tell: Takes lines for the log.
    """

    def __init__(
        self,
        upload: Upload,
        functions: ScriptFunctions,
        registers: Registers,
        setup: Setup,
        tell: Callable[[str], None],
    ) -> None:
        self.upload = upload
        self.program = functions.program
        self.do = functions
        self.registers = registers
        self.setup = setup
        self.tell = tell
        self.progress = AsyncProgress(lambda word: registers.write_integer(2, word))
        self.answers = Answers(functions, registers, setup)
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
        """The main thread."""
        self.setup.force_mode_defaults(self.do.robot.force_mode)
        self.progress.end()
        self._signal(READY)
        executing = False
        while True:
            command = self.registers.integer(0)
            if command == 0 and self._contact_seen:
                self._contact_seen = False
                yield from self._return_to_contact()
                # The script takes this for a command that it has done.
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

    def _table(self) -> dict[int, Callable[[], Done]]:
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
            24: lambda: self._servoing(self.do.inverse(self.registers.six(0))),
            33: self._stop,
            34: self._stop,
            41: self._start_jog,
            42: self._stop_jog,
            45: self._move_path,
            51: self._move_until_contact,
            62: self._start_contact_detection,
            63: self._stop_contact_detection,
            64: lambda: self.registers.write_integer(1, self._step_back),
            **self.answers.table(),
        }

    # ------------------------------------------------------------------------------------------------- threads

    def _run(self, name: str, steps: Steps) -> None:
        self._threads[name] = self.program.spawn(steps)

    def _runs(self, name: str) -> bool:
        thread = self._threads.get(name)
        return thread is not None and thread.alive

    def _kill(self, name: str) -> bool:
        runs = self._runs(name)
        if runs:
            self._threads[name].kill()
        return runs

    # --------------------------------------------------------------------------------------------------- moves

    def _move(self, kind: str) -> Steps:
        target = self.registers.six(0)
        speed, acceleration = self.registers.double(6), self.registers.double(7)
        if kind == "movej_ik":
            target = self.do.inverse(target)
        elif kind == "movel_fk":
            target = self.do.arm.pose(target)
        move = self.do.movej if kind.startswith("movej") else self.do.movel
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
            # The thread cannot say it any more.
            self.progress.end()

    def _move_path(self) -> Steps:
        return self._moved(lambda: self.upload.move_path(self.do, self.progress.progress))

    def _stop(self) -> Steps:
        # The script looks at nothing else: which of the two was asked for, it does not know.
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
            self._run("stop", self._async(lambda: self.do.stopl(deceleration)))
        else:
            stop = self.do.stopl if self._stops_along_tool else self.do.stopj
            yield from stop(deceleration)

    # ------------------------------------------------------------------------------------------ servo and speed

    def _servoing(self, target: Six) -> None:
        registers = self.registers
        self._servo_target = target
        self._servo = registers.double(8), registers.double(9), registers.double(10)
        self.setup.engage()
        if not self._runs("servo"):
            self._run("servo", self._servo_loop())

    def _servo_loop(self) -> Steps:
        while True:
            yield from self.do.servoj(self._servo_target, *self._servo)

    def _servoc(self) -> None:
        registers = self.registers
        self._circular = registers.six(0), registers.double(6), registers.double(7)
        self.setup.engage()
        if not self._runs("servoc"):
            self._run("servoc", self._servoc_loop())

    def _servoc_loop(self) -> Steps:
        while True:
            pose, speed, acceleration = self._circular
            yield from self.do.movel(pose, acceleration, speed)

    def _servo_stop(self) -> Steps:
        self._kill("servo")
        self._kill("servoc")
        return self.do.stopj(self.registers.double(0))

    def _speeding(self, *, along_tool: bool) -> None:
        registers = self.registers
        self._speed = along_tool, registers.six(0), registers.double(6), registers.double(7)
        self.setup.engage()
        if not self._runs("speed"):
            self._run("speed", self._speed_loop())

    def _speed_loop(self) -> Steps:
        while True:
            along_tool, velocity, acceleration, time_s = self._speed
            yield from (self.do.speedl if along_tool else self.do.speedj)(velocity, acceleration, time_s)

    def _speed_stop(self) -> Steps:
        self._kill("speed")
        stop = self.do.stopl if self._speed[0] else self.do.stopj
        return stop(self.registers.double(0))

    # -------------------------------------------------------------------------------------------------- force

    def _force_mode(self) -> None:
        registers = self.registers
        selection = tuple(registers.integer(number) != 0 for number in range(2, 8))
        self._force = registers.six(0), selection, registers.six(6), registers.integer(1), registers.six(12)
        if not self._runs("force"):
            self._run("force", self._force_loop())

    def _force_loop(self) -> Steps:
        while self._force is not None:
            self.do.robot.force_mode.begin(*self._force)
            yield

    def _force_mode_stop(self) -> Steps:
        self._kill("force")
        self.do.robot.end_force_mode()
        return self.do.stopl(FORCE_STOP_DECELERATION)

    # ----------------------------------------------------------------------------------------------------- jog

    def _start_jog(self) -> None:
        registers = self.registers
        self._jog = JogSpeed(registers.six(0), int(registers.double(6)), registers.double(7), registers.six(8))
        if not self._runs("jog"):
            self._run("jog", self._jog_loop())

    def _jog_loop(self) -> Steps:
        while self._jog is not None:
            velocity = self._jog.in_base(self.do.robot.measured.tool)
            yield from self.do.speedl(velocity, self._jog.acceleration, JOG_TIME_S)

    def _stop_jog(self) -> Done:
        return self.do.stopl(JOG_STOP_DECELERATION) if self._kill("jog") else None

    # ------------------------------------------------------------------------------------------------- contact

    def _start_contact_detection(self) -> None:
        self._kill("contact")
        self._run("contact", self._contact_loop(self.registers.six(0)))

    def _contact_loop(self, direction: Six) -> Steps:
        self._step_back = 0
        follows_tool = max(map(abs, direction)) < 1e-10

        def contact() -> int:
            return self.do.tool_contact(self.do.robot.measured.velocity if follows_tool else direction)

        # What touches already is no new contact.
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
        q = self.do.positions_before(self._step_back)
        yield from self.do.stopl(CONTACT_STOP_DECELERATION)
        yield from self.do.movel(self.do.arm.pose(q), 1.2, 0.25)

    def _move_until_contact(self) -> Steps:
        registers = self.registers
        velocity, direction, acceleration = registers.six(0), registers.six(6), registers.double(12)
        while (step_back := self.do.tool_contact(direction)) <= 0:
            yield from self.do.speedl(velocity, acceleration, self.do.robot.period_s)
        q = self.do.positions_before(step_back)
        yield from self.do.stopl(CONTACT_STOP_DECELERATION)
        yield from self.do.movel(self.do.arm.pose(q), 1.2, 0.25)


__all__ = ["ControlProgram", "ScriptError"]
