//! Whether scans and odometry tell of the same motion.

use std::time::Duration;

use super::finding::Finding;
use super::turn::laser_turn;
use super::watch::{SeenPose, SeenScan, Watch};
use crate::slam::pose::Pose2;
use crate::slam::scan::{LaserMount, MountOrientation, Scan};
use crate::statistics::percentile;
use crate::timeline::OdometryBuffer;

/// Turns that are compared, rad: well above the angle between beams, well below the most that
/// [`laser_turn`] finds.
const LEAST_TURN: f64 = 0.15;
const MOST_TURN: f64 = 0.9;

/// A turn is compared only if the robot hardly drove meanwhile, m.
const MOST_DRIVE: f64 = 0.5;

/// Scans within which a turn has to happen.
const MOST_SCANS: usize = 40;

/// Turns without which nothing is said.
const LEAST_TURNS: usize = 3;

/// Odometry that moved less, m and rad, stands still.
const STANDS_STILL: f64 = 0.02;

/// Odometry that moved more, m or rad, moves.
const MOVES: f64 = 0.3;

/// A robot that moved changes this share of its ranges by more than [`OTHER_RANGE`]; people who
/// walk about change fewer.
const MOVED_SHARE: f64 = 0.4;
const OTHER_RANGE: f32 = 0.2;

/// What scans and odometry say about each other.
pub(super) enum Agreement {
    /// They tell of the same turns.
    Alike { turns: usize, ratio: f64 },
    /// They do not.
    Contradiction(Finding),
    /// There is too little to compare.
    Unknown,
}

pub(super) fn compare(watch: &Watch, mount: Option<LaserMount>) -> Agreement {
    let odometry = watch.used_odometry();
    let (moved, turned) = extent(odometry);
    if moved < STANDS_STILL && turned < STANDS_STILL {
        let stuck = !odometry.is_empty() && scans_move(&watch.scans);
        return if stuck {
            Agreement::Contradiction(Finding::OdometryStuck)
        } else {
            Agreement::Unknown
        };
    }
    if moved.max(turned) > MOVES && scans_are_frozen(&watch.scans) {
        return Agreement::Contradiction(Finding::ScansFrozen { moved_m: moved });
    }
    let orientation = mount.unwrap_or_default().orientation;
    judge(turn_ratios(&watch.scans, odometry, orientation))
}

fn judge(mut ratios: Vec<f64>) -> Agreement {
    let turns = ratios.len();
    ratios.sort_by(f64::total_cmp);
    match percentile(&ratios, 50) {
        Some(ratio) if turns >= LEAST_TURNS => match ratio {
            0.7..=1.4 => Agreement::Alike { turns, ratio },
            -1.4..=-0.7 => Agreement::Contradiction(Finding::Mirrored { turns, ratio }),
            _ => Agreement::Contradiction(Finding::TurnScale { turns, ratio }),
        },
        _ => Agreement::Unknown,
    }
}

/// The base's turn by the scans over its turn by odometry, for each turn that is large enough.
fn turn_ratios(
    scans: &[SeenScan],
    odometry: &[SeenPose],
    orientation: MountOrientation,
) -> Vec<f64> {
    let mut timeline = OdometryBuffer::new(Duration::from_secs(3600), odometry.len());
    for sample in odometry {
        timeline.insert(sample.stamp, sample.odom_from_base);
    }
    let posed: Vec<(&Scan, Pose2)> = scans
        .iter()
        .filter_map(|seen| Some((&seen.scan, timeline.at(seen.scan.stamp).ok()?)))
        .collect();
    let sign = match orientation {
        MountOrientation::Upright => 1.0,
        MountOrientation::UpsideDown => -1.0,
    };
    let mut ratios = Vec::new();
    let mut first = 0;
    while let Some(&(before, pose)) = posed.get(first) {
        let until = posed.len().min(first + MOST_SCANS);
        let turned =
            (first + 1..until).find(|&i| pose.between(posed[i].1).theta.abs() > LEAST_TURN);
        let Some(index) = turned else {
            first += 1;
            continue;
        };
        let motion = pose.between(posed[index].1);
        let is_turn = motion.theta.abs() < MOST_TURN && motion.position().norm() < MOST_DRIVE;
        if let Some(turn) = is_turn.then(|| laser_turn(before, posed[index].0)).flatten() {
            ratios.push(sign * turn / motion.theta);
        }
        first = index;
    }
    ratios
}

/// The longest way and the largest turn from the first pose, m and rad.
fn extent(odometry: &[SeenPose]) -> (f64, f64) {
    let Some(first) = odometry.first() else { return (0.0, 0.0) };
    odometry.iter().fold((0.0, 0.0), |(moved, turned): (f64, f64), sample| {
        let motion = first.odom_from_base.between(sample.odom_from_base);
        (moved.max(motion.position().norm()), turned.max(motion.theta.abs()))
    })
}

/// Whether the first scan and one long after it are those of different places.
fn scans_move(scans: &[SeenScan]) -> bool {
    let Some(first) = scans.first() else { return false };
    let stride = (scans.len() / 20).max(1);
    let mut later = scans.iter().step_by(stride).skip(1);
    later.any(|seen| changed_share(&first.scan, &seen.scan) > MOVED_SHARE)
}

fn scans_are_frozen(scans: &[SeenScan]) -> bool {
    let Some(first) = scans.first() else { return false };
    let same = |seen: &SeenScan| {
        let ranges = seen.scan.ranges.iter().zip(&first.scan.ranges);
        seen.scan.ranges.len() == first.scan.ranges.len()
            && ranges.into_iter().all(|(a, b)| a.to_bits() == b.to_bits())
    };
    scans.len() > 2 && scans.iter().all(same)
}

/// The share of the beams with a range in both scans that differs.
fn changed_share(a: &Scan, b: &Scan) -> f64 {
    let both = a.ranges.iter().zip(&b.ranges).filter(|(a, b)| a.is_finite() && b.is_finite());
    let (changed, all) = both.fold((0_usize, 0_usize), |(changed, all), (a, b)| {
        (changed + usize::from((a - b).abs() > OTHER_RANGE), all + 1)
    });
    changed as f64 / all.max(1) as f64
}
