//! What the safety controllers answer at one tick.

use nalgebra::{SimdBool as _, SimdValue as _};

use crate::{Axes, Real};

/// Which controllers called the tick unsafe.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Tripped(u8);

impl Tripped {
    /// Nobody.
    pub const NONE: Self = Self(0);
    /// VFC, Eq. 2.
    pub const VFC: Self = Self(1);
    /// HSC, Eq. 14.
    pub const HSC: Self = Self(2);
    /// WSC, Eq. 13.
    pub const WSC: Self = Self(4);
    /// PC, Eq. 12.
    pub const PC: Self = Self(8);
    /// No controller now, but its minimum time on or the release ramp has not ended.
    pub const HELD: Self = Self(16);

    /// From [`bits`](Self::bits); bits without meaning are dropped.
    pub fn from_bits(bits: u8) -> Self {
        Self(bits & 31)
    }

    /// Whether anything is set.
    pub fn any(self) -> bool {
        self.0 != 0
    }

    /// Whether all of `other` is set.
    pub fn contains(self, other: Self) -> bool {
        self.0 & other.0 == other.0
    }

    /// Names of what is set, in the order of the bits.
    pub fn names(self) -> impl Iterator<Item = &'static str> {
        let names = [
            (Self::VFC, "vfc"),
            (Self::HSC, "hsc"),
            (Self::WSC, "wsc"),
            (Self::PC, "pc"),
            (Self::HELD, "held"),
        ];
        names.into_iter().filter(move |(bit, _)| self.contains(*bit)).map(|(_, name)| name)
    }

    /// The bits, for records: VFC 1, HSC 2, WSC 4, PC 8, held 16.
    pub fn bits(self) -> u8 {
        self.0
    }

    #[inline]
    fn with(self, other: Self, set: bool) -> Self {
        if set { Self(self.0 | other.0) } else { self }
    }
}

/// What the safety controllers add at one tick, and what they saw.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Intervention<const N: usize> {
    /// `F_c` in N.
    pub safety_force: Axes<N>,
    /// Who tripped.
    pub tripped: Tripped,
    /// `S_vf`; NaN when VFC is not built.
    pub velocity_force: f64,
    /// `S_h`; NaN when HSC is not built.
    pub grasp: f64,
    /// `E_wso` in J; NaN when WSC is not built.
    pub windowed_energy_j: f64,
    /// `E_so` in J; NaN when PC is not built.
    pub energy_j: f64,
}

impl<const N: usize> Intervention<N> {
    /// No force, and nothing was observed.
    pub fn none() -> Self {
        Self {
            safety_force: Axes::zeros(),
            tripped: Tripped::NONE,
            velocity_force: f64::NAN,
            grasp: f64::NAN,
            windowed_energy_j: f64::NAN,
            energy_j: f64::NAN,
        }
    }
}

/// What the safety controllers add at one tick, and what they saw, in each lane.
#[derive(Clone, Copy, Debug)]
pub struct Response<const N: usize, S: Real = f64> {
    /// `F_c` in N.
    pub safety_force: Axes<N, S>,
    /// Where any of them acts.
    pub acts: S::SimdBool,
    /// Where VFC called the tick unsafe.
    pub vfc: S::SimdBool,
    /// Where HSC did.
    pub hsc: S::SimdBool,
    /// Where WSC did.
    pub wsc: S::SimdBool,
    /// Where PC dissipates.
    pub pc: S::SimdBool,
    /// Where no controller does now, but the minimum time on or the release ramp has not ended.
    pub held: S::SimdBool,
    /// `S_vf`; NaN when VFC is not built.
    pub velocity_force: S,
    /// `S_h`; NaN when HSC is not built.
    pub grasp: S,
    /// `E_wso` in J; NaN when WSC is not built.
    pub windowed_energy_j: S,
    /// `E_so` in J; NaN when PC is not built.
    pub energy_j: S,
}

impl<const N: usize, S: Real> Response<N, S> {
    /// The intervention in one lane.
    #[inline]
    pub fn lane(&self, lane: usize) -> Intervention<N> {
        let is_set = |mask: S::SimdBool| mask.bitmask() >> lane & 1 == 1;
        Intervention {
            safety_force: self.safety_force.extract(lane),
            tripped: Tripped::NONE
                .with(Tripped::VFC, is_set(self.vfc))
                .with(Tripped::HSC, is_set(self.hsc))
                .with(Tripped::WSC, is_set(self.wsc))
                .with(Tripped::PC, is_set(self.pc))
                .with(Tripped::HELD, is_set(self.held)),
            velocity_force: self.velocity_force.extract(lane),
            grasp: self.grasp.extract(lane),
            windowed_energy_j: self.windowed_energy_j.extract(lane),
            energy_j: self.energy_j.extract(lane),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use simba::simd::{AutoBoolx4, AutoF64x4};

    const ALL: [(Tripped, &str); 5] = [
        (Tripped::VFC, "vfc"),
        (Tripped::HSC, "hsc"),
        (Tripped::WSC, "wsc"),
        (Tripped::PC, "pc"),
        (Tripped::HELD, "held"),
    ];

    #[test]
    fn bits_and_names_are_of_the_controllers_that_tripped() {
        for bits in 0..=u8::MAX {
            let tripped = Tripped::from_bits(bits);
            assert_eq!(tripped.bits(), bits % 32);
            assert_eq!(tripped.any(), bits % 32 != 0);
            let names: Vec<_> = tripped.names().collect();
            let mut expected = Vec::new();
            for (place, (one, name)) in ALL.into_iter().enumerate() {
                let is_set = bits >> place & 1 == 1;
                assert_eq!(tripped.contains(one), is_set);
                assert_eq!(tripped.with(one, true), Tripped::from_bits(bits | one.bits()));
                assert_eq!(tripped.with(one, false), tripped);
                if is_set {
                    expected.push(name);
                }
            }
            assert_eq!(names, expected);
            assert!(tripped.contains(Tripped::NONE) && tripped.contains(tripped));
        }
    }

    #[test]
    fn each_lane_has_its_own_answer() {
        for lane in 0..4 {
            let only = |place: usize| {
                let mut mask = AutoBoolx4::splat(false);
                mask.replace((lane + place) % 4, true);
                mask
            };
            let number = |from: f64| AutoF64x4::new(from, from + 1.0, from + 2.0, from + 3.0);
            let response = Response::<1, AutoF64x4> {
                safety_force: Axes::<1, AutoF64x4>::new(number(1.0)),
                acts: only(0),
                vfc: only(0),
                hsc: only(1),
                wsc: only(2),
                pc: only(3),
                held: only(0),
                velocity_force: number(10.0),
                grasp: number(20.0),
                windowed_energy_j: number(30.0),
                energy_j: number(40.0),
            };
            let own = response.lane(lane);
            assert_eq!(own.tripped, Tripped::from_bits(1 | 16));
            for (place, one) in [(1, Tripped::HSC), (2, Tripped::WSC), (3, Tripped::PC)] {
                assert_eq!(response.lane((lane + place) % 4).tripped, one);
            }
            let place = lane as f64;
            assert_eq!(
                [own.safety_force[0], own.velocity_force, own.grasp, own.windowed_energy_j, own.energy_j],
                [1.0 + place, 10.0 + place, 20.0 + place, 30.0 + place, 40.0 + place]
            );
        }
    }
}
