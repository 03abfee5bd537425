//! Replays what the fuzzer and people found worth keeping; `make fuzz` looks for more.
#![allow(clippy::unwrap_used)] // a test may

mod frame;
#[path = "../../../../netsim/tests/all/corpus/replay.rs"]
mod replay;
mod scene;
mod session;

#[test]
fn frames() {
    replay::replay("frame", frame::check);
}

#[test]
fn scenes() {
    replay::replay("scene", scene::check);
}

#[test]
fn sessions() {
    replay::replay("session", session::check);
}
