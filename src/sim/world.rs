//! The simulated surroundings: walls, clutter and people.

use super::bins::{self, Bins, Bounds};
use super::shape::{Circle, Segment, minus};
use crate::slam::pose::Point2;

/// Walls and clutter that stand still, and people who walk; all in the world frame.
#[derive(Debug, Clone, PartialEq)]
pub struct World {
    segments: Vec<Segment>,
    circles: Vec<Circle>,
    people: Vec<Person>,
    bins: Bins,
}

/// Someone who walks back and forth along a line at a constant speed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Person {
    /// The line, from end to end.
    pub path: Segment,
    /// Walking speed, m/s.
    pub speed: f64,
    /// Radius of the body, m.
    pub radius: f64,
    /// Metres already walked at time 0.
    pub head_start: f64,
}

impl Person {
    /// Where the person is `time_s` seconds after the start of the run.
    #[must_use]
    pub fn at(&self, time_s: f64) -> Circle {
        let length = self.path.length();
        let walked = (self.head_start + self.speed * time_s) % (2.0 * length);
        let center = self.path.point_at(walked.min(2.0 * length - walked));
        Circle { center, radius: self.radius }
    }
}

/// A ray in the world frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ray {
    /// Where it starts, m.
    pub origin: Point2,
    /// Where it points, rad.
    pub angle: f64,
    /// How far it goes, m.
    pub limit: f64,
}

impl World {
    /// A world of standing obstacles.
    #[must_use]
    pub fn new(segments: Vec<Segment>, circles: Vec<Circle>) -> Self {
        let bounds: Vec<Bounds> =
            segments.iter().map(segment_bounds).chain(circles.iter().map(circle_bounds)).collect();
        let bins = Bins::new(&bounds, |obstacle, bin| {
            segments.get(obstacle).is_none_or(|segment| bins::segment_touches(*segment, bin))
        });
        Self { segments, circles, people: Vec::new(), bins }
    }

    /// The same world with these people in it.
    #[must_use]
    pub fn with_people(self, people: Vec<Person>) -> Self {
        Self { people, ..self }
    }

    /// The walls and the straight sides of furniture.
    #[must_use]
    pub fn segments(&self) -> &[Segment] {
        &self.segments
    }

    /// The round obstacles that stand still.
    #[must_use]
    pub fn circles(&self) -> &[Circle] {
        &self.circles
    }

    /// The people.
    #[must_use]
    pub fn people(&self) -> &[Person] {
        &self.people
    }

    /// Metres to the first obstacle along `ray`, `time_s` seconds after the start of the run.
    ///
    /// `None` when nothing is met within the ray's limit.
    #[must_use]
    pub fn cast(&self, ray: Ray, time_s: f64) -> Option<f64> {
        let (sin, cos) = libm::sincos(ray.angle);
        let direction = Point2::new(cos, sin);
        let standing = self.bins.nearest(ray.origin, direction, ray.limit, |obstacle| {
            self.hit_from(obstacle, ray.origin, direction)
        });
        let walking = self.people.iter().map(|p| p.at(time_s).hit_from(ray.origin, direction));
        let range = walking.fold(standing, f64::min);
        (range <= ray.limit).then_some(range)
    }

    /// Distance from `point` to the nearest obstacle that stands still, m.
    #[must_use]
    pub fn clearance(&self, point: Point2) -> f64 {
        let walls = self.segments.iter().map(|s| s.distance_to(point));
        let pillars = self.circles.iter().map(|c| minus(point, c.center).norm() - c.radius);
        walls.chain(pillars).fold(f64::INFINITY, f64::min)
    }

    fn hit_from(&self, obstacle: usize, origin: Point2, direction: Point2) -> f64 {
        match self.segments.get(obstacle) {
            Some(segment) => segment.hit_from(origin, direction),
            None => self.circles[obstacle - self.segments.len()].hit_from(origin, direction),
        }
    }
}

fn segment_bounds(segment: &Segment) -> Bounds {
    let (a, b) = (segment.a, segment.b);
    (Point2::new(a.x.min(b.x), a.y.min(b.y)), Point2::new(a.x.max(b.x), a.y.max(b.y)))
}

fn circle_bounds(circle: &Circle) -> Bounds {
    let (c, r) = (circle.center, circle.radius);
    (Point2::new(c.x - r, c.y - r), Point2::new(c.x + r, c.y + r))
}

#[cfg(test)]
mod tests {
    use proptest::collection::vec;
    use proptest::prelude::{Strategy, prop_assert_eq, proptest};

    use super::*;

    fn points(span: f64) -> impl Strategy<Value = Point2> {
        // Whole metres put obstacles and rays on the borders of bins.
        let coordinate = move || {
            (-span..span, 0..3).prop_map(|(v, whole)| if whole == 0 { v.round() } else { v })
        };
        (coordinate(), coordinate()).prop_map(|(x, y)| Point2::new(x, y))
    }

    fn worlds() -> impl Strategy<Value = World> {
        let segments =
            vec((points(12.0), points(12.0)).prop_map(|(a, b)| Segment::new(a, b)), 0..20);
        let circles = vec(
            (points(12.0), 0.05..1.5).prop_map(|(center, radius)| Circle { center, radius }),
            0..8,
        );
        (segments, circles).prop_map(|(segments, circles)| World::new(segments, circles))
    }

    proptest! {
        #[test]
        fn bins_change_nothing(
            world in worlds(),
            origin in points(16.0),
            first_angle in (-3.2..3.2_f64, 0..4).prop_map(|(a, q)| if q == 0 { 0.0 } else { a }),
            limit in 1.0..40.0_f64,
        ) {
            for step in 0..100 {
                let angle = first_angle + 0.0625 * f64::from(step);
                let (sin, cos) = libm::sincos(angle);
                let all = 0..world.segments.len() + world.circles.len();
                let range = all
                    .map(|obstacle| world.hit_from(obstacle, origin, Point2::new(cos, sin)))
                    .fold(f64::INFINITY, f64::min);
                let expected = (range <= limit).then_some(range);
                prop_assert_eq!(world.cast(Ray { origin, angle, limit }, 0.0), expected);
            }
        }
    }

    #[test]
    fn people_walk_back_and_forth_and_block_rays() {
        let path = Segment::new(Point2::new(2.0, 0.0), Point2::new(6.0, 0.0));
        let person = Person { path, speed: 1.0, radius: 0.5, head_start: 1.0 };
        let world = World::new(Vec::new(), Vec::new()).with_people(vec![person]);
        let range_at =
            |time_s| world.cast(Ray { origin: Point2::default(), angle: 0.0, limit: 9.0 }, time_s);
        assert_eq!(range_at(0.0), Some(2.5));
        assert_eq!(range_at(3.0), Some(5.5));
        assert_eq!(range_at(5.0), Some(3.5));
        assert_eq!(range_at(8.0), Some(2.5));
    }

    #[test]
    fn clearance_is_the_distance_to_the_nearest_surface() {
        let wall = Segment::new(Point2::new(0.0, 3.0), Point2::new(9.0, 3.0));
        let pillar = Circle { center: Point2::new(2.0, 0.0), radius: 0.5 };
        let world = World::new(vec![wall], vec![pillar]);
        assert_eq!(world.clearance(Point2::new(1.0, 0.0)), 0.5);
        assert_eq!(world.clearance(Point2::new(8.0, 1.0)), 2.0);
    }
}
