//! A uniform grid of bins that makes ray casting fast.

use super::shape::Segment;
use crate::slam::pose::Point2;

/// Side of a bin, m: a few obstacles each in an office, and few bins along a typical ray.
const BIN_M: f64 = 1.0;

/// Which obstacles touch which square of the plane.
///
/// Obstacles are numbers here; the owner knows their shapes.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Bins {
    min: Point2,
    columns: usize,
    rows: usize,
    /// Where the obstacles of each bin begin in `members`, row by row, with a final end mark.
    first: Vec<u32>,
    members: Vec<u32>,
}

/// An axis-aligned box: lower-left and upper-right corner.
pub(super) type Bounds = (Point2, Point2);

impl Bins {
    /// Bins for obstacles `0..bounds.len()`; `touches` says whether an obstacle meets a box.
    pub(super) fn new(bounds: &[Bounds], touches: impl Fn(usize, Bounds) -> bool) -> Self {
        let least = |pick: fn(&Bounds) -> f64| bounds.iter().map(pick).fold(f64::MAX, f64::min);
        let most = |pick: fn(&Bounds) -> f64| bounds.iter().map(pick).fold(f64::MIN, f64::max);
        if bounds.is_empty() {
            let (min, first) = (Point2::default(), vec![0, 0]);
            return Self { min, columns: 1, rows: 1, first, members: Vec::new() };
        }
        // The margin keeps obstacles on the border inside.
        let min = Point2::new(least(|b| b.0.x) - 0.01, least(|b| b.0.y) - 0.01);
        let count = |extent: f64| ((extent + 0.01) / BIN_M).floor() as usize + 1;
        let (columns, rows) = (count(most(|b| b.1.x) - min.x), count(most(|b| b.1.y) - min.y));
        let mut bins = vec![Vec::new(); columns * rows];
        for (obstacle, bounds) in bounds.iter().enumerate() {
            let index = |v: f64, origin: f64| ((v - origin).max(0.0) / BIN_M) as usize;
            let (x0, y0) = (index(bounds.0.x - 1e-6, min.x), index(bounds.0.y - 1e-6, min.y));
            let (x1, y1) = (index(bounds.1.x + 1e-6, min.x), index(bounds.1.y + 1e-6, min.y));
            for iy in y0..=y1.min(rows - 1) {
                for ix in x0..=x1.min(columns - 1) {
                    if touches(obstacle, bin_bounds(min, ix, iy)) {
                        bins[iy * columns + ix].push(obstacle as u32);
                    }
                }
            }
        }
        let ends = bins.iter().scan(0, |end, bin| {
            *end += bin.len() as u32;
            Some(*end)
        });
        let first = std::iter::once(0).chain(ends).collect();
        Self { min, columns, rows, first, members: bins.concat() }
    }

    /// The least `range_to(obstacle)` along a ray, m; infinite when it leaves the bins or passes
    /// `limit` without meeting anything.
    pub(super) fn nearest(
        &self,
        origin: Point2,
        direction: Point2,
        limit: f64,
        range_to: impl Fn(usize) -> f64,
    ) -> f64 {
        let Some(entry) = self.entry(origin, direction) else { return f64::INFINITY };
        let mut x = Walk::new(origin.x - self.min.x, direction.x, entry, self.columns);
        let mut y = Walk::new(origin.y - self.min.y, direction.y, entry, self.rows);
        let mut best = f64::INFINITY;
        loop {
            let bin = y.bin as usize * self.columns + x.bin as usize;
            for &obstacle in &self.members[self.first[bin] as usize..self.first[bin + 1] as usize] {
                best = best.min(range_to(obstacle as usize));
            }
            // An obstacle may be met only in a later bin, where another can be nearer.
            let exit = x.next.min(y.next);
            if best <= exit || exit > limit {
                return best;
            }
            let walk = if x.next < y.next { &mut x } else { &mut y };
            if !walk.advance() {
                return best;
            }
        }
    }

    /// Range at which a ray is first inside the bins; `None` when it never is.
    fn entry(&self, origin: Point2, direction: Point2) -> Option<f64> {
        let axes = [
            (origin.x - self.min.x, direction.x, self.columns),
            (origin.y - self.min.y, direction.y, self.rows),
        ];
        let (mut entry, mut exit) = (0.0_f64, f64::INFINITY);
        for (from, step, bins) in axes {
            let far = bins as f64 * BIN_M;
            if step == 0.0 {
                if !(0.0..=far).contains(&from) {
                    return None;
                }
                continue;
            }
            let (at_low, at_high) = (-from / step, (far - from) / step);
            entry = entry.max(at_low.min(at_high));
            exit = exit.min(at_low.max(at_high));
        }
        (entry <= exit).then_some(entry)
    }
}

/// Whether a segment may meet a box: exact but for a margin of 1 micrometre.
pub(super) fn segment_touches(segment: Segment, (min, max): Bounds) -> bool {
    let side = |x: f64, y: f64| {
        (segment.b.x - segment.a.x) * (y - segment.a.y)
            - (segment.b.y - segment.a.y) * (x - segment.a.x)
    };
    let margin = 1e-6 * segment.length();
    let sides = [side(min.x, min.y), side(max.x, min.y), side(max.x, max.y), side(min.x, max.y)];
    sides.iter().any(|s| *s >= -margin) && sides.iter().any(|s| *s <= margin)
}

fn bin_bounds(min: Point2, ix: usize, iy: usize) -> Bounds {
    let low = Point2::new(min.x + ix as f64 * BIN_M, min.y + iy as f64 * BIN_M);
    (low, Point2::new(low.x + BIN_M, low.y + BIN_M))
}

/// The walk of a ray through the bins of one axis (Amanatides and Woo).
struct Walk {
    bin: isize,
    bins: isize,
    step: isize,
    /// Range at which the ray leaves the bin.
    next: f64,
    /// Range it takes to cross one.
    width: f64,
}

impl Walk {
    fn new(from: f64, direction: f64, entry: f64, bins: usize) -> Self {
        let bins = bins as isize;
        let bin = (((from + entry * direction) / BIN_M).floor() as isize).clamp(0, bins - 1);
        let step = if direction > 0.0 { 1 } else { -1 };
        let edge = (bin + isize::from(direction > 0.0)) as f64 * BIN_M;
        let next = if direction == 0.0 { f64::INFINITY } else { (edge - from) / direction };
        Self { bin, bins, step, next, width: BIN_M / direction.abs() }
    }

    /// Steps into the next bin; false when there is none.
    fn advance(&mut self) -> bool {
        self.bin += self.step;
        self.next += self.width;
        (0..self.bins).contains(&self.bin)
    }
}
