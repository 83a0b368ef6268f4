//! A world together with a way through it.

use rand::Rng as _;

use super::random::{Purpose, generator};
use super::route::{Route, shifted};
use super::shape::Segment;
use super::world::{Person, World};
use crate::slam::pose::Point2;

/// A world and a closed way through its free space.
#[derive(Debug, Clone, PartialEq)]
pub struct Site {
    /// The surroundings.
    pub world: World,
    /// Waypoints of a lap in the world frame, m; the last leads back to the first.
    pub circuit: Vec<Point2>,
    /// How far a run goes on past the start of the lap, m.
    pub overlap_m: f64,
}

impl Site {
    /// The same site with `count` people walking back and forth along parts of the circuit.
    #[must_use]
    pub fn with_people(self, count: usize, seed: u64) -> Self {
        let mut rng = generator(seed, Purpose::People, 0);
        let route = Route::new(self.circuit.clone());
        let legs: Vec<Segment> = route.legs().filter(|leg| leg.length() > 4.0).collect();
        let count = if legs.is_empty() { 0 } else { count };
        let mut person = || {
            let leg = legs[rng.random_range(0..legs.len())];
            let reach = leg.length().min(12.0);
            let start = rng.random_range(0.0..=leg.length() - reach);
            let path = Segment::new(leg.point_at(start), leg.point_at(start + reach));
            Person {
                path: shifted(path, rng.random_range(-0.4..0.4)),
                speed: rng.random_range(0.6..1.4),
                radius: rng.random_range(0.2..0.28),
                head_start: rng.random_range(0.0..2.0 * reach),
            }
        };
        let people = (0..count).map(|_| person()).collect();
        Self { world: self.world.with_people(people), ..self }
    }

    /// The way of `laps` laps and the overlap.
    #[must_use]
    pub fn route(&self, laps: u32) -> Route {
        Route::around(&self.circuit, laps, self.overlap_m)
    }
}
