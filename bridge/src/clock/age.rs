//! How old the newest packet of the peer is, by our clock alone.

use super::window::WindowMinimum;
use super::{ClockFault, share_up};

/// What the age of packets is measured against.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct AgeSettings {
    /// How many of our newest sending times are kept; an echo of an older one says nothing.
    pub sent_kept: usize,
    /// Window in ns of the expected age.
    pub window_ns: u64,
    /// The expected age is this share, in percent, of the packets' ages in order: 50 is the median.
    pub quantile_percent: u8,
    /// Most that is ever expected, in ns: a delay that grows slowly must not become normal without limit.
    pub most_expected_ns: u64,
    /// Greatest drift in parts per billion of the peer's clock, with which it measures how long it held a packet.
    pub max_drift_ppb: u64,
}

impl Default for AgeSettings {
    /// Four seconds of packets at 1 kHz, the median of 10 s, 2 s at most.
    fn default() -> Self {
        Self {
            sent_kept: 4096,
            window_ns: 10_000_000_000,
            quantile_percent: 50,
            most_expected_ns: 2_000_000_000,
            max_drift_ppb: 200_000,
        }
    }
}

/// Between what the age of a packet lies, in ns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Age {
    /// Time since it arrived.
    pub at_least_ns: u64,
    /// Time since we sent the newest of our packets that the peer had when it sent this one: our way, what the peer
    /// waited, and its way. None until the peer has echoed anything that we still know.
    pub at_most_ns: Option<u64>,
    /// The same less how long the peer says that it held our packet: closer, but as good as the peer's clock. A peer
    /// whose clock jumps ahead meanwhile makes it too little.
    pub at_most_by_peer_ns: Option<u64>,
}

/// Ages kept for the expected one.
const KEPT: usize = 256;

/// Keeps our sending times and the age of the newest packet received.
///
/// A packet that echoes our counter `c` left the peer after that arrived there, so not before the time `T_c` of our
/// clock at which `c` left here. So at `now` it is at most `now - T_c` old: whatever the ways take, and whatever the
/// peer's clock shows. With the time `h` for which the peer says that it held `c`, less what its rate may be wrong, it
/// is at most `now - T_c - h` old. A packet never is older than one that the peer sent before it, so neither bound falls
/// back when an echo is missing.
#[derive(Clone, Debug)]
pub struct PacketAge {
    settings: AgeSettings,
    /// Counter and time, at the place of the counter modulo the length.
    sent: Box<[Option<(u64, u64)>]>,
    arrived_ns: Option<u64>,
    /// The newest packet left the peer no earlier.
    sent_after_ns: Option<u64>,
    /// Nor, if the peer's clock is right, earlier than this.
    sent_after_by_peer_ns: Option<u64>,
    least: WindowMinimum<()>,
    /// Ages on arrival, one in each 256th of the window, in a ring.
    ages: Box<[u64; KEPT]>,
    scratch: Box<[u64; KEPT]>,
    age_count: u64,
    last_kept_ns: u64,
    expected_ns: Option<u64>,
}

impl PacketAge {
    /// Knows nothing yet.
    pub fn new(settings: AgeSettings) -> Self {
        Self {
            settings,
            sent: vec![None; settings.sent_kept.max(1)].into_boxed_slice(),
            arrived_ns: None,
            sent_after_ns: None,
            sent_after_by_peer_ns: None,
            least: WindowMinimum::new(settings.window_ns),
            ages: Box::new([0; KEPT]),
            scratch: Box::new([0; KEPT]),
            age_count: 0,
            last_kept_ns: 0,
            expected_ns: None,
        }
    }

    /// Notes that the packet `counter` left at `now_ns`.
    pub fn sent(&mut self, counter: u64, now_ns: u64) {
        let slot = self.slot(counter);
        self.sent[slot] = Some((counter, now_ns));
    }

    /// Notes that a packet newer than all before arrived at `now_ns`, with the counter it echoes and how long the
    /// peer had held that.
    ///
    /// The packet counts, and so does the counter, even if the time held is impossible.
    pub fn received(&mut self, now_ns: u64, echo: Option<(u64, u64)>) -> Result<(), ClockFault> {
        self.arrived_ns = Some(now_ns);
        let Some((sent_ns, held_ns)) = echo.and_then(|(counter, held)| Some((self.sent_at(counter)?, held)))
        else {
            return Ok(());
        };
        let after_ns = self.sent_after_ns.unwrap_or(0).max(sent_ns);
        self.sent_after_ns = Some(after_ns);
        self.expect(now_ns, now_ns.saturating_sub(after_ns));
        let took_ns = now_ns.saturating_sub(sent_ns);
        // Both readings of the time held are whole ns: 1 ns of it may be rounding.
        let unsure_ns = share_up(held_ns, self.settings.max_drift_ppb).saturating_add(1);
        let surely_held_ns = held_ns.saturating_sub(unsure_ns);
        let is_possible = surely_held_ns <= took_ns;
        let by_peer_ns =
            if is_possible { sent_ns.saturating_add(surely_held_ns).max(after_ns) } else { after_ns };
        self.sent_after_by_peer_ns = Some(self.sent_after_by_peer_ns.unwrap_or(0).max(by_peer_ns));
        if is_possible { Ok(()) } else { Err(ClockFault::NegativeRoundTrip { by_ns: held_ns - took_ns }) }
    }

    /// When a packet left; none of one that is not kept any more.
    pub fn sent_at(&self, counter: u64) -> Option<u64> {
        self.sent[self.slot(counter)].and_then(|(kept, sent_ns)| (kept == counter).then_some(sent_ns))
    }

    fn slot(&self, counter: u64) -> usize {
        usize::try_from(counter % self.sent.len() as u64).unwrap_or(0)
    }

    /// Takes the age of a packet on its arrival into what is expected.
    fn expect(&mut self, now_ns: u64, age_ns: u64) {
        self.least.add(now_ns, i64::try_from(age_ns).unwrap_or(i64::MAX), ());
        let due = self.last_kept_ns.saturating_add(self.settings.window_ns / KEPT as u64);
        if self.age_count > 0 && now_ns < due {
            return;
        }
        self.last_kept_ns = now_ns;
        let place = usize::try_from(self.age_count % KEPT as u64).unwrap_or(0);
        self.ages[place] = age_ns;
        self.age_count += 1;
        let filled = usize::try_from(self.age_count).map_or(KEPT, |count| count.min(KEPT));
        *self.scratch = *self.ages;
        let rank = (filled - 1) * usize::from(self.settings.quantile_percent.min(100)) / 100;
        let (_, &mut quantile, _) = self.scratch[..filled].select_nth_unstable(rank);
        self.expected_ns = Some(quantile.min(self.settings.most_expected_ns));
    }

    /// The age at `now_ns` of the newest packet; none before the first.
    pub fn age(&self, now_ns: u64) -> Option<Age> {
        let at_least_ns = now_ns.saturating_sub(self.arrived_ns?);
        let since = |after_ns: u64| now_ns.saturating_sub(after_ns);
        Some(Age {
            at_least_ns,
            at_most_ns: self.sent_after_ns.map(since),
            at_most_by_peer_ns: self.sent_after_by_peer_ns.map(since),
        })
    }

    /// The bound of the age that packets of this link have when they arrive, as the quantile of the window.
    pub fn expected_ns(&self) -> Option<u64> {
        self.expected_ns
    }

    /// The least bound of the age that a packet had on arrival in the window.
    pub fn least_ns(&self) -> Option<u64> {
        self.least.least().map(|least| least.key.unsigned_abs())
    }

    /// By how much the newest packet may be older at `now_ns` than is expected of this link; none until both are known.
    pub fn over_expected_ns(&self, now_ns: u64) -> Option<u64> {
        Some(self.age(now_ns)?.at_most_ns?.saturating_sub(self.expected_ns?))
    }

    /// Forgets the peer's packets, not what we sent: for a new session of the peer.
    pub fn restart(&mut self) {
        self.arrived_ns = None;
        self.sent_after_ns = None;
        self.sent_after_by_peer_ns = None;
        self.least.clear();
        self.age_count = 0;
        self.last_kept_ns = 0;
        self.expected_ns = None;
    }
}
