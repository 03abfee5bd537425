"""Network impairment, decided once for virtual time and for live sockets."""

from haptether._core import DirectionStatistics, Echo, ProxyStatistics, Recording, record
from haptether.netsim.control import ControlSocket, ask_control
from haptether.netsim.controlled import Controlled
from haptether.netsim.link_error import LinkError
from haptether.netsim.link_files import with_files
from haptether.netsim.link_parts import (
    Attack,
    BitFlip,
    ByteRange,
    CrossTraffic,
    DelayChange,
    DelayTrace,
    DistributionTable,
    Drop,
    Forge,
    FourState,
    GilbertElliott,
    Mirror,
    Once,
    Opportunities,
    Outage,
    Periodic,
    Random,
    Replay,
    SecondSource,
    SequenceLead,
    Slots,
    Target,
)
from haptether.netsim.link_settings import LinkSettings
from haptether.netsim.link_spec import link_json, link_spec
from haptether.netsim.netem import NetemComparison, compare_netem, translate_netem
from haptether.netsim.presets import PRESETS, Figure, Preset
from haptether.netsim.proxy import Proxy
from haptether.netsim.statistics import LinkFigures, asked, burst_lengths, realised
from haptether.netsim.verdicts import VERDICT_CAUSES, Verdicts, judge, judge_all, link_bounds

__all__ = [
    "PRESETS",
    "VERDICT_CAUSES",
    "Attack",
    "BitFlip",
    "ByteRange",
    "ControlSocket",
    "Controlled",
    "CrossTraffic",
    "DelayChange",
    "DelayTrace",
    "DirectionStatistics",
    "DistributionTable",
    "Drop",
    "Echo",
    "Figure",
    "Forge",
    "FourState",
    "GilbertElliott",
    "LinkError",
    "LinkFigures",
    "LinkSettings",
    "Mirror",
    "NetemComparison",
    "Once",
    "Opportunities",
    "Outage",
    "Periodic",
    "Preset",
    "Proxy",
    "ProxyStatistics",
    "Random",
    "Recording",
    "Replay",
    "SecondSource",
    "SequenceLead",
    "Slots",
    "Target",
    "Verdicts",
    "ask_control",
    "asked",
    "burst_lengths",
    "compare_netem",
    "judge",
    "judge_all",
    "link_bounds",
    "link_json",
    "link_spec",
    "realised",
    "record",
    "translate_netem",
    "with_files",
]
