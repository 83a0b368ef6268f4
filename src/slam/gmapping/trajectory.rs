//! The tree of the particles' trajectories: a node a pose, shared by all that descend from it.

use serde::{Deserialize, Serialize};

use super::super::pose::Pose2;
use super::super::state::{StateError, ensure, ensure_poses};

/// Names a node of a [`TrajectoryTree`].
pub type NodeId = u32;

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Node {
    pose_in_map: Pose2,
    parent: Option<NodeId>,
    /// Nodes since the root.
    depth: u32,
    /// Children and holders outside the tree.
    references: u32,
}

/// Trajectories that share their beginnings.
///
/// Nodes nobody refers to any more are reused, so the tree holds the trajectories of the living
/// particles and no others.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct TrajectoryTree {
    nodes: Vec<Node>,
    unused: Vec<NodeId>,
}

impl TrajectoryTree {
    /// Adds a pose after `parent` and returns its node, which the caller holds.
    pub fn append(&mut self, parent: Option<NodeId>, pose_in_map: Pose2) -> NodeId {
        let depth = parent.map_or(0, |id| self.nodes[id as usize].depth + 1);
        if let Some(id) = parent {
            self.nodes[id as usize].references += 1;
        }
        let node = Node { pose_in_map, parent, depth, references: 1 };
        if let Some(id) = self.unused.pop() {
            self.nodes[id as usize] = node;
            return id;
        }
        self.nodes.push(node);
        (self.nodes.len() - 1) as NodeId
    }

    /// Holds a node once more.
    pub fn hold(&mut self, id: NodeId) {
        self.nodes[id as usize].references += 1;
    }

    /// Lets go of a node; it and its ancestors disappear as far as nobody else refers to them.
    pub fn release(&mut self, id: NodeId) {
        let mut next = Some(id);
        while let Some(id) = next {
            let node = &mut self.nodes[id as usize];
            node.references -= 1;
            if node.references > 0 {
                return;
            }
            next = node.parent;
            self.unused.push(id);
        }
    }

    /// The pose at a node.
    #[must_use]
    pub fn pose(&self, id: NodeId) -> Pose2 {
        self.nodes[id as usize].pose_in_map
    }

    /// How many poses come before the node's.
    #[must_use]
    pub fn depth(&self, id: NodeId) -> u32 {
        self.nodes[id as usize].depth
    }

    /// The node and its ancestors, newest first.
    pub fn ancestry(&self, id: NodeId) -> impl Iterator<Item = NodeId> {
        std::iter::successors(Some(id), |id| self.nodes[*id as usize].parent)
    }

    /// The newest node that both trajectories pass; `None` if they have different roots.
    #[must_use]
    pub fn common_ancestor(&self, a: NodeId, b: NodeId) -> Option<NodeId> {
        let (mut a, mut b) = (a, b);
        while a != b {
            let (node_a, node_b) = (&self.nodes[a as usize], &self.nodes[b as usize]);
            if node_a.depth >= node_b.depth {
                a = node_a.parent?;
            } else {
                b = node_b.parent?;
            }
        }
        Some(a)
    }

    /// The node's ancestor at `depth`; itself, if it is not that deep or has no such ancestor.
    #[must_use]
    pub fn ancestor_at(&self, id: NodeId, depth: u32) -> NodeId {
        self.ancestry(id).find(|id| self.depth(*id) <= depth).unwrap_or(id)
    }

    /// Makes a node the root: its ancestors disappear.
    pub fn cut_above(&mut self, id: NodeId) {
        if let Some(parent) = self.nodes[id as usize].parent.take() {
            self.release(parent);
        }
    }

    /// Looks whether the tree can be gone on with by those who hold nodes of it; returns the depth of
    /// its only root and of its deepest node, or `None` if no node is in use.
    ///
    /// # Errors
    /// When a node or a reference leads to nothing or in a ring, or is counted wrongly.
    pub(super) fn check(&self, holders: &[NodeId]) -> Result<Option<(u32, u32)>, StateError> {
        let parts = "trajectories";
        let mut used = vec![true; self.nodes.len()];
        for id in &self.unused {
            let slot = used.get_mut(*id as usize).ok_or(StateError::Unsound(parts))?;
            ensure(std::mem::take(slot), parts)?;
        }
        let is_used = |id: NodeId| used.get(id as usize).copied().unwrap_or(false);
        let mut references = vec![0_u32; self.nodes.len()];
        let living = || self.nodes.iter().zip(&used).filter(|(_, used)| **used).map(|(n, _)| n);
        for id in living().filter_map(|node| node.parent).chain(holders.iter().copied()) {
            ensure(is_used(id), parts)?;
            references[id as usize] += 1;
        }
        // A parent is one less deep, so there is no ring.
        let follows = |node: &Node| {
            node.parent
                .is_none_or(|id| self.nodes[id as usize].depth.checked_add(1) == Some(node.depth))
        };
        let counted =
            |(index, node): (usize, &Node)| !used[index] || node.references == references[index];
        ensure(living().all(follows) && self.nodes.iter().enumerate().all(counted), parts)?;
        ensure(living().all(|node| node.references > 0), parts)?;
        ensure_poses(living().map(|node| node.pose_in_map), "the pose of a trajectory")?;
        let mut roots = living().filter(|node| node.parent.is_none()).map(|node| node.depth);
        let Some(root) = roots.next() else { return Ok(None) };
        ensure(roots.next().is_none(), parts)?;
        Ok(Some((root, living().map(|node| node.depth).fold(root, u32::max))))
    }

    /// Nodes in use.
    #[must_use]
    pub fn len(&self) -> usize {
        self.nodes.len() - self.unused.len()
    }

    /// Whether no node is in use.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pose(x: f64) -> Pose2 {
        Pose2::new(x, 0.0, 0.0)
    }

    #[test]
    fn dead_branches_are_reused_and_living_ones_kept() {
        let mut tree = TrajectoryTree::default();
        let root = tree.append(None, pose(0.0));
        let a = tree.append(Some(root), pose(1.0));
        let b = tree.append(Some(root), pose(2.0));
        tree.release(root);
        let b2 = tree.append(Some(b), pose(3.0));
        tree.release(b);
        assert_eq!(tree.common_ancestor(a, b2), Some(root));
        assert_eq!(tree.len(), 4);

        tree.release(b2);
        assert_eq!(tree.len(), 2);
        let poses: Vec<f64> = tree.ancestry(a).map(|id| tree.pose(id).x).collect();
        assert_eq!(poses, [1.0, 0.0]);

        tree.release(a);
        assert!(tree.is_empty());
    }

    #[test]
    fn a_new_root_has_no_ancestors_and_keeps_its_depth() {
        let mut tree = TrajectoryTree::default();
        let mut leaf = tree.append(None, pose(0.0));
        for i in 1..5 {
            let next = tree.append(Some(leaf), pose(f64::from(i)));
            tree.release(std::mem::replace(&mut leaf, next));
        }
        let root = tree.ancestor_at(leaf, 3);
        assert_eq!((tree.pose(root).x, tree.ancestor_at(leaf, 9)), (3.0, leaf));
        tree.cut_above(root);
        assert_eq!((tree.len(), tree.depth(leaf), tree.ancestor_at(leaf, 0)), (2, 4, leaf));
    }

    #[test]
    fn trajectories_without_a_common_root_have_no_common_ancestor() {
        let mut tree = TrajectoryTree::default();
        let (a, b) = (tree.append(None, pose(0.0)), tree.append(None, pose(0.0)));
        assert_eq!(tree.common_ancestor(a, b), None);
    }
}
