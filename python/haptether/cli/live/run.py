"""The main thread of a running side: its status, why it is not coupled, the flight recorder's file."""

import contextlib
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import msgspec

from haptether.bridge import DeviceRun
from haptether.bridge.flight import Cause, Step
from haptether.cli.device.consent import can_ask, says_yes
from haptether.cli.live.options import marked
from haptether.cli.shared.output import QueuedWriter
from haptether.cli.shared.stop import Stopped, wait
from haptether.printable import printable
from haptether.printed import forget, printed, shortened
from haptether.private_file import refuse_link, write_private

if TYPE_CHECKING:
    from haptether.bridge import LiveMaster, LiveSlave, LoopReport, MasterTrace, SlaveTrace
    from haptether.cli.live.panel_process import PanelProcess


SEEN_S = 0.2
"""Time in s after which the loop has taken a press, or has said why not."""
OLD_START = "the start was more than 5 s ago when the loop began, and is no press of the clutch any more"


class SideWatch:
    """Show the status of a side until its loop ends, and afterwards why it was not coupled.

    Args:
        name: `master` or `slave`.
        side: The side whose loop runs.
        stopped: Ends the wait.
        flight: Written at stops and faults.
        insecure: True without a key.
        press: Presses the clutch if the start is to do so; None otherwise.
    """

    SIGNALS: ClassVar = {
        ("master", "press"): "USR1",
        ("master", "acknowledge"): "USR2",
        ("slave", "acknowledge"): "USR2",
    }
    HELD: ClassVar = {"hold", "stop", "fault"}

    def __init__(
        self,
        name: str,
        side: "LiveMaster | LiveSlave | DeviceRun",
        stopped: Stopped,
        flight: "FlightFile",
        *,
        insecure: bool,
        press: Callable[[], None] | None = None,
    ) -> None:
        self.refused: str | None = None
        """Reason why the slave refused this master, if it did."""
        self.has_void_start = False
        """True if the run ended because its start was too long ago to press the clutch, and nobody pressed instead."""
        self._press = press
        self._has_asked = False
        self._name = name
        self._side = side
        self._stopped = stopped
        self._flight = flight
        self._insecure = insecure
        self._cause: Cause | None = None
        self._printed: Cause | None = None
        """The cause that stands last on standard error."""
        self._ineffective_presses = 0
        self._is_engaged = False

    def until_end(self, headline: str, panel: "PanelProcess | None", *, quiet: bool) -> None:
        """Print `headline` and the state of real time, then show the side until its loop has ended or is stopped.

        Without a panel process, or after its end, the status is a line.
        """
        headline = f"{marked(headline, insecure=self._insecure)}\nreal time: {self._side.realtime}"
        # The operator or a parent process reads this line to learn that the socket is open.
        print(headline, file=sys.stderr, flush=True)
        self._show(panel, quiet=quiet)
        if self._start_is_void() and self._is_pressed_again():
            self._show(None, quiet=quiet)

    def _show(self, panel: "PanelProcess | None", *, quiet: bool) -> None:
        if panel is not None:
            with panel.says():
                is_over = lambda: self._is_over() or not panel.draws  # noqa: E731
                wait("", self._status, is_over, self._stopped, None, shown=False)
            panel.end()
            # The panel process may have lost the lines.
            self._printed = None
            forget()
            if self._is_over() or self._stopped:
                return
            # Print the cause again.
            self._cause = None
        wait("", self._status, self._is_over, self._stopped, None, shown=not quiet)

    def _is_over(self) -> bool:
        return self._side.finished or self._start_is_void()

    def _start_is_void(self) -> bool:
        """Return true if the start is too old to press the clutch, and nobody has been asked to press instead."""
        waits = self._press is not None and not self._has_asked and not self._stopped
        return waits and self._side.start_is_void and not self._side.finished

    def _is_pressed_again(self) -> bool:
        """Ask for a press on the terminal; return false if nobody presses, and the run ends."""
        self._has_asked = True
        self._ineffective_presses = self._side.ineffective_presses[0]

        def is_over() -> bool:
            self._status()
            # A press elsewhere, such as at the console, answers it, too.
            return bool(self._stopped) or self._side.finished or self._is_engaged

        if self._press is not None and can_ask():
            print(OLD_START, file=sys.stderr, flush=True)
            while says_yes("Type yes and press Enter to press it now, anything else to end the run: ", is_over):
                before = self._ineffective_presses
                self._press()
                self._stopped.sleep(SEEN_S)
                # The status says why a press did nothing; then it is the person's choice to press again.
                self._status()
                if self._ineffective_presses == before:
                    return True
        self.has_void_start = not is_over()
        return self._is_engaged

    def after_end(self, report: "LoopReport") -> Cause | None:
        """Return why a side that has ended is not coupled; print it if a driver ended the side.

        The driver may have ended it before the status was last shown.

        Raises:
            MemoryError: The loop ended because no memory was left; nothing that needs much memory must follow.
        """
        if report.out_of_memory:
            message = "no memory was left: the run was ended, without force, and the other side was sent the end"
            raise MemoryError(message)
        self._print_security()
        self._flight.write(self._side.flight())
        if isinstance(self._side, DeviceRun) and self._side.error is not None:
            self._print_changes()
        cause = self._current_cause()
        if cause is not None and cause == self._printed:
            # The last line of the command does not repeat it.
            printed(cause.text)
            printed(cause.text.partition(": ")[2])
        return cause

    def raise_error(self) -> None:
        """Raise the error that ended the loop of a driver, if there is one."""
        if isinstance(self._side, DeviceRun) and self._side.error is not None:
            raise self._side.error

    def _status(self) -> str:
        side = self._side
        side.poll()
        if self._stopped.take_acknowledgement():
            self._acknowledge()
        self._print_security()
        self._print_changes()
        self._flight.write(side.flight())
        answer = "" if side.is_answered or self._name == "slave" else ", no answer yet"
        fault = side.notes.fault if isinstance(side, DeviceRun) else None
        fault = "" if fault is None else f", {printable(fault)}"
        end = None if side.recording is None else side.recording.end
        recording = "" if end is None else f", recording ended: {end}"
        status = f"{self._name} {side.state}{answer}, {side.ticks} ticks{fault}{recording}"
        return marked(status, insecure=self._insecure)

    def _acknowledge(self) -> None:
        """Pass an acknowledgement on, and say if there was anything to acknowledge."""
        cause = self._current_cause()
        awaited = cause is not None and ("acknowledge", self._name) in {(step.remedy, step.at) for step in cause.steps}
        # A side that has ended meanwhile has nothing to acknowledge.
        with contextlib.suppress(RuntimeError):
            self._side.acknowledge()
        text = "acknowledged: what was wrong counts as mended" if awaited else "there was nothing to acknowledge here"
        print(f"{self._name}: {text}", file=sys.stderr, flush=True)

    def _print_security(self) -> None:
        # A refused master tries again and is refused again.
        if self._name == "slave" or self.refused is None:
            self.refused = print_security(self._side.security_events())

    def _print_changes(self) -> None:
        """Print changes on standard error: why nothing is coupled, the remedies, and why a press does nothing."""
        cause, before = self._current_cause(), self._cause
        self._cause = cause
        if cause is not None and cause != before:
            text = shortened(cause.text)
            self._print(f"{cause.state}: {text}" if cause.state in self.HELD else text, cause)
            self._printed = cause
        presses, why = self._side.ineffective_presses
        if presses != self._ineffective_presses:
            self._ineffective_presses = presses
            is_open = self._name == "master" and self._press is None and self._side.start_is_void
            if is_open and presses == 1:
                # The start of `--clutch open` does not press.
                pass
            elif why is not None:
                again = f"press anew by its button or kill -{self.SIGNALS['master', 'press']} {os.getpid()}"
                print(f"the clutch was pressed for nothing: {why}; {again}", file=sys.stderr, flush=True)
            elif cause is not None:
                self._print(f"the clutch does nothing yet: {shortened(cause.text)}", cause)
        is_engaged = self._side.state == "engaged"
        if is_engaged and not self._is_engaged:
            print(f"{self._name}: engaged", file=sys.stderr, flush=True)
        self._is_engaged = is_engaged

    def _current_cause(self) -> Cause | None:
        cause = self._side.cause()
        return None if cause is None else msgspec.json.decode(cause, type=Cause)

    def _print(self, headline: str, cause: Cause) -> None:
        lines = [headline, *(f"  {number}. {self._text(step)}" for number, step in enumerate(cause.steps, start=1))]
        print("\n".join(printable(line) for line in lines), file=sys.stderr, flush=True)

    def _text(self, step: Step) -> str:
        name = self.SIGNALS.get((step.at, step.remedy))
        if name is None:
            return step.text
        where = f"here: kill -{name} {os.getpid()}" if step.at == self._name else f"there: kill -{name} PID"
        return f"{step.text} ({where})"


def print_kept(trace: "MasterTrace | SlaveTrace", report: "LoopReport") -> None:
    """Print on standard error which part of the run the figures cover, unless they cover all of it."""
    if report.dropped_records and len(trace):
        kept_s = float(trace.time_s[-1] - trace.time_s[0])
        print(f"the figures cover the last {kept_s:.3g} s: --keep-s keeps more", file=sys.stderr, flush=True)


def print_security(events: list[str]) -> str | None:
    """Print the events of the session on standard error; return the reason if the slave refused."""
    refused = None
    for event in events:
        print(printable(event), file=sys.stderr, flush=True)
        refused = event if event.startswith("refused") else refused
    return refused


class FlightFile:
    """A file with the last states and commands, rewritten when they change.

    Raises:
        OSError: A symbolic link: its owner could choose which file is overwritten.
    """

    def __init__(self, path: Path | None) -> None:
        if path is not None:
            refuse_link(path)
        self._path = path
        self._written: str | None = None

    def write(self, flight: str | None) -> None:
        """Write new states and commands; the file is replaced in one step and never seen half written."""
        if self._path is None or flight is None or flight == self._written:
            return
        # Try once: a full disk must not end the run at the stop that the file explains.
        self._written = flight
        try:
            if self._path.exists() and not self._path.is_file():
                # A pipe or a device is not replaced, and a pipe without a reader is not waited for.
                descriptor = os.open(self._path, os.O_WRONLY | os.O_NONBLOCK | os.O_CLOEXEC)
                writer = QueuedWriter(descriptor, "flight")
                writer.put(flight.encode())
                if writer.end(time.monotonic()):
                    os.close(descriptor)
                return
            write_private(self._path, flight.encode())
        except OSError as error:
            print(f"{self._path}: not written: {error.strerror or error}", file=sys.stderr, flush=True)
