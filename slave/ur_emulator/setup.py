"""What a program sets up on the controller."""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Final

from haptether.slave.ur_emulator.robot.force_mode import ForceMode
from haptether.slave.ur_emulator.script_error import ScriptError
from haptether.slave.ur_emulator.version import ControllerVersion

MAX_COG_M: Final = 10.0
MAX_GRAVITY: Final = 100.0

Three = tuple[float, ...]
Six = tuple[float, ...]


@dataclass(slots=True)
class Setup:
    """Settings that a program makes; those of the tool and of the payload outlive it."""

    version: ControllerVersion
    protective_stop: Callable[[str], None]
    """Asks for a protective stop, with its reason."""
    engage: Callable[[], None]
    """Is told when a servo or speed command has come."""
    payload_kg: float = 0.0
    payload_cog: Three = (0.0, 0.0, 0.0)
    payload_inertia: Six = (0.0,) * 6
    gravity: Three = (0.0, 0.0, 9.82)
    watchdog_hz: float | None = None
    """Least rate in Hz at which the command register must be written; None without a watchdog."""
    watched: str = ""
    """The input that the watchdog looks at."""
    watchdog_is_new: bool = False
    freedrive: bool = False
    external_sensor: bool = False
    """Whether force comes from the input external_force_torque."""

    def has(self, cb3: tuple[int, ...] | None, e_series: tuple[int, ...] | None) -> bool:
        """Whether the script has the lines that came with a version; the client takes out the others."""
        return self.version.has(cb3, e_series)

    def set_payload(self, mass_kg: float, cog: Three) -> None:
        """set_payload; a centre of gravity of zeros leaves that as it is."""
        if not 0.0 <= mass_kg <= 100.0:
            message = f"set_payload: m = {mass_kg:g}: must be between 0 and 100 kg"
            raise ScriptError(message)
        if not max(map(abs, cog)) <= MAX_COG_M:
            message = f"set_payload: cog = {list(cog)}: must be within {MAX_COG_M:g} m of the flange"
            raise ScriptError(message)
        self.payload_kg = mass_kg
        if any(cog) or self.version.is_cb3:
            self.payload_cog = cog

    def set_gravity(self, gravity: Three) -> None:
        """set_gravity: the acceleration in m/s² that holds the base up."""
        if not max(map(abs, gravity)) <= MAX_GRAVITY:
            message = f"set_gravity: {list(gravity)}: must be at most {MAX_GRAVITY:g} m/s^2"
            raise ScriptError(message)
        self.gravity = gravity

    def set_watchdog(self, name: str, min_frequency: float) -> None:
        """rtde_set_watchdog with action "stop"."""
        if not 0.0 < min_frequency <= self.version.rate_hz or not math.isfinite(min_frequency):
            message = f"rtde_set_watchdog: min_frequency = {min_frequency:g}: must be above 0, at most the control rate"
            raise ScriptError(message)
        self.watchdog_hz, self.watched, self.watchdog_is_new = min_frequency, name, True

    def force_mode_defaults(self, force_mode: ForceMode) -> None:
        """What the control script begins with."""
        if self.has(None, (5, 0)):
            force_mode.gain_scaling = 0.5
        force_mode.damping = 0.025

    def reset(self) -> None:
        """As at the begin."""
        fresh = Setup(self.version, self.protective_stop, self.engage)
        for field in fields(self):
            setattr(self, field.name, getattr(fresh, field.name))

    def program_ended(self) -> None:
        """Forgets what lives as long as a program."""
        self.watchdog_hz = None
        self.freedrive = False
