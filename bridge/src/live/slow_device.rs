//! Warning of a device that renews its samples more slowly than its loop ticks.

use haptether_safety::MIN_RENEWAL;

use crate::wire::Role;

/// Share of the reported renewal below which a device is reported again.
const WORSE: f64 = 0.8;

/// Report to the operator on a device that is slower than its loop.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SlowDevice {
    /// Side of the device.
    pub role: Role,
    /// Period of the loop in ns.
    pub period_ns: u64,
    /// Share of the ticks with a new sample.
    pub share: f64,
}

impl std::fmt::Display for SlowDevice {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { role, period_ns, share } = *self;
        let period_s = period_ns as f64 * 1e-9;
        let each_s = period_s / share;
        let (device, key, harm) = match role {
            Role::Master => {
                ("the device", "[run]", "V and A are wrong, and controllers trip without a cause")
            }
            Role::Slave => ("the arm", "[slave]", "its motion is read late and in steps"),
        };
        let [each_ms, period_ms] = [each_s, period_s].map(|period_s| two_digits(1e3 * period_s));
        write!(
            formatter,
            "slow: {device} has a new sample at {:.0} % of the ticks, one each {each_ms} ms: must be one each tick of \
             {period_ms} ms; {harm}; set {key} period_s to {}, raise the rate of the driver, or have its read() wait for \
             each sample",
            100.0 * share,
            two_digits(each_s),
        )
    }
}

/// Round to two significant digits.
fn two_digits(value: f64) -> f64 {
    format!("{value:.1e}").parse().unwrap_or(value)
}

/// Decides when a slow device is reported: once, and again if it gets clearly slower.
#[derive(Clone, Copy, Debug)]
pub(super) struct SlowWatch {
    below: f64,
}

impl Default for SlowWatch {
    fn default() -> Self {
        Self { below: MIN_RENEWAL }
    }
}

impl SlowWatch {
    /// Take the share of a tick; return it if it is to be reported.
    pub(super) fn poll(&mut self, share: Option<f64>) -> Option<f64> {
        let share = share.filter(|share| *share < self.below)?;
        self.below = WORSE * share;
        Some(share)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slow_device_is_reported_once_and_again_if_it_gets_slower() {
        let mut watch = SlowWatch::default();
        for (share, expected) in [
            (None, false),
            (Some(1.0), false),
            (Some(0.9), false),
            (Some(0.5), true),
            (Some(0.5), false),
            (Some(0.45), false),
            (Some(1.0), false),
            (Some(0.25), true),
            (None, false),
            (Some(0.25), false),
        ] {
            assert_eq!(watch.poll(share), share.filter(|_| expected), "{share:?}");
        }
    }

    #[test]
    fn the_text_has_the_measured_number_and_the_remedy() {
        for (role, period_ns, share, expected) in [
            (Role::Master, 1_000_000, 0.5, ["50 %", "each 2 ms", "of 1 ms", "[run] period_s to 0.002,"]),
            (Role::Master, 1_000_000, 0.799, ["80 %", "each 1.3 ms", "of 1 ms", "[run] period_s to 0.0013,"]),
            (Role::Slave, 2_000_000, 0.25, ["25 %", "each 8 ms", "of 2 ms", "[slave] period_s to 0.008,"]),
        ] {
            let text = SlowDevice { role, period_ns, share }.to_string();
            assert!(expected.iter().all(|part| text.contains(part)), "{text}");
        }
    }
}
