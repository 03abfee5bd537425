//! Where an arm may count its reach from: its start, and where it was after a fault that was acknowledged.

/// Accepted samples in a row that confirm the newest.
const CONFIRMING: u32 = 4;

/// Confirmed samples of an arm: the first of all, and the first after each end of a fault.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Homes<T> {
    of: [Option<T>; 16],
    count: usize,
    accepted: u32,
    is_sought: bool,
    had_fault: bool,
}

impl<T: Copy> Homes<T> {
    pub(crate) fn new() -> Self {
        Self { of: [None; 16], count: 0, accepted: 0, is_sought: true, had_fault: false }
    }

    /// Take a sample of a tick: it is accepted unless it is faulty or held.
    pub(crate) fn see(&mut self, sample: T, is_accepted: bool, has_fault: bool) {
        self.is_sought |= std::mem::replace(&mut self.had_fault, has_fault) && !has_fault;
        self.accepted = if is_accepted { self.accepted + 1 } else { 0 };
        if self.is_sought && self.accepted >= CONFIRMING {
            self.is_sought = false;
            self.of[self.count % 16] = Some(sample);
            self.count += 1;
        }
    }

    /// Return the least distance from one of them; 0 before the first.
    pub(crate) fn out(&self, distance: impl Fn(&T) -> f64) -> f64 {
        let least = self.of.iter().flatten().map(distance).fold(f64::INFINITY, f64::min);
        if self.count == 0 { 0.0 } else { least }
    }
}
