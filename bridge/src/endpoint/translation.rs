//! The translation of a slave's endpoint: from the master's position to the one that the arm is to take, of one arm or of
//! several side by side.

use haptether_safety::{Axes, Real, Signal, Track, is_within, norm};
use nalgebra::SimdBool as _;

use super::{Arm, EndpointError, SlaveSettings, check_period, period_s};
use crate::{
    coupling::{PositionForce, bounded, decayed},
    ladder::LadderState,
    lanes::packed,
};

/// What decides over the command of a tick beside where the arm is.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TranslationInput<'a, const N: usize, S: Real = f64> {
    /// Where the ladder stands.
    pub(crate) state: LadderState,
    /// For how long in ns the ladder has stood in STALE.
    pub(crate) stale_ns: u64,
    /// x in m and V in m/s of the master, of the newest frame; none before the first.
    pub(crate) newest: Option<[&'a Axes<N, S>; 2]>,
}

/// How the commanded position goes on.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Led<const N: usize, S: Real = f64> {
    /// Its velocity in m/s.
    pub(crate) velocity: Axes<N, S>,
    /// Where the bounds on speed and reach acted.
    pub(crate) limited: [S::SimdBool; 2],
    /// By how many s of its velocity the command goes ahead of the newest frame, and the share of the velocity that is left.
    pub(crate) extrapolated: (f64, f64),
}

/// Coupling and bounds of the position of an arm, with what they have to know of the last tick.
#[derive(Clone, Debug)]
pub(crate) struct SlaveTranslation<const N: usize, S = f64> {
    coupling: PositionForce<N, S>,
    /// Bounds on the command: speed in m/s, and distance in m from where the slave began.
    bounds: [S; 2],
    /// Speed in m/s with which the arm still brakes besides.
    braking: f64,
    /// Over how long in ns of STALE the commanded velocity decays.
    decay_ns: u64,
    /// Where the slave stood at its first tick.
    home: Option<Axes<N, S>>,
    command: Option<Axes<N, S>>,
    /// When the last command was made, in ns.
    commanded_ns: u64,
    /// When in ns the last sample was.
    sampled_ns: Option<u64>,
    /// The path of the samples and the last velocity, of lanes.
    path: Option<(Track<N, S>, Option<Axes<N, S>>)>,
    /// The period of its loop, in s.
    period_s: f64,
}

impl<const N: usize> SlaveTranslation<N> {
    pub(super) fn new(settings: &SlaveSettings) -> Result<Self, EndpointError> {
        check_period(settings.period_ns)?;
        settings.bounds.check()?;
        Ok(Self {
            coupling: PositionForce::new(settings.position_scale, 1.0)?,
            bounds: [settings.bounds.speed, settings.bounds.reach],
            braking: 0.0,
            decay_ns: settings.ladder.extrapolate_ns,
            home: None,
            command: None,
            commanded_ns: 0,
            sampled_ns: None,
            path: None,
            period_s: period_s(settings.period_ns),
        })
    }

    /// The arm still brakes with `speed` in m/s.
    pub(super) fn set_braking(&mut self, speed: f64) {
        self.braking = speed;
    }
}

impl<const N: usize, S: Real> SlaveTranslation<N, S> {
    /// Those of several arms side by side, before their first tick; None unless period, decay, braking and map
    /// are the same.
    pub(crate) fn gather(arms: &[&Arm<N>]) -> Option<Self> {
        let of = &arms.iter().map(|arm| arm.translation()).collect::<Vec<_>>()[..];
        let track = Track::gather(&arms.iter().map(|arm| arm.guard().track()).collect::<Vec<_>>())?;
        let SlaveTranslation { braking, decay_ns, period_s, .. } = **of.first()?;
        let begins_so = |one: &&SlaveTranslation<N>| {
            one.sampled_ns.is_none()
                && one.decay_ns == decay_ns
                && one.period_s.to_bits() == period_s.to_bits()
                && one.braking.to_bits() == braking.to_bits()
        };
        if !of.iter().all(begins_so) {
            return None;
        }
        Some(Self {
            coupling: PositionForce::gather(&of.iter().map(|one| &one.coupling).collect::<Vec<_>>())?,
            bounds: [0, 1].map(|which| packed(of, |one| one.bounds[which])),
            braking,
            decay_ns,
            home: None,
            command: None,
            commanded_ns: 0,
            sampled_ns: None,
            path: Some((track, None)),
            period_s,
        })
    }

    /// Time in s since the last command.
    #[inline]
    pub(super) fn elapsed_s(&self, now_ns: u64) -> f64 {
        now_ns.saturating_sub(self.commanded_ns) as f64 * 1e-9
    }

    /// Ticks since the last sample, with one at least for two that follow closely.
    #[inline(always)] // once a tick
    pub(super) fn sampled(&mut self, now_ns: u64) -> f64 {
        let Some(last_ns) = self.sampled_ns.replace(now_ns) else { return 1.0 };
        (now_ns.saturating_sub(last_ns) as f64 * 1e-9).max(self.period_s) / self.period_s
    }

    /// Where the numbers of a sample can be and lie on their path: what [`Arm::check`] would let through.
    #[inline(always)] // once a tick
    pub(crate) fn passes(
        &mut self,
        now_ns: u64,
        [position, velocity, force]: [&Axes<N, S>; 3],
    ) -> S::SimdBool {
        let mut passes = is_within(position, Signal::Position.bound())
            & is_within(velocity, Signal::Velocity.bound())
            & is_within(force, Signal::EnvironmentForce.bound());
        let ticks = S::splat(self.sampled(now_ns));
        if let Some((track, last)) = &mut self.path {
            if let Some(last) = last.replace(*velocity) {
                passes = passes & track.is_steady(&last, velocity, ticks);
            }
            passes = passes & track.step(position, ticks);
        }
        passes
    }

    /// One tick of an arm at `position` in m; `checked`: the sample can be. None where it is not led: it holds the last
    /// command, and when it engages again it does so from where both are then.
    #[inline(always)] // once a tick, from few places
    pub(crate) fn follow(
        &mut self,
        now_ns: u64,
        position: &Axes<N, S>,
        checked: bool,
        input: &TranslationInput<'_, N, S>,
    ) -> Option<Led<N, S>> {
        let elapsed_s = self.elapsed_s(now_ns);
        self.commanded_ns = now_ns;
        // From the first sample that can be: bounds hang on it.
        let home = if checked { *self.home.get_or_insert(*position) } else { *position };
        let TranslationInput { state, stale_ns, newest } = *input;
        let (LadderState::Engaged | LadderState::Stale, Some([master, velocity])) = (state, newest) else {
            self.coupling.disengage();
            return None;
        };
        // From the last command, not from where contact has bent the arm to.
        let from = self.command.unwrap_or(*position);
        let (ahead_s, share) = decayed(stale_ns, self.decay_ns);
        let velocity = self.coupling.commanded_velocity(velocity);
        // Where the two are taken to be coupled anew while frames are late, it has gone ahead already.
        let ahead = velocity * S::splat(ahead_s);
        let wanted = self.coupling.commanded_position(master, &(from - ahead)) + ahead;
        let [speed, reach] = self.bounds;
        let max_speed = (speed - S::splat(self.braking)).larger(S::zero());
        let (command, [mut hurries, leaves]) = bounded([max_speed, reach], elapsed_s, &home, &from, &wanted);
        let mut velocity = velocity * S::splat(share);
        let speed = norm(&velocity);
        let is_fast = speed.simd_gt(max_speed);
        if is_fast.any() {
            velocity *= (max_speed / speed).select(is_fast, S::one());
            hurries = hurries | is_fast;
        }
        self.command = Some(command);
        Some(Led { velocity, limited: [hurries, leaves], extrapolated: (ahead_s, share) })
    }

    /// The two are no longer coupled: when they engage again, it is from where both are then.
    pub(crate) fn disengage(&mut self) {
        self.coupling.disengage();
    }

    /// The arm no longer follows and comes to rest at `rest` in m: when the two engage again, it goes on from there. None
    /// where it does not know where it is: nothing is commanded until the two engage anew.
    pub(crate) fn rests(&mut self, rest: Option<Axes<N, S>>) {
        self.command = self.command.and(rest);
    }

    /// What its coupling is.
    pub(crate) fn coupling(&mut self) -> &mut PositionForce<N, S> {
        &mut self.coupling
    }

    /// The last commanded position in m; none before the first engagement.
    #[inline]
    pub(crate) fn last_command(&self) -> Option<Axes<N, S>> {
        self.command
    }

    /// Commands `position` in m unless something was commanded before.
    pub(super) fn stay_at(&mut self, position: &Axes<N, S>) {
        self.command.get_or_insert(*position);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{LadderSettings, coupling::CommandBounds};

    fn translation(speed: f64) -> SlaveTranslation<1> {
        let ladder = LadderSettings { extrapolate_ns: 20_000_000, ..LadderSettings::default() };
        let bounds = CommandBounds { speed, ..CommandBounds::default() };
        let settings = SlaveSettings { period_ns: 1_000_000, run_id: 1, position_scale: 2.0, bounds, ladder };
        SlaveTranslation::new(&settings).unwrap()
    }

    /// With T = 20 ms, `v / V = 1 - t / T` and `d / V = t - t² / (2 T)` of the velocity of twice the master's: closed form.
    #[test]
    fn a_late_velocity_decays_and_its_position_goes_ahead() {
        let (position, [x, v]) = (Axes::<1>::new(0.3), [0.1, 0.25].map(Axes::<1>::new));
        let mut arm = translation(1e3);
        for (tick, (stale_ns, share, ahead_s)) in
            [(0, 1.0, 0.0), (5_000_000, 0.75, 4.375e-3), (10_000_000, 0.5, 7.5e-3), (90_000_000, 0.0, 0.01)]
                .into_iter()
                .enumerate()
        {
            let state = if stale_ns == 0 { LadderState::Engaged } else { LadderState::Stale };
            let input = TranslationInput { state, stale_ns, newest: Some([&x, &v]) };
            let led = arm.follow(1_000_000 * (tick as u64 + 1), &position, true, &input).unwrap();
            assert!((led.velocity[0] - 0.5 * share).abs() < 1e-15, "{stale_ns}: {}", led.velocity);
            let command = arm.last_command().unwrap()[0];
            assert!((command - 0.3 - 0.5 * ahead_s).abs() < 1e-15, "{stale_ns}: {command}");
            assert_eq!(led.limited, [false; 2]);
        }
        // What it may not do is cut, of the velocity as of the position.
        let mut slow = translation(0.2);
        let input = TranslationInput { state: LadderState::Engaged, stale_ns: 0, newest: Some([&x, &v]) };
        let led = slow.follow(1_000_000, &position, true, &input).unwrap();
        assert!((led.velocity[0] - 0.2).abs() < 1e-15 && led.limited == [true, false], "{led:?}");
    }
}
