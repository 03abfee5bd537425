//! Renewal of a device's samples: the share of the ticks that have a new one.

/// Share of the ticks with a new sample below which the device is slower than its loop.
pub const MIN_RENEWAL: f64 = 0.9;

/// Fewest ticks over which a share is measured.
const MIN_TICKS: u64 = 128;
/// Fewest new samples in these ticks.
const MIN_RENEWED: u64 = 16;

/// Two successive changes are alike if their difference, as a share of the larger one, is in this
/// range. Steps of a quantum are equal, or differ by at least half of the larger one.
const ALIKE: [f64; 2] = [0.003, 0.45];
/// Above this share of alike changes, repeats come from the device's rate, not from its resolution.
const MIN_ALIKE: f64 = 0.35;
/// Weight of the newest change in that share.
const MEMORY: f64 = 1.0 / 32.0;
/// After this many successive ticks with a new sample, the device is as fast as its loop, however
/// small its steps are.
const LONG_RUN: u32 = 16;

/// Largest number of coordinates: joints of an arm.
const MAX_COORDINATES: usize = 7;

/// Sample as its device gives it.
#[derive(Clone, Copy, Debug)]
pub struct Stamped<'a> {
    /// Position in m (rad), up to seven coordinates.
    pub position: &'a [f64],
    /// Orientation as a unit quaternion, of a device that turns.
    pub orientation: Option<&'a [f64; 4]>,
    /// Time of the sample in s on the device's own clock, if the device gives one.
    pub time_s: Option<f64>,
}

/// Ticks, and how many of them had a new sample.
#[derive(Clone, Copy, Debug, Default)]
struct Renewed {
    samples: u64,
    ticks: u64,
}

impl Renewed {
    fn add(&mut self, samples: u64, ticks: u64) {
        (self.samples, self.ticks) = (self.samples + samples, self.ticks + ticks);
    }

    /// Return the share of the ticks with a new sample; None if too few ticks count.
    fn share(&self) -> Option<f64> {
        let is_measured = self.ticks >= MIN_TICKS && self.samples >= MIN_RENEWED;
        is_measured.then(|| self.samples as f64 / self.ticks as f64)
    }
}

/// Ticks and new samples of the run, and of the present window.
#[derive(Clone, Copy, Debug, Default)]
struct Count {
    total: Renewed,
    window: Renewed,
    /// Share of the last window.
    share: Option<f64>,
}

impl Count {
    fn add(&mut self, samples: u64, ticks: u64) {
        self.total.add(samples, ticks);
        self.window.add(samples, ticks);
        if let Some(share) = self.window.share() {
            (self.share, self.window) = (Some(share), Renewed::default());
        }
    }
}

/// State of the position or of the orientation.
#[derive(Clone, Copy, Debug, Default)]
struct Motion {
    last: Option<[f64; MAX_COORDINATES]>,
    /// Ticks since the last change.
    interval: u32,
    /// True if none of these ticks was late.
    on_time: bool,
    /// Last change, and its interval in ticks.
    before: ([f64; MAX_COORDINATES], u32),
    /// Successive ticks with a new sample.
    run: u32,
    /// Share of the newest changes that were alike.
    alike: f64,
    count: Count,
    /// Number of changes after a repeat that were not counted.
    unclear: u64,
}

impl Motion {
    fn step(&mut self, now: [f64; MAX_COORDINATES], on_time: bool) {
        let Some(last) = self.last.replace(now) else { return };
        self.interval = self.interval.saturating_add(1);
        self.on_time &= on_time;
        let change = less(&now, &last);
        let size = norm(&change);
        if size == 0.0 || !size.is_finite() {
            return;
        }
        let interval = std::mem::take(&mut self.interval);
        let (before, interval_before) = std::mem::replace(&mut self.before, (change, interval));
        if !std::mem::replace(&mut self.on_time, true) {
            self.run = 0;
            return;
        }
        let difference = norm(&less(&change, &before)) / size.max(norm(&before));
        let is_alike = (ALIKE[0]..ALIKE[1]).contains(&difference) && interval.abs_diff(interval_before) <= 1;
        let is_repeated = interval > 1;
        self.run = if is_repeated { 0 } else { self.run.saturating_add(1) };
        self.alike += MEMORY * (f64::from(u8::from(is_alike)) - self.alike);
        if self.run >= LONG_RUN || is_alike && self.alike > MIN_ALIKE {
            self.count.add(1, interval.into());
        } else {
            self.unclear += u64::from(is_repeated);
        }
    }

    fn interrupt(&mut self) {
        (self.last, self.interval, self.on_time) = (None, 0, false);
    }
}

/// Measure how often a device renews its samples, tick by tick.
///
/// - A device that gives the time of its samples is measured exactly, also at rest: a sample is new if its time is.
/// - Else a sample is new if its position or its orientation differs from the last. Each change counts with the ticks
///   since the change before.
/// - A coarse encoder in slow motion also repeats its samples. It changes by one quantum at varying intervals. Two
///   such changes are equal, or they are in different joints. The changes of a slow device vary a little
///   with the motion, at even intervals. So a change counts if it is like the one before but not
///   equal to it, and if more than 35 % of the recent changes are alike in this way.
/// - From the 16th successive tick with a new sample on, any change counts: a slow device has no
///   such run.
/// - A rest does not count. Nor does a repeat that arises between two clocks of the same rate,
///   because the changes around it differ too much.
/// - Position and orientation are measured separately; the smaller share counts.
///
/// A tick that is late, or that follows a late one, does not count: the device may have renewed its sample twice.
///
/// Source: derived here.
#[derive(Clone, Copy, Debug, Default)]
pub struct Renewal {
    position: Motion,
    orientation: Motion,
    /// By the times of the samples.
    stamped: Count,
    last_time_s: Option<f64>,
    was_late: bool,
}

impl Renewal {
    /// Take the sample of a tick, or None if the tick has none; `is_late` if the tick was half a period late or more.
    pub fn step(&mut self, sample: Option<Stamped<'_>>, is_late: bool) {
        let on_time = !std::mem::replace(&mut self.was_late, is_late) && !is_late;
        let Some(Stamped { position, orientation, time_s }) = sample else {
            self.position.interrupt();
            self.orientation.interrupt();
            self.last_time_s = None;
            return;
        };
        if let Some(last) = std::mem::replace(&mut self.last_time_s, time_s)
            && let Some(time_s) = time_s
            && on_time
        {
            self.stamped.add(u64::from(time_s > last), 1);
        }
        self.position.step(filled(position), on_time);
        if let Some(orientation) = orientation {
            let now = filled(orientation);
            // The quaternions q and -q are one orientation.
            let turned = self.orientation.last.map_or(1.0, |last| {
                now.iter().zip(&last).map(|(now, last)| now * last).sum::<f64>().signum()
            });
            self.orientation.step(now.map(|part| part * turned), on_time);
        }
    }

    /// Return the share of the ticks with a new sample over the last window; None before the first.
    ///
    /// A window has 128 ticks or more that count, and 16 new samples.
    pub fn share(&self) -> Option<f64> {
        self.least(|count| count.share)
    }

    /// Return the share of the ticks with a new sample over all ticks that count; None if they are too few.
    pub fn total_share(&self) -> Option<f64> {
        self.least(|count| count.total.share())
    }

    fn least(&self, share: impl Fn(&Count) -> Option<f64>) -> Option<f64> {
        share(&self.stamped).or_else(|| {
            let both = [share(&self.position.count), share(&self.orientation.count)];
            both.into_iter().flatten().reduce(f64::min)
        })
    }

    /// Return the number of changes after a repeat that were not counted: they may be steps of one
    /// quantum.
    pub fn unclear(&self) -> u64 {
        self.position.unclear + self.orientation.unclear
    }
}

fn less(from: &[f64; MAX_COORDINATES], to: &[f64; MAX_COORDINATES]) -> [f64; MAX_COORDINATES] {
    std::array::from_fn(|index| from[index] - to[index])
}

fn norm(of: &[f64; MAX_COORDINATES]) -> f64 {
    of.iter().map(|part| part * part).sum::<f64>().sqrt()
}

fn filled(values: &[f64]) -> [f64; MAX_COORDINATES] {
    let mut all = [0.0; MAX_COORDINATES];
    all.iter_mut().zip(values).for_each(|(to, from)| *to = *from);
    all
}

#[cfg(test)]
mod tests;
