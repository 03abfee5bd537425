//! The loop of the paper: device, hand and a force rendered on the spot, without a network.

use haptether_master::SimulatedMaster;
use haptether_safety::{Axes, LayerSettings, ParameterError, SafetyLayer};
use haptether_slave::Wall;

/// What is rendered.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum RenderedForce {
    /// A virtual wall. Source: paper Eq. 15.
    Wall(Wall),
    /// `F_v = a sin(w t)`, an active force. Source: paper section 4.5.
    Sinusoid {
        /// a in N.
        amplitude_n: f64,
        /// w in rad/s.
        rate: f64,
    },
}

impl RenderedForce {
    fn at(&self, time_s: f64, position: f64) -> f64 {
        match self {
            Self::Wall(wall) => wall.force(position),
            Self::Sinusoid { amplitude_n, rate } => amplitude_n * (rate * time_s).sin(),
        }
    }
}

/// A loop that cannot be built.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum WallLoopError {
    /// A parameter of the safety layer.
    #[error(transparent)]
    Safety(#[from] ParameterError),
    /// A period that is no whole number of nanoseconds between 1 us and 1 s.
    #[error("period_s (dT) = {0}: must be a whole number of nanoseconds between 1e-6 and 1")]
    Period(f64),
}

/// One tick of the loop.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LocalRecord {
    /// True position in m.
    pub position: f64,
    /// True velocity in m/s.
    pub velocity: f64,
    /// True force of the hand in N.
    pub hand_force: f64,
    /// `F_v` in N.
    pub rendered_force: f64,
    /// `F_h` in N, as estimated.
    pub grasp_force: f64,
    /// `F_device` in N.
    pub device_force: f64,
    /// `S_vf`; NaN where not observed.
    pub velocity_force: f64,
    /// `S_h`; NaN where not observed.
    pub grasp: f64,
    /// `E_wso` in J; NaN where not observed.
    pub windowed_energy_j: f64,
    /// `E_so` in J; NaN where not observed.
    pub energy_j: f64,
    /// Who tripped.
    pub tripped: u8,
}

/// Device and hand under a force rendered at the servo rate and held over each tick, through the safety layer.
#[derive(Clone, Debug)]
pub struct LocalLoop {
    master: SimulatedMaster,
    layer: SafetyLayer<1>,
    rendered: RenderedForce,
    period_ns: u64,
    tick: u64,
}

impl LocalLoop {
    /// A loop at time 0.
    pub fn new(
        master: SimulatedMaster,
        settings: &LayerSettings<1>,
        rendered: RenderedForce,
    ) -> Result<Self, WallLoopError> {
        let period_ns = settings.period_s * 1e9;
        if !(1e3..=1e9).contains(&period_ns) || (period_ns - period_ns.round()).abs() > 1e-3 {
            return Err(WallLoopError::Period(settings.period_s));
        }
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // checked above
        let period_ns = period_ns.round() as u64;
        Ok(Self { master, layer: SafetyLayer::new(settings)?, rendered, period_ns, tick: 0 })
    }

    /// One tick.
    pub fn step(&mut self) -> LocalRecord {
        let now_ns = self.tick * self.period_ns;
        self.tick += 1;
        let sample = self.master.read(now_ns);
        let rendered = self.rendered.at(now_ns as f64 * 1e-9, sample.position);
        let velocity = sample.velocity.map(Axes::<1>::new);
        let tick =
            self.layer.tick(&Axes::<1>::new(sample.position), velocity.as_ref(), &Axes::<1>::new(rendered));
        let record = LocalRecord {
            position: self.master.position(),
            velocity: self.master.velocity(),
            hand_force: self.master.hand_force(),
            rendered_force: rendered,
            grasp_force: tick.grasp_force[0],
            device_force: tick.device_force[0],
            velocity_force: tick.intervention.velocity_force,
            grasp: tick.intervention.grasp,
            windowed_energy_j: tick.intervention.windowed_energy_j,
            energy_j: tick.intervention.energy_j,
            tripped: tick.intervention.tripped.bits(),
        };
        self.master.write(tick.device_force[0]);
        record
    }
}
