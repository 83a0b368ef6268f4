//! A part of the map, or the whole, in coarser cells.

use std::io;

use serde::{Serialize, Serializer};
use thiserror::Error;

use super::tiles::Extent;
use crate::slam::grid::Cell;
use crate::slam::grid::occupancy::{Count, OccupancyGrid, OccupancyMap, OccupiedThreshold};
use crate::slam::grid::tile_map::{TILE_SIZE, TileKey, TileMap};
use crate::slam::pose::Point2;

/// Cells that a region may have; a layer has four bytes for each while it is made.
pub const MOST_CELLS: u64 = 1 << 24;

/// How far, in cells, a corner may be beside the edge between two cells and still be on it.
const ON_EDGE: f64 = 1e-6;

/// A rectangle in `map`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Window {
    /// Its lower-left corner, m.
    pub low: Point2,
    /// Its upper-right corner, m.
    pub high: Point2,
}

/// The cells that a window is answered with.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Region {
    /// In cells of the region, whose cell (0, 0) begins at the origin of `map`.
    extent: Extent,
    /// Cells of the map along the side of one of the region.
    factor: i32,
    /// Metres a cell of the region.
    resolution: f64,
}

/// Why a region cannot be had.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum RegionError {
    /// Finer than the map.
    #[error("res={asked} is finer than the map, which has {map} m a cell")]
    Finer {
        /// Metres a cell.
        asked: f64,
        /// Metres a cell of the map.
        map: f64,
    },
    /// It would not fit a message.
    #[error(
        "the region has {width:.0} by {height:.0} cells of {resolution} m, and {MOST_CELLS} are \
         the most; ask for a smaller one, or for a larger res"
    )]
    TooLarge {
        /// Columns.
        width: f64,
        /// Rows.
        height: f64,
        /// Metres a cell.
        resolution: f64,
    },
    /// An answer with a byte a cell would be too large.
    #[error(
        "the region has {cells} cells in {layers} layers, and max_reply_bytes allows {most} in \
         all; ask for a smaller one, or for a larger res"
    )]
    TooMuch {
        /// Its cells.
        cells: usize,
        /// Layers that are asked for.
        layers: usize,
        /// Bytes of an answer.
        most: usize,
    },
    /// Written down, it is too long.
    #[error(
        "the region takes more than {0} bytes, which max_reply_bytes allows; ask for a smaller \
         one, or for a larger res"
    )]
    TooLong(usize),
}

/// When cells were seen last: whole seconds of stamps, and one more; 0 is never.
pub type LastSeen = TileMap<u32>;

/// What layers are drawn from.
#[derive(Debug, Clone, Copy)]
pub struct Known<'a> {
    /// Hits and visits.
    pub map: &'a OccupancyMap,
    /// When a cell is occupied.
    pub threshold: OccupiedThreshold,
    /// When cells were seen.
    pub last_seen: &'a LastSeen,
}

/// What is known of each cell.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Layer {
    /// -1 unknown, 0 free, 100 occupied.
    Occupancy,
    /// Scans in which a beam ended in the cell.
    Hits,
    /// Scans that saw the cell.
    Visits,
    /// The stamp of the last one, s; -1 where there was none.
    LastSeen,
}

impl Layer {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Occupancy, Self::Hits, Self::Visits, Self::LastSeen];

    /// As queries and answers call it.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Occupancy => "occupancy",
            Self::Hits => "hits",
            Self::Visits => "visits",
            Self::LastSeen => "last_seen",
        }
    }
}

impl Region {
    /// The window's cells, of at least `resolution` metres: it is widened to whole ones.
    ///
    /// They are as many whole cells of the map wide as it takes, and lie so that neighbouring
    /// windows fit together.
    ///
    /// # Errors
    /// When `resolution` is finer than the map's, or the cells are too many.
    pub fn new(window: Window, resolution: f64, map_resolution: f64) -> Result<Self, RegionError> {
        let ratio = resolution / map_resolution;
        if ratio < 1.0 - ON_EDGE {
            return Err(RegionError::Finer { asked: resolution, map: map_resolution });
        }
        let factor = libm::ceil(ratio - ON_EDGE);
        let resolution = factor * map_resolution;
        let first = |low: f64| libm::floor(low / resolution + ON_EDGE);
        let end = |high: f64| libm::ceil(high / resolution - ON_EDGE);
        let (x, y) = (first(window.low.x), first(window.low.y));
        // What is thinner than the leeway at edges lies in a cell as well.
        let least = |low: f64, high: f64| if low < high { 1.0 } else { 0.0 };
        let width = (end(window.high.x) - x).max(least(window.low.x, window.high.x));
        let height = (end(window.high.y) - y).max(least(window.low.y, window.high.y));
        if width * height > MOST_CELLS as f64 {
            return Err(RegionError::TooLarge { width, height, resolution });
        }
        let extent =
            Extent { ix: x as i32, iy: y as i32, width: width as u32, height: height as u32 };
        Ok(Self { extent, factor: factor as i32, resolution })
    }

    /// Occupied where a cell of the map is, free where one is and none is occupied, unknown where
    /// nothing is known.
    #[must_use]
    pub fn occupancy(
        &self,
        map: Option<&OccupancyMap>,
        threshold: OccupiedThreshold,
    ) -> OccupancyGrid {
        let seen = |count: Count| (count.visits > 0).then(|| count.occupancy(threshold));
        let cells = self.maxima(map.map(OccupancyMap::counts), -1, seen);
        let corner = |i: i32| f64::from(i) * self.resolution;
        OccupancyGrid {
            resolution: self.resolution,
            width: self.extent.width as usize,
            height: self.extent.height as usize,
            origin: Point2::new(corner(self.extent.ix), corner(self.extent.iy)),
            cells,
        }
    }

    /// Looks whether an answer of so many bytes has one for each cell of each layer.
    ///
    /// # Errors
    /// When it has not.
    pub fn check_size(&self, layers: usize, most: usize) -> Result<(), RegionError> {
        let cells = self.extent.width as usize * self.extent.height as usize;
        let fits = cells.saturating_mul(layers) <= most;
        if fits { Ok(()) } else { Err(RegionError::TooMuch { cells, layers, most }) }
    }

    /// Layers as JSON of at most so many bytes: size and place as in the JSON of a map, and in
    /// `layers` the runs of each, the largest value of the merged cells in each.
    ///
    /// # Errors
    /// When that has more bytes.
    pub fn json(
        &self,
        layers: &[Layer],
        known: Option<Known<'_>>,
        most: usize,
    ) -> Result<Vec<u8>, RegionError> {
        let corner = |i: i32| f64::from(i) * self.resolution;
        let layers = Layers {
            resolution: self.resolution,
            width: self.extent.width,
            height: self.extent.height,
            origin: [corner(self.extent.ix), corner(self.extent.iy)],
            layers: Runs { region: self, layers, known },
        };
        let mut text = Bounded { bytes: Vec::new(), most };
        // Memory takes every write, and every key is a string.
        match serde_json::to_writer(&mut text, &layers) {
            Ok(()) => Ok(text.bytes),
            Err(_) => Err(RegionError::TooLong(most)),
        }
    }

    /// The largest value of the known cells that each cell of the region covers.
    fn maxima<C: Copy + Default, T: Copy + Ord>(
        &self,
        map: Option<&TileMap<C>>,
        unknown: T,
        value: impl Fn(C) -> Option<T>,
    ) -> Vec<T> {
        let (width, height) = (self.extent.width as usize, self.extent.height as usize);
        let mut cells = vec![unknown; width * height];
        let Some(map) = map else { return cells };
        let fine = |i: i32, count: u32| {
            let first = i64::from(i) * i64::from(self.factor);
            let last = first + i64::from(count) * i64::from(self.factor) - 1;
            [first, last].map(|i| i.clamp(i32::MIN.into(), i32::MAX.into()) as i32)
        };
        let ([left, right], [bottom, top]) =
            (fine(self.extent.ix, self.extent.width), fine(self.extent.iy, self.extent.height));
        let first = TileKey::containing(Cell::new(left, bottom));
        let last = TileKey::containing(Cell::new(right, top));
        for (key, tile) in map.tiles_between(first, last) {
            let corner = key.first_cell();
            for (i, value) in tile.iter().enumerate().filter_map(|(i, &c)| Some((i, value(c)?))) {
                let ix = corner.ix + (i % TILE_SIZE) as i32;
                let iy = corner.iy + (i / TILE_SIZE) as i32;
                let column = i64::from(ix.div_euclid(self.factor)) - i64::from(self.extent.ix);
                let row = i64::from(iy.div_euclid(self.factor)) - i64::from(self.extent.iy);
                let (Ok(column), Ok(row)) = (usize::try_from(column), usize::try_from(row)) else {
                    continue;
                };
                if column < width && row < height {
                    let cell = &mut cells[row * width + column];
                    *cell = (*cell).max(value);
                }
            }
        }
        cells
    }
}

#[derive(Serialize)]
struct Layers<'a> {
    resolution: f64,
    width: u32,
    height: u32,
    origin: [f64; 2],
    layers: Runs<'a>,
}

/// Layers by their names, each made as it is written: there is one in memory at a time.
struct Runs<'a> {
    region: &'a Region,
    layers: &'a [Layer],
    known: Option<Known<'a>>,
}

impl Serialize for Runs<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut layers = self.layers.to_vec();
        layers.sort_unstable_by_key(|layer| layer.name());
        serializer.collect_map(layers.into_iter().map(|layer| (layer.name(), self.cells(layer))))
    }
}

impl Runs<'_> {
    fn cells(&self, layer: Layer) -> Cells {
        let Self { region, known, .. } = *self;
        let map = known.map(|known| known.map);
        let counted = |value: fn(Count) -> u32| {
            let value = |count: Count| (count.visits > 0).then(|| value(count));
            Cells::Counts(region.maxima(map.map(OccupancyMap::counts), 0, value))
        };
        match layer {
            Layer::Occupancy => {
                let threshold = known.map_or(OccupiedThreshold::of_share(0.0), |of| of.threshold);
                Cells::Occupancy(region.occupancy(map, threshold).cells)
            }
            Layer::Hits => counted(|count| count.hits),
            Layer::Visits => counted(|count| count.visits),
            Layer::LastSeen => {
                Cells::Seconds(region.maxima(known.map(|known| known.last_seen), 0, Some))
            }
        }
    }
}

/// The cells of a layer, written as runs of a value and a count.
enum Cells {
    Occupancy(Vec<i8>),
    Counts(Vec<u32>),
    /// As in [`LastSeen`].
    Seconds(Vec<u32>),
}

impl Serialize for Cells {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Occupancy(cells) => serializer.collect_seq(runs(cells, i64::from)),
            Self::Counts(cells) => serializer.collect_seq(runs(cells, i64::from)),
            Self::Seconds(cells) => serializer.collect_seq(runs(cells, |seen| i64::from(seen) - 1)),
        }
    }
}

fn runs<T: Copy + PartialEq>(
    cells: &[T],
    value: impl Fn(T) -> i64,
) -> impl Iterator<Item = (i64, usize)> {
    cells.chunk_by(|a, b| a == b).map(move |run| (value(run[0]), run.len()))
}

/// Text that does not grow beyond a number of bytes.
struct Bounded {
    bytes: Vec<u8>,
    most: usize,
}

impl io::Write for Bounded {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.bytes.len() + bytes.len() > self.most {
            return Err(io::ErrorKind::FileTooLarge.into());
        }
        self.bytes.extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::{prop_assert_eq, proptest};

    use super::*;

    const THRESHOLD: OccupiedThreshold = OccupiedThreshold::of_share(0.25);
    use crate::slam::grid::occupancy::{BeamEnd, BeamEndKind, ScanOutline};
    use crate::slam::pose::Pose2;

    const FINE: f64 = 0.1;

    /// A robot at the origin that sees a wall.
    fn map() -> OccupancyMap {
        let mut map = OccupancyMap::new(FINE);
        let end = |y| BeamEnd { point: [2.05, y], kind: BeamEndKind::Hit };
        let ends = (-8..=8).map(|step| end(step as f32 * 0.1)).collect();
        let outline = ScanOutline { sensor: Point2::new(0.0, 0.0), ends, angle_increment: 0.05 };
        map.add(&outline, Pose2::IDENTITY);
        map
    }

    fn window(low: [f64; 2], high: [f64; 2]) -> Window {
        Window { low: Point2::new(low[0], low[1]), high: Point2::new(high[0], high[1]) }
    }

    proptest! {
        /// Cell by cell, from the map as it is handed out.
        #[test]
        fn a_cell_has_the_largest_value_of_those_it_covers(
            x in -3.0..3.0_f64, y in -3.0..3.0_f64, size in 0.05..3.0_f64, res in 0.1..1.0_f64,
        ) {
            let (map, window) = (map(), window([x, y], [x + size, y + size]));
            let region = Region::new(window, res, FINE).unwrap();
            let coarse = region.occupancy(Some(&map), THRESHOLD);
            let factor = (coarse.resolution / FINE).round() as i32;
            assert!(coarse.resolution >= res - 1e-6 && coarse.resolution < res + FINE + 1e-6);
            assert!(coarse.origin.x <= x + 1e-6 && coarse.origin.y <= y + 1e-6);
            let right = coarse.origin.x + coarse.width as f64 * coarse.resolution;
            assert!(right >= x + size - 1e-6 && right < x + size + coarse.resolution);
            for (i, &cell) in coarse.cells.iter().enumerate() {
                let ix = region.extent.ix + (i % coarse.width) as i32;
                let iy = region.extent.iy + (i / coarse.width) as i32;
                let covered = (0..factor * factor).map(|k| {
                    let cell = Cell::new(ix * factor + k % factor, iy * factor + k / factor);
                    map.counts().get(cell).occupancy(THRESHOLD)
                });
                prop_assert_eq!(cell, covered.max().unwrap());
            }
        }
    }

    #[test]
    fn walls_stay_and_the_unknown_stays_unknown() {
        let region = Region::new(window([-4.0, -2.0], [4.0, 2.0]), 0.8, FINE).unwrap();
        let grid = region.occupancy(Some(&map()), THRESHOLD);
        assert_eq!((grid.width, grid.height), (10, 6));
        let row = &grid.cells[30..40];
        assert_eq!(row, [-1, -1, -1, -1, -1, 0, 0, 100, -1, -1]);
    }

    #[test]
    fn the_thinnest_window_has_a_cell_and_that_of_no_map_has_none() {
        for (low, high) in [([0.0, 0.0], [1e-8, 0.1]), ([0.1 - 1e-9, 0.0], [0.1 + 1e-9, 0.1])] {
            let region = Region::new(window(low, high), FINE, FINE).unwrap();
            assert_eq!((region.extent.width, region.extent.height), (1, 1));
        }
        let region = Region::new(window([0.0, 0.0], [0.0, 0.0]), FINE, FINE).unwrap();
        assert_eq!((region.extent.width, region.extent.height), (0, 0));
    }

    #[test]
    fn layers_have_the_largest_count() {
        let mut map = map();
        let clone = map.clone();
        for _ in 0..2 {
            let end = BeamEnd { point: [2.05, 0.05], kind: BeamEndKind::Hit };
            let sensor = Point2::new(0.0, 0.0);
            let outline = ScanOutline { sensor, ends: vec![end], angle_increment: 0.05 };
            map.add(&outline, Pose2::IDENTITY);
        }
        let region = Region::new(window([2.0, 0.0], [2.2, 0.2]), 0.2, FINE).unwrap();
        let mut last_seen = LastSeen::new();
        *last_seen.get_mut(Cell::new(20, 0)) = 8;
        *last_seen.get_mut(Cell::new(21, 1)) = 5;
        let known = |map| Some(Known { map, threshold: THRESHOLD, last_seen: &last_seen });
        let json = |layers: &[Layer], known| {
            String::from_utf8(region.json(layers, known, 1000).unwrap()).unwrap()
        };
        let text = json(&[Layer::Hits, Layer::Visits, Layer::LastSeen], known(&map));
        assert_eq!(
            text,
            r#"{"resolution":0.2,"width":1,"height":1,"origin":[2.0,0.0],"layers":{"hits":[[3,1]],"last_seen":[[7,1]],"visits":[[3,1]]}}"#
        );
        let text = json(&[Layer::Hits], known(&clone));
        assert!(text.ends_with(r#""layers":{"hits":[[1,1]]}}"#), "{text}");
        let text = json(&[Layer::Occupancy, Layer::LastSeen], None);
        assert!(
            text.ends_with(r#""layers":{"last_seen":[[-1,1]],"occupancy":[[-1,1]]}}"#),
            "{text}"
        );
    }

    #[test]
    fn what_cannot_be_had_is_told() {
        let small = window([0.0, 0.0], [1.0, 1.0]);
        let error = Region::new(small, 0.05, FINE).unwrap_err().to_string();
        assert_eq!(error, "res=0.05 is finer than the map, which has 0.1 m a cell");
        let large = window([-1e6, -1e6], [1e6, 1e6]);
        let error = Region::new(large, 0.1, FINE).unwrap_err().to_string();
        assert!(error.starts_with("the region has 20000000 by 20000000 cells of 0.1 m"), "{error}");
        let region = Region::new(small, 0.1, FINE).unwrap();
        assert_eq!(region.check_size(2, 200), Ok(()));
        let error = region.check_size(2, 199).unwrap_err().to_string();
        let told = "the region has 100 cells in 2 layers, and max_reply_bytes allows 199 in all";
        assert!(error.starts_with(told), "{error}");
        let whole = region.json(&[Layer::Hits], None, 1000).unwrap();
        assert_eq!(region.json(&[Layer::Hits], None, whole.len()), Ok(whole.clone()));
        let error = region.json(&[Layer::Hits], None, whole.len() - 1).unwrap_err();
        assert_eq!(error, RegionError::TooLong(whole.len() - 1));
        let coarse = Region::new(large, 1e4, FINE).unwrap();
        assert_eq!(coarse.occupancy(Some(&map()), THRESHOLD).cells.iter().max(), Some(&100));
    }
}
