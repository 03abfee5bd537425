#![no_main]

#[path = "../../dynamixel/tests/all/corpus/status.rs"]
mod status;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| status::check(bytes));
