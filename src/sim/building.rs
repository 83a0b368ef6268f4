//! An office building: corridors that cross, rooms with doors, furniture.

use rand::Rng;

use super::random::{Purpose, generator};
use super::route::shifted;
use super::shape::{Circle, Segment, minus, outline, plus, rectangle};
use super::site::Site;
use super::tour;
use super::world::World;
use crate::slam::pose::Point2;

/// Gap between a room and the edge of its block, m: half the thickness of an inner wall.
const WALL_M: f64 = 0.1;
/// Least distance of furniture from where the robot may drive, m.
const KEEP_CLEAR_M: f64 = 0.55;
/// How far before the outer wall a corridor's centre line ends, m.
const DEAD_END_M: f64 = 0.8;

/// A square office building of `size_m` by `size_m` with a corner at the origin.
///
/// Corridors cross and so form loops; the blocks between hold rooms with doors and furniture. A
/// lap is a tour of about `10 * size_m` metres through corridors and rooms, many of them more
/// than once; it follows the plan of the building and so never meets a wall.
///
/// # Panics
/// When `size_m` is below 20 m, where rooms do not fit.
#[must_use]
pub fn building(seed: u64, size_m: f64) -> Site {
    assert!(size_m >= 20.0, "a building of {size_m} m has no place for rooms");
    let mut rng = generator(seed, Purpose::World, 0);
    let plan = Plan::draw(size_m, &mut rng);
    let (furniture, pillars) = plan.furniture(&mut rng);
    let mut segments = plan.walls();
    segments.extend(furniture);
    let circuit = tour::closed(&plan, 10.0 * size_m, &mut rng);
    Site { world: World::new(segments, pillars), circuit, overlap_m: 0.0 }
}

/// A place where corridors cross or end: column and row, counted from 0 at the lower left.
pub(super) type Node = (usize, usize);

/// The layout: corridors on a lattice, and rooms in the blocks between them.
pub(super) struct Plan {
    size: f64,
    /// Corridors along y, by rising x.
    columns: Vec<Corridor>,
    /// Corridors along x, by rising y.
    rows: Vec<Corridor>,
    pub(super) rooms: Vec<Room>,
}

/// Where a corridor's centre line is and how far its walls are from it, m.
#[derive(Clone, Copy)]
struct Corridor {
    center: f64,
    half_width: f64,
}

/// A room with one door.
pub(super) struct Room {
    min: Point2,
    max: Point2,
    door: Door,
    /// The stretch of corridor its door opens to, from the lower node to the higher.
    pub(super) stretch: (Node, Node),
    /// From the corridor's centre line through the door, about the room and back.
    pub(super) visit: Vec<Point2>,
}

/// An opening in the edge of a block.
struct Door {
    center: Point2,
    half_width: f64,
    /// Unit vector into the room.
    inward: Point2,
}

/// A rectangle between corridors and its column and row.
struct Block {
    min: Point2,
    max: Point2,
    node: Node,
}

/// A side of a rectangle.
#[derive(Clone, Copy, PartialEq)]
enum Side {
    Left,
    Right,
    Bottom,
    Top,
}

impl Plan {
    fn draw(size: f64, rng: &mut impl Rng) -> Self {
        let columns = corridors(size, rng);
        let rows = corridors(size, rng);
        let mut plan = Self { size, columns, rows, rooms: Vec::new() };
        for block in plan.blocks() {
            plan.add_rooms(&block, rng);
        }
        plan
    }

    /// Number of corridors each way.
    pub(super) fn corridors(&self) -> usize {
        self.columns.len()
    }

    /// Where a node is, m.
    pub(super) fn position(&self, (column, row): Node) -> Point2 {
        let along = |corridors: &[Corridor], index: usize| match index {
            0 => DEAD_END_M,
            _ => corridors.get(index - 1).map_or(self.size - DEAD_END_M, |c| c.center),
        };
        Point2::new(along(&self.columns, column), along(&self.rows, row))
    }

    fn blocks(&self) -> Vec<Block> {
        let spans = |corridors: &[Corridor]| -> Vec<(f64, f64)> {
            let starts = corridors.iter().map(|c| c.center + c.half_width);
            let ends = corridors.iter().map(|c| c.center - c.half_width);
            std::iter::once(0.0).chain(starts).zip(ends.chain([self.size])).collect()
        };
        let (x, y) = (spans(&self.columns), spans(&self.rows));
        let block = |column: usize, row: usize| Block {
            min: Point2::new(x[column].0, y[row].0),
            max: Point2::new(x[column].1, y[row].1),
            node: (column, row),
        };
        (0..x.len())
            .flat_map(|i| (0..y.len()).map(move |j| (i, j)))
            .map(|(i, j)| block(i, j))
            .collect()
    }

    /// Splits a block into one to three rooms side by side.
    fn add_rooms(&mut self, block: &Block, rng: &mut impl Rng) {
        let split_x = rng.random_bool(0.5);
        let span = minus(block.max, block.min);
        let most = (if split_x { span.x } else { span.y } / 2.9).floor().clamp(1.0, 3.0);
        let count = rng.random_range(1..=most as usize);
        for index in 0..count {
            let share = |i: usize| i as f64 / count as f64;
            let (mut min, mut max) = (block.min, block.max);
            if split_x {
                (min.x, max.x) =
                    (block.min.x + share(index) * span.x, block.min.x + share(index + 1) * span.x);
            } else {
                (min.y, max.y) =
                    (block.min.y + share(index) * span.y, block.min.y + share(index + 1) * span.y);
            }
            let sides = self.corridor_sides(block, [min, max]);
            let side = sides[rng.random_range(0..sides.len())];
            let room = self.room([min, max], side, block.node, rng);
            self.rooms.push(room);
        }
    }

    /// The sides of a part of a block that lie on a corridor; there is always one.
    fn corridor_sides(&self, block: &Block, [min, max]: [Point2; 2]) -> Vec<Side> {
        let last = self.corridors();
        let (column, row) = block.node;
        let candidates = [
            (Side::Left, column > 0 && min.x == block.min.x),
            (Side::Right, column < last && max.x == block.max.x),
            (Side::Bottom, row > 0 && min.y == block.min.y),
            (Side::Top, row < last && max.y == block.max.y),
        ];
        candidates.into_iter().filter_map(|(side, open)| open.then_some(side)).collect()
    }

    /// The room in the part of a block from `min` to `max` with a door on `side`.
    fn room(&self, [min, max]: [Point2; 2], side: Side, node: Node, rng: &mut impl Rng) -> Room {
        let (column, row) = node;
        let wall = Point2::new(WALL_M, WALL_M);
        let (inner_min, inner_max) = (plus(min, 1.0, wall), plus(max, -1.0, wall));
        let x = rng.random_range(inner_min.x + 0.8..inner_max.x - 0.8);
        let y = rng.random_range(inner_min.y + 0.8..inner_max.y - 0.8);
        let (center, inward, stretch) = match side {
            Side::Left => (Point2::new(min.x, y), (1.0, 0.0), (node, (column, row + 1))),
            Side::Right => {
                (Point2::new(max.x, y), (-1.0, 0.0), ((column + 1, row), (column + 1, row + 1)))
            }
            Side::Bottom => (Point2::new(x, min.y), (0.0, 1.0), (node, (column + 1, row))),
            Side::Top => {
                (Point2::new(x, max.y), (0.0, -1.0), ((column, row + 1), (column + 1, row + 1)))
            }
        };
        let inward = Point2::new(inward.0, inward.1);
        let half_width = rng.random_range(0.45..0.6);
        let door = Door { center, half_width, inward };
        let on_line = self.position(stretch.0);
        let approach = if inward.x == 0.0 {
            Point2::new(center.x, on_line.y)
        } else {
            Point2::new(on_line.x, center.y)
        };
        let mut visit = vec![approach, plus(center, 1.0, inward)];
        for _ in 0..rng.random_range(1..=2) {
            visit.push(Point2::new(
                rng.random_range(inner_min.x + 0.8..inner_max.x - 0.8),
                rng.random_range(inner_min.y + 0.8..inner_max.y - 0.8),
            ));
        }
        visit.extend([visit[1], approach]);
        Room { min: inner_min, max: inner_max, door, stretch, visit }
    }

    fn walls(&self) -> Vec<Segment> {
        let corner = Point2::new(self.size, self.size);
        let mut walls = rectangle(Point2::default(), corner).to_vec();
        for block in self.blocks() {
            let doors = self.rooms.iter().map(|room| &room.door);
            walls.extend(with_gaps(rectangle(block.min, block.max), doors));
        }
        for room in &self.rooms {
            walls.extend(with_gaps(rectangle(room.min, room.max), std::iter::once(&room.door)));
            walls.extend(room.door.jambs());
        }
        walls
    }

    /// Boxes and round things in the rooms, cabinets and pillars in the corridors.
    fn furniture(&self, rng: &mut impl Rng) -> (Vec<Segment>, Vec<Circle>) {
        let keep_clear = self.driving_lines();
        let is_clear =
            |sides: &[Segment]| sides.iter().all(|s| distance(*s, &keep_clear) > KEEP_CLEAR_M);
        let (mut boxes, mut pillars) = (Vec::new(), Vec::new());
        for room in &self.rooms {
            let span = minus(room.max, room.min);
            for _ in 0..(span.x * span.y / 5.0) as usize {
                let place = Point2::new(
                    rng.random_range(room.min.x + 0.4..room.max.x - 0.4),
                    rng.random_range(room.min.y + 0.4..room.max.y - 0.4),
                );
                let radius = rng.random_range(0.1..0.35);
                let sides = table(place, rng);
                let inside = |s: &Segment| room.contains(s.a);
                if rng.random_bool(0.3) {
                    let spot = Segment::new(place, place);
                    if distance(spot, &keep_clear) > KEEP_CLEAR_M + radius {
                        pillars.push(Circle { center: place, radius });
                    }
                } else if is_clear(&sides) && sides.iter().all(inside) {
                    boxes.extend(sides);
                }
            }
        }
        for block in self.blocks() {
            let cabinets = cabinets(&block, rng).into_iter();
            let indoors = |s: &Segment| self.contains(s.a);
            let stands = |sides: &[Segment; 4]| is_clear(sides) && sides.iter().all(indoors);
            boxes.extend(cabinets.filter(stands).flatten());
        }
        (boxes, pillars)
    }

    fn contains(&self, point: Point2) -> bool {
        (0.0..self.size).contains(&point.x) && (0.0..self.size).contains(&point.y)
    }

    /// Every line the robot may drive along.
    fn driving_lines(&self) -> Vec<Segment> {
        let visits = self.rooms.iter().flat_map(|room| room.visit.windows(2));
        let mut lines: Vec<Segment> = visits.map(|ends| Segment::new(ends[0], ends[1])).collect();
        let last = self.corridors() + 1;
        for index in 1..last {
            lines.push(Segment::new(self.position((index, 0)), self.position((index, last))));
            lines.push(Segment::new(self.position((0, index)), self.position((last, index))));
        }
        lines
    }
}

impl Room {
    fn contains(&self, point: Point2) -> bool {
        (self.min.x..self.max.x).contains(&point.x) && (self.min.y..self.max.y).contains(&point.y)
    }
}

impl Door {
    /// The two short walls between the corridor and the room.
    fn jambs(&self) -> [Segment; 2] {
        let across = Point2::new(self.inward.y, self.inward.x);
        [-self.half_width, self.half_width].map(|offset| {
            let outer = plus(self.center, offset, across);
            Segment::new(outer, plus(outer, WALL_M, self.inward))
        })
    }

    /// Leaves the opening out of a wall that runs past the door.
    fn cut(&self, wall: Segment) -> Vec<Segment> {
        let along = if self.inward.x == 0.0 { wall.b.x - wall.a.x } else { wall.b.y - wall.a.y };
        let offset = minus(self.center, wall.a);
        let at = if self.inward.x == 0.0 { offset.x } else { offset.y } * along.signum();
        let passes = along.abs() > 1e-6
            && (self.half_width..=wall.length() - self.half_width).contains(&at)
            && wall.distance_to(self.center) < WALL_M + 1e-6;
        if !passes {
            return vec![wall];
        }
        let (from, to) = (wall.point_at(at - self.half_width), wall.point_at(at + self.half_width));
        vec![Segment::new(wall.a, from), Segment::new(to, wall.b)]
    }
}

fn corridors(size: f64, rng: &mut impl Rng) -> Vec<Corridor> {
    let count = ((size / 13.0).round() as usize).max(1);
    let pitch = size / (count + 1) as f64;
    let corridor = |index| Corridor {
        center: pitch * (f64::from(index) + rng.random_range(0.88..1.12)),
        half_width: rng.random_range(0.95..1.25),
    };
    (0..count as u32).map(corridor).collect()
}

fn with_gaps<'a>(walls: [Segment; 4], doors: impl Iterator<Item = &'a Door>) -> Vec<Segment> {
    doors.fold(walls.to_vec(), |walls, door| walls.into_iter().flat_map(|w| door.cut(w)).collect())
}

fn distance(segment: Segment, lines: &[Segment]) -> f64 {
    lines.iter().map(|line| line.distance_between(segment)).fold(f64::INFINITY, f64::min)
}

/// A rectangle around `center`, turned at random.
fn table(center: Point2, rng: &mut impl Rng) -> [Segment; 4] {
    let (length, depth) = (rng.random_range(0.2..0.9), rng.random_range(0.15..0.45));
    let turned = if rng.random_bool(0.6) { 0.0 } else { rng.random_range(0.0..3.0) };
    let (sin, cos) = libm::sincos(turned);
    let corner = |x: f64, y: f64| {
        let (x, y) = (x * length, y * depth);
        Point2::new(center.x + cos * x - sin * y, center.y + sin * x + cos * y)
    };
    outline([corner(-1.0, -1.0), corner(1.0, -1.0), corner(1.0, 1.0), corner(-1.0, 1.0)])
}

/// Candidates for things that stand out from the sides of a block into the corridors.
fn cabinets(block: &Block, rng: &mut impl Rng) -> Vec<[Segment; 4]> {
    let mut found = Vec::new();
    for side in rectangle(block.min, block.max) {
        for _ in 0..2 {
            let pillar = rng.random_bool(0.5);
            let width =
                if pillar { rng.random_range(0.25..0.5) } else { rng.random_range(0.7..1.4) };
            let depth = rng.random_range(0.15..0.35);
            let start = rng.random_range(0.3..side.length() - width - 0.3);
            let wall = Segment::new(side.point_at(start), side.point_at(start + width));
            let front = shifted(wall, -depth);
            found.push(outline([wall.a, wall.b, front.b, front.a]));
        }
    }
    found
}
