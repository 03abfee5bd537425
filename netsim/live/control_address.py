"""Where a proxy is controlled: a Unix socket, or a port of this machine."""

import ipaddress
import re
import socket
from pathlib import Path

from msgspec import Struct

LONGEST_LINE = 2**16
"""Bytes of a request, its end included."""


class ControlAddress(Struct, frozen=True):
    """A Unix socket by its path, or TCP of this machine."""

    family: socket.AddressFamily
    place: str | tuple[str, int]
    text: str


def control_address(text: str) -> ControlAddress:
    """Reads `PATH` or `127.0.0.1:PORT`; a path that looks like an address begins with `./`.

    Raises:
        ValueError: Neither, or an address that others could reach.
    """
    found = re.fullmatch(r"\[?(?P<host>[^/\[\]]+)\]?:(?P<port>\d{1,5})", text)
    if found is None:
        if not text or "\0" in text:
            raise _refused(text)
        return ControlAddress(socket.AF_UNIX, str(Path(text)), text)
    try:
        host = ipaddress.ip_address(found["host"])
    except ValueError:
        raise _refused(text) from None
    port = int(found["port"])
    if not host.is_loopback or port > 65_535:
        raise _refused(text)
    family = socket.AF_INET if host.version == 4 else socket.AF_INET6
    return ControlAddress(family, (str(host), port), text)


def _refused(text: str) -> ValueError:
    return ValueError(f'control = "{text}": must be the path of a Unix socket, or 127.0.0.1:PORT of this machine')
