"""The unmodified ur_rtde, and a client to the letter of the protocol, against an emulated controller in real time.

Time bounds are loose: the machine may be shared. What is exact is tested in virtual time.
"""

import json
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from tests.ur.emulated import Emulated, client, emulator, free_host, result_of
from tests.ur.plain_rtde import Client
from tests.ur.virtual import START

pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this Python")

TRANSPORT_S = 0.02
"""What a command needs beyond the law: a cycle at most until it is read, one for the servo thread, half a one of
holding, the age of the state, and what a shared machine adds."""
SETTLED_S = 0.5
"""When a sine of servoj has settled: gain 300 and lookahead 0.1 s let what was before decay by exp(-15 t)."""
LATE_S = 0.1
"""More than any stall that a shared machine was seen to have while these ran."""


@pytest.fixture(scope="module")
def shared() -> Iterator[Emulated]:
    with emulator("--unlock-after-s", "0.5") as running:
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


def wave(values: np.ndarray, wall_s: list[float], frequency_hz: float) -> tuple[float, float]:
    """Amplitude and delay in s of a sampled `1 - cos(2 pi f t)` by least squares, once it has settled."""
    t = np.array(wall_s)
    settled = t > SETTLED_S
    w = 2 * np.pi * frequency_hz
    columns = np.column_stack((np.ones_like(t), np.cos(w * t), np.sin(w * t)))[settled]
    _, c, s = np.linalg.lstsq(columns, values[settled], rcond=None)[0]
    return float(np.hypot(c, s)), float((np.arctan2(-s, -c) / w) % (1.0 / frequency_hz))


def law(frequency_hz: float, lookahead_s: float, gain: float) -> tuple[float, float]:
    """Amplitude ratio and delay in s of `q'' = gain (u - q - lookahead q')` for a sine."""
    w = 2 * np.pi * frequency_hz
    response = gain / (gain - w * w + 1j * w * gain * lookahead_s)
    return abs(response), -np.angle(response) / w


# ----------------------------------------------------------------------------------------------------- streaming


@pytest.fixture(scope="module")
def streams(shared: Emulated) -> dict[str, Any]:
    """Every mode at 500 Hz, one after another."""
    shared.do("reset")
    runs = [
        ["servoj", 1.5, 0.05, 2.0],
        ["servol", 1.5, 0.01, 2.0],
        ["speedl", 0.8, [0.0, 0.0, 0.05, 0.0, 0.0, 0.0], 0.0],
        ["speedj", 0.6, [0.1, 0.0, 0.0, 0.0, 0.0, 0.0]],
    ]
    return client("streams", shared.host, [500.0, *runs])


@pytest.mark.parametrize("mode", ["servoj", "servol", "speedl", "speedj"])
def test_every_call_at_500_hz_is_accepted(streams: dict[str, Any], mode: str) -> None:
    accepted(streams[mode])


def test_servoj_tracks_as_its_law_says(streams: dict[str, Any]) -> None:
    q = np.array(streams["servoj"]["q"])
    amplitude, delay_s = wave(q[:, 0], streams["servoj"]["wall_s"], 2.0)
    ratio, lag_s = law(2.0, 0.1, 300.0)
    assert amplitude == pytest.approx(0.05 * ratio, rel=0.02)
    assert lag_s + 0.002 < delay_s < lag_s + TRANSPORT_S
    assert np.abs(q[:, 1:] - START[1:]).max() < 1e-9


def test_servol_tracks_as_the_law_of_servoj_says(streams: dict[str, Any]) -> None:
    pose = np.array(streams["servol"]["pose"])
    amplitude, delay_s = wave(pose[:, 2], streams["servol"]["wall_s"], 2.0)
    ratio, lag_s = law(2.0, 0.1, 300.0)
    assert amplitude == pytest.approx(0.01 * ratio, rel=0.02)
    assert lag_s + 0.002 < delay_s < lag_s + TRANSPORT_S
    # The law acts on joints: off its line the tool is by what is curved between.
    assert np.ptp(pose[:, :2], axis=0).max() < 1e-4


def test_speedl_and_speedj_reach_their_velocities(streams: dict[str, Any]) -> None:
    assert streams["speedl"]["speed"] == pytest.approx([0.0, 0.0, 0.05, 0.0, 0.0, 0.0], abs=1e-4)
    z = np.array(streams["speedl"]["pose"])[:, 2]
    # 50 mm/s for 0.8 s, less half of the 0.2 s in which it speeds up.
    assert z[-1] - z[0] == pytest.approx(0.05 * 0.7, abs=0.05 * LATE_S)
    q = np.array(streams["speedj"]["q"])[:, 0]
    assert q[-1] - q[0] == pytest.approx(0.1 * 0.5, abs=0.1 * LATE_S)


def test_force_mode_presses_a_box() -> None:
    bias = ("--bias", "1", "0", "0", "0", "0", "0")
    with emulator("--scene", "three_axis_box", "--noise", "0.2", *bias) as boxed:
        result = client("streams", boxed.host, [500.0, ["force", 2.0, [-25.0, 0.0, 0.0, 0.0, 0.0, 0.0]]])["force"]
    accepted(result)
    force, x = np.array(result["force"])[:, 0], np.array(result["pose"])[:, 0]
    assert force[:100].mean() == pytest.approx(1.0, abs=0.1)
    assert force[:100].std() == pytest.approx(0.2, rel=0.3)
    # Free for 20 mm, then into 150 N/m.
    depth = x[0] - x[-1] - 0.02
    assert 0.005 < depth < 0.04
    assert force[-20:].mean() == pytest.approx(1.0 + 150.0 * depth, abs=1.0)


def test_a_command_shows_in_the_state_within_cycles(arm: Emulated) -> None:
    result = client("latency", arm.host, [8])
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
    assert 0.05 < result["stopped_after_s"] < 0.1 + LATE_S
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
    assert result["on"] == "Robotmode: RUNNING"


def test_inputs_and_outputs(arm: Emulated) -> None:
    result = client("io", arm.host)
    assert all(result["set"])
    assert result["bits"] == 1 << 3 | 1 << 9 | 1 << 16
    assert result["cleared"] == 1 << 9 | 1 << 16
    assert result["slider"] == 0.5
    assert result["analog"] == pytest.approx(0.25)


def test_two_clients_of_control_and_reconnection(arm: Emulated) -> None:
    result = client("two_controls", arm.host)
    assert "already in use" in result["refused"].lower() or "in use" in result["refused"].lower()
    assert result["moved"] is True
    assert all(client("reconnects", arm.host)["states"])


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


# -------------------------------------------------------------------------------------------------------- faults


def while_streaming(arm: Emulated, *lines: tuple[float, str]) -> dict[str, Any] | None:
    """What a stream of servoJ meets while control lines are said, each some time in s after the one before.

    None where ur_rtde crashed: two of its threads connect again at once, and sometimes into each other.
    """
    command = [sys.executable, "-m", "tests.ur.clients", "lost", arm.host, "[2.5]"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    assert process.stdout is not None
    killer = threading.Timer(25.0, process.kill)
    killer.start()
    try:
        for line in process.stdout:
            if line.strip() == "streaming":
                break
        for after_s, line in lines:
            time.sleep(after_s)
            arm.do(line)
        told = process.stdout.read()
        process.wait()
    finally:
        killer.cancel()
        process.kill()
        process.wait()
        process.stdout.close()
    return result_of(told) if process.returncode != -signal.SIGSEGV else None


def test_a_freeze_is_not_seen_by_the_client_but_the_state_stands_still(arm: Emulated) -> None:
    result = while_streaming(arm, (0.5, "freeze 1.0"))
    assert result is not None
    assert [outcome for _, outcome in result["outcomes"]] == ["True"]
    assert 0.9 < result["longest_silence_s"] < 1.0 + 3 * LATE_S
    assert result["last_state_s"] > 2.0


def test_dropped_connections_are_met_again(arm: Emulated) -> None:
    result = while_streaming(arm, (0.5, "drop rtde"))
    # The client connects again by itself, from two threads at once: usually that works, sometimes it gives up, and
    # sometimes it crashes. Its receiver never comes back. The controller has room for the next in any case.
    if result is not None:
        assert result["connected"][1] is False
        assert result["last_state_s"] < 1.0
    assert client("connect_control", arm.host)["refused"] == ""


@pytest.mark.parametrize(
    ("line", "undo", "key", "value"),
    [
        ("protective-stop somebody is there", "reset", "safety_mode", "PROTECTIVE_STOP"),
        ("emergency-stop", "reset", "safety_mode", "ROBOT_EMERGENCY_STOP"),
        ("safety-fault", "reset", "safety_mode", "FAULT"),
        ("stop-program", "reset", "runtime_state", "STOPPED"),
        ("power off", "reset", "robot_mode", "POWER_OFF"),
    ],
)
def test_stops_on_command_end_the_program(arm: Emulated, line: str, undo: str, key: str, value: str) -> None:
    with Client(arm.host) as plain:
        names = ["runtime_state", "robot_mode", "safety_mode", "safety_status_bits", "robot_status_bits"]
        plain.outputs(names, 500.0)
        plain.start()
        with socket.create_connection((arm.host, 30003), 5.0) as script:
            script.sendall(b"def waiting():\n  sleep(20)\nend\n")
            plain.until(runtime_state=2)
            arm.do(line)
            package = plain.until(runtime_state=1)
            for _ in range(5):
                package = plain.package()
        assert arm.status()[key] == value
        expected = {
            "protective-stop": (7, 3, 1 << 2 | 1 << 10),
            "emergency-stop": (3, 7, 1 << 6 | 1 << 7 | 1 << 10),
            "safety-fault": (7, 9, 1 << 9 | 1 << 10),
            "stop-program": (7, 1, 1),
            "power": (3, 1, 1),
        }[line.split(maxsplit=1)[0]]
        assert (package["robot_mode"], package["safety_mode"], package["safety_status_bits"]) == expected
        arm.do(undo)
        plain.until(robot_mode=7, safety_mode=1)


def test_a_client_that_nobody_sees_holds_the_registers(arm: Emulated) -> None:
    arm.do("in-use on")
    assert "in use" in client("connect_control", arm.host)["refused"].lower()
    arm.do("in-use off")
    assert client("connect_control", arm.host)["refused"] == ""


def test_local_control_and_wrong_versions_refuse_the_client(arm: Emulated) -> None:
    arm.do("remote-control off")
    assert "remote control" in client("connect_control", arm.host)["refused"].lower()
    arm.do("remote-control on")
    arm.do("version 3.2.0.19000")
    with Client(arm.host) as plain:
        assert plain.controller_version() == (3, 2, 0, 19000)
    arm.do("version real")
    with Client(arm.host) as plain:
        assert plain.controller_version() == (5, 11, 0, 0)


def test_connections_can_be_refused(arm: Emulated) -> None:
    arm.do("refuse on")
    with pytest.raises((ConnectionResetError, BrokenPipeError)), Client(arm.host):
        pass
    arm.do("refuse off")
    with Client(arm.host) as plain:
        assert plain.controller_version()[0] == 5


def test_packages_can_be_late(arm: Emulated) -> None:
    with Client(arm.host) as prompt:
        prompt.outputs(["timestamp"], 500.0)
        prompt.start()
        arm.do("late 0.15 0.01")
        stamps = [prompt.package()["timestamp"] for _ in range(200)]
        begin, newest = time.monotonic(), 0.0
        while time.monotonic() - begin < 0.3:
            newest = prompt.package()["timestamp"]
        age_s = 100.0 + arm.status()["time_s"] - newest
        arm.do("late 0")
    # They keep their order.
    assert min(np.diff(stamps)) == pytest.approx(0.002, abs=1e-6)
    assert 0.14 < age_s < 0.16 + LATE_S


def test_a_push_is_felt(arm: Emulated) -> None:
    with Client(arm.host) as plain:
        plain.outputs(["actual_TCP_force", "safety_mode"], 500.0)
        plain.start()
        arm.do("push 10,-20,5 0.2")
        assert plain.until(actual_TCP_force=(10.0, -20.0, 5.0, 0.0, 0.0, 0.0))["safety_mode"] == 1
        plain.until(actual_TCP_force=(0.0,) * 6)
        arm.do("push 200")
        plain.until(safety_mode=3)


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
        deaf.start()
        other.outputs(["timestamp"], 500.0)
        other.start()
        begin = other.package()["timestamp"]
        while arm.status()["connections"].count("rtde") == 2:
            assert other.package()["timestamp"] - begin < 10.0
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
    def one(_: int) -> float:
        with Client(arm.host) as plain:
            plain.outputs(["timestamp"], 125.0)
            plain.start()
            stamps = [plain.package()["timestamp"] for _ in range(40)]
            return float(np.diff(stamps).max())

    with ThreadPoolExecutor(8) as pool:
        assert max(pool.map(one, range(24))) < 0.008 + LATE_S


# --------------------------------------------------------------------------------------------------- the process


@pytest.mark.parametrize("way", ["line", "SIGINT", "SIGTERM", "end of input"])
def test_it_ends_cleanly(way: str) -> None:
    with emulator() as running:
        assert running.process.stdin is not None
        if way == "line":
            assert running.ask("quit") == "ok"
        elif way == "end of input":
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
def test_bad_requests_are_refused(arguments: list[str], status: int, said: str) -> None:
    host = ["--host", free_host()] if "--host" not in arguments else []
    ended = subprocess.run(
        [sys.executable, "-m", "haptether", "ur-emulator", "--duration-s", "1", *host, *arguments],
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )
    assert ended.returncode == status, ended.stderr
    assert said in ended.stderr
    assert ended.stderr.count("\n") == 1


def test_a_port_in_use_is_a_failed_run(arm: Emulated) -> None:
    ended = subprocess.run(
        [sys.executable, "-m", "haptether", "ur-emulator", "--host", arm.host],
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )
    assert ended.returncode == 1
    assert f"{arm.host}:30004" in ended.stderr


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
            control.sendall(b"status\nnonsense\n\n \r\nquit\n")
            answers = b""
            while came := control.recv(1 << 16):
                answers += came
        status, error, empty, blank, end = answers.decode().splitlines()
        assert json.loads(status.removeprefix("ok "))["model"] == "ur5e"
        assert error.startswith("error: 'nonsense': must be one of")
        # Whoever waits for an answer to each line must get one.
        assert empty == blank
        assert empty.startswith("error: an empty line: must be one of")
        assert end == "ok"
        assert process.wait(5.0) == 0
        assert not path.exists()
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
