"""Names and meanings of codes and bits in signals, from the registries of controllers and ladder states."""

from collections.abc import Mapping
from inspect import signature
from typing import Any, NamedTuple

from haptether import _core


class ObservedSignal(NamedTuple):
    """Signal that a controller observes."""

    signal: str
    """Its name in traces, recordings and telemetry."""
    symbol: str
    unit: str
    """Empty if the signal has no unit."""

    @property
    def label(self) -> str:
        """Symbol and unit."""
        return f"{self.symbol} [{self.unit}]" if self.unit else self.symbol


def _observed(signal: str, label: str) -> ObservedSignal:
    symbol, _, unit = label.partition(" [")
    return ObservedSignal(signal, symbol, unit.removesuffix("]"))


TRIP_BITS = dict(_core.TRIP_BITS)
"""Bit of each controller in `tripped`, in registry order; "held" comes last."""
OBSERVED_SIGNALS = {name: _observed(signal, label) for name, signal, label in _core.OBSERVED}
"""Signal that each controller observes, in registry order."""
LADDER_STATES = _core.LADDER_STATES
"""Ladder states; the index of a state is its code."""
_SETTINGS = frozenset(signature(_core.SafetySettings).parameters)


def tripped_names(bits: int) -> tuple[str, ...]:
    """Names of the controllers whose bits are set, then "held"."""
    return tuple(name for name, bit in TRIP_BITS.items() if bits & bit)


def trip_thresholds(safety: Mapping[str, Any]) -> dict[str, float]:
    """Threshold of each controller's observer; positive: it trips above, else below.

    Args:
        safety: Table `safety` of a scene's JSON. The paper's thresholds replace missing ones.
    """
    numbers: dict[str, Any] = {key: safety[key] for key in _SETTINGS & safety.keys()}
    numbers = {key: value for key, value in numbers.items() if isinstance(value, int | float)}
    return _core.SafetySettings(**numbers).thresholds
