"""`haptether inverse3-emulator`."""

from dataclasses import dataclass

from haptether.cli.emulators.serving import EmulatorOptions

MAX_PORT = 65535


@dataclass(frozen=True, kw_only=True)
class Inverse3Emulator(EmulatorOptions):
    """Emulate the vendor's service of a Haply Inverse3 with a VerseGrip, for the driver and other clients.

    It speaks the WebSocket and JSON of version 3.5, on this machine only: a frame on connection, then one for each
    message, and events on a port of their own. It simulates a mass with friction that a hand holds: `haptether identify
    inverse3` needs the control line `release` first. docs/haptic_devices.md has the model, and the lines of --control
    that move the hand and cause faults.

    Examples:

    haptether inverse3-emulator

    haptether inverse3-emulator --port 0 --event-port 0 --control -
    """

    port: int = 10001
    """Port of the states; 0 for any free one, which the first line names."""
    event_port: int = 10020
    """Port of the events; 0 for any free one."""
    no_grip: bool = False
    """Emulate no VerseGrip."""
    mass_kg: float = 0.157
    """m in kg. The device's own numbers are not published: these are placeholders."""
    viscous: float = 0.0
    """b in N s/m."""
    coulomb: float = 0.038
    """c in N."""

    def run(self) -> int:
        """Serve until it is stopped."""
        from haptether.master.inverse3.emulator import ControlLine, EmulatedInverse3, EmulatedSettings, Server, Service

        self.check()
        for name in ("port", "event_port"):
            if not 0 <= getattr(self, name) <= MAX_PORT:
                message = f"{name} = {getattr(self, name)}: must be 0 to {MAX_PORT}"
                raise ValueError(message)
        settings = EmulatedSettings(mass_kg=self.mass_kg, viscous=self.viscous, coulomb=self.coulomb)
        service = Service(EmulatedInverse3(settings), grip=not self.no_grip)
        server = Server(service, "127.0.0.1", self.port, self.event_port)
        line = ControlLine(service, server)
        headline = f"an Inverse3 on 127.0.0.1:{server.port}, events on {server.event_port}"
        return self.serve(server, line, headline, line.figures)
