"""Measured networks as link settings for both directions.

Published figures rarely match a model, so a comment with each preset states what is taken over and what is assumed. If
only round trips are known, each direction has half of their median and half of their variance, because the two
directions are independent. Forward leads from master to slave. For cellular and satellite networks the slave has the
terminal, so forward is its downlink.
"""

from math import exp
from types import MappingProxyType
from typing import Literal, TypeAlias

from msgspec import Struct

from haptether.netsim.link.settings import LinkSettings, Outage, Random, Slots

Quantity: TypeAlias = Literal[
    "round-trip-p50", "round-trip-p90", "round-trip-p99", "one-way-p50", "one-way-p90",
    "loss", "mean-burst", "gaps-per-minute-over-50-ms", "gaps-per-minute-over-100-ms",
]  # fmt: skip


class Figure(Struct, frozen=True, kw_only=True):
    """Figure that a preset reproduces."""

    quantity: Quantity
    """Quantity; "gaps" and "one-way" refer to the forward direction, "loss" to a round trip."""
    value: float
    """Value; times in s."""
    within: float
    """Relative tolerance for a sample of a million packets."""


class Preset(Struct, frozen=True, kw_only=True):
    """Measured network."""

    title: str
    source: str
    """Source of the figures, and assumptions."""
    figures: tuple[Figure, ...]
    """Reproduced figures."""
    forward: LinkSettings
    """From master to slave."""
    backward: LinkSettings
    """From slave to master."""


def _figures(**values: tuple[float, float]) -> tuple[Figure, ...]:
    return tuple(
        Figure(quantity=name.replace("_", "-"), value=value, within=within)  # type: ignore[arg-type]
        for name, (value, within) in values.items()
    )


def _gaps(per_minute: float, mean_s: float, delay_s: float) -> Outage:
    """Return outages of a radio link that holds all packets: scheduling, handover, retransmission.

    `per_minute` counts exponentially distributed gaps between arrivals. The delay passes while a packet is held, so
    only longer outages are visible, a fraction exp(-delay / mean). Their excess over the delay has the same
    distribution.
    """
    # Rounded, so that the preset does not depend on the last bit of a platform's exp.
    mean_up_s = round(60.0 / (per_minute * exp(delay_s / mean_s)) - mean_s, 4)
    return Outage(times=Random(mean_up_s=mean_up_s, mean_down_s=mean_s), effect="hold")


def _cellular(delay_s: float, jitter_s: float, loss: float, gaps: tuple[float, float]) -> LinkSettings:
    """Return one direction of a cellular network.

    `delay_s` is half of the median round trip; `gaps` are gaps per minute and their mean length in s.
    """
    return LinkSettings(
        delay_s=delay_s,
        jitter_s=jitter_s,
        distribution="gamma",
        jitter_correlation_s=0.1,
        loss=loss,
        mean_burst=5.0,
        outages=(_gaps(*gaps, delay_s),),
    )


_WIRED = LinkSettings(delay_s=2e-4, jitter_s=2e-5, distribution="gamma")

# Loss and its isolation are published; the delay of an idle hop is assumed.
_HOME = LinkSettings(delay_s=0.002, jitter_s=0.0005, distribution="gamma", loss=7.5e-6)

# Lognormal law through both published quantiles of a hop: median 20 ms and ln(100 / 20) / 1.2816 = 1.2558 give the mean
# 20 exp(1.2558^2 / 2) = 44.0 ms and the deviation 44.0 sqrt(exp(1.2558^2) - 1) = 86.2 ms.
_LOADED = LinkSettings(
    delay_s=0.0440, jitter_s=0.0862, distribution="lognormal", jitter_correlation_s=0.1, loss=0.005, mean_burst=2.0
)

# Only the bursts are published: mean 4.9 packets, 47 % of 4 or more (geometric: 50 %). Delay and loss are assumed.
_VPN = LinkSettings(delay_s=0.02, jitter_s=0.002, distribution="exponential", loss=0.0025, mean_burst=4.9)

# The round trips of experimental.dat have mean 189.6 ms, deviation 13.0 ms and autocorrelation 0.48 between consecutive
# pings, one second apart. Two exponential directions of 13.0 / sqrt(2) ms match p1 to p90 within 2 %, and p99 within 6
# % (232 for 221 ms).
_FAR = LinkSettings(
    delay_s=0.0948, jitter_s=0.00919, distribution="exponential", jitter_correlation_s=1.36, loss=0.0005
)

# Published: 25.7 ms median, less than 1 % above 55 ms, and slots of 15 s with spikes of 140 and 75 ms. Spike height and
# loss (up to half of the packets in 2022) are chosen to meet the 1 %.
_STARLINK = LinkSettings(
    delay_s=0.0129,
    jitter_s=0.0025,
    distribution="gamma",
    jitter_correlation_s=0.05,
    slots=Slots(
        period_s=15.0,
        start_spike_s=0.14,
        end_spike_s=0.075,
        spike_delay_s=0.0235,
        level_s=0.002,
        spike_loss=0.05,
    ),
)

# Only the smallest round trip is exact; the rest is assumed.
_GEO = LinkSettings(
    delay_s=0.3, jitter_s=0.01, distribution="exponential", jitter_correlation_s=0.2, loss=0.0025, mean_burst=3.0
)

_UCC = "UCC 5G dataset (Ireland), recomputed"

PRESETS: MappingProxyType[str, Preset] = MappingProxyType({
    "wired-lan": Preset(
        title="Switched Ethernet",
        source="libfranka asks for less than 1 ms for round trip, computation and robot; the delay is assumed",
        figures=_figures(round_trip_p50=(0.0004, 0.02), round_trip_p99=(0.00047, 0.05)),
        forward=_WIRED,
        backward=_WIRED,
    ),
    "home-wifi": Preset(
        title="WiFi at home, idle",
        source="Deskhub #54: loss 1.5e-5, each packet alone; a delay of 2 ms is assumed",
        figures=_figures(loss=(1.5e-5, 1.0), round_trip_p50=(0.004, 0.05)),
        forward=_HOME,
        backward=_HOME,
    ),
    "loaded-wifi": Preset(
        title="WiFi on a loaded campus",
        source='"Weakest link", INFOCOM 2016: half of the packets above 20 ms, 10 % above 100 ms; loss assumed',
        figures=_figures(one_way_p50=(0.020, 0.06), one_way_p90=(0.100, 0.08)),
        forward=_LOADED,
        backward=_LOADED,
    ),
    "wan-vpn": Preset(
        title="Tunnel over the open Internet, losses in bursts",
        source="Deskhub #54: mean burst 4.9, 47 % of 4 or more; delay and 0.5 % of loss assumed",
        figures=_figures(mean_burst=(4.9, 0.1), loss=(0.005, 0.15), round_trip_p50=(0.0394, 0.05)),
        forward=_VPN,
        backward=_VPN,
    ),
    # Windows of a few probes publish their largest round trip only. Assumed: the median window is the bulk, and the
    # 95th percentile is about the 99th of single probes.
    "5g-static": Preset(
        title="5G NSA, at rest",
        source=f"{_UCC}: windows from 66 to 73 ms, largest of a window p95 114 ms, loss 0.37 %",
        figures=_figures(round_trip_p50=(0.0695, 0.04), round_trip_p99=(0.114, 0.12), loss=(0.0037, 0.15)),
        forward=_cellular(0.0345, 0.004, 0.00185, (10.6, 0.06)),
        backward=_cellular(0.0345, 0.004, 0.00185, (10.6, 0.06)),
    ),
    "5g-driving": Preset(
        title="5G NSA, in a moving car",
        source=f"{_UCC}: median 75 ms, largest of a window p95 114 ms, loss 1.06 %",
        figures=_figures(round_trip_p50=(0.075, 0.04), round_trip_p99=(0.114, 0.12), loss=(0.0106, 0.1)),
        forward=_cellular(0.03725, 0.005, 0.0053, (9.6, 0.06)),
        backward=_cellular(0.03725, 0.005, 0.0053, (9.6, 0.06)),
    ),
    "lte-static": Preset(
        title="LTE, at rest",
        source=f"{_UCC}: the median of LTE in a car (84 ms); spread and loss of 5G at rest are assumed to hold",
        figures=_figures(round_trip_p50=(0.084, 0.04), loss=(0.0037, 0.15)),
        forward=_cellular(0.04175, 0.004, 0.00185, (10.6, 0.06)),
        backward=_cellular(0.04175, 0.004, 0.00185, (10.6, 0.06)),
    ),
    # Gaps longer than x ms occur n exp(-x / d) times per minute. Downlink: 30 over 50 ms and 10 over 100 ms give d =
    # 45.5 ms and n = 90. Uplink: 8 over 50 ms with the same d give n = 24.
    "lte-driving": Preset(
        title="LTE, in a moving car",
        source=f"{_UCC}: median 84 ms, loss 1.16 %; gaps of mahimahi's AT&T downlink and T-Mobile uplink, recomputed",
        figures=_figures(
            round_trip_p50=(0.084, 0.08),
            loss=(0.0116, 0.1),
            gaps_per_minute_over_50_ms=(30.0, 0.1),
            gaps_per_minute_over_100_ms=(10.0, 0.15),
        ),
        forward=_cellular(0.041, 0.005, 0.0058, (90.0, 0.0455)),
        backward=_cellular(0.041, 0.005, 0.0058, (24.0, 0.0455)),
    ),
    "hspa-driving": Preset(
        title="HSPA+, in a moving car",
        source=f"{_UCC}: median 123 ms, largest of a window p95 581 ms, loss 4.4 %",
        figures=_figures(round_trip_p50=(0.123, 0.08), round_trip_p99=(0.581, 0.1), loss=(0.044, 0.06)),
        forward=_cellular(0.0605, 0.010, 0.0222, (5.3, 0.3)),
        backward=_cellular(0.0605, 0.010, 0.0222, (5.3, 0.3)),
    ),
    "starlink": Preset(
        title="Starlink, 2025",
        source="Starlink network updates 2025 (25.7 ms, 1 % above 55 ms); arXiv 2601.08439 (slots); IMC 2022 (losses)",
        figures=_figures(round_trip_p50=(0.0257, 0.05), round_trip_p99=(0.050, 0.12)),
        forward=_STARLINK,
        backward=_STARLINK,
    ),
    "transatlantic": Preset(
        title="New York to London on the shortest cable",
        source="Hibernia Express: round trip 58.95 ms; jitter and loss of a quiet backbone are assumed",
        figures=_figures(round_trip_p50=(0.05895, 0.01)),
        forward=LinkSettings(delay_s=0.0296, jitter_s=0.0003, distribution="exponential", loss=5e-5),
        backward=LinkSettings(delay_s=0.0296, jitter_s=0.0003, distribution="exponential", loss=5e-5),
    ),
    "intercontinental": Preset(
        title="Around half of the world",
        source="iproute2, experimental.dat: 13448 round trips; loss assumed",
        figures=_figures(
            round_trip_p50=(0.1862, 0.02), round_trip_p90=(0.2058, 0.03), round_trip_p99=(0.2209, 0.08)
        ),
        forward=_FAR,
        backward=_FAR,
    ),
    "geo": Preset(
        title="Geostationary satellite",
        source="477 ms at least by geometry, some 600 ms typical; the spread and 0.5 % of loss are assumed",
        figures=_figures(round_trip_p50=(0.600, 0.02), loss=(0.005, 0.2)),
        forward=_GEO,
        backward=_GEO,
    ),
})  # fmt: skip
"""Measured networks by name."""
