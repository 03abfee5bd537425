"""Scene tables of the operator's side: `[master]` and `[operator]`."""

from typing import Annotated, Literal

from msgspec import Meta, Struct, json

from haptether.bridge.scene.tables.ranges import (
    AimDamping,
    AimStiffness,
    AimStrength,
    AimTarget,
    AimTime,
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

    No preset has these values, because no available source gives them.

    Source: Euler's equations, Goldstein, Poole and Safko 2002, Eq. 5.39; friction as paper Eq. 3.
    """

    inertia_kg_m2: PositivePerAxis
    """I in kg m² about the axes of the body, above 0."""
    viscous: NonNegative = 0.0
    """b in N m s/rad."""
    coulomb: NonNegative = 0.0
    """c in N m."""
    measures_angular_velocity: bool = True
    """True if the device measures w itself; otherwise w is estimated from orientations."""
    max_torque_n_m: Positive | Unbounded | None = None
    """Largest |tau| in N m of its motors; by default no bound."""


_bit = Annotated[int, Meta(ge=0, le=31)]


class ButtonsTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[master.buttons]`: functions of a driven device's buttons, by bit of `MasterSample.buttons`, 0 to 31.

    With this table only a press engages; neither the start nor a signal closes the clutch. In virtual time `[operator]`
    still operates clutch and gripper.
    """

    clutch: _bit | None = None
    """Clutch button: closed while held."""
    engage: _bit | None = None
    """Clutch toggle button: a press closes it, the next opens it; it opens by itself when the sides decouple."""
    gripper: _bit | None = None
    """Gripper toggle button: a press closes it, the next opens it."""


class TriggerTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[master.gripper]`: trigger with force feedback from `[slave.gripper]`; without it the finger feels nothing.

    `m A + b V + c sign(V) = F_device + F_finger` in closing direction, and `F_v = -force_scale F_jaws` while an object
    blocks the jaws. No preset has `travel_m` and `mass_kg`, because no available source gives them.

    Source: paper Eq. 3.
    """

    travel_m: Annotated[float, Meta(gt=0.0, le=1.0)]
    """Travel from open to closed in m, at the finger."""
    mass_kg: Positive
    """m in kg, at the finger, above 0."""
    viscous: NonNegative = 0.0
    """b in N s/m."""
    coulomb: NonNegative = 0.0
    """c in N."""
    encoder_quantum: NonNegative = 0.0
    """Position resolution in m; 0 is exact."""
    force_scale: Annotated[float, Meta(gt=0.0, le=100.0)] = 0.05
    """Ratio of finger force to jaw force: 40 N at the gripper gives 2 N at the finger."""
    max_force_n: Annotated[float, Meta(gt=0.0, le=50.0)] = 5.0
    """Largest force in N, at most 50."""
    max_slew_n_per_s: Positive = 10.0
    """Largest growth of the force in N/s; unloading is not limited. For a finger that closes at V, a value below K_f V
    prevents contact from throwing the trigger back, which would reopen the jaws.
    """
    max_power_w: Positive = 5.0
    """Largest power in W into the finger."""


class MasterTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[master]`: the haptic device. `m A + b V + c sign(V) = F_device + F_h`.

    A field without a default takes its value from the preset that `device` names. Without a preset, `mass_kg` is
    required, and the fields state their defaults.

    Source: paper Eq. 3.
    """

    device: DeviceName | None = None
    """Preset of `haptether.master.DEVICE_PRESETS` for the omitted fields."""
    kind: SideKind | None = None
    """Kind of coordinates: "linear" (1 to 3 axes), "joints" (1 to 7) or "pose" (3 axes and an orientation); by default
    "linear" up to 3 axes, otherwise "joints".
    """
    axes: Axis = 1
    """Number of axes: 1 to 7."""
    mass_kg: PositivePerAxis | None = None
    """m in kg, above 0."""
    viscous: PerAxis | None = None
    """b in N s/m, of either sign; without a preset 0."""
    coulomb: NonNegativePerAxis | None = None
    """c in N, 0 or more; without a preset 0."""
    friction: Literal["vector", "axis"] | None = None
    """`c V / |V|` along the motion (stylus) or `c sign(V)` per axis (joints); without a preset "vector"."""
    encoder_quantum: NonNegative | None = None
    """Position resolution in m; 0 is exact and the default without a preset."""
    measures_velocity: bool | None = None
    """True if the device measures V itself; by default True if the position is exact."""
    max_force_n: Positive | Unbounded | None = None
    """Largest |F| in N of its motors; "unbounded", or no value without a preset, means no bound."""
    force_quantum_n: NonNegative = 0.0
    """Force resolution in N; 0 is exact."""
    stops: StopsPerAxis | None = None
    """Lower and upper mechanical stop in m, or one such pair per axis; none by default."""
    speed_bound: Positive | None = None
    """Speed limit of the device in m/s (rad/s); a faster, persistent step of its position is a fault. Without a preset
    or driver value, 20 m/s, or 60 rad/s for joints.
    """
    position: PositionPerAxis | None = None
    """Start position in m; by default the start of the hand's path, without a hand 0."""
    velocity: SpeedPerAxis = 0.0
    """V at the start in m/s."""
    rotation: RotationTable | None = None
    """Rotation; required for kind = "pose"."""
    buttons: ButtonsTable | None = None
    """Functions of the buttons of a driver's device; by default none."""
    gripper: TriggerTable | None = None
    """Trigger with force feedback; by default the finger feels nothing."""
    driver: str | None = None
    """Live only: driver of a real device, an entry point of `haptether.masters`. This table is then the safety layer's
    model of the device. By default the operator holds a simulated device.
    """
    options: Options = {}
    """Live only: keyword arguments of the driver."""

    def __hash__(self) -> int:
        # The options table may hold any keys and is not hashable.
        return hash(json.encode(self))


class SeriesTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Recorded series: `file`, with its first record at time 0, or `time_s` and `values`.

    Linear between points, constant outside.
    """

    file: str | None = None
    """CSV with the header `time_s,x[,y,z,...]` or .npz with the arrays `time_s` and `values`; path relative to the
    scene. Time starts at the first record.
    """
    time_s: tuple[Seconds, ...] | None = None
    """Times in s, increasing."""
    values: tuple[ForcePerAxis, ...] | None = None
    """For each time one value, or a list with one per axis: m of a path, N of a push."""


class LegTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[[operator.legs]]`: one leg of the hand's path. The hand stays at the end of the last leg."""

    duration_s: Duration
    """Duration in s, at least 1e-9."""
    end: PositionPerAxis
    """End position in m."""
    shape: Literal["linear", "smooth", "minimum-jerk"] = "minimum-jerk"
    """Fraction of the path at time fraction s: s, `3 s² - 2 s³` or `10 s³ - 15 s⁴ + 6 s⁵`.
    Source of minimum-jerk: Flash and Hogan 1985.
    """


class ReleaseTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[operator.release]`: release of the device by the hand."""

    at_s: Seconds
    """Start of the release in s, counted from engagement if there is an arm."""
    decay_s: Seconds = 0.05
    """Time in s in which the grip decays to zero; 0 is immediate."""
    kind: Literal["strength", "gain"] = "strength"
    """Decaying quantity: the grip strength, so that motion starts once it falls below the load, or the impedance."""


class RegraspTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[operator.regrasp]`: the hand grasps again after the release."""

    reaction_s: Seconds = 0.3
    """Time in s from the end of the release to the first grip."""
    rise_s: Seconds = 0.1
    """Time in s from the first grip to the full grip."""


class RotationLegTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[[operator.rotation.legs]]`: one turn of the hand about a fixed axis, by the shorter way."""

    duration_s: Duration
    """Duration in s, at least 1e-9."""
    turn: Vector3 | None = None
    """Rotation vector, axis times angle in rad, in the base frame, shorter than pi."""
    end_wxyz: Quaternion | None = None
    """Final orientation, as an alternative to `turn`."""
    shape: Literal["linear", "smooth", "minimum-jerk"] = "minimum-jerk"
    """Same as in `[[operator.legs]]`."""


class OperatorRotationTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[operator.rotation]`: the hand turns the device. `tau_h = K_h log(R_target R^T) - B_h w`, up to its strength.

    Source: Hogan 1989 (impedance); Bullo and Murray 1999, section 4 (proportional control on SO(3)).
    """

    stiffness: NonNegative = 2.0
    """K_h in N m/rad."""
    damping: NonNegative = 0.02
    """B_h in N m s/rad."""
    strength_n_m: NonNegative | None = None
    """Grip strength in N m; by default no bound."""
    start_wxyz: Quaternion = (1.0, 0.0, 0.0, 0.0)
    """Initial orientation."""
    legs: tuple[RotationLegTable, ...] = ()
    """Turns in order; by default the hand keeps its orientation."""
    release: ReleaseTable | None = None
    """Release of the device; by default never."""


class FingerTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[operator.finger]`: finger on the trigger of `[master.gripper]`; its target is `trigger`.

    `F_finger = K_f (travel p - x) - B_f V`, saturated at its strength.

    Source: Hogan 1989 (impedance).
    """

    stiffness: NonNegative = 300.0
    """K_f in N/m."""
    damping: NonNegative = 3.0
    """B_f in N s/m."""
    strength_n: NonNegative | None = None
    """Strength in N; by default no bound."""
    release: ReleaseTable | None = None
    """Release of the trigger; by default never."""


class AimTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[[operator.aims.rows]]`: a leg of the target. The hand opens 0.4 s later unless another aim follows."""

    at_s: Seconds
    """Time in s since the start of the run."""
    target: AimTarget
    """Position in m at the end of the leg, within 2 m of the origin."""
    over_s: AimTime = 1.0 / 30.0
    """Duration of the leg in s, 0.001 to 0.4."""
    stiffness: AimStiffness = 300.0
    """K_h in N/m, up to 2000."""
    damping: AimDamping = 5.0
    """B_h in N s/m, up to 50."""
    strength_n: AimStrength
    """Grip strength in N, up to 50; 0 opens the hand."""


class AimsTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[operator.aims]`: a person aims the hand, for example with a mouse. It is open until the first aim.

    Without `file` and `rows`, a live master takes its aims at its control socket; in virtual time the hand stays open.
    """

    file: str | None = None
    """CSV with the header `time_s,x[,y,z],over_s,stiffness,damping,strength_n`, as `haptether try --record` writes it;
    path relative to the scene. Time is since the start of the run.
    """
    rows: tuple[AimTable, ...] = ()
    """Aims in order of time, as an alternative to a file."""


class TremorTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[operator.tremor]`: `a sin(2 pi f t)` added to the path on every axis."""

    amplitude: NonNegative = 1e-4
    """a in m."""
    frequency_hz: TremorFrequency = 10.0
    """f in Hz, up to 100; physiological tremor is at 8 to 12 Hz. Source: Elble and Koller 1990."""


class OperatorTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[operator]`: the hand. `F_h = K_h (target - x) - B_h V`, saturated at its grip strength.

    Source: Hogan 1989 (impedance); Johansson and Westling 1984 (grip).
    """

    stiffness: NonNegative = 300.0
    """K_h in N/m."""
    damping: NonNegative = 5.0
    """B_h in N s/m."""
    grip_strength_n: NonNegative | None = None
    """Grip strength in N; by default no bound."""
    start: PositionPerAxis = 0.0
    """Start of the path in m."""
    legs: tuple[LegTable, ...] = ()
    """Legs of the path; by default the hand stays at `start`."""
    recorded: SeriesTable | None = None
    """Recorded path in m, as an alternative to legs."""
    aims: AimsTable | None = None
    """Aims of a person, as an alternative to legs."""
    release: ReleaseTable | None = None
    """Release of the device; by default never."""
    regrasp: RegraspTable | None = None
    """Grasp after the release; by default never."""
    tremor: TremorTable | None = None
    """Tremor; by default none."""
    clutch: Literal["auto", "once"] | ClutchTimes = "auto"
    """Clutch of a scene with a [slave]: "auto" presses at the start, and releases and presses again after each hold;
    "once" presses at the start only; or pairs of press and release times in s since the start.
    """
    clutch_reaction_s: Reaction = 0.5
    """Time in s, 0.05 to 60, from when both sides are ready after a hold to the next press of "auto"."""
    rotation: OperatorRotationTable | None = None
    """Rotation of a device of kind "pose" by the hand; by default none."""
    finger: FingerTable | None = None
    """Finger on the trigger of `[master.gripper]`."""
    trigger: TriggerCourse = ()
    """Command of `[slave.gripper]`: pairs of time in s since engagement and position, 0 (open) to 1 (closed), with
    linear interpolation; by default it stays open.
    """
