//! Maps as plain data: pages and tiles that maps share are written once, and shared again.

use std::collections::BTreeMap;
use std::fmt;
use std::marker::PhantomData;

use serde::de::{Error as _, SeqAccess, Visitor};
use serde::ser::SerializeTuple as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use triomphe::Arc;

use super::super::super::state::{StateError, ensure};
use super::{PAGE_SIZE, Page, TILE_CELLS, Tile, TileKey, TileMap};

/// Pages further from the origin have no cells whose coordinates fit.
const FURTHEST_PAGE: i32 = 1 << 24;

const PARTS: &str = "tiles";

/// Some maps.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(bound(serialize = "C: Serialize", deserialize = "C: Deserialize<'de> + Copy + Default"))]
pub struct SavedMaps<C> {
    tiles: Vec<SavedTile<C>>,
    pages: Vec<SavedPage>,
    /// Each map's pages by their keys.
    maps: Vec<Vec<(TileKey, u32)>>,
}

/// The slots of a page that have a tile, and which.
type SavedPage = Vec<(u8, u32)>;

#[derive(Debug, Clone, PartialEq)]
struct SavedTile<C>(Arc<Tile<C>>);

impl<C: Copy + Default> SavedMaps<C> {
    /// The maps in their order.
    #[must_use]
    pub fn of<'a>(maps: impl IntoIterator<Item = &'a TileMap<C>>) -> Self
    where
        C: 'a,
    {
        let mut saved = Self { tiles: Vec::new(), pages: Vec::new(), maps: Vec::new() };
        let mut known_tiles = BTreeMap::new();
        let mut known_pages = BTreeMap::new();
        for map in maps {
            let pages = map.pages.iter().map(|(key, page)| {
                let index = *known_pages.entry(Arc::as_ptr(page)).or_insert_with(|| {
                    let page = saved_page(page, &mut known_tiles, &mut saved.tiles);
                    saved.pages.push(page);
                    (saved.pages.len() - 1) as u32
                });
                (*key, index)
            });
            saved.maps.push(pages.collect());
        }
        saved
    }

    /// The maps again, which share what they shared.
    ///
    /// # Errors
    /// When an index leads to nothing, or pages are not in their order.
    pub fn restore(&self) -> Result<Vec<TileMap<C>>, StateError> {
        let pages: Vec<Arc<Page<C>>> =
            self.pages.iter().map(|page| self.page(page)).collect::<Result<_, _>>()?;
        let map = |saved: &Vec<(TileKey, u32)>| {
            ensure(saved.is_sorted_by(|a, b| a.0 < b.0), PARTS)?;
            let page = |&(key, index): &(TileKey, u32)| {
                let range = -FURTHEST_PAGE..FURTHEST_PAGE;
                ensure(range.contains(&key.tx) && range.contains(&key.ty), PARTS)?;
                let page = pages.get(index as usize).ok_or(StateError::Unsound(PARTS))?;
                Ok((key, Arc::clone(page)))
            };
            let pages = saved.iter().map(page).collect::<Result<_, _>>()?;
            Ok(TileMap { pages, ..TileMap::new() })
        };
        self.maps.iter().map(map).collect()
    }

    /// The only map again.
    ///
    /// # Errors
    /// As [`Self::restore`], and when there is not one map.
    pub fn restore_one(&self) -> Result<TileMap<C>, StateError> {
        ensure(self.maps.len() == 1, PARTS)?;
        self.restore()?.pop().ok_or(StateError::Unsound(PARTS))
    }

    fn page(&self, saved: &SavedPage) -> Result<Arc<Page<C>>, StateError> {
        let mut tiles = [const { None }; PAGE_SIZE * PAGE_SIZE];
        for &(slot, index) in saved {
            let slot = tiles.get_mut(usize::from(slot)).ok_or(StateError::Unsound(PARTS))?;
            let tile = self.tiles.get(index as usize).ok_or(StateError::Unsound(PARTS))?;
            *slot = Some(Arc::clone(&tile.0));
        }
        Ok(Arc::new(Page { tiles }))
    }
}

fn saved_page<C>(
    page: &Page<C>,
    known: &mut BTreeMap<*const Tile<C>, u32>,
    tiles: &mut Vec<SavedTile<C>>,
) -> SavedPage {
    let slots = (0..).zip(&page.tiles).filter_map(|(slot, tile)| Some((slot, tile.as_ref()?)));
    let saved = slots.map(|(slot, tile)| {
        let index = *known.entry(Arc::as_ptr(tile)).or_insert_with(|| {
            tiles.push(SavedTile(Arc::clone(tile)));
            (tiles.len() - 1) as u32
        });
        (slot, index)
    });
    saved.collect()
}

impl<C: Serialize> Serialize for SavedTile<C> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut cells = serializer.serialize_tuple(TILE_CELLS)?;
        self.0.iter().try_for_each(|cell| cells.serialize_element(cell))?;
        cells.end()
    }
}

impl<'de, C: Deserialize<'de> + Copy + Default> Deserialize<'de> for SavedTile<C> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_tuple(TILE_CELLS, CellsVisitor(PhantomData))
    }
}

struct CellsVisitor<C>(PhantomData<C>);

impl<'de, C: Deserialize<'de> + Copy + Default> Visitor<'de> for CellsVisitor<C> {
    type Value = SavedTile<C>;

    fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "a tile of {TILE_CELLS} cells")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut cells: A) -> Result<Self::Value, A::Error> {
        let mut tile = [C::default(); TILE_CELLS];
        for (index, cell) in tile.iter_mut().enumerate() {
            let next = cells.next_element()?;
            *cell = next.ok_or_else(|| A::Error::invalid_length(index, &self))?;
        }
        Ok(SavedTile(Arc::new(tile)))
    }
}

#[cfg(test)]
mod tests {
    use proptest::collection::vec;
    use proptest::prelude::{prop_assert_eq, proptest};

    use super::super::{Cell, TileCounts};
    use super::*;

    const SPREAD: std::ops::Range<i32> = -600..600;

    proptest! {
        #[test]
        fn maps_come_back_and_share_what_they_shared(
            before in vec((SPREAD, SPREAD, 1_u8..), 0..40),
            after in vec((SPREAD, SPREAD, 1_u8.., 0..3_usize), 0..40),
        ) {
            let mut first = TileMap::new();
            for (ix, iy, value) in before {
                *first.get_mut(Cell::new(ix, iy)) = value;
            }
            let mut maps = [first.clone(), first.clone(), first];
            for (ix, iy, value, which) in after {
                *maps[which].get_mut(Cell::new(ix, iy)) = value;
            }
            let saved = SavedMaps::of(&maps);
            let bytes = postcard::to_stdvec(&saved).unwrap();
            let decoded: SavedMaps<u8> = postcard::from_bytes(&bytes).unwrap();
            prop_assert_eq!(&decoded, &saved);
            let restored = decoded.restore().unwrap();
            for (map, again) in maps.iter().zip(&restored) {
                prop_assert_eq!(map.tiles().collect::<Vec<_>>(), again.tiles().collect::<Vec<_>>());
            }
            prop_assert_eq!(TileCounts::of(maps.iter()), TileCounts::of(restored.iter()));
        }
    }

    #[test]
    fn indices_that_lead_to_nothing_and_pages_in_disorder_are_refused() {
        let mut map = TileMap::<u8>::new();
        *map.get_mut(Cell::new(0, 0)) = 1;
        *map.get_mut(Cell::new(900, 0)) = 1;
        let change = |change: fn(&mut SavedMaps<u8>)| {
            let mut saved = SavedMaps::of([&map]);
            change(&mut saved);
            saved.restore_one().map(|_| ())
        };
        assert_eq!(change(|_| ()), Ok(()));
        let unsound = Err(StateError::Unsound(PARTS));
        assert_eq!(change(|saved| saved.maps[0][1].1 = 2), unsound);
        assert_eq!(change(|saved| saved.maps[0].reverse()), unsound);
        assert_eq!(change(|saved| saved.maps[0][0].0.tx = i32::MIN), unsound);
        assert_eq!(change(|saved| saved.pages[0][0] = (64, 0)), unsound);
        assert_eq!(change(|saved| saved.pages[0][0] = (0, 2)), unsound);
        assert_eq!(change(|saved| saved.maps.clear()), unsound);
    }
}
