//! The settings of a session, and what they must be.

use super::wire::{HANDSHAKE_LENGTH, sealed_length};
use crate::wire::{FrameForm, FrameLayout, MAX_FRAME, Role};

const MS: u64 = 1_000_000;
const SECOND: u64 = 1000 * MS;

/// How a session goes. [`SessionSettings::new`] returns what all but tests use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SessionSettings {
    /// The side that this is. The master begins every handshake, the slave grants the lease.
    pub role: Role,
    /// Bytes of every payload, in both directions.
    pub payload_length: usize,
    /// What stands in the payloads: a slave refuses a master that says otherwise.
    pub form: FrameForm,
    /// Time between two datagrams of the peer in ns.
    pub peer_period_ns: u64,
    /// How far behind the newest a datagram may be and still be distinguished from a replay, in ns of the peer's rate.
    pub window_ns: u64,
    /// Age of a key at which the master begins the next handshake.
    pub rekey_ns: u64,
    /// Age of a key at which nothing more is sent under it.
    pub refuse_ns: u64,
    /// How long the keys before the newest still open what was in flight; above the delay of the link.
    pub overlap_ns: u64,
    /// Silence of the peer after which the master begins anew, and a local act at the slave may free the lease.
    pub silence_ns: u64,
    /// Datagrams that one key seals at most.
    pub max_sealed: u64,
    /// Forgeries against one session, all its keys together, after which it ends.
    pub max_forged: u64,
}

/// Settings that do not make a session.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SettingsError {
    /// No datagram of that length can be.
    #[error("payload_length = {0}: must be between 1 and {MAX_FRAME}, and not as long as a handshake")]
    PayloadLength(usize),
    /// The window cannot be reserved, or holds nothing.
    #[error(
        "window_ns = {window_ns} at peer_period_ns = {peer_period_ns}: must hold 1 to {MAX_WINDOW} datagrams"
    )]
    Window {
        /// As given.
        window_ns: u64,
        /// As given.
        peer_period_ns: u64,
    },
    /// Times out of their order.
    #[error(
        "overlap_ns = {overlap_ns}, rekey_ns = {rekey_ns}, refuse_ns = {refuse_ns}: must rise in this order"
    )]
    Order {
        /// As given.
        overlap_ns: u64,
        /// As given.
        rekey_ns: u64,
        /// As given.
        refuse_ns: u64,
    },
    /// A limit or a time of zero.
    #[error("{0} = 0: must be above zero")]
    Zero(&'static str),
}

/// Bits of a window at most: 512 KiB.
const MAX_WINDOW: u64 = 1 << 22;
/// Bits of a window at least.
const MIN_WINDOW: u64 = 1024;

impl SessionSettings {
    /// The default times, for payloads of `payload_length` bytes and a peer that sends one each `peer_period_ns`.
    ///
    /// 2 s of window; keys renewed after 120 s and dead after 180 s, as in `WireGuard` (section 6.1); 5 s of
    /// overlap, above any delay that anybody teleoperates over; 2 s of silence; 2^32 datagrams under a key, 4.9 days
    /// at 10 kHz, long after the age limit; 2^36 forgeries.
    ///
    /// Source: Donenfeld, *`WireGuard`: Next Generation Kernel Network Tunnel*, 2017; RFC 9001, section 6.6 (the
    /// integrity limit of ChaCha20-Poly1305).
    pub const fn new(role: Role, payload_length: usize, peer_period_ns: u64) -> Self {
        Self {
            role,
            payload_length,
            #[allow(clippy::cast_possible_truncation)] // longer ones are refused
            form: FrameForm(payload_length as u16),
            peer_period_ns,
            window_ns: 2 * SECOND,
            rekey_ns: 120 * SECOND,
            refuse_ns: 180 * SECOND,
            overlap_ns: 5 * SECOND,
            silence_ns: 2 * SECOND,
            max_sealed: 1 << 32,
            max_forged: 1 << 36,
        }
    }

    /// Settings for frames of this layout.
    pub const fn of_frames(role: Role, layout: FrameLayout, peer_period_ns: u64) -> Self {
        let settings = Self::new(role, layout.length(), peer_period_ns);
        Self { form: layout.form(), ..settings }
    }

    pub(super) fn check(&self) -> Result<(), SettingsError> {
        let length = self.payload_length;
        if length == 0 || length > MAX_FRAME || sealed_length(length) == HANDSHAKE_LENGTH {
            return Err(SettingsError::PayloadLength(length));
        }
        let (window_ns, peer_period_ns) = (self.window_ns, self.peer_period_ns);
        if peer_period_ns == 0 || window_ns == 0 || window_ns / peer_period_ns > MAX_WINDOW {
            return Err(SettingsError::Window { window_ns, peer_period_ns });
        }
        let (overlap_ns, rekey_ns, refuse_ns) = (self.overlap_ns, self.rekey_ns, self.refuse_ns);
        if overlap_ns >= rekey_ns || rekey_ns >= refuse_ns {
            return Err(SettingsError::Order { overlap_ns, rekey_ns, refuse_ns });
        }
        for (name, value) in [
            ("overlap_ns", overlap_ns),
            ("silence_ns", self.silence_ns),
            ("max_sealed", self.max_sealed),
            ("max_forged", self.max_forged),
        ] {
            if value == 0 {
                return Err(SettingsError::Zero(name));
            }
        }
        Ok(())
    }

    /// Age of a key at which the operator is warned that no others have been made: 60 s before it opens nothing more.
    pub(super) const fn warn_ns(&self) -> u64 {
        self.rekey_ns + (self.refuse_ns - self.rekey_ns) / 12
    }

    /// Age at which keys open nothing more: what was sealed last may still be in flight when sealing ends.
    pub(super) const fn open_ns(&self) -> u64 {
        self.refuse_ns.saturating_add(self.overlap_ns)
    }

    /// Counters that the window reaches back.
    pub(super) fn window(&self) -> u32 {
        let datagrams = self.window_ns.div_ceil(self.peer_period_ns.max(1));
        u32::try_from(datagrams.clamp(MIN_WINDOW, MAX_WINDOW)).unwrap_or(u32::MAX)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_window_is_two_seconds_of_the_peer() {
        for (period_ns, reach) in [(MS, 2000), (100_000, 20_000), (10_000, 200_000), (10 * MS, 1024)] {
            let settings = SessionSettings::new(Role::Master, 92, period_ns);
            assert_eq!(settings.check(), Ok(()));
            assert_eq!(settings.window(), reach);
        }
    }

    #[test]
    fn what_makes_no_session_is_refused_by_name() {
        let good = SessionSettings::new(Role::Slave, 92, MS);
        for (bad, said) in [
            (SessionSettings { payload_length: 0, ..good }, "payload_length = 0"),
            (SessionSettings { payload_length: 80, ..good }, "payload_length = 80"),
            (SessionSettings { payload_length: 4000, ..good }, "payload_length = 4000"),
            (SessionSettings { peer_period_ns: 0, ..good }, "peer_period_ns = 0"),
            (SessionSettings { window_ns: u64::MAX, ..good }, "window_ns = 18446744073709551615"),
            (SessionSettings { rekey_ns: good.refuse_ns, ..good }, "rekey_ns = 180000000000"),
            (SessionSettings { overlap_ns: good.rekey_ns, ..good }, "overlap_ns = 120000000000"),
            (SessionSettings { silence_ns: 0, ..good }, "silence_ns = 0"),
            (SessionSettings { max_forged: 0, ..good }, "max_forged = 0"),
        ] {
            let error = bad.check().unwrap_err().to_string();
            assert!(error.contains(said), "{error}");
        }
    }
}
