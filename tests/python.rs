//! Runs `tests/python`: clients of another implementation, with messages that others encode.

use std::path::{Path, PathBuf};
use std::process::Command;

/// Runs a command and fails with what it printed if it fails.
fn run(command: &mut Command) {
    let output = command.output().unwrap_or_else(|error| panic!("{command:?}: {error}"));
    let (out, err) = (&output.stdout, &output.stderr);
    let printed = [out, err].map(|bytes| String::from_utf8_lossy(bytes)).concat();
    assert!(output.status.success(), "{command:?}\n{printed}");
}

/// A Python with what `requirements.txt` names, in a folder of its own name for each of its texts.
fn python(tests: &Path) -> PathBuf {
    let requirements = tests.join("requirements.txt");
    let text = std::fs::read_to_string(&requirements).expect("the requirements are there");
    let name: String = text.chars().filter(char::is_ascii_alphanumeric).collect();
    let home = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("venv-{name}"));
    let (python, ready) = (home.join("bin/python"), home.join("ready"));
    if !ready.exists() {
        run(Command::new("python3").args(["-m", "venv", "--clear"]).arg(&home));
        run(Command::new(&python).args(["-m", "pip", "install", "-q", "-r"]).arg(&requirements));
        std::fs::write(ready, "").expect("the target folder takes files");
    }
    python
}

#[test]
fn python_clients_feed_ask_and_command_the_daemon() {
    let tests = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python");
    // A client that hangs fails here; they take two minutes.
    run(Command::new("timeout")
        .arg("900")
        .arg(python(&tests))
        .args([
            "-m",
            "pytest",
            "-q",
            "-p",
            "no:cacheprovider",
            "--durations=5",
            "--ignore=test_bridge.py",
        ])
        .env("GMAPD", env!("CARGO_BIN_EXE_gmapd"))
        .env("PYTHONDONTWRITEBYTECODE", "1")
        .current_dir(&tests));
}
