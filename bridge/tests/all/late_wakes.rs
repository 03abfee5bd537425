//! Loops that wake late on the same clock. The time of a tick is its deadline, and a frame received in it may have
//! been sent later. That is no clock fault.
#![allow(clippy::unwrap_used)] // a test may

use haptether_bridge::{
    FrameLink, LinkTime, PortState, Status,
    wire::{MAX_FRAME, Role},
};

const US: u64 = 1_000;
const MS: u64 = 1_000 * US;
const TICKS: u64 = 20_000;
/// Transit time of a frame in ns.
const ONE_WAY_NS: u64 = 30 * US;

/// One loop: its end of the link, its next deadline, and the frames in flight to it with their arrival times.
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

    /// Take the frames that have arrived, and return the sent frame with its time.
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

/// Return the clock faults that each side counts, and the shortest round trip of the first side in ns.
fn run(knows: bool) -> ([u64; 2], u64) {
    let mut loops = [Loop::new(Role::Master, 1, 10 * MS), Loop::new(Role::Slave, 2, 10 * MS + 500 * US)];
    let mut draw = 1_u64;
    for _ in 0..2 * TICKS {
        let turns = usize::from(loops[1].woken_ns < loops[0].woken_ns);
        let (leaves_ns, datagram) = loops[turns].step(knows);
        loops[1 - turns].inward.push((leaves_ns + ONE_WAY_NS, datagram));
        // Usually 20 us late, and one wake in sixteen up to 0.95 ms.
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
fn late_wakes_are_no_clock_fault() {
    let (faults, min_ns) = run(true);
    assert_eq!(faults, [0, 0]);
    // Never below the transit time there and back.
    assert!(min_ns >= 2 * ONE_WAY_NS, "{min_ns}");
}

#[test]
fn late_wakes_of_unknown_lateness_look_like_clock_faults() {
    let (faults, _) = run(false);
    assert!(faults[0] > 0 && faults[1] > 0, "{faults:?}");
}
