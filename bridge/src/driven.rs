//! Plants of drivers outside of this crate: what they have read, and what they are to write.
//!
//! The loop of such a driver is `read -> tick -> write -> wait`: it leaves its sample here before the tick, and takes
//! force or order from here after it.

use haptether_safety::Axes;

use crate::plant::{MasterPlant, SlavePlant};

/// A haptic device whose driver is elsewhere.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DrivenMaster<const N: usize> {
    /// Position in m, as read.
    pub position: Axes<N>,
    /// Velocity in m/s, from a device that measures it.
    pub velocity: Option<Axes<N>>,
    /// Whether the clutch is pressed, of a device that has a button.
    pub clutch: Option<bool>,
    /// Force in N that the device is to exert.
    pub force: Axes<N>,
}

impl<const N: usize> Default for DrivenMaster<N> {
    fn default() -> Self {
        Self { position: Axes::zeros(), velocity: None, clutch: None, force: Axes::zeros() }
    }
}

impl<const N: usize> MasterPlant<N> for DrivenMaster<N> {
    fn read(&mut self, _now_ns: u64) -> (Axes<N>, Option<Axes<N>>) {
        (self.position, self.velocity)
    }

    fn write(&mut self, force: &Axes<N>) {
        self.force = *force;
    }

    fn clutch(&self) -> Option<bool> {
        self.clutch
    }
}

/// What a driver is to have its arm do.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum SlaveOrder<const N: usize> {
    /// Nothing yet: no master has engaged.
    Wait,
    /// Take the tool to `position` in m, which moves with `velocity` in m/s.
    Move {
        /// Position in m.
        position: Axes<N>,
        /// Velocity in m/s.
        velocity: Axes<N>,
    },
    /// Stop softly, and stay.
    Stop,
}

/// A deceleration that no arm can be stopped with.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[error("deceleration = {0}: must be above 0 and at most 100 m/s^2")]
pub struct DrivenSlaveError(pub f64);

/// The path to rest of an arm that is no longer led: straight on, with constant deceleration.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Braking<const N: usize> {
    from: Axes<N>,
    velocity: Axes<N>,
    begun_ns: u64,
    rest: Axes<N>,
}

/// An arm whose driver is elsewhere.
///
/// Where it is no longer led it brakes at `deceleration`; what is written meanwhile is added to that, so that neither
/// the commanded position nor its velocity ever jumps. A stop is left to the driver.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DrivenSlave<const N: usize> {
    /// Position in m, velocity in m/s and `F_e` in N, as read.
    pub sample: [Axes<N>; 3],
    order: SlaveOrder<N>,
    /// In m/s^2.
    deceleration: f64,
    braking: Option<Braking<N>>,
    now_ns: u64,
}

impl<const N: usize> DrivenSlave<N> {
    /// An arm that brakes at `deceleration` in m/s^2.
    pub fn new(deceleration: f64) -> Result<Self, DrivenSlaveError> {
        if !(deceleration > 0.0 && deceleration <= 100.0) {
            return Err(DrivenSlaveError(deceleration));
        }
        Ok(Self {
            sample: [Axes::zeros(); 3],
            order: SlaveOrder::Wait,
            deceleration,
            braking: None,
            now_ns: 0,
        })
    }

    /// What the driver is to do after this tick.
    pub fn order(&self) -> &SlaveOrder<N> {
        &self.order
    }
}

impl<const N: usize> SlavePlant<N> for DrivenSlave<N> {
    fn read(&mut self, now_ns: u64) -> [Axes<N>; 3] {
        self.now_ns = now_ns;
        self.sample
    }

    fn write(&mut self, position: &Axes<N>, velocity: &Axes<N>) {
        let (mut position, mut velocity) = (*position, *velocity);
        if let Some(Braking { from, velocity: before, begun_ns, rest }) = self.braking {
            let (t, speed) = ((self.now_ns - begun_ns) as f64 * 1e-9, before.norm());
            let left = speed - self.deceleration * t;
            if left > 0.0 {
                // x = v t - a t^2 / 2 along v, of constant deceleration.
                let along = from + before * (t - 0.5 * self.deceleration * t * t / speed);
                position += along - rest;
                velocity += before * (left / speed);
            } else {
                self.braking = None;
            }
        }
        self.order = SlaveOrder::Move { position, velocity };
    }

    /// Left to the driver, so that where it ends is not known here.
    fn stop(&mut self) -> Axes<N> {
        (self.order, self.braking) = (SlaveOrder::Stop, None);
        Axes::repeat(f64::NAN)
    }

    fn hold(&mut self) -> Axes<N> {
        let SlaveOrder::Move { position: from, velocity } = self.order else {
            return Axes::repeat(f64::NAN);
        };
        // v^2 / 2 a along v.
        let rest = from + velocity * (0.5 * velocity.norm() / self.deceleration);
        self.braking = Some(Braking { from, velocity, begun_ns: self.now_ns, rest });
        rest
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    fn commanded(arm: &DrivenSlave<3>) -> (Axes<3>, Axes<3>) {
        match *arm.order() {
            SlaveOrder::Move { position, velocity } => (position, velocity),
            ref other => panic!("{other:?}"),
        }
    }

    #[test]
    fn an_arm_that_is_not_led_brakes_evenly_to_where_it_said() {
        for (speed, deceleration) in [(0.25, 2.5), (1.0, 5.0), (3.0, 100.0), (0.0, 5.0)] {
            let mut arm = DrivenSlave::<3>::new(deceleration).unwrap();
            let velocity = Axes::<3>::new(0.6, -0.8, 0.0) * speed;
            let from = Axes::<3>::new(0.1, 0.2, 0.3);
            arm.read(10 * MS);
            arm.write(&from, &velocity);
            let rest = arm.hold();
            assert!(((rest - from).norm() - speed * speed / (2.0 * deceleration)).abs() < 1e-12);
            let mut before = (from, velocity);
            for n in 1..=2000 {
                arm.read((10 + n) * MS);
                arm.write(&rest, &Axes::zeros());
                let now = commanded(&arm);
                // Trapezoid of two velocities: exact for constant deceleration, but in the step it ends in.
                let step = now.0 - before.0 - (now.1 + before.1) * 0.5e-3;
                assert!(step.norm() < 1e-12 || (now.1.norm() == 0.0 && step.norm() < deceleration * 1e-6));
                assert!((now.1 - before.1).norm() <= deceleration * 1e-3 + 1e-12);
                before = now;
            }
            assert!((before.0 - rest).norm() < 1e-12 && before.1.norm() == 0.0);
        }
    }

    #[test]
    fn an_arm_that_is_led_again_while_it_brakes_is_commanded_no_jump() {
        let mut arm = DrivenSlave::<3>::new(2.0).unwrap();
        let velocity = Axes::<3>::new(1.0, 0.0, 0.0);
        arm.read(0);
        arm.write(&Axes::zeros(), &velocity);
        let rest = arm.hold();
        let mut before = Axes::zeros();
        for n in 1..=1000 {
            arm.read(n * MS);
            // From 100 ms on the master leads it the other way, slowly.
            let led = n.saturating_sub(100) as f64 * 1e-3;
            arm.write(&(rest - velocity * (0.1 * led)), &(velocity * -0.1));
            let (position, _) = commanded(&arm);
            assert!((position - before).norm() <= 1.0e-3 + 1e-12, "{n}");
            before = position;
        }
        assert!((before - (rest - velocity * 0.09)).norm() < 1e-12);
    }

    #[test]
    fn an_arm_that_was_never_led_is_left_alone_and_a_stop_is_the_drivers() {
        let mut arm = DrivenSlave::<3>::new(2.0).unwrap();
        assert!(arm.hold().iter().all(|x| x.is_nan()));
        assert_eq!(*arm.order(), SlaveOrder::Wait);
        assert!(arm.stop().iter().all(|x| x.is_nan()));
        assert_eq!(*arm.order(), SlaveOrder::Stop);
        arm.write(&Axes::zeros(), &Axes::zeros());
        assert_eq!(commanded(&arm).0, Axes::<3>::zeros());
    }

    #[test]
    fn only_a_deceleration_that_can_be_is_taken() {
        for deceleration in [0.0, -1.0, 100.1, f64::NAN, f64::INFINITY] {
            assert!(DrivenSlave::<1>::new(deceleration).is_err(), "{deceleration}");
        }
    }
}
