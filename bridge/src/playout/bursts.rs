//! Losses and how many of them stand together.

/// Sequences behind the newest that may still arrive late: two seconds at 1 kHz.
const PLACES: usize = 2048;
const WINDOW: u64 = PLACES as u64;

/// Runs of sequences that never arrived.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct Bursts {
    /// Sequences missing.
    pub lost: u64,
    /// Runs that they stand in.
    pub bursts: u64,
    /// The longest run.
    pub longest: u64,
    /// The run that is not ended yet.
    run: u64,
}

impl Bursts {
    /// Mean length of a run; 0 without any.
    pub fn mean(&self) -> f64 {
        if self.bursts == 0 { 0.0 } else { self.lost as f64 / self.bursts as f64 }
    }

    /// Takes the next `count` sequences, all missing.
    fn miss(&mut self, count: u64) {
        if count > 0 {
            self.bursts += u64::from(self.run == 0);
            self.lost += count;
            self.run += count;
            self.longest = self.longest.max(self.run);
        }
    }

    fn take(&mut self, there: bool) {
        if there {
            self.run = 0;
        } else {
            self.miss(1);
        }
    }
}

/// What a sequence is, seen against those before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Seen {
    /// Greater than all before.
    Newest,
    /// Missing until now.
    Behind,
    /// There before.
    Duplicate,
    /// Too far behind to tell.
    TooFar,
}

/// Which of the last [`WINDOW`] sequences arrived; what leaves the window unseen is lost for good.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Sequences {
    there: [bool; PLACES],
    first: Option<u64>,
    newest: u64,
    settled: Bursts,
}

impl Sequences {
    pub(super) fn new() -> Self {
        Self { there: [false; PLACES], first: None, newest: 0, settled: Bursts::default() }
    }

    /// Counting starts with the first sequence to arrive: those before it were never expected.
    pub(super) fn mark(&mut self, sequence: u64) -> Seen {
        // No link counts so far; what lies beyond it has no number.
        if sequence == u64::MAX {
            return Seen::TooFar;
        }
        let Some(first) = self.first else {
            self.first = Some(sequence);
            self.newest = sequence;
            self.there[slot(sequence)] = true;
            return Seen::Newest;
        };
        if sequence > self.newest {
            self.advance(first, sequence);
            return Seen::Newest;
        }
        if sequence < first || self.newest - sequence >= WINDOW {
            return Seen::TooFar;
        }
        if std::mem::replace(&mut self.there[slot(sequence)], true) { Seen::Duplicate } else { Seen::Behind }
    }

    fn advance(&mut self, first: u64, sequence: u64) {
        // Each new place is that of the sequence which leaves the window.
        for passed in (self.newest + 1..=sequence).take(self.there.len()) {
            if passed.checked_sub(WINDOW).is_some_and(|left| left >= first) {
                self.settled.take(self.there[slot(passed)]);
            }
            self.there[slot(passed)] = false;
        }
        // Beyond that, places were passed twice: neither arrived nor in the window.
        let skipped = sequence - self.newest;
        self.settled.miss(skipped.saturating_sub(WINDOW));
        self.there[slot(sequence)] = true;
        self.newest = sequence;
    }

    /// Losses up to the newest, those included that may still arrive.
    pub(super) fn bursts(&self) -> Bursts {
        let mut bursts = self.settled;
        if let Some(first) = self.first {
            let begin = first.max((self.newest + 1).saturating_sub(WINDOW));
            for sequence in begin..=self.newest {
                bursts.take(self.there[slot(sequence)]);
            }
        }
        bursts
    }

    /// How many sequences lie between the first and the newest, both included.
    pub(super) fn span(&self) -> u64 {
        self.first.map_or(0, |first| self.newest - first + 1)
    }
}

fn slot(sequence: u64) -> usize {
    usize::try_from(sequence % WINDOW).unwrap_or(0)
}
