"""Presets reproduce their documented figures over a million packets."""

import functools

import numpy as np
import numpy.typing as npt
import pytest

from haptether.netsim import PRESETS, Figure, LinkSettings, Verdicts, burst_lengths, judge_all, link_spec, realised

pytestmark = pytest.mark.slow

PACKETS, PERIOD_NS = 1_000_000, 10_000_000
"""Number of packets, and period: nearly three hours at 100 Hz, as the share of rare gaps and slots must settle."""


@functools.cache
def sampled(name: str) -> tuple[Verdicts, Verdicts]:
    sent = np.arange(PACKETS, dtype=np.int64) * PERIOD_NS
    preset = PRESETS[name]
    forward = judge_all(preset.forward, sent, seed=11, sizes=92).packets
    return forward, judge_all(preset.backward, sent, direction="backward", seed=11, sizes=92).packets


def delays(verdicts: Verdicts) -> npt.NDArray[np.float64]:
    return np.where(verdicts.t_out_ns < 0, np.nan, (verdicts.t_out_ns - verdicts.t_in_ns) * 1e-9)


def gaps_per_minute(settings: LinkSettings, longest_s: float) -> float:
    """Return the long interruptions of a 1 kHz stream per minute; only gaps hold so many packets at once."""
    sent = np.arange(PACKETS, dtype=np.int64) * 1_000_000
    out = judge_all(settings, sent, seed=11, sizes=92).packets
    arrived = np.sort(out.t_out_ns[out.t_out_ns >= 0])
    return float(np.count_nonzero(np.diff(arrived) > longest_s * 1e9)) / (PACKETS * 1e-3 / 60.0)


def measured(name: str, quantity: str) -> float:
    forward, backward = sampled(name)
    if quantity.startswith("round-trip-p"):
        return float(np.nanquantile(delays(forward) + delays(backward), int(quantity[12:]) / 100.0))
    if quantity.startswith("one-way-p"):
        return float(np.nanquantile(delays(forward), int(quantity[9:]) / 100.0))
    if quantity == "loss":
        return float(np.isnan(delays(forward) + delays(backward)).mean())
    if quantity == "mean-burst":
        return float(burst_lengths(forward).mean())
    assert quantity.startswith("gaps-per-minute-over-")
    return gaps_per_minute(PRESETS[name].forward, int(quantity.split("-")[4]) * 1e-3)


@pytest.mark.sampled(12)
@pytest.mark.parametrize(
    ("name", "figure"),
    [(name, figure) for name, preset in PRESETS.items() for figure in preset.figures],
    ids=lambda value: value if isinstance(value, str) else value.quantity,
)
def test_a_preset_reproduces_its_figures(name: str, figure: Figure) -> None:
    assert measured(name, figure.quantity) == pytest.approx(figure.value, rel=figure.within)


@pytest.mark.parametrize("name", PRESETS)
def test_no_preset_reorders(name: str) -> None:
    for verdicts in sampled(name):
        assert realised(verdicts).reordered == 0.0


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_is_a_link_by_its_name(name: str) -> None:
    assert link_spec(LinkSettings(preset=name), "forward") == link_spec(PRESETS[name].forward, "forward")
    assert link_spec(LinkSettings(preset=name), "backward") == link_spec(PRESETS[name].backward, "backward")
    assert PRESETS[name].source
    assert PRESETS[name].title


def test_what_is_given_beside_a_preset_counts_instead() -> None:
    spec = link_spec(LinkSettings(preset="lte-driving", loss=0.0, delay_s=0.1), "forward")
    preset = link_spec(PRESETS["lte-driving"].forward, "forward")
    assert (spec["loss"], spec["mean_burst"], spec["delay_s"]) == (0.0, None, 0.1)
    assert spec["outages"] == preset["outages"]
    chain = {"to_bad": 0.01, "to_good": 0.5, "loss_good": 0.0, "loss_bad": 1.0}
    from haptether.netsim import GilbertElliott

    spec = link_spec(LinkSettings(preset="geo", gilbert_elliott=GilbertElliott(to_bad=0.01, to_good=0.5)), "forward")
    assert (spec["gilbert_elliott"], spec["loss"], spec["mean_burst"]) == (chain, 0.0, None)
    still = link_spec(LinkSettings(preset="geo", jitter_s=0.0), "forward")
    assert (still["jitter_s"], still["distribution"], still["jitter_correlation_s"]) == (0.0, "normal", None)


def test_the_starlink_slots_are_15_s_apart() -> None:
    """Check the slots: packets are slow in the first 140 ms and the last 75 ms of a slot only."""
    forward, _ = sampled("starlink")
    delay, phase = delays(forward), (forward.t_in_ns * 1e-9) % 15.0
    spikes = (phase < 0.14) | (phase >= 15.0 - 0.075)
    assert np.nanmean(delay[spikes]) > np.nanmean(delay[~spikes]) + 0.01
    assert np.isnan(delay[~spikes]).sum() == 0
    assert 0.02 < np.isnan(delay[spikes]).mean() < 0.1
