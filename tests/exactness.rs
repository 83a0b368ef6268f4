//! The same log, configuration and seed give the same bytes in a debug and in a release build.
//!
//! Where the environment variable `GMAPD_RELEASE` names a release binary of the same commit, its
//! results are compared with those of the binary that was built with the tests.

use std::ffi::OsStr;
use std::path::Path;
use std::process::{Command, Stdio};

use serde_json::Value;

/// What a program prints that has to succeed.
fn output(program: &OsStr, arguments: &[&str], directory: &Path) -> String {
    let output = Command::new(program)
        .args(arguments)
        .current_dir(directory)
        .stdin(Stdio::null())
        .output()
        .unwrap_or_else(|error| panic!("{} does not start: {error}", program.display()));
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).expect("it prints text")
}

fn summary(program: &OsStr, arguments: &[&str], directory: &Path) -> Value {
    let arguments = [&["replay", "sim.log", "--json"], arguments].concat();
    let printed = output(program, &arguments, directory);
    serde_json::from_str(&printed).expect("--json prints JSON")
}

#[test]
fn debug_and_release_builds_give_the_same_bytes() {
    let Some(release) = std::env::var_os("GMAPD_RELEASE") else {
        eprintln!("NOT RUN: GMAPD_RELEASE does not name a release binary to compare with");
        return;
    };
    let debug = OsStr::new(env!("CARGO_BIN_EXE_gmapd"));
    let directory = tempfile::tempdir().expect("a temporary directory can be made");
    let directory = directory.path();
    let simulate = ["simulate", "--seed", "4", "--beams", "60", "--people", "3"];
    output(debug, &simulate, directory);
    let compat = ["--set", "matcher=compat", "--set", "particles=2"];
    for arguments in [&["--threads", "1"][..], &["--threads", "2"], &compat] {
        let ours = summary(debug, arguments, directory);
        let theirs = summary(&release, arguments, directory);
        assert_eq!((&ours["debug_build"], &theirs["debug_build"]), (&true.into(), &false.into()));
        assert_eq!(ours["version"], theirs["version"], "not the same program");
        assert!(ours["sha256"]["map.pgm"].is_string(), "{ours}");
        assert_eq!(ours["sha256"], theirs["sha256"], "{arguments:?}");
    }
}
