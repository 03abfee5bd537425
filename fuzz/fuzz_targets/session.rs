#![no_main]

#[path = "../../bridge/tests/pair/mod.rs"]
mod pair;
#[path = "../../bridge/tests/corpus/session.rs"]
mod session;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| session::check(bytes));
