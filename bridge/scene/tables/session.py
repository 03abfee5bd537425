"""A scene and its tables `[run]`, `[link]`, `[coupling]`, `[safety]` and `[record]`."""

from typing import Annotated, Literal, TypeAlias

from msgspec import Meta, Struct, json

from haptether.bridge.scene.tables.master import MasterTable, OperatorTable
from haptether.bridge.scene.tables.ranges import (
    LARGEST,
    Angle,
    AxisIndices,
    ClockDrift,
    ClockOffset,
    ClockStepTime,
    Duration,
    Extrapolation,
    FadeIn,
    FadeOut,
    Hold,
    HoldAfter,
    NonNegative,
    Options,
    Period,
    Positive,
    Quaternion,
    Ratio,
    Seconds,
    StaleAfter,
    StopAfter,
    Unbounded,
    Vector3,
)
from haptether.bridge.scene.tables.slave import EnvironmentTable, SlaveTable
from haptether.netsim import LinkSettings
from haptether.safety import ControllerName, EjectionSettings


class RunTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[run]`: how long and how it is computed."""

    duration_s: Duration = 5.0
    """In s; at most 2e7 ticks."""
    period_s: Period = 1e-3
    """dT of the master in s, a whole number of ns."""
    seed: Annotated[int, Meta(ge=0)] = 0
    """Seed of all randomness, 0 to 2^64 - 1."""
    integrator: Literal["exact"] = "exact"
    """Nothing to choose: device and hand follow the exact solution between located events."""
    stop_early: bool = False
    """Ends the run when nothing that is measured can change any more."""
    diverged_position: Positive = 10.0
    """|x| in m beyond which the loop has diverged; an arm has lambda_p times as much room if that is more."""
    diverged_speed: Positive = 100.0
    """|V| in m/s beyond which the loop has diverged."""


class ClockTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[link.master_clock]`, `[link.slave_clock]`: what is wrong with the clock of an endpoint.

    Arm, hand, what is touched and the network live in true time; the endpoint and its loop by what its clock shows,
    offset + (1 + drift) t, and from `step_at_s` on the step as well. Recorded times are true ones.
    """

    offset_s: ClockOffset = 0.0
    """By how much it is ahead of true time at the start, in s; below 0 behind."""
    drift_ppm: ClockDrift = 0.0
    """By how much it runs fast, in parts per million; below 0 slow."""
    step_s: ClockOffset = 0.0
    """By how much it is set forward, in s, 0 or more: its loop then finds itself late, as after a suspend."""
    step_at_s: ClockStepTime = 0.0
    """When it is set, in s of true time."""


class LinksTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[link]`: the network and the clocks at its ends; a direction without a table is perfect."""

    forward: LinkSettings | None = None
    """From master to slave."""
    backward: LinkSettings | None = None
    """From slave to master."""
    master_clock: ClockTable | None = None
    """The master's clock; by default it is right."""
    slave_clock: ClockTable | None = None
    """The slave's clock; by default it is right."""


class ChangeTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[[coupling.changes]]`: what somebody changes while it runs. What is left out stays.

    A change fades within `safety.ladder.fade_in_s`. A scale follows a straight line; rotation and locks fade both
    scales out and in again. Neither arm nor velocity jumps.
    """

    at_s: Seconds
    """When, in s since the start; not before the change above it."""
    position_scale: Positive | None = None
    """The new lambda_p."""
    force_scale: Positive | None = None
    """The new lambda_f."""
    rotation_scale: Positive | None = None
    """The new lambda_r."""
    torque_scale: Positive | None = None
    """The new lambda_tau."""
    quat_wxyz: Quaternion | None = None
    """The new rotation."""
    locked_axes: AxisIndices | None = None
    """The new locks."""


class AlignmentTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[coupling.alignment]`: after a press the slave turns to the master, `R_s -> C R_m C'`, before the two engage.

    Its tool point stays where it is, and the hand feels nothing of that.
    """

    speed: Positive = 0.5
    """Fastest that it turns, in rad/s."""
    max_angle: Angle = 1.0
    """Angle in rad between the two beyond which it refuses and stays."""


class CouplingTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[coupling]`: how master and slave are coupled.

    Source: Hannaford 1989; Lawrence 1993 (position-force coupling).
    """

    kind: Literal["position-force"] = "position-force"
    """Position forth, measured force back."""
    position_scale: Positive = 1.0
    """lambda_p: motion of the slave over that of the master."""
    force_scale: Positive = 1.0
    """lambda_f: rendered force over measured force."""
    quat_wxyz: Quaternion = (1.0, 0.0, 0.0, 0.0)
    """R, which maps motions of the master to those of the slave: a unit quaternion of 3 axes, or of 2 about z."""
    locked_axes: AxisIndices = ()
    """Axes of the slave that do not follow and are not felt, counted from 0."""
    command_speed: Positive | Unbounded = 3.0
    """Fastest that the commanded position moves, in m/s, or "unbounded"; what is faster is clamped and counted."""
    command_reach: Positive | Unbounded = "unbounded"
    """Largest distance in m of the commanded position from where the arm began, or "unbounded"."""
    rotation_scale: Positive = 1.0
    """lambda_r of kind "pose": `R_s = (C R_m R_m0^T C^T)^lambda_r R_s0`."""
    torque_scale: Positive = 1.0
    """lambda_tau: rendered torque over measured torque."""
    locks_rotation: bool = False
    """Whether the slave keeps its orientation, and its torque is not felt."""
    rotation_axis: Vector3 | None = None
    """The axis of the slave's base frame, of length 1, about which alone it turns and is felt; by default about all."""
    command_angular_speed: Positive | Unbounded = 2.5
    """Fastest that the commanded orientation turns, in rad/s, or "unbounded"."""
    command_turn: Positive | Unbounded = "unbounded"
    """Largest angle in rad of the commanded orientation from how the arm began, or "unbounded"."""
    alignment: AlignmentTable | None = None
    """How the slave turns to the master before the two engage; without, they engage however they are turned."""
    reference_point: Vector3 | None = None
    """The point of the slave's tool of kind "pose" that is coupled, in m from the tool point in the tool's frame, as
    the tip of a long tool: position, velocity, reach and moment of the slave are those of it, and the tool turns about
    it; by default the tool point."""
    change_factor: Annotated[float, Meta(ge=1.0, le=100.0)] = 2.0
    """Largest factor, up and down, by which a command may change a scale of this table while the clutch is closed; what
    `changes` states is allowed besides."""
    changes: tuple[ChangeTable, ...] = ()
    """What is changed while it runs; it fades as an engagement does."""


class SecurityTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[security]`: the session in which frames travel. Without this table they travel in the clear.

    Live runs are secure by default; a scene without attacks pays nothing for what it would not show.
    """

    secure: bool = True
    """Whether frames are encrypted and authenticated, after a handshake."""


class BackwardDifference(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True,
                         tag_field="kind", tag="backward-difference"):  # fmt: skip
    """Differences of the position."""


class LowPass(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="low-pass"):
    """First-order low-pass on the difference."""

    cutoff_hz: Positive
    """Cut-off in Hz, at most half the sample rate."""


class AdaptiveWindow(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True,
                     tag_field="kind", tag="adaptive-window"):  # fmt: skip
    """Slope of the longest straight line through the last samples (Janabi-Sharifi, Hayward and Chen 2000)."""

    noise_bound_m: Positive | None = None
    """d in m; by default the resolution of the device."""
    max_window: Annotated[int, Meta(ge=1, le=128)] = 32
    """Longest window in ticks."""
    fit: Literal["end", "best"] = "end"
    """Chord or least squares."""


class SavitzkyGolay(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True,
                    tag_field="kind", tag="savitzky-golay"):  # fmt: skip
    """Derivatives of a polynomial through the last samples."""

    degree: Annotated[int, Meta(ge=2, le=3)] = 2
    """Degree of the polynomial."""
    window: Annotated[int, Meta(ge=3, le=128)] = 15
    """In ticks, above the degree."""


class Kalman(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="kalman"):
    """Kalman filter of position, velocity and acceleration under white jerk."""

    jerk_density: Positive = 10.0
    """q in m²/s⁵."""
    quantum_m: Positive | None = None
    """Quantum of the encoder in m; by default the resolution of the device, of an exact one 2.3e-5."""


class DualKalman(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="dual-kalman"):
    """A quick Kalman filter for V, a calm one for A: for a lower bound on ejection speed at the same grasp force."""

    velocity_jerk_density: Positive = 1000.0
    """q_v in m²/s⁵, of V."""
    jerk_density: Positive = 10.0
    """q in m²/s⁵, of A."""
    quantum_m: Positive | None = None
    """Quantum of the encoder in m; by default the resolution of the device, of an exact one 2.3e-5."""


EstimatorTable: TypeAlias = BackwardDifference | LowPass | AdaptiveWindow | SavitzkyGolay | Kalman | DualKalman


class LimiterTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[safety.limiter]`: bounds on the device force."""

    enabled: bool = True
    """Only studies of a model switch the bounds off; the other fields then have no place here."""
    max_force_n: Positive | None = None
    """Largest |F| in N; by default what the device exerts, without such a bound 7.9."""
    max_slew_n_per_s: Positive = 1000.0
    """Largest growth of the force in N/s; unloading is free."""
    max_power_w: Positive = 20.0
    """Largest power in W that the device may put into the hand."""
    ramp_in_s: Hold = 0.2
    """Time in s in which the force rises from zero at the start, 0 to 60; with a [slave] at each engagement, and then
    at least 0.2."""


class LadderTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[safety.ladder]`: what a silent peer leads to, with a [slave]. Ages count from the one that the link is used to.

    Source: libfranka and UR (20 ms, at most 200 ms).
    """

    stale_after_s: StaleAfter = 0.005
    """In s to STALE, where the velocity of the arm decays; below `hold_after_s`."""
    hold_after_s: HoldAfter = 0.02
    """In s to HOLD, where the arm holds and the force fades; below `stop_after_s` and at most 0.1, so that the force is
    gone 0.2 s after the last frame."""
    stop_after_s: StopAfter = 0.2
    """In s to STOP: a soft stop of the arm, latched."""
    extrapolate_s: Extrapolation | None = None
    """In s, within which the velocity decays to zero in STALE, at most 0.02 and over before HOLD; by default 0.015, or
    less where HOLD begins earlier."""
    fade_out_s: FadeOut = 0.075
    """In s, in which the force fades from full to zero in HOLD, 0.05 to 0.1."""
    fade_in_s: FadeIn | None = None
    """In s, in which the force rises from zero to full at each engagement, at least 0.2; by default `ramp_in_s` of the
    limiter, or 0.2 if that is less."""


class RotationSafetyTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[safety.rotation]`: who watches the torque of kind "pose".

    What is not given is that of the force at a lever r: torques are r F, angular velocities V / r, damping r² mu;
    energies, times and ratios are the same.
    """

    lever_m: Annotated[float, Meta(ge=1e-3, le=10.0)] = 0.05
    """r in m: how far from its middle the hand holds the handle."""
    shares_trips: bool = True
    """Whether a trip of force or torque acts on both."""
    controllers: tuple[ControllerName, ...] | None = None
    """Who watches; by default those of the force."""
    damping: NonNegative | None = None
    """mu in N m s/rad, at most I / (5 dT)."""
    velocity_threshold: Positive | None = None
    """In rad/s, of VFC."""
    vfc_torque_threshold_n_m: Positive | None = None
    """In N m, of VFC."""
    grasp_threshold: Annotated[float, Meta(gt=1.0, le=LARGEST)] | None = None
    """zeta, above 1, of HSC."""
    grasp_floor_n_m: Positive | None = None
    """alpha in N m, of HSC."""
    hsc_torque_threshold_n_m: NonNegative | None = None
    """In N m, of HSC."""
    energy_threshold_j: Annotated[float, Meta(ge=-LARGEST, lt=0.0)] | None = None
    """delta in J, below 0, of WSC."""
    pc_max_damping: NonNegative | None = None
    """Bound in N m s/rad on the damping of PC, at most I / (5 dT)."""
    max_torque_n_m: Positive | None = None
    """Largest |tau| in N m; by default what the device exerts, without such a bound that of the force at the lever."""
    max_slew_n_m_per_s: Positive | None = None
    """Largest growth of the torque in N m/s."""
    max_power_w: Positive | None = None
    """Largest power in W that the torque may put into the hand."""
    quantum_rad: Positive | None = None
    """Resolution of an angle in rad that the estimator takes the device to have."""


class TriggerSafetyTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[safety.gripper]`: who watches the force at the trigger of `[master.gripper]`.

    What is not given is that of the hand, scaled by the largest forces of both and by the ways of both: velocities as
    the way, energies as both together, damping as force by way; times and ratios are the same.
    """

    reach_m: Annotated[float, Meta(gt=0.0, le=10.0)] = 0.14
    """Way of the hand in m that its thresholds are for: the paper's stylus is thrown over 0.14 m."""
    controllers: tuple[ControllerName, ...] | None = None
    """Who watches; by default those of the hand."""
    damping: NonNegative | None = None
    """mu in N s/m, at most m / (5 dT)."""
    velocity_threshold: Positive | None = None
    """In m/s, of VFC."""
    vfc_force_threshold_n: Positive | None = None
    """In N, of VFC."""
    grasp_threshold: Annotated[float, Meta(gt=1.0, le=LARGEST)] | None = None
    """zeta, above 1, of HSC."""
    grasp_floor_n: Positive | None = None
    """alpha in N, of HSC."""
    hsc_force_threshold_n: NonNegative | None = None
    """In N, of HSC."""
    energy_threshold_j: Annotated[float, Meta(ge=-LARGEST, lt=0.0)] | None = None
    """delta in J, below 0, of WSC."""
    pc_max_damping: NonNegative | None = None
    """Bound in N s/m on the damping of PC, at most m / (5 dT)."""


class ResearchTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[safety.research]`: a controller of your own, in Python, behind those of `[safety] controllers`.

    In simulated runs and sweeps only, of what moves and does not turn: live sides refuse such a scene.
    """

    controller: Annotated[str, Meta(min_length=1, max_length=100)]
    """Its name: an entry point of `haptether.controllers`, or what `haptether.bridge.register_controller` was given."""
    options: Options = {}
    """What it is called with, beside the number of axes and the period."""

    def __hash__(self) -> int:
        # Options are a table of any keys, which has no hash of its own.
        return hash(json.encode(self))


class SafetyTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[safety]`: who watches the hand. A threshold that is left out is that of the preset.

    Source: paper section 4 (preset "paper"); docs/thresholds.md (preset "measured").
    """

    preset: Literal["measured", "paper"] | None = None
    """Whose thresholds: "measured" under delay, or those of the paper; by default "measured", of joints "paper"."""
    controllers: tuple[ControllerName, ...] = ()
    """Any of "vfc" (Eq. 2), "hsc" (Eq. 14), "wsc" (Eq. 13), "pc" (Eq. 12); by default nobody."""
    signals: Literal["estimated", "true"] = "estimated"
    """What the observers get: what the estimator makes of measured positions, as live, or the model's own."""
    estimator: EstimatorTable = DualKalman()
    """How V and A are had from the position."""
    damping: NonNegative | None = None
    """mu in N s/m, at most m / (5 dT); by default 5, or that bound if it is less."""
    velocity_threshold: Positive | None = None
    """V_t in m/s, of VFC; measured 0.45, of the paper 0.6."""
    vfc_force_threshold_n: Positive | None = None
    """F_t in N, of VFC; measured 0.3, of the paper 1."""
    vfc_form: Literal["product", "both"] | None = None
    """"product", Eq. 1 as printed and the paper's, or "both" thresholds at the same time, the measured one."""
    grasp_threshold: Annotated[float, Meta(gt=1.0, le=LARGEST)] = 1.5
    """zeta, above 1, of HSC."""
    grasp_floor_n: Positive = 1e-3
    """alpha in N, of HSC."""
    hsc_force_threshold_n: NonNegative | None = None
    """F_t in N, of HSC; measured 0.3, of the paper 0.1."""
    hsc_velocity_threshold: NonNegative | None = None
    """V_s in m/s, of HSC: a push trips only while the device moves along it faster than that; 0 is as printed.

    Measured 0.05, of the paper 0.
    """
    energy_threshold_j: Annotated[float, Meta(ge=-LARGEST, lt=0.0)] | None = None
    """delta in J, below 0, of WSC; of the paper -0.03.

    Measured: that of V_w = 0.29 m/s, `-m V_w² / (2 eta)`, m the lightest axis.
    """
    wsc_force_threshold_n: NonNegative | None = None
    """F_w in N, of WSC: a motion trips only while the push along it exceeds that; 0 is as printed, and the paper's.

    Measured 0.005 with `master.stops`; without, 0: a push that WSC does not see would have no end.
    """
    energy_ratio: Ratio | None = None
    """eta, above 0 and at most 1; measured 0.05, of the paper 0.5."""
    window: Annotated[int, Meta(ge=1, le=3_600_000)] | None = None
    """w in ticks, of WSC; measured 10, of the paper 100."""
    pc_max_damping: NonNegative | None = None
    """Bound in N s/m on the damping of PC, at most m / (5 dT); by default 10, or that bound if it is less."""
    hold_off_s: Hold = 0.1
    """Least duration of an intervention in s, 0 to 60; as printed 0."""
    release_ramp_s: Hold = 0.2
    """Least time in s over which an intervention fades out, 0 to 60: a hand that yields takes longer; as printed 0."""
    probe_force_n: NonNegative | None = None
    """A in N of the probe that a hand must answer before an intervention fades; 0 only listens for one that moves.

    By default mu times 0.12 m/s, which moves a free device by less than 0.1 m/s, or 0 where friction would hide it.
    """
    probe_threshold: Annotated[float, Meta(gt=0.0, lt=1.0)] = 0.2
    """r_th: the share of the probe that a hand holds against, at least."""
    release_tries: Annotated[int, Meta(ge=0, le=1000)] | None = None
    """After so many tries, of a second each, without the force being back for 1 s it is withheld: by default 5.

    0 is no end; without a probe it then fades by time alone, and no hand is asked for.
    """
    limiter: LimiterTable = LimiterTable()
    """Bounds on the device force."""
    ladder: LadderTable | None = None
    """Times of the ladder, with a [slave]; by default the ladder's own."""
    rotation: RotationSafetyTable | None = None
    """What differs for the torque of kind "pose"."""
    gripper: TriggerSafetyTable | None = None
    """What differs for the force at the trigger of `[master.gripper]`."""
    research: ResearchTable | None = None
    """A controller of your own, in Python; simulated runs only."""


class RecordTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[record]`: the signals are kept; without this table only metrics and events."""

    every: Annotated[int, Meta(ge=1, le=1_000_000)] = 1
    """Every so many ticks."""


class Scene(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """A scene. A table that is absent is a part that is not built; SI units; positive forces push along +x."""

    schema: Literal[1]
    """Version of the format."""
    title: str = ""
    """What it is, in a few words."""
    shows: str = ""
    """What it shows, in a sentence."""
    run: RunTable = RunTable()
    """How long and how it is computed."""
    master: MasterTable
    """The device."""
    operator: OperatorTable | None = None
    """The hand; by default nobody holds the device."""
    slave: SlaveTable | None = None
    """The arm; by default the environment is rendered on the device itself."""
    environment: EnvironmentTable | None = None
    """What is touched and what pushes; by default nothing."""
    link: LinksTable | None = None
    """The network; by default the two sides share one wire without delay."""
    coupling: CouplingTable | None = None
    """How master and slave are coupled; the default coupling where there is an arm."""
    security: SecurityTable | None = None
    """The session; by default frames travel in the clear."""
    safety: SafetyTable = SafetyTable()
    """Who watches the hand; by default only the bounds of the limiter."""
    record: RecordTable | None = None
    """What is kept of the signals; by default nothing."""

    def ejection_settings(self) -> EjectionSettings:
        """What `haptether.safety.ejection_bound` takes of it.

        Raises:
            SceneError: A scene that cannot be built.
        """
        # It reads the tables of this file.
        from haptether.bridge.scene.ejection import settings_of  # noqa: PLC0415

        return settings_of(self)
