//! An arm along one axis before a wall.

use haptether_slave::{
    ArmControl, ArmModel, Axes, Contact, ContactLaw, Environment, Object, Pusher, Shape, SimulatedSlave,
};

/// An arm of 4 kg, 15 Hz and at most 1 m/s, at rest at `position` in m, before a wall of 100 N/m that fills x below
/// `wall` in m.
pub(crate) fn arm_before_wall(wall: f64, pusher: Option<Pusher>, position: f64) -> SimulatedSlave<1> {
    let control = ArmControl::Position { bandwidth_hz: 15.0 };
    let arm = ArmModel::new(control, 4.0, Some(1.0), None).unwrap();
    let law = ContactLaw::KelvinVoigt { stiffness: 100.0, damping: 0.0 };
    let plane = Shape::plane(Axes::<1>::new(wall), Axes::<1>::new(1.0)).unwrap();
    let object = Object::fixed(plane, Contact::new(law, 0.0).unwrap()).unwrap();
    let environment = Environment::new(vec![object], pusher.into_iter().collect());
    SimulatedSlave::in_environment(arm, environment, None, Axes::<1>::new(position), 0).unwrap()
}
