//! Why a datagram is not taken, and how often each was the cause.

/// Why a datagram is not taken, in the order in which it is looked at.
///
/// It has changed no state but its counter, and for [`Rejection::Forged`] the count towards the limit on forgeries.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Rejection {
    /// Of another length.
    #[error("datagram of a length that no datagram of this session has")]
    Length,
    /// Of something else, or of another version.
    #[error("datagram of another protocol or version")]
    Version,
    /// Of a kind that this side is never sent.
    #[error("datagram of a kind that this side is never sent")]
    Kind,
    /// Of a session that does not live here.
    #[error("datagram of a session that does not live here")]
    Session,
    /// Of an epoch whose keys are not here: past, or not yet.
    #[error("datagram of an epoch whose keys are not here")]
    Epoch,
    /// A counter beyond what one key may seal.
    #[error("counter beyond what one key may seal")]
    Counter,
    /// Too old to tell whether it was there before.
    #[error("counter too far behind the newest")]
    TooOld,
    /// There before.
    #[error("counter seen before")]
    Repeated,
    /// Its tag is not that of the shared key.
    #[error("tag that does not fit: forged, damaged, or sealed with another key")]
    Forged,
    /// An answer that nobody waits for.
    #[error("answer to a handshake that does not wait for one")]
    Unexpected,
    /// The first message of a handshake that was there before.
    #[error("first message of a handshake seen before")]
    Replayed,
    /// More handshakes than are worth answering.
    #[error("more handshakes than are answered in this time")]
    Busy,
    /// Keys of another master while one holds the lease.
    #[error("another master holds the lease")]
    Leased,
    /// The handshake could not go on here: no randomness was to be had.
    #[error("handshake that could not go on here: no randomness")]
    Unable,
}

impl Rejection {
    /// All causes.
    pub const ALL: [Self; 14] = [
        Self::Length,
        Self::Version,
        Self::Kind,
        Self::Session,
        Self::Epoch,
        Self::Counter,
        Self::TooOld,
        Self::Repeated,
        Self::Forged,
        Self::Unexpected,
        Self::Replayed,
        Self::Busy,
        Self::Leased,
        Self::Unable,
    ];
}

/// How many datagrams were not taken, by cause.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Rejections([u64; Rejection::ALL.len()]);

impl Rejections {
    pub(super) fn count(&mut self, cause: Rejection) {
        self.0[cause as usize] += 1;
    }

    /// The same with `more` datagrams not taken for this cause.
    #[must_use]
    pub(crate) fn with(mut self, cause: Rejection, more: u64) -> Self {
        self.0[cause as usize] += more;
        self
    }

    /// Datagrams not taken for this cause.
    pub fn of(&self, cause: Rejection) -> u64 {
        self.0[cause as usize]
    }

    /// Datagrams not taken for any cause.
    pub fn total(&self) -> u64 {
        self.0.iter().sum()
    }

    /// Each cause with its count.
    pub fn iter(&self) -> impl Iterator<Item = (Rejection, u64)> + '_ {
        Rejection::ALL.into_iter().zip(self.0)
    }
}

impl std::ops::Add for Rejections {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        let mut sum = self;
        for (count, more) in sum.0.iter_mut().zip(other.0) {
            *count += more;
        }
        sum
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_cause_has_its_own_count() {
        let mut counts = Rejections::default();
        for (n, cause) in Rejection::ALL.into_iter().enumerate() {
            assert_eq!(cause as usize, n);
            counts.count(cause);
            assert_eq!((counts.of(cause), counts.total()), (1, n as u64 + 1));
        }
        let twice = counts + counts;
        assert!(twice.iter().all(|(_, count)| count == 2));
    }
}
