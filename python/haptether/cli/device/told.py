"""Messages that a driver has printed: the table of a check does not repeat them."""

import contextlib
import sys
import threading
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any, TextIO

if TYPE_CHECKING:
    from haptether.bridge.devices.check.finding import Finding

SEE_ABOVE = "see above"
CONTROL = frozenset("\r\x1b")
MIN_MESSAGE = 8
"""Characters; a shorter message may be a part of any text."""


class Told:
    """A stream that keeps what is written to it, and passes it on; a line of the driver only once.

    The driver is opened a second time, and would repeat its checklist and its faults. Its threads are others than that
    of the command; the status line, which has a thread as well, is known by its control characters.

    Args:
        stream: Takes it as well.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._lines: set[str] = set()
        self._skipped: int | None = None
        """Thread whose line was left out, and whose end of line follows."""
        self.text = ""

    def write(self, text: str) -> int:
        """Writes to both."""
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
        """All else is that of the stream."""
        return getattr(self._stream, name)

    def shortened(self, found: "Iterable[Finding]", messages: Iterable[str]) -> "list[Finding]":
        """Return the findings with each message only at its first place, and without messages printed before.

        Args:
            found: In the order of the table.
            messages: Messages of the driver's errors and faults.
        """
        longest = sorted({message for message in messages if len(message) >= MIN_MESSAGE}, key=len, reverse=True)
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
    """Without white space: a terminal may have broken its lines anywhere."""
    return "".join(text.split())


@contextlib.contextmanager
def listening() -> Iterator[Told]:
    """Within it, what is printed to standard error is kept as well."""
    told = Told(sys.stderr)
    with contextlib.redirect_stderr(told):
        yield told
