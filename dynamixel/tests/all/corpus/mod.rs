//! Replays the committed corpus of fuzzer and hand-written inputs; `make fuzz` searches for more.
#![allow(clippy::unwrap_used)] // permitted in a test

#[path = "../../../../netsim/tests/all/corpus/replay.rs"]
mod replay;
mod status;

#[test]
fn answers() {
    replay::replay("status", status::check);
}
