"""Network impairment: delay, jitter and loss, decided once for virtual time and for live sockets."""

from haptether._core import DirectionStatistics, LinkSettings, Proxy, ProxyStatistics, judge

__all__ = ["DirectionStatistics", "LinkSettings", "Proxy", "ProxyStatistics", "judge"]
