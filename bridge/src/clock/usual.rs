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
const MAX_DEVIATION_NS: f64 = 20e6;
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
#[expect(clippy::struct_field_names, reason = "they are of one unit")]
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
            self.deviation_ns = (0.5 * age).min(MAX_DEVIATION_NS);
            self.level_ns = self.usual_ns();
            return;
        };
        let stands_ns = now_ns.saturating_sub(last_ns).min(SAMPLE_NS) as f64;
        let deviation = (age - self.mean_ns).abs().min(MAX_DEVIATION_NS);
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
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // finite, not negative: a mean of ages
    pub fn level_ns(&self) -> Option<u64> {
        self.last_ns.map(|_| self.level_ns as u64)
    }

    /// Forgets all: for a new session of the peer.
    pub fn restart(&mut self) {
        *self = Self::new();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    /// Feeds an age in ms each ms, from `from_ms` on.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // whole ns of tens of ms
    fn feed(usual: &mut UsualAge, from_ms: u64, count: u64, age_ms: impl Fn(u64) -> f64) {
        for n in from_ms..from_ms + count {
            usual.take(n * MS, (age_ms(n) * MS as f64) as u64);
        }
    }

    fn level_ms(usual: &UsualAge) -> f64 {
        usual.level_ns().unwrap() as f64 / MS as f64
    }

    /// `d_n = d_0 (20 ms / 21 ms) (21 / 22) ...`: of the first guess the share that 20 ms have of the time known is left.
    #[test]
    fn of_the_first_guess_the_share_of_its_time_is_left() {
        for (age_ms, first_ms) in [(10.0, 5.0), (40.0, 20.0), (100.0, 20.0)] {
            let mut usual = UsualAge::new();
            assert_eq!(usual.level_ns(), None);
            feed(&mut usual, 0, 1, |_| age_ms);
            assert_eq!(level_ms(&usual), age_ms + 4.0 * first_ms);
            for (from_ms, count, known_ms) in [(1, 80, 100.0), (81, 900, 1000.0), (981, 980, 1980.0)] {
                feed(&mut usual, from_ms, count, |_| age_ms);
                let wanted = age_ms + 4.0 * first_ms * 20.0 / known_ms;
                // Whole ns.
                assert!(
                    (level_ms(&usual) - wanted).abs() < 2e-6,
                    "{known_ms}: {} {wanted}",
                    level_ms(&usual)
                );
            }
        }
    }

    /// Two ages in turn, 6 ms apart, deviate by 3 ms: 12 ms above the mean.
    #[test]
    fn jitter_is_usual() {
        let mut usual = UsualAge::new();
        feed(&mut usual, 0, 30_000, |n| if n % 2 == 0 { 50.0 } else { 56.0 });
        // A three hundredth of the first guess is left after as many ms, and each sample moves the mean.
        assert!((level_ms(&usual) - (53.0 + 12.0)).abs() < 0.5, "{}", level_ms(&usual));
    }

    #[test]
    fn what_creeps_up_is_not_followed_and_what_falls_is_within_8_s() {
        let mut usual = UsualAge::new();
        feed(&mut usual, 0, 3000, |_| 20.0);
        let learnt = level_ms(&usual);
        feed(&mut usual, 3000, 10_000, |n| 20.0 + 0.012 * (n - 3000) as f64);
        assert!(level_ms(&usual) <= learnt);
        // Pressed anew at 140 ms: that is usual now, but for how far it is behind the creep within 0.1 s.
        usual.anchor();
        let deviation_ms = (level_ms(&usual) - 140.0) / 4.0;
        assert!((-0.5..=20.0).contains(&deviation_ms), "{deviation_ms}");
        feed(&mut usual, 13_000, 60_000, |_| 140.0);
        assert!((level_ms(&usual) - 140.0).abs() < 0.5, "{}", level_ms(&usual));
        // Mean, deviation and level follow one another with 8 s. Once the mean is within 20 ms of the fallen age, after
        // ln 5 of these, what is left of the level is at most (100 + 100 s + 40 s^2) exp(-s) ms.
        feed(&mut usual, 73_000, 80_000, |_| 40.0);
        let left_ms = level_ms(&usual) - 40.0;
        let s = 10.0 - 5.0_f64.ln();
        let most_ms = (100.0 + 100.0 * s + 40.0 * s * s) * (-s).exp();
        assert!((0.0..most_ms).contains(&left_ms), "{left_ms} {most_ms}");
        usual.restart();
        assert_eq!(usual, UsualAge::new());
    }

    /// Whatever is told, the level stays finite and within 80 ms of the greatest age.
    #[test]
    fn no_jitter_raises_the_level_by_more_than_80_ms() {
        let mut usual = UsualAge::new();
        for n in 0..20_000_u64 {
            let age_ns = n.wrapping_mul(6_364_136_223_846_793_005) >> 36;
            usual.take(n * MS, age_ns);
            if n % 3000 == 0 {
                usual.anchor();
            }
            assert!(usual.level_ns().unwrap() <= (1 << 28) + 80 * MS);
        }
    }
}
