"""A recording, or those of both sides, as one MCAP file for Foxglove."""

import heapq
import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from msgspec import json

from haptether.bridge.recording.foxglove.messages import FoxgloveMessage, messages_of
from haptether.bridge.recording.read import Recording, read_recording
from haptether.extras import require
from haptether.private_file import private_file, refuse_link

LAYOUT = Path(__file__).parent / "layout.json"
"""The layout that shows what is written: Foxglove's menu, "Import from file"."""


class _Copied(NamedTuple):
    """A message as it was recorded."""

    topic: str
    schema: tuple[str, str, bytes]
    """Name, encoding and text."""
    time_ns: int
    content: bytes


def write_foxglove(
    target: str | os.PathLike[str],
    file: str | os.PathLike[str],
    other: str | os.PathLike[str] | None = None,
    *,
    slave_begun_s: float | None = None,
) -> None:
    """Writes what one side recorded, or both, with poses, frames and force arrows in Foxglove's schemas beside it.

    Args:
        target: The file to write, for its owner alone.
        file: Path of the MCAP file of master or slave.
        other: The other side's.
        slave_begun_s: When the slave's run began after the master's, in s; by default as the wall clocks of the two
            machines have it.

    Raises:
        ImportError: Without the extra `record`.
        OSError: A file cannot be read or written; a symbolic link.
        ValueError: It is no recording of Haptether; two of one side; joints, which have no place.
    """
    require("a file for Foxglove", "mcap")
    paths = [Path(path) for path in (file, other) if path is not None]
    recordings = [read_recording(path) for path in paths]
    if len({recording.side for recording in recordings}) < len(recordings):
        message = f"{paths[0]}, {paths[1]}: both are of the {recordings[0].side}, must be one of each side"
        raise ValueError(message)
    begun = {recording.side: recording.begun_ns for recording in recordings}
    if slave_begun_s is not None and "master" in begun:
        begun["slave"] = begun["master"] + round(slave_begun_s * 1e9)
    streams: list[Iterator[FoxgloveMessage | _Copied]] = []
    for path, recording in zip(paths, recordings, strict=True):
        # Before anything is written: what cannot be is refused at the first message.
        drawn = list(messages_of(recording, begun[recording.side]))
        shift_ns = begun[recording.side] - recording.begun_ns
        streams += [iter(drawn), _copied(path, shift_ns)]
    refuse_link(Path(target))
    with private_file(Path(target)) as out:
        _write(out, streams, recordings)


def _copied(path: Path, shift_ns: int) -> Iterator[_Copied]:
    from mcap.exceptions import McapError  # noqa: PLC0415
    from mcap.records import Channel, Message, Schema  # noqa: PLC0415
    from mcap.stream_reader import StreamReader  # noqa: PLC0415

    schemas: dict[int, tuple[str, str, bytes]] = {}
    topics: dict[int, tuple[str, tuple[str, str, bytes]]] = {}
    with path.open("rb") as file:
        try:
            for record in StreamReader(file).records:
                match record:
                    case Schema():
                        schemas[record.id] = (record.name, record.encoding, record.data)
                    case Channel():
                        topics[record.id] = (record.topic, schemas[record.schema_id])
                    case Message():
                        topic, schema = topics[record.channel_id]
                        yield _Copied(topic, schema, record.log_time + shift_ns, record.data)
        except (McapError, EOFError, struct.error, KeyError):
            # Cut off: what was written before counts.
            return


def _write(out: Any, streams: list[Iterator[FoxgloveMessage | _Copied]], recordings: list[Recording]) -> None:  # noqa: ANN401
    from mcap.writer import Writer  # noqa: PLC0415

    writer = Writer(out)
    writer.start(profile="", library="haptether")
    for recording in recordings:
        about = {"side": recording.side, "version": recording.version, "scene": recording.scene.decode()}
        writer.add_metadata(f"haptether.{recording.side}", about)
    channels: dict[str, int] = {}
    for message in heapq.merge(*streams, key=lambda message: message.time_ns):
        if message.topic not in channels:
            if isinstance(message, _Copied):
                schema = writer.register_schema(*message.schema)
            else:
                schema = writer.register_schema(message.schema["title"], "jsonschema", json.encode(message.schema))
            channels[message.topic] = writer.register_channel(message.topic, "json", schema)
        content = message.content if isinstance(message, _Copied) else json.encode(message.content)
        writer.add_message(channels[message.topic], message.time_ns, content, message.time_ns)
    writer.finish()  # type: ignore[no-untyped-call]  # of the library
