//! The original's particle map: for each cell, how many beams ended in it and where on average.

use serde::{Deserialize, Serialize};

use super::tile_map::TileMap;
use super::{Cell, floor};

/// The hits of one cell. The mean is kept relative to the cell, so it is as exact far from the
/// frame's origin as near it (the original sums world coordinates in single precision).
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Hits {
    /// Beams that ended in the cell.
    pub count: u32,
    /// Sum of their ends, in cells from the cell's lower-left corner.
    pub sum: [f32; 2],
}

/// Hits over the plane.
pub type HitMap = TileMap<Hits>;

/// Enters a hit at (x, y), in cells from the lower-left corner of `origin`.
pub fn add_hit(map: &mut HitMap, origin: Cell, [x, y]: [f64; 2]) {
    let (column, row) = (floor(x), floor(y));
    let hits = map.get_mut(Cell::new(origin.ix + column, origin.iy + row));
    hits.count += 1;
    hits.sum[0] += (x - f64::from(column)) as f32;
    hits.sum[1] += (y - f64::from(row)) as f32;
}

/// Squared distance, in cells, from (x, y) to the nearest mean hit among the cells up to `reach`
/// around its own; `None` if they hold no hit.
///
/// This is the original's search without its test of the cell before the hit, which never had an
/// effect: it looked half a map away.
#[must_use]
pub fn nearest_hit(map: &HitMap, origin: Cell, [x, y]: [f64; 2], reach: i32) -> Option<f64> {
    let (column, row) = (floor(x), floor(y));
    let around = (-reach..=reach).flat_map(|dy| (-reach..=reach).map(move |dx| (dx, dy)));
    around
        .filter_map(|(dx, dy)| {
            let hits = map.get(Cell::new(origin.ix + column + dx, origin.iy + row + dy));
            let mean = |axis: usize| f64::from(hits.sum[axis]) / f64::from(hits.count);
            let ex = f64::from(column + dx) + mean(0) - x;
            let ey = f64::from(row + dy) + mean(1) - y;
            (hits.count > 0).then_some(ex * ex + ey * ey)
        })
        .reduce(f64::min)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_mean_counts_and_distant_hits_do_not() {
        let origin = Cell::new(-5, 7);
        let mut map = HitMap::new();
        add_hit(&mut map, origin, [0.2, 0.5]);
        add_hit(&mut map, origin, [0.4, 0.5]);
        add_hit(&mut map, origin, [1.9, 0.5]);
        let nearest = |x| nearest_hit(&map, origin, [x, 0.5], 1);
        assert!((nearest(0.0).unwrap() - 0.09).abs() < 1e-6, "the mean of two hits at 0.3");
        assert!((nearest(1.5).unwrap() - 0.16).abs() < 1e-6);
        assert_eq!(nearest(3.5), None);
        assert_eq!(nearest_hit(&map, origin, [-1.5, 0.5], 1), None);
    }
}
