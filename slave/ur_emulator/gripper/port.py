r"""Protocol of the URCap server on port 63352: one request, one reply.

A request with an end of line gets its variable back (`GET POS\n`: `POS 100`). A request without one gets digits alone,
as many as the largest value has (`GET FLT`: `00`). Python clients send the first form, URScript the second. This role
of the end of line is inferred from the replies that both expect.

Source: wuphilipp/gello_software, pyrobotiqur 0.2.2, and the preamble of the URCap's own scripts (cambel/robotiq).
"""

import re
from typing import Final

from haptether.slave.ur_emulator.gripper.gripper import WRITABLE, EmulatedGripper

MAX_REQUEST: Final = 256
"""Longest request in bytes without an end of line."""
SETTLED: Final = 3
"""Control cycles after which a request counts as one without an end of line: 6 ms."""
ACK: Final = b"ack"
REFUSED: Final = b"?"
"""Reply to an invalid request; the reply of a real server is not published."""
DIGITS: Final = {"FLT": 2, "PRE": 3, "POS": 3, "SPE": 3, "FOR": 3}
"""Digits of a bare reply; all others have 1."""
TEXTS: Final = {"NCY": "0", "DST": "4", "FWV": "emulated", "VER": "emulated", "PCO": "0"}
"""Always bare; DST 4: it runs. The others are placeholders."""
REQUEST: Final = re.compile(rb"GET [A-Z]{3}|SET(?: [A-Z]{3} [0-9]{1,3})+")


def is_request(text: bytes) -> bool:
    """Return True for a whole request, without its end of line."""
    return REQUEST.fullmatch(text) is not None


def answered(gripper: EmulatedGripper, request: bytes, *, bare: bool) -> bytes:
    """Return the reply to a request.

    Args:
        gripper: The gripper to read and set.
        request: The request without its end of line.
        bare: True if it had no end of line.
    """
    if not is_request(request):
        return REFUSED
    kind, *words = request.decode().split(" ")
    if kind == "GET":
        (variable,) = words
        if variable in TEXTS:
            return TEXTS[variable].encode()
        value = gripper.read(variable)
        if value is None:
            return REFUSED
        return f"{value:0{DIGITS.get(variable, 1)}}".encode() if bare else f"{variable} {value}".encode()
    pairs = list(zip(words[::2], map(int, words[1::2]), strict=True))
    # All pairs must be valid, or none is set.
    if not all(variable in WRITABLE and value <= WRITABLE[variable] for variable, value in pairs):
        return REFUSED
    for variable, value in pairs:
        gripper.write({variable: value})
    return ACK
