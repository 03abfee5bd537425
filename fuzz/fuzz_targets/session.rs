#![no_main]

#[path = "../../bridge/tests/all/pair.rs"]
mod pair;
#[path = "../../bridge/tests/all/corpus/session.rs"]
mod session;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| session::check(bytes));
