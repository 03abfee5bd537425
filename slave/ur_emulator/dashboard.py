"""Dashboard server: each line of a client gets a line as its answer.

Sources: Universal Robots, "Dashboard Server e-Series"; the answers that ur_rtde 1.6.5 and ur_client_library expect.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from haptether.slave.ur_emulator.controller import Controller

BANNER: Final = "Connected: Universal Robots Dashboard Server"
CONTROL_PROGRAM: Final = "rtde_control.urp"
"""Only program on the controller's disk: the control script of ur_rtde."""
INSTALLATION: Final = "default.installation"
REPORTS: Final = ("controller", "software", "system")
MODES: Final = frozenset({"manual", "automatic"})
MAX_SHOWN: Final = 500
"""Characters of a line or an argument that an answer repeats."""
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
"""If one begins like another, the longer one comes first."""
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
    """Answers of the dashboard server; all connections share it."""

    def __init__(self, controller: "Controller") -> None:
        self._controller = controller
        self._reports = 0
        self._answers = self._table()

    def answer(self, line: str) -> tuple[str, bool]:
        """Return the answer to a line, and True if the connection stays open."""
        command = line.strip().lower()
        if command in {"quit", "shutdown"}:
            return ("Disconnected" if command == "quit" else "Shutting down"), False
        name = command if command in self._answers else next(filter(command.startswith, TAKE_ARGUMENT), "").rstrip()
        if name not in self._answers:
            return f"could not understand: '{line.strip()[:MAX_SHOWN]}'", True
        if self._controller.is_local and name in NEEDS_REMOTE:
            return "Command is not allowed due to safety reasons", True
        return self._answers[name](line.strip()[len(name) :].strip()[:MAX_SHOWN]), True

    def _table(self) -> dict[str, Callable[[str], str]]:
        controller = self._controller
        series = controller.version.has(None, (5, 6))
        return {
            "polyscopeversion": lambda _: f"URSoftware {controller.reported_version} (Jan 01 2024)",
            **(
                {
                    "get serial number": lambda _: controller.settings.serial_number,
                    "is in remote control": lambda _: str(controller.remote_control).lower(),
                }
                if series
                else {}
            ),
            "robotmode": lambda _: f"Robotmode: {controller.safety.robot_mode.name}",
            "safetymode": lambda _: f"Safetymode: {controller.safety.mode.name}",
            "safetystatus": lambda _: f"Safetystatus: {controller.safety.mode.name}",
            "programstate": lambda _: (
                f"{controller.runtime.name} {controller.program_name or controller.loaded or '<unnamed>'}"
            ),
            "running": lambda _: f"Program running: {str(controller.runtime.name == 'PLAYING').lower()}",
            "isprogramsaved": lambda _: f"true {controller.loaded or '<unnamed>'}",
            "get loaded program": lambda _: (
                f"Loaded program: {controller.loaded}" if controller.loaded else "No program loaded"
            ),
            "get robot model": lambda _: controller.settings.model.name.rstrip("e").upper(),
            "get operational mode": lambda _: self._operational_mode,
            "version": lambda _: str(controller.reported_version),
            "play": lambda _: "Starting program" if controller.play() else "Failed to execute: play",
            "stop": _done("Stopped", lambda _: controller.stop_program()),
            "pause": lambda _: "Pausing program" if controller.pause() else "Failed to execute: pause",
            "load": self._load,
            "load installation": self._load_installation,
            "savelog": lambda _: "Log saved to disk",
            "generate flight report": self._flight_report,
            "generate support file": self._support_file,
            "power on": _done("Powering on", lambda _: controller.safety.power_on(controller.now_s)),
            "power off": _done("Powering off", lambda _: controller.safety.power_off()),
            "brake release": _done("Brake releasing", lambda _: controller.safety.release_brakes(controller.now_s)),
            "unlock protective stop": lambda _: controller.safety.unlock(controller.now_s),
            "restart safety": _done("Restarting safety", lambda _: controller.safety.restart(controller.now_s)),
            "close safety popup": lambda _: "closing safety popup",
            "close popup": lambda _: "closing popup",
            "popup": lambda _: "showing popup",
            "addtolog": _done("Added log message", lambda text: controller.write_log(f"dashboard: {text}")),
            **(
                {}
                if controller.version.is_cb3
                else {
                    "set operational mode": self._set_operational_mode,
                    "clear operational mode": self._clear_operational_mode,
                }
            ),
        }

    def _load(self, name: str) -> str:
        file = name.rpartition("/")[2]
        if file != CONTROL_PROGRAM:
            return f"File not found: {name}"
        self._controller.loaded = file
        if self._controller.runtime.name == "STOPPED":
            # Clients wait for a program state with the file name.
            self._controller.program_name = ""
        return f"Loading program: {name}"

    def _load_installation(self, name: str) -> str:
        if name.rpartition("/")[2] != INSTALLATION:
            return f"File not found: {name}"
        # The only installation, already loaded.
        return f"Loading installation: {name}"

    def _flight_report(self, kind: str) -> str:
        if kind.lower() not in REPORTS:
            return f"Error: {kind or 'no type of report'}: must be one of {', '.join(REPORTS)}"
        self._reports += 1
        return f"Flight Report generated with id: {self._reports}"

    def _support_file(self, folder: str) -> str:
        if not folder:
            return "Error: no folder"
        # The name on a real controller; no file is written.
        return f"Completed successfully: ur_{self._controller.settings.serial_number}_2024-01-01_00-00-00.zip"

    @property
    def _operational_mode(self) -> str:
        return self._controller.operational_mode or ("AUTOMATIC" if self._controller.remote_control else "MANUAL")

    def _set_operational_mode(self, mode: str) -> str:
        if mode.lower() not in MODES:
            return f"Failed setting operational mode: {mode}"
        self._controller.operational_mode = mode.upper()
        # Clients look for their own spelling.
        return f"Operational mode {mode} is set"

    def _clear_operational_mode(self, _: str) -> str:
        self._controller.operational_mode = None
        return f"No longer controlling the operational mode. Current operational mode: '{self._operational_mode}'."


def _done(answer: str, action: Callable[[str], None]) -> Callable[[str], str]:
    """Return a function that acts on its argument and has one answer."""

    def answered(argument: str) -> str:
        action(argument)
        return answer

    return answered
