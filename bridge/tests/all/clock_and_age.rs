//! Clock of the peer and age of packets, from real frames over netsim links with clock errors.
#![allow(clippy::unwrap_used)] // a test may

use std::ops::ControlFlow;

use haptether_bridge::{
    Event, Exchange, LadderSettings, LinkTime, OperatorCommand, PeerPath, RejectReason, Side, TickTime,
    VirtualSettings,
    coupling::CouplingError,
    path::{ClockFault, PeerOffset},
    run_virtual,
    wire::Role,
};
use haptether_netsim::{ClockSettings as ClockOf, Distribution, EndpointClock, LinkSettings};

const MS: u64 = 1_000_000;
const S: u64 = 1000 * MS;
const TICKS: u64 = 20_000;

/// Side that only measures.
struct Measuring {
    exchange: Exchange,
    faults: Vec<(u64, ClockFault)>,
}

/// State of a side at a tick.
#[derive(Clone, Copy, Default)]
struct Known {
    time: TickTime,
    /// Sequence of the newest frame of the peer.
    newest: Option<u64>,
    offset: Option<PeerOffset>,
    /// Upper bound of the frame's age in ns.
    max_age_ns: Option<u64>,
    steps: u64,
}

impl Measuring {
    fn new(role: Role, session: u64) -> Self {
        // The lease of the link is longer than any silence here, and the clutch is never pressed.
        let ladder = LadderSettings { stop_after_ns: 10 * S, ..LadderSettings::default() };
        Self { exchange: Exchange::new(role, 1, session, MS, ladder).unwrap(), faults: Vec::new() }
    }

    fn path(&self) -> &PeerPath {
        self.exchange.link().path()
    }
}

impl Side for Measuring {
    type Record = Known;

    fn begin(&mut self, _: u64) {}

    fn receive(&mut self, time: LinkTime, datagram: &[u8]) -> Result<(), RejectReason> {
        let before = self.path().report(time.tick_ns).clock_faults;
        self.exchange.receive(time, datagram)?;
        let report = self.path().report(time.tick_ns);
        if report.clock_faults > before {
            self.faults.extend(report.last_fault.map(|fault| (time.tick_ns, fault)));
        }
        Ok(())
    }

    fn tick_into(&mut self, time: TickTime, known: &mut Known) {
        let report = self.path().report(time.clock_ns);
        *known = Known {
            time,
            newest: self.exchange.link().newest().map(|frame| frame.sequence),
            offset: report.offset,
            max_age_ns: self.path().max_age_ns(time.clock_ns),
            steps: report.steps,
        };
    }

    fn command(&mut self, _: u64, _: OperatorCommand) -> Result<bool, CouplingError> {
        Ok(false)
    }

    fn rest(&mut self) {}

    fn exchange(&self) -> &Exchange {
        &self.exchange
    }

    fn exchange_mut(&mut self) -> &mut Exchange {
        &mut self.exchange
    }
}

/// Time of a clock step in ns.
const STEP_NS: u64 = 10 * S;

fn endpoint_clock(offset_s: f64, drift_ppm: f64, step_s: f64) -> ClockOf {
    ClockOf { offset_s, drift_ppm, step_s, step_at_s: STEP_NS as f64 * 1e-9 }
}

fn link(delay_s: f64, jitter_s: f64, loss: f64) -> LinkSettings {
    LinkSettings { delay_s, jitter_s, distribution: Distribution::Uniform, loss, ..LinkSettings::default() }
}

/// True send times of frames in ns, by sequence, and the true clocks for the checks.
struct Truth {
    clocks: [EndpointClock; 2],
    steps: [bool; 2],
    sent_ns: [Vec<u64>; 2],
    checked: [u64; 2],
}

impl Truth {
    /// Check the state of side `own`.
    fn check(&mut self, own: usize, known: &Known) {
        let (now_ns, peer) = (known.time.now_ns, 1 - own);
        self.sent_ns[own].push(now_ns);
        let seen = now_ns < STEP_NS || known.steps == u64::from(self.steps[0] || self.steps[1]);
        if let Some(PeerOffset { offset_ns, bound_ns }) = known.offset
            && seen
        {
            let truth = self.clocks[peer].reading_ns(now_ns) - self.clocks[own].reading_ns(now_ns);
            // On either side, a loop wakes up to 1 ns after its deadline, and frames carry the deadline.
            let error = offset_ns.abs_diff(truth);
            assert!(error <= bound_ns + 2, "{own} at {now_ns}: {error} of {bound_ns}");
            self.checked[own] += 1;
        }
        // Age is measured on the side's own clock, so only the peer's clock may step.
        if let (Some(sequence), Some(max_age_ns), false) = (known.newest, known.max_age_ns, self.steps[own]) {
            let sent_ns = self.sent_ns[peer][usize::try_from(sequence).unwrap()];
            let own_ns = |true_ns| self.clocks[own].reading_ns(true_ns);
            let truth = (own_ns(now_ns) - own_ns(sent_ns)).unsigned_abs();
            assert!(max_age_ns + 1 >= truth, "{own} at {now_ns}: {max_age_ns} of {truth}");
        }
    }
}

/// Return both sides after the run, and the number of checks of each.
fn run(settings: [ClockOf; 2], links: [LinkSettings; 2], seed: u64) -> (Vec<Measuring>, [u64; 2]) {
    let clocks = settings.map(|settings| EndpointClock::new(&settings).unwrap());
    let [forward, backward] = links;
    let run = VirtualSettings {
        period_ns: MS,
        slave_period_ns: 2 * MS,
        ticks: TICKS,
        forward,
        backward,
        seed,
        secure: false,
        encoded: true,
        master_clock: Some(clocks[0]),
        slave_clock: Some(clocks[1]),
    };
    let (mut master, mut slave) = (Measuring::new(Role::Master, 1), Measuring::new(Role::Slave, 2));
    let steps = settings.map(|settings| settings.step_s != 0.0);
    let mut truth = Truth { clocks, steps, sent_ns: [vec![], vec![]], checked: [0; 2] };
    run_virtual(&run, &mut master, &mut slave, |event, _| {
        match event {
            Event::Master(known) => truth.check(0, known),
            Event::Slave(known) => truth.check(1, known),
        }
        ControlFlow::Continue(())
    })
    .unwrap();
    (vec![master, slave], truth.checked)
}

#[test]
fn bounds_hold_without_faults_for_wrong_clocks_and_bad_links() {
    let paths = [
        [link(0.0, 0.0, 0.0), link(0.0, 0.0, 0.0)],
        [link(0.02, 0.005, 0.05), link(0.02, 0.005, 0.05)],
        // The offset cannot show that one direction takes twelve times as long as the other.
        [link(0.005, 0.001, 0.3), link(0.06, 0.02, 0.3)],
    ];
    for (seed, links) in (0..).zip(&paths) {
        for [near_ppm, far_ppm] in [[0.0, 0.0], [80.0, -100.0], [-100.0, 95.0]] {
            let clocks = [endpoint_clock(-1.5, near_ppm, 0.0), endpoint_clock(1e6, far_ppm, 0.0)];
            let (sides, checked) = run(clocks, links.clone(), seed);
            for side in sides {
                assert_eq!(side.faults, [], "{seed} {near_ppm} {far_ppm}");
            }
            assert!(checked[0] > TICKS * 9 / 10 && checked[1] > TICKS * 4 / 10, "{checked:?}");
        }
    }
}

#[test]
fn a_step_is_reported_within_a_round_trip_by_both_sides() {
    let links = [link(0.02, 0.005, 0.05), link(0.02, 0.005, 0.05)];
    for (whose, step_ms) in [(1, 300), (1, -300), (0, 300), (0, -300), (1, 3_600_000), (0, 3_600_000_i32)] {
        let step_s = f64::from(step_ms) * 1e-3;
        let mut steps_s = [0.0; 2];
        steps_s[whose] = step_s;
        let clocks = [endpoint_clock(-1.5, 80.0, steps_s[0]), endpoint_clock(1e6, -100.0, steps_s[1])];
        let settings = clocks.map(|clock| EndpointClock::new(&clock).unwrap());
        let (sides, checked) = run(clocks, links.clone(), 7);
        // The offset is known again one round trip after the proof of the step.
        assert!(checked[0] > TICKS * 9 / 10 && checked[1] > TICKS * 4 / 10, "{checked:?}");
        for (own, side) in sides.iter().enumerate() {
            assert_eq!(
                side.path().report(u64::MAX >> 1).steps,
                1,
                "{whose} {step_s}, {own}: {:?}",
                side.faults
            );
            let step = side.faults.iter().find_map(|&(_, fault)| match fault {
                ClockFault::Step { by_ns, at_least_ns, .. } => Some((by_ns, at_least_ns)),
                _ => None,
            });
            let (by_ns, at_least_ns) = step.unwrap();
            // Seen from the other side a step has the opposite sign.
            let seen_s = if own == whose { -step_s } else { step_s };
            assert_eq!(by_ns > 0, seen_s > 0.0, "{whose} {step_s}, {own}: {by_ns}");
            let step_ns = u64::from(step_ms.unsigned_abs()) * MS;
            assert!(at_least_ns <= step_ns, "{whose} {step_s}: {at_least_ns}");
            // A loop whose own clock is set back waits. In the backlog after that, the apparent step grows from frame
            // to frame, and the first proof is reported.
            if own != whose || step_s > 0.0 {
                // The bound is lower by both directions and ticks, at most 20 + 8.7 ms each, because their share
                // cannot be distinguished from a step. It is also lower by the drift of 200 ppm over the step of the
                // side's own clock.
                let parted_ns = step_ns / 5_000;
                assert!(at_least_ns >= step_ns - 64 * MS - parted_ns, "{whose} {step_s}: {at_least_ns}");
                let off_ns = by_ns.unsigned_abs().abs_diff(step_ns);
                assert!(off_ns < 40 * MS + 2 * parted_ns, "{whose} {step_s}: {by_ns}");
            }
            let (at_ns, _) = side.faults[0];
            // 62 ms for both directions and ticks, and ten frames lost in a row, which never happens here at 5 %.
            let stepped_ns = settings[own].reading_ns(10 * S).cast_unsigned().wrapping_add(1 << 62);
            assert!(
                at_ns.saturating_sub(stepped_ns) < 82 * MS + step_ns.min(300 * MS),
                "{whose} {step_s}, {own}"
            );
        }
    }
}
