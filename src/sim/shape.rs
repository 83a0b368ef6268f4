//! Line segments and circles: what walls, furniture and people are made of.

use crate::slam::pose::Point2;

/// A straight piece of wall between two points, in the world frame (m).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Segment {
    /// One end.
    pub a: Point2,
    /// The other end.
    pub b: Point2,
}

impl Segment {
    /// The segment from `a` to `b`.
    #[must_use]
    pub const fn new(a: Point2, b: Point2) -> Self {
        Self { a, b }
    }

    /// Its length, m.
    #[must_use]
    pub fn length(self) -> f64 {
        minus(self.b, self.a).norm()
    }

    /// The point `distance` metres from `a` towards `b`.
    #[must_use]
    pub fn point_at(self, distance: f64) -> Point2 {
        let share = distance / self.length();
        let along = minus(self.b, self.a);
        Point2::new(self.a.x + share * along.x, self.a.y + share * along.y)
    }

    /// Distance of `point` from the nearest point of the segment, m.
    #[must_use]
    pub fn distance_to(self, point: Point2) -> f64 {
        let (along, to) = (minus(self.b, self.a), minus(point, self.a));
        let square = dot(along, along);
        let share = if square > 0.0 { (dot(to, along) / square).clamp(0.0, 1.0) } else { 0.0 };
        Point2::new(to.x - share * along.x, to.y - share * along.y).norm()
    }

    /// Distance between the nearest points of two segments, m; 0 when they cross.
    #[must_use]
    pub fn distance_between(self, other: Self) -> f64 {
        let side = |s: Self, p: Point2| cross(minus(s.b, s.a), minus(p, s.a));
        let crossing = side(self, other.a) * side(self, other.b) < 0.0
            && side(other, self.a) * side(other, self.b) < 0.0;
        if crossing {
            return 0.0;
        }
        let ends = self.distance_to(other.a).min(self.distance_to(other.b));
        ends.min(other.distance_to(self.a)).min(other.distance_to(self.b))
    }

    /// Metres from `origin` along the unit vector `direction` to the segment; infinite on a miss.
    pub(super) fn hit_from(self, origin: Point2, direction: Point2) -> f64 {
        /// Closes the hairline crack between two walls that share an end.
        const SLACK: f64 = 1e-9;
        let (along, to) = (minus(self.b, self.a), minus(self.a, origin));
        let scale = 1.0 / cross(direction, along);
        let range = cross(to, along) * scale;
        let share = cross(to, direction) * scale;
        // A parallel wall makes these infinite or NaN, and both comparisons then fail.
        if range > 0.0 && range.is_finite() && (-SLACK..=1.0 + SLACK).contains(&share) {
            range
        } else {
            f64::INFINITY
        }
    }
}

/// A round obstacle in the world frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Circle {
    /// Its centre, m.
    pub center: Point2,
    /// Its radius, m.
    pub radius: f64,
}

impl Circle {
    /// Metres from `origin` along the unit vector `direction` to the circle; infinite on a miss.
    ///
    /// A circle around the origin is not there: whoever stands on the robot has stepped aside.
    pub(super) fn hit_from(self, origin: Point2, direction: Point2) -> f64 {
        let to = minus(self.center, origin);
        let outside = dot(to, to) - self.radius * self.radius;
        let nearest = dot(to, direction);
        let reach = nearest * nearest - outside;
        if outside <= 0.0 || nearest <= 0.0 || reach < 0.0 {
            return f64::INFINITY;
        }
        nearest - reach.sqrt()
    }
}

/// The difference `a - b`.
pub(super) fn minus(a: Point2, b: Point2) -> Point2 {
    Point2::new(a.x - b.x, a.y - b.y)
}

/// The sum `a + scale * b`.
pub(super) fn plus(a: Point2, scale: f64, b: Point2) -> Point2 {
    Point2::new(a.x + scale * b.x, a.y + scale * b.y)
}

/// The four sides of the rectangle from `min` to `max`.
pub(super) fn rectangle(min: Point2, max: Point2) -> [Segment; 4] {
    outline([min, Point2::new(max.x, min.y), max, Point2::new(min.x, max.y)])
}

/// The four sides of a quadrilateral.
pub(super) fn outline(corners: [Point2; 4]) -> [Segment; 4] {
    [0, 1, 2, 3].map(|i| Segment::new(corners[i], corners[(i + 1) % 4]))
}

fn dot(a: Point2, b: Point2) -> f64 {
    a.x * b.x + a.y * b.y
}

fn cross(a: Point2, b: Point2) -> f64 {
    a.x * b.y - a.y * b.x
}

#[cfg(test)]
mod tests {
    use super::*;

    fn segment(ax: f64, ay: f64, bx: f64, by: f64) -> Segment {
        Segment::new(Point2::new(ax, ay), Point2::new(bx, by))
    }

    #[test]
    fn a_ray_meets_a_wall_and_misses_beside_or_behind_it() {
        let wall = segment(3.0, -1.0, 3.0, 1.0);
        let east = Point2::new(1.0, 0.0);
        assert_eq!(wall.hit_from(Point2::new(0.0, 0.5), east), 3.0);
        assert_eq!(wall.hit_from(Point2::new(0.0, 1.5), east), f64::INFINITY);
        assert_eq!(wall.hit_from(Point2::new(4.0, 0.0), east), f64::INFINITY);
        assert_eq!(segment(1.0, 0.0, 2.0, 0.0).hit_from(Point2::default(), east), f64::INFINITY);
    }

    #[test]
    fn a_ray_meets_the_near_side_of_a_circle() {
        let pillar = Circle { center: Point2::new(5.0, 0.3), radius: 0.5 };
        let east = Point2::new(1.0, 0.0);
        assert!((pillar.hit_from(Point2::default(), east) - 4.6).abs() < 1e-12);
        assert_eq!(pillar.hit_from(Point2::new(0.0, 1.0), east), f64::INFINITY);
        assert_eq!(pillar.hit_from(Point2::new(5.1, 0.0), east), f64::INFINITY);
    }

    #[test]
    fn segments_know_their_distance() {
        let wall = segment(0.0, 0.0, 4.0, 0.0);
        assert_eq!(wall.distance_to(Point2::new(7.0, 4.0)), 5.0);
        assert_eq!(wall.distance_between(segment(1.0, -1.0, 1.0, 1.0)), 0.0);
        assert_eq!(wall.distance_between(segment(1.0, 2.0, 5.0, 3.0)), 2.0);
    }
}
