//! What `docs/architecture.md` says must never be, and what `docs/dependencies.md` must name.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

/// Words that would make the core depend on anything but its arguments.
const IMPURE: [&str; 39] = [
    "std::fs",
    "std::io",
    "std::net",
    "std::env",
    "std::process",
    "std::time",
    "std::thread",
    "std::os",
    "Instant",
    "SystemTime",
    "tokio",
    "zenoh",
    "async",
    "await",
    "tracing",
    "log::",
    "print!",
    "println!",
    "eprint!",
    "eprintln!",
    "dbg!",
    "static mut",
    "thread_local!",
    "OnceLock",
    "LazyLock",
    "OnceCell",
    "LazyCell",
    "Mutex",
    "RwLock",
    "AtomicBool",
    "AtomicUsize",
    "AtomicU64",
    "thread_rng",
    "rand::rng",
    "from_os_rng",
    "from_entropy",
    "unsafe",
    "available_parallelism",
    "include_bytes!",
];

/// Functions whose last digit depends on the platform, where those of `libm` do not, and maps whose
/// order changes from run to run.
const NOT_REPEATABLE: [&str; 13] = [
    "HashMap",
    ".sin()",
    ".cos()",
    ".tan()",
    ".sin_cos()",
    ".atan2(",
    ".exp()",
    ".ln()",
    ".powf(",
    ".powi(",
    ".hypot(",
    ".cbrt()",
    ".mul_add(",
];

/// Each module of the library, and the modules it may use.
const MAY_USE: [(&str, &[&str]); 21] = [
    ("slam", &[]),
    ("checkpoint", &["files", "slam"]),
    ("sim", &["slam"]),
    ("logs", &["ros", "slam"]),
    ("config", &["slam"]),
    ("ros", &[]),
    ("convert", &["ros", "slam", "tf"]),
    ("timeline", &["slam"]),
    ("tf", &["slam", "timeline"]),
    ("given_poses", &["evaluation", "slam", "timeline"]),
    ("replay", &["clock", "config", "convert", "evaluation", "logs", "slam", "statistics"]),
    ("recorded", &["clock", "config", "convert", "daemon", "logs", "ros", "slam", "tf"]),
    // Its tests read what the daemon writes.
    ("playback", &["convert", "daemon", "logs", "ros", "slam"]),
    (
        "doctor",
        // Its tests watch simulated robots.
        &["config", "convert", "playback", "ros", "sim", "slam", "statistics", "tf", "timeline"],
    ),
    ("map", &["slam", "statistics"]),
    ("evaluation", &["slam", "statistics"]),
    (
        "daemon",
        &[
            "checkpoint",
            "clock",
            "config",
            "convert",
            "evaluation",
            "files",
            "logs",
            "map",
            "replay",
            "ros",
            "sim",
            "slam",
            "statistics",
            "tf",
            "timeline",
        ],
    ),
    ("client", &["daemon", "map"]),
    ("files", &[]),
    ("clock", &[]),
    ("statistics", &[]),
];

/// Words that a module must not have, beside those its row above rules out.
const NEVER: [(&str, &[&str]); 11] = [
    ("checkpoint", &["tokio", "zenoh", "slam::gmapping", "slam::grid"]),
    ("sim", &["tokio", "zenoh", "Instant", "SystemTime", "std::fs"]),
    // The vocabulary of poses and scans, and not the filter.
    ("logs", &["tokio", "zenoh", "slam::gmapping", "slam::grid"]),
    ("config", &["tokio", "zenoh"]),
    ("ros", &["tokio", "zenoh::"]),
    ("convert", &["tokio", "zenoh", "slam::gmapping"]),
    ("timeline", &["tokio", "zenoh", "Instant", "SystemTime"]),
    ("tf", &["tokio", "zenoh", "Instant", "SystemTime"]),
    ("map", &["tokio", "zenoh", "slam::gmapping"]),
    ("playback", &["tokio", "zenoh", "slam::gmapping", "Instant", "SystemTime"]),
    ("doctor", &["tokio", "zenoh", "slam::gmapping", "Instant", "SystemTime"]),
];

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn read(path: &Path) -> String {
    fs::read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// Every Rust file below a directory, or the file itself; in the order of their names.
fn rust_files(path: &Path) -> Vec<PathBuf> {
    if path.is_file() {
        return vec![path.to_owned()];
    }
    let Ok(entries) = fs::read_dir(path) else { return Vec::new() };
    let mut entries: Vec<PathBuf> = entries.flatten().map(|entry| entry.path()).collect();
    entries.sort();
    let is_source = |path: &PathBuf| {
        path.is_dir() || path.extension().is_some_and(|extension| extension == "rs")
    };
    entries.iter().filter(|path| is_source(path)).flat_map(|path| rust_files(path)).collect()
}

/// The files of a module of the library: `src/name.rs` and what is below `src/name`.
fn files_of(module: &str) -> Vec<PathBuf> {
    let source = root().join("src");
    let mut files = rust_files(&source.join(module));
    files.extend(rust_files(&source.join(format!("{module}.rs"))));
    files
}

/// A line as the compiler sees it.
fn without_comment(line: &str) -> &str {
    line.split_once("//").map_or(line, |(code, _)| code)
}

/// Whether `code` has `word`, and not as a part of a longer name.
fn has_word(code: &str, word: &str) -> bool {
    let in_name = |c: char| c.is_alphanumeric() || c == '_';
    code.match_indices(word).any(|(at, _)| {
        let before = code[..at].chars().next_back().is_some_and(in_name);
        let after = code[at + word.len()..].chars().next().is_some_and(in_name);
        !(before && word.starts_with(in_name) || after && word.ends_with(in_name))
    })
}

/// `file:line: has word` for each word that a file's text has.
fn findings(path: &Path, text: &str, words: &[&str]) -> Vec<String> {
    let file = path.strip_prefix(root()).unwrap_or(path).display();
    let lines = text.lines().map(without_comment).enumerate();
    lines
        .flat_map(|(index, code)| {
            let found = words.iter().filter(move |word| has_word(code, word));
            found.map(move |word| (index + 1, *word))
        })
        .map(|(line, word)| format!("{file}:{line}: has {word}"))
        .collect()
}

fn assert_none(findings: &[String], rule: &str) {
    assert!(findings.is_empty(), "{rule}:\n{}", findings.join("\n"));
}

/// The modules of the library that `src/lib.rs` declares.
fn modules() -> BTreeSet<String> {
    let library = read(&root().join("src/lib.rs"));
    let declared = library.lines().filter_map(|line| line.strip_prefix("pub mod "));
    declared.map(|rest| rest.trim_end_matches(';').to_owned()).collect()
}

#[test]
fn the_scan_finds_words_and_not_parts_of_names() {
    let text =
        "use std::fs;\n// std::fs in a comment\nlet instantaneous = x.sin();\nInstant::now();";
    let found = findings(Path::new("a.rs"), text, &["std::fs", "Instant", ".sin()"]);
    assert_eq!(found, ["a.rs:1: has std::fs", "a.rs:3: has .sin()", "a.rs:4: has Instant"]);
}

#[test]
fn the_core_has_no_files_clocks_output_globals_or_async() {
    let files = files_of("slam");
    assert!(files.len() > 15, "the core was not found");
    let mut words = IMPURE.to_vec();
    let others = modules().into_iter().filter(|module| module != "slam");
    let others: Vec<String> = others.map(|module| format!("crate::{module}")).collect();
    words.extend(others.iter().map(String::as_str));
    let found: Vec<String> =
        files.iter().flat_map(|file| findings(file, &read(file), &words)).collect();
    assert_none(&found, "src/slam is pure");
}

/// The same bytes on every machine need the same sine; tests may use any.
#[test]
fn the_core_uses_only_what_gives_the_same_bytes_everywhere() {
    let found: Vec<String> = files_of("slam")
        .iter()
        .flat_map(|file| {
            let text = read(file);
            let code = text.split("#[cfg(test)]").next().unwrap_or_default();
            findings(file, code, &NOT_REPEATABLE)
        })
        .collect();
    assert_none(&found, "src/slam gives the same bytes everywhere, with functions of libm");
}

#[test]
fn modules_use_only_those_below_them() {
    let modules = modules();
    let named: BTreeSet<String> = MAY_USE.iter().map(|(module, _)| (*module).to_owned()).collect();
    assert_eq!(named, modules, "MAY_USE has a row for each module of src/lib.rs");
    let mut found = Vec::new();
    for (module, allowed) in MAY_USE {
        let others = modules.iter().filter(|other| *other != module);
        let ruled_out: Vec<String> = others
            .filter(|other| !allowed.contains(&other.as_str()))
            .map(|other| format!("crate::{other}"))
            .collect();
        let never = NEVER.iter().filter(|(name, _)| *name == module).flat_map(|(_, words)| *words);
        // Grouped paths would hide what they name.
        let mut words = vec!["crate::{", "crate::*"];
        words.extend(ruled_out.iter().map(String::as_str).chain(never.copied()));
        for file in files_of(module) {
            found.extend(findings(&file, &read(&file), &words));
        }
    }
    assert_none(&found, "the table MAY_USE of tests/architecture.rs");
}

#[test]
fn only_one_file_reads_clocks() {
    let clocks = ["Instant::now", "SystemTime::now", "clock_gettime"];
    let others = rust_files(&root().join("src")).into_iter();
    let found: Vec<String> = others
        .filter(|file| !file.ends_with("src/clock.rs"))
        .flat_map(|file| findings(&file, &read(&file), &clocks))
        .collect();
    assert_none(&found, "only src/clock.rs reads clocks");
}

#[test]
fn main_is_thin() {
    let lines = read(&root().join("src/main.rs")).lines().count();
    assert!(lines <= 60, "src/main.rs has {lines} lines; at most 60 are allowed");
}

/// The names in the dependency tables of `Cargo.toml`.
fn dependencies() -> BTreeSet<String> {
    let manifest = read(&root().join("Cargo.toml"));
    let mut names = BTreeSet::new();
    let mut in_table = false;
    for line in manifest.lines() {
        if line.starts_with('[') {
            in_table = line.contains("dependencies]");
        } else if let Some((name, _)) = line.split_once('=').filter(|_| in_table) {
            names.insert(name.trim().to_owned());
        }
    }
    names
}

#[test]
fn every_dependency_is_explained_and_no_other() {
    let document = read(&root().join("docs/dependencies.md"));
    let first_cells = document.lines().filter_map(|line| line.strip_prefix("| `"));
    let explained: BTreeSet<String> = first_cells
        .filter_map(|line| line.split(" |").next())
        .flat_map(|cell| cell.split(['`', ',']))
        .map(str::trim)
        .filter(|name| !name.is_empty() && !name.starts_with('('))
        .map(str::to_owned)
        .collect();
    assert_eq!(explained, dependencies(), "docs/dependencies.md on the left, Cargo.toml right");
}

#[test]
fn every_dependency_is_used() {
    let folders = ["src", "tests", "benches"].map(|folder| root().join(folder));
    let code: String =
        folders.iter().flat_map(|folder| rust_files(folder)).map(|f| read(&f)).collect();
    let unused: Vec<String> = dependencies()
        .into_iter()
        .filter(|name| !has_word(&code, &name.replace('-', "_")))
        .collect();
    assert!(unused.is_empty(), "in Cargo.toml, and nowhere used: {unused:?}");
}
