"""Network impairment: delay, jitter and loss, decided once for virtual time and for live sockets."""

from haptether._core import (
    DirectionStatistics,
    Echo,
    LinkSettings,
    Proxy,
    ProxyStatistics,
    Recording,
    judge,
    record,
)

__all__ = [
    "DirectionStatistics",
    "Echo",
    "LinkSettings",
    "Proxy",
    "ProxyStatistics",
    "Recording",
    "judge",
    "record",
]
