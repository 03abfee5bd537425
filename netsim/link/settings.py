"""Settings of one direction of a link, with number ranges for validation, messages and tools.

`netsim/src/settings.rs` reads the same settings; files are embedded before (`haptether.netsim.link.resolve`).
"""

from typing import Annotated, Literal, TypeAlias

from msgspec import Meta, Struct

MAX_DELAY_S = 3600.0

Share = Annotated[float, Meta(ge=0.0, le=1.0)]
Delay = Annotated[float, Meta(ge=0.0, le=MAX_DELAY_S)]
Time = Annotated[float, Meta(ge=0.0, le=1e9)]
"""Time in s since the link began, or between two events."""
Length = Annotated[float, Meta(gt=0.0, le=1e9)]
"""Duration in s."""
Burst = Annotated[float, Meta(ge=1.0, le=1e9)]
Rate = Annotated[float, Meta(gt=0.0, le=1e12)]
"""In bit/s."""
Bytes = Annotated[int, Meta(ge=0, le=65_535)]
Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Edited = Annotated[float, Meta(ge=-1e12, le=1e12)]
"""Value that an attacker on the path writes into a packet, adds or multiplies with."""
Operation: TypeAlias = Literal["set", "add", "multiply"]
"""Operation on a number in a packet."""
Shape = Annotated[float, Meta(gt=0.0, le=1e6)]
Level = Annotated[int, Meta(ge=-32_768, le=32_767)]
"""Value of a delay table in 1/8192 standard deviations."""


class GilbertElliott(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Loss model with two states, each with its own probability of loss.

    Source: E. N. Gilbert, Bell Syst. Tech. J. 39, 1960; E. O. Elliott, Bell Syst. Tech. J. 42, 1963.
    """

    to_bad: Share
    """p: probability per packet of a transition from good to bad."""
    to_good: Share
    """r: probability per packet of a transition from bad to good."""
    loss_good: Share = 0.0
    """1 - k: probability of loss in the good state."""
    loss_bad: Share = 1.0
    """1 - h: probability of loss in the bad state."""


class FourState(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Loss model with four states: 1 good, 2 good within a burst, 3 lost within a burst, 4 isolated loss.

    `pij` is the probability of the transition from i to j.

    Source: Salsano, Ludovici, Ordine and Giannuzzi 2012 (GI model).
    """

    p13: Share
    """Probability that a burst begins."""
    p31: Share
    """Probability that a burst ends."""
    p32: Share = 0.0
    """Probability that packets pass within a burst."""
    p23: Share = 1.0
    """Probability that loss resumes within a burst."""
    p14: Share = 0.0
    """Probability of an isolated loss."""


class Once(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="once"):
    """One outage."""

    at_s: Time
    """Start in s since the link began."""
    duration_s: Time
    """Duration in s."""


class Periodic(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="periodic"):
    """Periodic outages."""

    at_s: Time
    """Start of the first outage in s since the link began."""
    period_s: Length
    """Time in s between starts."""
    duration_s: Time
    """Duration of each outage in s."""


class Random(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="random"):
    """Random outages with exponentially distributed up and down times."""

    mean_up_s: Length
    """Mean time in s between an end and the next start."""
    mean_down_s: Length
    """Mean duration in s."""


class Outage(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Times at which no packet passes."""

    times: Once | Periodic | Random
    effect: Literal["drop", "hold"] = "drop"
    """Effect on packets: "drop", or "hold", which delivers them together at the end."""


class CrossTraffic(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Other traffic through the same bottleneck with Poisson arrivals."""

    rate_bps: Rate
    """Mean rate in bit/s while it sends, including headers."""
    packet_bytes: Bytes = 1500
    """Packet size in bytes, including headers."""
    mean_on_s: Length | None = None
    """Mean duration in s of sending, exponentially distributed; None sends without pauses."""
    mean_off_s: Length | None = None
    """Mean duration in s of a pause."""


class Opportunities(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Times at which the bottleneck may send 1500 bytes each, repeated indefinitely.

    Source: mahimahi, `mm-link` traces.
    """

    file: str | None = None
    """Trace file of mahimahi, as an alternative to `time_ms`; path relative to the scene."""
    time_ms: tuple[Count, ...] | None = None
    """Non-decreasing times in ms, the last above 0; the list then repeats."""


class DistributionTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Inverse distribution function at evenly spaced probabilities, as in iproute2's `.dist` files."""

    table: tuple[Level, ...]
    """Values in 1/8192 standard deviations around the mean."""


class DelayChange(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Change of the mean delay."""

    at_s: Time
    """Start in s since the link began."""
    delay_s: Delay
    """New mean delay in s."""
    ramp_s: Time = 0.0
    """Duration of the linear transition in s; 0 is a step."""


class Slots(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Scheduling slots with a random delay level per slot and spikes at both ends.

    Source: arXiv 2601.08439 (Starlink: 15 s; about 140 ms at the start, 75 ms at the end).
    """

    period_s: Length
    """Length of a slot in s."""
    start_spike_s: Time = 0.0
    """Duration in s of raised delays at the start of a slot."""
    end_spike_s: Time = 0.0
    """Duration in s of raised delays at the end of a slot."""
    spike_delay_s: Delay = 0.0
    """Mean spike height in s, exponentially distributed."""
    level_s: Delay = 0.0
    """Standard deviation in s of the level between slots, added to `delay_s`; the delay stays at least zero."""
    spike_loss: Share = 0.0
    """Probability that a packet is lost during a spike."""


class DelayTrace(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Recorded delays and losses: a file, or times and delays."""

    file: str | None = None
    """Recording file; path relative to the scene."""
    format: Literal["csv", "irtt"] | None = None
    """File format; by default IRTT for JSON, otherwise CSV."""
    direction: Literal["forward", "backward"] | None = None
    """Delays used from a bidirectional recording; by default the link's own direction."""
    time_s: tuple[Time, ...] | None = None
    """Increasing times in s, the first 0 or more; the link begins at the first."""
    delay_s: tuple[Delay | None, ...] | None = None
    """Delay in s of a packet sent at that time; an empty value in a file is a loss."""
    half_round_trips: bool = False
    """True if the delays are half of round trips, as from IRTT without one-way delays. Delays are not affected."""
    interpolate: bool = True
    """True to interpolate delays between records; False holds the previous one."""
    repeat: bool = True
    """True to repeat after the end; False holds the last record."""


class ByteRange(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Bytes from `start` up to, but not including, `end`."""

    start: Bytes
    end: Bytes


class Target(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Selection of packets by time, by index and by probability."""

    from_s: Time = 0.0
    """Start in s since the link began."""
    until_s: Time | None = None
    """End in s; None for no end."""
    every: Count = 1
    """Only packets whose index is a multiple of this value."""
    least_bytes: Bytes = 0
    """Smallest payload in bytes."""
    most_bytes: Bytes | None = None
    """Largest payload in bytes."""
    probability: Share = 1.0
    """Probability that a matching packet is selected."""


class Replay(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="replay"):
    """Delivers a copy `after_s` later."""

    after_s: Delay
    """Delay of the copy in s."""


class Forge(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="forge"):
    """Delivers an additional packet of the same size with random bytes from `keep_bytes` on."""

    keep_bytes: Bytes = 0
    """Number of leading bytes copied from the packet."""


class BitFlip(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="bit-flip"):
    """Flips bits of the header."""

    bits: Bytes
    """Number of flipped bits."""
    within: ByteRange
    """Affected bytes."""


class SequenceLead(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True,
                   tag_field="kind", tag="sequence-lead"):  # fmt: skip
    """Delivers a copy whose sequence, a little-endian u64, is ahead."""

    lead: Count
    """Sequence offset of the copy."""
    offset: Bytes
    """Index of the first byte of the sequence."""


class EditF64(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="type", tag="f64"):
    """Change of one little-endian binary64."""

    offset: Bytes
    """Index of its first byte."""
    operation: Operation
    """Replacement by `value`, addition or multiplication."""
    value: Edited
    """-1e12 to 1e12. Set other values, such as NaN, by their bits with type u64."""


class EditU64(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="type", tag="u64"):
    """Change of one little-endian u64, modulo 2^64."""

    offset: Bytes
    """Index of its first byte."""
    operation: Operation
    """Replacement by `value`, addition or multiplication."""
    value: Count
    """At most 2^63 - 1."""


class Alter(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True,
            tag_field="kind", tag="alter"):  # fmt: skip
    """Changes numbers at known positions."""

    edits: tuple[EditF64 | EditU64, ...] = ()
    """Changes in order, at most 4."""
    checksum: Literal["crc32"] | None = None
    """Checksum repaired afterwards: CRC-32 (IEEE 802.3) of all bytes but the last four, stored little-endian in those.
    """
    inject: bool = False
    """True to deliver an altered copy in addition to the unchanged packet."""


class HoldBack(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True,
               tag_field="kind", tag="hold-back"):  # fmt: skip
    """Holds a packet back; packets that are not selected overtake it."""

    by_s: Delay
    """Hold time in s."""


class Drop(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="drop"):
    """Drops the packet."""


class Mirror(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="mirror"):
    """Returns a copy to the sender."""


class SecondSource(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True,
                   tag_field="kind", tag="second-source"):  # fmt: skip
    """Delivers a copy from another source address; in virtual time, without addresses, a duplicate."""


class Attack(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Deliberate action on packets."""

    action: Replay | Forge | BitFlip | SequenceLead | Alter | HoldBack | Drop | Mirror | SecondSource
    target: Target = Target()
    """Selected packets."""


class LinkSettings(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Effect of the network on the packets of one direction, by default none. Also a scene's `[link.forward]`.

    Omitted settings come from the preset; without one they have no effect. Settings apply to a packet in the order of
    the fields. Ranges are checked on use.
    """

    preset: str | None = None
    """Name of a measured network from `haptether netsim list`; given settings override it."""

    mtu: Count | None = None
    """Largest payload in bytes that passes; a larger packet is dropped with cause `mtu`."""

    loss: Share | None = None
    """Probability of loss, by default 0; independent per packet without a mean burst."""
    mean_burst: Burst | None = None
    """Mean number of consecutive losses, at least 1. Source: E. N. Gilbert, Bell Syst. Tech. J. 39, 1960."""
    mean_burst_s: Time | None = None
    """Mean burst as a time in s: the chain runs in time, not per packet.
    Source: E. N. Gilbert, Bell Syst. Tech. J. 39, 1960.
    """
    gilbert_elliott: GilbertElliott | None = None
    """Gilbert-Elliott loss, as an alternative to `loss`."""
    four_state: FourState | None = None
    """Four-state Markov loss, as an alternative to `loss`."""
    outages: tuple[Outage, ...] | None = None
    """Times at which no packet passes."""

    rate_bps: Rate | None = None
    """Bottleneck rate in bit/s; packets wait in its queue and take transmission time."""
    overhead_bytes: Bytes | None = None
    """Header bytes per packet on the wire in addition to the payload; by default 28 for IPv4 and UDP."""
    opportunities: Opportunities | None = None
    """Sending times of the bottleneck, as an alternative to `rate_bps` (mahimahi)."""
    queue_packets: Count | None = None
    """Largest number of queued packets."""
    queue_bytes: Count | None = None
    """Largest number of queued bytes, including headers."""
    queue_ms: Time | None = None
    """Longest wait in ms."""
    discipline: Literal["tail-drop", "codel"] | None = None
    """Queue discipline, by default tail-drop. Source of codel: RFC 8289."""
    cross_traffic: CrossTraffic | None = None
    """Other traffic through the bottleneck."""

    delay_s: Delay | None = None
    """Mean one-way delay in s, 0 to 3600, by default 0, in addition to the bottleneck."""
    jitter_s: Delay | None = None
    """Standard deviation of the delay in s, by default 0.
    Source: Bierkens, Fearnhead and Roberts 2019 (process in time).
    """
    distribution: str | DistributionTable | None = None
    """Distribution of the delay around its mean: "normal" (the default), "uniform", "exponential", "gamma",
    "lognormal", "pareto", or the path of an iproute2 `.dist` file, relative to the scene.
    Source of normal: Johnson, Kotz and Balakrishnan 1994, section 13.10.1.
    Source of exponential: Sukhov, Kuznetsova, Pervitsky and Galtsev 2010.
    Source of gamma: Johnson, Kotz and Balakrishnan 1994, chapter 17.
    Source of lognormal: Johnson, Kotz and Balakrishnan 1994, chapter 14.
    Source of pareto: Johnson, Kotz and Balakrishnan 1994, chapter 20.
    """
    distribution_shape: Shape | None = None
    """Shape parameter of the Pareto and gamma distributions."""
    jitter_correlation_s: Time | None = None
    """Correlation time tau in s of the delay, by default 0.1: the autocorrelation is 1 / e at tau, and `exp(-t / tau)`
    for a normal law. With `keep_order` it is raised to at least four times `jitter_s`, because a delay that falls
    faster than time passes would reorder. Without `keep_order`, 0 is independent per packet.
    """
    timeline: tuple[DelayChange, ...] | None = None
    """Changes of the mean delay at given times."""
    slots: Slots | None = None
    """Scheduling slots with spikes at their ends, as of satellites."""
    trace: DelayTrace | None = None
    """Recorded delays and losses, which replace `delay_s`."""
    keep_order: bool | None = None
    """True if packets arrive in sending order, apart from `reorder`; by default True."""

    reorder: Share | None = None
    """Probability that a packet is reordered, by default 0."""
    reorder_depth: Count | None = None
    """Number of packets in flight that a reordered packet overtakes; by default 1."""
    reorder_hold_s: Delay | None = None
    """Alternative: time in s for which a reordered packet is held while later ones pass."""

    duplicate: Share | None = None
    """Probability that a packet arrives twice, by default 0."""
    duplicate_gap_s: Delay | None = None
    """Time in s between the first and the second arrival, by default 0."""
    corrupt: Share | None = None
    """Probability that bits of a packet are flipped, by default 0."""
    corrupt_bits: Bytes | None = None
    """Number of flipped bits, by default 1."""
    truncate: Share | None = None
    """Probability that a packet is truncated, by default 0."""
    truncate_bytes: Bytes | None = None
    """Length in bytes after truncation, by default 0."""

    attacks: tuple[Attack, ...] | None = None
    """Actions of an attacker on the path."""
    netem: str | None = None
    """Arguments of `tc netem`, reproduced with its quirks; excludes all other settings.
    Source: `sch_netem.c` of Linux 6.18; `tc-netem(8)`.
    """


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
"""Default of each setting whose default is not None."""

Direction: TypeAlias = Literal["forward", "backward"]
"""From master to slave, or back."""

DISTRIBUTIONS = ("normal", "uniform", "exponential", "gamma", "lognormal", "pareto")
"""Names of delay distributions."""
