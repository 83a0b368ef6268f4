//! The occupancy map of the best particle, kept up to date by what differs.

use std::collections::VecDeque;
use std::sync::Arc;

use super::super::grid::occupancy::{OccupancyMap, ScanOutline};
use super::trajectory::{NodeId, TrajectoryTree};

/// The occupancy map along the trajectory that ends at one node of the tree.
///
/// Moving to another trajectory takes out the scans since the common ancestor and enters those of
/// the other branch; the original replays all scans of the run.
#[derive(Debug, Clone)]
pub struct OutputMap {
    pub(super) map: OccupancyMap,
    /// Held in the tree.
    pub(super) node: Option<NodeId>,
    /// Scans that particles may still place differently; the first belongs to `first_depth`.
    pub(super) scans: VecDeque<Arc<ScanOutline>>,
    pub(super) first_depth: u32,
    pub(super) corrections: u64,
}

impl OutputMap {
    /// An empty map of cells of `resolution` metres.
    #[must_use]
    pub fn new(resolution: f64) -> Self {
        let map = OccupancyMap::new(resolution);
        Self { map, node: None, scans: VecDeque::new(), first_depth: 0, corrections: 0 }
    }

    /// The map.
    #[must_use]
    pub const fn map(&self) -> &OccupancyMap {
        &self.map
    }

    /// How often scans in the map were placed anew.
    #[must_use]
    pub const fn corrections(&self) -> u64 {
        self.corrections
    }

    /// Adds the scan of the tree's newest depth and moves to the trajectory that ends at `node`.
    pub fn extend(&mut self, tree: &mut TrajectoryTree, node: NodeId, scan: ScanOutline) {
        self.scans.push_back(Arc::new(scan));
        let shared = self.node.and_then(|old| tree.common_ancestor(old, node));
        self.corrections += u64::from(shared != self.node);
        let until_shared = |from| tree.ancestry(from).take_while(move |id| Some(*id) != shared);
        for id in self.node.into_iter().flat_map(until_shared) {
            let scan = &self.scans[(tree.depth(id) - self.first_depth) as usize];
            self.map.remove(scan, tree.pose(id));
        }
        for id in until_shared(node) {
            let scan = &self.scans[(tree.depth(id) - self.first_depth) as usize];
            self.map.add(scan, tree.pose(id));
        }
        tree.hold(node);
        if let Some(old) = self.node.replace(node) {
            tree.release(old);
        }
    }

    /// Forgets the scans up to `depth`: no trajectory will place them otherwise.
    pub fn forget(&mut self, depth: u32) {
        while self.first_depth <= depth {
            self.scans.pop_front();
            self.first_depth += 1;
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::{any, prop_assert_eq, proptest};

    use super::super::super::grid::Cell;
    use super::super::super::grid::occupancy::{BeamEnd, BeamEndKind, Count};
    use super::super::super::grid::tile_map::TILE_SIZE;
    use super::super::super::pose::{Point2, Pose2};
    use super::*;

    fn scan(range: f32) -> ScanOutline {
        let ends = (0..24).map(|i| {
            let (sin, cos) = (i as f32 * 0.2).sin_cos();
            let kind = match i % 7 {
                0 => BeamEndKind::Free,
                1 => BeamEndKind::Nothing,
                _ => BeamEndKind::Hit,
            };
            BeamEnd { point: [range * cos, range * sin], kind }
        });
        ScanOutline { sensor: Point2::new(0.1, -0.05), ends: ends.collect(), angle_increment: 0.2 }
    }

    const SIZE: i32 = TILE_SIZE as i32;

    fn seen(map: &OccupancyMap) -> Vec<(Cell, Count)> {
        let tiles = map.counts().tiles();
        let cells = tiles.flat_map(|(key, tile)| {
            tile.iter().enumerate().map(move |(i, count)| {
                let first = key.first_cell();
                (Cell::new(first.ix + i as i32 % SIZE, first.iy + i as i32 / SIZE), *count)
            })
        });
        let mut cells: Vec<_> = cells.filter(|(_, c)| *c != Count::default()).collect();
        cells.sort_unstable_by_key(|(cell, _)| *cell);
        cells
    }

    proptest! {
        /// Branches grow, die and take turns at being the best, as particles do.
        #[test]
        fn following_branches_equals_building_anew(
            steps in proptest::collection::vec((0..3_usize, 0..3_usize, any::<bool>()), 1..25),
        ) {
            let mut tree = TrajectoryTree::default();
            let mut output = OutputMap::new(0.1);
            let mut leaves = [None; 3];
            let mut scans = Vec::new();
            for (i, (best, ancestor, resample)) in steps.into_iter().enumerate() {
                let parents = if resample { [leaves[ancestor]; 3] } else { leaves };
                let grown = [0, 1, 2].map(|k| {
                    let pose = Pose2::new(i as f64 * 0.37, k as f64 * 0.51, (i + k) as f64 * 0.3);
                    tree.append(parents[k], pose)
                });
                leaves.into_iter().flatten().for_each(|old| tree.release(old));
                leaves = grown.map(Some);
                scans.push(scan(1.0 + i as f32 * 0.1));
                output.extend(&mut tree, grown[best], scans[i].clone());
                let shared = grown[1..]
                    .iter()
                    .try_fold(grown[0], |shared, leaf| tree.common_ancestor(shared, *leaf));
                if let Some(shared) = shared {
                    output.forget(tree.depth(shared));
                }

                let mut anew = OccupancyMap::new(0.1);
                for id in tree.ancestry(grown[best]) {
                    anew.add(&scans[tree.depth(id) as usize], tree.pose(id));
                }
                prop_assert_eq!(seen(output.map()), seen(&anew));
            }
        }
    }

    #[test]
    fn another_branch_is_a_correction_and_the_next_scan_is_none() {
        let mut tree = TrajectoryTree::default();
        let mut output = OutputMap::new(0.1);
        let mut grow = |output: &mut OutputMap, parents: [Option<NodeId>; 2], best: usize| {
            let leaves = parents.map(|parent| tree.append(parent, Pose2::IDENTITY));
            output.extend(&mut tree, leaves[best], scan(1.0));
            (leaves.map(Some), output.corrections())
        };
        let (first, corrections) = grow(&mut output, [None, None], 0);
        assert_eq!(corrections, 0);
        let (second, corrections) = grow(&mut output, first, 0);
        assert_eq!(corrections, 0);
        let (third, corrections) = grow(&mut output, second, 1);
        assert_eq!(corrections, 1);
        assert_eq!(grow(&mut output, third, 1).1, 1);
    }

    #[test]
    fn settled_scans_are_forgotten() {
        let mut tree = TrajectoryTree::default();
        let mut output = OutputMap::new(0.1);
        let mut leaf = None;
        for _ in 0..10 {
            let node = tree.append(leaf, Pose2::IDENTITY);
            output.extend(&mut tree, node, scan(1.0));
            leaf = Some(node);
        }
        assert_eq!(output.scans.len(), 10);
        output.forget(7);
        assert_eq!(output.scans.len(), 2);
    }
}
