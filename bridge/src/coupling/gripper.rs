//! Coupling of the gripper, which follows the master's trigger.

use haptether_slave::{GripperCommand, GripperSample, GripperSettings};

/// State of a gripper, or of the trigger that leads one, in a frame.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct GripperState {
    /// Position, 0 open to 1 closed; none if unknown, as for a device without a trigger.
    pub position: Option<f64>,
    /// Velocity in 1/s; positive closes.
    pub velocity: f64,
    /// Force between the jaws in N.
    pub force_n: f64,
    /// True if an object stops the jaws.
    pub holds_object: bool,
    /// True if the gripper follows the trigger; only in the slave's frames.
    pub follows: bool,
}

impl GripperState {
    /// Build the state of a trigger from its reading.
    pub fn of_trigger(position: Option<f64>) -> Self {
        Self { position: position.filter(|x| (0.0..=1.0).contains(x)), ..Self::default() }
    }

    /// Build the state of a gripper; `follows` is true if it follows the trigger. An invalid number makes the
    /// whole state unknown.
    pub fn of_gripper(sample: &GripperSample, follows: bool) -> Self {
        let GripperSample { position, velocity, force_n, holds_object } = *sample;
        let state = Self { position: Some(position), velocity, force_n, holds_object, follows };
        if state.is_possible() { state } else { Self::default() }
    }

    /// Return whether the state is valid; an unknown position requires all other fields to be zero.
    pub fn is_possible(&self) -> bool {
        let Self { position, velocity, force_n, holds_object, follows } = *self;
        match position {
            Some(position) => {
                (0.0..=1.0).contains(&position)
                    && velocity.abs() <= GripperSettings::MAX_SPEED
                    && (0.0..=GripperSettings::MAX_FORCE_N).contains(&force_n)
            }
            None => velocity == 0.0 && force_n == 0.0 && !holds_object && !follows,
        }
    }
}

/// Distance between trigger and last command, as a fraction of the travel, within which the gripper starts to
/// follow.
const PICKS_UP_WITHIN: f64 = 0.02;

/// Gripper's half of its coupling: `p_cmd = p_trigger`, limited to the gripper's speed.
///
/// When the two sides engage, the trigger may be anywhere, and a gripper that jumped to it would drop its
/// object. So the gripper stays until the trigger reaches or passes the last command.
///
/// While the sides are not coupled there is no command, and the gripper keeps its grip.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GripperFollower {
    speed: f64,
    force_n: f64,
    /// Last command; before the first command the measured position.
    position: Option<f64>,
    /// Trigger at the last coupled tick.
    trigger: Option<f64>,
    follows: bool,
}

impl GripperFollower {
    /// Build the follower of a gripper with `settings`.
    pub fn new(settings: &GripperSettings) -> Self {
        Self {
            speed: settings.speed,
            force_n: settings.force_n,
            position: None,
            trigger: None,
            follows: false,
        }
    }

    /// Return the command of a tick `elapsed_s` after the last one; `None` if the gripper is to stay.
    /// `trigger` is the value in the master's newest frame while the two sides are coupled, else `None`.
    pub fn step(
        &mut self,
        trigger: Option<f64>,
        measured: &GripperSample,
        elapsed_s: f64,
    ) -> Option<GripperCommand> {
        let before = std::mem::replace(&mut self.trigger, trigger);
        let Some(trigger) = trigger else {
            self.follows = false;
            return None;
        };
        if self.position.is_none() && !(0.0..=1.0).contains(&measured.position) {
            return None;
        }
        let position = *self.position.get_or_insert(measured.position);
        if !self.follows {
            let has_passed = before.is_some_and(|before| (before - position) * (trigger - position) < 0.0);
            // A command slightly more open than the stopped jaws would drop the object.
            let opens = measured.holds_object && trigger < measured.position;
            self.follows = has_passed || ((trigger - position).abs() <= PICKS_UP_WITHIN && !opens);
            if !self.follows {
                return None;
            }
        }
        let reach = self.speed * elapsed_s;
        let position = position + (trigger - position).clamp(-reach, reach);
        self.position = Some(position);
        Some(GripperCommand { position, speed: self.speed, force_n: self.force_n })
    }

    /// Return whether the trigger leads the gripper: the two sides are coupled, and the trigger has picked it
    /// up.
    pub fn follows(&self) -> bool {
        self.follows
    }

    /// Last command, 0 open to 1 closed; none before the first.
    pub fn position(&self) -> Option<f64> {
        self.position
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const SETTINGS: GripperSettings =
        GripperSettings { position: 0.0, speed: 2.0, force_n: 40.0, object: None };
    const AT_REST: GripperSample =
        GripperSample { position: 0.0, velocity: 0.0, force_n: 0.0, holds_object: false };

    fn position(command: Option<GripperCommand>) -> f64 {
        command.map_or(f64::NAN, |command| command.position)
    }

    #[test]
    fn it_follows_no_faster_than_the_gripper_moves() {
        let mut follower = GripperFollower::new(&SETTINGS);
        assert_eq!(position(follower.step(Some(0.0), &AT_REST, 1e-3)), 0.0);
        for n in 1..=500 {
            let expected = (2e-3 * f64::from(n)).min(0.8);
            let command = position(follower.step(Some(0.8), &AT_REST, 1e-3));
            assert!((command - expected).abs() < 1e-12, "{n}: {command}");
        }
    }

    /// A hand that releases the trigger while the sides are apart, then engages again, drops nothing.
    #[test]
    fn grip_is_kept_until_the_trigger_reaches_it() {
        for (first, then, follows) in
            [(0.0, 0.5, false), (0.0, 0.97, false), (0.0, 0.99, true), (1.0, 0.0, true), (0.985, 0.4, true)]
        {
            let mut follower = GripperFollower::new(&SETTINGS);
            let held = GripperSample { position: 1.0, ..AT_REST };
            assert_eq!(position(follower.step(Some(1.0), &held, 1e-3)), 1.0);
            assert_eq!(follower.step(None, &held, 1e-3), None, "not coupled");
            let _ = follower.step(Some(first), &held, 1e-3);
            assert_eq!(follower.step(Some(then), &held, 1e-3).is_some(), follows, "{first} {then}");
        }
    }

    /// After a restart the last command is unknown: the jaws are stopped by their object.
    #[test]
    fn unknown_grip_is_picked_up_only_by_closing() {
        let held = GripperSample { position: 0.6, holds_object: true, ..AT_REST };
        for (trigger, follows) in [(0.585, false), (0.599, false), (0.6, true), (0.615, true)] {
            let mut follower = GripperFollower::new(&SETTINGS);
            assert_eq!(follower.step(Some(trigger), &held, 1e-3).is_some(), follows, "{trigger}");
        }
        let mut follower = GripperFollower::new(&SETTINGS);
        assert_eq!(follower.step(Some(0.5), &held, 1e-3), None);
        assert!(
            position(follower.step(Some(0.7), &held, 1e-3)) > 0.6,
            "a closing trigger picks up the gripper"
        );
    }

    #[test]
    fn trigger_picks_up_the_command_when_it_passes_between_frames() {
        let mut follower = GripperFollower::new(&SETTINGS);
        let half = GripperSample { position: 0.5, ..AT_REST };
        assert_eq!(follower.step(Some(0.2), &half, 1e-3), None);
        assert!((position(follower.step(Some(0.9), &half, 1e-3)) - 0.502).abs() < 1e-12);
    }

    proptest! {
        /// The command never jumps, for any trigger and any loss of the link.
        #[test]
        fn the_command_never_jumps(
            triggers in prop::collection::vec(prop::option::of(0.0..=1.0f64), 1..200),
            start in 0.0..=1.0f64,
        ) {
            let mut follower = GripperFollower::new(&SETTINGS);
            let measured = GripperSample { position: start, ..AT_REST };
            let mut last = start;
            for trigger in triggers {
                if let Some(command) = follower.step(trigger, &measured, 1e-3) {
                    prop_assert!((command.position - last).abs() <= 2e-3 + 1e-15);
                    prop_assert!(trigger.is_some());
                    last = command.position;
                }
            }
        }
    }
}
