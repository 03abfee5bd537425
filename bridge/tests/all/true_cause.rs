//! The reason that one side has for its state reaches the other: codes, the driver's own text, and an end.
#![allow(clippy::unwrap_used)] // a test may

use LadderState::{Disengaged, Engaged, Fault, Hold, Stop};
use std::collections::VecDeque;

use haptether_bridge::{
    Clutch, DrivenMaster, DrivenSlave, FaultText, LadderSettings, LadderState, LinkTime, MasterEndpoint,
    MasterSettings, MasterSide, OperatorCommand, Reason, Remedy, Side, SlaveEndpoint, SlaveSettings,
    SlaveSide, TickTime, coupling::CommandBounds, wire::MAX_FRAME,
};
use haptether_safety::{
    Axes, DeviceModel, LimiterSettings, controller::SafetySettings, estimator::EstimatorKind,
};

const MS: u64 = 1_000_000;
const WORDS: &str = "Arm: OSError: the bus of joint 4 is down since the cable was pulled (own_arm.py:57)";

type Master = MasterSide<DrivenMaster<1>, 1>;
type Slave = SlaveSide<DrivenSlave<1>, 1>;

fn slave(session: u64) -> Slave {
    let endpoint = SlaveEndpoint::new(&SlaveSettings {
        period_ns: MS,
        run_id: session,
        position_scale: 1.0,
        bounds: CommandBounds::default(),
        ladder: LadderSettings::default(),
    })
    .unwrap();
    let mut plant = DrivenSlave::new(2.0).unwrap();
    plant.sample[2] = Axes::<1>::new(2.0);
    SlaveSide::new(plant, endpoint)
}

/// Two sides on a link that `passes` controls, and the clutch of the master.
struct Pair {
    master: Master,
    slave: Slave,
    now_ns: u64,
    clutch: bool,
}

impl Pair {
    fn new() -> Self {
        let endpoint = MasterEndpoint::new(&MasterSettings {
            period_ns: MS,
            run_id: 1,
            device: DeviceModel::uniform(0.1, 0.0, 0.0).unwrap(),
            estimator: EstimatorKind::default(),
            safety: SafetySettings::default(),
            limiter: LimiterSettings::default(),
            force_scale: 1.0,
            ladder: LadderSettings::default(),
        })
        .unwrap();
        let mut master = MasterSide::new(DrivenMaster::default(), endpoint, Clutch::Once).unwrap();
        let mut slave = slave(2);
        master.begin(0);
        slave.begin(0);
        Self { master, slave, now_ns: 0, clutch: true }
    }

    fn engaged() -> Self {
        let mut pair = Self::new();
        pair.run(500, |_| (true, true));
        assert_eq!(pair.states(), (Engaged, Engaged));
        assert!(pair.master.plant.force[0].abs() > 1.0);
        pair
    }

    fn states(&self) -> (LadderState, LadderState) {
        (self.master.exchange().state(), self.slave.exchange().state())
    }

    /// Run; `passes` returns for each tick whether frames reach the slave, and whether they reach the master.
    fn run(&mut self, ticks: u64, mut passes: impl FnMut(u64) -> (bool, bool)) {
        let mut buffer = [0; MAX_FRAME];
        for tick in 0..ticks {
            self.now_ns += MS;
            let (there, back) = passes(tick);
            self.master.plant.clutch = Some(self.clutch);
            self.master.tick(TickTime::at(self.now_ns));
            let frame = self.master.send(LinkTime::at(self.now_ns), &mut buffer).to_vec();
            if there {
                let _ = self.slave.receive(LinkTime::at(self.now_ns), &frame);
            }
            self.slave.tick(TickTime::at(self.now_ns));
            let frame = self.slave.send(LinkTime::at(self.now_ns), &mut buffer).to_vec();
            if back {
                let _ = self.master.receive(LinkTime::at(self.now_ns), &frame);
            }
        }
    }

    fn press(&mut self) {
        self.clutch = false;
        self.run(100, |_| (true, true));
        self.clutch = true;
        self.run(100, |_| (true, true));
    }
}

/// Return place, text and steps of a side's diagnosis.
fn explained(side: &impl Side) -> (&'static str, String, Vec<(&'static str, Remedy)>) {
    let explanation = side.exchange().flight().diagnosis().unwrap().explain();
    let steps = explanation.steps.iter().map(|step| (step.at, step.remedy)).collect();
    (explanation.at, explanation.text, steps)
}

fn reasons(side: &impl Side) -> Vec<String> {
    let flight: serde_json::Value = serde_json::from_str(&side.exchange().flight().to_json()).unwrap();
    let steps = flight["transitions"].as_array().unwrap();
    steps.iter().map(|step| step["reason"].as_str().unwrap().to_owned()).collect()
}

#[test]
fn fault_of_the_slave_is_reported_at_both_sides_in_the_drivers_words() {
    let mut pair = Pair::engaged();
    pair.slave.exchange_mut().device_failed(Some(&FaultText::new(WORDS)));
    // A driver reports it once, and two of three frames are lost.
    pair.run(400, |tick| (true, tick % 3 == 0));
    assert_eq!(pair.states(), (Stop, Fault));
    let steps = vec![("slave", Remedy::Acknowledge), ("master", Remedy::Press)];
    let expected = ("slave", format!("the slave has a fault: {WORDS}"), steps);
    assert_eq!(explained(&pair.master), expected);
    assert_eq!(explained(&pair.slave), expected);
    assert_eq!(reasons(&pair.master)[2..], ["peer has a fault", "no working peer for too long"]);

    // A press before the acknowledgement changes nothing, and the text stays.
    pair.press();
    assert_eq!(pair.states(), (Stop, Fault));
    assert_eq!(explained(&pair.master), expected);
    pair.slave.command(pair.now_ns, OperatorCommand::Acknowledge).unwrap();
    pair.run(100, |_| (true, true));
    assert_eq!(pair.states(), (Stop, Disengaged));
    assert_eq!(explained(&pair.master).2, [("master", Remedy::Press)]);
    pair.press();
    assert_eq!(pair.states(), (Engaged, Engaged));
    assert_eq!(
        (pair.master.exchange().flight().diagnosis(), pair.slave.exchange().flight().diagnosis()),
        (None, None)
    );
    let flight: serde_json::Value = serde_json::from_str(&pair.master.exchange().flight().to_json()).unwrap();
    let causes = flight["causes"].as_array().unwrap();
    assert_eq!(causes[0]["text"], expected.1);
    assert_eq!(
        (causes[0]["at"].as_str(), causes[0]["steps"][0]["remedy"].as_str()),
        (Some("slave"), Some("acknowledge"))
    );
}

#[test]
fn fault_of_the_master_is_reported_at_both_sides() {
    let mut pair = Pair::engaged();
    pair.master.exchange_mut().device_failed(Some(&FaultText::new(WORDS)));
    pair.run(400, |tick| (tick % 3 == 0, true));
    assert_eq!(pair.states(), (Fault, Stop));
    let steps = vec![("master", Remedy::Acknowledge), ("master", Remedy::Press)];
    let expected = ("master", format!("the master has a fault: {WORDS}"), steps);
    assert_eq!((explained(&pair.master), explained(&pair.slave)), (expected.clone(), expected));
}

/// An invalid number has no text of a driver: its code explains it at both sides.
#[test]
fn invalid_number_is_reported_by_its_code() {
    let mut pair = Pair::engaged();
    pair.slave.plant.sample[2][0] = f64::NAN;
    pair.run(100, |_| (true, true));
    let text = "the slave has a fault: environment force is not a finite number";
    assert_eq!((explained(&pair.master).1, explained(&pair.slave).1), (text.to_owned(), text.to_owned()));
}

/// A master that starts while the slave has a fault learns the reason before it ever engages.
#[test]
fn earlier_fault_is_reported_to_a_starting_master() {
    let mut pair = Pair::new();
    pair.slave.exchange_mut().device_failed(Some(&FaultText::new(WORDS)));
    pair.run(100, |_| (true, true));
    assert_eq!(explained(&pair.master).1, format!("the slave has a fault: {WORDS}"));
}

#[test]
fn hold_reports_whose_loop_was_late() {
    let mut pair = Pair::engaged();
    pair.slave.exchange_mut().stalled(pair.now_ns);
    pair.run(100, |_| (true, true));
    assert_eq!(pair.states(), (Hold, Hold));
    assert_eq!(
        explained(&pair.master),
        ("slave", "the slave held: its own loop was late".to_owned(), vec![("master", Remedy::Press)])
    );
    assert_eq!(explained(&pair.slave).1, "the slave's own loop was late");
    // A cut link is the fault of neither side.
    let mut pair = Pair::engaged();
    pair.run(300, |_| (false, true));
    assert_eq!(explained(&pair.slave).0, "link");
    assert_eq!(explained(&pair.master).0, "link");
}

/// Any one of the last frames is enough; all others are lost.
#[test]
fn an_orderly_end_is_no_hold() {
    for survivor in [0, 3] {
        let mut pair = Pair::engaged();
        pair.master.exchange_mut().end();
        pair.run(600, |tick| (tick == survivor, false));
        assert_eq!(pair.slave.exchange().state(), Disengaged);
        assert_eq!(reasons(&pair.slave).last().unwrap(), Reason::PeerEnded.text());
        assert_eq!(pair.slave.exchange().counts().holds, 0);
        assert_eq!(
            explained(&pair.slave),
            ("master", "the master has ended".to_owned(), vec![("master", Remedy::Start)])
        );

        let mut pair = Pair::engaged();
        pair.slave.exchange_mut().end();
        pair.run(600, |tick| (false, tick == survivor));
        assert_eq!((pair.master.exchange().state(), pair.master.exchange().counts().holds), (Disengaged, 0));
        assert_eq!(pair.master.plant.force[0], 0.0);
        let steps = vec![("slave", Remedy::Start), ("master", Remedy::Press)];
        assert_eq!(explained(&pair.master), ("slave", "the slave has ended".to_owned(), steps));
    }
}

/// The force fades as in any other decoupling, and a new slave needs a new press.
#[test]
fn end_fades_the_force_and_couples_nothing() {
    let mut pair = Pair::engaged();
    pair.slave.exchange_mut().end();
    let mut force = pair.master.plant.force[0].abs();
    for _ in 0..200 {
        pair.run(1, |_| (true, true));
        assert!(pair.master.plant.force[0].abs() <= force);
        force = pair.master.plant.force[0].abs();
    }
    assert_eq!((force, pair.master.exchange().state()), (0.0, Disengaged));
    pair.run(300, |_| (false, false));
    pair.slave = slave(3);
    pair.slave.begin(pair.now_ns);
    pair.run(300, |_| (true, true));
    assert_eq!(pair.master.exchange().state(), Disengaged, "the clutch waits, pressed");
    assert_eq!(pair.master.exchange().flight().diagnosis(), None, "another one is there");
    pair.press();
    assert_eq!(pair.states(), (Engaged, Engaged));
}

/// Without encryption anyone can forge an end. Then neither side continues alone.
#[test]
fn a_false_end_of_one_side_holds_the_other() {
    let mut pair = Pair::engaged();
    pair.slave.exchange_mut().peer_ended();
    pair.run(1, |_| (false, true));
    assert_eq!(pair.slave.exchange().state(), Disengaged);
    pair.run(100, |_| (true, true));
    assert_eq!(pair.states(), (Hold, Disengaged));
    assert_eq!(explained(&pair.master).1, "the slave received a message that the master has ended");
    pair.press();
    assert_eq!(pair.states(), (Engaged, Engaged));

    let mut pair = Pair::engaged();
    pair.master.exchange_mut().peer_ended();
    pair.run(1, |_| (true, false));
    pair.run(100, |_| (true, true));
    // A disengaged master takes its slave along, whatever the reason.
    assert_eq!(pair.states(), (Disengaged, Disengaged));
    pair.press();
    assert_eq!(pair.states(), (Engaged, Engaged));
}

/// A quick release and press over a long link is not an end: the slave opens after the master has closed again.
#[test]
fn quick_press_over_a_long_link_is_not_an_end() {
    let mut pair = Pair::engaged();
    let (mut there, mut back) = (VecDeque::new(), VecDeque::new());
    let mut buffer = [0; MAX_FRAME];
    let mut holds = pair.master.exchange().counts().holds;
    for tick in 0..3000_u64 {
        pair.now_ns += MS;
        let now_ns = pair.now_ns;
        // The delay of 150 ms starts with the run, and a press leaves the hold that it causes. A release shorter than
        // 20 ms may be a bounce, and no press counts after it.
        let released = [400..430, 1000..1030, 1500..1525].iter().any(|open| open.contains(&tick));
        pair.master.plant.clutch = Some(!released);
        pair.master.tick(TickTime::at(now_ns));
        there.push_back(pair.master.send(LinkTime::at(now_ns), &mut buffer).to_vec());
        pair.slave.tick(TickTime::at(now_ns));
        back.push_back(pair.slave.send(LinkTime::at(now_ns), &mut buffer).to_vec());
        if there.len() > 150 {
            let _ = pair.slave.receive(LinkTime::at(now_ns), &there.pop_front().unwrap());
            let _ = pair.master.receive(LinkTime::at(now_ns), &back.pop_front().unwrap());
        }
        if tick == 999 {
            assert_eq!(pair.states(), (Engaged, Engaged));
            holds = pair.master.exchange().counts().holds;
        }
    }
    assert_eq!(pair.states(), (Engaged, Engaged));
    assert_eq!(pair.master.exchange().counts().holds, holds);
}

/// A released session has the same effect if none of the last frames arrived.
#[test]
fn a_released_session_is_an_end() {
    let mut pair = Pair::engaged();
    pair.slave.exchange_mut().peer_ended();
    pair.run(600, |_| (false, false));
    assert_eq!((pair.slave.exchange().state(), pair.slave.exchange().counts().holds), (Disengaged, 0));
    assert_eq!(explained(&pair.slave).1, "the master has ended");
}

/// A driver that raised an exception ends its run: the fault stays, because it explains more than the end.
#[test]
fn a_failure_that_ends_a_run_stays_a_failure() {
    let mut pair = Pair::engaged();
    pair.slave.exchange_mut().device_failed(Some(&FaultText::new(WORDS)));
    pair.run(30, |_| (true, true));
    pair.slave.exchange_mut().end();
    pair.run(5, |_| (true, true));
    pair.run(600, |_| (false, false));
    let steps = vec![("slave", Remedy::Start), ("master", Remedy::Press)];
    let text = format!("the slave has a fault, and has ended: {WORDS}");
    assert_eq!(explained(&pair.master), ("slave", text, steps));
}
