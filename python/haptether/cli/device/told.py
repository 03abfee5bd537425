"""Messages that a driver has printed: the table of a check does not repeat them."""

import contextlib
import sys
import threading
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any, TextIO

if TYPE_CHECKING:
    from haptether.bridge.devices.check.finding import Finding

SEE_ABOVE = "see above"
MIN_MESSAGE = 8
"""Characters; a shorter message may be a part of any text."""


class Told:
    """A stream that keeps what is written to it, and passes it on; a line of the driver only once.

    The driver is opened a second time, and would repeat its checklist and its faults. Its threads are others than that
    of the command.

    Args:
        stream: Takes it as well.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._begun: dict[int, str] = {}
        """Line without an end, by thread of the driver."""
        self._lines: set[str] = set()
        self.text = ""

    def write(self, text: str) -> int:
        """Writes to both."""
        if threading.current_thread() is threading.main_thread():
            self._pass_on(text)
            return len(text)
        thread = threading.get_ident()
        *lines, self._begun[thread] = (self._begun.get(thread, "") + text).split("\n")
        for line in lines:
            if line not in self._lines:
                self._lines.add(line)
                self._pass_on(f"{line}\n")
        return len(text)

    def _pass_on(self, text: str) -> None:
        self.text += text
        self._stream.write(text)

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401  # of the stream
        """All else is that of the stream."""
        return getattr(self._stream, name)

    def shortened(self, found: "Iterable[Finding]", messages: Iterable[str]) -> "list[Finding]":
        """The findings, each message only where it appears first; one that was printed before appears in none.

        Args:
            found: In the order of the table.
            messages: Of the driver's errors and faults.
        """
        longest = sorted({message for message in messages if len(message) >= MIN_MESSAGE}, key=len, reverse=True)
        seen, shown = self.text, []
        for finding in found:
            text = finding.text
            for message in longest:
                # A checklist prints its refusals one by one, and raises them together.
                if message in text and all(part in seen for part in message.split("; ")):
                    text = text.replace(message, SEE_ABOVE)
            seen += f"\n{finding.text}"
            shown.append(finding if text == finding.text else type(finding)(finding.check, finding.verdict, text))
        return shown


@contextlib.contextmanager
def listening() -> Iterator[Told]:
    """Within it, what is printed to standard error is kept as well."""
    told = Told(sys.stderr)
    with contextlib.redirect_stderr(told):
        yield told
