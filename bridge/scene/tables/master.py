"""The tables of a scene on the side of the hand: `[master]` and `[operator]`."""

from typing import Annotated, Literal

from msgspec import Meta, Struct, json

from haptether.bridge.scene.tables.ranges import (
    Axis,
    ClutchTimes,
    Duration,
    ForcePerAxis,
    NonNegative,
    NonNegativePerAxis,
    Options,
    PerAxis,
    PositionPerAxis,
    Positive,
    PositivePerAxis,
    Quaternion,
    Reaction,
    Seconds,
    SideKind,
    SpeedPerAxis,
    StopsPerAxis,
    TremorFrequency,
    TriggerCourse,
    Unbounded,
    Vector3,
)

DeviceName = Literal[
    "phantom-desktop", "phantom-omni", "touch", "phantom-premium-1.5", "inverse3", "dynamixel-leader"
]  # fmt: skip


class RotationTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[master.rotation]`: the device as a rigid body. `I dw/dt + w x I w + b w + c w / |w| = tau_device + tau_h`.

    No preset has these numbers: no source that was at hand gives them.

    Source: Euler's equations, Goldstein, Poole and Safko 2002, Eq. 5.39; friction as paper Eq. 3.
    """

    inertia_kg_m2: PositivePerAxis
    """I in kg m² about the axes of the body, above 0."""
    viscous: NonNegative = 0.0
    """b in N m s/rad."""
    coulomb: NonNegative = 0.0
    """c in N m."""
    measures_angular_velocity: bool = True
    """Whether the device measures w itself; else it is estimated from orientations."""
    max_torque_n_m: Positive | Unbounded | None = None
    """Largest |tau| in N m that its motors exert; by default no bound."""


_bit = Annotated[int, Meta(ge=0, le=31)]


class ButtonsTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[master.buttons]`: what the buttons of a driven device do, each by its bit of `MasterSample.buttons`, 0 to 31.

    With this table nothing but a press engages: neither the start nor a signal closes a clutch that a button works. In
    virtual time, where nobody presses, `[operator]` works clutch and gripper all the same.
    """

    clutch: _bit | None = None
    """The clutch: closed while it is held."""
    engage: _bit | None = None
    """The clutch as a switch: a press closes it, the next opens it; it opens by itself where the two sides part."""
    gripper: _bit | None = None
    """The gripper: a press closes it, the next opens it."""


class TriggerTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[master.gripper]`: a trigger that feels like what `[slave.gripper]` holds; without it the finger feels nothing.

    `m A + b V + c sign(V) = F_device + F_finger` along its closing way, and `F_v = -force_scale F_jaws` while
    something stops the jaws. No preset has `travel_m` and `mass_kg`: no source that was at hand gives them.

    Source: paper Eq. 3.
    """

    travel_m: Annotated[float, Meta(gt=0.0, le=1.0)]
    """From open to closed, in m, at the finger."""
    mass_kg: Positive
    """m in kg, at the finger, above 0."""
    viscous: NonNegative = 0.0
    """b in N s/m."""
    coulomb: NonNegative = 0.0
    """c in N."""
    encoder_quantum: NonNegative = 0.0
    """Resolution of its position in m; 0 is exact."""
    force_scale: Annotated[float, Meta(gt=0.0, le=100.0)] = 0.05
    """Finger force per force between the jaws: at 40 N of a gripper the finger feels 2 N."""
    max_force_n: Annotated[float, Meta(gt=0.0, le=50.0)] = 5.0
    """Largest force in N, at most 50."""
    max_slew_n_per_s: Positive = 10.0
    """Largest growth of the force in N/s; unloading is free. Below K_f V of a finger that closes with V, contact does
    not throw the trigger back, which would open the jaws again."""
    max_power_w: Positive = 5.0
    """Largest power in W that it may put into the finger."""


class MasterTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[master]`: the haptic device. `m A + b V + c sign(V) = F_device + F_h`.

    A field without a default has that of the preset that `device` names; without one, `mass_kg` must be given and
    the others are as said.

    Source: paper Eq. 3.
    """

    device: DeviceName | None = None
    """Preset of `haptether.master.DEVICE_PRESETS` that fills in what this table leaves out."""
    kind: SideKind | None = None
    """What the coordinates are: "linear" (1 to 3 axes), "joints" (1 to 7) or "pose" (3 axes and an orientation); by
    default "linear" up to 3 axes, else "joints"."""
    axes: Axis = 1
    """Number of axes: 1 to 7."""
    mass_kg: PositivePerAxis | None = None
    """m in kg, above 0."""
    viscous: PerAxis | None = None
    """b in N s/m, of any sign; without a preset 0."""
    coulomb: NonNegativePerAxis | None = None
    """c in N, 0 or more; without a preset 0."""
    friction: Literal["vector", "axis"] | None = None
    """`c V / |V|` along the motion (a stylus) or `c sign(V)` on each axis (joints); without a preset "vector"."""
    encoder_quantum: NonNegative | None = None
    """Resolution of the position in m; 0 is exact, also without a preset."""
    measures_velocity: bool | None = None
    """Whether the device measures V itself; by default where the position is exact."""
    max_force_n: Positive | Unbounded | None = None
    """Largest |F| in N that its motors exert; "unbounded" and, without a preset, nothing: no bound."""
    force_quantum_n: NonNegative = 0.0
    """Resolution of its force in N; 0 is exact."""
    stops: StopsPerAxis | None = None
    """Lower and upper mechanical stop in m, or one such pair per axis; none by default."""
    speed_bound: Positive | None = None
    """Speed in m/s (rad/s) that it cannot exceed: a step of its position that is faster, and stays, is a fault. Without
    a preset and a driver that has one, 20 m/s, of joints 60 rad/s."""
    position: PositionPerAxis | None = None
    """Where it starts, in m; by default where the hand's path begins, without a hand 0."""
    velocity: SpeedPerAxis = 0.0
    """V at the start, in m/s."""
    rotation: RotationTable | None = None
    """Its rotation; kind = "pose" needs it."""
    buttons: ButtonsTable | None = None
    """What the buttons of a driver's device do; by default nothing."""
    gripper: TriggerTable | None = None
    """Its trigger, where the finger feels what the gripper holds; by default it feels nothing."""
    driver: str | None = None
    """Live only: drives a real device, by the name of an entry point of `haptether.masters`; this table then says what
    the safety layer takes the device for. By default a model of this table is held by the operator."""
    options: Options = {}
    """Live only: what the driver is called with; nothing without one."""

    def __hash__(self) -> int:
        # Options are a table of any keys, which has no hash of its own.
        return hash(json.encode(self))


class SeriesTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """A recording: `file`, whose first record is time 0, or `time_s` and `values`.

    Linear between its points, constant outside.
    """

    file: str | None = None
    """CSV with the header `time_s,x[,y,z,...]` or .npz with the arrays `time_s` and `values`; relative to the scene. It
    begins at its first record."""
    time_s: tuple[Seconds, ...] | None = None
    """Times in s, increasing."""
    values: tuple[ForcePerAxis, ...] | None = None
    """One value, or a list of one per axis, for each time: m of a path, N of a push."""


class LegTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[[operator.legs]]`: one leg of the hand's path. The hand rests after the last."""

    duration_s: Duration
    """Time in s that it takes, at least 1e-9."""
    end: PositionPerAxis
    """Where it ends, in m."""
    shape: Literal["linear", "smooth", "minimum-jerk"] = "minimum-jerk"
    """Share of the path at share s of the time: s, `3 s² - 2 s³` or `10 s³ - 15 s⁴ + 6 s⁵` (Flash and Hogan 1985)."""


class ReleaseTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[operator.release]`: the hand lets go."""

    at_s: Seconds
    """When it begins, in s; counted from engagement where there is an arm."""
    decay_s: Seconds = 0.05
    """Time in s within which nothing is left; 0 is at once."""
    kind: Literal["strength", "gain"] = "strength"
    """What decays: the grip strength, so that nothing moves before it has fallen to the load, or the impedance."""


class RegraspTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[operator.regrasp]`: the hand takes hold again after the release."""

    reaction_s: Seconds = 0.3
    """From the end of the release to the first grip, in s."""
    rise_s: Seconds = 0.1
    """From there to the full grip, in s."""


class RotationLegTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[[operator.rotation.legs]]`: one turn of the hand, about a fixed axis, the shorter way."""

    duration_s: Duration
    """Time in s that it takes, at least 1e-9."""
    turn: Vector3 | None = None
    """By how much it turns: axis times angle in rad, in the base frame, shorter than pi."""
    end_wxyz: Quaternion | None = None
    """The orientation where it ends, instead of `turn`."""
    shape: Literal["linear", "smooth", "minimum-jerk"] = "minimum-jerk"
    """As of `[[operator.legs]]`."""


class OperatorRotationTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[operator.rotation]`: the hand turns the device. `tau_h = K_h log(R_target R^T) - B_h w`, up to its strength."""

    stiffness: NonNegative = 2.0
    """K_h in N m/rad."""
    damping: NonNegative = 0.02
    """B_h in N m s/rad."""
    strength_n_m: NonNegative | None = None
    """Grip strength in N m; no bound by default."""
    start_wxyz: Quaternion = (1.0, 0.0, 0.0, 0.0)
    """The orientation where it begins."""
    legs: tuple[RotationLegTable, ...] = ()
    """How it turns, leg by leg; by default it keeps its orientation."""
    release: ReleaseTable | None = None
    """When it lets go; never by default."""


class FingerTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[operator.finger]`: the finger at the trigger of `[master.gripper]`, which means to be where `trigger` says.

    `F_finger = K_f (travel p - x) - B_f V`, at most its strength.

    Source: Hogan 1989 (impedance).
    """

    stiffness: NonNegative = 300.0
    """K_f in N/m."""
    damping: NonNegative = 3.0
    """B_f in N s/m."""
    strength_n: NonNegative | None = None
    """Its strength in N; no bound by default."""
    release: ReleaseTable | None = None
    """When it lets go of the trigger; never by default."""


class TremorTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[operator.tremor]`: `a sin(2 pi f t)` on the path, on every axis."""

    amplitude: NonNegative = 1e-4
    """a in m."""
    frequency_hz: TremorFrequency = 10.0
    """f in Hz, up to 100; physiological tremor lies at 8 to 12 Hz."""


class OperatorTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[operator]`: the hand. `F_h = K_h (target - x) - B_h V`, at most its grip strength.

    Source: Hogan 1989 (impedance); Johansson and Westling 1984 (grip).
    """

    stiffness: NonNegative = 300.0
    """K_h in N/m."""
    damping: NonNegative = 5.0
    """B_h in N s/m."""
    grip_strength_n: NonNegative | None = None
    """Grip strength in N; no bound by default."""
    start: PositionPerAxis = 0.0
    """Where the path begins, in m."""
    legs: tuple[LegTable, ...] = ()
    """The path, leg by leg; by default the hand stays at `start`."""
    recorded: SeriesTable | None = None
    """A recorded path in m instead of legs."""
    release: ReleaseTable | None = None
    """When it lets go; never by default."""
    regrasp: RegraspTable | None = None
    """How it takes hold again; never by default."""
    tremor: TremorTable | None = None
    """Tremor; none by default."""
    clutch: Literal["auto", "once"] | ClutchTimes = "auto"
    """The clutch, with a [slave]: "auto" is pressed at the start, and let go and pressed again after each hold; "once"
    only at the start; or pairs of press and release times in s since the start."""
    clutch_reaction_s: Reaction = 0.5
    """From when both sides are ready after a hold to the new press of "auto", in s, 0.05 to 60."""
    rotation: OperatorRotationTable | None = None
    """How the hand turns a device of kind "pose"; by default nobody does."""
    finger: FingerTable | None = None
    """The finger at the trigger of `[master.gripper]`."""
    trigger: TriggerCourse = ()
    """What leads the gripper of `[slave.gripper]`: pairs of time in s since engagement and position, 0 (open) to 1
    (closed), with straight lines between; by default it stays open."""
