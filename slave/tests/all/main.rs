//! Integration tests of the slave crate in one binary; tests with their own allocator are separate binaries.

mod arm;
mod bodies;
mod contact;
mod force_sensor;
mod reach;
mod robust;
mod settings;
mod shapes;
mod ur_inverse;
