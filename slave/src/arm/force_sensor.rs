//! A force sensor between the tool and the arm. Its noise is a pure function of (seed, stream, index).

use haptether_numeric::random::draw;

use crate::{Axes, ModelError, require, require_axes};

/// Base of the noise streams, one per axis; distinct from the streams of the network under the same seed.
const STREAM: u64 = 0x5E << 32;

/// 2^52; every larger number is whole.
const INTEGERS_FROM: f64 = 4_503_599_627_370_496.0;

/// Force sensor: `q round((F + bias + noise) / q)`, sampled at its own rate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ForceSensor<const N: usize> {
    noise_n: f64,
    bias_n: Axes<N>,
    quantum_n: f64,
    rate_hz: Option<f64>,
    seed: u64,
    /// Newest sample: its index and value.
    held: Option<(u64, Axes<N>)>,
}

impl<const N: usize> ForceSensor<N> {
    /// Standard deviation in N, bias in N per axis, quantum in N (0 is exact), samples per second (none samples at each
    /// tick), seed of the noise.
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

    /// Sample number `index` of a force in N; the same index has the same noise.
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
        // From 2^52 quanta on, numbers are whole already, and larger ones may overflow.
        measured.map(|f| {
            let count = f / self.quantum_n;
            if count.abs() < INTEGERS_FROM { self.quantum_n * count.round() } else { f }
        })
    }

    /// Index and time in s of the newest sample at or before `time_s`, if the sensor has its own rate.
    pub(crate) fn newest(&self, time_s: f64) -> Option<(u64, f64)> {
        let rate = self.rate_hz?;
        // A tick that coincides with a sample in decimal may precede it by rounding in binary.
        let index = (time_s * rate * (1.0 + 1e-12) + 1e-9).floor().max(0.0);
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
        // nonnegative, below 2^63 for 1e12 s
        Some((index as u64, (index / rate).min(time_s)))
    }

    /// True if it has its own sample rate.
    pub(crate) fn has_rate(&self) -> bool {
        self.rate_hz.is_some()
    }

    pub(crate) fn held(&self) -> Option<(u64, Axes<N>)> {
        self.held
    }

    /// Take sample `index` and hold it.
    pub(crate) fn take(&mut self, force: &Axes<N>, index: u64) -> Axes<N> {
        let measured = self.sample(force, index);
        self.held = Some((index, measured));
        measured
    }
}

/// One standard normal number, by the Box-Muller transform.
///
/// The uniform numbers have 53 bits, so every draw is finite and within 8.6 standard deviations.
fn normal(seed: u64, stream: u64, index: u64) -> f64 {
    let [a, b, c, d] = draw(seed, stream, index);
    let radius = (-2.0 * uniform(a, b).ln()).sqrt();
    radius * (std::f64::consts::TAU * uniform(c, d)).cos()
}

/// A uniform number in (0, 1].
fn uniform(low: u32, high: u32) -> f64 {
    let bits = (u64::from(low) | (u64::from(high) << 32)) >> 11;
    (bits + 1) as f64 * 2_f64.powi(-53)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn uniform_numbers_span_the_half_open_interval() {
        assert_eq!(uniform(0, 0), 2_f64.powi(-53));
        assert_eq!(uniform(u32::MAX, u32::MAX), 1.0);
    }
}
