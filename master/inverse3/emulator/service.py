"""Answers of the emulated service: one frame on connection, one per message; time is an argument."""

import json
import math
from collections import deque
from typing import Any, Final

import msgspec

from haptether.master.inverse3.emulator.device import EmulatedInverse3, Vector

DEVICE_ID: Final = "0E30"
GRIP_ID: Final = "0E31"
IDLE_S: Final = 0.02
"""Time in s without a message after which the device idles; chosen, because none is published."""
MAX_LOG: Final = 100


class Faults:
    """Faults on command."""

    def __init__(self) -> None:
        self.drop = 0
        """Number of suppressed replies."""
        self.delay_s = 0.0
        """Delay of each reply in s."""
        self.stall_s = 0.0
        """One-time delay in s of replies from the next message on."""
        self.garble: str | None = None
        """Replacement of the next reply."""
        self.twice = 0
        """Number of replies sent twice."""
        self.added: Vector = (0.0, 0.0, 0.0)
        """Force of another program in N."""
        self.gain = 1.0
        """Gain of forces, as of a force gate."""


class Service:
    """One Inverse3, one wireless VerseGrip, and sessions.

    Args:
        device: Emulated device.
        grip: True if there is a VerseGrip.
    """

    def __init__(self, device: EmulatedInverse3, *, grip: bool = True) -> None:
        self.device = device
        self.grip = grip
        self.faults = Faults()
        self.status = {"calibrated": True, "in_use": False, "power_supply": True, "ready": True, "started": True}
        self.awake = True
        self.present = True
        self.orientation = (1.0, 0.0, 0.0, 0.0)
        self.buttons = {"a": False, "b": False, "c": False}
        self.events: deque[str] = deque()
        """Pending events."""
        self.log: deque[str] = deque(maxlen=MAX_LOG)
        self.braked = False
        self.asleep_after_s: float | None = None
        self._received = 0
        self._idles = True
        self._commanded: Vector = (0.0, 0.0, 0.0)
        self._sent: Vector = (0.0, 0.0, 0.0)
        """Last force of a client, even if the device idles since."""
        self._last_s = -math.inf
        self._config: dict[str, Any] = {"force_gate": {"gain": 0.3}, "damping": {"scalar": 0.0}}

    def advance(self, now_s: float) -> None:
        """Advance the device; without messages it idles."""
        if now_s - self._last_s > IDLE_S:
            self._idle()
        self.device.advance(now_s)

    def first(self) -> str:
        """Return the frame on connection, with the configuration."""
        return json.dumps({"session_id": 1, **self._state(configured=True)})

    def receive(self, text: bytes, now_s: float) -> list[str]:
        """Return the replies to a message of a client."""
        full = False
        try:
            message = msgspec.json.decode(text)
            full = "force_render_full_state" in message.get("session", {})
            self._obey(message)
        except (msgspec.MsgspecError, ValueError, TypeError, KeyError, AttributeError) as error:
            self.log.append(f"refused: {error}: {text[:120]!r}")
            self.tell("invalid-value", {"field": "", "reason": str(error), "context": ""}, "warning")
        self._received += 1
        self._last_s = now_s
        self.device.advance(now_s)
        faults = self.faults
        if faults.drop > 0:
            faults.drop -= 1
            return []
        if faults.garble is not None:
            garbled, faults.garble = faults.garble, None
            return [garbled]
        state = json.dumps(self._state(configured=full))
        if faults.twice > 0:
            faults.twice -= 1
            return [state, state]
        return [state]

    def tell(self, name: str, details: dict[str, Any], level: str = "info") -> None:
        """Send an event to all listeners."""
        self.events.append(
            json.dumps({"name": name, "category": "device", "level": level, "data": details, "message": ""})
        )

    def brake(self, *, on: bool) -> None:
        """Set the emergency brake."""
        self.braked = on
        self._exert()
        self.tell("device-safety-triggered", {
            "device_id": DEVICE_ID, "safety_type": "ebrake_triggered" if on else "ebrake_released",
        }, "critical")  # fmt: skip

    def sleep(self, *, awake: bool) -> None:
        """Set the sleep state of the grip."""
        self.awake = awake
        if not awake:
            self.tell("device-sleep", {"device_family": "wireless_verse_grip", "device_id": GRIP_ID})

    def figures(self) -> dict[str, Any]:
        """Return state and figures for `status`."""
        device = self.device
        return {
            "position": list(device.position),
            "velocity": list(device.velocity),
            "force": list(device.force),
            "commanded": list(self._commanded),
            "sent": list(self._sent),
            "idle": self._idles,
            "braked": self.braked,
            "awake": self.awake,
            "received": self._received,
            **self.status,
        }

    def _obey(self, message: dict[str, Any]) -> None:
        for device in message.get("inverse3", []):
            if device["device_id"] != DEVICE_ID:
                error = f"no device {device['device_id']}"
                raise ValueError(error)
            for name in ("force_gate", "damping"):
                if name in device.get("configure", {}):
                    self._config[name] = device["configure"][name]
            commands = device.get("commands", {})
            if "set_cursor_force" in commands:
                vector = commands["set_cursor_force"]["vector"]
                x, y, z = (float(vector[axis]) for axis in "xyz")
                self._idles, self._commanded, self._sent = False, (x, y, z), (x, y, z)
            else:
                self._idle()
            self._exert()

    def _idle(self) -> None:
        self._idles, self._commanded = True, (0.0, 0.0, 0.0)
        self._exert()

    def _exert(self) -> None:
        works = not self.braked and all(self.status[name] for name in ("power_supply", "calibrated", "started"))
        x, y, z = (
            self.faults.gain * f + added if works else 0.0
            for f, added in zip(self._commanded, self.faults.added, strict=True)
        )
        self.device.force = x, y, z

    def _state(self, *, configured: bool) -> dict[str, Any]:
        device = self.device
        inverse3: dict[str, Any] = {
            "device_id": DEVICE_ID,
            "state": {
                "angular_position": {"a0": 0.0, "a1": 0.0, "a2": 0.0},
                "angular_velocity": {"a0": 0.0, "a1": 0.0, "a2": 0.0},
                "body_orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
                "cursor_position": _xyz(device.position),
                "cursor_velocity": _xyz(device.velocity),
                "current_cursor_force": _xyz(device.force),
                # Format before 3.5, which the vendor's client still requires.
                "mode": "idle" if self._idles else "position",
                "control_domain": "undefined" if self._idles else "cartesian",
                "control_mode": "idle" if self._idles else "force",
                # The service omits parts that change nothing.
                "transform": {},
            },
            "status": self.status,
        }
        w, x, y, z = self.orientation
        grip: dict[str, Any] = {
            "device_id": GRIP_ID,
            "state": {
                "battery_level": 0.9,
                "buttons": self.buttons,
                "hall": 0,
                "orientation": {"w": w, "x": x, "y": y, "z": z},
            },
            "status": {"connected": True, "awake": self.awake, "ready": True},
        }
        if configured:
            inverse3["config"] = {
                "id": DEVICE_ID,
                "type": "inverse3",
                "device_info": {
                    "id": DEVICE_ID,
                    "major_version": 7,
                    "minor_version": 0,
                    "device_type": "inverse3",
                    "uuid": f"00000000-0000-0000-0000-00000000{DEVICE_ID}",
                },
                "port": "emulated",
                "extended_device_id": DEVICE_ID,
                "extended_firmware_version": "emulated",
                "preset": "defaults",
                "mount": {},
                "gravity_compensation": {"enabled": True, "scaling_factor": 1.0},
                "torque_scaling": {"enabled": True},
                "handedness": "right",
                "basis": {"permutation": "XYZ"},
                "filters": self._config,
            }
        return {
            "inverse3": [inverse3] if self.present else [],
            "verse_grip": [],
            "wireless_verse_grip": [grip] if self.grip else [],
            "custom_verse_grip": [],
        }


def _xyz(vector: Vector) -> dict[str, float]:
    x, y, z = vector
    return {"x": x, "y": y, "z": z}
