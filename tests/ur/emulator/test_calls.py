"""Every call of the unmodified ur_rtde once, on an emulated controller in real time; time bounds are loose."""

import numpy as np
import pytest
from tests.ur.emulated import Emulated, client
from tests.ur.raw_rtde import Client
from tests.ur.stalls import anew_after_stalls
from tests.ur.virtual import START

pytestmark = pytest.mark.live

pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this Python")

CYCLE_S = 0.002
LATE_S = 0.1
"""Time in s beyond any observed stall of a shared machine during these tests."""

EMULATOR = ("--unlock-after-s", "0.5")


def test_moves(arm: Emulated) -> None:
    result = client("moves", arm.host)
    for name in ("movej", "movej_back", "movel", "movej_ik", "movel_fk", "async", "path", "custom"):
        assert result[name] is True, name
    assert result["q"] == pytest.approx([*START[:5], 0.3], abs=1e-6)
    assert result["off_m"] < 1e-6
    assert result["running"] >= 0
    assert result["ended"] < 0
    assert 0.0 < result["stopped_at"] < 0.3
    assert result["path_end"] == pytest.approx([*START[:5], 0.3], abs=1e-6)
    assert result["digital"] == 1 << 3
    assert result["runtime_state"] == 1


def test_questions(arm: Emulated) -> None:
    result = client("questions", arm.host)
    assert result["inverse"] == pytest.approx(START, abs=1e-9)
    assert result["inverse_near"] == pytest.approx(START, abs=1e-9)
    assert result["solution"] is True
    assert result["no_solution"] is False
    assert result["tcp"] == [0.0, 0.0, 0.1, 0.0, 0.0, 0.0]
    assert np.linalg.norm(np.subtract(result["tool_pose"], result["pose"])[:3]) == pytest.approx(0.1)
    assert result["forward"] == pytest.approx(result["tool_pose"])
    assert (result["payload"], result["payload_kg"]) == (True, 1.5)
    assert result["zero"] is True
    assert result["step_time"] == 0.002
    assert result["steady"] is True
    assert result["within"] == [True, True]
    assert result["jog"] is True
    assert result["jog_speed"][2] == pytest.approx(0.02, abs=1e-3)
    assert result["jog_stop"] is True
    assert result["contact"] == [True, False, False]


def test_the_watchdog(arm: Emulated) -> None:
    result = client("watchdog", arm.host)
    assert result["armed"] is True
    assert result["streaming"] is True
    # It fires in the first cycle that begins more than 0.1 s after the one that heard the last command.
    assert 0.1 - CYCLE_S < result["stopped_after_s"] < 0.1 + LATE_S
    assert result["speed"] == pytest.approx([0.0] * 6, abs=1e-6)
    assert result["refused"] is False
    assert result["again"] is True


def test_the_dashboard_and_a_protective_stop(arm: Emulated) -> None:
    result = client("dashboard", arm.host)
    assert "5.11" in result["version"]
    assert result["modes"] == ["Robotmode: RUNNING", "Safetymode: NORMAL", "Safetystatus: NORMAL"]
    assert result["running"] is True
    assert result["remote"] is True
    assert result["model"] == "UR5"
    assert result["program"] == "PLAYING rtde_control"
    assert result["stopped"] == [True, 3, False]
    assert result["refused"] is False
    assert "Cannot unlock protective stop" in result["too_early"]
    assert result["unlocked"] == [False, 1]
    assert result["moves"] is True
    assert result["paused"] == [4, False]
    assert result["resumed"] is True
    assert result["ended"] == 1
    assert result["off"] == ["Robotmode: POWER_OFF", 3]
    assert result["on"] == "Robotmode: POWER_ON"


BODIES = {
    "if": 'if True:\n  textmsg("yes")\nend',
    "while": "i = 0\nwhile i < 3:\n  i = i + 1\nend",
    "a function": "def inner():\n  sleep(0.1)\nend\ninner()",
}


@pytest.mark.sampled(1)
@pytest.mark.parametrize("upper", [False, True], ids=["lower registers", "upper registers"])
@pytest.mark.parametrize("name", BODIES)
def test_a_program_that_cannot_be_read_is_logged_and_holds_no_client(arm: Emulated, name: str, upper: bool) -> None:
    assert client("custom", arm.host, [upper, BODIES[name]]) == {"returned": True, "moved": True}
    assert "custom: " in arm.do("log 5")
    assert "knows only calls of its own functions" in arm.do("log 5")


@anew_after_stalls
def test_inputs_and_outputs(arm: Emulated) -> None:
    result = client("io", arm.host)
    assert all(result["set"])
    assert result["bits"] == 1 << 3 | 1 << 9 | 1 << 16
    assert result["cleared"] == 1 << 9 | 1 << 16
    assert result["slider"] == 0.5
    # 0.25 of 10 V; as a current, 0.5 of 4 to 20 mA.
    assert result["analog"] == pytest.approx([2.5, 0.012])
    # The pendant, a reset and the next client may change the slider that one client has set.
    arm.do("slider 1")
    assert client("slider", arm.host)["seen"] == 1.0
    assert client("io", arm.host)["slider"] == 0.5
    arm.do("reset")
    assert client("slider", arm.host)["seen"] == 1.0


def test_two_clients_of_control_and_reconnection(arm: Emulated) -> None:
    result = client("two_controls", arm.host)
    assert "in use" in result["refused"].lower()
    assert result["states"] == [True] * 3


def test_the_upper_range_of_registers(arm: Emulated) -> None:
    with Client(arm.host) as lower:
        # A client with the lower range does not block it.
        assert lower.inputs([f"input_int_register_{n}" for n in range(24)])[0] == 1
        result = client("upper_registers", arm.host)
    assert result == {"moved": True, "offset": [0.0] * 6}
