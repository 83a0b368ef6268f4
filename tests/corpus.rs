//! Inputs of every kind and their mutants are the end of nothing: a fuzzer that runs with the
//! tests.
//!
//! `GMAPD_FUZZ=1000000 cargo test --release --test corpus` runs so many mutants of each kind, and
//! with `GMAPD_FUZZ_KIND=states` those of one kind.

#[path = "fuzz/targets.rs"]
#[allow(unreachable_pub, reason = "the fuzzers are another package")]
mod targets;

use std::alloc::System;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::thread;
use std::time::{Duration, Instant};

use gmapd::checkpoint;
use gmapd::clock;
use gmapd::config::Config;
use gmapd::daemon::checkpointing::Checkpoint;
use gmapd::slam::engine::Engine;
use rand::seq::IndexedRandom as _;
use rand::{Rng as _, RngCore as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use stats_alloc::{INSTRUMENTED_SYSTEM, Region, StatsAlloc};

#[global_allocator]
static MEMORY: &StatsAlloc<System> = &INSTRUMENTED_SYSTEM;

/// Mutants of each kind, unless `GMAPD_FUZZ` says how many.
const MUTANTS: usize = 3000;

/// What one input may make a reader allocate, freed or not.
const MOST_ALLOCATED: usize = 256 << 20;

/// What one input may take, many times what any does.
const LONGEST: Duration = Duration::from_secs(5);

/// Lengths and counts that have been the end of many a reader.
const FATEFUL: [u64; 8] =
    [0, 1, 0x7f, 0xff, 0xffff, 0x7fff_ffff, 0xffff_ffff, 0xffff_ffff_ffff_ffff];

/// What is allocated is counted of the whole process; the other tests allocate little.
#[test]
fn every_input_and_its_mutants_are_borne() {
    let mutants =
        std::env::var("GMAPD_FUZZ").map_or(MUTANTS, |text| text.parse().expect("a number"));
    watch();
    for (name, target) in targets::ALL {
        let inputs = inputs(name);
        assert!(inputs.len() >= 3, "{name} has {} inputs", inputs.len());
        if std::env::var("GMAPD_FUZZ_KIND").is_ok_and(|kind| kind != name) {
            continue;
        }
        inputs.iter().for_each(|input| bear(name, target, input));
        let mut random = ChaCha8Rng::seed_from_u64(1);
        for _ in 0..mutants {
            bear(name, target, &mutant(&inputs, &mut random));
        }
    }
}

fn inputs(name: &str) -> Vec<Vec<u8>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fuzz/corpus").join(name);
    let mut paths: Vec<_> = std::fs::read_dir(folder)
        .expect("each kind has a folder")
        .map(|entry| entry.expect("it is listed").path())
        .collect();
    paths.sort();
    paths.iter().map(|path| std::fs::read(path).expect("it is a file")).collect()
}

/// What is being borne, and since when.
static BORNE: Mutex<Option<(&str, Vec<u8>, Instant)>> = Mutex::new(None);

/// Ends the process when an input takes too long: a target that hangs cannot be stopped.
fn watch() {
    let look = || {
        loop {
            thread::sleep(LONGEST / 10);
            let borne = BORNE.lock().expect("nobody panics with it").clone();
            let Some((name, input, since)) = borne else { continue };
            if since.elapsed() > LONGEST {
                eprintln!("{name}: {LONGEST:?} are over for {}", keep(name, &input).display());
                std::process::exit(1);
            }
        }
    };
    let thread = thread::Builder::new().name("watch".to_owned());
    thread.spawn(look).expect("a thread can be started");
}

fn keep(name: &str, input: &[u8]) -> PathBuf {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("not-borne-{name}"));
    std::fs::write(&path, input).expect("it can be kept");
    path
}

/// An input that is not borne is kept, to become one of the corpus.
fn bear(name: &'static str, target: targets::Target, input: &[u8]) {
    *BORNE.lock().expect("nobody panics with it") = Some((name, input.to_vec(), clock::now()));
    let region = Region::new(MEMORY);
    let ended = catch_unwind(AssertUnwindSafe(|| target(input)));
    let allocated = region.change().bytes_allocated;
    *BORNE.lock().expect("nobody panics with it") = None;
    if ended.is_err() || allocated > MOST_ALLOCATED {
        let path = keep(name, input);
        panic!("{name}: {} bytes allocated for the input in {}", allocated, path.display());
    }
}

fn mutant(inputs: &[Vec<u8>], random: &mut ChaCha8Rng) -> Vec<u8> {
    let mut bytes = inputs.choose(random).expect("there are some").clone();
    for _ in 0..random.random_range(1..6) {
        mutate(&mut bytes, inputs, random);
    }
    bytes
}

fn mutate(bytes: &mut Vec<u8>, inputs: &[Vec<u8>], random: &mut ChaCha8Rng) {
    let at = random.random_range(0..=bytes.len());
    let end = random.random_range(at..=bytes.len().min(at + 64));
    match random.random_range(0..7) {
        0 => bytes.truncate(at),
        1 => drop(bytes.drain(at..end)),
        2 => bytes.extend_from_within(at..end),
        3 => bytes.insert(at, random.next_u32() as u8),
        4 => {
            let other = inputs.choose(random).expect("there are some");
            bytes.truncate(at);
            bytes.extend_from_slice(&other[at.min(other.len())..]);
        }
        5 => {
            let width = [1, 2, 4, 8][random.random_range(0..4)];
            let number = FATEFUL.choose(random).expect("there are some").to_le_bytes();
            bytes.iter_mut().skip(at).take(width).zip(number).for_each(|(byte, new)| *byte = new);
        }
        _ => {
            let bit = 1 << random.random_range(0..8);
            bytes.iter_mut().skip(at).take(1).for_each(|byte| *byte ^= bit);
        }
    }
}

#[test]
fn each_target_has_a_fuzzer() {
    let package = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fuzz");
    let manifest = std::fs::read_to_string(package.join("Cargo.toml")).expect("it is there");
    for (name, _) in targets::ALL {
        let path = format!("fuzz_targets/{name}.rs");
        assert!(manifest.contains(&format!("name = \"{name}\"\npath = \"{path}\"\n")), "{name}");
        let text = std::fs::read_to_string(package.join(path)).expect("it is there");
        assert!(text.contains(&format!("gmapd_fuzz::{name}(bytes)")), "{text}");
    }
}

/// Robots have such files: a gmapd that reads the same format goes on from them.
#[test]
fn checkpoints_of_this_format_are_gone_on_from() {
    const ADVICE: &str = "if the state has changed, raise FORMAT in src/checkpoint.rs, and make the \
                          files tests/fuzz/corpus/checkpoints/file-* and their bodies in \
                          tests/fuzz/corpus/states anew";
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fuzz/corpus");
    for name in ["gmapping", "hector", "known_poses"] {
        let file = folder.join(format!("checkpoints/file-{name}"));
        let bytes = checkpoint::read(&file).expect("it is there");
        let opened = checkpoint::open(&bytes).unwrap_or_else(|e| panic!("{name}: {e}; {ADVICE}"));
        let body = opened.body().expect("its checksum fits");
        let state = Checkpoint::decode(&opened).unwrap_or_else(|e| panic!("{name}: {e}; {ADVICE}"));
        let mut again = Vec::new();
        state.write(&mut again).expect("memory takes it");
        assert!(again == body, "{name}: {ADVICE}");
        assert!(std::fs::read(folder.join("states").join(name)).is_ok_and(|state| state == body));
        let set = [format!("engine={name}"), "particles=2".to_owned(), "maxUrange=3".to_owned()];
        let parameters = Config::load(None, &set).expect("it is allowed").engine_parameters();
        let mut engine = Engine::new(parameters, 1).expect("it needs no thread");
        let resumed = engine.resume(state.engine.clone());
        resumed.unwrap_or_else(|e| panic!("{name}: {e}; {ADVICE}"));
        assert!(engine.state() == state.engine, "{name}: {ADVICE}");
        assert_eq!(engine.path().len() as u64, opened.head.processed, "{name}: {ADVICE}");
        assert!(engine.occupancy_grid().is_some(), "{name}: {ADVICE}");
    }
}
