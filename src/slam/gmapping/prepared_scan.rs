//! A scan made ready once for all particles: classified, transformed to the base, in cells.

use super::super::grid::likelihood_field::Points;
use super::super::grid::occupancy::{BeamEnd, BeamEndKind, ScanOutline};
use super::super::outline::{BeamLimits, FURTHEST_CELL, outline};
use super::{Parameters, ScanReading};

/// Of the hits, the climb looks at every second.
const COARSE_STEP: usize = 2;
/// Neighbouring hits lie on one surface if they are at most this far apart, m, ...
const SURFACE_GAP: f64 = 2.0;
/// ... and at most this many times as far as on a surface seen head-on.
const SURFACE_SLANT: f64 = 15.0;
/// Points of a surface that are nearer to each other than this add nothing, cells.
const SURFACE_SPACING: f64 = 0.8;

/// What the filter needs of a scan.
#[derive(Debug, Clone)]
pub struct PreparedScan {
    /// Hits to match, in the base frame, cells.
    pub hits: Points,
    /// Some of them, for the climb.
    pub coarse_hits: Points,
    /// Points of the surfaces that were seen: the hits, and points between neighbouring hits.
    ///
    /// Far away and at a slant, hits are further apart than the matcher's reach; a map of such
    /// dots holds later scans fast wherever their beams happen to meet the dots.
    pub surfaces: Points,
    /// Distance of the furthest hit from the base, cells.
    pub radius: i32,
    /// The scan as the occupancy map takes it.
    pub outline: ScanOutline,
}

impl PreparedScan {
    /// Prepares a scan; `hits` is empty if no beam is usable.
    #[must_use]
    pub fn new(reading: &ScanReading<'_>, parameters: &Parameters) -> Self {
        let limits = BeamLimits {
            max_range: parameters.max_range,
            max_usable_range: parameters.max_usable_range,
            free_on_no_return: parameters.map.free_on_no_return,
            furthest: FURTHEST_CELL * parameters.resolution,
        };
        let outline = outline(reading.scan, reading.mount, &limits);
        let resolution = parameters.resolution;
        let in_cells = |end: &BeamEnd| {
            (end.kind == BeamEndKind::Hit)
                .then(|| end.point.map(|metres| f64::from(metres) / resolution))
        };
        let ends: Vec<Option<[f64; 2]>> = outline.ends.iter().map(in_cells).collect();
        let used = ends.iter().flatten().step_by(parameters.matcher.beam_skip + 1);
        let hits: Points = used.map(|[x, y]| (*x as f32, *y as f32)).collect();
        let radius = hits.iter().map(|(x, y)| (x * x + y * y).sqrt()).fold(0.0, f32::max);
        let widest = SURFACE_GAP / resolution;
        Self {
            coarse_hits: hits.every(COARSE_STEP),
            hits,
            surfaces: surfaces(&ends, widest, SURFACE_SLANT * outline.angle_increment),
            radius: radius as i32 + 1,
            outline,
        }
    }
}

/// Hits and the points between neighbouring hits that lie on one surface, cells.
fn surfaces(ends: &[Option<[f64; 2]>], widest: f64, slant: f64) -> Points {
    let mut points: Vec<[f64; 2]> = Vec::with_capacity(2 * ends.len());
    let mut previous: Option<[f64; 2]> = None;
    for end in ends {
        let Some(hit) = *end else {
            previous = None;
            continue;
        };
        if let Some(before) = previous {
            let gap = distance(before, hit);
            let range = distance(before, [0.0; 2]).min(distance(hit, [0.0; 2]));
            if gap < widest && gap < slant * range {
                let pieces = gap.round();
                points.extend((1..pieces as i32).map(|i| {
                    let share = f64::from(i) / pieces;
                    [0, 1].map(|axis| before[axis] + share * (hit[axis] - before[axis]))
                }));
            }
        }
        if points.last().is_none_or(|last| distance(*last, hit) >= SURFACE_SPACING) {
            points.push(hit);
        }
        previous = Some(hit);
    }
    points.into_iter().map(|[x, y]| (x as f32, y as f32)).collect()
}

fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    let (dx, dy) = (a[0] - b[0], a[1] - b[1]);
    (dx * dx + dy * dy).sqrt()
}
