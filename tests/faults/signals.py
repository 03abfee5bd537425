"""Ladder of one side from its ticks: when it held, what moved, and the force on the hand."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from haptether.bridge import Run

Array = npt.NDArray[np.float64]

DISENGAGED, ALIGNING, ENGAGED, STALE, HOLD, STOP, FAULT = range(7)
NAMES = ("disengaged", "aligning", "engaged", "stale", "hold", "stop", "fault")


@dataclass(frozen=True, kw_only=True)
class Ticks:
    """Ticks of one side; each array has shape `(n_ticks,)`."""

    time_s: Array
    state: npt.NDArray[np.int64]
    age_s: Array
    """Silence of the peer in s; infinite or NaN before its first frame."""
    output: Array
    """Force on the hand in N for a master, commanded position in m for a slave."""

    @classmethod
    def of_run(cls, run: Run) -> tuple[Self, Self]:
        """Return master and slave of a run in virtual time, where the slave's ages are not recorded."""
        signals = run.signals
        master = cls(
            time_s=signals.time_s, state=signals.state.astype(np.int64), age_s=signals.age_s,
            output=signals.device_force,
        )  # fmt: skip
        slave = cls(
            time_s=signals.slave_time_s, state=signals.slave_state.astype(np.int64),
            age_s=np.full(len(signals.slave_time_s), np.nan), output=signals.slave_command,
        )  # fmt: skip
        return master, slave

    @classmethod
    def of_signals(cls, side: str, signals: dict[str, npt.NDArray[Any]]) -> Self:
        """Return the ticks of a recording."""
        output = signals["device_force" if side == "master" else "command"]
        return cls(
            time_s=signals["time_ns"] * 1e-9,
            state=np.array([NAMES.index(name) for name in signals["state"]], dtype=np.int64),
            age_s=np.asarray(signals["age_s"], dtype=np.float64),
            output=np.asarray(output, dtype=np.float64).reshape(len(output), -1)[:, 0],
        )

    def between(self, begin_s: float, end_s: float = np.inf) -> Self:
        """Return the ticks of a time span."""
        kept = (self.time_s >= begin_s) & (self.time_s < end_s)
        return type(self)(
            time_s=self.time_s[kept], state=self.state[kept], age_s=self.age_s[kept], output=self.output[kept]
        )

    @property
    def held(self) -> npt.NDArray[np.bool_]:
        """Mask of the ticks in HOLD, STOP or FAULT."""
        held: npt.NDArray[np.bool_] = self.state >= HOLD
        return held

    @property
    def coupled(self) -> npt.NDArray[np.bool_]:
        """Mask of the ticks in ENGAGED or STALE."""
        coupled: npt.NDArray[np.bool_] = (self.state == ENGAGED) | (self.state == STALE)
        return coupled

    def first(self, state: int) -> int | None:
        """Return the first tick at or beyond a state."""
        found = np.flatnonzero(self.state >= state)
        return int(found[0]) if found.size else None

    @property
    def worst(self) -> str:
        """Name of the furthest state down the ladder; states before ENGAGED do not count."""
        return NAMES[max((int(state) for state in self.state if state >= ENGAGED), default=DISENGAGED)]

    @property
    def last(self) -> str:
        """Name of the last state."""
        return NAMES[int(self.state[-1])] if self.state.size else "nothing"

    def held_after_s(self, fault_s: float) -> float:
        """Return the time in s from `fault_s` to the first tick that held; infinite if none did."""
        tick = self.between(fault_s).first(HOLD)
        return float(self.between(fault_s).time_s[tick]) - fault_s if tick is not None else np.inf

    def travelled(self) -> float:
        """Return how far a slave's command moved between ticks that both held, in m."""
        both = self.held[:-1] & self.held[1:]
        return float(np.abs(np.diff(self.output))[both].sum())

    def fade_s(self) -> float:
        """Return the time in s from a master's first hold to the last force before it engaged again."""
        tick = self.first(HOLD)
        if tick is None:
            return 0.0
        end = self._end_of_hold(tick)
        pressed = np.flatnonzero(self.output[tick:end])
        if not pressed.size:
            return 0.0
        last = tick + int(pressed[-1]) + 1
        return float(self.time_s[last] - self.time_s[tick]) if last < len(self.time_s) else np.inf

    def force_after_n(self, fade_s: float) -> float:
        """Return a master's largest force in N later than `fade_s` after its first hold, until it engaged again."""
        tick = self.first(HOLD)
        if tick is None:
            return 0.0
        end = self._end_of_hold(tick)
        later = self.time_s[tick:end] > self.time_s[tick] + fade_s + 1e-9
        return float(np.abs(self.output[tick:end][later]).max(initial=0.0))

    def _end_of_hold(self, tick: int) -> int:
        again = np.flatnonzero(self.coupled[tick:])
        return tick + int(again[0]) if again.size else len(self.state)
