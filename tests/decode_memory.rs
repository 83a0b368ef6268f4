//! Decoders allocate by the bytes that are there, whatever lengths the bytes claim.

use std::alloc::System;

use gmapd::ros::{
    DiagnosticArray, GetMapResponse, LaserScan, Message, OccupancyGrid, Path, PoseArray, TfMessage,
    decode,
};
use proptest::collection::vec;
use proptest::prelude::{any, prop_assert, prop_oneof, proptest};
use proptest::strategy::{Just, Strategy};
use stats_alloc::{INSTRUMENTED_SYSTEM, Region, StatsAlloc};

#[global_allocator]
static MEMORY: &StatsAlloc<System> = &INSTRUMENTED_SYSTEM;

/// One test, for the count is that of the whole process.
#[test]
fn decoders_allocate_by_the_bytes_that_are_there() {
    allocation_is_bounded_by_the_input();
    a_claimed_length_costs_nothing();
    the_largest_list_stays_within_the_bound();
}

/// The most a list may take a byte of input, regrown as it is: a list of statuses with empty
/// strings.
const BYTES_A_BYTE: usize = 40;

/// For the error's text and small buffers.
const ALLOWANCE: usize = 4096;

/// Everything that decoding allocated, freed or not.
fn allocated<M: Message>(bytes: &[u8]) -> usize {
    let region = Region::new(MEMORY);
    decode::<M>(bytes, "").ok();
    region.change().bytes_allocated
}

fn worst(bytes: &[u8]) -> usize {
    [
        allocated::<LaserScan>(bytes),
        allocated::<OccupancyGrid>(bytes),
        allocated::<GetMapResponse>(bytes),
        allocated::<PoseArray>(bytes),
        allocated::<Path>(bytes),
        allocated::<TfMessage>(bytes),
        allocated::<DiagnosticArray>(bytes),
    ]
    .into_iter()
    .max()
    .expect("there are decoders")
}

/// Words as a hostile sender would choose them: lengths that are huge, and lengths that fit.
fn words() -> impl Strategy<Value = [u8; 4]> {
    let hostile = prop_oneof![Just(u32::MAX), Just(0x7fff_ffff), Just(0xffff_fff0), 0..9_u32];
    prop_oneof![hostile.prop_map(u32::to_le_bytes), any::<[u8; 4]>()]
}

proptest! {
    fn allocation_is_bounded_by_the_input(words in vec(words(), 0..400)) {
        let bytes = [vec![[0, 1, 0, 0]], words].concat().concat();
        let most = BYTES_A_BYTE * bytes.len() + ALLOWANCE;
        let worst = worst(&bytes);
        prop_assert!(worst <= most, "{worst} bytes for {}", bytes.len());
    }
}

/// A frame id, and then a list, that claim four thousand million elements.
fn a_claimed_length_costs_nothing() {
    let frame = [[0, 1, 0, 0], [0; 4], [0; 4], [0xf0, 0xff, 0xff, 0xff], [0; 4]].concat();
    assert!(worst(&frame) < ALLOWANCE);
    let list = [[0, 1, 0, 0], [0; 4], [0; 4], [1, 0, 0, 0], [0; 4], [0xff; 4], [0; 4]].concat();
    assert!(worst(&list) < ALLOWANCE);
}

/// An honest list is the worst case of the bound above: it is kept whole.
fn the_largest_list_stays_within_the_bound() {
    let empty_statuses = [vec![0, 1, 0, 0], vec![0; 12], 10_000_u32.to_le_bytes().to_vec()];
    let bytes = [empty_statuses.concat(), vec![0; 20 * 10_000]].concat();
    let statuses = allocated::<DiagnosticArray>(&bytes);
    assert!(statuses <= BYTES_A_BYTE * bytes.len() + ALLOWANCE, "{statuses}");
    assert!(statuses > bytes.len(), "the list was not read: {statuses}");
}
