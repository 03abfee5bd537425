//! Measures of the rotation of hand and arm.

use haptether_safety::Axes;
use nalgebra::{Quaternion, Unit, UnitQuaternion};

use crate::{
    MasterRotation, SlaveRotation,
    command::OperatorCommand,
    coupling::{CouplingError, RotationCoupling, RotationLock},
    scene::{
        measures::Outcome,
        metrics::{Metric, Metrics},
        spec::CouplingSpec,
    },
};

/// Peaks, and the difference between slave rotation and scaled master rotation.
#[derive(Clone, Debug)]
pub(crate) struct RotationMeasures {
    coupling: RotationCoupling,
    /// Time in s at which the hand lets go; infinite until engagement.
    release_s: f64,
    /// Newest record of the slave.
    slave: Option<SlaveRotation>,
    peak_rate: f64,
    peak_torque: f64,
    /// Sums of the squared differences of orientation and torque; `samples` counts them.
    squares: [f64; 2],
    samples: [u64; 2],
    newest_s: f64,
}

fn unit([w, x, y, z]: [f64; 4]) -> UnitQuaternion<f64> {
    Unit::new_unchecked(Quaternion::new(w, x, y, z))
}

impl RotationMeasures {
    pub(crate) fn new(spec: &CouplingSpec, lock: RotationLock) -> Result<Self, CouplingError> {
        let mut coupling = RotationCoupling::new(spec.rotation_scale, spec.torque_scale)?;
        coupling.set_lock(lock);
        coupling.set_frame(spec.quat_wxyz, 0)?;
        Ok(Self {
            coupling,
            release_s: f64::INFINITY,
            slave: None,
            peak_rate: 0.0,
            peak_torque: 0.0,
            squares: [0.0; 2],
            samples: [0; 2],
            newest_s: f64::NEG_INFINITY,
        })
    }

    /// Restart at engagement; the hand lets go at `release_s`, in s since the start.
    pub(crate) fn engage(&mut self, release_s: f64) {
        self.release_s = release_s;
        (self.peak_rate, self.peak_torque) = (0.0, 0.0);
    }

    /// Apply a change by the operator, which affects both sides.
    pub(crate) fn change(&mut self, command: &OperatorCommand) -> Result<(), CouplingError> {
        match command {
            OperatorCommand::RotationScale(scale) => self.coupling.set_rotation_scale(*scale, 0),
            OperatorCommand::TorqueScale(scale) => self.coupling.set_torque_scale(*scale, 0),
            OperatorCommand::Frame { quat_wxyz, .. } => self.coupling.set_frame(*quat_wxyz, 0),
            _ => Ok(()),
        }
    }

    /// Take a tick of the master; `coupled` is true if both sides are coupled.
    pub(crate) fn take_master(&mut self, time_s: f64, record: &MasterRotation, coupled: bool) {
        self.newest_s = time_s;
        self.peak_torque = self.peak_torque.max(record.device_torque.norm());
        if time_s >= self.release_s {
            self.peak_rate = self.peak_rate.max(record.angular_velocity.norm());
        }
        let (Some(newest), true) = (&self.slave, coupled) else {
            self.coupling.disengage();
            return;
        };
        let slave = unit(newest.orientation);
        let wanted = self.coupling.commanded_orientation(&unit(record.true_orientation), &slave);
        self.squares[0] += wanted.angle_to(&slave).powi(2);
        self.samples[0] += 1;
        let difference: Axes<3> =
            record.device_torque - self.coupling.rendered_torque(&newest.environment_torque);
        self.squares[1] += difference.norm_squared();
        self.samples[1] += 1;
    }

    /// Take a tick of the slave.
    pub(crate) fn take_slave(&mut self, record: &SlaveRotation) {
        self.slave = Some(*record);
    }

    /// Add the measured values of `metrics`.
    pub(crate) fn complete(&self, outcome: Outcome, metrics: Metrics) -> Outcome {
        let mean = |which: usize, metric: Metric| {
            let samples = self.samples[which];
            (samples > 0 && metrics.has(metric))
                .then(|| (self.squares[which] / samples as f64).sqrt())
                .filter(|mean| mean.is_finite())
        };
        Outcome {
            max_ejection_rate: (self.newest_s >= self.release_s && metrics.has(Metric::MaxEjectionRate))
                .then_some(self.peak_rate),
            peak_device_torque: (self.newest_s >= 0.0 && metrics.has(Metric::PeakDeviceTorque))
                .then_some(self.peak_torque),
            orientation_rmse_rad: mean(0, Metric::OrientationError),
            torque_rmse_n_m: mean(1, Metric::TorqueError),
            ..outcome
        }
    }
}
