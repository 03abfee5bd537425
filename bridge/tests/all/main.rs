//! The integration tests of the bridge, one binary; those with an allocator of their own are binaries apart.

mod alignment;
#[cfg(test)]
mod arms;
mod changing_delay;
mod clock_and_age;
mod common_beginning;
mod corpus;
mod device_failure;
mod felt_trigger;
mod frames_without_bytes;
mod invariants;
mod late_wakes;
mod lost_peer;
mod measured_metrics;
mod outliers;
#[cfg(test)]
mod pair;
mod pose;
mod run_time_changes;
mod session;
mod session_hostile;
mod soft_stop;
mod ticks_in_a_row;
mod true_cause;
