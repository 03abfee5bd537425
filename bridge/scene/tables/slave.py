"""Scene tables of the robot's side: `[slave]` and `[environment]`."""

from typing import Annotated, Literal, TypeAlias

from msgspec import Meta, Struct, json

from haptether.bridge.scene.tables.master import SeriesTable
from haptether.bridge.scene.tables.ranges import (
    Acceleration,
    Duration,
    ForcePerAxis,
    NonNegative,
    Number,
    Opening,
    Options,
    PerAxis,
    Position,
    PositionPerAxis,
    Positive,
    PositivePerAxis,
    Quaternion,
    SampleRate,
    Seconds,
    SideKind,
    SpeedPerAxis,
    Unbounded,
    Vector3,
)

SIMULATED = "simulated"
"""Name of the simulated arm."""


class ForceSensorTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[slave.force_sensor]`: sensor between the tool force and the force that is sent back."""

    noise_n: NonNegative = 0.0
    """Noise standard deviation in N."""
    bias_n: ForcePerAxis = 0.0
    """Offset in N."""
    quantum_n: NonNegative = 0.0
    """Resolution in N; 0 is exact."""
    rate_hz: SampleRate | None = None
    """Samples per second, 1e-3 to 1e6; by default one per tick."""


class GripperTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[slave.gripper]`: follows the master's trigger while the sides are coupled; otherwise keeps its grip."""

    position: Opening = 0.0
    """Start position, 0 (open) to 1 (closed)."""
    speed: Annotated[float, Meta(gt=0.0, le=100.0)] = 1.8
    """Largest jaw speed in 1/s; 1.8 is 150 mm/s for 85 mm."""
    force_n: Annotated[float, Meta(ge=0.0, le=10_000.0)] = 40.0
    """Closing force in N."""
    object: Opening | None = None
    """Jaw position at which a simulated gripper meets a rigid object; by default there is none."""
    device: str = SIMULATED
    """Live only: driver of a real gripper, an entry point of `haptether.grippers`, such as "robotiq". By default, and
    in virtual time, the gripper is the model of this table.
    """
    options: Options = {}
    """Live only: keyword arguments of the driver."""

    def __hash__(self) -> int:
        # The options table may hold any keys and is not hashable.
        return hash(json.encode(self))


Metres = Annotated[float, Meta(gt=0.0, le=1000.0)]
_point = Annotated[tuple[Position, ...], Meta(min_length=3, max_length=3)]


class ToolTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[slave.tool]`: tool as a rigid body; its point has the mass, stiffness and damping of the arm.

    `I w' + w x I w = k_r log(R_set R^T) + b_r (w_set - w) + tau_e`

    Source: Euler's equations, Goldstein, Poole and Safko 2002, Eq. 5.39; Hogan 1985 (impedance).
    """

    inertia_kg_m2: PositivePerAxis
    """I in kg m² about the axes of the tool, through the tool point."""
    rotational_stiffness: NonNegative
    """k_r in N m/rad."""
    rotational_damping: NonNegative | None = None
    """b_r in N m s/rad; by default critical for the smallest inertia, `2 sqrt(k_r I)`."""
    max_angular_speed: Positive | Unbounded = 2.5
    """Largest angular speed of the set orientation in rad/s, or "unbounded"."""
    quat_wxyz: Quaternion = (1.0, 0.0, 0.0, 0.0)
    """Initial orientation."""
    points: tuple[_point, ...] = ((0.0, 0.0, 0.0),)
    """Contact points in m in the tool frame; by default the tool point."""
    jaw_width_m: Metres = 0.085
    """Distance between the open gripper jaws along the tool's x axis, in m."""
    jaw_friction: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.5
    """Coefficient of friction at the jaws."""
    jaw_stiffness: Positive = 1e4
    """Contact stiffness of the jaws in N/m."""
    jaw_radius_m: Metres = 0.01
    """Radius in m of a jaw pad, at which friction resists moments."""


class SlaveTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[slave]`: arm. Without this table the environment is rendered on the device itself."""

    control: Literal["position", "velocity", "pd"] = "position"
    """"position" tracks as a critically damped second-order system, "velocity" as a first-order system, "pd" by `M x''
    = K_s (x_set - x) + B_s (V_set - V) + F_e`.
    """
    mass_kg: Positive = 4.0
    """M in kg."""
    bandwidth_hz: Positive = 15.0
    """Bandwidth of position or velocity control in Hz."""
    stiffness: Positive | None = None
    """K_s in N/m; required for "pd", not allowed otherwise."""
    damping: NonNegative | None = None
    """B_s in N s/m, for "pd" only; by default critical, `2 sqrt(K_s M)`."""
    max_speed: Positive | Unbounded = 1.0
    """Largest speed of the set position in m/s, or "unbounded"; a UR moves at 1 m/s."""
    max_acceleration: Acceleration | None = None
    """Acceleration bound in m/s², at least 1e-6; by default none."""
    takes_force: bool = False
    """True if the arm takes the force of the coupling, `M x'' = F_c - b V + F_e`, in place of a virtual tool. Between
    forces it follows a position by `control`, "position" or "pd". A live driver must take forces too.
    """
    viscous: NonNegative = 0.0
    """b in N s/m, friction that an arm that takes forces does not compensate."""
    max_force_n: Positive | None = None
    """Largest force in N (N m for joints) of the coupling on an arm that takes forces; by default 50, or that of its
    driver if it is smaller.
    """
    max_torque_nm: Positive | None = None
    """Largest torque in N m of the same for kind "pose"; by default 5, or that of its driver."""
    speed_bound: Positive | None = None
    """Speed limit of the arm in m/s (rad/s); a faster, persistent step of its position is a fault. Without a driver
    value, 20 m/s, or 60 rad/s for joints.
    """
    period_s: Annotated[float, Meta(ge=1e-5, le=2e-2)] | None = None
    """Loop period in s, 10 us to 20 ms; by default that of the master."""
    position: PositionPerAxis | None = None
    """Start position in m; by default that of the master."""
    force_sensor: ForceSensorTable | None = None
    """Force sensor; by default the force is exact."""
    kind: SideKind | None = None
    """Kind of coordinates; must be that of the master, because no map between kinds exists yet."""
    gripper: GripperTable | None = None
    """Gripper; by default none."""
    tool: ToolTable | None = None
    """Tool that turns; required for kind = "pose"."""
    device: str = SIMULATED
    """Live only: driver of a real arm, an entry point of `haptether.slaves`, such as "ur". By default, and in virtual
    time, the arm is the model of this table.
    """
    options: Options = {}
    """Live only: keyword arguments of the driver."""

    def __hash__(self) -> int:
        # The options table may hold any keys and is not hashable.
        return hash(json.encode(self))


class Plane(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="plane"):
    """Half space behind a plane, opposite to its normal."""

    point: PositionPerAxis = 0.0
    """Point on the plane in m."""
    normal: PerAxis | None = None
    """Outward normal of any length; by default +x."""


class Sphere(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="sphere"):
    """Sphere."""

    centre: PositionPerAxis = 0.0
    """Centre in m."""
    radius: Positive
    """Radius in m."""


class Box(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="box"):
    """Box aligned with the axes."""

    centre: PositionPerAxis = 0.0
    """Centre in m."""
    half_extents: PositivePerAxis
    """Half of its size in m."""


class Spring(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="spring"):
    """Spring that pushes and pulls everywhere: `F = K (anchor - x) - B V`.

    Source: paper Eq. 15, without its surface.
    """

    anchor: PositionPerAxis = 0.0
    """Anchor in m."""


Shape: TypeAlias = Plane | Sphere | Box | Spring


class ContactTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[environment.objects.contact]`: contact force of an object at depth d."""

    law: Literal["kelvin-voigt", "hunt-crossley"] = "kelvin-voigt"
    """`max(0, K d + B d')` or `max(0, K d^n (1 + chi d'))`.
    Source of kelvin-voigt: paper Eq. 15. Source of hunt-crossley: Hunt and Crossley 1975.
    """
    stiffness: NonNegative
    """K in N/m; for Hunt and Crossley in N/m^n."""
    damping: NonNegative = 0.0
    """B in N s/m; for Hunt and Crossley chi in s/m."""
    exponent: Annotated[float, Meta(ge=1.0, le=5.0)] | None = None
    """n, for Hunt and Crossley only; by default 1.5, a ball on a plane (Hertz)."""
    friction: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.0
    """Coefficient of Coulomb friction along the surface; requires two axes."""


class MotionTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[environment.objects.motion]`: constant velocity for an interval, plus a sine."""

    velocity: SpeedPerAxis = 0.0
    """Velocity in m/s."""
    from_s: Seconds = 0.0
    """Start of the velocity in s."""
    until_s: Seconds | None = None
    """End of the velocity in s; by default the end of the run."""
    amplitude: PositionPerAxis = 0.0
    """Amplitude of the sine in m."""
    frequency_hz: NonNegative = 0.0
    """Frequency of the sine in Hz."""


class BodyTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[environment.objects.body]`: object that slides freely on the ground."""

    mass_kg: Positive
    """Mass in kg."""
    viscous: NonNegative = 0.0
    """Viscous friction with the ground in N s/m."""
    coulomb: NonNegative = 0.0
    """Coulomb friction with the ground in N."""
    velocity: SpeedPerAxis = 0.0
    """V at the start in m/s."""


class ObjectTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[[environment.objects]]`: object that can be touched."""

    shape: Shape = Plane()
    """`kind` "plane", "sphere", "box" or "spring" with its numbers; by default a wall that fills x < 0."""
    contact: ContactTable
    """Contact force."""
    motion: MotionTable | None = None
    """Prescribed motion; by default the object stands still."""
    body: BodyTable | None = None
    """Mass; by default the object does not move."""


class PusherTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[[environment.pushers]]`: independent force on the arm or, without one, rendered on the device."""

    shape: Literal["step", "ramp", "half-sine", "sine", "recorded"] = "step"
    """Step; ramp that stays; `F sin(pi t / duration)`; `F sin(2 pi f t)`; recorded."""
    at_s: Seconds = 0.0
    """Start in s since engagement, or since the start of the run without an arm."""
    duration_s: Duration | None = None
    """Duration in s; required for "half-sine". By default to the end of the run or of the recording."""
    rise_s: Seconds | None = None
    """Rise time of a ramp in s; required for "ramp"."""
    frequency_hz: Positive | None = None
    """f in Hz; required for "sine"."""
    force_n: ForcePerAxis | None = None
    """F in N; required except for "recorded"."""
    recorded: SeriesTable | None = None
    """Recorded force in N; required for "recorded"."""


class HoleTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[[environment.holes]]`: round hole in a half space, in contact with the tool points of kind "pose"."""

    entrance: _point
    """Centre of the entrance in m."""
    axis: Vector3 = (0.0, 0.0, 1.0)
    """Axis out of the material, of any length but 0."""
    radius: Metres
    """Radius in m."""
    depth: Metres
    """Depth in m."""
    chamfer_m: Annotated[float, Meta(ge=0.0, le=1000.0)] = 0.0
    """Height in m of a 45 degree chamfer."""
    contact: ContactTable
    """Contact force."""


class HandleTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[[environment.handles]]`: valve, crank or door that turns about one axis while the tool holds it.

    `J theta'' = -b theta' - c sign(theta') - k theta + tau`. A tool without a gripper holds it from engagement on if it
    is in reach; a tool with a gripper holds it while the jaws press.
    """

    point: _point
    """Point on the axis in m."""
    axis: Vector3
    """Axis, of any length but 0."""
    grip: _point
    """Grip point at angle 0, in m."""
    reach_m: Metres = 0.03
    """Largest distance in m from the tool point at which the tool can hold it."""
    width_m: Annotated[float, Meta(ge=0.0, le=1000.0)] = 0.02
    """Width between the jaws in m."""
    inertia_kg_m2: Positive
    """J in kg m² about its axis."""
    viscous: NonNegative = 0.0
    """b in N m s/rad."""
    coulomb: NonNegative = 0.0
    """c in N m, at full value above 0.01 rad/s."""
    stiffness: NonNegative = 0.0
    """k in N m/rad of a spring that returns it to 0."""
    stops_rad: Annotated[tuple[Number, ...], Meta(min_length=2, max_length=2)] = (-1e9, 1e9)
    """Lower and upper stop in rad; by default out of reach."""
    hold_stiffness: Positive = 1e4
    """Stiffness of the hold in N/m."""
    hold_rotational_stiffness: NonNegative = 50.0
    """Rotational stiffness of the hold in N m/rad."""


class RigidBodyTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[[environment.bodies]]`: box of uniform density that rests on objects and that jaws can hold."""

    mass_kg: Positive
    """Mass in kg."""
    half_extents: Annotated[tuple[Metres, ...], Meta(min_length=3, max_length=3)]
    """Half of its size in m."""
    position: _point
    """Initial centre in m."""
    quat_wxyz: Quaternion = (1.0, 0.0, 0.0, 0.0)
    """Initial orientation."""
    gravity: Annotated[float, Meta(ge=0.0, le=100.0)] = 9.81
    """Gravity along -z, in m/s²."""


class TorqueTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[[environment.torques]]`: independent torque on the tool of kind "pose"."""

    shape: Literal["step", "ramp", "half-sine", "sine"] = "step"
    """Step; ramp that stays; `tau sin(pi t / duration)`; `tau sin(2 pi f t)`."""
    at_s: Seconds = 0.0
    """Start in s since engagement."""
    duration_s: Duration | None = None
    """Duration in s; required for "half-sine". By default to the end of the run."""
    rise_s: Seconds | None = None
    """Rise time of a ramp in s; required for "ramp"."""
    frequency_hz: Positive | None = None
    """f in Hz; required for "sine"."""
    torque_n_m: ForcePerAxis
    """tau in N m, in the base frame."""


class EnvironmentTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[environment]`: objects and pushes."""

    rendering: Literal["sampled", "continuous"] = "sampled"
    """Action on a device without an arm: "sampled" holds the force over each tick, as hardware does; "continuous" does
    not.
    """
    delay_ticks: Annotated[int, Meta(ge=0, le=100_000)] = 0
    """Delay of its force in ticks; only for "sampled" without an arm."""
    objects: tuple[ObjectTable, ...] = ()
    """Objects that can be touched."""
    pushers: tuple[PusherTable, ...] = ()
    """Independent forces."""
    torques: tuple[TorqueTable, ...] = ()
    """Independent torques on a tool of kind "pose"."""
    holes: tuple[HoleTable, ...] = ()
    """Holes for a tool of kind "pose"."""
    handles: tuple[HandleTable, ...] = ()
    """Handles of doors and valves, for a tool of kind "pose"."""
    bodies: tuple[RigidBodyTable, ...] = ()
    """Bodies that the gripper of a tool of kind "pose" can hold."""
