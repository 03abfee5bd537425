//! Flight recorder: the last states, commands and interventions of a side, in fixed memory.

use haptether_safety::controller::{ControllerKind, Intervention, PerController, SafetySettings, Tripped};
use serde::Serialize;

use super::{
    diagnosis::{Diagnosis, Explanation},
    machine::History,
    table::LadderState,
};
use crate::wire::MAX_AXES;

/// Capacity in ticks.
const KEPT: usize = 50;

/// Capacity in diagnoses.
const KEPT_DIAGNOSES: usize = 8;

/// Record of one tick of a side.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FlightEntry {
    /// Time in ns.
    pub time_ns: u64,
    /// State of the ladder.
    pub state: LadderState,
    /// State of the peer, if known.
    pub peer: Option<LadderState>,
    /// Time in ns since the peer was last heard.
    pub age_ns: Option<u64>,
    /// True if the clutch was closed.
    pub clutch: bool,
    /// Gain of the ladder on the force, 0 to 1.
    pub gain: f64,
    /// Controllers that tripped in each layer, in the order of [`LAYERS`].
    pub tripped: [Tripped; LAYERS.len()],
    /// Measured and commanded values.
    pub values: FlightValues,
}

/// Three rows of values per axis. Row 1: measured position in m. Row 2: `F_device` in N at the master,
/// commanded position in m at the slave. Row 3: `F_v` at the master, `F_e` at the slave, in N.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FlightValues {
    axes: usize,
    rows: [[f64; MAX_AXES]; 3],
}

impl FlightValues {
    /// Store position, command and force of each axis.
    pub fn new<const N: usize>(of: [&haptether_safety::Axes<N>; 3]) -> Self {
        let mut rows = [[0.0; MAX_AXES]; 3];
        for (row, values) in rows.iter_mut().zip(of) {
            for (slot, value) in row.iter_mut().zip(values.iter()) {
                *slot = *value;
            }
        }
        Self { axes: N.min(MAX_AXES), rows }
    }
}

impl FlightEntry {
    const EMPTY: Self = Self {
        time_ns: 0,
        state: LadderState::Disengaged,
        peer: None,
        age_ns: None,
        clutch: false,
        gain: 0.0,
        tripped: [Tripped::NONE; LAYERS.len()],
        values: FlightValues { axes: 0, rows: [[0.0; MAX_AXES]; 3] },
    };
}

/// Last ticks of a side, and those before its last hold or fault; allocates nothing.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FlightRecorder {
    side: &'static str,
    start_ns: Option<u64>,
    latest: Ring,
    /// Ticks up to the last one at which the side went to HOLD, STOP or FAULT from any other state.
    at_hold: Option<Ring>,
    history: History,
    interventions: [Interventions; LAYERS.len()],
    /// Diagnoses, and the time in ns at which each began.
    diagnoses: [Option<(u64, Diagnosis)>; KEPT_DIAGNOSES],
    diagnosed: usize,
    /// Diagnosis of the last tick.
    diagnosis: Option<Diagnosis>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
struct Ring {
    entries: [FlightEntry; KEPT],
    count: usize,
}

impl Ring {
    fn iter(&self) -> impl Iterator<Item = &FlightEntry> {
        (self.count.saturating_sub(KEPT)..self.count).map(|index| &self.entries[index % KEPT])
    }
}

impl FlightRecorder {
    /// Build an empty recorder of the side with this name.
    pub fn new(side: &'static str) -> Self {
        let entries = [FlightEntry::EMPTY; KEPT];
        Self {
            side,
            start_ns: None,
            latest: Ring { entries, count: 0 },
            at_hold: None,
            history: History::default(),
            interventions: [Interventions::NONE; LAYERS.len()],
            diagnoses: [None; KEPT_DIAGNOSES],
            diagnosed: 0,
            diagnosis: None,
        }
    }

    /// Set the thresholds of a layer's observers, see [`thresholds`]; `layer` is an index into [`LAYERS`].
    pub(crate) fn set_thresholds(&mut self, layer: usize, thresholds: PerController<f64>) {
        self.interventions[layer].thresholds = thresholds;
    }

    /// Time in ns at which the side went to FAULT; none unless that was the last transition.
    pub(crate) fn failed_ns(&self) -> Option<u64> {
        self.history.last().filter(|last| last.to == LadderState::Fault).map(|last| last.time_ns)
    }

    /// Record the controllers' observations in each layer at a tick.
    pub(crate) fn observe(&mut self, now_ns: u64, observed: &[Observed; LAYERS.len()]) {
        for (interventions, seen) in self.interventions.iter_mut().zip(observed) {
            interventions.take(now_ns, seen);
        }
    }

    /// Record a tick. A new hold or fault copies the last ticks to `at_hold`; a new diagnosis gets a slot.
    pub(crate) fn take(&mut self, entry: FlightEntry, history: &History, diagnosis: Option<&Diagnosis>) {
        self.start_ns.get_or_insert(entry.time_ns);
        if self.diagnosis.as_ref() != diagnosis {
            if let Some(&diagnosis) = diagnosis {
                let mut since_ns = entry.time_ns;
                // More text on the same case, or an intermittent link, reuses the slot.
                if let Some(before) = self.diagnosis.filter(|before| before.is_same_case(&diagnosis)) {
                    self.diagnosed -= 1;
                    let slot = self.diagnoses[self.diagnosed % KEPT_DIAGNOSES];
                    since_ns = slot.filter(|slot| slot.1 == before).map_or(since_ns, |slot| slot.0);
                }
                self.diagnoses[self.diagnosed % KEPT_DIAGNOSES] = Some((since_ns, diagnosis));
                self.diagnosed += 1;
            }
            self.diagnosis = diagnosis.copied();
        }
        let before = self.latest.count.checked_sub(1).map(|last| self.latest.entries[last % KEPT].state);
        self.latest.entries[self.latest.count % KEPT] = entry;
        self.latest.count += 1;
        if self.history.count() != history.count() {
            self.history = *history;
        }
        if entry.state.is_held() && before.is_none_or(|before| !before.is_held()) {
            self.at_hold = Some(self.latest);
        }
    }

    /// Return why the two sides were not coupled at the last tick; none if nothing is wrong.
    pub fn diagnosis(&self) -> Option<&Diagnosis> {
        self.diagnosis.as_ref()
    }

    /// Explanations of the stored diagnoses, oldest first, without consecutive repetitions.
    fn causes(&self, seconds: impl Fn(u64) -> f64) -> Vec<Cause> {
        let kept = self.diagnosed.saturating_sub(KEPT_DIAGNOSES)..self.diagnosed;
        let mut causes: Vec<Cause> = Vec::new();
        for (time_ns, diagnosis) in kept.filter_map(|index| self.diagnoses[index % KEPT_DIAGNOSES]) {
            let explanation = diagnosis.explain();
            if causes.last().is_none_or(|last| last.explanation != explanation) {
                causes.push(Cause { time_s: seconds(time_ns), explanation });
            }
        }
        causes
    }

    /// Stored interventions of all layers, by time.
    fn rows(&self, seconds: impl Fn(u64) -> f64) -> Vec<Row> {
        let of_layers = self.interventions.iter().zip(LAYERS);
        let mut rows: Vec<_> = of_layers.flat_map(|(kept, layer)| kept.rows(layer, &seconds)).collect();
        rows.sort_by(|one, other| one.time_s.total_cmp(&other.time_s));
        rows
    }

    /// Write the record as JSON: times in s since the first tick, transitions with reasons, ticks with
    /// values.
    pub fn to_json(&self) -> String {
        let start_ns = self.start_ns.unwrap_or(0);
        let seconds = |time_ns: u64| time_ns.saturating_sub(start_ns) as f64 / 1e9;
        let ticks = |ring: &Ring| ring.iter().map(|entry| Tick::of(entry, seconds(entry.time_ns))).collect();
        let log = Log {
            schema: 1,
            side: self.side,
            transitions: self
                .history
                .iter()
                .map(|one| Step {
                    time_s: seconds(one.time_ns),
                    from: one.from,
                    to: one.to,
                    reason: one.reason.text(),
                })
                .collect(),
            interventions: self.rows(seconds),
            interventions_seen: self.interventions.iter().map(Interventions::count).sum(),
            causes: self.causes(seconds),
            at_hold: self.at_hold.as_ref().map(ticks).unwrap_or_default(),
            latest: ticks(&self.latest),
        };
        // Plain numbers and names: serialisation cannot fail.
        serde_json::to_string(&log).unwrap_or_default()
    }
}

#[derive(Serialize)]
struct Log {
    schema: u32,
    side: &'static str,
    transitions: Vec<Step>,
    /// Last interventions, and the number of all interventions.
    interventions: Vec<Row>,
    interventions_seen: usize,
    causes: Vec<Cause>,
    at_hold: Vec<Tick>,
    latest: Vec<Tick>,
}

#[derive(Serialize)]
struct Cause {
    time_s: f64,
    #[serde(flatten)]
    explanation: Explanation,
}

#[derive(Serialize)]
struct Step {
    time_s: f64,
    from: LadderState,
    to: LadderState,
    reason: &'static str,
}

#[derive(Serialize)]
struct Tick {
    time_s: f64,
    state: LadderState,
    peer: Option<LadderState>,
    age_s: Option<f64>,
    clutch: bool,
    gain: f64,
    tripped: Vec<String>,
    position: Vec<Option<f64>>,
    command: Vec<Option<f64>>,
    force: Vec<Option<f64>>,
}

impl Tick {
    fn of(entry: &FlightEntry, time_s: f64) -> Self {
        // JSON cannot represent NaN and infinity, which a fault may well have as values.
        let [position, command, force] = entry.values.rows.map(|row| {
            row[..entry.values.axes].iter().map(|value| value.is_finite().then_some(*value)).collect()
        });
        Self {
            time_s,
            state: entry.state,
            peer: entry.peer,
            age_s: entry.age_ns.map(|age| age as f64 * 1e-9),
            clutch: entry.clutch,
            gain: entry.gain,
            tripped: names(entry.tripped),
            position,
            command,
            force,
        }
    }
}

/// Names of the controllers that tripped. Layers other than translation add their name as prefix:
/// `rotation:hsc`.
fn names(tripped: [Tripped; LAYERS.len()]) -> Vec<String> {
    let of_layer = |(index, tripped): (usize, Tripped)| {
        let prefix = if index == TRANSLATION { String::new() } else { format!("{}:", LAYERS[index]) };
        tripped.names().map(move |name| format!("{prefix}{name}")).collect::<Vec<_>>()
    };
    tripped.into_iter().enumerate().flat_map(of_layer).collect()
}

/// Safety layers of a hand, each with its own observers and thresholds.
pub const LAYERS: [&str; 3] = ["translation", "rotation", "trigger"];
pub(crate) const TRANSLATION: usize = 0;
pub(crate) const ROTATION: usize = 1;
/// Index of the layer of a trigger with force feedback.
pub(crate) const TRIGGER: usize = 2;

/// Observations of a layer's safety controllers at a tick, and which of them tripped.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Observed {
    /// Controllers that tripped.
    pub tripped: Tripped,
    /// `S_vf`, `S_h`, `E_wso` and `E_so` in J; NaN where not observed.
    pub values: PerController<f64>,
}

impl Observed {
    /// Observations of a side without controllers.
    pub const NOTHING: Self = Self { tripped: Tripped::NONE, values: PerController::repeat(f64::NAN) };

    /// Extract the stored part of an intervention.
    pub fn of<const N: usize>(seen: &Intervention<N>) -> Self {
        Self { tripped: seen.tripped, values: seen.observed }
    }
}

/// Thresholds of the observers: 1 of Eq. 1, zeta of Eq. 8, delta of Eq. 10, 0 of Eq. 12.
pub fn thresholds(settings: &SafetySettings) -> PerController<f64> {
    PerController::of(|kind| kind.threshold(settings))
}

/// Capacity of each layer in interventions.
const KEPT_INTERVENTIONS: usize = 16;

/// Consecutive ticks at which at least one controller acted.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Span {
    begun_ns: u64,
    ended_ns: u64,
    tripped: Tripped,
    /// Value of each observer at the first tick at which its controller tripped.
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

/// Ring of the last interventions; allocates nothing.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Interventions {
    thresholds: PerController<f64>,
    spans: [Span; KEPT_INTERVENTIONS],
    count: usize,
    is_on: bool,
}

impl Interventions {
    const NONE: Self = Self {
        thresholds: PerController::repeat(f64::NAN),
        spans: [Span::EMPTY; KEPT_INTERVENTIONS],
        count: 0,
        is_on: false,
    };

    fn take(&mut self, now_ns: u64, seen: &Observed) {
        let was_on = std::mem::replace(&mut self.is_on, seen.tripped.any());
        if !self.is_on {
            return;
        }
        if !was_on {
            self.spans[self.count % KEPT_INTERVENTIONS] = Span { begun_ns: now_ns, ..Span::EMPTY };
            self.count += 1;
        }
        if let Some(newest) = self.count.checked_sub(1) {
            self.spans[newest % KEPT_INTERVENTIONS].take(now_ns, seen);
        }
    }

    fn count(&self) -> usize {
        self.count
    }

    /// Rows of the stored interventions, oldest first.
    fn rows(&self, layer: &'static str, seconds: impl Fn(u64) -> f64) -> Vec<Row> {
        let first = self.count.saturating_sub(KEPT_INTERVENTIONS);
        (first..self.count)
            .map(|index| {
                let span = &self.spans[index % KEPT_INTERVENTIONS];
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
                    layer,
                    trips: ControllerKind::ALL.into_iter().filter_map(trip).collect(),
                }
            })
            .collect()
    }
}

/// Return `None` for NaN and infinity, which JSON cannot represent.
fn finite(value: f64) -> Option<f64> {
    value.is_finite().then_some(value)
}

#[derive(Serialize)]
struct Row {
    time_s: f64,
    until_s: f64,
    layer: &'static str,
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
    use crate::{
        fault_text::FaultText,
        ladder::{Reason, Transition},
        wire::Role,
    };
    use haptether_safety::Axes;

    #[test]
    fn ticks_before_a_hold_are_kept() {
        let mut recorder = FlightRecorder::new("slave");
        for tick in 0..1000_u64 {
            let state = if tick < 300 { LadderState::Engaged } else { LadderState::Hold };
            let value = Axes::<2>::new(tick as f64, if tick == 299 { f64::NAN } else { 0.5 });
            let values = FlightValues::new([&value; 3]);
            let entry = FlightEntry { time_ns: 5 + tick * 1_000_000, state, values, ..FlightEntry::EMPTY };
            recorder.take(entry, &History::default(), None);
        }
        let log: serde_json::Value = serde_json::from_str(&recorder.to_json()).unwrap();
        let first = |key: &str| log[key][0]["position"][0].as_f64();
        assert_eq!((first("at_hold"), first("latest")), (Some(251.0), Some(950.0)));
        let ticks = log["at_hold"].as_array().unwrap();
        assert_eq!((ticks.len(), ticks[49]["state"].as_str()), (50, Some("hold")));
        assert!(ticks[48]["position"][1].is_null());
        assert_eq!(ticks[48]["time_s"], 0.299);
    }

    fn read(recorder: &FlightRecorder) -> serde_json::Value {
        serde_json::from_str(&recorder.to_json()).unwrap()
    }

    fn at(time_ns: u64) -> FlightEntry {
        FlightEntry { time_ns, ..FlightEntry::EMPTY }
    }

    fn moved(from: LadderState, to: LadderState, time_ns: u64) -> Transition {
        Transition { time_ns, from, to, reason: Reason::BadNumber }
    }

    #[test]
    fn failure_has_a_time_until_the_fault_ends() {
        let (mut recorder, mut history) = (FlightRecorder::new("master"), History::default());
        recorder.take(at(10), &history, None);
        assert_eq!(recorder.failed_ns(), None);
        history.push(moved(LadderState::Engaged, LadderState::Hold, 20));
        recorder.take(at(20), &history, None);
        assert_eq!(recorder.failed_ns(), None);
        history.push(moved(LadderState::Hold, LadderState::Fault, 30));
        recorder.take(at(30), &history, None);
        recorder.take(at(40), &history, None);
        assert_eq!(recorder.failed_ns(), Some(30));
        history.push(moved(LadderState::Fault, LadderState::Disengaged, 50));
        recorder.take(at(50), &history, None);
        assert_eq!(recorder.failed_ns(), None);
        let log = read(&recorder);
        let steps: Vec<_> = log["transitions"].as_array().unwrap().iter().map(|one| &one["time_s"]).collect();
        assert_eq!(steps, [10e-9, 20e-9, 40e-9]);
        assert_eq!((&log["transitions"][1]["to"], &log["side"]), (&"fault".into(), &"master".into()));
    }

    fn held(reason: Reason) -> Diagnosis {
        Diagnosis {
            role: Role::Master,
            state: LadderState::Hold,
            reason: Some(reason),
            fault: 0,
            text: FaultText::EMPTY,
            peer: None,
            ended: false,
            silent: false,
            ends: false,
        }
    }

    /// Time in ns and number of steps of each cause. A silent link adds a step.
    fn causes(recorder: &FlightRecorder) -> Vec<(f64, usize)> {
        let log = read(recorder);
        let of = |one: &serde_json::Value| {
            (one["time_s"].as_f64().unwrap() * 1e9, one["steps"].as_array().unwrap().len())
        };
        log["causes"].as_array().unwrap().iter().map(of).collect()
    }

    #[test]
    fn cause_keeps_first_time_and_newest_text() {
        let mut recorder = FlightRecorder::new("master");
        let mut take = |time_ns: u64, diagnosis: Option<Diagnosis>| {
            recorder.take(at(time_ns), &History::default(), diagnosis.as_ref());
            assert_eq!(recorder.diagnosis(), diagnosis.as_ref());
            causes(&recorder).iter().map(|(time, steps)| (time.round(), *steps)).collect::<Vec<_>>()
        };
        let late = held(Reason::OwnDelay);
        assert_eq!(take(0, None), []);
        assert_eq!(take(10, Some(late)), [(10.0, 1)]);
        assert_eq!(take(20, Some(late)), [(10.0, 1)]);
        // Same case, but the link is down.
        assert_eq!(take(30, Some(Diagnosis { silent: true, ..late })), [(10.0, 2)]);
        assert_eq!(take(40, None), [(10.0, 2)]);
        // A new case with the same text as the stored one.
        assert_eq!(take(50, Some(Diagnosis { silent: true, ..late })), [(10.0, 2)]);
        assert_eq!(take(60, Some(held(Reason::PeerRestarted))), [(10.0, 2), (60.0, 1)]);
        assert_eq!(take(70, Some(late)), [(10.0, 2), (60.0, 1), (70.0, 1)]);
        let silent = Diagnosis { silent: true, ..late };
        assert_eq!(take(80, Some(silent)), [(10.0, 2), (60.0, 1), (70.0, 2)], "the first time is kept");
    }

    #[test]
    fn last_causes_are_kept_in_order() {
        let mut recorder = FlightRecorder::new("slave");
        for time_ns in 0..20 {
            let reason = if time_ns % 2 == 0 { Reason::OwnDelay } else { Reason::PeerRestarted };
            recorder.take(at(time_ns), &History::default(), Some(&held(reason)));
        }
        let times: Vec<_> = causes(&recorder).iter().map(|(time, _)| time.round()).collect();
        assert_eq!(times, [12.0, 13.0, 14.0, 15.0, 16.0, 17.0, 18.0, 19.0]);
    }

    #[test]
    fn newest_hold_is_kept() {
        let mut recorder = FlightRecorder::new("slave");
        let states = [(0, LadderState::Engaged), (100, LadderState::Hold), (150, LadderState::Stop)];
        let states = [&states[..], &[(200, LadderState::Engaged), (300, LadderState::Fault)]].concat();
        for tick in 0..400_u64 {
            let (_, state) = *states.iter().rev().find(|(from, _)| *from <= tick).unwrap();
            let age_ns = (tick > 300).then_some(tick * 1_000_000_000);
            let entry = FlightEntry { time_ns: tick * 1_000_000_000, state, age_ns, ..FlightEntry::EMPTY };
            recorder.take(entry, &History::default(), None);
        }
        let log = read(&recorder);
        let last = |key: &str| log[key].as_array().unwrap().last().unwrap().clone();
        assert_eq!((&last("at_hold")["time_s"], &last("at_hold")["state"]), (&300.0.into(), &"fault".into()));
        assert!(last("at_hold")["age_s"].is_null());
        assert_eq!((&last("latest")["time_s"], &last("latest")["age_s"]), (&399.0.into(), &399.0.into()));
    }

    #[test]
    fn interventions_show_their_thresholds() {
        let mut recorder = FlightRecorder::new("master");
        recorder.set_thresholds(TRANSLATION, PerController([1.0, 1.5, -0.03, 0.0]));
        for (time_ns, tripped) in [(0, 0), (1_000_000_000, 2), (2_000_000_000, 0), (3_000_000_000, 2)] {
            let observed = Observed {
                tripped: Tripped::from_bits(tripped),
                values: PerController([0.0, 2.0, 0.0, 0.0]),
            };
            let mut entry = at(5 + time_ns);
            entry.tripped[TRANSLATION] = observed.tripped;
            recorder.observe(5 + time_ns, &[observed, Observed::NOTHING, Observed::NOTHING]);
            recorder.take(entry, &History::default(), None);
        }
        let log = read(&recorder);
        assert_eq!(
            (&log["interventions_seen"], log["interventions"].as_array().unwrap().len()),
            (&2.into(), 2)
        );
        assert_eq!(log["interventions"][1]["time_s"], 3.0);
        assert_eq!(log["interventions"][0]["trips"][0]["threshold"], 1.5);
        assert_eq!(log["latest"][1]["tripped"], serde_json::json!(["hsc"]));
    }

    #[test]
    fn layers_have_separate_interventions_and_thresholds() {
        let mut recorder = FlightRecorder::new("master");
        recorder.set_thresholds(TRANSLATION, PerController([1.0, 1.5, -0.03, 0.0]));
        recorder.set_thresholds(ROTATION, PerController([1.0, 0.2, -0.01, 0.0]));
        recorder.set_thresholds(TRIGGER, PerController([1.0, 0.7, -0.02, 0.0]));
        // The trigger trips before the rotation; then both are tripped.
        for (time_ns, bits) in [(0, [0, 0, 2]), (1_000_000_000, [0, 2, 2]), (2_000_000_000, [0, 0, 0])] {
            let values = PerController([0.0, 3.0, 0.0, 0.0]);
            let tripped = bits.map(Tripped::from_bits);
            recorder.observe(5 + time_ns, &tripped.map(|tripped| Observed { tripped, values }));
            let entry = FlightEntry { tripped, ..at(5 + time_ns) };
            recorder.take(entry, &History::default(), None);
        }
        let log = read(&recorder);
        let row = |time_s: f64, layer: &str, threshold: f64| {
            let trip = serde_json::json!(
                {"controller": "hsc", "observer": "S_h", "observed": 3.0, "threshold": threshold}
            );
            serde_json::json!({"time_s": time_s, "until_s": 1.0, "layer": layer, "trips": [trip]})
        };
        assert_eq!(
            log["interventions"],
            serde_json::json!([row(0.0, "trigger", 0.7), row(1.0, "rotation", 0.2)])
        );
        assert_eq!(log["interventions_seen"], 2);
        assert_eq!(log["latest"][1]["tripped"], serde_json::json!(["rotation:hsc", "trigger:hsc"]));
    }
}

#[cfg(test)]
mod intervention_tests {
    use super::*;

    fn seen(tripped: u8, grasp: f64, energy_j: f64) -> Observed {
        Observed {
            tripped: Tripped::from_bits(tripped),
            values: PerController([f64::NAN, grasp, energy_j, f64::NAN]),
        }
    }

    #[test]
    fn observers_use_their_controllers_thresholds() {
        let settings =
            SafetySettings { grasp_threshold: 1.7, energy_threshold_j: -0.2, ..SafetySettings::default() };
        assert_eq!(thresholds(&settings).0, [1.0, 1.7, -0.2, 0.0]);
    }

    #[test]
    fn an_intervention_keeps_what_each_controller_saw_when_it_tripped() {
        let mut kept = Interventions::NONE;
        kept.thresholds = PerController([1.0, 1.5, -0.03, 0.0]);
        // WSC trips, HSC joins, their damping is held, then all is normal.
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
        let rows = serde_json::to_value(kept.rows("rotation", |ns| ns as f64)).unwrap();
        let expected = serde_json::json!([{"time_s": 1.0, "until_s": 3.0, "layer": "rotation", "trips": [
            {"controller": "hsc", "observer": "S_h", "observed": 1.7, "threshold": 1.5},
            {"controller": "wsc", "observer": "E_wso [J]", "observed": -0.031, "threshold": -0.03},
        ]}]);
        assert_eq!(rows, expected);
    }

    #[test]
    fn newest_interventions_are_kept_and_all_are_counted() {
        let mut kept = Interventions::NONE;
        for tick in 0..200_u64 {
            kept.take(tick, &seen(if tick % 2 == 0 { 2 } else { 0 }, 2.0, f64::NAN));
        }
        let rows = serde_json::to_value(kept.rows("rotation", |ns| ns as f64)).unwrap();
        assert_eq!((kept.count(), rows.as_array().unwrap().len()), (100, KEPT_INTERVENTIONS));
        assert_eq!((&rows[0]["time_s"], &rows[15]["time_s"]), (&168.0.into(), &198.0.into()));
        assert_eq!((&rows[0]["until_s"], &rows[15]["until_s"]), (&168.0.into(), &198.0.into()));
        assert_eq!(rows[7]["trips"][0]["observed"], 2.0);
    }
}
