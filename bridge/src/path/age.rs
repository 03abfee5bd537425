//! Age of the peer's newest packet by our clock only, and the level that the ladder compares with.

use super::{peer_clock::ClockFault, share_up};

/// Number of send times kept: four seconds at 1 kHz. Echoes of older packets are ignored.
const SENT_KEPT: usize = 4096;

/// Bounds the age of the newest packet, from our send times.
///
/// A packet that echoes counter `c` left the peer after `c` arrived there, so not before `T_c`, when `c` was sent by
/// our clock. At `now` it is at most `now - T_c` old, for any delays and peer clock. A packet is never older than one
/// sent before it, so the bound does not fall back when an echo is missing.
#[derive(Clone, Debug)]
pub struct PacketAge {
    /// Maximum drift in ppb of the peer's clock, which measures the hold time.
    max_drift_ppb: u64,
    /// Send times in ns, indexed by counter modulo length.
    sent: Box<[u64]>,
    /// Newest counter sent.
    newest: Option<u64>,
    /// Number of known send times up to the newest.
    known: u64,
    /// Lower bound in ns of the send time of the newest packet.
    sent_after_ns: Option<u64>,
}

impl PacketAge {
    /// Create a tracker without packets. Healthy clocks drift apart by at most `max_drift_ppb`.
    pub fn new(max_drift_ppb: u64) -> Self {
        let sent = vec![0; SENT_KEPT].into_boxed_slice();
        Self { max_drift_ppb, sent, newest: None, known: 0, sent_after_ns: None }
    }

    /// Record our packet `counter`, sent at `now_ns`. A gap in the counters clears all before.
    pub fn sent(&mut self, counter: u64, now_ns: u64) {
        let follows = self.newest.and_then(|newest| newest.checked_add(1)) == Some(counter);
        self.known = if follows { (self.known + 1).min(SENT_KEPT as u64) } else { 1 };
        self.newest = Some(counter);
        self.sent[slot(counter)] = now_ns;
    }

    /// Take the echo of a packet newer than all before, arrived at `now_ns`: our counter, and the hold time in ns.
    /// Ignores unknown counters.
    ///
    /// A hold time longer than the exchange is a fault of a clock; the bound holds even then.
    pub fn received(&mut self, now_ns: u64, echo: (u64, u64)) -> Result<(), ClockFault> {
        let (counter, held_ns) = echo;
        self.sent_at(counter).map_or(Ok(()), |sent_ns| self.echoed(now_ns, sent_ns, held_ns))
    }

    /// The same, for an echo of a packet sent at `sent_ns`.
    #[inline]
    pub(super) fn echoed(&mut self, now_ns: u64, sent_ns: u64, held_ns: u64) -> Result<(), ClockFault> {
        self.sent_after_ns = Some(self.sent_after_ns.unwrap_or(0).max(sent_ns));
        let took_ns = now_ns.saturating_sub(sent_ns);
        if held_ns <= took_ns {
            return Ok(());
        }
        // Both readings of the hold time are whole ns, so 1 ns may be rounding.
        let unsure_ns = share_up(held_ns, self.max_drift_ppb).saturating_add(1);
        if held_ns.saturating_sub(unsure_ns) > took_ns {
            return Err(ClockFault::NegativeRoundTrip { by_ns: held_ns - took_ns });
        }
        Ok(())
    }

    /// Send time of our packet `counter` in ns; `None` if not kept.
    pub fn sent_at(&self, counter: u64) -> Option<u64> {
        let before = self.newest?.checked_sub(counter)?;
        (before < self.known).then(|| self.sent[slot(counter)])
    }

    /// Maximum age in ns of the newest packet at `now_ns`; `None` before the first known echo.
    pub fn max_ns(&self, now_ns: u64) -> Option<u64> {
        self.sent_after_ns.map(|sent_ns| now_ns.saturating_sub(sent_ns))
    }

    /// Clear the state of the peer's packets for a new session, but keeps send times.
    pub fn restart(&mut self) {
        self.sent_after_ns = None;
    }
}

fn slot(counter: u64) -> usize {
    usize::try_from(counter % SENT_KEPT as u64).unwrap_or(0)
}

/// Averaging time in ns of mean and deviation.
const REACH_NS: f64 = 8e9;
/// Averaging time in ns of the present mean.
const PRESENT_NS: f64 = 0.1e9;
/// Time in ns after an anchoring in which the level is learnt and may rise.
const LEARNT_NS: f64 = 2e9;
/// Time in ns that the first sample stands for, and maximum for any sample.
const SAMPLE_NS: u64 = 20_000_000;
/// Deviations in ns saturate here: one that makes the ladder hold is not jitter.
const MAX_DEVIATION_NS: f64 = 20e6;
/// Number of mean deviations above the mean that belong to the baseline.
const DEVIATIONS: f64 = 4.0;

/// Baseline of a link's ages for the ladder: mean plus four mean deviations, anchored when the sides engage.
///
/// `m += g (a - m)`, `d += g (|a - m| - d)`, level `m + 4 d`. The gain `g` is the time that a sample stands for, over
/// the known time of at most 8 s. The mean starts at the anchoring with that of the last 0.1 s, the deviation with
/// the session at half of the first age. Two seconds after the anchoring the level is learnt: it then only falls,
/// within some 8 s. So a creeping delay is compared with its earlier value.
///
/// Source: RFC 6298, section 2 (`K = 4`, first deviation `R / 2`), with gains by time instead of by sample, since
/// packets of one link are correlated.
#[derive(Clone, Copy, Debug, PartialEq)]
#[expect(clippy::struct_field_names, reason = "they are of one unit")]
pub struct AgeBaseline {
    last_ns: Option<u64>,
    present_ns: f64,
    mean_ns: f64,
    deviation_ns: f64,
    /// Known time in ns of each of the three, up to its averaging time.
    present_known_ns: f64,
    mean_known_ns: f64,
    deviation_known_ns: f64,
    level_ns: f64,
}

impl Default for AgeBaseline {
    fn default() -> Self {
        Self::new()
    }
}

impl AgeBaseline {
    /// Create a baseline without ages.
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

    /// Take the age `age_ns` of a packet that arrived at `now_ns`.
    #[inline]
    pub fn take(&mut self, now_ns: u64, age_ns: u64) {
        let age = age_ns as f64;
        let Some(last_ns) = self.last_ns.replace(now_ns) else {
            (self.present_ns, self.mean_ns) = (age, age);
            self.deviation_ns = (0.5 * age).min(MAX_DEVIATION_NS);
            self.level_ns = self.present_level_ns();
            return;
        };
        let stands_ns = now_ns.saturating_sub(last_ns).min(SAMPLE_NS) as f64;
        for (known, reach) in [
            (&mut self.present_known_ns, PRESENT_NS),
            (&mut self.mean_known_ns, REACH_NS),
            (&mut self.deviation_known_ns, REACH_NS),
        ] {
            *known = (*known + stands_ns).min(reach);
        }
        // Depends on times only: these divisions do not wait for the age.
        let [present_gain, mean_gain, deviation_gain] =
            [self.present_known_ns, self.mean_known_ns, self.deviation_known_ns]
                .map(|known| stands_ns / known);
        let above_ns = age - self.mean_ns;
        self.present_ns += present_gain * (age - self.present_ns);
        self.mean_ns += mean_gain * above_ns;
        self.deviation_ns += deviation_gain * (above_ns.abs().min(MAX_DEVIATION_NS) - self.deviation_ns);
        let higher_ns = self.present_level_ns() - self.level_ns;
        if self.mean_known_ns < LEARNT_NS {
            self.level_ns += higher_ns;
        } else {
            self.level_ns += stands_ns / REACH_NS * higher_ns.min(0.0);
        }
    }

    fn present_level_ns(&self) -> f64 {
        self.mean_ns + DEVIATIONS * self.deviation_ns
    }

    /// Anchors the level at the present ages, when the sides engage.
    pub fn anchor(&mut self) {
        self.mean_ns = self.present_ns;
        self.mean_known_ns = SAMPLE_NS as f64;
        self.level_ns = self.present_level_ns();
    }

    /// Level in ns; `None` before the first packet.
    #[inline]
    #[allow(clippy::cast_possible_truncation)] // a mean of ages: from 0 to below 2^63, as ages of 292 years are
    pub fn level_ns(&self) -> Option<u64> {
        // Signed, since processors have an instruction for it.
        self.last_ns.map(|_| (self.level_ns as i64).cast_unsigned())
    }

    /// Clear all, for a new session of the peer.
    pub fn restart(&mut self) {
        *self = Self::new();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    /// Feed an age in ms each ms, from `from_ms` on.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // whole ns of tens of ms
    fn feed(baseline: &mut AgeBaseline, from_ms: u64, count: u64, age_ms: impl Fn(u64) -> f64) {
        for n in from_ms..from_ms + count {
            baseline.take(n * MS, (age_ms(n) * MS as f64) as u64);
        }
    }

    fn level_ms(baseline: &AgeBaseline) -> f64 {
        baseline.level_ns().unwrap() as f64 / MS as f64
    }

    /// `d_n = d_0 (20 ms / 21 ms) (21 / 22) ...`: the first guess has the weight of 20 ms over the known time.
    #[test]
    fn weight_of_first_guess_decays_with_known_time() {
        for (age_ms, first_ms) in [(10.0, 5.0), (40.0, 20.0), (100.0, 20.0)] {
            let mut baseline = AgeBaseline::new();
            assert_eq!(baseline.level_ns(), None);
            feed(&mut baseline, 0, 1, |_| age_ms);
            assert_eq!(level_ms(&baseline), age_ms + 4.0 * first_ms);
            for (from_ms, count, known_ms) in [(1, 80, 100.0), (81, 900, 1000.0), (981, 980, 1980.0)] {
                feed(&mut baseline, from_ms, count, |_| age_ms);
                let wanted = age_ms + 4.0 * first_ms * 20.0 / known_ms;
                // Whole ns.
                assert!(
                    (level_ms(&baseline) - wanted).abs() < 2e-6,
                    "{known_ms}: {} {wanted}",
                    level_ms(&baseline)
                );
            }
        }
    }

    /// Up to its averaging time, a mean is that of all ages so far; the first stands for 20 ms.
    #[test]
    fn mean_and_deviation_are_those_of_all_ages_so_far() {
        let age_ms = |n: u64| if n % 700 < 350 { 10.0 } else { 30.0 };
        let mut baseline = AgeBaseline::new();
        feed(&mut baseline, 0, 1, age_ms);
        let (mut sum, mut deviations) = (20.0 * age_ms(0), 20.0 * 0.5 * age_ms(0));
        for n in 1..1900 {
            let mean = sum / (19 + n) as f64;
            feed(&mut baseline, n, 1, age_ms);
            sum += age_ms(n);
            deviations += (age_ms(n) - mean).abs();
            let wanted = (sum + 4.0 * deviations) / (20 + n) as f64;
            // Whole ns.
            assert!((level_ms(&baseline) - wanted).abs() < 2e-6, "{n}: {} {wanted}", level_ms(&baseline));
        }
    }

    /// Two alternating ages, 6 ms apart, deviate by 3 ms: 12 ms above the mean.
    #[test]
    fn jitter_is_part_of_the_level() {
        let mut baseline = AgeBaseline::new();
        feed(&mut baseline, 0, 30_000, |n| if n % 2 == 0 { 50.0 } else { 56.0 });
        // A three hundredth of the first guess is left after as many ms, and each sample moves the mean.
        assert!((level_ms(&baseline) - (53.0 + 12.0)).abs() < 0.5, "{}", level_ms(&baseline));
    }

    #[test]
    fn level_ignores_creep_and_follows_fall_within_8_s() {
        let mut baseline = AgeBaseline::new();
        feed(&mut baseline, 0, 3000, |_| 20.0);
        let learnt = level_ms(&baseline);
        feed(&mut baseline, 3000, 10_000, |n| 20.0 + 0.012 * (n - 3000) as f64);
        assert!(level_ms(&baseline) <= learnt);
        // Anchored again at 140 ms, minus its lag behind the creep within 0.1 s.
        baseline.anchor();
        let deviation_ms = (level_ms(&baseline) - 140.0) / 4.0;
        assert!((-0.5..=20.0).contains(&deviation_ms), "{deviation_ms}");
        feed(&mut baseline, 13_000, 60_000, |_| 140.0);
        assert!((level_ms(&baseline) - 140.0).abs() < 0.5, "{}", level_ms(&baseline));
        // Mean, deviation and level follow each other with 8 s. The mean is within 20 ms of the fallen age after ln 5
        // of these. Then at most (100 + 100 s + 40 s^2) exp(-s) ms of the level are left.
        feed(&mut baseline, 73_000, 80_000, |_| 40.0);
        let left_ms = level_ms(&baseline) - 40.0;
        let s = 10.0 - 5.0_f64.ln();
        let max_ms = (100.0 + 100.0 * s + 40.0 * s * s) * (-s).exp();
        assert!((0.0..max_ms).contains(&left_ms), "{left_ms} {max_ms}");
        baseline.restart();
        assert_eq!(baseline, AgeBaseline::new());
    }

    /// For any ages, the level stays finite and within 80 ms of the maximum age.
    #[test]
    fn no_jitter_raises_the_level_by_more_than_80_ms() {
        let mut baseline = AgeBaseline::new();
        for n in 0..20_000_u64 {
            let age_ns = n.wrapping_mul(6_364_136_223_846_793_005) >> 36;
            baseline.take(n * MS, age_ns);
            if n % 3000 == 0 {
                baseline.anchor();
            }
            assert!(baseline.level_ns().unwrap() <= (1 << 28) + 80 * MS);
        }
    }
}
