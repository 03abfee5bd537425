"""The tables of a scene on the side of the robot: `[slave]` and `[environment]`."""

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
"""The arm that is a model."""


class ForceSensorTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[slave.force_sensor]`: what stands between the force on the tool and what is sent back."""

    noise_n: NonNegative = 0.0
    """Standard deviation in N."""
    bias_n: ForcePerAxis = 0.0
    """Offset in N."""
    quantum_n: NonNegative = 0.0
    """Resolution in N; 0 is exact."""
    rate_hz: SampleRate | None = None
    """Samples per second, 1e-3 to 1e6; by default one at each tick."""


class GripperTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[slave.gripper]`: follows the trigger of the master while the two sides are coupled, and else keeps its grip."""

    position: Opening = 0.0
    """Where it starts, 0 (open) to 1 (closed)."""
    speed: Annotated[float, Meta(gt=0.0, le=100.0)] = 1.8
    """Fastest motion of the jaws in 1/s; 1.8 is 150 mm/s of 85 mm."""
    force_n: Annotated[float, Meta(ge=0.0, le=10_000.0)] = 40.0
    """With which it closes on what is in between, in N."""
    object: Opening | None = None
    """Where the jaws of a model meet something rigid; by default nothing is in between."""
    device: str = SIMULATED
    """Live only: drives a real gripper, by the name of an entry point of `haptether.grippers`, such as "robotiq"; by
    default, and in virtual time, it is the model that the rest of this table describes."""
    options: Options = {}
    """Live only: what the driver is called with; nothing without one."""

    def __hash__(self) -> int:
        # Options are a table of any keys, which has no hash of its own.
        return hash(json.encode(self))


Metres = Annotated[float, Meta(gt=0.0, le=1000.0)]
_point = Annotated[tuple[Position, ...], Meta(min_length=3, max_length=3)]


class ToolTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[slave.tool]`: the arm's tool as a rigid body, whose point has the mass, stiffness and damping of the arm.

    `I w' + w x I w = k_r log(R_set R^T) + b_r (w_set - w) + tau_e`

    Source: Euler's equations, Goldstein, Poole and Safko 2002, Eq. 5.39; Hogan 1985 (impedance).
    """

    inertia_kg_m2: PositivePerAxis
    """I in kg m² about the axes of the tool, through the tool point."""
    rotational_stiffness: NonNegative
    """k_r in N m/rad."""
    rotational_damping: NonNegative | None = None
    """b_r in N m s/rad; by default critical for the least inertia, `2 sqrt(k_r I)`."""
    max_angular_speed: Positive | Unbounded = 2.5
    """Fastest that the set orientation turns, in rad/s, or "unbounded"."""
    quat_wxyz: Quaternion = (1.0, 0.0, 0.0, 0.0)
    """How it is turned at the start."""
    points: tuple[_point, ...] = ((0.0, 0.0, 0.0),)
    """Points of it that touch, in m in its own frame; by default the tool point."""
    jaw_width_m: Metres = 0.085
    """Between the open jaws of its gripper, along its x axis, in m."""
    jaw_friction: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.5
    """Coefficient of friction at the jaws."""
    jaw_stiffness: Positive = 1e4
    """How the jaws hold, in N/m."""
    jaw_radius_m: Metres = 0.01
    """Radius in m of a jaw's pad, at which friction withstands moments."""


class SlaveTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[slave]`: the arm. Without this table the environment is rendered on the device itself."""

    control: Literal["position", "velocity", "pd"] = "position"
    """Tracks positions as a critically damped second-order system, velocities as a first-order system, or pulls with
    `M x'' = K_s (x_set - x) + B_s (V_set - V) + F_e`."""
    mass_kg: Positive = 4.0
    """M in kg."""
    bandwidth_hz: Positive = 15.0
    """Bandwidth in Hz of position or velocity control."""
    stiffness: Positive | None = None
    """K_s in N/m: of "pd", which needs it, and of nothing else."""
    damping: NonNegative | None = None
    """B_s in N s/m, of "pd" only; by default critical, `2 sqrt(K_s M)`."""
    max_speed: Positive | Unbounded = 1.0
    """Fastest that the set position moves, in m/s, or "unbounded"; a UR moves at 1 m/s."""
    max_acceleration: Acceleration | None = None
    """Bound on its acceleration in m/s², at least 1e-6; none by default."""
    speed_bound: Positive | None = None
    """Speed in m/s (rad/s) that it cannot exceed: a step of its position that is faster, and stays, is a fault. Without
    a driver that has one, 20 m/s, of joints 60 rad/s."""
    period_s: Annotated[float, Meta(ge=1e-5, le=2e-2)] | None = None
    """Period of its loop in s, 10 us to 20 ms; by default that of the master."""
    position: PositionPerAxis | None = None
    """Where it starts, in m; by default where the master does."""
    force_sensor: ForceSensorTable | None = None
    """Its force sensor; by default the force is exact."""
    kind: SideKind | None = None
    """What its coordinates are; that of the master, since no map leads from one kind to another yet."""
    gripper: GripperTable | None = None
    """Its gripper; none by default."""
    tool: ToolTable | None = None
    """The tool that it turns; kind = "pose" needs it."""
    device: str = SIMULATED
    """Live only: drives a real arm, by the name of an entry point of `haptether.slaves`, such as "ur"; by default, and
    in virtual time, the arm is the model that the rest of this table describes."""
    options: Options = {}
    """Live only: what the driver is called with; nothing without one."""

    def __hash__(self) -> int:
        # Options are a table of any keys, which has no hash of its own.
        return hash(json.encode(self))


class Plane(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="plane"):
    """Fills the side of a plane that its normal points away from."""

    point: PositionPerAxis = 0.0
    """A point on it, in m."""
    normal: PerAxis | None = None
    """Outward normal of any length; by default along +x."""


class Sphere(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="sphere"):
    """A ball."""

    centre: PositionPerAxis = 0.0
    """In m."""
    radius: Positive
    """In m."""


class Box(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="box"):
    """A box along the axes."""

    centre: PositionPerAxis = 0.0
    """In m."""
    half_extents: PositivePerAxis
    """Half of its size in m."""


class Spring(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="spring"):
    """Pushes and pulls everywhere: `F = K (anchor - x) - B V`."""

    anchor: PositionPerAxis = 0.0
    """In m."""


Shape: TypeAlias = Plane | Sphere | Box | Spring


class ContactTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[environment.objects.contact]`: how an object resists, d deep.

    Source: Hunt and Crossley 1975; paper Eq. 15 is Kelvin and Voigt.
    """

    law: Literal["kelvin-voigt", "hunt-crossley"] = "kelvin-voigt"
    """`max(0, K d + B d')` or `max(0, K d^n (1 + chi d'))`."""
    stiffness: NonNegative
    """K in N/m, of Hunt and Crossley in N/m^n."""
    damping: NonNegative = 0.0
    """B in N s/m, of Hunt and Crossley chi in s/m."""
    exponent: Annotated[float, Meta(ge=1.0, le=5.0)] | None = None
    """n, of Hunt and Crossley only; by default 1.5, that of a ball on a plane (Hertz)."""
    friction: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.0
    """Coefficient of Coulomb friction along the surface; needs two axes."""


class MotionTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[environment.objects.motion]`: a constant velocity for a while, and a sine on top."""

    velocity: SpeedPerAxis = 0.0
    """In m/s."""
    from_s: Seconds = 0.0
    """When the velocity begins, in s."""
    until_s: Seconds | None = None
    """When it ends, in s; by default with the run."""
    amplitude: PositionPerAxis = 0.0
    """Amplitude in m of the sine."""
    frequency_hz: NonNegative = 0.0
    """Its frequency in Hz."""


class BodyTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[environment.objects.body]`: the object slides freely on the ground."""

    mass_kg: Positive
    """In kg."""
    viscous: NonNegative = 0.0
    """Viscous friction with the ground in N s/m."""
    coulomb: NonNegative = 0.0
    """Coulomb friction with the ground in N."""
    velocity: SpeedPerAxis = 0.0
    """V at the start, in m/s."""


class ObjectTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[[environment.objects]]`: something that is touched."""

    shape: Shape = Plane()
    """`kind` "plane", "sphere", "box" or "spring" with its numbers; by default the wall that fills x < 0."""
    contact: ContactTable
    """How it resists."""
    motion: MotionTable | None = None
    """How it moves on its own; by default it stands."""
    body: BodyTable | None = None
    """Its mass; by default it does not move."""


class PusherTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[[environment.pushers]]`: a force of its own, on the arm or, without one, rendered on the device."""

    shape: Literal["step", "ramp", "half-sine", "sine", "recorded"] = "step"
    """At once; rising linearly and staying; `F sin(pi t / duration)`; `F sin(2 pi f t)`; as recorded."""
    at_s: Seconds = 0.0
    """When it begins, in s since engagement; since the start without an arm."""
    duration_s: Duration | None = None
    """How long it lasts, in s; "half-sine" needs it. By default to the end of the run or of the recording."""
    rise_s: Seconds | None = None
    """Time in s in which a ramp rises; "ramp" needs it."""
    frequency_hz: Positive | None = None
    """f in Hz; "sine" needs it."""
    force_n: ForcePerAxis | None = None
    """F in N; all but "recorded" need it."""
    recorded: SeriesTable | None = None
    """The recording in N; "recorded" needs it."""


class HoleTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[[environment.holes]]`: a round hole in a half space, which touches the points of a tool of kind "pose"."""

    entrance: _point
    """Middle of its entrance, in m."""
    axis: Vector3 = (0.0, 0.0, 1.0)
    """Its axis, out of the material, of any length but 0."""
    radius: Metres
    """In m."""
    depth: Metres
    """In m."""
    chamfer_m: Annotated[float, Meta(ge=0.0, le=1000.0)] = 0.0
    """Height in m of a chamfer of 45 degrees."""
    contact: ContactTable
    """How it resists."""


class HandleTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[[environment.handles]]`: a valve, a crank or a door, which turns about one axis while the tool holds it.

    `J theta'' = -b theta' - c sign(theta') - k theta + tau`. A tool without a gripper holds it from the engagement on,
    if it is in reach; one with a gripper while the jaws press.
    """

    point: _point
    """A point on its axis, in m."""
    axis: Vector3
    """Its axis, of any length but 0."""
    grip: _point
    """Where it is gripped while its angle is 0, in m."""
    reach_m: Metres = 0.03
    """How near in m the tool point must be to hold it."""
    width_m: Annotated[float, Meta(ge=0.0, le=1000.0)] = 0.02
    """Its width in m between the jaws."""
    inertia_kg_m2: Positive
    """J in kg m² about its axis."""
    viscous: NonNegative = 0.0
    """b in N m s/rad."""
    coulomb: NonNegative = 0.0
    """c in N m, in full above 0.01 rad/s."""
    stiffness: NonNegative = 0.0
    """k in N m/rad of a spring that turns it back to 0."""
    stops_rad: Annotated[tuple[Number, ...], Meta(min_length=2, max_length=2)] = (-1e9, 1e9)
    """Lower and upper stop in rad; by default none that is reached."""
    hold_stiffness: Positive = 1e4
    """How it is held, in N/m."""
    hold_rotational_stiffness: NonNegative = 50.0
    """And in N m/rad."""


class RigidBodyTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[[environment.bodies]]`: a box of even density that lies on what is touched, and that jaws can hold."""

    mass_kg: Positive
    """In kg."""
    half_extents: Annotated[tuple[Metres, ...], Meta(min_length=3, max_length=3)]
    """Half of its size in m."""
    position: _point
    """Where its middle begins, in m."""
    quat_wxyz: Quaternion = (1.0, 0.0, 0.0, 0.0)
    """How it is turned at the start."""
    gravity: Annotated[float, Meta(ge=0.0, le=100.0)] = 9.81
    """Gravity along -z, in m/s²."""


class TorqueTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[[environment.torques]]`: a torque of its own on the tool of kind "pose"."""

    shape: Literal["step", "ramp", "half-sine", "sine"] = "step"
    """At once; rising linearly and staying; `tau sin(pi t / duration)`; `tau sin(2 pi f t)`."""
    at_s: Seconds = 0.0
    """When it begins, in s since engagement."""
    duration_s: Duration | None = None
    """How long it lasts, in s; "half-sine" needs it. By default to the end of the run."""
    rise_s: Seconds | None = None
    """Time in s in which a ramp rises; "ramp" needs it."""
    frequency_hz: Positive | None = None
    """f in Hz; "sine" needs it."""
    torque_n_m: ForcePerAxis
    """tau in N m, in the base frame."""


class EnvironmentTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[environment]`: what is touched and what pushes."""

    rendering: Literal["sampled", "continuous"] = "sampled"
    """How it acts on a device without an arm between: held over each tick, as hardware does, or at every instant."""
    delay_ticks: Annotated[int, Meta(ge=0, le=100_000)] = 0
    """Ticks by which its force is late; only sampled and without an arm."""
    objects: tuple[ObjectTable, ...] = ()
    """What is touched."""
    pushers: tuple[PusherTable, ...] = ()
    """What pushes by itself."""
    torques: tuple[TorqueTable, ...] = ()
    """What turns a tool of kind "pose" by itself."""
    holes: tuple[HoleTable, ...] = ()
    """Holes in what is touched, for a tool of kind "pose"."""
    handles: tuple[HandleTable, ...] = ()
    """Handles of doors and valves, for a tool of kind "pose"."""
    bodies: tuple[RigidBodyTable, ...] = ()
    """Bodies that the gripper of a tool of kind "pose" can hold."""
