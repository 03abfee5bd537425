//! Translation of a slave's endpoint: from the master's position to the commanded position, for one arm or
//! for several in SIMD lanes.

use haptether_numeric::pack;
use haptether_safety::{Axes, Real, Signal, Track, is_within, norm};
use nalgebra::SimdBool as _;

use super::{Arm, EndpointError, SlaveSettings, check_period, period_s};
use crate::{
    coupling::{CoupledSlave, Mapping, OfHalf, OfMaster, Room, bounded, capped, decayed},
    ladder::LadderState,
    wire::unpadded,
};

/// Number of successive accepted samples that confirm the newest: more than the guard counts as outliers.
const CONFIRMING: u32 = 4;

/// Inputs of a tick beside the position of the arm.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TranslationInput<'a, const N: usize, S: Real = f64> {
    pub(crate) state: LadderState,
    /// Time in ns that the ladder has been in STALE.
    pub(crate) stale_ns: u64,
    /// x in m and V in m/s of the master in the newest frame; none before the first.
    pub(crate) newest: Option<[&'a Axes<N, S>; 2]>,
}

/// Motion of the commanded position.
#[derive(Clone, Copy, Debug)]
pub(crate) struct CommandMotion<const N: usize, S: Real = f64> {
    /// Velocity of the command in m/s.
    pub(crate) velocity: Axes<N, S>,
    /// Masks of the lanes in which the bounds on speed and on reach limited the command.
    pub(crate) limited: [S::SimdBool; 2],
    /// Time in s by which the command is extrapolated beyond the newest frame, and remaining share of the
    /// velocity.
    pub(crate) extrapolated: (f64, f64),
}

/// Position coupling of an arm and its bounds, with the state after the last tick.
#[derive(Clone, Debug)]
pub(crate) struct SlaveTranslation<const N: usize, S = f64> {
    coupling: Mapping<N, S>,
    /// Bounds on the command: speed in m/s, and distance in m from home.
    bounds: [S; 2],
    /// Speed in m/s that the arm's own braking adds to the command's; the speed bound includes it.
    braking: f64,
    /// Time in ns of STALE over which the commanded velocity decays.
    decay_ns: u64,
    /// Successive accepted samples up to the newest.
    accepted: u32,
    /// Position in m of the first confirmed sample since the start or an acknowledged fault of the arm.
    home: Option<Axes<N, S>>,
    command: Option<Axes<N, S>>,
    /// Time in ns of the last command.
    commanded_ns: u64,
    /// Time in ns of the last sample.
    sampled_ns: Option<u64>,
    /// Path of the samples, and the last velocity; only for lanes, because a single arm has its own guard.
    path: Option<(Track<N, S>, Option<Axes<N, S>>)>,
    /// Period of the loop in s.
    period_s: f64,
}

impl<const N: usize> SlaveTranslation<N> {
    pub(super) fn new(settings: &SlaveSettings) -> Result<Self, EndpointError> {
        check_period(settings.period_ns)?;
        settings.bounds.check()?;
        Ok(Self {
            coupling: Mapping::new(settings.position_scale, 1.0)?,
            bounds: [settings.bounds.speed, settings.bounds.reach],
            braking: 0.0,
            decay_ns: settings.ladder.extrapolate_ns,
            accepted: 0,
            home: None,
            command: None,
            commanded_ns: 0,
            sampled_ns: None,
            path: None,
            period_s: period_s(settings.period_ns),
        })
    }

    /// Set the `speed` in m/s of the arm's own braking. Commands get the rest of the speed bound.
    pub(super) fn set_braking(&mut self, speed: f64) {
        self.braking = speed;
    }
}

impl<const N: usize> SlaveTranslation<N> {
    /// Step one tick of a coupling whose force acts on a virtual tool, or on the arm. `position` in m and velocity in m/s are
    /// those of the arm, `environment_force` in N pushes it.
    ///
    /// Also returns the work in J of that force on the tool. Returns `None` unless coupled, like
    /// [`follow`](Self::follow). A late command is not extrapolated: the spring holds the newest position.
    pub(super) fn push(
        &mut self,
        now_ns: u64,
        [position, measured, environment_force]: [&Axes<N>; 3],
        input: &TranslationInput<'_, N>,
        coupled: &mut CoupledSlave<N>,
        half: &OfHalf<'_>,
    ) -> Option<(CommandMotion<N>, f64)> {
        let (elapsed_s, home) = self.begin(now_ns, position);
        let TranslationInput { state, newest, .. } = *input;
        let (LadderState::Engaged | LadderState::Stale, Some([at, velocity])) = (state, newest) else {
            self.coupling.disengage();
            coupled.disengage();
            return None;
        };
        let takes_force = coupled.takes_force();
        let from = self.command.filter(|_| !takes_force).unwrap_or(*position);
        let bounds @ [max_speed, _] = self.bounds();
        let room = Room { away: &(position - home), velocity: measured, bounds };
        // A late loop must not make the spring unstable: the tool then moves for one period.
        let dt = self.period_s;
        let master = OfMaster { at, velocity, force: &unpadded(half.force), half: *half };
        let wanted = coupled.step(&mut self.coupling, &from, (&room, environment_force), &master, dt);
        if let Some((_, limited)) = coupled.exerted() {
            self.command = Some(wanted);
            let motion = CommandMotion { velocity: *measured, limited, extrapolated: (0.0, 1.0) };
            return Some((motion, coupled.work_j()));
        }
        let (command, limited @ [hurries, leaves]) = bounded(bounds, elapsed_s, &home, &from, &wanted);
        if hurries || leaves {
            coupled.tool().limit([&wanted, &command], max_speed, leaves);
        }
        self.command = Some(command);
        let velocity = capped(coupled.tool().velocity(), max_speed);
        Some((CommandMotion { velocity, limited, extrapolated: (0.0, 1.0) }, coupled.work_j()))
    }
}

impl<const N: usize, S: Real> SlaveTranslation<N, S> {
    /// Gather several arms into lanes. Returns `None` if one of them has had a sample, if they differ in
    /// period, decay, braking, map or sample bounds, or if they are more than the lanes.
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
            coupling: Mapping::gather(&of.iter().map(|one| &one.coupling).collect::<Vec<_>>())?,
            bounds: [pack(of, |one| one.bounds[0])?, pack(of, |one| one.bounds[1])?],
            braking,
            decay_ns,
            accepted: 0,
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

    /// Record a sample at `now_ns`; return the ticks since the sample before it, at least 1.
    #[inline(always)] // once per tick
    pub(super) fn sampled(&mut self, now_ns: u64) -> f64 {
        let Some(last_ns) = self.sampled_ns.replace(now_ns) else { return 1.0 };
        (now_ns.saturating_sub(last_ns) as f64 * 1e-9).max(self.period_s) / self.period_s
    }

    /// Record a sample of each lane. Returns the mask of lanes in which [`Arm::check`] would accept it: it is
    /// valid and continues the [`Track`] of the samples before it.
    #[inline(always)] // once per tick
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
                passes = passes & track.is_steady(&last, velocity);
            }
            passes = passes & track.step(position, ticks);
        }
        // This counts for all lanes, because the caller discards the lanes that do not pass.
        self.accepts(true);
        passes
    }

    /// Record whether the newest sample is accepted: valid and not held.
    #[inline]
    pub(super) fn accepts(&mut self, accepted: bool) {
        self.accepted = if accepted { self.accepted.saturating_add(1) } else { 0 };
    }

    /// Return whether the last [`CONFIRMING`] samples were all accepted.
    #[inline]
    pub(super) fn is_confirmed(&self) -> bool {
        self.accepted >= CONFIRMING
    }

    /// Forget home: the next confirmed sample becomes home.
    pub(super) fn forget_home(&mut self) {
        self.home = None;
    }

    /// Begin a tick of an arm at `position` in m; return the time in s since the last command, and home.
    #[inline(always)] // once per tick
    fn begin(&mut self, now_ns: u64, position: &Axes<N, S>) -> (f64, Axes<N, S>) {
        let elapsed_s = self.elapsed_s(now_ns);
        self.commanded_ns = now_ns;
        if self.home.is_none() && self.is_confirmed() {
            self.home = Some(*position);
        }
        // No live side engages before its start is confirmed; a run in virtual time may.
        (elapsed_s, self.home.unwrap_or(*position))
    }

    /// Bounds on the command: speed in m/s that the arm's braking leaves, and distance in m from home.
    #[inline(always)] // once per tick
    fn bounds(&self) -> [S; 2] {
        let [speed, reach] = self.bounds;
        [(speed - S::splat(self.braking)).larger(S::zero()), reach]
    }

    /// Step one tick of an arm at `position` in m.
    ///
    /// Returns `None` unless coupled: the arm then holds the last command, and the next engagement starts
    /// from the positions at that time.
    #[inline(always)] // once per tick, from few callers
    pub(crate) fn follow(
        &mut self,
        now_ns: u64,
        position: &Axes<N, S>,
        input: &TranslationInput<'_, N, S>,
    ) -> Option<CommandMotion<N, S>> {
        let (elapsed_s, home) = self.begin(now_ns, position);
        let TranslationInput { state, stale_ns, newest } = *input;
        let (LadderState::Engaged | LadderState::Stale, Some([master, velocity])) = (state, newest) else {
            self.coupling.disengage();
            return None;
        };
        // The step starts at the last command; contact may have displaced the arm from it.
        let from = self.command.unwrap_or(*position);
        let (ahead_s, share) = decayed(stale_ns, self.decay_ns);
        let velocity = self.coupling.commanded_velocity(velocity);
        // If a coupling starts while frames are late, its anchor leaves out the extrapolation that is added
        // here. So its first command equals the last one.
        let ahead = velocity * S::splat(ahead_s);
        let wanted = self.coupling.commanded_position(master, &(from - ahead)) + ahead;
        let bounds @ [max_speed, _] = self.bounds();
        let (command, [mut hurries, leaves]) = bounded(bounds, elapsed_s, &home, &from, &wanted);
        let mut velocity = velocity * S::splat(share);
        let speed = norm(&velocity);
        let is_fast = speed.simd_gt(max_speed);
        if is_fast.any() {
            velocity *= (max_speed / speed).select(is_fast, S::one());
            hurries = hurries | is_fast;
        }
        self.command = Some(command);
        Some(CommandMotion { velocity, limited: [hurries, leaves], extrapolated: (ahead_s, share) })
    }

    /// End the coupling: the next engagement starts from the positions at that time.
    pub(crate) fn disengage(&mut self) {
        self.coupling.disengage();
    }

    /// Record that the arm stops following and comes to rest at `rest` in m; the next engagement continues
    /// from there. With `None` the position is unknown, and there is no command until the next engagement.
    /// An arm without a command stays without one.
    pub(crate) fn set_rest(&mut self, rest: Option<Axes<N, S>>) {
        self.command = self.command.and(rest);
    }

    pub(crate) fn coupling(&mut self) -> &mut Mapping<N, S> {
        &mut self.coupling
    }

    /// Last commanded position in m; none before the first engagement.
    #[inline]
    pub(crate) fn last_command(&self) -> Option<Axes<N, S>> {
        self.command
    }

    /// Command `position` in m if there is no command yet.
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
        let mut arm = SlaveTranslation::new(&settings).unwrap();
        (0..CONFIRMING).for_each(|_| arm.accepts(true));
        arm
    }

    /// Closed form with T = 20 ms: `v / V = 1 - t / T` and `d / V = t - t² / (2 T)`, where V is twice the
    /// master's velocity.
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
            let led = arm.follow(1_000_000 * (tick as u64 + 1), &position, &input).unwrap();
            assert!((led.velocity[0] - 0.5 * share).abs() < 1e-15, "{stale_ns}: {}", led.velocity);
            let command = arm.last_command().unwrap()[0];
            assert!((command - 0.3 - 0.5 * ahead_s).abs() < 1e-15, "{stale_ns}: {command}");
            assert_eq!(led.limited, [false; 2]);
        }
        // The speed bound limits the velocity, like the position.
        let mut slow = translation(0.2);
        let input = TranslationInput { state: LadderState::Engaged, stale_ns: 0, newest: Some([&x, &v]) };
        let led = slow.follow(1_000_000, &position, &input).unwrap();
        assert!((led.velocity[0] - 0.2).abs() < 1e-15 && led.limited == [true, false], "{led:?}");
    }
}
