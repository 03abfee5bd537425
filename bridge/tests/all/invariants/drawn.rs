//! Scene drawn from a seed. It holds everything about a run, so that a failing one can be printed and repeated.

use super::{gripped::DrawnGripper, pressed::DrawnButtons, turned::DrawnPose};
use haptether_bridge::{Clutch, LadderSettings, OperatorCommand, coupling::CommandBounds};
use haptether_netsim::{
    Action, Attack, ByteRange, Checksum, ClockSettings, Direction, Edit, EndpointClock, Link, LinkSettings,
    Operation, Outage, OutageEffect, OutageTimes, Target,
};
use haptether_safety::{
    LimiterSettings,
    controller::{ControllerKind, SafetySettings},
    estimator::{EstimatorKind, Fit},
};

pub(crate) const MS: u64 = 1_000_000;

/// `SplitMix64`: a counter with mixed output.
#[derive(Clone, Debug)]
pub(crate) struct Numbers(pub(crate) u64);

impl Numbers {
    pub(crate) fn draw(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// Draw from `low` to `high`, without `high`.
    pub(crate) fn real(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * (self.draw() >> 11) as f64 / (1_u64 << 53) as f64
    }

    pub(crate) fn integer(&mut self, low: u64, high: u64) -> u64 {
        low + self.draw() % (high - low + 1)
    }

    pub(crate) fn chance(&mut self, probability: f64) -> bool {
        self.real(0.0, 1.0) < probability
    }

    pub(crate) fn one_of<T: Clone>(&mut self, of: &[T]) -> T {
        #[allow(clippy::cast_possible_truncation)] // below the length
        let index = (self.draw() % of.len() as u64) as usize;
        of[index].clone()
    }
}

/// Value of a faulty sensor, and its interval in ns.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Broken {
    pub(crate) from_ns: u64,
    pub(crate) until_ns: u64,
    pub(crate) value: f64,
}

impl Broken {
    pub(crate) fn draw(numbers: &mut Numbers, end_ns: u64) -> Option<Self> {
        let from_ns = numbers.integer(0, end_ns);
        let until_ns = from_ns + numbers.integer(1, 60 * MS);
        let value = numbers.one_of(&[
            f64::NAN,
            f64::INFINITY,
            f64::NEG_INFINITY,
            1e300,
            -1e7,
            f64::MIN_POSITIVE / 8.0,
        ]);
        numbers.chance(0.12).then_some(Self { from_ns, until_ns, value })
    }

    pub(crate) fn at(broken: Option<Self>, now_ns: u64) -> Option<f64> {
        broken.filter(|one| (one.from_ns..one.until_ns).contains(&now_ns)).map(|one| one.value)
    }
}

/// Control of the arm.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Control {
    Position,
    Velocity,
    Pd,
}

/// Drawn scene of a run.
#[derive(Clone, Debug)]
pub(crate) struct Drawn {
    pub(crate) axes: usize,
    pub(crate) periods_ns: [u64; 2],
    pub(crate) end_ns: u64,
    pub(crate) seed: u64,
    /// Mass in kg, viscous friction, and encoder quantum in m.
    pub(crate) device: [f64; 3],
    /// Stiffness, damping and grip strength.
    pub(crate) hand: [f64; 3],
    /// Legs of the hand's path along the first axis: duration in s and end in m.
    pub(crate) legs: Vec<(f64, f64)>,
    pub(crate) estimator: EstimatorKind,
    pub(crate) safety: SafetySettings,
    pub(crate) limiter: LimiterSettings,
    /// `lambda_p`, `lambda_f`.
    pub(crate) scales: [f64; 2],
    pub(crate) ladder: LadderSettings,
    pub(crate) clutch: Clutch,
    pub(crate) control: Control,
    /// Mass in kg, bandwidth in Hz and largest speed in m/s.
    pub(crate) arm: [f64; 3],
    pub(crate) max_acceleration: Option<f64>,
    /// Stiffness and damping of the wall that fills x < 0.
    pub(crate) wall: [f64; 2],
    /// Push on the arm in N.
    pub(crate) push_n: f64,
    pub(crate) bounds: CommandBounds,
    pub(crate) links: [LinkSettings; 2],
    pub(crate) clocks: [Option<ClockSettings>; 2],
    pub(crate) broken: [Option<Broken>; 2],
    /// Commands of people at both sides, in order of time.
    pub(crate) commands: Vec<(u64, OperatorCommand)>,
    /// True if frames travel in a secure session.
    pub(crate) secure: bool,
    /// Rotation; none for a point.
    pub(crate) pose: Option<DrawnPose>,
    pub(crate) buttons: Option<DrawnButtons>,
    pub(crate) gripper: Option<DrawnGripper>,
}

impl Drawn {
    pub(crate) fn new(seed: u64) -> Self {
        let mut numbers = Numbers(seed);
        let n = &mut numbers;
        // Without mixing, the streams of consecutive seeds would be alike.
        n.0 = n.draw();
        // A press waits at least 0.5 s. Few runs are so long, because they are slow.
        let is_long = n.chance(0.01);
        let end_ns = if is_long { 1200 } else { n.integer(120, 500) } * MS;
        let turns = n.chance(0.33);
        let axes = if turns || n.chance(0.1) { 3 } else { 1 };
        let stale_after_ns = n.integer(MS / 2, 10 * MS);
        let align_ns = if is_long { 500 * MS } else { LadderSettings::default().align_ns };
        let hold_after_ns = stale_after_ns + n.integer(MS / 2, 30 * MS);
        let drawn = Self {
            axes,
            periods_ns: [n.one_of(&[MS, MS, 2 * MS, 3 * MS]), n.one_of(&[MS, MS, 2 * MS, 4 * MS])],
            end_ns,
            seed: n.draw(),
            device: [n.real(0.05, 0.5), n.real(0.0, 0.1), n.one_of(&[0.0, 2.3e-5, 1e-4])],
            hand: [n.real(20.0, 800.0), n.real(0.0, 20.0), n.real(0.5, 40.0)],
            legs: (0..n.integer(1, 3)).map(|_| (n.real(0.02, 0.3), n.real(-0.1, 0.1))).collect(),
            estimator: estimator(n),
            safety: safety(n),
            limiter: LimiterSettings {
                max_force_n: n.real(0.5, 10.0),
                max_slew_n_per_s: n.real(20.0, 3000.0),
                max_power_w: n.one_of(&[0.2, 5.0, 1e4]),
                ramp_in_s: 0.0,
            },
            scales: [n.real(0.2, 4.0), n.real(0.1, 5.0)],
            ladder: LadderSettings {
                stale_after_ns,
                hold_after_ns,
                stop_after_ns: hold_after_ns + n.integer(1, 120 * MS),
                extrapolate_ns: n.integer(0, (20 * MS).min(hold_after_ns - stale_after_ns)),
                fade_out_ns: n.integer(50 * MS, 100 * MS),
                fade_in_ns: n.integer(200 * MS, 400 * MS),
                align_ns,
            },
            // Held from the start, through a silence that is longer than a press waits.
            clutch: if is_long { Clutch::Schedule(vec![(0, end_ns)]) } else { clutch(n, end_ns) },
            control: n.one_of(&[Control::Position, Control::Velocity, Control::Pd]),
            arm: [n.real(0.5, 8.0), n.real(2.0, 30.0), n.real(0.05, 3.0)],
            max_acceleration: n.chance(0.3).then(|| n.real(1.0, 50.0)),
            wall: [n.real(10.0, 2e4), n.real(0.0, 20.0)],
            push_n: n.real(-10.0, 10.0),
            bounds: CommandBounds {
                speed: n.one_of(&[0.05, 0.3, 3.0]),
                reach: n.one_of(&[0.02, f64::INFINITY, f64::INFINITY]),
            },
            links: [if is_long { silent(n) } else { link(n) }, link(n)],
            clocks: [clock(n), clock(n)],
            broken: [Broken::draw(n, end_ns), Broken::draw(n, end_ns)],
            commands: commands(n, end_ns, axes),
            secure: n.chance(0.5),
            pose: turns.then(|| DrawnPose::draw(n, end_ns, align_ns)),
            buttons: n.chance(0.25).then(|| DrawnButtons::draw(n, end_ns)),
            gripper: n.chance(0.4).then(|| DrawnGripper::draw(n, end_ns)),
        };
        drawn.without_refused_commands()
    }

    /// Remove refused commands: an arm with alignment keeps its scale of rotation.
    fn without_refused_commands(mut self) -> Self {
        if self.pose.as_ref().is_some_and(|pose| pose.slave.alignment.is_some()) {
            self.commands.retain(|(_, command)| !matches!(command, OperatorCommand::RotationScale(_)));
        }
        self
    }
}

pub(crate) fn estimator(n: &mut Numbers) -> EstimatorKind {
    n.one_of(&[
        EstimatorKind::BackwardDifference {},
        EstimatorKind::LowPass { cutoff_hz: 30.0 },
        EstimatorKind::AdaptiveWindow { noise_bound_m: 2.3e-5, max_window: 16, fit: Fit::End },
        EstimatorKind::default(),
    ])
}

pub(crate) fn safety(n: &mut Numbers) -> SafetySettings {
    SafetySettings {
        controllers: ControllerKind::ALL
            .into_iter()
            .zip([0.2, 0.2, 0.3, 0.2])
            .filter(|(_, odds)| n.chance(*odds))
            .map(|(kind, _)| kind)
            .collect(),
        damping: n.real(0.0, 3.0),
        pc_max_damping: n.real(0.0, 3.0),
        window: 20,
        ..SafetySettings::default()
    }
}

fn clutch(n: &mut Numbers, end_ns: u64) -> Clutch {
    if n.chance(0.2) {
        return Clutch::Auto { reaction_ns: n.integer(50 * MS, 150 * MS) };
    }
    let (mut times, mut at_ns) = (Vec::new(), n.integer(0, 20 * MS));
    while at_ns < end_ns {
        let press_ns = at_ns;
        at_ns += if n.chance(0.3) { end_ns } else { n.integer(1, 200 * MS) };
        times.push((press_ns, at_ns));
        at_ns += n.integer(1, 60 * MS);
    }
    Clutch::Schedule(times)
}

fn link(n: &mut Numbers) -> LinkSettings {
    let delay_s = if n.chance(0.1) { n.real(0.02, 0.1) } else { n.real(0.0, 0.015) };
    let jitter_s = if n.chance(0.4) { n.real(0.0, delay_s / 4.0) } else { 0.0 };
    let mut some = |probability: f64, most: f64| if n.chance(probability) { n.real(0.0, most) } else { 0.0 };
    let settings = LinkSettings {
        delay_s,
        jitter_s,
        loss: some(0.4, 0.3),
        reorder: some(0.3, 0.3),
        duplicate: some(0.3, 0.3),
        corrupt: some(0.2, 0.2),
        truncate: some(0.1, 0.1),
        ..LinkSettings::default()
    };
    let settings = LinkSettings {
        mean_burst: (settings.loss > 0.0).then(|| n.real(2.0, 40.0)),
        jitter_correlation_s: (jitter_s > 0.0).then(|| n.real(4.0, 40.0) * jitter_s),
        outages: (0..n.integer(0, 2)).map(|_| outage(n)).collect(),
        attacks: (0..n.integer(0, 4) / 3).map(|_| attack(n)).collect(),
        reorder_depth: 3,
        truncate_bytes: 40,
        ..settings
    };
    // Contradictory settings are not the subject of this test.
    if Link::new(Direction::Forward, 0, &settings).is_ok() {
        settings
    } else {
        LinkSettings { delay_s, ..LinkSettings::default() }
    }
}

/// Link that is cut soon after the start, for longer than a press waits.
fn silent(n: &mut Numbers) -> LinkSettings {
    let times = OutageTimes::Once { at_s: n.real(0.0, 0.02), duration_s: n.real(0.51, 0.7) };
    let outages = vec![Outage { times, effect: OutageEffect::Drop }];
    LinkSettings { delay_s: n.real(0.0, 0.015), outages, ..LinkSettings::default() }
}

fn outage(n: &mut Numbers) -> Outage {
    let times = OutageTimes::Once { at_s: n.real(0.02, 0.4), duration_s: n.real(0.002, 0.2) };
    Outage { times, effect: n.one_of(&[OutageEffect::Drop, OutageEffect::Hold]) }
}

fn attack(n: &mut Numbers) -> Attack {
    let actions = [
        Action::Replay { after_s: 0.05 },
        Action::Forge { keep_bytes: 64 },
        Action::BitFlip { bits: 3, within: ByteRange { start: 0, end: 64 } },
        Action::SequenceLead { lead: 1000, offset: 16 },
        // An attacker who knows the frame changes the position and corrects the checksum.
        Action::Alter {
            edits: vec![Edit::F64 { offset: 64, operation: Operation::Multiply, value: -1.0 }],
            checksum: Some(Checksum::Crc32),
            inject: n.chance(0.5),
        },
        Action::HoldBack { by_s: n.real(0.0, 0.1) },
        Action::Drop,
        Action::Mirror,
        Action::SecondSource,
    ];
    let action = n.one_of(&actions);
    let target = Target { from_s: n.real(0.0, 0.2), probability: n.real(0.0, 1.0), ..Target::default() };
    Attack { action, target }
}

fn clock(n: &mut Numbers) -> Option<ClockSettings> {
    let settings = ClockSettings {
        offset_s: n.real(-1e5, 1e5),
        drift_ppm: n.real(-1e4, 1e4),
        step_s: if n.chance(0.4) { n.real(0.0, 0.1) } else { 0.0 },
        step_at_s: n.real(0.05, 0.4),
    };
    (n.chance(0.3) && EndpointClock::new(&settings).is_ok()).then_some(settings)
}

fn commands(n: &mut Numbers, end_ns: u64, axes: usize) -> Vec<(u64, OperatorCommand)> {
    let mut commands: Vec<_> = (0..n.integer(0, 4))
        .map(|_| {
            let half = n.real(-1.5, 1.5);
            let turned = if axes == 3 { [half.cos(), 0.0, half.sin(), 0.0] } else { [1.0, 0.0, 0.0, 0.0] };
            let command = match n.integer(0, 8) {
                0 => OperatorCommand::PositionScale(n.real(0.1, 5.0)),
                1 => OperatorCommand::ForceScale(n.real(0.1, 5.0)),
                3 => OperatorCommand::RotationScale(n.real(0.1, 5.0)),
                4 => OperatorCommand::TorqueScale(n.real(0.1, 5.0)),
                5 => OperatorCommand::Press,
                6 => OperatorCommand::Release,
                2 => OperatorCommand::Frame {
                    quat_wxyz: turned,
                    locked: std::array::from_fn(|_| n.chance(0.3)),
                },
                _ => OperatorCommand::Acknowledge,
            };
            (n.integer(0, end_ns), command)
        })
        .collect();
    commands.sort_by_key(|(at_ns, _)| *at_ns);
    commands
}
