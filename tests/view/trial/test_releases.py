"""Measurements after a release, from telemetry as a side sends it."""

from typing import Any

import pytest

from haptether.bridge import TRIP_BITS, TelemetryChange, TelemetryHello, TelemetrySample
from haptether.view.trial.releases import WATCHED_NS, Releases

SAMPLE_NS = 16_000_000
HELLO = TelemetryHello(
    schema=1,
    side="master",
    security="secure",
    signals=[],
    scene={"run": {"period_s": 0.001}, "safety": {"controllers": ["wsc"]}},
)


def sample(time_ns: int, position: float, speed: float, state: str = "engaged") -> TelemetrySample:
    def axis(value: float) -> list[list[float]]:
        return [[min(0.0, value), max(0.0, value), value]]

    signals: dict[str, Any] = {"position": axis(position), "velocity": axis(speed), "device_force": axis(3.0)}
    return TelemetrySample(
        time_ns=time_ns, ticks=16, dropped=0, unsent_changes=0, signals={**signals, "state": state}
    )  # fmt: skip


def test_speed_distance_and_trip_after_a_release() -> None:
    releases = Releases(("left", "right"))
    for pair in ("left", "right"):
        releases.take(pair, HELLO, None)
        releases.take(pair, HELLO, sample(0, -0.03, 9.0))
    releases.begin("let go", {"left": 20, "right": 40}, {"delay_s": 0.05})
    assert [one["is_complete"] for one in releases.rows[0]["pairs"].values()] == [False, False]
    trip = TelemetryChange(time_ns=60_000_000, signal="tripped", from_=0, to=TRIP_BITS["wsc"])
    releases.take("right", HELLO, trip)
    end_ns = 40_000_000 + WATCHED_NS
    for time_ns in range(SAMPLE_NS, end_ns + SAMPLE_NS, SAMPLE_NS):
        for pair, speed in (("left", 2.0), ("right", -0.5)):
            # Faster before the release and after the measurement.
            is_watched = 40_000_000 < time_ns < 40_000_000 + WATCHED_NS // 2
            releases.take(pair, HELLO, sample(time_ns, 0.05, speed if is_watched else 0.1))
    (row,) = releases.rows
    left, right = row["pairs"]["left"], row["pairs"]["right"]
    assert (left["peak_speed"], right["peak_speed"]) == (2.0, 0.5)
    assert left["distance"] == pytest.approx(0.08)
    assert (left["trip_s"], right["trip_s"]) == (None, pytest.approx(0.02))
    assert (left["force_n"], left["is_complete"], right["is_complete"]) == (3.0, True, True)
    # Later samples change nothing.
    releases.take("left", HELLO, sample(2 * end_ns, 0.0, 9.0))
    assert releases.rows[0]["pairs"]["left"]["peak_speed"] == 2.0


def test_an_uncoupled_hand_is_not_measured() -> None:
    releases = Releases(("left",))
    releases.begin("let go", {"left": 1}, {})
    releases.take("left", HELLO, None)
    releases.take("left", HELLO, sample(0, 0.0, 0.0, "disengaged"))
    releases.begin("let go", {"left": 1}, {})
    assert releases.rows == []
