//! The integration tests of the slave crate, one binary; those with an allocator of their own are binaries apart.

mod arm;
mod bodies;
mod contact;
mod force_sensor;
mod one_axis;
mod reach;
mod robust;
mod settings;
mod shapes;
mod ur_inverse;
