//! Replays what the fuzzer and people found worth keeping; `make fuzz` looks for more.
#![allow(clippy::unwrap_used)] // a test may

mod recording;
mod replay;

#[test]
fn recordings() {
    replay::replay("recording", recording::check);
}
