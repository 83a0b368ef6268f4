//! Corridors: one that closes into a ring, and one without features.

use rand::Rng;

use super::random::{Purpose, generator};
use super::route::shifted;
use super::shape::{Circle, Segment, outline, rectangle};
use super::site::Site;
use super::world::World;
use crate::slam::pose::Point2;

/// A rectangular ring corridor with a centre line `length_m` long and 2 m to 3 m wide.
///
/// Door niches, recesses, pillars and columns stand at irregular places along both walls: enough
/// to match scans along the corridor, but not much. A lap starts amid the lower side at the
/// origin and turns left; a run overlaps its start by 12 m.
///
/// # Panics
/// When `length_m` is below 60 m, where the corners would meet.
#[must_use]
pub fn ring_corridor(seed: u64, length_m: f64) -> Site {
    assert!(length_m >= 60.0, "a ring of {length_m} m has no straight sides");
    let mut rng = generator(seed, Purpose::World, 0);
    let half_width = 0.5 * rng.random_range(2.0..3.0);
    let width = length_m * rng.random_range(0.27..0.33);
    let height = 0.5 * length_m - width;
    let corners = [(-0.5, 0.0), (0.5, 0.0), (0.5, 1.0), (-0.5, 1.0)]
        .map(|(x, y)| Point2::new(x * width, y * height));
    let mut walls = Walls { rng, segments: Vec::new(), circles: Vec::new() };
    for side in outline(corners) {
        // The corridor is on the right of an inner wall and, seen from the far end, of an outer.
        let inner = shifted(part(side, half_width, side.length() - half_width), half_width);
        let outer = shifted(part(side, -half_width, side.length() + half_width), -half_width);
        walls.add(inner);
        walls.add(Segment::new(outer.b, outer.a));
    }
    let [a, b, c, d] = corners;
    Site {
        world: World::new(walls.segments, walls.circles),
        circuit: vec![Point2::default(), b, c, d, a],
        overlap_m: 12.0,
    }
}

/// A straight corridor of `length_m` by 2.4 m without any feature between its ends.
///
/// A lap leads from 2 m before one end to 2 m before the other and back.
#[must_use]
pub fn straight_corridor(length_m: f64) -> Site {
    let walls = rectangle(Point2::new(-2.0, -1.2), Point2::new(length_m - 2.0, 1.2));
    Site {
        world: World::new(walls.to_vec(), Vec::new()),
        circuit: vec![Point2::default(), Point2::new(length_m - 4.0, 0.0)],
        overlap_m: 0.0,
    }
}

/// The part of a line between two distances from its start; may reach beyond its ends.
fn part(line: Segment, from: f64, to: f64) -> Segment {
    Segment::new(line.point_at(from), line.point_at(to))
}

struct Walls<R> {
    rng: R,
    segments: Vec<Segment>,
    circles: Vec<Circle>,
}

impl<R: Rng> Walls<R> {
    /// A wall with features; the corridor is on its right.
    fn add(&mut self, line: Segment) {
        let mut at = 0.0;
        loop {
            let plain = self.rng.random_range(1.5..9.0);
            let width = self.feature_width();
            if at + plain + width + 1.5 > line.length() {
                self.segments.push(part(line, at, line.length()));
                return;
            }
            let start = at + plain;
            self.segments.push(part(line, at, start));
            at = start + width;
            self.feature(part(line, start, at));
        }
    }

    /// Niches for doors and pillars are about a metre wide or less, recesses are wider.
    fn feature_width(&mut self) -> f64 {
        match self.rng.random_range(0..3) {
            0 => self.rng.random_range(0.3..0.5),
            1 => self.rng.random_range(0.9..1.1),
            _ => self.rng.random_range(1.5..3.0),
        }
    }

    /// Fills the gap `line` of a wall with something that stands out or back.
    fn feature(&mut self, line: Segment) {
        let depth = match line.length() {
            // A pillar that stands out of the wall.
            width if width < 0.6 => -self.rng.random_range(0.15..0.35),
            // A door, set back into the wall.
            width if width < 1.2 => self.rng.random_range(0.08..0.25),
            // A recess; a column may stand before it.
            _ => self.rng.random_range(0.4..1.2),
        };
        let back = shifted(line, depth);
        let sides = [Segment::new(line.a, back.a), back, Segment::new(back.b, line.b)];
        self.segments.extend(sides);
        if line.length() > 1.5 && self.rng.random_bool(0.3) {
            let radius = self.rng.random_range(0.08..0.18);
            let center = shifted(line, -0.05).point_at(0.5 * line.length());
            self.circles.push(Circle { center, radius });
        }
    }
}
