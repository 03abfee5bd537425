"""`haptether dynamixel-emulator`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from haptether.cli.emulators.serving import EmulatorOptions

if TYPE_CHECKING:
    from haptether.dynamixel.emulator import ArmLoad, Bus, Server, Servo, StreamLine

MAX_CONSTANT = 20.0
"""Largest torque constant in N m/A."""


@dataclass(frozen=True, kw_only=True)
class DynamixelEmulator(EmulatorOptions):
    """Emulate a bus of Dynamixel servos behind a pseudo-terminal, for the real client libraries.

    Servos of the X series speak Protocol 2.0 with the control tables of their models: EEPROM that is locked while
    torque is on, operating modes, limits, bus watchdog, hardware errors. Each servo turns an inertia with friction.
    docs/dynamixel.md has the model, and the lines of --control that push a joint and cause faults.

    Examples:

    haptether dynamixel-emulator --servos 1=XM430-W350 2=XL330-M288

    haptether dynamixel-emulator --arm gello-ur --control 127.0.0.1:7001

    haptether dynamixel-emulator --link /tmp/leader --baud 1000000 --wire-time --control -

    haptether dynamixel-emulator --tcp 127.0.0.1:7000
    """

    servos: Annotated[tuple[str, ...], tyro.conf.arg(metavar="ID=MODEL")] = (
        "1=XM430-W350", "2=XM430-W350", "3=XM430-W350", "4=XL330-M288", "5=XL330-M288", "6=XL330-M288", "7=XL330-M077",
    )  # fmt: skip
    """The servos, as ID=MODEL."""
    arm: Annotated[str | None, tyro.conf.arg(metavar="NAME|FILE")] = None
    """Use the servos of this description of an arm, under gravity; `--start` are then its joint angles."""
    mass_scale: float = 1.0
    """Factor on the masses of the description of `--arm`."""
    mount_offsets: Annotated[tuple[float, ...], tyro.conf.arg(metavar="RAD")] = ()
    """Offset in rad of each joint's servo of `--arm` from the description; a client learns it only by calibration."""
    mount_signs: Annotated[tuple[int, ...], tyro.conf.arg(metavar="SIGN")] = ()
    """1 for each joint whose servo turns as described, -1 if it turns the other way."""
    baud: int = 4_000_000
    """Rate of the servos in bit/s: a client at another rate gets no answer."""
    any_rate: bool = False
    """Let the servos understand every rate."""
    firmware: int = 52
    """Reported firmware version; fast reads exist from 45 on, in 330 models from 46 on."""
    start: Annotated[tuple[float, ...], tyro.conf.arg(metavar="Q")] = ()
    """Initial joint angles in rad from the mechanical centre; by default 0."""
    stops: Annotated[tuple[str, ...], tyro.conf.arg(metavar="ID=A:B[:K[:D]]")] = ()
    """Stops of the output of a servo at two angles in rad from its mechanical centre, such as jaws or an object between
    them, as ID=A:B, with a stiffness in N m/rad as ID=A:B:K, and with a damping in N m s/rad as ID=A:B:K:D."""
    constants: Annotated[tuple[str, ...], tyro.conf.arg(metavar="ID=NM_PER_A")] = ()
    """Torque constants in N m/A of servos, as ID=NM_PER_A; by default the likely one of each model."""
    return_delay: int = 0
    """Initial Return Delay Time in 2 us; the factory setting is 250."""
    wire_time: bool = False
    """Make answers take as long as on a wire, with the return delay."""
    latency_ms: float = 0.0
    """Latency timer of the adapter in ms; a common factory setting is 16."""
    link: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """A symbolic link to the terminal, which stays the same when the terminal is unplugged and plugged."""
    tcp: Annotated[str | None, tyro.conf.arg(metavar="HOST:PORT")] = None
    """Also offer the bus over TCP, raw bytes for one client at a time; port 0 is any free one."""
    socket: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Also offer the bus on a Unix socket, which `port` of a driver may name. A pseudo-terminal forwards bytes by
    kernel threads without priority, which are late on a busy machine."""
    seed: int = 0
    """Seed of the choice of lost or wrong bytes."""
    realtime: Literal["auto", "off", "require"] = "auto"
    """Ask for SCHED_FIFO and go on without (auto), do not ask (off), or fail without (require)."""

    def run(self) -> int:
        """Serve until it is stopped."""
        import time

        from haptether.dynamixel.emulator import ControlLine, Server

        self.check()
        if not 0 <= self.seed < 2**64:
            message = f"seed = {self.seed}: must be 0 to 2^64 - 1"
            raise ValueError(message)
        if not 0.0 <= self.latency_ms <= 1000.0:
            message = f"latency_ms = {self.latency_ms:g}: must be 0 to 1000 ms"
            raise ValueError(message)
        bus = self._bus()
        tcp = self._stream()
        server = Server(
            bus,
            link=self.link,
            wire_time=self.wire_time,
            latency_s=1e-3 * self.latency_ms,
            any_rate=self.any_rate,
            tcp=tcp,
        )
        line = ControlLine(bus, server, self._bus)
        reached = "" if tcp is None else f", {'TCP' if self.socket is None else 'socket'} {tcp.address}"
        headline = f"{self._headline(server)}{reached}"
        return self.serve(server, line, headline, lambda: line.status(time.monotonic()), self.realtime)

    def _bus(self) -> "Bus":
        from haptether.dynamixel.emulator import Bus

        servos, load = self._servos()
        bus = Bus(servos, self.seed, load)
        self._stop(bus)
        self._set_constants(bus)
        return bus

    def _stream(self) -> "StreamLine | None":
        """Return the second line to the bus.

        Raises:
            ValueError: Both of them are given.
            OSError: An address or a path that cannot be used.
        """
        from haptether.dynamixel.emulator import TcpLine, UnixLine

        if self.tcp is not None and self.socket is not None:
            message = f"socket = {self.socket}: beside --tcp: must be one of the two"
            raise ValueError(message)
        if self.tcp is not None:
            return TcpLine(self.tcp, self.baud)
        return None if self.socket is None else UnixLine(self.socket, self.baud)

    def _stop(self, bus: "Bus") -> None:
        from haptether.dynamixel.emulator import set_stops

        for text in self.stops:
            number, _, ends = text.partition("=")
            try:
                set_stops(bus.servo(int(number)).joint, ends.split(":"))
            except ValueError as error:
                why = f"{error}" if number.isdecimal() else "must be ID=A:B or ID=A:B:K[:D]"
                message = f"stops = {text}: {why}"
                raise ValueError(message) from None

    def _set_constants(self, bus: "Bus") -> None:
        for text in self.constants:
            number, _, given = text.partition("=")
            try:
                servo, constant = bus.servo(int(number)), float(given)
            except ValueError as error:
                message = f"constants = {text}: must be ID=NM_PER_A with the id of a servo: {error}"
                raise ValueError(message) from None
            if not 0.0 < constant <= MAX_CONSTANT:
                message = f"constants = {text}: must be above 0 and at most {MAX_CONSTANT:g} N m/A"
                raise ValueError(message)
            servo.joint.constant_nm_per_a = constant

    def _headline(self, server: "Server") -> str:
        names = ", ".join(f"{servo.id} {servo.model.name}" for servo in server.bus.servos)
        return f"servos {names} on {self.link or server.port} at {self.baud} bit/s"

    def _servos(self) -> "tuple[list[Servo], ArmLoad | None]":
        from haptether.dynamixel import SERVO_MODELS
        from haptether.dynamixel.emulator import Servo

        if self.arm is not None:
            return self._arm(self.arm)
        if self.mount_offsets or self.mount_signs:
            message = "mount_offsets, mount_signs: are of the joints of an arm: give --arm"
            raise ValueError(message)
        if self.start and len(self.start) != len(self.servos):
            message = f"start: {len(self.start)} angles: must be {len(self.servos)}, one of each servo"
            raise ValueError(message)
        servos = []
        for index, text in enumerate(self.servos):
            number, _, name = text.partition("=")
            if not (number.isdecimal() and len(number) <= 3 and name in SERVO_MODELS):
                message = f"servos = {text}: must be ID=MODEL with a model of {', '.join(SERVO_MODELS)}"
                raise ValueError(message)
            position_rad = self.start[index] if self.start else 0.0
            if not abs(position_rad) <= 1000.0:
                message = f"start = {position_rad:g}: must be at most 1000 rad"
                raise ValueError(message)
            servo = Servo(
                SERVO_MODELS[name], int(number), baud=self.baud, firmware=self.firmware, position_rad=position_rad
            )
            servos.append(servo)
        self._set_delay(servos)
        return servos, None

    def _arm(self, name: str) -> "tuple[list[Servo], ArmLoad | None]":
        from haptether.dynamixel.description import load_arm
        from haptether.dynamixel.emulator import ArmLoad, mounted, servos_of

        if self.servos != type(self).servos:
            message = f"arm = {name}: has servos of its own: leave --servos out"
            raise ValueError(message)
        if not 0.0 <= self.mass_scale <= 10.0:
            message = f"mass_scale = {self.mass_scale:g}: must be 0 to 10"
            raise ValueError(message)
        arm = mounted(load_arm(name), self.mount_offsets, self.mount_signs)
        servos = servos_of(arm, baud=self.baud, firmware=self.firmware, start=self.start)
        self._set_delay(servos)
        return servos, ArmLoad(arm, servos, mass_scale=self.mass_scale)

    def _set_delay(self, servos: "list[Servo]") -> None:
        for servo in servos:
            delay = servo.model.table["Return Delay Time"]
            if not 0 <= self.return_delay <= (delay.maximum or 0):
                message = f"return_delay = {self.return_delay}: must be 0 to {delay.maximum}"
                raise ValueError(message)
            servo.write(delay.address, delay.encoded(self.return_delay), 0.0)
