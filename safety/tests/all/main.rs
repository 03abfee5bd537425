//! The integration tests of the safety crate, one binary.

mod damping;
mod lanes;
mod probe;
mod properties;
mod settings;
