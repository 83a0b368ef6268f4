#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| gmapd_fuzz::maps(bytes));
