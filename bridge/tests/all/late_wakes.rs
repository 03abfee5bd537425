//! Loops that wake late on one and the same clock: a tick's time is its deadline, and what it takes may have been sent
//! after that. Nothing of it is a fault of a clock.
#![allow(clippy::unwrap_used)] // a test may

use haptether_bridge::{
    FrameLink, LinkTime, PortState, Status,
    wire::{MAX_FRAME, Role},
};

const US: u64 = 1_000;
const MS: u64 = 1_000 * US;
const TICKS: u64 = 20_000;
/// What a frame takes.
const ONE_WAY_NS: u64 = 30 * US;

/// One loop: its end of the link, its next deadline, and what is in flight to it with the time of its arrival.
struct Loop {
    link: FrameLink,
    deadline_ns: u64,
    woken_ns: u64,
    inward: Vec<(u64, Vec<u8>)>,
}

impl Loop {
    fn new(role: Role, run_id: u64, first_ns: u64) -> Self {
        Self {
            link: FrameLink::new(role, 1, run_id, 1_000 * MS),
            deadline_ns: first_ns,
            woken_ns: first_ns,
            inward: Vec::new(),
        }
    }

    /// Take what has arrived, and return what it sends with the time at which it leaves.
    fn step(&mut self, knows: bool) -> (u64, Vec<u8>) {
        let (now_ns, woken_ns) = (self.deadline_ns, self.woken_ns);
        let time = LinkTime { tick_ns: now_ns, by_ns: if knows { woken_ns } else { now_ns } };
        for (_, datagram) in self.inward.extract_if(.., |(arrives_ns, _)| *arrives_ns <= woken_ns) {
            self.link.receive(time, &datagram).unwrap();
        }
        let status = Status { hears_peer: true, ..Status::default() };
        let mut buffer = [0; MAX_FRAME];
        (woken_ns, self.link.send(time, status, PortState::default(), &mut buffer).to_vec())
    }
}

/// Faults of a clock that each side counts, and the shortest round trip of the first in ns.
fn run(knows: bool) -> ([u64; 2], u64) {
    let mut loops = [Loop::new(Role::Master, 1, 10 * MS), Loop::new(Role::Slave, 2, 10 * MS + 500 * US)];
    let mut draw = 1_u64;
    for _ in 0..2 * TICKS {
        let turns = usize::from(loops[1].woken_ns < loops[0].woken_ns);
        let (leaves_ns, datagram) = loops[turns].step(knows);
        loops[1 - turns].inward.push((leaves_ns + ONE_WAY_NS, datagram));
        // Mostly 20 us late, one wake in sixteen by up to 0.95 ms.
        draw = draw.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        let late_ns = if draw >> 60 == 0 { (draw >> 20) % (950 * US) } else { 20 * US };
        loops[turns].deadline_ns += MS;
        loops[turns].woken_ns = loops[turns].deadline_ns + late_ns;
    }
    let faults =
        [0, 1].map(|side: usize| loops[side].link.path().report(loops[side].deadline_ns).clock_faults);
    (faults, loops[0].link.statistics().min_round_trip_ns)
}

#[test]
fn late_wakes_are_no_fault_of_a_clock() {
    let (faults, min_ns) = run(true);
    assert_eq!(faults, [0, 0]);
    // Never below what a frame takes there and back.
    assert!(min_ns >= 2 * ONE_WAY_NS, "{min_ns}");
}

#[test]
fn and_would_be_if_their_lateness_were_not_known() {
    let (faults, _) = run(false);
    assert!(faults[0] > 0 && faults[1] > 0, "{faults:?}");
}
