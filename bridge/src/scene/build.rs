//! From the numbers of a scene to its parts.

use haptether_master::{
    ContinuousWall, DeviceParameters, Friction, Hand, Leg, LegShape, ModelError as MasterError, Path,
    Regrasp, Release, ReleaseKind, SimulatedMaster, SteppedMaster, Stepping, Tremor,
};
use haptether_netsim::LinkSettings;
use haptether_safety::{
    Axes, DeviceModel, LayerSettings, Limiter, LimiterSettings, ParameterError, SafetyLayer,
    controller::{SafetyController, SafetySettings},
    estimator::{EstimatorKind, Fit},
    observer::VelocityForceForm,
};
use haptether_slave::{
    ArmControl, ArmModel, Contact, ContactLaw, Environment, ForceSensor, FreeBody, ModelError as SlaveError,
    Object, ObjectMotion, PushShape, Pusher, RenderedPush, RenderedWall, RenderedWalls, Series, Shape,
};

use super::{
    measures::MeasureSettings,
    spec::{
        ContactLawSpec, ControlSpec, ControllerSpec, EnvironmentSpec, EstimatorSpec, FitSpec, FrictionSpec,
        IntegratorSpec, LegShapeSpec, MasterSpec, ObjectSpec, OperatorSpec, PersonSpec, PusherShapeSpec,
        PusherSpec, ReleaseKindSpec, SafetySpec, SceneSpec, SeriesSpec, ShapeSpec, SlaveSpec, VfcFormSpec,
    },
};
use crate::{Clutch, local::Watch};

/// A scene that cannot be built.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SceneError {
    /// A number of the device or the hand.
    #[error("master or operator: {0}")]
    Master(#[from] MasterError),
    /// A number of the arm or of what is touched.
    #[error("slave or environment: {0}")]
    Slave(#[from] SlaveError),
    /// A parameter of the safety layer.
    #[error("safety: {0}")]
    Safety(#[from] ParameterError),
    /// An endpoint.
    #[error("{0}")]
    Endpoint(#[from] crate::EndpointError),
    /// The network.
    #[error("link: {0}")]
    Link(#[from] haptether_netsim::LinkError),
    /// The clutch.
    #[error("operator.clutch: {0}")]
    Clutch(#[from] crate::ClutchError),
    /// The session.
    #[error("security: {0}")]
    Session(#[from] crate::session::EndError),
    /// It was told to stop.
    #[error("stopped")]
    Stopped,
    /// Tables or keys that contradict each other.
    #[error("{0}")]
    Contradiction(String),
}

impl From<crate::VirtualError> for SceneError {
    fn from(error: crate::VirtualError) -> Self {
        match error {
            crate::VirtualError::Link(error) => error.into(),
            crate::VirtualError::Session(error) => error.into(),
        }
    }
}

fn contradiction<T>(text: impl Into<String>) -> Result<T, SceneError> {
    Err(SceneError::Contradiction(text.into()))
}

/// Reaction of a simulated person in ns where no operator says another.
const REACTION_NS: u64 = 500_000_000;

/// How the clutch of the master is worked.
pub(crate) fn clutch(scene: &SceneSpec) -> Clutch {
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // not negative, and saturates
    let ns = |seconds: f64| (seconds * 1e9).round() as u64;
    let Some(operator) = &scene.operator else {
        return Clutch::Auto { reaction_ns: REACTION_NS };
    };
    match (&operator.clutch_times, operator.clutch) {
        (Some(times), _) => {
            Clutch::Schedule(times.iter().map(|(press, release)| (ns(*press), ns(*release))).collect())
        }
        (None, PersonSpec::Once) => Clutch::Once,
        (None, PersonSpec::Auto) => Clutch::Auto { reaction_ns: ns(operator.clutch_reaction_s) },
    }
}

/// One value per axis.
pub(crate) fn axes<const N: usize>(name: &str, values: &[f64]) -> Result<Axes<N>, SceneError> {
    if values.len() == N {
        Ok(Axes::from_column_slice(values))
    } else {
        contradiction(format!("{name}: {} values, must have {N}, one per axis", values.len()))
    }
}

/// One value per axis, of which only the direction counts: so short a vector that its square is 0 has one too.
fn direction<const N: usize>(name: &str, values: &[f64]) -> Result<Axes<N>, SceneError> {
    let vector = axes::<N>(name, values)?;
    let most = vector.amax();
    Ok(if most > 0.0 { vector / most } else { vector })
}

/// A period as a whole number of ns.
pub(crate) fn period_ns(name: &str, seconds: f64) -> Result<u64, SceneError> {
    let ns = seconds * 1e9;
    if !(1e4..=2e7).contains(&ns) || (ns - ns.round()).abs() > 1e-3 {
        return contradiction(format!(
            "{name} = {seconds}: must be a whole number of nanoseconds between 1e-5 and 2e-2 s"
        ));
    }
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // checked above
    Ok(ns.round() as u64)
}

/// Most ticks of one run.
const MOST_TICKS: f64 = 2e7;

/// Most steps of an integrator in one run: minutes.
const MOST_STEPS: f64 = 1e9;

/// How many ticks of `period_s` a run of `duration_s` has.
pub(crate) fn ticks(scene: &SceneSpec) -> Result<u64, SceneError> {
    let (duration, period) = (scene.run.duration_s, scene.run.period_s);
    let ticks = (duration / period).round();
    if !(duration > 0.0 && (1.0..=MOST_TICKS).contains(&ticks)) {
        return contradiction(format!(
            "run: duration_s = {duration} of ticks of {period} s is {ticks} ticks, must be 1 to 2e7"
        ));
    }
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // checked above
    Ok(ticks as u64)
}

/// Most ticks by which an environment is late.
const MOST_LATE: usize = 100_000;

/// By how many ticks the force of the environment is late.
pub(crate) fn late(scene: &SceneSpec) -> Result<usize, SceneError> {
    let ticks = scene.environment.as_ref().map_or(0, |environment| environment.delay_ticks);
    if ticks > MOST_LATE {
        return contradiction(format!("environment.delay_ticks = {ticks}: must be at most {MOST_LATE}"));
    }
    Ok(ticks)
}

pub(crate) fn device<const N: usize>(spec: &MasterSpec) -> Result<DeviceParameters<N>, SceneError> {
    let stops = match &spec.stops {
        Some(stops) if stops.len() == N => {
            (Axes::from_fn(|axis, _| stops[axis].0), Axes::from_fn(|axis, _| stops[axis].1))
        }
        Some(stops) => {
            return contradiction(format!(
                "master.stops: {} pairs, must have {N}, one per axis",
                stops.len()
            ));
        }
        None => (Axes::repeat(f64::NEG_INFINITY), Axes::repeat(f64::INFINITY)),
    };
    let device = DeviceParameters {
        mass_kg: axes("master.mass_kg", &spec.mass_kg)?,
        viscous: axes("master.viscous", &spec.viscous)?,
        coulomb: axes("master.coulomb", &spec.coulomb)?,
        friction: match spec.friction {
            FrictionSpec::Vector => Friction::Vector,
            FrictionSpec::Axis => Friction::Axis,
        },
        encoder_quantum: spec.encoder_quantum,
        measures_velocity: spec.measures_velocity,
        stops,
        max_force_n: spec.max_force_n.unwrap_or(f64::INFINITY),
        force_quantum_n: spec.force_quantum_n,
    };
    device.check()?;
    Ok(device)
}

/// Shortest leg of a path in s; `bridge/scene_spec.py` lets no two points of a recording be closer.
const LEAST_LEG_S: f64 = 1e-9;

fn path<const N: usize>(spec: &OperatorSpec) -> Result<Path<N>, SceneError> {
    let start = axes("operator.start", &spec.start)?;
    let Some(SeriesSpec { time_s, values }) = &spec.recorded else {
        let legs = spec.legs.iter().map(|leg| {
            Ok(Leg {
                duration_s: leg.duration_s,
                end: axes("operator.legs.end", &leg.end)?,
                shape: match leg.shape {
                    LegShapeSpec::Linear => LegShape::Linear,
                    LegShapeSpec::Smooth => LegShape::Smooth,
                    LegShapeSpec::MinimumJerk => LegShape::MinimumJerk,
                },
            })
        });
        return Ok(Path::new(start, legs.collect::<Result<_, SceneError>>()?)?);
    };
    if time_s.is_empty() || time_s.len() != values.len() {
        return contradiction("operator.recorded: must have as many values as times, and at least one");
    }
    let rows = values.iter().map(|row| axes::<N>("operator.recorded", row)).collect::<Result<Vec<_>, _>>()?;
    let mut legs = Vec::with_capacity(rows.len());
    let mut before = 0.0;
    for (time, row) in time_s.iter().zip(&rows) {
        if *time - before >= LEAST_LEG_S {
            legs.push(Leg { duration_s: time - before, end: *row, shape: LegShape::Linear });
            before = *time;
        }
    }
    Ok(Path::new(rows[0], legs)?)
}

pub(crate) fn hand<const N: usize>(scene: &SceneSpec) -> Result<Hand<N>, SceneError> {
    let Some(spec) = &scene.operator else {
        return Ok(Hand::absent(axes("master.position", &scene.master.position)?)?);
    };
    let release = spec.release.as_ref().map(|release| Release {
        at_s: release.at_s,
        duration_s: release.decay_s,
        kind: match release.kind {
            ReleaseKindSpec::Strength => ReleaseKind::Strength,
            ReleaseKindSpec::Gain => ReleaseKind::Gain,
        },
    });
    let strength = spec.grip_strength_n.unwrap_or(f64::INFINITY);
    let mut hand = Hand::new(spec.stiffness, spec.damping, strength, path(spec)?, release)?;
    if let Some(regrasp) = &spec.regrasp {
        hand = hand.with_regrasp(Regrasp { reaction_s: regrasp.reaction_s, rise_s: regrasp.rise_s })?;
    }
    if let Some(tremor) = &spec.tremor {
        hand = hand.with_tremor(Tremor { amplitude: tremor.amplitude, frequency_hz: tremor.frequency_hz })?;
    }
    Ok(hand)
}

/// The walls that a continuous environment is made of.
fn continuous_walls<const N: usize>(spec: &SceneSpec) -> Result<Vec<ContinuousWall<N>>, SceneError> {
    let Some(environment) = &spec.environment else { return Ok(Vec::new()) };
    let mut walls = Vec::new();
    for (point, normal, stiffness, damping, is_two_sided) in planes::<N>(environment)? {
        walls.push(ContinuousWall::new(point, normal, stiffness, damping, is_two_sided)?);
    }
    Ok(walls)
}

type Plane<const N: usize> = (Axes<N>, Axes<N>, f64, f64, bool);

/// Planes and springs of an environment, as planes.
fn planes<const N: usize>(environment: &EnvironmentSpec) -> Result<Vec<Plane<N>>, SceneError> {
    let mut planes = Vec::new();
    for object in &environment.objects {
        let (stiffness, damping) = (object.contact.stiffness, object.contact.damping);
        match &object.shape {
            ShapeSpec::Plane { point, normal } => planes.push((
                axes("environment.objects.shape.point", point)?,
                direction("environment.objects.shape.normal", normal)?,
                stiffness,
                damping,
                false,
            )),
            ShapeSpec::Spring { anchor } => {
                let anchor = axes("environment.objects.shape.anchor", anchor)?;
                for axis in 0..N {
                    let mut normal = Axes::zeros();
                    normal[axis] = 1.0;
                    planes.push((anchor, normal, stiffness, damping, true));
                }
            }
            ShapeSpec::Sphere { .. } | ShapeSpec::Box { .. } => {
                return contradiction("environment: only planes and springs act continuously");
            }
        }
    }
    Ok(planes)
}

/// Whether all that is touched are resting planes and springs of Kelvin and Voigt, and formulas push.
pub(crate) fn is_plain(environment: &EnvironmentSpec) -> bool {
    let is_plain = |object: &ObjectSpec| {
        matches!(object.shape, ShapeSpec::Plane { .. } | ShapeSpec::Spring { .. })
            && object.contact.law == ContactLawSpec::KelvinVoigt
            && object.contact.friction == 0.0
            && object.motion.is_none()
            && object.body.is_none()
    };
    environment.objects.iter().all(is_plain)
        && environment.pushers.iter().all(|pusher| pusher.shape != PusherShapeSpec::Recorded)
}

pub(crate) fn rendered_walls<const N: usize>(
    environment: Option<&EnvironmentSpec>,
    with_objects: bool,
) -> Result<RenderedWalls<N>, SceneError> {
    let Some(environment) = environment else { return Ok(RenderedWalls::new(&[], &[])?) };
    let planes = if with_objects { planes::<N>(environment)? } else { Vec::new() };
    let walls: Vec<_> = planes
        .into_iter()
        .map(|(point, normal, stiffness, damping, is_two_sided)| RenderedWall {
            normal,
            point,
            stiffness,
            damping,
            is_two_sided,
        })
        .collect();
    let pushes = environment.pushers.iter().map(|pusher| {
        Ok(RenderedPush {
            shape: push_shape(pusher),
            at_s: pusher.at_s,
            duration_s: pusher.duration_s,
            force_n: axes("environment.pushers.force_n", &pusher.force_n)?,
        })
    });
    Ok(RenderedWalls::new(&walls, &pushes.collect::<Result<Vec<_>, SceneError>>()?)?)
}

fn push_shape(pusher: &PusherSpec) -> PushShape {
    match pusher.shape {
        PusherShapeSpec::Step | PusherShapeSpec::Recorded => PushShape::Step,
        PusherShapeSpec::Ramp => PushShape::Ramp { rise_s: pusher.rise_s },
        PusherShapeSpec::HalfSine => PushShape::HalfSine,
        PusherShapeSpec::Sine => PushShape::Sine { frequency_hz: pusher.frequency_hz },
    }
}

/// What is touched in a scene and what pushes there, for an arm that the scene does not have.
pub fn scene_environment<const N: usize>(scene: &SceneSpec) -> Result<Environment<N>, SceneError> {
    if scene.master.axes != N {
        return contradiction(format!("master.axes = {}: must be {N}", scene.master.axes));
    }
    environment(scene.environment.as_ref())
}

pub(crate) fn environment<const N: usize>(
    spec: Option<&EnvironmentSpec>,
) -> Result<Environment<N>, SceneError> {
    let Some(spec) = spec else { return Ok(Environment::empty()) };
    let objects = spec.objects.iter().map(object).collect::<Result<Vec<_>, _>>()?;
    let pushers = spec.pushers.iter().map(pusher).collect::<Result<Vec<_>, _>>()?;
    Ok(Environment::new(objects, pushers))
}

fn object<const N: usize>(spec: &ObjectSpec) -> Result<Object<N>, SceneError> {
    let key = |name: &str| format!("environment.objects.{name}");
    let shape = match &spec.shape {
        ShapeSpec::Plane { point, normal } => {
            Shape::plane(axes(&key("shape.point"), point)?, direction(&key("shape.normal"), normal)?)?
        }
        ShapeSpec::Sphere { centre, radius } => Shape::sphere(axes(&key("shape.centre"), centre)?, *radius)?,
        ShapeSpec::Box { centre, half_extents } => Shape::cuboid(
            axes(&key("shape.centre"), centre)?,
            axes(&key("shape.half_extents"), half_extents)?,
        )?,
        ShapeSpec::Spring { anchor } => Shape::spring(axes(&key("shape.anchor"), anchor)?)?,
    };
    let (stiffness, damping) = (spec.contact.stiffness, spec.contact.damping);
    let law = match spec.contact.law {
        ContactLawSpec::KelvinVoigt => ContactLaw::KelvinVoigt { stiffness, damping },
        ContactLawSpec::HuntCrossley => {
            ContactLaw::HuntCrossley { stiffness, exponent: spec.contact.exponent, damping }
        }
    };
    let contact = Contact::new(law, spec.contact.friction)?;
    Ok(match (&spec.motion, &spec.body) {
        (None, None) => Object::fixed(shape, contact)?,
        (Some(motion), None) => {
            let velocity = axes(&key("motion.velocity"), &motion.velocity)?;
            let amplitude = axes(&key("motion.amplitude"), &motion.amplitude)?;
            let motion =
                ObjectMotion::new(velocity, motion.from_s, motion.until_s, amplitude, motion.frequency_hz)?;
            Object::moving(shape, contact, motion)?
        }
        (None, Some(body)) => {
            let velocity = axes(&key("body.velocity"), &body.velocity)?;
            Object::free(shape, contact, FreeBody::new(body.mass_kg, body.viscous, body.coulomb, velocity)?)?
        }
        (Some(_), Some(_)) => {
            return contradiction(
                "environment.objects: an object has a motion of its own or a body, not both",
            );
        }
    })
}

fn pusher<const N: usize>(spec: &PusherSpec) -> Result<Pusher<N>, SceneError> {
    if spec.shape == PusherShapeSpec::Recorded {
        let Some(SeriesSpec { time_s, values }) = &spec.recorded else {
            return contradiction("environment.pushers: a recorded push needs its recording");
        };
        let rows = values.iter().map(|row| axes("environment.pushers.recorded", row));
        let series = Series::new(time_s.clone(), rows.collect::<Result<_, _>>()?)?;
        return Ok(Pusher::recorded(series, spec.at_s, spec.duration_s)?);
    }
    let force = axes("environment.pushers.force_n", &spec.force_n)?;
    Ok(Pusher::shaped(push_shape(spec), spec.at_s, spec.duration_s, force)?)
}

pub(crate) fn arm(spec: &SlaveSpec) -> Result<ArmModel, SceneError> {
    let control = match spec.control {
        ControlSpec::Position => ArmControl::Position { bandwidth_hz: spec.bandwidth_hz },
        ControlSpec::Velocity => ArmControl::Velocity { bandwidth_hz: spec.bandwidth_hz },
        ControlSpec::Pd => ArmControl::Pd { stiffness: spec.stiffness, damping: spec.damping },
    };
    Ok(ArmModel::new(control, spec.mass_kg, spec.max_speed, spec.max_acceleration)?)
}

pub(crate) fn force_sensor<const N: usize>(
    spec: &SlaveSpec,
    seed: u64,
) -> Result<Option<ForceSensor<N>>, SceneError> {
    let Some(sensor) = &spec.force_sensor else { return Ok(None) };
    let bias = axes("slave.force_sensor.bias_n", &sensor.bias_n)?;
    Ok(Some(ForceSensor::new(sensor.noise_n, bias, sensor.quantum_n, sensor.rate_hz, seed)?))
}

pub(crate) fn device_model<const N: usize>(spec: &MasterSpec) -> Result<DeviceModel<N>, SceneError> {
    Ok(DeviceModel::new(
        axes("master.mass_kg", &spec.mass_kg)?,
        axes("master.viscous", &spec.viscous)?,
        axes("master.coulomb", &spec.coulomb)?,
    )?)
}

pub(crate) fn safety_settings(spec: &SafetySpec) -> SafetySettings {
    let watches = |which| spec.controllers.contains(&which);
    SafetySettings {
        vfc: watches(ControllerSpec::Vfc),
        hsc: watches(ControllerSpec::Hsc),
        wsc: watches(ControllerSpec::Wsc),
        pc: watches(ControllerSpec::Pc),
        damping: spec.damping,
        velocity_threshold: spec.velocity_threshold,
        vfc_force_threshold_n: spec.vfc_force_threshold_n,
        vfc_form: match spec.vfc_form {
            VfcFormSpec::Product => VelocityForceForm::Product,
            VfcFormSpec::Both => VelocityForceForm::Both,
        },
        grasp_threshold: spec.grasp_threshold,
        grasp_floor_n: spec.grasp_floor_n,
        hsc_force_threshold_n: spec.hsc_force_threshold_n,
        energy_threshold_j: spec.energy_threshold_j,
        energy_ratio: spec.energy_ratio,
        window: spec.window,
        pc_max_damping: spec.pc_max_damping,
        hold_off_s: spec.hold_off_s,
        release_ramp_s: spec.release_ramp_s,
    }
}

pub(crate) fn estimator(spec: &EstimatorSpec) -> EstimatorKind {
    match *spec {
        EstimatorSpec::BackwardDifference {} => EstimatorKind::BackwardDifference,
        EstimatorSpec::LowPass { cutoff_hz } => EstimatorKind::LowPass { cutoff_hz },
        EstimatorSpec::AdaptiveWindow { noise_bound_m, max_window, fit } => EstimatorKind::AdaptiveWindow {
            noise_bound_m,
            max_window,
            fit: match fit {
                FitSpec::End => Fit::End,
                FitSpec::Best => Fit::Best,
            },
        },
        EstimatorSpec::SavitzkyGolay { degree, window } => EstimatorKind::SavitzkyGolay { degree, window },
        EstimatorSpec::Kalman { jerk_density, quantum_m } => {
            EstimatorKind::Kalman { jerk_density, quantum_m }
        }
    }
}

/// Bounds that nothing reaches: a study has switched the limiter off.
const WITHOUT_BOUNDS: LimiterSettings =
    LimiterSettings { max_force_n: 1e15, max_slew_n_per_s: 1e18, max_power_w: 1e18, ramp_in_s: 0.0 };

pub(crate) fn limiter(spec: &SafetySpec) -> LimiterSettings {
    spec.limiter.as_ref().map_or(WITHOUT_BOUNDS, |limiter| LimiterSettings {
        max_force_n: limiter.max_force_n,
        max_slew_n_per_s: limiter.max_slew_n_per_s,
        max_power_w: limiter.max_power_w,
        ramp_in_s: limiter.ramp_in_s,
    })
}

/// Who watches a scene without an arm.
pub(crate) fn watch<const N: usize>(scene: &SceneSpec) -> Result<Watch<N>, SceneError> {
    let (device, safety) = (device_model::<N>(&scene.master)?, safety_settings(&scene.safety));
    let period_s = scene.run.period_s;
    if scene.safety.signals == super::spec::SignalsSpec::True {
        let controller = SafetyController::new(&device, period_s, &safety)?;
        let limiters = scene.safety.limiter.as_ref().map(|_| {
            let settings = limiter(&scene.safety);
            Ok::<_, ParameterError>([
                Limiter::new(period_s, settings)?,
                Limiter::new(period_s, LimiterSettings { ramp_in_s: 0.0, ..settings })?,
            ])
        });
        return Ok(Watch::True { controller, limiters: limiters.transpose()? });
    }
    let layer = SafetyLayer::new(&LayerSettings {
        device,
        period_s,
        estimator: estimator(&scene.safety.estimator),
        safety,
        limiter: limiter(&scene.safety),
    })?;
    Ok(Watch::Estimated(Box::new(layer)))
}

/// Whether the environment acts on the device at every instant.
pub(crate) fn is_continuous(scene: &SceneSpec) -> bool {
    let continuous = super::spec::RenderingSpec::Continuous;
    scene.environment.as_ref().is_some_and(|environment| environment.rendering == continuous)
}

/// Walls that act on the device by themselves.
pub(crate) fn walls_on_device<const N: usize>(
    scene: &SceneSpec,
) -> Result<Vec<ContinuousWall<N>>, SceneError> {
    if !is_continuous(scene) {
        return Ok(Vec::new());
    }
    if scene.environment.as_ref().is_some_and(|environment| !is_plain(environment)) {
        return contradiction(
            "environment.rendering = \"continuous\": only resting planes and springs of Kelvin and Voigt, \
             without friction, act continuously",
        );
    }
    continuous_walls(scene)
}

/// The device advanced by its exact solution.
pub(crate) fn exact_master<const N: usize>(scene: &SceneSpec) -> Result<SimulatedMaster<N>, SceneError> {
    let mut master =
        SimulatedMaster::new(device(&scene.master)?, hand(scene)?, 0)?.among(walls_on_device(scene)?)?;
    let position = axes("master.position", &scene.master.position)?;
    master.place(position, axes("master.velocity", &scene.master.velocity)?)?;
    Ok(master)
}

/// The device advanced in steps.
pub(crate) fn stepped_master<const N: usize>(
    scene: &SceneSpec,
    stepping: Stepping,
) -> Result<SteppedMaster<N>, SceneError> {
    let step_s = scene.run.step_s.unwrap_or(scene.run.period_s);
    let steps = scene.run.period_s / step_s;
    if !(step_s > 0.0 && steps >= 1.0 - 1e-9 && (steps - steps.round()).abs() < 1e-6 * steps) {
        return contradiction(format!(
            "run.step_s = {step_s}: must go a whole number of times into period_s = {}",
            scene.run.period_s
        ));
    }
    let total = steps * scene.run.duration_s / scene.run.period_s;
    if total > MOST_STEPS {
        return contradiction(format!(
            "run.step_s = {step_s}: makes {total:.3e} steps of the run, must be at most {MOST_STEPS:e}"
        ));
    }
    let (device, hand, walls) = (device(&scene.master)?, hand(scene)?, walls_on_device(scene)?);
    let mut master =
        SteppedMaster::new(&device, &hand, &walls, stepping, step_s, scene.master.friction_speed)?;
    let position = axes("master.position", &scene.master.position)?;
    master.place(position, axes("master.velocity", &scene.master.velocity)?)?;
    Ok(master)
}

/// The method of an integrator that has steps.
pub(crate) fn stepping(integrator: IntegratorSpec) -> Option<Stepping> {
    match integrator {
        IntegratorSpec::Exact => None,
        IntegratorSpec::SemiImplicitEuler => Some(Stepping::SemiImplicitEuler),
        IntegratorSpec::VelocityVerlet => Some(Stepping::VelocityVerlet),
        IntegratorSpec::Rk4 => Some(Stepping::RungeKutta4),
    }
}

/// How a run is judged.
pub(crate) fn measures(scene: &SceneSpec) -> MeasureSettings {
    let operator = scene.operator.as_ref();
    let release = operator.and_then(|operator| operator.release.as_ref());
    let mut quiet_after: f64 = 0.0;
    if let Some(operator) = operator {
        let legs: f64 = operator.legs.iter().map(|leg| leg.duration_s).sum();
        let recorded = operator.recorded.as_ref().and_then(|series| series.time_s.last().copied());
        quiet_after = quiet_after.max(legs).max(recorded.unwrap_or(0.0));
        if let Some(release) = release {
            let regrasp = operator.regrasp.as_ref();
            let regrips = regrasp.map_or(0.0, |regrasp| regrasp.reaction_s + regrasp.rise_s);
            quiet_after = quiet_after.max(release.at_s + release.decay_s + regrips);
        }
        if operator.tremor.is_some() && (release.is_none() || operator.regrasp.is_some()) {
            // A hand that trembles and holds is never quiet.
            quiet_after = f64::MAX;
        }
    }
    if let Some(environment) = &scene.environment {
        for pusher in &environment.pushers {
            quiet_after = quiet_after.max(pusher.at_s + pusher.duration_s);
        }
        for object in &environment.objects {
            if object.body.is_some() {
                quiet_after = f64::MAX;
            }
            if let Some(motion) = &object.motion {
                let swings = motion.amplitude.iter().any(|a| *a != 0.0);
                quiet_after = quiet_after.max(if swings { f64::MAX } else { motion.until_s });
            }
        }
    }
    // What was scheduled last arrives late.
    let late = scene.environment.as_ref().map_or(0, |environment| environment.delay_ticks);
    let links = scene.link.iter().flat_map(|links| [&links.forward, &links.backward]).flatten();
    let round_trip: f64 = links.clone().map(LinkSettings::longest_delay_s).sum();
    quiet_after = links.map(LinkSettings::last_change_s).fold(quiet_after, f64::max);
    let ramp = scene.safety.limiter.as_ref().map_or(0.0, |limiter| limiter.ramp_in_s);
    quiet_after += late as f64 * scene.run.period_s + 2.0 * round_trip + ramp;
    MeasureSettings {
        release_s: release.map(|release| release.at_s),
        diverged_position: scene.run.diverged_position,
        diverged_speed: scene.run.diverged_speed,
        quiet_after_s: scene.run.stop_early.then_some(quiet_after),
    }
}
