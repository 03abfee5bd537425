//! Which of the sender's times is due at which of ours.

use super::delay::Wait;
use super::settings::PlayoutSettings;
use crate::clock::{WindowMinimum, difference, share_up};

/// The sender's time that is due, as `now - shift`.
///
/// The shift is the least transit in a window plus the wait that the policy asks for. A transit is the difference of
/// two unrelated clocks: only its changes mean something, and only those are used. The shift rests while what is asked
/// for stays near it, so that what is played stays exactly as far apart as it was sent; otherwise it moves slowly.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Timeline {
    settings: PlayoutSettings,
    least: WindowMinimum<()>,
    wait: Wait,
    shift_ns: Option<i64>,
    began_ns: u64,
    moved_ns: u64,
    moving: bool,
    /// Since when all packets came too late.
    late_since_ns: Option<u64>,
    /// The latest of the sender's times that was due: it never falls within one timeline.
    position_ns: Option<i64>,
}

/// How a packet lies on the timeline.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Placed {
    InTime,
    Late,
    /// It begins a new timeline.
    Anew,
}

impl Timeline {
    pub(super) fn new(settings: PlayoutSettings) -> Self {
        Self {
            settings,
            least: WindowMinimum::new(settings.window_ns),
            wait: Wait::new(),
            shift_ns: None,
            began_ns: 0,
            moved_ns: 0,
            moving: false,
            late_since_ns: None,
            position_ns: None,
        }
    }

    /// Takes a packet sent at `sent_ns` on the sender's clock.
    pub(super) fn arrived(&mut self, sent_ns: u64, now_ns: u64) -> Placed {
        if self.shift_ns.is_none() {
            self.begin(sent_ns, now_ns);
            return Placed::InTime;
        }
        let transit = difference(now_ns, sent_ns);
        let earlier = self.least.least().map_or(0, |least| least.key.saturating_sub(transit));
        if !self.is_warming(now_ns) && earlier > self.settings.relearn_ns.cast_signed() {
            self.begin(sent_ns, now_ns);
            return Placed::Anew;
        }
        self.learn(sent_ns, now_ns, transit);
        if self.position_ns.is_none_or(|position| sent_ns.cast_signed() > position) {
            self.late_since_ns = None;
            return Placed::InTime;
        }
        let since = *self.late_since_ns.get_or_insert(now_ns);
        if now_ns.saturating_sub(since) >= self.settings.relearn_ns {
            self.begin(sent_ns, now_ns);
            return Placed::Anew;
        }
        Placed::Late
    }

    fn begin(&mut self, sent_ns: u64, now_ns: u64) {
        *self = Self::new(self.settings);
        self.began_ns = now_ns;
        self.moved_ns = now_ns;
        self.learn(sent_ns, now_ns, difference(now_ns, sent_ns));
    }

    fn learn(&mut self, sent_ns: u64, now_ns: u64, transit: i64) {
        self.least.add(now_ns, transit, ());
        self.wait.arrived(sent_ns, now_ns, transit);
        if self.shift_ns.is_none() || self.is_warming(now_ns) {
            self.shift_ns = self.target_ns();
        }
    }

    fn is_warming(&self, now_ns: u64) -> bool {
        now_ns.saturating_sub(self.began_ns) < self.settings.warm_up_ns
    }

    fn target_ns(&self) -> Option<i64> {
        let least = self.least.least()?.key;
        Some(least.saturating_add(self.wait.wait_ns(self.settings.policy, least)))
    }

    /// Moves on to `now_ns`; the sender's time that is due then, and the shift.
    pub(super) fn advance(&mut self, now_ns: u64) -> Option<(i64, i64)> {
        let (mut shift, target) = (self.shift_ns?, self.target_ns()?);
        let elapsed = now_ns.saturating_sub(self.moved_ns);
        self.moved_ns = self.moved_ns.max(now_ns);
        let away = target.saturating_sub(shift);
        self.moving = away != 0 && (self.moving || away.unsigned_abs() > self.settings.tolerance_ns);
        if self.moving {
            // Rounded up, so that ticks of any length move; one ns at most is not backwards in a tick of more.
            let most = share_up(elapsed, self.settings.slew_ppb).min(elapsed).cast_signed();
            shift += away.clamp(-most, most);
            self.shift_ns = Some(shift);
        }
        let due = now_ns.cast_signed().saturating_sub(shift);
        let position = self.position_ns.map_or(due, |before| before.max(due));
        self.position_ns = Some(position);
        Some((position, shift))
    }

    /// The wait in ns of a packet of least transit, as it is now.
    pub(super) fn wait_ns(&self) -> Option<u64> {
        let wait = self.shift_ns?.saturating_sub(self.least.least()?.key);
        Some(u64::try_from(wait).unwrap_or(0))
    }
}
