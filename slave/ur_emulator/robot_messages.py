"""Messages of the script interfaces: `int32 size, uint8 type = 20`, then what the controller has to say.

Source: Universal Robots, "Client Interfaces", robot message of type 10 (runtime exception).
"""

import struct
from typing import Final

from haptether.slave.ur_emulator.utf8 import utf8

ROBOT_MESSAGE, RUNTIME_EXCEPTION, CONTROLLER = 20, 10, -2
HEAD: Final = struct.Struct(">iBQbbii")
"""Size, type, time stamp in us, source, type of the message, line and column of the script."""
MAX_TEXT: Final = 1000
"""Bytes of a text."""


def runtime_exception(text: str, timestamp_s: float) -> bytes:
    """What stopped a script, where the line is not known."""
    said = utf8(text, MAX_TEXT)
    stamp_us = int(1e6 * timestamp_s)
    return HEAD.pack(HEAD.size + len(said), ROBOT_MESSAGE, stamp_us, CONTROLLER, RUNTIME_EXCEPTION, -1, -1) + said
