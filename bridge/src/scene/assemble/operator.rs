//! The operator of a scene: clutch, path and hand.

use haptether_master::{Hand, Leg, LegShape, Path, Regrasp, Release, ReleaseKind, Tremor};

use super::{
    super::spec::{LegShapeSpec, OperatorSpec, PersonSpec, ReleaseKindSpec, SceneSpec, SeriesSpec},
    axes::axes,
    error::{SceneError, contradiction},
};
use crate::Clutch;

/// Reaction of a simulated person in ns where no operator says another.
const REACTION_NS: u64 = 500_000_000;

#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // not negative, and saturates
fn ns(seconds: f64) -> u64 {
    (seconds * 1e9).round() as u64
}

/// A simulated person, as quick as the operator.
fn person(scene: &SceneSpec) -> Clutch {
    let reaction_ns = scene.operator.as_ref().map_or(REACTION_NS, |operator| ns(operator.clutch_reaction_s));
    Clutch::Auto { reaction_ns }
}

/// How the clutch of a simulated master is worked in virtual time, where nobody can be hurt.
pub(crate) fn clutch(scene: &SceneSpec) -> Clutch {
    match &scene.operator {
        None => person(scene),
        Some(_) => live_clutch(scene),
    }
}

/// How the clutch of a simulated master is worked live, where the arm may be a real one: only an operator presses anew.
pub(crate) fn live_clutch(scene: &SceneSpec) -> Clutch {
    let Some(operator) = &scene.operator else { return Clutch::Once };
    match (&operator.clutch_times, operator.clutch) {
        (Some(times), _) => {
            Clutch::Schedule(times.iter().map(|(press, release)| (ns(*press), ns(*release))).collect())
        }
        (None, PersonSpec::Once) => Clutch::Once,
        (None, PersonSpec::Auto) => person(scene),
    }
}

/// How the clutch of a real device without a button is worked: by its start and by whoever presses it anew. The scene's
/// operator, who is simulated, has no say, but that times without a press leave it open; `simulated` asks for a
/// simulated person all the same.
pub(crate) fn driven_clutch(scene: &SceneSpec, simulated: bool) -> Result<Clutch, SceneError> {
    let times = scene.operator.as_ref().and_then(|operator| operator.clutch_times.as_deref());
    match times {
        Some([]) => Ok(Clutch::Schedule(Vec::new())),
        Some(_) => contradiction(
            "operator.clutch: times press the clutch of a real device without a person: must be \"once\", \"auto\" or []",
        ),
        None if simulated => Ok(person(scene)),
        None => Ok(Clutch::Once),
    }
}

/// Shortest leg of a path in s; `bridge/scene/resolve.py` lets no two points of a recording be closer.
const MIN_LEG_S: f64 = 1e-9;

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
        if *time - before >= MIN_LEG_S {
            legs.push(Leg { duration_s: time - before, end: *row, shape: LegShape::Linear });
            before = *time;
        }
    }
    Ok(Path::new(rows[0], legs)?)
}

pub(super) fn hand<const N: usize>(scene: &SceneSpec) -> Result<Hand<N>, SceneError> {
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
