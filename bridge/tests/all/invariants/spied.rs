//! Both sides, with invariants checked at every tick.

use std::{
    cell::{Cell, RefCell},
    rc::Rc,
};

use haptether_bridge::{
    ButtonWord, CarriedState, Exchange, LadderState, LinkTime, MasterPlant, MasterRecord, MasterSide,
    MasterTurn, OperatorCommand, PortEnergy, Reason, RejectReason, Side, SlavePlant, SlaveRecord, SlaveSide,
    SlaveTurn, TickTime, WithTriggerFeedback,
    coupling::{CommandBounds, CouplingError},
    wire::{Frame, FrameLayout, MAX_FRAME, Role, unpadded},
};
use haptether_safety::{ActiveLimits, Axes, LimiterSettings};
use nalgebra::{Quaternion, UnitQuaternion};

use super::{
    drawn::Drawn,
    gripped::{DrawnGripper, FingerTickSeen, FingerWatch, GripperWatch, SeenGripper},
    homes::Homes,
    plant::Plant,
    pressed::{ButtonWatch, SeenButtons},
    turned::{OrientationWatch, SeenTurn, TorqueWatch, TurnTick, Wrong},
};

/// Relative rounding error of a sum of a few terms.
pub(crate) const ROUNDING: f64 = 1e-9;

/// Longest interval in ns between frames of a peer that a side accepts as its period.
const MAX_INTERVAL_NS: u64 = 20_000_000;

/// Bit for the bound on the reach in the limits of a command.
const REACH: u8 = 2;

/// Coverage of all runs: a test without events proves nothing.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Seen {
    /// Ticks in each state of the ladder, at the master and at the slave.
    pub(crate) ticks: [[u64; 7]; 2],
    pub(crate) engagements: [u64; 2],
    pub(crate) growth_limited: u64,
    pub(crate) commands_limited: u64,
    pub(crate) soft_stops: u64,
    /// Samples of the arm that were accepted, and that were held.
    pub(crate) samples: [u64; 2],
    pub(crate) accepted: u64,
    pub(crate) authentic: u64,
    pub(crate) refused: u64,
    /// Ticks of master and slave whose work was computed and was not zero, and ticks whose work cannot be computed.
    pub(crate) worked: [u64; 2],
    pub(crate) unknown: [u64; 2],
    pub(crate) turn: SeenTurn,
    pub(crate) buttons: SeenButtons,
    pub(crate) gripper: SeenGripper,
}

impl Seen {
    /// Return the sum of both.
    pub(crate) fn and(&self, other: &Self) -> Self {
        let sum =
            |side: usize| std::array::from_fn(|state| self.ticks[side][state] + other.ticks[side][state]);
        let both = |of: [u64; 2], and: [u64; 2]| std::array::from_fn(|side| of[side] + and[side]);
        Self {
            ticks: [sum(0), sum(1)],
            engagements: both(self.engagements, other.engagements),
            growth_limited: self.growth_limited + other.growth_limited,
            commands_limited: self.commands_limited + other.commands_limited,
            soft_stops: self.soft_stops + other.soft_stops,
            samples: both(self.samples, other.samples),
            accepted: self.accepted + other.accepted,
            authentic: self.authentic + other.authentic,
            refused: self.refused + other.refused,
            worked: both(self.worked, other.worked),
            unknown: both(self.unknown, other.unknown),
            turn: self.turn.and(&other.turn),
            buttons: self.buttons.and(&other.buttons),
            gripper: self.gripper.and(&other.gripper),
        }
    }
}

/// Invariants of both sides.
#[allow(clippy::struct_excessive_bools)] // states of the last tick
#[derive(Clone, Debug)]
pub(crate) struct Watch {
    side: usize,
    pub(crate) state: LadderState,
    pub(crate) gain: f64,
    /// Rise of the gain at the last tick.
    rise: f64,
    clock_ns: Option<u64>,
    holds: u64,
    /// True if the clutch was open since the last hold began. `pressed` is true if it was closed after that.
    opened: bool,
    pressed: bool,
    /// Time of the last closing on the clock of the side. `align_ns` is the longest wait of a press in ns.
    closed_ns: Option<u64>,
    align_ns: u64,
    was_closed: bool,
    /// Newest frame of the peer: its time on the clock of the side, and the peer's state. Then true if the peer's
    /// clutch is closed, and true if the peer hears this side.
    heard: Option<(u64, LadderState, bool, bool)>,
    /// Silence in ns after which no frame may move anything: time to HOLD plus the longest interval of a peer.
    silent_ns: u64,
    /// C.
    frame: UnitQuaternion<f64>,
    /// Last time coupled, on the clock of the side. `fade_out_ns` is the longest fade of the force.
    coupled_ns: u64,
    fade_out_ns: u64,
    /// Energy from and to the plant since the engagement: as computed here, and as in the last frame.
    energy: PortEnergy,
    said: PortEnergy,
    /// Rounding error of the computed sums in J.
    rounding_j: f64,
    /// Number of the last engagement in the frames; 0 before the first.
    epoch: u16,
    /// Faults since then; a fault may end an engagement in its first tick, so that no frame shows it.
    faults: u16,
    was_fault: bool,
    /// True if a run of the peer has begun since the last tick.
    began: bool,
    turns: bool,
    /// Run and sequence of the newest frame that was acted on.
    newest: Option<(u64, u64)>,
    commands: Vec<(u64, OperatorCommand)>,
    /// Frames sent by either side; in a session, no other frame may be accepted.
    sent: Option<Sent>,
    pub(crate) seen: Seen,
    wrong: Option<String>,
}

/// Alignment in progress as of the slave's last tick; shared by both sides.
#[derive(Clone, Debug, Default)]
pub(crate) struct Turning {
    turns: Rc<Cell<bool>>,
    /// Sequence of the first frame sent in the current alignment.
    since: Rc<Cell<Option<u64>>>,
}

impl Turning {
    pub(crate) fn get(&self) -> bool {
        self.turns.get()
    }

    /// Set whether the arm turns, and return the value before.
    fn replace(&self, turns: bool) -> bool {
        if !turns {
            self.since.set(None);
        }
        self.turns.replace(turns)
    }

    fn sent(&self, sequence: u64) {
        if self.get() {
            self.since.set(self.since.get().or(Some(sequence)));
        }
    }

    /// Return true if the frame was sent during the current alignment.
    fn is_of(&self, sequence: u64) -> bool {
        self.since.get().is_some_and(|since| since <= sequence)
    }
}

/// Frames of the master and of the slave, by sequence.
pub(crate) type Sent = Rc<RefCell<[Vec<Vec<u8>>; 2]>>;

impl Watch {
    fn new(side: usize, drawn: &Drawn, sent: Option<Sent>) -> Self {
        let (state, commands) = (LadderState::Disengaged, drawn.commands.clone());
        Self {
            side,
            state,
            gain: 0.0,
            rise: 0.0,
            clock_ns: None,
            holds: 0,
            opened: true,
            pressed: false,
            closed_ns: None,
            align_ns: drawn.ladder.align_ns,
            was_closed: false,
            heard: None,
            silent_ns: drawn.ladder.hold_after_ns + MAX_INTERVAL_NS,
            frame: UnitQuaternion::identity(),
            coupled_ns: 0,
            fade_out_ns: drawn.ladder.fade_out_ns,
            energy: PortEnergy::default(),
            said: PortEnergy::default(),
            rounding_j: 0.0,
            epoch: 0,
            faults: 0,
            was_fault: false,
            began: false,
            turns: drawn.pose.is_some(),
            newest: None,
            commands,
            sent,
            seen: Seen::default(),
            wrong: None,
        }
    }

    pub(crate) fn hold(&mut self, holds: bool, time: TickTime, what: impl FnOnce() -> String) {
        if !holds && self.wrong.is_none() {
            let side = ["master", "slave"][self.side];
            self.wrong = Some(format!("{side} at {:.3} ms: {}", time.now_ns as f64 * 1e-6, what()));
        }
    }

    /// Check that a side sends a valid frame.
    fn send<const N: usize>(&mut self, time: LinkTime, frame: &[u8], layout: FrameLayout) -> Option<Frame> {
        let (tick, role) = (TickTime::at(time.tick_ns), [Role::Master, Role::Slave][self.side]);
        let decoded = Frame::decode(frame, role, layout);
        if let Err(error) = &decoded {
            self.hold(false, tick, || format!("sent what is no frame: {error}"));
        }
        if let Some(sent) = &self.sent {
            sent.borrow_mut()[self.side].push(frame.to_vec());
        }
        decoded.ok()
    }

    /// Check the energies of a sent frame: they start at zero with each engagement, rise during one, and contain the
    /// work computed here.
    fn energies(&mut self, time: TickTime, frame: &Frame, is_coupled: bool, counted: Counted) {
        let &Frame { energy, message, .. } = frame;
        let (state, epoch) = (self.state, message.epoch);
        self.hold((epoch != 0) == is_coupled, time, || format!("engagement {epoch} in {state:?}"));
        let said = std::mem::replace(&mut self.said, energy);
        let is_fault = state == LadderState::Fault;
        let fails = !std::mem::replace(&mut self.was_fault, is_fault) && is_fault;
        self.faults += u16::from(fails);
        if epoch != 0 && epoch != self.epoch {
            let (last, faults) = (self.epoch, self.faults);
            let follows = (last + 1..=last + 1 + faults).contains(&epoch);
            self.hold(follows, time, || format!("engagement {epoch} after {last} and {faults} faults"));
            (self.epoch, self.faults) = (epoch, 0);
            (self.energy, self.rounding_j) = (PortEnergy::default(), 0.0);
        } else if fails && energy == PortEnergy::default() {
            (self.energy, self.rounding_j) = (energy, 0.0);
        } else {
            let rises = energy.in_j >= said.in_j && energy.out_j >= said.out_j;
            self.hold(rises, time, || format!("energies {said:?}, then {energy:?}"));
        }
        match counted {
            Counted::Nothing => {}
            Counted::Unknown => {
                self.seen.unknown[self.side] += 1;
                self.energy = energy;
            }
            Counted::Work { energy_j, rounding_j } => {
                self.seen.worked[self.side] += u64::from(energy_j != 0.0);
                self.energy.add(energy_j);
                let sums_j = self.energy.in_j + self.energy.out_j;
                self.rounding_j += rounding_j + f64::EPSILON * sums_j;
            }
        }
        let (seen, most) = (self.energy, self.rounding_j);
        let differs = (energy.in_j - seen.in_j).abs().max((energy.out_j - seen.out_j).abs());
        self.hold(differs <= most, time, || format!("sent {energy:?}, seen {seen:?} within {most} J"));
    }

    /// Check that an accepted frame is newer than the last and, in a session, was sent by the peer.
    fn accepted<const N: usize>(&mut self, now_ns: u64, datagram: &[u8], taken: bool, layout: FrameLayout) {
        if !taken {
            self.seen.refused += 1;
            return;
        }
        self.seen.accepted += 1;
        let time = TickTime::at(now_ns);
        let from = [Role::Slave, Role::Master][self.side];
        let Ok(frame) = Frame::decode(datagram, from, layout) else {
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
        let stands = LadderState::from_code(frame.state).unwrap_or(LadderState::Fault);
        self.heard = Some((now_ns, stands, frame.clutch, frame.hears_peer));
        let newest = self.newest.replace((frame.run_id, frame.sequence));
        self.began |= newest.is_none_or(|(run_id, _)| run_id != frame.run_id);
        // Without encryption, an attacker who corrects the checksum can imitate another session once the peer is
        // silent.
        let may_change = self.sent.is_none();
        let newer =
            newest.is_none_or(
                |(run_id, sequence)| {
                    if run_id == frame.run_id { sequence < frame.sequence } else { may_change }
                },
            );
        self.hold(newer, time, || format!("acted on {} after {newest:?}", frame.sequence));
    }

    /// Check the ladder of a side; return the state before.
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
        self.rise = rise;
        self.seen.ticks[self.side][usize::from(state.code())] += 1;
        self.hold((0.0..=1.0).contains(&gain), time, || format!("gain {gain}"));
        self.hold(rise <= elapsed_ns as f64 / 200e6 + ROUNDING, time, || format!("gain rose by {rise}"));
        self.hold(rise <= 0.0 || state == LadderState::Engaged, time, || {
            format!("gain rose by {rise} in {state:?}")
        });
        let dead = matches!(state, LadderState::Stop | LadderState::Fault);
        self.hold(!dead || gain == 0.0, time, || format!("gain {gain} in {state:?}"));
        if state.is_coupled() {
            self.coupled_ns = time.clock_ns;
        }
        let faded = time.clock_ns - self.coupled_ns > self.fade_out_ns + elapsed_ns;
        self.hold(!faded || gain == 0.0, time, || format!("gain {gain} long after the two have parted"));
        if clutch && !std::mem::replace(&mut self.was_closed, clutch) {
            self.closed_ns = Some(time.clock_ns);
        }
        self.was_closed = clutch;
        if clutch {
            self.pressed |= self.opened;
        } else {
            (self.opened, self.pressed) = (true, false);
        }
        if state.is_coupled() && !before.is_coupled() {
            self.seen.engagements[self.side] += 1;
            self.seen.turn.engagements[self.side] += u64::from(self.turns);
            // The slave receives a press later than it is made.
            let waited_ns = self.closed_ns.map_or(u64::MAX, |closed_ns| time.clock_ns - closed_ns);
            let in_time = self.side == 1 || waited_ns <= self.align_ns;
            self.hold(in_time, time, || format!("engaged {waited_ns} ns after the press"));
            let pressed = self.pressed && self.holds == holds;
            self.hold(pressed, time, || format!("{before:?} to {state:?} without a press after a release"));
        }
        // A press that ended without engagement is over too.
        let is_unanswered =
            before == LadderState::Aligning && state == LadderState::Disengaged && self.was_closed;
        if holds > self.holds || state == LadderState::Fault || is_unanswered {
            (self.opened, self.pressed) = (false, false);
        }
        self.holds = holds;
        before
    }
}

impl Watch {
    /// Check the alignment. `turned` and `turns` are true if the arm is turned at the last tick and at this one. It
    /// may turn only during a press, and only by a recent frame of the master.
    fn aligning(&mut self, time: TickTime, (turned, turns): (bool, bool), clutch: bool) {
        let (state, waited_ns) = (self.state, self.closed_ns.map_or(u64::MAX, |since| time.clock_ns - since));
        let may = state == LadderState::Aligning && clutch && self.pressed && waited_ns <= self.align_ns;
        self.hold(!turns || may, time, || format!("turned in {state:?}, clutch {clutch}, {waited_ns} ns on"));
        let is_led_there = self.heard.is_some_and(|(at_ns, stands, clutch, hears)| {
            clutch && hears && stands.is_aligned() && time.clock_ns - at_ns <= self.silent_ns
        });
        let heard = self.heard;
        self.hold(!turns || is_led_there, time, || format!("turned by {heard:?}"));
        let seen = &mut self.seen.turn;
        seen.aligning += u64::from(turns);
        seen.aligned += u64::from(turned && state.is_coupled());
        seen.cut += u64::from(turned && !turns && !state.is_coupled());
    }
}

fn axes<const N: usize>(of: Axes<3>) -> Axes<N> {
    Axes::from_fn(|axis, _| of[axis])
}

/// Work on the link between two ticks.
#[derive(Clone, Copy, Debug)]
enum Counted {
    /// None, because this side was not coupled.
    Nothing,
    /// Work in J of the plant on the link, and its rounding error in J.
    Work { energy_j: f64, rounding_j: f64 },
    /// Cannot be computed from record and frames.
    Unknown,
}

/// Place of a plant at a tick of an engagement, and the wrench that acts from then on.
#[derive(Clone, Copy, Debug)]
struct Acting<const N: usize> {
    position: Axes<N>,
    orientation: Option<UnitQuaternion<f64>>,
    force: Axes<N>,
    torque: Axes<3>,
    /// Rounding error of the position in m; its own terms may be larger than the position.
    rounding_m: f64,
}

impl<const N: usize> Acting<N> {
    /// `f·dx + tau·dphi` up to the next tick.
    ///
    /// Rounding error: of the `N` products and their sum; of both positions; and of the angle, which comes from the
    /// product of two unit quaternions (4 products of at most 1 a part), its half angle and its axis.
    fn work(&self, next: &Self) -> Counted {
        let Self { force, torque, .. } = self;
        let way = next.position - self.position;
        let turned = self.orientation.zip(next.orientation);
        let turned = turned.map_or(Axes::zeros(), |(last, now)| (now * last.inverse()).scaled_axis());
        let terms = force.abs().dot(&way.abs()) + torque.abs().dot(&turned.abs());
        let rounding_m = self.rounding_m + next.rounding_m;
        let rounding_j = f64::EPSILON * (16.0 * terms + 32.0 * torque.norm()) + force.norm() * rounding_m;
        Counted::Work { energy_j: force.dot(&way) + torque.dot(&turned), rounding_j }
    }
}

impl Counted {
    /// Work of the reaction.
    fn reversed(self) -> Self {
        match self {
            Self::Work { energy_j, rounding_j } => Self::Work { energy_j: -energy_j, rounding_j },
            other => other,
        }
    }
}

/// Tick of a side until its frame is sent.
#[derive(Clone, Copy, Debug)]
struct Due<const N: usize> {
    /// Place and wrench of the tick; none if the sample is held, and the place is then that of the frame.
    place: Option<(Axes<N>, Option<UnitQuaternion<f64>>)>,
    rounding_m: f64,
    /// Force in N and torque in N m that act from this tick on; none if they are not known.
    wrench: Option<(Axes<N>, Axes<3>)>,
    is_coupled: bool,
    /// True if the work since the last tick counts.
    counts: bool,
}

/// Work of the plant at the port of a side.
#[derive(Clone, Debug, Default)]
struct Port<const N: usize> {
    due: Option<Due<N>>,
    /// True if the frame before was not sent.
    follows_gap: bool,
    /// Last tick, if it was coupled.
    last: Option<(Acting<N>, bool)>,
}

impl<const N: usize> Port<N> {
    fn tick(&mut self, due: Due<N>) {
        self.follows_gap |= self.due.replace(due).is_some();
    }

    /// Count the work since the last tick: `f·dx + tau·dphi`.
    fn sent(&mut self, watch: &mut Watch, time: TickTime, frame: &Frame) -> (bool, Counted) {
        let Some(due) = self.due.take() else { return (frame.message.epoch != 0, Counted::Unknown) };
        let sent = unpadded(&frame.position);
        let of_frame = (sent, frame.rotation.map(|rotation| rotation.orientation));
        let (position, orientation) = due.place.unwrap_or(of_frame);
        let is_there = (position - sent).norm() <= due.rounding_m;
        watch.hold(is_there || !due.counts, time, || format!("sent {sent:?} of an arm at {position:?}"));
        let (force, torque) = due.wrench.unwrap_or((Axes::zeros(), Axes::zeros()));
        let next = Acting { position, orientation, force, torque, rounding_m: due.rounding_m };
        let counted = match self.last {
            _ if std::mem::take(&mut self.follows_gap) => Counted::Unknown,
            Some((last, true)) if due.counts => last.work(&next),
            Some((_, false)) if due.counts => Counted::Unknown,
            _ => Counted::Nothing,
        };
        self.last = due.is_coupled.then_some((next, due.wrench.is_some()));
        (due.is_coupled, counted)
    }
}

/// Master with checks.
#[derive(Clone, Debug)]
pub(crate) struct Near<P, const N: usize, R> {
    side: MasterSide<Plant<P, N>, N, WithTriggerFeedback<R>>,
    watch: Watch,
    limiter: LimiterSettings,
    period_s: f64,
    force: Axes<N>,
    torque: Option<TorqueWatch>,
    buttons: Option<ButtonWatch>,
    gripper: Option<DrawnGripper>,
    finger: Option<FingerWatch>,
    stalled: bool,
    measures: bool,
    /// Alignment of the peer's arm.
    turning: Turning,
    port: Port<N>,
}

/// Slave with checks.
#[derive(Clone, Debug)]
pub(crate) struct Far<P, const N: usize, S> {
    side: SlaveSide<Plant<P, N>, N, S>,
    watch: Watch,
    bounds: CommandBounds,
    homes: Homes<Axes<N>>,
    command: Option<Axes<N>>,
    /// Coupled point from the tool point in m, in the tool's frame.
    reference_m: Option<Axes<3>>,
    /// Power in W of the measured wrench, and the sum of its absolute parts.
    power_w: Option<(f64, f64)>,
    /// Force in N and torque in N m about the coupled point of the last sample that was not held.
    taken: (Axes<N>, Axes<3>),
    port: Port<N>,
    clock_ns: u64,
    orientation: Option<OrientationWatch>,
    /// Alignment at the last tick.
    turning: Turning,
    gripper: Option<GripperWatch>,
}

impl<P: MasterPlant<N>, const N: usize, R: MasterTurn> Near<P, N, R> {
    pub(crate) fn new(
        side: MasterSide<Plant<P, N>, N, WithTriggerFeedback<R>>,
        drawn: &Drawn,
        sent: Option<Sent>,
        turning: Turning,
    ) -> Self {
        let pose = drawn.pose.as_ref();
        Self {
            side,
            watch: Watch::new(0, drawn, sent),
            limiter: drawn.limiter,
            period_s: drawn.periods_ns[0] as f64 * 1e-9,
            force: Axes::zeros(),
            torque: pose.map(|pose| TorqueWatch::new(&pose.master)),
            buttons: drawn.buttons.as_ref().map(|buttons| ButtonWatch::new(buttons.settings)),
            gripper: drawn.gripper.clone(),
            finger: FingerWatch::new(drawn),
            stalled: false,
            measures: pose.is_some_and(|pose| pose.measures),
            turning,
            port: Port::default(),
        }
    }

    pub(crate) fn verdict(self) -> Result<Seen, String> {
        self.watch.wrong.map_or(Ok(self.watch.seen), Err)
    }

    /// Check that the device receives only the recorded torque, and none if it measures no orientation.
    fn turn(&mut self, time: TickTime, record: &MasterRecord<N, WithTriggerFeedback<R>>) {
        let (Some(torque), Some(rotation)) = (&mut self.torque, record.rotation.rotation()) else { return };
        let (plant, watch) = (&mut self.side.plant, &mut self.watch);
        let written = plant.torque.take();
        torque.tick(watch, time, self.period_s, rotation, record.tripped, written);
        let Some(wrong) = plant.wrong() else { return };
        // A faulty value reaches a sample only if the device measures it; a device has no torque sensor.
        let is_sampled = self.measures || !matches!(wrong, Wrong::Speed(_));
        if wrong.is_none() && is_sampled && !matches!(wrong, Wrong::Torque(_)) {
            watch.seen.turn.faults[0] += 1;
            let dead = record.state == LadderState::Fault && record.device_force == Axes::<N>::zeros();
            watch.hold(dead, time, || format!("{:?} of {wrong:?}", record.state));
        }
    }

    /// Prepare the work `-(F·dx + tau·dphi)` of the hand, with the force of the coupling that the device exerted since the
    /// last tick. While controllers damp, records do not contain the share of it in the force of the device.
    fn energy(&mut self, record: &MasterRecord<N, WithTriggerFeedback<R>>, was_coupled: bool) {
        let turn = record.rotation.rotation();
        let is_damped = record.tripped != 0
            || record.safety_force != Axes::<N>::zeros()
            || turn.is_some_and(|turn| turn.tripped != 0 || turn.safety_torque != Axes::<3>::zeros());
        let torque = turn.map_or(Axes::zeros(), |turn| turn.device_torque);
        // A trip withholds the force only at the end of its tick.
        let withheld =
            [Reason::HandYields, Reason::HandGone].map(Some).contains(&Reason::from_code(record.reason));
        let parts = was_coupled && record.state == LadderState::Hold && withheld;
        self.port.tick(Due {
            place: None,
            rounding_m: 0.0,
            wrench: (!is_damped).then_some((record.device_force, torque)),
            is_coupled: record.fault == 0 && (record.state.is_coupled() || parts),
            counts: record.fault == 0 && record.past == CarriedState::All,
        });
    }

    /// Check that no force is rendered during alignment, except the fade of an earlier force.
    fn while_turned(&mut self, time: TickTime, record: &MasterRecord<N, WithTriggerFeedback<R>>) {
        let coupled = record.state.is_coupled();
        let turning = self.turning.get();
        self.watch.hold(!(turning && coupled), time, || "engaged with an arm that is turned".into());
        let rise = self.watch.rise;
        self.watch.hold(!turning || rise <= 0.0, time, || format!("gain rose by {rise} as the arm turned"));
        // Without encryption, an attacker can send any state of the arm.
        let newest = self.side.exchange().link().newest().filter(|_| self.watch.sent.is_some());
        if newest.is_some_and(|frame| self.turning.is_of(frame.sequence)) {
            let torque = record.rotation.rotation().map_or(0.0, |turn| turn.rendered_torque.norm());
            let rendered = (record.rendered_force.norm(), torque);
            self.watch
                .hold(rendered == (0.0, 0.0), time, || format!("{rendered:?} of an arm that is turned"));
        }
        self.watch.seen.turn.fading += u64::from(turning && self.watch.gain > 0.0);
    }

    /// Check norm and growth of the force. Unloading is not limited, and the power bound may exceed the growth limit.
    fn force(&mut self, time: TickTime, record: &MasterRecord<N, WithTriggerFeedback<R>>) {
        let last = std::mem::replace(&mut self.force, record.device_force);
        let force = self.force;
        let LimiterSettings { max_force_n, max_slew_n_per_s, .. } = self.limiter;
        self.watch
            .hold(force.norm() <= max_force_n * (1.0 + ROUNDING), time, || format!("force {}", force.norm()));
        let squared = last.norm_squared();
        let share = if squared > 0.0 { (last.dot(&force) / squared).clamp(0.0, 1.0) } else { 0.0 };
        let growth = (force - last * share).norm();
        let most = max_slew_n_per_s * self.period_s;
        let by_power = record.acted & ActiveLimits::POWER.bits() != 0;
        self.watch.seen.growth_limited += u64::from(record.acted & ActiveLimits::SLEW.bits() != 0);
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

impl<P: SlavePlant<N>, const N: usize, S: SlaveTurn> Far<P, N, S> {
    pub(crate) fn new(
        mut side: SlaveSide<Plant<P, N>, N, S>,
        drawn: &Drawn,
        sent: Option<Sent>,
        turning: Turning,
    ) -> Self {
        if drawn.buttons.is_some() {
            side.exchange_mut().carry_buttons();
        }
        Self {
            side,
            watch: Watch::new(1, drawn, sent),
            bounds: drawn.bounds,
            homes: Homes::new(),
            command: None,
            power_w: None,
            taken: (Axes::zeros(), Axes::zeros()),
            port: Port::default(),
            reference_m: drawn.pose.as_ref().and_then(|pose| pose.reference_m),
            clock_ns: 0,
            orientation: drawn
                .pose
                .as_ref()
                .map(|pose| OrientationWatch::new(&pose.slave, drawn.periods_ns[1] as f64 * 1e-9)),
            turning,
            gripper: drawn.gripper.as_ref().map(GripperWatch::new),
        }
    }

    pub(crate) fn verdict(self) -> Result<Seen, String> {
        self.watch.wrong.map_or(Ok(self.watch.seen), Err)
    }

    /// Prepare the work `F_e·dx + tau_e·dphi` of the arm on the link. The wrench is measured about the tool point; the
    /// coupled point p is at `p = x + R r`, and the torque about it is `tau - (R r) x F`.
    fn energy(&mut self, record: &SlaveRecord<N, S>) {
        let plant = &self.side.plant;
        let [tool, measured_velocity, force] = plant.sample;
        let is_held = self.side.endpoint.holds_sample();
        self.watch.seen.samples[usize::from(is_held)] += 1;
        let measured = plant.rotation();
        let by =
            self.reference_m.zip(measured).map(|(reference_m, measured)| measured.orientation * reference_m);
        let by_m = by.unwrap_or(Axes::zeros());
        if !is_held {
            let moment = by_m.cross(&Axes::<3>::from_fn(|axis, _| if axis < N { force[axis] } else { 0.0 }));
            self.taken = (force, measured.map_or(Axes::zeros(), |measured| measured.torque - moment));
        }
        // No motion counts over the beginning of a run of the peer.
        let began = std::mem::take(&mut self.watch.began);
        self.port.tick(Due {
            place: (!is_held).then(|| (tool + axes(by_m), measured.map(|measured| measured.orientation))),
            rounding_m: 4.0 * f64::EPSILON * (tool.norm() + 8.0 * by_m.norm()),
            wrench: Some(self.taken),
            is_coupled: record.state.is_coupled(),
            counts: record.fault == 0 && !began,
        });
        self.power_w = measured.filter(|_| record.fault == 0 && !is_held).map(|measured| {
            let (moving, w) = (force.dot(&measured_velocity), measured.angular_velocity);
            let turning = measured.torque.dot(&w);
            let most_round = by.map_or(0.0, |by| force.norm() * by.norm() * w.norm());
            (moving + turning, moving.abs() + turning.abs() + most_round)
        });
    }

    /// Check the power of the sent wrench: it is the same about any point of the tool, and zero during alignment.
    fn power(&mut self, time: LinkTime, frame: &Frame) {
        self.turning.sent(frame.sequence);
        if self.turning.get() {
            let torque = frame.rotation.map_or(0.0, |seen| seen.torque.norm());
            let is_still = (frame.force.norm(), torque) == (0.0, 0.0);
            return self.watch.hold(is_still, TickTime::at(time.tick_ns), || {
                format!("sent {:?}, {torque} N m of an arm that is turned", frame.force)
            });
        }
        let Some((power_w, most_w)) = self.power_w.take() else { return };
        let turning = frame.rotation.map_or(0.0, |seen| seen.torque.dot(&seen.angular_velocity));
        let sent_w = frame.force.dot(&frame.velocity) + turning;
        self.watch.hold((sent_w - power_w).abs() <= ROUNDING * most_w, TickTime::at(time.tick_ns), || {
            format!("sent of a wrench that does {sent_w} W, of {power_w} W at the tool")
        });
    }

    /// Return position and velocity of the coupled point from the written tool point and rotation, and the rounding
    /// error of the velocity in m/s.
    fn about(
        &self,
        [position, velocity]: [Axes<N>; 2],
        turned: Option<(UnitQuaternion<f64>, Axes<3>)>,
    ) -> ([Axes<N>; 2], f64) {
        let Some((reference_m, (orientation, w))) = self.reference_m.zip(turned) else {
            return ([position, velocity], 0.0);
        };
        let by = orientation * reference_m;
        let round = axes(w.cross(&by));
        ([position + axes(by), velocity + round], ROUNDING * round.norm())
    }

    /// Check the commanded rotation.
    fn turn(
        &mut self,
        time: TickTime,
        record: &SlaveRecord<N, S>,
        elapsed_s: f64,
        (stops, turns): (bool, bool),
    ) {
        let (Some(orientation), Some(_)) = (&mut self.orientation, record.rotation.rotation()) else {
            return;
        };
        let (side, watch) = (&mut self.side, &mut self.watch);
        let is_taken = !side.plant.is_broken(time.now_ns) && !side.endpoint.holds_sample();
        let sample = side.plant.rotation().map(|sample| sample.orientation);
        let measured = sample.filter(|_| is_taken);
        if let Some(sample) = sample {
            orientation.homes.see(sample, is_taken, record.fault != 0);
        }
        let newest = side.exchange().link().newest().and_then(|frame| frame.rotation);
        let turn_tick = TurnTick {
            command: side.endpoint.last_orientation(),
            written: (side.plant.turned.take(), side.plant.written.is_some()),
            measured,
            target: newest.map(|master| watch.frame * master.orientation * watch.frame.inverse()),
            stops,
            limited: record.limited,
            turns,
        };
        orientation.tick(watch, time, elapsed_s, &turn_tick);
        let refuses = Reason::from_code(record.reason) == Some(Reason::TurnRefused);
        watch.seen.turn.refused += u64::from(refuses);
        watch.seen.turn.speed_limited += u64::from(record.limited & 4 != 0);
        watch.seen.turn.turn_limited += u64::from(record.limited & 8 != 0);
        if let Some(wrong) = side.plant.wrong().filter(|wrong| wrong.is_none()) {
            watch.seen.turn.faults[1] += 1;
            let dead = record.state == LadderState::Fault;
            watch.hold(dead, time, || format!("{:?} of {wrong:?}", record.state));
        }
    }

    /// Check the command: it moves only while coupled, within the bounds on speed and reach.
    fn command(
        &mut self,
        time: TickTime,
        elapsed_s: f64,
        stops: bool,
        record: &SlaveRecord<N, S>,
        was_coupled: bool,
        turned: Option<(UnitQuaternion<f64>, Axes<3>)>,
    ) {
        let limited = record.limited;
        let is_taken = !self.side.plant.is_broken(time.now_ns) && !self.side.endpoint.holds_sample();
        let measured = is_taken.then_some(record.position);
        let state = self.watch.state;
        let command = self.side.endpoint.last_command();
        let before = std::mem::replace(&mut self.command, command);
        let CommandBounds { speed, reach } = self.bounds;
        let written = self.side.plant.written.take();
        let stopped = matches!(state, LadderState::Stop | LadderState::Fault);
        self.watch
            .hold(!(stopped && written.is_some()), time, || format!("written {written:?} in {state:?}"));
        if let Some(written) = written {
            let ([position, velocity], rounding) = self.about(written, turned);
            let fits = match self.reference_m {
                None => Some(position) == command,
                Some(_) => command.is_some_and(|command| (position - command).norm() <= 1e-12),
            };
            self.watch.hold(fits, time, || format!("{position:?} written, not {command:?}"));
            let most = if state.is_coupled() { speed * (1.0 + ROUNDING) } else { 0.0 } + rounding;
            self.watch
                .hold(velocity.norm() <= most, time, || format!("velocity {} in {state:?}", velocity.norm()));
            self.watch.seen.turn.about_a_point += u64::from(self.reference_m.is_some() && state.is_coupled());
        }
        let has_engaged = self.watch.seen.engagements[1] > 0 || self.watch.seen.turn.aligning > 0;
        self.watch.hold(has_engaged || command.is_none(), time, || format!("{command:?} before it engaged"));
        // The first command continues from the position of the arm.
        let Some((before, command)) = before.or(measured).zip(command) else { return };
        let step = (command - before).norm();
        if state.is_coupled() {
            let most = speed * elapsed_s * (1.0 + ROUNDING) + 1e-12;
            self.watch.hold(step <= most, time, || format!("commanded step {step} > {most} in {state:?}"));
            // Both sides are anchored at engagement, so motion of the hand before it has no effect.
            let jumps = !was_coupled && step > 1e-9 && limited & REACH == 0;
            self.watch.hold(!jumps, time, || format!("jumped by {step} m when it engaged"));
            let out = self.homes.out(|home| (command - home).norm());
            // A stop may have ended outside: the command may lead back, but not further out.
            let was_out = self.homes.out(|home| (before - home).norm());
            let most = reach.max(was_out) * (1.0 + ROUNDING);
            self.watch.hold(out <= most, time, || format!("commanded {out} m out, beyond {most}"));
        } else if !stops {
            self.watch.hold(step == 0.0, time, || format!("commanded step {step} in {state:?}"));
        }
    }
}

impl<P: MasterPlant<N>, const N: usize, R: MasterTurn> Side for Near<P, N, R> {
    type Record = MasterRecord<N, WithTriggerFeedback<R>>;

    fn begin(&mut self, now_ns: u64) {
        self.side.begin(now_ns);
    }

    fn receive(&mut self, time: LinkTime, datagram: &[u8]) -> Result<(), RejectReason> {
        let taken = self.side.receive(time, datagram);
        let layout = self.side.exchange().link().layout();
        self.watch.accepted::<N>(time.tick_ns, datagram, taken.is_ok(), layout);
        taken
    }

    fn tick_into(&mut self, time: TickTime, record: &mut MasterRecord<N, WithTriggerFeedback<R>>) {
        let released = act(&mut self.side, &mut self.watch, time);
        if let Some(read) = self.gripper.as_ref().and_then(|drawn| drawn.read_trigger(time.now_ns)) {
            self.side.trigger = Some(read);
        }
        let stood = self.side.exchange().state();
        self.side.tick_into(time, record);
        let ladder = self.side.exchange().ladder();
        let (gain, holds) = (ladder.gain(), ladder.holds());
        let before = self.watch.ladder(time, record.state, gain, holds, record.clutch);
        self.force(time, record);
        self.turn(time, record);
        self.while_turned(time, record);
        self.energy(record, before.is_coupled());
        let stalled = std::mem::take(&mut self.stalled);
        if let Some(finger) = &mut self.finger {
            let tick = FingerTickSeen {
                felt: self.side.felt().copied(),
                recorded: record.rotation.finger,
                position: record.trigger,
                jaws: self.side.exchange().peer_gripper(),
                stalled,
            };
            finger.tick(&mut self.watch, time, &tick);
        }
        if let Some(buttons) = &mut self.buttons {
            if released {
                buttons.release();
            }
            if stalled {
                buttons.stall();
            }
            let word = self.side.plant.buttons().unwrap_or(ButtonWord::UNKNOWN);
            let trigger = self.side.trigger.as_ref().map(|_| record.trigger);
            buttons.tick(&mut self.watch, time, word, stood, record.clutch, trigger);
        }
    }

    fn send<'a>(&mut self, time: LinkTime, buffer: &'a mut [u8; MAX_FRAME]) -> &'a [u8] {
        let layout = self.side.exchange().link().layout();
        let frame = self.side.send(time, buffer);
        if let Some(frame) = self.watch.send::<N>(time, frame, layout) {
            let tick = TickTime::at(time.tick_ns);
            let (is_coupled, counted) = self.port.sent(&mut self.watch, tick, &frame);
            self.watch.energies(tick, &frame, is_coupled, counted.reversed());
        }
        frame
    }

    fn rest(&mut self) {
        self.side.rest();
    }

    fn command(&mut self, now_ns: u64, command: OperatorCommand) -> Result<bool, CouplingError> {
        self.side.command(now_ns, command)
    }

    fn exchange(&self) -> &Exchange {
        self.side.exchange()
    }

    fn exchange_mut(&mut self) -> &mut Exchange {
        // The runner in virtual time calls this only after the loop has stalled.
        self.stalled = true;
        self.side.exchange_mut()
    }
}

impl<P: SlavePlant<N>, const N: usize, S: SlaveTurn> Side for Far<P, N, S> {
    type Record = SlaveRecord<N, S>;

    fn begin(&mut self, now_ns: u64) {
        self.side.begin(now_ns);
    }

    fn receive(&mut self, time: LinkTime, datagram: &[u8]) -> Result<(), RejectReason> {
        let taken = self.side.receive(time, datagram);
        let layout = self.side.exchange().link().layout();
        self.watch.accepted::<N>(time.tick_ns, datagram, taken.is_ok(), layout);
        taken
    }

    fn tick_into(&mut self, time: TickTime, record: &mut SlaveRecord<N, S>) {
        act(&mut self.side, &mut self.watch, time);
        if let (Some(watch), Some(gripper)) = (&mut self.gripper, &mut self.side.gripper) {
            watch.read(time.now_ns, gripper);
        }
        let stops = self.side.plant.stops;
        self.side.tick_into(time, record);
        let ladder = self.side.exchange().ladder();
        let (gain, holds) = (ladder.gain(), ladder.holds());
        let turns = ladder.turns();
        let before = self.watch.ladder(time, record.state, gain, holds, record.clutch);
        let is_taken = !self.side.plant.is_broken(time.now_ns) && !self.side.endpoint.holds_sample();
        self.homes.see(record.position, is_taken, record.fault != 0);
        let stopped = self.side.plant.stops - stops;
        let dead = |state| matches!(state, LadderState::Stop | LadderState::Fault);
        let turned = self.turning.replace(turns);
        let (was_led, is_led) = (before.is_coupled() || turned, record.state.is_coupled() || turns);
        let due = dead(record.state) && !dead(before) || was_led && !is_led;
        self.watch.aligning(time, (turned, turns), record.clutch);
        self.watch.hold(stopped == u64::from(due), time, || format!("stopped {stopped} times, due {due}"));
        self.watch.seen.soft_stops += stopped;
        self.watch.seen.commands_limited += u64::from(record.limited != 0);
        let elapsed_s = (time.clock_ns - std::mem::replace(&mut self.clock_ns, time.clock_ns)) as f64 * 1e-9;
        self.energy(record);
        let oriented = self.side.plant.turned;
        self.turn(time, record, elapsed_s, (stopped > 0, turns));
        self.command(time, elapsed_s, stopped > 0, record, before.is_coupled(), oriented);
        if let (Some(watch), Some(gripper)) = (&mut self.gripper, &self.side.gripper) {
            let trigger = self.side.exchange().peer_gripper().and_then(|state| state.position);
            watch.tick(&mut self.watch, time, gripper, trigger);
        }
    }

    fn send<'a>(&mut self, time: LinkTime, buffer: &'a mut [u8; MAX_FRAME]) -> &'a [u8] {
        let layout = self.side.exchange().link().layout();
        let frame = self.side.send(time, buffer);
        if let Some(frame) = self.watch.send::<N>(time, frame, layout) {
            self.power(time, &frame);
            let tick = TickTime::at(time.tick_ns);
            let (is_coupled, counted) = self.port.sent(&mut self.watch, tick, &frame);
            self.watch.energies(tick, &frame, is_coupled, counted);
        }
        frame
    }

    fn rest(&mut self) {
        self.side.rest();
    }

    fn command(&mut self, now_ns: u64, command: OperatorCommand) -> Result<bool, CouplingError> {
        self.side.command(now_ns, command)
    }

    fn exchange(&self) -> &Exchange {
        self.side.exchange()
    }

    fn exchange_mut(&mut self) -> &mut Exchange {
        self.side.exchange_mut()
    }
}

/// Apply the operator's commands due at a tick; return true if the clutch was released.
fn act(side: &mut impl Side, watch: &mut Watch, time: TickTime) -> bool {
    let mut released = false;
    let due = watch.commands.iter().take_while(|(at_ns, _)| *at_ns <= time.now_ns).count();
    for (_, command) in watch.commands.drain(..due) {
        released |= command == OperatorCommand::Release;
        if let OperatorCommand::Frame { quat_wxyz: [w, x, y, z], .. } = command {
            watch.frame = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
        }
        let done = side.command(time.clock_ns, command);
        let is_refused = match done {
            Err(CouplingError::Change { seen, closed: [least, most], .. }) => !(least..=most).contains(&seen),
            Err(CouplingError::NoScale(_)) => true,
            _ => false,
        };
        if done.is_err() && !is_refused {
            watch.wrong.get_or_insert_with(|| format!("{command:?}: {done:?}"));
        }
    }
    released
}
