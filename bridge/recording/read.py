"""The file that `--record` of master or slave writes, read back."""

import os
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from haptether._core import read_recording_columns
from haptether.bridge.flight import Cause, Step
from haptether.bridge.scene.errors import REMOVED

SCHEMA = "1"
RECORDED = "what --record of master, slave or simulate wrote"
"""What can be read."""


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
        OSError: It cannot be read.
        ValueError: No path; it is no recording of Haptether, or of another version; it was cut off before it says what
            its signals are; somebody compressed it.
    """
    if not isinstance(path, str | os.PathLike) or path == "":
        message = f"recording = {path!r}: must be the path of {RECORDED}"
        raise ValueError(message)
    try:
        read = read_recording_columns(path)
    except OSError as error:
        if error.errno is None:
            raise
        # Of no file or a folder another is to be given; of a disk that fails none.
        remedy = f": must be {RECORDED}" if isinstance(error, FileNotFoundError | IsADirectoryError) else ""
        raise type(error)(error.errno, f"{error.strerror}{remedy}", path) from None
    about = read.about
    if about.get("schema") != SCHEMA:
        none = f"no recording of Haptether: must be {RECORDED}"
        found = f"schema {about['schema']!r}, must be {SCHEMA!r}" if "schema" in about else none
        message = f"{path}: {found}"
        raise ValueError(message)
    if "time_ns" not in read.columns:
        message = f"{path}: was cut off before its first tick: it does not even say what its signals are"
        raise ValueError(message)
    causes, is_whole = _causes(read.causes)
    return Recording(
        side=about["side"],
        security=about["security"],
        version=about.get("version", ""),
        scene=_scene(about.get("scene", "").encode()),
        begun_ns=read.begun_ns,
        whole=read.whole and is_whole,
        signals={name: _signal(column) for name, column in read.columns.items()},
        meanings=read.meanings,
        causes=causes,
    )


def _scene(recorded: bytes) -> bytes:
    """A scene without the keys of the stepped integrators, which earlier recordings have and nothing needs."""
    if b'"integrator"' not in recorded:
        return recorded
    try:
        scene = msgspec.json.decode(recorded, type=dict[str, Any])
    except msgspec.MsgspecError:
        return recorded  # refused by what needs it
    for table, key in REMOVED:
        if isinstance(keys := scene.get(str(table)), dict):
            keys.pop(key, None)
    return msgspec.json.encode(scene)


def _signal(column: npt.NDArray[Any] | tuple[list[str], npt.NDArray[np.uint8]]) -> npt.NDArray[Any]:
    """Names, where it has them and not their places."""
    if not isinstance(column, tuple):
        return column
    names, places = column
    return np.array(names, dtype=np.str_)[places]


def _causes(messages: list[bytes]) -> tuple[list[RecordedCause], bool]:
    """Those before the first that is none, and whether they are all."""
    causes: list[RecordedCause] = []
    for message in messages:
        try:
            causes.append(msgspec.json.decode(message, type=RecordedCause))
        except msgspec.DecodeError:
            return causes, False
    return causes, True
