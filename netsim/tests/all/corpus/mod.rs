//! Replays the committed corpus of fuzzer and hand-written inputs; `make fuzz` searches for more.
#![allow(clippy::unwrap_used)] // permitted in a test

mod recording;
mod replay;

#[test]
fn recordings() {
    replay::replay("recording", recording::check);
}
