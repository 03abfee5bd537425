//! The last interventions of the safety controllers, in a fixed room.

use haptether_safety::controller::{ControllerKind, Intervention, PerController, SafetySettings, Tripped};
use serde::Serialize;

/// What the safety controllers saw at a tick, and which of them tripped.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Observed {
    /// Who tripped.
    pub tripped: Tripped,
    /// `S_vf`, `S_h`, `E_wso` and `E_so` in J; NaN where not observed.
    pub values: PerController<f64>,
}

impl Observed {
    /// A side without controllers.
    pub const NOTHING: Self = Self { tripped: Tripped::NONE, values: PerController::repeat(f64::NAN) };

    /// What is kept of an intervention.
    pub fn of<const N: usize>(seen: &Intervention<N>) -> Self {
        Self { tripped: seen.tripped, values: seen.observed }
    }
}

/// What the observers are held against: 1 of Eq. 1, zeta of Eq. 8, delta of Eq. 10, 0 of Eq. 12.
pub fn thresholds(settings: &SafetySettings) -> PerController<f64> {
    PerController(ControllerKind::ALL.map(|kind| kind.threshold(settings)))
}

/// How many interventions are kept.
const KEPT: usize = 16;

/// Ticks that lie together, from the first at which a controller acted to the last.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Span {
    begun_ns: u64,
    ended_ns: u64,
    tripped: Tripped,
    /// Each observer at the tick at which its controller tripped first.
    values: PerController<f64>,
}

impl Span {
    const EMPTY: Self =
        Self { begun_ns: 0, ended_ns: 0, tripped: Tripped::NONE, values: PerController::repeat(f64::NAN) };

    fn take(&mut self, now_ns: u64, seen: &Observed) {
        self.ended_ns = now_ns;
        for kind in ControllerKind::ALL {
            if seen.tripped.contains(Tripped::of(kind)) && !self.tripped.contains(Tripped::of(kind)) {
                self.values[kind] = seen.values[kind];
            }
        }
        self.tripped = self.tripped.and(seen.tripped);
    }
}

/// The last interventions; nothing in it is allocated.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Interventions {
    thresholds: PerController<f64>,
    spans: [Span; KEPT],
    count: usize,
    is_on: bool,
}

impl Interventions {
    pub(super) const NONE: Self = Self {
        thresholds: PerController::repeat(f64::NAN),
        spans: [Span::EMPTY; KEPT],
        count: 0,
        is_on: false,
    };

    pub(super) fn hold_against(&mut self, thresholds: PerController<f64>) {
        self.thresholds = thresholds;
    }

    pub(super) fn take(&mut self, now_ns: u64, seen: &Observed) {
        let was_on = std::mem::replace(&mut self.is_on, seen.tripped.any());
        if !self.is_on {
            return;
        }
        if !was_on {
            self.spans[self.count % KEPT] = Span { begun_ns: now_ns, ..Span::EMPTY };
            self.count += 1;
        }
        if let Some(newest) = self.count.checked_sub(1) {
            self.spans[newest % KEPT].take(now_ns, seen);
        }
    }

    /// How many there were.
    pub(super) fn count(&self) -> usize {
        self.count
    }

    /// Those that are kept, the oldest first, as they are written.
    pub(super) fn rows(&self, seconds: impl Fn(u64) -> f64) -> Vec<Row> {
        let first = self.count.saturating_sub(KEPT);
        (first..self.count)
            .map(|index| {
                let span = &self.spans[index % KEPT];
                let trip = |kind: ControllerKind| {
                    span.tripped.contains(Tripped::of(kind)).then(|| Trip {
                        controller: kind.about().name,
                        observer: kind.observed().symbol,
                        observed: finite(span.values[kind]),
                        threshold: finite(self.thresholds[kind]),
                    })
                };
                Row {
                    time_s: seconds(span.begun_ns),
                    until_s: seconds(span.ended_ns),
                    trips: ControllerKind::ALL.into_iter().filter_map(trip).collect(),
                }
            })
            .collect()
    }
}

/// JSON has no word for a number that is none.
fn finite(value: f64) -> Option<f64> {
    value.is_finite().then_some(value)
}

#[derive(Serialize)]
pub(super) struct Row {
    time_s: f64,
    until_s: f64,
    trips: Vec<Trip>,
}

#[derive(Serialize)]
struct Trip {
    controller: &'static str,
    observer: &'static str,
    observed: Option<f64>,
    threshold: Option<f64>,
}

#[cfg(test)]
mod tests {
    use super::*;

    fn seen(tripped: u8, grasp: f64, energy_j: f64) -> Observed {
        let values = PerController([f64::NAN, grasp, energy_j, f64::NAN]);
        Observed { tripped: Tripped::from_bits(tripped), values }
    }

    #[test]
    fn observers_are_held_against_what_their_controllers_have() {
        let settings =
            SafetySettings { grasp_threshold: 1.7, energy_threshold_j: -0.2, ..SafetySettings::default() };
        assert_eq!(thresholds(&settings).0, [1.0, 1.7, -0.2, 0.0]);
    }

    #[test]
    fn an_intervention_keeps_what_each_controller_saw_when_it_tripped() {
        let mut kept = Interventions::NONE;
        kept.hold_against(PerController([1.0, 1.5, -0.03, 0.0]));
        // WSC trips, HSC joins, both are held, then all is well.
        let ticks = [
            seen(0, 1.0, 0.1),
            seen(4, 1.2, -0.031),
            seen(6, 1.7, -0.05),
            seen(16, 1.0, 0.0),
            seen(0, 1.0, 0.0),
        ];
        for (tick, seen) in ticks.iter().enumerate() {
            kept.take(tick as u64, seen);
        }
        let rows = serde_json::to_value(kept.rows(|ns| ns as f64)).unwrap();
        let expected = serde_json::json!([{"time_s": 1.0, "until_s": 3.0, "trips": [
            {"controller": "hsc", "observer": "S_h", "observed": 1.7, "threshold": 1.5},
            {"controller": "wsc", "observer": "E_wso [J]", "observed": -0.031, "threshold": -0.03},
        ]}]);
        assert_eq!(rows, expected);
    }

    #[test]
    fn the_newest_are_kept_and_all_are_counted() {
        let mut kept = Interventions::NONE;
        for tick in 0..200_u64 {
            kept.take(tick, &seen(if tick % 2 == 0 { 2 } else { 0 }, 2.0, f64::NAN));
        }
        let rows = serde_json::to_value(kept.rows(|ns| ns as f64)).unwrap();
        assert_eq!((kept.count(), rows.as_array().unwrap().len()), (100, KEPT));
        assert_eq!((&rows[0]["time_s"], &rows[15]["time_s"]), (&168.0.into(), &198.0.into()));
        assert_eq!((&rows[0]["until_s"], &rows[15]["until_s"]), (&168.0.into(), &198.0.into()));
        assert_eq!(rows[7]["trips"][0]["observed"], 2.0);
    }
}
