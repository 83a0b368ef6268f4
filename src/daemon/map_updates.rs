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

/// Publishes the rectangle of cells that a version changes.
///
/// A rectangle is placed in the last map by numbers of cells, so it says nothing where the map has
/// grown: then `map` alone is published, and the next rectangle is one of that map.
#[derive(Debug)]
pub(super) struct UpdatesOutput {
    pub(super) publisher: Arc<Publisher<'static>>,
    pub(super) signature: Signature,
    pub(super) products: Arc<ProductCache>,
    pub(super) map_frame: String,
    /// Between two maps at least.
    pub(super) interval: Duration,
}

impl UpdatesOutput {
    pub(super) async fn run(self, mut snapshots: watch::Receiver<Arc<Snapshot>>) {
        let mut last: Option<Arc<MapProducts>> = None;
        snapshots.mark_changed();
        while snapshots.changed().await.is_ok() {
            let snapshot = snapshots.borrow_and_update().clone();
            let version = snapshot.map.as_ref().map(|map| map.version);
            let known = last.as_ref().map(|products| products.version());
            if version.is_none() || version == known {
                continue;
            }
            if self.is_wanted().await {
                let newest = self.products.of(snapshot.map.as_ref());
                if let Some(before) = last.replace(newest.clone()) {
                    self.put(before, newest).await;
                }
            } else {
                last = None;
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
    use crate::slam::pose::Point2;

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
