"""The unmodified ur_rtde streams to an emulated controller in real time.

Time bounds are loose: the machine may be shared. Exact behaviour is tested in virtual time.
"""

from typing import Any

import numpy as np
import pytest
from tests.ur.emulated import Emulated, client, emulator
from tests.ur.raw_rtde import Client
from tests.ur.virtual import START

from haptether.slave.ur_emulator.robot.motions import transition

pytestmark = pytest.mark.alone


pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this Python")

CYCLE_S = 0.002
GRID_S = 0.0005
"""Grid in s of the search for the lateness of a law's input."""
TRANSPORT_S = 0.008
"""Longest time in s until the law has a command: a cycle until it is read, one for the servo thread, and one for the
age of the freshest state. It includes delays of the client between a call and its clock."""

EMULATOR = ("--scene", "three_axis_box")


def accepted(result: dict[str, Any]) -> None:
    assert result["accepted"] == result["calls"]
    assert result["stopped"] is True
    assert result["runtime_state"] == 2
    assert result["safety_mode"] == 1
    assert result["state_steps_back"] == 0
    # A stalled machine loses states of the client; none comes between two control cycles.
    cycles = np.diff(result["time_s"]) / 0.002
    assert np.abs(cycles - cycles.round()).max() < 1e-6
    assert 1.0 in cycles.round()


def followed(result: dict[str, Any], values: np.ndarray) -> tuple[float, float]:
    """Return the lateness in s at which the law of servoj took the commands, and the RMS error of the values.

    `q'' = gain (u - q - lookahead q')` is driven by the commands at their actual times, so a stalled client bends
    nothing. The lateness is the best fit.
    """
    stamps, seen, wall, commands = (np.array(result[name]) for name in ("time_s", "seen_s", "wall_s", "command"))
    # This removes the offset of the two clocks, with the age of the freshest state.
    given_s = wall - (seen - stamps).min()
    a, b, c, d = transition(300.0, 30.0, 0.002)
    cycles = np.arange(round((stamps[-1] - stamps[0]) / 0.002) + 1)
    at = np.rint((stamps - stamps[0]) / 0.002).astype(int)

    def rms(late_s: float) -> float:
        held = np.searchsorted(given_s, stamps[0] + 0.002 * cycles - late_s) - 1
        q, v, path = values[0], 0.0, []
        for goal in np.where(held >= 0, commands[np.maximum(held, 0)], values[0]):
            path.append(q)
            q, v = goal + a * (q - goal) + b * v, c * (q - goal) + d * v
        return float(np.sqrt(np.mean((np.array(path)[at] - values) ** 2)))

    off, late_s = min((rms(late_s), late_s) for late_s in np.arange(-0.004, 0.012, GRID_S))
    return late_s, off


@pytest.fixture(scope="module")
def streams(shared: Emulated) -> dict[str, Any]:
    """Run every mode at 500 Hz, one after another."""
    shared.do("reset")
    runs = [
        ["servoj", 1.0, 0.05, 2.0],
        ["servol", 1.0, 0.01, 2.0],
        ["speedl", 0.6, [0.0, 0.0, 0.05, 0.0, 0.0, 0.0], 0.0],
        ["speedj", 0.5, [0.1, 0.0, 0.0, 0.0, 0.0, 0.0]],
        ["force", 1.0, [-50.0, 0.0, 0.0, 0.0, 0.0, 0.0]],
    ]
    return client("streams", shared.host, [500.0, *runs])


@pytest.mark.parametrize("mode", ["servoj", "servol", "speedl", "speedj", "force"])
def test_every_call_at_500_hz_is_accepted(streams: dict[str, Any], mode: str) -> None:
    accepted(streams[mode])


def test_servoj_tracks_as_its_law_says(streams: dict[str, Any]) -> None:
    q = np.array(streams["servoj"]["q"])
    late_s, off = followed(streams["servoj"], q[:, 0])
    # The servo thread takes a cycle before the law has a command.
    assert CYCLE_S - GRID_S <= late_s <= TRANSPORT_S
    # At 0.6 rad/s the beat of two clocks is worth 1.2 mrad per cycle.
    assert off < 1.2e-3
    assert np.ptp(q[:, 0]) > 0.06
    assert np.abs(q[:, 1:] - START[1:]).max() < 1e-9


def test_servol_tracks_as_the_law_of_servoj_says(streams: dict[str, Any]) -> None:
    pose = np.array(streams["servol"]["pose"])
    late_s, off = followed(streams["servol"], pose[:, 2])
    assert CYCLE_S - GRID_S <= late_s <= TRANSPORT_S
    # At 0.13 m/s, 0.25 mm per cycle.
    assert off < 0.25e-3
    assert np.ptp(pose[:, 2]) > 0.012
    # The law acts on joints: between commands the tool's path is curved.
    assert np.ptp(pose[:, :2], axis=0).max() < 1e-4


def test_speedl_and_speedj_reach_their_velocities(streams: dict[str, Any]) -> None:
    assert streams["speedl"]["speed"] == pytest.approx([0.0, 0.0, 0.05, 0.0, 0.0, 0.0], abs=1e-4)
    rows = [
        ("speedl", np.array(streams["speedl"]["pose"])[:, 2], 0.05),
        ("speedj", np.array(streams["speedj"]["q"])[:, 0], 0.1),
    ]
    for mode, values, speed in rows:
        stamps = streams[mode]["time_s"]
        # Half of the 0.2 s of acceleration is missing, and some cycles before it begins.
        assert values[-1] - values[0] == pytest.approx(speed * (stamps[-1] - stamps[0] - 0.1), abs=0.02 * speed)


def test_force_mode_presses_a_box(streams: dict[str, Any]) -> None:
    force, x = (np.array(streams["force"][name])[:, 0] for name in ("force", "pose"))
    # The tool is free for 20 mm, then goes into 150 N/m.
    assert np.abs(force[:100]).max() == 0.0
    depth = x[0] - x[-1] - 0.02
    assert 0.005 < depth < 0.04
    # The box has 1 N s/m, and the tool comes at 40 mm/s.
    assert force[-1] == pytest.approx(150.0 * depth, abs=0.05)


def test_a_command_shows_in_the_state_within_cycles(arm: Emulated) -> None:
    result = client("latency", arm.host, [6])
    # At least two whole cycles and at most three, plus the client's polling.
    assert 0.0035 < result["min_s"] < 0.02
    assert result["p50_s"] < 0.02


@pytest.mark.parametrize("version", ["3.15", "5.23"])
def test_other_versions(version: str) -> None:
    with emulator("--version", version, "--model", "ur10" if version == "3.15" else "ur20") as other:
        rate_hz = 125.0 if version == "3.15" else 500.0
        result = client("streams", other.host, [rate_hz, ["servoj", 0.6, 0.05, 2.0]])["servoj"]
        assert result["accepted"] == result["calls"]
        assert result["stopped"] is True
        assert np.diff(np.unique(result["time_s"])).min() == pytest.approx(1.0 / rate_hz, abs=1e-6)
        assert np.ptp(np.array(result["q"])[:, 0]) > 0.05
        with Client(other.host) as rtde:
            assert rtde.controller_version()[:2] == tuple(map(int, version.split(".")))
