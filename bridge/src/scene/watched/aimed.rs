//! Releases of a hand that follows aims, with the largest speed of the device after each.

use haptether_master::Aim;
use haptether_safety::Axes;

use super::{EventLog, SceneSpec};

/// Time in which the hand is open after a release.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Opening {
    /// Time in s of the release.
    from_s: f64,
    /// Time in s of the next grip.
    until_s: f64,
    /// Square of the largest speed in (m/s)².
    peak_squared: f64,
}

/// Releases by the aims of a scene; none without aims.
#[derive(Clone, Debug, Default)]
pub(super) struct AimedReleases {
    openings: Vec<Opening>,
    /// Index of the newest opening, or of the next one.
    newest: usize,
}

impl AimedReleases {
    /// Find the releases: each aim without strength after one with, and each silence in which a grip expires.
    pub(super) fn of<const N: usize>(scene: &SceneSpec<N>) -> Self {
        let aims = scene.operator.as_ref().and_then(|operator| operator.aims.as_ref());
        let rows = aims.iter().flat_map(|aims| &aims.rows);
        let mut openings: Vec<Opening> = Vec::new();
        let mut expires_s = None;
        for row in rows {
            let at_s = to_ns(row.at_s);
            let grips = row.aim.strength_n > 0.0;
            if let Some(expires_s) = expires_s.filter(|expires_s| !grips || *expires_s < at_s) {
                openings.push(Opening::at(at_s.min(expires_s)));
            }
            if grips {
                if let Some(last) = openings.last_mut() {
                    last.until_s = last.until_s.min(at_s);
                }
                expires_s = Some(to_ns(row.at_s + Aim::<N>::EXPIRES_S));
            } else {
                expires_s = None;
            }
        }
        openings.extend(expires_s.map(Opening::at));
        Self { openings, newest: 0 }
    }

    pub(super) fn is_empty(&self) -> bool {
        self.openings.is_empty()
    }

    /// Forget the releases before the engagement at `time_s`; return the time in s of the first one after it.
    pub(super) fn engage(&mut self, time_s: f64) -> Option<f64> {
        self.openings.retain(|opening| opening.from_s >= time_s);
        self.newest = 0;
        self.openings.first().map(|opening| opening.from_s)
    }

    /// Take the velocity in m/s of the device at a tick.
    #[inline(always)] // once a tick; most scenes have no aims
    pub(super) fn take<const N: usize>(&mut self, time_s: f64, velocity: &Axes<N>) {
        let Some(opening) = self.openings.get_mut(self.newest) else { return };
        if time_s > opening.until_s {
            self.newest += 1;
        } else if time_s >= opening.from_s {
            opening.peak_squared = opening.peak_squared.max(velocity.dot(velocity));
        }
    }

    /// Return the largest speed in m/s of the device while the hand is open; none without a release.
    pub(super) fn peak(&self) -> Option<f64> {
        self.openings.iter().map(|opening| opening.peak_squared.sqrt()).reduce(f64::max)
    }

    /// Add the releases after the engagement and up to `end_s`.
    pub(super) fn log(&self, end_s: f64, log: &mut EventLog) {
        for opening in self.openings.iter().filter(|opening| opening.from_s <= end_s) {
            log.add(opening.from_s, "release", format!("peak {:.3} m/s", opening.peak_squared.sqrt()));
        }
    }
}

impl Opening {
    fn at(from_s: f64) -> Self {
        Self { from_s, until_s: f64::INFINITY, peak_squared: 0.0 }
    }
}

/// Round a time in s to whole ns, like the times of the ticks.
fn to_ns(time_s: f64) -> f64 {
    (time_s * 1e9).round() / 1e9
}
