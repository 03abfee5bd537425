"""Options of a UR arm's driver: `[slave.options]` of a scene."""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, TypeAlias

import msgspec
from msgspec import Meta

from haptether.options import check_host, converted, refused
from haptether.slave.ur.kinematics.constraints import ToolCone, WorkspacePlane
from haptether.slave.ur.kinematics.models import MAX_PAYLOAD_KG, UR_MODELS, Six, ur_model

if TYPE_CHECKING:
    from haptether.slave.ur.kinematics.chain import UrCalibration

Three: TypeAlias = tuple[float, float, float]
Four: TypeAlias = tuple[float, float, float, float]
Mode: TypeAlias = Literal["servoj", "servol", "speedl", "direct-torque"]

FARTHEST_M: Final = 10.0
"""Largest length in m in these options; a larger value was meant in millimetres."""
MIN_NORM: Final = 1e-6
MIN_CONE: Final = 0.1
"""Smallest cone in rad; a narrower one leaves no room to brake."""


class UrOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the driver `ur`, in SI units; directions and positions in the controller's base frame."""

    host: str
    """Address or name of the controller."""
    model: str = "ur5e"
    """Model: ur3, ur5, ur10, ur3e, ur5e, ur7e, ur10e, ur12e, ur16e, ur20 or ur30."""
    calibration: str | None = None
    """File with the deltas of this unit; by default the data sheet applies."""
    mode: Mode = "servoj"
    """Motion command of the controller."""
    frequency: Annotated[Literal[125, 500], Meta(extra={"unit": "Hz"})] | None = None
    """Packages per second; by default the controller's rate, 500 Hz or 125 Hz (CB3)."""
    axes: Literal[1, 3] = 1
    """1 for motion along `axis`, 3 for x, y and z of the base."""
    axis: Three = (1.0, 0.0, 0.0)
    """Direction of the one axis, of any length."""
    lookahead_time: Annotated[float, Meta(ge=0.03, le=0.2, extra={"unit": "s"})] = 0.05
    """servoj and servol: lag of the arm behind a moving target in s."""
    gain: Annotated[float, Meta(ge=100.0, le=2000.0, extra={"unit": "1/s²"})] = 1000.0
    """servoj and servol: proportional gain towards the target in 1/s²."""
    position_gain: Annotated[float, Meta(ge=0.5, le=30.0, extra={"unit": "1/s"})] = 10.0
    """speedl: speed per distance from the target in 1/s, limited by the loop delay."""
    joint_stiffness: Annotated[float, Meta(ge=10.0, le=2000.0, extra={"unit": "N m/rad"})] = 300.0
    """direct-torque: stiffness of the three large joints in N m/rad; the wrists have a fifth."""
    joint_damping: Annotated[float, Meta(ge=0.0, le=200.0, extra={"unit": "N m s/rad"})] = 30.0
    """direct-torque: damping of the three large joints in N m s/rad; the wrists have a fifth."""
    torque_share: Annotated[float, Meta(gt=0.0, le=0.8)] = 0.3
    """direct-torque: largest commanded fraction of each joint's torque."""
    max_force: Annotated[float, Meta(gt=0.0, le=300.0, extra={"unit": "N"})] = 50.0
    """direct-torque: largest commanded force in N."""
    max_torque: Annotated[float, Meta(gt=0.0, le=100.0, extra={"unit": "N m"})] = 5.0
    """direct-torque: largest commanded moment about the tool point in N m."""
    payload_kg: Annotated[float, Meta(ge=0.0, le=50.0, extra={"unit": "kg"})] | None = None
    """Mass of everything on the flange; by default as set on the pendant."""
    payload_cog: Three | None = None
    """Centre of gravity in the flange frame in m; requires `payload_kg`."""
    tool: Six | None = None
    """Tool point in the flange frame, x y z rx ry rz in m and rad; by default as set on the pendant."""
    zero_ft_sensor: bool = True
    """True to zero the force sensor before the first motion; the tool must be free then."""
    force_source: Literal["tcp", "raw"] = "tcp"
    """The controller's force at the tool, or the raw flange sensor (e-Series from 5.9 on)."""
    force_filter_hz: Annotated[float, Meta(gt=0.0, le=1000.0, extra={"unit": "Hz"})] | None = 50.0
    """Corner frequency of the force low-pass; None for none."""
    force_deadband_n: Annotated[float, Meta(ge=0.0, le=100.0, extra={"unit": "N"})] = 0.0
    """Force subtracted as noise."""
    max_speed: Annotated[float, Meta(gt=0.0, le=3.0, extra={"unit": "m/s"})] = 0.25
    """Largest commanded tool speed in m/s."""
    max_acceleration: Annotated[float, Meta(gt=0.0, le=20.0, extra={"unit": "m/s²"})] = 5.0
    """Largest commanded acceleration in m/s²."""
    max_angular_speed: Annotated[float, Meta(gt=0.0, le=6.0, extra={"unit": "rad/s"})] = 1.0
    """Largest commanded angular speed of the tool in rad/s."""
    max_angular_acceleration: Annotated[float, Meta(gt=0.0, le=50.0, extra={"unit": "rad/s²"})] = 10.0
    """Largest commanded angular acceleration in rad/s²."""
    stop_deceleration: Annotated[float, Meta(ge=0.1, le=20.0, extra={"unit": "m/s² or rad/s²"})] = 5.0
    """Deceleration of a soft stop: m/s² of the tool (speedl), rad/s² of the joints (others)."""
    max_jump: Annotated[float, Meta(gt=0.0, le=0.1, extra={"unit": "m"})] = 0.005
    """Largest distance of a first command from the tool in m."""
    max_turn: Annotated[float, Meta(gt=0.0, le=0.5, extra={"unit": "rad"})] = 0.05
    """Largest angle of a first orientation from the tool's in rad."""
    workspace: tuple[Four, ...] = ()
    """Planes nx, ny, nz, d: the tool point is commanded to n . p >= d only, n of any length."""
    tool_cone: Four | None = None
    """x, y, z, angle: the tool's z axis is commanded within the angle in rad from that axis, of any length."""
    watchdog_hz: Annotated[float, Meta(ge=5.0, le=100.0, extra={"unit": "Hz"})] = 10.0
    """Rate below which the controller ends the program."""
    verify_watchdog: bool = True
    """True to trip the watchdog once as a test before the first motion."""

    @property
    def axis_unit(self) -> Three:
        """Unit direction of the one axis."""
        length = math.hypot(*self.axis)
        x, y, z = self.axis
        return x / length, y / length, z / length

    @property
    def planes(self) -> tuple[WorkspacePlane, ...]:
        """Planes of `workspace` with unit normals."""
        return tuple(WorkspacePlane.through(*numbers) for numbers in self.workspace)

    @property
    def cone(self) -> ToolCone | None:
        """Cone of `tool_cone` with a unit axis."""
        return None if self.tool_cone is None else ToolCone.around(*self.tool_cone)


def ur_options(given: Mapping[str, Any]) -> UrOptions:
    """Convert the options of a scene; numbers may be given as text.

    Raises:
        ValueError: A key is unknown or missing, or a value is invalid; names the key.
    """
    options = converted(UrOptions, given, "device = ur", {"host": "the address of the controller"})
    _check(options)
    return options


def unit_calibration(options: UrOptions) -> "UrCalibration | None":
    """Return the deltas of `calibration`; None without this option.

    Raises:
        ValueError: The file cannot be read, or is no calibration of this model; names option and file.
    """
    if options.calibration is None:
        return None
    from haptether.slave.ur.kinematics.chain import read_calibration  # noqa: PLC0415  # with numpy

    try:
        return read_calibration(options.calibration, ur_model(options.model))
    except OSError as error:
        why = f"{error.strerror}: must be a calibration.toml with the deltas of this unit"
    except ValueError as error:
        why = str(error).removeprefix(f"{options.calibration}: ")
    raise _wrong("calibration", options.calibration, why)


def _check(options: UrOptions) -> None:
    check_host("device = ur", options.host)
    if options.model.lower() not in UR_MODELS:
        raise _wrong("model", options.model, f"must be one of {', '.join(UR_MODELS)}")
    model = ur_model(options.model)
    if math.hypot(*options.axis) < MIN_NORM:
        raise _wrong("axis", options.axis, "must have a length")
    max_kg = MAX_PAYLOAD_KG[model.name]
    if options.payload_kg is not None and options.payload_kg > max_kg:
        raise _wrong("payload_kg", options.payload_kg, f"must be 0 to {max_kg:g} kg: a {model.name} carries no more")
    if options.payload_cog is not None and options.payload_kg is None:
        raise _wrong("payload_cog", options.payload_cog, "needs payload_kg")
    for key in ("tool", "payload_cog"):
        place = getattr(options, key)
        if place is not None and any(abs(part) > FARTHEST_M for part in place[:3]):
            raise _wrong(key, place, f"must be in m, within {FARTHEST_M:g} m of the flange")
    for plane in options.workspace:
        if math.hypot(*plane[:3]) < MIN_NORM:
            raise _wrong("workspace", plane, "must have a normal of some length")
    if options.tool_cone is not None:
        *axis, half_angle = options.tool_cone
        if math.hypot(*axis) < MIN_NORM or not MIN_CONE <= half_angle < math.pi:
            raise _wrong(
                "tool_cone", options.tool_cone, f"must be an axis of some length and {MIN_CONE:g} to below pi rad"
            )
    if options.force_source == "raw" and not model.wrench.measured:
        raise _wrong("force_source", "raw", f"a {model.name} has no sensor in its flange: must be tcp")


def _wrong(key: str, value: object, why: str) -> ValueError:
    return refused("device = ur", key, value, why)
