"""`haptether ur-emulator`."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from haptether.cli.emulators.serving import EmulatorOptions

if TYPE_CHECKING:
    from haptether.slave import SceneTouch
    from haptether.slave.ur_emulator import Controller, GripperSettings, Server, ToolEnvironment


MAX_UNLOCK_S = 3600.0
MAX_PORT = 65535


@dataclass(frozen=True, kw_only=True)
class UrEmulator(EmulatorOptions):
    """Emulate the controller of a UR arm, for the real client libraries.

    It serves RTDE on port 30004, the dashboard on 29999 and scripts on 30001 to 30003 of one address. The protocol
    fixes these ports, so several emulators need several addresses, 127.0.0.2, 127.0.0.3 and so on. The simulated arm
    follows servoj, speedj, speedl, moves and force mode, and touches the objects of a scene. docs/ur_emulator.md has
    the model, and the lines of --control that push the tool and cause faults.

    Examples:

    haptether ur-emulator

    haptether ur-emulator --gripper 2f-85 --gripper-object-mm 40

    haptether ur-emulator --host 127.0.0.2 --model ur10e --version 5.23 --scene three_axis_box --control -
    """

    host: str = "127.0.0.1"
    """Address to listen on."""
    expose: bool = False
    """Allow an address that other machines reach: anybody there can then move the arm."""
    model: str = "ur5e"
    """The arm: ur3, ur5, ur10, ur3e, ur5e, ur7e, ur10e, ur12e, ur16e, ur20 or ur30."""
    version: Annotated[str, tyro.conf.arg(metavar="X.Y[.Z[.BUILD]]")] = "5.11"
    """Version of the controller: 3.15 (CB3, 125 Hz) or 5.4 to 5.26 (500 Hz)."""
    scene: Annotated[str | None, tyro.conf.arg(metavar="SCENE")] = None
    """Environment of the tool: [environment] of a shipped scene or of a scene file; by default nothing."""
    set: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="KEY=VALUE")] = ()
    """Change the scene, as in `haptether simulate`; may be given often."""
    start: Annotated[tuple[float, float, float, float, float, float], tyro.conf.arg(metavar="Q")] = (
        -1.6, -1.7, -2.2, -0.8, 1.6, 0.0,
    )  # fmt: skip
    """Initial joint angles in rad."""
    tcp: Annotated[tuple[float, float, float, float, float, float], tyro.conf.arg(metavar="P")] = (0.0,) * 6
    """Initial tool in the frame of the flange, x y z rx ry rz in m and rad."""
    noise: float = 0.0
    """Standard deviation of the force sensor in N; its torques have a tenth of it in N m."""
    bias: Annotated[tuple[float, float, float, float, float, float], tyro.conf.arg(metavar="W")] = (0.0,) * 6
    """Offset of the force sensor, three in N and three in N m."""
    seed: int = 0
    """Seed of the sensor's noise and of the jitter of late packages."""
    gripper: Literal["2f-85", "2f-140", "hand-e"] | None = None
    """A Robotiq gripper on the flange, and the server of its URCap; by default none."""
    gripper_port: int = 63352
    """Port of the gripper's server; 0 for any free one, which the first line names."""
    gripper_object_mm: float | None = None
    """Width in mm of the object between its jaws; by default none."""
    gripper_active: bool = False
    """Begin with the gripper activated, rather than freshly powered."""
    local: bool = False
    """Begin in local control, which refuses scripts, rather than in remote control."""
    unlock_after_s: float = 5.0
    """Time in s after a protective stop during which it cannot be unlocked."""
    realtime: Literal["auto", "off", "require"] = "auto"
    """Ask for SCHED_FIFO and go on without (auto), do not ask (off), or fail without (require)."""

    def run(self) -> int:
        """Serve until it is stopped."""
        from haptether.slave.ur_emulator import ControlLine, Faults, Server

        if not 0 <= self.seed < 2**64:
            message = f"seed = {self.seed}: must be 0 to 2^64 - 1"
            raise ValueError(message)
        if not 0.0 <= self.unlock_after_s <= MAX_UNLOCK_S:
            message = f"unlock_after_s = {self.unlock_after_s:g}: must be 0 to {MAX_UNLOCK_S:g} s"
            raise ValueError(message)
        self.check()
        self._check_host()
        controller, environment = self._controller()
        faults = Faults(seed=self.seed)
        server = Server(controller, faults, self.host, self.gripper_port)
        line = ControlLine(controller, environment, faults, server)
        return self.serve(server, line, self._headline(server), line.status, self.realtime)

    def _headline(self, server: "Server") -> str:
        gripper = "" if self.gripper is None else f", a {self.gripper} on port {server.gripper_port}"
        return f"listening on {self.host} as a {self.model} with software {self.version}{gripper}"

    def _check_host(self) -> None:
        import ipaddress

        try:
            address = ipaddress.ip_address("127.0.0.1" if self.host == "localhost" else self.host)
        except ValueError:
            message = f"host = {self.host!r}: must be an IPv4 address such as 127.0.0.1"
            raise ValueError(message) from None
        if address.version != 4:
            message = f"host = {self.host}: must be an IPv4 address: the clients speak no other"
            raise ValueError(message)
        if not (address.is_loopback or self.expose):
            message = f"host = {self.host}: other machines reach it, and could move the arm: add --expose to allow that"
            raise ValueError(message)

    def _controller(self) -> "tuple[Controller, ToolEnvironment]":
        from haptether.slave.ur.kinematics.models import ur_model
        from haptether.slave.ur_emulator import (
            Controller,
            ControllerSettings,
            ControllerVersion,
            ToolEnvironment,
            WrenchSensing,
        )

        environment = ToolEnvironment(self._scene())
        settings = ControllerSettings(
            model=ur_model(self.model),
            version=ControllerVersion.parsed(self.version),
            start=self.start,
            tcp=self.tcp,
            remote_control=not self.local,
            unlock_after_s=self.unlock_after_s,
            gripper=self._gripper(),
        )
        sensing = WrenchSensing(noise_n=self.noise, bias=self.bias, seed=self.seed)
        controller = Controller(settings, environment, sensing)
        controller.on_engaged = environment.engage
        return controller, environment

    def _gripper(self) -> "GripperSettings | None":
        if not 0 <= self.gripper_port <= MAX_PORT:
            message = f"gripper_port = {self.gripper_port}: must be 0 to {MAX_PORT}"
            raise ValueError(message)
        if self.gripper is None:
            if self.gripper_object_mm is not None or self.gripper_active:
                message = "gripper_object_mm, gripper_active: --gripper must name a gripper"
                raise ValueError(message)
            return None
        from haptether.slave.robotiq.models import ROBOTIQ_MODELS
        from haptether.slave.ur_emulator import GrippedObject, GripperSettings

        width_mm = self.gripper_object_mm
        try:
            grips = None if width_mm is None else GrippedObject(width_m=1e-3 * width_mm)
            return GripperSettings(model=ROBOTIQ_MODELS[self.gripper], grips=grips, active=self.gripper_active)
        except ValueError as error:
            message = f"gripper_object_mm = {width_mm:g}: {error}"
            raise ValueError(message) from None

    def _scene(self) -> "SceneTouch | None":
        if self.scene is None:
            if self.set:
                message = f"set = {self.set[0]}: changes a scene: --scene must name one"
                raise ValueError(message)
            return None
        from haptether.bridge import load_scene, scene_json
        from haptether.slave import SceneTouch

        return SceneTouch(scene_json(load_scene(self.scene, self.set)))
