"""What codes and bits of signals mean, as the registries of controllers and ladder states have it."""

from typing import NamedTuple

from haptether import _core


class ObservedSignal(NamedTuple):
    """What a controller observes."""

    signal: str
    """Its name in traces, recordings and telemetry."""
    symbol: str
    unit: str
    """Empty where it has none."""

    @property
    def label(self) -> str:
        """Symbol and unit."""
        return f"{self.symbol} [{self.unit}]" if self.unit else self.symbol


def _observed(signal: str, label: str) -> ObservedSignal:
    symbol, _, unit = label.partition(" [")
    return ObservedSignal(signal, symbol, unit.removesuffix("]"))


TRIP_BITS = dict(_core.TRIP_BITS)
"""The bit of each controller in `tripped`, in the order of the registry, and of "held" behind them."""
OBSERVED_SIGNALS = {name: _observed(signal, label) for name, signal, label in _core.OBSERVED}
"""What each controller observes, in the order of the registry."""
LADDER_STATES = _core.LADDER_STATES
"""States of the ladder; the place of each is its code."""


def tripped_names(bits: int) -> tuple[str, ...]:
    """Names of the controllers whose bits are set, then "held"."""
    return tuple(name for name, bit in TRIP_BITS.items() if bits & bit)
