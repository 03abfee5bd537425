"""Time line of a run: events, ladder states, interventions, and the force on the hand."""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from haptether.bridge import Event, Signals, ladder_state_name
from haptether.view.scene3d.extent import is_joints, largest_of, norms_of
from haptether.view.scene3d.status import spans

MOST_COLUMNS = 1500
"""Columns of the force; more than the width of a screen."""
SHOWN = frozenset(
    {"release", "regrasp", "contact", "grip", "drop", "hold", "stop", "fault", "diverged", "trip", "engaged"}
)
"""Kinds of events with a name on the line; the others are only marks."""
APART_S = 0.05
"""Trips closer than this in s count as one for `next_trip`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Mark:
    """An event on the line."""

    time_s: float
    kind: str
    text: str
    named: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Timeline:
    """Time line of one run."""

    begin_s: float
    end_s: float
    over_s: float
    """End of the last tick, assumed as long as the previous one."""
    marks: tuple[Mark, ...]
    ladder: tuple[tuple[float, float, str], ...]
    """Begin, end and state of the hand's side."""
    trips: tuple[tuple[float, float], ...]
    """Intervals of interventions, hold-off included."""
    force_time_s: npt.NDArray[np.float64]
    force_n: npt.NDArray[np.float64]
    """Largest force of each piece of the time line: |F_device|, or |F_e| without a hand; for joints the largest torque.
    """

    def next_trip(self, time_s: float) -> float | None:
        """Start of the next intervention; after the last, of the first; None without any."""
        begins = [begin for n, (begin, _) in enumerate(self.trips) if n == 0 or begin - self.trips[n - 1][1] > APART_S]
        return next((begin for begin in begins if begin > time_s + 1e-9), begins[0] if begins else None)


def timeline_of(signals: Signals, events: Iterable[Event]) -> Timeline:
    """Time line of a run's signals and events."""
    time_s = np.asarray(signals["time_s" if "time_s" in signals else "slave_time_s"], dtype=np.float64)
    named_before: dict[str, float] = {}
    marks = []
    for event in events:
        # Name a chattering event once.
        is_new = event.time_s - named_before.get(event.kind, -np.inf) > 0.5
        named_before[event.kind] = event.time_s
        side, _, _ = event.detail.partition(":")
        text = f"{event.kind} {event.detail}" if event.kind == "trip" else event.kind
        # The slave's ladder follows the master's.
        named = event.kind in SHOWN and is_new and (side != "slave" or "time_s" not in signals)
        marks.append(Mark(time_s=event.time_s, kind=event.kind, text=text, named=named))
    return Timeline(
        begin_s=float(time_s[0]),
        end_s=float(time_s[-1]),
        over_s=float(2.0 * time_s[-1] - time_s[-2] if len(time_s) > 1 else time_s[-1]),
        marks=tuple(marks),
        ladder=tuple(_ladder(signals, time_s)),
        trips=tuple(spans(time_s, _tripped(signals, len(time_s)) > 0)),
        **_force(signals, time_s),
    )


def _tripped(signals: Signals, ticks: int) -> npt.NDArray[np.uint8]:
    bits = [
        np.nan_to_num(signals[name]).astype(np.uint8) & 31
        for name in ("tripped", "rotation_tripped")
        if name in signals
    ]
    return np.bitwise_or.reduce(bits) if bits else np.zeros(ticks, dtype=np.uint8)


def _ladder(signals: Signals, time_s: npt.NDArray[np.float64]) -> list[tuple[float, float, str]]:
    name = "state" if "time_s" in signals else "slave_state"
    if name not in signals:
        return []
    state = np.nan_to_num(signals[name])
    changes = [0, *(np.flatnonzero(np.diff(state)) + 1).tolist(), len(state) - 1]
    return [(float(time_s[a]), float(time_s[b]), ladder_state_name(int(state[a]))) for a, b in pairwise(changes)]


def _force(signals: Signals, time_s: npt.NDArray[np.float64]) -> dict[str, npt.NDArray[np.float64]]:
    names = ("device_force_peak", "device_force") if "time_s" in signals else ("environment_force",)
    name = next((name for name in names if name in signals), None)
    if name is None:
        return {"force_time_s": np.zeros(0), "force_n": np.zeros(0)}
    norm = (largest_of if is_joints(signals, None) else norms_of)(signals[name])
    piece = max(1, len(norm) // MOST_COLUMNS)
    whole = len(norm) // piece * piece
    return {
        "force_time_s": time_s[:whole:piece],
        "force_n": np.nan_to_num(norm[:whole]).reshape(-1, piece).max(axis=1),
    }
