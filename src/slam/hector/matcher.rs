//! Where a scan was taken: by the map, and by what was known before.

use nalgebra::Matrix3;

use super::super::pose::Pose2;
use super::correlation::Search;
use super::gauss_newton::{Fit, Level, Problem};
use super::prediction::Prediction;
use super::prepared_scan::PreparedScan;
use super::pyramid::Pyramid;
use super::weakness::Weakness;

/// Steps on the coarse maps and on the finest, as in the original.
const COARSE_STEPS: usize = 4;
const FINE_STEPS: usize = 6;
/// A prediction that leaves what is seen unsure by this many of the coarsest cells may be beyond what
/// the descent sees: a search follows if the scan fits worse than usual, ...
const POOR: f64 = 0.5;
/// ... that is, by less than this share of the usual score.
const WORSE: f64 = 0.95;
/// With a prediction this unsure, a search is made at once.
const VERY_POOR: f64 = 6.0;
/// A match counts if 1 - (1 - M)² is at least this on average over the points, in the finest map or
/// in the coarsest, where beams leave no gaps; ...
const LEAST_EXPLAINED: f64 = 0.7;
/// ... where nothing is known it is this. A place further around counts if it is more, and as usual.
const SCORE_OF_NOTHING: f64 = 0.75;
/// What a residual weighs beside the prediction: 1 / its variance.
const GAIN: f64 = 1.0;
/// What a residual tells, once the pose is found: this makes the squared error, normalized,
/// what it should be in rooms and buildings, at noise of 1 cm and 3 cm and cells of 2.5 cm and 5 cm.
const CERTAINTY: f64 = 2.1;
/// What a hit in an occupied cell is worth to the search, nats.
const SEARCH_GAIN: f64 = 1.0;

/// A scan's place.
#[derive(Debug, Clone, Copy)]
pub struct Placed {
    /// The base in `map`.
    pub pose_in_map: Pose2,
    /// How sure that is: m², m rad, rad².
    pub covariance: Matrix3<f64>,
    /// Whether the map confirms it.
    pub matched: bool,
    /// Up to the number of points that were matched.
    pub score: f64,
    /// How many those are.
    pub points: f64,
    /// What the scan does not tell.
    pub weakness: Weakness,
}

impl Placed {
    /// The first scan is where it is said to be.
    #[must_use]
    pub fn first(scan: &PreparedScan, pose_in_map: Pose2) -> Self {
        let weakness = Weakness::of(&scan.hits, lever(&scan.hits));
        Self {
            pose_in_map,
            covariance: Matrix3::zeros(),
            matched: true,
            score: 0.0,
            points: 0.0,
            weakness,
        }
    }
}

/// The likeliest place of a scan, if scans usually score `expected` a point, up to 1.
///
/// A scan that contradicts the map is looked for further around, and if it fits nowhere as usual
/// either, it is nowhere in particular there.
#[must_use]
pub fn place(
    pyramid: &Pyramid,
    scan: &PreparedScan,
    prediction: &Prediction,
    expected: f64,
) -> Placed {
    let lever = lever(&scan.hits);
    let matcher = Matcher {
        weakness: Weakness::of(&scan.hits, lever),
        levels: pyramid.levels(scan, prediction.pose_in_map).collect(),
        lever,
    };
    let placed = matcher.place(prediction, expected);
    if placed.matched {
        return placed;
    }
    let lost = prediction.lost();
    let elsewhere = matcher.place(&lost, expected);
    if elsewhere.score > expected.max(SCORE_OF_NOTHING) * elsewhere.points {
        return elsewhere;
    }
    Placed { pose_in_map: lost.pose_in_map, covariance: lost.covariance, ..placed }
}

/// A scan and the maps it is matched with.
#[derive(Debug)]
struct Matcher<'a> {
    /// Coarsest first.
    levels: Vec<Level<'a>>,
    weakness: Weakness,
    lever: f64,
}

impl Matcher<'_> {
    fn place(&self, prediction: &Prediction, expected: f64) -> Placed {
        let &Self { ref levels, weakness, lever } = self;
        let &Prediction { pose_in_map, covariance } = prediction;
        let points = levels.last().map_or(0, |level| level.points().len()) as f64;
        let unknown =
            Placed { pose_in_map, covariance, matched: false, score: 0.0, points, weakness };
        let Some(prior) = prediction.prior() else { return unknown };
        let problem = Problem { prior: &prior, weakness: &weakness, lever, gain: GAIN };
        let deviations = prediction.deviations();
        let unsure = deviations[0].max(deviations[1] * lever) / levels[0].resolution();
        let search = || {
            let gain = SEARCH_GAIN;
            let search = Search { level: &levels[0], prior: &prior, deviations, lever, gain };
            descend(levels, &problem, search.run())
        };
        let (pose, fit) = if unsure > VERY_POOR {
            search()
        } else {
            let near = descend(levels, &problem, pose_in_map);
            let fits = points - near.1.cost >= WORSE * expected * points;
            let cost = |found: &(Pose2, Fit)| problem.cost(&found.1, found.0);
            let other = (unsure > POOR && !fits).then(search);
            other.filter(|other| cost(other) < cost(&near)).unwrap_or(near)
        };
        let score = points - fit.cost;
        let (hessian, _) = weakness.without(&fit, pose.theta);
        let information = CERTAINTY * hessian + prior.information;
        Placed {
            pose_in_map: pose,
            covariance: information.try_inverse().unwrap_or(covariance),
            matched: score >= LEAST_EXPLAINED * points
                || levels[0].explains(pose) >= LEAST_EXPLAINED,
            score,
            ..unknown
        }
    }
}

/// Coarse to fine.
fn descend(levels: &[Level<'_>], problem: &Problem<'_>, start: Pose2) -> (Pose2, Fit) {
    let (finest, coarse) = levels.split_last().expect("there is a finest level");
    let mut pose = start;
    for level in coarse {
        (pose, _) = level.descend(problem, pose, COARSE_STEPS);
    }
    finest.descend(problem, pose, FINE_STEPS)
}

/// Root mean square distance of the hits from the base, m.
#[must_use]
pub fn lever(hits: &[[f32; 2]]) -> f64 {
    let sum: f32 = hits.iter().map(|[x, y]| x * x + y * y).sum();
    (f64::from(sum) / hits.len().max(1) as f64).sqrt().max(0.1)
}
