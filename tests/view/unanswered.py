"""Master without a slave, for tests of displays."""

import subprocess
import sys
from pathlib import Path

from tests.live.sides import free_port


def master(path: Path, *arguments: str) -> "subprocess.Popen[bytes]":
    """Start a master without a slave."""
    return subprocess.Popen(
        [sys.executable, "-m", "haptether", "master", "--peer", f"127.0.0.1:{free_port()}", "--insecure",
         "--telemetry", str(path), *arguments],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
