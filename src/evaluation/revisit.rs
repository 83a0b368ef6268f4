//! Whether loops close: do scans agree with those taken when the robot first came by?

use std::collections::{HashMap, HashSet};

use crate::slam::pose::{Point2, Pose2, wrap_angle};

/// A scan revisits a pose that is at least this many scans older, ...
const SCANS_BETWEEN: usize = 60;
/// ... at most this far away, m, ...
const NEAR: f64 = 1.5;
/// ... and headed about the same way, rad.
const SAME_HEADING: f64 = 0.6;
/// Hits further away than this are not compared, m: the direction of the beam blurs them.
const RANGE: f64 = 15.0;
/// Scans before and after the earlier pose that are compared with.
const AROUND: usize = 2;
/// Side of the squares by which hits are compared, m.
const BIN: f64 = 0.15;

/// How scans agree with what was seen when the robot was there before.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RevisitAgreement {
    /// Scans taken where the robot had been long before.
    pub revisits: usize,
    /// The share of their hits that lie where there were hits before, on average; 0 to 1.
    pub share: f64,
}

/// The agreement of scans with those of earlier visits; `None` if no place was visited twice.
///
/// `path` has the pose in `map` of each scan, and `hits` its hits in the base frame. A scan
/// revisits the nearest pose that is at least 60 scans older and within 1.5 m and 0.6 rad; its
/// hits up to 15 m agree if the five scans around that pose have a hit in their square of 0.15 m
/// or one next to it. Where loops close nine of ten hits and more agree. Where they do not, walls
/// stand twice and about half agree, by chance or along corridors.
///
/// # Panics
/// When `path` and `hits` differ in length.
#[must_use]
pub fn revisit_agreement(path: &[Pose2], hits: &[Vec<Point2>]) -> Option<RevisitAgreement> {
    assert_eq!(path.len(), hits.len(), "every scan has a pose");
    let mut places = Places::default();
    let (mut revisits, mut sum) = (0, 0.0);
    for (index, pose) in path.iter().enumerate() {
        if let Some(old) = index.checked_sub(SCANS_BETWEEN) {
            places.add(old, path[old]);
        }
        let Some(earlier) = places.nearest(path, *pose) else { continue };
        let around = earlier.saturating_sub(AROUND)..=earlier + AROUND;
        let seen: HashSet<Square> =
            around.flat_map(|i| squares(path[i], &hits[i])).flat_map(with_neighbours).collect();
        let (mut agreeing, mut all) = (0, 0);
        for square in squares(*pose, &hits[index]) {
            agreeing += usize::from(seen.contains(&square));
            all += 1;
        }
        if all > 0 {
            revisits += 1;
            sum += agreeing as f64 / all as f64;
        }
    }
    (revisits > 0).then(|| RevisitAgreement { revisits, share: sum / revisits as f64 })
}

/// Column and row.
type Square = (i64, i64);

fn square(point: Point2, side: f64) -> Square {
    ((point.x / side).floor() as i64, (point.y / side).floor() as i64)
}

fn with_neighbours((column, row): Square) -> impl Iterator<Item = Square> {
    (-1..=1).flat_map(move |dy| (-1..=1).map(move |dx| (column + dx, row + dy)))
}

/// The squares in `map` of a scan's near hits.
fn squares(map_from_base: Pose2, hits: &[Point2]) -> impl Iterator<Item = Square> {
    let near = hits.iter().filter(|hit| hit.norm() <= RANGE);
    near.map(move |hit| square(map_from_base * *hit, BIN))
}

/// Poses by where they are.
#[derive(Default)]
struct Places(HashMap<Square, Vec<usize>>);

impl Places {
    fn add(&mut self, index: usize, pose: Pose2) {
        self.0.entry(square(pose.position(), NEAR)).or_default().push(index);
    }

    /// The nearest pose that is near enough; the oldest of equals.
    fn nearest(&self, path: &[Pose2], pose: Pose2) -> Option<usize> {
        let distance = |index: usize| pose.between(path[index]).position().norm();
        let around = with_neighbours(square(pose.position(), NEAR));
        around
            .filter_map(|square| self.0.get(&square))
            .flatten()
            .map(|index| (distance(*index), *index))
            .filter(|(distance, index)| {
                let turned = wrap_angle(path[*index].theta - pose.theta).abs();
                *distance <= NEAR && turned <= SAME_HEADING
            })
            .min_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)))
            .map(|(_, index)| index)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Hits on a ragged wall that runs along x at y = 2 m, seen up to 4 m either way.
    fn hits(x: f64) -> Vec<Point2> {
        (-20..20)
            .map(|i| {
                let along = f64::from(i) * 0.2;
                let depth = 0.7 * (((x + along) * 0.5).floor() * 2.3).sin();
                Point2::new(along, 2.0 + depth)
            })
            .collect()
    }

    /// Twice along the wall, 40 m each time; the second time `drift` off in x and y.
    fn agreement(drift: f64) -> Option<RevisitAgreement> {
        let x = |i: i32| f64::from(i % 80) * 0.5;
        let path: Vec<Pose2> = (0..160)
            .map(|i| {
                let error = if i < 80 { 0.0 } else { drift };
                Pose2::new(x(i) + error, error, 0.0)
            })
            .collect();
        let hits: Vec<Vec<Point2>> = (0..160).map(|i| hits(x(i))).collect();
        revisit_agreement(&path, &hits)
    }

    #[test]
    fn closed_loops_agree_and_open_ones_do_not() {
        let closed = agreement(0.02).unwrap();
        assert_eq!(closed.revisits, 80);
        assert!(closed.share > 0.97, "{closed:?}");
        let open = agreement(0.7).unwrap();
        assert!(open.revisits >= 79 && open.share < 0.6, "{open:?}");
    }

    #[test]
    fn a_path_without_revisits_has_no_agreement() {
        assert_eq!(revisit_agreement(&[], &[]), None);
        let away: Vec<Pose2> = (0..200).map(|i| Pose2::new(f64::from(i), 0.0, 0.0)).collect();
        assert_eq!(revisit_agreement(&away, &vec![hits(0.0); 200]), None);
    }

    #[test]
    fn the_other_way_along_is_no_revisit() {
        let pose = |i: i32| Pose2::new(0.01 * f64::from(i), 0.0, if i < 70 { 0.0 } else { 3.1 });
        let path: Vec<Pose2> = (0..100).map(pose).collect();
        let found = revisit_agreement(&path, &vec![hits(0.0); 100]).unwrap();
        assert_eq!(found.revisits, 10);
    }
}
