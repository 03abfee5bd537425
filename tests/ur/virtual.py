"""The emulated controller in virtual time, with a client that acts like ur_rtde."""

from collections.abc import Sequence

from haptether.bridge import load_scene, scene_json
from haptether.slave import SceneTouch, ur_model
from haptether.slave.ur_emulator import (
    Controller,
    ControllerSettings,
    ControllerVersion,
    ControlLine,
    Faults,
    SafetyLimits,
    ToolEnvironment,
    WrenchSensing,
)
from haptether.slave.ur_emulator.rtde.session import RtdeSession
from haptether.slave.ur_emulator.script.control_script import CONTROL_SCRIPT
from haptether.slave.ur_emulator.script.port import Submitted

START = (-1.6, -1.7, -2.2, -0.8, 1.6, 0.0)
UP = (0.0, 0.0, 0.05, 0.0, 0.0, 0.0)
"""A velocity of the tool along z."""
READY, DONE = 1, 2


def shifted(joint: int, by: float) -> tuple[float, ...]:
    """Return the start with one joint, counted from 0, moved."""
    return tuple(q + by * (n == joint) for n, q in enumerate(START))


def lifted(pose: tuple[float, ...], by: float) -> tuple[float, ...]:
    """Return a pose raised by some m."""
    return (*pose[:2], pose[2] + by, *pose[3:])


class World:
    """A controller, the environment of its tool, and a client that has uploaded the control script."""

    def __init__(
        self,
        version: str = "5.11",
        *,
        scene: str | None = None,
        overrides: Sequence[str] = (),
        offset: int = 0,
        limits: SafetyLimits | None = None,
        noise_n: float = 0.0,
        tcp: Sequence[float] = (0.0,) * 6,
        start: tuple[float, ...] = START,
        upload: bool = True,
    ) -> None:
        touch = None if scene is None else SceneTouch(scene_json(load_scene(scene, overrides)))
        self.environment = ToolEnvironment(touch)
        self.controller = Controller(
            ControllerSettings(
                model=ur_model("ur5e"),
                version=ControllerVersion.parsed(version),
                start=start,
                tcp=tuple(tcp),
                limits=limits or SafetyLimits(),
            ),
            self.environment,
            WrenchSensing(noise_n=noise_n, seed=1),
        )
        self.controller.on_engaged = self.environment.engage
        self.line = ControlLine(self.controller, self.environment, Faults())
        self.offset = offset
        if upload:
            self.upload()

    # ------------------------------------------------------------------------------------------------- the client

    def upload(self) -> None:
        """Upload the control script and wait until it is ready."""
        text = f"{CONTROL_SCRIPT.removesuffix('end')}  # int register offset\n{self.offset}\nend"
        self.write(0)
        self.controller.submit(Submitted("rtde_control", text))
        self.until(lambda: self.playing and self.answer == READY)

    def write(self, command: int, doubles: Sequence[float] = (), integers: Sequence[int] = ()) -> None:
        """Write a command with its arguments, as one package."""
        values: dict[str, float | int] = {f"input_int_register_{self.offset}": command}
        values |= {f"input_double_register_{self.offset + n}": v for n, v in enumerate(doubles)}
        values |= {f"input_int_register_{self.offset + 1 + n}": v for n, v in enumerate(integers)}
        self.controller.inputs.write(values)

    def realtime(self, command: int, doubles: Sequence[float] = (), integers: Sequence[int] = ()) -> None:
        """Write a command of the real-time class once the script is ready."""
        self.until(lambda: self.answer == READY)
        self.write(command, doubles, integers)

    def call(
        self, command: int, doubles: Sequence[float] = (), integers: Sequence[int] = (), *, limit_s: float = 30.0
    ) -> int:
        """Perform a whole handshake; return the control cycles from the command to its answer."""
        self.realtime(command, doubles, integers)
        begin = self.controller.cycles
        self.until(lambda: self.answer == DONE or not self.playing, limit_s)
        assert self.answer == DONE, self.controller.log
        took = self.controller.cycles - begin
        self.write(0)
        return took

    def servo(self, q: Sequence[float], time_s: float = 0.002, lookahead_s: float = 0.1, gain: float = 300.0) -> None:
        """Call servoJ once."""
        self.realtime(11, [*q, 0.0, 0.0, time_s, lookahead_s, gain])

    def rtde(self, protocol: int = 2) -> RtdeSession:
        """Return a session of RTDE with the controller."""
        of = self.controller
        return RtdeSession(
            99,
            500.0,
            lambda: of.reported_version,
            of.inputs,
            of.outputs,
            of.output_types,
            of.write_log,
            protocol=protocol,
        )

    # ---------------------------------------------------------------------------------------------------- time

    def cycles(self, count: int) -> None:
        """Let control cycles pass."""
        for _ in range(count):
            self.controller.cycle()

    def seconds(self, seconds: float) -> None:
        """Let time pass."""
        self.cycles(round(seconds / self.controller.period_s))

    def until(self, holds: "object", limit_s: float = 1.0) -> None:
        """Let time pass until a condition holds."""
        assert callable(holds)
        for _ in range(round(limit_s / self.controller.period_s)):
            if holds():
                return
            self.controller.cycle()
        assert holds(), self.controller.log

    # --------------------------------------------------------------------------------------------------- outputs

    @property
    def playing(self) -> bool:
        """True if the program runs."""
        return self.controller.runtime.name == "PLAYING"

    @property
    def answer(self) -> int:
        """Register of the handshake."""
        return self.integer(0)

    def integer(self, number: int) -> int:
        """Return an output register of the script."""
        value = self.controller.outputs[f"output_int_register_{self.offset + number}"]
        assert isinstance(value, int)
        return value

    def six(self, first: int = 0) -> tuple[float, ...]:
        """Return six output registers of the script."""
        names = [f"output_double_register_{self.offset + first + n}" for n in range(6)]
        return tuple(float(self.controller.outputs[name]) for name in names)  # type: ignore[arg-type]

    def vector(self, name: str) -> tuple[float, ...]:
        """Return an output that is a vector."""
        value = self.controller.outputs[name]
        assert isinstance(value, tuple)
        return value

    def number(self, name: str) -> float:
        """Return an output that is a number."""
        value = self.controller.outputs[name]
        assert isinstance(value, float | int)
        return value
