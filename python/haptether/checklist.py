"""Checklist before a device moves: findings, and a remedy for each refusal."""

import sys
from collections.abc import Callable

from haptether.printed import printed


class RefusedError(RuntimeError):
    """The device must not move now."""


class Checklist:
    """Lines of findings; `finish` raises an error if one was refused.

    Args:
        device: Name and address at the beginning of each line.
        report: Takes each line; by default standard error.
        error: Exception type that `finish` raises.
    """

    def __init__(
        self, device: str, report: Callable[[str], None] | None = None, error: type[RefusedError] = RefusedError
    ) -> None:
        self._device = device
        self._report = report or _to_stderr
        self._error = error
        self.refused: list[str] = []

    def ok(self, what: str, found: str) -> None:
        """Report a valid item."""
        self._report(f"{self._device}: ok       {what}: {found}")

    def caution(self, what: str, found: str, act: str) -> None:
        """Report an item that needs action by a person but does not stop the checklist."""
        self._report(f"{self._device}: CAUTION  {what}: {found}: {act}")

    def refuse(self, what: str, found: str, remedy: str) -> None:
        """Report a refused item."""
        self._report(f"{self._device}: REFUSED  {what}: {found}: {remedy}")
        self.refused.append(f"{what}: {found}: {remedy}")

    def check(self, what: str, found: str, *, good: bool, remedy: str) -> None:
        """Report a valid or a refused item."""
        if good:
            self.ok(what, found)
        else:
            self.refuse(what, found, remedy)

    def finish(self) -> None:
        """End a part of the list.

        Raises:
            RefusedError: An item was refused.
        """
        if self.refused:
            # Each item has its line already.
            raise self._error(printed("; ".join(self.refused)))


def _to_stderr(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
