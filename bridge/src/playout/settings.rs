//! When packets are to be used.

/// How long a packet waits for its time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PlayoutPolicy {
    /// Not at all: what is newest is used.
    Newest,
    /// Until it is older by this than the packet of least delay was on its arrival. For couplings that need a constant
    /// delay.
    Constant {
        /// The wait in ns of a packet of least delay, so the jitter that is evened out.
        delay_ns: u64,
    },
    /// The same, with a wait that follows the jitter.
    Adaptive {
        /// How many mean deviations are waited for; 4 is common.
        factor: u32,
        /// Least wait in ns.
        least_ns: u64,
        /// Longest wait in ns.
        most_ns: u64,
    },
}

/// Settings of a play-out. Without the policy they rarely need a change.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PlayoutSettings {
    /// When a packet is used.
    pub policy: PlayoutPolicy,
    /// Most sequences that wait, missing ones included: more than delay times rate.
    pub capacity: usize,
    /// Window in ns in which the least delay is sought.
    pub window_ns: u64,
    /// Time in ns after the first packet in which the play-out follows what it learns at once, not slowly.
    pub warm_up_ns: u64,
    /// The play-out stays as it is while it would move by less, in ns.
    pub tolerance_ns: u64,
    /// How fast the play-out moves otherwise, in parts per billion of time: below a whole, so that time played never
    /// runs backwards.
    pub slew_ppb: u64,
    /// After this time in ns in which all packets came too late, the play-out begins anew: the path or a clock has
    /// changed. So it does at once with a packet that would wait for longer than this beyond its delay.
    pub relearn_ns: u64,
}

impl PlayoutSettings {
    /// Of a policy: 1024 sequences, a window of 10 s after a warm-up of 1 s, moves of 0.5 percent beyond 0.5 ms, anew
    /// after 200 ms of late packets.
    pub const fn new(policy: PlayoutPolicy) -> Self {
        Self {
            policy,
            capacity: 1024,
            window_ns: 10_000_000_000,
            warm_up_ns: 1_000_000_000,
            tolerance_ns: 500_000,
            slew_ppb: 5_000_000,
            relearn_ns: 200_000_000,
        }
    }

    pub(super) fn check(&self) -> Result<(), PlayoutError> {
        if !(1..=1 << 20).contains(&self.capacity) {
            return Err(PlayoutError::Capacity(self.capacity));
        }
        if self.slew_ppb >= crate::clock::BILLION {
            return Err(PlayoutError::Slew(self.slew_ppb));
        }
        if let PlayoutPolicy::Adaptive { least_ns, most_ns, .. } = self.policy
            && least_ns > most_ns
        {
            return Err(PlayoutError::Range { least_ns, most_ns });
        }
        Ok(())
    }
}

/// Settings with which nothing can be played.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum PlayoutError {
    /// Too few or too many to hold.
    #[error("capacity = {0}: must be from 1 to 1048576 sequences")]
    Capacity(usize),
    /// Time would run backwards.
    #[error("slew_ppb = {0}: must be below 1000000000, or time runs backwards")]
    Slew(u64),
    /// No delay lies in the range.
    #[error("least_ns = {least_ns}: must be at most most_ns = {most_ns}")]
    Range {
        /// The least.
        least_ns: u64,
        /// The most.
        most_ns: u64,
    },
}
