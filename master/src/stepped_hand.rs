//! A hand evaluated for one scenario or for several side by side.

use std::f64::consts::TAU;

use crate::{
    Axes, Hand, Real, ReleaseKind,
    axes::{gather, gather_axes},
    path::DEGREE,
};

/// In s.
const HALF_NS: f64 = 0.5e-9;

/// The force of a hand, without branches between scenarios: `F_h = g (K_h (target - x) - B_h V)`, bounded by the grip.
#[derive(Clone, Debug)]
pub struct SteppedHand<const N: usize, S = f64> {
    stiffness: S,
    damping: S,
    strength_n: S,
    /// Whether no scenario bounds the grip.
    is_unbounded: bool,
    release: Option<SteppedRelease<S>>,
    kind: ReleaseKind,
    start: Axes<N, S>,
    legs: Vec<SteppedLeg<N, S>>,
    tremor: Option<[S; 2]>,
}

#[derive(Clone, Debug)]
struct SteppedRelease<S> {
    /// Before this time in s no scenario has begun to let go.
    earliest: f64,
    /// From this time in s on all have let go for good; infinite with a regrasp.
    latest: f64,
    at: S,
    ends: S,
    /// Share of the grip per second, while it falls.
    falls: S,
    regrips: S,
    full: S,
    rises: S,
    has_regrasp: bool,
}

#[derive(Clone, Debug)]
struct SteppedLeg<const N: usize, S> {
    begins: S,
    rate: S,
    displacement: Axes<N, S>,
    shape: [f64; DEGREE + 1],
    /// First power of s in the shape, and the one after the last.
    powers: (usize, usize),
    /// Before this time in s no scenario has begun it; after that one all have ended it.
    earliest: f64,
    latest: f64,
}

impl<const N: usize> SteppedHand<N> {
    /// The hand of one scenario.
    pub(crate) fn new(hand: &Hand<N>) -> Self {
        let path = hand.path();
        let legs = path.legs().iter().enumerate().map(|(index, leg)| {
            let shape = leg.shape.coefficients();
            let first = shape.iter().position(|term| *term != 0.0).unwrap_or(0);
            let after = shape.iter().rposition(|term| *term != 0.0).unwrap_or(0) + 1;
            SteppedLeg {
                begins: path.begins(index),
                rate: leg.duration_s.recip(),
                displacement: leg.end - path.from(index),
                shape,
                powers: (first, after),
                earliest: path.begins(index),
                // A leg has ended where its rounded share is 1, which rounding may put a little later.
                latest: path.begins(index + 1) + 1e-9 * (1.0 + path.begins(index + 1).abs()),
            }
        });
        let pace = |time: f64| if time > 0.0 { time.recip() } else { 0.0 };
        let release = hand.release().map(|release| {
            let [ends, begins, full] = hand.schedule().unwrap_or([release.at_s; 3]);
            SteppedRelease {
                earliest: release.at_s,
                latest: if hand.regrasp().is_some() { f64::INFINITY } else { ends },
                at: release.at_s,
                ends,
                falls: pace(release.decay_s),
                regrips: hand.regrasp().map_or(f64::MAX, |_| begins),
                full: hand.regrasp().map_or(f64::MAX, |_| full),
                rises: hand.regrasp().map_or(0.0, |regrasp| pace(regrasp.rise_s)),
                has_regrasp: hand.regrasp().is_some(),
            }
        });
        Self {
            stiffness: hand.stiffness(),
            damping: hand.damping(),
            // A bound that nothing reaches, so that no lane multiplies infinity by zero.
            strength_n: hand.full_strength().min(f64::MAX),
            is_unbounded: hand.full_strength().is_infinite(),
            release,
            kind: hand.release().map_or(ReleaseKind::Strength, |release| release.kind),
            start: *path.start(),
            legs: legs.collect(),
            tremor: hand.tremor().map(|tremor| [tremor.amplitude, TAU * tremor.frequency_hz]),
        }
    }

    /// Several scenarios side by side; none if the kinds of their releases or the shapes of their paths differ.
    pub(crate) fn gather<S: Real>(of: &[&Self]) -> Option<SteppedHand<N, S>> {
        let first = of.first()?;
        let shares = |one: &&Self| {
            let kinds = |hand: &Self| {
                let regrasps = hand.release.as_ref().map(|release| release.has_regrasp);
                (hand.kind, hand.legs.len(), regrasps, hand.tremor.is_some())
            };
            kinds(one) == kinds(first) && one.legs.iter().zip(&first.legs).all(|(a, b)| a.shape == b.shape)
        };
        if of.len() != S::LANES || !of.iter().all(shares) {
            return None;
        }
        let leg = |index: usize| {
            let times =
                |time: fn(&SteppedLeg<N, f64>) -> f64| of.iter().map(move |one| time(&one.legs[index]));
            SteppedLeg {
                begins: gather(of, |one| one.legs[index].begins),
                rate: gather(of, |one| one.legs[index].rate),
                displacement: gather_axes(of, |one| one.legs[index].displacement),
                shape: first.legs[index].shape,
                powers: first.legs[index].powers,
                earliest: times(|leg| leg.earliest).fold(f64::INFINITY, f64::min),
                latest: times(|leg| leg.latest).fold(f64::NEG_INFINITY, f64::max),
            }
        };
        let releases = |time: fn(&SteppedRelease<f64>) -> f64| {
            of.iter().filter_map(|one| one.release.as_ref()).map(time)
        };
        let release = |field: fn(&SteppedRelease<f64>) -> f64| {
            gather(of, |one| one.release.as_ref().map_or(0.0, field))
        };
        let tremor = |which: usize| gather(of, |one| one.tremor.map_or(0.0, |tremor| tremor[which]));
        Some(SteppedHand {
            stiffness: gather(of, |one| one.stiffness),
            damping: gather(of, |one| one.damping),
            strength_n: gather(of, |one| one.strength_n),
            is_unbounded: of.iter().all(|one| one.is_unbounded),
            release: first.release.as_ref().map(|of_first| SteppedRelease {
                earliest: releases(|release| release.earliest).fold(f64::INFINITY, f64::min),
                latest: releases(|release| release.latest).fold(f64::NEG_INFINITY, f64::max),
                at: release(|release| release.at),
                ends: release(|release| release.ends),
                falls: release(|release| release.falls),
                regrips: release(|release| release.regrips),
                full: release(|release| release.full),
                rises: release(|release| release.rises),
                has_regrasp: of_first.has_regrasp,
            }),
            kind: first.kind,
            start: gather_axes(of, |one| one.start),
            legs: (0..first.legs.len()).map(leg).collect(),
            tremor: first.tremor.map(|_| [tremor(0), tremor(1)]),
        })
    }
}

impl<const N: usize, S: Real> SteppedHand<N, S> {
    /// Force in N on a device at x in m with V in m/s, at time t in s.
    #[inline(always)]
    pub(crate) fn force(&self, t: f64, position: &Axes<N, S>, velocity: &Axes<N, S>) -> Axes<N, S> {
        // Steps are products of seconds: what is within half a ns of a time is at that time.
        if self.release.as_ref().is_some_and(|release| t + HALF_NS >= release.latest) {
            return Axes::zeros();
        }
        let wish = (self.target(t) - position) * self.stiffness - velocity * self.damping;
        let Some(grip) = self.grip(t) else {
            return self.bounded(wish, self.strength_n);
        };
        let mut force = match self.kind {
            ReleaseKind::Gain => self.bounded(wish * grip, self.strength_n),
            ReleaseKind::Strength => self.bounded(wish, self.strength_n * grip),
        };
        // Not -0.0, which it would be from one that has let go while another holds.
        let nothing = S::splat(0.0);
        for axis in 0..N {
            force[axis] = nothing.select(grip.simd_eq(nothing), force[axis]);
        }
        force
    }

    /// A force no stronger than the grip.
    #[inline(always)]
    fn bounded(&self, mut wish: Axes<N, S>, strength: S) -> Axes<N, S> {
        if self.is_unbounded {
            return wish;
        }
        if N == 1 {
            wish[0] = wish[0].simd_clamp(-strength, strength);
            return wish;
        }
        let norm = wish.dot(&wish).root();
        wish * S::splat(1.0).select(norm.simd_le(strength), strength / norm)
    }

    #[inline(always)]
    fn target(&self, t: f64) -> Axes<N, S> {
        let (zero, one) = (S::splat(0.0), S::splat(1.0));
        let mut target = self.start;
        for leg in &self.legs {
            if t < leg.earliest {
                // So have not those that follow.
                break;
            }
            if t > leg.latest {
                target += leg.displacement;
                continue;
            }
            let s = ((S::splat(t) - leg.begins) * leg.rate).simd_clamp(zero, one);
            let (first, after) = leg.powers;
            let mut share = S::splat(leg.shape[after - 1]);
            for term in leg.shape[first..after - 1].iter().rev() {
                share = share * s + S::splat(*term);
            }
            for _ in 0..first {
                share *= s;
            }
            target += leg.displacement * share;
        }
        if let Some([amplitude, rate]) = self.tremor {
            let shake = amplitude * (rate * S::splat(t)).map_lanes(f64::sin);
            target.add_scalar_mut(shake);
        }
        target
    }

    /// The share of the grip; none where it never changes, or has not begun to.
    #[inline(always)]
    fn grip(&self, t: f64) -> Option<S> {
        let release = self.release.as_ref()?;
        let (zero, one, time) = (S::splat(0.0), S::splat(1.0), S::splat(t));
        if t + HALF_NS < release.earliest {
            return None;
        }
        let now = S::splat(t + HALF_NS);
        let falling = one - (time - release.at) * release.falls;
        let held = one
            .select(now.simd_lt(release.at), zero.select(now.simd_ge(release.ends), falling.simd_min(one)));
        if !release.has_regrasp {
            return Some(held);
        }
        let rising = (time - release.regrips) * release.rises;
        let regained =
            zero.select(now.simd_lt(release.regrips), one.select(now.simd_ge(release.full), rising));
        Some(held.simd_max(regained))
    }
}
