//! A particle: one hypothesis of the trajectory, with the map that follows from it.

use nalgebra::Matrix3;

use super::super::grid::hit_map::{HitMap, add_hit};
use super::super::grid::likelihood_field::LikelihoodField;
use super::super::known_map::KnownMap;
use super::super::odometry::{Motion, MotionNoise};
use super::super::pose::{Pose2, wrap_angle};
use super::compat::CompatMatcher;
use super::motion_model;
use super::prepared_scan::PreparedScan;
use super::random::{Gaussian, Purpose, Streams};
use super::scan_matcher::{FieldMatcher, Match, MatcherKind, MatcherParameters};
use super::trajectory::NodeId;

/// How far particles spread around the matched heading, in standard deviations of the match.
///
/// The matcher draws all particles to nearly the same pose, so that none is right when a loop
/// closes. Headings matter most there: an error of one degree is one metre after sixty. Sampling
/// all three dimensions (the paper's proposal, which the original never had) costs three times the
/// accuracy from step to step for the same spread at the end of a loop; see `docs/tuning.md`.
const HEADING_SPREAD: f64 = 2.0;

/// One hypothesis.
#[derive(Debug, Clone)]
pub struct Particle {
    pub(super) pose_in_map: Pose2,
    pub(super) covariance: Matrix3<f64>,
    pub(super) map: ParticleMap,
    /// Since the last resampling.
    pub(super) log_weight: f64,
    /// Since the start, ancestors included.
    pub(super) total_log_weight: f64,
    pub(super) node: NodeId,
    pub(super) score: f64,
    /// The last match was accepted.
    pub(super) matched: bool,
}

/// The map of a particle, as its matcher wants it; the other one stays empty.
#[derive(Debug, Clone, Default)]
pub(super) struct ParticleMap {
    pub(super) field: LikelihoodField,
    pub(super) hits: HitMap,
}

/// Matches scans with the maps of particles and enters them there.
#[derive(Debug, Clone)]
pub(super) enum ScanMatcher {
    Field(Box<FieldMatcher>),
    Compat(CompatMatcher),
}

/// What moves a particle from one processed scan to the next.
#[derive(Debug, Clone, Copy)]
pub(super) struct Step<'a> {
    pub(super) scan: &'a PreparedScan,
    pub(super) motion: Motion,
    pub(super) noise: MotionNoise,
    /// What a unit of log likelihood adds to the log weight.
    pub(super) weight_gain: f64,
    pub(super) minimum_score: f64,
    /// Number of the processed scan.
    pub(super) number: u64,
}

impl Particle {
    /// A particle at the start, with the map that is known there.
    pub(super) fn new(pose_in_map: Pose2, node: NodeId, map: ParticleMap) -> Self {
        Self {
            pose_in_map,
            covariance: Matrix3::zeros(),
            map,
            log_weight: 0.0,
            total_log_weight: 0.0,
            node,
            score: 0.0,
            matched: true,
        }
    }

    /// The base at the last processed scan.
    #[must_use]
    pub const fn pose_in_map(&self) -> Pose2 {
        self.pose_in_map
    }

    /// Uncertainty of the last scan match: m², m rad, rad²; x and y along the map's axes.
    #[must_use]
    pub const fn covariance(&self) -> &Matrix3<f64> {
        &self.covariance
    }

    /// Samples the motion, matches the scan, weights the particle and spreads its heading.
    ///
    /// A match whose score is not above `minimumScore` leaves the pose that odometry gave.
    pub(super) fn advance(
        &mut self,
        matcher: &ScanMatcher,
        step: &Step<'_>,
        streams: &Streams,
        index: usize,
    ) {
        let mut motion_noise = streams.gaussian(Purpose::Motion, step.number, index);
        let moved = motion_model::sample(&step.motion, &step.noise, &mut motion_noise);
        let start = self.pose_in_map * moved;
        let found = matcher.run(&self.map, step.scan, start);
        self.score = found.score;
        self.matched = found.score > step.minimum_score;
        self.covariance = found.covariance;
        self.pose_in_map = if self.matched {
            spread(&found, &mut streams.gaussian(Purpose::Proposal, step.number, index))
        } else {
            start
        };
        self.log_weight += step.weight_gain * found.log_likelihood;
        self.total_log_weight += step.weight_gain * found.log_likelihood;
    }
}

/// The matched pose with a heading drawn around the matched one, and the position that goes with
/// that heading: the mean of the match's Gaussian given the heading.
fn spread(found: &Match, gaussian: &mut Gaussian) -> Pose2 {
    let Pose2 { x, y, theta } = found.pose_in_map;
    let covariance = &found.covariance;
    let variance = covariance[(2, 2)];
    if variance <= 0.0 {
        return found.pose_in_map;
    }
    let turn = HEADING_SPREAD * variance.sqrt() * gaussian.draw();
    let share = turn / variance;
    Pose2::new(
        x + covariance[(0, 2)] * share,
        y + covariance[(1, 2)] * share,
        wrap_angle(theta + turn),
    )
}

impl ScanMatcher {
    pub(super) fn new(parameters: MatcherParameters, resolution: f64) -> Self {
        match parameters.kind {
            MatcherKind::Field => Self::Field(Box::new(FieldMatcher::new(parameters, resolution))),
            MatcherKind::Compat => Self::Compat(CompatMatcher::new(parameters, resolution)),
        }
    }

    /// A known map as particles have it.
    pub(super) fn map_of(&self, known: &KnownMap) -> ParticleMap {
        let (mut map, first) = (ParticleMap::default(), known.first());
        match self {
            Self::Field(matcher) => {
                let obstacles = known.obstacles().map(|[x, y]| (x as f32, y as f32));
                matcher.enter(&mut map.field, first, &obstacles.collect());
            }
            Self::Compat(_) => {
                known.obstacles().for_each(|point| add_hit(&mut map.hits, first, point));
            }
        }
        map
    }

    pub(super) fn run(&self, map: &ParticleMap, scan: &PreparedScan, start: Pose2) -> Match {
        match self {
            Self::Field(matcher) => matcher.run(&map.field, scan, start),
            Self::Compat(matcher) => matcher.run(&map.hits, scan, start),
        }
    }

    pub(super) fn register(&self, particle: &mut Particle, scan: &PreparedScan) {
        let pose = particle.pose_in_map;
        match self {
            Self::Field(matcher) => matcher.register(&mut particle.map.field, scan, pose),
            Self::Compat(matcher) => matcher.register(&mut particle.map.hits, scan, pose),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn found(covariance: Matrix3<f64>) -> Match {
        Match {
            pose_in_map: Pose2::new(1.0, 2.0, 3.0),
            covariance,
            log_likelihood: 0.0,
            score: 1.0,
        }
    }

    #[test]
    fn headings_spread_by_the_match_and_positions_follow_them() {
        let covariance = Matrix3::new(4.0, 0.0, 0.1, 0.0, 4.0, -0.2, 0.1, -0.2, 0.0025);
        let found = found(covariance);
        let mut gaussian = Streams::new(3).gaussian(Purpose::Proposal, 0, 0);
        let mut squares = 0.0;
        let n = 10_000;
        for _ in 0..n {
            let error = spread(&found, &mut gaussian);
            let turn = wrap_angle(error.theta - 3.0);
            squares += turn * turn;
            assert!((error.x - 1.0 - 0.1 / 0.0025 * turn).abs() < 1e-9);
            assert!((error.y - 2.0 + 0.2 / 0.0025 * turn).abs() < 1e-9);
        }
        let deviation = (squares / f64::from(n)).sqrt();
        assert!((deviation / 0.05 - HEADING_SPREAD).abs() < 0.05, "{deviation}");
    }

    #[test]
    fn a_match_without_covariance_is_taken_as_it_is() {
        let mut gaussian = Streams::new(3).gaussian(Purpose::Proposal, 0, 0);
        assert_eq!(spread(&found(Matrix3::zeros()), &mut gaussian), Pose2::new(1.0, 2.0, 3.0));
    }
}
