"""Scene and its tables `[run]`, `[link]`, `[coupling]`, `[safety]` and `[record]`."""

from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias

from msgspec import Meta, Struct, json

from haptether._core import COUPLINGS
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

if TYPE_CHECKING:
    CouplingName: TypeAlias = str
else:
    # The registry of the extension is the only list of the couplings.
    CouplingName = Literal[tuple(name for name, _, _ in COUPLINGS)]


class RunTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[run]`: duration and computation of a run."""

    duration_s: Duration = 5.0
    """Duration in s; at most 2e7 ticks."""
    period_s: Period = 1e-3
    """dT of the master in s, a multiple of 1 ns."""
    seed: Annotated[int, Meta(ge=0)] = 0
    """Seed of all random numbers, 0 to 2^64 - 1."""
    integrator: Literal["exact"] = "exact"
    """Only choice: device and hand follow the exact solution between located events; tools and bodies are integrated.
    Source of exact: Hairer, Norsett and Wanner 1993, section I.11 (variation of constants); Dormand and Prince 1980
    (tools and bodies).
    """
    stop_early: bool = False
    """True to end the run when no measured quantity can change any more."""
    diverged_position: Positive = 10.0
    """|x| in m that counts as divergence; for an arm multiplied by lambda_p if that is more."""
    diverged_speed: Positive = 100.0
    """|V| in m/s that counts as divergence."""


class ClockTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[link.master_clock]`, `[link.slave_clock]`: clock error of an endpoint.

    Arm, hand, environment and network use true time t. The endpoint and its loop use the clock, offset + (1 + drift) t,
    plus the step from `step_at_s` on. Recorded times are true times.
    """

    offset_s: ClockOffset = 0.0
    """Lead over true time at the start in s; negative if behind."""
    drift_ppm: ClockDrift = 0.0
    """Rate error in parts per million; negative if slow."""
    step_s: ClockOffset = 0.0
    """Forward step in s, 0 or more; the loop then finds itself late, as after a suspend."""
    step_at_s: ClockStepTime = 0.0
    """True time of the step in s."""


class LinksTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[link]`: network and clocks of both ends; a direction without a table is perfect."""

    forward: LinkSettings | None = None
    """Link from master to slave."""
    backward: LinkSettings | None = None
    """Link from slave to master."""
    master_clock: ClockTable | None = None
    """Clock of the master; by default exact."""
    slave_clock: ClockTable | None = None
    """Clock of the slave; by default exact."""


class ChangeTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[[coupling.changes]]`: changes during the run. Omitted fields keep their values.

    A change fades within `safety.ladder.fade_in_s`. A scale changes linearly; a change of rotation or locks fades both
    scales out and in again. Arm position and velocity stay continuous.
    """

    at_s: Seconds
    """Time in s since the start, not before the previous change."""
    position_scale: Positive | None = None
    """New lambda_p."""
    force_scale: Positive | None = None
    """New lambda_f."""
    rotation_scale: Positive | None = None
    """New lambda_r."""
    torque_scale: Positive | None = None
    """New lambda_tau."""
    quat_wxyz: Quaternion | None = None
    """New rotation."""
    locked_axes: AxisIndices | None = None
    """New locked axes."""
    kind: CouplingName | None = None
    """Coupling to which the operator switches: that of `[coupling]` or an alternative. It releases the clutch."""


class AlignmentTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[coupling.alignment]`: the slave rotates to the master's orientation, `R_s -> C R_m C'`, before they engage.

    The tool point does not move, and the hand feels no force.
    """

    speed: Positive = 0.5
    """Largest turning speed in rad/s."""
    max_angle: Angle = 1.0
    """Largest angle in rad between the sides; above it the slave refuses and does not move."""


class CouplingGains(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Kind and numbers of a coupling."""

    kind: CouplingName = "position-force"
    """Coupling; by default position forward, measured force back."""
    stiffness: Positive | None = None
    """K in N/m (N m/rad for joints) of a coupling with a spring; by default that of the coupling."""
    damping: NonNegative | None = None
    """B in N s/m (N m s/rad) of the same; by default that of the coupling."""
    rotational_stiffness: Positive | None = None
    """K in N m/rad of the rotation for kind "pose"; by default K at `safety.rotation.lever_m`."""
    rotational_damping: NonNegative | None = None
    """B in N m s/rad of the same."""
    impedance: Positive | None = None
    """b in N s/m (N m s/rad) of `wave`; d0 of `tdpa`, the damping of the master's port that counts as energy; d at each
    side of `four-channel` and its reduced forms. By default that of the coupling. At most 0.3 M/T of the device.
    """
    start_energy_j: NonNegative | None = None
    """E_0 in J of each side at the engagement, of `wave`, `tdpa` and `pspm`. At most a quarter of M (0.3 m/s)^2."""
    spread_s: NonNegative | None = None
    """Time in s over which `wave` spreads a wave; more is smoother, and adds to the delay."""
    environment_gain: Positive | None = None
    """C2 of `four-channel` and `three-channel-environment`: gain of F_e at the hand; its own share of F_h is 1 - C2."""
    grasp_gain: Positive | None = None
    """C3 of `four-channel` and `three-channel-grasp`: gain of F_h at the arm, which moves as 1/C3 of its mass."""
    play_out_s: NonNegative | None = None
    """Longest wait in s of a frame that `wave` and `tdpa` play with a constant delay; 0 for none. By default 0.06."""
    tool_mass_kg: Positive | None = None
    """M_v of the virtual tool, which turns the coupling's force into a motion of the arm:
    `M_v a = F_c + F_e - B_v v`. By default `K_max / (0.4 w)^2`, with the stiffest wall of the scene and w of the arm.
    """
    tool_damping: NonNegative | None = None
    """B_v in N s/m; by default 10 M_v per second."""
    tool_lead_s: NonNegative | None = None
    """tau in s by which the command leads the tool, the lag of the arm behind its command. By default 2/w of position
    control, 1/w of velocity control, and 0 of `pd`, which follows the velocity too.
    """


class AlternativeTable(CouplingGains, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[[coupling.alternatives]]`: a coupling to which the operator may switch. All else is that of `[coupling]`."""


class CouplingTable(CouplingGains, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[coupling]`: coupling of master and slave; `haptether list` has the kinds with their sources."""

    position_scale: Positive = 1.0
    """lambda_p: slave motion per master motion."""
    force_scale: Positive = 1.0
    """lambda_f: rendered force per measured force."""
    quat_wxyz: Quaternion = (1.0, 0.0, 0.0, 0.0)
    """R, which maps master motion to slave motion: a unit quaternion with 3 axes, or about z with 2."""
    locked_axes: AxisIndices = ()
    """Slave axes, from 0, that do not follow and are not felt."""
    command_speed: Positive | Unbounded = 3.0
    """Largest speed of the commanded position in m/s, or "unbounded"; a faster command is clamped and counted."""
    command_reach: Positive | Unbounded = "unbounded"
    """Largest distance in m of the commanded position from the arm's start, or "unbounded"."""
    rotation_scale: Positive = 1.0
    """lambda_r for kind "pose": `R_s = (C R_m R_m0^T C^T)^lambda_r R_s0`."""
    torque_scale: Positive = 1.0
    """lambda_tau: rendered torque per measured torque."""
    locks_rotation: bool = False
    """True if the slave keeps its orientation and its torque is not felt."""
    rotation_axis: Vector3 | None = None
    """Unit axis in the slave's base frame about which it turns and is felt; by default all axes."""
    command_angular_speed: Positive | Unbounded = 2.5
    """Largest angular speed of the commanded orientation in rad/s, or "unbounded"."""
    command_turn: Positive | Unbounded = "unbounded"
    """Largest angle in rad of the commanded orientation from the arm's start, or "unbounded"."""
    alignment: AlignmentTable | None = None
    """Alignment of the slave before engagement; without it the sides engage in any orientation."""
    reference_point: Vector3 | None = None
    """Coupled point of the slave's tool for kind "pose", in m from the tool point in the tool frame, for example the
    tip of a long tool. Position, velocity, reach and moment of the slave refer to it, and the tool turns about it.
    By default the tool point.
    """
    change_factor: Annotated[float, Meta(ge=1.0, le=100.0)] = 2.0
    """Largest factor, up and down, by which a command may change a scale while the clutch is closed; values in
    `changes` are allowed too.
    """
    changes: tuple[ChangeTable, ...] = ()
    """Changes during the run; they fade like an engagement."""
    alternatives: tuple[AlternativeTable, ...] = ()
    """Couplings to which the operator may switch during a run, with their own numbers; the same at both sides."""


class SecurityTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[security]`: session of the frames. Without this table frames are not encrypted.

    Live runs are secure by default; a scene without attacks avoids the cost.
    """

    secure: bool = True
    """True to encrypt and authenticate frames after a handshake."""


class BackwardDifference(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True,
                         tag_field="kind", tag="backward-difference"):  # fmt: skip
    """Backward difference of the position."""


class LowPass(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="low-pass"):
    """First-order low-pass on the backward difference."""

    cutoff_hz: Positive
    """Cut-off in Hz, at most half the sample rate."""


class AdaptiveWindow(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True,
                     tag_field="kind", tag="adaptive-window"):  # fmt: skip
    """Slope of the longest line through the latest samples (Janabi-Sharifi, Hayward and Chen 2000)."""

    noise_bound_m: Positive | None = None
    """d in m; by default the resolution of the device."""
    max_window: Annotated[int, Meta(ge=1, le=128)] = 32
    """Longest window in ticks."""
    fit: Literal["end", "best"] = "end"
    """Chord or least squares."""


class SavitzkyGolay(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True,
                    tag_field="kind", tag="savitzky-golay"):  # fmt: skip
    """Derivatives of a polynomial fit to the latest samples."""

    degree: Annotated[int, Meta(ge=2, le=3)] = 2
    """Degree of the polynomial."""
    window: Annotated[int, Meta(ge=3, le=128)] = 15
    """In ticks, above the degree."""


class Kalman(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="kalman"):
    """Kalman filter of position, velocity and acceleration under white jerk."""

    jerk_density: Positive = 10.0
    """q in m²/s⁵."""
    quantum_m: Positive | None = None
    """Encoder quantum in m; by default the device resolution, or 2.3e-5 for an exact device."""


class DualKalman(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag="dual-kalman"):
    """Fast Kalman filter for V, slow one for A: gives a lower bound on ejection speed at the same grasp force."""

    velocity_jerk_density: Positive = 1000.0
    """q_v in m²/s⁵, for V."""
    jerk_density: Positive = 10.0
    """q in m²/s⁵, for A."""
    quantum_m: Positive | None = None
    """Encoder quantum in m; by default the device resolution, or 2.3e-5 for an exact device."""


EstimatorTable: TypeAlias = BackwardDifference | LowPass | AdaptiveWindow | SavitzkyGolay | Kalman | DualKalman


class LimiterTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[safety.limiter]`: bounds of the device force."""

    enabled: bool = True
    """False disables the bounds, for model studies only; the other fields are then not allowed."""
    max_force_n: Positive | None = None
    """Largest |F| in N; by default the device limit, or 7.9 without one."""
    max_slew_n_per_s: Positive = 1000.0
    """Largest growth of the force in N/s; unloading is not limited."""
    max_power_w: Positive = 20.0
    """Largest power in W from the device into the hand."""
    ramp_in_s: Hold = 0.2
    """Rise time in s of the force from zero at the start, 0 to 60; with a [slave] at each engagement, at least 0.2."""


class LadderTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[safety.ladder]`: reaction to a silent peer, with a [slave]. Ages count from the usual age of the link.

    Source: libfranka and UR (20 ms, at most 200 ms).
    """

    stale_after_s: StaleAfter = 0.005
    """Age in s for STALE, where the arm velocity decays; below `hold_after_s`."""
    hold_after_s: HoldAfter = 0.02
    """Age in s for HOLD, where the arm holds and the force fades; below `stop_after_s` and at most 0.1, so that the
    force is zero 0.2 s after the last frame.
    """
    stop_after_s: StopAfter = 0.2
    """Age in s for STOP: a latched soft stop of the arm."""
    extrapolate_s: Extrapolation | None = None
    """Time in s in which the velocity decays to zero in STALE, at most 0.02 and finished before HOLD; by default 0.015,
    or less if HOLD begins earlier.
    """
    fade_out_s: FadeOut = 0.075
    """Time in s in which the force fades from full to zero in HOLD, 0.05 to 0.1."""
    fade_in_s: FadeIn | None = None
    """Time in s in which the force rises from zero to full at each engagement, at least 0.2; by default `ramp_in_s` of
    the limiter, or 0.2 if that is less.
    """


class RotationSafetyTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[safety.rotation]`: controllers of the torque for kind "pose".

    Omitted values follow from those of the force at a lever r: torques r F, angular velocities V / r, damping r² mu.
    Energies, times and ratios are equal.
    """

    lever_m: Annotated[float, Meta(ge=1e-3, le=10.0)] = 0.05
    """r in m: distance of the hand from the centre of the handle."""
    shares_trips: bool = True
    """True if a trip of force or torque acts on both."""
    controllers: tuple[ControllerName, ...] | None = None
    """Active controllers; by default those of the force."""
    damping: NonNegative | None = None
    """mu in N m s/rad, at most I / (5 dT)."""
    velocity_threshold: Positive | None = None
    """VFC velocity threshold in rad/s."""
    vfc_torque_threshold_n_m: Positive | None = None
    """VFC torque threshold in N m."""
    grasp_threshold: Annotated[float, Meta(gt=1.0, le=LARGEST)] | None = None
    """zeta of HSC, above 1."""
    grasp_floor_n_m: Positive | None = None
    """alpha of HSC in N m."""
    hsc_torque_threshold_n_m: NonNegative | None = None
    """HSC torque threshold in N m."""
    energy_threshold_j: Annotated[float, Meta(ge=-LARGEST, lt=0.0)] | None = None
    """delta of WSC in J, below 0."""
    pc_max_damping: NonNegative | None = None
    """Damping bound of PC in N m s/rad, at most I / (5 dT)."""
    max_torque_n_m: Positive | None = None
    """Largest |tau| in N m; by default the device limit, or without one the force limit at the lever."""
    max_slew_n_m_per_s: Positive | None = None
    """Largest growth of the torque in N m/s."""
    max_power_w: Positive | None = None
    """Largest power in W from the torque into the hand."""
    quantum_rad: Positive | None = None
    """Angular resolution in rad that the estimator assumes for the device."""


class TriggerSafetyTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[safety.gripper]`: controllers of the trigger force of `[master.gripper]`.

    Omitted values follow from those of the hand, scaled by the ratio of largest forces and the ratio of travels.
    Velocities scale with travel, energies with force times travel, damping with force per travel. Times and ratios are
    equal.
    """

    reach_m: Annotated[float, Meta(gt=0.0, le=10.0)] = 0.14
    """Travel of the hand in m for which its thresholds hold: the paper's stylus is thrown over 0.14 m."""
    controllers: tuple[ControllerName, ...] | None = None
    """Active controllers; by default those of the hand."""
    damping: NonNegative | None = None
    """mu in N s/m, at most m / (5 dT)."""
    velocity_threshold: Positive | None = None
    """VFC velocity threshold in m/s."""
    vfc_force_threshold_n: Positive | None = None
    """VFC force threshold in N."""
    grasp_threshold: Annotated[float, Meta(gt=1.0, le=LARGEST)] | None = None
    """zeta of HSC, above 1."""
    grasp_floor_n: Positive | None = None
    """alpha of HSC in N."""
    hsc_force_threshold_n: NonNegative | None = None
    """HSC force threshold in N."""
    energy_threshold_j: Annotated[float, Meta(ge=-LARGEST, lt=0.0)] | None = None
    """delta of WSC in J, below 0."""
    pc_max_damping: NonNegative | None = None
    """Damping bound of PC in N s/m, at most m / (5 dT)."""


class ResearchTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[safety.research]`: custom Python controller, evaluated after those of `[safety] controllers`.

    Translation in simulated runs and sweeps only; live sides refuse such a scene.
    """

    controller: Annotated[str, Meta(min_length=1, max_length=100)]
    """Name: an entry point of `haptether.controllers`, or a name given to `haptether.bridge.register_controller`."""
    options: Options = {}
    """Keyword arguments, in addition to the number of axes and the period."""

    def __hash__(self) -> int:
        # The options table may hold any keys and is not hashable.
        return hash(json.encode(self))


class SafetyTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[safety]`: safety layer of the hand. Omitted thresholds come from the preset.

    Source: paper section 4 (preset "paper"); docs/thresholds.md (preset "measured").
    """

    preset: Literal["measured", "paper"] | None = None
    """Source of thresholds: "measured" under delay, or "paper"; by default "measured", for joints "paper"."""
    controllers: tuple[ControllerName, ...] = ()
    """Active controllers: any of "vfc" (Eq. 2), "hsc" (Eq. 14), "wsc" (Eq. 13), "pc" (Eq. 12); by default none."""
    signals: Literal["estimated", "true"] = "estimated"
    """Input of the observers: "estimated" from measured positions, as live, or "true" model values."""
    estimator: EstimatorTable = DualKalman()
    """Estimator of V and A from the position."""
    damping: NonNegative | None = None
    """mu in N s/m, at most m / (5 dT); by default 5, or that bound if it is less."""
    velocity_threshold: Positive | None = None
    """V_t of VFC in m/s; measured 0.45, paper 0.6."""
    vfc_force_threshold_n: Positive | None = None
    """F_t of VFC in N; measured 0.3, paper 1."""
    vfc_form: Literal["product", "both"] | None = None
    """"product": Eq. 1 as printed, in the preset "paper"; "both": both thresholds at the same time, in "measured"."""
    grasp_threshold: Annotated[float, Meta(gt=1.0, le=LARGEST)] = 1.5
    """zeta of HSC, above 1."""
    grasp_floor_n: Positive = 1e-3
    """alpha of HSC in N."""
    hsc_force_threshold_n: NonNegative | None = None
    """F_t of HSC in N; measured 0.3, paper 0.1."""
    hsc_velocity_threshold: NonNegative | None = None
    """V_s of HSC in m/s: a push trips only while the device moves along it faster than this; 0 is as printed.
    Measured 0.05, paper 0.
    """
    energy_threshold_j: Annotated[float, Meta(ge=-LARGEST, lt=0.0)] | None = None
    """delta of WSC in J, below 0; paper -0.03.
    Measured: the value for V_w = 0.29 m/s, `-m V_w² / (2 eta)`, with m of the lightest axis.
    """
    wsc_force_threshold_n: NonNegative | None = None
    """F_w of WSC in N: a motion trips only while the push along it exceeds this; 0 is as printed and in "paper".
    Measured 0.005 with `master.stops`. Without stops 0, because a push that WSC ignores would have no end.
    """
    energy_ratio: Ratio | None = None
    """eta, above 0 and at most 1; measured 0.05, paper 0.5."""
    window: Annotated[int, Meta(ge=1, le=3_600_000)] | None = None
    """w of WSC in ticks; measured 10, paper 100."""
    pc_max_damping: NonNegative | None = None
    """Damping bound of PC in N s/m, at most m / (5 dT); by default 10, or that bound if it is less."""
    hold_off_s: Hold = 0.1
    """Minimum duration of an intervention in s, 0 to 60; as printed 0."""
    release_ramp_s: Hold = 0.2
    """Minimum fade-out time of an intervention in s, 0 to 60; a yielding hand takes longer; as printed 0."""
    probe_force_n: NonNegative | None = None
    """A in N of the probe that a hand must answer before an intervention fades; 0 only waits for a hand that moves.
    By default mu times 0.12 m/s, which moves a free device at less than 0.1 m/s, or 0 if friction would hide it.
    """
    probe_threshold: Annotated[float, Meta(gt=0.0, lt=1.0)] = 0.2
    """r_th: minimum fraction of the probe that a hand must resist."""
    release_tries: Annotated[int, Meta(ge=0, le=1000)] | None = None
    """Number of release tries, of 1 s each, after which the force is withheld unless it returned for 1 s; by default 5.
    0 sets no limit. Without a probe 0 fades by time only, and no hand is required.
    """
    limiter: LimiterTable = LimiterTable()
    """Bounds of the device force."""
    ladder: LadderTable | None = None
    """Times of the ladder, with a [slave]; by default the ladder's defaults."""
    rotation: RotationSafetyTable | None = None
    """Differences for the torque of kind "pose"."""
    gripper: TriggerSafetyTable | None = None
    """Differences for the trigger force of `[master.gripper]`."""
    research: ResearchTable | None = None
    """Custom Python controller; simulated runs only."""


class RecordTable(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """`[record]`: keep signals; without this table only metrics and events are kept."""

    every: Annotated[int, Meta(ge=1, le=1_000_000)] = 1
    """Interval of recorded ticks."""


class Scene(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Scene. An absent table is a part that is not built; SI units; positive forces push along +x."""

    schema: Literal[1]
    """Version of the format."""
    title: str = ""
    """Short title."""
    shows: str = ""
    """Purpose in one sentence."""
    run: RunTable = RunTable()
    """Duration and computation of the run."""
    master: MasterTable
    """Haptic device."""
    operator: OperatorTable | None = None
    """Hand; by default nobody holds the device."""
    slave: SlaveTable | None = None
    """Arm; by default the environment is rendered on the device itself."""
    environment: EnvironmentTable | None = None
    """Objects and pushes; by default none."""
    link: LinksTable | None = None
    """Network; by default both sides share one wire without delay."""
    coupling: CouplingTable | None = None
    """Coupling of master and slave; with an arm the default coupling applies."""
    security: SecurityTable | None = None
    """Session; by default frames are not encrypted."""
    safety: SafetyTable = SafetyTable()
    """Safety layer of the hand; by default only the bounds of the limiter."""
    record: RecordTable | None = None
    """Recorded signals; by default none."""

    def ejection_settings(self) -> EjectionSettings:
        """Return the inputs of `haptether.safety.ejection_bound`.

        Raises:
            SceneError: The scene is invalid.
        """
        # The module imports the tables of this file.
        from haptether.bridge.scene.ejection import settings_of  # noqa: PLC0415

        return settings_of(self)
