//! Which metrics there are, and which of them a run measures.

use super::measures::Outcome;

/// A metric of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Metric {
    /// [`Outcome::max_ejection_velocity`].
    MaxEjectionVelocity,
    /// [`Outcome::peak_device_force`].
    PeakDeviceForce,
    /// [`Outcome::time_to_trip_s`].
    TimeToTrip,
    /// [`Outcome::false_trips`].
    FalseTrips,
    /// [`Outcome::intervention_ticks`] times the period of the master.
    InterventionTime,
    /// [`Outcome::intervention_ticks`].
    InterventionTicks,
    /// [`Outcome::position_rmse_m`].
    PositionError,
    /// [`Outcome::force_rmse_n`].
    ForceError,
    /// [`Outcome::max_ejection_rate`].
    MaxEjectionRate,
    /// [`Outcome::peak_device_torque`].
    PeakDeviceTorque,
    /// [`Outcome::orientation_rmse_rad`].
    OrientationError,
    /// [`Outcome::torque_rmse_n_m`].
    TorqueError,
    /// [`Outcome::passivity_min_j`].
    PassivityMin,
}

impl Metric {
    /// All, in the order of tables.
    pub const ALL: [Self; 13] = [
        Self::MaxEjectionVelocity,
        Self::PeakDeviceForce,
        Self::TimeToTrip,
        Self::FalseTrips,
        Self::InterventionTime,
        Self::InterventionTicks,
        Self::PositionError,
        Self::ForceError,
        Self::MaxEjectionRate,
        Self::PeakDeviceTorque,
        Self::OrientationError,
        Self::TorqueError,
        Self::PassivityMin,
    ];

    /// Its name in tables.
    pub const fn name(self) -> &'static str {
        match self {
            Self::MaxEjectionVelocity => "max_ejection_velocity",
            Self::PeakDeviceForce => "peak_device_force",
            Self::TimeToTrip => "time_to_trip_s",
            Self::FalseTrips => "false_trips",
            Self::InterventionTime => "intervention_s",
            Self::InterventionTicks => "intervention_ticks",
            Self::PositionError => "position_rmse_m",
            Self::ForceError => "force_rmse_n",
            Self::MaxEjectionRate => "max_ejection_rate",
            Self::PeakDeviceTorque => "peak_device_torque",
            Self::OrientationError => "orientation_rmse_rad",
            Self::TorqueError => "torque_rmse_n_m",
            Self::PassivityMin => "passivity_min_j",
        }
    }

    /// Whether only a hand that turns has it.
    pub const fn is_of_rotation(self) -> bool {
        matches!(
            self,
            Self::MaxEjectionRate | Self::PeakDeviceTorque | Self::OrientationError | Self::TorqueError
        )
    }

    /// Its value in a run whose master has a period of `period_s`; none where it was not measured.
    pub fn of(self, outcome: &Outcome, period_s: f64) -> Option<f64> {
        let count = |count: Option<u64>| count.map(|count| count as f64);
        match self {
            Self::MaxEjectionVelocity => outcome.max_ejection_velocity,
            Self::PeakDeviceForce => outcome.peak_device_force,
            Self::TimeToTrip => outcome.time_to_trip_s,
            Self::FalseTrips => count(outcome.false_trips),
            Self::InterventionTime => count(outcome.intervention_ticks).map(|ticks| ticks * period_s),
            Self::InterventionTicks => count(outcome.intervention_ticks),
            Self::PositionError => outcome.position_rmse_m,
            Self::ForceError => outcome.force_rmse_n,
            Self::MaxEjectionRate => outcome.max_ejection_rate,
            Self::PeakDeviceTorque => outcome.peak_device_torque,
            Self::OrientationError => outcome.orientation_rmse_rad,
            Self::TorqueError => outcome.torque_rmse_n_m,
            Self::PassivityMin => outcome.passivity_min_j,
        }
    }
}

/// The metrics that a run measures: by default all. What is measured has the same value whatever else is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Metrics(u16);

impl Default for Metrics {
    fn default() -> Self {
        Self::ALL
    }
}

impl FromIterator<Metric> for Metrics {
    fn from_iter<I: IntoIterator<Item = Metric>>(metrics: I) -> Self {
        Self(metrics.into_iter().fold(0, |bits, metric| bits | 1 << metric as u8))
    }
}

/// A metric that [`Metric::ALL`] leaves out, or has in another place, would never be measured.
const _: () = {
    let mut place = 0;
    while place < Metric::ALL.len() {
        assert!(Metric::ALL[place] as usize == place);
        place += 1;
    }
    assert!(Metric::PassivityMin as usize + 1 == place);
};

impl Metrics {
    /// All metrics.
    pub const ALL: Self = Self((1 << Metric::ALL.len()) - 1);

    const OF_ROTATION: Self = {
        let mut bits = 0;
        let mut place = 0;
        while place < Metric::ALL.len() {
            if Metric::ALL[place].is_of_rotation() {
                bits |= 1 << place;
            }
            place += 1;
        }
        Self(bits)
    };

    /// Whether it is measured.
    #[inline(always)]
    pub const fn has(self, metric: Metric) -> bool {
        self.0 & 1 << metric as u8 != 0
    }

    /// Whether anything of interventions is measured.
    #[inline(always)]
    pub(super) const fn has_interventions(self) -> bool {
        self.has(Metric::TimeToTrip) | self.has(Metric::FalseTrips) | self.has_intervention_ticks()
    }

    /// Whether ticks under intervention are counted.
    pub(super) const fn has_intervention_ticks(self) -> bool {
        self.has(Metric::InterventionTime) | self.has(Metric::InterventionTicks)
    }

    /// Whether anything of a hand that turns is measured.
    #[inline(always)]
    pub(super) const fn has_rotation(self) -> bool {
        self.0 & Self::OF_ROTATION.0 != 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_set_has_what_it_was_made_of_and_by_default_all() {
        let all: Metrics = Metric::ALL.into_iter().collect();
        assert_eq!((all, Metrics::default()), (Metrics::ALL, Metrics::ALL));
        for metric in Metric::ALL {
            let one: Metrics = [metric].into_iter().collect();
            let others: Metrics = Metric::ALL.into_iter().filter(|other| *other != metric).collect();
            for other in Metric::ALL {
                assert_eq!((one.has(other), others.has(other)), (other == metric, other != metric));
            }
            assert!(all.has(metric));
            assert_eq!(one.has_rotation(), metric.is_of_rotation());
            assert_eq!(Metric::ALL.iter().filter(|other| other.name() == metric.name()).count(), 1);
        }
    }
}
