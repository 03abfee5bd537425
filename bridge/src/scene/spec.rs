//! A scene as numbers: what the TOML file says, checked and with its defaults filled in.
//!
//! The tables, their documentation, ranges and defaults are those of `bridge/scene/tables/`, which reads the file. Here
//! every field is required, so that a table that the two sides describe differently cannot be misread.

use haptether_netsim::{ClockSettings, LinkSettings};
use serde::Deserialize;

/// A scene.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SceneSpec {
    /// How it is run.
    pub run: RunSpec,
    /// The device.
    pub master: MasterSpec,
    /// The hand; without it nobody holds the device.
    pub operator: Option<OperatorSpec>,
    /// The arm; without it the environment is rendered on the device itself.
    pub slave: Option<SlaveSpec>,
    /// What is touched.
    pub environment: Option<EnvironmentSpec>,
    /// The network; without it the two sides share one wire without delay.
    pub link: Option<LinksSpec>,
    /// How master and slave are coupled; only with an arm.
    pub coupling: Option<CouplingSpec>,
    /// The session in which frames travel; without it, in the clear.
    pub security: Option<SecuritySpec>,
    /// Who watches the hand.
    pub safety: SafetySpec,
    /// What is recorded; without it only metrics and events are kept.
    pub record: Option<RecordSpec>,
}

/// `[run]`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunSpec {
    /// In s.
    pub duration_s: f64,
    /// dT of the master in s.
    pub period_s: f64,
    /// Seed of all randomness.
    pub seed: u64,
    /// How device and hand are advanced.
    pub integrator: IntegratorSpec,
    /// Step in s of an integrator that has one; a whole fraction of the period.
    pub step_s: Option<f64>,
    /// Ends the run when nothing that is measured can change any more.
    pub stop_early: bool,
    /// |x| in m beyond which the loop has diverged.
    pub diverged_position: f64,
    /// |V| in m/s beyond which the loop has diverged.
    pub diverged_speed: f64,
}

/// How device and hand are advanced.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum IntegratorSpec {
    /// The exact solution between located events.
    Exact,
    /// Semi-implicit (symplectic) Euler.
    SemiImplicitEuler,
    /// Velocity Verlet.
    VelocityVerlet,
    /// The classical Runge-Kutta method of order 4.
    Rk4,
}

/// `[master]`, after its preset has been filled in.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MasterSpec {
    /// Number of axes: 1, 2, 3, 6 or 7.
    pub axes: usize,
    /// m in kg per axis.
    pub mass_kg: Vec<f64>,
    /// b in N s/m per axis.
    pub viscous: Vec<f64>,
    /// c in N per axis.
    pub coulomb: Vec<f64>,
    /// Whether friction acts along the motion or on each axis by itself.
    pub friction: FrictionSpec,
    /// |V| in m/s below which an integrator with steps takes friction as proportional to V.
    pub friction_speed: f64,
    /// In m; 0 is exact.
    pub encoder_quantum: f64,
    /// Whether the device measures V itself.
    pub measures_velocity: bool,
    /// Largest force in N that its motors exert; none without a bound.
    pub max_force_n: Option<f64>,
    /// Resolution of its force in N; 0 is exact.
    pub force_quantum_n: f64,
    /// Lower and upper mechanical stops in m per axis.
    pub stops: Option<Vec<(f64, f64)>>,
    /// Where it starts, in m per axis.
    pub position: Vec<f64>,
    /// V at the start, in m/s per axis.
    pub velocity: Vec<f64>,
}

/// How friction acts on several axes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FrictionSpec {
    /// `c V / |V|`: a stylus in space.
    Vector,
    /// `c sign(V)` on each axis: joints.
    Axis,
}

/// `[operator]`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OperatorSpec {
    /// `K_h` in N/m.
    pub stiffness: f64,
    /// `B_h` in N s/m.
    pub damping: f64,
    /// Grip strength in N; none without a bound.
    pub grip_strength_n: Option<f64>,
    /// Where the path begins, in m per axis.
    pub start: Vec<f64>,
    /// The legs of the path.
    pub legs: Vec<LegSpec>,
    /// A recorded path instead of legs.
    pub recorded: Option<SeriesSpec>,
    /// When it lets go.
    pub release: Option<ReleaseSpec>,
    /// How it takes hold again.
    pub regrasp: Option<RegraspSpec>,
    /// Tremor.
    pub tremor: Option<TremorSpec>,
    /// What the person does with the clutch, where no times are given.
    pub clutch: PersonSpec,
    /// Press and release times of the clutch in s.
    pub clutch_times: Option<Vec<(f64, f64)>>,
    /// From when both sides are ready after a hold to the new press, in s.
    pub clutch_reaction_s: f64,
}

/// What a simulated person does with the clutch.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PersonSpec {
    /// Presses at the start and, after letting go, after each hold.
    Auto,
    /// Presses at the start.
    Once,
}

/// `[[operator.legs]]`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LegSpec {
    /// In s.
    pub duration_s: f64,
    /// Where it ends, in m per axis.
    pub end: Vec<f64>,
    /// How it is travelled.
    pub shape: LegShapeSpec,
}

/// How a leg is travelled.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum LegShapeSpec {
    /// At constant speed.
    Linear,
    /// `3 s² - 2 s³`.
    Smooth,
    /// `10 s³ - 15 s⁴ + 6 s⁵`.
    MinimumJerk,
}

/// Values over time, linear between its points and constant outside.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SeriesSpec {
    /// In s, increasing.
    pub time_s: Vec<f64>,
    /// One row of values (one per axis) for each time.
    pub values: Vec<Vec<f64>>,
}

/// `[operator.release]`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReleaseSpec {
    /// When it begins, in s.
    pub at_s: f64,
    /// In s.
    pub decay_s: f64,
    /// What decays.
    pub kind: ReleaseKindSpec,
}

/// What decays at a release.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ReleaseKindSpec {
    /// The grip strength.
    Strength,
    /// The impedance: `F_h = g (K_h (target - x) - B_h V)`.
    Gain,
}

/// `[operator.regrasp]`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RegraspSpec {
    /// From the end of the release to the first grip, in s.
    pub reaction_s: f64,
    /// Until the full grip, in s.
    pub rise_s: f64,
}

/// `[operator.tremor]`: `a sin(2 pi f t)` on the path, on every axis.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TremorSpec {
    /// a in m.
    pub amplitude: f64,
    /// f in Hz.
    pub frequency_hz: f64,
}

/// `[slave]`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SlaveSpec {
    /// What its controller takes.
    pub control: ControlSpec,
    /// M in kg.
    pub mass_kg: f64,
    /// Bandwidth in Hz of its position or velocity control.
    pub bandwidth_hz: f64,
    /// `K_s` in N/m, of `pd` only.
    pub stiffness: f64,
    /// `B_s` in N s/m, of `pd` only.
    pub damping: f64,
    /// In m/s; none without a bound.
    pub max_speed: Option<f64>,
    /// In m/s²; none without a bound.
    pub max_acceleration: Option<f64>,
    /// Period of its loop in s.
    pub period_s: f64,
    /// Where it starts, in m per axis.
    pub position: Vec<f64>,
    /// Its force sensor; without it the force is exact.
    pub force_sensor: Option<ForceSensorSpec>,
}

/// What an arm's controller takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ControlSpec {
    /// A position, tracked as a critically damped second-order system.
    Position,
    /// A velocity (from the commanded positions), tracked as a first-order system.
    Velocity,
    /// `M x'' = K_s (x_set - x) + B_s (V_set - V) + F_e`.
    Pd,
}

/// `[slave.force_sensor]`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ForceSensorSpec {
    /// Standard deviation in N.
    pub noise_n: f64,
    /// In N per axis.
    pub bias_n: Vec<f64>,
    /// In N; 0 is exact.
    pub quantum_n: f64,
    /// Samples per second; none for one at each tick.
    pub rate_hz: Option<f64>,
}

/// `[environment]`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EnvironmentSpec {
    /// How it acts on a device without an arm between.
    pub rendering: RenderingSpec,
    /// Ticks by which its force is late; only sampled, without an arm.
    pub delay_ticks: usize,
    /// What is touched.
    pub objects: Vec<ObjectSpec>,
    /// What pushes by itself.
    pub pushers: Vec<PusherSpec>,
}

/// How an environment acts on a device without an arm between.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RenderingSpec {
    /// Sampled and held at the servo rate, as hardware does.
    Sampled,
    /// At every instant, as physics does.
    Continuous,
}

/// `[[environment.objects]]`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ObjectSpec {
    /// Its shape.
    pub shape: ShapeSpec,
    /// How it resists.
    pub contact: ContactSpec,
    /// How it moves on its own.
    pub motion: Option<ObjectMotionSpec>,
    /// Its mass, if it slides freely.
    pub body: Option<BodySpec>,
}

/// The shape of an object.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum ShapeSpec {
    /// Fills the side of a plane that its normal points away from.
    Plane {
        /// A point on it, in m.
        point: Vec<f64>,
        /// Outward normal; need not have unit length.
        normal: Vec<f64>,
    },
    /// A ball.
    Sphere {
        /// In m.
        centre: Vec<f64>,
        /// In m.
        radius: f64,
    },
    /// A box along the axes.
    Box {
        /// In m.
        centre: Vec<f64>,
        /// In m per axis.
        half_extents: Vec<f64>,
    },
    /// A spring that pushes and pulls: `F = K (anchor - x) - B V`, everywhere.
    Spring {
        /// In m.
        anchor: Vec<f64>,
    },
}

/// How an object resists.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ContactSpec {
    /// The law along the normal.
    pub law: ContactLawSpec,
    /// K in N/m (N/m^n of Hunt and Crossley).
    pub stiffness: f64,
    /// B in N s/m of Kelvin and Voigt; chi in s/m of Hunt and Crossley.
    pub damping: f64,
    /// n of Hunt and Crossley.
    pub exponent: f64,
    /// Coefficient of Coulomb friction along the surface.
    pub friction: f64,
}

/// The law of a contact along the normal.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ContactLawSpec {
    /// `F = max(0, K d + B d')`.
    KelvinVoigt,
    /// `F = max(0, K d^n (1 + chi d'))`.
    HuntCrossley,
}

/// `[environment.objects.motion]`: constant velocity for a while, and a sine.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ObjectMotionSpec {
    /// In m/s per axis.
    pub velocity: Vec<f64>,
    /// When the velocity begins, in s.
    pub from_s: f64,
    /// When it ends, in s.
    pub until_s: f64,
    /// Amplitude in m per axis of a sine on top.
    pub amplitude: Vec<f64>,
    /// Its frequency in Hz.
    pub frequency_hz: f64,
}

/// `[environment.objects.body]`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BodySpec {
    /// In kg.
    pub mass_kg: f64,
    /// Viscous friction with the ground in N s/m.
    pub viscous: f64,
    /// Coulomb friction with the ground in N.
    pub coulomb: f64,
    /// V at the start, in m/s per axis.
    pub velocity: Vec<f64>,
}

/// `[[environment.pushers]]`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PusherSpec {
    /// Its course.
    pub shape: PusherShapeSpec,
    /// In s, since engagement; since the start without an arm.
    pub at_s: f64,
    /// In s.
    pub duration_s: f64,
    /// Rise of a ramp in s.
    pub rise_s: f64,
    /// Frequency of a sine in Hz.
    pub frequency_hz: f64,
    /// In N per axis.
    pub force_n: Vec<f64>,
    /// The course of a recorded one, in N.
    pub recorded: Option<SeriesSpec>,
}

/// The course of a push.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PusherShapeSpec {
    /// At once.
    Step,
    /// Rises linearly, then stays.
    Ramp,
    /// `F sin(pi t / duration)`.
    HalfSine,
    /// `F sin(2 pi f t)`.
    Sine,
    /// As recorded.
    Recorded,
}

/// `[link]`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LinksSpec {
    /// From master to slave.
    pub forward: Option<LinkSettings>,
    /// From slave to master.
    pub backward: Option<LinkSettings>,
    /// What the master's clock shows; without it, true time.
    pub master_clock: Option<ClockSettings>,
    /// What the slave's clock shows.
    pub slave_clock: Option<ClockSettings>,
}

/// `[security]`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SecuritySpec {
    /// Whether frames are encrypted and authenticated.
    pub secure: bool,
}

/// `[coupling]`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CouplingSpec {
    /// Which.
    pub kind: CouplingKindSpec,
    /// `lambda_p`.
    pub position_scale: f64,
    /// `lambda_f`.
    pub force_scale: f64,
    /// Rotation from the master's frame to the slave's, a unit quaternion.
    pub quat_wxyz: Vec<f64>,
    /// The slave's axes that do not follow, from 0.
    pub locked_axes: Vec<usize>,
    /// Fastest that the commanded position moves, in m/s; none without a bound.
    pub command_speed: Option<f64>,
    /// Largest distance in m of the commanded position from where the arm began; none without a bound.
    pub command_reach: Option<f64>,
    /// What is changed while it runs.
    pub changes: Vec<ChangeSpec>,
}

/// `[[coupling.changes]]`: what is not given stays as it is.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ChangeSpec {
    /// When, in s since the start.
    pub at_s: f64,
    /// The new `lambda_p`.
    pub position_scale: Option<f64>,
    /// The new `lambda_f`.
    pub force_scale: Option<f64>,
    /// The new rotation.
    pub quat_wxyz: Option<Vec<f64>>,
    /// The new locks.
    pub locked_axes: Option<Vec<usize>>,
}

/// Which coupling.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum CouplingKindSpec {
    /// Position forth, measured force back.
    PositionForce,
}

/// `[safety]`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SafetySpec {
    /// Who watches.
    pub controllers: Vec<ControllerSpec>,
    /// What the observers are told.
    pub signals: SignalsSpec,
    /// How V and A are had.
    pub estimator: EstimatorSpec,
    /// mu in N s/m.
    pub damping: f64,
    /// `V_t` in m/s.
    pub velocity_threshold: f64,
    /// `F_t` in N, of VFC.
    pub vfc_force_threshold_n: f64,
    /// Which reading of Eq. 1.
    pub vfc_form: VfcFormSpec,
    /// zeta.
    pub grasp_threshold: f64,
    /// alpha in N.
    pub grasp_floor_n: f64,
    /// `F_t` in N, of HSC.
    pub hsc_force_threshold_n: f64,
    /// delta in J.
    pub energy_threshold_j: f64,
    /// eta.
    pub energy_ratio: f64,
    /// w in ticks.
    pub window: usize,
    /// alpha in N s/m of PC.
    pub pc_max_damping: f64,
    /// In s.
    pub hold_off_s: f64,
    /// In s.
    pub release_ramp_s: f64,
    /// Bounds on the device force; none only where a study switches them off.
    pub limiter: Option<LimiterSpec>,
    /// Times of the ladder; only with an arm.
    pub ladder: Option<LadderSpec>,
}

/// `[safety.ladder]`, in s.
#[allow(clippy::struct_field_names)] // the unit
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LadderSpec {
    /// Over the expected age to STALE.
    pub stale_after_s: f64,
    /// Over the expected age to HOLD.
    pub hold_after_s: f64,
    /// Over the expected age to STOP.
    pub stop_after_s: f64,
    /// In STALE until the velocity of the slave has decayed to zero.
    pub extrapolate_s: f64,
    /// From full force to zero.
    pub fade_out_s: f64,
    /// From zero to full force.
    pub fade_in_s: f64,
}

/// Who watches.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ControllerSpec {
    /// Velocity and force.
    Vfc,
    /// Hand grasp.
    Hsc,
    /// Windowed energy.
    Wsc,
    /// Passivity.
    Pc,
}

/// What the observers are told.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SignalsSpec {
    /// What the estimator makes of the measured positions, as live.
    Estimated,
    /// The model's own velocity and hand force.
    True,
}

/// Which reading of Eq. 1.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum VfcFormSpec {
    /// As printed.
    Product,
    /// Both thresholds at the same time.
    Both,
}

/// `[safety.estimator]`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum EstimatorSpec {
    /// Backward difference.
    BackwardDifference {},
    /// First-order low-pass on it.
    LowPass {
        /// In Hz.
        cutoff_hz: f64,
    },
    /// First-order adaptive window.
    AdaptiveWindow {
        /// In m.
        noise_bound_m: f64,
        /// In ticks.
        max_window: usize,
        /// `end` or `best`.
        fit: FitSpec,
    },
    /// Savitzky and Golay.
    SavitzkyGolay {
        /// 2 or 3.
        degree: usize,
        /// In ticks.
        window: usize,
    },
    /// Kalman filter.
    Kalman {
        /// q in m²/s⁵.
        jerk_density: f64,
        /// In m.
        quantum_m: f64,
    },
}

/// The line of an adaptive window.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FitSpec {
    /// Through both ends.
    End,
    /// Least squares.
    Best,
}

/// `[safety.limiter]`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LimiterSpec {
    /// In N.
    pub max_force_n: f64,
    /// In N/s.
    pub max_slew_n_per_s: f64,
    /// In W.
    pub max_power_w: f64,
    /// In s.
    pub ramp_in_s: f64,
}

/// `[record]`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RecordSpec {
    /// Every so many ticks.
    pub every: u64,
}
