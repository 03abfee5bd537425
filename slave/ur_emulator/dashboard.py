"""The dashboard server: a line comes in, a line goes out.

Source: Universal Robots, "Dashboard Server e-Series"; what ur_rtde 1.6.5 and ur_client_library compare answers with.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from haptether.slave.ur_emulator.controller import Controller

BANNER: Final = "Connected: Universal Robots Dashboard Server"
CONTROL_PROGRAM: Final = "rtde_control.urp"
"""The one program that the controller has on its disk: the control script of ur_rtde."""
INSTALLATION: Final = "default.installation"
REPORTS: Final = ("controller", "software", "system")
MODES: Final = frozenset({"manual", "automatic"})
MAX_SHOWN: Final = 500
"""Characters of a line or an argument that come back in an answer."""
TAKE_ARGUMENT: Final = (
    "load installation ",
    "load ",
    "popup ",
    "addtolog ",
    "set operational mode ",
    "savelog ",
    "generate flight report ",
    "generate support file ",
)
"""The longer one first where one begins like another."""
NEEDS_REMOTE: Final = frozenset(
    {
        "play",
        "stop",
        "pause",
        "load",
        "load installation",
        "power on",
        "power off",
        "brake release",
        "unlock protective stop",
    }
)


class Dashboard:
    """What the dashboard server says; its connections share it."""

    def __init__(self, controller: "Controller") -> None:
        self._of = controller
        self._reports = 0
        self._answers = self._table()

    def answer(self, line: str) -> tuple[str, bool]:
        """The answer to a line, and whether the connection stays open."""
        words = line.strip().lower()
        if words in {"quit", "shutdown"}:
            return ("Disconnected" if words == "quit" else "Shutting down"), False
        name = words if words in self._answers else next(filter(words.startswith, TAKE_ARGUMENT), "").rstrip()
        if name not in self._answers:
            return f"could not understand: '{line.strip()[:MAX_SHOWN]}'", True
        if self._is_local and name in NEEDS_REMOTE:
            return "Command is not allowed due to safety reasons", True
        return self._answers[name](line.strip()[len(name) :].strip()[:MAX_SHOWN]), True

    @property
    def _is_local(self) -> bool:
        return not (self._of.remote_control or self._of.version.is_cb3)

    def _table(self) -> dict[str, Callable[[str], str]]:
        of = self._of
        series = of.version.has(None, (5, 6))
        return {
            "polyscopeversion": lambda _: f"URSoftware {of.reported_version} (Jan 01 2024)",
            **(
                {
                    "get serial number": lambda _: of.settings.serial_number,
                    "is in remote control": lambda _: str(of.remote_control).lower(),
                }
                if series
                else {}
            ),
            "robotmode": lambda _: f"Robotmode: {of.safety.robot_mode.name}",
            "safetymode": lambda _: f"Safetymode: {of.safety.mode.name}",
            "safetystatus": lambda _: f"Safetystatus: {of.safety.mode.name}",
            "programstate": lambda _: f"{of.runtime.name} {of.program_name or of.loaded or '<unnamed>'}",
            "running": lambda _: f"Program running: {str(of.runtime.name == 'PLAYING').lower()}",
            "isprogramsaved": lambda _: f"true {of.loaded or '<unnamed>'}",
            "get loaded program": lambda _: f"Loaded program: {of.loaded}" if of.loaded else "No program loaded",
            "get robot model": lambda _: of.settings.model.name.rstrip("e").upper(),
            "get operational mode": lambda _: self._operational_mode,
            "version": lambda _: str(of.reported_version),
            "play": lambda _: "Starting program" if of.play() else "Failed to execute: play",
            "stop": self._stop,
            "pause": lambda _: "Pausing program" if of.pause() else "Failed to execute: pause",
            "load": self._load,
            "load installation": self._load_installation,
            "savelog": lambda _: "Log saved to disk",
            "generate flight report": self._flight_report,
            "generate support file": self._support_file,
            "power on": self._power_on,
            "power off": self._power_off,
            "brake release": self._release_brakes,
            "unlock protective stop": lambda _: of.safety.unlock(of.now_s),
            "restart safety": self._restart,
            "close safety popup": lambda _: "closing safety popup",
            "close popup": lambda _: "closing popup",
            "popup": lambda _: "showing popup",
            "addtolog": self._add_to_log,
            **(
                {}
                if of.version.is_cb3
                else {
                    "set operational mode": self._set_operational_mode,
                    "clear operational mode": self._clear_operational_mode,
                }
            ),
        }

    def _stop(self, _: str) -> str:
        self._of.stop_program()
        return "Stopped"

    def _load(self, name: str) -> str:
        file = name.rpartition("/")[2]
        if file != CONTROL_PROGRAM:
            return f"File not found: {name}"
        self._of.loaded = file
        if self._of.runtime.name == "STOPPED":
            # Clients wait for a state with the name of the file.
            self._of.program_name = ""
        return f"Loading program: {name}"

    def _load_installation(self, name: str) -> str:
        if name.rpartition("/")[2] != INSTALLATION:
            return f"File not found: {name}"
        # It is the one that it has.
        return f"Loading installation: {name}"

    def _flight_report(self, kind: str) -> str:
        if kind.lower() not in REPORTS:
            return f"Error: {kind or 'no type of report'}: must be one of {', '.join(REPORTS)}"
        self._reports += 1
        return f"Flight Report generated with id: {self._reports}"

    def _support_file(self, folder: str) -> str:
        if not folder:
            return "Error: no folder"
        # As a real one names it; there is no disk that it would be written to.
        return f"Completed successfully: ur_{self._of.settings.serial_number}_2024-01-01_00-00-00.zip"

    @property
    def _operational_mode(self) -> str:
        return self._of.operational_mode or ("AUTOMATIC" if self._of.remote_control else "MANUAL")

    def _set_operational_mode(self, mode: str) -> str:
        if mode.lower() not in MODES:
            return f"Failed setting operational mode: {mode}"
        self._of.operational_mode = mode.upper()
        # With the client's own spelling, which it looks for.
        return f"Operational mode {mode} is set"

    def _clear_operational_mode(self, _: str) -> str:
        self._of.operational_mode = None
        return f"No longer controlling the operational mode. Current operational mode: '{self._operational_mode}'."

    def _power_on(self, _: str) -> str:
        self._of.safety.power_on(self._of.now_s)
        return "Powering on"

    def _power_off(self, _: str) -> str:
        self._of.safety.power_off()
        return "Powering off"

    def _release_brakes(self, _: str) -> str:
        self._of.safety.release_brakes(self._of.now_s)
        return "Brake releasing"

    def _restart(self, _: str) -> str:
        self._of.safety.restart(self._of.now_s)
        return "Restarting safety"

    def _add_to_log(self, text: str) -> str:
        self._of.tell(f"dashboard: {text}")
        return "Added log message"
