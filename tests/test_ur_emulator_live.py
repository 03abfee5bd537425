"""The unmodified ur_rtde, and a client to the letter of the protocol, against an emulated controller in real time.

Time bounds are loose: the machine may be shared. What is exact is tested in virtual time.
"""

import json
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from tests.ur.emulated import Emulated, client, emulator, free_host
from tests.ur.plain_rtde import Client
from tests.ur.virtual import START

from haptether.cli import main
from haptether.slave.ur_emulator.joint_tracking import transition
from haptether.slave.ur_emulator.outbox import PATIENCE_S

pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this Python")

CYCLE_S = 0.002
GRID_S = 0.0005
"""Of the search for how late a law was fed."""
TRANSPORT_S = 0.008
"""What a command needs until the law has it: a cycle at most until it is read, one for the servo thread, and one for
the age of the freshest state, with what a client is held up between a call and the look at its clock."""
LATE_S = 0.1
"""More than any stall that a shared machine was seen to have while these ran."""


@pytest.fixture(scope="module")
def shared() -> Iterator[Emulated]:
    with emulator("--unlock-after-s", "0.5", "--scene", "three_axis_box") as running:
        yield running


@pytest.fixture
def arm(shared: Emulated) -> Emulated:
    shared.do("reset")
    return shared


def accepted(result: dict[str, Any]) -> None:
    assert result["accepted"] == result["calls"]
    assert result["stopped"] is True
    assert result["runtime_state"] == 2
    assert result["safety_mode"] == 1
    assert result["state_steps_back"] == 0
    # A machine that stalls the client costs it states; none comes between two control cycles.
    cycles = np.diff(result["time_s"]) / 0.002
    assert np.abs(cycles - cycles.round()).max() < 1e-6
    assert 1.0 in cycles.round()


def followed(result: dict[str, Any], values: np.ndarray) -> tuple[float, float]:
    """How late in s the law of servoj took the commands that were given, and how far in RMS the values are off it.

    `q'' = gain (u - q - lookahead q')` is driven by the commands at the times at which they were given, so a client
    that stalls bends nothing; the lateness is the one that fits best.
    """
    stamps, seen, wall, commands = (np.array(result[name]) for name in ("time_s", "seen_s", "wall_s", "command"))
    # What the two clocks differ by, and how old the freshest state was.
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


# ----------------------------------------------------------------------------------------------------- streaming


@pytest.fixture(scope="module")
def streams(shared: Emulated) -> dict[str, Any]:
    """Every mode at 500 Hz, one after another."""
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
    # A command passes the servo thread, which takes a cycle, before the law has it.
    assert CYCLE_S - GRID_S <= late_s <= TRANSPORT_S
    # At 0.6 rad/s the rhythm of two clocks is worth 1.2 mrad a cycle.
    assert off < 1.2e-3
    assert np.ptp(q[:, 0]) > 0.06
    assert np.abs(q[:, 1:] - START[1:]).max() < 1e-9


def test_servol_tracks_as_the_law_of_servoj_says(streams: dict[str, Any]) -> None:
    pose = np.array(streams["servol"]["pose"])
    late_s, off = followed(streams["servol"], pose[:, 2])
    assert CYCLE_S - GRID_S <= late_s <= TRANSPORT_S
    # At 0.13 m/s, 0.25 mm a cycle.
    assert off < 0.25e-3
    assert np.ptp(pose[:, 2]) > 0.012
    # The law acts on joints: off its line the tool is by what is curved between.
    assert np.ptp(pose[:, :2], axis=0).max() < 1e-4


def test_speedl_and_speedj_reach_their_velocities(streams: dict[str, Any]) -> None:
    assert streams["speedl"]["speed"] == pytest.approx([0.0, 0.0, 0.05, 0.0, 0.0, 0.0], abs=1e-4)
    rows = [
        ("speedl", np.array(streams["speedl"]["pose"])[:, 2], 0.05),
        ("speedj", np.array(streams["speedj"]["q"])[:, 0], 0.1),
    ]
    for mode, values, speed in rows:
        stamps = streams[mode]["time_s"]
        # Half of the 0.2 s in which it speeds up are missing, and some cycles before it begins.
        assert values[-1] - values[0] == pytest.approx(speed * (stamps[-1] - stamps[0] - 0.1), abs=0.02 * speed)


def test_force_mode_presses_a_box(streams: dict[str, Any]) -> None:
    force, x = (np.array(streams["force"][name])[:, 0] for name in ("force", "pose"))
    # Free for 20 mm, then into 150 N/m.
    assert np.abs(force[:100]).max() == 0.0
    depth = x[0] - x[-1] - 0.02
    assert 0.005 < depth < 0.04
    # The box has 1 N s/m, and the tool comes at 40 mm/s.
    assert force[-1] == pytest.approx(150.0 * depth, abs=0.05)


def test_a_command_shows_in_the_state_within_cycles(arm: Emulated) -> None:
    result = client("latency", arm.host, [6])
    # Two whole cycles at least, three at most, and the client's polling.
    assert 0.0035 < result["min_s"] < 0.02
    assert result["p50_s"] < 0.02


# -------------------------------------------------------------------------------------------- everything once


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
    # It bites in the first cycle that begins more than 0.1 s after the one that heard the last command.
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


def test_inputs_and_outputs(arm: Emulated) -> None:
    result = client("io", arm.host)
    assert all(result["set"])
    assert result["bits"] == 1 << 3 | 1 << 9 | 1 << 16
    assert result["cleared"] == 1 << 9 | 1 << 16
    assert result["slider"] == 0.5
    assert result["analog"] == pytest.approx(0.25)


def test_two_clients_of_control_and_reconnection(arm: Emulated) -> None:
    result = client("two_controls", arm.host)
    assert "in use" in result["refused"].lower()
    assert result["states"] == [True] * 3


def test_the_upper_range_of_registers(arm: Emulated) -> None:
    with Client(arm.host) as lower:
        # Whoever has the lower range is not in the way.
        assert lower.inputs([f"input_int_register_{n}" for n in range(24)])[0] == 1
        result = client("upper_registers", arm.host)
    assert result == {"moved": True, "offset": [0.0] * 6}


@pytest.mark.parametrize("version", ["3.15", "5.23"])
def test_other_versions(version: str) -> None:
    with emulator("--version", version, "--model", "ur10" if version == "3.15" else "ur20") as other:
        rate_hz = 125.0 if version == "3.15" else 500.0
        result = client("streams", other.host, [rate_hz, ["servoj", 0.6, 0.05, 2.0]])["servoj"]
        assert result["accepted"] == result["calls"]
        assert result["stopped"] is True
        assert np.diff(np.unique(result["time_s"])).min() == pytest.approx(1.0 / rate_hz, abs=1e-6)
        assert np.ptp(np.array(result["q"])[:, 0]) > 0.05
        with Client(other.host) as plain:
            assert plain.controller_version()[:2] == tuple(map(int, version.split(".")))


# ------------------------------------------------------------------------------------------------------ the letter


@pytest.mark.parametrize("protocol", [1, 2])
def test_a_client_to_the_letter(arm: Emulated, protocol: int) -> None:
    names = ["timestamp", "actual_q", "robot_mode", "output_int_register_12"]
    with Client(arm.host, protocol) as plain, Client(arm.host) as other:
        number, types = plain.outputs(names, 100.0)
        assert number == (None if protocol == 1 else 1)
        assert types == ["DOUBLE", "VECTOR6D", "INT32", "INT32"]
        assert plain.inputs(["input_int_register_24"]) == (1, ["INT32"])
        assert plain.inputs(["input_int_register_24", "input_double_register_24"]) == (2, ["INT32", "DOUBLE"])
        assert other.inputs(["input_int_register_25", "input_int_register_24"]) == (0, ["INT32", "IN_USE"])
        assert other.inputs(["nothing"]) == (0, ["NOT_FOUND"])
        assert plain.start()
        stamps = [plain.package()["timestamp"] for _ in range(20)]
        # Version 1 cannot ask for a rate.
        assert np.median(np.diff(stamps)) == pytest.approx(0.008 if protocol == 1 else 0.01, abs=1e-6)
        assert plain.package()["actual_q"] == START
        plain.write(2, "id", 5, 0.5)
        assert plain.pause()
        plain.socket.settimeout(0.1)
        with pytest.raises(TimeoutError):
            plain.next()
        plain.socket.settimeout(5.0)
        assert plain.start()
        assert plain.package()["robot_mode"] == 7
    with Client(arm.host) as third:
        # What was given back can be had again.
        assert third.inputs(["input_int_register_24"]) == (1, ["INT32"])


def test_clients_have_rates_of_their_own(arm: Emulated) -> None:
    with Client(arm.host) as fast, Client(arm.host) as slow:
        for plain, rate_hz in ((fast, 500.0), (slow, 20.0)):
            plain.outputs(["timestamp"], rate_hz)
            plain.start()
            plain.package()
        for plain, period_s in ((fast, 0.002), (slow, 0.05)):
            stamps = [plain.package()["timestamp"] for _ in range(11)]
            assert np.median(np.diff(stamps)) == pytest.approx(period_s, abs=1e-6)


def test_a_client_that_reads_nothing_is_dropped_and_others_are_not(arm: Emulated) -> None:
    names = ["actual_q", "target_q", "actual_TCP_pose", "actual_qd", "target_qd"] * 8
    with Client(arm.host) as deaf, Client(arm.host) as other:
        deaf.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        deaf.outputs(names, 500.0)
        begun_s = time.monotonic()
        deaf.start()
        other.outputs(["timestamp"], 500.0)
        other.start()
        begin = other.package()["timestamp"]
        while arm.status()["connections"].count("rtde") == 2:
            assert other.package()["timestamp"] - begin < 10.0
        # Nobody is dropped before the end of patience.
        assert time.monotonic() - begun_s > PATIENCE_S
        # What else is missing, a machine that stalls takes.
        gaps = np.diff([other.package()["timestamp"] for _ in range(100)])
        assert np.median(gaps) == pytest.approx(0.002, abs=1e-6)


@pytest.mark.parametrize("noise", [b"\x00\x00V", b"GET / HTTP/1.1\r\n\r\n", b"\xff" * 70_000, b"\x00\x01"])
def test_noise_harms_nobody(arm: Emulated, noise: bytes) -> None:
    for port in (30004, 29999, 30001, 30002, 30003):
        with socket.create_connection((arm.host, port), 5.0) as broken:
            broken.sendall(noise)
            # Closed with what was sent unread: the other end sees a reset.
            broken.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    with Client(arm.host) as plain:
        assert plain.controller_version()[0] == 5


def test_many_clients_at_once(arm: Emulated) -> None:
    def one(_: int) -> tuple[float, float]:
        with Client(arm.host) as plain:
            plain.outputs(["timestamp"], 125.0)
            plain.start()
            stamps = [plain.package()["timestamp"] for _ in range(40)]
            gaps = np.diff(stamps)
            return float(np.median(gaps)), float(gaps.max())

    with ThreadPoolExecutor(8) as pool:
        medians, longest = zip(*pool.map(one, range(24)), strict=True)
    # Whoever asked for 125 Hz gets that and no more, but for what a stall takes.
    assert medians == pytest.approx([0.008] * 24, abs=1e-6)
    assert max(longest) < 0.008 + LATE_S


# --------------------------------------------------------------------------------------------------- the process


@pytest.mark.parametrize("way", ["SIGINT", "SIGTERM", "end of input"])
def test_it_ends_cleanly(way: str) -> None:
    with emulator() as running:
        assert running.process.stdin is not None
        if way == "end of input":
            running.process.stdin.close()
        else:
            running.process.send_signal(signal.Signals[way])
        assert running.process.wait(5.0) == 0


@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        (["--host", "192.0.2.1"], 2, "add --expose"),
        (["--host", "nowhere"], 2, "must be an IPv4 address"),
        (["--host", "::1"], 2, "must be an IPv4 address"),
        (["--model", "ur6"], 2, "must be one of"),
        (["--version", "4.2"], 2, "must be 3.15"),
        (["--scene", "no_scene"], 2, "no shipped scene"),
        (["--noise", "-1"], 2, "must be finite and 0 or more"),
        (["--start", "9", "0", "0", "0", "0", "0"], 2, "start"),
        (["--control", "192.0.2.1:9000"], 2, "control = "),
    ],
)
def test_bad_requests_are_refused(
    arguments: list[str], status: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    host = ["--host", free_host()] if "--host" not in arguments else []
    assert main(["ur-emulator", "--duration-s", "1", *host, *arguments]) == status
    complaint = capsys.readouterr().err
    assert said in complaint
    assert complaint.count("\n") == 1


def test_a_port_in_use_is_a_failed_run(arm: Emulated, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["ur-emulator", "--host", arm.host]) == 1
    assert f"{arm.host}:30004" in capsys.readouterr().err


def test_the_control_line_on_a_socket(arm: Emulated, tmp_path: Any) -> None:  # noqa: ANN401
    del arm
    path = tmp_path / "control.sock"
    host = free_host()
    command = [sys.executable, "-m", "haptether", "ur-emulator", "--host", host, "--control", str(path)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        assert f"controlled by {path}" in process.stdout.readline()
        assert path.stat().st_mode & 0o077 == 0
        with socket.socket(socket.AF_UNIX) as control:
            control.settimeout(5.0)
            control.connect(str(path))
            control.sendall(b"status\nnonsense\nquit\n")
            answers = b""
            while answers.count(b"\n") < 3:
                answers += control.recv(1 << 16)
        status, error, end = answers.decode().splitlines()
        assert json.loads(status.removeprefix("ok "))["model"] == "ur5e"
        assert error.startswith("error: 'nonsense': must be one of")
        assert end == "ok"
        assert process.wait(5.0) == 0
        assert not path.exists()
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
