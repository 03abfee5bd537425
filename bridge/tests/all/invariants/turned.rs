//! Rotation in a scene of kind pose: drawn values and invariants.

use haptether_bridge::{
    MasterRotation, MasterRotationSettings, SlaveRotationSettings, TickTime,
    coupling::{AlignmentSettings, RotationBounds, RotationLock},
};
use haptether_safety::{
    ActiveLimits, Axes, LimiterSettings, RotationModel,
    controller::{ControllerKind, Tripped},
};
use nalgebra::UnitQuaternion;

use super::{
    drawn::{MS, Numbers, estimator, safety},
    homes::Homes,
    spied::{ROUNDING, Watch},
};

/// Lever in m at which a handle is held.
const LEVER_M: f64 = 0.05;
/// Rounding error in rad of an angle from an inverse cosine.
const ANGLE: f64 = 3e-8;
/// Bit for the bound on the angle in the limits of a command.
const TURN: u8 = 8;
/// Largest angle in rad to the master at the engagement of an aligned arm.
const ALIGNED: f64 = 0.01;

/// Fault of a rotation sensor.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Wrong {
    /// Norm of the quaternion.
    Norm(f64),
    /// No orientation.
    Unknown,
    /// Angular velocity of one axis.
    Speed(f64),
    /// Torque about one axis.
    Torque(f64),
    /// Sudden turn in rad.
    Leap(f64),
}

impl Wrong {
    /// Return true if no device can measure this. A leap may be a motion of the hand.
    pub(crate) fn is_none(self) -> bool {
        let is_possible = match self {
            Self::Norm(norm) => (norm.abs() - 1.0).abs() <= 1e-9,
            Self::Unknown => false,
            Self::Speed(value) => value.abs() <= 1e3,
            Self::Torque(value) => value.abs() <= 1e4,
            Self::Leap(_) => true,
        };
        !is_possible
    }
}

/// Faulty rotation sensor, with its interval in ns.
#[derive(Clone, Copy, Debug)]
pub(crate) struct BrokenTurn {
    from_ns: u64,
    until_ns: u64,
    wrong: Wrong,
}

impl BrokenTurn {
    fn draw(n: &mut Numbers, end_ns: u64) -> Option<Self> {
        let from_ns = n.integer(0, end_ns);
        let until_ns = from_ns + n.integer(1, 60 * MS);
        let number = n.one_of(&[f64::NAN, f64::INFINITY, 1e300, -1e7, f64::MIN_POSITIVE / 8.0]);
        let wrong = match n.integer(0, 6) {
            0 => Wrong::Unknown,
            1 => Wrong::Speed(number),
            2 => Wrong::Torque(number),
            3 => Wrong::Leap(n.real(0.0, 3.1)),
            _ => Wrong::Norm(n.one_of(&[f64::NAN, 0.0, 1e-200, 1e200, 1.1, 1.0 + 1e-8, 1.0 + 1e-10, -1.0])),
        };
        n.chance(0.12).then_some(Self { from_ns, until_ns, wrong })
    }

    pub(crate) fn at(broken: Option<Self>, now_ns: u64) -> Option<Wrong> {
        broken.filter(|one| (one.from_ns..one.until_ns).contains(&now_ns)).map(|one| one.wrong)
    }
}

/// Drawn rotation of hand and arm.
#[derive(Clone, Debug)]
pub(crate) struct DrawnPose {
    /// Turns of the hand: end in s and angular velocity in rad/s.
    pub(crate) turns: Vec<(f64, Axes<3>)>,
    /// True if the device, or the arm, is a rigid body that yields to torques.
    pub(crate) is_modelled: [bool; 2],
    pub(crate) measures: bool,
    pub(crate) inertia_kg_m2: f64,
    /// Orientations of master and slave at the start.
    pub(crate) starts: [UnitQuaternion<f64>; 2],
    /// Stiffness in N m/rad against which the arm turns.
    pub(crate) stiffness: f64,
    pub(crate) broken: [Option<BrokenTurn>; 2],
    pub(crate) lock: RotationLock,
    pub(crate) master: MasterRotationSettings,
    pub(crate) slave: SlaveRotationSettings,
    /// Coupled point of the tool, in m from the tool point in the tool's frame.
    pub(crate) reference_m: Option<Axes<3>>,
    /// Turn in rad of a driven arm by a person before it is led.
    pub(crate) moved_rad: Option<Axes<3>>,
}

fn direction(n: &mut Numbers) -> Axes<3> {
    let axis = Axes::<3>::from_fn(|_, _| n.real(-1.0, 1.0));
    axis.try_normalize(1e-3).unwrap_or_else(Axes::<3>::z)
}

fn orientation(n: &mut Numbers) -> UnitQuaternion<f64> {
    let angle = n.real(-3.1, 3.1);
    UnitQuaternion::from_scaled_axis(direction(n) * angle)
}

impl DrawnPose {
    /// Draw the rotation; `align_ns` is the time for which a press waits.
    pub(crate) fn draw(n: &mut Numbers, end_ns: u64, align_ns: u64) -> Self {
        let inertia_kg_m2 = n.real(1e-4, 2e-3);
        let mut at_s = 0.0;
        // Turn about one axis by more than 2 pi, or about several axes.
        let (axis, is_steady) = (direction(n), n.chance(0.4));
        let turns = (0..n.integer(1, 5))
            .map(|_| {
                at_s += n.real(0.01, 0.3);
                let about = if is_steady { axis } else { direction(n) };
                let fastest = n.one_of(&[0.5, 3.0, 3.0, 20.0, 60.0, 400.0]);
                (at_s, about * n.real(0.0, fastest))
            })
            .collect();
        let lock = match n.integer(0, 9) {
            0 => RotationLock::Locked,
            1 | 2 => RotationLock::only_about(direction(n).into()).unwrap(),
            _ => RotationLock::Free,
        };
        let rotation_scale = if n.chance(0.4) { 1.0 } else { n.real(0.2, 4.0) };
        let master = MasterRotationSettings {
            device: RotationModel::new(
                Axes::<3>::repeat(inertia_kg_m2),
                n.real(0.0, 1e-3),
                n.one_of(&[0.0, 1e-3]),
            )
            .unwrap(),
            estimator: estimator(n),
            safety: safety(n).at_lever(LEVER_M),
            limiter: LimiterSettings {
                max_force_n: n.real(0.02, 0.5),
                max_slew_n_per_s: n.one_of(&[0.3, 3.0, 100.0]),
                max_power_w: n.one_of(&[0.05, 5.0, 1e4]),
                ramp_in_s: 0.0,
            },
            torque_scale: n.real(0.1, 5.0),
            shares_trips: n.chance(0.5),
        };
        let bounds = RotationBounds {
            speed: n.one_of(&[0.3, 2.5, 2.5, 30.0, f64::INFINITY]),
            turn: n.one_of(&[0.1, 1.0, 1.8, 2.4, 2.9, f64::INFINITY, f64::INFINITY]),
        };
        Self {
            turns,
            is_modelled: [n.chance(0.2), n.chance(0.2)],
            measures: n.chance(0.5),
            inertia_kg_m2,
            starts: [orientation(n), orientation(n)],
            stiffness: n.real(0.0, 1.0),
            broken: [BrokenTurn::draw(n, end_ns), BrokenTurn::draw(n, end_ns)],
            lock,
            master,
            slave: SlaveRotationSettings { rotation_scale, lock, bounds, alignment: None },
            reference_m: n.chance(0.4).then(|| direction(n) * n.real(0.0, 0.3)),
            moved_rad: None,
        }
        .aligned(n, align_ns)
    }

    /// Give some arms an alignment, which mostly ends before a press times out.
    fn aligned(mut self, n: &mut Numbers, align_ns: u64) -> Self {
        let speed = f64::min(n.one_of(&[0.5, 2.5, 10.0, 30.0]), self.slave.bounds.speed);
        let max_angle = f64::min(n.one_of(&[0.2, 1.0, 3.1]), 0.7e-9 * speed * align_ns as f64);
        // A link of 500 ms each way takes one second of that time.
        if self.lock != RotationLock::Free || align_ns <= 1000 * MS || !n.chance(0.5) {
            return self;
        }
        self.slave.rotation_scale = 1.0;
        self.slave.alignment = Some(AlignmentSettings { speed, max_angle });
        if n.chance(0.9) {
            // Most alignments end soon enough for the scene to continue.
            let most = if n.chance(0.7) { f64::min(0.1 * speed, max_angle) } else { 1.2 * max_angle };
            let off = direction(n) * n.real(0.0, most);
            self.starts[0] = UnitQuaternion::from_scaled_axis(off) * self.starts[1];
        }
        if n.chance(0.15) {
            // The arm is turned beyond the bound on its angle, and the hand is at the arm's first orientation.
            self.slave.bounds.turn = 0.1;
            self.is_modelled[1] = false;
            self.moved_rad = Some(direction(n) * n.real(0.0, f64::min(0.9, max_angle)));
            self.starts[0] = self.starts[1];
        }
        if n.chance(0.7) {
            // A hand that the arm can follow.
            for (_, velocity) in &mut self.turns {
                *velocity = velocity.cap_magnitude(0.3 * speed);
            }
        }
        self
    }
}

/// Return the angle between two orientations, which is exact near 0 too.
fn angle(from: &UnitQuaternion<f64>, to: &UnitQuaternion<f64>) -> f64 {
    let turn = to * from.inverse();
    2.0 * turn.imag().norm().atan2(turn.w.abs())
}

/// Coverage of rotations.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct SeenTurn {
    /// Engagements at both sides.
    pub(crate) engagements: [u64; 2],
    pub(crate) torques: u64,
    pub(crate) growth_limited: u64,
    pub(crate) tripped: u64,
    /// Ticks of shared trips, and of trips of only force or only torque.
    pub(crate) shared: u64,
    pub(crate) alone: u64,
    /// Ticks at which each bound on the orientation acted.
    pub(crate) speed_limited: u64,
    pub(crate) turn_limited: u64,
    pub(crate) faults: [u64; 2],
    /// Alignment: ticks with it, ends with engagement, other ends, and ticks at which it was refused.
    pub(crate) aligning: u64,
    pub(crate) aligned: u64,
    pub(crate) cut: u64,
    pub(crate) refused: u64,
    /// Ticks at which the hand's force faded during alignment; few operators press so soon.
    pub(crate) fading: u64,
    /// Ticks at which an arm was led at a point other than its tool point.
    pub(crate) about_a_point: u64,
}

impl SeenTurn {
    pub(crate) fn and(&self, other: &Self) -> Self {
        Self {
            engagements: std::array::from_fn(|side| self.engagements[side] + other.engagements[side]),
            torques: self.torques + other.torques,
            growth_limited: self.growth_limited + other.growth_limited,
            tripped: self.tripped + other.tripped,
            shared: self.shared + other.shared,
            alone: self.alone + other.alone,
            speed_limited: self.speed_limited + other.speed_limited,
            turn_limited: self.turn_limited + other.turn_limited,
            faults: std::array::from_fn(|side| self.faults[side] + other.faults[side]),
            aligning: self.aligning + other.aligning,
            aligned: self.aligned + other.aligned,
            cut: self.cut + other.cut,
            refused: self.refused + other.refused,
            fading: self.fading + other.fading,
            about_a_point: self.about_a_point + other.about_a_point,
        }
    }

    /// Return the counts that must be positive in a run of ten thousand scenes.
    pub(crate) fn all(&self) -> [u64; 16] {
        let Self { engagements: [near, far], faults: [near_faults, far_faults], .. } = *self;
        [
            near,
            far,
            self.torques,
            self.growth_limited,
            self.tripped,
            self.shared,
            self.alone,
            self.speed_limited,
            self.turn_limited,
            near_faults,
            far_faults,
            self.aligning,
            self.aligned,
            self.cut,
            self.refused,
            self.about_a_point,
        ]
    }
}

/// Invariants of the torque on a hand.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TorqueWatch {
    limiter: LimiterSettings,
    shares_trips: bool,
    torque: Axes<3>,
}

impl TorqueWatch {
    pub(crate) fn new(settings: &MasterRotationSettings) -> Self {
        let MasterRotationSettings { limiter, shares_trips, .. } = *settings;
        Self { limiter, shares_trips, torque: Axes::zeros() }
    }

    /// Check a tick, like the force, in the base frame. `tripped` are the trips of the force; `written` is the torque
    /// that the device received.
    pub(crate) fn tick(
        &mut self,
        watch: &mut Watch,
        time: TickTime,
        period_s: f64,
        record: &MasterRotation,
        tripped: u8,
        written: Option<Axes<3>>,
    ) {
        let last = std::mem::replace(&mut self.torque, record.device_torque);
        let torque = self.torque;
        let LimiterSettings { max_force_n: bound, max_slew_n_per_s: slew, .. } = self.limiter;
        watch.hold(torque.norm() <= bound * (1.0 + ROUNDING), time, || format!("torque {}", torque.norm()));
        let squared = last.norm_squared();
        let share = if squared > 0.0 { (last.dot(&torque) / squared).clamp(0.0, 1.0) } else { 0.0 };
        let (growth, most) = ((torque - last * share).norm(), slew * period_s);
        let by_power = record.acted & ActiveLimits::POWER.bits() != 0;
        // An orientation whose norm is off by up to 1e-9 scales a rotated vector by twice that.
        let rounding = ROUNDING * (most + 2.0 * last.norm()) + 1e-12;
        watch.hold(by_power || growth <= most + rounding, time, || {
            format!("growth of the torque {growth} > {most}")
        });
        let dead = watch.gain == 0.0;
        watch.hold(!dead || torque == Axes::<3>::zeros(), time, || {
            format!("torque {} without gain", torque.norm())
        });
        watch.hold(written == Some(torque), time, || format!("recorded {torque:?}, written {written:?}"));
        let finite = record.rendered_torque.iter().chain(&record.grasp_torque).chain(&record.safety_torque);
        watch.hold(finite.clone().all(|x| x.is_finite()), time, || format!("{record:?}"));
        // The force of PC is not an intervention.
        let of_pc = Tripped::of(ControllerKind::Pc).bits();
        let either = (tripped & !of_pc != 0, record.tripped & !of_pc != 0);
        watch.hold(!self.shares_trips || either.0 == either.1, time, || {
            format!("trips are shared, and of force and torque {tripped} and {} tripped", record.tripped)
        });
        let seen = &mut watch.seen.turn;
        seen.torques += u64::from(torque != Axes::<3>::zeros());
        seen.growth_limited += u64::from(record.acted & ActiveLimits::SLEW.bits() != 0);
        seen.tripped += u64::from(either.1);
        seen.shared += u64::from(self.shares_trips && either.1);
        seen.alone += u64::from(either.0 != either.1);
    }
}

/// Values at a tick of an arm that turns.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TurnTick {
    /// Command of the endpoint.
    pub(crate) command: Option<UnitQuaternion<f64>>,
    /// Rotation written to the arm, and true if a position was written.
    pub(crate) written: (Option<(UnitQuaternion<f64>, Axes<3>)>, bool),
    /// Measured orientation, if the sensor is not faulty.
    pub(crate) measured: Option<UnitQuaternion<f64>>,
    /// `C R_m C'` of the master's newest frame.
    pub(crate) target: Option<UnitQuaternion<f64>>,
    /// True if the arm was stopped at this tick, where it may rest elsewhere.
    pub(crate) stops: bool,
    /// Bits of the bounds that acted.
    pub(crate) limited: u8,
    /// True during alignment.
    pub(crate) turns: bool,
}

/// Invariants of a commanded orientation.
#[derive(Clone, Copy, Debug)]
pub(crate) struct OrientationWatch {
    bounds: RotationBounds,
    lock: RotationLock,
    alignment: Option<AlignmentSettings>,
    /// Longest time in s for which one step compensates.
    max_step_s: f64,
    pub(crate) homes: Homes<UnitQuaternion<f64>>,
    command: Option<UnitQuaternion<f64>>,
    was_coupled: bool,
    /// True if the bound on the angle has acted since engagement.
    is_led_off: bool,
}

impl OrientationWatch {
    pub(crate) fn new(settings: &SlaveRotationSettings, period_s: f64) -> Self {
        let SlaveRotationSettings { bounds, lock, alignment, .. } = *settings;
        let max_step_s = 2.0 * period_s;
        Self {
            bounds,
            lock,
            alignment,
            max_step_s,
            homes: Homes::new(),
            command: None,
            was_coupled: false,
            is_led_off: false,
        }
    }

    pub(crate) fn tick(&mut self, watch: &mut Watch, time: TickTime, elapsed_s: f64, turn_tick: &TurnTick) {
        let TurnTick { command, written, measured, target, stops, limited, turns } = *turn_tick;
        let before = std::mem::replace(&mut self.command, command);
        let was_coupled = std::mem::replace(&mut self.was_coupled, watch.state.is_coupled());
        let (state, RotationBounds { speed, turn }) = (watch.state, self.bounds);
        let (written, moves) = written;
        watch.hold(written.is_some() == moves, time, || format!("{written:?} beside a position"));
        if let Some((orientation, velocity)) = written {
            watch.hold(command == Some(orientation), time, || format!("{orientation:?}, not {command:?}"));
            let most = match self.alignment {
                _ if state.is_coupled() => speed,
                Some(alignment) if turns => alignment.speed,
                _ => 0.0,
            } * (1.0 + ROUNDING);
            watch.hold(velocity.norm() <= most, time, || format!("turns with {velocity:?} in {state:?}"));
            let norm = orientation.quaternion().norm();
            watch.hold((norm - 1.0).abs() <= 1e-9, time, || format!("commanded a norm of {norm}"));
        }
        // The first command continues from the orientation of the arm.
        let Some((before, command)) = before.or(measured).zip(command) else { return };
        let step = angle(&before, &command);
        // Largest alignment step within this tick, before engagement.
        let aligns_by =
            self.alignment.map_or(0.0, |alignment| alignment.speed * elapsed_s.min(self.max_step_s));
        if let Some((alignment, target)) = self.alignment.zip(target) {
            let (was_off, off) = (angle(&before, &target), angle(&command, &target));
            let engages = state.is_coupled() && !was_coupled;
            watch.hold(!engages || off <= ALIGNED + ANGLE, time, || {
                format!("engaged {off} rad off the master")
            });
            let from_home = |of| self.homes.out(|home| angle(home, of));
            let (out, was_out) = (from_home(&target), from_home(&before));
            let may = was_off <= alignment.max_angle + ANGLE && out <= turn + ANGLE;
            watch.hold(!turns || may, time, || format!("turned from {was_off} off to {out} from the first"));
            // From beyond the bound on its angle, the arm is first led back within it.
            let nears = off <= was_off + ANGLE || was_out > turn;
            watch.hold(!turns || nears, time, || format!("turned from {was_off} to {off} off"));
        }
        if state.is_coupled() {
            let most = speed * elapsed_s * (1.0 + ROUNDING) + ANGLE;
            watch.hold(step <= most, time, || format!("commanded turn {step} > {most} in {state:?}"));
            let from_home = |of| self.homes.out(|home| angle(home, of));
            // As for the reach: a stop may have ended outside.
            let (out, was_out) = (from_home(&command), from_home(&before));
            let most = turn.max(was_out) + ANGLE;
            watch.hold(out <= most, time, || format!("commanded {out} rad from the first, beyond {turn}"));
            // After the bound on the angle has led the orientation off the axis, it returns no faster than the speed
            // bound.
            self.is_led_off = (self.is_led_off && was_coupled) || limited & TURN != 0;
            let is_free = self.is_led_off;
            // Both sides are anchored at engagement, so motion of the hand before it has no effect.
            let jumps = !was_coupled && step > aligns_by * (1.0 + ROUNDING) + ANGLE;
            watch.hold(is_free || !jumps, time, || format!("jumped by {step} when it engaged"));
            let way = (command * before.inverse()).scaled_axis();
            let off = match self.lock {
                RotationLock::Free => 0.0,
                RotationLock::OnlyAbout(axis) => way.cross(&axis).norm(),
                RotationLock::Locked => step,
            };
            watch.hold(is_free || off <= ANGLE, time, || format!("turned by {way:?} with {:?}", self.lock));
        } else if turns {
            let most = aligns_by * (1.0 + ROUNDING) + ANGLE;
            watch.hold(step <= most, time, || format!("turned by {step} > {most} in {state:?}"));
        } else if !stops {
            watch.hold(before == command, time, || format!("turned by {step} in {state:?}"));
        }
    }
}
