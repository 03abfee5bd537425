"""What can be made to go wrong between controller and clients."""

import math
import random
from dataclasses import dataclass, field

from haptether.slave.ur_emulator.connections import DASHBOARD, RTDE, SCRIPT

KINDS = frozenset({RTDE, DASHBOARD, SCRIPT})


@dataclass(slots=True)
class Faults:
    """Faults of network and clients; those of the arm are the controller's. Time is an argument, in s."""

    seed: int = 0
    refusing: bool = False
    """Whether new connections are closed at once."""
    late_s: float = 0.0
    """By which data packages are late."""
    jitter_s: float = 0.0
    """Largest further lateness, uniform; packages keep their order."""
    dropping: set[str] = field(default_factory=set)
    """Kinds of connections that are to be closed."""
    _frozen_until_s: float = -math.inf
    _random: random.Random = field(init=False)
    _last_due_s: dict[int, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._random = random.Random(self.seed)

    def reset(self) -> None:
        """Nothing goes wrong any more."""
        self.refusing = False
        self.late_s = self.jitter_s = 0.0
        self.thaw()

    def freeze(self, now_s: float, duration_s: float = math.inf) -> None:
        """Nothing is read, sent or accepted for a time, as if the network were gone; the arm goes on."""
        self._frozen_until_s = now_s + duration_s

    def thaw(self) -> None:
        """Ends it."""
        self._frozen_until_s = -math.inf

    def is_frozen(self, now_s: float) -> bool:
        """Whether nothing passes."""
        return now_s < self._frozen_until_s

    def due_s(self, connection: int, now_s: float) -> float:
        """When a package of now may leave."""
        if self.late_s == 0.0 and self.jitter_s == 0.0:
            # Those that are late already stay before it.
            return now_s
        due = now_s + self.late_s + self.jitter_s * self._random.random()
        due = max(due, self._last_due_s.get(connection, due))
        self._last_due_s[connection] = due
        return due

    def take_dropping(self) -> set[str]:
        """The kinds of connections to close now."""
        kinds, self.dropping = self.dropping, set()
        return kinds
