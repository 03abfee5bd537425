"""The emulated bus over TCP."""

import re
import socket

import pytest
import serial  # type: ignore[import-untyped]
from dynamixel_sdk import port_handler  # type: ignore[import-untyped]
from tests.dynamixel.emulated import EmulatedBus, VendorClient, emulated_bus, vendor_client

from haptether.cli import main

pytestmark = pytest.mark.live

PING_1 = bytes.fromhex("fffffd0001030001194e")
"""Ping of ID 1. Source: ROBOTIS e-Manual, Protocol 2.0, the example of a ping of ID 1."""


def tcp_of(bus: EmulatedBus) -> tuple[str, int]:
    host, _, port = bus.status()["tcp"].rpartition(":")
    return host, int(port)


def connected(bus: EmulatedBus) -> socket.socket:
    return socket.create_connection(tcp_of(bus), timeout=5.0)


def test_the_vendors_client_reads_and_writes_over_tcp(monkeypatch: pytest.MonkeyPatch) -> None:
    with emulated_bus("--tcp", "127.0.0.1:0") as bus:
        host, port = tcp_of(bus)

        def opened(port: str, *, timeout: float, **_how: object) -> serial.SerialBase:
            return serial.serial_for_url(port, timeout=timeout)

        monkeypatch.setattr(port_handler.serial, "Serial", opened)
        client = VendorClient(f"socket://{host}:{port}")
        try:
            assert client.packets.ping(client.port, 1) == (1020, 0, 0)
            assert client.write(1, 65, 1, 1) == (0, 0)
            assert client.read(1, 65, 1) == (1, 0, 0)
        finally:
            client.close()
        # The terminal reaches the same servos.
        monkeypatch.undo()
        with vendor_client(bus.port) as client:
            assert client.read(1, 65, 1) == (1, 0, 0)


def test_one_client_at_a_time_and_the_next_one_after_it() -> None:
    with emulated_bus("--tcp", "127.0.0.1:0") as bus:
        with connected(bus) as first:
            first.sendall(PING_1)
            assert re.match(rb"\xff\xff\xfd\x00\x01", first.recv(64))
            with connected(bus) as second:
                assert second.recv(64) == b""
            # Send the packet in pieces, after bytes that are no packet.
            first.sendall(b"\x00\xff" + PING_1[:4])
            first.sendall(PING_1[4:])
            assert first.recv(64)
        with connected(bus) as third:
            third.sendall(PING_1)
            assert third.recv(64)
            bus.do("unplug")
            assert third.recv(64) == b""
        with connected(bus) as unplugged:
            assert unplugged.recv(64) == b""
        bus.do("plug")
        with connected(bus) as anew:
            anew.sendall(PING_1)
            assert anew.recv(64)


@pytest.mark.parametrize("address", ["7000", "127.0.0.1:", "127.0.0.1:70000", ":7000"])
def test_an_address_that_is_none_is_refused(address: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["dynamixel-emulator", "--duration-s", "1", "--tcp", address]) == 2
    assert "must be HOST:PORT" in capsys.readouterr().err
