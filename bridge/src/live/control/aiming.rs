//! Connection that aims the hand of a model: one at a time.

use haptether_master::Aim;

/// Time in us after its last aim for which no other connection may aim: the hand still follows it.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // a positive constant
const ALONE_US: u64 = (Aim::<1>::EXPIRES_S * 1e6) as u64;

#[derive(Debug, Default)]
pub(super) struct Aiming(Option<Last>);

/// Last aim.
#[derive(Clone, Copy, Debug)]
struct Last {
    from: u64,
    at_us: u64,
}

impl Aiming {
    /// True if connection `from` may aim now.
    pub(super) fn may(&self, from: u64, now_us: u64) -> bool {
        self.0.is_none_or(|last| last.from == from || now_us.saturating_sub(last.at_us) > ALONE_US)
    }

    /// Note an aim of connection `from`.
    pub(super) fn aimed(&mut self, from: u64, now_us: u64) {
        self.0 = Some(Last { from, at_us: now_us });
    }

    /// Forget connection `from`. Returns whether the last aim was of this connection: then the hand must open.
    pub(super) fn end(&mut self, from: u64) -> bool {
        self.0.take_if(|last| last.from == from).is_some()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_connection_aims_until_silence_or_end() {
        let mut aiming = Aiming::default();
        assert!(aiming.may(1, 0) && !aiming.end(1));
        aiming.aimed(1, 1000);
        assert!(aiming.may(1, 1001) && !aiming.may(2, 1000 + ALONE_US));
        assert!(aiming.may(2, 1001 + ALONE_US), "silence");
        assert!(!aiming.end(2) && aiming.end(1) && aiming.may(2, 1002), "end");
        aiming.aimed(2, 2000);
        assert!(!aiming.end(1), "the hand of another connection stays closed");
    }
}
