//! What every engine takes, and what it says became of it.

use serde::{Deserialize, Serialize};

use super::pose::Pose2;
use super::scan::{LaserMount, Scan};

/// A scan with the odometry of its stamp.
#[derive(Debug, Clone, Copy)]
pub struct ScanReading<'a> {
    /// The sweep.
    pub scan: &'a Scan,
    /// How the laser sits on the robot.
    pub mount: &'a LaserMount,
    /// Where odometry says the base was when the sweep was taken.
    pub odom_from_base: Pose2,
}

/// What became of an odometry reading.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum OdometryUpdate {
    /// Its motion counts.
    Accepted,
    /// It moved further than [`JumpGuard::max_step`](super::odometry::JumpGuard::max_step); the step was taken out.
    JumpRejected,
    /// It is not finite, or further from the origin than any robot gets; it was ignored.
    NotUsable,
}

/// What became of a scan.
#[derive(Debug, Clone, PartialEq)]
pub enum ScanUpdate {
    /// The pose follows from it; it is in the map where [`ScanReport::registered`] says so.
    Processed(ScanReport),
    /// It is not, for this reason.
    Skipped(SkipReason),
}

/// Figures about a processed scan.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ScanReport {
    /// Hits that were matched.
    pub hits: usize,
    /// Hypotheses whose match was accepted; the others went on with odometry.
    pub matched: usize,
    /// Score of the best hypothesis' match, up to `hits`.
    pub best_score: f64,
    /// 1 / Σ wᵢ² before resampling, between 1 and the number of hypotheses.
    pub effective_sample_size: f64,
    /// −Σ wᵢ ln wᵢ before resampling, nats.
    pub entropy: f64,
    /// Whether particles were drawn anew.
    pub resampled: bool,
    /// Whether the scan entered the map; GMapping enters each that it processes.
    pub registered: bool,
    /// The motion that the scan tells nothing about, if there is one and the engine looks for it.
    pub weak_direction: Option<WeakDirection>,
}

/// A motion of the base that changes nothing of what its laser sees, as along a corridor.
///
/// A unit vector: x² + y² + turn² = 1.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct WeakDirection {
    /// Its part along the x axis of `map`.
    pub x: f64,
    /// Its part along the y axis of `map`.
    pub y: f64,
    /// Its part that turns: the angle times the root mean square distance of what is seen.
    pub turn: f64,
}

/// Why a scan was not processed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum SkipReason {
    /// Not the n-th scan that `throttle_scans` asks for.
    Throttled,
    /// The motion gate is closed.
    NotMovedEnough,
    /// No beam is a hit within `maxUrange`.
    NoUsableBeams,
    /// The odometry pose is not usable, or there is none and the engine needs one.
    BadOdometry,
}

/// The parts of processing a scan, in order; reported when each ends. An engine may lack some.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Phase {
    /// Scan matching, and weighting of all particles.
    Match,
    /// Normalisation, resampling and the trajectory tree.
    Resample,
    /// The scan enters each particle's map.
    Register,
    /// The scan enters the output map; with several threads while it enters those of the particles.
    Map,
}

/// Called as each phase of processing a scan ends.
pub type OnPhase<'a> = &'a mut (dyn FnMut(Phase) + Send);
