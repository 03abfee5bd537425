//! The master's endpoint: one tick of the side of the hand.

use haptether_safety::{
    Axes, DeviceModel, LayerSettings, LimiterSettings, SafetyLayer, SafetyTick, controller::SafetySettings,
    estimator::EstimatorKind,
};

use super::{EndpointError, Exchange, check_period, period_s};
use crate::{
    coupling::PositionForce,
    ladder::{LadderSettings, LadderState},
    link::Refusal,
    wire::Role,
};

/// How a master endpoint is built.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MasterSettings<const N: usize> {
    /// dT in ns.
    pub period_ns: u64,
    /// Drawn anew at every start.
    pub session: u64,
    /// Dynamics of the device.
    pub device: DeviceModel<N>,
    /// How V and A are had from positions.
    pub estimator: EstimatorKind,
    /// Observers and controllers.
    pub safety: SafetySettings,
    /// Bounds on the device force; the ladder fades the force in, so the limiter's ramp-in is not used.
    pub limiter: LimiterSettings,
    /// `lambda_f`, of the position-force coupling.
    pub force_scale: f64,
    /// Times of the ladder.
    pub ladder: LadderSettings,
}

/// What one tick of the master did.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MasterTick<const N: usize> {
    /// All that the safety layer saw and decided; `device_force` in it goes to the device.
    pub safety: SafetyTick<N>,
    /// Where the ladder stands.
    pub state: LadderState,
    /// Silence of the peer in ns.
    pub age_ns: Option<u64>,
}

/// The master's side as a state machine: `(sample, frames, time) -> (device force, frame)`.
#[derive(Clone, Debug)]
pub struct MasterEndpoint<const N: usize> {
    layer: SafetyLayer<N>,
    coupling: PositionForce<N>,
    exchange: Exchange<N>,
}

impl<const N: usize> MasterEndpoint<N> {
    /// An endpoint that waits for its peer.
    pub fn new(settings: &MasterSettings<N>) -> Result<Self, EndpointError> {
        check_period(settings.period_ns)?;
        let layer = SafetyLayer::new(&LayerSettings {
            device: settings.device,
            period_s: period_s(settings.period_ns),
            estimator: settings.estimator,
            safety: settings.safety,
            limiter: LimiterSettings { ramp_in_s: 0.0, ..settings.limiter },
        })?;
        Ok(Self {
            layer,
            coupling: PositionForce::new(1.0, settings.force_scale)?,
            exchange: Exchange::new(Role::Master, settings.session, settings.ladder),
        })
    }

    /// Takes a datagram that arrived by `now_ns`.
    pub fn receive(&mut self, now_ns: u64, datagram: &[u8]) -> Result<(), Refusal> {
        self.exchange.receive(now_ns, datagram).map(|_| ())
    }

    /// One tick: x in m and, from a device that measures it, V in m/s.
    pub fn tick(&mut self, now_ns: u64, position: &Axes<N>, velocity: Option<&Axes<N>>) -> MasterTick<N> {
        let (_, age_ns) = self.exchange.advance(now_ns);
        let asked =
            self.exchange.newest().map_or(Axes::zeros(), |frame| self.coupling.rendered_force(&frame.force));
        let safety = self.layer.tick(position, velocity, &(asked * self.exchange.ladder.gain()));
        if safety.fault.is_some() {
            self.exchange.ladder.fault();
        } else {
            self.exchange.outgoing = [*position, safety.motion.velocity, safety.device_force];
        }
        MasterTick { safety, state: self.exchange.ladder.state(), age_ns }
    }

    /// What talks to the peer.
    pub fn exchange(&self) -> &Exchange<N> {
        &self.exchange
    }

    /// What talks to the peer.
    pub fn exchange_mut(&mut self) -> &mut Exchange<N> {
        &mut self.exchange
    }
}
