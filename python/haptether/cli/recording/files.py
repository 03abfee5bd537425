"""Files of the recording commands."""

import os
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from haptether.bridge import Run


def check_files(*files: Path | None, what: str | None = None) -> None:
    """Refuse files that cannot be read; `what` names the expected file, by default a recording.

    Raises:
        ValueError: A file that cannot be read; the message names the expected one.
    """
    from haptether.bridge.recording.read import RECORDED

    for file in files:
        if file is None or (file.exists() and not file.is_dir() and os.access(file, os.R_OK)):
            continue
        problem = "is a folder" if file.is_dir() else "may not be read" if file.exists() else "no such file"
        message = f"{file}: {problem}: give {what or RECORDED}"
        raise ValueError(message)


def read_run(file: Path, other: Path | None, slave_begun_s: float | None) -> "Run":
    """Return the run of one file or of both sides', with a line on standard error if it takes long.

    Raises:
        ValueError: No file, no recording, two of one side or of different runs, or one without a tick.
    """
    from haptether.bridge import load
    from haptether.cli.scene.simulate import spinner

    check_files(file, other)
    names = " and ".join(str(path) for path in (file, other) if path is not None)
    with spinner(f"reading {names}"):
        run = load(file, other, slave_begun_s=slave_begun_s)
    if not any(len(run.signals[time]) for time in ("time_s", "slave_time_s") if time in run.signals):
        message = f"{names}: has no tick: the run was ended before its first, or killed before it was written"
        raise ValueError(message)
    return run
