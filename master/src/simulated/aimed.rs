//! A device in a hand that a person aims, for example with a mouse: each aim is a leg of its target from now on.

use super::SimulatedMaster;
use crate::{Aim, Hand, ModelError};

/// Aims of a hand.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Aims<const N: usize> {
    /// Newest aim since the last read.
    next: Option<Aim<N>>,
}

impl<const N: usize> SimulatedMaster<N> {
    /// The same device in a hand that follows aims; it is open until the first.
    ///
    /// # Errors
    ///
    /// The position is not finite.
    pub fn aimed(mut self) -> Result<Self, ModelError> {
        self.hand = Hand::aimed(self.motion.position)?;
        self.restart_hand();
        self.aims = Some(Box::new(Aims { next: None }));
        Ok(self)
    }

    /// True if the hand follows aims.
    pub fn is_aimed(&self) -> bool {
        self.aims.is_some()
    }

    /// Follow `aim` from the next read on; the hand opens 0.4 s later unless another aim follows. An open hand that
    /// grips takes the device where it is. False if the hand follows no aims, or the aim is invalid.
    pub fn aim(&mut self, aim: &Aim<N>) -> bool {
        let Some(aims) = self.aims.as_mut().filter(|_| aim.check().is_ok()) else { return false };
        aims.next = Some(*aim);
        true
    }

    /// Begin the leg of an aim that came since the last read.
    pub(super) fn take_aim(&mut self) {
        let Some(aim) = self.aims.as_mut().and_then(|aims| aims.next.take()) else { return };
        let time = self.clock.time;
        let is_open = self.hand.strength_at(time) == 0.0;
        let from = if is_open { self.motion.position } else { self.hand.target_at(time) };
        self.hand.aim(&aim, from);
        self.restart_hand();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Axes, DeviceParameters, Leg, LegShape, Path};

    /// A period that divides neither a leg nor the time to expiry.
    const PERIOD_NS: u64 = 700_000;

    fn device<const N: usize>(coulomb: f64) -> DeviceParameters<N> {
        DeviceParameters::ideal(0.1, 0.0, coulomb)
    }

    fn open_hand(coulomb: f64) -> SimulatedMaster<1> {
        let hand = Hand::absent(Axes::<1>::new(0.02)).unwrap();
        SimulatedMaster::new(device(coulomb), hand, 0).unwrap().aimed().unwrap()
    }

    fn aim_at(target: f64, over_s: f64) -> Aim<1> {
        Aim { target: Axes::<1>::new(target), over_s, stiffness: 90.0, damping: 0.0, strength_n: 50.0 }
    }

    /// x of a mass of 0.1 kg at a spring of 90 N/m from rest at 0.02 m, t s after an aim at 0.08 m over 0.2 s,
    /// after which the hand opens: `m x'' = K (target - x)`.
    fn closed_form(t: f64) -> f64 {
        let (w, over_s, speed) = (30.0_f64, 0.2, 0.3);
        if t <= over_s {
            return 0.02 + speed * (t - (w * t).sin() / w);
        }
        let (lag, v) = (-speed * (w * over_s).sin() / w, speed * (1.0 - (w * over_s).cos()));
        let held = |since: f64| 0.08 + lag * (w * since).cos() + v / w * (w * since).sin();
        let expires = Aim::<1>::EXPIRES_S - over_s;
        if t - over_s <= expires {
            return held(t - over_s);
        }
        let flies = v * (w * expires).cos() - lag * w * (w * expires).sin();
        held(expires) + flies * (t - over_s - expires)
    }

    #[test]
    fn leg_and_expiry_follow_the_closed_form() {
        let mut master = open_hand(0.0);
        let begun = 10;
        for tick in 0..begun {
            assert_eq!(master.read(tick * PERIOD_NS).position[0], 0.02, "an open hand moves nothing");
        }
        assert!(master.aim(&aim_at(0.08, 0.2)));
        for tick in begun..begun + 1000 {
            let x = master.read(tick * PERIOD_NS).position[0];
            let t = ((tick - begun) * PERIOD_NS) as f64 / 1e9;
            assert!((x - closed_form(t)).abs() < 1e-12, "{t}: {x} {}", closed_form(t));
        }
        assert_eq!(master.hand_force()[0], 0.0);
    }

    #[test]
    fn aims_in_a_row_are_the_legs_of_a_path() {
        let targets = [0.05, -0.01, -0.01, 0.03];
        let legs =
            targets.map(|end| Leg { duration_s: 0.1, end: Axes::<1>::new(end), shape: LegShape::Linear });
        let path = Path::new(Axes::<1>::new(0.02), legs.to_vec()).unwrap();
        let hand = Hand::new(90.0, 0.0, 50.0, path, None).unwrap();
        let mut led = SimulatedMaster::new(device(0.05), hand, 0).unwrap();
        let mut aimed = open_hand(0.05);
        for tick in 0..600 {
            if tick % 100 == 0 {
                let target = targets[(tick / 100).min(3) as usize];
                assert!(aimed.aim(&aim_at(target, 0.1)));
            }
            let [expected, x] =
                [&mut led, &mut aimed].map(|master| master.read(tick * 1_000_000).position[0]);
            assert!((x - expected).abs() < 1e-12, "{tick}: {x} {expected}");
            let force = Axes::<1>::new(if tick < 250 { 0.4 } else { -0.7 });
            led.write(&force);
            aimed.write(&force);
        }
    }

    #[test]
    fn open_hand_grips_where_the_device_is() {
        let mut master = open_hand(0.0);
        master.read(0);
        master.place(Axes::<1>::new(-0.3), Axes::zeros()).unwrap();
        assert!(master.aim(&aim_at(0.1, 0.1)));
        master.read(0);
        assert_eq!(master.hand_force()[0], 0.0, "the leg begins at the device");
        // A firm hand whose target has moved on does not begin again at the device.
        master.read(50_000_000);
        let target = master.hand.target_at(master.clock.time);
        assert!(master.aim(&aim_at(0.0, 0.1)));
        master.read(50_000_000);
        assert_eq!(master.hand.target_at(0.0), target);
        assert!(master.aim(&Aim::open()));
        master.read(50_000_000);
        assert_eq!(master.hand_force()[0], 0.0);
    }

    #[test]
    fn invalid_aim_changes_nothing() {
        let valid = aim_at(0.1, 0.1);
        let mut master = open_hand(0.0);
        master.read(0);
        let before = master.clone();
        for (aim, name) in [
            (Aim { target: Axes::<1>::new(f64::NAN), ..valid }, "target"),
            (Aim { target: Axes::<1>::new(2.1), ..valid }, "|target|"),
            (Aim { over_s: 0.0009, ..valid }, "over_s"),
            (Aim { over_s: 0.41, ..valid }, "over_s"),
            (Aim { stiffness: 2000.1, ..valid }, "stiffness"),
            (Aim { stiffness: f64::INFINITY, ..valid }, "stiffness"),
            (Aim { damping: -0.1, ..valid }, "damping"),
            (Aim { strength_n: 51.0, ..valid }, "strength_n"),
        ] {
            assert_eq!(aim.check().unwrap_err().name, name);
            assert!(!master.aim(&aim));
        }
        assert_eq!(master, before);
        let hand = Hand::absent(Axes::<1>::zeros()).unwrap();
        assert!(!SimulatedMaster::new(device(0.0), hand, 0).unwrap().aim(&valid), "not aimed");
    }
}
