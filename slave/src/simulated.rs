//! A simulated slave: an arm in an environment, advanced in time under held commands.

mod lanes;

pub use lanes::{SlaveLanes, SlaveLanesSample};

use crate::{
    ArmModel, Axes, Environment, ForceSensor, ModelError, Push, all_finite,
    arm::drive::{ArmDrive, Tool},
    require_axes,
    solver::{adaptive::Drive, linear::LinearArm},
};

/// Measurement of the slave at one tick.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SlaveSample<const N: usize = 1> {
    /// Tool position in m.
    pub position: Axes<N>,
    /// Tool velocity in m/s.
    pub velocity: Axes<N>,
    /// `F_e` in N as the force sensor measures it: force of objects and pushers on the tool.
    pub environment_force: Axes<N>,
    /// `F_e` in N, without sensor errors.
    pub true_environment_force: Axes<N>,
}

/// An arm in an environment.
///
/// Commands are held until the next. The solution depends on the environment:
///
/// - Exact between located contacts if arm and environment are linear there: control of position or pd, fixed
///   Kelvin-Voigt planes across the axes without friction, springs, and pushes that are linear in time. While all other
///   objects are out of reach, the motion is bit-identical to that without them.
/// - A Taylor series, exact to rounding between located events, among flat faces with friction (fixed planes and
///   boxes).
/// - An adaptive integrator between located contacts otherwise.
#[derive(Clone, Debug, PartialEq)]
pub struct SimulatedSlave<const N: usize = 1> {
    plant: Plant<N>,
    sensor: Option<ForceSensor<N>>,
    /// Origin of the time of the objects.
    begun_ns: u64,
    now_ns: u64,
    /// Origin of the time of the pushers, once started.
    started_ns: Option<u64>,
    /// Index of the next sample of a sensor without its own rate.
    reads: u64,
}

#[derive(Clone, Debug, PartialEq)]
struct Plant<const N: usize> {
    drive: ArmDrive<N>,
    environment: Environment<N>,
    tool: Tool<N>,
    /// The exact solution among the objects that it supports, if there is one.
    linear: Option<LinearArm<N>>,
}

impl<const N: usize> Plant<N> {
    fn advance(&mut self, from: f64, span: f64) {
        let Self { drive, environment, tool, linear } = self;
        let solved = match linear {
            // Without a spring of its own, the arm has no particular solution there.
            Some(_) if drive.exerted().is_some() => false,
            Some(linear) if linear.is_complete => {
                linear.advance(drive, environment, tool, from, span);
                true
            }
            Some(linear) => linear.advance_clear(drive, environment, tool, from, span),
            None => false,
        };
        if !solved {
            environment.solve(&mut Drive::Arm(drive), tool, from, span);
        }
    }

    fn force(&mut self, time_s: f64) -> Axes<N> {
        self.environment.force(&self.tool.position, &self.tool.velocity, time_s)
    }
}

impl<const N: usize> SimulatedSlave<N> {
    /// An arm at rest at `position` in m, at time `now_ns`, in an environment whose time starts there. Without a force
    /// sensor the measured force is exact.
    pub fn in_environment(
        arm: ArmModel,
        mut environment: Environment<N>,
        sensor: Option<ForceSensor<N>>,
        position: Axes<N>,
        now_ns: u64,
    ) -> Result<Self, ModelError> {
        require_axes("arm position", &position, |_| true, "finite")?;
        environment.push_from(f64::INFINITY);
        let drive = ArmDrive::new(arm, &position);
        let linear = LinearArm::new(&drive, &environment);
        let tool = Tool { position, velocity: Axes::zeros(), set_velocity: Axes::zeros() };
        let plant = Plant { drive, environment, tool, linear };
        Ok(Self { plant, sensor, begun_ns: now_ns, now_ns, started_ns: None, reads: 0 })
    }

    /// Set the clock to `now_ns` without advancing: arm and objects rest until then.
    pub fn begin(&mut self, now_ns: u64) {
        self.begun_ns = now_ns;
        self.now_ns = now_ns;
        self.place_pushers();
    }

    /// Start the time of the pushers; later calls have no effect.
    pub fn start(&mut self, now_ns: u64) {
        if self.started_ns.is_some() {
            return;
        }
        self.started_ns = Some(now_ns);
        self.place_pushers();
    }

    fn place_pushers(&mut self) {
        if let Some(started_ns) = self.started_ns {
            let after = started_ns.saturating_sub(self.begun_ns) as f64 * 1e-9;
            let before = self.begun_ns.saturating_sub(started_ns) as f64 * 1e-9;
            self.plant.environment.push_from(after - before);
        }
    }

    /// Push the tool from `now_ns` on, as [`Environment::ask`].
    pub fn push(&mut self, now_ns: u64, push: &Push<N>) -> bool {
        let time_s = now_ns.saturating_sub(self.begun_ns) as f64 * 1e-9;
        self.plant.environment.ask(push, time_s)
    }

    /// Command a position in m and the velocity there in m/s, which position control ignores. Values that are not
    /// finite are ignored.
    pub fn write(&mut self, position: &Axes<N>, velocity: &Axes<N>) {
        if all_finite(position) {
            self.plant.drive.follow(&self.plant.tool);
            let velocity = if all_finite(velocity) { *velocity } else { Axes::zeros() };
            self.plant.drive.command(*position, velocity);
        }
    }

    /// Exert `force` in N until the next command. A force that is not finite is ignored. An arm that takes motions only
    /// ignores all.
    pub fn exert(&mut self, force: &Axes<N>) {
        self.plant.drive.exert(force);
    }

    /// Brake within the limits and stay. Returns the rest position in m.
    pub fn stop(&mut self) -> Axes<N> {
        self.plant.drive.stop(&self.plant.tool)
    }

    /// Advance to `now_ns` (monotonic) and return the measurement there.
    pub fn read(&mut self, now_ns: u64) -> SlaveSample<N> {
        let advanced = now_ns > self.now_ns;
        let from = self.now_ns.saturating_sub(self.begun_ns) as f64 * 1e-9;
        let span = now_ns.saturating_sub(self.now_ns) as f64 * 1e-9;
        self.now_ns = self.now_ns.max(now_ns);
        let plant = &mut self.plant;
        let mut done = 0.0;
        if let Some(sensor) = &mut self.sensor
            && let Some((index, at)) = sensor.newest(from + span)
            && sensor.held().is_none_or(|(held, _)| held != index)
        {
            // The newest sample falls between two ticks: use the force at that time.
            done = (at - from).clamp(0.0, span);
            plant.advance(from, done);
            let force = plant.force(from + done);
            sensor.take(&force, index);
        }
        plant.advance(from + done, span - done);
        let force = plant.force(from + span);
        let measured = self.sensor.as_mut().map_or(force, |sensor| {
            if !sensor.has_rate() && (advanced || sensor.held().is_none()) {
                self.reads += 1;
                sensor.take(&force, self.reads - 1);
            }
            sensor.held().map_or(force, |(_, measured)| measured)
        });
        SlaveSample {
            position: plant.tool.position,
            velocity: plant.tool.velocity,
            environment_force: measured,
            true_environment_force: force,
        }
    }

    /// Environment of the arm.
    pub fn environment(&self) -> &Environment<N> {
        &self.plant.environment
    }

    /// True if the tool was inside an object at the last read; pushers do not count.
    pub fn touches(&self) -> bool {
        self.plant.environment.touches()
    }

    /// True if the motion is exact between located contacts.
    pub fn is_exact(&self) -> bool {
        self.plant.linear.as_ref().is_some_and(|linear| linear.is_complete)
    }

    /// Number of steps so far that were too stiff for full accuracy and used a stable method of order 1.
    pub fn coarse_steps(&self) -> u64 {
        let solved = self.plant.linear.as_ref().map_or(0, |linear| linear.coarse_steps);
        solved + self.plant.environment.coarse_steps()
    }
}
