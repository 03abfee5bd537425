//! The master's endpoint: one tick of the side of the hand.

use haptether_safety::{
    Axes, DeviceModel, LayerSettings, LimiterSettings, SafetyLayer, SafetyTick, controller::SafetySettings,
    estimator::EstimatorKind,
};

use super::{EndpointError, check_period, is_ready, period_s};
use crate::{
    coupling::PositionForce,
    ladder::{Ladder, LadderSettings, LadderState},
    link::{FrameLink, LinkStatistics, Refusal},
    wire::{MAX_FRAME, Role},
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
    ladder: Ladder,
    link: FrameLink<N>,
    outgoing: [Axes<N>; 3],
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
            ladder: Ladder::new(settings.ladder),
            link: FrameLink::new(Role::Master, settings.session, settings.ladder.stop_after_ns),
            outgoing: [Axes::zeros(); 3],
        })
    }

    /// Takes a datagram that arrived by `now_ns`.
    pub fn receive(&mut self, now_ns: u64, datagram: &[u8]) -> Result<(), Refusal> {
        if self.link.receive(now_ns, datagram)? {
            self.ladder.new_session();
        }
        Ok(())
    }

    /// One tick: x in m and, from a device that measures it, V in m/s.
    pub fn tick(&mut self, now_ns: u64, position: &Axes<N>, velocity: Option<&Axes<N>>) -> MasterTick<N> {
        let age_ns = self.link.age_ns(now_ns);
        let ready = self.link.newest().is_some_and(is_ready);
        self.ladder.step(now_ns, age_ns, ready);
        let asked =
            self.link.newest().map_or(Axes::zeros(), |frame| self.coupling.rendered_force(&frame.force));
        let safety = self.layer.tick(position, velocity, &(asked * self.ladder.gain()));
        if safety.fault.is_some() {
            self.ladder.fault();
        } else {
            self.outgoing = [*position, safety.motion.velocity, safety.device_force];
        }
        MasterTick { safety, state: self.ladder.state(), age_ns }
    }

    /// Writes the frame of this tick.
    pub fn send<'a>(&mut self, now_ns: u64, buffer: &'a mut [u8; MAX_FRAME]) -> &'a [u8] {
        let status = (self.ladder.state().code(), self.ladder.hears_peer());
        self.link.send(now_ns, status, self.outgoing, buffer)
    }

    /// The loop was late by more than the ladder allows.
    pub fn stalled(&mut self) {
        self.ladder.stalled();
    }

    /// Where the ladder stands.
    pub fn state(&self) -> LadderState {
        self.ladder.state()
    }

    /// How often the ladder went to HOLD.
    pub fn holds(&self) -> u64 {
        self.ladder.holds()
    }

    /// Counts of the link.
    pub fn link(&self) -> LinkStatistics {
        self.link.statistics()
    }
}
