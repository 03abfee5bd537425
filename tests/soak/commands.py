"""The command lines of a soak: the three processes of the README."""

import sys
from pathlib import Path

HAPTETHER = (sys.executable, "-m", "haptether")
PERIOD_S = 1e-3
"""Of both loops, in s."""
KEEP_S = 10.0
"""What the two sides keep of their ticks, in s: it is full long before memory is measured."""


def key(result: Path) -> list[str]:
    """The key of both sides, beside their results."""
    return ["--key", str(result.with_name("soak.key"))]


def slave(result: Path) -> list[str]:
    """The side of the robot, in front of a wall, pushed once."""
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
    """A network with delay, jitter and losses in bursts, far from where the two sides would hold."""
    link = ["--delay-s", "0.005", "--jitter-s", "0.001", "--loss", "0.02", "--mean-burst", "3"]
    # What is judged here is memory; how late a busy machine releases packets is reported.
    judged = ["--max-error-s", "1", "--json", str(result)]
    place = ["--listen", "127.0.0.1:0", "--forward", slave_address]
    return [*HAPTETHER, "netsim", "proxy", *place, *link, *judged]


def master(proxy_address: str, result: Path) -> list[str]:
    """The side of the hand, which presses the wall all the time."""
    judged = ["--controller", "wsc", "--keep-s", f"{KEEP_S}", "--json", str(result)]
    return [*HAPTETHER, "master", "--peer", proxy_address, *key(result), *judged]
