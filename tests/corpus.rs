//! Inputs of every kind and their mutants are the end of nothing: a fuzzer that runs with the
//! tests.
//!
//! `GMAPD_FUZZ=1000000 cargo test --release --test corpus` runs so many mutants of each kind.

#[path = "fuzz/targets.rs"]
#[allow(unreachable_pub, reason = "the fuzzers are another package")]
mod targets;

use std::alloc::System;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

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

/// Lengths and counts that have been the end of many a reader.
const FATEFUL: [u64; 8] =
    [0, 1, 0x7f, 0xff, 0xffff, 0x7fff_ffff, 0xffff_ffff, 0xffff_ffff_ffff_ffff];

/// One test, for what is allocated is counted of the whole process.
#[test]
fn every_input_and_its_mutants_are_borne() {
    let mutants =
        std::env::var("GMAPD_FUZZ").map_or(MUTANTS, |text| text.parse().expect("a number"));
    for (name, target) in targets::ALL {
        let inputs = inputs(name);
        assert!(inputs.len() >= 3, "{name} has {} inputs", inputs.len());
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

/// An input that is not borne is kept, to become one of the corpus.
fn bear(name: &str, target: targets::Target, input: &[u8]) {
    let region = Region::new(MEMORY);
    let ended = catch_unwind(AssertUnwindSafe(|| target(input)));
    let allocated = region.change().bytes_allocated;
    if ended.is_err() || allocated > MOST_ALLOCATED {
        let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("not-borne-{name}"));
        std::fs::write(&path, input).expect("it can be kept");
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
