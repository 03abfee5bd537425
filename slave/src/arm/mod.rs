//! An arm: its model and control, what it does with commands, and its force sensor.

pub(crate) mod drive;
pub(crate) mod force_sensor;
pub(crate) mod model;
