"""The inputs of the controller: their values, and which connection may write which."""

import math
from collections import Counter
from collections.abc import Mapping

from haptether.slave.ur_emulator.rtde_types import IN_USE, NOT_FOUND, Value, WireType

NOBODY = 0


class RtdeInputs:
    """Values persist until they are overwritten; a variable belongs to one connection, until that ends."""

    def __init__(self, types: Mapping[str, WireType]) -> None:
        self.types = types
        self.values: dict[str, Value] = {name: kind.zero for name, kind in types.items()}
        self.writes: Counter[str] = Counter()
        """How often each has been written, whatever its value."""
        self.refused = 0
        """Packages that held a number that is not finite."""
        self.blocked: frozenset[str] = frozenset()
        """Inputs that nobody gets any more: as if a client that nobody sees had them."""
        self.changed: set[str] = set()
        """Inputs that were written since somebody emptied this."""
        self._owners: dict[str, int] = {}
        self._names = {name: name for name in types}

    def claim(
        self, owner: int, names: tuple[str, ...], *, wanted: bool = True
    ) -> tuple[list[str], tuple[WireType, ...] | None]:
        """Gives variables to a connection: what to answer, and their types, or None if it gets none of them."""
        answers = [self._answer(owner, name) for name in names]
        if not wanted or NOT_FOUND in answers or IN_USE in answers:
            return answers, None
        for name in self.known(names):
            self._owners[name] = owner
        return answers, tuple(self.types[name] for name in names)

    def known(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """The same names, as the table has them."""
        return tuple(self._names[name] for name in names)

    def release(self, owner: int) -> None:
        """Takes all that a connection had."""
        self._owners = {name: of for name, of in self._owners.items() if of != owner}

    def write(self, values: Mapping[str, Value]) -> None:
        """Takes values over; a package with a number that is not finite is refused as a whole."""
        for value in values.values():
            if not (math.isfinite(value) if isinstance(value, float | int) else all(map(math.isfinite, value))):
                self.refused += 1
                return
        self.values.update(values)
        self.changed.update(values)
        self.writes.update(values.keys())

    def _answer(self, owner: int, name: str) -> str:
        kind = self.types.get(name)
        if kind is None:
            return NOT_FOUND
        mine = self._owners.get(name, NOBODY if name in self.blocked else owner) == owner
        return kind.name if mine else IN_USE
