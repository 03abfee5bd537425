//! Replays what the fuzzer and people found worth keeping; `make fuzz` looks for more.
#![allow(clippy::unwrap_used)] // a test may

#[path = "../../../../netsim/tests/all/corpus/replay.rs"]
mod replay;
mod status;

#[test]
fn answers() {
    replay::replay("status", status::check);
}
