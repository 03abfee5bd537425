"""Emulated servos in virtual time, in the place of an arm's bus and clock."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from haptether.dynamixel.arm import ServoSettings, write_calibration
from haptether.dynamixel.arm import arm as arm_module
from haptether.dynamixel.emulator import ArmLoad, Bus, JointSettings, Servo
from haptether.dynamixel.emulator.protocol import ErrorNumber
from haptether.dynamixel.models import SERVO_MODELS
from haptether.slave import SlaveSample
from haptether.slave.dynamixel.driver import DynamixelSlave
from haptether.slave.dynamixel.gripper.driver import DynamixelGripper

TICK_S = 0.002
MODEL = "XM430-W350"
BAUD = 4_000_000


class Clock:
    """Virtual time in s."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s

    def wait(self, duration_s: float) -> None:
        self.now_s += duration_s


class VirtualRead:
    """The arguments of a `SyncRead`."""

    def __init__(self, address: int, length: int, ids: Sequence[int], *, fast: bool = True) -> None:
        self.address, self.length, self.ids, self.fast = address, length, tuple(ids), fast
        self.alerts: tuple[int, ...] = ()


class VirtualBus:
    """A `DynamixelBus` whose calls reach emulated servos at the time of a clock."""

    def __init__(self, bus: Bus, clock: Clock) -> None:
        self._bus, self._clock = bus, clock

    def _servo(self, servo_id: int) -> Servo:
        """Advance all servos, which hear the instruction."""
        now_s = self._clock.now_s
        self._bus.advance(now_s)
        for servo in self._bus.servos:
            servo.heard(now_s)
        return self._bus.servo(servo_id)

    def ping(self, servo_id: int) -> tuple[int, int]:
        servo = self._servo(servo_id)
        return servo.value("Model Number"), servo.value("Firmware Version")

    def read(self, servo_id: int, address: int, length: int) -> bytes:
        error, found = self._servo(servo_id).read(address, length)
        _refuse(error)
        return found

    def write(self, servo_id: int, address: int, written: bytes) -> bool:
        _refuse(self._servo(servo_id).write(address, written, self._clock.now_s))
        return True

    def sync_read(self, read: VirtualRead) -> bytes:
        read.alerts = tuple(one for one in read.ids if self._bus.servo(one).alert)
        return b"".join(self._servo(one).read(read.address, read.length)[1] for one in read.ids)

    def sync_write(self, address: int, length: int, ids: bytes, written: bytes) -> None:
        for at, one in enumerate(ids):
            # Nobody answers a sync write.
            self._servo(one).write(address, written[at * length : (at + 1) * length], self._clock.now_s)

    stop = sync_write

    def close(self) -> None:
        """Do nothing."""


def _refuse(error: ErrorNumber) -> None:
    if error != ErrorNumber.NONE:
        message = f"{error.name.lower().replace('_', ' ')} error ({int(error)})"
        raise RuntimeError(message)


class World:
    """Buses of emulated servos by their ports, and one clock."""

    def __init__(self, patched: pytest.MonkeyPatch) -> None:
        self.clock = Clock()
        self.buses: dict[str, Bus] = {}
        patched.setattr(time, "monotonic", self.clock)
        patched.setattr(time, "sleep", self.clock.wait)
        patched.setattr(arm_module, "SyncRead", VirtualRead)
        patched.setattr(arm_module, "opened_bus", lambda port, *_: VirtualBus(self.buses[port], self.clock))
        patched.setattr(arm_module, "check_port", lambda *_: 0.0)

    def plug(self, port: str, servos: Sequence[Servo], load: ArmLoad | None = None) -> None:
        """Put servos on a new bus; its steps end half a step before each tick, whatever the rounding of times."""
        self.buses[port] = Bus(servos, load=load)
        self.buses[port].advance(self.clock.now_s - 0.5e-3)

    def pass_by(self, duration_s: float) -> None:
        """Let time pass without any host."""
        for _ in range(round(duration_s / TICK_S)):
            self.clock.wait(TICK_S)
            for bus in self.buses.values():
                bus.advance(self.clock.now_s)


def joint_servo(inertia: float, *, coulomb: float = 0.0, viscous: float = 0.0, position_rad: float = 0.0) -> Servo:
    """Return a servo with a joint of known inertia and friction."""
    joint = JointSettings(inertia=inertia, viscous=viscous, coulomb=coulomb)
    return Servo(SERVO_MODELS[MODEL], 1, baud=BAUD, position_rad=position_rad, joint=joint)


class Follower:
    """One or more joints in current mode on a virtual bus, with the driver of a slave.

    Args:
        world: Its time.
        folder: Place of the calibration file.
        servos: Emulated servos; the driver knows their torque constants.
        load: Gravity on them.
        gripper: Driver of a gripper on the last servo, which is no joint.
        low_rad: Lower limit of each joint.
        high_rad: Upper limit of each joint.
        options: Options of the driver.
    """

    def __init__(
        self, world: World, folder: Path, servos: Sequence[Servo], load: ArmLoad | None = None,
        *, gripper: DynamixelGripper | None = None, low_rad: float = -3.0, high_rad: float = 3.0, port: str = "virtual",
        **options: Any,  # noqa: ANN401  # options of the driver
    ) -> None:  # fmt: skip
        self.world, self.servos = world, servos
        world.plug(port, servos, load)
        path = folder / f"{port}.toml"
        settings = tuple(
            ServoSettings(
                servo_id=one.id, model=one.model.name, low_rad=low_rad, high_rad=high_rad, cap_a=2.0,
                torque_constant=one.joint.constant_nm_per_a,
            )
            for one in (servos if gripper is None else servos[:-1])
        )  # fmt: skip
        write_calibration(path, BAUD, settings)
        given = {"mode": "current", "ramp_s": 0.0, "release_s": 0.0, "verify_watchdog": False, **options}
        self.driver = DynamixelSlave(port=port, arm=str(path), **given)
        if gripper is not None:
            gripper.attach(self.driver)
        self.driver.open()
        self.sample = self.driver.read()

    def read(self) -> SlaveSample:
        """Start the next tick."""
        self.world.clock.wait(TICK_S)
        self.sample = self.driver.read()
        return self.sample

    def exert(self, duration_s: float, *torque: float) -> list[SlaveSample]:
        """Command torques for a time; return the samples."""
        samples = []
        for _ in range(round(duration_s / TICK_S)):
            samples.append(self.read())
            self.driver.write_force(torque)
        return samples

    def hold(self, duration_s: float) -> list[SlaveSample]:
        """Stop and then only read, as the loop of a slave does."""
        samples = []
        for index in range(round(duration_s / TICK_S)):
            samples.append(self.read())
            if index == 0:
                self.driver.stop()
        return samples

    @property
    def joint(self) -> Any:  # noqa: ANN401  # of the emulator
        """First joint."""
        return self.servos[0].joint

    def exerted(self) -> float:
        """Return the torque in N m that the first servo exerts from now on."""
        self.world.clock.wait(TICK_S)
        self.world.buses[self.driver.settings.port].advance(self.world.clock.now_s)
        return float(self.joint.torque_nm)
