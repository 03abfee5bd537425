"""The file that `--record` of master or slave writes, read back."""

import os
import struct
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from haptether.bridge.flight import Cause, Step

SCHEMA = "1"


class RecordedCause(Cause, frozen=True):
    """Why the two sides were not coupled, as the recorded side knew it."""

    time_ns: int
    """Since the run began."""


RecordedStep = Step
"""Its public name."""


class Recording(msgspec.Struct, frozen=True, kw_only=True):
    """A recording of one side; names, meanings and units of the signals are in the file's own schema."""

    side: str
    """"master" or "slave"."""
    security: str
    """"insecure" if frames were in plain sight."""
    version: str
    """Of the Haptether that wrote it; empty where the file does not say."""
    scene: bytes
    """The scene as JSON, defaults and presets filled in; empty where the file has none."""
    begun_ns: int
    """When the run began, in ns of the wall clock of that machine since 1970; 0 without a tick and in virtual time."""
    whole: bool
    """Whether the file has its end: it has none where the run was killed or the disk was full."""
    signals: dict[str, npt.NDArray[Any]]
    """One value per tick; of what has axes, shape `(n_ticks, axes)`. What was no finite number is NaN."""
    meanings: dict[str, str]
    """What each signal is, with its unit."""
    causes: list[RecordedCause] = []
    """Why the two sides were not coupled, in the order of time."""


def read_recording(path: str | os.PathLike[str]) -> Recording:
    """Reads an MCAP file of `record=` or `--record`, as far as it goes.

    Raises:
        ImportError: Without the extra `record`.
        OSError: It cannot be read.
        ValueError: It is no recording of Haptether, or of another version.
    """
    try:
        from mcap.exceptions import McapError
        from mcap.records import Channel, Footer, Message, Metadata, Schema
        from mcap.stream_reader import StreamReader
    except ImportError:
        message = "reading a recording needs mcap: install haptether[record]"
        raise ImportError(message) from None

    about: dict[str, str] = {}
    meanings: dict[str, str] = {}
    topics: set[int] = set()
    messages: list[dict[str, Any]] = []
    cause_topics: set[int] = set()
    causes: list[RecordedCause] = []
    begun_ns = 0
    whole = False
    with Path(path).open("rb") as file:
        try:
            for record in StreamReader(file).records:
                match record:
                    case Metadata(name="haptether"):
                        about = record.metadata
                    case Schema(name="haptether.master" | "haptether.slave"):
                        properties = msgspec.json.decode(record.data)["properties"]
                        meanings = {name: field["description"] for name, field in properties.items()}
                    case Channel(message_encoding="json", topic=topic):
                        (cause_topics if topic.endswith("/cause") else topics).add(record.id)
                    case Message(channel_id=channel) if channel in topics:
                        messages.append(msgspec.json.decode(record.data))
                        if len(messages) == 1:
                            begun_ns = record.log_time - messages[0]["time_ns"]
                    case Message(channel_id=channel) if channel in cause_topics:
                        causes.append(msgspec.json.decode(record.data, type=RecordedCause))
                    case Footer():
                        whole = True
        except (McapError, msgspec.DecodeError, EOFError, struct.error):
            # Cut off: what was written before counts.
            whole = False
    if about.get("schema") != SCHEMA:
        found = f"schema {about['schema']!r}, must be {SCHEMA!r}" if "schema" in about else "no recording of Haptether"
        message = f"{path}: {found}"
        raise ValueError(message)
    return Recording(
        side=about["side"],
        security=about["security"],
        version=about.get("version", ""),
        scene=about.get("scene", "").encode(),
        begun_ns=begun_ns,
        whole=whole,
        signals={name: _column([message.get(name) for message in messages]) for name in meanings},
        meanings=meanings,
        causes=causes,
    )


def _column(values: list[Any]) -> npt.NDArray[Any]:
    """Null is NaN, and alone among integers it makes them floats."""
    if any(value is None for value in values) or (values and isinstance(values[0], float | list)):
        return np.array(values, dtype=np.float64)
    return np.array(values)
