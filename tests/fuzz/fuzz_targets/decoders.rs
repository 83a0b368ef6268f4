//! Bytes of any content as each message that the daemon takes, and as a map that `gmapd get` reads.
//!
//! `cargo fuzz run --fuzz-dir tests/fuzz decoders`, with cargo-fuzz and a nightly toolchain, or
//! with a stable one and RUSTC_BOOTSTRAP=1.
#![no_main]

use gmapd::{convert, map, ros};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    for encoding in ["", "application/json"] {
        if let Ok(message) = ros::decode::<ros::LaserScan>(bytes, encoding) {
            convert::scan(message).ok();
        }
        if let Ok(message) = ros::decode::<ros::Odometry>(bytes, encoding) {
            convert::odometry(message).ok();
        }
        if let Ok(message) = ros::decode::<ros::TfMessage>(bytes, encoding) {
            message.transforms.into_iter().for_each(|transform| {
                convert::transform(transform).ok();
            });
        }
        ros::decode::<ros::GetMapRequest>(bytes, encoding).ok();
    }
    map::parse_json(bytes).ok();
});
