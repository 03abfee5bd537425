//! A scene as numbers: what the TOML file says, checked and with its defaults filled in.
//!
//! The tables that a user writes, their documentation, ranges and defaults are those of `bridge/scene/tables/`. What
//! describes one part (device, leg, arm, estimator, ladder, link) is the type that the part itself is built from. A
//! test holds the schema of these types against that of the tables.

use haptether_master::{
    DeviceParameters, Leg, Regrasp, Release, RotationHandParameters, RotationParameters, Tremor,
};
use haptether_netsim::{ClockSettings, LinkSettings};
use haptether_safety::{
    Axes, LimiterSettings,
    controller::{Controllers, SafetySettings},
    estimator::EstimatorKind,
};
use haptether_slave::{
    ArmSettings, HandleSettings, HoleSettings, ObjectSettings, PusherSettings, RigidBodySettings,
    SeriesSettings,
};
use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::Deserialize;

use crate::{
    ButtonSettings, LadderSettings, SideKind,
    coupling::{AlignmentSettings, CHANGE_FACTOR, CommandBounds, RotationBounds},
    scene::metrics::Metrics,
};

/// Runs an expression for the number of axes of a device; `$n` is that number as a constant, `$other` what any other
/// number leads to.
macro_rules! of_axes {
    ($axes:expr, $n:ident => $body:expr, $other:ident => $refused:expr) => {
        match $axes {
            1 => {
                const $n: usize = 1;
                $body
            }
            2 => {
                const $n: usize = 2;
                $body
            }
            3 => {
                const $n: usize = 3;
                $body
            }
            4 => {
                const $n: usize = 4;
                $body
            }
            5 => {
                const $n: usize = 5;
                $body
            }
            6 => {
                const $n: usize = 6;
                $body
            }
            7 => {
                const $n: usize = 7;
                $body
            }
            $other => $refused,
        }
    };
}
pub(super) use of_axes;

/// A scene of N axes, read from JSON: vectors are lists with one number per axis.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SceneSpec<const N: usize> {
    /// How it is run.
    pub run: RunSpec,
    /// The device.
    pub master: MasterSpec<N>,
    /// The hand; without it nobody holds the device.
    pub operator: Option<OperatorSpec<N>>,
    /// The arm; without it the environment is rendered on the device itself.
    pub slave: Option<ArmSettings<N>>,
    /// What is touched.
    pub environment: Option<EnvironmentSpec<N>>,
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
    /// What is measured: all, unless a sweep asks for less. No part of a scene as JSON.
    #[serde(skip)]
    pub metrics: Metrics,
}

/// The number of axes of a scene as JSON, for which its [`SceneSpec`] is read; the rest of it is not looked at.
///
/// # Errors
///
/// It is no JSON, or has no such number.
pub fn scene_axes(json: &[u8]) -> Result<usize, serde_json::Error> {
    #[derive(Deserialize)]
    struct Master {
        axes: usize,
    }
    #[derive(Deserialize)]
    struct Scene {
        master: Master,
    }
    serde_json::from_slice(json).map(|Scene { master: Master { axes } }| axes)
}

/// The schema of a scene, as JSON.
pub fn scene_schema() -> String {
    schemars::schema_for!(SceneSpec<1>).as_value().to_string()
}

/// `[run]`.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RunSpec {
    /// In s.
    pub duration_s: f64,
    /// dT of the master in s.
    pub period_s: f64,
    /// Seed of all randomness.
    pub seed: u64,
    /// Ends the run when nothing that is measured can change any more.
    pub stop_early: bool,
    /// |x| in m beyond which the loop has diverged.
    pub diverged_position: f64,
    /// |V| in m/s beyond which the loop has diverged.
    pub diverged_speed: f64,
}

/// `[master]`, after its preset has been filled in.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
pub struct MasterSpec<const N: usize> {
    /// What its coordinates are, and those of the slave.
    pub kind: SideKind,
    /// Number of axes: 1 to 7.
    pub axes: usize,
    /// Mechanics, encoder and motors.
    #[serde(flatten)]
    pub device: DeviceParameters<N>,
    /// Speed bound in m/s (rad/s) that its samples are held against; without it that of its kind.
    pub speed_bound: Option<f64>,
    /// Where it starts, in m per axis.
    #[schemars(with = "Vec<f64>")]
    pub position: Axes<N>,
    /// V at the start, in m/s per axis.
    #[schemars(with = "Vec<f64>")]
    pub velocity: Axes<N>,
    /// Mechanics of its rotation; of kind `pose` only.
    pub rotation: Option<RotationParameters>,
    /// What its buttons do.
    pub buttons: Option<ButtonSettings>,
    /// Its trigger, where the finger feels what the gripper holds.
    pub gripper: Option<TriggerSpec>,
}

/// `[master.gripper]`: a trigger with a motor. `m A + b V + c sign(V) = F_device + F_finger` along its closing way.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TriggerSpec {
    /// From open to closed, in m.
    pub travel_m: f64,
    /// m in kg, at the finger.
    pub mass_kg: f64,
    /// b in N s/m.
    pub viscous: f64,
    /// c in N.
    pub coulomb: f64,
    /// Resolution of its position in m; 0 is exact.
    pub encoder_quantum: f64,
    /// Finger force per force between the jaws.
    pub force_scale: f64,
    /// Largest force in N.
    pub max_force_n: f64,
    /// Largest growth of the force in N/s.
    pub max_slew_n_per_s: f64,
    /// Largest power in W that it may put into the finger.
    pub max_power_w: f64,
}

/// `[operator]`.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct OperatorSpec<const N: usize> {
    /// `K_h` in N/m.
    pub stiffness: f64,
    /// `B_h` in N s/m.
    pub damping: f64,
    /// Grip strength in N; none without a bound.
    pub grip_strength_n: Option<f64>,
    /// Where the path begins, in m per axis.
    #[schemars(with = "Vec<f64>")]
    pub start: Axes<N>,
    /// The legs of the path.
    pub legs: Vec<Leg<N>>,
    /// A recorded path instead of legs.
    pub recorded: Option<SeriesSettings<N>>,
    /// When it lets go.
    pub release: Option<Release>,
    /// How it takes hold again.
    pub regrasp: Option<Regrasp>,
    /// Tremor.
    pub tremor: Option<Tremor>,
    /// What the operator does with the clutch, where no times are given.
    pub clutch: ClutchSpec,
    /// Press and release times of the clutch in s.
    pub clutch_times: Option<Vec<(f64, f64)>>,
    /// From when both sides are ready after a hold to the new press, in s.
    pub clutch_reaction_s: f64,
    /// Times in s since engagement and positions of the trigger that leads the gripper.
    pub trigger: Vec<[f64; 2]>,
    /// The finger at a trigger that it feels.
    pub finger: Option<FingerSpec>,
    /// How it turns a device of kind `pose`; without it, nobody does.
    pub rotation: Option<RotationHandParameters>,
}

/// `[operator.finger]`: `F_finger = K_f (travel p_target - x) - B_f V`, up to its strength.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct FingerSpec {
    /// `K_f` in N/m.
    pub stiffness: f64,
    /// `B_f` in N s/m.
    pub damping: f64,
    /// Its strength in N; none without a bound.
    pub strength_n: Option<f64>,
    /// When it lets go of the trigger.
    pub release: Option<Release>,
}

/// What a simulated operator does with the clutch.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum ClutchSpec {
    /// Presses at the start and, after letting go, after each hold.
    Auto,
    /// Presses at the start.
    Once,
}

/// `[environment]`.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct EnvironmentSpec<const N: usize> {
    /// How it acts on a device without an arm between.
    pub rendering: RenderingSpec,
    /// Ticks by which its force is late; only sampled, without an arm.
    pub delay_ticks: usize,
    /// What is touched.
    pub objects: Vec<ObjectSettings<N>>,
    /// What pushes by itself.
    pub pushers: Vec<PusherSettings<N>>,
    /// What turns by itself; of kind `pose` only, as all that follows.
    pub torques: Vec<TorqueSpec<N>>,
    /// Holes.
    pub holes: Vec<HoleSettings>,
    /// Handles.
    pub handles: Vec<HandleSettings>,
    /// Bodies that a gripper can hold.
    pub bodies: Vec<RigidBodySettings>,
}

/// How a torque goes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum TorqueKind {
    /// At once.
    Step,
    /// Rising linearly and staying.
    Ramp,
    /// `tau sin(pi t / duration)`.
    HalfSine,
    /// `tau sin(2 pi f t)`.
    Sine,
}

/// `[[environment.torques]]`: a torque of its own on the tool.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TorqueSpec<const N: usize> {
    /// Its course.
    pub shape: TorqueKind,
    /// When it begins, in s since engagement.
    pub at_s: f64,
    /// How long it lasts, in s.
    pub duration_s: f64,
    /// Time in s in which a ramp rises.
    pub rise_s: f64,
    /// Of a sine, in Hz.
    pub frequency_hz: f64,
    /// In N m.
    #[schemars(with = "Vec<f64>")]
    pub torque_n_m: Axes<N>,
}

/// How an environment acts on a device without an arm between.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum RenderingSpec {
    /// Sampled and held at the servo rate, as hardware does.
    Sampled,
    /// At every instant, as physics does.
    Continuous,
}

/// `[link]`.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
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
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SecuritySpec {
    /// Whether frames are encrypted and authenticated.
    pub secure: bool,
}

/// `[coupling]`.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
pub struct CouplingSpec {
    /// Which.
    pub kind: CouplingKind,
    /// `lambda_p`.
    pub position_scale: f64,
    /// `lambda_f`.
    pub force_scale: f64,
    /// Rotation from the master's frame to the slave's, a unit quaternion.
    pub quat_wxyz: [f64; 4],
    /// The slave's axes that do not follow, from 0.
    pub locked_axes: Vec<usize>,
    /// What the slave takes of a remote command.
    #[serde(flatten)]
    pub bounds: CommandBounds,
    /// `lambda_r`.
    pub rotation_scale: f64,
    /// `lambda_tau`.
    pub torque_scale: f64,
    /// Whether the slave keeps its orientation.
    pub locks_rotation: bool,
    /// The axis of the slave's base frame about which alone it turns.
    pub rotation_axis: Option<[f64; 3]>,
    /// What the slave takes of a remote command of its orientation.
    #[serde(flatten)]
    pub rotation_bounds: RotationBounds,
    /// How the slave turns to the master before the two engage.
    pub alignment: Option<AlignmentSettings>,
    /// The point of the tool that is coupled, in its frame.
    pub reference_point: Option<[f64; 3]>,
    /// Largest factor, up and down, by which a scale may be changed while the clutch is closed.
    #[serde(default = "change_factor")]
    pub change_factor: f64,
    /// What is changed while it runs.
    pub changes: Vec<ChangeSpec>,
}

const fn change_factor() -> f64 {
    CHANGE_FACTOR
}

/// `[[coupling.changes]]`: what is not given stays as it is.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ChangeSpec {
    /// When, in s since the start.
    pub at_s: f64,
    /// The new `lambda_p`.
    pub position_scale: Option<f64>,
    /// The new `lambda_f`.
    pub force_scale: Option<f64>,
    /// The new `lambda_r`.
    pub rotation_scale: Option<f64>,
    /// The new `lambda_tau`.
    pub torque_scale: Option<f64>,
    /// The new rotation.
    pub quat_wxyz: Option<[f64; 4]>,
    /// The new locks.
    pub locked_axes: Option<Vec<usize>>,
}

/// Which coupling.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum CouplingKind {
    /// Position forth, measured force back.
    PositionForce,
}

/// `[safety]`.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
pub struct SafetySpec {
    /// Who watches, and the thresholds.
    #[serde(flatten)]
    pub settings: SafetySettings,
    /// What the observers see.
    pub signals: SignalsSpec,
    /// How V and A are estimated.
    pub estimator: EstimatorKind,
    /// Bounds on the device force; none only where a study switches them off.
    pub limiter: Option<LimiterSettings>,
    /// Times of the ladder; only with an arm.
    pub ladder: Option<LadderSettings>,
    /// What differs for torques, of kind `pose` only.
    pub rotation: Option<RotationSafetySpec>,
    /// What differs for the force at the trigger, with `[master.gripper]` only.
    pub gripper: Option<TriggerSafetySpec>,
    /// A controller of the caller's own behind the others.
    pub research: Option<ResearchSpec>,
}

/// `[safety.research]`: a controller of the caller's own, in simulated runs only.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ResearchSpec {
    /// Its name.
    pub controller: String,
    /// What it is made with.
    pub options: BTreeMap<String, serde_json::Value>,
}

/// `[safety.gripper]`: who watches the finger; what is not given is that of the hand, scaled.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TriggerSafetySpec {
    /// Way of the hand in m that the thresholds of the hand are for.
    pub reach_m: f64,
    /// Who watches.
    pub controllers: Option<Controllers>,
    /// mu in N s/m.
    pub damping: Option<f64>,
    /// In m/s, of VFC.
    pub velocity_threshold: Option<f64>,
    /// In N, of VFC.
    pub vfc_force_threshold_n: Option<f64>,
    /// zeta, of HSC.
    pub grasp_threshold: Option<f64>,
    /// alpha in N, of HSC.
    pub grasp_floor_n: Option<f64>,
    /// In N, of HSC.
    pub hsc_force_threshold_n: Option<f64>,
    /// delta in J, of WSC.
    pub energy_threshold_j: Option<f64>,
    /// Bound in N s/m on the damping of PC.
    pub pc_max_damping: Option<f64>,
}

/// `[safety.rotation]`: who watches torques; what is not given is that of forces at a lever.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RotationSafetySpec {
    /// Lever in m at which the hand holds the handle.
    pub lever_m: f64,
    /// Whether a trip of force or torque acts on both.
    pub shares_trips: bool,
    /// Who watches.
    pub controllers: Option<Controllers>,
    /// mu in N m s/rad.
    pub damping: Option<f64>,
    /// In rad/s, of VFC.
    pub velocity_threshold: Option<f64>,
    /// In N m, of VFC.
    pub vfc_torque_threshold_n_m: Option<f64>,
    /// zeta, of HSC.
    pub grasp_threshold: Option<f64>,
    /// alpha in N m, of HSC.
    pub grasp_floor_n_m: Option<f64>,
    /// In N m, of HSC.
    pub hsc_torque_threshold_n_m: Option<f64>,
    /// delta in J, of WSC.
    pub energy_threshold_j: Option<f64>,
    /// Bound in N m s/rad on the damping of PC.
    pub pc_max_damping: Option<f64>,
    /// Largest torque in N m.
    pub max_torque_n_m: Option<f64>,
    /// Largest growth of the torque in N m/s.
    pub max_slew_n_m_per_s: Option<f64>,
    /// Largest power in W that the torque may put into the hand.
    pub max_power_w: Option<f64>,
    /// Resolution of an angle in rad that the estimator takes the device to have.
    pub quantum_rad: Option<f64>,
}

/// What the observers see.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum SignalsSpec {
    /// What the estimator makes of the measured positions, as live.
    Estimated,
    /// The model's own velocity and hand force.
    True,
}

/// `[record]`.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RecordSpec {
    /// Every so many ticks.
    pub every: u64,
}
