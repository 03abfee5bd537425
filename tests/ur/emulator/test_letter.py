"""A client that follows the protocol exactly, others beside it, and noise, on an emulated controller in real time."""

import socket
import struct
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from tests.ur.emulated import Emulated
from tests.ur.raw_rtde import Client
from tests.ur.virtual import START

from haptether.slave.ur_emulator.connections import READ_TIMEOUT_S

pytestmark = pytest.mark.live


LATE_S = 0.1
"""Time in s beyond any observed stall of a shared machine during these tests."""


@pytest.mark.parametrize("protocol", [1, 2])
def test_a_client_to_the_letter(arm: Emulated, protocol: int) -> None:
    names = ["timestamp", "actual_q", "robot_mode", "output_int_register_12"]
    with Client(arm.host, protocol) as rtde, Client(arm.host) as other:
        number, types = rtde.outputs(names, 100.0)
        assert number == (None if protocol == 1 else 1)
        assert types == ["DOUBLE", "VECTOR6D", "INT32", "INT32"]
        assert rtde.inputs(["input_int_register_24"]) == (1, ["INT32"])
        assert rtde.inputs(["input_int_register_24", "input_double_register_24"]) == (2, ["INT32", "DOUBLE"])
        assert other.inputs(["input_int_register_25", "input_int_register_24"]) == (0, ["INT32", "IN_USE"])
        assert other.inputs(["nothing"]) == (0, ["NOT_FOUND"])
        assert rtde.start()
        stamps = [rtde.package()["timestamp"] for _ in range(20)]
        # Version 1 cannot request a rate.
        assert np.median(np.diff(stamps)) == pytest.approx(0.008 if protocol == 1 else 0.01, abs=1e-6)
        assert rtde.package()["actual_q"] == START
        rtde.write(2, "id", 5, 0.5)
        assert rtde.pause()
        rtde.socket.settimeout(0.1)
        with pytest.raises(TimeoutError):
            rtde.next()
        rtde.socket.settimeout(5.0)
        assert rtde.start()
        assert rtde.package()["robot_mode"] == 7
    with Client(arm.host) as third:
        # Released inputs can be reserved again.
        assert third.inputs(["input_int_register_24"]) == (1, ["INT32"])


def test_clients_have_rates_of_their_own(arm: Emulated) -> None:
    with Client(arm.host) as fast, Client(arm.host) as slow:
        for rtde, rate_hz in ((fast, 500.0), (slow, 20.0)):
            rtde.outputs(["timestamp"], rate_hz)
            rtde.start()
            rtde.package()
        for rtde, period_s in ((fast, 0.002), (slow, 0.05)):
            stamps = [rtde.package()["timestamp"] for _ in range(11)]
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
        # No client is dropped before the timeout.
        assert time.monotonic() - begun_s > READ_TIMEOUT_S
        # Other gaps come from stalls of the machine.
        gaps = np.diff([other.package()["timestamp"] for _ in range(100)])
        assert np.median(gaps) == pytest.approx(0.002, abs=1e-6)


@pytest.mark.parametrize("noise", [b"\x00\x00V", b"GET / HTTP/1.1\r\n\r\n", b"\xff" * 70_000, b"\x00\x01"])
def test_noise_harms_nobody(arm: Emulated, noise: bytes) -> None:
    for port in (30004, 29999, 30001, 30002, 30003):
        with socket.create_connection((arm.host, port), 5.0) as broken:
            broken.sendall(noise)
            # Closed with unread data: the other end sees a reset.
            broken.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    with Client(arm.host) as rtde:
        assert rtde.controller_version()[0] == 5


def test_many_clients_at_once(arm: Emulated) -> None:
    def one(_: int) -> tuple[float, float]:
        with Client(arm.host) as rtde:
            rtde.outputs(["timestamp"], 125.0)
            rtde.start()
            stamps = [rtde.package()["timestamp"] for _ in range(40)]
            gaps = np.diff(stamps)
            return float(np.median(gaps)), float(gaps.max())

    with ThreadPoolExecutor(8) as pool:
        medians, longest = zip(*pool.map(one, range(24)), strict=True)
    # Each client gets its requested 125 Hz, except during stalls.
    assert medians == pytest.approx([0.008] * 24, abs=1e-6)
    assert max(longest) < 0.008 + LATE_S
