//! The gripper follows the trigger of the master.

use haptether_slave::{GripperCommand, GripperSample, GripperSettings};

/// What a frame says of a gripper or of the trigger that leads one.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct GripperState {
    /// 0 open to 1 closed; none where it is not known, as of a device without a trigger.
    pub position: Option<f64>,
    /// In 1/s; positive closes.
    pub velocity: f64,
    /// Between the jaws in N.
    pub force_n: f64,
    /// Whether something stops the jaws.
    pub holds_object: bool,
    /// Whether the gripper follows the trigger: of the slave's only.
    pub follows: bool,
}

impl GripperState {
    /// Of a trigger, as it is read.
    pub fn of_trigger(position: Option<f64>) -> Self {
        Self { position: position.filter(|x| (0.0..=1.0).contains(x)), ..Self::default() }
    }

    /// Of a gripper that follows the trigger, or does not; a number that none can have makes all of it unknown.
    pub fn of_gripper(sample: &GripperSample, follows: bool) -> Self {
        let GripperSample { position, velocity, force_n, holds_object } = *sample;
        let state = Self { position: Some(position), velocity, force_n, holds_object, follows };
        if state.is_possible() { state } else { Self::default() }
    }

    /// Whether a gripper can be so; what is not known has no other numbers.
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

/// How near the trigger must be to the last command to take the gripper along, as a share of the whole way.
const PICKS_UP_WITHIN: f64 = 0.02;

/// The gripper's half of its coupling: `p_cmd = p_trigger`, at most as fast as the gripper.
///
/// When the two sides engage the trigger may be anywhere, and a gripper that jumped to it would let fall what it
/// holds. So it stays as it is until the trigger reaches the last command or passes it. Nothing is commanded while the
/// sides are not coupled: the gripper keeps its grip.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GripperFollower {
    speed: f64,
    force_n: f64,
    /// The last command; where the jaws were before the first.
    position: Option<f64>,
    /// The trigger at the last coupled tick.
    trigger: Option<f64>,
    follows: bool,
}

impl GripperFollower {
    /// Of a gripper as `settings` have it.
    pub fn new(settings: &GripperSettings) -> Self {
        Self {
            speed: settings.speed,
            force_n: settings.force_n,
            position: None,
            trigger: None,
            follows: false,
        }
    }

    /// The command of a tick `elapsed_s` after the one before; none where the gripper is to stay as it is. `trigger`
    /// is that of the master's newest frame while the two sides are coupled, else none.
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
            // A little more open than where something stops the jaws would let it fall.
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

    /// Whether the trigger leads the gripper: the two sides are coupled, and it has been picked up.
    pub fn follows(&self) -> bool {
        self.follows
    }

    /// The last command, 0 open to 1 closed; none before the first.
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

    /// A hand that lets go of the trigger while nobody is coupled, and engages anew, drops nothing.
    #[test]
    fn a_grip_is_kept_until_the_trigger_comes_to_it() {
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

    /// The last command is not known after a restart: the jaws stand on what they hold.
    #[test]
    fn a_grip_of_unknown_strength_is_picked_up_by_closing_only() {
        let held = GripperSample { position: 0.6, holds_object: true, ..AT_REST };
        for (trigger, follows) in [(0.585, false), (0.599, false), (0.6, true), (0.615, true)] {
            let mut follower = GripperFollower::new(&SETTINGS);
            assert_eq!(follower.step(Some(trigger), &held, 1e-3).is_some(), follows, "{trigger}");
        }
        let mut follower = GripperFollower::new(&SETTINGS);
        assert_eq!(follower.step(Some(0.5), &held, 1e-3), None);
        assert!(position(follower.step(Some(0.7), &held, 1e-3)) > 0.6, "closing takes it along");
    }

    #[test]
    fn a_trigger_that_passes_the_command_between_two_frames_takes_it_along() {
        let mut follower = GripperFollower::new(&SETTINGS);
        let half = GripperSample { position: 0.5, ..AT_REST };
        assert_eq!(follower.step(Some(0.2), &half, 1e-3), None);
        assert!((position(follower.step(Some(0.9), &half, 1e-3)) - 0.502).abs() < 1e-12);
    }

    proptest! {
        /// Whatever the trigger does and however often the link fails, the command never jumps.
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
