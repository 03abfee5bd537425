//! Additional fields of master records with force feedback at the trigger.

use haptether_master::RotationSample;
use haptether_safety::{Axes, SafetyTick};

use super::{MasterRotation, MasterTurn};
use crate::{
    plant::RotationTruth,
    recorder::{Field, Recorded, Value},
};

/// One tick of a trigger with force feedback; positive closes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FingerTick {
    /// Estimated velocity in m/s.
    pub velocity: f64,
    /// `F_v` in N.
    pub rendered_force: f64,
    /// `F_c` in N.
    pub safety_force: f64,
    /// `F_device` in N.
    pub device_force: f64,
    /// Controllers that tripped, [`haptether_safety::controller::Tripped::bits`].
    pub tripped: u8,
}

impl FingerTick {
    fn of(tick: &SafetyTick<1>) -> Self {
        Self {
            velocity: tick.motion.velocity[0],
            rendered_force: tick.rendered_force[0],
            safety_force: tick.intervention.safety_force[0],
            device_force: tick.device_force[0],
            tripped: tick.intervention.tripped.bits(),
        }
    }
}

/// Rotation part of a record, plus the force feedback at the trigger.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WithTriggerFeedback<R> {
    /// Rotation; empty for a point.
    pub turn: R,
    /// Trigger.
    pub finger: FingerTick,
}

impl<R: MasterTurn> MasterTurn for WithTriggerFeedback<R> {
    const TURNS: bool = R::TURNS;

    fn empty() -> Self {
        Self { turn: R::empty(), finger: FingerTick::of(&SafetyTick::still()) }
    }

    fn rotation(&self) -> Option<&MasterRotation> {
        self.turn.rotation()
    }

    fn of(
        measured: Option<&RotationSample>,
        truth: Option<RotationTruth>,
        tick: Option<&SafetyTick<3>>,
        torques: [Axes<3>; 2],
    ) -> Self {
        Self { turn: R::of(measured, truth, tick, torques), ..Self::empty() }
    }

    fn felt(self, tick: Option<&SafetyTick<1>>) -> Self {
        Self { finger: tick.map_or(self.finger, FingerTick::of), ..self }
    }

    fn fields<'a>(&'a self, take: &mut dyn FnMut(Field<'a>)) {
        self.turn.fields(take);
        self.finger.fields(take);
    }
}

impl FingerTick {
    fn fields<'a>(&'a self, take: &mut dyn FnMut(Field<'a>)) {
        let Self { velocity, rendered_force, safety_force, device_force, tripped } = *self;
        for field in [
            ("trigger_velocity", "of the trigger in m/s, positive closes", Value::Number(velocity)),
            ("trigger_rendered_force", "F_v at the trigger in N", Value::Number(rendered_force)),
            ("trigger_safety_force", "F_c at the trigger in N", Value::Number(safety_force)),
            ("trigger_device_force", "F_device at the trigger in N", Value::Number(device_force)),
            (
                "trigger_tripped",
                "bits of the controllers that tripped by the trigger",
                Value::Bits(tripped.into()),
            ),
        ] {
            take(field);
        }
    }
}

/// Master record plus force feedback at the trigger, for runs in virtual time, whose records have one type.
#[derive(Clone, Copy, Debug)]
pub(crate) struct WithFinger<M> {
    record: M,
    finger: FingerTick,
}

impl<M> WithFinger<M> {
    /// Combines a record with the finger's tick, if any.
    pub(crate) fn new(record: M, felt: Option<&SafetyTick<1>>) -> Self {
        Self { record, finger: felt.map_or_else(|| FingerTick::of(&SafetyTick::still()), FingerTick::of) }
    }
}

impl<M: Recorded> Recorded for WithFinger<M> {
    fn side(&self) -> &'static str {
        self.record.side()
    }

    fn any() -> Self {
        Self::new(M::any(), None)
    }

    fn time_ns(&self) -> u64 {
        self.record.time_ns()
    }

    fn fields<'a>(&'a self, take: &mut dyn FnMut(Field<'a>)) {
        self.record.fields(take);
        self.finger.fields(take);
    }
}
