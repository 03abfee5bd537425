"""Reader of the file that `--record` of master or slave writes."""

import contextlib
import os
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from haptether._core import read_recording_columns
from haptether.bridge.flight import Cause, Step
from haptether.bridge.scene.errors import REMOVED, abridged
from haptether.input_file import refuse_special

SCHEMA = "1"
RECORDED = "what --record of master, slave or simulate wrote"
"""Accepted files, for messages."""
EXPECTED = {
    "each": ("state", "reason", "peer_state", "position", "overshoot_s"),
    "master": ("device_force",),
    "slave": ("command", "environment_force", "gripper"),
}
"""Signals that every recording of a side has."""
NAMES = ("state", "reason", "peer_state")
"""Signals whose values are names."""


class RecordedCause(Cause, frozen=True):
    """Cause of not being coupled, as the recorded side knew it."""

    time_ns: int
    """Time since the run began."""


RecordedStep = Step
"""Public name of `Step`."""


class Recording(msgspec.Struct, frozen=True, kw_only=True):
    """Recording of one side; the schema in the file defines names, meanings and units of the signals."""

    side: str
    """"master" or "slave"."""
    security: str
    """"insecure" if frames were not encrypted."""
    version: str
    """Haptether version of the writer; empty if the file does not state it."""
    scene: bytes
    """Scene as JSON, with defaults and presets filled in; empty if the file has none."""
    begun_ns: int
    """Start of the run in ns of that machine's wall clock since 1970; 0 without a tick and in virtual time."""
    whole: bool
    """True if the file was read to its end; False after a killed run or a full disk."""
    problems: tuple[str, ...] = ()
    """Invalid parts of the file, which were skipped."""
    signals: dict[str, npt.NDArray[Any]]
    """One value per tick, shape `(n_ticks, axes)` for signals with axes. NaN stands for a value that is not finite."""
    meanings: dict[str, str]
    """Meaning of each signal, with its unit."""
    causes: list[RecordedCause] = []
    """Causes of not being coupled, in time order."""


def read_recording(path: str | os.PathLike[str]) -> Recording:
    """Read an MCAP file of `record=` or `--record` as far as it is intact.

    Raises:
        OSError: The file cannot be read.
        ValueError: The path is invalid or not a plain file; the file is not a Haptether recording or has another
            version; it is truncated before the signal definitions; signals are missing; it is compressed.
    """
    if not isinstance(path, str | os.PathLike) or path == "":
        message = f"recording = {path!r}: must be the path of {RECORDED}"
        raise ValueError(message)
    try:
        if not Path(path).is_dir():
            # The system raises its own error for a folder.
            refuse_special(path)
        read = read_recording_columns(path)
    except ValueError as error:
        message = f"{path}: {str(error).removeprefix(f'{path}: ')}"
        raise ValueError(message) from None
    except OSError as error:
        if error.errno is None:
            raise
        # Another file helps if the path is missing or a folder, but not if the disk fails.
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
    side = about.get("side", "")
    missing = [name for name in (*EXPECTED["each"], *EXPECTED.get(side, ())) if name not in read.columns]
    if side not in EXPECTED or missing:
        problem = f"has no {', '.join(missing)}" if side in EXPECTED else f"side = {abridged(side)!r}"
        message = f"{path}: {problem}: must be {RECORDED}"
        raise ValueError(message)
    if nameless := [
        name for name in NAMES if len(read.columns["time_ns"]) and not isinstance(read.columns[name], tuple)
    ]:
        message = f"{path}: {', '.join(nameless)}: must be names: must be {RECORDED}"
        raise ValueError(message)
    causes, invalid_causes = _causes(read.causes)
    scene, scene_problem = _scene(about.get("scene", "").encode())
    problems = []
    if invalid := read.invalid + invalid_causes:
        problems.append(f"{invalid} record{'s are' if invalid > 1 else ' is'} not valid, and left out")
    if read.damaged:
        problems.append("it is damaged after its last tick here: what follows cannot be read")
    if scene_problem:
        problems.append(f"its scene is not valid, and left out: {scene_problem}")
    return Recording(
        side=side,
        security=about.get("security", "insecure"),
        version=about.get("version", ""),
        scene=scene,
        begun_ns=read.begun_ns,
        whole=read.whole,
        problems=tuple(problems),
        signals={name: _signal(column) for name, column in read.columns.items()},
        meanings=read.meanings,
        causes=causes,
    )


class _Run(msgspec.Struct):
    seed: int


class _Scene(msgspec.Struct):
    """Tables of a recorded scene; null for a part that was not built."""

    run: _Run
    master: dict[str, Any] = {}
    operator: dict[str, Any] | None = None
    slave: dict[str, Any] = {}
    environment: dict[str, Any] | None = None
    link: dict[str, Any] | None = None
    coupling: dict[str, Any] = {}
    safety: dict[str, Any] = {}


def _scene(recorded: bytes) -> tuple[bytes, str]:
    """Return a scene and an empty problem, or an empty scene and the problem.

    Keys of the stepped integrators, which earlier recordings contain, are removed because nothing uses them.
    """
    if not recorded:
        return recorded, ""
    try:
        msgspec.json.decode(recorded, type=_Scene)
        scene = msgspec.json.decode(recorded, type=dict[str, Any])
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        return b"", str(error)
    if b'"integrator"' not in recorded:
        return recorded, ""
    for table, key in REMOVED:
        if isinstance(keys := scene.get(str(table)), dict):
            keys.pop(key, None)
    return msgspec.json.encode(scene), ""


def _signal(column: npt.NDArray[Any] | tuple[list[str], npt.NDArray[np.uint8]]) -> npt.NDArray[Any]:
    """Replace indices by names if the column has names."""
    if not isinstance(column, tuple):
        return column
    names, places = column
    return np.array(names, dtype=np.str_)[places]


def _causes(messages: list[bytes]) -> tuple[list[RecordedCause], int]:
    """Return the valid causes and the number of invalid ones."""
    causes: list[RecordedCause] = []
    for message in messages:
        with contextlib.suppress(msgspec.DecodeError, UnicodeDecodeError):
            causes.append(msgspec.json.decode(message, type=RecordedCause))
    return causes, len(messages) - len(causes)
