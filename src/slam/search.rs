//! Where in a known map a scan was taken, if nothing is known of the pose: correlative matching
//! over all free cells and headings, by branch and bound over maxima of the likelihood
//! (Olson, ICRA 2009; Hess, Kohler, Rapp, Andor, ICRA 2016).
//!
//! It answers with a pose only if the scan fits there, and clearly better than anywhere else.

use std::cmp::Reverse;
use std::f64::consts::TAU;

use rayon::iter::{IntoParallelIterator as _, ParallelIterator as _};
use thiserror::Error;

use super::grid::occupancy::OccupancyGrid;
use super::pose::{Point2, Pose2, wrap_angle};

/// Cells of the search are at least this long, m: finer ones cost time and tell no more.
const FINEST: f64 = 0.05;
/// ... and so long that there are no more than these.
const MOST_CELLS: usize = 4_000_000;
/// Standard deviation of the likelihood around an obstacle, cells of the search.
const SIGMA: f64 = 2.0;
/// How often cells are merged two by two: the coarsest blocks have 64 by 64 cells.
const LEVELS: u32 = 6;
const BLOCK: i32 = 1 << LEVELS;
/// Points of a scan that are looked at.
const MOST_POINTS: usize = 180;
/// Fewer points tell nothing.
const LEAST_POINTS: usize = 20;
/// Headings tried, at least and at most; between, neighbours move the furthest point by a cell.
const HEADINGS: [f64; 2] = [180.0, 1800.0];
/// The likelihood of a cell with an obstacle.
const FULL: f64 = 255.0;
/// Places where less of the scan fits are not looked at.
const FLOOR: f64 = 0.45;
/// The scan has to fit as well as this, of 1.
pub const LEAST_SCORE: f64 = 0.6;
/// Another place where it fits with this share of the best score makes the answer ambiguous.
pub const AS_GOOD: f64 = 0.9;
/// Poses within this distance, m, and angle, rad, are one place.
const ONE_PLACE: (f64, f64) = (0.5, 0.35);

/// Where a scan fits.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Place {
    /// The base in `map`, to half a cell and half a step of the heading.
    pub pose_in_map: Pose2,
    /// Mean likelihood of the points, up to 1.
    pub score: f64,
}

/// Why no pose is answered.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum NotLocalized {
    /// The scan is too small.
    #[error("the scan has {points} points that tell apart places, and {LEAST_POINTS} are needed")]
    FewPoints {
        /// How many it has.
        points: usize,
    },
    /// The scan fits nowhere.
    #[error("the scan fits nowhere in the map: {}, and {LEAST_SCORE} is needed", score_in_words(*best))]
    FitsNowhere {
        /// The best place, if one is above the floor of the search.
        best: Option<Place>,
    },
    /// Two places look alike.
    #[error(
        "two places look alike: the scan scores {:.2} at {} and {:.2} at {}",
        best.score, pose_in_words(best.pose_in_map), other.score, pose_in_words(other.pose_in_map)
    )]
    Ambiguous {
        /// The best place.
        best: Place,
        /// Another one that is nearly as good.
        other: Place,
    },
}

fn score_in_words(best: Option<Place>) -> String {
    match best {
        Some(best) => {
            format!("it scores {:.2} at {}", best.score, pose_in_words(best.pose_in_map))
        }
        None => format!("it scores less than {FLOOR} everywhere"),
    }
}

fn pose_in_words(pose: Pose2) -> String {
    format!("({:.2} m, {:.2} m, {:.2} rad)", pose.x, pose.y, pose.theta)
}

/// A map made ready to be searched.
#[derive(Debug, Clone)]
pub struct SearchMap {
    /// Metres a cell.
    resolution: f64,
    /// The lower-left corner of the first cell that can hold the base.
    origin: Point2,
    width: i32,
    height: i32,
    /// The likelihood, and its maximum over blocks of 2, 4, ... cells that begin at each cell.
    likelihood: Vec<Layer>,
    /// The same of whether a cell is free.
    free: Vec<Layer>,
}

/// Values for cells, with a margin that blocks may begin in; zero outside.
#[derive(Debug, Clone)]
struct Layer {
    width: i32,
    height: i32,
    values: Vec<u8>,
}

impl Layer {
    fn new(width: i32, height: i32) -> Self {
        let (width, height) = (width + BLOCK, height + BLOCK);
        Self { width, height, values: vec![0; width as usize * height as usize] }
    }

    #[inline]
    fn get(&self, x: i32, y: i32) -> u8 {
        self.index(x, y).map_or(0, |index| self.values[index])
    }

    #[inline]
    const fn index(&self, x: i32, y: i32) -> Option<usize> {
        let (x, y) = (x + BLOCK, y + BLOCK);
        if x >= 0 && y >= 0 && x < self.width && y < self.height {
            Some(y as usize * self.width as usize + x as usize)
        } else {
            None
        }
    }

    fn raise(&mut self, x: i32, y: i32, value: u8) {
        if let Some(index) = self.index(x, y) {
            self.values[index] = self.values[index].max(value);
        }
    }

    /// Each cell's maximum with those `step` further right, above, and both.
    fn merged(&self, step: i32) -> Self {
        let mut merged = self.clone();
        for y in -BLOCK..self.height - BLOCK {
            for x in -BLOCK..self.width - BLOCK {
                let others = [(x + step, y), (x, y + step), (x + step, y + step)];
                others.into_iter().for_each(|(i, j)| merged.raise(x, y, self.get(i, j)));
            }
        }
        merged
    }

    fn pyramid(self) -> Vec<Self> {
        let mut layers = vec![self];
        for level in 0..LEVELS {
            layers.push(layers[level as usize].merged(1 << level));
        }
        layers
    }
}

/// A block of candidates with one heading.
#[derive(Debug, Clone, Copy)]
struct Node {
    /// No candidate in it scores more.
    bound: u32,
    heading: usize,
    x: i32,
    y: i32,
}

/// The cells of a scan's points, for each heading, from the base's cell.
struct Turned {
    headings: Vec<Vec<(i32, i32)>>,
    points: usize,
}

impl Turned {
    fn heading(&self, index: usize) -> f64 {
        wrap_angle(index as f64 * TAU / self.headings.len() as f64)
    }

    /// A share of the score that all points together may have.
    fn score(&self, share: f64) -> u32 {
        (share * FULL * self.points as f64) as u32
    }

    fn share(&self, score: u32) -> f64 {
        f64::from(score) / (FULL * self.points as f64)
    }
}

impl SearchMap {
    /// Makes a map ready. Cells above `occupied`, of 100, are obstacles.
    #[must_use]
    pub fn new(map: &OccupancyGrid, occupied: f64) -> Self {
        let cells = |factor: usize| map.width.div_ceil(factor) * map.height.div_ceil(factor);
        let fine = |factor: &usize| {
            map.resolution * *factor as f64 > FINEST * 0.999 && cells(*factor) <= MOST_CELLS
        };
        let factor = (1..).find(fine).unwrap_or(1);
        let (width, height) = (map.width.div_ceil(factor), map.height.div_ceil(factor));
        let (width, height) = (width as i32, height as i32);
        let (mut likelihood, mut free) = (Layer::new(width, height), Layer::new(width, height));
        let kernel = kernel();
        for (row, cells) in map.cells.chunks_exact(map.width.max(1)).enumerate() {
            for (column, cell) in cells.iter().enumerate() {
                let (x, y) = ((column / factor) as i32, (row / factor) as i32);
                if f64::from(*cell) > occupied {
                    kernel.iter().for_each(|(dx, dy, level)| {
                        likelihood.raise(x + dx, y + dy, *level);
                    });
                } else if *cell >= 0 {
                    free.raise(x, y, 1);
                }
            }
        }
        Self {
            resolution: map.resolution * factor as f64,
            origin: map.origin,
            width,
            height,
            likelihood: likelihood.pyramid(),
            free: free.pyramid(),
        }
    }

    /// Where a scan with these hits in the frame of the base, m, was taken.
    ///
    /// The answer is the same with and without threads.
    ///
    /// # Errors
    /// When it fits nowhere, or at two places.
    pub fn find(
        &self,
        hits: &[[f32; 2]],
        pool: Option<&rayon::ThreadPool>,
    ) -> Result<Place, NotLocalized> {
        let turned = self.turned(hits);
        if turned.points < LEAST_POINTS {
            return Err(NotLocalized::FewPoints { points: turned.points });
        }
        let blocks = self.blocks(&turned, pool);
        let best = self.best(&turned, &blocks, turned.score(FLOOR));
        let Some(found) = best.filter(|best| turned.share(best.bound) >= LEAST_SCORE) else {
            let best = best.map(|best| self.place(&turned, best));
            return Err(NotLocalized::FitsNowhere { best });
        };
        let best = self.place(&turned, found);
        let least = (AS_GOOD * f64::from(found.bound)) as u32;
        match self.elsewhere(&turned, &blocks, best, least) {
            Some(other) => Err(NotLocalized::Ambiguous { best, other }),
            None => Ok(best),
        }
    }

    fn turned(&self, hits: &[[f32; 2]]) -> Turned {
        let in_cells = |metres: f32| f64::from(metres) / self.resolution;
        let mut points: Vec<[f64; 2]> = Vec::with_capacity(hits.len());
        for [x, y] in hits.iter().map(|hit| hit.map(in_cells)) {
            let near = |[px, py]: &[f64; 2]| (x - px) * (x - px) + (y - py) * (y - py) < 1.0;
            if !points.last().is_some_and(near) {
                points.push([x, y]);
            }
        }
        let every = points.len().div_ceil(MOST_POINTS).max(1);
        let points: Vec<[f64; 2]> = points.into_iter().step_by(every).collect();
        let squared = points.iter().map(|[x, y]| x * x + y * y).fold(1.0, f64::max);
        let count = libm::ceil(TAU * squared.sqrt()).clamp(HEADINGS[0], HEADINGS[1]) as usize;
        let turn = |index: usize| {
            let (sin, cos) = libm::sincos(index as f64 * TAU / count as f64);
            let cell = |[x, y]: &[f64; 2]| {
                let cell = |at: f64| libm::floor(at + 0.5) as i32;
                (cell(cos * x - sin * y), cell(sin * x + cos * y))
            };
            points.iter().map(cell).collect()
        };
        Turned { headings: (0..count).map(turn).collect(), points: points.len() }
    }

    /// The coarsest blocks with free space, those that may be best first.
    fn blocks(&self, turned: &Turned, pool: Option<&rayon::ThreadPool>) -> Vec<Node> {
        let least = turned.score(FLOOR);
        let steps = |length: i32| (0..length).step_by(BLOCK as usize);
        let corners = steps(self.height).flat_map(|y| steps(self.width).map(move |x| (x, y)));
        let corners: Vec<(i32, i32)> =
            corners.filter(|&(x, y)| self.free[LEVELS as usize].get(x, y) > 0).collect();
        let of_heading = |heading: usize| -> Vec<Node> {
            let node = |&(x, y): &(i32, i32)| self.node(turned, LEVELS, (heading, x, y));
            corners.iter().map(node).filter(|node| node.bound > least).collect()
        };
        let headings = 0..turned.headings.len();
        let mut nodes: Vec<Node> = match pool {
            Some(pool) => {
                pool.install(|| headings.into_par_iter().flat_map_iter(of_heading).collect())
            }
            None => headings.flat_map(of_heading).collect(),
        };
        nodes.sort_by_key(|node| Reverse(node.bound));
        nodes
    }

    fn node(&self, turned: &Turned, level: u32, (heading, x, y): (usize, i32, i32)) -> Node {
        let layer = &self.likelihood[level as usize];
        let points = turned.headings[heading].iter();
        let bound = points.map(|(dx, dy)| u32::from(layer.get(x + dx, y + dy))).sum();
        Node { bound, heading, x, y }
    }

    /// The four quarters of a block that have free space, best first.
    fn quarters(&self, turned: &Turned, node: Node, level: u32) -> Vec<Node> {
        let half = 1 << (level - 1);
        let free = &self.free[level as usize - 1];
        let corners = [(0, 0), (half, 0), (0, half), (half, half)];
        let corners = corners.into_iter().map(|(dx, dy)| (node.x + dx, node.y + dy));
        let mut quarters: Vec<Node> = corners
            .filter(|&(x, y)| free.get(x, y) > 0)
            .map(|(x, y)| self.node(turned, level - 1, (node.heading, x, y)))
            .collect();
        quarters.sort_by_key(|node| Reverse(node.bound));
        quarters
    }

    /// The candidate with the best score above `least`; the first of equals.
    fn best(&self, turned: &Turned, blocks: &[Node], mut least: u32) -> Option<Node> {
        let mut best = None;
        self.visit(turned, blocks, &mut |level, node| {
            if node.bound <= least {
                return Visit::PassOver;
            }
            if level == 0 {
                least = node.bound;
                best = Some(node);
            }
            Visit::GoOn
        });
        best
    }

    /// A place other than `best` that scores at least `least`.
    fn elsewhere(
        &self,
        turned: &Turned,
        blocks: &[Node],
        best: Place,
        least: u32,
    ) -> Option<Place> {
        let mut found = None;
        self.visit(turned, blocks, &mut |level, node| {
            if node.bound < least || self.is_near(turned, (node, level), best.pose_in_map) {
                return Visit::PassOver;
            }
            if level == 0 {
                found = Some(self.place(turned, node));
                return Visit::End;
            }
            Visit::GoOn
        });
        found
    }

    /// Whether all candidates of a block are one place with `pose`.
    fn is_near(&self, turned: &Turned, (node, level): (Node, u32), pose: Pose2) -> bool {
        let turn = wrap_angle(turned.heading(node.heading) - pose.theta).abs();
        let last = (1 << level) - 1;
        let far = |at: i32, origin: f64, to: f64| {
            let distance =
                |cell: i32| (origin + (f64::from(cell) + 0.5) * self.resolution - to).abs();
            distance(at).max(distance(at + last))
        };
        let (dx, dy) = (far(node.x, self.origin.x, pose.x), far(node.y, self.origin.y, pose.y));
        turn <= ONE_PLACE.1 && dx * dx + dy * dy <= ONE_PLACE.0 * ONE_PLACE.0
    }

    /// Looks at blocks, and at the quarters of those that `look` goes on with, depth first.
    fn visit(&self, turned: &Turned, blocks: &[Node], look: &mut dyn FnMut(u32, Node) -> Visit) {
        let mut waiting: Vec<(u32, Node)> = Vec::new();
        for block in blocks {
            waiting.push((LEVELS, *block));
            while let Some((level, node)) = waiting.pop() {
                match look(level, node) {
                    Visit::End => return,
                    Visit::GoOn if level > 0 => {
                        let quarters = self.quarters(turned, node, level).into_iter().rev();
                        waiting.extend(quarters.map(|quarter| (level - 1, quarter)));
                    }
                    Visit::GoOn | Visit::PassOver => {}
                }
            }
        }
    }

    fn place(&self, turned: &Turned, node: Node) -> Place {
        let centre = |cell: i32| (f64::from(cell) + 0.5) * self.resolution;
        let (x, y) = (self.origin.x + centre(node.x), self.origin.y + centre(node.y));
        Place {
            pose_in_map: Pose2::new(x, y, turned.heading(node.heading)),
            score: turned.share(node.bound),
        }
    }
}

/// What follows from a look at a block.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Visit {
    /// Its quarters are looked at.
    GoOn,
    /// They are not.
    PassOver,
    /// Nothing is looked at any more.
    End,
}

/// The likelihood around an obstacle.
fn kernel() -> Vec<(i32, i32, u8)> {
    let reach = libm::ceil(3.0 * SIGMA) as i32;
    let around = (-reach..=reach).flat_map(|dy| (-reach..=reach).map(move |dx| (dx, dy)));
    let level = |(dx, dy): (i32, i32)| {
        let squared = f64::from(dx * dx + dy * dy);
        let share = libm::exp(-0.5 * squared / (SIGMA * SIGMA));
        (dx, dy, libm::round(FULL * share) as u8)
    };
    around.map(level).collect()
}
