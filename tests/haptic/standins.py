"""Stand-ins for the vendors' libraries: built from C when a test needs them, controlled and read by name."""

import ctypes
import itertools
import os
import subprocess
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

HERE = Path(__file__).parent
BUILD_S = 60.0
TURNS = [
    [sign + axis for sign, axis in zip(signs, names, strict=True)]
    for names in itertools.permutations("xyz")
    for signs in itertools.product(("", "-"), repeat=3)
]
"""All ways to name three axes; half of them are right-handed."""


def axes_matrix(axes: list[str]) -> NDArray[np.float64]:
    """Return C, which converts a vector of the device to our frame."""
    rows = [(-1.0 if axis[0] == "-" else 1.0) * np.eye(3)["xyz".index(axis[-1])] for axis in axes]
    return np.array(rows)


RIGHT_HANDED = [axes for axes in TURNS if np.linalg.det(axes_matrix(axes)) > 0.0]


def rotation_matrix(quat_wxyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrix of a unit quaternion by Rodrigues' formula, from its axis and angle."""
    sine = float(np.linalg.norm(quat_wxyz[1:]))
    angle = 2.0 * np.arctan2(sine, quat_wxyz[0])
    x, y, z = quat_wxyz[1:] / sine if sine > 0.0 else np.zeros(3)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross)


class Standin:
    """A stand-in that is loaded in this process: a driver that loads the same file has the same device."""

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
        """Return the force on the device in N, in its own frame."""
        return self.get("fx"), self.get("fy"), self.get("fz")

    def calls(self) -> list[str]:
        """Return the calls so far."""
        return str(self.library.standin_log().decode()).splitlines()

    def fail(self, call: str, error: int, times: int = 1) -> None:
        """Let the next calls of a function of the Force Dimension SDK fail."""
        self.library.standin_fail(call.encode(), error, times)

    def error(self, code: int) -> None:
        """Raise an error of OpenHaptics."""
        self.library.standin_error(code)

    def reset(self) -> None:
        self.library.standin_reset()


def built(source: str, folder: Path, *flags: str) -> Path:
    """Return the shared library of a stand-in, such as `touch/hd.c`."""
    target = folder / f"lib{Path(source).stem}.so"
    command = [os.environ.get("CC", "cc"), "-O1", "-Wall", "-Wextra", "-Werror", "-fPIC", "-shared", *flags]
    command += [str(HERE / source), "-o", str(target), "-lpthread", "-lm"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=BUILD_S, check=False)
    assert ended.returncode == 0, ended.stderr
    return target


class Failing:
    """A loop that leads a driver with a force, and fails after some ticks."""

    def __init__(self, force: tuple[float, ...], ticks: int) -> None:
        self._force = force
        self._left = ticks

    def step(self, sample: object, at_s: float) -> tuple[tuple[float, ...], ...]:  # noqa: ARG002
        self._left -= 1
        if self._left < 0:
            message = "out of tune"
            raise RuntimeError(message)
        return (self._force,)
