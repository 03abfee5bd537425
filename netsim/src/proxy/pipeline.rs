//! One direction of the proxy: a link, its datagrams in flight, and its statistics.

use super::Clock;
use super::batch::{BufferPool, Destinations, MAX_DATAGRAM, MAX_SENT, Outgoing, Sender, Slot};
use super::log::{Log, Record};
use super::ports::{Egress, EgressSocket, Ports, Routes};
use super::statistics::{DirectionRecorder, Recorder, count};
use crate::checks::LinkSettingsError;
use crate::damage::Damage;
use crate::impairments::LinkSettings;
use crate::in_flight::{DEFAULT_CAPACITY, InFlight};
use crate::link::{Link, Rules};
use crate::packet::{Direction, Packet};
use crate::verdict::{DropCause, ExtraCause, Judgement, Verdict};
use arrayvec::ArrayVec;
use std::io::IoSlice;
use std::sync::atomic::{AtomicBool, Ordering, Ordering::Relaxed};
use std::sync::{Arc, Mutex, PoisonError};

/// Log: the socket refused the datagram, or its client was gone.
const UNSENT: &str = "unsent";
/// Log: the proxy stopped before the datagram was due.
const UNFINISHED: &str = "unfinished";

/// Metadata of a datagram in flight.
#[derive(Clone, Copy, Debug)]
struct Datagram {
    /// Fixed at arrival, so that an answer to a replaced client does not reach the new one.
    egress: Egress,
    index: u64,
    extra: Option<ExtraCause>,
    in_ns: u64,
    size: usize,
}

#[derive(Debug)]
pub(super) struct DirectionPipeline {
    link: Link,
    pub(super) change: Arc<Change>,
    queue: InFlight<Slot>,
    buffers: BufferPool<Datagram>,
    next_index: u64,
}

pub(super) struct Metrics<'a> {
    pub(super) record: &'a Recorder,
    pub(super) log: &'a mut Option<Log>,
}

impl Metrics<'_> {
    fn of(&self, direction: Direction) -> &DirectionRecorder {
        match direction {
            Direction::Forward => &self.record.forward,
            Direction::Backward => &self.record.backward,
        }
    }

    fn log(&mut self, record: impl FnOnce() -> Record) {
        if let Some(log) = self.log {
            log.push(record(), &self.record.log_lost);
        }
    }
}

impl DirectionPipeline {
    pub(super) fn new(
        direction: Direction,
        seed: u64,
        settings: &LinkSettings,
    ) -> Result<Self, LinkSettingsError> {
        Ok(Self {
            link: Link::new(direction, seed, settings)?,
            change: Arc::default(),
            queue: InFlight::with_capacity(DEFAULT_CAPACITY),
            buffers: BufferPool::with_capacity(DEFAULT_CAPACITY),
            next_index: 0,
        })
    }

    pub(super) fn next_due(&self) -> Option<u64> {
        self.queue.next_due()
    }

    pub(super) fn take_up_change(&mut self) {
        self.change.take_up(&mut self.link);
    }

    /// Judge a datagram that arrived at `now_ns`, and keep it and its extras until they are due.
    pub(super) fn accept(
        &mut self,
        now_ns: u64,
        datagram: &[u8],
        routes: &Routes,
        metrics: &mut Metrics<'_>,
        mut observe: impl FnMut(&Packet, &Judgement<'_>),
    ) {
        let direction = self.link.direction();
        if datagram.len() > MAX_DATAGRAM {
            count(&metrics.of(direction).oversize);
            return;
        }
        let packet = Packet { direction, sent_ns: now_ns, size: datagram.len(), index: self.next_index };
        self.next_index += 1;
        let Self { link, queue, buffers, .. } = self;
        let judgement = link.judge(&packet);
        let mut enqueue = |at_ns, damage: &Damage, about: Datagram| {
            // Pool and queue have equal capacity: a free cell implies room in the queue, so no slot is lost.
            let slot = buffers.store(datagram, about, |bytes| damage.apply(bytes));
            slot.ok_or(DropCause::InFlight).and_then(|slot| queue.push(at_ns, slot))
        };
        let about = Datagram {
            egress: routes.on,
            index: packet.index,
            extra: None,
            in_ns: now_ns,
            size: packet.size,
        };
        let verdict = match judgement.verdict {
            Verdict::Deliver { at_ns } => match enqueue(at_ns, judgement.damage, about) {
                Ok(()) => judgement.verdict,
                Err(cause) => Verdict::Drop { cause },
            },
            lost @ Verdict::Drop { .. } => lost,
        };
        count(&metrics.of(direction).received);
        match verdict {
            Verdict::Deliver { .. } if !judgement.damage.is_none() => count(&metrics.of(direction).damaged),
            Verdict::Deliver { .. } => {}
            Verdict::Drop { cause } => {
                metrics.of(direction).dropped(cause);
                metrics.log(|| about.record(direction, None, None, cause.name()));
            }
        }
        for extra in judgement.extras {
            let egress = match extra.cause {
                ExtraCause::Mirror => routes.back,
                ExtraCause::SecondSource => routes.beside,
                _ => routes.on,
            };
            let about = Datagram { egress, extra: Some(extra.cause), ..about };
            count(&metrics.of(direction).extras);
            if let Err(cause) = enqueue(extra.at_ns, &extra.damage, about) {
                count(&metrics.of(direction).extras_lost);
                metrics.log(|| about.record(direction, Some(extra.at_ns), None, cause.name()));
            }
        }
        observe(&packet, &Judgement { verdict, ..judgement });
        let overtaking = self.link.counters().overtaking;
        metrics.of(direction).overtaking.store(overtaking, Relaxed);
    }

    /// Send what is due by `now_ns`, with one call per run of datagrams for the same socket.
    pub(super) fn release(
        &mut self,
        now_ns: u64,
        clock: Clock,
        ports: &Ports,
        sender: &mut Sender,
        metrics: &mut Metrics<'_>,
    ) {
        let mut next = self.queue.pop_due(now_ns);
        while let Some((due_ns, slot)) = next.take() {
            let mut batch: ArrayVec<(u64, Slot), MAX_SENT> = ArrayVec::new();
            let socket = self.socket(&slot);
            batch.push((due_ns, slot));
            while !batch.is_full() {
                let Some((due_ns, slot)) = self.queue.pop_due(now_ns) else {
                    break;
                };
                if self.socket(&slot) != socket {
                    next = Some((due_ns, slot));
                    break;
                }
                batch.push((due_ns, slot));
            }
            self.send(batch, socket, clock, ports, sender, metrics);
            if next.is_none() {
                next = self.queue.pop_due(now_ns);
            }
        }
    }

    fn socket(&self, slot: &Slot) -> Option<EgressSocket> {
        self.buffers.about(slot).map(|datagram| datagram.egress.socket().0)
    }

    fn send(
        &mut self,
        batch: ArrayVec<(u64, Slot), MAX_SENT>,
        socket: Option<EgressSocket>,
        clock: Clock,
        ports: &Ports,
        sender: &mut Sender,
        metrics: &mut Metrics<'_>,
    ) {
        let direction = self.link.direction();
        let mut taken = 0;
        let mut out_ns = 0;
        if let Some((fd, asked)) = socket.and_then(|to| ports.egress_socket(to).map(|fd| (fd, to.asked()))) {
            let outgoing: Outgoing<'_> =
                batch.iter().map(|(_, slot)| [IoSlice::new(self.buffers.read(slot))]).collect();
            let destinations: Destinations = batch
                .iter()
                .map(|(_, slot)| self.buffers.about(slot).and_then(|datagram| datagram.egress.socket().1))
                .collect();
            out_ns = clock.now_ns();
            taken = sender.send(fd, &outgoing, &destinations, asked, &metrics.record.peer_unreachable);
        }
        for (n, (due_ns, slot)) in batch.into_iter().enumerate() {
            let is_sent = taken & (1 << n) != 0;
            if is_sent {
                match out_ns.checked_sub(due_ns) {
                    Some(error_ns) => metrics.record.scheduling_error.record(error_ns),
                    None => count(&metrics.record.early),
                }
            }
            if let Some(datagram) = self.buffers.about(&slot) {
                let to = metrics.of(direction);
                count(match (datagram.extra, is_sent) {
                    (None, true) => &to.released,
                    (None, false) => &to.unsent,
                    (Some(_), true) => &to.extras_released,
                    (Some(_), false) => &to.extras_lost,
                });
                let cause = if is_sent { "" } else { UNSENT };
                metrics.log(|| datagram.record(direction, Some(due_ns), is_sent.then_some(out_ns), cause));
            }
            self.buffers.release(slot);
        }
    }

    /// Logs datagrams that will not leave.
    pub(super) fn give_up(&mut self, metrics: &mut Metrics<'_>) {
        let direction = self.link.direction();
        while let Some((due_ns, slot)) = self.queue.pop_due(u64::MAX) {
            if let Some(datagram) = self.buffers.about(&slot) {
                metrics.log(|| datagram.record(direction, Some(due_ns), None, UNFINISHED));
            }
            self.buffers.release(slot);
        }
    }
}

impl Datagram {
    fn record(
        &self,
        direction: Direction,
        due_ns: Option<u64>,
        out_ns: Option<u64>,
        cause: &'static str,
    ) -> Record {
        let kind = self.extra.map_or("", ExtraCause::name);
        Record {
            direction,
            index: self.index,
            kind,
            in_ns: self.in_ns,
            due_ns,
            out_ns,
            cause,
            size: self.size,
        }
    }
}

/// Handle by which any thread changes the rules of a running proxy.
#[derive(Clone, Debug)]
pub struct ProxyControl {
    pub(super) seed: u64,
    pub(super) forward: Arc<Change>,
    pub(super) backward: Arc<Change>,
}

impl ProxyControl {
    /// Apply new settings to later datagrams; those in flight keep their verdicts.
    ///
    /// Settings are checked and built on the caller's thread. The proxy adopts them when it next wakes,
    /// within 20 ms. A pending change is replaced.
    pub fn change(&self, direction: Direction, settings: &LinkSettings) -> Result<(), LinkSettingsError> {
        self.change_rules(direction, Rules::build(direction, self.seed, settings)?);
        Ok(())
    }

    pub(crate) fn change_rules(&self, direction: Direction, rules: Rules) {
        let change = match direction {
            Direction::Forward => &self.forward,
            Direction::Backward => &self.backward,
        };
        change.put(rules);
    }
}

/// Pending rules; afterwards the replaced ones, so that the proxy's thread frees nothing.
#[derive(Debug, Default)]
pub(super) struct Change {
    is_waiting: AtomicBool,
    rules: Mutex<Option<Rules>>,
}

impl Change {
    fn put(&self, rules: Rules) {
        let replaced = {
            let mut slot = self.rules.lock().unwrap_or_else(PoisonError::into_inner);
            let replaced = slot.replace(rules);
            self.is_waiting.store(true, Ordering::Release);
            replaced
        };
        drop(replaced);
    }

    /// Adopts pending rules, unless another thread holds the lock: then at the next call.
    fn take_up(&self, link: &mut Link) {
        if !self.is_waiting.load(Ordering::Acquire) {
            return;
        }
        if let Ok(mut slot) = self.rules.try_lock()
            && let Some(rules) = slot.as_mut()
        {
            link.swap(rules);
            self.is_waiting.store(false, Ordering::Release);
        }
    }
}
