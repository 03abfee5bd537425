//! The age that a link's packets usually have, and from when on they are older than that.

/// Time in ns over which mean and deviation reach back.
const REACH_NS: f64 = 8e9;
/// Time in ns within which the present mean follows.
const PRESENT_NS: f64 = 0.1e9;
/// Time in ns after an anchoring in which the level is still being learnt, and may rise.
const LEARNT_NS: f64 = 2e9;
/// Time in ns that a first sample counts for, and that any sample counts for at most.
const SAMPLE_NS: u64 = 20_000_000;
/// A deviation in ns counts as no more than this: what would hold is no jitter.
const MOST_DEVIATION_NS: f64 = 20e6;
/// Mean deviations above the mean that are usual.
const DEVIATIONS: f64 = 4.0;

/// Level of ages that a person is used to: mean and four mean deviations, anchored when the two sides engage.
///
/// `m += g (a - m)`, `d += g (|a - m| - d)`, level `m + 4 d`, where the gain `g` is the time that a sample stands for by
/// the time known, at most 8 s. The mean begins at the anchoring with that of the last 0.1 s, the deviation with the
/// session at half of the first age. Two seconds after the anchoring the level is learnt: from then on it only falls, within
/// some 8 s, so that a delay that creeps up is measured against what it was, not against what it has become.
///
/// Source: RFC 6298, section 2 (`K = 4`, first deviation `R / 2`), with gains by time instead of by sample, since packets
/// of one link are correlated.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UsualAge {
    last_ns: Option<u64>,
    present_ns: f64,
    mean_ns: f64,
    deviation_ns: f64,
    /// For how long each of the three has been known, in ns, to its reach.
    present_known_ns: f64,
    mean_known_ns: f64,
    deviation_known_ns: f64,
    level_ns: f64,
}

impl Default for UsualAge {
    fn default() -> Self {
        Self::new()
    }
}

impl UsualAge {
    /// Knows nothing yet.
    pub fn new() -> Self {
        let known = SAMPLE_NS as f64;
        Self {
            last_ns: None,
            present_ns: 0.0,
            mean_ns: 0.0,
            deviation_ns: 0.0,
            present_known_ns: known,
            mean_known_ns: known,
            deviation_known_ns: known,
            level_ns: 0.0,
        }
    }

    /// Takes the age `age_ns` that a packet had when it arrived at `now_ns`.
    pub fn take(&mut self, now_ns: u64, age_ns: u64) {
        let age = age_ns as f64;
        let Some(last_ns) = self.last_ns.replace(now_ns) else {
            (self.present_ns, self.mean_ns) = (age, age);
            self.deviation_ns = (0.5 * age).min(MOST_DEVIATION_NS);
            self.level_ns = self.usual_ns();
            return;
        };
        let stands_ns = now_ns.saturating_sub(last_ns).min(SAMPLE_NS) as f64;
        let deviation = (age - self.mean_ns).abs().min(MOST_DEVIATION_NS);
        for (known, reach, value, seen) in [
            (&mut self.present_known_ns, PRESENT_NS, &mut self.present_ns, age),
            (&mut self.mean_known_ns, REACH_NS, &mut self.mean_ns, age),
            (&mut self.deviation_known_ns, REACH_NS, &mut self.deviation_ns, deviation),
        ] {
            *known = (*known + stands_ns).min(reach);
            *value += (seen - *value) * stands_ns / *known;
        }
        let higher_ns = self.usual_ns() - self.level_ns;
        if self.mean_known_ns < LEARNT_NS {
            self.level_ns += higher_ns;
        } else {
            self.level_ns += higher_ns.min(0.0) * stands_ns / REACH_NS;
        }
    }

    fn usual_ns(&self) -> f64 {
        self.mean_ns + DEVIATIONS * self.deviation_ns
    }

    /// What the ages are now is what they are measured against from here on: the two sides engage.
    pub fn anchor(&mut self) {
        self.mean_ns = self.present_ns;
        self.mean_known_ns = SAMPLE_NS as f64;
        self.level_ns = self.usual_ns();
    }

    /// The level in ns; none before the first packet.
    pub fn level_ns(&self) -> Option<u64> {
        // Finite, and not negative: a mean of ages.
        self.last_ns.map(|_| self.level_ns as u64)
    }

    /// Forgets all: for a new session of the peer.
    pub fn restart(&mut self) {
        *self = Self::new();
    }
}
