"""The command lines of a soak: the three processes of the README."""

import sys
from pathlib import Path

HAPTETHER = (sys.executable, "-m", "haptether")
PERIOD_S = 1e-3
"""Period of both loops in s."""
KEEP_S = 10.0
"""Kept ticks of both sides in s: the buffer is full long before memory is measured."""


def key(result: Path) -> list[str]:
    """Return the option of the key of both sides, beside their results."""
    return ["--key", str(result.with_name("soak.key"))]


def slave(result: Path) -> list[str]:
    """Return the command of the side of the robot, in front of a wall, pushed once."""
    pushed = ["--push-at-s", "5", "--push-force-n", "2"]
    return [
        *HAPTETHER,
        "slave",
        "--listen",
        "127.0.0.1:0",
        *key(result),
        "--keep-s",
        f"{KEEP_S}",
        *pushed,
        "--json",
        str(result),
    ]


def proxy(slave_address: str, result: Path) -> list[str]:
    """Return the command of a network with delay, jitter and bursts of losses, far from a hold of the two sides."""
    link = ["--delay-s", "0.005", "--jitter-s", "0.001", "--loss", "0.02", "--mean-burst", "3"]
    # Only memory is judged; the lateness of packets on a busy machine is reported.
    judged = ["--max-error-s", "1", "--json", str(result)]
    place = ["--listen", "127.0.0.1:0", "--forward", slave_address]
    return [*HAPTETHER, "netsim", "proxy", *place, *link, *judged]


def master(proxy_address: str, result: Path) -> list[str]:
    """Return the command of the side of the hand, which presses the wall all the time."""
    judged = ["--controller", "wsc", "--keep-s", f"{KEEP_S}", "--json", str(result)]
    return [*HAPTETHER, "master", "--peer", proxy_address, *key(result), *judged]
