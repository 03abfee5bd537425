"""What the tool touches: the environment of a scene, and pushes that are asked for while it runs."""

from collections.abc import Sequence
from typing import Protocol

Vector = tuple[float, float, float]


class Touch(Protocol):
    """Something that exerts a force on the tool."""

    def force(self, time_s: float, position: Sequence[float], velocity: Sequence[float]) -> Vector:
        """Force in N on the tool, in the frame of the base."""

    def advance(self, time_s: float, step_s: float, position: Sequence[float], velocity: Sequence[float]) -> None:
        """Moves what gives way over a step."""


class Nothing:
    """Free space."""

    def force(self, time_s: float, position: Sequence[float], velocity: Sequence[float]) -> Vector:  # noqa: ARG002
        """See `Touch`."""
        return 0.0, 0.0, 0.0

    def advance(self, time_s: float, step_s: float, position: Sequence[float], velocity: Sequence[float]) -> None:
        """See `Touch`."""
