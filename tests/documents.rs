//! The documents say what the code does: keys, defaults and files that they name.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

use gmapd::config::RawConfig;
use gmapd::daemon::ledger::Verdict;
use gmapd::daemon::snapshot::State;
use serde::Serialize;
use serde_json::Value;

/// Documents whose file names must be there.
const DOCUMENTS: [&str; 10] = [
    "README.md",
    "CHANGELOG.md",
    "docs/architecture.md",
    "docs/dependencies.md",
    "docs/mesh.md",
    "docs/parameters.md",
    "docs/ros2.md",
    "docs/security.md",
    "docs/state.md",
    "bridge/README.md",
];

/// Folders whose files the documents name.
const FOLDERS: [&str; 7] = ["src/", "tests/", "docs/", "config/", "benches/", "bridge/", ".ci/"];

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn read(name: &str) -> String {
    fs::read_to_string(root().join(name)).unwrap_or_else(|error| panic!("{name}: {error}"))
}

/// The keys of the tables of `docs/parameters.md`, with the default beside each.
fn documented() -> BTreeMap<String, String> {
    let document = read("docs/parameters.md");
    let rows = document.lines().filter_map(|line| line.strip_prefix("| `"));
    let cells = rows.filter_map(|row| {
        let mut cells = row.split('|').map(str::trim);
        Some((cells.next()?.trim_end_matches('`').to_owned(), cells.next()?.to_owned()))
    });
    let mut documented = BTreeMap::new();
    for (key, default) in cells {
        let before = documented.insert(key.clone(), default);
        assert!(before.is_none(), "docs/parameters.md has {key} twice");
    }
    documented
}

#[test]
fn every_key_is_documented_with_its_default_and_no_other() {
    let keys = serde_json::to_value(RawConfig::default()).expect("the configuration is JSON");
    let Value::Object(keys) = keys else { panic!("the configuration is an object") };
    let keys: BTreeMap<String, String> =
        keys.into_iter().map(|(key, default)| (key, default.to_string())).collect();
    assert_eq!(documented(), keys, "docs/parameters.md on the left, src/config/raw.rs right");
}

#[test]
fn files_that_documents_name_are_there() {
    let mut missing = Vec::new();
    for name in DOCUMENTS {
        for (index, line) in read(name).lines().enumerate() {
            for path in paths(line).filter(|path| !root().join(path).exists()) {
                missing.push(format!("{name}:{}: {path}", index + 1));
            }
        }
    }
    assert!(missing.is_empty(), "no such file:\n{}", missing.join("\n"));
}

/// Names of files of this project that a line has between backticks or as a link.
fn paths(line: &str) -> impl Iterator<Item = &str> {
    let words = line.split(['`', '(', ')', ' ', ',']);
    words.filter(|word| {
        FOLDERS.iter().any(|folder| word.starts_with(folder)) && !word.contains(['<', '*'])
    })
}

/// The keys of a table of the page's script.
fn keys_of(table: &str) -> Vec<String> {
    let script = read("src/cli/view/view.js");
    let (_, rest) = script.split_once(&format!("const {table} = {{")).expect("it has the table");
    let (table, _) = rest.split_once("};").expect("the table ends");
    let keys = table.split(", ").flat_map(|part| part.split(",\n"));
    let keys = keys.filter_map(|entry| entry.split_once(": \"")).map(|(key, _)| key.trim());
    keys.map(str::to_owned).collect()
}

fn names<T: Serialize>(all: &[T]) -> BTreeSet<String> {
    let name = |of: &T| serde_json::to_value(of).expect("it is JSON");
    all.iter().map(|of| name(of).as_str().expect("it is a word").to_owned()).collect()
}

#[test]
fn the_page_has_words_for_every_verdict_and_a_colour_for_every_state() {
    for (table, all) in [("VERDICTS", names(&Verdict::ALL)), ("STATES", names(&State::ALL))] {
        let told: BTreeSet<String> = keys_of(table).into_iter().collect();
        assert_eq!(told, all, "{table} of the page on the left, the daemon's right");
    }
}

#[test]
fn the_architecture_fits_two_hundred_lines() {
    let lines = read("docs/architecture.md").lines().count();
    assert!(lines <= 200, "docs/architecture.md has {lines} lines");
}
