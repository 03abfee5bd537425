//! Settings of a session, with their limits.

use super::wire::{HANDSHAKE_LENGTH, sealed_length};
use crate::wire::{FrameForm, FrameLayout, MAX_FRAME, Role};

const MS: u64 = 1_000_000;
const SECOND: u64 = 1000 * MS;

/// Settings of a session. [`SessionSettings::new`] returns the defaults; only tests use others.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SessionSettings {
    /// Role of this side. The master begins every handshake; the slave grants the lease, to one
    /// master at a time.
    pub role: Role,
    /// Length in bytes of every payload, in both directions.
    pub payload_length: usize,
    /// Form of the payloads; a slave refuses a master with another form.
    pub form: FrameForm,
    /// Time in ns between two datagrams of the peer.
    pub peer_period_ns: u64,
    /// Length of the replay window in ns, at the peer's rate: a datagram that lags further behind the newest
    /// is rejected.
    pub window_ns: u64,
    /// Age in ns of a key at which the master begins the next handshake.
    pub rekey_ns: u64,
    /// Age in ns of a key from which on it seals nothing.
    pub refuse_ns: u64,
    /// Time in ns for which the previous keys still open datagrams in flight; above the delay of the link.
    pub overlap_ns: u64,
    /// Silence of the peer in ns after which the master begins a new session, and a local act at the slave
    /// may free the lease.
    pub silence_ns: u64,
    /// Largest number of datagrams that one key seals.
    pub max_sealed: u64,
    /// Number of forgeries against one session, over all its keys, at which the session ends.
    pub max_forged: u64,
}

/// Invalid settings of a session.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SettingsError {
    /// Invalid payload length.
    #[error("payload_length = {0}: must be between 1 and {MAX_FRAME}, and not as long as a handshake")]
    PayloadLength(usize),
    /// Window that is empty or too large for memory.
    #[error(
        "window_ns = {window_ns} at peer_period_ns = {peer_period_ns}: must hold 1 to {MAX_WINDOW} datagrams"
    )]
    Window {
        /// Given value.
        window_ns: u64,
        /// Given value.
        peer_period_ns: u64,
    },
    /// Times out of order.
    #[error(
        "overlap_ns = {overlap_ns}, rekey_ns = {rekey_ns}, refuse_ns = {refuse_ns}: must rise in this order"
    )]
    Order {
        /// Given value.
        overlap_ns: u64,
        /// Given value.
        rekey_ns: u64,
        /// Given value.
        refuse_ns: u64,
    },
    /// Limit or time of zero.
    #[error("{0} = 0: must be above zero")]
    Zero(&'static str),
}

/// Largest window in bits: 512 KiB.
const MAX_WINDOW: u64 = 1 << 22;
/// Smallest window in bits.
const MIN_WINDOW: u64 = 1024;

impl SessionSettings {
    /// Default settings for payloads of `payload_length` bytes and a peer that sends one per
    /// `peer_period_ns`.
    ///
    /// The replay window is 2 s. Keys are renewed after 120 s and seal nothing after 180 s, as in `WireGuard`
    /// (section 6.1). The overlap is 5 s, above any delay in teleoperation, and a peer is silent after 2 s. A
    /// key seals at most 2^32 datagrams: at 10 kHz these are 5 days, far beyond its age limit. A session ends
    /// at 2^36 forgeries.
    ///
    /// Source: Donenfeld, *`WireGuard`: Next Generation Kernel Network Tunnel*, 2017; RFC 9001, section 6.6 (the
    /// integrity limit of ChaCha20-Poly1305).
    pub const fn new(role: Role, payload_length: usize, peer_period_ns: u64) -> Self {
        Self {
            role,
            payload_length,
            #[allow(clippy::cast_possible_truncation)] // longer ones are rejected
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

    /// Age in ns of a key at which the operator is warned about a missing renewal. With the default times,
    /// the key still opens datagrams for 60 s.
    pub(super) const fn warn_ns(&self) -> u64 {
        self.rekey_ns + (self.refuse_ns - self.rekey_ns) / 12
    }

    /// Age in ns from which on keys open nothing. It exceeds the sealing limit, because the last datagrams
    /// may be in flight.
    pub(super) const fn open_ns(&self) -> u64 {
        self.refuse_ns.saturating_add(self.overlap_ns)
    }

    /// Reach of the window in counters.
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
    fn invalid_settings_are_refused_by_name() {
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
