//! What one end knows of the way to its peer, from the frames alone.

use crate::{
    clock::{AgeSettings, ClockFault, ClockSettings, FourTimes, PacketAge, PeerClock, PeerOffset, UsualAge},
    playout::{PathMeter, PathStatistics},
    wire::Echo,
};

/// What is believed of clocks and ages.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PathSettings {
    /// Of the peer's clock.
    pub clock: ClockSettings,
    /// Of the age of its frames.
    pub age: AgeSettings,
}

/// Clock of the peer, age of its frames and counts of its way, of the session that lives.
///
/// [`Self::sent`] with each frame sent, [`Self::arrived`] with each authentic frame of the peer in the order of arrival,
/// [`Self::news`] with each of them that is newer than all before. Times are those of one monotonic clock.
#[derive(Clone, Debug)]
pub struct PeerPath {
    clock: PeerClock,
    age: PacketAge,
    usual: UsualAge,
    meter: PathMeter,
    clock_faults: u64,
    last_fault: Option<ClockFault>,
}

/// The way to the peer, for records and the summary of a run.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[non_exhaustive]
pub struct PathReport {
    /// Loss, bursts, order, jitter, rate and gaps of the peer's frames.
    pub statistics: PathStatistics,
    /// The peer's clock less ours.
    pub offset: Option<PeerOffset>,
    /// How much faster it runs, in parts per billion.
    pub drift_ppb: Option<i64>,
    /// How often a clock was proven to step.
    pub steps: u64,
    /// Exchanges that no healthy clocks make, steps included.
    pub clock_faults: u64,
    /// The last of them.
    pub last_fault: Option<ClockFault>,
    /// Bound of the age in ns that frames have on arrival: the median, by our clock alone.
    pub expected_age_ns: Option<u64>,
    /// Bound of the age in ns that the link is used to, which the ladder measures against.
    pub usual_age_ns: Option<u64>,
}

impl PeerPath {
    /// Knows nothing yet.
    pub fn new(settings: PathSettings) -> Self {
        Self {
            clock: PeerClock::new(settings.clock),
            age: PacketAge::new(settings.age),
            usual: UsualAge::new(),
            meter: PathMeter::new(),
            clock_faults: 0,
            last_fault: None,
        }
    }

    /// Notes that the frame `sequence` left at `now_ns`.
    pub fn sent(&mut self, sequence: u64, now_ns: u64) {
        self.age.sent(sequence, now_ns);
    }

    /// Counts a frame that arrived by `now_ns`, be it late or there before.
    pub fn arrived(&mut self, sequence: u64, sent_ns: u64, now_ns: u64) {
        self.meter.arrived(sequence, sent_ns, now_ns);
    }

    /// Takes a frame newer than all before that the peer sent at `sent_ns` on its clock; `echo` is of our session.
    ///
    /// It is taken at `now_ns` and had arrived by `by_ns`, which is later where the loop woke late. When ours left we know
    /// ourselves; of the echo only the counter and the time held are used.
    pub fn news(&mut self, sent_ns: u64, echo: Option<&Echo>, now_ns: u64, by_ns: u64) {
        let exchanged = echo.and_then(|echo| Some((self.age.sent_at(echo.sequence)?, echo.held_ns)));
        let told = match exchanged {
            Some((own_sent_ns, held_ns)) => self
                .clock
                .learn(&FourTimes {
                    sent_ns: own_sent_ns,
                    peer_received_ns: sent_ns.saturating_sub(held_ns),
                    peer_sent_ns: sent_ns,
                    received_ns: by_ns,
                })
                .map(|_| ()),
            None => self.clock.backward_delay(sent_ns, by_ns).map(|_| ()),
        };
        let aged = self.age.received(by_ns, echo.map(|echo| (echo.sequence, echo.held_ns)));
        if let Some(age_ns) = self.age.age(now_ns).and_then(|age| age.at_most_ns) {
            self.usual.take(now_ns, age_ns);
        }
        if let Err(fault) = told.and(aged) {
            self.clock_faults += 1;
            self.last_fault = Some(fault);
        }
    }

    /// The peer began a new session: its clock, its sequences and the age of its frames begin anew.
    pub fn begin(&mut self) {
        self.clock.restart();
        self.age.restart();
        self.usual.restart();
        self.meter.restart();
    }

    /// The peer's clock.
    pub fn clock(&self) -> &PeerClock {
        &self.clock
    }

    /// The age of its newest frame.
    pub fn age(&self) -> &PacketAge {
        &self.age
    }

    /// The two sides engage: what ages are now is what they are measured against.
    pub fn anchor(&mut self) {
        self.usual.anchor();
    }

    /// By how much the newest of the peer may be older at `now_ns` than the link is used to, in ns; none until the peer has
    /// echoed anything.
    pub fn over_usual_ns(&self, now_ns: u64) -> Option<u64> {
        Some(self.age.age(now_ns)?.at_most_ns?.saturating_sub(self.usual.level_ns()?))
    }

    /// What is known at `now_ns`.
    pub fn report(&self, now_ns: u64) -> PathReport {
        PathReport {
            statistics: self.meter.statistics(now_ns),
            offset: self.clock.offset(now_ns),
            drift_ppb: self.clock.drift_ppb(),
            steps: self.clock.steps(),
            clock_faults: self.clock_faults,
            last_fault: self.last_fault,
            expected_age_ns: self.age.expected_ns(),
            usual_age_ns: self.usual.level_ns(),
        }
    }
}
