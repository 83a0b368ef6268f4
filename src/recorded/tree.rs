//! Which frame is the robot, and which is odometry's: told by the transforms themselves.

use std::collections::BTreeMap;

use nalgebra::Isometry3;

use super::choice::Topics;
use super::survey::Survey;
use crate::config::Config;
use crate::daemon::frames::FrameNames;
use crate::logs::recording::Kind;
use crate::tf::Transform;

/// A frame that is displaced by more than this in its parent, m and rad, moves: the others are
/// screwed on, and differ by rounding.
const MOVES: f64 = 1e-3;

/// Frames of a robot; more are nonsense.
const MOST_FRAMES: usize = 1000;

/// The frames that transforms name.
#[derive(Debug, Clone, Default)]
pub(super) struct Tree {
    /// By child.
    links: BTreeMap<String, Link>,
}

#[derive(Debug, Clone)]
struct Link {
    parent: String,
    first: Isometry3<f64>,
    moves: bool,
}

impl Tree {
    pub(super) const fn new() -> Self {
        Self { links: BTreeMap::new() }
    }

    pub(super) fn add(&mut self, transform: &Transform) {
        let name = |frame: &str| frame.trim_start_matches('/').to_owned();
        let (parent, child) = (name(&transform.parent), name(&transform.child));
        let place = transform.parent_from_child;
        if self.links.len() >= MOST_FRAMES && !self.links.contains_key(&child) {
            return;
        }
        let link = self.links.entry(child).or_insert_with(|| Link {
            parent: parent.clone(),
            first: place,
            moves: false,
        });
        let motion = link.first.inv_mul(&place);
        link.moves |= motion.translation.vector.norm() > MOVES || motion.rotation.angle() > MOVES;
        link.parent = parent;
    }

    fn knows(&self, frame: &str) -> bool {
        self.links.contains_key(frame) || self.links.values().any(|link| link.parent == frame)
    }

    /// A frame and all it hangs from, up to the root.
    fn chain<'a>(&'a self, frame: &'a str) -> Vec<&'a str> {
        let mut chain = vec![frame];
        while let Some(link) = chain.last().and_then(|frame| self.links.get(*frame)) {
            if chain.contains(&link.parent.as_str()) {
                break;
            }
            chain.push(&link.parent);
        }
        chain
    }

    /// The frame in which the robot of a laser moves: the parent of the first frame that moves on
    /// the way from the laser to the root, or the root of a robot that stands.
    fn odometry_of(&self, chain: &[&str]) -> Option<String> {
        let moves = |frame: &&&str| self.links.get(**frame).is_some_and(|link| link.moves);
        let moving = chain.iter().find(moves).and_then(|frame| self.links.get(*frame));
        moving.map(|link| link.parent.clone()).or_else(|| chain.last().map(|&root| root.to_owned()))
    }
}

/// The frames of a recording: those of the configuration where the recording knows them.
pub(super) fn frame_names(survey: &Survey, topics: &Topics, config: &Config) -> FrameNames {
    let mut tree = Tree::new();
    for (_, topic) in survey.topics.iter().filter(|(name, _)| topics.names(name)) {
        tree.links.extend(topic.tree.links.clone());
    }
    let frame = |name: &str, kind| {
        let topic = survey.topics.get(name).filter(|topic| topic.kind == kind)?;
        topic.frame.clone().filter(|frame| !frame.is_empty())
    };
    let laser = frame(&topics.scan, Kind::LaserScan).unwrap_or_default();
    let chain = tree.chain(&laser);
    let name = |name: &String| name.trim_start_matches('/').to_owned();
    // Given poses are those in the map's frame, and no others.
    let in_map = config.raw.odom_frame == config.raw.map_frame;
    let configured = (name(&config.raw.odom_frame), name(&config.raw.base_frame));
    let odom = Some(configured.0.clone())
        .filter(|odom| chain.contains(&odom.as_str()))
        .or_else(|| tree.odometry_of(&chain).filter(|_| chain.len() > 1 && !in_map))
        .unwrap_or(configured.0);
    let told = topics.odometry.as_deref().and_then(|topic| frame(topic, Kind::Odometry));
    let below =
        chain.iter().position(|frame| *frame == odom).and_then(|place| place.checked_sub(1));
    let base = Some(configured.1.clone())
        .filter(|base| tree.knows(base) || *base == laser)
        .or_else(|| told.filter(|base| tree.knows(base) || *base == laser))
        .or_else(|| below.map(|place| chain[place].to_owned()))
        .unwrap_or(configured.1);
    FrameNames { base, odom }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::slam::pose::Stamp;

    fn tree(links: &[(&str, &str, f64)]) -> Tree {
        let mut tree = Tree::new();
        for &(parent, child, x) in links {
            tree.add(&Transform {
                parent: parent.to_owned(),
                child: child.to_owned(),
                stamp: Stamp(0),
                parent_from_child: Isometry3::translation(x, 0.0, 0.0),
            });
        }
        tree
    }

    #[test]
    fn odometry_is_what_the_robot_moves_in_and_not_the_map() {
        let tree = tree(&[
            ("map", "world", 0.0),
            ("world", "foot", 1.0),
            ("/foot", "body", 0.1),
            ("body", "laser", 0.2),
            ("map", "world", 0.3),
            ("world", "foot", 1.5),
            ("body", "laser", 0.2),
        ]);
        let chain = tree.chain("laser");
        assert_eq!(chain, ["laser", "body", "foot", "world", "map"]);
        assert_eq!(tree.odometry_of(&chain).as_deref(), Some("world"));
    }

    #[test]
    fn a_robot_that_stands_stands_in_the_root() {
        let tree = tree(&[("world", "foot", 1.0), ("foot", "laser", 0.1)]);
        assert_eq!(tree.odometry_of(&tree.chain("laser")).as_deref(), Some("world"));
    }

    #[test]
    fn a_ring_of_frames_ends() {
        let tree = tree(&[("a", "b", 0.0), ("b", "a", 0.0)]);
        assert_eq!(tree.chain("a"), ["a", "b"]);
    }
}
