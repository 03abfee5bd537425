//! A gripper: jaws that close at a bounded speed until an object stops them.

use crate::{ModelError, require};

/// `[slave.gripper]`: the capabilities of a gripper, and the object between its jaws.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Deserialize, schemars::JsonSchema), serde(deny_unknown_fields))]
pub struct GripperSettings {
    /// Initial position, 0 open to 1 closed.
    pub position: f64,
    /// Maximum speed of the jaws in 1/s.
    pub speed: f64,
    /// Grip force on an object, in N.
    pub force_n: f64,
    /// Position at which the jaws meet an object from outside; none without an object. Simulated grippers only.
    pub object: Option<f64>,
}

impl GripperSettings {
    /// Validate and return the settings.
    pub fn checked(self) -> Result<Self, ModelError> {
        let is_share = |x: f64| (0.0..=1.0).contains(&x);
        require("gripper.position", self.position, is_share(self.position), "0 (open) to 1 (closed)")?;
        let fits = self.speed > 0.0 && self.speed <= Self::MAX_SPEED;
        require("gripper.speed", self.speed, fits, "above 0 and at most 100 1/s")?;
        let fits = (0.0..=Self::MAX_FORCE_N).contains(&self.force_n);
        require("gripper.force_n", self.force_n, fits, "0 to 10000 N")?;
        if let Some(object) = self.object {
            require("gripper.object", object, is_share(object), "0 (open) to 1 (closed)")?;
            let fits = object >= self.position;
            require(
                "gripper.object",
                object,
                fits,
                "at gripper.position or beyond: the jaws meet it from outside",
            )?;
        }
        Ok(self)
    }

    /// 1/s: no gripper closes within 10 ms.
    pub const MAX_SPEED: f64 = 100.0;
    /// In N.
    pub const MAX_FORCE_N: f64 = 10_000.0;
}

/// Target of a gripper.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GripperCommand {
    /// 0 open to 1 closed.
    pub position: f64,
    /// Maximum speed in 1/s.
    pub speed: f64,
    /// Grip force on an object, in N.
    pub force_n: f64,
}

/// Measurement of a gripper.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct GripperSample {
    /// 0 open to 1 closed.
    pub position: f64,
    /// In 1/s; positive closes.
    pub velocity: f64,
    /// Force between the jaws in N.
    pub force_n: f64,
    /// True if an object stops the jaws.
    pub holds_object: bool,
}

/// Jaws whose position moves to the command at constant speed and stops at a rigid object.
///
/// `p(t + T) = p(t) + clamp(p_cmd - p(t), -v T, v T)`, `p <= object`. While the object stops them, the force is that of
/// the command.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SimulatedGripper {
    settings: GripperSettings,
    command: Option<GripperCommand>,
    sample: GripperSample,
    now_ns: Option<u64>,
}

impl SimulatedGripper {
    /// Jaws at rest at their initial position.
    pub fn new(settings: GripperSettings) -> Result<Self, ModelError> {
        let settings = settings.checked()?;
        let sample = GripperSample { position: settings.position, ..GripperSample::default() };
        Ok(Self { settings, command: None, sample, now_ns: None })
    }

    /// Advance to `now_ns` under the last command.
    pub fn read(&mut self, now_ns: u64) -> GripperSample {
        let elapsed_s = now_ns.saturating_sub(self.now_ns.replace(now_ns).unwrap_or(now_ns)) as f64 * 1e-9;
        let before = self.sample.position;
        let Some(command) = self.command else {
            self.sample.velocity = 0.0;
            return self.sample;
        };
        let reach = command.speed.min(self.settings.speed) * elapsed_s;
        let free = before + (command.position - before).clamp(-reach, reach);
        let (position, holds_object) = match self.settings.object {
            Some(object) if command.position > object && free >= object => (object, true),
            _ => (free, false),
        };
        let velocity = if elapsed_s > 0.0 { (position - before) / elapsed_s } else { 0.0 };
        let force_n = if holds_object { command.force_n.min(self.settings.force_n) } else { 0.0 };
        self.sample = GripperSample { position, velocity, force_n, holds_object };
        self.sample
    }

    /// Set the command.
    pub fn write(&mut self, command: GripperCommand) {
        self.command = Some(command);
    }

    /// Place a rigid object at this position, 0 open to 1 closed, or remove it.
    pub fn set_object(&mut self, object: Option<f64>) {
        self.settings.object = object.filter(|position| (0.0..=1.0).contains(position));
    }

    /// Stop the jaws and keep the force on a held object.
    pub fn hold(&mut self) {
        if self.sample.holds_object {
            return;
        }
        self.command = self.command.map(|last| GripperCommand { position: self.sample.position, ..last });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;
    const CLOSE: GripperCommand = GripperCommand { position: 1.0, speed: 9.0, force_n: 60.0 };
    const SETTINGS: GripperSettings =
        GripperSettings { position: 0.0, speed: 2.0, force_n: 40.0, object: None };

    #[test]
    fn jaws_close_at_their_speed_and_stop_at_an_object() {
        for (object, end, holds) in [(None, 1.0, false), (Some(0.6), 0.6, true), (Some(1.0), 1.0, false)] {
            let mut gripper = SimulatedGripper::new(GripperSettings { object, ..SETTINGS }).unwrap();
            assert_eq!(gripper.read(0), GripperSample::default());
            gripper.write(CLOSE);
            for n in 1..=800 {
                let sample = gripper.read(n * MS);
                let expected = (2e-3 * n as f64).min(end);
                assert!((sample.position - expected).abs() < 1e-12, "{object:?} {n}: {sample:?}");
                assert_eq!(sample.holds_object, holds && expected == end, "{n}");
                assert_eq!(sample.force_n, if sample.holds_object { 40.0 } else { 0.0 });
            }
            gripper.hold();
            assert_eq!(gripper.read(900 * MS).holds_object, holds, "a hold keeps the grip");
            gripper.write(GripperCommand { position: 0.0, ..CLOSE });
            let opened = gripper.read(1000 * MS);
            assert!((opened.position - (end - 0.2)).abs() < 1e-12 && !opened.holds_object);
            gripper.hold();
            assert_eq!(gripper.read(2000 * MS).position, opened.position);
        }
    }

    #[test]
    fn numbers_that_no_gripper_has_are_refused() {
        for settings in [
            GripperSettings { position: -0.1, ..SETTINGS },
            GripperSettings { speed: 0.0, ..SETTINGS },
            GripperSettings { speed: f64::NAN, ..SETTINGS },
            GripperSettings { force_n: -1.0, ..SETTINGS },
            GripperSettings { object: Some(1.1), ..SETTINGS },
            GripperSettings { object: Some(0.2), position: 0.3, ..SETTINGS },
        ] {
            assert!(SimulatedGripper::new(settings).is_err(), "{settings:?}");
        }
    }
}
