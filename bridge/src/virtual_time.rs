//! Virtual-time runner: both sides and the network between them, without socket, sleep or clock.

use std::ops::ControlFlow;

use haptether_netsim::{
    Damage, Direction, EndpointClock, ExtraCause, InFlight, Judgement, Link, LinkSettings, LinkSettingsError,
    Packet, Verdict,
};

use crate::{
    link::LinkTime,
    pace::{Pace, TickTime},
    session::{
        EndError, MAX_DATAGRAM, PreSharedKey, Received, Rejections, SeededEntropy, SessionEnd,
        SessionSettings,
    },
    side::{Side, sealed_frame},
    wire::{Frame, MAX_FRAME, Role},
};

/// Settings of a run in virtual time.
#[derive(Clone, Debug, PartialEq)]
pub struct VirtualSettings {
    /// Period of the master's loop in ns.
    pub period_ns: u64,
    /// Period of the slave's loop in ns.
    pub slave_period_ns: u64,
    /// Number of the master's ticks; for a drifting clock, of its periods in true time.
    pub ticks: u64,
    /// Network from master to slave.
    pub forward: LinkSettings,
    /// Network from slave to master.
    pub backward: LinkSettings,
    /// Seed of both directions and of the keys.
    pub seed: u64,
    /// True for a secure session. Otherwise frames are sent as datagrams without a handshake.
    pub secure: bool,
    /// True if every frame is encoded. Otherwise only those that the network changes: faster, with equal results.
    pub encoded: bool,
    /// The master's clock; `None` for true time.
    pub master_clock: Option<EndpointClock>,
    /// The slave's clock; `None` for true time.
    pub slave_clock: Option<EndpointClock>,
}

/// Max. number of datagrams in flight per direction: more than an hour at 1 kHz. Allocated as they are sent.
const MAX_IN_FLIGHT: usize = 1 << 22;

/// Error of a run in virtual time.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum VirtualError {
    /// Invalid link settings.
    #[error(transparent)]
    Link(#[from] LinkSettingsError),
    /// No session.
    #[error(transparent)]
    Session(#[from] EndError),
}

/// Counts of the network and of both loops.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct VirtualCounts {
    /// Datagrams dropped because too many were in flight.
    pub overflowed: u64,
    /// Counts of the master's and the slave's loop.
    pub loops: [LoopCounts; 2],
}

/// Counts of a loop in virtual time and of its session.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LoopCounts {
    /// Ticks done.
    pub ticks: u64,
    /// Ticks skipped because the endpoint's clock was set forward.
    pub skipped: u64,
    /// Reading of the endpoint's clock at the last tick, in ns.
    pub clock_ns: u64,
    /// Datagrams rejected by the session.
    pub rejections: Rejections,
}

type Datagram = ([u8; MAX_DATAGRAM], usize);

/// Packet in flight, by slot, so that a queue moves only an index.
#[derive(Clone, Copy, Debug)]
enum Sent {
    /// A frame that was not encoded.
    Frame(usize),
    Bytes(usize),
}

/// Slab of packets in flight.
#[derive(Clone)]
struct Slab<T> {
    slots: Vec<T>,
    free: Vec<usize>,
}

impl<T> Slab<T> {
    const fn new() -> Self {
        Self { slots: Vec::new(), free: Vec::new() }
    }

    fn insert(&mut self, one: T) -> usize {
        if let Some(slot) = self.free.pop() {
            self.slots[slot] = one;
            slot
        } else {
            self.slots.push(one);
            self.slots.len() - 1
        }
    }
}

#[derive(Clone)]
struct OneWay {
    link: Link,
    in_flight: InFlight<Sent>,
    frames: Slab<Frame>,
    datagrams: Slab<Datagram>,
    /// Frames not judged yet, and their slots.
    sent: Vec<Packet>,
    sent_slots: Vec<usize>,
    verdicts: Vec<Verdict>,
    index: u64,
    direction: Direction,
    /// Bytes of the sender's frames.
    frame_size: usize,
}

impl OneWay {
    fn new(
        direction: Direction,
        seed: u64,
        settings: &LinkSettings,
        frame_size: usize,
    ) -> Result<Self, LinkSettingsError> {
        let link = Link::new(direction, seed, settings)?;
        let in_flight = InFlight::growing(MAX_IN_FLIGHT);
        Ok(Self {
            link,
            in_flight,
            frames: Slab::new(),
            datagrams: Slab::new(),
            sent: Vec::new(),
            sent_slots: Vec::new(),
            verdicts: Vec::new(),
            index: 0,
            direction,
            frame_size,
        })
    }

    /// Carry a datagram; `back` leads to its sender.
    fn carry(&mut self, now_ns: u64, datagram: &[u8], back: &mut Self) {
        self.carry_sent();
        self.judged(now_ns, datagram.len(), back, |to, at_ns, damage| {
            to.push_bytes(at_ns, &damaged(datagram, damage));
        });
    }

    /// Carry the next frame of a side in an insecure session. It is encoded only if the link changes packets;
    /// otherwise it waits for [`carry_sent`](Self::carry_sent).
    #[inline(always)] // takes a frame: docs/decisions/060-ticks-in-a-row.md
    fn carry_next_frame(&mut self, side: &mut impl Side, time: LinkTime, now_ns: u64, back: &mut Self) {
        if self.link.changes_packets() {
            self.carry_changing(now_ns, &build_frame(side, time), back);
            return;
        }
        let packet = self.next_packet(now_ns, self.frame_size);
        self.sent.push(packet);
        let slot =
            if let Some(slot) = self.frames.free.pop() { slot } else { self.frames.insert(Frame::EMPTY) };
        // In place: a frame is large.
        side.fill_frame(time, &mut self.frames.slots[slot]);
        self.check_length(&self.frames.slots[slot]);
        self.sent_slots.push(slot);
    }

    fn check_length(&self, frame: &Frame) {
        debug_assert_eq!(frame.layout().length(), self.frame_size, "what stands in a frame never changes");
    }

    /// Judge the waiting frames. Meanwhile a side does several ticks in a row, so that the sides do not evict each
    /// other's code from the cache.
    fn carry_sent(&mut self) {
        if self.sent.is_empty() {
            return;
        }
        let Self { link, in_flight, frames, sent, sent_slots, verdicts, direction, .. } = self;
        link.judge_all(sent, verdicts);
        for ((packet, &slot), verdict) in sent.iter().zip(&*sent_slots).zip(&*verdicts) {
            let is_taken = match *verdict {
                Verdict::Deliver { at_ns } => {
                    let at_ns = at_ns.max(earliest_ns(*direction, packet.sent_ns));
                    in_flight.push(at_ns, Sent::Frame(slot)).is_ok()
                }
                Verdict::Drop { .. } => false,
            };
            if !is_taken {
                frames.free.push(slot);
            }
        }
        sent.clear();
        sent_slots.clear();
    }

    fn next_packet(&mut self, sent_ns: u64, size: usize) -> Packet {
        let packet = Packet { direction: self.direction, sent_ns, size, index: self.index };
        self.index += 1;
        packet
    }

    // Not inlined, to keep it apart from links that change nothing.
    #[inline(never)]
    fn carry_changing(&mut self, now_ns: u64, frame: &Frame, back: &mut Self) {
        self.check_length(frame);
        self.judged(now_ns, self.frame_size, back, |to, at_ns, damage| {
            if damage.is_none() {
                to.push_frame(at_ns, frame);
            } else {
                to.push_bytes(at_ns, &damaged(frame.encode(&mut [0; MAX_FRAME]), damage));
            }
        });
    }

    /// Pass each arrival of a datagram to `push`.
    fn judged(
        &mut self,
        now_ns: u64,
        size: usize,
        back: &mut Self,
        push: impl Fn(&mut Arrivals<'_>, u64, &Damage),
    ) {
        let packet = self.next_packet(now_ns, size);
        let Self { link, in_flight, frames, datagrams, .. } = self;
        let Judgement { verdict, damage, extras } = link.judge(&packet);
        let mut forward = Arrivals { in_flight, frames, datagrams };
        let earliest_ns = earliest_ns(self.direction, now_ns);
        if let Verdict::Deliver { at_ns } = verdict {
            push(&mut forward, at_ns.max(earliest_ns), damage);
        }
        for extra in extras {
            if extra.cause == ExtraCause::Mirror {
                let Self { in_flight, frames, datagrams, .. } = &mut *back;
                push(&mut Arrivals { in_flight, frames, datagrams }, extra.at_ns, &extra.damage);
            } else {
                push(&mut forward, extra.at_ns.max(earliest_ns), &extra.damage);
            }
        }
    }
}

#[inline(never)]
fn build_frame(side: &mut impl Side, time: LinkTime) -> Frame {
    let mut frame = Frame::EMPTY;
    side.fill_frame(time, &mut frame);
    frame
}

/// Earliest arrival of a packet sent at `now_ns`. The master ticks first at one instant, so it hears the slave at its
/// next tick.
fn earliest_ns(direction: Direction, now_ns: u64) -> u64 {
    if direction == Direction::Backward { now_ns + 1 } else { now_ns }
}

/// Packets in flight in one direction.
struct Arrivals<'a> {
    in_flight: &'a mut InFlight<Sent>,
    frames: &'a mut Slab<Frame>,
    datagrams: &'a mut Slab<Datagram>,
}

impl Arrivals<'_> {
    // A full queue drops and counts the packet, as a network would.

    fn push_frame(&mut self, at_ns: u64, frame: &Frame) {
        let slot = self.frames.insert(*frame);
        if self.in_flight.push(at_ns, Sent::Frame(slot)).is_err() {
            self.frames.free.push(slot);
        }
    }

    fn push_bytes(&mut self, at_ns: u64, datagram: &Datagram) {
        let slot = self.datagrams.insert(*datagram);
        if self.in_flight.push(at_ns, Sent::Bytes(slot)).is_err() {
            self.datagrams.free.push(slot);
        }
    }
}

/// A side with its session, seeded entropy and clock.
struct Loop<'a, S> {
    side: &'a mut S,
    end: SessionEnd,
    entropy: SeededEntropy,
    pace: Pace,
    counts: LoopCounts,
    /// True if frames are encoded from the start.
    encodes: bool,
}

impl<'a, S: Side> Loop<'a, S> {
    /// Create a loop, secure if `seed` is given.
    fn new(
        side: &'a mut S,
        role: Role,
        peer_period_ns: u64,
        seed: Option<u64>,
        encoded: bool,
        pace: Pace,
    ) -> Result<Self, EndError> {
        let settings = SessionSettings::of_frames(role, side.exchange().link().layout(), peer_period_ns);
        let mut entropy = SeededEntropy::new(seed.unwrap_or_default(), role);
        let end = if seed.is_some() {
            // Nobody listens in a simulation: any key will do.
            let key = PreSharedKey::new(b"the key of simulated sides alone")?;
            SessionEnd::secure(settings, key, &mut entropy)?
        } else {
            SessionEnd::insecure(settings)?
        };
        let encodes = encoded || seed.is_some();
        Ok(Self { side, end, entropy, pace, counts: LoopCounts::default(), encodes })
    }

    fn goes_on(&self, end_ns: u64) -> bool {
        self.pace.true_ns < end_ns
    }

    /// Does the due tick, from `inward` to `outward`, which judges its frames in `carry_sent`.
    fn step(&mut self, inward: &mut OneWay, outward: &mut OneWay, record: &mut S::Record) {
        let (now_ns, wake) = (self.pace.true_ns, self.pace.wake());
        let clock_ns = wake.deadline_ns;
        if wake.is_stalled() {
            while let Some((_, sent)) = inward.in_flight.pop_due(now_ns) {
                match sent {
                    Sent::Frame(slot) => inward.frames.free.push(slot),
                    Sent::Bytes(slot) => inward.datagrams.free.push(slot),
                }
            }
            self.side.exchange_mut().stalled(clock_ns);
        }
        let time = LinkTime::late(clock_ns, self.pace.late_ns(&wake));
        while let Some((_, sent)) = inward.in_flight.pop_due(now_ns) {
            match sent {
                Sent::Frame(slot) => {
                    // The link counts a refusal.
                    let _ = self.side.receive_frame(time, &inward.frames.slots[slot]);
                    inward.frames.free.push(slot);
                }
                Sent::Bytes(slot) => self.open(time, slot, inward, outward),
            }
        }
        let tick = TickTime {
            now_ns,
            clock_ns,
            overshoot_ns: wake.overshoot_ns,
            missed: wake.missed,
            ..TickTime::default()
        };
        self.side.tick_into(tick, record);
        if self.encodes {
            // Seeded randomness does not fail.
            if let Some(hello) = self.end.poll(clock_ns, &mut self.entropy).ok().flatten() {
                outward.carry(now_ns, &hello, inward);
            }
            let mut buffer = [0; MAX_DATAGRAM];
            if let Some(datagram) = sealed_frame(&mut self.end.session, time, self.side, &mut buffer) {
                outward.carry(now_ns, datagram, inward);
            }
        } else {
            // An insecure session is always open and seals nothing.
            outward.carry_next_frame(self.side, time, now_ns, inward);
        }
        self.pace.wait_after(&wake);
        self.counts.ticks += 1;
        self.counts.skipped += wake.missed;
        self.counts.clock_ns = clock_ns;
    }

    fn open(&mut self, time: LinkTime, slot: usize, inward: &mut OneWay, outward: &mut OneWay) {
        let (mut bytes, length) = inward.datagrams.slots[slot];
        inward.datagrams.free.push(slot);
        match self.end.receive(time.tick_ns, &mut bytes[..length], &mut self.entropy) {
            // The link counts a refusal.
            Ok(Received::Payload { payload, .. }) => {
                let _ = self.side.receive(time, payload);
            }
            Ok(Received::Reply(answer)) => outward.carry(self.pace.true_ns, &answer, inward),
            // The session counts a rejection.
            Ok(Received::Nothing) | Err(_) => {}
        }
    }

    fn counts(&self) -> LoopCounts {
        LoopCounts { rejections: self.end.rejections(), ..self.counts }
    }
}

fn damaged(sent: &[u8], damage: &Damage) -> Datagram {
    let mut buffer = [0; MAX_DATAGRAM];
    buffer[..sent.len()].copy_from_slice(sent);
    let length = if damage.is_none() { sent.len() } else { damage.apply(&mut buffer[..sent.len()]) };
    (buffer, length)
}

/// Next event of a run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Event<'a, M, S> {
    /// The master ticked.
    Master(&'a M),
    /// The slave ticked.
    Slave(&'a S),
}

/// Run both sides at their own rates. Passes each record and both sides to `observe`, until it breaks off or the
/// master has done its ticks.
///
/// The loop that is next takes the frames due by then, ticks and sends; at the same instant the master is first. A
/// frame without delay reaches the slave in the same tick, the master in the next.
///
/// Both loops begin at time 0. Plants and network use true time, each loop its endpoint's clock. A drift stretches
/// the true period. A clock set forward makes the loop late, as after a suspend. In a secure session the first ticks
/// send only the handshake.
pub fn run_virtual<M: Side, S: Side>(
    settings: &VirtualSettings,
    master: &mut M,
    slave: &mut S,
    mut observe: impl FnMut(Event<'_, M::Record, S::Record>, (&M, &S)) -> ControlFlow<()>,
) -> Result<VirtualCounts, VirtualError> {
    let mut run = Run::new(settings, master, slave)?;
    let (mut master_record, mut slave_record) = (M::Record::default(), S::Record::default());
    while run.master.goes_on(run.end_ns) || run.slave.goes_on(run.end_ns) {
        let Run { master, slave, forward, backward, .. } = &mut run;
        let flow = if master.pace.true_ns <= slave.pace.true_ns {
            master.step(backward, forward, &mut master_record);
            forward.carry_sent();
            observe(Event::Master(&master_record), (master.side, slave.side))
        } else {
            slave.step(forward, backward, &mut slave_record);
            backward.carry_sent();
            observe(Event::Slave(&slave_record), (master.side, slave.side))
        };
        if flow.is_break() {
            break;
        }
    }
    Ok(run.counts())
}

/// Maximum number of ticks of a side in a row: enough to keep its code in the cache, few enough to keep their records
/// there.
pub(crate) const MAX_BATCH_TICKS: usize = 64;

/// As [`run_virtual`], with the same records in the same order, for callers that read only records. The sides may be
/// some ticks ahead of `observe`, and so may their counts after a break.
pub(crate) fn run_virtual_batched<M: Side, S: Side>(
    settings: &VirtualSettings,
    master: &mut M,
    slave: &mut S,
    mut observe: impl FnMut(Event<'_, M::Record, S::Record>, (&M, &S)) -> ControlFlow<()>,
) -> Result<VirtualCounts, VirtualError> {
    let mut batched = BatchedRun::new(settings, master, slave)?;
    while batched.advance(&mut observe).is_continue() {}
    Ok(batched.counts())
}

/// A run whose sides are some ticks ahead of `observe`.
///
/// The code of both sides exceeds the first cache. So a side does several ticks in a row, as long as no packet still
/// to be sent can arrive by then.
///
/// Source: K. M. Chandy, J. Misra, "Distributed simulation: a case study in design and verification of distributed
/// programs", IEEE Trans. Softw. Eng. 5, 1979 (lookahead of a channel that keeps the order).
pub(crate) struct BatchedRun<'a, M: Side, S: Side> {
    run: Run<'a, M, S>,
    master_ticks: PendingTicks<M::Record>,
    slave_ticks: PendingTicks<S::Record>,
}

/// True time in ns and record of each unobserved tick, the oldest first.
///
/// Usually all are observed before more are added: no ring is needed.
struct PendingTicks<R> {
    /// The first `kept` are ticks, the rest is free.
    ticks: Vec<(u64, R)>,
    filled: usize,
    /// Number of those that were observed.
    observed: usize,
}

impl<R: Copy + Default> PendingTicks<R> {
    fn new() -> Self {
        Self { ticks: Vec::new(), filled: 0, observed: 0 }
    }

    /// Drop observed ticks. Call before adding more.
    fn drop_observed(&mut self) {
        self.ticks.copy_within(self.observed..self.filled, 0);
        self.filled -= self.observed;
        self.observed = 0;
        self.ticks.resize_with(MAX_BATCH_TICKS, Default::default);
    }

    /// Slot for a tick at `true_ns`; `None` if full. Call before any is observed.
    fn push_slot(&mut self, true_ns: u64) -> Option<&mut R> {
        debug_assert_eq!(self.observed, 0, "drop_observed comes first");
        let (at_ns, record) = self.ticks.get_mut(self.filled)?;
        *at_ns = true_ns;
        self.filled += 1;
        Some(record)
    }

    fn pending(&self) -> &[(u64, R)] {
        &self.ticks[self.observed..self.filled]
    }

    /// Copy the unobserved ticks, without spare capacity.
    fn copied(&self) -> Self {
        Self { ticks: self.pending().to_vec(), filled: self.pending().len(), observed: 0 }
    }
}

fn first_ns<R>(ticks: &[(u64, R)], next_ns: u64) -> u64 {
    ticks.first().map_or(next_ns, |(at_ns, _)| *at_ns)
}

impl<'a, M: Side, S: Side> BatchedRun<'a, M, S> {
    /// A run before its first tick.
    pub(crate) fn new(
        settings: &VirtualSettings,
        master: &'a mut M,
        slave: &'a mut S,
    ) -> Result<Self, VirtualError> {
        let run = Run::new(settings, master, slave)?;
        Ok(Self { run, master_ticks: PendingTicks::new(), slave_ticks: PendingTicks::new() })
    }

    /// Does some ticks of each side, then observes those that no earlier tick can follow. Breaks at the end of the
    /// run.
    pub(crate) fn advance(
        &mut self,
        observe: &mut impl FnMut(Event<'_, M::Record, S::Record>, (&M, &S)) -> ControlFlow<()>,
    ) -> ControlFlow<()> {
        let Self { run: Run { master, slave, forward, backward, end_ns }, master_ticks, slave_ticks } = self;
        master_ticks.drop_observed();
        slave_ticks.drop_observed();
        // A packet sent later arrives later than it is sent. At the same instant the master is first.
        while master.goes_on(*end_ns)
            && (master.pace.true_ns <= slave.pace.true_ns
                || master.pace.true_ns < backward.link.earliest_later_ns())
            && let Some(record) = master_ticks.push_slot(master.pace.true_ns)
        {
            master.step(backward, forward, record);
        }
        forward.carry_sent();
        while slave.goes_on(*end_ns)
            && (slave.pace.true_ns < master.pace.true_ns
                || slave.pace.true_ns < forward.link.earliest_later_ns())
            && let Some(record) = slave_ticks.push_slot(slave.pace.true_ns)
        {
            slave.step(forward, backward, record);
        }
        backward.carry_sent();
        // In order of time, the master first at the same instant. The next tick of a side without unobserved ticks
        // bounds the other's.
        let next_ns = [master.pace.true_ns, slave.pace.true_ns];
        let has_ended = !master.goes_on(*end_ns) && !slave.goes_on(*end_ns);
        let sides = (&*master.side, &*slave.side);
        let (mut master_left, mut slave_left) = (master_ticks.pending(), slave_ticks.pending());
        let flow = loop {
            // Observed in place: a record is large to move.
            let event = if first_ns(master_left, next_ns[0]) <= first_ns(slave_left, next_ns[1]) {
                let Some(((_, record), left)) = master_left.split_first() else { break None };
                master_left = left;
                Event::Master(record)
            } else {
                let Some(((_, record), left)) = slave_left.split_first() else { break None };
                slave_left = left;
                Event::Slave(record)
            };
            let flow = observe(event, sides);
            if flow.is_break() {
                break Some(flow);
            }
        };
        // All kept ticks are before the end, so before the next tick of an ended side.
        debug_assert!(!has_ended || flow.is_some() || (master_left.is_empty() && slave_left.is_empty()));
        (master_ticks.observed, slave_ticks.observed) =
            (master_ticks.filled - master_left.len(), slave_ticks.filled - slave_left.len());
        flow.unwrap_or(if has_ended { ControlFlow::Break(()) } else { ControlFlow::Continue(()) })
    }

    pub(crate) fn counts(&self) -> VirtualCounts {
        self.run.counts()
    }

    /// The master side, which may be ahead of `observe`.
    pub(crate) fn master(&self) -> &M {
        self.run.master.side
    }

    /// Unobserved ticks of the master.
    pub(crate) fn pending_master_records(&self) -> impl Iterator<Item = &M::Record> {
        self.master_ticks.pending().iter().map(|(_, record)| record)
    }

    /// Copy the run. `None` with security, encoded frames, or a network that changes packets.
    pub(crate) fn snapshot(&self) -> Option<Snapshot<M, S>>
    where
        M: Clone,
        S: Clone,
    {
        let Self { run: Run { master, slave, forward, backward, .. }, master_ticks, slave_ticks } = self;
        let has_sessions = master.encodes || slave.encodes;
        if has_sessions || forward.link.changes_packets() || backward.link.changes_packets() {
            return None;
        }
        Some(Snapshot {
            master: master.side.clone(),
            slave: slave.side.clone(),
            paces: [master.pace, slave.pace],
            counts: [master.counts, slave.counts],
            network: [forward.clone(), backward.clone()],
            master_ticks: master_ticks.copied(),
            slave_ticks: slave_ticks.copied(),
        })
    }

    /// Resume a snapshot of a run of the same settings, with sides in its state.
    pub(crate) fn resume(
        settings: &VirtualSettings,
        snapshot: &Snapshot<M, S>,
        master: &'a mut M,
        slave: &'a mut S,
    ) -> Result<Self, VirtualError> {
        let Snapshot { paces, counts, network, master_ticks, slave_ticks, .. } = snapshot;
        let mut run = Run::of(settings, master, slave, network.clone())?;
        (run.master.pace, run.slave.pace) = (paces[0], paces[1]);
        (run.master.counts, run.slave.counts) = (counts[0], counts[1]);
        Ok(Self { run, master_ticks: master_ticks.copied(), slave_ticks: slave_ticks.copied() })
    }
}

/// A run between two ticks, for repeated resumption.
pub(crate) struct Snapshot<M: Side, S: Side> {
    pub(crate) master: M,
    pub(crate) slave: S,
    paces: [Pace; 2],
    counts: [LoopCounts; 2],
    /// Forward and backward.
    network: [OneWay; 2],
    master_ticks: PendingTicks<M::Record>,
    slave_ticks: PendingTicks<S::Record>,
}

struct Run<'a, M, S> {
    master: Loop<'a, M>,
    slave: Loop<'a, S>,
    forward: OneWay,
    backward: OneWay,
    end_ns: u64,
}

impl<'a, M: Side, S: Side> Run<'a, M, S> {
    fn new(settings: &VirtualSettings, master: &'a mut M, slave: &'a mut S) -> Result<Self, VirtualError> {
        master.begin(0);
        slave.begin(0);
        let sizes = [master.exchange(), slave.exchange()].map(|of| of.link().frame_length());
        let forward = OneWay::new(Direction::Forward, settings.seed, &settings.forward, sizes[0])?;
        let backward = OneWay::new(Direction::Backward, settings.seed, &settings.backward, sizes[1])?;
        Self::of(settings, master, slave, [forward, backward])
    }

    fn of(
        settings: &VirtualSettings,
        master: &'a mut M,
        slave: &'a mut S,
        [forward, backward]: [OneWay; 2],
    ) -> Result<Self, VirtualError> {
        let end_ns = settings.ticks * settings.period_ns;
        let periods_ns = [settings.period_ns, settings.slave_period_ns];
        let paces =
            [Pace::new(settings.master_clock, periods_ns[0]), Pace::new(settings.slave_clock, periods_ns[1])];
        let key = settings.secure.then_some(settings.seed);
        let encoded = settings.encoded;
        let master = Loop::new(master, Role::Master, periods_ns[1], key, encoded, paces[0])?;
        let slave = Loop::new(slave, Role::Slave, periods_ns[0], key, encoded, paces[1])?;
        Ok(Self { master, slave, forward, backward, end_ns })
    }

    fn counts(&self) -> VirtualCounts {
        let Self { forward, backward, master, slave, .. } = self;
        VirtualCounts {
            overflowed: forward.in_flight.overflowed() + backward.in_flight.overflowed(),
            loops: [master.counts(), slave.counts()],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Compares with a plain list.
    #[test]
    fn unobserved_ticks_keep_their_order() {
        let (mut pending, mut expected) = (PendingTicks::<u64>::new(), Vec::new());
        let mut time_ns = 0;
        for round in 0..50 {
            pending.drop_observed();
            for _ in 0..round * 7 % 90 {
                let Some(record) = pending.push_slot(time_ns) else {
                    assert_eq!(expected.len(), MAX_BATCH_TICKS);
                    break;
                };
                *record = 2 * time_ns + 1;
                expected.push((time_ns, 2 * time_ns + 1));
                time_ns += 1;
            }
            for _ in 0..expected.len().min(round * 5 % 80) {
                assert_eq!(pending.pending()[0], expected[0]);
                assert_eq!(first_ns(pending.pending(), u64::MAX), expected[0].0);
                pending.observed += 1;
                expected.remove(0);
            }
            if round % 3 == 0 {
                pending = pending.copied();
                assert_eq!(pending.ticks, expected);
            }
            assert_eq!(pending.pending(), expected);
        }
        assert_eq!(first_ns::<u64>(&[], 7), 7);
        assert!(time_ns > 1000, "{time_ns}");
    }
}
