"""Verdicts of the network model: bounds, rates, determinism and refusals."""

import math
import re
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from haptether.netsim import DelayTrace, LinkError, LinkSettings, Once, Outage, judge

Times = npt.NDArray[np.int64]

PACKETS = 20_000
SENT_NS = np.arange(PACKETS, dtype=np.int64) * 1_000_000

seeds = st.integers(0, 2**64 - 1)


def uniform(half_width_s: float) -> dict[str, Any]:
    """Return uniform jitter that is independent from packet to packet, so that packets overtake one another."""
    return {
        "jitter_s": half_width_s / math.sqrt(3.0),
        "distribution": "uniform",
        "jitter_correlation_s": 0.0,
        "keep_order": False,
    }


def test_a_perfect_network_delivers_at_once() -> None:
    assert np.array_equal(judge(LinkSettings(), SENT_NS), SENT_NS)
    assert judge(LinkSettings(), SENT_NS[:0]).shape == (0,)
    assert judge(LinkSettings(), SENT_NS).dtype == np.int64


@given(
    delay_s=st.floats(0.0, 2.0),
    share=st.floats(0.0, 1.0),
    loss=st.floats(0.0, 1.0),
    seed=seeds,
    sent_ns=st.lists(st.integers(0, 10**12), max_size=50),
)
def test_what_arrives_does_so_within_the_jitter(
    delay_s: float, share: float, loss: float, seed: int, sent_ns: list[int]
) -> None:
    half_width_s = delay_s * share
    settings = LinkSettings(delay_s=delay_s, loss=loss, **uniform(half_width_s))
    sent = np.array(sorted(sent_ns), dtype=np.int64)
    due = judge(settings, sent, seed=seed)
    arrived = due >= 0
    assert np.all(due[~arrived] == -1)
    # Delay and jitter are rounded to a nanosecond each.
    delay_ns, jitter_ns = round(delay_s * 1e9), round(half_width_s * 1e9)
    travelled = (due - sent)[arrived]
    assert np.all(travelled >= max(0, delay_ns - jitter_ns - 1))
    assert np.all(travelled <= delay_ns + jitter_ns + 1)


def test_a_constant_delay_is_exact() -> None:
    assert np.array_equal(judge(LinkSettings(delay_s=0.05), SENT_NS) - SENT_NS, [50_000_000] * PACKETS)


@pytest.mark.parametrize("loss", [0.001, 0.01, 0.3, 0.99])
@pytest.mark.parametrize("direction", ["forward", "backward"])
def test_losses_are_as_many_as_asked_for(loss: float, direction: Literal["forward", "backward"]) -> None:
    for seed in range(5):
        due = judge(LinkSettings(loss=loss), SENT_NS, direction=direction, seed=seed)
        # Four standard deviations of a binomial count: one run in 16000 lies outside.
        sigma = np.sqrt(PACKETS * loss * (1 - loss))
        assert abs(np.count_nonzero(due == -1) - PACKETS * loss) <= 4 * sigma


def test_losses_are_independent_of_their_neighbours() -> None:
    lost = judge(LinkSettings(loss=0.3), SENT_NS, seed=7) == -1
    pairs = np.count_nonzero(lost[1:] & lost[:-1])
    expected = (PACKETS - 1) * 0.09
    # Neighbouring pairs share a packet: Var = n (p² - p⁴) + 2 n (p³ - p⁴).
    variance = PACKETS * ((0.09 - 0.0081) + 2 * (0.027 - 0.0081))
    assert abs(pairs - expected) <= 4 * np.sqrt(variance)


def test_all_or_nothing() -> None:
    assert np.all(judge(LinkSettings(loss=1.0), SENT_NS) == -1)
    assert np.all(judge(LinkSettings(loss=0.0), SENT_NS) >= 0)


def test_jitter_is_uniform_around_the_delay() -> None:
    due = judge(LinkSettings(delay_s=0.05, **uniform(0.01)), SENT_NS, seed=3)
    shift = (due - SENT_NS) / 1e9 - 0.05
    # Uniform with half-width w: mean 0 ± w / sqrt(3 n), mean square w²/3 ± w² sqrt(4 / (45 n)).
    assert abs(shift.mean()) <= 4 * 0.01 / np.sqrt(3 * PACKETS)
    assert abs((shift**2).mean() - 0.01**2 / 3) <= 4 * 0.01**2 * np.sqrt(4 / 45 / PACKETS)
    counts = np.histogram(shift, bins=10, range=(-0.01, 0.01))[0]
    assert np.all(abs(counts - PACKETS / 10) <= 4 * np.sqrt(PACKETS * 0.09))
    assert np.any(np.diff(due) < 0), "packets overtake one another"


FULL = LinkSettings(delay_s=0.05, loss=0.05, **uniform(0.01))


@given(seed=seeds)
def test_the_same_seed_gives_the_same_verdicts(seed: int) -> None:
    sent = SENT_NS[:500]
    due = judge(FULL, sent, seed=seed)
    assert np.array_equal(judge(FULL, sent, seed=seed), due)
    assert not np.array_equal(judge(FULL, sent, seed=(seed + 1) % 2**64), due)
    assert not np.array_equal(judge(FULL, sent, direction="backward", seed=seed), due)


@given(seed=seeds, packets=st.integers(0, 200))
def test_a_verdict_depends_on_its_own_packet_alone(seed: int, packets: int) -> None:
    due = judge(FULL, SENT_NS[:200], seed=seed)
    assert np.array_equal(judge(FULL, SENT_NS[:packets], seed=seed), due[:packets])
    later = judge(FULL, SENT_NS[:200] + 12345, seed=seed)
    assert np.array_equal(later, np.where(due >= 0, due + 12345, -1))
    assert np.array_equal(judge(FULL, np.repeat(SENT_NS[:200], 2)[::2], seed=seed), due)


def test_the_layout_of_the_times_changes_nothing() -> None:
    sent = SENT_NS[:200]
    due = judge(FULL, sent)
    records = np.zeros(200, dtype=[("flag", "u1"), ("sent", "i8")])
    records["sent"] = sent
    for laid in (sent[::-1].copy()[::-1], np.repeat(sent, 3)[::3], records["sent"]):
        assert np.array_equal(judge(FULL, laid), due)


@given(seed=seeds)
def test_an_impairment_shifts_no_draw_of_another(seed: int) -> None:
    sent = SENT_NS[:500]
    both = judge(FULL, sent, seed=seed)
    jitter = judge(LinkSettings(delay_s=0.05, **uniform(0.01)), sent, seed=seed)
    loss = judge(LinkSettings(loss=0.05), sent, seed=seed)
    assert np.array_equal(both, np.where(loss == -1, -1, jitter))
    # A larger rate loses every packet that a smaller rate loses.
    more = judge(LinkSettings(loss=0.2), sent, seed=seed)
    assert np.all(more[loss == -1] == -1)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"delay_s": -0.1}, "delay_s = -0.1: must be a number from 0 to 3600"),
        ({"delay_s": 3601.0}, "delay_s = 3601.0: must be a number from 0 to 3600"),
        ({"delay_s": np.nan}, "delay_s = nan: must be a finite number"),
        ({"jitter_s": np.inf}, "jitter_s = inf: must be a finite number"),
        ({"loss": 1.5}, "loss = 1.5: must be a number from 0 to 1"),
        ({"loss": -0.1}, "loss = -0.1: must be a number from 0 to 1"),
        ({"delay_s": 0.01, "jitter_s": 0.02}, "jitter_s"),
        ({"delay_s": "50 ms"}, 'delay_s = "50 ms": must be a number from 0 to 3600'),
        ({"rate_bps": 0.0}, "rate_bps = 0.0: must be a number above 0 and at most 1e+12"),
        ({"mtu": -1}, "mtu = -1: must be a whole number from 0 to "),
        ({"mtu": 1.5}, "mtu = 1.5: must be a whole number from 0 to "),
        ({"discipline": "red"}, 'discipline = "red": must be one of codel, tail-drop'),
        ({"outages": (Outage(times=Once(at_s=1.0, duration_s=-1.0)),)}, "outages.0.times.duration_s = -1.0: must be"),
        ({"trace": DelayTrace(time_s=(0.0,))}, "trace: needs file, or time_s and delay_s"),
        ({"distribution": "norml"}, 'distribution = "norml": must be one of normal, uniform'),
        ({"preset": "star-link"}, 'preset = "star-link": must be one of wired-lan, '),
    ],
)
def test_settings_out_of_range_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(LinkError, match=f"^{re.escape(message)}"):
        judge(LinkSettings(**settings), SENT_NS)


def test_numbers_of_numpy_are_numbers() -> None:
    settings = LinkSettings(delay_s=np.float64(0.05), loss=np.float32(0.0), mtu=np.int64(1000))  # type: ignore[arg-type]
    assert np.array_equal(judge(settings, SENT_NS) - SENT_NS, [50_000_000] * PACKETS)


def test_settings_tell_what_they_were_given() -> None:
    settings = LinkSettings(delay_s=0.05, jitter_s=0.01, loss=0.02)
    assert (settings.delay_s, settings.jitter_s, settings.loss) == (0.05, 0.01, 0.02)
    assert settings == LinkSettings(delay_s=0.05, jitter_s=0.01, loss=0.02)
    assert settings != LinkSettings(delay_s=0.05, jitter_s=0.01)


@pytest.mark.parametrize(
    ("sent", "keywords", "error", "message"),
    [
        (np.array([0, 5, -1]), {}, ValueError, r"^sent_ns\[2\] = -1: must be 0 or more$"),
        (np.array([0, 5, 4]), {}, ValueError, r"^sent_ns\[2\] = 4: must be at least the one before it, 5$"),
        (np.array([0, 5]), {"sizes": np.array([1])}, ValueError, "^sizes: 1 of them, must be 2, one per packet$"),
        (np.array([0, 5]), {"sizes": -1}, ValueError, r"^sizes\[0\] = -1: must be 0 or more$"),
        (
            SENT_NS,
            {"direction": "sideways"},
            ValueError,
            '^direction = "sideways": must be "forward" or "backward"$',
        ),
        (SENT_NS, {"seed": -1}, OverflowError, None),
        (SENT_NS, {"seed": 2**64}, OverflowError, None),
        (SENT_NS.astype(np.int32), {}, TypeError, "int64"),
        (SENT_NS.astype(np.float64), {}, TypeError, "int64"),
        (SENT_NS.reshape(-1, 2), {}, TypeError, None),
    ],
)
def test_bad_questions_are_refused(
    sent: Times, keywords: dict[str, Any], error: type[Exception], message: str | None
) -> None:
    with pytest.raises(error, match=message):
        judge(LinkSettings(), sent, **keywords)
