"""Texts of events; a chattering pair of events becomes one line."""

from collections import Counter
from collections.abc import Sequence
from typing import Protocol

REPEATED = {"trip", "recover"}, {"contact", "free"}
"""Pairs of events that chatter."""


class RunEvent(Protocol):
    """An event in a run."""

    @property
    def time_s(self) -> float:
        """Time in s since the start."""

    @property
    def kind(self) -> str:
        """Kind of the event."""

    @property
    def detail(self) -> str:
        """Object or reason."""


def merged_events(events: Sequence[RunEvent]) -> list[tuple[float, str]]:
    """Events with a time in s each; a chattering pair is one line with its count and end."""
    merged: list[tuple[float, str]] = []
    waiting = list(events)
    while waiting:
        first = waiting[0]
        pair = next((pair for pair in REPEATED if first.kind in pair), set())
        same = waiting[: next((n for n, event in enumerate(waiting) if event.kind not in pair), len(waiting))]
        times = sum(event.kind == first.kind for event in same)
        text = f"{first.kind}  {first.detail}".rstrip()
        if times > 2:
            details = Counter(event.detail for event in same if event.kind == first.kind)
            if len(details) > 1:
                counted = (
                    f"{detail} {often} times" if often > 1 else f"{detail} once" for detail, often in details.items()
                )
                text, often_text = f"{first.kind}  {', '.join(counted)}", ""
            else:
                often_text = f"  {times} times"
            merged.append((first.time_s, f"{text}{often_text}, until {same[-1].time_s:.4f} s"))
        else:
            same = same[:1] or [first]
            merged.append((first.time_s, text))
        del waiting[: len(same)]
    return merged
