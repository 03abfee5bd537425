//! A force sensor between the tool and the arm. Its noise is a pure function of (seed, stream, index).
//!
//! Source: J. K. Salmon, M. A. Moraes, R. O. Dror, D. E. Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC 2011,
//! Philox4x32-10.

use crate::{Axes, ModelError, require, require_axes};

/// Base of the noise streams, one per axis; distinct from the streams of the network under the same seed.
const STREAM: u64 = 0x5E << 32;

/// 2^52; every larger number is whole.
const WHOLE: f64 = 4_503_599_627_370_496.0;

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
            if count.abs() < WHOLE { self.quantum_n * count.round() } else { f }
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

/// Multipliers and Weyl key increments of Philox4x32 (Salmon et al. 2011).
const MULTIPLIER: [u32; 2] = [0xD251_1F53, 0xCD9E_8D57];
const WEYL: [u32; 2] = [0x9E37_79B9, 0xBB67_AE85];
const ROUNDS: usize = 10;

/// One standard normal number, by the Box-Muller transform.
///
/// The uniform numbers have 53 bits, so every draw is finite and within 8.6 standard deviations.
fn normal(seed: u64, stream: u64, index: u64) -> f64 {
    let ([k0, k1], [i0, i1], [s0, s1]) = (split(seed), split(index), split(stream));
    let [a, b, c, d] = philox4x32([i0, i1, s0, s1], [k0, k1]);
    let radius = (-2.0 * uniform(a, b).ln()).sqrt();
    radius * (std::f64::consts::TAU * uniform(c, d)).cos()
}

/// A uniform number in (0, 1].
fn uniform(low: u32, high: u32) -> f64 {
    let bits = (u64::from(low) | (u64::from(high) << 32)) >> 11;
    (bits + 1) as f64 * 2_f64.powi(-53)
}

fn philox4x32(counter: [u32; 4], key: [u32; 2]) -> [u32; 4] {
    let [mut c0, mut c1, mut c2, mut c3] = counter;
    let [mut k0, mut k1] = key;
    for _ in 0..ROUNDS {
        let [low0, high0] = split(u64::from(MULTIPLIER[0]) * u64::from(c0));
        let [low1, high1] = split(u64::from(MULTIPLIER[1]) * u64::from(c2));
        [c0, c1, c2, c3] = [high1 ^ c1 ^ k0, low1, high0 ^ c3 ^ k1, low0];
        k0 = k0.wrapping_add(WEYL[0]);
        k1 = k1.wrapping_add(WEYL[1]);
    }
    [c0, c1, c2, c3]
}

/// Low word, high word.
#[expect(clippy::cast_possible_truncation, reason = "takes the word apart")]
fn split(word: u64) -> [u32; 2] {
    [word as u32, (word >> 32) as u32]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Source: Random123, `tests/kat_vectors`, lines `philox4x32 10`.
    #[test]
    fn matches_the_known_answers() {
        let cases: [([u32; 4], [u32; 2], [u32; 4]); 3] = [
            ([0; 4], [0; 2], [0x6627_e8d5, 0xe169_c58d, 0xbc57_ac4c, 0x9b00_dbd8]),
            ([u32::MAX; 4], [u32::MAX; 2], [0x408f_276d, 0x41c8_3b0e, 0xa20b_c7c6, 0x6d54_51fd]),
            (
                [0x243f_6a88, 0x85a3_08d3, 0x1319_8a2e, 0x0370_7344],
                [0xa409_3822, 0x299f_31d0],
                [0xd16c_fe09, 0x94fd_cceb, 0x5001_e420, 0x2412_6ea1],
            ),
        ];
        for (counter, key, answer) in cases {
            assert_eq!(philox4x32(counter, key), answer);
        }
    }

    #[test]
    fn uniform_numbers_span_the_half_open_interval() {
        assert_eq!(uniform(0, 0), 2_f64.powi(-53));
        assert_eq!(uniform(u32::MAX, u32::MAX), 1.0);
    }
}
