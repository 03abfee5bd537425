//! `CoDel`: drops from a queue whose packets have waited too long for some time.
//!
//! A decision concerns the time at which a packet leaves the queue. That time is known when it enters,
//! because everything ahead of it is determined. One test cannot see later arrivals: that less than a full
//! packet is waiting. It counts the bytes that wait when the packet enters, its own included.
//!
//! Source: K. Nichols, V. Jacobson et al., "Controlled delay active queue management", RFC 8289, section 5,
//! applied packet by packet.

/// Acceptable permanent wait in ns.
const TARGET_NS: u64 = 5_000_000;
/// Time in ns that the wait may exceed the target.
const INTERVAL_NS: u64 = 100_000_000;
/// Size of a full packet in bytes.
const FULL_PACKET: u64 = 1500;

/// Treatment of the packet after a dropped one, if it is already queued.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Next {
    /// No special treatment.
    #[default]
    Regular,
    /// The packet passes: entering the dropping state costs one packet.
    Passes,
    /// The packet advances the next drop, and may be dropped at the same time.
    Follows,
}

#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Codel {
    /// Time at which the wait will have exceeded the target for an interval; 0 while it is below.
    first_above_ns: u64,
    dropping: bool,
    drop_next_ns: u64,
    count: u64,
    last_count: u64,
    next: Next,
}

impl Codel {
    /// Decides on a packet that leaves the queue at `now_ns`; packets come in order.
    pub(super) fn drops(&mut self, arrival_ns: u64, now_ns: u64, backlog: u64) -> bool {
        let may_drop = self.may_drop(now_ns - arrival_ns, now_ns, backlog);
        // A packet that did not wait found an empty queue, so it does not follow the previous one.
        let next = if now_ns == arrival_ns { Next::Regular } else { self.next };
        self.next = Next::Regular;
        match next {
            Next::Passes => return false,
            Next::Follows if may_drop => self.drop_next_ns = control_law(self.drop_next_ns, self.count),
            Next::Follows | Next::Regular => {}
        }
        if self.dropping {
            self.dropping = may_drop;
            if self.dropping && now_ns >= self.drop_next_ns {
                self.count += 1;
                self.next = Next::Follows;
                return true;
            }
            return false;
        }
        if may_drop {
            self.enter(now_ns);
        }
        may_drop
    }

    /// Test if the wait has exceeded the target for an interval.
    fn may_drop(&mut self, wait_ns: u64, now_ns: u64, backlog: u64) -> bool {
        if wait_ns < TARGET_NS || backlog <= FULL_PACKET {
            self.first_above_ns = 0;
        } else if self.first_above_ns == 0 {
            self.first_above_ns = now_ns.saturating_add(INTERVAL_NS);
        } else {
            return now_ns >= self.first_above_ns;
        }
        false
    }

    fn enter(&mut self, now_ns: u64) {
        // Soon after the previous dropping state, resume at its drop rate.
        let since = self.count - self.last_count;
        let recent = now_ns.saturating_sub(self.drop_next_ns) < 16 * INTERVAL_NS;
        self.count = if since > 1 && recent { since } else { 1 };
        self.drop_next_ns = control_law(now_ns, self.count);
        self.last_count = self.count;
        self.dropping = true;
        self.next = Next::Passes;
    }
}

/// Time of the next drop: the interval shrinks with the square root of the number of drops.
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0 to one interval")]
fn control_law(from_ns: u64, count: u64) -> u64 {
    from_ns.saturating_add((INTERVAL_NS as f64 / (count as f64).sqrt()).round() as u64)
}
