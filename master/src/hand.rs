//! A hand: an impedance towards a path, held by a finite grip that can release and regrasp.

use std::f64::consts::TAU;

use haptether_numeric::{Real, norm};
use nalgebra::SimdBool as _;

use crate::{
    Aim, Axes, Leg, LegShape, ModelError, Path,
    path::{DEGREE, MIN_LEG_S},
    polynomial::{Series, TERMS},
    require,
};

/// Quantity that decays during a release.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(
    feature = "serde",
    derive(serde::Deserialize, schemars::JsonSchema),
    serde(rename_all = "kebab-case")
)]
pub enum ReleaseKind {
    /// Grip strength: nothing moves until it has fallen to the load, then the stylus slips.
    #[default]
    Strength,
    /// Whole impedance: `F_h = g (K_h (target - x) - B_h V)` with g from 1 to 0.
    Gain,
}

/// Release of the grip.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Deserialize, schemars::JsonSchema), serde(deny_unknown_fields))]
pub struct Release {
    /// Start in s.
    pub at_s: f64,
    /// Time in s over which the grip falls linearly to zero; 0 releases at once.
    pub decay_s: f64,
    /// Quantity that decays.
    pub kind: ReleaseKind,
}

/// Regrasp after a release.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Deserialize, schemars::JsonSchema), serde(deny_unknown_fields))]
pub struct Regrasp {
    /// Time in s from the end of the release to the first grip: the operator's reaction time.
    pub reaction_s: f64,
    /// Time in s over which the grip grows linearly to its full strength; 0 grips at once.
    pub rise_s: f64,
}

/// Physiological tremor on the path: `a sin(2 pi f t)` on every axis.
///
/// Source: 8 to 12 Hz, Elble and Koller 1990.
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Deserialize, schemars::JsonSchema), serde(deny_unknown_fields))]
pub struct Tremor {
    /// a in m.
    pub amplitude: f64,
    /// f in Hz (0 to 100).
    pub frequency_hz: f64,
}

/// A hand that steers the device along a path with a limited grip.
///
/// `F_h = K_h (x_target - x) - B_h V`, its norm clipped to the grip strength; beyond it the stylus slips
/// through the fingers. Operators hold with a margin above the load, so a loosening grip first changes
/// nothing, then slips.
#[derive(Clone, Debug, PartialEq)]
pub struct Hand<const N: usize> {
    stiffness: f64,
    damping: f64,
    strength_n: f64,
    path: Path<N>,
    release: Option<Release>,
    regrasp: Option<Regrasp>,
    /// Times in s at which the release has ended, the grip begins again and is full again; none without a
    /// release.
    schedule: Option<[f64; 3]>,
    tremor: Option<Tremor>,
}

impl<const N: usize> Hand<N> {
    /// A hand with `K_h` in N/m, `B_h` in N s/m and grip strength in N (each >= 0), a path and a release.
    ///
    /// An infinite grip strength never slips and cannot decay; only its gain may.
    pub fn new(
        stiffness: f64,
        damping: f64,
        strength_n: f64,
        path: Path<N>,
        release: Option<Release>,
    ) -> Result<Self, ModelError> {
        require("hand stiffness", stiffness, stiffness >= 0.0, "finite and 0 or more")?;
        require("hand damping", damping, damping >= 0.0, "finite and 0 or more")?;
        if strength_n.is_nan() || strength_n < 0.0 {
            return Err(ModelError { name: "grip strength", seen: strength_n, allowed: "0 or more" });
        }
        if let Some(Release { at_s, decay_s, kind }) = release {
            require("release time", at_s, true, "finite")?;
            require("release duration", decay_s, decay_s >= 0.0, "finite and 0 or more")?;
            if kind == ReleaseKind::Strength {
                require("grip strength", strength_n, true, "finite, for a release of the strength")?;
            }
        }
        let release = release.map(|one| Release {
            at_s: rounded_to_ns(one.at_s),
            decay_s: or_at_once(one.decay_s),
            ..one
        });
        let schedule = release.map(|release| grip_times(release, None));
        Ok(Self { stiffness, damping, strength_n, path, release, regrasp: None, schedule, tremor: None })
    }

    /// No hand: the device rests at `position` in m.
    pub fn absent(position: Axes<N>) -> Result<Self, ModelError> {
        Self::new(0.0, 0.0, 0.0, Path::new(position, Vec::new())?, None)
    }

    /// An open hand whose time restarts at each aim: a path of one leg, and a release when the aim expires.
    pub(crate) fn aimed(position: Axes<N>) -> Result<Self, ModelError> {
        let leg = Leg { duration_s: Aim::<N>::EXPIRES_S, end: position, shape: LegShape::Linear };
        let expires = Release { at_s: Aim::<N>::EXPIRES_S, decay_s: 0.0, kind: ReleaseKind::Strength };
        Self::new(0.0, 0.0, 0.0, Path::new(position, vec![leg])?, Some(expires))
    }

    /// Take over a valid aim at time 0 of this hand, which [`Hand::aimed`] made; its leg begins at `from` in m.
    pub(crate) fn aim(&mut self, aim: &Aim<N>, from: Axes<N>) {
        (self.stiffness, self.damping, self.strength_n) = (aim.stiffness, aim.damping, aim.strength_n);
        self.path.restart(from, Leg { duration_s: aim.over_s, end: aim.target, shape: LegShape::Linear });
    }

    /// The same hand with a regrasp after its release.
    pub fn with_regrasp(self, regrasp: Regrasp) -> Result<Self, ModelError> {
        let Regrasp { reaction_s, rise_s } = regrasp;
        require("reaction time", reaction_s, reaction_s >= 0.0, "finite and 0 or more")?;
        require("grip rise", rise_s, rise_s >= 0.0, "finite and 0 or more")?;
        let Some(release) = self.release else {
            return Err(ModelError {
                name: "reaction time",
                seen: reaction_s,
                allowed: "given with a release",
            });
        };
        let regrasp = Some(Regrasp { reaction_s, rise_s: or_at_once(rise_s) });
        Ok(Self { regrasp, schedule: Some(grip_times(release, regrasp)), ..self })
    }

    /// The same hand with a tremor.
    pub fn with_tremor(self, tremor: Tremor) -> Result<Self, ModelError> {
        let Tremor { amplitude, frequency_hz } = tremor;
        require("tremor amplitude", amplitude, amplitude >= 0.0, "finite and 0 or more")?;
        let allowed = "between 0 and 100";
        require("tremor frequency", frequency_hz, (0.0..=100.0).contains(&frequency_hz), allowed)?;
        Ok(Self { tremor: Some(tremor), ..self })
    }

    pub(crate) fn stiffness(&self) -> f64 {
        self.stiffness
    }

    pub(crate) fn damping(&self) -> f64 {
        self.damping
    }

    pub(crate) fn with_strength(&self, strength_n: f64) -> Self {
        Self { strength_n, ..self.clone() }
    }

    /// True if path, release, regrasp and tremor equal those of `other`.
    pub(crate) fn moves_as(&self, other: &Self) -> bool {
        let Self { path, release, regrasp, schedule, tremor, .. } = self;
        (path, release, regrasp, schedule, tremor)
            == (&other.path, &other.release, &other.regrasp, &other.schedule, &other.tremor)
    }

    pub(crate) fn full_strength(&self) -> f64 {
        self.strength_n
    }

    pub(crate) fn tremor(&self) -> Option<Tremor> {
        self.tremor
    }

    /// Path of the hand's target.
    pub fn path(&self) -> &Path<N> {
        &self.path
    }

    /// Target of the hand in m at time t in s, tremor included.
    pub fn target_at(&self, t: f64) -> Axes<N> {
        let shake =
            self.tremor.map_or(0.0, |tremor| tremor.amplitude * (TAU * tremor.frequency_hz * t).sin());
        self.path.at(t).add_scalar(shake)
    }

    /// Taylor series of the target about t.
    pub(crate) fn target_series(&self, t: f64) -> [Axes<N>; TERMS] {
        let mut series = [Axes::zeros(); TERMS];
        series[..=DEGREE].copy_from_slice(&self.path.taylor(t));
        if let Some(Tremor { amplitude, frequency_hz }) = self.tremor {
            let rate = TAU * frequency_hz;
            let (sine, cosine) = (rate * t).sin_cos();
            let mut scale = amplitude;
            for (n, term) in series.iter_mut().enumerate() {
                let derivative = [sine, cosine, -sine, -cosine][n % 4];
                term.add_scalar_mut(scale * derivative);
                scale *= rate / (n + 1) as f64;
            }
        }
        series
    }

    /// Grip as a fraction of the full grip at time t: 1 before the release, 0 after it, 1 after a regrasp.
    pub fn grip_at(&self, t: f64) -> f64 {
        let (Some(Release { at_s, decay_s, .. }), Some([ends, begins, full])) = (self.release, self.schedule)
        else {
            return 1.0;
        };
        let held = if t < at_s {
            1.0
        } else if t >= ends {
            0.0
        } else {
            1.0 - (t - at_s) / decay_s
        };
        let regained = self.regrasp.map_or(0.0, |Regrasp { rise_s, .. }| {
            if t < begins {
                0.0
            } else if t >= full {
                1.0
            } else {
                (t - begins) / rise_s
            }
        });
        held.max(regained)
    }

    /// Grip strength in N at time t in s; a release of the gain leaves it unchanged.
    pub fn strength_at(&self, t: f64) -> f64 {
        match self.release.map(|release| release.kind) {
            Some(ReleaseKind::Strength) => self.grip_at(t) * self.strength_n,
            _ => self.strength_n,
        }
    }

    /// Rate of the grip just after time t, in 1/s.
    fn grip_rate(&self, t: f64) -> f64 {
        let (Some(Release { at_s, decay_s, .. }), Some([ends, begins, full])) = (self.release, self.schedule)
        else {
            return 0.0;
        };
        if t >= at_s && t < ends {
            return -decay_s.recip();
        }
        self.regrasp
            .map_or(0.0, |Regrasp { rise_s, .. }| if t >= begins && t < full { rise_s.recip() } else { 0.0 })
    }

    /// Gain, and grip strength in N, from t to the next kink, each as value and rate.
    pub(crate) fn grip_line(&self, t: f64) -> ([f64; 2], [f64; 2]) {
        let line = [self.grip_at(t), self.grip_rate(t)];
        match self.release.map(|release| release.kind) {
            Some(ReleaseKind::Gain) => (line, [self.strength_n, 0.0]),
            Some(ReleaseKind::Strength) => ([1.0, 0.0], line.map(|term| term * self.strength_n)),
            None => ([1.0, 0.0], [self.strength_n, 0.0]),
        }
    }

    /// Force in N of the hand on the device at time t.
    pub fn force(&self, t: f64, position: &Axes<N>, velocity: &Axes<N>) -> Axes<N> {
        let gain = match self.release.map(|release| release.kind) {
            Some(ReleaseKind::Gain) => self.grip_at(t),
            _ => 1.0,
        };
        let strength = self.strength_at(t);
        let wish = ((self.target_at(t) - position) * self.stiffness - velocity * self.damping) * gain;
        gripped(&wish, strength)
    }

    fn kinks(&self) -> [Option<f64>; 4] {
        let (Some(Release { at_s, .. }), Some([ends, begins, full])) = (self.release, self.schedule) else {
            return [None; 4];
        };
        let again = |time: f64| self.regrasp.map(|_| time);
        [Some(at_s), Some(ends), again(begins), again(full)]
    }

    /// Next time after t at which path or grip is not smooth.
    pub(crate) fn next_kink(&self, t: f64) -> Option<f64> {
        let kinks = self.kinks().into_iter().flatten().chain(self.path.next_knot(t));
        kinks.filter(|&kink| kink > t).min_by(f64::total_cmp)
    }
}

/// Duration in s of a change of the grip; 0 if it is so short that powers of its rate would overflow.
pub(crate) fn or_at_once(duration_s: f64) -> f64 {
    if duration_s < MIN_LEG_S { 0.0 } else { duration_s }
}

/// Times in s at which a release has ended, the grip begins again and is full again. They are whole ns, so
/// that a sudden grip falls on its tick.
fn grip_times(release: Release, regrasp: Option<Regrasp>) -> [f64; 3] {
    let Regrasp { reaction_s, rise_s } = regrasp.unwrap_or(Regrasp { reaction_s: 0.0, rise_s: 0.0 });
    let ends = rounded_to_ns(release.at_s + release.decay_s);
    let begins = rounded_to_ns(ends + reaction_s);
    [ends, begins, rounded_to_ns(begins + rise_s)]
}

/// Round s to whole ns: a sum of decimal seconds differs from its tick by rounding.
pub(crate) fn rounded_to_ns(time_s: f64) -> f64 {
    (time_s * 1e9).round() / 1e9
}

pub(crate) fn line([value, rate]: [f64; 2]) -> Series {
    let mut series = [0.0; TERMS];
    (series[0], series[1]) = (value, rate);
    series
}

/// Clip the hand's force `wish` in N to the grip `strength` in N.
#[inline(always)] // once per tick
pub(crate) fn gripped<const N: usize, S: Real>(wish: &Axes<N, S>, strength: S) -> Axes<N, S> {
    // The common case, well below the strength, needs no root.
    let holds = wish.dot(wish).simd_lt(S::splat(0.99) * strength * strength);
    if holds.all() {
        return *wish;
    }
    let wished = norm(wish);
    let share = S::one().select(holds | wished.simd_le(strength), strength / wished);
    // A released hand exerts no force, whatever its wish.
    let share = S::zero().select(strength.simd_eq(S::zero()), share);
    wish.map(|x| x * share)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Compare `gripped` with the law written with a root and a division.
    fn check_grip<const N: usize>(direction: Axes<N>) {
        for strength in [0.0, 1e-310, 1e-150, 20.0, 1e150, f64::INFINITY] {
            let size = if strength == f64::INFINITY { 1e9 } else { strength };
            let shares =
                [0.0, 0.9, 0.9949, 0.995, 0.99499, 1.0_f64.next_down(), 1.0, 1.0_f64.next_up(), 2.0, 1e3];
            for wish in shares.map(|share| direction * (share * size)) {
                let wished = if N == 1 { wish[0].abs() } else { wish.norm() };
                let expected = if wished <= strength { wish } else { wish * (strength / wished) };
                assert_eq!(gripped(&wish, strength), expected, "{strength:e} {wish}");
            }
        }
    }

    #[test]
    fn grip_clips_the_hand_force() {
        check_grip(Axes::<1>::new(-1.0));
        check_grip(Axes::<3>::new(0.6, -0.0, 0.8));
    }

    fn hand(release: Release) -> Hand<1> {
        let path = Path::new(Axes::<1>::zeros(), Vec::new()).unwrap();
        Hand::new(300.0, 5.0, 20.0, path, Some(release)).unwrap()
    }

    #[test]
    fn the_grip_falls_over_the_release_and_returns() {
        let slow = Release { at_s: 1.0, decay_s: 0.04, kind: ReleaseKind::Strength };
        let once = hand(slow);
        for (t, grip) in [(0.0, 1.0), (1.0, 1.0), (1.01, 0.75), (1.04, 0.0), (5.0, 0.0)] {
            assert!((once.grip_at(t) - grip).abs() < 1e-12, "{t}");
        }
        let again = once.with_regrasp(Regrasp { reaction_s: 0.2, rise_s: 0.1 }).unwrap();
        for (t, grip) in [(1.01, 0.75), (1.2, 0.0), (1.24, 0.0), (1.29, 0.5), (1.34, 1.0), (9.0, 1.0)] {
            assert!((again.grip_at(t) - grip).abs() < 1e-12, "{t}");
        }
        let kinks: Vec<_> = [0.0, 1.0, 1.04, 1.3].iter().map(|&t| again.next_kink(t).unwrap()).collect();
        for (kink, expected) in kinks.iter().zip([1.0, 1.04, 1.24, 1.34]) {
            assert!((kink - expected).abs() < 1e-12);
        }
        let sudden = hand(Release { decay_s: 0.0, ..slow });
        assert_eq!((sudden.grip_at(0.999), sudden.grip_at(1.0)), (1.0, 0.0));
        assert_eq!(sudden.grip_line(0.5).1, [20.0, 0.0], "a sudden release is no ramp before it");
    }

    #[test]
    fn the_target_series_is_the_target() {
        let path = Path::new(Axes::<1>::new(0.3), Vec::new()).unwrap();
        let hand = Hand::new(300.0, 5.0, f64::INFINITY, path, None).unwrap();
        let hand = hand.with_tremor(Tremor { amplitude: 1e-3, frequency_hz: 10.0 }).unwrap();
        let series = hand.target_series(0.37).map(|term| term[0]);
        let there = crate::polynomial::value(&series, 5e-3);
        assert!((there - hand.target_at(0.375)[0]).abs() < 1e-16);
    }

    #[test]
    fn rejects_invalid_hand() {
        let path = || Path::new(Axes::<1>::zeros(), Vec::new()).unwrap();
        let fades = Release { at_s: 1.0, decay_s: 0.1, kind: ReleaseKind::Strength };
        assert!(Hand::new(300.0, 5.0, f64::INFINITY, path(), Some(fades)).is_err());
        assert!(Hand::new(300.0, 5.0, f64::NAN, path(), None).is_err());
        assert!(Hand::new(-1.0, 5.0, 1.0, path(), None).is_err());
        let endless = Hand::new(300.0, 5.0, 1.0, path(), None).unwrap();
        assert!(endless.clone().with_regrasp(Regrasp { reaction_s: 0.2, rise_s: 0.1 }).is_err());
        assert!(endless.with_tremor(Tremor { amplitude: 1e-3, frequency_hz: f64::NAN }).is_err());
    }
}
