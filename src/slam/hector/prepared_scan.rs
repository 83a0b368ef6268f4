//! A scan made ready for matching and mapping: classified, and transformed to the base.

use super::super::deskew::Velocity;
use super::super::grid::occupancy::{BeamEnd, BeamEndKind, ScanOutline};
use super::super::outline::FURTHEST_CELL;
use super::super::pose::Point2;
use super::super::scan::{Beam, LaserMount, Scan, ScanGeometry};
use super::Parameters;

/// Points of a level nearer to the last one than this add nothing, cells.
const SPACING: f32 = 0.5;

/// What matching and mapping need of a scan.
#[derive(Debug, Clone, Default)]
pub struct PreparedScan {
    /// Where beams ended on something, in the base frame, m; in the order of the beams.
    pub hits: Vec<[f32; 2]>,
    /// The scan as maps take it.
    pub outline: ScanOutline,
}

impl PreparedScan {
    /// Distance of the furthest hit from the base, m.
    #[must_use]
    pub fn radius(&self) -> f64 {
        let squared = self.hits.iter().map(|[x, y]| x * x + y * y).fold(0.0, f32::max);
        f64::from(squared).sqrt()
    }

    /// The hits in cells of `resolution` metres, without those that others stand for.
    #[must_use]
    pub fn points(&self, resolution: f64) -> Vec<[f32; 2]> {
        let per_metre = (1.0 / resolution) as f32;
        let mut points = Vec::with_capacity(self.hits.len());
        let mut last = [f32::INFINITY; 2];
        for hit in &self.hits {
            let [x, y] = hit.map(|metres| metres * per_metre);
            let (dx, dy) = (x - last[0], y - last[1]);
            if dx * dx + dy * dy >= SPACING * SPACING {
                last = [x, y];
                points.push(last);
            }
        }
        points
    }
}

/// Where the beams of the last scan pointed; lasers hardly ever change it.
#[derive(Debug, Clone, Default)]
pub struct Directions {
    of: Option<(ScanGeometry, LaserMount)>,
    /// Cosine and sine in the base frame, a pair a beam.
    unit: Vec<[f64; 2]>,
}

impl Directions {
    /// The scan made ready; without hits if no beam is usable.
    #[must_use]
    pub fn prepare(
        &mut self,
        scan: &Scan,
        mount: &LaserMount,
        parameters: &Parameters,
    ) -> PreparedScan {
        self.point(scan, mount);
        let geometry = &scan.geometry;
        let limit = parameters.max_range.min(FURTHEST_CELL * parameters.resolution);
        let sensor = mount.base_from_laser.position();
        let end = |(index, (range, [cos, sin])): (usize, (&f32, &[f64; 2]))| {
            let (range, kind) = match geometry.classify(*range) {
                Beam::Hit(range) if range < parameters.min_range => (0.0, BeamEndKind::Nothing),
                Beam::Hit(range) if range <= limit => (range, BeamEndKind::Hit),
                Beam::Hit(_) => (limit, BeamEndKind::Free),
                Beam::NoReturn if parameters.free_on_no_return => {
                    (limit.min(geometry.range_max()), BeamEndKind::Free)
                }
                Beam::NoReturn | Beam::Invalid => (0.0, BeamEndKind::Nothing),
            };
            let point = Point2::new(sensor.x + range * cos, sensor.y + range * sin);
            let Point2 { x, y } = match geometry.motion_until(index) {
                Some(base_from_later_base) => base_from_later_base * point,
                None => point,
            };
            BeamEnd { point: [x as f32, y as f32], kind }
        };
        let ends: Vec<BeamEnd> = scan.ranges.iter().zip(&self.unit).enumerate().map(end).collect();
        let hits = ends.iter().filter(|end| end.kind == BeamEndKind::Hit);
        PreparedScan {
            hits: hits.map(|end| end.point).collect(),
            outline: ScanOutline {
                sensor,
                ends,
                angle_increment: geometry.angle_increment().abs(),
            },
        }
    }

    fn point(&mut self, scan: &Scan, mount: &LaserMount) {
        // How fast the robot moves changes from scan to scan, and where its beams point does not.
        let geometry = scan.geometry.with_velocity(Velocity::default());
        if self.of != Some((geometry, *mount)) {
            self.of = Some((geometry, *mount));
            self.unit.clear();
        }
        let known = self.unit.len();
        self.unit.extend((known..scan.ranges.len()).map(|index| {
            let (sin, cos) = libm::sincos(mount.angle_in_base(scan.geometry.angle(index)));
            [cos, sin]
        }));
    }
}
