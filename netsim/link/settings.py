"""What the network does to the packets of one direction."""

from typing import Literal, TypeAlias

from msgspec import Struct

from haptether.netsim.link.parts import (
    Attack,
    CrossTraffic,
    DelayChange,
    DelayTrace,
    DistributionTable,
    FourState,
    GilbertElliott,
    Opportunities,
    Outage,
    Slots,
)
from haptether.netsim.link.ranges import Burst, Bytes, Count, Delay, Rate, Shape, Share, Time


class LinkSettings(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """What the network does to the packets of one direction; by default nothing. Also a scene's `[link.forward]`.

    What is left out is as the preset says, and without one as if it were not there. A packet meets what is set in the
    order in which it stands here. The numbers are held against their ranges where the settings are used.
    """

    preset: str | None = None
    """Name of a network that was measured, of `haptether netsim list`; what is given beside it counts instead."""

    mtu: Count | None = None
    """Largest payload in bytes that passes; a larger packet is dropped with the cause `mtu`."""

    loss: Share | None = None
    """Probability that a packet is lost, by default 0. Without a mean burst, packets are lost independently."""
    mean_burst: Burst | None = None
    """Mean number of packets lost together, at least 1 (Gilbert)."""
    mean_burst_s: Time | None = None
    """The same as a time in s: the chain runs in time, not by packets."""
    gilbert_elliott: GilbertElliott | None = None
    """Gilbert-Elliott, instead of `loss`."""
    four_state: FourState | None = None
    """Four-state Markov loss, instead of `loss`."""
    outages: tuple[Outage, ...] | None = None
    """Times at which nothing passes."""

    rate_bps: Rate | None = None
    """Rate of the bottleneck in bit/s; packets wait in its queue and take their time on the wire."""
    overhead_bytes: Bytes | None = None
    """Bytes of headers that each packet takes on the wire beside its payload; by default the 28 of IPv4 and UDP."""
    opportunities: Opportunities | None = None
    """Times at which the bottleneck may send, instead of `rate_bps` (mahimahi)."""
    queue_packets: Count | None = None
    """Most packets that wait."""
    queue_bytes: Count | None = None
    """Most bytes that wait, headers included."""
    queue_ms: Time | None = None
    """Longest wait in ms."""
    discipline: Literal["tail-drop", "codel"] | None = None
    """What a queue that fills does, by default tail-drop. Source of CoDel: RFC 8289."""
    cross_traffic: CrossTraffic | None = None
    """Other traffic through the same bottleneck."""

    delay_s: Delay | None = None
    """Mean one-way delay in s, 0 to 3600, by default 0, beside what the bottleneck takes."""
    jitter_s: Delay | None = None
    """Standard deviation of the delay in s, by default 0."""
    distribution: str | DistributionTable | None = None
    """Law of the delay around its mean: "normal" (the default), "uniform", "exponential", "gamma", "lognormal",
    "pareto", or the path of a `.dist` file of iproute2, relative to the scene."""
    distribution_shape: Shape | None = None
    """Shape of the law where it has one to choose: that of Pareto and of gamma."""
    jitter_correlation_s: Time | None = None
    """Time tau in s over which the delay forgets itself: its autocorrelation is 1 / e at tau, and `exp(-t / tau)` of a
    normal law; by default 0.1. With `keep_order` at least four times `jitter_s`, since a delay that falls faster than
    time passes would reorder: what is shorter is taken as that. 0 without `keep_order` is independent from packet to
    packet."""
    timeline: tuple[DelayChange, ...] | None = None
    """Changes of the mean delay at given times."""
    slots: Slots | None = None
    """Scheduling slots with spikes at their ends, as of satellites."""
    trace: DelayTrace | None = None
    """Recorded delays and losses, which take the place of `delay_s`."""
    keep_order: bool | None = None
    """Whether packets arrive in the order in which they were sent, apart from `reorder`; by default true."""

    reorder: Share | None = None
    """Probability that a packet is reordered, by default 0."""
    reorder_depth: Count | None = None
    """How many packets before it, if still under way, a reordered packet overtakes; by default 1."""
    reorder_hold_s: Delay | None = None
    """Instead: how long in s a reordered packet is held while later ones pass."""

    duplicate: Share | None = None
    """Probability that a packet arrives twice, by default 0."""
    duplicate_gap_s: Delay | None = None
    """How long in s after the first the second arrives, by default 0."""
    corrupt: Share | None = None
    """Probability that bits of a packet are flipped, by default 0."""
    corrupt_bits: Bytes | None = None
    """How many bits, by default 1."""
    truncate: Share | None = None
    """Probability that a packet is cut short, by default 0."""
    truncate_bytes: Bytes | None = None
    """To how many bytes, by default 0."""

    attacks: tuple[Attack, ...] | None = None
    """What somebody on the path does."""
    netem: str | None = None
    """Arguments of `tc netem`, reproduced with its quirks; nothing else may be given beside it."""


LINK_DEFAULTS = {
    "loss": 0.0,
    "outages": (),
    "overhead_bytes": 28,
    "discipline": "tail-drop",
    "delay_s": 0.0,
    "jitter_s": 0.0,
    "distribution": "normal",
    "timeline": (),
    "keep_order": True,
    "reorder": 0.0,
    "reorder_depth": 1,
    "duplicate": 0.0,
    "duplicate_gap_s": 0.0,
    "corrupt": 0.0,
    "corrupt_bits": 1,
    "truncate": 0.0,
    "truncate_bytes": 0,
    "attacks": (),
}
"""What a setting without a value is, where that is not `None`."""

Direction: TypeAlias = Literal["forward", "backward"]
"""From master to slave, or back."""

DISTRIBUTIONS = ("normal", "uniform", "exponential", "gamma", "lognormal", "pareto")
"""Laws of the delay by name."""
