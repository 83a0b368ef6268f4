//! Text of any content as the parameters of each query.
#![no_main]

use gmapd::daemon::keys::Prefix;
use gmapd::daemon::selector::Topic;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|text: &str| {
    for topic in Topic::ALL {
        if let Err(error) = topic.question(text) {
            assert!(error.to_string().len() < 2000, "{error}");
        }
    }
    if let Ok(prefix) = Prefix::parse(text) {
        prefix.key("map").expect("what a prefix takes, a key takes");
    }
});
