//! What a version of the map changes, as the static layer of nav2 takes it.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::watch;
use tokio::task::spawn_blocking;
use zenoh::Wait as _;
use zenoh::pubsub::Publisher;

use super::formats::{MapProducts, ProductCache};
use super::ros_node::Signature;
use super::snapshot::Snapshot;
use crate::ros;
use crate::slam::grid::occupancy::OccupancyGrid;

/// The map that was put as a whole last; `None` while nobody takes it.
pub(super) type LastPut = watch::Sender<Option<Arc<MapProducts>>>;

/// Publishes the rectangle of cells that differ from the last map that was put as a whole.
///
/// A rectangle is placed in the last map by numbers of cells, so it says nothing where the map has
/// grown: then `map` alone is published, and the next rectangle is one of that map.
#[derive(Debug)]
pub(super) struct UpdatesOutput {
    pub(super) publisher: Arc<Publisher<'static>>,
    pub(super) signature: Signature,
    pub(super) products: Arc<ProductCache>,
    pub(super) last_put: watch::Receiver<Option<Arc<MapProducts>>>,
    pub(super) map_frame: String,
    /// Between two maps at least.
    pub(super) interval: Duration,
}

impl UpdatesOutput {
    pub(super) async fn run(self, mut snapshots: watch::Receiver<Arc<Snapshot>>) {
        let (mut base, mut told) = (Base::default(), 0);
        snapshots.mark_changed();
        while snapshots.changed().await.is_ok() {
            let snapshot = snapshots.borrow_and_update().clone();
            let Some(newest) = snapshot.map.as_ref().filter(|map| map.version != told) else {
                continue;
            };
            told = newest.version;
            if self.is_wanted().await {
                let newest = self.products.of(Some(newest));
                let put = self.last_put.borrow().clone();
                if let Some(before) = base.before(put, &newest) {
                    self.put(before, newest).await;
                }
            } else {
                base = Base::default();
            }
            tokio::time::sleep(self.interval).await;
        }
    }

    async fn is_wanted(&self) -> bool {
        self.publisher.matching_status().await.is_ok_and(|status| status.matching())
    }

    async fn put(&self, before: Arc<MapProducts>, newest: Arc<MapProducts>) {
        let (publisher, signature) = (self.publisher.clone(), self.signature.clone());
        let frame = self.map_frame.clone();
        let put = move || {
            let Some(mut update) = update(before.grid(), newest.grid()) else { return };
            let stamp = newest.metadata().map_load_time;
            update.header = ros::Header { stamp, frame_id: frame };
            let put = publisher.put(ros::cdr(&update)).attachment(signature.next());
            if let Err(error) = put.wait() {
                tracing::debug!(output = "map_updates", %error, "not published");
            }
        };
        spawn_blocking(put).await.ok();
    }
}

/// What a rectangle is told beside.
///
/// A rectangle may be dropped on its way, so the next one holds its cells as well: both differ from
/// the same whole map. Where none was put, there is only the version before.
#[derive(Debug, Default)]
struct Base {
    whole: Option<Arc<MapProducts>>,
    last: Option<Arc<MapProducts>>,
}

impl Base {
    /// The map that the newest one is to be told beside; `None` for the first.
    fn before(
        &mut self,
        put: Option<Arc<MapProducts>>,
        newest: &Arc<MapProducts>,
    ) -> Option<Arc<MapProducts>> {
        match put {
            // The newest itself may have been put already: its rectangle is the same.
            Some(put) if put.version() < newest.version() => self.whole = Some(put),
            Some(_) => {}
            None => self.whole = None,
        }
        let last = self.last.replace(newest.clone());
        self.whole.clone().or(last)
    }
}

/// The smallest rectangle with all cells that differ; `None` where none does, and where the two
/// maps do not lie on each other.
fn update(before: &OccupancyGrid, now: &OccupancyGrid) -> Option<ros::OccupancyGridUpdate> {
    let place = |grid: &OccupancyGrid| (grid.width, grid.height, grid.origin, grid.resolution);
    if place(before) != place(now) || now.width == 0 {
        return None;
    }
    let rows = before.cells.chunks_exact(now.width).zip(now.cells.chunks_exact(now.width));
    let mut found: Option<[usize; 4]> = None;
    for (y, (before, now)) in rows.enumerate().filter(|(_, (before, now))| before != now) {
        let differs = || before.iter().zip(now).map(|(a, b)| a != b);
        let first = differs().position(|differs| differs)?;
        let last = differs().rposition(|differs| differs)?;
        let [left, right, bottom, _] = found.unwrap_or([first, last, y, y]);
        found = Some([left.min(first), right.max(last), bottom, y]);
    }
    let [left, right, bottom, top] = found?;
    let rows = now.cells.chunks_exact(now.width).take(top + 1).skip(bottom);
    let cells: Vec<i8> = rows.flat_map(|row| &row[left..=right]).copied().collect();
    Some(ros::OccupancyGridUpdate {
        header: ros::Header::default(),
        x: left as i32,
        y: bottom as i32,
        width: (right - left + 1) as u32,
        height: (top - bottom + 1) as u32,
        data: ros::Int8Array::from(cells.as_slice()),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::daemon::formats::EmptyMap;
    use crate::daemon::snapshot::MapVersion;
    use crate::slam::grid::occupancy::{
        BeamEnd, BeamEndKind, OccupancyMap, OccupiedThreshold, ScanOutline,
    };
    use crate::slam::path::Path;
    use crate::slam::pose::{Point2, Pose2, Stamp};

    /// A version in which a robot in a room of walls of 4 m saw an obstacle at these places.
    fn products(number: u64, places: &[f32]) -> Arc<MapProducts> {
        let mut occupancy = OccupancyMap::new(0.1);
        let mut see = |points: Vec<[f32; 2]>| {
            let ends = points.into_iter().map(|point| BeamEnd { point, kind: BeamEndKind::Hit });
            let sensor = Point2::new(0.0, 0.0);
            let outline = ScanOutline { sensor, ends: ends.collect(), angle_increment: 0.05 };
            occupancy.add(&outline, Pose2::IDENTITY);
        };
        see((0..60).map(|i| (i as f32 * 0.1).sin_cos()).map(|(s, c)| [4.0 * c, 4.0 * s]).collect());
        see(places.iter().map(|x| [*x, 0.05]).collect());
        let version = MapVersion {
            version: number,
            epoch: 1,
            stamp: Stamp(1),
            occupancy,
            occupied_threshold: OccupiedThreshold::of_share(0.25),
            path: Path::default(),
        };
        let empty = EmptyMap { frame: "map".to_owned(), resolution: 0.1 };
        Arc::new(MapProducts::new(Some(Arc::new(version)), empty))
    }

    /// What somebody has who gets a rectangle.
    fn updated(map: &OccupancyGrid, update: &ros::OccupancyGridUpdate) -> OccupancyGrid {
        let mut map = map.clone();
        let cells = serde_json::to_value(&update.data).and_then(serde_json::from_value::<Vec<i8>>);
        let cells = cells.unwrap();
        for (row, cells) in (update.y as usize..).zip(cells.chunks_exact(update.width as usize)) {
            let start = row * map.width + update.x as usize;
            map.cells[start..start + cells.len()].copy_from_slice(cells);
        }
        map
    }

    #[test]
    fn a_rectangle_that_was_dropped_is_in_the_next_one() {
        let versions: Vec<_> = [&[1.05][..], &[1.05, 2.05], &[1.05, 2.05, 3.05]]
            .into_iter()
            .zip(1..)
            .map(|(places, number)| products(number, places))
            .collect();
        let mut base = Base::default();
        let put = Some(versions[0].clone());
        assert!(base.before(put.clone(), &versions[0]).is_none());
        let dropped = base.before(put.clone(), &versions[1]).unwrap();
        assert!(update(dropped.grid(), versions[1].grid()).is_some());
        let before = base.before(put, &versions[2]).unwrap();
        let next = update(before.grid(), versions[2].grid()).unwrap();
        assert_eq!(updated(versions[0].grid(), &next), *versions[2].grid());
        // Who has the newest already keeps it.
        assert_eq!(updated(versions[2].grid(), &next), *versions[2].grid());
    }

    #[test]
    fn without_whole_maps_rectangles_are_told_beside_the_version_before() {
        let versions = [1, 2, 3].map(|number| products(number, &[number as f32]));
        let mut base = Base::default();
        assert!(base.before(None, &versions[0]).is_none());
        assert_eq!(base.before(None, &versions[1]).unwrap().version(), 1);
        let put = Some(versions[1].clone());
        assert_eq!(base.before(put, &versions[2]).unwrap().version(), 2);
        assert_eq!(base.before(None, &products(4, &[])).unwrap().version(), 3);
    }

    fn grid(cells: [i8; 12]) -> OccupancyGrid {
        let origin = Point2::new(-1.0, 2.0);
        OccupancyGrid { resolution: 0.5, width: 4, height: 3, origin, cells: cells.to_vec() }
    }

    #[test]
    fn the_rectangle_holds_all_that_changed_and_no_more() {
        let before = grid([0; 12]);
        let now = grid([0, 0, 0, 0, 0, 0, 100, 0, 0, -1, 0, 0]);
        let update = update(&before, &now).unwrap();
        assert_eq!((update.x, update.y, update.width, update.height), (1, 1, 2, 2));
        assert_eq!(update.data, ros::Int8Array::from([0, 100, -1, 0].as_slice()));
    }

    #[test]
    fn nothing_is_told_of_equal_maps_and_of_those_that_grew() {
        let before = grid([0; 12]);
        assert_eq!(update(&before, &before), None);
        let moved = OccupancyGrid { origin: Point2::new(-1.5, 2.0), ..grid([100; 12]) };
        assert_eq!(update(&before, &moved), None);
        let turned = OccupancyGrid { width: 3, height: 4, ..grid([100; 12]) };
        assert_eq!(update(&before, &turned), None);
    }
}
