//! What a run leaves behind: one column of numbers for each signal.

use haptether_safety::Axes;

/// One signal over time.
#[derive(Clone, Debug, PartialEq)]
pub struct Signal {
    /// Its name.
    pub name: &'static str,
    /// Values per sample: 1 for a scalar.
    pub width: usize,
    /// The samples, one after the other.
    pub values: Vec<f64>,
}

/// Signals of one loop, sampled every so many ticks.
#[derive(Clone, Debug)]
pub(crate) struct Recorder {
    every: u64,
    /// Ticks that the run has at most: room is made for them at once.
    most: u64,
    ticks: u64,
    signals: Vec<Signal>,
}

/// A sample of one signal.
pub(crate) enum Sample<'a, const N: usize> {
    Vector(&'a Axes<N>),
    Scalar(f64),
}

impl Recorder {
    /// Records every `every`-th of `most` ticks; nothing for 0.
    pub(crate) fn new(every: u64, most: u64) -> Self {
        Self { every, most, ticks: 0, signals: Vec::new() }
    }

    /// Takes a tick: the same signals in the same order each time.
    #[inline]
    pub(crate) fn take<const N: usize>(&mut self, samples: &[(&'static str, Sample<'_, N>)]) {
        if self.every == 0 {
            return;
        }
        if self.signals.is_empty() {
            let signal = |(name, sample): &(&'static str, Sample<'_, N>)| {
                let width = if matches!(sample, Sample::Vector(_)) { N } else { 1 };
                let samples = usize::try_from(self.most.div_ceil(self.every)).unwrap_or(0);
                Signal { name, width, values: Vec::with_capacity(samples * width) }
            };
            self.signals = samples.iter().map(signal).collect();
        }
        if self.ticks.is_multiple_of(self.every) {
            for (signal, (_, sample)) in self.signals.iter_mut().zip(samples) {
                match sample {
                    Sample::Vector(vector) => signal.values.extend_from_slice(vector.as_slice()),
                    Sample::Scalar(scalar) => signal.values.push(*scalar),
                }
            }
        }
        self.ticks += 1;
    }

    pub(crate) fn into_signals(self) -> Vec<Signal> {
        self.signals
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keeps_every_so_many_ticks() {
        let mut recorder = Recorder::new(3, 10);
        for tick in 0..10 {
            let x = Axes::<2>::new(f64::from(tick), -1.0);
            recorder.take(&[("t", Sample::Scalar(f64::from(tick))), ("x", Sample::Vector(&x))]);
        }
        let signals = recorder.into_signals();
        assert_eq!(signals[0].values, [0.0, 3.0, 6.0, 9.0]);
        assert_eq!((signals[1].width, signals[1].values.len()), (2, 8));
        let mut nothing = Recorder::new(0, 10);
        nothing.take::<1>(&[("t", Sample::Scalar(0.0))]);
        assert!(nothing.into_signals().is_empty());
    }
}
