"""Messages that a driver has printed: the table of a check does not repeat them."""

import contextlib
import sys
import threading
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any, TextIO

from haptether.printed import MIN_CHARACTERS, SEE_ABOVE

if TYPE_CHECKING:
    from haptether.bridge.devices.check.finding import Finding

CONTROL = frozenset("\r\x1b")


class Told:
    """A stream that records what is written to it and passes it on; each line of the driver only once.

    The driver is opened a second time, and would repeat its checklist and its faults. Its lines come from other threads
    than the main thread. The status line, which also has its own thread, is known by its control characters.

    Args:
        stream: Receives the text.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._lines: set[str] = set()
        self._skipped: int | None = None
        """Thread whose line was skipped, and whose end of line follows."""
        self.text = ""

    def write(self, text: str) -> int:
        """Write to the stream and record the text."""
        thread, line = threading.get_ident(), text.rstrip("\n")
        is_drivers = thread != threading.main_thread().ident and CONTROL.isdisjoint(text)
        if is_drivers and not line and self._skipped == thread:
            self._skipped = None
        elif is_drivers and line in self._lines:
            self._skipped = thread if line == text else None
        else:
            if is_drivers and line:
                self._lines.add(line)
            self.text += text
            self._stream.write(text)
        return len(text)

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401  # of the stream
        """Delegate everything else to the stream."""
        return getattr(self._stream, name)

    def shortened(self, found: "Iterable[Finding]", messages: Iterable[str]) -> "list[Finding]":
        """Return the findings with each message only at its first place, and without messages printed before.

        Args:
            found: In the order of the table.
            messages: Messages of the driver's errors and faults.
        """
        longest = sorted({message for message in messages if len(message) >= MIN_CHARACTERS}, key=len, reverse=True)
        seen, shown = _squeezed(self.text), []
        for finding in found:
            text = finding.text
            for message in longest:
                # A checklist prints its refusals one by one, and raises them together.
                if message in text and all(_squeezed(part) in seen for part in message.split("; ")):
                    text = text.replace(message, SEE_ABOVE)
            seen += _squeezed(finding.text)
            shown.append(finding if text == finding.text else type(finding)(finding.check, finding.verdict, text))
        return shown


def _squeezed(text: str) -> str:
    """Remove white space: a terminal may have broken the lines anywhere."""
    return "".join(text.split())


@contextlib.contextmanager
def listening() -> Iterator[Told]:
    """Record standard error within this context, and pass it on."""
    told = Told(sys.stderr)
    with contextlib.redirect_stderr(told):
        yield told
