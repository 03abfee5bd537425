//! `CoDel`: drops from a queue in which packets have waited too long for a while.
//!
//! Decisions are taken when a packet leaves the queue, at a time that is known when it enters, since everything ahead
//! of it is settled by then. Only the test that less than a full packet is waiting cannot look at what comes in
//! between: it counts the bytes that wait when the packet enters, its own included.
//!
//! Source: K. Nichols, V. Jacobson et al., "Controlled delay active queue management", RFC 8289,
//! section 5, taken packet by packet.

/// Wait in ns that is acceptable for good.
const TARGET_NS: u64 = 5_000_000;
/// How long in ns the wait may be above the target.
const INTERVAL_NS: u64 = 100_000_000;
/// Bytes of a full packet.
const FULL_PACKET: u64 = 1500;

/// What follows the packet that was dropped last, if its successor is already there.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Next {
    /// Nothing in particular.
    #[default]
    Regular,
    /// It passes: entering the dropping state costs one packet.
    Passes,
    /// It moves the next drop on, and may be dropped at the same time.
    Follows,
}

#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Codel {
    /// When the wait will have been above the target for an interval; 0 while it is below.
    first_above_ns: u64,
    dropping: bool,
    drop_next_ns: u64,
    count: u64,
    last_count: u64,
    next: Next,
}

impl Codel {
    /// Decides on a packet that leaves the queue at `now_ns`; packets come in their order.
    pub(super) fn drops(&mut self, arrival_ns: u64, now_ns: u64, backlog: u64) -> bool {
        let may_drop = self.may_drop(now_ns - arrival_ns, now_ns, backlog);
        // What did not wait found the queue empty, so nothing followed the packet before it.
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

    /// Whether packets have waited longer than the target for an interval.
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
        // Soon after the last time, it goes on at the rate of drops that was right then.
        let since = self.count - self.last_count;
        let recent = now_ns.saturating_sub(self.drop_next_ns) < 16 * INTERVAL_NS;
        self.count = if since > 1 && recent { since } else { 1 };
        self.drop_next_ns = control_law(now_ns, self.count);
        self.last_count = self.count;
        self.dropping = true;
        self.next = Next::Passes;
    }
}

/// Time of the next drop: drops come closer together with the square root of their number.
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0 to one interval")]
fn control_law(from_ns: u64, count: u64) -> u64 {
    from_ns.saturating_add((INTERVAL_NS as f64 / (count as f64).sqrt()).round() as u64)
}
