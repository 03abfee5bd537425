"""Stand-ins for the vendors' libraries: built from C when a test needs them, steered and read by name."""

import ctypes
import os
import subprocess
from pathlib import Path

HERE = Path(__file__).parent
BUILD_S = 60.0


class Standin:
    """One that is loaded in this process: a driver that loads the same file has the same device."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.library = ctypes.CDLL(str(path))
        self.library.standin_get.restype = ctypes.c_double
        self.library.standin_get.argtypes = (ctypes.c_char_p,)
        self.library.standin_set.argtypes = (ctypes.c_char_p, ctypes.c_double)
        self.library.standin_log.restype = ctypes.c_char_p

    def set(self, **numbers: float) -> None:
        for name, value in numbers.items():
            self.library.standin_set(name.encode(), value)

    def get(self, name: str) -> float:
        return float(self.library.standin_get(name.encode()))

    def force(self) -> tuple[float, float, float]:
        """What acts on the device, in N and in its own frame."""
        return self.get("fx"), self.get("fy"), self.get("fz")

    def calls(self) -> list[str]:
        """So far."""
        return str(self.library.standin_log().decode()).splitlines()

    def fail(self, call: str, error: int, times: int = 1) -> None:
        """The next calls of a function fail, of the Force Dimension SDK."""
        self.library.standin_fail(call.encode(), error, times)

    def error(self, code: int) -> None:
        """An error of OpenHaptics."""
        self.library.standin_error(code)

    def reset(self) -> None:
        self.library.standin_reset()


def built(source: str, folder: Path, *flags: str) -> Path:
    """The shared library of a stand-in, such as `touch/hd.c`."""
    target = folder / f"lib{Path(source).stem}.so"
    command = [os.environ.get("CC", "cc"), "-O1", "-Wall", "-Wextra", "-Werror", "-fPIC", "-shared", *flags]
    command += [str(HERE / source), "-o", str(target), "-lpthread", "-lm"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=BUILD_S, check=False)
    assert ended.returncode == 0, ended.stderr
    return target


class Failing:
    """What leads a driver with a force, and fails after so many ticks."""

    def __init__(self, force: tuple[float, ...], ticks: int) -> None:
        self._force = force
        self._left = ticks

    def step(self, sample: object, at_s: float) -> tuple[tuple[float, ...], ...]:  # noqa: ARG002
        self._left -= 1
        if self._left < 0:
            message = "out of tune"
            raise RuntimeError(message)
        return (self._force,)
