"""The file that `--record` of master or slave writes, read back."""

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
"""What can be read."""
EXPECTED = {
    "each": ("state", "reason", "peer_state", "position", "overshoot_s"),
    "master": ("device_force",),
    "slave": ("command", "environment_force", "gripper"),
}
"""Signals that every recording of a side has."""
NAMES = ("state", "reason", "peer_state")
"""Those of them whose values are names."""


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
    """True if the file was read to its end; a killed run or a full disk leaves none."""
    problems: tuple[str, ...] = ()
    """Invalid parts of the file, which were left out."""
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
        ValueError: No path or plain file; it is no recording of Haptether, or of another version; it was cut off before
            it says what its signals are; signals are missing; somebody compressed it.
    """
    if not isinstance(path, str | os.PathLike) or path == "":
        message = f"recording = {path!r}: must be the path of {RECORDED}"
        raise ValueError(message)
    try:
        if not Path(path).is_dir():
            # For a folder the system raises an error of its own.
            refuse_special(path)
        read = read_recording_columns(path)
    except ValueError as error:
        message = f"{path}: {str(error).removeprefix(f'{path}: ')}"
        raise ValueError(message) from None
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
    """A scene and no problem, or no scene and why.

    It is without the keys of the stepped integrators, which earlier recordings have and nothing needs.
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
    """Names, where it has them and not their places."""
    if not isinstance(column, tuple):
        return column
    names, places = column
    return np.array(names, dtype=np.str_)[places]


def _causes(messages: list[bytes]) -> tuple[list[RecordedCause], int]:
    """Those that are valid, and how many are not."""
    causes: list[RecordedCause] = []
    for message in messages:
        with contextlib.suppress(msgspec.DecodeError, UnicodeDecodeError):
            causes.append(msgspec.json.decode(message, type=RecordedCause))
    return causes, len(messages) - len(causes)
