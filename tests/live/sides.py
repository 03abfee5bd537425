"""Shared parts of live tests: arguments of insecure sides, waiting, and simple devices in Python."""

import os
import secrets
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from haptether.master import MasterSample
from haptether.slave import SlaveSample


def how(**others: object) -> dict[str, Any]:
    """Return the arguments of an insecure side."""
    return {"run_id": secrets.randbits(64), "insecure": True, **others}


def free_port() -> int:
    """Return a free UDP port."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def packaged(folder: Path, driver: str) -> dict[str, str]:
    """Return the environment of a process that finds a driver `bench` of another package."""
    (folder / "bench_arm.py").write_text(driver)
    package = folder / "bench_arm-1.0.dist-info"
    package.mkdir(exist_ok=True)
    (package / "METADATA").write_text("Metadata-Version: 2.1\nName: bench-arm\nVersion: 1.0\n")
    (package / "entry_points.txt").write_text("[haptether.slaves]\nbench = bench_arm:Arm\n")
    path = [str(folder), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {"PYTHONPATH": os.pathsep.join(path), "PATH": "/usr/bin:/bin"}


def until(done: Callable[[], bool], seconds: float = 10.0) -> None:
    """Wait until the condition holds."""
    end_s = time.monotonic() + seconds
    while not done() and time.monotonic() < end_s:
        time.sleep(0.002)
    assert done()


class Hand:
    """Device at rest; a test sets the other fields of its sample."""

    paces = False

    def __init__(self, *, trigger: float | None = None, buttons: int | None = None, clutch: bool | None = None) -> None:
        self.trigger, self.buttons, self.clutch = trigger, buttons, clutch
        self.fault: str | None = None
        self.raises: Exception | None = None

    def open(self) -> None:
        pass

    def read(self) -> MasterSample:
        if self.raises is not None:
            raise self.raises
        return MasterSample(0.02, trigger=self.trigger, buttons=self.buttons, clutch=self.clutch, fault=self.fault)

    def write(self, force: tuple[float, ...]) -> None:
        pass

    def close(self) -> None:
        pass


class Arm:
    """Arm that is always at its commanded position."""

    paces = False

    def __init__(self) -> None:
        self.position: tuple[float, ...] = (0.02,)
        self.stops = 0

    def open(self) -> None:
        pass

    def read(self) -> SlaveSample:
        return SlaveSample(self.position, 0.0, 0.0)

    def write(self, position: tuple[float, ...], velocity: tuple[float, ...]) -> None:
        assert len(velocity) == 1
        self.position = position

    def stop(self) -> None:
        self.stops += 1

    def close(self) -> None:
        pass


class Never:
    """A stop that never comes."""

    def __bool__(self) -> bool:
        return False

    def sleep(self, seconds: float) -> None:
        time.sleep(seconds)
