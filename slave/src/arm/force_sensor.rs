//! A force sensor between the tool and the arm.

use crate::{Axes, ModelError, arm::random::normal, axes::require_axes, require};

/// Streams of the noise, one per axis: apart from those that the same seed has in the network.
const STREAM: u64 = 0x5E << 32;

/// 2^52, from which on every number is whole.
const WHOLE: f64 = 4_503_599_627_370_496.0;

/// What a force sensor makes of a force: `q round((F + bias + noise) / q)`, at its own rate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ForceSensor<const N: usize> {
    noise_n: f64,
    bias_n: Axes<N>,
    quantum_n: f64,
    rate_hz: Option<f64>,
    seed: u64,
    /// The newest sample: its number and what it said.
    held: Option<(u64, Axes<N>)>,
}

impl<const N: usize> ForceSensor<N> {
    /// Standard deviation in N, bias in N per axis, quantum in N (0 is exact), samples per second (none for one at
    /// each tick), seed of the noise.
    pub fn new(
        noise_n: f64,
        bias_n: Axes<N>,
        quantum_n: f64,
        rate_hz: Option<f64>,
        seed: u64,
    ) -> Result<Self, ModelError> {
        require("sensor noise", noise_n, noise_n >= 0.0, "finite and 0 or more")?;
        require_axes("sensor bias", &bias_n, |_| true, "finite")?;
        require("sensor quantum", quantum_n, quantum_n >= 0.0, "finite and 0 or more")?;
        if let Some(rate) = rate_hz {
            require("sensor rate", rate, (1e-3..=1e6).contains(&rate), "between 1e-3 and 1e6")?;
        }
        Ok(Self { noise_n, bias_n, quantum_n, rate_hz, seed, held: None })
    }

    /// Sample number `index` of a force in N: the same index gives the same noise.
    pub fn sample(&self, force: &Axes<N>, index: u64) -> Axes<N> {
        let mut measured = force + self.bias_n;
        if self.noise_n > 0.0 {
            for axis in 0..N {
                measured[axis] += self.noise_n * normal(self.seed, STREAM | axis as u64, index);
            }
        }
        if self.quantum_n == 0.0 {
            return measured;
        }
        // Numbers of 2^52 quanta are whole as they are, and more are infinite.
        measured.map(|f| {
            let count = f / self.quantum_n;
            if count.abs() < WHOLE { self.quantum_n * count.round() } else { f }
        })
    }

    /// Number and time in s of the newest sample at or before `time_s`, if the sensor has a rate of its own.
    pub(crate) fn newest(&self, time_s: f64) -> Option<(u64, f64)> {
        let rate = self.rate_hz?;
        // A tick that falls on a sample in decimal may fall a rounding before it in binary.
        let index = (time_s * rate * (1.0 + 1e-12) + 1e-9).floor().max(0.0);
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
        // not negative, below 2^63 for 1e12 s
        Some((index as u64, (index / rate).min(time_s)))
    }

    /// Whether it samples by itself, not at each tick.
    pub(crate) fn has_rate(&self) -> bool {
        self.rate_hz.is_some()
    }

    pub(crate) fn held(&self) -> Option<(u64, Axes<N>)> {
        self.held
    }

    /// Takes sample `index` and holds it.
    pub(crate) fn take(&mut self, force: &Axes<N>, index: u64) -> Axes<N> {
        let measured = self.sample(force, index);
        self.held = Some((index, measured));
        measured
    }
}
