//! What the beams of a sweep say of the plane: obstacles, free space, or nothing.

use super::grid::occupancy::{BeamEnd, BeamEndKind, ScanOutline};
use super::pose::Point2;
use super::scan::{Beam, LaserMount, Scan};

/// Beams are not used further than this many cells: what one scan enters stays bounded, and its
/// hits can be looked up.
pub const FURTHEST_CELL: f64 = 16_000.0;

/// Which readings are used, and how far.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BeamLimits {
    /// `maxRange`, m: readings strictly above are discarded; `None` takes the sensor's own limit.
    pub max_range: Option<f64>,
    /// `maxUrange`, m: no obstacles above, and free space ends there; `None` takes `max_range`.
    pub max_usable_range: Option<f64>,
    /// Whether a beam without return marks free space out to the usable range.
    pub free_on_no_return: bool,
    /// No beam is used further than this, m.
    pub furthest: f64,
}

/// Where the beams end in the frame of the base at the scan's stamp.
///
/// The free space of all beams is seen from where the first was taken: within a sweep a robot
/// moves by less than a few cells, and free space ends at the obstacles either way.
///
/// As in slam_gmapping, readings above `maxRange` say nothing, and readings between `maxUrange`
/// and `maxRange` make free space up to `maxUrange`. Beams without return make none where neither
/// the limits nor the sensor say how far it sees.
#[must_use]
pub fn outline(scan: &Scan, mount: &LaserMount, limits: &BeamLimits) -> ScanOutline {
    let geometry = &scan.geometry;
    let max_range = limits.max_range.unwrap_or(f64::INFINITY);
    let usable = limits.max_usable_range.unwrap_or(geometry.range_max());
    let usable = usable.min(max_range).min(limits.furthest);
    let limit = limits.max_usable_range.or(limits.max_range);
    let reach_known = limit.is_some() || geometry.range_max().is_finite();
    let free_on_no_return = limits.free_on_no_return && reach_known;
    let end = |(index, range): (usize, &f32)| {
        let (range, kind) = match geometry.classify(*range) {
            Beam::Hit(range) if range <= usable => (range, BeamEndKind::Hit),
            Beam::Hit(range) if range <= max_range => (usable, BeamEndKind::Free),
            Beam::NoReturn if free_on_no_return => (usable, BeamEndKind::Free),
            Beam::Hit(_) | Beam::NoReturn | Beam::Invalid => (0.0, BeamEndKind::Nothing),
        };
        let Point2 { x, y } = scan.point_in_base(mount, index, range);
        BeamEnd { point: [x as f32, y as f32], kind }
    };
    ScanOutline {
        sensor: mount.base_from_laser.position(),
        ends: scan.ranges.iter().enumerate().map(end).collect(),
        angle_increment: geometry.angle_increment().abs(),
    }
}
