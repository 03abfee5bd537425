//! Integration tests of the safety crate in one binary.

mod damping;
mod lanes;
mod probe;
mod properties;
mod settings;
