"""Without a velocity within all limits, or with an invalid number, a streamed arm brakes and reports the reason."""

import math
from typing import Any

import msgspec
import numpy as np
import pytest
from tests.ur.kinematics.streaming_cases import JOINTS, LIMITS, MODEL, PERIOD_S, steps

from haptether.slave import (
    SelfKeepOut,
    StreamingCost,
    StreamingLimits,
    UrKinematics,
    UrStreaming,
    WorkspacePlane,
    model_limits,
    ur_model,
)


@pytest.mark.parametrize("size", [1e3, 1e12, 1e100, 1e308])
@pytest.mark.parametrize("name", ["joints", "all"])
def test_an_absurd_wish_leads_to_no_absurd_velocity(size: float, name: str) -> None:
    streaming = UrStreaming(UrKinematics(MODEL), LIMITS[name], period_s=PERIOD_S)
    velocity = streaming.velocity(steps(1)[0].q, np.zeros(6), np.full(6, size))
    assert (np.abs(velocity) <= 8.0 * PERIOD_S + 1e-12).all()
    assert (streaming.reason != "") is (size > 1e50)


@pytest.mark.parametrize("q", [(0.4, -1.3, 1.1, 0.6, 0.0, -2.0), (0.0,) * 6, (0.0, -math.pi / 2, 0.0, 0.0, 0.0, 0.0)])
@pytest.mark.parametrize("damping", [0.0, 0.01])
def test_at_a_singularity_there_is_a_velocity(q: tuple[float, ...], damping: float) -> None:
    for limits in LIMITS.values():
        if limits.planes:
            continue
        streaming = UrStreaming(UrKinematics(MODEL), limits, period_s=PERIOD_S, cost=StreamingCost(damping=damping))
        velocity = streaming.velocity(q, np.zeros(6), (0.1, 0.2, 0.3, 0.1, 0.2, 0.3))
        assert streaming.reason == ""
        assert np.isfinite(velocity).all()


def test_a_wrist_without_end_has_no_end() -> None:
    endless = ur_model("ur3e")
    streaming = UrStreaming(UrKinematics(endless), model_limits(endless), period_s=PERIOD_S)
    streaming.velocity((0.4, -1.3, 1.1, 0.6, 0.9, 100.0), np.zeros(6), np.zeros(6))
    assert streaming.reason == ""
    assert streaming.program.upper[5] == pytest.approx(8.0 * PERIOD_S)


def test_it_brakes_with_a_reason_and_goes_on_after() -> None:
    limits = msgspec.structs.replace(JOINTS, max_tool_speed=0.1)
    streaming = UrStreaming(UrKinematics(MODEL), limits, period_s=PERIOD_S)
    q, fast = np.array((-0.6, -1.6, 1.7, -1.5, -1.4, 0.3)), np.array((1.5, -0.01, 0.0, 0.0, 0.0, 0.0))
    # No acceleration within bounds slows the tool at once.
    velocity = streaming.velocity(q, fast, np.zeros(6))
    assert "tool speed" in streaming.reason
    assert "must be at most 0.1 m/s" in streaming.reason
    np.testing.assert_allclose(velocity, (1.5 - 8.0 * PERIOD_S, 0.0, 0.0, 0.0, 0.0, 0.0), rtol=0, atol=1e-15)
    for _ in range(200):
        velocity = streaming.velocity(q, velocity, np.zeros(6))
    assert streaming.reason == ""
    np.testing.assert_allclose(velocity, 0, atol=1e-6)


def test_bounds_that_cross_brake_too() -> None:
    streaming = UrStreaming(UrKinematics(MODEL), JOINTS, period_s=PERIOD_S)
    q, qd = np.zeros(6), np.zeros(6)
    q[1], qd[1] = 2 * math.pi - 1e-4, 1.0
    for _ in range(3):
        velocity = streaming.velocity(q, qd, np.ones(6))
        assert "joint 2 must be at least 0.984 rad/s" in streaming.reason
        np.testing.assert_allclose(velocity, (0, 1.0 - 0.016, 0, 0, 0, 0), rtol=0, atol=1e-15)
    qd[1] = 0.0
    streaming.velocity(q, qd, np.ones(6))
    assert streaming.reason == ""


def test_without_an_acceleration_limit_braking_is_standing_still() -> None:
    # The arm cannot clear a table below it and one above it at once.
    floor = WorkspacePlane(normal=(0.0, 0.0, 1.0), offset_m=5.0)
    ceiling = WorkspacePlane(normal=(0.0, 0.0, -1.0), offset_m=5.0)
    streaming = UrStreaming(UrKinematics(MODEL), StreamingLimits(planes=(floor, ceiling)), period_s=PERIOD_S)
    velocity = streaming.velocity(np.ones(6), np.ones(6), np.ones(6))
    assert streaming.reason.startswith("planes[")
    np.testing.assert_array_equal(velocity, np.zeros(6))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("which", range(3))
def test_a_number_that_is_not_finite_brakes(bad: float, which: int) -> None:
    streaming = UrStreaming(UrKinematics(MODEL), LIMITS["all"], period_s=PERIOD_S)
    step = steps(1)[0]
    given = [step.q.copy(), np.full(6, 0.1), step.twist.copy()]
    given[which][3] = bad
    velocity = streaming.velocity(*given)
    assert "must be finite" in streaming.reason
    expected = np.zeros(6) if which == 1 else np.full(6, 0.1 - 8.0 * PERIOD_S)
    np.testing.assert_allclose(velocity, expected, rtol=0, atol=1e-15)
    streaming.velocity(step.q, np.zeros(6), step.twist)
    assert streaming.reason == ""


@pytest.mark.parametrize("bad", [np.zeros(5), np.zeros((2, 3)), "motion", None])
def test_what_is_no_vector_brakes(bad: Any) -> None:  # noqa: ANN401
    streaming = UrStreaming(UrKinematics(MODEL), JOINTS, period_s=PERIOD_S)
    np.testing.assert_array_equal(streaming.velocity(np.ones(6), np.zeros(6), bad), np.zeros(6))
    assert streaming.reason
    np.testing.assert_array_equal(streaming.velocity(np.ones(6), bad, np.zeros(6)), np.zeros(6))
    assert streaming.reason


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"position_min": (0.0,) * 6}, "must both be given"),
        ({"position_min": (1.0,) * 6, "position_max": (1.0,) * 6}, "position_min = 1.0: must be less than"),
        ({"position_min": (math.nan,) * 6, "position_max": (1.0,) * 6}, "position_min = nan"),
        ({"max_speed": (0.0,) * 6}, "max_speed = 0.0: must be above 0"),
        ({"max_acceleration": (math.inf,) * 6}, "max_acceleration = inf"),
        ({"max_tool_speed": -1.0}, "max_tool_speed = -1.0"),
        ({"approach_rate_hz": 0.0}, "approach_rate_hz = 0.0"),
    ],
)
def test_limits_that_cannot_be_are_refused(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        StreamingLimits(**fields)


def test_parts_of_limits_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match="length 1"):
        WorkspacePlane(normal=(0.0, 0.0, 2.0), offset_m=0.0)
    with pytest.raises(ValueError, match="offset_m = nan"):
        WorkspacePlane(normal=(0.0, 0.0, 1.0), offset_m=math.nan)
    with pytest.raises(ValueError, match="margin_m"):
        SelfKeepOut(margin_m=-0.1)
    with pytest.raises(ValueError, match="radius_m"):
        SelfKeepOut(radius_m=0.0)
    with pytest.raises(ValueError, match="weights"):
        StreamingCost(weights=(0.0,) * 6)
    with pytest.raises(ValueError, match="damping = nan"):
        StreamingCost(damping=math.nan)
    with pytest.raises(ValueError, match="damping_below"):
        StreamingCost(damping_below=0.0)
    for period_s in (0.0, -1.0, 0.11, math.nan):
        with pytest.raises(ValueError, match="period_s"):
            UrStreaming(UrKinematics(MODEL), JOINTS, period_s=period_s)
