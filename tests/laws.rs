//! Laws of the mapping core: what must hold whatever the scans are.

use std::collections::{BTreeMap, BTreeSet};

use gmapd::sim::Simulation;
use gmapd::sim::building::building;
use gmapd::sim::lidar::Lidar;
use gmapd::sim::shape::Segment;
use gmapd::sim::world::World;
use gmapd::slam::gmapping::compat::CompatMatcher;
use gmapd::slam::gmapping::prepared_scan::PreparedScan;
use gmapd::slam::gmapping::scan_matcher::FieldMatcher;
use gmapd::slam::gmapping::{GMapping, MatcherParameters, Parameters, ScanReading, ScanUpdate};
use gmapd::slam::grid::Cell;
use gmapd::slam::grid::footprint::{Footprint, halved};
use gmapd::slam::grid::hit_map::HitMap;
use gmapd::slam::grid::likelihood_field::{
    FULL, Kernel, LikelihoodField, Points, Window, WindowPose,
};
use gmapd::slam::grid::log_odds::{Evidence, LogOdds, LogOddsMap};
use gmapd::slam::grid::occupancy::{
    BeamEnd, BeamEndKind, Count, OccupancyGrid, OccupancyMap, ScanOutline,
};
use gmapd::slam::grid::tile_map::{TILE_SIZE, TileKey, TileMap};
use gmapd::slam::motion_gate::MotionGate;
use gmapd::slam::path::Path;
use gmapd::slam::pose::{Point2, Pose2};
use gmapd::slam::scan::LaserMount;
use proptest::collection::vec;
use proptest::prelude::{Strategy, prop_assert, prop_assert_eq, proptest};

mod support;

use support::{add, filter, full_circle, parameters, room, route, shots};

/// Cells from the centre of a window to its edge.
const WINDOW_RADIUS: i32 = 120;

/// Points within reach of a window's centre, cells.
fn points() -> impl Strategy<Value = Points> {
    let point = (0.0..80.0_f32, -3.2..3.2_f32).prop_map(|(r, a)| (r * a.cos(), r * a.sin()));
    vec(point, 0..200).prop_map(|points| points.into_iter().collect())
}

/// Where a base is, relative to the centre of a window: cells, cells, radians.
fn offsets() -> impl Strategy<Value = [f64; 3]> {
    (-30.0..30.0, -30.0..30.0, -4.0..4.0).prop_map(|(x, y, theta)| [x, y, theta])
}

fn cells() -> impl Strategy<Value = Cell> {
    (-3000..3000, -3000..3000).prop_map(|(ix, iy)| Cell::new(ix, iy))
}

/// A field with these hits around `centre`, of a width of some cells so that it is smooth.
fn field(centre: Cell, hits: &[(f64, f64)]) -> LikelihoodField {
    let mut field = LikelihoodField::new();
    let hits: Points = hits.iter().map(|(x, y)| (*x as f32, *y as f32)).collect();
    Kernel::new(2.5).insert(&mut field, centre, &hits, WindowPose::new(0.0, 0.0, 0.0));
    field
}

/// The points' places in the map, in cells, with the base at `offset` from `centre`'s corner.
fn places(points: &Points, centre: Cell, [x, y, theta]: [f64; 3]) -> Vec<[f64; 2]> {
    let (sin, cos) = libm::sincos(theta);
    let place = |(px, py): (f32, f32)| {
        let (px, py) = (f64::from(px), f64::from(py));
        [
            f64::from(centre.ix) + x + cos * px - sin * py,
            f64::from(centre.iy) + y + sin * px + cos * py,
        ]
    };
    points.iter().map(place).collect()
}

fn pose_in(window: &Window<'_>, centre: Cell, [x, y, theta]: [f64; 3]) -> WindowPose {
    let first = window.first_cell();
    let from = |centre: i32, first: i32| f64::from(centre - first);
    WindowPose::new(from(centre.ix, first.ix) + x, from(centre.iy, first.iy) + y, theta)
}

/// Whether a point is so near a line between cells that single precision may take either.
fn on_a_line([x, y]: [f64; 2], lines: f64) -> bool {
    [x, y].iter().any(|v| (v - lines - (v - lines).round()).abs() < 2e-3)
}

fn keep(points: &Points, wanted: &[bool]) -> Points {
    points.iter().zip(wanted).filter_map(|(point, wanted)| wanted.then_some(point)).collect()
}

/// The bilinear interpolation between cell centres, cell by cell.
fn interpolated(field: &LikelihoodField, [x, y]: [f64; 2]) -> f64 {
    let (column, row) = ((x - 0.5).floor(), (y - 0.5).floor());
    let (fx, fy) = (x - 0.5 - column, y - 0.5 - row);
    let at = |dx: i32, dy: i32| {
        f64::from(field.get(Cell::new(column as i32 + dx, row as i32 + dy))) / f64::from(FULL)
    };
    let below = at(0, 0) + fx * (at(1, 0) - at(0, 0));
    let above = at(0, 1) + fx * (at(1, 1) - at(0, 1));
    below + fy * (above - below)
}

fn cost(field: &LikelihoodField, places: &[[f64; 2]]) -> f64 {
    places.iter().map(|place| 1.0 - interpolated(field, *place)).map(|e| e * e).sum()
}

proptest! {
    #[test]
    fn the_score_kernel_equals_its_scalar_twin(
        centre in cells(),
        hits in vec((-110.0..110.0, -110.0..110.0), 0..400),
        points in points(),
        offset in offsets(),
    ) {
        let field = field(centre, &hits);
        let clear: Vec<bool> =
            places(&points, centre, offset).into_iter().map(|p| !on_a_line(p, 0.0)).collect();
        let points = keep(&points, &clear);
        let twin: Vec<u8> = places(&points, centre, offset)
            .into_iter()
            .map(|[x, y]| field.get(Cell::new(x.floor() as i32, y.floor() as i32)))
            .collect();

        let window = Window::around(&field, centre, WINDOW_RADIUS);
        let pose = pose_in(&window, centre, offset);
        let mut values = Vec::new();
        window.for_each_value(&points, pose, |value| values.push(value));
        prop_assert_eq!(&values, &twin);
        prop_assert_eq!(window.score(&points, pose), twin.iter().map(|v| u32::from(*v)).sum::<u32>());
    }

    #[test]
    fn the_gradient_is_that_of_the_cost(
        centre in cells(),
        hits in vec((-90.0..90.0, -90.0..90.0), 1..300),
        points in points(),
        offset in offsets(),
    ) {
        const STEP: f64 = 1e-6;
        let field = field(centre, &hits);
        let clear: Vec<bool> =
            places(&points, centre, offset).into_iter().map(|p| !on_a_line(p, 0.5)).collect();
        let points = keep(&points, &clear);
        let window = Window::around(&field, centre, WINDOW_RADIUS);
        let fit = window.linearize(&points, pose_in(&window, centre, offset));
        let cost_at = |offset| cost(&field, &places(&points, centre, offset));

        let size = points.len() as f64 + 1.0;
        prop_assert!((f64::from(fit.cost) - cost_at(offset)).abs() < 2e-4 * size);
        for (axis, arm) in [(0, 1.0), (1, 1.0), (2, 80.0)] {
            let moved = |by: f64| {
                let mut offset = offset;
                offset[axis] += by;
                cost_at(offset)
            };
            let slope = (moved(STEP) - moved(-STEP)) / (2.0 * STEP);
            // Gauss-Newton's right-hand side is minus half the derivative of the sum of squares.
            let expected = -0.5 * slope;
            let found = f64::from(fit.gradient[axis]);
            prop_assert!((found - expected).abs() < 2e-4 * size * arm, "{found} {expected}");
        }
    }
}

/// The cells that were seen, with their counts.
fn seen(map: &OccupancyMap) -> BTreeMap<Cell, Count> {
    known(map.counts())
}

/// The cells of which something is known, and what.
fn known<T: Copy + Default + PartialEq>(cells: &TileMap<T>) -> BTreeMap<Cell, T> {
    let size = TILE_SIZE as i32;
    let cells = cells.tiles().flat_map(|(key, tile)| {
        let first = key.first_cell();
        let cell = move |i: i32| Cell::new(first.ix + i % size, first.iy + i / size);
        (0..).zip(tile).map(move |(i, value)| (cell(i), *value))
    });
    cells.filter(|(_, value)| *value != T::default()).collect()
}

/// Beam ends all around, of any range and kind.
fn outlines() -> impl Strategy<Value = ScanOutline> {
    let kind = (0..6).prop_map(|kind| match kind {
        0 => BeamEndKind::Nothing,
        1 => BeamEndKind::Free,
        _ => BeamEndKind::Hit,
    });
    let beams = vec((0.15..6.0_f32, kind), 3..150);
    (beams, -0.3..0.3, -0.3..0.3, 1.0..7.0_f32).prop_map(|(beams, x, y, turn)| {
        let increment = turn / beams.len() as f32;
        let end = |(i, (range, kind)): (usize, (f32, BeamEndKind))| {
            let (sin, cos) = (i as f32 * increment).sin_cos();
            BeamEnd { point: [x as f32 + range * cos, y as f32 + range * sin], kind }
        };
        ScanOutline {
            sensor: Point2::new(x, y),
            ends: beams.into_iter().enumerate().map(end).collect(),
            angle_increment: f64::from(increment),
        }
    })
}

fn poses() -> impl Strategy<Value = Pose2> {
    (-50.0..50.0, -50.0..50.0, -3.1..3.1).prop_map(|(x, y, theta)| Pose2::new(x, y, theta))
}

proptest! {
    #[test]
    fn a_scan_counts_each_cell_once_and_an_obstacle_beats_free_space(
        scan in outlines(),
        pose in poses(),
    ) {
        let mut map = OccupancyMap::new(0.05);
        map.add(&scan, pose);
        let seen = seen(&map);
        let once = |count: &Count| count.visits == 1 && count.hits <= 1;
        prop_assert!(seen.values().all(once));
        let hits = scan.ends.iter().filter(|end| end.kind == BeamEndKind::Hit);
        for [x, y] in hits.map(|end| end.point.map(f64::from)) {
            let end = pose * Point2::new(x, y);
            if !on_a_line([end.x / 0.05, end.y / 0.05], 0.0) {
                let count = seen.get(&Cell::containing(end, 0.05));
                prop_assert_eq!(count, Some(&Count { hits: 1, visits: 1 }));
            }
        }
    }

    #[test]
    fn nothing_is_known_beyond_the_longest_beam_nor_of_beams_that_say_nothing(
        scan in outlines(),
        pose in poses(),
    ) {
        let mut map = OccupancyMap::new(0.05);
        map.add(&scan, pose);
        let sensor = pose * scan.sensor;
        let used = scan.ends.iter().filter(|end| end.kind != BeamEndKind::Nothing);
        let range = |end: &BeamEnd| {
            let [x, y] = end.point.map(f64::from);
            Point2::new(x - scan.sensor.x, y - scan.sensor.y).norm()
        };
        let longest = used.map(range).fold(0.0, f64::max);
        for cell in seen(&map).keys() {
            let [x, y] = [cell.ix, cell.iy].map(|i| (f64::from(i) + 0.5) * 0.05);
            let distance = Point2::new(x - sensor.x, y - sensor.y).norm();
            prop_assert!(distance < longest + 0.05, "{distance} m, {longest} m");
        }
    }

    #[test]
    fn taking_out_undoes_entering(a in outlines(), b in outlines(), p in poses(), q in poses()) {
        let mut map = OccupancyMap::new(0.05);
        map.add(&a, p);
        let before = seen(&map);
        map.add(&b, q);
        map.remove(&b, q);
        prop_assert_eq!(seen(&map), before);
    }
}

/// The triangles that beams know to be free, in cells of a metre: between two neighbours, as long as
/// the shorter of the two, and around a beam without neighbours, as wide as beams are apart. A full
/// turn has one between its last beam and its first.
fn wedges(scan: &ScanOutline, pose: Pose2) -> Vec<[Point2; 3]> {
    let count = scan.ends.len();
    let closes = (count as f64 + 0.5) * scan.angle_increment >= std::f64::consts::TAU;
    let pairs = (1..count).map(|i| (i - 1, i)).chain(closes.then_some((count - 1, 0)));
    let says = |i: &usize| scan.ends[*i].kind != BeamEndKind::Nothing;
    let sensor = scan.sensor;
    let arm = |i: usize| {
        let [x, y] = scan.ends[i].point.map(f64::from);
        Point2::new(x - sensor.x, y - sensor.y)
    };
    let pairs: Vec<(usize, usize)> =
        pairs.filter(|(a, b)| scan.angle_increment <= 0.6 && says(a) && says(b)).collect();
    let alone = (0..count).filter(says).filter(|i| pairs.iter().all(|(a, b)| i != a && i != b));
    let half_width = 0.5 * scan.angle_increment.min(0.04);
    let around = alone.map(|i| {
        let Point2 { x, y } = arm(i);
        let beside = |turn: f64| Point2::new(sensor.x + x - turn * y, sensor.y + y + turn * x);
        [sensor, beside(-half_width), beside(half_width)].map(|corner| pose * corner)
    });
    let between = pairs.iter().map(|&(a, b)| {
        let arms = [arm(a), arm(b)];
        let reach = arms[0].norm().min(arms[1].norm());
        let [a, b] = arms.map(|arm| {
            let share = reach / arm.norm();
            Point2::new(sensor.x + share * arm.x, sensor.y + share * arm.y)
        });
        [sensor, a, b].map(|corner| pose * corner)
    });
    between.chain(around).collect()
}

/// Whether a point is inside of the triangles: more turn left around it than right, or fewer, for
/// beams may overlap after a full turn. `None` so near an edge that rounding decides.
fn is_inside(triangles: &[[Point2; 3]], p: Point2) -> Option<bool> {
    let mut winding = 0;
    for &[a, b, c] in triangles {
        let left_of = |a: Point2, b: Point2| (b.x - a.x) * (p.y - a.y) - (b.y - a.y) * (p.x - a.x);
        let sides = [left_of(a, b), left_of(b, c), left_of(c, a)];
        if sides.iter().any(|side| side.abs() < 1e-6) {
            return None;
        }
        winding += i32::from(sides.iter().all(|side| *side > 0.0));
        winding -= i32::from(sides.iter().all(|side| *side < 0.0));
    }
    Some(winding != 0)
}

proptest! {
    #[test]
    fn a_cell_is_free_if_its_centre_is_between_two_beams(scan in outlines(), pose in poses()) {
        let mut map = OccupancyMap::new(1.0);
        // A cell of a metre is as good as one of a few centimetres, and quicker.
        let scan = ScanOutline {
            sensor: Point2::new(5.0 * scan.sensor.x, 5.0 * scan.sensor.y),
            ends: scan
                .ends
                .iter()
                .map(|end| BeamEnd { point: end.point.map(|v| 5.0 * v), ..*end })
                .collect(),
            ..scan
        };
        map.add(&scan, pose);
        let wedges = wedges(&scan, pose);
        let middle = Cell::containing(pose.position(), 1.0);
        for (dx, dy) in (-40..=40).flat_map(|dy| (-40..=40).map(move |dx| (dx, dy))) {
            let cell = Cell::new(middle.ix + dx, middle.iy + dy);
            let count = map.counts().get(cell);
            let centre = Point2::new(f64::from(cell.ix) + 0.5, f64::from(cell.iy) + 0.5);
            if let Some(inside) = is_inside(&wedges, centre).filter(|_| count.hits == 0) {
                prop_assert_eq!(count.visits == 1, inside, "{:?}", cell);
            }
        }
    }

    /// Each cell once a scan, an obstacle before free space; and whoever keeps the tiles is told.
    #[test]
    fn log_odds_add_up_what_the_counts_of_each_scan_say(
        scans in vec((outlines(), -1.0..1.0, -3.1..3.1), 1..5),
        near in poses(),
    ) {
        let [free, occupied] = [0.4, 0.9].map(LogOdds::of_probability);
        let (mut map, mut footprint) = (LogOddsMap::new(0.05), Footprint::default());
        let mut expected: BTreeMap<Cell, LogOdds> = BTreeMap::new();
        let mut touched = BTreeSet::new();
        for (scan, beside, turn) in &scans {
            let pose = near * Pose2::new(*beside, -*beside, *turn);
            let tiles = footprint.of(scan, pose, 0.05);
            map.add(tiles, Evidence { free, occupied });
            let told: BTreeSet<TileKey> = tiles.iter().map(|(tile, _)| *tile).collect();
            let mut counts = OccupancyMap::new(0.05);
            counts.add(scan, pose);
            let of_cells = seen(&counts).into_keys().map(TileKey::containing).collect();
            prop_assert_eq!(&told, &of_cells, "none is told of which nothing was seen");
            touched.extend(told);
            for (cell, count) in seen(&counts) {
                let value = expected.entry(cell).or_default();
                *value = value.and(if count.hits > 0 { occupied } else { free });
            }
        }
        expected.retain(|_, value| *value != LogOdds::default());
        let tiles: BTreeSet<TileKey> = expected.keys().map(|c| TileKey::containing(*c)).collect();
        prop_assert!(tiles.is_subset(&touched));
        prop_assert_eq!(known(map.cells()), expected);
    }
}

proptest! {
    /// An obstacle in one of four cells is one of all; free are they if two are that meet at the
    /// middle.
    #[test]
    fn coarse_cells_are_what_their_four_cells_are(scan in outlines(), pose in poses()) {
        let [free, occupied] = [0.4, 0.9].map(LogOdds::of_probability);
        let (mut coarse, mut footprint) = (LogOddsMap::new(0.1), Footprint::default());
        coarse.add(&halved(footprint.of(&scan, pose, 0.05)), Evidence { free, occupied });
        let mut counts = OccupancyMap::new(0.05);
        counts.add(&scan, pose);
        let fine = seen(&counts);
        let halves = fine.keys().map(|cell| Cell::new(cell.ix >> 1, cell.iy >> 1));
        let mut expected = BTreeMap::new();
        for cell in halves.collect::<BTreeSet<_>>() {
            let count = |dx, dy| fine.get(&Cell::new(2 * cell.ix + dx, 2 * cell.iy + dy));
            let is_hit = |dx, dy| count(dx, dy).is_some_and(|count| count.hits > 0);
            let is_free = |dx, dy| count(dx, dy).is_some_and(|count| count.hits == 0);
            if is_hit(0, 0) || is_hit(0, 1) || is_hit(1, 0) || is_hit(1, 1) {
                expected.insert(cell, occupied);
            } else if is_free(0, 0) && is_free(1, 1) || is_free(1, 0) && is_free(0, 1) {
                expected.insert(cell, free);
            }
        }
        prop_assert_eq!(known(coarse.cells()), expected);
    }
}

/// A scan of a laser at the origin, 1 degree from beam to beam, that begins straight ahead.
fn outline(beams: &[(f32, BeamEndKind)]) -> ScanOutline {
    let increment = 1.0_f32.to_radians();
    let end = |(i, (range, kind)): (usize, &(f32, BeamEndKind))| {
        let (sin, cos) = (i as f32 * increment).sin_cos();
        BeamEnd { point: [range * cos, range * sin], kind: *kind }
    };
    ScanOutline {
        sensor: Point2::default(),
        ends: beams.iter().enumerate().map(end).collect(),
        angle_increment: f64::from(increment),
    }
}

fn count_at(map: &OccupancyMap, range: f64, degrees: f64) -> Count {
    let (sin, cos) = libm::sincos(degrees.to_radians());
    map.counts().get(Cell::containing(Point2::new(range * cos, range * sin), 0.05))
}

#[test]
fn cells_hidden_behind_a_depth_jump_stay_unknown() {
    let mut map = OccupancyMap::new(0.05);
    let beams: Vec<_> =
        (0..40).map(|i| (if i < 20 { 6.0 } else { 2.0 }, BeamEndKind::Hit)).collect();
    map.add(&outline(&beams), Pose2::IDENTITY);
    let free = Count { hits: 0, visits: 1 };
    // The beam at 19 degrees is the last long one, that at 20 degrees the first short one.
    assert_eq!(count_at(&map, 4.0, 18.5), free);
    assert_eq!(count_at(&map, 1.8, 19.5), free);
    assert_eq!(count_at(&map, 4.0, 19.7), Count::default());
    assert_eq!(count_at(&map, 4.0, 30.0), Count::default());
}

#[test]
fn beams_that_say_nothing_leave_a_gap() {
    let kind = |i: usize| if i == 20 { BeamEndKind::Nothing } else { BeamEndKind::Hit };
    let beams: Vec<_> = (0..40).map(|i| (6.0, kind(i))).collect();
    let mut map = OccupancyMap::new(0.05);
    map.add(&outline(&beams), Pose2::IDENTITY);
    assert_eq!(count_at(&map, 5.0, 18.5), Count { hits: 0, visits: 1 });
    assert_eq!(count_at(&map, 5.0, 20.0), Count::default());
}

#[test]
fn no_returns_are_free_space_only_where_that_is_asked_for() {
    let lidar = full_circle(360);
    let mut shot = shots(&room(Point2::default()), &lidar, &[Pose2::new(5.0, 3.0, 0.0)]).remove(0);
    // A stretch of no returns ahead; maxUrange is 2 m, and so the room ends nowhere.
    shot.scan.ranges[170..190].fill(f32::INFINITY);
    for free_on_no_return in [false, true] {
        let mut parameters = Parameters { max_usable_range: Some(2.5), ..parameters() };
        parameters.map.free_on_no_return = free_on_no_return;
        let mut filter = filter(&parameters);
        add(&mut filter, &lidar, &shot);
        let cell =
            |x, y| filter.occupancy().counts().get(Cell::containing(Point2::new(x, y), 0.05));
        let free = Count { hits: 0, visits: 1 };
        let expected = if free_on_no_return { free } else { Count::default() };
        assert_eq!(cell(7.4, 3.0), expected);
        assert_eq!(cell(7.6, 3.0), Count::default());
        // A wall beyond maxUrange makes free space up to there, asked for or not.
        assert_eq!(cell(2.6, 3.0), free);
        assert_eq!(cell(2.4, 3.0), Count::default());
    }
}

/// The columns of a row that are occupied, as the world's x of their lower-left corners.
fn occupied_in_row(grid: &OccupancyGrid, y: f64) -> Vec<f64> {
    let row = ((y - grid.origin.y) / grid.resolution).floor() as usize;
    let cells = &grid.cells[row * grid.width..(row + 1) * grid.width];
    let corner = |column: usize| grid.origin.x + column as f64 * grid.resolution;
    (0..).zip(cells).filter(|(_, v)| **v == 100).map(|(column, _)| corner(column)).collect()
}

/// The original published the centre of the first cell as its corner: all was half a cell off.
#[test]
fn a_wall_is_in_the_cell_that_covers_it_without_half_a_cell_of_shift() {
    for wall in [3.01, 3.025, 3.049, -2.501, -2.549] {
        let ends = [Point2::new(wall, -4.0), Point2::new(wall, 4.0)];
        let world = World::new(vec![Segment::new(ends[0], ends[1])], vec![]);
        let lidar = full_circle(720);
        let mut filter = filter(&parameters());
        add(&mut filter, &lidar, &shots(&world, &lidar, &[Pose2::IDENTITY])[0]);
        let grid = filter.occupancy_grid().expect("a scan was processed");
        let occupied = occupied_in_row(&grid, 0.026);
        assert_eq!(occupied.len(), 1, "{wall}: {occupied:?}");
        let corner = occupied[0];
        assert!(corner <= wall && wall < corner + 0.05, "{wall} is not in the cell at {corner}");
    }
}

/// A minute through a building with noise everywhere.
fn noisy_run(seed: u64) -> Simulation {
    let lidar = Lidar::full_circle(180).expect("two beams or more");
    Simulation::through(&building(seed, 20.0), 1, lidar, seed)
}

#[test]
fn the_incremental_map_equals_the_map_rebuilt_from_the_trajectory() {
    let gate = MotionGate { linear_update: 0.3, angular_update: 0.3, ..MotionGate::default() };
    let mut parameters = Parameters { gate, ..Parameters::default() };
    parameters.weighting.resample_threshold = 0.9;
    parameters.weighting.flatness = 1.0;
    let mut filter = filter(&parameters);
    let (mut outlines, mut resampled, mut rewritten) = (Vec::new(), 0, 0);
    let mut before = Path::default();
    for reading in noisy_run(5).readings().take(900) {
        let reading = ScanReading {
            scan: &reading.scan,
            mount: &LaserMount::default(),
            odom_from_base: reading.odom_from_base,
        };
        let ScanUpdate::Processed(report) = filter.add_scan(&reading, &mut |_| ()) else {
            continue;
        };
        outlines.push(PreparedScan::new(&reading, &parameters).outline);
        resampled += usize::from(report.resampled);
        let path = filter.path();
        rewritten += usize::from(path.iter().zip(before.iter()).any(|(now, then)| now != then));
        if outlines.len().is_multiple_of(20) {
            let mut anew = OccupancyMap::new(parameters.resolution);
            outlines.iter().zip(path.iter()).for_each(|(scan, (_, pose))| anew.add(scan, pose));
            assert_eq!(seen(filter.occupancy()), seen(&anew), "after {} scans", outlines.len());
        }
        before = path;
    }
    assert!(outlines.len() > 100 && resampled > 1 && rewritten > 1, "{resampled} {rewritten}");
}

#[test]
fn the_field_matcher_agrees_with_the_original_matcher() {
    let parameters = Parameters::default();
    let resolution = parameters.resolution;
    let field_matcher = FieldMatcher::new(MatcherParameters::default(), resolution);
    let compat_matcher = CompatMatcher::new(MatcherParameters::default(), resolution);
    let (mut field, mut hits) = (LikelihoodField::new(), HitMap::new());
    let (mut distance, mut angle, mut matched) = (0.0, 0.0, 0.0);
    // Every fifth reading: 0.4 m of way.
    for (index, reading) in noisy_run(6).readings().step_by(5).take(120).enumerate() {
        let truth = reading.world_from_base;
        let scan = ScanReading {
            scan: &reading.scan,
            mount: &LaserMount::default(),
            odom_from_base: truth,
        };
        let scan = PreparedScan::new(&scan, &parameters);
        if index > 0 {
            // Starts are off by a few centimetres and degrees, each in a direction of its own.
            let (sin, cos) = libm::sincos(index as f64);
            let start = truth * Pose2::new(0.06 * cos, 0.06 * sin, 0.04 * sin);
            let a = field_matcher.run(&field, &scan, start).pose_in_map;
            let b = compat_matcher.run(&hits, &scan, start).pose_in_map;
            let difference = a.between(b);
            distance += difference.position().norm();
            angle += difference.theta.abs();
            matched += 1.0;
        }
        field_matcher.register(&mut field, &scan, truth);
        compat_matcher.register(&mut hits, &scan, truth);
    }
    let (distance, angle) = (distance / matched, angle / matched);
    assert!(distance < 0.015 && angle < 0.004, "{distance} m, {angle} rad on average");
}

/// Standard deviations of the particles after an arc, with `per_metre` odometry readings a metre.
fn spread(per_metre: u32) -> [f64; 3] {
    let lidar = full_circle(90);
    let mut parameters = Parameters { particles: 1000, ..parameters() };
    // No match counts, so particles go where the motion model puts them.
    parameters.matcher.minimum_score = f64::INFINITY;
    let mut filter: GMapping = filter(&parameters);
    let (start, radius) = (route(Point2::default())[0], 4.0);
    let at = |way: f64| {
        let angle: f64 = way / radius;
        let (sin, cos) = libm::sincos(angle);
        start * Pose2::new(radius * sin, radius * (1.0 - cos), angle)
    };
    let ends = shots(&room(Point2::default()), &lidar, &[at(0.0), at(3.0)]);
    add(&mut filter, &lidar, &ends[0]);
    for step in 1..3 * per_metre {
        filter.add_odometry(at(f64::from(step) / f64::from(per_metre)));
    }
    let update = add(&mut filter, &lidar, &ends[1]);
    assert!(matches!(update, ScanUpdate::Processed(report) if report.matched == 0));
    let errors: Vec<Pose2> =
        filter.particles().iter().map(|p| at(3.0).between(p.pose_in_map())).collect();
    let deviation = |of: fn(&Pose2) -> f64| {
        (errors.iter().map(|e| of(e) * of(e)).sum::<f64>() / errors.len() as f64).sqrt()
    };
    [deviation(|e| e.x), deviation(|e| e.y), deviation(|e| e.theta)]
}

#[test]
fn the_spread_of_particles_does_not_depend_on_the_rate_of_odometry() {
    let (slow, fast) = (spread(5), spread(50));
    assert!(slow.iter().all(|deviation| *deviation > 0.005), "{slow:?}");
    for (slow, fast) in slow.iter().zip(fast) {
        assert!((slow / fast - 1.0).abs() < 0.03, "{slow} {fast}");
    }
}
