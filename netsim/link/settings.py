"""Settings of one direction of a link, with the ranges of their numbers, which validation, messages and tools read.

`netsim/src/settings.rs` reads the same; what may name a file here is embedded before (`haptether.netsim.link.resolve`).
"""

from typing import Annotated, Literal, TypeAlias

from msgspec import Meta, Struct

MAX_DELAY_S = 3600.0
"""Longest delay that a link accepts."""

Share = Annotated[float, Meta(ge=0.0, le=1.0)]
Delay = Annotated[float, Meta(ge=0.0, le=MAX_DELAY_S)]
Time = Annotated[float, Meta(ge=0.0, le=1e9)]
"""In s since the link began, or between two things that happen."""
Length = Annotated[float, Meta(gt=0.0, le=1e9)]
"""In s, of something that lasts."""
Burst = Annotated[float, Meta(ge=1.0, le=1e9)]
Rate = Annotated[float, Meta(gt=0.0, le=1e12)]
"""In bit/s."""
Bytes = Annotated[int, Meta(ge=0, le=65_535)]
Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Edited = Annotated[float, Meta(ge=-1e12, le=1e12)]
"""What somebody on the path writes into a packet, adds or multiplies with."""
Operation: TypeAlias = Literal["set", "add", "multiply"]
"""What is done to a number."""
Shape = Annotated[float, Meta(gt=0.0, le=1e6)]
Level = Annotated[int, Meta(ge=-32_768, le=32_767)]
"""Of a table of delays, in 1/8192 standard deviations."""


class GilbertElliott(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Two states, each with its own probability of loss.

    Source: E. N. Gilbert, Bell Syst. Tech. J. 39, 1960; E. O. Elliott, Bell Syst. Tech. J. 42, 1963.
    """

    to_bad: Share
    """p: probability that the good state turns bad, per packet."""
    to_good: Share
    """r: probability that the bad state turns good, per packet."""
    loss_good: Share = 0.0
    """1 - k: probability of loss in the good state."""
    loss_bad: Share = 1.0
    """1 - h: probability of loss in the bad state."""


class FourState(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Four states: 1 good, 2 good within a burst, 3 lost within a burst, 4 lost alone. `pij` leads from i to j.

    Source: Salsano, Ludovici, Ordine and Giannuzzi 2012 (GI model).
    """

    p13: Share
    """A burst begins."""
    p31: Share
    """A burst ends."""
    p32: Share = 0.0
    """Packets pass within a burst."""
    p23: Share = 1.0
    """Packets are lost again within a burst."""
    p14: Share = 0.0
    """A packet is lost alone."""


class Once(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="once"):
    """One outage."""

    at_s: Time
    """When it begins, in s since the link began."""
    duration_s: Time
    """How long it lasts in s."""


class Periodic(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="periodic"):
    """Outages again and again."""

    at_s: Time
    """When the first one begins, in s since the link began."""
    period_s: Length
    """From one beginning to the next, in s."""
    duration_s: Time
    """How long each lasts in s."""


class Random(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="random"):
    """Outages at random: both times are exponentially distributed."""

    mean_up_s: Length
    """Mean time in s between an end and the next beginning."""
    mean_down_s: Length
    """Mean time in s that one lasts."""


class Outage(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Times at which nothing passes."""

    times: Once | Periodic | Random
    """When."""
    effect: Literal["drop", "hold"] = "drop"
    """What becomes of the packets: dropped, or held, so that they arrive together once it is over."""


class CrossTraffic(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Other traffic through the same bottleneck: packets at random times (Poisson)."""

    rate_bps: Rate
    """Mean rate in bit/s while it sends, headers included."""
    packet_bytes: Bytes = 1500
    """Size of its packets in bytes, headers included."""
    mean_on_s: Length | None = None
    """Mean time in s that it sends before it pauses; exponentially distributed. Without it, it never pauses."""
    mean_off_s: Length | None = None
    """Mean time in s that it pauses."""


class Opportunities(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Times at which the bottleneck may send 1500 bytes each, repeated for ever.

    Source: mahimahi, `mm-link` traces.
    """

    file: str | None = None
    """A trace of mahimahi, instead of `time_ms`; relative to the scene."""
    time_ms: tuple[Count, ...] | None = None
    """Times in ms, not decreasing, the last above 0: after it the list begins anew."""


class DistributionTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An inverse distribution function at evenly spaced probabilities, as in the `.dist` files of iproute2."""

    table: tuple[Level, ...]
    """In 1/8192 standard deviations around the mean."""


class DelayChange(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """A change of the mean delay."""

    at_s: Time
    """When it begins, in s since the link began."""
    delay_s: Delay
    """The new mean delay in s."""
    ramp_s: Time = 0.0
    """How long in s it takes to get there, linearly; 0 is a step."""


class Slots(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Scheduling slots: a level of delay that is drawn anew for each, and spikes at both ends.

    Source: arXiv 2601.08439 (Starlink: 15 s; about 140 ms at the start, 75 ms at the end).
    """

    period_s: Length
    """Length of a slot in s."""
    start_spike_s: Time = 0.0
    """How long in s delays are raised at the start of a slot."""
    end_spike_s: Time = 0.0
    """How long in s delays are raised at the end of a slot."""
    spike_delay_s: Delay = 0.0
    """By how much in s, on average; exponentially distributed from spike to spike."""
    level_s: Delay = 0.0
    """Standard deviation in s of the level from slot to slot, beside `delay_s`; never below zero delay."""
    spike_loss: Share = 0.0
    """Probability that a packet is lost during a spike."""


class DelayTrace(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Recorded delays and losses: a file, or times and delays."""

    file: str | None = None
    """The recording; relative to the scene."""
    format: Literal["csv", "irtt"] | None = None
    """What the file is; by default JSON is of IRTT, all else CSV."""
    direction: Literal["forward", "backward"] | None = None
    """Which delays of a recording of both directions; by default those of the link's own."""
    time_s: tuple[Time, ...] | None = None
    """Times in s, increasing, the first 0 or more: the link begins at the first."""
    delay_s: tuple[Delay | None, ...] | None = None
    """Delay in s of a packet sent then; in a file, an empty one was lost."""
    half_round_trips: bool = False
    """True if the delays are half of round trips, as from IRTT without one-way delays. It changes no delay."""
    interpolate: bool = True
    """Whether delays between two records are interpolated; else the last one holds."""
    repeat: bool = True
    """Whether it begins anew after its end; else its last record holds."""


class ByteRange(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Bytes from `start` up to but not including `end`."""

    start: Bytes
    """First byte."""
    end: Bytes
    """First byte after it."""


class Target(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Which packets: those of the given times, every n-th of them, each with a probability."""

    from_s: Time = 0.0
    """From when on, in s since the link began."""
    until_s: Time | None = None
    """Until when, in s; without it, for ever."""
    every: Count = 1
    """Only packets whose index is a multiple of it."""
    least_bytes: Bytes = 0
    """Smallest payload in bytes."""
    most_bytes: Bytes | None = None
    """Largest payload in bytes."""
    probability: Share = 1.0
    """With which probability."""


class Replay(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="replay"):
    """A copy arrives `after_s` later."""

    after_s: Delay
    """How much later, in s."""


class Forge(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="forge"):
    """A packet of the same size arrives beside it, with random bytes from `keep_bytes` on."""

    keep_bytes: Bytes = 0
    """How many bytes at its start are those of the packet seen."""


class BitFlip(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="bit-flip"):
    """Bits of its header are flipped."""

    bits: Bytes
    """How many."""
    within: ByteRange
    """Within which bytes."""


class SequenceLead(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True,
                   tag_field="kind", tag="sequence-lead"):  # fmt: skip
    """A copy arrives beside it whose sequence, a little-endian u64, is ahead."""

    lead: Count
    """By how much."""
    offset: Bytes
    """First byte of the sequence."""


class EditF64(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="type", tag="f64"):
    """A change of one little-endian binary64."""

    offset: Bytes
    """Its first byte."""
    operation: Operation
    """Whether it is replaced by `value`, or that is added, or multiplied with."""
    value: Edited
    """-1e12 to 1e12; other numbers, NaN among them, are set as their bits with the type u64."""


class EditU64(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="type", tag="u64"):
    """A change of one little-endian u64, modulo 2^64."""

    offset: Bytes
    """Its first byte."""
    operation: Operation
    """Whether it is replaced by `value`, or that is added, or multiplied with."""
    value: Count
    """At most 2^63 - 1."""


class Alter(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True,
            tag_field="kind", tag="alter"):  # fmt: skip
    """Numbers in it are changed by somebody who knows where they stand."""

    edits: tuple[EditF64 | EditU64, ...] = ()
    """Which numbers and how, one after the other: at most 4."""
    checksum: Literal["crc32"] | None = None
    """What is put right afterwards: CRC-32 (IEEE 802.3) of all bytes but the last four, little-endian in those."""
    inject: bool = False
    """Whether an altered copy arrives beside the packet, which itself stays as it is."""


class HoldBack(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True,
               tag_field="kind", tag="hold-back"):  # fmt: skip
    """It is held back; packets that are not aimed at pass it."""

    by_s: Delay
    """For how long, in s."""


class Drop(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="drop"):
    """It does not arrive."""


class Mirror(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="mirror"):
    """A copy goes back to its sender."""


class SecondSource(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True,
                   tag_field="kind", tag="second-source"):  # fmt: skip
    """A copy arrives from another source address; in virtual time, which has none, a duplicate."""


class Attack(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Something done to packets on purpose."""

    action: Replay | Forge | BitFlip | SequenceLead | Alter | HoldBack | Drop | Mirror | SecondSource
    """What is done."""
    target: Target = Target()
    """To which packets."""


class LinkSettings(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """What the network does to the packets of one direction; by default nothing. Also a scene's `[link.forward]`.

    What is left out is as the preset says, and without one as if it were not there. A packet meets what is set in the
    order in which it stands here. The numbers are checked against their ranges where the settings are used.
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
