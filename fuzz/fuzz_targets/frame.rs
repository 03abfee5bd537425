#![no_main]

#[path = "../../bridge/tests/all/corpus/frame.rs"]
mod frame;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| frame::check(bytes));
