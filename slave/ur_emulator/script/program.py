"""A program of the controller: a main thread and others, each a generator that yields once a control cycle."""

from collections.abc import Generator
from dataclasses import dataclass, field

from haptether.slave.ur_emulator.script_error import ScriptError

Steps = Generator[None, None, None]
"""Runs until the end of the control cycle at each `yield`."""


@dataclass(slots=True, eq=False)
class Thread:
    """A thread of URScript."""

    steps: Steps
    alive: bool = True

    def run(self) -> None:
        """Runs until its next `yield`.

        Raises:
            ScriptError: What it did stops the program.
        """
        if self.alive and next(self.steps, self) is self:
            self.alive = False

    def kill(self) -> None:
        """Ends it where it stands."""
        self.alive = False
        self.steps.close()


@dataclass(slots=True, eq=False)
class Program:
    """Threads that live and end together."""

    name: str
    main: Thread | None = None
    others: list[Thread] = field(default_factory=list)
    running: Thread | None = None
    """The thread that runs now."""

    def spawn(self, steps: Steps) -> Thread:
        """Begins a thread besides the main one; it runs first in the next control cycle."""
        thread = Thread(steps)
        self.others.append(thread)
        return thread

    def cycle(self) -> bool:
        """Runs every thread until the end of the control cycle; whether the program goes on.

        The main thread comes last: what it writes for the others reaches them in the next control cycle.

        Raises:
            ScriptError: What a thread did stops the program.
        """
        for thread in (*self.others, *((self.main,) if self.main else ())):
            self.running = thread
            try:
                thread.run()
            except (ValueError, ArithmeticError, TypeError) as error:
                # Numbers that a function cannot do with, a pose of 1e300 m say.
                raise ScriptError(str(error)) from None
        self.others = [thread for thread in self.others if thread.alive]
        return self.main is not None and self.main.alive

    def kill(self) -> None:
        """Ends all threads."""
        for thread in (*self.others, *((self.main,) if self.main else ())):
            thread.kill()
        self.others = []
