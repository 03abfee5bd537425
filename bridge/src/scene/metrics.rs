//! Metrics of a run, and the set of those that a run measures.

/// A metric of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Metric {
    /// [`max_ejection_velocity`](super::Outcome::max_ejection_velocity).
    MaxEjectionVelocity,
    /// [`peak_device_force`](super::Outcome::peak_device_force).
    PeakDeviceForce,
    /// [`time_to_trip_s`](super::Outcome::time_to_trip_s).
    TimeToTrip,
    /// [`false_trips`](super::Outcome::false_trips).
    FalseTrips,
    /// [`intervention_ticks`](super::Outcome::intervention_ticks) times the period of the master.
    InterventionTime,
    /// [`intervention_ticks`](super::Outcome::intervention_ticks).
    InterventionTicks,
    /// [`position_rmse_m`](super::Outcome::position_rmse_m).
    PositionError,
    /// [`force_rmse_n`](super::Outcome::force_rmse_n).
    ForceError,
    /// [`max_ejection_rate`](super::Outcome::max_ejection_rate).
    MaxEjectionRate,
    /// [`peak_device_torque`](super::Outcome::peak_device_torque).
    PeakDeviceTorque,
    /// [`orientation_rmse_rad`](super::Outcome::orientation_rmse_rad).
    OrientationError,
    /// [`torque_rmse_n_m`](super::Outcome::torque_rmse_n_m).
    TorqueError,
    /// [`passivity_min_j`](super::Outcome::passivity_min_j).
    PassivityMin,
}

impl Metric {
    /// All metrics, in the order of tables.
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

    /// Return the name used in tables.
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

    /// Return true if the metric requires a hand that turns.
    pub const fn is_of_rotation(self) -> bool {
        matches!(
            self,
            Self::MaxEjectionRate | Self::PeakDeviceTorque | Self::OrientationError | Self::TorqueError
        )
    }
}

/// Set of the metrics that a run measures, by default all. The value of a metric does not depend on the set.
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

/// Check that [`Metric::ALL`] has every metric at its place; a missing or misplaced one would never be measured.
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

    /// Return true if the metric is measured.
    #[inline(always)]
    pub const fn has(self, metric: Metric) -> bool {
        self.0 & 1 << metric as u8 != 0
    }

    /// Return true if a metric of interventions is measured.
    #[inline(always)]
    pub(super) const fn has_interventions(self) -> bool {
        self.has(Metric::TimeToTrip) | self.has(Metric::FalseTrips) | self.has_intervention_ticks()
    }

    /// Return true if ticks under intervention are counted.
    pub(super) const fn has_intervention_ticks(self) -> bool {
        self.has(Metric::InterventionTime) | self.has(Metric::InterventionTicks)
    }

    /// Return true if a metric of a hand that turns is measured.
    #[inline(always)]
    pub(super) const fn has_rotation(self) -> bool {
        self.0 & Self::OF_ROTATION.0 != 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn set_has_its_metrics_and_by_default_all() {
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
