"""A port that another process holds: every command that listens names the holder's remedy and its own option."""

import contextlib
import re
import socket
from collections.abc import Iterator

import pytest

from haptether.cli.entry import main

UDP, TCP = socket.SOCK_DGRAM, socket.SOCK_STREAM


@contextlib.contextmanager
def held(kind: int, host: str, port: int = 0) -> Iterator[int]:
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, kind) as holder:
        holder.bind((host, port))
        if kind == TCP:
            holder.listen()
        yield holder.getsockname()[1]


@pytest.mark.parametrize(
    ("kind", "option", "arguments"),
    [
        (UDP, "listen", ["slave", "--insecure", "--listen", "127.0.0.1:PORT"]),
        (UDP, "listen", ["slave", "--insecure", "--listen", "[::1]:PORT"]),
        (UDP, "listen", ["master", "--insecure", "--peer", "127.0.0.1:9", "--listen", "127.0.0.1:PORT"]),
        (UDP, "listen", ["netsim", "proxy", "--forward", "127.0.0.1:9", "--listen", "127.0.0.1:PORT"]),
        (UDP, "listen", ["netsim", "echo", "--listen", "127.0.0.1:PORT"]),
        (
            TCP,
            "control",
            ["netsim", "proxy", "--forward", "127.0.0.1:9", "--listen", "127.0.0.1:0", "--control", "127.0.0.1:PORT"],
        ),
        (TCP, "port", ["inverse3-emulator", "--port", "PORT", "--event-port", "0"]),
        (TCP, "event-port", ["inverse3-emulator", "--port", "0", "--event-port", "PORT"]),
        (TCP, "tcp", ["dynamixel-emulator", "--tcp", "127.0.0.1:PORT"]),
        (TCP, "gripper-port", ["ur-emulator", "--host", "127.0.0.77", "--gripper", "2f-85", "--gripper-port", "PORT"]),
        (TCP, "port", ["console", "--scene", "remote_push", "--port", "PORT"]),
    ],
)
def test_a_busy_port_names_its_remedy(
    kind: int, option: str, arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    text = " ".join(arguments)
    host = "::1" if "::1" in text else "127.0.0.77" if "127.0.0.77" in text else "127.0.0.1"
    with held(kind, host) as port:
        assert main([argument.replace("PORT", str(port)) for argument in arguments]) in {1, 2}
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("haptether: ")]
    assert len(lines) == 1
    assert f"`ss -lntup 'sport = :{port}'` names it; end it, or give another --{option}" in lines[0]


def test_ports_that_a_protocol_fixes_leave_another_address(capsys: pytest.CaptureFixture[str]) -> None:
    with held(TCP, "127.0.0.78", 30004):
        assert main(["ur-emulator", "--host", "127.0.0.78"]) == 1
    assert re.search(r"sport = :30004'` names it; end it, or give another --host\n", capsys.readouterr().err)


def test_another_error_of_an_address_has_no_such_remedy(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["slave", "--insecure", "--listen", "192.0.2.1:9000"]) in {1, 2}
    assert "sport" not in capsys.readouterr().err
