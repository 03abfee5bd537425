"""Export of the recordings of one or both sides to one MCAP file for Foxglove."""

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
"""Layout for the exported topics; import it in Foxglove with "Import from file"."""


class _Copied(NamedTuple):
    """Message copied from a recording."""

    topic: str
    schema: tuple[str, str, bytes]
    """Name, encoding and text of the schema."""
    time_ns: int
    content: bytes


def write_foxglove(
    target: str | os.PathLike[str],
    file: str | os.PathLike[str],
    other: str | os.PathLike[str] | None = None,
    *,
    slave_begun_s: float | None = None,
) -> None:
    """Write the recordings of one or both sides, with poses, frames and force arrows in Foxglove's schemas.

    Args:
        target: File to write, with mode 0600.
        file: MCAP file of master or slave.
        other: MCAP file of the other side; by default one side.
        slave_begun_s: Start of the slave's run after the master's in s; by default from the wall clocks of both
            machines.

    Raises:
        ImportError: The extra `record` is not installed.
        OSError: A file cannot be read or written, or the target is a symbolic link.
        ValueError: A file is not a Haptether recording, both are of one side, or the coordinates are joints.
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
        # Convert before writing, so that an invalid recording is refused at its first message.
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
            # Truncated file: keep the messages before the end.
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
