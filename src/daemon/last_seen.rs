//! When each cell was seen last, told from one version of the map to the next.

use std::sync::Arc;

use super::snapshot::MapVersion;
use crate::map::region::LastSeen;

/// The newest version, and when its cells were seen.
///
/// A cell is seen with a version if its counts are others than in the version before. So stamps
/// are as fine as versions are, and where the whole map was corrected, cells that moved count as
/// seen then. Hector's cells have no counts: theirs are the stamps at which they became free or
/// occupied.
#[derive(Debug, Default)]
pub(super) struct Sightings {
    map: Option<Arc<MapVersion>>,
    seen: LastSeen,
}

impl Sightings {
    /// Takes the newest version, or that there is none any more; looks at those tiles only that
    /// were written since the last one.
    pub(super) fn update(&mut self, map: Option<&Arc<MapVersion>>) -> LastSeen {
        match map {
            Some(map) if self.map.as_ref().is_none_or(|newest| newest.version < map.version) => {
                self.see(map);
            }
            Some(_) => {}
            None => *self = Self::default(),
        }
        self.seen.clone()
    }

    fn see(&mut self, map: &Arc<MapVersion>) {
        let counts = map.occupancy.counts();
        let before = self.map.as_ref().map(|map| map.occupancy.counts());
        let touched = before.map_or_else(
            || counts.tiles().map(|(key, _)| key).collect(),
            |before| counts.tiles_not_shared_with(before),
        );
        // From 1, for 0 is never.
        let seconds = u32::try_from(map.stamp.0.div_euclid(1_000_000_000)).unwrap_or(0);
        for key in touched {
            let [now, then] = [Some(counts), before].map(|counts| counts?.tile(key));
            for (i, seen) in self.seen.tile_mut(key).iter_mut().enumerate() {
                let [now, then] = [now, then].map(|tile| tile.map(|tile| tile[i]));
                match now.filter(|count| count.visits > 0) {
                    // Forgotten, or moved away.
                    None => *seen = 0,
                    Some(_) if now != then => *seen = seconds.saturating_add(1),
                    Some(_) => {}
                }
            }
        }
        self.map = Some(map.clone());
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::grid::Cell;
    use crate::slam::grid::occupancy::{
        BeamEnd, BeamEndKind, OccupancyMap, OccupiedThreshold, ScanOutline,
    };
    use crate::slam::path::Path;
    use crate::slam::pose::{Point2, Pose2, Stamp};

    fn version(number: u64, occupancy: &OccupancyMap) -> Arc<MapVersion> {
        Arc::new(MapVersion {
            version: number,
            epoch: 1,
            stamp: Stamp(number as i64 * 10_000_000_000),
            occupancy: occupancy.clone(),
            occupied_threshold: OccupiedThreshold::of_share(0.25),
            path: Path::default(),
        })
    }

    #[test]
    fn what_a_scan_sees_was_seen_then_and_the_rest_before() {
        let mut map = OccupancyMap::new(0.1);
        // From right before the wall, so that no other cell is seen.
        let mut look = |x: f32| {
            let end = BeamEnd { point: [x, 0.05], kind: BeamEndKind::Hit };
            let sensor = Point2::new(f64::from(x) - 0.01, 0.05);
            let outline = ScanOutline { sensor, ends: vec![end], angle_increment: 0.05 };
            map.add(&outline, Pose2::IDENTITY);
            map.clone()
        };
        let mut sightings = Sightings::default();
        let seen = |seen: &LastSeen| [10, 4, 20].map(|ix| seen.get(Cell::new(ix, 0)));
        let first = sightings.update(Some(&version(1, &look(1.05))));
        assert_eq!(seen(&first), [11, 0, 0]);
        let second = sightings.update(Some(&version(2, &look(0.45))));
        assert_eq!(seen(&second), [11, 21, 0]);
        let third = sightings.update(Some(&version(3, &look(2.05))));
        assert_eq!(seen(&third), [11, 21, 31]);
        assert_eq!(seen(&first), [11, 0, 0], "what was handed out stays");
        assert_eq!(seen(&sightings.update(None)), [0; 3]);
    }
}
