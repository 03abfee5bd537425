#![no_main]

#[path = "../../bridge/tests/all/corpus/scene.rs"]
mod scene;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| scene::check(bytes));
