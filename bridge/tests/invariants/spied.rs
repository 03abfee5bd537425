//! Both sides, with every tick held against what must never be.

use std::{cell::RefCell, rc::Rc};

use haptether_bridge::{
    Exchange, LadderState, LinkTime, MasterPlant, MasterRecord, MasterSide, OperatorCommand, RejectReason,
    Side, SlavePlant, SlaveRecord, SlaveSide, TickTime,
    coupling::{CommandBounds, CouplingError},
    wire::{Frame, FrameLayout, MAX_FRAME, Role},
};
use haptether_safety::{Acted, Axes, LimiterSettings};

use crate::plant::Plant;

/// Rounding of sums of a few numbers of their size.
const ROUNDING: f64 = 1e-9;

/// What was seen of all runs: a test in which nothing happens proves nothing.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Seen {
    /// Ticks in each state of the ladder, at the master and at the slave.
    pub(crate) ticks: [[u64; 7]; 2],
    pub(crate) engagements: [u64; 2],
    pub(crate) growth_limited: u64,
    pub(crate) commands_limited: u64,
    pub(crate) soft_stops: u64,
    pub(crate) accepted: u64,
    pub(crate) authentic: u64,
    pub(crate) refused: u64,
}

impl Seen {
    /// What was seen here and there.
    pub(crate) fn and(&self, other: &Self) -> Self {
        let sum =
            |side: usize| std::array::from_fn(|state| self.ticks[side][state] + other.ticks[side][state]);
        Self {
            ticks: [sum(0), sum(1)],
            engagements: std::array::from_fn(|side| self.engagements[side] + other.engagements[side]),
            growth_limited: self.growth_limited + other.growth_limited,
            commands_limited: self.commands_limited + other.commands_limited,
            soft_stops: self.soft_stops + other.soft_stops,
            accepted: self.accepted + other.accepted,
            authentic: self.authentic + other.authentic,
            refused: self.refused + other.refused,
        }
    }
}

/// What both sides are held to.
#[derive(Clone, Debug)]
struct Watch {
    side: usize,
    state: LadderState,
    gain: f64,
    clock_ns: Option<u64>,
    holds: u64,
    /// Whether the clutch was seen open, and then closed, since the last hold began.
    opened: bool,
    pressed: bool,
    /// Run and sequence of the newest frame that was acted on.
    newest: Option<(u64, u64)>,
    commands: Vec<(u64, OperatorCommand)>,
    /// What either side has sent, where a session must let nothing else through.
    sent: Option<Sent>,
    seen: Seen,
    wrong: Option<String>,
}

/// The frames of the master and of the slave, by sequence.
pub(crate) type Sent = Rc<RefCell<[Vec<Vec<u8>>; 2]>>;

impl Watch {
    fn new(side: usize, commands: Vec<(u64, OperatorCommand)>, sent: Option<Sent>) -> Self {
        let state = LadderState::Disengaged;
        Self {
            side,
            state,
            gain: 0.0,
            clock_ns: None,
            holds: 0,
            opened: true,
            pressed: false,
            newest: None,
            commands,
            sent,
            seen: Seen::default(),
            wrong: None,
        }
    }

    fn hold(&mut self, holds: bool, time: TickTime, what: impl FnOnce() -> String) {
        if !holds && self.wrong.is_none() {
            let side = ["master", "slave"][self.side];
            self.wrong = Some(format!("{side} at {:.3} ms: {}", time.now_ns as f64 * 1e-6, what()));
        }
    }

    fn send(&mut self, frame: &[u8]) {
        if let Some(sent) = &self.sent {
            sent.borrow_mut()[self.side].push(frame.to_vec());
        }
    }

    /// The frame that a side took must be newer than what it had and, in a session, one that the peer sent.
    fn accepted<const N: usize>(&mut self, now_ns: u64, datagram: &[u8], taken: bool, layout: FrameLayout) {
        if !taken {
            self.seen.refused += 1;
            return;
        }
        self.seen.accepted += 1;
        let time = TickTime::at(now_ns);
        let from = [Role::Slave, Role::Master][self.side];
        let Ok(frame) = Frame::<N>::decode(datagram, from, layout) else {
            return self.hold(false, time, || "acted on what is no frame".into());
        };
        if let Some(sent) = &self.sent {
            #[allow(clippy::cast_possible_truncation)] // a count of what is in memory
            let is_sent = sent.borrow()[1 - self.side]
                .get(frame.sequence as usize)
                .is_some_and(|sent| sent == datagram);
            self.hold(is_sent, time, || format!("acted on {}, which the peer never sent", frame.sequence));
            self.seen.authentic += 1;
        }
        let newest = self.newest.replace((frame.run_id, frame.sequence));
        // In the clear, who repairs the checksum may well feign another session once the peer is silent.
        let may_change = self.sent.is_none();
        let newer =
            newest.is_none_or(
                |(run_id, sequence)| {
                    if run_id == frame.run_id { sequence < frame.sequence } else { may_change }
                },
            );
        self.hold(newer, time, || format!("acted on {} after {newest:?}", frame.sequence));
    }

    /// What holds of the ladder at a side; gives the state before.
    fn ladder(
        &mut self,
        time: TickTime,
        state: LadderState,
        gain: f64,
        holds: u64,
        clutch: bool,
    ) -> LadderState {
        let before = std::mem::replace(&mut self.state, state);
        let elapsed_ns = time.clock_ns - self.clock_ns.replace(time.clock_ns).unwrap_or(time.clock_ns);
        let rise = gain - std::mem::replace(&mut self.gain, gain);
        self.seen.ticks[self.side][usize::from(state.code())] += 1;
        self.hold((0.0..=1.0).contains(&gain), time, || format!("gain {gain}"));
        self.hold(rise <= elapsed_ns as f64 / 200e6 + ROUNDING, time, || format!("gain rose by {rise}"));
        self.hold(rise <= 0.0 || state == LadderState::Engaged, time, || {
            format!("gain rose by {rise} in {state:?}")
        });
        let dead = matches!(state, LadderState::Stop | LadderState::Fault);
        self.hold(!dead || gain == 0.0, time, || format!("gain {gain} in {state:?}"));
        if clutch {
            self.pressed |= self.opened;
        } else {
            (self.opened, self.pressed) = (true, false);
        }
        if state.is_coupled() && !before.is_coupled() {
            self.seen.engagements[self.side] += 1;
            let pressed = self.pressed && self.holds == holds;
            self.hold(pressed, time, || format!("{before:?} to {state:?} without a press after a release"));
        }
        if holds > self.holds || state == LadderState::Fault {
            (self.opened, self.pressed) = (false, false);
        }
        self.holds = holds;
        before
    }
}

/// The side of the hand, watched.
#[derive(Clone, Debug)]
pub(crate) struct Near<P, const N: usize> {
    side: MasterSide<Plant<P, N>, N>,
    watch: Watch,
    limiter: LimiterSettings,
    period_s: f64,
    force: Axes<N>,
}

/// The side of the robot, watched.
#[derive(Clone, Debug)]
pub(crate) struct Far<P, const N: usize> {
    side: SlaveSide<Plant<P, N>, N>,
    watch: Watch,
    bounds: CommandBounds,
    home: Option<Axes<N>>,
    command: Option<Axes<N>>,
    clock_ns: u64,
}

impl<P: MasterPlant<N>, const N: usize> Near<P, N> {
    pub(crate) fn new(
        side: MasterSide<Plant<P, N>, N>,
        limiter: LimiterSettings,
        period_ns: u64,
        commands: Vec<(u64, OperatorCommand)>,
        sent: Option<Sent>,
    ) -> Self {
        let period_s = period_ns as f64 * 1e-9;
        Self { side, watch: Watch::new(0, commands, sent), limiter, period_s, force: Axes::zeros() }
    }

    pub(crate) fn verdict(self) -> Result<Seen, String> {
        self.watch.wrong.map_or(Ok(self.watch.seen), Err)
    }

    /// Norm and growth of the force. Unloading is free; the growth is exceeded only by what the power bound takes.
    fn force(&mut self, time: TickTime, record: &MasterRecord<N>) {
        let last = std::mem::replace(&mut self.force, record.device_force);
        let force = self.force;
        let LimiterSettings { max_force_n, max_slew_n_per_s, .. } = self.limiter;
        self.watch
            .hold(force.norm() <= max_force_n * (1.0 + ROUNDING), time, || format!("force {}", force.norm()));
        let squared = last.norm_squared();
        let share = if squared > 0.0 { (last.dot(&force) / squared).clamp(0.0, 1.0) } else { 0.0 };
        let growth = (force - last * share).norm();
        let most = max_slew_n_per_s * self.period_s;
        let by_power = record.acted & Acted::POWER.bits() != 0;
        self.watch.seen.growth_limited += u64::from(record.acted & Acted::SLEW.bits() != 0);
        self.watch.hold(by_power || growth <= most * (1.0 + ROUNDING), time, || {
            format!("growth {growth} > {most}")
        });
        let dead = self.watch.gain == 0.0;
        self.watch
            .hold(!dead || force.norm() == 0.0, time, || format!("force {} without gain", force.norm()));
        let written = self.side.plant.written.map(|[force, _]| force);
        self.watch.hold(written == Some(force), time, || format!("recorded {force:?}, written {written:?}"));
    }
}

impl<P: SlavePlant<N>, const N: usize> Far<P, N> {
    pub(crate) fn new(
        side: SlaveSide<Plant<P, N>, N>,
        bounds: CommandBounds,
        commands: Vec<(u64, OperatorCommand)>,
        sent: Option<Sent>,
    ) -> Self {
        Self { side, watch: Watch::new(1, commands, sent), bounds, home: None, command: None, clock_ns: 0 }
    }

    pub(crate) fn verdict(self) -> Result<Seen, String> {
        self.watch.wrong.map_or(Ok(self.watch.seen), Err)
    }

    /// What is commanded: nothing moves but while coupled, and then no faster and no further than it may.
    fn command(&mut self, time: TickTime, state: LadderState, stops: bool) {
        let command = self.side.endpoint.last_command();
        let before = std::mem::replace(&mut self.command, command);
        let elapsed_s = (time.clock_ns - std::mem::replace(&mut self.clock_ns, time.clock_ns)) as f64 * 1e-9;
        let CommandBounds { speed, reach } = self.bounds;
        let written = self.side.plant.written.take();
        let stopped = matches!(state, LadderState::Stop | LadderState::Fault);
        self.watch
            .hold(!(stopped && written.is_some()), time, || format!("written {written:?} in {state:?}"));
        if let Some([position, velocity]) = written {
            self.watch
                .hold(Some(position) == command, time, || format!("{position:?} written, not {command:?}"));
            let most = if state.is_coupled() { speed * (1.0 + ROUNDING) } else { 0.0 };
            self.watch
                .hold(velocity.norm() <= most, time, || format!("velocity {} in {state:?}", velocity.norm()));
        }
        let Some((before, command)) = before.zip(command) else { return };
        let step = (command - before).norm();
        if state.is_coupled() {
            let most = speed * elapsed_s * (1.0 + ROUNDING) + 1e-12;
            self.watch.hold(step <= most, time, || format!("commanded step {step} > {most} in {state:?}"));
            let out = self.home.map_or(0.0, |home| (command - home).norm());
            // A stop may have come to rest outside: it is led back, never further out.
            let was_out = self.home.map_or(0.0, |home| (before - home).norm());
            let most = reach.max(was_out) * (1.0 + ROUNDING);
            self.watch.hold(out <= most, time, || format!("commanded {out} m out, beyond {most}"));
        } else if !stops {
            self.watch.hold(step == 0.0, time, || format!("commanded step {step} in {state:?}"));
        }
    }
}

impl<P: MasterPlant<N>, const N: usize> Side<N> for Near<P, N> {
    type Record = MasterRecord<N>;

    fn begin(&mut self, now_ns: u64) {
        self.side.begin(now_ns);
    }

    fn receive(&mut self, time: LinkTime, datagram: &[u8]) -> Result<(), RejectReason> {
        let taken = self.side.receive(time, datagram);
        let layout = self.side.exchange().link().layout();
        self.watch.accepted::<N>(time.tick_ns, datagram, taken.is_ok(), layout);
        taken
    }

    fn tick(&mut self, time: TickTime) -> MasterRecord<N> {
        act(&mut self.side, &mut self.watch, time);
        let record = self.side.tick(time);
        let ladder = self.side.exchange().ladder();
        let (gain, holds) = (ladder.gain(), ladder.holds());
        self.watch.ladder(time, record.state, gain, holds, record.clutch);
        self.force(time, &record);
        record
    }

    fn send<'a>(&mut self, time: LinkTime, buffer: &'a mut [u8; MAX_FRAME]) -> &'a [u8] {
        let frame = self.side.send(time, buffer);
        self.watch.send(frame);
        frame
    }

    fn rest(&mut self) {
        self.side.rest();
    }

    fn command(&mut self, now_ns: u64, command: OperatorCommand) -> Result<bool, CouplingError> {
        self.side.command(now_ns, command)
    }

    fn exchange(&self) -> &Exchange<N> {
        self.side.exchange()
    }

    fn exchange_mut(&mut self) -> &mut Exchange<N> {
        self.side.exchange_mut()
    }
}

impl<P: SlavePlant<N>, const N: usize> Side<N> for Far<P, N> {
    type Record = SlaveRecord<N>;

    fn begin(&mut self, now_ns: u64) {
        self.side.begin(now_ns);
    }

    fn receive(&mut self, time: LinkTime, datagram: &[u8]) -> Result<(), RejectReason> {
        let taken = self.side.receive(time, datagram);
        let layout = self.side.exchange().link().layout();
        self.watch.accepted::<N>(time.tick_ns, datagram, taken.is_ok(), layout);
        taken
    }

    fn tick(&mut self, time: TickTime) -> SlaveRecord<N> {
        act(&mut self.side, &mut self.watch, time);
        let stops = self.side.plant.stops;
        let record = self.side.tick(time);
        let ladder = self.side.exchange().ladder();
        let (gain, holds) = (ladder.gain(), ladder.holds());
        let before = self.watch.ladder(time, record.state, gain, holds, record.clutch);
        self.home.get_or_insert(record.position);
        let stopped = self.side.plant.stops - stops;
        let dead = |state| matches!(state, LadderState::Stop | LadderState::Fault);
        let due = dead(record.state) && !dead(before) || before.is_coupled() && !record.state.is_coupled();
        self.watch.hold(stopped == u64::from(due), time, || format!("stopped {stopped} times, due {due}"));
        self.watch.seen.soft_stops += stopped;
        self.watch.seen.commands_limited += u64::from(record.limited != 0);
        self.command(time, record.state, stopped > 0);
        record
    }

    fn send<'a>(&mut self, time: LinkTime, buffer: &'a mut [u8; MAX_FRAME]) -> &'a [u8] {
        let frame = self.side.send(time, buffer);
        self.watch.send(frame);
        frame
    }

    fn rest(&mut self) {
        self.side.rest();
    }

    fn command(&mut self, now_ns: u64, command: OperatorCommand) -> Result<bool, CouplingError> {
        self.side.command(now_ns, command)
    }

    fn exchange(&self) -> &Exchange<N> {
        self.side.exchange()
    }

    fn exchange_mut(&mut self) -> &mut Exchange<N> {
        self.side.exchange_mut()
    }
}

/// Does at a side what people do there by the time of a tick.
fn act<const N: usize>(side: &mut impl Side<N>, watch: &mut Watch, time: TickTime) {
    let due = watch.commands.iter().take_while(|(at_ns, _)| *at_ns <= time.now_ns).count();
    for (_, command) in watch.commands.drain(..due) {
        let done = side.command(time.clock_ns, command);
        if done.is_err() {
            watch.wrong.get_or_insert_with(|| format!("{command:?}: {done:?}"));
        }
    }
}
