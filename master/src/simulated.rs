//! A simulated master: device and hand, advanced exactly under the force held since the last write.

use crate::{
    DeviceParameters, Hand, ModelError, require,
    stretch::{Linear, first_negative},
};

/// What a device tells at one tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MasterSample {
    /// x in m, as the encoder sees it.
    pub position: f64,
    /// V in m/s, only from a device that measures it.
    pub velocity: Option<f64>,
}

/// Longest time in s over which the hand's path is taken for a straight line.
const LONGEST_STEP: f64 = 1e-3;

/// Least progress in s between two events. At a tie (the grip exactly as strong as the load) rounding would place
/// the next event at no distance; within a nanosecond the forces change by less than rounding of the velocity.
const LEAST_PROGRESS: f64 = 1e-9;

/// Events that one step locates; beyond them (the model has not been seen to make more than 4) it moves on in
/// steps of this share of the tick, so that a tick always ends.
const MOST_EVENTS: i32 = 64;

/// Device and hand along one axis.
///
/// Between two events (the velocity turns, the grip begins or ceases to slip, the release begins or ends) the motion
/// is linear and is advanced by its exact solution; the events themselves are located to rounding.
#[derive(Clone, Debug, PartialEq)]
pub struct SimulatedMaster {
    device: DeviceParameters,
    hand: Hand,
    held_force: f64,
    /// Time in s of the hand: 0 where its path begins.
    time: f64,
    waits: bool,
    now_ns: u64,
    position: f64,
    velocity: f64,
}

/// How the hand's force arises during a stretch.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Grip {
    Holds,
    /// Slips, with the force in this direction.
    Slips(f64),
}

impl SimulatedMaster {
    /// A device at rest where the hand's path starts, at time `now_ns`.
    pub fn new(device: DeviceParameters, hand: Hand, now_ns: u64) -> Result<Self, ModelError> {
        device.check()?;
        let position = hand.path().start();
        Ok(Self { device, hand, held_force: 0.0, time: 0.0, waits: false, now_ns, position, velocity: 0.0 })
    }

    /// Whether the hand waits at the start of its path; once it no longer waits, its time runs from there.
    pub fn set_waiting(&mut self, waits: bool) {
        self.waits = waits;
    }

    /// Puts the device at x in m with V in m/s.
    pub fn place(&mut self, position: f64, velocity: f64) -> Result<(), ModelError> {
        require("position", position, true, "finite")?;
        require("velocity", velocity, true, "finite")?;
        (self.position, self.velocity) = (position, velocity);
        Ok(())
    }

    /// Sets the clock to `now_ns` without advancing: the device rests until then.
    pub fn begin(&mut self, now_ns: u64) {
        self.now_ns = now_ns;
    }

    /// Advances to `now_ns` (monotonic) and tells what the device measures there.
    pub fn read(&mut self, now_ns: u64) -> MasterSample {
        let elapsed_ns = now_ns.saturating_sub(self.now_ns);
        self.now_ns = self.now_ns.max(now_ns);
        let mut left = elapsed_ns as f64 * 1e-9;
        while left > LONGEST_STEP * (1.0 + 1e-9) {
            self.advance(LONGEST_STEP);
            left -= LONGEST_STEP;
        }
        if left > 0.0 {
            self.advance(left);
        }
        MasterSample {
            position: self.device.encode(self.position),
            velocity: (self.device.encoder_quantum == 0.0).then_some(self.velocity),
        }
    }

    /// Holds this force in N from now on; what is not finite becomes no force.
    pub fn write(&mut self, force: f64) {
        self.held_force = if force.is_finite() { force } else { 0.0 };
    }

    /// True position in m, which no encoder tells.
    pub fn position(&self) -> f64 {
        self.position
    }

    /// True velocity in m/s.
    pub fn velocity(&self) -> f64 {
        self.velocity
    }

    /// True force of the hand on the device in N.
    pub fn hand_force(&self) -> f64 {
        let wished = self.wished_force(self.hand.path().at(self.time), self.position, self.velocity);
        let strength = self.hand.strength_at(self.time);
        wished.clamp(-strength, strength)
    }

    fn wished_force(&self, target: f64, position: f64, velocity: f64) -> f64 {
        self.hand.stiffness() * (target - position) - self.hand.damping() * velocity
    }

    fn advance(&mut self, duration: f64) {
        let begun = self.time;
        let target = self.hand.path().at(begun);
        let target_rate =
            if self.waits { 0.0 } else { (self.hand.path().at(begun + duration) - target) / duration };
        let end = begun + duration;
        let mut events = 0;
        while self.time < end {
            events += 1;
            let least = if events < MOST_EVENTS { LEAST_PROGRESS } else { duration / f64::from(MOST_EVENTS) };
            let kink = self.hand.next_kink(self.time).unwrap_or(f64::INFINITY);
            let target_now = target + target_rate * (self.time - begun);
            self.stretch(end.min(kink), least, target_now, target_rate);
        }
        // Rounding of many small additions must not shift the clock.
        self.time = if self.waits { begun } else { end };
    }

    /// Follows one stretch until `end` or the next event, whichever is first.
    ///
    /// It is at least `least` s long, unless `end` is nearer.
    fn stretch(&mut self, end: f64, least: f64, target: f64, target_rate: f64) {
        let wanted = end - self.time;
        let strength = self.hand.strength_at(self.time);
        let strength_rate = (self.strength_just_before(end) - strength) / wanted;
        let wished = self.wished_force(target, self.position, self.velocity);
        let grip = if wished.abs() <= strength { Grip::Holds } else { Grip::Slips(wished.signum()) };
        let (force, force_rate) = match grip {
            // The part of the hand's force that depends on x and V is in the stretch's stiffness and damping.
            Grip::Holds => (self.hand.stiffness() * target, self.hand.stiffness() * target_rate),
            Grip::Slips(way) => (way * strength, way * strength_rate),
        };
        let (stiffness, hand_damping) = match grip {
            Grip::Holds => (self.hand.stiffness(), self.hand.damping()),
            Grip::Slips(_) => (0.0, 0.0),
        };

        let push = force - stiffness * self.position;
        if self.leans_on_stop(push) {
            let total = self.held_force + push;
            self.rest(end, least, |t| total.signum() * (total + force_rate * t));
            return;
        }
        let Some(direction) = self.direction_of_motion(push) else {
            let (total, most) = (self.held_force + push, self.device.coulomb);
            self.rest(end, least, |t| most - (total + force_rate * t).abs());
            return;
        };
        let equation = Linear {
            mass: self.device.mass_kg,
            damping: self.device.viscous + hand_damping,
            stiffness,
            force: self.held_force + force - direction * self.device.coulomb,
            force_rate,
        };
        let motion = equation.from(self.position, self.velocity);
        let mut duration = wanted.min(equation.reach());
        if self.device.coulomb > 0.0
            && let Some(turn) = first_negative(|t| direction * motion.velocity(t), duration)
        {
            duration = turn.max(least).min(wanted);
        }
        let slack = |t: f64| {
            let wished = self.wished_force(target + target_rate * t, motion.position(t), motion.velocity(t));
            let slack = strength + strength_rate * t - wished.abs();
            if grip == Grip::Holds { slack } else { -slack }
        };
        let turns = duration;
        // The way that is left to the nearer stop.
        let ahead = |t: f64| {
            let x = motion.position(t);
            (x - self.device.stops.0).min(self.device.stops.1 - x)
        };
        if let Some(hit) = first_negative(ahead, duration) {
            duration = hit.max(least).min(wanted);
        }
        if let Some(slip) = first_negative(slack, duration) {
            duration = slip.max(least).min(wanted);
        }
        self.position = motion.position(duration);
        self.velocity = motion.velocity(duration);
        let turned = self.device.coulomb > 0.0 && duration == turns && direction * self.velocity < 0.0;
        if turned {
            self.velocity = 0.0;
        }
        self.meet_stops();
        self.time = if duration == wanted { end } else { self.time + duration };
    }

    /// A stop takes the speed that leads into it.
    fn meet_stops(&mut self) {
        let (lower, upper) = self.device.stops;
        if self.position <= lower {
            (self.position, self.velocity) = (lower, self.velocity.max(0.0));
        } else if self.position >= upper {
            (self.position, self.velocity) = (upper, self.velocity.min(0.0));
        }
    }

    fn strength_just_before(&self, end: f64) -> f64 {
        // A sudden release is a jump at its kink: the stretch before it keeps the full strength.
        match self.hand.release() {
            Some(release) if release.duration_s == 0.0 && end <= release.at_s => {
                self.hand.strength_at(self.time)
            }
            _ => self.hand.strength_at(end),
        }
    }

    /// The sign that friction works against, or none if it holds the device at rest against `hand_force`.
    fn direction_of_motion(&self, hand_force: f64) -> Option<f64> {
        let push = self.held_force + hand_force;
        if self.velocity != 0.0 {
            Some(self.velocity.signum())
        } else if push.abs() > self.device.coulomb {
            Some(push.signum())
        } else {
            // Without friction a device at rest under no force may still move later in this stretch.
            (self.device.coulomb == 0.0).then_some(1.0)
        }
    }

    /// Whether the device rests at a stop and is pushed into it.
    fn leans_on_stop(&self, hand_force: f64) -> bool {
        let push = self.held_force + hand_force;
        let (lower, upper) = self.device.stops;
        self.velocity == 0.0
            && ((self.position <= lower && push < 0.0) || (self.position >= upper && push > 0.0))
    }

    /// Rests until `end` or until the margin of what holds it is used up.
    fn rest(&mut self, end: f64, least: f64, margin: impl Fn(f64) -> f64) {
        self.time = match first_negative(margin, end - self.time) {
            Some(breaks) => (self.time + breaks.max(least)).min(end),
            None => end,
        };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Leg, LegShape, Path, Release};

    const TICK_NS: u64 = 1_000_000;
    const FRICTIONLESS: DeviceParameters = DeviceParameters {
        viscous: 0.0,
        coulomb: 0.0,
        encoder_quantum: 0.0,
        ..DeviceParameters::PHANTOM_DESKTOP
    };

    fn alone(device: DeviceParameters, position: f64) -> SimulatedMaster {
        SimulatedMaster::new(device, Hand::absent(position).unwrap(), 0).unwrap()
    }

    /// Peak velocity when a wall of stiffness K, sampled and held, throws the device out from depth D.
    fn ejection(stiffness: f64, depth: f64) -> f64 {
        let mut master = alone(FRICTIONLESS, -depth);
        for tick in 0..1000 {
            let sample = master.read(tick * TICK_NS);
            master.write(-stiffness * sample.position.min(0.0));
        }
        master.velocity()
    }

    #[test]
    fn a_held_wall_throws_as_the_sampled_recursion_says() {
        for (stiffness, depth) in [(200.0, 0.039), (1000.0, 0.0078), (500.0, 0.01)] {
            let (mut z, mut v, dt) = (-depth, 0.0_f64, 1e-3);
            while z < 0.0 {
                let force = -stiffness * z;
                z += v * dt + force * dt * dt / (2.0 * 0.157);
                v += force * dt / 0.157;
            }
            assert!((ejection(stiffness, depth) - v).abs() < 1e-12);
        }
    }

    #[test]
    fn a_held_wall_returns_more_than_it_took() {
        // Half a tick of delay acts as damping -K dT / 2; over a quarter period it gains exp(pi/8 dT sqrt(K/m)).
        let w = (200.0_f64 / 0.157).sqrt();
        let gain = ejection(200.0, 0.039) / (w * 0.039);
        let predicted = (std::f64::consts::PI / 8.0 * 1e-3 * w).exp();
        // The wall is left inside a tick, up to K D w dT² / m beyond the edge: 1 - cos(w dT) of the velocity.
        assert!((gain - predicted).abs() < 1e-3, "{gain} {predicted}");
        assert!((1.013..1.016).contains(&gain));
    }

    #[test]
    fn coulomb_friction_stops_exactly() {
        let device = DeviceParameters { coulomb: 0.038, ..FRICTIONLESS };
        let mut master = alone(device, 0.0);
        master.place(0.0, 0.1).unwrap();
        master.read(10_000 * TICK_NS);
        // v² / (2 c / m)
        assert!((master.position() - 0.01 * 0.157 / (2.0 * 0.038)).abs() < 1e-15);
        assert_eq!(master.velocity(), 0.0);
    }

    #[test]
    fn stiction_holds_up_to_c_and_not_beyond() {
        let device = DeviceParameters { coulomb: 0.038, ..FRICTIONLESS };
        for (force, moves) in [(0.0379, false), (-0.0379, false), (0.0381, true), (-0.0381, true)] {
            let mut master = alone(device, 0.0);
            master.write(force);
            master.read(100 * TICK_NS);
            assert_eq!(master.position() != 0.0, moves, "{force}");
        }
    }

    #[test]
    fn time_may_begin_anywhere() {
        let mut master = alone(FRICTIONLESS, 0.01);
        master.write(1.0);
        // A monotonic clock may have run for years: advancing from 0 would never end.
        master.begin(u64::MAX / 2);
        assert_eq!(master.read(u64::MAX / 2).position, 0.01);
        master.read(u64::MAX / 2 + 10 * TICK_NS);
        assert!((master.velocity() - 0.01 / 0.157).abs() < 1e-12);
    }

    #[test]
    fn a_stop_takes_the_speed_and_lets_go_again() {
        let device = DeviceParameters { stops: (-0.1, 0.08), ..FRICTIONLESS };
        let mut master = alone(device, 0.0);
        master.write(2.0);
        // x = F t² / (2 m) reaches the stop at 112 ms.
        master.read(112 * TICK_NS);
        assert!((master.velocity() - 2.0 * 0.112 / 0.157).abs() < 1e-12);
        master.read(300 * TICK_NS);
        assert_eq!((master.position(), master.velocity()), (0.08, 0.0));
        master.write(-1.0);
        master.read(400 * TICK_NS);
        assert!((master.position() - (0.08 - 0.005 / 0.157)).abs() < 1e-12);
    }

    #[test]
    fn rests_where_hand_and_force_balance() {
        let path =
            Path::new(0.02, vec![Leg { duration_s: 0.5, end: -0.03, shape: LegShape::MinimumJerk }]).unwrap();
        let hand = Hand::new(300.0, 5.0, 50.0, path, None).unwrap();
        let mut master = SimulatedMaster::new(FRICTIONLESS, hand, 0).unwrap();
        master.write(3.0);
        master.read(3000 * TICK_NS);
        assert!((master.position() - (-0.03 + 3.0 / 300.0)).abs() < 1e-9);
        assert!((master.hand_force() + 3.0).abs() < 1e-6);
    }

    #[test]
    fn a_grip_slips_only_beyond_its_strength() {
        for (strength, holds) in [(3.1, true), (2.9, false)] {
            let path = Path::new(0.0, Vec::new()).unwrap();
            let hand = Hand::new(300.0, 20.0, strength, path, None).unwrap();
            let mut master = SimulatedMaster::new(FRICTIONLESS, hand, 0).unwrap();
            master.write(3.0 * 0.2);
            master.read(500 * TICK_NS);
            // Approach slowly so that the dynamic overshoot does not break the grip.
            for tick in 500..3000_u32 {
                master.write(0.6 + 2.4 * f64::from(tick - 500) / 2500.0);
                master.read(u64::from(tick) * TICK_NS);
            }
            master.write(3.0);
            master.read(4000 * TICK_NS);
            assert_eq!(master.position() < 0.0105, holds, "{strength}: {}", master.position());
        }
    }

    /// A linear release from a balanced hold: with the hand slipping, m x'' = F0 t / T for constant F0.
    #[test]
    fn a_release_unbalances_as_its_ramp_says() {
        let path = Path::new(0.0, Vec::new()).unwrap();
        let release = Some(Release { at_s: 0.1, duration_s: 0.05 });
        // Strength equal to the load: it slips from the first instant of the release. Very stiff: x stays put.
        let hand = Hand::new(1e6, 1e3, 7.8, path, release).unwrap();
        let mut master = SimulatedMaster::new(FRICTIONLESS, hand, 0).unwrap();
        master.write(7.8);
        master.place(7.8e-6, 0.0).unwrap();
        master.read(100 * TICK_NS);
        assert!(master.velocity().abs() < 1e-6);
        master.read(130 * TICK_NS);
        let t: f64 = 0.03;
        let expected = 7.8 / (2.0 * 0.157 * 0.05) * t * t;
        assert!((master.velocity() - expected).abs() < 1e-4 * expected, "{}", master.velocity());
        assert!((master.hand_force() + 7.8 * 0.4).abs() < 1e-9);
    }

    #[test]
    fn work_of_all_forces_is_the_kinetic_energy() {
        // Slipping hand, friction and held force together, at a step unlike the internal one.
        let path = Path::new(0.0, Vec::new()).unwrap();
        let release = Some(Release { at_s: 0.01, duration_s: 0.02 });
        let hand = Hand::new(300.0, 5.0, 4.0, path, release).unwrap();
        let device = DeviceParameters { viscous: 0.5, coulomb: 0.05, ..FRICTIONLESS };
        let mut coarse = SimulatedMaster::new(device, hand.clone(), 0).unwrap();
        let mut fine = SimulatedMaster::new(device, hand, 0).unwrap();
        coarse.write(3.0);
        fine.write(3.0);
        let (mut work, mut last) = (0.0, (0.0, 0.0));
        for step in 1..=60_000_u64 {
            fine.read(step * 1000);
            let (x, v) = (fine.position(), fine.velocity());
            let middle = 0.5 * (v + last.1);
            let friction = 0.5 * middle + 0.05 * if middle == 0.0 { 0.0 } else { middle.signum() };
            work += (3.0 + fine.hand_force() - friction) * (x - last.0);
            last = (x, v);
        }
        coarse.read(60 * TICK_NS);
        assert!((coarse.velocity() - fine.velocity()).abs() < 1e-10);
        let kinetic = 0.5 * 0.157 * fine.velocity().powi(2);
        assert!((work - kinetic).abs() < 2e-4 * kinetic, "{work} {kinetic}");
    }
}
