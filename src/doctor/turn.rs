//! By how much a laser turned between two of its scans, from the scans alone.

use crate::slam::scan::{Beam, Scan};

/// Turns that are tried either way, rad.
const MOST_TURN: f64 = 1.2;

/// Ranges that differ by more, m, see different things, and how different does not matter.
const MOST_DIFFERENCE: f64 = 0.5;

/// Pairs of hits without which nothing is told, and their share of the beams.
const LEAST_PAIRS: usize = 20;
const LEAST_SHARE: f64 = 0.3;

/// The best turn must fit this much better than turns do on average, or all look alike.
const CLEARLY_BETTER: f64 = 0.7;

/// How far the laser turned about its own z axis from one scan to another, rad: what was seen in
/// one direction is later seen that much further clockwise.
///
/// `None` where scans have too few hits, other angles, or look the same in every direction. The
/// laser should not have moved far meanwhile.
#[must_use]
pub fn laser_turn(before: &Scan, after: &Scan) -> Option<f64> {
    let increment = before.geometry.angle_increment();
    let beams = before.ranges.len().min(after.ranges.len());
    if (after.geometry.angle_increment() - increment).abs() > 1e-6 || beams < LEAST_PAIRS {
        return None;
    }
    let profiles = Profiles {
        before: hits(before, beams),
        after: hits(after, beams),
        all_around: (beams as f64 + 0.5) * increment.abs() >= std::f64::consts::TAU,
    };
    let most = (MOST_TURN / increment.abs()) as isize;
    let costs: Vec<(isize, f64)> =
        (-most..=most).filter_map(|shift| Some((shift, profiles.difference(shift)?))).collect();
    let &(shift, least) = costs.iter().min_by(|a, b| a.1.total_cmp(&b.1))?;
    let mean = costs.iter().map(|(_, cost)| cost).sum::<f64>() / costs.len() as f64;
    (least < CLEARLY_BETTER * mean).then_some(-(shift as f64) * increment)
}

fn hits(scan: &Scan, beams: usize) -> Vec<Option<f64>> {
    let hit = |&range| match scan.geometry.classify(range) {
        Beam::Hit(range) => Some(range),
        Beam::NoReturn | Beam::Invalid => None,
    };
    scan.ranges[..beams].iter().map(hit).collect()
}

struct Profiles {
    before: Vec<Option<f64>>,
    after: Vec<Option<f64>>,
    all_around: bool,
}

impl Profiles {
    /// Mean difference of the ranges, m, when the later scan is moved on by `shift` beams.
    fn difference(&self, shift: isize) -> Option<f64> {
        let beams = self.before.len() as isize;
        let (mut sum, mut pairs) = (0.0, 0_usize);
        for (index, before) in self.before.iter().enumerate() {
            let mut other = index as isize + shift;
            if self.all_around {
                other = other.rem_euclid(beams);
            }
            let after = usize::try_from(other).ok().and_then(|other| self.after.get(other));
            if let (Some(before), Some(Some(after))) = (before, after) {
                sum += (before - after).abs().min(MOST_DIFFERENCE);
                pairs += 1;
            }
        }
        let enough = pairs >= LEAST_PAIRS && pairs as f64 >= LEAST_SHARE * beams as f64;
        enough.then(|| sum / pairs as f64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::pose::{Stamp, wrap_angle};
    use crate::slam::scan::ScanGeometry;

    /// From the middle of a room of 6 m by 4 m that has a pillar.
    fn room(heading: f64, geometry: ScanGeometry, beams: usize) -> Scan {
        let range = |index| {
            let direction = heading + geometry.angle(index);
            let (sin, cos) = libm::sincos(direction);
            let wall = (3.0 / cos.abs()).min(2.0 / sin.abs());
            if wrap_angle(direction - 1.0).abs() < 0.2 { 0.8 } else { wall as f32 }
        };
        Scan { stamp: Stamp(0), geometry, ranges: (0..beams).map(range).collect() }
    }

    fn geometry(start: f64, increment: f64, beams: usize) -> ScanGeometry {
        let end = start + increment * (beams - 1) as f64;
        ScanGeometry::new([start, end], increment, [0.1, 20.0]).unwrap()
    }

    #[test]
    fn a_turn_to_the_left_is_positive_and_one_to_the_right_negative() {
        let all_around = geometry(-std::f64::consts::PI, std::f64::consts::TAU / 360.0, 360);
        let ahead = geometry(-1.57, 0.01, 315);
        for (geometry, beams) in [(all_around, 360), (ahead, 315)] {
            for turn in [-0.5, -0.2, 0.0, 0.3, 0.9] {
                let (before, after) =
                    (room(0.4, geometry, beams), room(0.4 + turn, geometry, beams));
                let found = laser_turn(&before, &after).unwrap();
                assert!((found - turn).abs() < 0.02, "{found} for {turn}");
            }
        }
    }

    #[test]
    fn a_laser_that_turns_clockwise_tells_the_same() {
        let clockwise = geometry(3.0, -0.01, 600);
        let (before, after) = (room(0.0, clockwise, 600), room(0.4, clockwise, 600));
        assert!((laser_turn(&before, &after).unwrap() - 0.4).abs() < 0.02);
    }

    #[test]
    fn what_looks_the_same_everywhere_or_is_empty_tells_nothing() {
        let geometry = geometry(-3.0, 0.01, 600);
        let round = Scan { stamp: Stamp(0), geometry, ranges: vec![2.0; 600] };
        assert_eq!(laser_turn(&round, &round), None);
        let empty = Scan { ranges: vec![f32::INFINITY; 600], ..round.clone() };
        assert_eq!(laser_turn(&empty, &empty), None);
        let few = Scan { ranges: vec![2.0; 3], ..round };
        assert_eq!(laser_turn(&few, &few), None);
    }
}
