"""Program of the controller: its threads, registers and settings."""

import math
from collections.abc import Callable, Generator, Mapping, MutableMapping
from dataclasses import dataclass, field, fields
from typing import Final

from haptether.slave.ur_emulator.robot.kinematics import Six, Three
from haptether.slave.ur_emulator.rtde.variables import ControllerVersion, Value

Steps = Generator[None, None, None]
"""Runs until the end of the control cycle at each `yield`."""

MAX_COG_M: Final = 10.0
MAX_GRAVITY: Final = 100.0


class ScriptError(Exception):
    """URScript runtime error: the program ends, and the message goes to the log and to its sender."""


@dataclass(slots=True, eq=False)
class Thread:
    """URScript thread; each call runs it until the end of a control cycle."""

    steps: Steps
    alive: bool = True

    def run(self) -> None:
        """Run until the next `yield`.

        Raises:
            ScriptError: An error stops the program.
        """
        if self.alive and next(self.steps, self) is self:
            self.alive = False

    def kill(self) -> None:
        """End the thread at its present step."""
        self.alive = False
        self.steps.close()


@dataclass(slots=True, eq=False)
class Program:
    """Main thread and others, which start and end together."""

    name: str
    main: Thread | None = None
    others: list[Thread] = field(default_factory=list)
    running: Thread | None = None
    """Thread that runs now."""

    def spawn(self, steps: Steps) -> Thread:
        """Begin another thread; it runs first in the next control cycle."""
        thread = Thread(steps)
        self.others.append(thread)
        return thread

    def cycle(self) -> bool:
        """Run every thread until the end of the control cycle; return True if the program continues.

        The main thread runs last: its values for the others reach them in the next control cycle.

        Raises:
            ScriptError: An error of a thread stops the program.
        """
        for thread in self._threads():
            self.running = thread
            try:
                thread.run()
            except (ValueError, ArithmeticError, TypeError) as error:
                # Arguments outside the domain of a function, for example a pose of 1e300 m.
                raise ScriptError(str(error)) from None
        self.others = [thread for thread in self.others if thread.alive]
        return self.main is not None and self.main.alive

    def kill(self) -> None:
        """End all threads."""
        for thread in self._threads():
            thread.kill()
        self.others = []

    def _threads(self) -> tuple[Thread, ...]:
        return (*self.others, *((self.main,) if self.main else ()))


class Registers:
    """Input and output registers from an offset: 0, or 24 for the range of external clients.

    Args:
        inputs: Values of the inputs, by name.
        outputs: Values of the outputs, by name.
        offset: Added to every number of a register.
    """

    def __init__(self, inputs: Mapping[str, Value], outputs: MutableMapping[str, Value], offset: int = 0) -> None:
        self._inputs = inputs
        self._outputs = outputs
        numbers = range(offset, 48)
        self._ints = [f"input_int_register_{number}" for number in numbers]
        self._doubles = [f"input_double_register_{number}" for number in numbers]
        self._offset = offset

    @property
    def command(self) -> str:
        """Name of the input register that holds the command."""
        return self._ints[0]

    def integer(self, number: int) -> int:
        """Return an integer input register."""
        return self._inputs[self._ints[number]]  # type: ignore[return-value]  # the table says that it is an integer

    def double(self, number: int) -> float:
        """Return a double input register."""
        return self._inputs[self._doubles[number]]  # type: ignore[return-value]  # the table says that it is a number

    def six(self, first: int) -> Six:
        """Return six double input registers."""
        inputs = self._inputs
        return tuple([inputs[name] for name in self._doubles[first : first + 6]])  # type: ignore[misc]

    def write_integer(self, number: int, value: int) -> None:
        """Write an output register.

        Raises:
            ScriptError: The register does not exist, or cannot hold the number.
        """
        if not -(2**31) <= value < 2**31:
            message = f"output integer register {number} = {value}: must have 32 bits"
            raise ScriptError(message)
        self._write(f"output_int_register_{number + self._offset}", value)

    def write_double(self, number: int, value: float) -> None:
        """Write an output register.

        Raises:
            ScriptError: The register does not exist, or the number is not finite.
        """
        if not math.isfinite(value):
            message = f"output double register {number} = {value}: must be finite"
            raise ScriptError(message)
        self._write(f"output_double_register_{number + self._offset}", value)

    def _write(self, name: str, value: float) -> None:
        if name not in self._outputs:
            message = f"{name}: there is no such register"
            raise ScriptError(message)
        self._outputs[name] = value

    def write_six(self, first: int, values: Six) -> None:
        """Write six double output registers."""
        for number, value in enumerate(values, start=first):
            self.write_double(number, value)


@dataclass(slots=True)
class Setup:
    """Controller settings of programs; payload and gravity outlive the program."""

    version: ControllerVersion
    protective_stop: Callable[[str], None]
    """Requests a protective stop, with its reason."""
    engage: Callable[[], None]
    """Called at each servo or speed command."""
    payload_kg: float = 0.0
    payload_cog: Three = (0.0, 0.0, 0.0)
    payload_inertia: Six = (0.0,) * 6
    gravity: Three = (0.0, 0.0, 9.82)
    watchdog_hz: float | None = None
    """Minimum rate in Hz of writes to the command register; None without a watchdog."""
    watched: str = ""
    """Input that the watchdog monitors."""
    watchdog_is_new: bool = False
    freedrive: bool = False
    external_sensor: bool = False
    """True if the input external_force_torque replaces the force sensor."""

    def set_payload(self, mass_kg: float, cog: Three) -> None:
        """Set the payload; a centre of gravity of zeros keeps the previous one (e-Series)."""
        if not 0.0 <= mass_kg <= 100.0:
            message = f"set_payload: m = {mass_kg:g}: must be between 0 and 100 kg"
            raise ScriptError(message)
        if not max(map(abs, cog)) <= MAX_COG_M:
            message = f"set_payload: cog = {list(cog)}: must be within {MAX_COG_M:g} m of the flange"
            raise ScriptError(message)
        self.payload_kg = mass_kg
        if any(cog) or self.version.is_cb3:
            self.payload_cog = cog

    def set_gravity(self, gravity: Three) -> None:
        """Set the acceleration in m/s² that holds the base up."""
        if not max(map(abs, gravity)) <= MAX_GRAVITY:
            message = f"set_gravity: {list(gravity)}: must be at most {MAX_GRAVITY:g} m/s^2"
            raise ScriptError(message)
        self.gravity = gravity

    def set_watchdog(self, name: str, min_frequency: float) -> None:
        """Set the watchdog: rtde_set_watchdog with action "stop"."""
        if not 0.0 < min_frequency <= self.version.rate_hz or not math.isfinite(min_frequency):
            message = f"rtde_set_watchdog: min_frequency = {min_frequency:g}: must be above 0, at most the control rate"
            raise ScriptError(message)
        self.watchdog_hz, self.watched, self.watchdog_is_new = min_frequency, name, True

    def reset(self) -> None:
        """Restore the defaults of all settings."""
        fresh = Setup(self.version, self.protective_stop, self.engage)
        for setting in fields(self):
            setattr(self, setting.name, getattr(fresh, setting.name))

    def program_ended(self) -> None:
        """Reset the settings that end with a program."""
        self.watchdog_hz = None
        self.freedrive = False
