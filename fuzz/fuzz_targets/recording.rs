#![no_main]

#[path = "../../netsim/tests/all/corpus/recording.rs"]
mod recording;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| recording::check(bytes));
