//! A scene as numbers: the checked content of its TOML file, with all defaults filled in.
//!
//! The tables that a user writes, with documentation, ranges and defaults, are in `bridge/scene/tables/`. A part
//! (device, leg, arm, estimator, ladder, link) is read as the settings type of that part itself. A test compares the
//! schema of these types with that of the tables.

use haptether_master::{
    Aim, DeviceParameters, Leg, Regrasp, Release, RotationHandParameters, RotationParameters, Tremor,
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
    coupling::{AlignmentSettings, CHANGE_FACTOR, CommandBounds, CouplingKind, RotationBounds},
    scene::metrics::Metrics,
};

/// Scene of N axes, read from JSON: vectors are lists with one number per axis.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SceneSpec<const N: usize> {
    /// Duration and computation of the run.
    pub run: RunSpec,
    /// Haptic device.
    pub master: MasterSpec<N>,
    /// Hand; without it, no hand holds the device.
    pub operator: Option<OperatorSpec<N>>,
    /// Arm; without it, the environment is rendered on the device itself.
    pub slave: Option<ArmSettings<N>>,
    /// Objects and pushes.
    pub environment: Option<EnvironmentSpec<N>>,
    /// Network; without it, the sides share one link without delay.
    pub link: Option<LinksSpec>,
    /// Coupling of master and slave; only with an arm.
    pub coupling: Option<CouplingSpec>,
    /// Session of the frames; without it, frames are not encrypted.
    pub security: Option<SecuritySpec>,
    /// Safety layer of the hand.
    pub safety: SafetySpec,
    /// Recorded signals; without it, only metrics and events are kept.
    pub record: Option<RecordSpec>,
    /// Measured quantities: all by default, a subset in a sweep. Not part of the JSON of a scene.
    #[serde(skip)]
    pub metrics: Metrics,
}

/// Return the number of axes of a scene as JSON, which selects its [`SceneSpec`]. The other fields are ignored.
///
/// # Errors
///
/// The text is not valid JSON, or has no number of axes.
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

/// Return the schema of a scene as JSON.
pub fn scene_schema() -> String {
    schemars::schema_for!(SceneSpec<1>).as_value().to_string()
}

/// `[run]`.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RunSpec {
    /// Duration in s.
    pub duration_s: f64,
    /// dT of the master in s.
    pub period_s: f64,
    /// Seed of all random numbers.
    pub seed: u64,
    /// True to end the run when no measured quantity can change any more.
    pub stop_early: bool,
    /// |x| in m beyond which the loop has diverged.
    pub diverged_position: f64,
    /// |V| in m/s beyond which the loop has diverged.
    pub diverged_speed: f64,
}

/// `[master]`, after its preset has been filled in.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
pub struct MasterSpec<const N: usize> {
    /// Kind of coordinates of master and slave.
    pub kind: SideKind,
    /// Number of axes: 1 to 7.
    pub axes: usize,
    /// Mechanics, encoder and motors.
    #[serde(flatten)]
    pub device: DeviceParameters<N>,
    /// Speed limit in m/s (rad/s) of its samples; by default the limit of its kind.
    pub speed_bound: Option<f64>,
    /// Start position in m per axis.
    #[schemars(with = "Vec<f64>")]
    pub position: Axes<N>,
    /// V at the start, in m/s per axis.
    #[schemars(with = "Vec<f64>")]
    pub velocity: Axes<N>,
    /// Mechanics of its rotation; of kind `pose` only.
    pub rotation: Option<RotationParameters>,
    /// Functions of its buttons.
    pub buttons: Option<ButtonSettings>,
    /// Trigger with force feedback.
    pub gripper: Option<TriggerSpec>,
}

/// `[master.gripper]`: trigger with force feedback. `m A + b V + c sign(V) = F_device + F_finger` in closing
/// direction.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TriggerSpec {
    /// Travel from open to closed in m.
    pub travel_m: f64,
    /// m in kg, at the finger.
    pub mass_kg: f64,
    /// b in N s/m.
    pub viscous: f64,
    /// c in N.
    pub coulomb: f64,
    /// Position resolution in m; 0 is exact.
    pub encoder_quantum: f64,
    /// Ratio of finger force to jaw force.
    pub force_scale: f64,
    /// Largest force in N.
    pub max_force_n: f64,
    /// Largest growth of the force in N/s.
    pub max_slew_n_per_s: f64,
    /// Largest power in W into the finger.
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
    /// Grip strength in N; by default no bound.
    pub grip_strength_n: Option<f64>,
    /// Start of the path in m per axis.
    #[schemars(with = "Vec<f64>")]
    pub start: Axes<N>,
    /// Legs of the path.
    pub legs: Vec<Leg<N>>,
    /// Recorded path, as an alternative to legs.
    pub recorded: Option<SeriesSettings<N>>,
    /// Aims that the hand follows instead of a path.
    pub aims: Option<AimsSpec<N>>,
    /// Release of the device.
    pub release: Option<Release>,
    /// Grasp after the release.
    pub regrasp: Option<Regrasp>,
    /// Tremor.
    pub tremor: Option<Tremor>,
    /// Clutch, if no times are given.
    pub clutch: ClutchSpec,
    /// Press and release times of the clutch in s.
    pub clutch_times: Option<Vec<(f64, f64)>>,
    /// Time in s from when both sides are ready after a hold to the next press.
    pub clutch_reaction_s: f64,
    /// Command of the gripper: pairs of time in s since engagement and trigger position.
    pub trigger: Vec<[f64; 2]>,
    /// Finger on a trigger with force feedback.
    pub finger: Option<FingerSpec>,
    /// Rotation of a device of kind `pose` by the hand; by default none.
    pub rotation: Option<RotationHandParameters>,
}

/// `[operator.aims]`.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct AimsSpec<const N: usize> {
    /// Aims in order of time. Without any, those of a person at a live side.
    pub rows: Vec<AimSpec<N>>,
}

/// One aim of the hand.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, JsonSchema)]
pub struct AimSpec<const N: usize> {
    /// Time in s since the start.
    pub at_s: f64,
    /// The aim.
    #[serde(flatten)]
    pub aim: Aim<N>,
}

/// `[operator.finger]`: `F_finger = K_f (travel p_target - x) - B_f V`, saturated at its strength.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct FingerSpec {
    /// `K_f` in N/m.
    pub stiffness: f64,
    /// `B_f` in N s/m.
    pub damping: f64,
    /// Strength in N; by default no bound.
    pub strength_n: Option<f64>,
    /// Release of the trigger.
    pub release: Option<Release>,
}

/// Clutch of a simulated operator.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum ClutchSpec {
    /// Press at the start; after each hold release and press again.
    Auto,
    /// Press at the start only.
    Once,
}

/// `[environment]`.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct EnvironmentSpec<const N: usize> {
    /// Action on a device without an arm.
    pub rendering: RenderingSpec,
    /// Delay of its force in ticks; only if sampled, without an arm.
    pub delay_ticks: usize,
    /// Objects that can be touched.
    pub objects: Vec<ObjectSettings<N>>,
    /// Independent forces.
    pub pushers: Vec<PusherSettings<N>>,
    /// Independent torques; of kind `pose` only, like all fields below.
    pub torques: Vec<TorqueSpec<N>>,
    /// Holes.
    pub holes: Vec<HoleSettings>,
    /// Handles.
    pub handles: Vec<HandleSettings>,
    /// Bodies that a gripper can hold.
    pub bodies: Vec<RigidBodySettings>,
}

/// Course of a torque over time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum TorqueKind {
    /// Constant from its start.
    Step,
    /// Linear rise, then constant.
    Ramp,
    /// `tau sin(pi t / duration)`.
    HalfSine,
    /// `tau sin(2 pi f t)`.
    Sine,
}

/// `[[environment.torques]]`: independent torque on the tool.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TorqueSpec<const N: usize> {
    /// Course over time.
    pub shape: TorqueKind,
    /// Start in s since engagement.
    pub at_s: f64,
    /// Duration in s.
    pub duration_s: f64,
    /// Rise time of a ramp in s.
    pub rise_s: f64,
    /// Frequency of a sine in Hz.
    pub frequency_hz: f64,
    /// Torque in N m.
    #[schemars(with = "Vec<f64>")]
    pub torque_n_m: Axes<N>,
}

/// Action of an environment on a device without an arm.
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
    /// Link from master to slave.
    pub forward: Option<LinkSettings>,
    /// Link from slave to master.
    pub backward: Option<LinkSettings>,
    /// Clock of the master; by default exact.
    pub master_clock: Option<ClockSettings>,
    /// Clock of the slave; by default exact.
    pub slave_clock: Option<ClockSettings>,
}

/// `[security]`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SecuritySpec {
    /// True to encrypt and authenticate frames.
    pub secure: bool,
}

/// Kind and numbers of a coupling. Omitted numbers are those of the kind, of the device and of the arm.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, JsonSchema)]
pub struct CouplingNumbers {
    /// Coupling method.
    pub kind: CouplingKind,
    /// K in N/m; by default that of the coupling.
    #[serde(default)]
    pub stiffness: Option<f64>,
    /// B in N s/m; by default that of the coupling.
    #[serde(default)]
    pub damping: Option<f64>,
    /// b in N s/m: impedance of a wave, or damping `d0` of the master's port.
    #[serde(default)]
    pub impedance: Option<f64>,
    /// `E_0` in J of each side at the engagement.
    #[serde(default)]
    pub start_energy_j: Option<f64>,
    /// Time in s over which waves are spread.
    #[serde(default)]
    pub spread_s: Option<f64>,
    /// C2: gain of `F_e` at the hand.
    #[serde(default)]
    pub environment_gain: Option<f64>,
    /// C3: gain of `F_h` at the slave.
    #[serde(default)]
    pub grasp_gain: Option<f64>,
    /// Longest wait in s of a frame in the play-out; 0 for none.
    #[serde(default)]
    pub play_out_s: Option<f64>,
    /// `M_v` in kg of the virtual tool; by default that of a stiff wall.
    #[serde(default)]
    pub tool_mass_kg: Option<f64>,
    /// `B_v` in N s/m of the virtual tool; by default `10 M_v` per second.
    #[serde(default)]
    pub tool_damping: Option<f64>,
    /// K in N m/rad of the rotation; by default that of the force at the lever.
    #[serde(default)]
    pub rotational_stiffness: Option<f64>,
    /// B in N m s/rad of the rotation, likewise.
    #[serde(default)]
    pub rotational_damping: Option<f64>,
    /// Time in s by which the arm lags behind its command; by default that of its control.
    #[serde(default)]
    pub tool_lead_s: Option<f64>,
}

/// `[coupling]`.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
pub struct CouplingSpec {
    /// Kind and numbers.
    #[serde(flatten)]
    pub numbers: CouplingNumbers,
    /// `lambda_p`: slave motion per master motion.
    pub position_scale: f64,
    /// `lambda_f`: rendered force per measured force.
    pub force_scale: f64,
    /// Rotation from the master's frame to the slave's, a unit quaternion.
    pub quat_wxyz: [f64; 4],
    /// Slave axes, from 0, that do not follow.
    pub locked_axes: Vec<usize>,
    /// Bounds on a remote position command at the slave.
    #[serde(flatten)]
    pub bounds: CommandBounds,
    /// `lambda_r` of the rotation.
    pub rotation_scale: f64,
    /// `lambda_tau`: rendered torque per measured torque.
    pub torque_scale: f64,
    /// True if the slave keeps its orientation.
    pub locks_rotation: bool,
    /// Unit axis in the slave's base frame about which it turns; by default all axes.
    pub rotation_axis: Option<[f64; 3]>,
    /// Bounds on a remote orientation command at the slave.
    #[serde(flatten)]
    pub rotation_bounds: RotationBounds,
    /// Alignment of the slave with the master before engagement.
    pub alignment: Option<AlignmentSettings>,
    /// Coupled point of the tool, in the tool frame; by default the tool point.
    pub reference_point: Option<[f64; 3]>,
    /// Largest factor, up and down, by which a scale may change while the clutch is closed.
    #[serde(default = "change_factor")]
    pub change_factor: f64,
    /// Changes during the run.
    pub changes: Vec<ChangeSpec>,
    /// Couplings to which the operator may switch. All else is that of this table.
    #[serde(default)]
    pub alternatives: Vec<CouplingNumbers>,
}

impl CouplingSpec {
    /// Return the coupling with the kind and the numbers of an alternative, without switches.
    pub(crate) fn with(&self, numbers: CouplingNumbers) -> Self {
        let changes = self.changes.iter().map(|change| ChangeSpec { kind: None, ..change.clone() }).collect();
        Self { numbers, changes, alternatives: Vec::new(), ..self.clone() }
    }
}

const fn change_factor() -> f64 {
    CHANGE_FACTOR
}

/// `[[coupling.changes]]`: omitted fields keep their values.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ChangeSpec {
    /// Time in s since the start.
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
    /// The new locked axes.
    pub locked_axes: Option<Vec<usize>>,
    /// Coupling to which the operator switches.
    #[serde(default)]
    pub kind: Option<CouplingKind>,
}

/// `[safety]`.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
pub struct SafetySpec {
    /// Controllers and thresholds.
    #[serde(flatten)]
    pub settings: SafetySettings,
    /// Input of the observers.
    pub signals: SignalsSpec,
    /// Estimator of V and A.
    pub estimator: EstimatorKind,
    /// Bounds of the device force; none only in studies that disable them.
    pub limiter: Option<LimiterSettings>,
    /// Times of the ladder; only with an arm.
    pub ladder: Option<LadderSettings>,
    /// Settings that differ for torques; of kind `pose` only.
    pub rotation: Option<RotationSafetySpec>,
    /// Settings that differ for the trigger force; with `[master.gripper]` only.
    pub gripper: Option<TriggerSafetySpec>,
    /// Custom controller, evaluated after the others.
    pub research: Option<ResearchSpec>,
}

/// `[safety.research]`: custom controller, in simulated runs only.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ResearchSpec {
    /// Name of the controller.
    pub controller: String,
    /// Keyword arguments of its factory.
    pub options: BTreeMap<String, serde_json::Value>,
}

/// `[safety.gripper]`: controllers of the trigger force. Omitted values follow from those of the hand, scaled.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TriggerSafetySpec {
    /// Travel of the hand in m for which its thresholds hold.
    pub reach_m: f64,
    /// Active controllers.
    pub controllers: Option<Controllers>,
    /// mu in N s/m.
    pub damping: Option<f64>,
    /// VFC velocity threshold in m/s.
    pub velocity_threshold: Option<f64>,
    /// VFC force threshold in N.
    pub vfc_force_threshold_n: Option<f64>,
    /// zeta of HSC.
    pub grasp_threshold: Option<f64>,
    /// alpha of HSC in N.
    pub grasp_floor_n: Option<f64>,
    /// HSC force threshold in N.
    pub hsc_force_threshold_n: Option<f64>,
    /// delta of WSC in J.
    pub energy_threshold_j: Option<f64>,
    /// Damping bound of PC in N s/m.
    pub pc_max_damping: Option<f64>,
}

/// `[safety.rotation]`: controllers of the torque. Omitted values follow from those of the force at a lever.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RotationSafetySpec {
    /// Distance in m of the hand from the centre of the handle.
    pub lever_m: f64,
    /// True if a trip of force or torque acts on both.
    pub shares_trips: bool,
    /// Active controllers.
    pub controllers: Option<Controllers>,
    /// mu in N m s/rad.
    pub damping: Option<f64>,
    /// VFC velocity threshold in rad/s.
    pub velocity_threshold: Option<f64>,
    /// VFC torque threshold in N m.
    pub vfc_torque_threshold_n_m: Option<f64>,
    /// zeta of HSC.
    pub grasp_threshold: Option<f64>,
    /// alpha of HSC in N m.
    pub grasp_floor_n_m: Option<f64>,
    /// HSC torque threshold in N m.
    pub hsc_torque_threshold_n_m: Option<f64>,
    /// delta of WSC in J.
    pub energy_threshold_j: Option<f64>,
    /// Damping bound of PC in N m s/rad.
    pub pc_max_damping: Option<f64>,
    /// Largest torque in N m.
    pub max_torque_n_m: Option<f64>,
    /// Largest growth of the torque in N m/s.
    pub max_slew_n_m_per_s: Option<f64>,
    /// Largest power in W from the torque into the hand.
    pub max_power_w: Option<f64>,
    /// Angular resolution in rad that the estimator assumes for the device.
    pub quantum_rad: Option<f64>,
}

/// Input of the observers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum SignalsSpec {
    /// Estimates from measured positions, as live.
    Estimated,
    /// Velocity and hand force of the model.
    True,
}

/// `[record]`.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RecordSpec {
    /// Sampling interval in ticks.
    pub every: u64,
}
