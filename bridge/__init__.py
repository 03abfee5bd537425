"""The bridge: both sides coupled, in virtual time and over UDP."""

from haptether._core import (
    LinkStatistics,
    LiveMaster,
    LiveSlave,
    LocalTrace,
    LoopReport,
    MasterSettings,
    MasterTrace,
    Sinusoid,
    SlaveSettings,
    SlaveTrace,
    ladder_state_name,
    run_bridge,
    run_local,
)

__all__ = [
    "LinkStatistics",
    "LiveMaster",
    "LiveSlave",
    "LocalTrace",
    "LoopReport",
    "MasterSettings",
    "MasterTrace",
    "Sinusoid",
    "SlaveSettings",
    "SlaveTrace",
    "ladder_state_name",
    "run_bridge",
    "run_local",
]
