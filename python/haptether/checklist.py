"""The lines of a checklist before a device moves: what was found, and what to do where it is refused."""

import sys
from collections.abc import Callable


class RefusedError(RuntimeError):
    """The device is not to be moved now."""


class Checklist:
    """Lines of what was found; `finish` raises where one was refused.

    Args:
        device: Named at the begin of each line, with its address.
        report: Takes each line; by default they go to standard error.
        error: What `finish` raises.
    """

    def __init__(
        self, device: str, report: Callable[[str], None] | None = None, error: type[RefusedError] = RefusedError
    ) -> None:
        self._device = device
        self._report = report or _to_stderr
        self._error = error
        self.refused: list[str] = []

    def ok(self, what: str, found: str) -> None:
        """It is as it should be."""
        self._report(f"{self._device}: ok       {what}: {found}")

    def caution(self, what: str, found: str, act: str) -> None:
        """It goes on, and a person has to do something meanwhile."""
        self._report(f"{self._device}: CAUTION  {what}: {found}: {act}")

    def refuse(self, what: str, found: str, remedy: str) -> None:
        """It is not."""
        self._report(f"{self._device}: REFUSED  {what}: {found}: {remedy}")
        self.refused.append(f"{what}: {found}: {remedy}")

    def check(self, what: str, found: str, *, good: bool, remedy: str) -> None:
        """One or the other."""
        if good:
            self.ok(what, found)
        else:
            self.refuse(what, found, remedy)

    def finish(self) -> None:
        """Ends a part of the list.

        Raises:
            RefusedError: Something was refused.
        """
        if self.refused:
            raise self._error("; ".join(self.refused))


def _to_stderr(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
