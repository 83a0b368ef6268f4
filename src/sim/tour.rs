//! A tour of a building along its plan.

use std::collections::BTreeMap;

use rand::Rng;

use super::building::{Node, Plan, Room};
use super::shape::minus;
use crate::slam::pose::Point2;

/// How likely the robot enters a room it passes, the first time and later.
const ENTER: [f64; 2] = [0.6, 0.15];

/// Waypoints of a closed tour of about `length_m` metres.
pub(super) fn closed(plan: &Plan, length_m: f64, rng: &mut impl Rng) -> Vec<Point2> {
    let middle = plan.corridors().div_ceil(2);
    let start = (middle, middle);
    let mut walker = Walker::new(plan, start);
    while walker.length < 0.9 * length_m {
        let next = walker.next_node(rng);
        walker.go(next, rng);
    }
    while walker.at != start {
        let distance = |node: Node| node.0.abs_diff(start.0) + node.1.abs_diff(start.1);
        let nearer = walker.neighbours().into_iter().min_by_key(|node| distance(*node));
        walker.go(nearer.expect("every corridor leads somewhere"), rng);
    }
    // The last waypoint is the first of the next lap.
    walker.waypoints.pop();
    walker.waypoints
}

struct Walker<'a> {
    plan: &'a Plan,
    waypoints: Vec<Point2>,
    length: f64,
    at: Node,
    previous: Node,
    passed: BTreeMap<(Node, Node), u32>,
    entered: Vec<usize>,
}

impl<'a> Walker<'a> {
    fn new(plan: &'a Plan, start: Node) -> Self {
        Self {
            plan,
            waypoints: vec![plan.position(start)],
            length: 0.0,
            at: start,
            previous: start,
            passed: BTreeMap::new(),
            entered: vec![0; plan.rooms.len()],
        }
    }

    /// The nodes next to this one that a corridor leads to.
    fn neighbours(&self) -> Vec<Node> {
        let (column, row) = self.at;
        let inner = 1..=self.plan.corridors();
        let mut found = Vec::new();
        if inner.contains(&row) {
            found.extend(column.checked_sub(1).map(|left| (left, row)));
            found.extend((column <= self.plan.corridors()).then_some((column + 1, row)));
        }
        if inner.contains(&column) {
            found.extend(row.checked_sub(1).map(|below| (column, below)));
            found.extend((row <= self.plan.corridors()).then_some((column, row + 1)));
        }
        found
    }

    /// Prefers corridors that were passed less often, and those that lead on.
    fn next_node(&self, rng: &mut impl Rng) -> Node {
        let inner = 1..=self.plan.corridors();
        let mut cost = |node: Node| {
            let passed = self.passed.get(&ordered(self.at, node)).copied().unwrap_or(0);
            let dead_end = !inner.contains(&node.0) || !inner.contains(&node.1);
            let back = node == self.previous;
            f64::from(passed)
                + f64::from(dead_end)
                + if back { 100.0 } else { 0.0 }
                + rng.random::<f64>()
        };
        let costs = self.neighbours().into_iter().map(|node| (cost(node), node));
        costs.min_by(|a, b| a.0.total_cmp(&b.0)).expect("every corridor leads somewhere").1
    }

    /// Walks to a neighbour and enters some of the rooms on the way.
    fn go(&mut self, next: Node, rng: &mut impl Rng) {
        let plan = self.plan;
        let from = plan.position(self.at);
        let stretch = ordered(self.at, next);
        let along = |room: &Room| minus(room.visit[0], from).norm();
        let mut passed: Vec<usize> =
            (0..plan.rooms.len()).filter(|i| plan.rooms[*i].stretch == stretch).collect();
        passed.sort_by(|a, b| along(&plan.rooms[*a]).total_cmp(&along(&plan.rooms[*b])));
        for index in passed {
            if rng.random_bool(ENTER[self.entered[index].min(1)]) {
                self.entered[index] += 1;
                plan.rooms[index].visit.iter().for_each(|point| self.push(*point));
            }
        }
        self.push(plan.position(next));
        *self.passed.entry(stretch).or_default() += 1;
        (self.previous, self.at) = (self.at, next);
    }

    fn push(&mut self, point: Point2) {
        if let Some(last) = self.waypoints.last() {
            self.length += minus(point, *last).norm();
        }
        self.waypoints.push(point);
    }
}

fn ordered(a: Node, b: Node) -> (Node, Node) {
    (a.min(b), a.max(b))
}
