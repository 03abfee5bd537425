"""Drivers for tests: a valid stylus, a valid arm, and variants with one defect each."""

import functools
import math
import os
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path

from tests.devices.plant import Plant, VirtualDevice

from haptether.checklist import Checklist
from haptether.master import MasterSample
from haptether.slave import GripperCommand, GripperSample, SlaveSample

WRITTEN = "WRITTEN"
"""Environment variable with the path of a file that gets a line for each call except `read`."""


@functools.cache
def opened(path: str) -> int:
    """Open a file for appending."""
    return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)


def note(text: str) -> None:
    """Append a line to that file, if the variable names one."""
    if path := os.environ.get(WRITTEN):
        os.write(opened(path), f"{text}\n".encode())


class Stylus:
    """Stylus that a hand moves by 3 cm on three axes, at 1 Hz and its multiples; it does not pace."""

    paces = False
    sign = 1.0
    kinds: tuple[str, ...] = ("linear",)

    def __init__(self, *, held: bool = True, writes: bool = True) -> None:
        self.held, self.writes = held, writes
        self.opened = self.closed = 0
        self.forces: list[tuple[float, ...]] = []
        self.pushed_m = 0.0

    def open(self) -> None:
        self.opened += 1
        self.begun_s = time.monotonic()
        note("open")

    def at(self, time_s: float) -> tuple[list[float], list[float]]:
        """Return position and velocity."""
        rates = [2.0 * math.pi * (axis + 1) for axis in range(3)]
        x = [0.03 * math.sin(rate * time_s) for rate in rates]
        v = [0.03 * rate * math.cos(rate * time_s) for rate in rates]
        if not self.held:
            x, v = [0.0] * 3, [0.0] * 3
        x[0] += self.pushed_m
        return x, v

    def read(self) -> MasterSample:
        x, v = self.at(time.monotonic() - self.begun_s)
        return MasterSample(x, v)

    def write(self, force: tuple[float, ...]) -> None:
        assert isinstance(force, tuple)
        self.forces.append(force)
        # A soft hand holds it: it yields in the direction of the force.
        self.pushed_m += 1e-3 * (self.sign * 0.02 * force[0] - self.pushed_m) / 0.1
        note(f"write {' '.join(f'{value:.4f}' for value in force)}")

    def close(self) -> None:
        self.closed += 1
        note("close")


class BearsItself(Stylus):
    """Exerts a force against its weight from `open` on."""

    exerts_by_itself = True


class OfAnyKind(Stylus):
    """Declares joints as a further kind."""

    kinds = ("linear", "joints")


class Turned(Stylus):
    """Pushes in the wrong direction."""

    sign = -1.0


class Paced(Stylus):
    """Waits for its samples."""

    paces = True
    period_s = 0.002

    def open(self) -> None:
        super().open()
        self.next_s = time.monotonic()

    def read(self) -> MasterSample:
        self.next_s += 0.002
        time.sleep(max(0.0, self.next_s - time.monotonic()))
        return super().read()


class WrongPeriod(Paced):
    """Declares a wrong period."""

    period_s = 0.001


class DoesNotWait(Stylus):
    """Declares that it paces, and does not."""

    paces = True


class RaisesInOpen(Stylus):
    """Raises in `open`: the bus is missing."""

    def open(self) -> None:
        super().open()
        message = "no such bus"
        raise OSError(message)


class RaisesInRead(Stylus):
    """Raises after 50 samples."""

    def read(self) -> MasterSample:
        if len(self.forces) > 50:
            message = "encoder"
            raise KeyError(message)
        return super().read()


class RaisesInWrite(Stylus):
    """Raises once in `write`."""

    def write(self, force: tuple[float, ...]) -> None:
        if len(self.forces) == 50:
            self.forces.append(())
            message = "unplugged"
            raise OSError(message)
        super().write(force)


class RaisesInEveryWrite(Stylus):
    """Raises in every `write`."""

    def write(self, force: tuple[float, ...]) -> None:
        message = f"unplugged: {force}"
        raise OSError(message)


class RaisesInClose(Stylus):
    """Raises in `close`."""

    def close(self) -> None:
        super().close()
        message = "busy"
        raise OSError(message)


class NotANumber(Stylus):
    """Returns one sample that is not finite."""

    def read(self) -> MasterSample:
        sample = super().read()
        return sample._replace(position=[math.nan, 0.0, 0.0]) if len(self.forces) == 40 else sample


class WrongShape(Stylus):
    """Returns a velocity of the wrong shape."""

    def read(self) -> MasterSample:
        sample = super().read()
        return sample._replace(velocity=[0.0, 0.0])


class TwoFields(Stylus):
    """Returns tuples that are not samples."""

    def read(self) -> MasterSample:
        return 0.0, 0.0  # type: ignore[return-value]  # invalid on purpose


class ChangingAxes(Stylus):
    """Returns one sample with fewer axes."""

    def read(self) -> MasterSample:
        sample = super().read()
        return sample._replace(position=[0.0, 0.0], velocity=None) if len(self.forces) == 40 else sample


class Blocking(Stylus):
    """Blocks for 50 ms in each hundredth `read`."""

    def read(self) -> MasterSample:
        if len(self.forces) % 100 == 99:
            time.sleep(0.05)
        return super().read()


class Millimetres(Stylus):
    """Returns positions in mm."""

    def read(self) -> MasterSample:
        x, v = self.at(time.monotonic() - self.begun_s)
        return MasterSample([1e3 * value for value in x], [1e3 * value for value in v])


class Slow(Stylus):
    """Has a new sample every 4 ms only."""

    def at(self, time_s: float) -> tuple[list[float], list[float]]:
        return super().at(4e-3 * math.floor(time_s / 4e-3))


class MillimetresPerSecond(Stylus):
    """Returns the velocity in mm/s."""

    def read(self) -> MasterSample:
        sample = super().read()
        assert isinstance(sample.velocity, Sequence)
        return sample._replace(velocity=[1e3 * value for value in sample.velocity])


class WrongSign(Stylus):
    """Returns the velocity with the wrong sign."""

    def read(self) -> MasterSample:
        sample = super().read()
        assert isinstance(sample.velocity, Sequence)
        return sample._replace(velocity=[-value for value in sample.velocity])


class SometimesVelocity(Stylus):
    """Returns a velocity in every other sample."""

    def read(self) -> MasterSample:
        sample = super().read()
        return sample._replace(velocity=None) if len(self.forces) % 2 else sample


class Jumps(Stylus):
    """Jumps once."""

    def read(self) -> MasterSample:
        sample = super().read()
        assert isinstance(sample.position, Sequence)
        if len(self.forces) == 300:
            return sample._replace(position=[value + 0.2 for value in sample.position])
        return sample


class TextKinds(Stylus):
    """Declares its kinds as a string."""

    kinds = "linear"  # type: ignore[assignment]  # invalid on purpose


class Faulty(Stylus):
    """Reports a fault."""

    def read(self) -> MasterSample:
        return super().read()._replace(fault="overheated")


class FaultyAndSaysSo(Faulty):
    """Prints its fault as well."""

    def open(self) -> None:
        super().open()
        print("stylus: fault: overheated", file=sys.stderr, flush=True)


class Refused(Stylus):
    """Fails its checklist."""

    refusals: tuple[tuple[str, str, str], ...] = (("supply", "off", "plug it in"),)

    def open(self) -> None:
        super().open()
        checklist = Checklist("stylus")
        for what, found, remedy in self.refusals:
            checklist.refuse(what, found, remedy)
        checklist.finish()


class RefusedTwice(Refused):
    """Fails its checklist for two reasons."""

    refusals = (*Refused.refusals, ("cover", f"open by {'more and ' * 20}more", "close it"))


class Unplugged(Stylus):
    """Raises the same error in every call after some samples."""

    def read(self) -> MasterSample:
        if len(self.forces) > 50:
            message = "the cable is out"
            raise OSError(message)
        return super().read()

    def write(self, force: tuple[float, ...]) -> None:
        super().write(force)
        if len(self.forces) > 51:
            message = "the cable is out"
            raise OSError(message)

    def close(self) -> None:
        super().close()
        if len(self.forces) > 51:
            message = "the cable is out"
            raise OSError(message)


class HungInOpen(Stylus):
    """Hangs in `open`."""

    def open(self) -> None:
        super().open()
        threading.Event().wait(60.0)


class HungInRead(Stylus):
    """Hangs in `read` after 50 samples."""

    def read(self) -> MasterSample:
        if len(self.forces) == 50:
            threading.Event().wait(60.0)
        return super().read()


class HangsAndBearsItself(HungInRead):
    """Hangs in `read`, and exerts a force by itself."""

    exerts_by_itself = True


class HangsInOpenAndBearsItself(Stylus):
    """Hangs in `open`, and exerts a force by itself."""

    exerts_by_itself = True

    def open(self) -> None:
        """Block for 60 s."""
        threading.Event().wait(60.0)


class Pose(Stylus):
    """Turns about z at 1 rad/s, and about its own x at 0.5 rad/s."""

    kinds = ("pose",)

    def turn(self, time_s: float) -> tuple[list[float], list[float]]:
        """Return `quat_wxyz` and the angular velocity in the base frame."""
        a, b = 0.5 * time_s, 0.25 * time_s
        # R = Rz(t) Rx(t / 2): w = z + Rz(t) x / 2.
        ca, sa, cb, sb = math.cos(a), math.sin(a), math.cos(b), math.sin(b)
        quaternion = [ca * cb, ca * sb, sa * sb, sa * cb]
        return quaternion, [0.5 * math.cos(time_s), 0.5 * math.sin(time_s), 1.0]

    def read(self) -> MasterSample:
        time_s = time.monotonic() - self.begun_s
        x, v = self.at(time_s)
        quaternion, angular = self.turn(time_s)
        norm = math.hypot(*quaternion)
        return MasterSample(x, v, orientation=[q / norm for q in quaternion], angular_velocity=angular)

    def write(self, force: tuple[float, ...], torque: tuple[float, ...] | None = None) -> None:
        assert torque is not None
        assert len(torque) == 3
        super().write(force)


class NotUnit(Pose):
    """Returns a quaternion that is not of length 1."""

    def read(self) -> MasterSample:
        sample = super().read()
        assert sample.orientation is not None
        return sample._replace(orientation=[1.001 * value for value in sample.orientation])


class OwnFrame(Pose):
    """Returns its angular velocity in its own frame: R^T w."""

    def turn(self, time_s: float) -> tuple[list[float], list[float]]:
        quaternion, _ = super().turn(time_s)
        return quaternion, [0.5, math.sin(0.5 * time_s), math.cos(0.5 * time_s)]


class Arm:
    """Arm at rest that measures no force."""

    paces = False

    def __init__(self, axes: int = 1) -> None:
        self.axes, self.calls = axes, list[str]()

    def open(self) -> None:
        self.calls.append("open")
        note("open")

    def read(self) -> SlaveSample:
        if self.axes == 1:
            return SlaveSample(0.02, 0.0, 0.0)
        zero = [0.0] * self.axes
        return SlaveSample(zero, zero, zero)

    def write(self, position: tuple[float, ...], velocity: tuple[float, ...]) -> None:
        self.calls.append(f"write {position} {velocity}")
        note("write")

    def stop(self) -> None:
        self.calls.append("stop")
        note("stop")

    def close(self) -> None:
        self.calls.append("close")
        note("close")


class ArmThatHolds(Arm):
    """Has torque by itself while it is open."""

    exerts_by_itself = True


class ArmThatHangsInOpen(ArmThatHolds):
    """Hangs in `open`."""

    def open(self) -> None:
        """Block for 60 s."""
        threading.Event().wait(60.0)


class Drifting(Arm):
    """Reports a velocity while it is at rest."""

    def read(self) -> SlaveSample:
        return SlaveSample(0.02, 0.5, 0.0)


class RaisesInStop(Arm):
    """Raises in `stop`."""

    def stop(self) -> None:
        super().stop()
        message = "no program"
        raise RuntimeError(message)


class OtherAxes(Arm):
    """Declares another number of axes."""

    def __init__(self) -> None:
        super().__init__(1)
        self.axes = 3

    def read(self) -> SlaveSample:
        return SlaveSample(0.0, 0.0, 0.0)


def declared(folder: Path, group: str = "haptether.masters", **drivers: str) -> dict[str, str]:
    """Return the environment of a process that finds drivers of this module, or others, by the given names."""
    package = folder / "bench_drivers-1.0.dist-info"
    package.mkdir()
    (package / "METADATA").write_text("Metadata-Version: 2.1\nName: bench-drivers\nVersion: 1.0\n")
    lines = [f"{name} = {value if ':' in value else f'{__name__}:{value}'}" for name, value in drivers.items()]
    (package / "entry_points.txt").write_text("\n".join([f"[{group}]", *lines, ""]))
    root = Path(__file__).resolve().parents[2]
    before = os.environ.get("PYTHONPATH")
    path = os.pathsep.join([str(folder), str(root), *([before] if before else [])])
    return {"PYTHONPATH": path, "PATH": "/usr/bin:/bin", "COLUMNS": "200"}


class RaisesWhenMade:
    """Raises in its constructor."""

    def __init__(self) -> None:
        raise KeyError("counts per turn")


class Free:
    """Device of one axis that nobody holds: 0.1 kg, 0.5 N s/m, 0.1 N, an encoder of 0.023 mm."""

    paces = False
    kinds = ("linear",)

    def __init__(self, coulomb: float = 0.1, hangs_at: int = 0) -> None:
        self.coulomb, self.hangs_at, self.reads = coulomb, hangs_at, 0
        self.closed = threading.Event()

    def open(self) -> None:
        self.device = VirtualDevice([Plant(0.1, 0.5, self.coulomb)], quantum=2.3e-5)
        self.begun_s = time.monotonic()
        note("open")

    def read(self) -> MasterSample:
        self.reads += 1
        if self.reads == self.hangs_at:
            self.closed.wait(30.0)
        return self.device.read(time.monotonic() - self.begun_s)

    def write(self, force: tuple[float, ...]) -> None:
        self.device.write(force, time.monotonic() - self.begun_s)
        note(f"write {force[0]:.4f}")

    def close(self) -> None:
        note("close")
        self.closed.set()


class Jaws:
    """Gripper that stays in place, or has one defect."""

    def __init__(self, *, wrong: str = "") -> None:
        self.wrong = wrong

    def open(self) -> None:
        note("open")

    def read(self) -> GripperSample:
        if self.wrong == "slow":
            time.sleep(0.02)
        if self.wrong == "none":
            return None  # type: ignore[return-value]
        fault = "overheating: let it cool" if self.wrong == "fault" else None
        return GripperSample(position=0.25, velocity=0.0, force_n=3.0, holds_object=True, fault=fault)

    def write(self, command: GripperCommand) -> None:
        note(f"write {command.position}")

    def hold(self) -> None:
        note("hold")
        if self.wrong == "hold":
            message = "the bus is gone"
            raise OSError(message)

    def close(self) -> None:
        note("close")
