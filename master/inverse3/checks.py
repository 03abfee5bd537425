"""Checklist before an Inverse3 exerts a force: service status, and settings that alter forces silently."""

import time
from typing import Any, Final

from haptether.checklist import Checklist
from haptether.master.inverse3.channel import Channel, ChannelError
from haptether.master.inverse3.messages import (
    GRIPS,
    Event,
    Grip,
    InverseDevice,
    InverseStatus,
    MessageError,
    Reply,
    event,
    reply,
)
from haptether.master.inverse3.options import Inverse3Options

FIRST_S: Final = 1.0
"""Timeout in s of the first frame after connection."""
STATUS: Final = (
    ("power_supply", True, "no power", "is its supply plugged in?"),
    ("started", True, "not started", "wake it up: press its power button"),
    ("calibrated", True, "not calibrated", "put the arm into its calibration pose, as the vendor's hub shows"),
    ("ready", True, "not ready", "see what the vendor's hub says of it"),
    ("in_use", False, "in use", "another program moves it: end that"),
)
"""Required value of each flag, fault otherwise, and remedy."""
MAX_EVENTS: Final = 100
"""Events read per tick; a flood must not delay it."""
EVENTS_S: Final = 0.005
"""Time in s for events per tick; the rest waits for the next tick."""
EBRAKE: Final = "e-brake"
TRIPS: Final = {
    "ebrake_triggered": f"{EBRAKE}: the emergency brake is on: see why, release it, acknowledge",
    "stall_detected": "stall: a motor pushes and does not turn: let it go, acknowledge",
    "stability_ceiling": "unstable: the service has bounded the force: lower stiffness or rate, acknowledge",
    "fod_stage_changed": "overload: the service has changed what the motors may: let it cool, acknowledge",
}
"""Faults by `safety_type` of a `device-safety-triggered` event."""


def status_fault(status: InverseStatus) -> str | None:
    """Return the fault of the device, or None."""
    for name, wanted, fault, remedy in STATUS:
        if getattr(status, name) is not wanted:
            return f"{fault}: {remedy}"
    return None


def grip_fault(grip: Grip, kind: str) -> str | None:
    """Return the fault of the grip, or None; a wired grip does not sleep."""
    if grip.status.connected is False or grip.status.ready is False:
        return "grip lost: is it charged, in reach and paired?"
    if GRIPS[kind] != "verse_grip" and grip.status.awake is not True:
        return "grip asleep: press one of its buttons, acknowledge"
    if grip.state.orientation is None:
        return "grip without an orientation: is it of the kind that the option says?"
    return None


def event_fault(received: Event, device_id: str, grip_id: str | None) -> str | None:
    """Return the fault of an event about these devices, or None."""
    details = received.data or {}
    about = _about(received, device_id)
    if about not in (device_id, grip_id):
        return None
    which = "grip" if about == grip_id else "device"
    if received.name == "device-disconnected":
        return f"{which} disconnected: see its cable, acknowledge"
    if received.name == "device-sleep":
        return "grip asleep: press one of its buttons, acknowledge" if which == "grip" else "device asleep: wake it up"
    if received.name == "device-busy":
        return f"{which} in use: another program has it: end that, acknowledge"
    if received.name == "device-safety-triggered":
        trip = str(details.get("safety_type"))
        return None if trip == "ebrake_released" else TRIPS.get(trip, f"safety stop: {trip}: see the vendor's hub")
    return None


def brake(received: Event, device_id: str) -> bool | None:
    """Return the state of the emergency brake if the event contains it, otherwise None."""
    if received.name != "device-safety-triggered" or _about(received, device_id) != device_id:
        return None
    return {"ebrake_triggered": True, "ebrake_released": False}.get(str((received.data or {}).get("safety_type")))


def _about(received: Event, device_id: str) -> object:
    """Return the device named by an event; an event without a name may concern ours."""
    about = (received.data or {}).get("device_id")
    return device_id if about is None else about


def first_frame(channel: Channel) -> Reply:
    """Return the service's first frame after connection.

    Raises:
        ChannelError: No frame in time, or another kind of data.
    """
    received = channel.frame(FIRST_S)
    if received is None:
        message = f"the service said nothing within {FIRST_S:g} s of the connection: is its version 3.5 or later?"
        raise ChannelError(message)
    try:
        return reply(received)
    except MessageError as error:
        message = f"malformed frame: {error}"
        raise ChannelError(message) from None


def chosen_device(found: Reply, options: Inverse3Options, checklist: Checklist) -> InverseDevice:
    """Return the selected Inverse3 after checks.

    Raises:
        RefusedError: There is no device, the selection is ambiguous, or it is not ready.
    """
    names = [device.device_id for device in found.inverse3]
    wanted = [device for device in found.inverse3 if options.device_id in {"", device.device_id}]
    shown = ", ".join(names) or "none"
    checklist.check("Inverse3", shown, good=len(wanted) == 1, remedy=_which(options.device_id, names))
    checklist.finish()
    (device,) = wanted
    fault = status_fault(device.status)
    if fault is None:
        checklist.ok("status", "calibrated, ready, free")
    else:
        what, _, remedy = fault.partition(": ")
        checklist.refuse("status", what, remedy)
    transform = device.state.transform
    if transform is not None:
        checklist.check(
            "workspace", "as it is" if transform.is_identity else "moved, turned or scaled", good=transform.is_identity,
            remedy="another program has set a transform of the device: reset it in the vendor's hub",
        )  # fmt: skip
    _check_force_settings(device.config or {}, options, checklist)
    checklist.finish()
    return device


def chosen_grip(found: Reply, options: Inverse3Options, checklist: Checklist) -> Grip | None:
    """Return the selected VerseGrip after checks; None if the option is "none".

    Raises:
        RefusedError: There is none or more than one, or it sleeps.
    """
    if options.grip == "none":
        checklist.ok("VerseGrip", "none: no orientation, no buttons")
        return None
    kind = GRIPS[options.grip]
    grips = {grip.device_id: grip for grip in found.grips(kind)}
    checklist.check(
        "VerseGrip", ", ".join(grips) or "none", good=len(grips) == 1,
        remedy=f"there must be one in {kind}: switch it on or pair it, or take the option grip that fits",
    )  # fmt: skip
    checklist.finish()
    (grip,) = grips.values()
    fault = grip_fault(grip, options.grip)
    if fault is not None:
        what, _, remedy = fault.partition(": ")
        checklist.refuse("VerseGrip", what, remedy.removesuffix(", acknowledge"))
    checklist.ok("torque", "none is exerted: the grip is turned and does not turn")
    checklist.finish()
    return grip


def opened_events(options: Inverse3Options, checklist: Checklist) -> Channel:
    """Open the event channel, which is required to detect a brake.

    Raises:
        RefusedError: The channel cannot be opened.
    """
    try:
        events = Channel(options.host, options.event_port)
    except ChannelError as error:
        checklist.refuse("events", str(error), "emergency brake and stall are told there only: is the service 3.5?")
        checklist.finish()
        raise
    checklist.ok("events", f"port {options.event_port}")
    return events


def check_events(events: Channel, options: Inverse3Options, checklist: Checklist) -> None:
    """Check that a new event channel sends events or nothing; the ordinary port sends its state to a new client.

    Raises:
        RefusedError: The channel sends other data, or is lost.
    """
    try:
        if (received := events.peek(0.0)) is not None:
            event(received)
    except (ChannelError, MessageError) as error:
        remedy = "event_port must be that of the events, by default 10020"
        checklist.refuse("events", f"port {options.event_port}: malformed event: {error}", remedy)
        checklist.finish()


def pending_events(events: Channel) -> list[Event]:
    """Return the events that have arrived.

    Raises:
        ChannelError: The channel is lost, or sends other data.
    """
    found: list[Event] = []
    end_s = time.monotonic() + EVENTS_S
    while time.monotonic() < end_s and (received := events.frame(0.0)) is not None:
        if len(found) >= MAX_EVENTS:
            message = f"more than {MAX_EVENTS} events at once"
            raise ChannelError(message)
        try:
            found.append(event(received))
        except MessageError as error:
            message = f"malformed event: {error}"
            raise ChannelError(message) from None
    return found


def _which(device_id: str, names: list[str]) -> str:
    if device_id:
        return f"must have {device_id}, as device_id says: is it on?"
    return "give device_id, one of these" if names else "is it plugged in and on, and seen by the vendor's hub?"


def _check_force_settings(config: dict[str, Any], options: Inverse3Options, checklist: Checklist) -> None:
    filters = _table(config, "filters")
    gate = _table(filters, "force_gate").get("gain") if options.force_gate is None else options.force_gate
    damping = _table(filters, "damping").get("scalar") if options.damping is None else options.damping
    gravity = _table(config, "gravity_compensation")
    scaling = _table(config, "torque_scaling").get("enabled")
    checklist.ok("force gate", f"{_shown(gate)}: the service alters forces by it (option force_gate)")
    checklist.ok("damping", f"{_shown(damping)}: the service adds it to the device's own (option damping)")
    weight = gravity.get("scaling_factor") if gravity.get("enabled") else "off"
    checklist.ok("gravity compensation", f"{_shown(weight)}: added to forces by the service")
    checklist.ok("torque scaling", f"{_shown(scaling)}: where on, a force beyond the motors is scaled, not cut")
    checklist.ok("handedness", _shown(config.get("handedness")))


def _table(config: dict[str, Any], name: str) -> dict[str, Any]:
    found = config.get(name)
    return found if isinstance(found, dict) else {}


def _shown(value: object) -> str:
    return (
        "not stated"
        if value is None
        else {True: "on", False: "off"}.get(value, str(value))
        if isinstance(value, bool)
        else str(value)
    )
