//! A grid without bounds that is cheap to copy: tiles behind reference counts, copied when written.
//!
//! Tiles are gathered in pages, so that a clone of the map copies one short list of pages and a
//! write copies at most one page of pointers and one tile.

pub mod saved;

use std::collections::{BTreeSet, HashSet};

use serde::{Deserialize, Serialize};
use triomphe::Arc;

use super::Cell;

/// Cells along the side of a tile.
pub const TILE_SIZE: usize = 16;
/// Cells in a tile.
pub const TILE_CELLS: usize = TILE_SIZE * TILE_SIZE;
const TILE_SHIFT: u32 = TILE_SIZE.trailing_zeros();
const PAGE_SIZE: usize = 8;
const PAGE_SHIFT: u32 = PAGE_SIZE.trailing_zeros();

/// The cells of a tile, row by row.
pub type Tile<C> = [C; TILE_CELLS];

/// Which tile: cell coordinates divided by [`TILE_SIZE`], rounded down; rows order first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct TileKey {
    /// Row of tiles.
    pub ty: i32,
    /// Column of tiles.
    pub tx: i32,
}

impl TileKey {
    /// The tile that holds `cell`.
    #[must_use]
    pub const fn containing(cell: Cell) -> Self {
        Self { ty: cell.iy >> TILE_SHIFT, tx: cell.ix >> TILE_SHIFT }
    }

    /// The lower-left cell of the tile.
    #[must_use]
    pub const fn first_cell(self) -> Cell {
        Cell::new(self.tx << TILE_SHIFT, self.ty << TILE_SHIFT)
    }

    const fn page(self) -> Self {
        Self { ty: self.ty >> PAGE_SHIFT, tx: self.tx >> PAGE_SHIFT }
    }

    const fn slot(self) -> usize {
        let mask = PAGE_SIZE as i32 - 1;
        (self.ty & mask) as usize * PAGE_SIZE + (self.tx & mask) as usize
    }
}

/// Index of `cell` within its tile.
#[must_use]
pub const fn index_in_tile(cell: Cell) -> usize {
    let mask = TILE_SIZE as i32 - 1;
    (cell.iy & mask) as usize * TILE_SIZE + (cell.ix & mask) as usize
}

#[derive(Debug, Clone)]
struct Page<C> {
    tiles: [Option<Arc<Tile<C>>>; PAGE_SIZE * PAGE_SIZE],
}

impl<C> Page<C> {
    fn tiles(&self, page: TileKey) -> impl Iterator<Item = (TileKey, &Tile<C>)> {
        self.tiles.iter().enumerate().filter_map(move |(slot, tile)| {
            let key = TileKey {
                ty: (page.ty << PAGE_SHIFT) + (slot / PAGE_SIZE) as i32,
                tx: (page.tx << PAGE_SHIFT) + (slot % PAGE_SIZE) as i32,
            };
            Some((key, &**tile.as_ref()?))
        })
    }
}

/// Cells of type `C` over the whole plane; a cell never written holds `C::default()`.
///
/// A clone shares every tile with its original until one of the two writes to it.
#[derive(Debug, Clone, Default)]
pub struct TileMap<C> {
    /// Ordered by key.
    pages: Vec<(TileKey, Arc<Page<C>>)>,
    /// The page that was written last; the next tile is often in it, too.
    last: usize,
}

impl<C: Copy + Default> TileMap<C> {
    /// A map in which every cell holds the default.
    #[must_use]
    pub const fn new() -> Self {
        Self { pages: Vec::new(), last: 0 }
    }

    /// The value of one cell.
    #[must_use]
    pub fn get(&self, cell: Cell) -> C {
        self.tile(TileKey::containing(cell))
            .map_or_else(C::default, |tile| tile[index_in_tile(cell)])
    }

    /// A tile, if a cell of it was ever written.
    #[must_use]
    pub fn tile(&self, key: TileKey) -> Option<&Tile<C>> {
        self.page(key.page())?.tiles[key.slot()].as_deref()
    }

    /// A tile to write to: created if missing, copied if shared.
    pub fn tile_mut(&mut self, key: TileKey) -> &mut Tile<C> {
        let page_key = key.page();
        let is_last = self.pages.get(self.last).is_some_and(|(page, _)| *page == page_key);
        if !is_last {
            self.last = self.pages.partition_point(|(page, _)| *page < page_key);
            if self.pages.get(self.last).is_none_or(|(page, _)| *page != page_key) {
                let empty = Page { tiles: [const { None }; PAGE_SIZE * PAGE_SIZE] };
                self.pages.insert(self.last, (page_key, Arc::new(empty)));
            }
        }
        let page = Arc::make_mut(&mut self.pages[self.last].1);
        let tile =
            page.tiles[key.slot()].get_or_insert_with(|| Arc::new([C::default(); TILE_CELLS]));
        Arc::make_mut(tile)
    }

    /// A cell to write to.
    pub fn get_mut(&mut self, cell: Cell) -> &mut C {
        &mut self.tile_mut(TileKey::containing(cell))[index_in_tile(cell)]
    }

    /// The written tiles in the rectangle from `first` to `last`, both included.
    pub fn tiles_between(
        &self,
        first: TileKey,
        last: TileKey,
    ) -> impl Iterator<Item = (TileKey, &Tile<C>)> {
        let (first_page, last_page) = (first.page(), last.page());
        let start = self.pages.partition_point(|(page, _)| page.ty < first_page.ty);
        self.pages[start..]
            .iter()
            .take_while(move |(page, _)| page.ty <= last_page.ty)
            .filter(move |(page, _)| (first_page.tx..=last_page.tx).contains(&page.tx))
            .flat_map(|(key, page)| page.tiles(*key))
            .filter(move |(key, _)| {
                (first.tx..=last.tx).contains(&key.tx) && (first.ty..=last.ty).contains(&key.ty)
            })
    }

    /// The tiles that are not shared with `before`, an earlier or later copy of this map: those
    /// that were written since one was cloned from the other, and some that hold the same still.
    ///
    /// It compares pointers, and of pages that are shared as a whole only one.
    #[must_use]
    pub fn tiles_not_shared_with(&self, before: &Self) -> Vec<TileKey> {
        let mut keys: BTreeSet<TileKey> = BTreeSet::new();
        for (here, there) in [(self, before), (before, self)] {
            for (page_key, page) in &here.pages {
                let other = there.page(*page_key);
                if other.is_some_and(|other| Arc::ptr_eq(page, other)) {
                    continue;
                }
                let is_other = |key: &TileKey, tile: &Tile<C>| {
                    let same = other.and_then(|other| other.tiles[key.slot()].as_deref());
                    !same.is_some_and(|same| std::ptr::eq(same, tile))
                };
                let tiles = page.tiles(*page_key).filter(|(key, tile)| is_other(key, tile));
                keys.extend(tiles.map(|(key, _)| key));
            }
        }
        keys.into_iter().collect()
    }

    fn page(&self, key: TileKey) -> Option<&Arc<Page<C>>> {
        let found = self.pages.binary_search_by_key(&key, |(page, _)| *page).ok()?;
        Some(&self.pages[found].1)
    }

    /// Every written tile, page by page.
    pub fn tiles(&self) -> impl Iterator<Item = (TileKey, &Tile<C>)> {
        self.pages.iter().flat_map(|(key, page)| page.tiles(*key))
    }
}

/// A part of a map in which many cells are read: whole pages, so that none is searched for.
///
/// Cells are counted from [`Self::first_cell`]; outside, every cell holds the default.
#[derive(Debug)]
pub struct Window<'a, C> {
    first: Cell,
    columns: usize,
    pages: Vec<Option<&'a Page<C>>>,
}

impl<'a, C: Copy + Default> Window<'a, C> {
    /// The pages of `map` from the one with the cell `low` to the one with `high`.
    #[must_use]
    pub fn between(map: &'a TileMap<C>, low: Cell, high: Cell) -> Self {
        let [first, last] = [low, high].map(|cell| TileKey::containing(cell).page());
        let columns = (last.tx - first.tx + 1) as usize;
        let mut pages = vec![None; columns * (last.ty - first.ty + 1) as usize];
        let start = map.pages.partition_point(|(page, _)| page.ty < first.ty);
        let rows = map.pages[start..].iter().take_while(|(page, _)| page.ty <= last.ty);
        for (key, page) in rows.filter(|(page, _)| (first.tx..=last.tx).contains(&page.tx)) {
            let row = (key.ty - first.ty) as usize;
            pages[row * columns + (key.tx - first.tx) as usize] = Some(&**page);
        }
        let shift = PAGE_SHIFT + TILE_SHIFT;
        Self { first: Cell::new(first.tx << shift, first.ty << shift), columns, pages }
    }

    /// The lower-left cell of the window, in the map.
    #[must_use]
    pub const fn first_cell(&self) -> Cell {
        self.first
    }

    /// The values of a cell, of its right, its upper and its upper right neighbour.
    #[inline]
    #[must_use]
    pub fn square(&self, column: usize, row: usize) -> [C; 4] {
        let (x, y) = (column % TILE_SIZE, row % TILE_SIZE);
        if x + 1 < TILE_SIZE && y + 1 < TILE_SIZE {
            let Some(tile) = self.tile(column, row) else { return [C::default(); 4] };
            let index = y * TILE_SIZE + x;
            return [index, index + 1, index + TILE_SIZE, index + TILE_SIZE + 1]
                .map(|index| tile[index % TILE_CELLS]);
        }
        [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(dx, dy)| self.get(column + dx, row + dy))
    }

    /// The values of a cell and of those to its right in the same tile; `None` if it was never
    /// written.
    #[inline]
    #[must_use]
    pub fn rest_of_row(&self, column: usize, row: usize) -> Option<&'a [C]> {
        let (x, y) = (column % TILE_SIZE, row % TILE_SIZE);
        Some(&self.tile(column, row)?[y * TILE_SIZE + x..(y + 1) * TILE_SIZE])
    }

    /// The value of one cell.
    #[inline]
    #[must_use]
    pub fn get(&self, column: usize, row: usize) -> C {
        let index = row % TILE_SIZE * TILE_SIZE + column % TILE_SIZE;
        self.tile(column, row).map_or_else(C::default, |tile| tile[index])
    }

    #[inline]
    fn tile(&self, column: usize, row: usize) -> Option<&'a Tile<C>> {
        let page_column = column >> (PAGE_SHIFT + TILE_SHIFT);
        if page_column >= self.columns {
            return None;
        }
        let page = (row >> (PAGE_SHIFT + TILE_SHIFT)) * self.columns + page_column;
        let slot = (row / TILE_SIZE % PAGE_SIZE) * PAGE_SIZE + column / TILE_SIZE % PAGE_SIZE;
        self.pages.get(page).copied().flatten()?.tiles[slot].as_deref()
    }
}

/// How many tiles some maps refer to, and how many there are when shared ones count once.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct TileCounts {
    /// References to tiles, summed over the maps.
    pub referenced: usize,
    /// Tiles in memory.
    pub distinct: usize,
    /// Bytes of the tiles in memory.
    pub bytes: usize,
}

impl TileCounts {
    /// Counts the tiles of `maps`.
    #[must_use]
    pub fn of<'a, C: Copy + Default + 'a>(maps: impl Iterator<Item = &'a TileMap<C>>) -> Self {
        let mut distinct = HashSet::new();
        let mut referenced = 0;
        for (_, tile) in maps.flat_map(TileMap::tiles) {
            referenced += 1;
            distinct.insert(std::ptr::from_ref(tile));
        }
        let bytes = distinct.len() * size_of::<Tile<C>>();
        Self { referenced, distinct: distinct.len(), bytes }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::{prop_assert_eq, proptest};

    use super::*;

    const SPREAD: std::ops::Range<i32> = -600..600;

    proptest! {
        #[test]
        fn copy_on_write_equals_deep_copies(
            before in proptest::collection::vec((SPREAD, SPREAD, 1_u8..), 0..40),
            after in proptest::collection::vec((SPREAD, SPREAD, 1_u8.., 0..2_usize), 0..40),
        ) {
            let mut shared = [TileMap::new(), TileMap::new()];
            let mut deep = [std::collections::HashMap::new(), std::collections::HashMap::new()];
            for (ix, iy, value) in before {
                *shared[0].get_mut(Cell::new(ix, iy)) = value;
                deep[0].insert((ix, iy), value);
            }
            shared[1] = shared[0].clone();
            deep[1] = deep[0].clone();
            for (ix, iy, value, which) in after {
                *shared[which].get_mut(Cell::new(ix, iy)) = value;
                deep[which].insert((ix, iy), value);
            }
            for (map, expected) in shared.iter().zip(&deep) {
                let written = map.tiles().flat_map(|(_, tile)| tile).filter(|v| **v != 0).count();
                prop_assert_eq!(written, expected.len());
                for ((ix, iy), value) in expected {
                    prop_assert_eq!(map.get(Cell::new(*ix, *iy)), *value);
                }
            }
        }
    }

    #[test]
    fn only_the_written_tile_is_copied() {
        let mut a = TileMap::<u8>::new();
        *a.get_mut(Cell::new(0, 0)) = 1;
        *a.get_mut(Cell::new(-1, 0)) = 2;
        let mut b = a.clone();
        *b.get_mut(Cell::new(5, 5)) = 3;
        let counts = TileCounts::of([&a, &b].into_iter());
        assert_eq!((counts.referenced, counts.distinct), (4, 3));
        assert_eq!(a.get(Cell::new(5, 5)), 0);
    }

    proptest! {
        #[test]
        fn written_tiles_are_told_and_no_others(
            before in proptest::collection::vec((SPREAD, SPREAD), 0..40),
            after in proptest::collection::vec((SPREAD, SPREAD), 0..20),
        ) {
            let mut old = TileMap::<u8>::new();
            for (ix, iy) in before {
                *old.get_mut(Cell::new(ix, iy)) += 1;
            }
            let mut new = old.clone();
            let mut written = BTreeSet::new();
            for (ix, iy) in after {
                *new.get_mut(Cell::new(ix, iy)) += 1;
                written.insert(TileKey::containing(Cell::new(ix, iy)));
            }
            let written: Vec<_> = written.into_iter().collect();
            prop_assert_eq!(&new.tiles_not_shared_with(&old), &written);
            prop_assert_eq!(&old.tiles_not_shared_with(&new), &written);
        }
    }

    #[test]
    fn tiles_know_where_they_are() {
        let mut map = TileMap::<u8>::new();
        for cell in [Cell::new(-1, -33), Cell::new(1000, 7), Cell::new(i32::MAX, i32::MIN)] {
            *map.get_mut(cell) = 9;
            let key = TileKey::containing(cell);
            assert!(
                map.tiles().any(|(found, tile)| found == key && tile[index_in_tile(cell)] == 9)
            );
        }
    }
}
