//! Waiting for a deadline: asleep until shortly before, then spinning.

/// Maximum spin before a departure, in ns.
const SPIN_NS: u64 = 100_000;
/// Maximum sleep in ns, so that a stop is noticed.
const SLEEP_NS: u64 = 20_000_000;
/// Maximum saved spin time in ns.
const MAX_CREDIT_NS: u64 = 2_000_000;

/// Decides how long to sleep.
///
/// The kernel wakes a sleeper some us late, some tens of us without real-time scheduling; a spinner is on
/// time. With a deadline every few us, spinning before each would occupy the processor forever, and under
/// real-time scheduling nothing could preempt it. Therefore at most half of the time is spent spinning; the
/// rest is slept until the exact deadline.
#[derive(Debug)]
pub(super) struct SpinBudget {
    credit_ns: u64,
    looked_ns: u64,
    was_spinning: bool,
}

impl Default for SpinBudget {
    fn default() -> Self {
        Self { credit_ns: MAX_CREDIT_NS, looked_ns: 0, was_spinning: false }
    }
}

impl SpinBudget {
    /// Time to sleep now in ns; `None` to spin.
    pub(super) fn sleep_ns(&mut self, now_ns: u64, due_ns: Option<u64>) -> Option<u64> {
        let passed_ns = now_ns.saturating_sub(self.looked_ns);
        self.looked_ns = now_ns;
        self.credit_ns = if self.was_spinning {
            self.credit_ns.saturating_sub(passed_ns)
        } else {
            self.credit_ns.saturating_add(passed_ns).min(MAX_CREDIT_NS)
        };
        let until_due_ns = due_ns.map_or(u64::MAX, |due_ns| due_ns.saturating_sub(now_ns));
        self.was_spinning = false;
        if until_due_ns == 0 {
            return None;
        }
        if until_due_ns > SPIN_NS {
            return Some((until_due_ns - SPIN_NS).min(SLEEP_NS));
        }
        if self.credit_ns == 0 {
            return Some(until_due_ns);
        }
        self.was_spinning = true;
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_last_part_before_a_deadline_is_spent_awake() {
        let mut budget = SpinBudget::default();
        assert_eq!(budget.sleep_ns(0, None), Some(SLEEP_NS));
        assert_eq!(budget.sleep_ns(0, Some(1_000_000)), Some(1_000_000 - SPIN_NS));
        assert_eq!(budget.sleep_ns(1_000_000 - SPIN_NS, Some(1_000_000)), None);
        assert_eq!(budget.sleep_ns(999_999, Some(1_000_000)), None);
        assert_eq!(budget.sleep_ns(1_000_001, Some(1_000_000)), None);
        // 1 kHz in both directions never exhausts the budget.
        for tick in 0..10_000 {
            let due_ns = 2_000_000 + tick * 500_000;
            assert_eq!(budget.sleep_ns(due_ns - SPIN_NS, Some(due_ns)), None);
            assert_eq!(budget.sleep_ns(due_ns, Some(due_ns)), None);
        }
    }

    #[test]
    fn at_most_half_of_the_time_is_spent_awake() {
        let mut budget = SpinBudget::default();
        let (mut now_ns, mut asleep_ns) = (0, 0);
        while now_ns < 1_000_000_000 {
            // The next deadline is always 10 us away.
            match budget.sleep_ns(now_ns, Some(now_ns + 10_000)) {
                Some(sleep_ns) => {
                    asleep_ns += sleep_ns;
                    now_ns += sleep_ns;
                }
                None => now_ns += 500,
            }
        }
        assert!(asleep_ns * 2 >= now_ns - 2 * MAX_CREDIT_NS, "{asleep_ns} of {now_ns}");
    }
}
